"""Check of a configuration against a recording: ground speed, slope, acceleration, yaw rate.

    wheel speed     slip = a * thrust over load + an error of the radius, a > 0: on no ground is it nothing
    accelerometer   changes of its readings = a * changes of ground speed + b * those of g sin(pitch), a = 1, and b = 1
                    where it feels gravity, else 0
    slope           changes of thrust rise with those of m g sin(pitch)
    yaw rate        positive where the right wheels go faster

Noise of a regressor makes its coefficient smaller, never larger: only a coefficient that is too large, either way
round, tells of a wrong scale.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from soilbus.arrays import Array
from soilbus.estimation.window import forward, pairs, pull_given
from soilbus.grouping import grouped
from soilbus.sensors.consistency import change, median, moving_sum
from soilbus.sensors.facts import LIMITS, Facts, Finding, UndecidableError, changes, regression, settled, steps
from soilbus.terra.vehicle import GRAVITY


def _wheel_based(facts: Facts) -> Iterator[Finding]:
    """A ground speed against which an axle does not slip while its thrust changes.

    Means of a second hold no slip that only a late speed makes.
    """
    second, _ = steps(facts)
    for axle, own in _driven_axles(facts).items():
        carried = median(facts.window.load[:, own].sum(axis=1))
        rows = np.stack([facts.slip[:, own].mean(axis=1), facts.thrust[:, own].sum(axis=1) / carried], axis=1)
        means = settled(rows, second, 2 * LIMITS.least_seconds * second)
        if means is None:
            continue
        slip, thrust = (means - means.mean(axis=0)).T
        (per_thrust,), (sd,) = regression(slip, thrust[:, None])
        if thrust.std() > LIMITS.excited and per_thrust + LIMITS.side_sd * sd < LIMITS.least_slip:
            yield Finding(
                f"signals.ground_speed: goes with the {axle} wheels: hardly any slip comes with their thrust, which"
                f" moves by {thrust.std() * carried / 1e3:.1f} kN: is it computed from wheels or motor? map a radar's"
                " or a receiver's speed",
                True,
                ("ground_speed",),
            )
            return


def _driven_axles(facts: Facts) -> dict[str, list[int]]:
    """Wheels of each axle whose own torque is measured; where there is none, all driven wheels."""
    driven = [w for w in facts.config.wheel if w.driven and w.name in facts.rig.wheels]
    axles = {
        axle: [w.name for w in wheels]
        for axle, wheels in grouped(driven, lambda w: str(w.axle)).items()
        if f"torque.{axle}" in facts.mapped or {f"torque.{w.name}" for w in wheels} <= facts.mapped
    } or {"driven": [w.name for w in driven]}
    return {axle: [facts.rig.wheels.index(name) for name in names] for axle, names in axles.items() if names}


class Felt(NamedTuple):
    """Parts of an accelerometer's readings, with standard deviations, and the sd of the slope [m/s^2]."""

    of_speed: float
    of_slope: float
    speed_sd: float
    slope_sd: float
    slope: float

    @property
    def shows_slope(self) -> bool:
        """Whether the readings decide if gravity is felt."""
        return self.slope > GRAVITY * LIMITS.tilted and LIMITS.side_sd * self.slope_sd < 0.5


def _changes(facts: Facts) -> Array | None:
    """Changes (N, 3) within 1 s of the accelerometer's integral, ground speed, and g sin(pitch)'s integral [m/s]."""
    window, (lag, block) = facts.window, steps(facts)
    if not {"acceleration", "ground_speed"} <= facts.mapped:
        return None
    slope = GRAVITY * np.sin(window.pitch) if "pitch" in facts.mapped else np.zeros(len(window.t))
    summed = [facts.config.estimator.bin * moving_sum(a, lag) for a in (forward(facts.raw).acceleration, slope)]
    gained = change(np.where(facts.straight, window.ground_speed, np.nan), lag)
    rows = settled(np.stack([summed[0], gained, summed[1]], axis=1), block)
    return None if rows is None else np.asarray(rows - rows.mean(axis=0))  # a constant offset is no scale


def _felt(rows: Array) -> Felt:
    (of_speed, of_slope), (speed_sd, slope_sd) = regression(rows[:, 0], rows[:, 1:])
    return Felt(float(of_speed), float(of_slope), float(speed_sd), float(slope_sd), float(rows[:, 2].std()))


def _accelerometer(facts: Facts) -> Iterator[Finding]:
    """Scale and kind of the accelerometer; scale and sign of the pitch that it feels."""
    rows = _changes(facts)
    if rows is None:
        return
    felt, most = _felt(rows), LIMITS.scale[1]
    (back, _), (back_sd, _) = regression(rows[:, 1], rows[:, [0, 2]])
    size = felt.of_speed if felt.of_speed - LIMITS.side_sd * felt.speed_sd > most else 0.0
    if not size and back - LIMITS.side_sd * back_sd > most:
        size = 1.0 / float(back)
    if size:
        yield Finding(
            f"signals.acceleration: changes {size:.2g} times as much as the ground speed asks: its unit or scale?",
            True,
            ("acceleration",),
        )
        return
    if "pitch" not in facts.mapped or facts.config.signals.acceleration is None or not felt.shows_slope:
        return
    margin, is_force = LIMITS.side_sd * felt.slope_sd, facts.config.signals.acceleration.kind == "specific_force"
    if felt.of_slope < -margin:
        text = "signals.pitch: the accelerometer feels it the other way: its sign (positive nose up; sign = -1)?"
        yield Finding(text, True, ("pitch",))
    elif not is_force and felt.of_slope - margin > 0.5:
        text = 'signals.acceleration: feels the slope, which dv/dt does not: kind = "specific_force"?'
        yield Finding(text, True, ("acceleration",))
    elif is_force and abs(felt.of_slope) < margin and margin < 0.5:
        text = 'signals.acceleration: does not feel the slope: kind = "kinematic", or scale of signals.pitch?'
        yield Finding(text, True, ("acceleration",))
    elif is_force and (felt.of_slope + margin < 0.5 or felt.of_slope - margin > 1.5):
        yield Finding(
            f"signals.pitch: the accelerometer feels {felt.of_slope:.2g} times the slope that it shows: its unit or"
            " scale?",
            True,
            ("pitch",),
        )


