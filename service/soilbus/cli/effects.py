"""`soilbus effects`: the catalogue of effects as rows, text and JSON."""

from __future__ import annotations

import argparse
import textwrap
from collections.abc import Iterable
from typing import Any

from soilbus.cli.common import report
from soilbus.config.model import ConfigError
from soilbus.report.table import table
from soilbus.terra.effects.catalogue import CATALOGUE
from soilbus.terra.effects.effect import Effect
from soilbus.words import did_you_mean

WIDTH = 100
"""Characters of a line."""
HEAD = ("parameter", "unit", "absent at", "prior std", "range")
"""Of each column of parameter_rows()."""


def effects(args: argparse.Namespace) -> None:
    """Run `soilbus effects`: the catalogue, or one effect in full."""
    if args.name is not None and args.name not in CATALOGUE:
        raise ConfigError([f"no effect {args.name}{did_you_mean(args.name, CATALOGUE)}"])
    wanted = [CATALOGUE[args.name]] if args.name else list(CATALOGUE.values())
    report(args.json, effect_records(wanted), effect_text(wanted[0]) if args.name else overview(wanted))


def parameter_rows(effect: Effect) -> list[tuple[str, ...]]:
    """Return each parameter of an effect: name, unit, value at which the effect is absent, prior std, range."""
    of = effect.parameters
    return [(p.name, p.unit or "–", f"{p.neutral:g}", f"{p.std:g}", f"{p.low:g} to {p.high:g}") for p in of]


def effect_text(effect: Effect) -> str:
    """Return one effect in full, as text."""
    physics, *texts = effect.physics, f"Shown by: {effect.tells}", f"Source: {effect.source}"
    parts = [effect.name, textwrap.fill(physics, WIDTH), table(HEAD, parameter_rows(effect)).rstrip("\n")]
    return "\n\n".join([*parts, *(textwrap.fill(text, WIDTH) for text in texts)]) + "\n"


def overview(effects: Iterable[Effect]) -> str:
    """Return a row for each effect: name and physics."""
    rows = [(effect.name, effect.physics.partition(": ")[0].rstrip(".")) for effect in effects]
    more = "\nsoilbus effects NAME: parameters, units, ranges, what tells it apart, source; --json OUT: all of them\n"
    return table(("effect", "physics"), rows) + more


def effect_records(effects: Iterable[Effect]) -> list[dict[str, Any]]:
    """Return all that the catalogue says of effects, for JSON."""
    records = []
    for of in effects:
        parameters = [
            {"name": p.name, "unit": p.unit, "absent_at": p.neutral, "std": p.std, "range": [p.low, p.high]}
            for p in of.parameters
        ]
        head = {"name": of.name, "physics": of.physics, "parameters": parameters}
        records.append({**head, "shown_by": of.tells, "source": of.source})
    return records
