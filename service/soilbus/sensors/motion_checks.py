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

import numpy as np

from soilbus.arrays import Array
from soilbus.estimation.window import forward, pairs, pull_given
from soilbus.grouping import grouped
from soilbus.sensors.consistency import change, median, moving_sum
from soilbus.sensors.facts import LIMITS, Facts, Finding, UndecidableError, changes, fault, regression, settled
from soilbus.sensors.options import CONSISTENCY
from soilbus.terra.vehicle import GRAVITY


def _wheel_based(facts: Facts) -> Iterator[Finding]:
    """A ground speed against which an axle does not slip while its thrust changes.

    Means of a second hold no slip that only a late speed makes.
    """
    second = facts.bins(1.0)
    for axle, own in _driven_axles(facts).items():
        carried = median(facts.window.load[:, own].sum(axis=1))
        rows = np.stack([facts.slip[:, own].mean(axis=1), facts.thrust[:, own].sum(axis=1) / carried], axis=1)
        means = settled(rows, second, facts.bins(2.0 * LIMITS.least_seconds))
        if means is None:
            continue
        slip, thrust = (means - means.mean(axis=0)).T
        (per_thrust,), (sd,) = regression(slip, thrust[:, None])
        if thrust.std() > LIMITS.excited and per_thrust + LIMITS.side_sd * sd < CONSISTENCY.slip_per_traction:
            yield fault(
                f"signals.ground_speed: goes with the {axle} wheels: hardly any slip comes with their thrust, which"
                f" moves by {thrust.std() * carried / 1e3:.1f} kN: is it computed from wheels or motor? map a radar's"
                " or a receiver's speed",
                "ground_speed",
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


def _felt(facts: Facts) -> Array | None:
    """Changes (N, 3) within 1 s of the accelerometer's integral, ground speed, and g sin(pitch)'s integral [m/s]."""
    window, lag = facts.window, facts.bins(1.0)
    if not {"acceleration", "ground_speed"} <= facts.mapped:
        return None
    slope = GRAVITY * np.sin(window.pitch) if "pitch" in facts.mapped else np.zeros(len(window.t))
    summed = [facts.config.estimator.bin * moving_sum(a, lag) for a in (forward(facts.raw).acceleration, slope)]
    gained = change(np.where(facts.straight, window.ground_speed, np.nan), lag)
    rows = settled(np.stack([summed[0], gained, summed[1]], axis=1), facts.bins(0.5), facts.bins(20.0))
    return None if rows is None else np.asarray(rows - rows.mean(axis=0))  # a constant offset is no scale


def _slope_felt(rows: Array) -> tuple[float, float] | None:
    """Share of the slope that the accelerometer feels, and what it may be off; None where the slope hardly changes."""
    (_, share), (_, sd) = regression(rows[:, 0], rows[:, 1:])
    margin = LIMITS.side_sd * float(sd)
    return (float(share), margin) if rows[:, 2].std() > GRAVITY * LIMITS.tilted and margin < 0.5 else None


def _accelerometer(facts: Facts) -> Iterator[Finding]:
    """Scale and kind of the accelerometer; scale and sign of the pitch that it feels."""
    rows = _felt(facts)
    if rows is None:
        return
    for factors, sds, power in (
        (*regression(rows[:, 0], rows[:, 1:]), 1.0),
        (*regression(rows[:, 1], rows[:, [0, 2]]), -1.0),
    ):
        if factors[0] - LIMITS.side_sd * sds[0] > LIMITS.scale[1]:
            size = f"{factors[0] ** power:.2g} times as much as the ground speed asks"
            yield fault(f"signals.acceleration: changes {size}: its unit or scale?", "acceleration")
            return
    felt, sensor = _slope_felt(rows), facts.config.signals.acceleration
    if "pitch" not in facts.mapped or sensor is None or felt is None:
        return
    (share, margin), is_force = felt, sensor.kind == "specific_force"
    if share < -margin:
        text = "signals.pitch: the accelerometer feels it the other way: its sign (positive nose up; sign = -1)?"
        yield fault(text, "pitch")
    elif not is_force and share - margin > 0.5:
        text = 'signals.acceleration: feels the slope, which dv/dt does not: kind = "specific_force"?'
        yield fault(text, "acceleration")
    elif is_force and share < margin:
        text = 'signals.acceleration: does not feel the slope: kind = "kinematic", or scale of signals.pitch?'
        yield fault(text, "acceleration")
    elif is_force and (share + margin < 0.5 or share - margin > 1.5):
        text = f"the accelerometer feels {share:.2g} times the slope that it shows: its unit or scale?"
        yield fault(f"signals.pitch: {text}", "pitch")


def _slope(facts: Facts) -> Iterator[Finding]:
    """Changes of the wheels' thrust against those of the slope alone."""
    window, chassis = facts.window, facts.rig.chassis
    if chassis is None or "pitch" not in facts.mapped or not np.isfinite(window.pitch).any():
        return
    weight = chassis.mass * GRAVITY
    uphill = weight * np.sin(window.pitch)
    x = changes(facts, facts.thrust.sum(axis=1), uphill, pull_given(window, chassis) - uphill)
    if x is None or x[:, 1].std() < LIMITS.excited * weight:
        rows = _felt(facts)
        if rows is not None and _slope_felt(rows):
            return  # the accelerometer says it
        kind = " and the kind of signals.acceleration" if "acceleration" in facts.mapped else ""
        raise UndecidableError(
            f"the slope hardly changes: the sign and scale of signals.pitch{kind} cannot be decided: drive up and down"
            " a slope"
        )
    (of_slope, _), (sd, _) = regression(x[:, 0], x[:, 1:])
    if of_slope < -LIMITS.side_sd * sd:
        text = "signals.pitch: the wheels thrust less uphill: its sign (positive nose up; sign = -1)?"
        yield fault(text, "pitch")


def _yaw(facts: Facts) -> Iterator[Finding]:
    """Yaw rate against wheel speeds in turns: positive to the left, where the right wheels go faster.

    Without it, only loads and torques of each wheel tell left and right apart.
    """
    window, rig = facts.window, facts.rig
    own = {f"{quantity}.{wheel}" for quantity in ("load", "torque") for wheel in rig.wheels}
    if pairs(rig).size and "yaw_rate" not in facts.mapped and not own <= facts.mapped:
        raise UndecidableError("left and right wheels cannot be told apart: map signals.yaw_rate and drive curves")
    if not np.isfinite(window.yaw_rate).any() or not pairs(rig).size:
        return
    left, right = pairs(rig)
    rims = rig.radius * window.speed
    sides = np.sign(rims[:, right] - rims[:, left])
    with np.errstate(invalid="ignore"):
        turns = (np.abs(window.yaw_rate) > 0.1) & (np.abs(sides.sum(axis=1)) == sides.shape[1])
    if turns.sum() < facts.bins(2.0):
        raise UndecidableError("no turns: the sign of the yaw rate, and which wheels are left, cannot be decided")
    if median((sides[:, 0] * np.sign(window.yaw_rate))[turns]) < 0.0:
        yield fault(
            "signals.yaw_rate: to the left while the left wheels go faster: its sign (positive to the left), or left"
            " and right wheels swapped (the left wheel of an axle comes first)?",
            "yaw_rate",
        )


def _radius_open(facts: Facts) -> Iterator[Finding]:
    """Radii where the wheels roll without thrust; else what their errors are worth."""
    chassis = facts.rig.chassis
    if chassis is None:
        return
    forces = facts.thrust.sum(axis=1), pull_given(facts.window, chassis)
    idle = np.max(np.abs(forces), axis=0) < LIMITS.rolling * chassis.mass * GRAVITY
    slips = [(wheel, median(facts.slip[idle, i])) for i, wheel in enumerate(facts.rig.wheels)]
    if idle.sum() > facts.bins(LIMITS.least_seconds):
        for wheel, slip in slips:
            if abs(slip) > LIMITS.idle_slip:
                yield Finding(f"wheel.{wheel}: slips by {slip:.2f} where nothing is pulled: its radius?", False)
        return
    free = [w.name for w in facts.config.wheel if not w.driven and w.name in facts.rig.wheels]
    usual = {wheel: median(facts.slip[:, facts.rig.wheels.index(wheel)]) for wheel in free}
    rims = ", ".join(f"{wheel} {1.0 / (1.0 - own):.3f}" for wheel, own in usual.items())
    over = f" (rim over ground speed of free wheels: {rims})" if rims else ""
    raise UndecidableError(
        f"radius and slip cannot be told apart, 5 % of radius is 0.05 of slip{over}: roll a minute without draft on"
        " firm ground"
    )


MOTION_CHECKS = (_wheel_based, _accelerometer, _slope, _yaw, _radius_open)
"""Each with the channels that no check before it has named."""
