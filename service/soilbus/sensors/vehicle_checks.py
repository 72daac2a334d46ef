"""Check of a configuration against a recording: loads, gears, speeds, forces, motion.

    weight          sum of the wheel loads = m g cos(pitch), and its share on each axle by moments
    gear            motor speed = gear ratio * wheel speed
    slip            1 - v / (r omega), within the range of driven wheels
    transfer        changes of the front axle's load less the rear's = twice those by moments of draft, slope, inertia
    balance         changes of sum(torque / r) = 0.7 to 1.0 * changes of draft, and of slope + inertia
    sides           left less right: torque = a * load + b * slip + constant, with a > 0 and b > 0
    wheel speed     slip = a * thrust over load + an error of the radius, a > 0 on every ground
    accelerometer   changes of its readings = a * changes of ground speed + b * those of g sin(pitch), a = 1, and b = 1
                    where it feels gravity, else 0
    slope           changes of thrust rise with those of m g sin(pitch)
    yaw rate        positive where the right wheels go faster

A wrong sign of a or b shows that loads, speeds or torques of left and right are swapped; all three swapped at once are
the mirrored vehicle.  Noise of a regressor makes its coefficient smaller, never larger: only a coefficient that is too
large, either way round, tells of a wrong scale.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

import numpy as np

from soilbus.arrays import Array
from soilbus.config.model import Axle, Wheel
from soilbus.estimation.window import forward, pairs, pull_given, zero_if_unknown
from soilbus.grouping import grouped
from soilbus.sensors.consistency import change, median, moving_sum
from soilbus.sensors.facts import LIMITS, Facts, Finding, UndecidableError, changes, fault, regression, settled
from soilbus.sensors.options import CONSISTENCY
from soilbus.terra.vehicle import GRAVITY, Chassis, axle_loads


def _weight(facts: Facts) -> Iterator[Finding]:
    """Sum of the loads against the mass, and each axle's load against the geometry."""
    window, rig, chassis = facts.window, facts.rig, facts.rig.chassis
    if chassis is None:
        return
    if not any(name.startswith("load.") for name in facts.mapped):
        raise UndecidableError("no load is measured: vehicle.mass and cg_ahead_of_rear_axle cannot be compared")
    weight, measured = chassis.mass * GRAVITY, median(window.load.sum(axis=1) / np.cos(zero_if_unknown(window.pitch)))
    if not math.isfinite(measured):
        raise UndecidableError("not every wheel load is known: the loads cannot be compared with the mass")
    share, names = measured / weight, [f"load.{w}" for w in rig.wheels]
    off = abs(share - 1.0)
    if off > LIMITS.weight / 2.0:
        why = _likely(FACTORS, share, 0.96, 1.04) or "which of them is wrong? (ballast, unit or scale of the loads)"
        has = f"{measured / 1e3:.1f} kN, the weight of {measured / GRAVITY:.0f} kg"
        text = f"the wheel loads sum to {has}, but vehicle.mass = {chassis.mass:g} kg: {why}"
        yield fault(text, *names) if off > LIMITS.weight else Finding(text, False)
        return
    (front, rear), (front_due, rear_due) = _axle_loads(facts, chassis)
    if set(rig.front.tolist()) == {True, False} and abs(front - front_due) > LIMITS.weight * weight:
        between = "axles between them count on both by their place; " if len(rig.axles) > 2 else ""
        carry = f"the front wheels carry {front / 1e3:.1f} kN and the rear wheels {rear / 1e3:.1f} kN"
        give = f"mass, centre of gravity and draft give {front_due / 1e3:.1f} and {rear_due / 1e3:.1f} kN"
        why = f"{between}cg_ahead_of_rear_axle, loads of swapped wheels, or a draft of the wrong sign or size?"
        is_swapped = abs(front - rear_due) < LIMITS.weight * weight
        text = f"{carry}, where {give}: {why}"
        yield fault(text, *names) if is_swapped else Finding(text, False)


