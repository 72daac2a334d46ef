"""Where model and data disagree: channel, wheel, and region of slip, load, speed or time.

    z = mean standardised residual of a region / sqrt(1/n + s' P s)     (s: its mean slope, P: posterior covariance)

Each residual of the held-out blocks, given the others of its instant, is standard normal where nothing is missing.  So
is the mean over a region divided by its standard deviation, which includes noise and what the fit leaves uncertain of
soil, gains and effects.  So is the shift of a gain error or of an effect's parameter from its prior over its standard
deviation, sqrt(prior variance - posterior variance).  Each region and each of these is one test; the significance
reported is corrected for the number of all tests (Holm 1979, Scand. J. Statist. 6:65).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from soilbus.arrays import Array
from soilbus.diagnosis.fitted_model import FittedModel, HeldOutCheck
from soilbus.diagnosis.options import DiagnosisOptions
from soilbus.diagnosis.records import Record
from soilbus.estimation.gaussian import Gaussian
from soilbus.estimation.posterior import PARAMETERS

_SOIL = len(PARAMETERS)
_ROUNDING = float(np.sqrt(np.finfo(float).eps))  # of a difference of two variances, over either
_REGRESSORS = ("slip", "load", "speed", "time")


@dataclass(frozen=True, slots=True)
class Disagreement:
    """One place where model and data disagree.

    Attributes
    ----------
    channel
        torque, draft or sinkage, a sensor whose gain error is implausible, or an effect of the present model.
    wheel
        Its name; empty for a channel of the vehicle.
    region
        `everywhere`, `slip 0.20..0.35` and the like, `scatter` (residuals larger than noise, of either sign), `gain`
        or `parameter share` and the like.
    size
        Mean of reading less model [SI]; of a scatter the residuals' std over the noise's, of a gain the gain error, of
        a parameter [its unit] the fitted value less that of the prior.
    log
        Name of the recording; empty for a gain and a parameter, which all of them share.
    significance
        Probability that noise alone does as much in any of the tests.
    """

    channel: str
    wheel: str
    region: str
    size: float
    log: str = ""
    significance: float = 1.0


def disagreements(records: Sequence[Record], fitted: FittedModel) -> list[Disagreement]:
    """All significant disagreements of a model with the held-out blocks of its recordings, the clearest first."""
    options = records[0].options
    tests = [
        test
        for record, check, fit in zip(records, fitted.checks, fitted.fits, strict=True)
        for test in _tests(record.name, check, fit.mode, options)
    ]
    tests += [*_gain_tests(fitted), *_parameter_tests(fitted)]
    tests.sort(key=lambda test: -abs(test[0]))
    found, worst = [], 0.0
    for rank, (deviations, place) in enumerate(tests):
        worst = max(worst, min(1.0, math.erfc(abs(deviations) / math.sqrt(2.0)) * (len(tests) - rank)))
        if worst > options.significance:
            break
        found.append(replace(place, significance=worst))
    return found


def _tests(
    log: str, check: HeldOutCheck, gaussian: Gaussian, options: DiagnosisOptions
) -> Iterator[tuple[float, Disagreement]]:
    """The tests of one recording, in standard deviations: mean by region, and scatter, of each channel."""
    problem = check.problem
    z, slopes = problem.standardised(check.at)
    slopes = slopes * np.concatenate([gaussian.soil, np.ones(len(gaussian.gains))])
    raw = check.at.rows[:, 0].reshape(z.shape)
    slip = 1.0 - check.latents.ground_speed[:, None] / (problem.rig.radius * check.latents.speed)
    for i, ((channel, wheel), wheels) in enumerate(zip(problem.row_channels, problem.row_wheels, strict=True)):
        regressors = {
            "slip": slip[:, wheels].mean(1),
            "load": check.latents.load[:, wheels].sum(1),
            "speed": check.latents.ground_speed,
            "time": problem.since,
        }
        known = np.isfinite(z[:, i])
        for region, members in _regions(regressors, known, options.min_sample):
            n = len(members)
            mean, slope = z[members, i].mean(), slopes[members, i].mean(0)
            sd = math.sqrt(1.0 / n + float(slope @ gaussian.covariance @ slope))
            yield mean / sd, Disagreement(channel, wheel, region, float(raw[members, i].mean()), log)
        n = int(known.sum())
        if n >= options.min_sample:
            square = float((z[known, i] ** 2).mean())
            uncertain = gaussian.covariance @ (slopes[known, i].T @ slopes[known, i])
            # of I + M: M's trace, and that of M^2
            expected, of_squares = float(uncertain.trace()), float((uncertain @ uncertain).trace())
            sd = math.sqrt(2.0 * (n + 2.0 * expected + of_squares)) / n
            larger = max((square - 1.0 - expected / n) / sd, 0.0)  # smaller than noise is no disagreement
            yield larger, Disagreement(channel, wheel, "scatter", math.sqrt(square), log)


def _regions(
    regressors: dict[str, Array], known: NDArray[np.bool_], least: int
) -> Iterator[tuple[str, NDArray[np.intp]]]:
    """Everywhere, and each third of each regressor, where there are `least` residuals in it."""
    every = np.flatnonzero(known)
    if len(every) < least:
        return
    yield "everywhere", every
    for name in _REGRESSORS:
        values = regressors[name]
        edges = np.quantile(values[every], [0.0, 1.0 / 3.0, 2.0 / 3.0, 1.0])
        if not edges[3] > edges[0]:
            continue
        for low, high in pairwise(edges.tolist()):
            members = every[(values[every] >= low) & (values[every] <= high)]
            if len(members) >= least:
                yield f"{name} {low:.3g}..{high:.3g}", members


def _gain_tests(fitted: FittedModel) -> Iterator[tuple[float, Disagreement]]:
    """Tests of the gain errors against their priors: a fit may hide an effect in them."""
    problem, gaussian = fitted.checks[-1].problem, fitted.fits[-1].mode
    for i in range(problem.layout.standing.start):
        std = float(problem.gain_std[i])
        shift_variance = std**2 - float(gaussian.covariance[_SOIL + i, _SOIL + i])  # of the posterior mean, under noise
        if std > 0.0 and shift_variance > _ROUNDING * std**2:
            quantity, _, wheel = problem.gain_names[i].partition(".")
            gain = float(gaussian.gains[i])
            yield gain / math.sqrt(shift_variance), Disagreement(quantity, wheel, "gain", gain)


def _parameter_tests(fitted: FittedModel) -> Iterator[tuple[float, Disagreement]]:
    """Tests of the effects' parameters that recordings share against their priors, as of the gain errors.

    A parameter at the edge of its range has no posterior variance: its shift has at most the prior's.
    """
    problem, gaussian = fitted.checks[-1].problem, fitted.fits[-1].mode
    by_name = {effect.name: effect for effect in fitted.effects}
    for i, (prior, free) in enumerate(zip(fitted.free_unheld, fitted.free, strict=True), problem.n_sensors):
        if prior.std == 0.0 or by_name[prior.effect].own_in_each_record(prior.parameter):
            continue
        u = float(gaussian.gains[i])
        shift = free.at(u) - prior.value
        shift_variance = 1.0 - float(gaussian.covariance[_SOIL + i, _SOIL + i]) if free.std > 0.0 else 1.0
        if shift_variance > _ROUNDING:
            wheel = "" if prior.wheel is None else problem.rig.wheels[prior.wheel]
            place = Disagreement(prior.effect, wheel, f"parameter {prior.parameter.name}", shift)
            yield shift / prior.std / math.sqrt(shift_variance), place
