"""Prediction: how far new data are from what the windows before say of them, in plain units.

    share = sqrt((sum of squares of the mean error of each second - variance of that mean by the scatter within it)
                 / sum of squares of what is predicted)

The error is that of torque at measured loads and slips, and of the pull at measured draft, slope and acceleration.  No
fit has seen these data.  Means over a second leave out what a machine that shakes does in an instant.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from soilbus.estimation.linearisation import RESIDUAL, Linearisation
from soilbus.estimation.observation_model import ObservationModel
from soilbus.estimation.variance_components import block_sums


class Share(NamedTuple):
    """Sums of squares of prediction errors beyond noise, and of what was predicted."""

    error: float
    size: float


def prediction_shares(problem: ObservationModel, at: Linearisation, since: float, block: float) -> dict[str, Share]:
    """Return the errors of the instants after `since` [s], by channel `torque` and `draft`; block in s.

    `at` is the window's linearisation at the estimate of earlier ones, with latents as measured.
    """
    new, (n, m) = problem.t > since, at.by_latents.shape[:2]
    if not new.any():
        return {}
    W, known, t = problem.n_wheels, problem.known[new], problem.t[new]
    residual = np.where(known, at.rows[:, RESIDUAL].reshape(n, m)[new], 0.0)[:, : W + 1]
    known = known[:, : W + 1]
    thrust = np.abs(problem.wheel_torque[new] / problem.rig.radius).sum(axis=1)
    size = np.column_stack([np.where(known[:, :W], problem.torque[new], 0.0), np.where(known[:, W], thrust, 0.0)])
    sums = block_sums(np.hstack([residual, residual**2, size, known]), t, block)
    errors, squares, sizes, counts = np.split(sums, 4, axis=1)
    counts = np.maximum(counts, 1.0)
    noise = np.maximum(squares - errors**2 / counts, 0.0) / np.maximum(counts - 1.0, 1.0)  # of an instant
    found = (errors / counts) ** 2 - noise / counts, (sizes / counts) ** 2
    parts = {"torque": slice(W), "draft": slice(W, W + 1)}
    return {
        name: Share(*(max(float(s[:, part].sum()), 0.0) for s in found))
        for name, part in parts.items()
        if known[:, part].any()
    }