def _axle_loads(facts: Facts, chassis: Chassis) -> tuple[list[float], list[float]]:
    """Medians of the loads [N] on the front and rear axle, and what these should be by moments."""
    window, rig = facts.window, facts.rig
    known = (zero_if_unknown(a) for a in (window.draft, window.pitch, window.acceleration))
    due = [median(np.broadcast_to(load, window.t.shape)) for load in axle_loads(chassis, *known)]
    return [median(window.load @ share) for share in (rig.ahead, 1.0 - rig.ahead)], due


def _one_axle(facts: Facts) -> Iterator[Finding]:
    """The load of the one axle that is weighed against the geometry, for its unit, and against the weight."""
    rig, chassis = facts.rig, facts.rig.chassis
    names = [f"load.{w}" for w in rig.wheels]
    weighed = [axle for axle in ("front", "rear") if f"load.{axle}" in facts.mapped]
    if chassis is None or len(weighed) != 1 or facts.mapped & {*names} or set(rig.front.tolist()) != {True, False}:
        return
    has, due = (pair[weighed[0] == "rear"] for pair in _axle_loads(facts, chassis))
    why = _likely(FACTORS, has / due, 1.0 - LIMITS.weight, 1.0 + LIMITS.weight)
    if why and _log_off(has / due) > 1.0:
        given = f"where mass, centre of gravity and draft give {due / 1e3:.1f} kN"
        yield fault(f"axle.{weighed[0]}.load: {has / 1e3:.1f} kN, {given}: {why}", *names)
    elif has > (1.0 + LIMITS.weight) * chassis.mass * GRAVITY:
        more = f"{has / 1e3:.1f} kN, more than the weight of vehicle.mass = {chassis.mass:g} kg"
        yield fault(f"the {weighed[0]} axle alone carries {more}: mass, or unit or scale of the load?", *names)


def _transfer(facts: Facts) -> Iterator[Finding]:
    """Changes of each axle's load against those that draft, slope and inertia bring to it."""
    window, rig, chassis = facts.window, facts.rig, facts.rig.chassis
    cells = [f"load.{wheel}" for wheel in rig.wheels]
    if chassis is None or set(rig.front.tolist()) != {True, False} or not set(cells) <= facts.mapped:
        return
    known = (zero_if_unknown(a) for a in (window.pitch, window.acceleration))
    front = np.broadcast_to(axle_loads(chassis, window.draft, *known)[0], window.t.shape)
    more = window.load @ (2.0 * rig.ahead - 1.0)
    rows = changes(facts, more, 2.0 * np.where(facts.straight, front, np.nan))
    lever = max(chassis.hitch_height, chassis.cg_height) / chassis.wheelbase
    if rows is None or rows[:, 1].std() < LIMITS.excited * chassis.mass * GRAVITY * lever:
        return
    (share,), (sd,) = regression(rows[:, 0], rows[:, 1:])
    if share < LIMITS.scale[0] - LIMITS.side_sd * sd:
        what = f"load moves between front and rear wheels {share:.2f} times as much as draft, slope and inertia move it"
        why = "are loads of front and rear wheels swapped, or is hitch_height or cg_height wrong?"
        yield fault(f"{what}: {why}", *cells)


def _log_off(ratio: float) -> float:
    """How far a ratio is from one, as a logarithm; infinite where a channel reads nothing, or below it."""
    return abs(math.log(ratio)) if ratio > 0.0 else math.inf


FACTORS = {
    0.45359237: "is the mass in lb?",
    GRAVITY: "is the mass a weight, or are the loads taken for kg?",
    1.0 / GRAVITY: "are the loads in kg, not in N?",
    1e3: "are the loads in N where the DBC says kN?",
    1e-3: "are the loads in kN where the DBC says N?",
    2.0: "does each load cell read a whole axle?",
    0.5: "does a load cell read only half of its wheel's load?",
}
"""The likely mistake where the loads sum up to this multiple of the weight."""

