"""Configuration and DBC -> channels: which signal carries which quantity, in SI, within what limits."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import NamedTuple

from cantools.database.can import Database, Message, Signal

from soilbus.can.channels import Channel
from soilbus.can.dbc_files import checked_messages, load_databases
from soilbus.can.decode import check_decodable, code_limits
from soilbus.can.units import SI, STANDARD_GRAVITY, unit_of
from soilbus.config.model import Config, ConfigError, Wheel
from soilbus.config.model import Signal as Mapped
from soilbus.words import did_you_mean

WHEEL_ROLES = ("torque", "speed", "load", "sinkage", "torque_limit", "motor_speed")
POSITION_ROLES = ("latitude", "longitude")
VEHICLE_ROLES = ("ground_speed", "draft", "pitch", "acceleration", "yaw_rate", *POSITION_ROLES)
OPTIONAL_ROLES = ("yaw_rate", *POSITION_ROLES)
"""Without them a window is as good as before."""

MAX_SPEED = 25.0  # m/s, faster than any field tractor
LEAST_GAP, GAP_CYCLES = 2.0, 1.5
"""A position is stale after these seconds, or, where the DBC says that it is sent seldom, after these cycles."""
_HEAVY = 5.0e4  # kg, stands for the mass when there is no [vehicle]

_DIMENSIONS: dict[str, tuple[str, ...]] = {
    "torque": ("torque",),
    "torque_limit": ("torque",),
    "motor_speed": ("rotation",),
    "speed": ("rotation", "speed"),
    "load": ("force", "mass"),
    "sinkage": ("length",),
    "ground_speed": ("speed",),
    "draft": ("force",),
    "pitch": ("angle",),
    "acceleration": ("acceleration",),
    "yaw_rate": ("rotation",),
    "latitude": ("angle",),
    "longitude": ("angle",),
}
_SHAFT_BY_DEFAULT = frozenset({"torque", "torque_limit", "motor_speed"})
_HAS_SIDE = _SHAFT_BY_DEFAULT | {"speed"}


class _Fault(Exception):
    """One line on why one role cannot be mapped."""


class _Role(NamedTuple):
    quantity: str
    wheel: Wheel | None
    mapped: Mapped

    @property
    def where(self) -> str:
        """The key in the configuration file."""
        return f"wheel.{self.wheel.name}.{self.quantity}" if self.wheel else f"signals.{self.quantity}"


def channels_of(config: Config, database: Database) -> list[Channel]:
    """One channel for each role that the configuration maps, wheels first.

    Raises ConfigError with a line for each fault: a message or signal that the DBC does not
    have (the nearest name is suggested), a unit of another dimension than the role, a signal
    mapped twice, a signal that cannot be decoded, a validity signal that cannot work.
    """
    faults: list[str] = []
    channels: list[Channel] = []
    for role in _roles(config):
        try:
            channels.append(_channel(config, database, role))
        except _Fault as fault:
            faults.append(f"{role.where}: {fault}")
    faults += _mapped_twice(_roles(config))
    faults += _identifiers_shared(channels, database)
    if faults:
        raise ConfigError(faults)
    return channels


def without_unit(channels: Iterable[Channel], database: Database) -> list[Channel]:
    """Channels whose signal has no unit, so that SI was assumed."""
    return [c for c in channels if unit_of(_signal(c, database).unit) is None]


def _signal(channel: Channel, database: Database) -> Signal:
    return database.get_message_by_name(channel.message).get_signal_by_name(channel.signal)


def _roles(config: Config) -> Iterator[_Role]:
    for wheel in config.wheel:
        for quantity in WHEEL_ROLES:
            if (mapped := getattr(wheel, quantity)) is not None:
                yield _Role(quantity, wheel, mapped)
    for quantity in VEHICLE_ROLES:
        if (mapped := getattr(config.signals, quantity)) is not None:
            yield _Role(quantity, None, mapped)


def _channel(config: Config, database: Database, role: _Role) -> Channel:
    message, signal = _find(database, role.mapped.signal)
    low, high = plausible(config, role.quantity, role.wheel)
    valid_signal = _valid_signal(message, role.mapped)
    return Channel(
        quantity=role.quantity,
        wheel=role.wheel.name if role.wheel else "",
        message=message.name,
        signal=signal.name,
        factor=_factor(role, signal),
        offset=0.0,
        low=low,
        high=high,
        valid_signal=valid_signal,
        valid_values=tuple(role.mapped.valid_values) if valid_signal else (),
        timeout=role.mapped.timeout or _usual_timeout(role, message),
        delay=role.mapped.delay,
    )


def _usual_timeout(role: _Role, message: Message) -> float | None:
    """Age [s] from which a channel is stale if the configuration does not say; None: as any other."""
    if role.quantity not in POSITION_ROLES:
        return None
    return max(LEAST_GAP, GAP_CYCLES * (message.cycle_time or 0) / 1e3)


def _find(database: Database, path: str) -> tuple[Message, Signal]:
    message_name, _, signal_name = path.partition(".")
    messages = {m.name: m for m in database.messages}
    message = messages.get(message_name)
    if message is None:
        raise _Fault(f"no message {message_name} in the DBC{did_you_mean(message_name, messages)}")
    return message, _find_signal(message, signal_name)


def _find_signal(message: Message, name: str) -> Signal:
    try:
        return check_decodable(message, name)
    except KeyError:
        names = [s.name for s in message.signals]
        raise _Fault(f"no signal {name} in message {message.name}{did_you_mean(name, names)}") from None
    except ValueError as error:
        raise _Fault(str(error)) from None


def _valid_signal(message: Message, mapped: Mapped) -> str | None:
    """Name of the signal that vouches for the mapped one; a fault when it never could."""
    if mapped.valid is None:
        return None
    before, dot, name = mapped.valid.rpartition(".")
    if dot and before != message.name:
        raise _Fault(f"valid = {mapped.valid} is not in message {message.name}, where it must be")
    signal = _find_signal(message, name)
    if signal.conversion.is_float:
        raise _Fault(f"valid = {mapped.valid} is a float; it must be a code")
    low, high = code_limits(signal)
    if not any(low <= code <= high for code in mapped.valid_values):
        raise _Fault(f"valid_values {mapped.valid_values} never occur in {mapped.valid}, which has {low}..{high}")
    return name


def _factor(role: _Role, signal: Signal) -> float:
    """SI value of one unit of the DBC, on the wheel's side of the gear."""
    quantity, wheel, mapped = role
    if mapped.at is not None and quantity not in _HAS_SIDE:
        raise _Fault(f"at = {mapped.at} has no meaning for {quantity}")
    dimension, factor = _unit(quantity, signal)
    at_shaft = (mapped.at or ("shaft" if quantity in _SHAFT_BY_DEFAULT else "wheel")) == "shaft"
    if wheel is None:
        return mapped.sign * factor
    if dimension == "mass":
        factor *= STANDARD_GRAVITY
    elif dimension == "speed":
        if at_shaft:
            raise _Fault(f"{mapped.signal} is in {signal.unit}: a shaft has no speed along the ground")
        factor /= wheel.radius
    elif at_shaft and dimension == "torque":
        factor *= wheel.gear_ratio
    elif at_shaft and dimension == "rotation":
        factor /= wheel.gear_ratio
    return mapped.sign * factor


