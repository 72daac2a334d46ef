"""Check of a configuration against a recording: each mapped signal, and what contradicts the configured vehicle.

Mistakes of mapping (sign, unit, gear ratio, byte order, wheel) are large and constant, so each check compares means
over the whole recording. Where the recording varies too little, the survey says that it cannot decide.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from typing import NamedTuple

import numpy as np
from cantools.database.can import Database, Message

from soilbus.arrays import Array
from soilbus.can.admission import MEANING, Admission, Counts
from soilbus.can.candump import Frame
from soilbus.can.channels import Channel, Reason
from soilbus.can.dbc_files import checked_messages
from soilbus.can.mapping import LOCK, OPTIONAL_ROLES, POSITION_ROLES, channels_of, found_signal, si_unit
from soilbus.can.units import unit_of
from soilbus.config.model import SHORT_BIN, Config, ConfigError, Signal, Wheel
from soilbus.estimation.assembly import rig_of
from soilbus.grouping import grouped
from soilbus.sensors.consistency import implausible, resolution_of, runs
from soilbus.sensors.facts import LIMITS, Columns, Facts, Finding, UndecidableError, fault, longest_part
from soilbus.sensors.vehicle_checks import CHECKS

MAX_LISTED = 4
"""Identifiers that one line names."""
NOTHING: tuple[Array, Array] = np.empty(0), np.empty(0)
"""Times and values of a signal that was not heard."""
OTHER_SENDER = "another priority or source address than in the DBC?"


class Seen:
    """One mapped signal: number of values, rate [1/s], range and median (SI), refused values by reason; nan without.

    unit: of its values in SI, "" of a code; is_absent: no frame held it; is_optional: estimates do without it.
    """

    def __init__(self, channel: Channel, heard: Columns, refused: Mapping[tuple[str, Reason], int]) -> None:
        t, value = heard.get(channel.name, NOTHING)
        self.channel, self.unit, self.count = channel, si_unit(channel), len(t)
        self.rate = float((len(t) - 1) / (t[-1] - t[0])) if len(t) > 1 and t[-1] > t[0] else math.nan
        ends = np.quantile(value, [0.0, 0.5, 1.0]).tolist() if len(value) else [math.nan] * 3
        self.low, self.median, self.high = map(float, ends)
        self.refused = {reason: n for (name, reason), n in refused.items() if name == channel.name}
        self.is_absent = self.count == 0 and not self.refused
        self.is_optional = channel.quantity in {*OPTIONAL_ROLES, "sinkage", "torque_limit", "motor_speed"}


class Survey(NamedTuple):
    """Result of a survey: every mapped signal, the findings, and what this recording cannot decide (open)."""

    seen: tuple[Seen, ...]
    findings: tuple[Finding, ...]
    open: tuple[str, ...]

    @property
    def faults(self) -> list[str]:
        """Texts of the findings that make estimates wrong."""
        return [f.text for f in self.findings if f.fatal]

    @property
    def warnings(self) -> list[str]:
        """Texts of all other findings."""
        return [f.text for f in self.findings if not f.fatal]


def survey(config: Config, database: Database, frames: Iterable[Frame]) -> Survey:
    """Compare the frames of one recording with a configuration and the messages of the vehicle's bus.

    ConfigError where configuration and database do not fit.
    """
    channels = channels_of(config, database)
    mapped = {c.name for c in channels}
    with suppress(ConfigError):  # of a speed that nobody mapped
        with_motors = config.model_copy(update={"wheel": _with_motor_speeds(config, database)})
        channels = channels_of(with_motors, database)
        config = with_motors
    admission = Admission(channels, database, checked_messages(config, database))
    heard, refused, n = longest_part(admission, frames)
    seen = tuple(Seen(c, heard, refused) for c in channels if c.name in mapped)
    findings = list(_absent(seen, database, admission.counts))
    if not sum(admission.counts.received.values()):
        text = f"none of the {n} frames heard is of a mapped message: another bus or channel, or the wrong DBC?"
        return Survey(seen, (fault(text), *(f for f in findings if OTHER_SENDER in f.text)), ())
    findings += _of_several_senders(channels, admission.counts)
    findings += [finding for s in seen for finding in _of_one(s, database)]
    findings += _stuck_and_jagged(seen, heard, config)
    findings += _too_slow_to_measure(heard, config)
    findings += _mixed_rates(seen, config)
    questions = [f"{s.channel.key}: not in this recording" for s in seen if s.is_absent and s.is_optional]
    rig = rig_of(config)
    if rig.wheels and heard.keys() & {*rig.channels}:
        speeds = {w.name: found_signal(database, w.speed.signal)[1].unit for w in config.wheel if w.speed is not None}
        by_radius = [wheel for wheel, unit in speeds.items() if _dimension(unit) == "speed"]
        questions += _compare(Facts(config, mapped, heard, by_radius), findings, channels, database)
    return Survey(seen, tuple(findings), tuple(questions))


def _with_motor_speeds(config: Config, database: Database) -> list[Wheel]:
    """The wheels, with an unmapped motor speed added where the torque's message has exactly one."""
    wheels = []
    for wheel in config.wheel:
        if wheel.torque is not None and wheel.motor_speed is None and wheel.torque.at != "wheel":
            name = wheel.torque.signal.partition(".")[0]
            signals = [s for message in database.messages if message.name == name for s in message.signals]
            turns = [f"{name}.{s.name}" for s in signals if _dimension(s.unit) == "rotation"]
            mapped = {given.signal for given in (wheel.torque, wheel.speed) if given is not None}
            if len(turns) == 1 and turns[0] not in mapped:
                wheel = wheel.model_copy(update={"motor_speed": Signal(signal=turns[0], sign=wheel.torque.sign)})
        wheels.append(wheel)
    return wheels


