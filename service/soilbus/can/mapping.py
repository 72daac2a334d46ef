"""Configuration and DBC -> channels: which signal carries which quantity, in SI, within what limits."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from typing import NamedTuple

from cantools.database.can import Database, Message, Signal

from soilbus.can.channels import WHOLE, Channel
from soilbus.can.decode import check_decodable, code_limits
from soilbus.can.units import SI, STANDARD_GRAVITY, unit_of
from soilbus.can.validity import meaning, vouching_codes
from soilbus.config.model import Axle, Config, ConfigError, Wheel
from soilbus.config.model import Signal as Mapped
from soilbus.grouping import grouped
from soilbus.words import did_you_mean

WHEEL_ROLES = ("torque", "speed", "load", "sinkage", "torque_limit", "motor_speed")
AXLE_ROLES = {"torque": "torque", "torque_limit": "torque_limit", "motor_speed": "speed", "load": "load"}
"""Roles of an axle, and the quantity of the channel: its motor's speed stands for that of its wheels."""
SHARED_ROLES = ("torque", "speed", "load")
"""Roles of which one signal may be mapped for several wheels: it is one measurement, with one noise."""
POSITION_ROLES = ("latitude", "longitude")
LOCK = "differential_lock"
OF_MOTION = ("ground_speed", "draft", "pitch", "acceleration", "yaw_rate", "roll", "steering_angle")
VEHICLE_ROLES = (*OF_MOTION, *POSITION_ROLES)
OPTIONAL_ROLES = ("yaw_rate", "roll", "steering_angle", LOCK, *POSITION_ROLES)  # a window is as good without

MAX_SPEED = 25.0  # m/s, faster than any field tractor
LEAST_GAP, GAP_CYCLES = 2.0, 1.5  # seconds, and cycles of what is sent seldom, after which a position is stale
_HEAVY = 5.0e4  # kg, stands for the mass when there is no [vehicle]

DIMENSIONS: Mapping[str, tuple[str, ...]] = {
    "torque": ("torque",), "torque_limit": ("torque",), "motor_speed": ("rotation",), "speed": ("rotation", "speed"),
    "load": ("force", "mass"), "sinkage": ("length",), "ground_speed": ("speed",), "draft": ("force",),
    "pitch": ("angle",), "acceleration": ("acceleration",), "yaw_rate": ("rotation",), "roll": ("angle",),
    "steering_angle": ("angle",), LOCK: ("",), "latitude": ("angle",), "longitude": ("angle",),
}  # fmt: skip
"""Dimensions that the unit of a role's signal may have, that of its values in SI first."""
_SHAFT_BY_DEFAULT = frozenset({"torque", "torque_limit", "motor_speed"})


class _Number(NamedTuple):
    """What a number of the mapping makes of a signal in a unit that is not one of the role."""

    what: str
    units: Mapping[str, float]
    dimension: str
    unit: str


_PRESSURES = {"Pa": 1.0, "hPa": 1e2, "mbar": 1e2, "kPa": 1e3, "bar": 1e5, "MPa": 1e6, "psi": 6894.757}
_NUMBERS: Mapping[str, _Number] = {
    "torque_constant": _Number("current", {"": 1.0, "A": 1.0, "mA": 1e-3, "kA": 1e3}, "torque", "N m/A"),
    "reference_torque": _Number("percentage", {"%": 0.01}, "torque", "N m"),
    "effective_area": _Number("pressure", {"": 1.0, **_PRESSURES}, "force", "m^2"),
}
"""By key of the mapping."""


class _Fault(Exception):
    """One line on why one role cannot be mapped."""


class _Role(NamedTuple):
    quantity: str
    part: Wheel | Axle | None
    mapped: Mapped
    where: str  # the key in the configuration file


def channels_of(config: Config, database: Database) -> list[Channel]:
    """Return one channel for each role that the configuration maps, wheels first.

    Raises ConfigError with a line for each fault: a signal that is not in the DBC, cannot be decoded, has a unit of
    another dimension than the role or is mapped twice; a validity signal that cannot work.  Several wheels may have one
    limit or one measurement.
    """
    channels, faults, twice = [], [], []
    first: dict[str, _Role] = {}
    for role in _roles(config):
        known = first.setdefault(role.mapped.signal, role)
        is_same = known is not role and known.quantity == role.quantity
        if is_same and role.quantity in SHARED_ROLES and isinstance(role.part, Wheel):
            continue  # the channel of another wheel, too, which came first
        if known is not role and not (is_same and role.quantity == "torque_limit"):
            twice.append(f"{role.where}: {role.mapped.signal} is already mapped to {known.where}")
        try:
            channels.append(_channel(config, database, role))
        except _Fault as fault:
            faults.append(f"{role.where}: {fault}")
    faults += twice
    messages = [database.get_message_by_name(name) for name in dict.fromkeys(c.message for c in channels)]
    for (number, _), (first_one, *others) in grouped(messages, lambda m: (m.frame_id, m.is_extended_frame)).items():
        same = f"have the same identifier {number:#x}"
        faults += [f"messages {first_one.name} and {other.name} {same}" for other in others]
    if faults:
        raise ConfigError(faults)
    return channels


