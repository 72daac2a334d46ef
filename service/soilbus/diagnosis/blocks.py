"""How well a model predicts each block of a recording, and each sensor's gain, from all others.

    s_b = -2 log p(r_b | all other blocks) = r' (I + J P_-b J')^-1 r + log det(I + H_b P_-b)

r and J are the block's residuals and Jacobian, whitened, at the optimum by the other blocks; P_-b is the posterior
covariance of soil, gains and effects by these, H_b = J'J.  With the quadratic model about the fit nothing is fitted
again (leave-one-out by one fit: Beirami et al. 2017, NeurIPS 30; blocks, as instants follow each other: Burman, Chow &
Nolan 1994, Biometrika 81:351).

What is known of a sensor's gain is a block of one residual.  An effect that is missing bends gains where the soil
cannot imitate it, and then blocks are predicted well by a gain that no such sensor has.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from soilbus.arrays import Array
from soilbus.diagnosis.options import DEFAULT, DiagnosisOptions
from soilbus.estimation.gaussian import Gaussian
from soilbus.estimation.linearisation import RESIDUAL, Linearisation


class BlockScores(NamedTuple):
    """Of each block (B,): -2 log predictive likelihood, the chi-square in it, and the number of residuals.

    A gain counts in the first alone: it is no residual.
    """

    neg2_log: Array
    chi2: Array
    rows: Array


class Part(NamedTuple):
    """Blocks of one recording, linearised at one point.

    Attributes
    ----------
    soil : (6,)
        Where the model is linearised.
    gains : (G,)
        The same of gains and parameters.
    at
        Linearisation there.
    block : (N,)
        Number of the block of each instant.
    known : (N, m)
        Which residuals are measured.
    """

    soil: Array
    gains: Array
    at: Linearisation
    block: NDArray[np.intp]
    known: NDArray[np.bool_]


def block_scores(
    records: Sequence[tuple[Part, Part]],
    priors: Sequence[Gaussian],
    modes: Sequence[Gaussian],
    own: NDArray[np.bool_],
    n_sensors: int,
    options: DiagnosisOptions = DEFAULT,
) -> BlockScores:
    """Return the scores of the sensors' gains, and then of all blocks of all recordings, in the order of these.

    Parameters
    ----------
    records
        Parts of each recording.
    priors
        Of each recording: of its soil, and its part of that of what all share.
    modes
        Soil and gains of each recording, near which its parts are linearised.
    own : (G,)
        Which gains and parameters each recording has for itself.
    n_sensors
        Number of the sensors' gains, the first of all.
    options
        Of `gain_left_out`.
    """
    free = np.diag(priors[0].covariance) > 0.0
    R = len(records)
    is_own = np.append(np.ones(len(free) - len(own), bool), own if R > 1 else np.ones(len(own), bool))[free]
    n, shared = int(is_own.sum()), int((~is_own).sum())
    columns = [np.where(is_own, np.cumsum(is_own) - 1 + i * n, np.cumsum(~is_own) - 1 + R * n) for i in range(R)]
    precision, slope = np.zeros((R * n + shared,) * 2), np.zeros(R * n + shared)
    blocks = [_blocks(parts, mode, free) for parts, mode in zip(records, modes, strict=True)]
    of_gains = _gain_blocks(priors[0], modes[0], free, n_sensors, R, options.gain_left_out)
    for at, prior, mode, (_, gradient, information, _) in zip(columns, priors, modes, blocks, strict=True):
        of_prior = np.linalg.inv(prior.covariance[np.ix_(free, free)])
        precision[np.ix_(at, at)] += of_prior + information.sum(0)
        slope[at] += of_prior @ _steps(prior.soil, prior.gains, mode)[free] + gradient.sum(0)
    covariance = np.linalg.inv(precision)
    to_best = -covariance @ slope
    scores = []
    for at, (chi2, gradient, information, rows) in zip([columns[0], *columns], [of_gains, *blocks], strict=True):
        P = covariance[np.ix_(at, at)]
        chi2, gradient = _moved(chi2, gradient, information, to_best[at])
        left = np.eye(len(P)) - P @ information
        without = np.linalg.solve(left, np.broadcast_to(P, information.shape))
        chi2, gradient = _moved(chi2, gradient, information, np.einsum("bij,bj->bi", without, gradient))
        chi2 = chi2 - np.einsum("bi,ij,bj->b", gradient, P, gradient)
        scores.append(BlockScores(chi2 - np.linalg.slogdet(left)[1], np.where(rows > 0.0, chi2, 0.0), rows))
    return BlockScores(*(np.concatenate(column) for column in zip(*scores, strict=True)))


def _blocks(parts: tuple[Part, Part], mode: Gaussian, free: NDArray[np.bool_]) -> tuple[Array, Array, Array, Array]:
    """Return chi-square, half its gradient and the information of each block at the mode, and its residuals."""
    numbers, inverse = np.unique(np.concatenate([part.block for part in parts]), return_inverse=True)
    B, K = len(numbers), int(free.sum())
    chi2, gradient, information, rows = np.zeros(B), np.zeros((B, K)), np.zeros((B, K, K)), np.zeros(B)
    for part, of_part in zip(parts, np.split(inverse, [len(parts[0].block)]), strict=True):
        columns = np.append(True, free)
        scale = np.concatenate([np.ones(1), part.soil, np.ones(len(part.gains))])[columns]
        to_mode, by_row = _steps(part.soil, part.gains, mode)[free], np.repeat(of_part, part.known.shape[1])
        for b in np.unique(of_part):
            residuals, weighed = (x[by_row == b][:, columns] for x in (part.at.rows, part.at.weighed))
            normal = residuals.T @ weighed * np.outer(scale, scale)
            change = normal[1:, 1:] @ to_mode
            chi2[b] += normal[RESIDUAL, RESIDUAL] + (2.0 * normal[RESIDUAL, 1:] + change) @ to_mode
            gradient[b] += normal[RESIDUAL, 1:] + change
            information[b] += normal[1:, 1:]
            rows[b] += part.known[of_part == b].sum()
    return chi2, gradient, information, rows


def _gain_blocks(
    prior: Gaussian, mode: Gaussian, free: NDArray[np.bool_], n_sensors: int, R: int, left_out: float
) -> tuple[Array, Array, Array, Array]:
    """Return the same as `_blocks` of this share of each sensor's gain's prior; a recording has the R-th part of it."""
    first = len(free) - len(prior.gains)
    gains = np.flatnonzero(free[first : first + n_sensors])
    at = np.searchsorted(np.flatnonzero(free), first + gains)
    covariance = prior.covariance[np.ix_(first + gains, first + gains)] / R
    jacobian, residual = np.zeros((n_sensors, int(free.sum()))), np.zeros(n_sensors)
    whitened = left_out**0.5 * np.linalg.inv(np.linalg.cholesky(covariance))
    jacobian[gains[:, None], at] = whitened
    residual[gains] = whitened @ (mode.gains - prior.gains)[gains]
    return residual**2, jacobian * residual[:, None], np.einsum("bi,bj->bij", jacobian, jacobian), np.zeros(n_sensors)


def _steps(soil: Array, gains: Array, mode: Gaussian) -> Array:
    """Return the way (6 + G,) to the mode in logarithms of the soil, and in gains."""
    kept = (soil > 0.0) & (mode.soil > 0.0)  # a parameter that is held at 0
    return np.append(np.log(np.where(kept, mode.soil, 1.0) / np.where(kept, soil, 1.0)), mode.gains - gains)


def expected_change(information: Array, vector: Array) -> float:
    """Return the change of the sum of scores that a linear effect of parameters (P,) is expected to make.

        -2 b'u + u' H u + 2 tr H (H + I)^-1,    u = (H + I)^-1 b        (Akaike 1974, IEEE Trans. Autom. Control 19:716)

    Parameters
    ----------
    information
        H (P, P): Fisher information of its parameters in units of their prior std, all others eliminated.
    vector
        b (P,): gradient of the log likelihood where the effect is absent.
    """
    posterior = np.linalg.inv(information + np.eye(len(vector)))
    u = posterior @ vector
    return float(u @ information @ u - 2.0 * vector @ u + 2.0 * np.trace(information @ posterior))


def _moved(chi2: Array, gradient: Array, information: Array, step: Array) -> tuple[Array, Array]:
    """Return chi-squares (B,) and half their gradients (B, K) after a step (K,), or one of each block (B, K)."""
    change = (information @ np.broadcast_to(step, gradient.shape)[:, :, None])[:, :, 0]
    return chi2 + ((2.0 * gradient + change) * step).sum(1), gradient + change
