"""Check of a configuration against a recording: each mapped signal, and what contradicts the configured vehicle.

    weight      sum of the wheel loads = m g cos(pitch), and its share on each axle by moments
    gear        motor speed = gear ratio * wheel speed
    slip        1 - v / (r omega), within the range of driven wheels
    transfer    changes of the front axle's load less the rear's = twice those by moments of draft, slope and inertia
    balance     changes of sum(torque / r) = 0.7 to 1.0 * changes of draft, and of slope + inertia
    sides       left less right: torque = a * load + b * slip + constant, with a > 0 and b > 0

Mistakes of mapping (sign, unit, gear ratio, byte order, wheel) are large and constant, so each check compares means
over the whole recording.  A wrong sign of a or b shows that loads, speeds or torques of left and right are swapped; all
three swapped at once are the mirrored vehicle.  Where the recording varies too little, the survey says that it cannot
decide.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from cantools.database.can import Database, Message

from soilbus.arrays import Array, Mask
from soilbus.can.admission import Admission, Counts
from soilbus.can.channels import Channel, Reason
from soilbus.can.dbc_files import checked_messages
from soilbus.can.doubts import MEANING
from soilbus.can.mapping import LOCK, OPTIONAL_ROLES, POSITION_ROLES, channels_of, found_signal
from soilbus.can.units import SI, unit_of
from soilbus.config.model import SHORT_BIN, Config, ConfigError, Signal
from soilbus.estimation.assembly import rig_of
from soilbus.estimation.instrumentation import completed
from soilbus.estimation.window import Rig, Window, forward, pairs, pull_given, turning
from soilbus.grouping import grouped
from soilbus.sensors.bins import Bins, bin_means
from soilbus.sensors.consistency import change, implausible, median, resolution_of, without
from soilbus.sensors.recorded import Columns, Frame, longest_part
from soilbus.terra.vehicle import GRAVITY, axle_loads, slip_ratio

MAX_LISTED = 4
"""Identifiers that one line names."""
OTHER_SENDER = "another priority or source address than in the DBC?"


@dataclass(frozen=True, slots=True)
class Limits:
    """Thresholds from which a recording contradicts its configuration.

    Evidence, where not given: three recordings of the field vehicle and simulated drives on loam, wet clay, heavy clay
    and sand gave loads of 0.997 to 1.002 of the weight, axles within 0.004 of it, slopes of the balance of 0.72 to
    1.01, slips of 5 % of the time of 0.06 to 0.14, and slips of wheels within 0.04 of each other.
    """

    least_seconds: float = 10.0
    """Least time [s] of straight driving for any comparison."""
    refused: float = 0.05
    """Share of refused values from which a warning is given; four times this share is a fault."""
    rate: float = 0.8
    """Share of the DBC's rate below which a signal is too slow."""
    least_rate: float = 5.0
    """Least rate [1/s] for windows of 0.1 s bins."""
    instant: float = 1.5
    """Samples of a wheel's channel in a bin below which the bin holds a value of one instant."""
    mean_of: float = 3.0
    """Samples of another channel in the same bin from which they are a mean.  Behind differentials, with loads that
    shake, 65 % of the intervals of n held where both stood side by side, 95 % in shorter bins (loam, 40 drives)."""
    weight: float = 0.15
    """Share of the weight by which the loads may differ (fuel, driver, freight); half of it is a warning."""
    axle: float = 0.12
    """The same for one axle: centre of gravity and hitch height are known to this accuracy."""
    gear: float = 0.03
    """Relative difference of motor and wheel speed, due to resolution and phase; any other gear step is larger."""
    locked: float = 0.015
    """Median difference of two wheel speeds over their mean, from which no shaft connects them: each sensor's noise and
    gain error are 0.003 and 0.002 (`noise.speed`); behind an open differential a simulated drive on loam has 0.06."""
    pushed: float = -0.2
    """Least median slip of driving wheels."""
    never_less: float = 0.45
    """Slip exceeded in 95 % of a drive, from which the speeds are implausible."""
    wheel_apart: float = 0.15
    """Difference of one wheel's median slip from the median of all."""
    free: float = 0.25
    """Largest median slip, either way, of a wheel that rolls freely: wheels towed through soft soil skid by 0.1 to 0.2
    (Wong 2008, ch. 4); simulated ones on loam by 0.02."""
    transfer: float = 0.75
    """Least share of the load transfer by moments: 0 where a front and a rear cell are swapped, -1 where both are.  The
    field vehicle has 1.2 +- 0.1 (on clay, where the draft hardly changes, 2.3 +- 0.5), a simulated drive 1.00."""
    scale: tuple[float, float] = (0.6, 1.3)
    """Range of the regression slope of thrust on draft."""
    turn: float = 0.5
    """Relative difference [1] of an axle's speeds from yaw rate times track that still is a turn's, not a spin's: of 17
    logs of a rover on snow two were refused without it, for the sign of a yaw rate that is right."""
    excited: float = 0.008
    """Sd of the draft's changes within 1 s, as a share of the weight, below which the balance cannot be decided."""
    pull: float = 0.02
    """Median pull, as a share of the weight, from which thrust and pull are compared."""
    less_thrust: float = 0.9
    """Least thrust over pull: the thrust includes rolling resistance, at least a hundredth of the weight."""
    most_thrust: float = 0.9
    """Largest median thrust over weight that soil can bear for long."""
    side_sd: float = 4.0
    """Standard deviations by which a regression coefficient must have the wrong sign, or lie outside `scale`."""
    side_torque: float = 0.05
    """Sd of the difference of an axle's torques, over their mean, below which it tells nothing of load and slip: motors
    that are given the same torque have 0.002 to 0.02 in multibody drives, the field vehicle 0.16."""
    side_offset: float = 0.3
    """Constant difference of the torques of an axle, as a share of their mean."""
    jump: float = 0.3
    """Median change from value to value, as a share of the median value; a vehicle's inertia keeps it lower."""
    jump_sd: float = 10.0
    """The same, in standard deviations of the configured noise."""
    windows: float = 0.2
    """Share of windows in which a sensor contradicts the others."""


