"""Sensors that lie about how what they measure changes: against each other, or by another measure."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from soilbus.estimation.scene import DEVIATIONS, FALSE_SLIP, Scene
from soilbus.estimation.series import change, change_variance, median, moving_sum, neighbours, running_sum, smooth
from soilbus.estimation.window import pull_given, zero_if_unknown
from soilbus.terra.vehicle import GRAVITY

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

LAG = 1.0
"""Seconds over which changes are compared."""
OPPOSITE = 0.85
"""Share of significant changes that go the wrong way."""
CORRELATION = -0.9
"""Their correlation, at most."""
LEAST_SLOWING, LEAST_PULLING = 2.0, 4.0
"""Seconds of significant changes, one after the other, that there must be of speed and of pull: at the border of a
soft soil a driver who lifts the implement may pull less and drive more for a moment."""
LEAST_FORCE, LEAST_SPEED = 0.01, 0.05
"""Changes of force, as a share of the weight, and of speed [m/s] below which none is significant."""
COMPARED, CHANGING = 3.0, 0.06
"""Seconds over which speed and acceleration are compared, and rms of the changes of speed [m/s] that there must be."""
TOGETHER, MAY_BE, KNOWN = 0.985, 0.9, 0.9
"""Their correlation at the best delay, at least, and at another one that may be theirs; share of bins with both."""
OTHER_SCALE = math.log(1.35)
"""Logarithm of the ratio of their changes from which they contradict each other."""
AT_ONCE, ABOUT, JUMP, UNEXPLAINED = 0.3, 0.6, 0.25, 0.25
"""A jump: at least so much [m/s] in AT_ONCE [s], of which not this share is told within ABOUT [s] of it."""


def accelerated(scene: Scene) -> Iterator[str]:
    """The acceleration, where it says that the vehicle slows down whenever it speeds up."""
    window = scene.window
    lag = max(round(LAG / scene.bin), 1)
    gained = change(smooth(window.ground_speed), lag)
    told = scene.bin * moving_sum(window.acceleration, lag)
    noise = np.sqrt(change_variance(window.variance["ground_speed"], lag) / 3.0)
    told_noise = scene.bin * np.sqrt(moving_sum(window.variance["acceleration"], lag))
    if _opposite(scene, gained, noise, LEAST_SPEED, told, told_noise, LEAST_SPEED, LEAST_SLOWING):
        yield "acceleration"


def scaled(scene: Scene) -> Iterator[str]:
    """Ground speed or acceleration, where the one changes several tenths more or less than the other says.

    Where the ground speed jumps it is the one; where the slip would be impossible with the
    one false it is the other; else it may be either, and both are named.
    """
    window = scene.window
    lag, n = max(round(LAG / scene.bin), 1), max(round(COMPARED / scene.bin), 1)
    gained = change(smooth(window.ground_speed), lag)
    told = scene.bin * moving_sum(window.acceleration, lag)
    if len(told) < n:
        return
    scale = _scales(np.where(scene.driving[lag:], gained, np.nan), told, n, round(ABOUT / scene.bin))
    wrong = np.abs(np.log(scale)) > OTHER_SCALE  # nor nan
    if not wrong.any():
        return
    factor, seen = median(scale[wrong]), _usual_slip(scene.slip[lag:], wrong, n)
    if _jumps(scene):
        yield "ground_speed"
        return
    if not 1.0 - (1.0 - seen) / factor < -FALSE_SLIP:
        yield "ground_speed"
    if not seen < -FALSE_SLIP:
        yield "acceleration"


def _scales(gained: Array, told: Array, n: int, late: int) -> Array:
    """Ratios of what is gained to what is told (both (M,)) in each n neighbours, (M - n + 1,); nan where none is sure.

    Either may be late by so many bins; of the delays with which the two may go together the
    one counts with which they are most alike.
    """
    nothing = np.full(late, np.nan)
    moved = neighbours(np.concatenate([nothing, told, nothing]), len(told))
    known = np.isfinite(gained) & np.isfinite(moved)
    one, other = np.where(known, gained, 0.0), np.where(known, moved, 0.0)
    both, of_one, of_other, count = np.stack([one * other, one * one, other * other, known]) @ _stretches(len(told), n)
    enough = (count >= KNOWN * n) & (of_one > n * CHANGING**2) & (of_other > 0.0)
    together = np.divide(both, np.sqrt(of_one * of_other), where=enough, out=np.zeros(both.shape))
    scale = np.divide(both, of_other, where=together > MAY_BE, out=np.full(both.shape, np.inf))
    best = np.argmin(np.abs(np.log(scale)), axis=0)
    chosen = np.take_along_axis(scale, best[None], axis=0)[0]
    return np.where(together.max(axis=0) > TOGETHER, chosen, np.nan)


@lru_cache(maxsize=8)
def _stretches(length: int, n: int) -> Array:
    """What sums each n neighbours of so many values: (length, length - n + 1) of ones and zeros."""
    first = np.arange(length - n + 1)
    place = np.arange(length)[:, None]
    return np.asarray((place >= first) & (place < first + n), float)


def _usual_slip(slip: Array, begins: Mask, n: int) -> float:
    """Median slip in the stretches of n of these instants (N, W) that begin where the mask (N - n + 1,) says."""
    within = np.convolve(begins, np.ones(n)) > 0.0
    return median(slip[within])


def _jumps(scene: Scene) -> bool:
    """Whether the ground speed changes at once by what no acceleration about that time explains."""
    window = scene.window
    at_once, about = (max(round(span / scene.bin), 1) for span in (AT_ONCE, ABOUT))
    jump = np.abs(change(window.ground_speed, at_once))
    told = np.abs(scene.bin * moving_sum(zero_if_unknown(window.acceleration), at_once))
    most = neighbours(np.pad(told, about), 2 * about + 1).max(axis=1)
    with np.errstate(invalid="ignore"):
        return bool((scene.driving[at_once:] & (jump > JUMP) & (most < UNEXPLAINED * jump)).any())


def pulling(scene: Scene) -> Iterator[str]:
    """The draft, where the vehicle pulls less whenever its wheels drive more; told only with slope and inertia."""
    window, rig, chassis = scene.window, scene.rig, scene.rig.chassis
    if chassis is None:
        return
    lag, weight, variance = max(round(LAG / scene.bin), 1), chassis.mass * GRAVITY, window.variance
    driven = change((window.torque / rig.radius).sum(axis=1), lag)
    noise = np.sqrt(change_variance((variance["torque"] / rig.radius**2).sum(axis=1), lag))
    known = np.isfinite(window.pitch) & np.isfinite(window.acceleration)
    pull = change(np.where(known, pull_given(window, chassis), np.nan), lag)
    of_pull = variance["draft"] + weight**2 * variance["pitch"] + chassis.mass**2 * variance["acceleration"]
    pull_noise = np.sqrt(change_variance(of_pull, lag))
    least = LEAST_FORCE * weight
    if _opposite(scene, driven, noise, least, pull, pull_noise, least, LEAST_PULLING):
        yield "draft"


def _opposite(
    scene: Scene,
    one: Array,
    one_noise: Array,
    one_least: float,
    other: Array,
    other_noise: Array,
    other_least: float,
    seconds: float,
) -> bool:
    """Whether changes (M,) of two quantities that go together go against each other for so long.

    Only changes count that are significant, of both: beyond their noise and at least so great.
    """
    with np.errstate(invalid="ignore"):
        both = np.abs(one) > np.maximum(DEVIATIONS * one_noise, one_least)
        both &= np.abs(other) > np.maximum(DEVIATIONS * other_noise, other_least)
    both &= scene.driving[len(scene.driving) - len(both) :]
    a, b = one[both], other[both]
    product, n = a * b, max(round(seconds / scene.bin), 1)
    if np.count_nonzero(product < 0.0) < OPPOSITE * n:
        return False
    opposite, of_both, of_one, of_other = (running_sum(x, n) for x in (product < 0.0, product, a * a, b * b))
    return bool(((opposite >= OPPOSITE * n) & (of_both < CORRELATION * np.sqrt(of_one * of_other))).any())