def _dimension(unit: str | None) -> str:
    """The dimension of a unit's text; "" of none that is known."""
    with suppress(ValueError):
        return known.dimension if (known := unit_of(unit)) is not None else ""
    return ""


_REFUSAL: Mapping[Reason, str] = {
    Reason.NOT_AVAILABLE: "the sender says that it is not available",
    Reason.ERROR: "the sender reports an error",
    Reason.RESERVED: "codes that the DBC reserves",
    Reason.OUT_OF_RANGE: "beyond the DBC's range: start bit, length or byte order?",
    Reason.IMPLAUSIBLE: "beyond what this vehicle can do ({low:.4g} to {high:.4g} {unit}): unit, factor, byte order?",
    Reason.SATURATED: "at the end of the range",
    Reason.NOT_VALID: "its `valid` signal does not vouch for it: right `valid_values`?",
    **MEANING,
    Reason.BAD_COUNTER: "its Counter stands still, or is another maker's (dbc.checked, dbc/README.md)",
    Reason.WRONG_LENGTH: "frames of another length than the DBC says",
    Reason.TIME_BACKWARDS: "stamps that run backwards",
}


def _absent(seen: Iterable[Seen], database: Database, counts: Counts) -> Iterator[Finding]:
    """Messages without which nothing can be estimated, and that never came."""
    missing = [s.channel for s in seen if s.is_absent and not s.is_optional]
    for name, channels in grouped(missing, lambda channel: channel.message).items():
        message = database.get_message_by_name(name)
        where = f"{'29' if message.is_extended_frame else '11'}-bit identifier {message.frame_id:#x}"
        keys = ", ".join(channel.key for channel in channels)
        text = f"{keys}: no frame of {name} ({where}) was heard"
        if heard := counts.unknown_of_group(message.frame_id) if message.is_extended_frame else []:
            shown = [f"{identifier:#x}" for identifier in heard[:MAX_LISTED]] + ["..."] * (len(heard) > MAX_LISTED)
            text += f", but {', '.join(shown)} of its parameter group: {OTHER_SENDER}"
        signals = dict.fromkeys(channel.signal for channel in channels)
        if counts.received[name] and all(_is_of_a_page(message, signal) for signal in signals):
            text = f"{keys}: {name} was heard, but never the page of its multiplexer that holds {', '.join(signals)}"
        yield fault(text, *(c.name for c in channels))


def _is_of_a_page(message: Message, signal: str) -> bool:
    """Whether a multiplexer says which frames hold a signal."""
    return message.get_signal_by_name(signal).multiplexer_signal is not None


