"""Evidence of an effect whose size, and whose simplest sufficient form, are unknown.

    p(data | effect) = mean over cases c, mean over scales s of  integral L(u) N(u; 0, s^2 I) du,
    log L(u) = b' u - u' H u / 2    (u: the effect's parameters in units of their prior std)

The catalogue's prior ranges are those of large effects.  With these ranges alone, a small effect of eight parameters
has to overcome eight large penalties.  So the parameters that say how large an effect is share a scale, one of
PRIOR_SCALES times their prior std, each equally likely (a scale mixture of Gaussians, as heavy-tailed as it is peaked:
Andrews & Mallows 1974, J. R. Stat. Soc. B 36:99).  And an effect may be simpler than all it could be: a curve along
the way with fewer knots, one wheel of four, one part of a loss.  Each simpler case has the same prior probability as
the full effect (Bayesian model averaging: Hoeting et al. 1999, Stat. Sci. 14:382).
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

PRIOR_SCALES = tuple(2.0**k for k in range(-4, 3))
"""Scales of the mixture, in units of the catalogue's prior std; all equally likely."""


def mixture_neg2_log_evidence(information: Array, information_vector: Array, free: Sequence[Free]) -> float:
    """-2 log evidence of an effect, relative to its absence.

    Parameters
    ----------
    information
        H (P, P), Fisher information of the effect's parameters in units of their prior std, all others maximised or
        marginalised.
    information_vector
        b (P,), gradient of the log likelihood at zero.
    free
        The parameters.
    """
    found = [_per_scale(rows @ information @ rows.T, rows @ information_vector, sized) for rows, sized in _cases(free)]
    each = np.concatenate([evidences + 2.0 * np.log(len(evidences)) for evidences in found])
    return float(-2.0 * np.logaddexp.reduce(-0.5 * each) + 2.0 * np.log(len(found)))


def mixture_correction(standardised: Array, covariance: Array, free: Sequence[Free]) -> float:
    """Difference of the -2 log evidence under the mixture to that under the catalogue's prior std.

    Parameters
    ----------
    standardised, covariance
        Posterior mean (P,) and covariance (P, P) of the effect's parameters in units of their prior std.
    free
        The parameters.
    """
    information, information_vector = _likelihood(standardised, covariance)
    fixed = np.zeros(len(standardised), bool)
    mixture = mixture_neg2_log_evidence(information, information_vector, free)
    return mixture - float(_per_scale(information, information_vector, fixed)[0])


class OwnParameters(NamedTuple):
    """Likelihood of the parameters (P,) that one recording has for itself.

    information (P, P) and information_vector (P,) are as mixture_neg2_log_evidence() takes them.
    """

    information: Array
    information_vector: Array
    free: tuple[Free, ...]

    def moments(self) -> tuple[Array, Array]:
        """Posterior mean (P,) and covariance (P, P), in units of the prior std."""
        covariance = np.asarray(np.linalg.inv(self.information + np.eye(len(self.free))), float)
        return np.asarray(covariance @ self.information_vector), covariance

    def surcharge(self, temperature: float) -> float:
        """By how much more these parameters cost than their share of a -2 log evidence divided by a temperature.

        Dividing by a temperature T allows for formulas that are not the field's, as if there were T times less data.
        The penalty for having the parameters does not shrink in that proportion, but as their information does
        (coarsened posterior: Miller & Dunson 2019, J. Am. Stat. Assoc. 114:1113).
        """
        return self.neg2_log_evidence(temperature) - self.neg2_log_evidence() / temperature

    def surcharge_or_absent(self, temperature: float) -> float:
        """The same where the recording has them or not, each with probability 1/2."""
        coarsened = self.neg2_log_evidence(temperature)
        either = -2.0 * float(np.logaddexp(0.0, -0.5 * coarsened) - np.log(2.0))
        return either - self.neg2_log_evidence() / temperature

    def neg2_log_evidence(self, temperature: float = 1.0) -> float:
        """Relative to the absence of the parameters, with the likelihood to the power of 1 / temperature."""
        return mixture_neg2_log_evidence(
            self.information / temperature, self.information_vector / temperature, self.free
        )


def own_parameters(standardised: Array, covariance: Array, free: Sequence[Free]) -> OwnParameters:
    """OwnParameters from posterior mean (P,) and covariance (P, P) of a fit."""
    return OwnParameters(*_likelihood(standardised, covariance), tuple(free))


def _likelihood(standardised: Array, covariance: Array) -> tuple[Array, Array]:
    """Information (P, P) and information vector (P,) of the data alone: posterior less the standard normal prior."""
    precision = np.linalg.inv(covariance)
    return precision - np.eye(len(standardised)), precision @ standardised


def _per_scale(information: Array, information_vector: Array, sized: NDArray[np.bool_]) -> Array:
    """-2 log evidence (S,) for each scale of the parameters that have one; (1,), for scale 1, where none has."""
    scales = np.where(sized, np.array(PRIOR_SCALES if sized.any() else (1.0,))[:, None], 1.0)
    scaled = np.eye(len(information_vector)) + scales[:, :, None] * information * scales[:, None, :]
    vectors = scales * information_vector
    explained = np.einsum("sp,sp->s", vectors, np.linalg.solve(scaled, vectors[:, :, None])[:, :, 0])
    return np.asarray(np.linalg.slogdet(scaled)[1] - explained)


def _cases(free: Sequence[Free]) -> Iterator[tuple[Array, NDArray[np.bool_]]]:
    """The full effect and its simpler cases.

    Of each, its parameters as rows (Q, P) in those of the full effect, and which (Q,) of them have a size.
    """
    sized = np.array([f.parameter.neutral == 0.0 for f in free])
    full = np.eye(len(free))
    yield full, sized
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
        yield full[part], sized[part]


def _with_fewer_knots(free: Sequence[Free], every: int) -> tuple[Array, NDArray[np.bool_]]:
    """The case with each `every`-th knot of the curves; heights between follow the natural spline through these."""
    rows, sized = [], []
    for i, f in enumerate(free):
        knot = f.parameter.knot
        if knot is None or knot.number % every == 0:
            rows.append(np.eye(len(free))[i] if knot is None else [_cardinal_height(g, knot, every) for g in free])
            sized.append(f.parameter.neutral == 0.0)
    return np.array(rows).reshape(-1, len(free)), np.array(sized, bool)


def _cardinal_height(other: Free, knot: Knot, every: int) -> float:
    """Height, at another parameter's knot, of the spline that is 1 at `knot` and 0 at the other remaining knots."""
    there = other.parameter.knot
    if there is None or there.curve != knot.curve:
        return 0.0
    heights = splines(there.number / there.intervals, knot.intervals // every + 1)
    return float(heights[knot.number // every])
