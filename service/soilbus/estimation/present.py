"""The soil under the wheels now, where a window's fit takes it for constant.

At the optimum of the fit the window is linear.  It is cut into pieces of which each has
its own soil, a random walk away from that of the piece before, while the sensors' gain
errors stay what they are: an information filter from piece to piece (e.g. Anderson &
Moore, Optimal Filtering, 1979, sect. 6.3).  What the last piece has is the present soil;
a constant one would be late by half a window, and too sure of itself.

How fast the soil wanders, the data tell: the filter runs for several rates beside one
another, each as likely as it foretells the window (multiple models: Bar-Shalom, Li &
Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, sect. 11.6),
and what they say is averaged.

The linear window tells the mode.  By as much as the filter moves that, and by what it adds
to the covariance there (never less than nothing: what may wander is known the worse), all
else that a fit says moves too: moments, averages and rivals keep their shape.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from soilbus.estimation.belief import Belief
from soilbus.estimation.gauss_newton import Fit
from soilbus.estimation.linearised import Linearised
from soilbus.estimation.normal_equations import Fitting, Place, solved

Array = NDArray[np.float64]

PIECES = 10
"""Pieces of a whole window."""
FACTORS = np.array([1.0, 3.3, 10.0])
"""Drifts that are tried, in units of the configured one: not less, for a steady soil may begin to drift."""
AT_FIRST = np.array([0.8, 0.15, 0.05])
"""How likely they are before any data."""
AT_BORDER = np.array([0.3, 0.3, 0.4])
"""How likely they are where another soil has just begun: its border may be gradual."""
MEMORY = 2.0
"""Windows after which what was learned of the drift is forgotten."""
_ENDS = np.arange(1.0, PIECES + 1.0) / PIECES


class Drifts(NamedTuple):
    """Sd (S,) by which each coordinate of the soil may change in the time of one window, and their probabilities."""

    sd: Array
    probability: Array

    @classmethod
    def about(cls, drift: float, border: bool = False) -> Drifts:
        """Before any data, where this is typical; at the border of another soil, or not."""
        return cls(drift * FACTORS, AT_BORDER if border else AT_FIRST) if drift else cls.only(drift)

    @classmethod
    def only(cls, drift: float) -> Drifts:
        """This and no other."""
        return cls(np.array([drift]), np.ones(1))

    def later(self, elapsed: float) -> Drifts:
        """After so many windows of which nothing was learned: the soil may have begun to drift, or ceased."""
        kept = np.exp(-elapsed / MEMORY)
        at_first = AT_FIRST if len(self.sd) > 1 else 1.0
        return self._replace(probability=kept * self.probability + (1.0 - kept) * at_first)


class Wandered(NamedTuple):
    """Step (F + A,) from the optimum of a constant soil to the last piece's, its covariance, and -2 log evidence."""

    step: Array
    covariance: Array
    evidence: float


def at_present(fitting: Fitting, fit: Fit, window: float, drift: float) -> Fit:
    """The fit with everything it believes of a soil that wanders.

    drift: sd by which each coordinate of the soil changes in the time of one window [s].
    The same fit where nothing wanders or the numbers stop being finite.  Cost and evidence
    stay those of a constant soil: a wandering one would explain too much that is no soil.
    """
    return present_and_drifts(fitting, fit, window, Drifts.only(drift))[0]


