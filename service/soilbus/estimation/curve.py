"""Curves: the wheels of one side go faster over the ground than the vehicle's middle, those of the other slower.

No sensor tells the yaw rate.  On a curve of radius R with track B a wheel's ground speed is
that of the middle times 1 -+ B/(2 R), and slip told from the middle's is as wrong as if its
speed sensor had just that gain error: on the left the opposite of on the right.  So a
curve is one more unknown of a window, along these gains.  By how much the rim speeds of the
two sides differ says how large it may be; whether they do for a curve or for slip, the
forces tell.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from soilbus.estimation.belief import Belief
from soilbus.estimation.posterior import PARAMETERS
from soilbus.estimation.readings import Readings
from soilbus.estimation.window import Rig

Array = NDArray[np.float64]


def sides(rig: Rig) -> Array:
    """-1 for the wheels on the left, 1 for those on the right, 0 where an axle has not two wheels (W,)."""
    side = np.zeros(len(rig.wheels))
    for members in (np.flatnonzero(rig.front), np.flatnonzero(~rig.front)):
        if len(members) == 2:
            side[members] = -1.0, 1.0
    return side


def rim_difference(readings: Readings) -> float:
    """Root mean square over the window of half the relative difference of rim speeds between the sides."""
    side = sides(readings.rig)
    whole = readings.usable[:, side != 0.0].all(axis=1)
    if not side.any() or not whole.any():
        return 0.0
    rim = (readings.rig.radius * readings.speed)[whole][:, side != 0.0]
    return float(np.sqrt(np.mean(((rim @ side[side != 0.0]) / rim.sum(axis=1)) ** 2)))


def with_curve(belief: Belief, readings: Readings) -> Belief:
    """What is known before a window whose curve is not: as sharp as the rim speeds allow, either way."""
    names = [f"speed.{wheel}" for wheel in readings.rig.wheels]
    gains = len(PARAMETERS) + np.array([readings.gain_names.index(name) for name in names])
    along = rim_difference(readings) * sides(readings.rig)
    covariance = belief.covariance.copy()
    covariance[np.ix_(gains, gains)] += np.outer(along, along)
    return replace(belief, covariance=covariance)