LIMITS = Limits()


class Finding(NamedTuple):
    """One line of text; `fatal` if estimates would be wrong; names of the channels concerned."""

    text: str
    fatal: bool
    channels: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Seen:
    """One mapped signal: number of values, rate [1/s], range and median (SI), refused values by reason; nan without."""

    channel: Channel
    count: int
    rate: float
    low: float
    high: float
    median: float
    refused: Mapping[Reason, int]

    @property
    def unit(self) -> str:
        """SI unit of its values; "" of a code."""
        return si_unit(self.channel)


def si_unit(channel: Channel) -> str:
    """SI unit of a channel's values; "" of a code."""
    return "" if channel.quantity == LOCK else SI.get(_dimension(channel), "")


@dataclass(frozen=True, slots=True)
class Survey:
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


class UndecidableError(Exception):
    """The recording cannot decide a check; the text says which and why."""


class Facts(NamedTuple):
    """A recording in N bins.

    raw, window: as measured, and turned forward; straight (N,): where the vehicle drives straight on; motor (N, W):
    motor speeds [rad/s]; shaft: those of motors of axles (N,), by axle; mapped: names of the mapped channels;
    by_radius: wheels whose speed is measured in m/s.
    """

    config: Config
    rig: Rig
    raw: Window
    window: Window
    straight: Mask
    motor: Array
    shaft: Mapping[str, Array]
    mapped: frozenset[str]
    by_radius: frozenset[str]

    @property
    def slip(self) -> Array:
        """Slip (N, W), nan where the vehicle does not drive straight on."""
        ground = np.where(self.straight, self.window.ground_speed, np.nan)[:, None]
        return np.asarray(slip_ratio(self.rig.radius, self.window.speed, ground))

    @property
    def thrust(self) -> Array:
        """Torque over radius [N] (N, W), nan where the vehicle does not drive straight on."""
        return np.where(self.straight[:, None], self.window.torque / self.rig.radius, np.nan)

    def less(self, channels: Iterable[str]) -> Facts:
        """The same without these channels."""
        gone = set(channels)
        motor = np.where([f"motor_speed.{w}" in gone for w in self.rig.wheels], np.nan, self.motor)
        return self._replace(
            raw=without(self.raw, self.rig, gone), window=without(self.window, self.rig, gone), motor=motor
        )