FASTER = {
    30.0 / math.pi: "are the wheel speeds in rpm where the DBC says rad/s, ",
    3.6: "is the ground speed in m/s where the DBC says km/h, ",
    2.0: "a diameter in the place of a radius, ",
    1.0 / 3.6: "is the ground speed in km/h where the DBC says m/s, ",
    math.pi / 30.0: "are the wheel speeds in rad/s where the DBC says rpm, ",
}
"""The likely mistake where rims seem to run this many times as fast as the ground."""

OTHER_SIDE = "torques measured at the other side of the gear"


def _likely(mistakes: Mapping[float, str], ratio: float, least: float, most: float) -> str:
    """The mistake that makes this multiple, to such a factor; "" if there is none."""
    return next((why for known, why in mistakes.items() if least < ratio / known < most), "")


def _directions(facts: Facts) -> Iterator[Finding]:
    """Wheels that turn or drive in the opposite direction to most."""
    rig, raw, moving = facts.rig, facts.raw, facts.straight
    turns = [median(np.sign(raw.speed[moving, i])) for i in range(len(rig.wheels))]
    forward_sign = np.sign(np.nansum(turns))
    for wheel, turn in zip(rig.wheels, turns, strict=True):
        if turn * forward_sign < 0.0:
            text = f"wheel.{wheel}.speed: turns backward while most wheels turn forward: sign = -1?"
            yield fault(text, f"speed.{wheel}", f"torque.{wheel}")
    thrust = [median(facts.thrust[:, i]) for i in range(len(rig.wheels))]
    share = np.array(thrust) / max(np.nanmax(np.abs(thrust), initial=0.0), 1.0)
    drives = np.nansum(np.sign(share) * (np.abs(share) > 0.2))
    braking = [wheel for wheel, part in zip(rig.wheels, share.tolist(), strict=True) if part < -0.2]
    of_axles = {a.name: [w.name for w in facts.config.wheel if w.axle == a.name] for a in facts.config.axle if a.torque}
    for axle, wheels in of_axles.items():
        if wheels and set(wheels) <= set(braking) and drives >= 0.0:
            braking = [wheel for wheel in braking if wheel not in wheels]
            text = f"axle.{axle}.torque: brakes while the other axle drives: sign = -1?"
            yield fault(text, f"torque.{axle}", *(f"torque.{wheel}" for wheel in wheels))
    for wheel in braking if drives > 0.0 else ():
        yield fault(f"wheel.{wheel}.torque: brakes while most wheels drive: sign = -1?", f"torque.{wheel}")
    if forward_sign > 0.0 and median(np.sign(raw.ground_speed[moving])) < 0.0:
        text = "signals.ground_speed: backward while the wheels turn forward: sign = -1?"
        yield fault(text, "ground_speed")


