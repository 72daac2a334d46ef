"""Check of a configuration against a recording: loads, gears, wheel speeds, forces.

    weight      sum of the wheel loads = m g cos(pitch), and its share on each axle by moments
    gear        motor speed = gear ratio * wheel speed
    slip        1 - v / (r omega), within the range of driven wheels
    transfer    changes of the front axle's load less the rear's = twice those by moments of draft, slope and inertia
    balance     changes of sum(torque / r) = 0.7 to 1.0 * changes of draft, and of slope + inertia
    sides       left less right: torque = a * load + b * slip + constant, with a > 0 and b > 0

A wrong sign of a or b shows that loads, speeds or torques of left and right are swapped; all three swapped at once are
the mirrored vehicle.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator

import numpy as np

from soilbus.estimation.window import pairs, pull_given
from soilbus.sensors.consistency import change, median
from soilbus.sensors.facts import (
    LIMITS,
    Facts,
    Finding,
    UndecidableError,
    block_means,
    changes,
    regression,
    spread,
    steps,
)  # fmt: skip
from soilbus.terra.vehicle import GRAVITY, axle_loads


def _weight(facts: Facts) -> Iterator[Finding]:
    """Sum of the loads against the mass, and each axle's load against the geometry."""
    window, rig, chassis = facts.window, facts.rig, facts.rig.chassis
    if chassis is None:
        return
    if not any(name.startswith("load.") for name in facts.mapped):
        raise UndecidableError("no load is measured: vehicle.mass and cg_ahead_of_rear_axle cannot be compared")
    names = tuple(f"load.{w}" for w in rig.wheels)
    pitch = np.where(np.isfinite(window.pitch), window.pitch, 0.0)
    measured = median(window.load.sum(axis=1) / np.cos(pitch))
    if not math.isfinite(measured):
        raise UndecidableError("not every wheel load is known: the loads cannot be compared with the mass")
    weight = chassis.mass * GRAVITY
    off = measured / weight - 1.0
    if abs(off) > LIMITS.weight / 2.0:
        yield Finding(
            f"the wheel loads sum to {measured / 1e3:.1f} kN, the weight of {measured / GRAVITY:.0f} kg, but"
            f" vehicle.mass = {chassis.mass:g} kg: "
            + (
                _known_factor(measured / weight, 0.04)
                or "which of them is wrong? (ballast, unit or scale of the loads)"
            ),
            abs(off) > LIMITS.weight,
            names if abs(off) > LIMITS.weight else (),
        )
        return
    if set(rig.front.tolist()) != {True, False}:
        return
    draft, acceleration = (np.where(np.isfinite(a), a, 0.0) for a in (window.draft, window.acceleration))
    due = [median(np.broadcast_to(a, window.t.shape)) for a in axle_loads(chassis, draft, pitch, acceleration)]
    has = [median(window.load @ ahead) for ahead in (rig.ahead, 1.0 - rig.ahead)]
    weighed = [axle for axle in ("front", "rear") if f"load.{axle}" in facts.mapped]
    if len(weighed) == 1 and not facts.mapped & {*names}:
        side = ("front", "rear").index(weighed[0])
        ratio = has[side] / due[side]
        if _log_off(ratio) > 1.0 and (why := _known_factor(ratio, LIMITS.axle)):  # a unit, not a measure
            yield Finding(
                f"axle.{weighed[0]}.load: {has[side] / 1e3:.1f} kN, where mass, centre of gravity and draft give"
                f" {due[side] / 1e3:.1f} kN: {why}",
                True,
                names,
            )
            return
    if max(has) > (1.0 + LIMITS.weight) * weight:
        axle = "front" if has[0] > has[1] else "rear"
        yield Finding(
            f"the {axle} axle alone carries {max(has) / 1e3:.1f} kN, more than the weight of vehicle.mass ="
            f" {chassis.mass:g} kg: mass, or unit or scale of the load?",
            True,
            names,
        )
        return
    if abs(has[0] - due[0]) > LIMITS.axle * weight:
        swapped = abs(has[0] - due[1]) < LIMITS.axle * weight
        yield Finding(
            f"the front wheels carry {has[0] / 1e3:.1f} kN and the rear wheels {has[1] / 1e3:.1f} kN, where mass,"
            f" centre of gravity and draft give {due[0] / 1e3:.1f} and {due[1] / 1e3:.1f} kN: "
            + ("axles between them count on both by their place; " if len(rig.axles) > 2 else "")
            + (
                "are the loads of front and rear wheels swapped?"
                if swapped
                else "cg_ahead_of_rear_axle, loads of swapped wheels, or a draft of the wrong sign or size?"
            ),
            swapped,
            names if swapped else (),
        )