def _unit(quantity: str, signal: Signal) -> tuple[str, float]:
    """Dimension and factor to SI of a signal, which must suit the quantity; no unit means SI."""
    fitting = _DIMENSIONS[quantity]
    wanted = " or ".join(SI[dimension] for dimension in fitting)
    try:
        unit = unit_of(signal.unit)
    except ValueError as error:
        raise _Fault(f"{signal.name}: {error} ({quantity} needs {wanted})") from None
    if unit is None:
        if quantity in POSITION_ROLES:
            raise _Fault(f"{signal.name} has no unit: write deg or rad in the DBC")
        return fitting[0], 1.0
    if unit.dimension not in fitting:
        raise _Fault(f"{signal.name} is in {signal.unit}, a {unit.dimension}; {quantity} needs {wanted}")
    return unit.dimension, unit.factor


def plausible(config: Config, quantity: str, wheel: Wheel | None) -> tuple[float, float]:
    """Least and greatest SI value that a working sensor of this vehicle can give."""
    weight = STANDARD_GRAVITY * (config.vehicle.mass if config.vehicle else _HEAVY)
    radius = wheel.radius if wheel else 1.0
    match quantity:
        case "torque" | "torque_limit":
            return -2.0 * weight * radius, 2.0 * weight * radius
        case "speed" | "motor_speed":
            return -MAX_SPEED / radius, MAX_SPEED / radius
        case "load":
            return -0.02 * weight, 5.0 * weight  # a lifted wheel reads about zero
        case "sinkage":
            return -0.1 * radius, radius
        case "ground_speed":
            return -MAX_SPEED, MAX_SPEED
        case "draft":
            return -2.0 * weight, 2.0 * weight
        case "pitch":
            return -1.0, 1.0
        case "acceleration":
            return -20.0, 20.0
        case "yaw_rate":
            return -4.0, 4.0  # a skid-steered rover on the spot
        case "latitude":
            return -math.pi / 2.0, math.pi / 2.0
        case "longitude":
            return -math.pi - 1e-9, math.pi + 1e-9  # 180 degrees, however it is rounded
    return -math.inf, math.inf


def _mapped_twice(roles: Iterable[_Role]) -> list[str]:
    """A signal that feeds two roles would count one sensor twice.

    One torque limit may hold for several wheels: a limit is not a measurement.
    """
    first: dict[str, _Role] = {}
    faults: list[str] = []
    for role in roles:
        known = first.setdefault(role.mapped.signal, role)
        shared_limit = known.quantity == role.quantity == "torque_limit"
        if known is not role and not shared_limit:
            faults.append(f"{role.where}: {role.mapped.signal} is already mapped to {known.where}")
    return faults


def _identifiers_shared(channels: Iterable[Channel], database: Database) -> list[str]:
    owner: dict[tuple[int, bool], str] = {}
    faults: list[str] = []
    for name in dict.fromkeys(c.message for c in channels):
        message = database.get_message_by_name(name)
        known = owner.setdefault((message.frame_id, message.is_extended_frame), name)
        if known != name:
            faults.append(f"messages {known} and {name} have the same identifier {message.frame_id:#x}")
    return faults


__all__ = ["channels_of", "checked_messages", "load_databases", "plausible", "without_unit"]