def si_unit(channel: Channel) -> str:
    """Return the SI unit of a channel's values; "" of a code."""
    return SI.get(DIMENSIONS[channel.quantity][0], "")


def without_unit(channels: Iterable[Channel], database: Database) -> list[Channel]:
    """Return the channels whose signal has no unit, so that SI was assumed."""
    return [c for c in channels if c.quantity != LOCK and _unit_said(found_signal(database, c.path)[1]) == ""]


def _unit_said(signal: Signal) -> str | None:
    """The dimension of a signal's unit, "" without a unit; None for a unit that is none of ours, such as ampere."""
    try:
        unit = unit_of(signal.unit)
    except ValueError:
        return None
    return unit.dimension if unit is not None else ""


def _roles(config: Config) -> Iterator[_Role]:
    for wheel in config.wheel:
        for quantity in WHEEL_ROLES:
            if (mapped := getattr(wheel, quantity)) is not None:
                yield _Role(quantity, wheel, mapped, f"{wheel.section}.{wheel.name}.{quantity}")
    for axle in config.axle:
        for role, quantity in AXLE_ROLES.items():
            if (mapped := getattr(axle, role)) is not None:
                yield _Role(quantity, axle, mapped, f"axle.{axle.name}.{role}")
    for quantity in VEHICLE_ROLES:
        if (mapped := getattr(config.signals, quantity)) is not None and (quantity != "draft" or config.measures_draft):
            yield _Role(quantity, None, mapped, f"signals.{quantity}")
    if config.vehicle is not None and config.vehicle.differential_lock is not None:
        yield _Role(LOCK, None, config.vehicle.differential_lock, f"vehicle.{LOCK}")


def _channel(config: Config, database: Database, role: _Role) -> Channel:
    message, signal = found_signal(database, role.mapped.signal)
    if role.mapped.unit is not None and signal.name != WHOLE:
        raise _Fault(f"unit is for the columns of a table: {signal.name} has the unit that the DBC says")
    if role.mapped.valid is not None and signal.name == WHOLE:
        raise _Fault("valid is for messages; of a column leave those cells empty that do not count")
    factor, offset = _factor(role, signal), STANDARD_GRAVITY * role.mapped.unsprung_mass
    low, high = plausible(config, role.quantity, role.part)
    valid_signal, valid_values = _validity(message, role.mapped)
    timeout = role.mapped.timeout
    if timeout is None and role.quantity in POSITION_ROLES:
        timeout = max(LEAST_GAP, GAP_CYCLES * (message.cycle_time or 0) / 1e3)
    wheel = role.part.name if role.part else ""
    return Channel(
        role.quantity, wheel, message.name, signal.name, factor, offset, low, high, valid_signal, valid_values,
        timeout, role.mapped.delay, role.where,
    )  # fmt: skip


def found_signal(database: Database, path: str) -> tuple[Message, Signal]:
    """Return the message and signal of a "Message.Signal", or of a column by its name."""
    messages = {m.name: m for m in database.messages}
    if path in messages and messages[path].signals[0].name == WHOLE:
        return messages[path], messages[path].signals[0]
    message_name, _, signal_name = path.partition(".")
    message = messages.get(message_name)
    if message is None:
        raise _Fault(f"no message {message_name} in the DBC{did_you_mean(message_name, messages)}")
    return message, _find_signal(message, signal_name)


def _find_signal(message: Message, name: str) -> Signal:
    try:
        return check_decodable(message, name)
    except KeyError:
        meant = did_you_mean(name, (s.name for s in message.signals))
        raise _Fault(f"no signal {name} in message {message.name}{meant}") from None
    except ValueError as error:
        raise _Fault(str(error)) from None


def _validity(message: Message, mapped: Mapped) -> tuple[str | None, tuple[int, ...]]:
    """Name of the signal that vouches for the mapped one, and its codes that do."""
    if mapped.valid is None:
        return None, ()
    before, dot, name = mapped.valid.rpartition(".")
    if dot and before != message.name:
        raise _Fault(f"valid = {mapped.valid} is not in message {message.name}, where it must be")
    signal = _find_signal(message, name)
    if signal.conversion.is_float:
        raise _Fault(f"valid = {mapped.valid} is a float; it must be a code")
    codes = mapped.valid_values if mapped.valid_values is not None else list(vouching_codes(signal)) or [1]
    low, high = code_limits(signal)
    if not any(low <= code <= high for code in codes):
        raise _Fault(f"valid_values {codes} never occur in {mapped.valid}, which has {low}..{high}")
    names = {code: str(name) for code, name in (signal.choices or {}).items()}
    if wrong := [f'{code} is "{names[code]}"' for code in codes if meaning(names.get(code, ""))]:
        asked = "give valid_values" if mapped.valid_values is None else "valid_values cannot hold it"
        raise _Fault(f"{mapped.valid}: {', '.join(wrong)} in the DBC's value table; {asked}")
    return name, tuple(codes)


