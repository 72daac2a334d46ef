"""What a window's record holds, key by key: kind and unit, for every file format that wants to know.

    window_record -> flat_record -> row;    column(key) -> kind and unit of a row's entry

A key is the path to a value, parts joined by dots, as in `soil.phi.value`; `*` stands for a wheel, an axle, a soil, a
reason, or the place in a list.  tests/export holds that every key of a record is described here.
"""

from __future__ import annotations

from fnmatch import fnmatchcase
from functools import cache
from typing import Literal, NamedTuple

__all__ = ["SCHEMA_VERSION", "Column", "column", "is_part"]

SCHEMA_VERSION = "1"
"""Version of the records' keys, kinds and units; a reader of another one must not assume this table."""

Kind = Literal["text", "number", "integer", "truth", "time"]


class Column(NamedTuple):
    """Kind of a value and its unit: "1" of a ratio, count or probability, "" of no number.

    A `time` is an integer, milliseconds since 1970 (UTC).
    """

    kind: Kind
    unit: str


_TEXT, _TRUTH, _COUNT, _RATIO = Column("text", ""), Column("truth", ""), Column("integer", "1"), Column("number", "1")
_COLUMNS: tuple[tuple[str, Column], ...] = (
    ("t", Column("number", "s")),
    ("window", _COUNT),
    ("samples", _COUNT),
    ("rejected.*", _COUNT),
    ("log", _TEXT),
    ("status", _TEXT),
    ("state", _TEXT),
    ("reason", _TEXT),
    ("soil_change.state", _TEXT),
    ("soil_change.reason", _TEXT),
    ("soil_change.statistic", _RATIO),
    ("soil_change.threshold", _RATIO),
    ("traversability.state", _TEXT),
    ("warning.state", _TEXT),
    ("traversability.limit", _TEXT),
    ("traversability.contradicted", _TEXT),
    ("solver.termination", _TEXT),
    ("solver.evaluations", _COUNT),
    ("search_ended", _TRUTH),
    ("bearing_pressure.extrapolates", _TRUTH),
    ("soil.k_c.*", Column("number", "N/m^(n+1)")),
    ("soil.k_phi.*", Column("number", "N/m^(n+2)")),
    ("soil.n.*", _RATIO),
    ("soil.phi.*", Column("number", "rad")),
    ("soil.c.*", Column("number", "Pa")),
    ("soil.K.*", Column("number", "m")),
    ("bearing_pressure.?_ref", Column("number", "m")),
    ("bearing_pressure.z_driven*", Column("number", "m")),
    ("bearing_pressure.*", Column("number", "Pa")),
    ("soil_class.*", _RATIO),
    ("slip.*", _RATIO),
    ("sinkage.*", Column("number", "m")),
    ("traversability.probability", _RATIO),
    ("traversability.torque_*", Column("number", "N m")),
    ("traversability.max_draft.*", Column("number", "N")),
    ("traversability.max_grade.*", Column("number", "rad")),
    ("traversability.age", Column("number", "s")),
    ("traversability.since_valid", Column("number", "s")),
    ("gaps.*", _RATIO),
    ("prediction_error.*", _RATIO),
    ("noise_factors.*", _RATIO),
    ("standing.relaxation_length.*", Column("number", "m")),
    ("standing.wheel_inertia.*", Column("number", "kg m^2")),
    ("standing.lateness.*", Column("number", "s")),
    ("warning.time_left", Column("number", "s")),
    ("warning.since", Column("number", "s")),
    ("warning.begun*", Column("number", "s")),
    ("capability.max_draft_here.*", Column("number", "N")),
    ("capability.max_grade_with_draft.*", Column("number", "rad")),
    ("capability.set_points.*", _RATIO),
    ("capability.forecast.slip.*", _RATIO),
    ("capability.forecast.torque.*", Column("number", "N m")),
    ("capability.forecast.sinkage.*", Column("number", "m")),
    ("capability.over_slip.slip*", _RATIO),
    ("capability.over_slip.pull*", Column("number", "N")),
    ("capability.over_slip.torque*", Column("number", "N m")),
    ("chi2", _RATIO),
    ("time", Column("time", "")),
    ("longitude", Column("number", "deg")),
    ("latitude", Column("number", "deg")),
    ("vehicle", _TEXT),
    ("day", _TEXT),
    ("configuration", _TEXT),
    ("fault", _TEXT),
    ("effect", _TEXT),
    ("scope", _TEXT),
    ("parameter", _TEXT),
    ("value", Column("number", "")),
    ("std", Column("number", "")),
    ("probability", _RATIO),
    ("named", _TRUTH),
    ("since", _TEXT),
    ("begin", Column("time", "")),
    ("end", Column("time", "")),
    ("duration", Column("number", "s")),
    ("logs.*", _COUNT),
    ("windows", _COUNT),
    ("windows.*", _COUNT),
    ("frames.*", _COUNT),
)
"""First match counts.  From `time` on: what `soilbus batch` adds to windows, and its summaries of logs and vehicles."""


@cache
def column(key: str) -> Column | None:
    """Return the kind and unit of a key; None where it is no key of a record."""
    return next((found for pattern, found in _COLUMNS if fnmatchcase(key, pattern)), None)


@cache
def is_part(key: str) -> bool:
    """Return whether a key is that of a part with values below it, such as `soil`."""
    return column(key) is None and any(pattern.startswith(f"{key}.") for pattern, _ in _COLUMNS)
