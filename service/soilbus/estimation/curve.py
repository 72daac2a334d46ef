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

import numpy as np
from numpy.typing import NDArray

from soilbus.estimation.belief import Belief
from soilbus.estimation.posterior import PARAMETERS
from soilbus.estimation.readings import Readings
from soilbus.estimation.window import Rig, pairs

Array = NDArray[np.float64]


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


def with_curve(belief: Belief, readings: Readings) -> Belief:
    """What is known before a window whose curve is not: as sharp as the rim speeds allow, either way."""
    along = rim_difference(readings) * _by_side(readings)
    return replace(belief, covariance=belief.covariance + np.outer(along, along))


def without_curve(belief: Belief, readings: Readings) -> Belief:
    """What a window leaves known for later ones: its curve is not theirs, and hides what the speed sensors have of it.

    Of that only its prior is left.
    """
    curve, side = with_curve(belief, readings), _by_side(readings)
    count = np.count_nonzero(side)
    if not count:
        return belief
    variance = float(np.sum((side[len(PARAMETERS) :] * readings.gain_std) ** 2))
    mean_along = curve.covariance @ side / count
    spread = float(side @ mean_along) / count + variance / count**2
    if not spread > 0.0:
        return belief
    step = -mean_along / spread * float(side[len(PARAMETERS) :] @ belief.gains) / count
    return belief.moved(step, curve.covariance - np.outer(mean_along, mean_along) / spread)


def _by_side(readings: Readings) -> Array:
    """Derivatives (6 + G) of soil and gains by a curve: those of the speed gains, as `sides`."""
    along = np.zeros(len(PARAMETERS) + len(readings.gain_std))
    names = [f"speed.{wheel}" for wheel in readings.rig.wheels]
    along[len(PARAMETERS) + np.array([readings.gain_names.index(name) for name in names])] = sides(readings.rig)
    return along
