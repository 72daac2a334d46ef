"""Curves: the wheels of one side go faster over the ground than the vehicle's middle, those of the other slower.

No sensor tells the yaw rate.  On a curve of radius R with track B a wheel's ground speed is
that of the middle times 1 -+ B/(2 R), and slip told from the middle's is as wrong as if its
speed sensor had just that gain error: on the left the opposite of on the right.  So a
curve is one more unknown of a window, along these gains.  By how much the rim speeds of the
two sides differ says how large it may be; whether they do for a curve or for slip, the
forces tell.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from soilbus.estimation.belief import Belief
from soilbus.estimation.posterior import PARAMETERS
from soilbus.estimation.readings import Readings
from soilbus.estimation.window import Rig, pairs

Array = NDArray[np.float64]

_SOIL = len(PARAMETERS)


def sides(rig: Rig) -> Array:
    """-1 for the wheels on the left, 1 for those on the right, 0 where an axle has not two wheels (W,)."""
    side = np.zeros(len(rig.wheels))
    side[pairs(rig)] = [[-1.0], [1.0]]
    return side


def rim_differences(readings: Readings) -> Array:
    """Half the relative difference of rim speeds between the sides at each instant (N,); nan where not all turn."""
    side = sides(readings.rig)
    known = side != 0.0
    rim = readings.rig.radius * readings.speed
    if not known.any():
        return np.full(readings.n, np.nan)
    return np.where(readings.usable[:, known].all(axis=1), (rim @ side) / rim[:, known].sum(axis=1), np.nan)


def rim_difference(readings: Readings) -> float:
    """Root mean square of these over the window, 0 where none is known."""
    apart = rim_differences(readings)
    known = apart[np.isfinite(apart)]
    return math.sqrt(float(np.mean(known**2))) if len(known) else 0.0


class Curve(NamedTuple):
    """A window's curve as one more unknown, as large as the rim speeds allow.

    side (6 + G,): derivatives of soil and gains by it, as `sides`; std: how large it may be, as a relative speed;
    of_gains: variance of the mean speed gain of a side, by the sensors alone.
    """

    side: Array
    std: float
    of_gains: float


def curve_of(readings: Readings) -> Curve:
    """The curve that a window may be driven on."""
    side = np.zeros(_SOIL + len(readings.gain_std))
    first = readings.gain_names.index(f"speed.{readings.rig.wheels[0]}")
    side[_SOIL + first : _SOIL + first + readings.n_wheels] = sides(readings.rig)
    of_mean = side[_SOIL:] * readings.gain_std / max(np.count_nonzero(side), 1)
    return Curve(side, rim_difference(readings), float(of_mean @ of_mean))


def with_curve(belief: Belief, curve: Curve) -> Belief:
    """What is known before a window whose curve is not: as sharp as the rim speeds allow, either way."""
    return replace(belief, covariance=belief.covariance + np.outer(curve.side, curve.side * curve.std**2))


def without_curve(belief: Belief, curve: Curve) -> Belief:
    """What a window leaves known for later ones: its curve is not theirs, and hides what the speed sensors have of it.

    Of that only its prior is left.
    """
    side = curve.side
    count = np.count_nonzero(side)
    if not count:
        return belief
    covariance = with_curve(belief, curve).covariance
    mean_along = covariance @ side / count
    spread = float(side @ mean_along) / count + curve.of_gains
    if not spread > 0.0:
        return belief
    step = -mean_along / spread * float(side[_SOIL:] @ belief.gains) / count
    return belief.moved(step, covariance - np.outer(mean_along, mean_along) / spread)