def survey(config: Config, database: Database, frames: Iterable[Frame]) -> Survey:
    """Compare a recording with a configuration.

    Parameters
    ----------
    config, database
        The configuration and the messages of the vehicle's bus.
    frames
        Of one recording: (time [s], identifier, extended, data, remote, error).

    Returns
    -------
    Survey
        Signals, findings, open questions.

    Raises
    ------
    ConfigError
        Where configuration and database do not fit.
    """
    with_motors = config.model_copy(update={"wheel": _with_motor_speeds(config, database)})
    mapped = {c.name for c in channels_of(config, database)}
    try:
        channels = channels_of(with_motors, database)
    except ConfigError:  # of a speed that nobody mapped
        with_motors, channels = config, channels_of(config, database)
    admission = Admission(channels, database, checked_messages(config, database))
    longest, refused, n = longest_part(admission, frames)
    seen = tuple(_seen(c, longest, refused) for c in channels if c.name in mapped)
    absent = list(_absent(seen, database, admission.counts))
    if not sum(admission.counts.received.values()):
        text = f"none of the {n} frames heard is of a mapped message: another bus or channel, or the wrong DBC?"
        return Survey(seen, (Finding(text, True), *(f for f in absent if OTHER_SENDER in f.text)), ())
    findings = [
        *absent,
        *_of_several_senders(channels, admission.counts),
        *(f for s in seen for f in _of_one(s, database)),
    ]
    findings += [
        *_stuck_and_jagged(seen, longest, config),
        *_too_slow_to_measure(longest, config),
        *_mixed_rates(seen, config),
    ]
    facts = _facts(with_motors, mapped, longest, database)
    open_questions = [f"{s.channel.key}: not in this recording" for s in seen if _is_absent(s) and _is_optional(s)]
    if facts is not None:
        found, questions = _compared(facts, findings, channels, database)
        findings += found
        open_questions += questions
    return Survey(seen, tuple(findings), tuple(open_questions))


# --- decoding ---


def _with_motor_speeds(config: Config, database: Database) -> list[object]:
    """The wheels, with an unmapped motor speed added where the torque's message has exactly one."""
    wheels: list[object] = []
    for wheel in config.wheel:
        if wheel.torque is not None and wheel.motor_speed is None and wheel.torque.at != "wheel":
            name = wheel.torque.signal.partition(".")[0]
            message = next((m for m in database.messages if m.name == name), None)
            taken = {getattr(wheel, role).signal for role in ("torque", "speed") if getattr(wheel, role) is not None}
            turns = [s for s in message.signals if _rotation(s.unit)] if message is not None else []
            if len(turns) == 1 and f"{name}.{turns[0].name}" not in taken:
                signal = Signal(signal=f"{name}.{turns[0].name}", sign=wheel.torque.sign)
                wheel = wheel.model_copy(update={"motor_speed": signal})
        wheels.append(wheel)
    return wheels


def _rotation(text: str | None) -> bool:
    try:
        unit = unit_of(text)
    except ValueError:
        return False
    return unit is not None and unit.dimension == "rotation"


def _is_in_metres(signal: Signal, database: Database) -> bool:
    unit = unit_of(found_signal(database, signal.signal)[1].unit)
    return unit is not None and unit.dimension == "speed"


def _seen(channel: Channel, heard: Columns, refused: Mapping[tuple[str, Reason], int]) -> Seen:
    t, value = heard.get(channel.name, (np.empty(0), np.empty(0)))
    rate = (len(t) - 1) / (t[-1] - t[0]) if len(t) > 1 and t[-1] > t[0] else math.nan
    low, middle, high = np.quantile(value, [0.0, 0.5, 1.0]).tolist() if len(value) else [math.nan] * 3
    why = {reason: n for (name, reason), n in refused.items() if name == channel.name}
    return Seen(channel, len(t), float(rate), low, high, middle, why)


