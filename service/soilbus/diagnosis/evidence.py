"""Evidence for an effect of which nobody knows how great, nor how simple, it is.

The catalogue's prior ranges are those of large effects.  Held to them alone, one with
eight parameters that is there, but small, has to beat eight large penalties, and one
beyond its range another.  So the evidence is that of a mixture: the parameters that say
how great an effect is have, together, one of several times their prior std (a scale
mixture of Gaussians, as heavy-tailed as it is peaked: Andrews & Mallows 1974, J. R. Stat.
Soc. B 36:99).  And what is there may be simpler than all that the effect could be: a curve
along the way with fewer bends, one wheel of four, one of a loss's parts.  Each simpler
case has the same chance as the whole (averaging over models: Hoeting et al. 1999, Stat.
Sci. 14:382).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from soilbus.arrays import Array
from soilbus.estimation.nuisance_parameters import Free
from soilbus.terra.effects.along import splines
from soilbus.terra.effects.effect import Knot

SCALES = tuple(2.0**k for k in range(-4, 3))
"""Times the prior std, all as likely."""


def evidence_of_any_size(information: Array, pull: Array, free: Sequence[Free]) -> float:
    """-2 log evidence over that of the effect's absence, from what the data tell of its parameters.

    Of parameters (P,) in units of their prior std the data's log likelihood is
    pull u - u information u / 2, whatever all else may be.
    """
    found = [_evidences(rows @ information @ rows.T, rows @ pull, sized) for rows, sized in _cases(free)]
    each = np.concatenate([evidences + 2.0 * np.log(len(evidences)) for evidences in found])
    return float(-2.0 * np.logaddexp.reduce(-0.5 * each) + 2.0 * np.log(len(found)))


class OwnParameters(NamedTuple):
    """What one recording tells of the parameters (P,) that are its own, as evidence_of_any_size() wants it."""

    information: Array
    pull: Array
    free: tuple[Free, ...]

    def surcharge(self, temperature: float) -> float:
        """By how much more they cost than their share of a -2 log evidence that is divided by a temperature.

        That division is for formulas that are not the field's: as if there were so many times less data.  What
        parameters cost for being there does not shrink in proportion, but as their information does (coarsened
        posterior: Miller & Dunson 2019, J. Am. Stat. Assoc. 114:1113).
        """
        coarse = evidence_of_any_size(self.information / temperature, self.pull / temperature, self.free)
        return coarse - evidence_of_any_size(self.information, self.pull, self.free) / temperature


def own_parameters(pulls: Array, covariance: Array, free: Sequence[Free], times: float = 1.0) -> OwnParameters:
    """The same from what a fit came to, with so many times the data."""
    information, pull = _likelihood(pulls, covariance)
    return OwnParameters(times * information, times * pull, tuple(free))


def _likelihood(pulls: Array, covariance: Array) -> tuple[Array, Array]:
    """Information (P, P) and pull (P,) of the data alone."""
    precision = np.linalg.inv(covariance)
    return precision - np.eye(len(pulls)), precision @ pulls


def correction(pulls: Array, covariance: Array, free: Sequence[Free]) -> float:
    """What that changes of a -2 log evidence found with the prior std themselves, from what the fit came to."""
    information, pull = _likelihood(pulls, covariance)
    fixed = np.zeros(len(pulls), bool)
    return evidence_of_any_size(information, pull, free) - float(_evidences(information, pull, fixed)[0])


def _evidences(information: Array, pull: Array, sized: NDArray[np.bool_]) -> Array:
    """One -2 log evidence for each scale of the parameters that have one; for 1 alone where none has."""
    scales = np.where(sized, np.array(SCALES if sized.any() else (1.0,))[:, None], 1.0)
    scaled = np.eye(len(pull)) + scales[:, :, None] * information * scales[:, None, :]
    pulls = scales * pull
    explained = np.einsum("sp,sp->s", pulls, np.linalg.solve(scaled, pulls[:, :, None])[:, :, 0])
    return np.asarray(np.linalg.slogdet(scaled)[1] - explained)


def _cases(free: Sequence[Free]) -> Iterator[tuple[Array, NDArray[np.bool_]]]:
    """The whole effect and simpler ones: parameters (Q,) of each as rows (Q, P) in these, and which have a size."""
    sized = np.array([f.parameter.neutral == 0.0 for f in free])
    whole = np.eye(len(free))
    yield whole, sized
    intervals = {f.parameter.knot.intervals for f in free if f.parameter.knot is not None}
    if intervals:
        for every in range(2, max(intervals) + 1):
            if all(n % every == 0 for n in intervals):
                yield _with_fewer_knots(free, every)
        return
    wheels = sorted({f.wheel for f in free if f.wheel is not None})
    parts = [np.array([f.wheel == wheel for f in free]) for wheel in wheels]
    if not wheels:
        parts = [(np.arange(len(free)) == i) | ~sized for i in np.flatnonzero(sized)]
    for part in parts if len(parts) > 1 else ():
        yield whole[part], sized[part]


def _with_fewer_knots(free: Sequence[Free], every: int) -> tuple[Array, NDArray[np.bool_]]:
    """Only every so manieth knot of the curves; those between follow the smooth curve through them."""
    rows, sized = [], []
    for i, f in enumerate(free):
        knot = f.parameter.knot
        if knot is None or knot.number % every == 0:
            rows.append(np.eye(len(free))[i] if knot is None else [_share_in(g, knot, every) for g in free])
            sized.append(f.parameter.neutral == 0.0)
    return np.array(rows).reshape(-1, len(free)), np.array(sized, bool)


def _share_in(other: Free, knot: Knot, every: int) -> float:
    """Height at another parameter's knot of the curve that is one at this of the fewer knots and zero at the rest."""
    there = other.parameter.knot
    if there is None or there.curve != knot.curve:
        return 0.0
    heights = splines(there.number / there.intervals, knot.intervals // every + 1)
    return float(heights[knot.number // every])