def _gears(facts: Facts) -> Iterator[Finding]:
    """Speeds of what turns together: motor and wheel, an axle's motor and the mean of its wheels, locked wheels.

    An unmapped motor speed may also be the wheel's own.  Any differential keeps the mean of its wheels.  Each of two
    locked wheels is known to half of what a gear's two speeds may differ by.
    """
    ratios: list[tuple[str, Wheel | Axle, float, list[str], str]] = []
    for i, wheel in enumerate(facts.rig.wheels):
        own = next(w for w in facts.config.wheel if w.name == wheel)
        ratio = median(np.abs(facts.motor[:, i] / facts.raw.speed[:, i])[facts.straight])
        is_own = _log_off(own.gear_ratio * ratio) < CONSISTENCY.gear_slack
        if own.motor_speed is not None and (f"motor_speed.{wheel}" in facts.mapped or not is_own):
            ratios.append((f"wheel.{wheel}", own, ratio, [wheel], "the wheel"))
    for axle in facts.config.axle:
        names = [w.name for w in facts.config.wheel if w.axle == axle.name and w.speed is not None]
        pair = [facts.rig.wheels.index(name) for name in names if name in facts.rig.wheels]
        if axle.name not in facts.shaft or axle.motor_speed is None or len(pair) != 2:
            continue
        ratio = median((facts.shaft[axle.name] / facts.raw.speed[:, pair].mean(axis=1))[facts.straight])
        if ratio < 0.0:
            text = f"axle.{axle.name}.motor_speed: turns backward while its wheels turn forward: sign = -1?"
            yield fault(text, f"torque.{axle.name}", f"speed.{axle.name}")
        else:
            ratios.append((f"axle.{axle.name}", axle, ratio, names, "the mean of its wheels"))
    for key, of, ratio, names, what in ratios:
        if not math.isfinite(ratio) or _log_off(ratio) < CONSISTENCY.gear_slack or of.motor_speed is None:
            continue
        radius = " radius (the wheels' speeds are in m/s)," if facts.by_radius & set(names) else ""
        turns = f"{of.motor_speed.signal} turns {of.gear_ratio * ratio:.4g} times as fast as {what}"
        text = f"{turns}: gear ratio,{radius} or unit or byte order of one of the speeds?"
        speed = f"{'motor_speed' if isinstance(of, Wheel) else 'speed'}.{of.name}"
        yield fault(f"{key}.gear_ratio = {of.gear_ratio:g}, but {text}", f"torque.{of.name}", speed)
    for axle in facts.config.axle:
        both = [w for w in facts.config.wheel if w.axle == axle.name and w.driven and w.speed is not None]
        if axle.differential != "locked" or len(both) != 2:
            continue
        one, other = (facts.raw.speed[:, facts.rig.wheels.index(w.name)] for w in both)
        apart = median(np.abs(one / other - 1.0)[facts.straight])
        if apart > CONSISTENCY.gear_slack / 2.0:
            text = f"the speeds of {both[0].name} and {both[1].name} differ by {apart:.1%} straight on"
            key = f'axle.{axle.name}.differential = "locked"'
            yield fault(f'{key}, but {text}: "open" or "limited"?', *(f"speed.{w.name}" for w in both))


def _free_wheels(facts: Facts) -> Iterator[Finding]:
    """Rims of wheels that roll freely against the ground: they may skid, and never drive."""
    free = {w.name for w in facts.config.wheel if not w.driven}
    for i, wheel in enumerate(facts.rig.wheels):
        slip = median(facts.slip[:, i])
        if wheel in free and (slip < -LIMITS.skid or slip > LIMITS.idle_slip):
            goes = f"its rim goes {1.0 / (1.0 - slip):.2f} times as fast as the ground"
            text = f"wheel.{wheel}: rolls freely, but {goes}: radius, or unit of its speed or of the ground speed?"
            yield fault(text, f"speed.{wheel}") if abs(slip) > LIMITS.skid else Finding(text, False)


def _slips(facts: Facts) -> Iterator[Finding]:
    """Rim speeds against the ground speed and against each other."""
    slip, wheels = facts.slip, facts.rig.wheels
    speeds = [f"speed.{w}" for w in wheels]
    drives = np.where(facts.thrust > 0.0, slip, np.nan)
    usual = {w: own for i, w in enumerate(wheels) if math.isfinite(own := median(drives[:, i]))}
    if not usual:
        raise UndecidableError("no slip is known: wheel and ground speeds cannot be compared")
    least, middle = float(np.nanquantile(slip, 0.05)), float(np.median(list(usual.values())))
    at_shaft = any(w.speed is not None and w.speed.at == "shaft" for w in facts.config.wheel)
    gear = "gear ratio, " if at_shaft or any(a.motor_speed is not None for a in facts.config.axle) else ""
    if middle < -LIMITS.skid or least > LIMITS.never_less:
        is_pushed = middle < -LIMITS.skid
        factor = 1.0 / (1.0 - (middle if is_pushed else least))
        who = "driving wheels seem" if is_pushed else "the wheels seem"
        never = "" if is_pushed else f", never by less than {least:.2f}"
        goes = f"their rims go {factor:.2f} times as fast as the ground"
        why = _likely(FASTER, factor, 0.95, 1.7) + gear  # slip of up to 0.4 included
        wrong = f"{why}radius, or unit, sign or byte order of ground and wheel speeds?"
        yield fault(f"{who} to slip by {middle:.2f}{never}: {goes}: {wrong}", "ground_speed", *speeds)
        return
    apart = {wheel: own for wheel, own in usual.items() if abs(own - middle) > LIMITS.wheel_apart}
    if 2 * len(apart) > len(usual):  # there are no most wheels
        groups = [{w: own for w, own in apart.items() if (own > middle) is more} for more in (True, False)]
        slips = [f"{' and '.join(group)} by {np.mean(list(group.values())):.2f}" for group in groups if group]
        wrong = f"radius, {gear}speed signal or its unit of some of them?"
        yield fault(f"wheels seem to slip unlike: {', '.join(slips)}: {wrong}", *speeds)
        return
    for wheel, own in apart.items():
        text = f"seems to slip by {own:.2f}, most wheels by {middle:.2f}: its radius, {gear}speed signal or its unit?"
        yield fault(f"wheel.{wheel}: {text}", f"speed.{wheel}")


