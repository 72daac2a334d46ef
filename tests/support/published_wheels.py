"""What the model misses on published single-wheel points.

Points are shared/field/single-wheel-published.csv: five or six rows a wheel, traced
by eye from figures.  So each line holds only for these few rows and the errors assumed in
rigs/*.toml.  Where the soil is from the other wheel, that wheel's posterior of soil and effects is
the prior: a missing effect is then a difference between the two wheels.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from soilbus.config.file import load_config
from soilbus.config.model import Config
from soilbus.diagnosis.diagnose import Diagnosis, diagnose
from soilbus.diagnosis.fitted_model import FittedModel, fit_model
from soilbus.diagnosis.records import Record
from soilbus.estimation.assembly import prior_of
from soilbus.offline.tables import candidates, recordings_of_tables
from soilbus.terra.effects.catalogue import CATALOGUE

RIGS = Path(__file__).with_name("rigs")
LUG = 0.01
"""Height of the lugs [m] of the two rigs that had both wheels."""


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
    """What one effect beside those known does for the other wheel: fall of the score, strain left of the soil."""

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
    return {n: Beside(known.score - fit.score, strain(fit)) for n, fit in fits.items() if fit is not None}


def strain(fitted: FittedModel) -> float:
    """Distance of the soil's posterior mean from its prior mean, as chi-square per parameter."""
    before, after = fitted.priors[-1], fitted.fits[-1].mode
    free = np.flatnonzero(np.diag(before.covariance)[:6] > 0.0)
    off = np.log(after.soil[free] / before.soil[free])
    return float(off @ np.linalg.solve(before.covariance[np.ix_(free, free)], off)) / len(free)