def present_and_drifts(fitting: Fitting, fit: Fit, window: float, drifts: Drifts) -> tuple[Fit, Drifts]:
    """As `at_present`, averaged over how fast the soil may drift; and how likely each of that is now."""
    if not drifts.sd.any():
        return fit, drifts
    optimum = fit.optimum
    place = Place(optimum.soil, optimum.gains, optimum.latents, fit.cost, 0)
    pieces = _pieces(fitting, place, optimum.at, optimum.t, window)
    still = solved(*_constant(pieces))
    all_wandered = _wandered(pieces, len(fitting.free), drifts.sd)
    if still is None or all_wandered is None:
        return fit, drifts
    unlikely = np.array([wandered.evidence for wandered in all_wandered])
    probability = drifts.probability * np.exp(-0.5 * (unlikely - unlikely.min()))
    probability /= probability.sum()
    steps = np.array([wandered.step for wandered in all_wandered])
    step = probability @ steps
    off = steps - step
    covariance = np.tensordot(probability, np.array([wandered.covariance for wandered in all_wandered]), axes=1)
    covariance += (off.T * probability) @ off
    free, gains = len(fitting.free), place.gains.copy()
    gains[fitting.active] += step[free:]
    now = replace(place, soil=fitting.coordinates.moved(place.soil, step[:free]), gains=gains)
    mode = fitting.believed(now, covariance)

    def moved(belief: Belief) -> Belief:
        return mode if belief is fit.mode else fitting.changed(belief, still[0] + step, covariance - still[1])

    present = replace(
        fit,
        mode=mode,
        belief=moved(fit.belief),
        rival=None if fit.rival is None else fit.rival._replace(belief=moved(fit.rival.belief)),
        averaged=None if fit.averaged is None else moved(fit.averaged),
    )
    return present, drifts._replace(probability=probability)


def _pieces(fitting: Fitting, place: Place, at: Linearised, t: Array, window: float) -> list[Array]:
    """What was known before, then what each piece with data tells: normal equations (1 + F + A, 1 + F + A).

    Cost, half its gradient and the information, by steps of the coordinates and active gains.
    """
    before, m = fitting.before_at(place), at.by_latents.shape[1]
    directions = fitting.directions(place)
    of_residual = np.zeros((len(directions), 1 + directions.shape[1]))
    of_residual[0, 0] = 1.0
    of_residual[:, 1:] = directions
    known = np.zeros((of_residual.shape[1],) * 2)
    known[1:, 1:] = before.information
    known[0, 1:] = known[1:, 0] = before.gradient
    ends = m * np.searchsorted(t - t[-1], window * (_ENDS - 1.0), side="right")
    told = [known]
    for begin, end in zip([0, *ends[:-1].tolist()], ends.tolist(), strict=True):
        if end > begin:
            told.append(of_residual.T @ (at.rows[begin:end].T @ at.weighed[begin:end]) @ of_residual)
    return told


def _constant(pieces: list[Array]) -> tuple[Array, Array]:
    """Information and half the gradient of a soil that does not wander."""
    whole = np.sum(pieces, axis=0)
    return whole[1:, 1:], whole[1:, 0]


def _wandered(pieces: list[Array], free: int, drifts: Array) -> list[Wandered] | None:
    """The last piece's soil for each drift (S,); None where the numbers stop being finite."""
    known, first, *others = pieces
    joint = np.tile(known + first, (len(drifts), 1, 1))
    soil = slice(1, 1 + free)
    variance = drifts**2 / PIECES
    stiff = np.eye(free) / variance[:, None, None]
    evidence = np.zeros(len(drifts))
    for piece in others:
        link = joint[:, :, soil].copy()
        step = link[:, soil] + stiff
        link[:, soil] = -stiff
        joint[:, soil] = joint[:, :, soil] = 0.0
        joint[:, soil, soil] = stiff
        joint -= link @ np.linalg.solve(step, link.transpose(0, 2, 1))
        joint += piece
        evidence += np.linalg.slogdet(step)[1] + free * np.log(variance)
    wandered = []
    for i, last in enumerate(joint):
        solution = solved(last[1:, 1:], last[1:, 0])
        if solution is None:
            return None
        minimum, covariance = solution
        cost = last[0, 0] - last[0, 1:] @ minimum
        covariance[:free, :free] += np.eye(free) * variance[i] / 3.0  # the end of the last piece is not its mean
        wandered.append(Wandered(-minimum, covariance, cost + evidence[i] + np.linalg.slogdet(last[1:, 1:])[1]))
    return wandered
