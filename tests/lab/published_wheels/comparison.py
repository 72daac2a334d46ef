"""`python -m tests.lab.published_wheels POINTS`: what the model misses on published single-wheel points.

POINTS is shared/field/single-wheel-published.csv: five or six rows a wheel, traced
by eye from figures.  So each line holds only for these few rows and the errors assumed in
rigs/*.toml.  Where the soil is from the other wheel, that wheel's posterior of soil and effects is
the prior: a missing effect is then a difference between the two wheels.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from soilbus.config.file import load_config
from soilbus.config.model import Config
from soilbus.diagnosis.diagnose import Diagnosis, diagnose
from soilbus.diagnosis.fitted_model import FittedModel, fit_model
from soilbus.diagnosis.records import Record
from soilbus.diagnosis.verdict import gap_limit
from soilbus.estimation.assembly import prior_of
from soilbus.offline.tables import candidates, recordings_of_tables
from soilbus.report.table import table
from soilbus.terra.effects.catalogue import CATALOGUE

RIGS = Path(__file__).with_name("rigs")
LUG = 0.01
"""Height of the lugs [m] of the two rigs that had both wheels."""

ERRORS = (1.0, 2.0)
"""Assumed errors in units of those in rigs/*.toml: a finding should outlive twice the error."""


@dataclass(frozen=True)
class Case:
    """One wheel's points, with errors times those of its rig.

    soil: "tests" where published soil tests were the prior, else the wheel that was fitted
    before in the same soil.
    """

    rig: str
    wheel: str
    soil: str
    errors: float
    found: Diagnosis


def cases(errors: float, points: Path) -> Iterator[Case]:
    """Every wheel by itself, then each after the other in the same soil."""
    for rig in ("ding2011", "kls1"):
        alone: dict[str, Diagnosis] = {}
        for wheel in ("smooth", "lugged"):
            alone[wheel] = diagnosed(rig, wheel, errors, points)
            yield Case(rig, wheel, "tests", errors, alone[wheel])
        for wheel, other in (("lugged", "smooth"), ("smooth", "lugged")):
            found = diagnosed(rig, wheel, errors, points, alone[other].completed)
            yield Case(rig, wheel, f"{other} wheel", errors, found)
    yield Case("rashid1", "lugged", "tests", errors, diagnosed("rashid1", "lugged", errors, points))


def configuration(rig: str, wheel: str, errors: float = 1.0) -> Config:
    """A rig's configuration for the rows of one wheel."""
    config = load_config(RIGS / f"{rig}.toml")
    noise = config.noise.model_dump()
    changes = [f"noise.{name}.absolute={errors * noise[name]['absolute']}" for name in ("draft", "torque", "sinkage")]
    if rig != "rashid1":
        changes.append(f"table.where.grouser_height_m={LUG if wheel == 'lugged' else 0.0}")
    return load_config(RIGS / f"{rig}.toml", changes)


def diagnosed(rig: str, wheel: str, errors: float, points: Path, other_wheel: FittedModel | None = None) -> Diagnosis:
    """The diagnosis of one wheel's points; `other_wheel` is the model fitted to another wheel on the same soil."""
    config = configuration(rig, wheel, errors)
    records = records_of(config, points, other_wheel)
    return diagnose(records, prior_of(config), candidates(config, records))


def records_of(config: Config, points: Path, other_wheel: FittedModel | None = None) -> tuple[Record, ...]:
    """One wheel's points; `other_wheel` as of diagnosed()."""
    records = recordings_of_tables(config, [points]).records
    if other_wheel is None:
        return records
    return tuple(r.with_effects(other_wheel.effects, other_wheel.free, other_wheel.fits[-1].mode) for r in records)


class Beside(NamedTuple):
    """What one effect beside those known does for the other wheel: fall of -2 log evidence, strain left of the soil."""

    fall: float
    strain: float


def lugs_beside_a_shifted_peak(errors: float, points: Path) -> dict[str, Beside]:
    """Ding's lugged wheel with soil and slip sinkage as the smooth one had them: what each name then adds.

    "nothing" is the known model by itself.
    """
    config = configuration("ding2011", "smooth", errors)
    smooth = fit_model(records_of(config, points), prior_of(config), [CATALOGUE["slip_sinkage"]])
    assert smooth is not None
    config = configuration("ding2011", "lugged", errors)
    records, prior = records_of(config, points, smooth), prior_of(config)
    fits = {
        name: fit_model(records, prior, [*smooth.effects, *(CATALOGUE[n] for n in added)])
        for name, *added in (("nothing",), ("lugs", "lugs"), ("stress_peak_shift", "stress_peak_shift"))
    }
    known = fits["nothing"]
    assert known is not None
    return {
        n: Beside(known.neg2_log_evidence - fit.neg2_log_evidence, strain(fit))
        for n, fit in fits.items()
        if fit is not None
    }


def strain(fitted: FittedModel) -> float:
    """Distance of the soil's posterior mean from its prior mean, as chi-square per parameter."""
    before, after = fitted.priors[-1], fitted.fits[-1].mode
    free = np.flatnonzero(np.diag(before.covariance)[:6] > 0.0)
    off = np.log(after.soil[free] / before.soil[free])
    return float(off @ np.linalg.solve(before.covariance[np.ix_(free, free)], off)) / len(free)


def tabulated(found: Sequence[Case]) -> str:
    """A row for each case."""
    head = (
        "rig",
        "wheel",
        "soil from",
        "errors",
        "gap",
        "noise below",
        "soil strained",
        "verdict",
        "effects",
        "beside",
    )
    return table(head, [_row(case) for case in found])


def _row(case: Case) -> tuple[str, ...]:
    found, base = case.found, case.found.base
    had = "".join(f"{name} known; " for name in base.names)
    added = ", ".join(f"{a.effect.name} {a.falls[a.effect.name]:.0f} (p {a.probability:.2f})" for a in found.additions)
    first = found.additions[0] if found.additions else None
    falls = sorted(first.falls.items(), key=lambda item: -item[1]) if first else []
    return (
        case.rig,
        case.wheel,
        case.soil,
        f"x{case.errors:g}",
        f"{base.held_out_chi2:.1f} -> {found.completed.held_out_chi2:.1f}",
        f"{gap_limit(base.checked_rows):.1f}",
        f"{strain(base):.1f} -> {strain(found.completed):.1f}",
        str(found.verdict),
        (had + (added or "none added")).strip(),
        ", ".join(f"{name} {fall:.0f}" for name, fall in falls if first and name != first.effect.name)[:60] or "-",
    )


def soils(found: Sequence[Case]) -> str:
    """Soil and effects' parameters of each case under the completed model."""
    rows = []
    for case in found:
        fit = case.found.completed.fits[-1]
        values = fit.posterior.parameters()
        effects = case.found.completed.parameters()
        reported = "; ".join(
            f"{name} " + ", ".join(f"{p} {e.value:.3g} ± {e.std:.2g}" for p, e in of.items())
            for name, of in effects.items()
        )
        phi, c, K = values["phi"], values["c"], values["K"]
        rows.append(
            (
                case.rig,
                case.wheel,
                case.soil,
                f"x{case.errors:g}",
                f"{values['n'].value:.2f} ± {values['n'].std:.2f}",
                f"{math.degrees(phi.value):.1f} ± {math.degrees(phi.std):.1f}",
                f"{c.value / 1e3:.2f} ± {c.std / 1e3:.2f}",
                f"{1e3 * K.value:.1f} ± {1e3 * K.std:.1f}",
                reported or "-",
            )
        )
    return table(("rig", "wheel", "soil from", "errors", "n", "phi, deg", "c, kPa", "K, mm", "effects"), rows)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print all cases; 1 where there are no points."""
    parser = argparse.ArgumentParser(prog="python -m tests.lab.published_wheels", description=__doc__)
    parser.add_argument("points", type=Path, help="single-wheel-published.csv")
    points = parser.parse_args(arguments).points
    if not points.exists():
        print(f"no {points}", file=sys.stderr)
        return 1
    found = [case for errors in ERRORS for case in cases(errors, points)]
    print(tabulated(found))
    print("effects: fall of -2 log evidence in the round that added them; beside: others in the first round")
    print("soil strained: chi-square per parameter of the soil's posterior mean under its prior\n")
    print(soils(found))
    print("\nDing's lugged wheel on the smooth wheel's soil: fall of -2 log evidence (strain left of the soil)")
    for errors in (*ERRORS, 3.0):
        reported = ", ".join(
            f"{n} {b.fall:.0f} ({b.strain:.1f})" for n, b in lugs_beside_a_shifted_peak(errors, points).items()
        )
        print(f"  errors x{errors:g}: {reported}")
    return 0
