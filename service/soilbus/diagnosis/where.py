"""Where model and data disagree: channel, wheel, region of slip, load, speed or time.

Each residual of the held-out blocks, given the others of its instant, is standard normal
where nothing is missing.  So is its mean over a region, times a known factor: noise, and
what the fit leaves open of soil, gains and effects, are both in it.  Many looks are taken,
and each significance says what is left of it after that (Holm 1979, Scand. J. Statist. 6:65).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from soilbus.arrays import Array
from soilbus.diagnosis.fitted_model import Checked, FittedModel
from soilbus.estimation.posterior import PARAMETERS

FEWEST = 20
"""Residuals that a region must have."""
SIGNIFICANT = 0.01
"""Chance, all looks taken together, below which a disagreement is told."""
_SOIL = len(PARAMETERS)
_REGRESSORS = ("slip", "load", "speed", "time")


@dataclass(frozen=True, slots=True)
class Disagreement:
    """One place where model and data disagree.

    channel: torque, draft or sinkage, or a sensor whose gain error is implausible; wheel is
    empty for the vehicle's.  region: `everywhere`, `slip 0.20..0.35` and the like, `scatter`
    (residuals larger than noise, whatever their sign) or `gain`.  size: mean of reading less
    model in SI (of a scatter: the residuals' std over the noise's; of a gain: the gain
    error); significance: the chance that noise alone does as much in any of the looks.
    """

    channel: str
    wheel: str
    region: str
    size: float
    significance: float


@dataclass(frozen=True, slots=True)
class _Look:
    channel: str
    wheel: str
    region: str
    size: float
    deviations: float


def disagreements(completion: FittedModel) -> list[Disagreement]:
    """All significant disagreements of the held-out blocks, the clearest first."""
    looks = [look for i, check in enumerate(completion.checks) for look in _looks(check, completion, i)]
    looks += list(_gain_looks(completion))
    looks.sort(key=lambda look: -abs(look.deviations))
    found, worst = [], 0.0
    for rank, look in enumerate(looks):
        worst = max(worst, min(1.0, math.erfc(abs(look.deviations) / math.sqrt(2.0)) * (len(looks) - rank)))
        if worst > SIGNIFICANT:
            break
        found.append(Disagreement(look.channel, look.wheel, look.region, look.size, worst))
    return found


def channels(wheels: Sequence[str], with_sinkage: bool) -> list[tuple[str, str]]:
    """Channel and wheel of each residual of an instant."""
    names = [("torque", w) for w in wheels] + [("draft", "")]
    return names + ([("sinkage", w) for w in wheels] if with_sinkage else [])


def _looks(check: Checked, completion: FittedModel, record: int) -> Iterator[_Look]:
    problem, gaussian = check.problem, completion.fits[record].mode
    z, by = problem.standardised(check.at, gaussian.gains)
    by = by * np.concatenate([gaussian.soil, np.ones(len(gaussian.gains))])
    raw = check.at.rows[:, 0].reshape(z.shape)
    W = problem.n_wheels
    slip = 1.0 - check.latents.ground_speed[:, None] / (problem.rig.radius * check.latents.speed)
    for i, (channel, wheel) in enumerate(channels(problem.rig.wheels, problem.with_sinkage)):
        own = i % (W + 1) if i != W else None
        regressors = {
            "slip": slip.mean(1) if own is None else slip[:, own],
            "load": check.latents.load.sum(1) if own is None else check.latents.load[:, own],
            "speed": check.latents.ground_speed,
            "time": problem.since,
        }
        known = np.isfinite(z[:, i])
        for region, members in _regions(regressors, known):
            n = len(members)
            mean, slope = z[members, i].mean(), by[members, i].mean(0)
            sd = math.sqrt(1.0 / n + float(slope @ gaussian.covariance @ slope))
            yield _Look(channel, wheel, region, float(raw[members, i].mean()), mean / sd)
        n = int(known.sum())
        if n >= FEWEST:
            square = float((z[known, i] ** 2).mean())
            left_open = gaussian.covariance @ (by[known, i].T @ by[known, i])  # of I + M: M's trace, and that of M^2
            expected, of_squares = float(left_open.trace()), float((left_open @ left_open).trace())
            sd = math.sqrt(2.0 * (n + 2.0 * expected + of_squares)) / n
            yield _Look(channel, wheel, "scatter", math.sqrt(square), (square - 1.0 - expected / n) / sd)


def _regions(regressors: dict[str, Array], known: NDArray[np.bool_]) -> Iterator[tuple[str, NDArray[np.intp]]]:
    """Everywhere, and each third of each regressor, where there is enough in it."""
    every = np.flatnonzero(known)
    if len(every) < FEWEST:
        return
    yield "everywhere", every
    for name in _REGRESSORS:
        values = regressors[name]
        edges = np.quantile(values[every], [0.0, 1.0 / 3.0, 2.0 / 3.0, 1.0])
        if not edges[3] > edges[0]:
            continue
        for low, high in pairwise(edges.tolist()):
            members = every[(values[every] >= low) & (values[every] <= high)]
            if len(members) >= FEWEST:
                yield f"{name} {low:.3g}..{high:.3g}", members


def _gain_looks(completion: FittedModel) -> Iterator[_Look]:
    """Gain errors that are larger than they may be: a fit hides an effect in them."""
    problem, gaussian = completion.checks[-1].problem, completion.fits[-1].mode
    for i in range(problem.n_sensors):
        std = float(problem.gain_std[i])
        told = std**2 - float(gaussian.covariance[_SOIL + i, _SOIL + i])  # what the data moved it by, were it noise
        if std > 0.0 and told > 0.01 * std**2:
            quantity, _, wheel = problem.gain_names[i].partition(".")
            gain = float(gaussian.gains[i])
            yield _Look(quantity, wheel, "gain", gain, gain / math.sqrt(told))
