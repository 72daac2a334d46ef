"""A completed model as the tables that a configuration's model.effects takes."""

from __future__ import annotations

from typing import Any

from soilbus.diagnosis.completion import Completion
from soilbus.estimation.posterior import Estimate

DIGITS = 6


def effect_tables(completion: Completion) -> tuple[list[dict[str, Any]], list[str]]:
    """A table for each effect, {name, parameter = {value, std}}, and notes on those left out.

    A parameter that every wheel has for itself is a table by wheel.  Left out is what
    describes the recording only: its ground, how a zero wandered in it.
    """
    tables: list[dict[str, Any]] = []
    notes: list[str] = []
    values = completion.parameters()
    wheels = completion.checks[-1].problem.rig.wheels
    for effect in completion.effects:
        found = {name: _told(estimate) for name, estimate in values[effect.name].items()}
        kept = [p for p in effect.parameters if not (effect.of_record or p.of_record)]
        names = {p: [f"{p.name}_{w}" for w in wheels] if effect.each_wheel else [p.name] for p in effect.parameters}
        gone = ", ".join(f"{n} = {found[n]['value']:g}" for p in effect.parameters if p not in kept for n in names[p])
        if gone:
            notes.append(f"{effect.name} ({gone}) describes the recording only and is left out")
        if effect.each_wheel:
            tables.append({"name": effect.name} | {p.name: {w: found[f"{p.name}_{w}"] for w in wheels} for p in kept})
        elif kept:
            tables.append({"name": effect.name} | {p.name: found[p.name] for p in kept})
    return tables, notes


def _told(estimate: Estimate) -> dict[str, float]:
    told = {"value": estimate.value} if estimate.std == 0.0 else {"value": estimate.value, "std": estimate.std}
    return {name: float(f"{number:.{DIGITS}g}") for name, number in told.items()}
