"""Instants: means of a window's bins over whole cycles of a machine that shakes.

    y_i = mean of the known y_b,    var y_i = sum of var y_b / n^2         n bins b of an instant i
    omega_i = V_i / mean (V_b / omega_b)                                   so that 1 - V / (r omega) is the mean slip

A model of steady wheels holds in the mean of a cycle only.  Within one, loads, slips and torques also follow each other
by relaxation, inertia and filters.  What these leave of a fit passes for curvature of torque over slip, and so for
less tan phi.  Instants are counted back from the window's end: windows a whole number of instants apart share theirs.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from soilbus.arrays import Array
from soilbus.estimation.window import TIME_TOLERANCE, VEHICLE_QUANTITIES, WHEEL_QUANTITIES, Rig, Window

_QUANTITIES = (*WHEEL_QUANTITIES, *VEHICLE_QUANTITIES)


def instant_of(rig: Rig, length: float) -> float:
    """Return the length [s] of a machine's instants: `length`, or at least a bounce where loads are computed.

    On tracks it is 0, which keeps the bins: no tyre relaxes or bounces.
    """
    lengths, given = rig.lengths, rig.instrumentation
    if lengths is not None and (lengths > 0.0).all():
        return 0.0
    computed = given is not None and given.loads_at_prior.any()
    return max(length, rig.options.measurements.bounce_period) if computed else length


def averaged(window: Window, end: float, length: float) -> Window:
    """Return the window with means of its bins over instants of this length [s], counted back from `end` [s].

    A value is known where one of its bins is; length 0 returns the window itself.
    """
    if not length or not len(window.t):
        return window
    number = np.floor((end - window.t + TIME_TOLERANCE) / length)
    starts = np.flatnonzero(np.diff(number, prepend=np.inf))
    if len(starts) == len(window.t):
        return window
    given = window.observations
    values, variances = [getattr(window, q) for q in _QUANTITIES], [window.variance[q] for q in _QUANTITIES]
    if given is not None:
        values += [given.torque, given.value, given.by_inertia, given.by_draft]
        variances += [given.torque_var, given.variance]
    means = _means(values, starts, 1), _means(variances, starts, 2)
    value, variance = (dict(zip(_QUANTITIES, part, strict=False)) for part in means)
    ratio, swing = _ratios(window, starts)
    with np.errstate(divide="ignore", invalid="ignore"):
        value["speed"] = value["ground_speed"][:, None] / ratio
    if given is not None:
        (torque, latents, *follows), of_latents = means[0][len(value) :], means[1][len(variance) :]
        given = type(given)(torque, of_latents[0], latents, of_latents[1], *follows)
    each = np.diff(starts, append=len(window.t))
    return replace(
        window,
        t=np.add.reduceat(window.t - end, starts) / each + end,
        variance=variance,
        observations=given,
        swing=swing,
        direction=np.sign(np.add.reduceat(window.direction, starts)),
        curves={name: curve.averaged(length, int(np.median(each))) for name, curve in window.curves.items()},
        **value,  # type: ignore[arg-type]
    )


def _ratios(window: Window, starts: NDArray[np.intp]) -> tuple[Array, Array]:
    """Mean of V / omega (N, W) in the instants that begin at starts (N,), and its relative sd less the noise of bins.

    The sd is at most a half, so that V / omega stays positive one sd below its mean.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = window.ground_speed[:, None] / window.speed
        noise = window.variance["ground_speed"] / window.ground_speed**2
        variance = ratio**2 * (noise[:, None] + window.variance["speed"] / window.speed**2)
        mean, square, of_noise = _means([ratio, ratio**2, variance], starts, 1)
        swing = np.sqrt(np.maximum(square - mean**2 - of_noise, 0.0)) / np.abs(mean)
    return mean, np.where(np.isfinite(swing), np.minimum(swing, 0.5), 0.0)


def _means(columns: list[Array], starts: NDArray[np.intp], power: int) -> list[Array]:
    """Return sums of the known rows from each start on, over a power of their number, for columns (N,) or (N, C)."""
    flat = [column.reshape(len(column), -1) for column in columns]
    values = np.concatenate(flat, axis=1)
    known = np.isfinite(values)
    count = np.add.reduceat(known, starts, axis=0, dtype=float)
    total = np.add.reduceat(np.where(known, values, 0.0), starts, axis=0)
    means = total / np.where(count > 0.0, count, np.nan) ** power
    ends = np.cumsum([part.shape[1] for part in flat]).tolist()
    parts = (means[:, end - part.shape[1] : end] for end, part in zip(ends, flat, strict=True))
    return [part.reshape(len(means), *column.shape[1:]) for part, column in zip(parts, columns, strict=True)]