def _factor(role: _Role, signal: Signal) -> float:
    """SI value of one unit of the DBC, on the wheel's side of the gear."""
    quantity, part, mapped, where = role
    if mapped.at is not None and quantity not in _SHAFT_BY_DEFAULT | {"speed"}:
        raise _Fault(f"at = {mapped.at} has no meaning for {quantity}")
    dimension, factor = _unit(quantity, signal, mapped)
    of_motor = quantity in _SHAFT_BY_DEFAULT or where.endswith("motor_speed")
    at_shaft = (mapped.at or ("shaft" if of_motor else "wheel")) == "shaft"
    if part is None:
        return mapped.sign * factor
    if dimension == "mass":
        factor *= STANDARD_GRAVITY
    elif dimension == "speed":
        if at_shaft or isinstance(part, Axle):
            turning = "shaft" if at_shaft else "motor"
            raise _Fault(f"{mapped.signal} is in {signal.unit}: a {turning} has no speed along the ground")
        factor /= part.radius
    elif at_shaft and dimension == "torque":
        factor *= part.gear_ratio
    elif at_shaft and dimension == "rotation":
        factor /= part.gear_ratio
    return mapped.sign * factor


def _unit(quantity: str, signal: Signal, mapped: Mapped) -> tuple[str, float]:
    """Dimension and factor to SI of a signal, which must suit the quantity; no unit means SI."""
    fitting, said = DIMENSIONS[quantity], (signal.unit or "").strip()
    name = signal.name or "the column"
    here = f"{name} is in {said or 'no unit'}"
    if fitting == ("",):
        if _unit_said(signal):
            raise _Fault(f"{here}; {quantity} is a state: 0, or 1 while locked")
        return "", 1.0
    for key, rule in _NUMBERS.items():
        number, is_meant = getattr(mapped, key), rule.dimension in fitting
        if number is not None and not is_meant:
            raise _Fault(f"{key} has no meaning for {quantity}")
        if number is not None and said not in rule.units:
            raise _Fault(f"{here}; with {key} it must be a {rule.what}")
        if number is not None:
            return rule.dimension, number * rule.units[said]
        if said and is_meant and said in rule.units:
            raise _Fault(f"{here}, a {rule.what}: give its {key} [{rule.unit}]")
    wanted = " or ".join(SI[dimension] for dimension in fitting)
    try:
        unit = unit_of(signal.unit)
    except ValueError as error:
        raise _Fault(f"{name}: {error} ({quantity} needs {wanted})") from None
    if unit is None and quantity in POSITION_ROLES:
        raise _Fault(f"{name} has no unit: write deg or rad in the DBC")
    if unit is not None and unit.dimension not in fitting:
        article = "an" if unit.dimension[0] in "ai" else "a"
        raise _Fault(f"{here}, {article} {unit.dimension}; {quantity} needs {wanted}")
    return (fitting[0], 1.0) if unit is None else (unit.dimension, unit.factor)


def plausible(config: Config, quantity: str, part: Wheel | Axle | None) -> tuple[float, float]:
    """Return the least and greatest SI value that a working sensor of this vehicle can give."""
    weight = STANDARD_GRAVITY * (config.vehicle.mass if config.vehicle else _HEAVY)
    radius = 1.0
    if isinstance(part, Wheel):
        radius = part.radius
    elif part is not None:
        radii = [w.radius for w in config.wheel if part.name in ("both", w.axle)] or [radius]
        if part.name == "both":  # its shaft turns faster, with less torque
            ratios = [a.gear_ratio for a in config.axle if a.name != "both"] or [1.0]
            radii = [r / (max(ratios) if quantity == "speed" else min(ratios)) for r in radii]
        radius = min(radii) if quantity == "speed" else max(radii)
    if quantity == "load":
        return -0.02 * weight, 5.0 * weight  # a lifted wheel reads about zero
    if quantity == "sinkage":
        return -0.1 * radius, radius
    torque, speed = 2.0 * weight * radius, MAX_SPEED / radius
    of_wheel = {"torque": torque, "torque_limit": torque, "speed": speed, "motor_speed": speed, "draft": 2.0 * weight}
    greatest = of_wheel.get(quantity, _GREATEST.get(quantity, math.inf))
    return -greatest, greatest


_GREATEST = {
    "ground_speed": MAX_SPEED, "pitch": 1.0, "roll": 1.6, "steering_angle": 1.6, "acceleration": 20.0,
    "yaw_rate": 4.0,  # a skid-steered rover on the spot
    "latitude": math.pi / 2.0, "longitude": math.pi + 1e-9,  # 180 degrees, however it is rounded
}  # fmt: skip
