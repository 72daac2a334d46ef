"""A completed model as the tables that a configuration's model.effects takes."""

from __future__ import annotations

from typing import Any

from soilbus.diagnosis.fitted_model import FittedModel
from soilbus.estimation.posterior import Estimate

DIGITS = 6


def effect_tables(completion: FittedModel) -> tuple[list[dict[str, Any]], list[str]]:
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
        kept: dict[str, Any] = {}
        gone: list[str] = []
        for p in effect.parameters:
            names = {w: f"{p.name}_{w}" for w in wheels} if effect.each_wheel else {"": p.name}
            if effect.of_record or p.of_record:
                gone += [f"{name} = {found[name]['value']:g}" for name in names.values()]
            else:
                kept[p.name] = {w: found[n] for w, n in names.items()} if effect.each_wheel else found[p.name]
        if gone:
            notes.append(f"{effect.name} ({', '.join(gone)}) describes the recording only and is left out")
        if kept:
            tables.append({"name": effect.name, **kept})
    return tables, notes


def _told(estimate: Estimate) -> dict[str, float]:
    told = {"value": estimate.value} if estimate.std == 0.0 else {"value": estimate.value, "std": estimate.std}
    return {name: float(f"{number:.{DIGITS}g}") for name, number in told.items()}
