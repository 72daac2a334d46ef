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


_KEYS: dict[Column, tuple[str, ...]] = {
    Column("text", ""): (
        "log", "status", "state", "reason", "soil_change.state", "soil_change.reason", "traversability.state",
        "warning.state", "traversability.limit", "traversability.contradicted", "solver.termination", "vehicle", "day",
        "configuration", "fault", "effect", "scope", "parameter", "since",
    ),
    Column("truth", ""): ("search_ended", "bearing_pressure.extrapolates", "named"),
    Column("integer", "1"): (
        "window", "samples", "rejected.*", "solver.evaluations", "logs.*", "windows", "windows.*", "frames.*",
    ),
    Column("number", "1"): (
        "soil_change.statistic", "soil_change.threshold", "soil.n.*", "soil_class.*", "slip.*",
        "traversability.probability", "gaps.*", "prediction_error.*", "noise_factors.*", "capability.set_points.*",
        "capability.forecast.slip.*", "capability.over_slip.slip*", "chi2", "probability",
    ),
    Column("number", "s"): (
        "t", "traversability.age", "traversability.since_valid", "standing.lateness.*", "warning.time_left",
        "warning.since", "warning.begun*", "duration",
    ),
    Column("number", "m"): (
        "soil.K.*", "bearing_pressure.?_ref", "bearing_pressure.z_driven*", "sinkage.*",
        "standing.relaxation_length.*", "capability.forecast.sinkage.*",
    ),
    Column("number", "N/m^(n+1)"): ("soil.k_c.*",),
    Column("number", "N/m^(n+2)"): ("soil.k_phi.*",),
    Column("number", "Pa"): ("soil.c.*", "bearing_pressure.*"),
    Column("number", "rad"): ("soil.phi.*", "traversability.max_grade.*", "capability.max_grade_with_draft.*"),
    Column("number", "deg"): ("longitude", "latitude"),
    Column("number", "N"): (
        "traversability.max_draft.*", "capability.max_draft_here.*", "capability.over_slip.pull*",
    ),
    Column("number", "N m"): (
        "traversability.torque_*", "capability.forecast.torque.*", "capability.over_slip.torque*",
    ),
    Column("number", "kg m^2"): ("standing.wheel_inertia.*",),
    Column("number", ""): ("value", "std"),
    Column("time", ""): ("time", "begin", "end"),
}  # fmt: skip
"""Keys by kind and unit, those that `soilbus batch` adds too; the first match counts."""
_COLUMNS = [(pattern, found) for found, patterns in _KEYS.items() for pattern in patterns]


@cache
def column(key: str) -> Column | None:
    """Return the kind and unit of a key; None where it is no key of a record."""
    return next((found for pattern, found in _COLUMNS if fnmatchcase(key, pattern)), None)


@cache
def is_part(key: str) -> bool:
    """Return whether a key is that of a part with values below it, such as `soil`."""
    return column(key) is None and any(pattern.startswith(f"{key}.") for pattern, _ in _COLUMNS)