def _balance(facts: Facts) -> Iterator[Finding]:
    """Thrust of the wheels against their weight, and its changes against those of draft and of slope and inertia."""
    window, rig, chassis = facts.window, facts.rig, facts.rig.chassis
    if chassis is None:
        return
    weight, torques = chassis.mass * GRAVITY, [f"torque.{w}" for w in rig.wheels]
    thrust, asked = facts.thrust.sum(axis=1), pull_given(window, chassis)
    usual = median(thrust)
    if usual < -0.02 * weight:
        what = f"the wheels brake with {-usual / 1e3:.1f} kN all along while the vehicle drives on"
        yield fault(f"{what}: sign of the torques, or of the wheel speeds (sign = -1)?", *torques)
        return
    if usual > LIMITS.most_thrust * weight:
        what = f"{usual / 1e3:.3g} kN, more than soil can hold under {weight / 1e3:.3g} kN"
        why = f"gear_ratio too large, {OTHER_SIDE} (`at`), or their unit or byte order?"
        yield fault(f"the wheels thrust with {what}: {why}", *torques)
        return
    rows = changes(facts, thrust, window.draft, asked - window.draft, least=LIMITS.least_seconds)
    if rows is None:
        what = "torques and draft are not known together"
        raise UndecidableError(f"{what}: their signs and the gear ratio cannot be compared")
    (of_draft, of_inertia), (draft_sd, inertia_sd) = regression(rows[:, 0], rows[:, 1:])
    given, drawn, _ = rows.std(axis=0) > LIMITS.excited * weight
    swings = given and of_draft - LIMITS.side_sd * draft_sd > LIMITS.scale[1]
    if not drawn and not swings:
        what = "the signs of draft and torque and the gear ratio"
        raise UndecidableError(f"the draft hardly changes: {what} cannot be decided")
    if of_draft < -LIMITS.side_sd * draft_sd:
        sign = "sign of the draft (positive holds the vehicle back; sign = -1)?"
        yield fault(f"signals.draft: falls whenever the wheels thrust more: {sign}", "draft")
    elif of_draft > LIMITS.scale[1] or of_draft + LIMITS.side_sd * draft_sd < LIMITS.scale[0]:
        of_torque = of_inertia > 2.0 * LIMITS.side_sd * inertia_sd and 0.7 < of_draft / of_inertia < 1.4
        gear = f"gear_ratio too {'large' if of_draft > 1.0 else 'small'}"
        in_kgf = "kgf or daN where the DBC says N, " if 6.5 < of_draft < 11.0 else ""
        why = f"unit or scale of the draft, {in_kgf}or {gear} (or torques at the other side of the gear)?"
        if of_torque:
            why = f"{gear}, {OTHER_SIDE} (`at`), or their unit?"
        text = f"the wheels' thrust changes {of_draft:.2f} times as much as the draft does: {why}"
        yield fault(text, *torques, "draft")
    elif of_inertia < -LIMITS.side_sd * inertia_sd:
        lag = facts.bins(1.0)
        slope, inertia = (change(zero_if_unknown(a), lag).std() for a in (window.pitch, window.acceleration))
        name = "pitch" if GRAVITY * slope > inertia else "acceleration"
        sign = f"its sign (positive {'nose up' if name == 'pitch' else 'where the vehicle speeds up'}; sign = -1)?"
        yield fault(f"signals.{name}: asks for less thrust whenever the wheels give more: {sign}", name)