def _slope(facts: Facts) -> Iterator[Finding]:
    """Changes of the wheels' thrust against those of the slope alone."""
    window, chassis = facts.window, facts.rig.chassis
    if chassis is None or "pitch" not in facts.mapped or not np.isfinite(window.pitch).any():
        return
    weight = chassis.mass * GRAVITY
    uphill = weight * np.sin(window.pitch)
    x = changes(facts, facts.thrust.sum(axis=1), uphill, pull_given(window, chassis) - uphill)
    if x is None or x[:, 1].std() < LIMITS.excited * weight:
        if (felt := _changes(facts)) is not None and _felt(felt).shows_slope:
            return  # the accelerometer says it
        kind = " and the kind of signals.acceleration" if "acceleration" in facts.mapped else ""
        raise UndecidableError(
            f"the slope hardly changes: the sign and scale of signals.pitch{kind} cannot be decided: drive up and down"
            " a slope"
        )
    (of_slope, _), (sd, _) = regression(x[:, 0], x[:, 1:])
    if of_slope < -LIMITS.side_sd * sd:
        text = "signals.pitch: the wheels thrust less uphill: its sign (positive nose up; sign = -1)?"
        yield Finding(text, True, ("pitch",))


def _yaw(facts: Facts) -> Iterator[Finding]:
    """Yaw rate against wheel speeds in turns: positive to the left, where the right wheels go faster.

    Where the track is known only speeds that differ by about yaw rate times track are of a turn, and not of a spin.
    """
    window, rig = facts.window, facts.rig
    if not np.isfinite(window.yaw_rate).any() or not pairs(rig).size:
        return
    rims = rig.radius * window.speed
    apart = np.stack([rims[:, right] - rims[:, left] for left, right in pairs(rig).T.tolist()])
    with np.errstate(invalid="ignore"):
        turns = (np.abs(window.yaw_rate) > 0.1) & (np.abs(np.sign(apart).sum(axis=0)) == len(apart))
        if rig.track is not None:
            due = np.abs(window.yaw_rate) * rig.track
            turns &= (np.abs(np.abs(apart) - due) < LIMITS.turn * due).all(axis=0)
    if turns.sum() * facts.config.estimator.bin < 2.0:
        raise UndecidableError("no turns: the sign of the yaw rate, and which wheels are left, cannot be decided")
    if median(np.sign(apart[0] * window.yaw_rate)[turns]) < 0.0:
        yield Finding(
            "signals.yaw_rate: to the left while the left wheels go faster: its sign (positive to the left), or left"
            " and right wheels swapped (the left wheel of an axle comes first)?",
            True,
            ("yaw_rate",),
        )


def _sides_open(facts: Facts) -> Iterator[Finding]:
    """No finding: says where left and right are not told apart."""
    own = {f"{quantity}.{wheel}" for quantity in ("load", "torque") for wheel in facts.rig.wheels}
    if pairs(facts.rig).size and "yaw_rate" not in facts.mapped and not own <= facts.mapped:
        raise UndecidableError("left and right wheels cannot be told apart: map signals.yaw_rate and drive curves")
    yield from ()


def _radius_open(facts: Facts) -> Iterator[Finding]:
    """Radii where the wheels roll without thrust; else what their errors are worth."""
    chassis = facts.rig.chassis
    if chassis is None:
        return
    weight = chassis.mass * GRAVITY
    idle = np.abs(facts.thrust.sum(axis=1)) < LIMITS.rolling * weight
    idle &= np.abs(pull_given(facts.window, chassis)) < LIMITS.pull * weight
    if idle.sum() * facts.config.estimator.bin > LIMITS.least_seconds:
        for i, wheel in enumerate(facts.rig.wheels):
            slip = median(facts.slip[idle, i])
            if abs(slip) > LIMITS.idle_slip:
                yield Finding(f"wheel.{wheel}: slips by {slip:.2f} where nothing is pulled: its radius?", False)
        return
    free = {w.name for w in facts.config.wheel if not w.driven} & set(facts.rig.wheels)
    rims = [
        f"{wheel} {1.0 / (1.0 - median(facts.slip[:, i])):.3f}"
        for i, wheel in enumerate(facts.rig.wheels)
        if wheel in free
    ]
    over = f" (rim over ground speed of free wheels: {', '.join(rims)})" if rims else ""
    raise UndecidableError(
        f"radius and slip cannot be told apart, 5 % of radius is 0.05 of slip{over}: roll a minute without draft on"
        " firm ground"
    )


MOTION_CHECKS = (_wheel_based, _accelerometer, _slope, _yaw, _sides_open, _radius_open)
"""Each with the channels that no check before it has named."""