def _facts(config: Config, mapped: Iterable[str], heard: Columns, database: Database) -> Facts | None:
    """The recording in bins; None where no wheel is measured or nothing was heard of the rig."""
    rig, bin_length = rig_of(config), config.estimator.bin
    known = {name: column for name, column in heard.items() if name in set(rig.channels)}
    if not rig.wheels or not known:
        return None
    start = min(float(t[0]) for t, _ in known.values())
    end = max(float(t[-1]) for t, _ in known.values())
    store = Bins(rig, bin_length, start)
    store.add(known)
    raw = store.window(start, end)
    if not len(raw.t):
        return None
    window = completed(forward(raw), rig)
    motor = np.full(raw.speed.shape, np.nan)
    for i, wheel in enumerate(rig.wheels):
        if f"motor_speed.{wheel}" in heard:
            motor[:, i] = bin_means(*heard[f"motor_speed.{wheel}"], start, bin_length, len(raw.t))
    of_axles: dict[str, tuple[Array, Array]] = {
        a.name: heard[f"speed.{a.name}"] for a in config.axle if f"speed.{a.name}" in heard
    }
    shaft = {name: bin_means(*column, start, bin_length, len(raw.t)) for name, column in of_axles.items()}
    moving = np.abs(window.ground_speed) > config.estimator.min_speed
    straight = moving & ~turning(window, rig, config.estimator.max_turn)
    by_radius = frozenset(w.name for w in config.wheel if w.speed is not None and _is_in_metres(w.speed, database))
    return Facts(config, rig, raw, window, straight, motor, shaft, frozenset(mapped), by_radius)


# --- one signal by itself ---


def _is_absent(seen: Seen) -> bool:
    return seen.count == 0 and not seen.refused


def _is_optional(seen: Seen) -> bool:
    return seen.channel.quantity in {*OPTIONAL_ROLES, "sinkage", "torque_limit", "motor_speed"}


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
    Reason.BAD_TIME: "stamps that are no times",
}


def _absent(seen: Iterable[Seen], database: Database, counts: Counts) -> Iterator[Finding]:
    """Messages without which nothing can be estimated, and that never came."""
    missing = [s.channel for s in seen if _is_absent(s) and not _is_optional(s)]
    for name, channels in grouped(missing, lambda channel: channel.message).items():
        message = database.get_message_by_name(name)
        where = f"{'29' if message.is_extended_frame else '11'}-bit identifier {message.frame_id:#x}"
        keys = ", ".join(channel.key for channel in channels)
        text = f"{keys}: no frame of {name} ({where}) was heard{_elsewhere(message, counts)}"
        signals = dict.fromkeys(channel.signal for channel in channels)
        if counts.received[name] and all(_is_of_a_page(message, signal) for signal in signals):
            text = f"{keys}: {name} was heard, but never the page of its multiplexer that holds {', '.join(signals)}"
        yield Finding(text, True, tuple(c.name for c in channels))


def _is_of_a_page(message: Message, signal: str) -> bool:
    """Whether a multiplexer says which frames hold a signal."""
    return message.get_signal_by_name(signal).multiplexer_signal is not None


def _elsewhere(message: Message, counts: Counts) -> str:
    """What was heard of a message's parameter group under other identifiers."""
    heard = counts.unknown_of_group(message.frame_id) if message.is_extended_frame else []
    if not heard:
        return ""
    shown = ", ".join(f"{identifier:#x}" for identifier in heard[:MAX_LISTED]) + ", ..." * (len(heard) > MAX_LISTED)
    return f", but {shown} of its parameter group: {OTHER_SENDER}"


def _of_several_senders(channels: Iterable[Channel], counts: Counts) -> Iterator[Finding]:
    """Messages that several nodes send, of which none is the one that the DBC names: which one counts is chance."""
    for name, members in grouped(channels, lambda channel: channel.message).items():
        if addresses := sorted(counts.senders.get(name, ())):
            keys = ", ".join(channel.key for channel in members)
            heard = " and ".join(f"{address:#04x}" for address in addresses)
            yield Finding(
                f"{keys}: {name} comes from the source addresses {heard}, and the one heard first counts: put the one"
                f" that you mean into the identifier of a DBC of your own", False,
            )  # fmt: skip


