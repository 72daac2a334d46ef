"""A completed model as the tables that a configuration's model.effects takes."""

from __future__ import annotations

from typing import Any

from soilbus.diagnosis.completion import Completion
from soilbus.estimation.posterior import Estimate

DIGITS = 6


def effect_tables(completion: Completion) -> tuple[list[dict[str, Any]], list[str]]:
    """A table for each effect, {name, parameter = {value, std}}, and notes on those left out.

    A parameter that every wheel has for itself is a table by wheel.  Left out is what
    describes the ground of the recording only: it means nothing on other ground.
    """
    tables: list[dict[str, Any]] = []
    notes: list[str] = []
    values = completion.parameters()
    wheels = completion.checks[-1].problem.rig.wheels
    for effect in completion.effects:
        found = {name: _told(estimate) for name, estimate in values[effect.name].items()}
        if effect.of_record:
            told = ", ".join(f"{name} = {value['value']:g}" for name, value in found.items())
            notes.append(f"{effect.name} ({told}) describes the ground of the recording only and is left out")
        elif effect.each_wheel:
            by_wheel = {p.name: {w: found[f"{p.name}_{w}"] for w in wheels} for p in effect.parameters}
            tables.append({"name": effect.name, **by_wheel})
        else:
            tables.append({"name": effect.name, **found})
    return tables, notes


def _told(estimate: Estimate) -> dict[str, float]:
    told = {"value": estimate.value} if estimate.std == 0.0 else {"value": estimate.value, "std": estimate.std}
    return {name: float(f"{number:.{DIGITS}g}") for name, number in told.items()}