def _levels(facts: Facts) -> Iterator[Finding]:
    """Mean thrust against mean pull: the thrust must exceed the pull by the rolling resistance."""
    window, rig, chassis = facts.window, facts.rig, facts.rig.chassis
    if chassis is None:
        return
    thrust = median(facts.thrust.sum(axis=1))
    asked = median(pull_given(window, chassis)[facts.straight & np.isfinite(window.pitch)])
    if asked > LIMITS.rolling * chassis.mass * GRAVITY and thrust < LIMITS.scale[0] * asked:
        what = f"{thrust / 1e3:.2f} kN, but draft, slope and inertia alone ask for {asked / 1e3:.2f} kN"
        why = f"gear_ratio too small, {OTHER_SIDE} (`at`), or unit of torque or draft?"
        yield fault(f"the wheels thrust with {what}: {why}", *(f"torque.{w}" for w in rig.wheels), "draft")


def _sides(facts: Facts) -> Iterator[Finding]:
    """Left and right wheel of each axle: the one with more load, or more slip, must have more torque."""
    rig, load = facts.rig, facts.window.load
    for left, right in pairs(rig).T.tolist():
        names = rig.wheels[left], rig.wheels[right]
        torque, more, slip = (of[:, left] - of[:, right] for of in (facts.thrust, load, facts.slip))
        rows = settled(np.stack([torque, more, slip, np.ones(len(slip))], axis=1), facts.bins(0.5), facts.bins(20.0))
        carried = median(load[:, [left, right]].sum(axis=1))
        if rows is None or not {f"load.{name}" for name in names} <= facts.mapped:
            continue  # without loads what shakes is in torques and slips alone
        if rows[:, 0].std() < LIMITS.excited * carried:
            continue  # motors that are given the same torque
        factors, sd = regression(rows[:, 0], rows[:, 1:])
        of_load, of_slip = (factors < -LIMITS.side_sd * sd)[:2]
        what = "torques" if of_load and of_slip else "loads" if of_load else "speeds"
        which = "load and slip" if of_load and of_slip else "load" if of_load else "slip"
        if of_load or of_slip:
            text = f"the {what} of {names[0]} and {names[1]} are swapped: the wheel with more {which} has less torque"
            yield fault(text, *(f"{q}.{w}" for q in ("load", "speed", "torque") for w in names))