def _of_one(seen: Seen, database: Database) -> Iterator[Finding]:
    """Whether a signal comes often enough and its values are accepted."""
    channel, key = seen.channel, seen.channel.key
    message = database.get_message_by_name(channel.message)
    refused = sum(seen.refused.values())
    if _is_absent(seen):
        return
    share = refused / (refused + seen.count)
    said = {max(seen.refused, key=lambda reason: seen.refused[reason])} if share > LIMITS.refused else set()
    for reason in sorted(said | ({Reason.SECOND_SENDER} & seen.refused.keys())):
        n, unit = seen.refused[reason], SI.get(_dimension(channel), "")
        why = _REFUSAL.get(reason, str(reason).replace("_", " ")).format(low=channel.low, high=channel.high, unit=unit)
        text = f"{key}: {n} of {refused + seen.count} values of {channel.path} do not count: {why}"
        yield Finding(text, share > 4.0 * LIMITS.refused, (channel.name,) if share > 4.0 * LIMITS.refused else ())
    if math.isfinite(seen.rate) and channel.quantity not in POSITION_ROLES:
        cycle = 0 if _is_of_a_page(message, channel.signal) else message.cycle_time
        due = 1e3 / cycle * (1.0 - share) if cycle else 0.0
        if seen.rate < LIMITS.rate * due:
            yield Finding(f"{key}: {seen.rate:.3g} values a second, where the DBC says {due:.3g}", False)
        elif seen.rate < LIMITS.least_rate and not _is_optional(seen):
            yield Finding(f"{key}: only {seen.rate:.3g} values a second; windows need {LIMITS.least_rate:g}", False)


def _dimension(channel: Channel) -> str:
    of_quantity = {
        "torque": "torque", "torque_limit": "torque", "speed": "rotation", "motor_speed": "rotation", "load": "force",
        "draft": "force", "sinkage": "length", "ground_speed": "speed", "acceleration": "acceleration",
        "yaw_rate": "rotation",
    }  # fmt: skip
    return of_quantity.get(channel.quantity, "angle")


def _stuck_and_jagged(seen: Iterable[Seen], heard: Columns, config: Config) -> Iterator[Finding]:
    """Values that never change while the vehicle drives, and values that jump more than a vehicle can."""
    ground = heard.get("ground_speed", (np.empty(0), np.empty(0)))
    moving = ground[0][np.abs(ground[1]) > config.estimator.min_speed]
    drives = float(np.ptp(moving)) if len(moving) else 0.0
    for s in seen:
        quantity, name = s.channel.quantity, s.channel.name
        if quantity in ("torque_limit", LOCK, *POSITION_ROLES) or s.count < 50:
            continue
        _, value = heard[name]
        unit = SI.get(_dimension(s.channel), "")
        if s.low == s.high:
            if drives > LIMITS.least_seconds or quantity == "ground_speed":
                text = f"{s.channel.key}: reads {s.low:.4g} {unit} in all {s.count} values: is the sensor connected?"
                yield Finding(text, False, (name,) if s.low != 0.0 else ())
            continue
        noise = getattr(config.noise, "speed" if quantity == "motor_speed" else quantity)
        size = float(np.median(np.abs(value)))
        sd = math.sqrt(noise.absolute**2 + (noise.relative**2 + noise.of_mean**2) * size**2)
        jumps = np.abs(np.diff(value))
        typical = float(np.median(jumps))
        alike = float((np.diff(value) ** 2).mean() / (2.0 * value.var()))  # 1 for uncorrelated values
        if typical > max(LIMITS.jump_sd * sd, LIMITS.jump * size) and alike > 0.5:
            yield Finding(
                f"{s.channel.key}: jumps by {typical:.3g} {unit} from one value to the next, {typical / sd:.0f} times"
                f" its noise: is the byte order (Intel, Motorola) or the start bit of {s.channel.path}"
                " right in the DBC?",
                True,
                (name,),
            )


