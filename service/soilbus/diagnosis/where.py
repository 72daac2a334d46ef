"""Where model and data disagree: channel, wheel, and region of slip, load, speed or time.

    z = mean standardised residual of a region / sqrt(1/n + s' P s)     (s: its mean slope, P: posterior covariance)

Each residual of the held-out blocks, given the others of its instant, is standard normal where nothing is missing.  So
is the mean over a region divided by its standard deviation, which includes noise and what the fit leaves uncertain of
soil, gains and effects.  Each region is one test; the significance reported is corrected for the number of all tests
(Holm 1979, Scand. J. Statist. 6:65).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from soilbus.arrays import Array
from soilbus.diagnosis.fitted_model import FittedModel, HeldOutCheck
from soilbus.diagnosis.options import DEFAULT, DiagnosisOptions
from soilbus.estimation.posterior import PARAMETERS

_SOIL = len(PARAMETERS)
_REGRESSORS = ("slip", "load", "speed", "time")


@dataclass(frozen=True, slots=True)
class Disagreement:
    """One place where model and data disagree.

    Attributes
    ----------
    channel
        torque, draft or sinkage, or a sensor whose gain error is implausible.
    wheel
        Its name; empty for a channel of the vehicle.
    region
        `everywhere`, `slip 0.20..0.35` and the like, `scatter` (residuals larger than noise, of either sign) or
        `gain`.
    size
        Mean of reading less model [SI]; of a scatter the residuals' std over the noise's, of a gain the gain error.
    significance
        Probability that noise alone does as much in any of the tests.
    """

    channel: str
    wheel: str
    region: str
    size: float
    significance: float


@dataclass(frozen=True, slots=True)
class _Test:
    """One test, with its statistic in standard deviations."""

    channel: str
    wheel: str
    region: str
    size: float
    deviations: float


def disagreements(fitted: FittedModel, options: DiagnosisOptions = DEFAULT) -> list[Disagreement]:
    """All significant disagreements of the held-out blocks, the clearest first."""
    tests = [test for i, check in enumerate(fitted.checks) for test in _tests(check, fitted, i, options)]
    tests += list(_gain_tests(fitted, options))
    tests.sort(key=lambda test: -abs(test.deviations))
    found, worst = [], 0.0
    for rank, test in enumerate(tests):
        worst = max(worst, min(1.0, math.erfc(abs(test.deviations) / math.sqrt(2.0)) * (len(tests) - rank)))
        if worst > options.significance:
            break
        found.append(Disagreement(test.channel, test.wheel, test.region, test.size, worst))
    return found


def _tests(check: HeldOutCheck, fitted: FittedModel, record: int, options: DiagnosisOptions) -> Iterator[_Test]:
    """The tests of one recording: mean by region, and scatter, of each channel."""
    problem, gaussian = check.problem, fitted.fits[record].mode
    z, slopes = problem.standardised(check.at, gaussian.gains)
    slopes = slopes * np.concatenate([gaussian.soil, np.ones(len(gaussian.gains))])
    raw = check.at.rows[:, 0].reshape(z.shape)
    W = problem.n_wheels
    slip = 1.0 - check.latents.ground_speed[:, None] / (problem.rig.radius * check.latents.speed)
    for i, (channel, wheel) in enumerate(problem.row_channels):
        own = i % (W + 1) if i != W else None
        regressors = {
            "slip": slip.mean(1) if own is None else slip[:, own],
            "load": check.latents.load.sum(1) if own is None else check.latents.load[:, own],
            "speed": check.latents.ground_speed,
            "time": problem.since,
        }
        known = np.isfinite(z[:, i])
        for region, members in _regions(regressors, known, options.where_residuals):
            n = len(members)
            mean, slope = z[members, i].mean(), slopes[members, i].mean(0)
            sd = math.sqrt(1.0 / n + float(slope @ gaussian.covariance @ slope))
            yield _Test(channel, wheel, region, float(raw[members, i].mean()), mean / sd)
        n = int(known.sum())
        if n >= options.where_residuals:
            square = float((z[known, i] ** 2).mean())
            uncertain = gaussian.covariance @ (
                slopes[known, i].T @ slopes[known, i]
            )  # of I + M: M's trace, and that of M^2
            expected, of_squares = float(uncertain.trace()), float((uncertain @ uncertain).trace())
            sd = math.sqrt(2.0 * (n + 2.0 * expected + of_squares)) / n
            larger = max((square - 1.0 - expected / n) / sd, 0.0)  # smaller than noise is no disagreement
            yield _Test(channel, wheel, "scatter", math.sqrt(square), larger)


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


def _gain_tests(fitted: FittedModel, options: DiagnosisOptions) -> Iterator[_Test]:
    """Tests of the gain errors against their priors: a fit may hide an effect in them."""
    problem, gaussian = fitted.checks[-1].problem, fitted.fits[-1].mode
    for i in range(problem.n_sensors):
        std = float(problem.gain_std[i])
        shift_variance = std**2 - float(gaussian.covariance[_SOIL + i, _SOIL + i])  # of the posterior mean, under noise
        if std > 0.0 and shift_variance > options.min_variance_share * std**2:
            quantity, _, wheel = problem.gain_names[i].partition(".")
            gain = float(gaussian.gains[i])
            yield _Test(quantity, wheel, "gain", gain, gain / math.sqrt(shift_variance))
