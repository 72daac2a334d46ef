"""The soil prior as a table: 95 % interval of each parameter, and the table's soils outside it.

    low, high = median exp(-+1.96 log_std)

A soil outside an interval is where a badly determined parameter would stay near the prior, with too small an sd.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

from soilbus.config.model import Config
from soilbus.estimation.assembly import prior_of
from soilbus.estimation.posterior import NORMAL_95, PARAMETERS
from soilbus.pipeline.outputs import PARAMETER_FRAMES
from soilbus.report.table import table
from soilbus.terra.soils import KINDS, SOILS

MAX_SOILS_NAMED = 3
"""Soils outside an interval that are named; the others are counted."""


def prior_text(config: Config) -> str:
    """Return the 95 % interval of each parameter before any data, and the known soils that lie outside of it."""
    head = ("parameter", "assumed", "95 % from", "to", "unit", "known soils outside")
    return (
        table(head, list(_rows(config)))
        + "\nOn a soil outside, a badly determined parameter stays near the prior, with a deviation too small; set"
        "\n[soil] there.  Bearing pressure, drafts and slopes depend on what the sensors determine well."
    )


def _rows(config: Config) -> Iterator[tuple[str, ...]]:
    prior = prior_of(config)
    for name, median, log_std in zip(PARAMETERS, prior.median.tolist(), prior.log_std.tolist(), strict=True):
        _, unit, size = PARAMETER_FRAMES[name]
        low, high = (median * math.exp(way * NORMAL_95 * log_std) for way in (-1.0, 1.0))
        if log_std == 0.0:
            yield name, f"{median / size:.3g}", "held", "", unit, ""
            continue
        values = {kind: getattr(SOILS[kind], name) for kind in KINDS}
        outside = sorted((kind for kind, v in values.items() if not low <= v <= high), key=lambda kind: -values[kind])
        named = ", ".join(f"{kind} ({values[kind] / size:.3g})" for kind in outside[:MAX_SOILS_NAMED])
        more = f" and {len(outside) - MAX_SOILS_NAMED} more" if len(outside) > MAX_SOILS_NAMED else ""
        yield name, f"{median / size:.3g}", f"{low / size:.3g}", f"{high / size:.3g}", unit, named + more or "none"