def _too_slow_to_measure(heard: Columns, config: Config) -> Iterator[Finding]:
    """A ground speed that reads zero while the wheels turn slowly, and has no value below some speed else."""
    t, ground = heard.get("ground_speed", (np.empty(0), np.empty(0)))
    speeds = [(*heard[f"speed.{w.name}"], w.radius) for w in config.wheel if f"speed.{w.name}" in heard]
    moves = ground != 0.0
    if not moves.any() or not speeds:
        return
    least, settings = float(np.abs(ground[moves]).min()), config.traversability
    rim = np.mean([np.interp(t, at, radius * np.abs(speed)) for at, speed, radius in speeds], axis=0)
    creeps = ~moves & (rim > settings.standstill) & (rim < least)
    begins, ends = (np.flatnonzero(np.diff(np.pad(creeps.astype(int), 1)) == step) for step in (1, -1))
    longest = max((float(t[end - 1] - t[begin]) for begin, end in zip(begins, ends, strict=True)), default=0.0)
    if least > config.estimator.min_speed and longest > settings.stuck_time:
        enough = math.ceil(20.0 * float(rim[~moves].max())) / 20.0
        yield Finding(
            f"signals.ground_speed: reads 0 for up to {longest:.1f} s while the wheels turn, and else never less than"
            f" {least:.2g} m/s: a vehicle that creeps passes for one that is stuck; if the sensor measures no slower"
            f" speed, set estimator.min_speed = {enough:.2f}",
            False,
        )


def _mixed_rates(seen: Iterable[Seen], config: Config) -> Iterator[Finding]:
    """Bins that hold one sample of a wheel's channel and several of another: a mean beside a value of one instant."""
    wheels = [s for s in seen if s.channel.quantity in ("torque", "speed", "load") and s.rate > 0.0]
    if len(wheels) < 2:
        return
    slow, fast = (by(wheels, key=lambda s: s.rate) for by in (min, max))
    present, length = config.estimator.bin, min(max(1.0 / fast.rate, SHORT_BIN), 0.5 / slow.rate)
    if slow.rate * present < LIMITS.instant and fast.rate * present >= LIMITS.mean_of and length < present:
        yield Finding(
            f"{slow.channel.key}: {slow.rate:.3g} values a second beside {fast.rate:.3g} of {fast.channel.key}: in"
            f" bins of {present:g} s a mean stands beside a value of one instant, and loads that shake bias the soil;"
            f" set estimator.bin = {length:.2g}",
            False,
        )


# --- signals compared with each other ---

Check = Callable[[Facts], Iterator[Finding]]


def _compared(
    facts: Facts, before: Iterable[Finding], channels: Iterable[Channel], database: Database
) -> tuple[list[Finding], list[str]]:
    """Findings of all checks, each without the channels that an earlier check has named, and open questions."""
    facts = facts.less(name for f in before for name in f.channels)
    if facts.straight.sum() * facts.config.estimator.bin < LIMITS.least_seconds:
        return [], [
            f"the vehicle drives straight on for less than {LIMITS.least_seconds:g} s: signs, gear ratio and sides"
            " cannot be compared"
        ]
    findings: list[Finding] = []
    questions: list[str] = []
    checks = (
        _weight, _directions, _gears, _axle_gears, _locked, _free_wheels, _slips, _balance, _levels, _slope, _transfer,
        _sides, _yaw,
    )  # fmt: skip
    for check in checks:
        try:
            found = list(check(facts))
        except UndecidableError as reason:
            if not any(f.fatal for f in (*before, *findings)):  # else undecided because of the fault
                questions.append(str(reason))
            continue
        findings += found
        facts = facts.less(name for f in found for name in f.channels)
    if not any(f.fatal for f in (*before, *findings)):
        findings += _contradictions(facts, channels, database)
    return findings, questions


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
            f" vehicle.mass = {chassis.mass:g} kg: {_why_weight(measured / weight)}",
            abs(off) > LIMITS.weight,
            names if abs(off) > LIMITS.weight else (),
        )
        return
    if set(rig.front.tolist()) != {True, False}:
        return
    draft, acceleration = (np.where(np.isfinite(a), a, 0.0) for a in (window.draft, window.acceleration))
    due = [median(np.broadcast_to(a, window.t.shape)) for a in axle_loads(chassis, draft, pitch, acceleration)]
    has = [median(window.load @ ahead) for ahead in (rig.ahead, 1.0 - rig.ahead)]
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
    lag, block = _steps(facts)
    more = window.load @ (2.0 * rig.ahead - 1.0)
    rows = np.stack([change(more, lag), 2.0 * change(np.where(facts.straight, front, np.nan), lag)], axis=1)
    rows = rows[np.isfinite(rows).all(axis=1)]
    if len(rows) < 40 * block:
        return
    y, x = _blocks(rows, block).T
    lever = max(chassis.hitch_height, chassis.cg_height) / chassis.wheelbase
    if x.std() < LIMITS.excited * chassis.mass * GRAVITY * lever:
        return
    (share,), (sd,) = _regression(y, x[:, None])
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