def _wheel_based(facts: Facts) -> Iterator[Finding]:
    """A ground speed against which an axle does not slip while its thrust changes.

    Of each axle whose own torque is measured; where there is none, of all driven wheels.  Means of a second hold no
    slip that only a late speed makes.
    """
    second, rig = facts.bins(1.0), facts.rig
    driven = [w for w in facts.config.wheel if w.driven and w.name in rig.wheels]
    axles = {
        axle: wheels
        for axle, wheels in grouped(driven, lambda w: str(w.axle)).items()
        if f"torque.{axle}" in facts.mapped or {f"torque.{w.name}" for w in wheels} <= facts.mapped
    }
    for axle, wheels in (axles or {"driven": driven}).items() if driven else ():
        own = [rig.wheels.index(w.name) for w in wheels]
        carried = median(facts.window.load[:, own].sum(axis=1))
        rows = np.stack([facts.slip[:, own].mean(axis=1), facts.thrust[:, own].sum(axis=1) / carried], axis=1)
        means = settled(rows, second, facts.bins(2.0 * LIMITS.least_seconds))
        if means is None:
            continue
        slip, thrust = (means - means.mean(axis=0)).T
        (per_thrust,), (sd,) = regression(slip, thrust[:, None])
        if thrust.std() > LIMITS.excited and per_thrust + LIMITS.side_sd * sd < CONSISTENCY.slip_per_traction:
            moves = f"hardly any slip comes with their thrust, which moves by {thrust.std() * carried / 1e3:.1f} kN"
            why = "is it computed from wheels or motor? map a radar's or a receiver's speed"
            yield fault(f"signals.ground_speed: goes with the {axle} wheels: {moves}: {why}", "ground_speed")
            return


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
    for of, on, power in ((0, (1, 2), 1.0), (1, (0, 2), -1.0)):
        factors, sds = regression(rows[:, of], rows[:, on])
        if factors[0] - LIMITS.side_sd * sds[0] > LIMITS.scale[1]:
            size = f"{factors[0] ** power:.2g} times as much as the ground speed asks"
            yield fault(f"signals.acceleration: changes {size}: its unit or scale?", "acceleration")
            return
    felt = _slope_felt(rows)
    if "pitch" not in facts.mapped or felt is None:
        return
    (share, margin), is_force = felt, facts.rig.specific_force
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
        if (rows := _felt(facts)) is not None and _slope_felt(rows):
            return  # the accelerometer says it
        kind = " and the kind of signals.acceleration" if "acceleration" in facts.mapped else ""
        what = f"the sign and scale of signals.pitch{kind}"
        raise UndecidableError(f"the slope hardly changes: {what} cannot be decided: drive up and down a slope")
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
        raise UndecidableError("the log does not separate left and right wheels: map signals.yaw_rate and drive curves")
    if not np.isfinite(window.yaw_rate).any() or not pairs(rig).size:
        return
    left, right = (rig.radius * window.speed).T[pairs(rig)]
    sides = np.sign(right - left).T
    turns = (np.abs(window.yaw_rate) > 0.1) & (np.abs(sides.sum(axis=1)) == sides.shape[1])
    if turns.sum() < facts.bins(2.0):
        raise UndecidableError("no turns: the sign of the yaw rate, and which wheels are left, cannot be decided")
    if median((sides[:, 0] * np.sign(window.yaw_rate))[turns]) < 0.0:
        why = "left and right wheels swapped (the left wheel of an axle comes first)?"
        text = f"to the left while the left wheels go faster: its sign (positive to the left), or {why}"
        yield fault(f"signals.yaw_rate: {text}", "yaw_rate")


def _radius_open(facts: Facts) -> Iterator[Finding]:
    """Radii where the wheels roll without thrust; else what their errors are worth."""
    chassis = facts.rig.chassis
    if chassis is None:
        return
    forces = facts.thrust.sum(axis=1), pull_given(facts.window, chassis)
    idle = np.max(np.abs(forces), axis=0) < LIMITS.rolling * chassis.mass * GRAVITY
    if idle.sum() > facts.bins(LIMITS.least_seconds):
        for i, wheel in enumerate(facts.rig.wheels):
            if abs(slip := median(facts.slip[idle, i])) > LIMITS.idle_slip:
                yield Finding(f"wheel.{wheel}: slips by {slip:.2f} where nothing is pulled: its radius?", False)
        return
    free = [w.name for w in facts.config.wheel if not w.driven and w.name in facts.rig.wheels]
    usual = {wheel: median(facts.slip[:, facts.rig.wheels.index(wheel)]) for wheel in free}
    rims = ", ".join(f"{wheel} {1.0 / (1.0 - own):.3f}" for wheel, own in usual.items())
    over = f" (rim over ground speed of free wheels: {rims})" if rims else ""
    what = f"radius and slip are not separable, 5 % of radius is 0.05 of slip{over}"
    raise UndecidableError(f"{what}: roll a minute without draft on firm ground")


CHECKS = (
    _weight, _one_axle, _directions, _gears, _free_wheels, _slips, _balance, _levels, _transfer, _sides,
    _wheel_based, _accelerometer, _slope, _yaw, _radius_open,
)  # fmt: skip
"""Each with the channels that no check before it has named."""