def _transfer(facts: Facts) -> Iterator[Finding]:
    """Changes of each axle's load against those that draft, slope and inertia bring to it."""
    window, rig, chassis = facts.window, facts.rig, facts.rig.chassis
    cells = [f"load.{wheel}" for wheel in rig.wheels]
    if chassis is None or set(rig.front.tolist()) != {True, False} or not set(cells) <= facts.mapped:
        return
    known = (np.where(np.isfinite(a), a, 0.0) for a in (window.pitch, window.acceleration))
    front = np.broadcast_to(axle_loads(chassis, window.draft, *known)[0], window.t.shape)
    more = window.load @ (2.0 * rig.ahead - 1.0)
    rows = changes(facts, more, 2.0 * np.where(facts.straight, front, np.nan))
    if rows is None:
        return
    y, x = rows.T
    lever = max(chassis.hitch_height, chassis.cg_height) / chassis.wheelbase
    if x.std() < LIMITS.excited * chassis.mass * GRAVITY * lever:
        return
    (share,), (sd,) = regression(y, x[:, None])
    if share < LIMITS.transfer - LIMITS.side_sd * sd:
        yield Finding(
            f"load moves between front and rear wheels {share:.2f} times as much as draft, slope and inertia move it:"
            " are loads of front and rear wheels swapped, or is hitch_height or cg_height wrong?",
            True,
            tuple(cells),
        )


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
"""Likely mistakes by the multiple of what loads should be."""


def _known_factor(ratio: float, within: float) -> str:
    """The likely mistake if loads are this multiple of what they should be, to a share of it; "" if there is none."""
    nearest = min(FACTORS, key=lambda factor: _log_off(ratio / factor))
    return FACTORS[nearest] if _log_off(ratio / nearest) < within else ""


def _directions(facts: Facts) -> Iterator[Finding]:
    """Wheels that turn or drive in the opposite direction to most."""
    rig, raw = facts.rig, facts.raw
    moving = facts.straight
    with np.errstate(invalid="ignore"):
        turns = [median(np.sign(raw.speed[moving, i])) for i in range(len(rig.wheels))]
    forward_sign = np.sign(np.nansum(turns))
    for wheel, turn in zip(rig.wheels, turns, strict=True):
        if turn * forward_sign < 0.0:
            text = f"wheel.{wheel}.speed: turns backward while most wheels turn forward: sign = -1?"
            yield Finding(text, True, (f"speed.{wheel}", f"torque.{wheel}"))
    thrust = [median(facts.thrust[:, i]) for i in range(len(rig.wheels))]
    share = np.array(thrust) / max(np.nanmax(np.abs(thrust), initial=0.0), 1.0)
    drives = np.nansum(np.sign(share) * (np.abs(share) > 0.2))
    braking = [wheel for wheel, part in zip(rig.wheels, share.tolist(), strict=True) if part < -0.2]
    of_axles = {a.name: [w.name for w in facts.config.wheel if w.axle == a.name] for a in facts.config.axle if a.torque}
    for axle, wheels in of_axles.items():
        if wheels and set(wheels) <= set(braking) and drives >= 0.0:
            braking = [wheel for wheel in braking if wheel not in wheels]
            text = f"axle.{axle}.torque: brakes while the other axle drives: sign = -1?"
            yield Finding(text, True, (f"torque.{axle}", *(f"torque.{wheel}" for wheel in wheels)))
    for wheel in braking if drives > 0.0 else ():
        yield Finding(f"wheel.{wheel}.torque: brakes while most wheels drive: sign = -1?", True, (f"torque.{wheel}",))
    ground = median(np.sign(raw.ground_speed[moving]))
    if ground < 0.0 and forward_sign > 0.0:
        text = "signals.ground_speed: backward while the wheels turn forward: sign = -1?"
        yield Finding(text, True, ("ground_speed",))


def _gears(facts: Facts) -> Iterator[Finding]:
    """Motor speeds against wheel speeds; an unmapped motor speed may also be the wheel's own."""
    for i, wheel in enumerate(facts.rig.wheels):
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = median(np.abs(facts.motor[:, i] / facts.raw.speed[:, i])[facts.straight])
        own = next(w for w in facts.config.wheel if w.name == wheel)
        if not math.isfinite(ratio) or _log_off(ratio) < LIMITS.gear or own.motor_speed is None:
            continue
        if f"motor_speed.{wheel}" not in facts.mapped and abs(own.gear_ratio * ratio - 1.0) < LIMITS.gear:
            continue
        yield Finding(
            f"wheel.{wheel}.gear_ratio = {own.gear_ratio:g}, but {own.motor_speed.signal} turns"
            f" {own.gear_ratio * ratio:.4g} times as fast as the wheel: {_why_gear(facts, [wheel])}",
            True,
            (f"torque.{wheel}", f"motor_speed.{wheel}"),
        )