def _of_several_senders(channels: Iterable[Channel], counts: Counts) -> Iterator[Finding]:
    """Messages that several nodes send, of which none is the one that the DBC names: which one counts is chance."""
    for name, members in grouped(channels, lambda channel: channel.message).items():
        if addresses := sorted(counts.senders.get(name, ())):
            keys = ", ".join(channel.key for channel in members)
            heard = " and ".join(f"{address:#04x}" for address in addresses)
            text = f"{keys}: {name} comes from the source addresses {heard}, and the one heard first counts"
            yield Finding(f"{text}: put the one that you mean into the identifier of a DBC of your own", False)


def _of_one(seen: Seen, database: Database) -> Iterator[Finding]:
    """Whether a signal comes often enough and its values are accepted."""
    channel, key = seen.channel, seen.channel.key
    message = database.get_message_by_name(channel.message)
    refused = sum(seen.refused.values())
    if seen.is_absent:
        return
    share = refused / (refused + seen.count)
    said = {max(seen.refused, key=lambda reason: seen.refused[reason])} if share > LIMITS.refused else set()
    for reason in sorted(said | ({Reason.SECOND_SENDER} & seen.refused.keys())):
        n, why = seen.refused[reason], _REFUSAL.get(reason, str(reason).replace("_", " "))
        why = why.format(low=channel.low, high=channel.high, unit=seen.unit)
        text = f"{key}: {n} of {refused + seen.count} values of {channel.path} do not count: {why}"
        yield fault(text, channel.name) if share > 4.0 * LIMITS.refused else Finding(text, False)
    if math.isfinite(seen.rate) and channel.quantity not in POSITION_ROLES:
        cycle = 0 if _is_of_a_page(message, channel.signal) else message.cycle_time
        due = 1e3 / cycle * (1.0 - share) if cycle else 0.0
        if seen.rate < LIMITS.rate * due:
            yield Finding(f"{key}: {seen.rate:.3g} values a second, where the DBC says {due:.3g}", False)
        elif seen.rate < LIMITS.least_rate and not seen.is_optional:
            yield Finding(f"{key}: only {seen.rate:.3g} values a second; windows need {LIMITS.least_rate:g}", False)


def _stuck_and_jagged(seen: Iterable[Seen], heard: Columns, config: Config) -> Iterator[Finding]:
    """Values that never change while the vehicle drives, and values that jump more than a vehicle can."""
    ground = heard.get("ground_speed", NOTHING)
    moving = ground[0][np.abs(ground[1]) > config.estimator.min_speed]
    drives = float(np.ptp(moving)) if len(moving) else 0.0
    for s in seen:
        quantity, name = s.channel.quantity, s.channel.name
        if quantity in ("torque_limit", LOCK, *POSITION_ROLES) or s.count < 50:
            continue
        _, value = heard[name]
        if s.low == s.high:
            if drives > LIMITS.least_seconds or quantity == "ground_speed":
                text = f"{s.channel.key}: reads {s.low:.4g} {s.unit} in all {s.count} values: is the sensor connected?"
                yield Finding(text, False, (name,) if s.low != 0.0 else ())
            continue
        noise = getattr(config.noise, "speed" if quantity == "motor_speed" else quantity)
        size = float(np.median(np.abs(value)))
        sd = math.sqrt(noise.absolute**2 + (noise.relative**2 + noise.of_mean**2) * size**2)
        jumps = np.diff(value)
        typical = float(np.median(np.abs(jumps)))
        alike = float((jumps**2).mean() / (2.0 * value.var()))  # 1 for uncorrelated values
        if typical > max(LIMITS.jump_sd * sd, LIMITS.jump * size) and alike > 0.5:
            jumps_by = f"jumps by {typical:.3g} {s.unit} from one value to the next, {typical / sd:.0f} times its noise"
            why = f"is the byte order (Intel, Motorola) or the start bit of {s.channel.path} right in the DBC?"
            yield fault(f"{s.channel.key}: {jumps_by}: {why}", name)