def _why_weight(ratio: float) -> str:
    """The likely mistake if the loads are this multiple of the weight."""
    for factor, why in (
        (0.45359237, "is the mass in lb?"),
        (GRAVITY, "is the mass a weight, or are the loads taken for kg?"),
        (1.0 / GRAVITY, "are the loads in kg, not in N?"),
        (1e3, "are the loads in N where the DBC says kN?"),
        (1e-3, "are the loads in kN where the DBC says N?"),
        (2.0, "does each load cell read a whole axle?"),
        (0.5, "does a load cell read only half of its wheel's load?"),
    ):
        if _log_off(ratio / factor) < 0.04:
            return why
    return "which of them is wrong? (ballast, unit or scale of the loads)"


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
    """Rims of wheels that roll freely against the ground."""
    for i, wheel in enumerate(facts.rig.wheels):
        slip = median(facts.slip[:, i])
        if not next(w for w in facts.config.wheel if w.name == wheel).driven and abs(slip) > LIMITS.free:
            yield Finding(
                f"wheel.{wheel}: rolls freely, but its rim goes {1.0 / (1.0 - slip):.2f} times as fast as the ground:"
                " radius, or unit of its speed or of the ground speed?",
                True,
                (f"speed.{wheel}",),
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
    bin_length = facts.config.estimator.bin
    lag, block = _steps(facts)
    inertia = pull_given(window, chassis) - window.draft
    changes = np.stack([change(a, lag) for a in (thrust, window.draft, inertia)], axis=1)
    changes = changes[np.isfinite(changes).all(axis=1)]
    if len(changes) * bin_length < LIMITS.least_seconds:
        raise UndecidableError(
            "torques and draft are not known together: their signs and the gear ratio cannot be compared"
        )
    given, *asked = _blocks(changes, block).T
    if asked[0].std() < LIMITS.excited * weight:
        raise UndecidableError(
            "the draft hardly changes: the signs of draft and torque and the gear ratio cannot be decided"
        )
    (of_draft, of_inertia), (draft_sd, inertia_sd) = _regression(given, np.stack(asked, axis=1))
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
        why = (
            f"gear_ratio too {size}, torques measured at the other side of the gear (`at`), or their unit?"
            if of_torque
            else f"unit or scale of the draft, or gear_ratio too {size} (or torques at the other side of the gear)?"
        )
        yield Finding(
            f"the wheels' thrust changes {of_draft:.2f} times as much as the draft does: {why}",
            True,
            (*torques, "draft"),
        )
        return
    if of_inertia < -LIMITS.side_sd * inertia_sd:
        slope = _sd(change(window.pitch, lag)) * GRAVITY
        name = "pitch" if slope > _sd(change(window.acceleration, lag)) else "acceleration"
        positive = "nose up" if name == "pitch" else "where the vehicle speeds up"
        yield Finding(
            f"signals.{name}: asks for less thrust whenever the wheels give more: its sign (positive {positive};"
            " sign = -1)?",
            True,
            (name,),
        )


def _slope(facts: Facts) -> Iterator[Finding]:
    """Changes of the wheels' thrust against those of the slope alone."""
    window, chassis = facts.window, facts.rig.chassis
    if chassis is None or "pitch" not in facts.mapped or not np.isfinite(window.pitch).any():
        return
    weight, (lag, block) = chassis.mass * GRAVITY, _steps(facts)
    thrust, uphill = facts.thrust.sum(axis=1), weight * np.sin(window.pitch)
    rest = pull_given(window, chassis) - uphill
    rows = np.stack([change(a, lag) for a in (thrust, uphill, rest)], axis=1)
    rows = rows[np.isfinite(rows).all(axis=1)]
    if len(rows) < 40 * block or (x := _blocks(rows, block))[:, 1].std() < LIMITS.excited * weight:
        raise UndecidableError("the slope hardly changes: the sign of signals.pitch cannot be decided")
    (of_slope, _), (sd, _) = _regression(x[:, 0], x[:, 1:])
    if of_slope < -LIMITS.side_sd * sd:
        text = "signals.pitch: the wheels thrust less uphill: its sign (positive nose up; sign = -1)?"
        yield Finding(text, True, ("pitch",))


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


def _regression(y: Array, x: Array) -> tuple[Array, Array]:
    """Least-squares coefficients (K,) of y (N,) on the columns of x (N, K), and their standard deviations."""
    inverse = np.linalg.pinv(x.T @ x)
    factors = inverse @ x.T @ y
    residual_variance = float(((y - x @ factors) ** 2).sum()) / max(len(y) - x.shape[1], 1)
    return factors, np.sqrt(residual_variance * np.diag(inverse))


def _sides(facts: Facts) -> Iterator[Finding]:
    """Left and right wheel of each axle: the one with more load, or more slip, must have more torque."""
    rig, thrust, slip = facts.rig, facts.thrust, facts.slip
    for left, right in pairs(rig).T.tolist():
        names = rig.wheels[left], rig.wheels[right]
        y = thrust[:, left] - thrust[:, right]
        load = facts.window.load[:, left] - facts.window.load[:, right]
        x = np.stack([load, slip[:, left] - slip[:, right]], axis=1)
        known = np.isfinite(y) & np.isfinite(x).all(axis=1)
        per_block = max(round(0.5 / facts.config.estimator.bin), 1)
        if known.sum() < 40 * per_block:
            continue
        y, x = _blocks(y[known][:, None], per_block)[:, 0], _blocks(x[known], per_block)
        factors, sd = _regression(y, np.column_stack([x, np.ones(len(x))]))
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
        if abs(factors[2]) > LIMITS.side_offset * mean:
            yield Finding(
                f"the torques of {names[0]} and {names[1]} differ by {abs(factors[2]) / mean:.0%} of their mean all"
                " along: gear ratio, sign or scale of one of them?",
                False,
            )


def _steps(facts: Facts) -> tuple[int, int]:
    """Bins in the second over which changes are compared, and in the half second over which they are averaged."""
    bin_length = facts.config.estimator.bin
    return max(round(1.0 / bin_length), 1), max(round(0.5 / bin_length), 1)


def _sd(values: Array) -> float:
    """Standard deviation of what is known; 0 of nothing."""
    known = values[np.isfinite(values)]
    return float(known.std()) if len(known) else 0.0


def _blocks(values: Array, n: int) -> Array:
    """Means of each n rows."""
    whole = len(values) // n * n
    return np.asarray(values[:whole].reshape(-1, n, values.shape[1]).mean(axis=1))


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


def _contradictions(facts: Facts, channels: Iterable[Channel], database: Database) -> Iterator[Finding]:
    """Sensors that contradict the others in many windows, by the checks of `consistency`."""
    s, rig = facts.config.estimator, facts.rig
    key = {c.name: c.key for c in channels}
    resolution = {c.name: resolution_of(c, database) for c in channels}
    n = max(round(s.window / s.bin), 1)
    named: Counter[str] = Counter()
    mapped = np.array([f"motor_speed.{w}" in facts.mapped for w in rig.wheels])
    begins = range(0, max(len(facts.window.t) - n, 0) + 1, n)
    for begin in begins:
        rows = np.arange(begin, min(begin + n, len(facts.window.t)))
        motor = np.where(mapped, np.abs(facts.motor[rows]), np.nan)
        named.update(implausible(facts.window.rows(rows), rig, s.min_speed, s.max_turn, s.bin, resolution, motor))
    for name, count in named.items():
        if count > max(LIMITS.windows * len(begins), 1.0):
            text = f"{key.get(name, name)}: contradicts the other sensors in {count} of {len(begins)} windows"
            yield Finding(text, False, (name,))