def _why_gear(facts: Facts, wheels: Iterable[str]) -> str:
    radius = " radius (the wheels' speeds are in m/s)," if facts.by_radius & set(wheels) else ""
    return f"gear ratio,{radius} or unit or byte order of one of the speeds?"


def _axle_gears(facts: Facts) -> Iterator[Finding]:
    """The speed of an axle's motor against the mean of its wheels, which any differential keeps."""
    for axle in facts.config.axle:
        names = [w.name for w in facts.config.wheel if w.axle == axle.name and w.speed is not None]
        own = [facts.rig.wheels.index(name) for name in names if name in facts.rig.wheels]
        if axle.name not in facts.shaft or axle.motor_speed is None or len(own) != 2:
            continue
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = median((facts.shaft[axle.name] / facts.raw.speed[:, own].mean(axis=1))[facts.straight])
        channels = (f"torque.{axle.name}", f"speed.{axle.name}")
        if ratio < 0.0:
            text = f"axle.{axle.name}.motor_speed: turns backward while its wheels turn forward: sign = -1?"
            yield Finding(text, True, channels)
        elif math.isfinite(ratio) and _log_off(ratio) > LIMITS.gear:
            yield Finding(
                f"axle.{axle.name}.gear_ratio = {axle.gear_ratio:g}, but {axle.motor_speed.signal} turns"
                f" {axle.gear_ratio * ratio:.4g} times as fast as the mean of its wheels: {_why_gear(facts, names)}",
                True,
                channels,
            )


def _locked(facts: Facts) -> Iterator[Finding]:
    """Speeds left and right behind a locked differential."""
    for axle in facts.config.axle:
        own = [w for w in facts.config.wheel if w.axle == axle.name and w.driven and w.speed is not None]
        if axle.differential != "locked" or len(own) != 2:
            continue
        one, other = (facts.raw.speed[:, facts.rig.wheels.index(w.name)] for w in own)
        with np.errstate(invalid="ignore", divide="ignore"):
            apart = median(np.abs(one / other - 1.0)[facts.straight])
        if apart > LIMITS.locked:
            yield Finding(
                f'axle.{axle.name}.differential = "locked", but the speeds of {own[0].name} and {own[1].name} differ by'
                f' {apart:.1%} straight on: "open" or "limited"?',
                True,
                tuple(f"speed.{w.name}" for w in own),
            )


def _free_wheels(facts: Facts) -> Iterator[Finding]:
    """Rims of wheels that roll freely against the ground: they may skid, and never drive."""
    free = {w.name for w in facts.config.wheel if not w.driven}
    for i, wheel in enumerate(facts.rig.wheels):
        slip = median(facts.slip[:, i])
        if wheel in free and not -LIMITS.free <= slip <= LIMITS.idle_slip and np.isfinite(slip):
            yield Finding(
                f"wheel.{wheel}: rolls freely, but its rim goes {1.0 / (1.0 - slip):.2f} times as fast as the ground:"
                " radius, or unit of its speed or of the ground speed?",
                abs(slip) > LIMITS.free,
                (f"speed.{wheel}",) if abs(slip) > LIMITS.free else (),
            )


