"""Frames in, windows of measured data out.

    CAN frames -> Admission (decode, refuse) -> Bins (outliers, means) -> SensorConsistency -> WindowTask
    window k covers [t0 + k hop, t0 + k hop + window)          t0: just before the first sample of a mapped channel

All times are the frames' stamps, so the same frames always give the same windows.  Delayed channels are aligned: all
others wait for the latest one.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from statistics import median
from typing import NamedTuple

import numpy as np
from cantools.database.can import Database

from soilbus.arrays import Array
from soilbus.can.admission import LONGEST_GAP, Admission
from soilbus.can.channels import Channel, Decoded
from soilbus.can.channels import Reason as Refusal
from soilbus.can.dbc_files import checked_messages
from soilbus.can.mapping import OPTIONAL_ROLES, POSITION_ROLES, channels_of
from soilbus.config.model import Config
from soilbus.decision.moments import Moment, moment_of
from soilbus.decision.options import WATCH
from soilbus.estimation.assembly import Motor, delays_of, motors_of, rig_of
from soilbus.estimation.instrumentation import completed
from soilbus.estimation.window import (
    VEHICLE_QUANTITIES,
    WHEEL_QUANTITIES,
    Rig,
    Window,
    forward,
    steady,
)
from soilbus.pipeline.corrections import NO_CORRECTIONS, Corrections
from soilbus.pipeline.positions import PositionTrack
from soilbus.sensors.bins import Bins
from soilbus.sensors.consistency import SensorConsistency, without
from soilbus.sensors.options import RECEPTION, ReceptionOptions
from soilbus.sensors.outliers import OUTLIER
from soilbus.sensors.rates import resolved_window
from soilbus.terra.vehicle import slip_ratio

EDGE_LEAD = 0.005
"""Bins begin this long before the first sample [s]: else each frame of its message would fall on
an edge, and a microsecond would decide on which side."""


@dataclass(frozen=True, slots=True)
class WindowTask:
    """One window's data and the quality of its inputs: everything an estimate needs.

    Attributes
    ----------
    index, epoch, fresh
        Number of the window since the start, number of restarts of the clock, and whether nothing may be carried over
        from the window before.
    start, end, late
        [s], and the delay [s] of the latest channel, for which all others wait.
    window, slip, track
        The forward data, mean slip by wheel (None where not known), positions from the window's middle on.
    missing, poor, implausible, untrusted
        Needed channels never received; needed channels that are stale at the end or silent too long; channels that
        contradict the others and were removed from the window; channels of a message with a second sender.
    torque_limit
        (W,) [N m], nan where not known.
    rejected
        Refused samples by reason.
    """

    index: int
    start: float
    end: float
    window: Window
    slip: dict[str, float | None]
    torque_limit: Array
    fresh: bool
    missing: tuple[str, ...] = ()
    poor: tuple[str, ...] = ()
    track: PositionTrack = field(default_factory=lambda: PositionTrack({}))
    rejected: dict[str, int] = field(default_factory=dict)
    implausible: tuple[str, ...] = ()
    untrusted: Mapping[str, str] = field(default_factory=dict)
    late: float = 0.0
    epoch: int = 0


class Latest(NamedTuple):
    """Means over the last `moment_span`: slip by wheel, what the watch reads, draft [N] and pitch [rad] as measured.

    None where not known.
    """

    slip: dict[str, float | None]
    moment: Moment | None = None
    draft: float | None = None
    pitch: float | None = None


@dataclass(slots=True)
class Refusals:
    """Refused samples by reason, kept while a window may contain them; `used` counts the accepted samples."""

    entries: list[tuple[str, Array]] = field(default_factory=list)
    total: Counter[str] = field(default_factory=Counter)
    used: int = 0

    @property
    def refused(self) -> int:
        """Samples refused since the start, for any reason."""
        return sum(self.total.values())

    def add(self, decoded: Decoded) -> None:
        """Count what was used and refused of one batch of frames."""
        self.used += sum(len(column.t) for column in decoded.columns.values())
        for (_, reason), times in decoded.refused.items():
            self._note(str(reason), times)
        for reason, n in decoded.untimed.items():
            self.total[str(reason)] += n

    def note_outliers(self, times: Array) -> None:
        """Count samples as refused that were counted as used before they were found to be outliers."""
        self._note(OUTLIER, times)
        self.used -= len(times)

    def _note(self, reason: str, times: Array) -> None:
        if len(times):
            self.entries.append((reason, times))
            self.total[reason] += len(times)

    def within(self, start: float, end: float) -> dict[str, int]:
        """Return the counts by reason from start to end [s]; older ones are dropped."""
        self.entries = [(r, t) for r, t in self.entries if t[-1] >= start]
        counts: Counter[str] = Counter()
        for reason, t in self.entries:
            counts[reason] += int(np.count_nonzero((t >= start) & (t < end)))
        return {r: n for r, n in sorted(counts.items()) if n}


class ReportedLimits:
    """Torque limit [N m] of each motor (W,): as reported, else as configured, else nan.

    The median of the last samples holds until another one is reported, also through silence and a set clock.  A motor
    of several wheels gives each the share that `Motor.share` says; a wheel that is not driven has the limit 0, one of
    several motors that of the last with a limit.
    """

    def __init__(self, config: Config, rig: Rig, samples: int = RECEPTION.limit_samples) -> None:
        self._motors, self._driven, self._samples = motors_of(config, rig), rig.drives, samples
        self._names = {motor.name for motor in self._motors}
        self._reported: dict[str, tuple[Array, Array]] = {}

    def add(self, name: str, t: Array, value: Array) -> None:
        """Add samples [N m] (N,) of the motor of a wheel or axle at the times t [s]."""
        if name in self._names:
            old_t, old = self._reported.get(name, (t[:0], value[:0]))
            self._reported[name] = np.concatenate([old_t, t]), np.concatenate([old, value])

    def at(self, t: float) -> Array:
        """Return the limits (W,) in force at the time t [s]."""
        out = np.where(self._driven, np.nan, 0.0)
        for motor in self._motors:
            limit = self._of(motor, t)
            if math.isfinite(limit):
                out[list(motor.wheels)] = limit * np.array(motor.share)
        return out

    def _of(self, motor: Motor, now: float) -> float:
        t, value = self._reported.get(motor.name, (np.empty(0), np.empty(0)))
        last = value[t <= now][-self._samples :]
        return median(last.tolist()) if len(last) else motor.max_torque

    def drop_before(self, end: float) -> None:
        """Forget samples that are no longer among the last ones at the time `end` [s]."""
        for wheel, (t, value) in self._reported.items():
            first = max(int(np.count_nonzero(t <= end)) - self._samples, 0)
            self._reported[wheel] = t[first:], value[first:]

    def forget_times(self) -> None:
        """Treat what was reported as earlier than all that follows, as the clock was set."""
        self._reported = {wheel: (np.full(len(t), -math.inf), value) for wheel, (t, value) in self._reported.items()}


class Intake:
    """Decoding, bins and freshness of one vehicle's channels; ConfigError where configuration and database do not fit.

    Channels are aligned by delaying all others to the latest one, by their `delay` and `delays` [s] by quantity (None:
    those of the configured effects).  So a window is complete, and its data are older than its end by that delay.
    Freshness goes by the stamps of the frames.
    """

    def __init__(
        self,
        config: Config,
        database: Database,
        delays: Mapping[str, float] | None = None,
        options: ReceptionOptions = RECEPTION,
    ) -> None:
        self.config, self._database, self._delays, self._options = config, database, delays, options
        self.channels = channels_of(config, database)
        self.admission = Admission(self.channels, database, checked_messages(config, database))
        self.rig = rig_of(config)
        self._binned = frozenset(self.rig.channels)
        self.refusals = Refusals()
        self.needed = tuple(c for c in self.channels if self._is_needed(c))
        self._of_position = {c.name: self._timeout(c) for c in self.channels if c.quantity in POSITION_ROLES}
        self._positions = PositionTrack(self._of_position, options.timeout)
        of_effects = delays_of(config) if delays is None else delays
        late = {c.name: c.delay + of_effects.get(c.quantity, 0.0) for c in self.channels}
        self._latest = max([0.0, *late.values()])
        self._waits = {name: self._latest - delay for name, delay in late.items() if self._latest != delay}
        self._settings = config.estimator
        self._limits = ReportedLimits(config, self.rig, options.limit_samples)
        self.ended = 0
        """Windows that have ended since the start, and restarts of the clock."""
        self.epoch = 0
        self._silent_hops = LONGEST_GAP / config.estimator.hop  # that may still end windows
        self._ready: list[WindowTask] = []
        self._bins: Bins | None = None
        self._restart()
        self.admission.at_break = self.begin_recording

    def of_another_recording(self) -> Intake:
        """Return a new intake without data, which continues the counts of windows, frames and refusals."""
        other = Intake(self.config, self._database, self._delays, self._options)
        other.admission.counts, other.ended = self.admission.counts, self.ended
        other.refusals.total, other.refusals.used = self.refusals.total, self.refusals.used
        return other

    def _timeout(self, channel: Channel) -> float:
        return channel.timeout or self._options.timeout

    def _is_needed(self, channel: Channel) -> bool:
        if channel.wheel:
            return channel.name in self._binned and channel.quantity in ("torque", "speed", "load")
        return channel.quantity not in OPTIONAL_ROLES

    def begin_recording(self) -> None:
        """Begin another recording: the clock was set, or the bus was silent for long."""
        ready = self.finish(self.admission.newest)
        self._restart()
        self._ready = ready

    def _restart(self) -> None:
        self.epoch += 1  # nothing of the previous epoch may be carried over
        self._bins = None
        self._fresh = True
        self._positions.forget()
        self._consistency = SensorConsistency(self.rig, self.channels, self._database, self._settings)
        self._limits.forget_times()
        self._implausible: tuple[str, ...] = ()
        self.next_end = math.inf
        self.last_seen: dict[str, float] = {}
        self._last_refused: dict[str, tuple[float, str]] = {}
        self._last_untrusted: dict[str, float] = {}
        self._newest = -math.inf  # stamp of the latest sample, admitted or refused

    def _screen_the_rest(self) -> None:
        """Count the outliers after the last window."""
        if self._bins is not None:
            self._bins.window(self._newest, self._newest + self._bins.bin_length)
            self.refusals.note_outliers(self._bins.new_outliers())

    def ingest(self, until: float = math.inf) -> None:
        """Decode the received frames that are older than `until` [s] and put them into bins."""
        self.add(self.admission.take(until))

    def add(self, decoded: Decoded) -> None:
        """Put decoded samples into bins; `ingest` calls it with the received frames."""
        self.refusals.add(decoded)
        ends = [(c.t[0], c.t[-1]) for c in decoded.columns.values() if len(c.t)]
        ends += [(known.min(), known.max()) for t in decoded.refused.values() if len(known := t[np.isfinite(t)])]
        if ends:
            self._newest = max(self._newest, *(float(last) for _, last in ends))
            if self._bins is None:
                begin = float(min(first for first, _ in ends)) - EDGE_LEAD
                self._bins = Bins(self.rig, self._settings.bin, begin, self._options)
                self.next_end = begin + self._settings.window
        heard = {name: (c.t, c.value) for name, c in decoded.columns.items() if len(c.t)}
        self.last_seen |= {name: float(t[-1]) for name, (t, _) in heard.items()}
        for (name, reason), t in decoded.refused.items():
            self._last_refused[name] = max(self._last_refused.get(name, (-math.inf, "")), (float(t[-1]), str(reason)))
            if reason is Refusal.SECOND_SENDER and name not in self._of_position:
                self._last_untrusted[name] = float(t[-1])
        for name, (t, value) in heard.items():
            if name.startswith("torque_limit."):
                self._limits.add(name.removeprefix("torque_limit."), t, value)
        self._positions.add(heard)
        for name in heard.keys() & self._waits.keys():
            t, value = heard[name]
            heard[name] = t + self._waits[name], value
        self._consistency.add(heard)
        if self._bins is not None:
            self._bins.add({name: samples for name, samples in heard.items() if name in self._binned})

    def due(self, now: float) -> list[WindowTask]:
        """Return all windows that ended at or before `now` [s] and were not returned yet.

        Hops without any sample end windows for LONGEST_GAP in all; each hop with samples earns one more.  So a log of
        short bursts far apart makes at most two windows a burst.
        """
        tasks, self._ready = self._ready, []
        if self._bins is None:
            self.ingest(now)
        while self._bins is not None and self.next_end <= now:
            self.ingest(self.next_end)
            if self.next_end - self._newest > LONGEST_GAP:
                self._screen_the_rest()
                self._restart()
                break
            is_heard = self.next_end - self._newest <= self._settings.hop
            if is_heard or self._silent_hops >= 1.0:
                tasks.append(self._task(self._bins, self.next_end))
            change = 1.0 if is_heard else -1.0
            self._silent_hops = min(max(self._silent_hops + change, 0.0), LONGEST_GAP / self._settings.hop)
            self.next_end += self._settings.hop
        return tasks

    def finish(self, now: float) -> list[WindowTask]:
        """Return the windows still open at the end of a recording that lasts until `now` [s]."""
        tasks = self.due(now)
        self.ingest(math.inf)
        tasks += self.due(now)
        self._screen_the_rest()
        return tasks

    def taken_whole(self) -> Window | None:
        """Return all data since the clock was last set as one window, and begin another recording.

        The bins are as short as the recording's spectrum asks for (see `sensors.rates`); the unfinished one is left
        out.  None without samples.
        """
        bins, end = self._bins, max(self.last_seen.values(), default=-math.inf)
        window = None
        if bins is not None and end - bins.origin >= bins.bin_length:
            end = bins.origin + math.floor((end - bins.origin) / bins.bin_length) * bins.bin_length
            window = forward(resolved_window(bins, end))
            self.refusals.note_outliers(bins.new_outliers())
        self._restart()
        return window

    def _task(self, bins: Bins, end: float) -> WindowTask:
        start = end - self._settings.window
        raw, self._implausible = self._consistency.checked(forward(bins.window(start, end)))
        window = completed(raw, self.rig)
        self.refusals.note_outliers(bins.new_outliers())
        missing = [c.name for c in self.needed if c.name not in self.last_seen]
        missing += ["ground_speed"] if self.config.signals.ground_speed is None else []
        missing += [] if self.rig.wheels else ["wheels"]
        longest = self._options.timeout
        silent = dict(zip(self.rig.channels, silences(raw, longest / 2.0), strict=True))
        stale = self.stale(end)
        poor = [c.name for c in self.needed if c.name in stale or silent[c.name] >= longest]
        task = WindowTask(
            index=self.ended,
            start=start,
            end=end,
            window=window,
            slip=self._slip(window),
            missing=tuple(missing),
            poor=tuple(poor),
            torque_limit=self._limits.at(end),
            track=self._positions.copy(),
            rejected=self.refusals.within(start, end),
            fresh=self._fresh,
            late=self._latest,
            implausible=self._implausible,
            untrusted=self.untrusted(start),
            epoch=self.epoch,
        )
        self._fresh = False
        self.ended += 1
        bins.drop_before(start + self._settings.hop)
        self._positions.drop_before((start + end) / 2.0 + self._settings.hop)
        self._consistency.drop_before(start + self._settings.hop)
        self._limits.drop_before(end)
        return task

    def stale(self, now: float, since: float = -math.inf) -> list[str]:
        """Return the names of needed channels without an accepted sample within their time-out before `now` [s].

        A channel without any sample yet is stale when its time-out has passed after `since` [s].
        """
        return [
            c.name
            for c in self.needed
            if not now - self.last_seen.get(c.name, since) <= self._timeout(c)  # nor nan
        ]

    def untrusted(self, since: float) -> dict[str, str]:
        """Return channels with a sample refused for a second sender since `since` [s], and why; no positions."""
        return {name: str(Refusal.SECOND_SENDER) for name, t in self._last_untrusted.items() if t >= since}

    def refused(self, now: float) -> dict[str, str]:
        """Return the needed channels with a refused sample within their time-out before `now` [s], and why."""
        return {
            c.name: self._last_refused[c.name][1]
            for c in self.needed
            if c.name in self._last_refused and now - self._last_refused[c.name][0] <= self._timeout(c)
        }

    def latest(self, now: float, corrections: Corrections = NO_CORRECTIONS) -> Latest:
        """Return the slip, moment, draft and pitch over the last `moment_span` before `now` [s].

        corrections: of the last window.  Pitch and acceleration may be as old as the time-out of a channel.
        """
        if self._bins is None or not abs(now - self._newest) <= LONGEST_GAP:  # nor nan: no bins for years of silence
            return Latest(dict.fromkeys(self.rig.wheels))
        last = math.floor((now - self._bins.origin) / self._settings.bin) * self._settings.bin + self._bins.origin
        raw = without(self._bins.glimpse(last - self._options.timeout, last), self.rig, set(self._implausible))
        measured, start = completed(forward(raw), self.rig), last - WATCH.moment_span
        recent = np.flatnonzero(measured.t > start)
        window, measured = corrections.corrected(steady(measured), self.rig).rows(recent), measured.rows(recent)
        if self.rig.chassis is None:
            return Latest(self._slip(window))
        limit = corrections.torque_limit(self._limits.at(now))
        moment = moment_of(window, self.rig, limit, self.config)
        draft, pitch = column_means(np.column_stack((measured.draft, measured.pitch)))
        return Latest(self._slip(window), moment, draft, pitch)

    def _slip(self, window: Window) -> dict[str, float | None]:
        ground = window.ground_speed[:, None]
        slip = slip_ratio(self.rig.radius, window.speed, ground)
        slip = np.where((ground > self._settings.min_speed) & (slip > -1.0), slip, np.nan)
        if self.rig.instrumentation is not None:
            slip[:, self.rig.instrumentation.without_speed] = np.nan  # their speed is assumed
        return dict(zip(self.rig.wheels, column_means(slip), strict=True))


def input_rejected(refused: Mapping[str, str]) -> str:
    """Return the reason of a status for refused channels, each with why it is refused."""
    return " ".join(["input_rejected", *(f"{name} ({why})" for name, why in refused.items())])


def column_means(rows: Array) -> list[float | None]:
    """Return the mean of each column of (N, W) over its finite entries; None for a column without any."""
    known = np.isfinite(rows)
    count = known.sum(0)
    total = np.where(known, rows, 0.0).sum(0)
    return [float(s / n) if n else None for s, n in zip(total, count, strict=True)]


def silences(window: Window, block: float) -> list[float]:
    """Return the time [s] of a window's blocks of this length [s] without a sample, by channel of the rig."""
    known = np.isfinite(np.column_stack([getattr(window, q) for q in (*WHEEL_QUANTITIES, *VEHICLE_QUANTITIES)]))
    if len(known) < 2:
        return [math.inf] * known.shape[1]
    number = ((window.t - window.t[0]) / block + 1e-6).astype(int)
    heard = np.logical_or.reduceat(known, np.flatnonzero(np.diff(number, prepend=-1)))
    silent: list[float] = (block * (number[-1] + 1 - heard.sum(axis=0))).tolist()
    return silent
