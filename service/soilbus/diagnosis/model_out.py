"""A fitted model as the tables that model.effects of a configuration takes."""

from __future__ import annotations

from typing import Any

from soilbus.diagnosis.fitted_model import FittedModel
from soilbus.estimation.posterior import Estimate

SIGNIFICANT_DIGITS = 6
"""Of values and std as written."""


def effect_tables(fitted: FittedModel) -> tuple[list[dict[str, Any]], list[str]]:
    """The effects of a fitted model for a configuration.

    Returns
    -------
    list of dict
        A table for each effect, {name, parameter = {value, std}}; a parameter that every wheel has for itself is a
        table by wheel.  One at the edge of its range, where the data leave no std, keeps that of its prior: it is not
        held there for ever.
    list of str
        Notes on what is left out: what describes the recording only, as its ground, or how a zero wandered in it.
    """
    tables: list[dict[str, Any]] = []
    notes: list[str] = []
    values, priors = fitted.parameters(), fitted.prior_parameters()
    wheels = fitted.checks[-1].problem.rig.wheels
    for effect in fitted.effects:
        of_effect = values[effect.name]
        found = {name: _value_table(of_effect[name], prior.std) for name, prior in priors[effect.name].items()}
        kept: dict[str, Any] = {}
        left_out: list[str] = []
        for p in effect.parameters:
            names = {w: f"{p.name}_{w}" for w in wheels} if effect.each_wheel else {"": p.name}
            if effect.of_record or p.of_record:
                left_out += [f"{name} = {found[name]['value']:g}" for name in names.values()]
            else:
                kept[p.name] = {w: found[n] for w, n in names.items()} if effect.each_wheel else found[p.name]
        if left_out:
            notes.append(f"{effect.name} ({', '.join(left_out)}) describes the recording only and is left out")
        if kept:
            tables.append({"name": effect.name, **kept})
    notes += [
        f"{f.effect} is to be doubted: {f.parameter.name} = {f.value:g} is the edge of what is possible"
        for f in fitted.at_limits
    ]
    return tables, notes


def _value_table(estimate: Estimate, prior_std: float) -> dict[str, float]:
    std = estimate.std or prior_std
    table = {"value": estimate.value, "std": std} if std > 0.0 else {"value": estimate.value}
    return {name: float(f"{number:.{SIGNIFICANT_DIGITS}g}") for name, number in table.items()}