def _slips(facts: Facts) -> Iterator[Finding]:
    """Rim speeds against the ground speed and against each other."""
    slip, rig = facts.slip, facts.rig
    drives = np.where(facts.thrust > 0.0, slip, np.nan)
    usual = np.array([median(drives[:, i]) for i in range(len(rig.wheels))])
    if not np.isfinite(usual).any():
        raise UndecidableError("no slip is known: wheel and ground speeds cannot be compared")
    least = float(np.nanquantile(slip, 0.05)) if np.isfinite(slip).any() else math.nan
    middle = float(np.nanmedian(usual))
    at_shaft = any(w.speed is not None and w.speed.at == "shaft" for w in facts.config.wheel)
    at_shaft = at_shaft or any(a.motor_speed is not None for a in facts.config.axle)
    gear = "gear ratio, " if at_shaft else ""
    if middle < LIMITS.pushed or least > LIMITS.never_less:
        seems = middle if middle < LIMITS.pushed else least
        factor = 1.0 / (1.0 - seems)
        text = (
            f"the wheels seem to slip by {middle:.2f}, never by less than {least:.2f}"
            if least > LIMITS.never_less
            else f"driving wheels seem to slip by {middle:.2f}"
        )
        yield Finding(
            f"{text}: their rims go {factor:.2f} times as fast as the ground: {_why_fast(factor)}"
            f"{gear}radius, or unit, sign or byte order of ground and wheel speeds?",
            True,
            ("ground_speed", *(f"speed.{w}" for w in rig.wheels)),
        )
        return
    apart = {wheel: own - middle for wheel, own in zip(rig.wheels, usual.tolist(), strict=True)}
    apart = {wheel: by for wheel, by in apart.items() if abs(by) > LIMITS.wheel_apart}
    if 2 * len(apart) > np.isfinite(usual).sum():  # there are no most wheels
        more, less = ([w for w, by in apart.items() if (by > 0.0) is is_more] for is_more in (True, False))
        slips = [f"{' and '.join(w)} by {middle + np.mean([apart[i] for i in w]):.2f}" for w in (more, less) if w]
        text = (
            f"wheels seem to slip unlike: {', '.join(slips)}: radius, {gear}speed signal or its unit of some of them?"
        )
        yield Finding(text, True, tuple(f"speed.{w}" for w in rig.wheels))
        return
    for wheel, own in zip(rig.wheels, usual.tolist(), strict=True):
        if wheel in apart:
            yield Finding(
                f"wheel.{wheel}: seems to slip by {own:.2f}, most wheels by {middle:.2f}: its radius,"
                f" {gear}speed signal or its unit?",
                True,
                (f"speed.{wheel}",),
            )


def _why_fast(factor: float) -> str:
    """The likely mistake if rims are this many times as fast as the ground (slip of up to 0.4 included)."""
    for known, why in (
        (30.0 / math.pi, "are the wheel speeds in rpm where the DBC says rad/s, "),
        (3.6, "is the ground speed in m/s where the DBC says km/h, "),
        (2.0, "a diameter in the place of a radius, "),
        (1.0 / 3.6, "is the ground speed in km/h where the DBC says m/s, "),
        (math.pi / 30.0, "are the wheel speeds in rad/s where the DBC says rpm, "),
    ):
        if 0.95 < factor / known < 1.7:
            return why
    return ""


def _balance(facts: Facts) -> Iterator[Finding]:
    """Changes of the wheels' thrust against changes of draft and of slope and inertia."""
    window, rig, chassis = facts.window, facts.rig, facts.rig.chassis
    if chassis is None:
        return
    weight, torques = chassis.mass * GRAVITY, tuple(f"torque.{w}" for w in rig.wheels)
    thrust = facts.thrust.sum(axis=1)
    if median(thrust) < -0.02 * weight:
        yield Finding(
            f"the wheels brake with {-median(thrust) / 1e3:.1f} kN all along while the vehicle drives on: sign of the"
            " torques, or of the wheel speeds (sign = -1)?",
            True,
            torques,
        )
        return
    if median(thrust) > LIMITS.most_thrust * weight:
        yield Finding(
            f"the wheels thrust with {median(thrust) / 1e3:.3g} kN, more than soil can hold under"
            f" {weight / 1e3:.3g} kN: gear_ratio too large, torques measured at the other side of the gear"
            " (`at`), or their unit or byte order?",
            True,
            torques,
        )
        return
    inertia = pull_given(window, chassis) - window.draft
    least = LIMITS.least_seconds / facts.config.estimator.bin
    rows = changes(facts, thrust, window.draft, inertia, least=least)
    if rows is None:
        raise UndecidableError(
            "torques and draft are not known together: their signs and the gear ratio cannot be compared"
        )
    given, *asked = rows.T
    (of_draft, of_inertia), (draft_sd, inertia_sd) = regression(given, np.stack(asked, axis=1))
    swings = of_draft - LIMITS.side_sd * draft_sd > LIMITS.scale[1] and given.std() > LIMITS.excited * weight
    if asked[0].std() < LIMITS.excited * weight and not swings:
        raise UndecidableError(
            "the draft hardly changes: the signs of draft and torque and the gear ratio cannot be decided"
        )
    if of_draft < -LIMITS.side_sd * draft_sd:
        yield Finding(
            "signals.draft: falls whenever the wheels thrust more: sign of the draft (positive holds the vehicle back;"
            " sign = -1)?",
            True,
            ("draft",),
        )
        return
    if of_draft > LIMITS.scale[1] or of_draft + LIMITS.side_sd * draft_sd < LIMITS.scale[0]:
        of_torque = of_inertia > 2.0 * LIMITS.side_sd * inertia_sd and 0.7 < of_draft / of_inertia < 1.4
        size = "large" if of_draft > 1.0 else "small"
        in_kgf = "kgf or daN where the DBC says N, " if 6.5 < of_draft < 11.0 else ""
        why = (
            f"gear_ratio too {size}, torques measured at the other side of the gear (`at`), or their unit?"
            if of_torque
            else f"unit or scale of the draft, {in_kgf}or gear_ratio too {size} (or torques at the other side of the"
            " gear)?"
        )
        yield Finding(
            f"the wheels' thrust changes {of_draft:.2f} times as much as the draft does: {why}",
            True,
            (*torques, "draft"),
        )
        return
    if of_inertia < -LIMITS.side_sd * inertia_sd:
        lag, _ = steps(facts)
        slope = spread(change(window.pitch, lag)) * GRAVITY
        name = "pitch" if slope > spread(change(window.acceleration, lag)) else "acceleration"
        positive = "nose up" if name == "pitch" else "where the vehicle speeds up"
        yield Finding(
            f"signals.{name}: asks for less thrust whenever the wheels give more: its sign (positive {positive};"
            " sign = -1)?",
            True,
            (name,),
        )