def _too_slow_to_measure(heard: Columns, config: Config) -> Iterator[Finding]:
    """A ground speed that reads zero while the wheels turn slowly, and has no value below some speed else."""
    t, ground = heard.get("ground_speed", NOTHING)
    speeds = [(*heard[f"speed.{w.name}"], w.radius) for w in config.wheel if f"speed.{w.name}" in heard]
    moves = ground != 0.0
    if not moves.any() or not speeds:
        return
    least, settings = float(np.abs(ground[moves]).min()), config.traversability
    rim = np.mean([np.interp(t, at, radius * np.abs(speed)) for at, speed, radius in speeds], axis=0)
    creeps = ~moves & (rim > settings.standstill) & (rim < least)
    longest = max((float(t[end - 1] - t[begin]) for begin, end in runs(creeps)), default=0.0)
    if least > config.estimator.min_speed and longest > settings.stuck_time:
        enough = math.ceil(20.0 * float(rim[~moves].max())) / 20.0
        reads = f"reads 0 for up to {longest:.1f} s while the wheels turn, and else never less than {least:.2g} m/s"
        mend = f"if the sensor measures no slower speed, set estimator.min_speed = {enough:.2f}"
        passes = "a vehicle that creeps passes for one that is stuck"
        yield Finding(f"signals.ground_speed: {reads}: {passes}; {mend}", False)


def _mixed_rates(seen: Iterable[Seen], config: Config) -> Iterator[Finding]:
    """Bins that hold one sample of a wheel's channel and several of another: a mean beside a value of one instant."""
    wheels = [s for s in seen if s.channel.quantity in ("torque", "speed", "load") and s.rate > 0.0]
    if len(wheels) < 2:
        return
    slow, fast = (by(wheels, key=lambda s: s.rate) for by in (min, max))
    present, length = config.estimator.bin, min(max(1.0 / fast.rate, SHORT_BIN), 0.5 / slow.rate)
    if slow.rate * present < LIMITS.instant and fast.rate * present >= 2.0 * LIMITS.instant and length < present:
        rates = f"{slow.channel.key}: {slow.rate:.3g} values a second beside {fast.rate:.3g} of {fast.channel.key}"
        mean = f"in bins of {present:g} s a mean stands beside a value of one instant"
        shakes = f"loads that shake bias the soil; set estimator.bin = {length:.2g}"
        yield Finding(f"{rates}: {mean}, and {shakes}", False)


@np.errstate(invalid="ignore", divide="ignore")  # of values that are not known
def _compare(facts: Facts, findings: list[Finding], channels: Sequence[Channel], database: Database) -> list[str]:
    """Add what checks find, each without the channels that an earlier one has named; return open questions."""
    facts = facts.less(name for f in findings for name in f.channels)
    if facts.straight.sum() < facts.bins(LIMITS.least_seconds):
        least = f"{LIMITS.least_seconds:g} s: signs, gear ratio and sides cannot be compared"
        return [f"the vehicle drives straight on for less than {least}"]
    questions: list[str] = []
    for check in CHECKS:
        found: list[Finding] = []
        try:
            found += check(facts)
        except UndecidableError as reason:
            if not any(f.fatal for f in findings):  # else undecided because of the fault
                questions.append(str(reason))
        findings += found
        facts = facts.less(name for f in found for name in f.channels)
    if not any(f.fatal for f in findings):
        findings += _contradictions(facts, channels, database)
    return questions


def _contradictions(facts: Facts, channels: Sequence[Channel], database: Database) -> Iterator[Finding]:
    """Sensors that contradict the others in many windows, by the checks of `consistency`."""
    rig, settings = facts.rig, facts.config.estimator
    resolution = {c.name: resolution_of(c, database) for c in channels}
    motor = np.abs(facts.less({f"motor_speed.{w}" for w in rig.wheels} - facts.mapped).motor)
    n, end = facts.bins(settings.window), len(facts.window.t)
    parts = [slice(begin, begin + n) for begin in range(0, max(end - n, 0) + 1, n)]
    named: Counter[str] = Counter()
    for rows in parts:
        named.update(implausible(facts.window.rows(rows), rig, settings, resolution, motor[rows]))
    keys = {c.name: c.key for c in channels}
    for name, count in named.items():
        if count > max(LIMITS.windows * len(parts), 1.0):
            text = f"{keys.get(name, name)}: contradicts the other sensors in {count} of {len(parts)} windows"
            yield Finding(text, False, (name,))