def _levels(facts: Facts) -> Iterator[Finding]:
    """Mean thrust against mean pull: the thrust must exceed the pull by the rolling resistance."""
    window, rig, chassis = facts.window, facts.rig, facts.rig.chassis
    if chassis is None:
        return
    weight = chassis.mass * GRAVITY
    thrust = median(facts.thrust.sum(axis=1))
    known = facts.straight & np.isfinite(window.pitch)
    asked = median(pull_given(window, chassis)[known])
    if asked > LIMITS.pull * weight and thrust < LIMITS.less_thrust * asked:
        yield Finding(
            f"the wheels thrust with {thrust / 1e3:.2f} kN, but draft, slope and inertia alone ask for"
            f" {asked / 1e3:.2f} kN: gear_ratio too small, torques measured at the other side of the gear (`at`), or"
            " unit of torque or draft?",
            True,
            (*(f"torque.{w}" for w in rig.wheels), "draft"),
        )


def _sides(facts: Facts) -> Iterator[Finding]:
    """Left and right wheel of each axle: the one with more load, or more slip, must have more torque."""
    rig, thrust, slip = facts.rig, facts.thrust, facts.slip
    rolls = abs(median(thrust.sum(axis=1))) < LIMITS.rolling * median(
        facts.window.load.sum(axis=1)
    )  # torques are noise
    for left, right in pairs(rig).T.tolist():
        names = rig.wheels[left], rig.wheels[right]
        y = thrust[:, left] - thrust[:, right]
        load = facts.window.load[:, left] - facts.window.load[:, right]
        x = np.stack([load, slip[:, left] - slip[:, right]], axis=1)
        known = np.isfinite(y) & np.isfinite(x).all(axis=1)
        per_block = max(round(0.5 / facts.config.estimator.bin), 1)
        if known.sum() < 40 * per_block:
            continue
        y, x = block_means(y[known][:, None], per_block)[:, 0], block_means(x[known], per_block)
        factors, sd = regression(y, np.column_stack([x, np.ones(len(x))]))
        mean = median(np.abs(thrust[:, [left, right]]).mean(axis=1))
        has_loads = {f"load.{name}" for name in names} <= facts.mapped  # else what shakes is in torques and slips alone
        of_load, of_slip = (factors < -LIMITS.side_sd * sd)[:2] & (has_loads and y.std() > LIMITS.side_torque * mean)
        swapped = f"{names[0]} and {names[1]} are swapped: the wheel with more"
        wheels = tuple(f"{q}.{w}" for q in ("load", "speed", "torque") for w in names)
        if of_load and of_slip:
            yield Finding(f"the torques of {swapped} load and slip has less torque", True, wheels)
        elif of_load:
            yield Finding(f"the loads of {swapped} load has less torque", True, wheels)
        elif of_slip:
            yield Finding(f"the speeds of {swapped} slip has less torque", True, wheels)
        if abs(factors[2]) > LIMITS.side_offset * mean and not rolls:
            yield Finding(
                f"the torques of {names[0]} and {names[1]} differ by {abs(factors[2]) / mean:.0%} of their mean all"
                " along: gear ratio, sign or scale of one of them?",
                False,
            )


VEHICLE_CHECKS = (
    _weight, _directions, _gears, _axle_gears, _locked, _free_wheels, _slips, _balance, _levels, _transfer, _sides,
)  # fmt: skip
"""Each with the channels that no check before it has named."""
