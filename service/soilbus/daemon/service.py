"""The daemon's loop: receive, admit, publish; a worker thread estimates beside it.

    every round    receive frames until the next tick -> intake
                   windows that have ended -> work queue -> worker -> results -> SoilStrength ... frames
    every tick     (10 Hz) wheel slip, immobilisation watch, decision -> frames; state, watchdog, state store

No step of the loop waits for the estimator. The decision that goes out is valid only while inputs are fresh and no
interruption (silent bus, stale input, foreign sender, fault) came after the last of the data that it rests on.
"""

from __future__ import annotations

import logging
import math
import time
from collections import Counter
from collections.abc import Callable, Mapping
from concurrent.futures import Executor, Future
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from soilbus import __version__
from soilbus.can.admission import RecentDoubts
from soilbus.can.bus import SAY_AGAIN, BusState, LiveBus
from soilbus.can.publish import Publisher
from soilbus.config.model import Config
from soilbus.daemon.bus_health import health_frame, health_text
from soilbus.daemon.bus_time import BusTime
from soilbus.daemon.exception_guard import INTERNAL, GuardedEstimator
from soilbus.daemon.health import Health
from soilbus.daemon.notify import Notifier
from soilbus.daemon.tick_phase import next_tick
from soilbus.daemon.totals import totals
from soilbus.daemon.work_queue import WorkQueue, wait_for
from soilbus.decision.judgement import Basis, at_present
from soilbus.decision.traversability import State, Status, Traversability
from soilbus.decision.watch import Alert, Watch, curve_age, ended, seen_at, watched
from soilbus.pipeline.corrections import NO_CORRECTIONS
from soilbus.pipeline.intake import Latest, input_rejected
from soilbus.pipeline.outputs import TICK, WINDOW_MODULUS, demand_frame, forecast_frame, hop_frames, slip_frames
from soilbus.pipeline.pipeline import Pipeline
from soilbus.pipeline.result import WindowResult, as_of
from soilbus.pipeline.states import ServiceState, state_after

if TYPE_CHECKING:
    from soilbus.daemon.address_claim import AddressClaim
    from soilbus.daemon.state_persistence import StatePersistence
    from soilbus.decision.capability import OverSlip
    from soilbus.estimation.gaussian import Gaussian
    from soilbus.pipeline.estimator import WindowEstimator

log = logging.getLogger(__name__)

SILENCE_TIME = 1.0
"""Time [s] without any frame after which the bus counts as silent."""
MAX_FRAMES_PER_ROUND = 4000
"""Frames taken in one round before the loop reads its clock again."""
MAX_WAIT, MAX_WAIT_WHILE_SOLVING = 0.02, 0.003
"""Longest wait for a frame [s]; the second one while the worker has a window, whose result may come any moment."""
UNDISTURBED_TIME, UNDISTURBED_TIME_LARGE_BUFFER = 0.04, 0.08
"""Time [s] for which frames stay with the kernel after the worker got a window: loop and worker share one interpreter,
and each frame taken halts the worker. The second one where the kernel's buffer holds seconds of frames; its default
holds 75 ms of a full bus."""
FOREIGN_SENDER_HOLD_TIME = 3.0
"""Time [s] for which a second sender of our frames or of an input is reported, so that every reader sees it."""


class Service:
    """Service of one vehicle on one bus; `step` makes one round and returns, `run` repeats it until `stop`.

    The bus may open later. `workers` is one thread, which estimates; `waiting` waits for its future, for at most the
    seconds given. Stamps of frames only space the samples, the clock [s] is monotonic. `on_window` is called with each
    window's result, `open_persistence` in the worker before the first window: it returns the stored state of the last
    run, or None. The claim is of our source address; None where [j1939] asks for none.
    """

    def __init__(
        self,
        config: Config,
        pipeline: Pipeline,
        bus: LiveBus,
        publisher: Publisher,
        notifier: Notifier,
        workers: Executor,
        clock: Callable[[], float] = time.monotonic,
        on_window: Callable[[WindowResult], None] | None = None,
        open_persistence: Callable[[], StatePersistence | None] = lambda: None,
        waiting: Callable[[Future[WindowResult], float], None] = wait_for,
        claim: AddressClaim | None = None,
    ) -> None:
        self.config, self.bus, self.publisher = config, bus, publisher
        self.intake = pipeline.intake
        self._pipeline, self._open_persistence = pipeline, open_persistence
        self._guarded_estimator = GuardedEstimator(self._first_estimator, pipeline.new_estimator)
        self._persistence: StatePersistence | None = None
        self.notifier, self.clock, self.on_window = notifier, clock, on_window
        self._claim, self._claimed_after = claim, bus.counts.reopened
        self.result: WindowResult | None = None
        self.deadline_misses = 0
        self.failures: Counter[str] = Counter()
        """Failed solves by kind, since the start."""
        self._watch = Watch()
        self._curve: tuple[OverSlip | None, float] = None, -math.inf
        self._stopping = False
        self._started = clock()
        self._work_queue = WorkQueue(workers, self._guarded_estimator.solve, self._started, waiting)
        workers.submit(
            lambda: self._guarded_estimator.estimator
        )  # where it raises, the first window does again, and says so
        self._ended = -math.inf  # monotonic time of the end of the present result's window
        self._reached = -math.inf  # monotonic time of the last of its data
        self._interrupted = self._started  # monotonic time at which inputs failed last
        self._epoch = self.intake.epoch
        self._inputs_since = -math.inf  # bus time since which inputs come in this epoch; -inf while there are none
        self._time = BusTime(bus, self._started)
        self._handed_out = -math.inf  # monotonic time at which the worker got a window last
        self._next_tick = self._started
        self._due = dict.fromkeys(("SoilbusStatus", "SoilbusIdentity", "BusHealth"), self._started)
        self._counted = 0, 0  # samples refused, samples received until the last status
        self._lost = bus.counts.lost
        self._next_watchdog = self._started
        self._health, self._fault = Health(self._started), ""
        self._state: tuple[ServiceState, str] = (ServiceState.STARTING, "none")
        self._failing = "none"
        self._doubts = RecentDoubts(self.intake.admission.counts)
        self._said: dict[str, float] = {}

    def _first_estimator(self) -> WindowEstimator:
        """In the worker: the estimator, with the posterior of the last run as its prior where one is stored."""
        estimator, persistence = self._pipeline.estimator, self._open_persistence()
        if persistence is not None and persistence.stored_prior is not None:
            estimator.tracker.start_from_last_run(*persistence.stored_prior)
        self._persistence = persistence
        return estimator

    @property
    def windows(self) -> int:
        """Number of windows solved since the start."""
        return self._work_queue.solved

    @property
    def newest_posterior(self) -> Gaussian | None:
        """Posterior from which the next window's prior comes; None before there is one."""
        return self._guarded_estimator.newest

    def stop(self) -> None:
        """Let `run` return after the present round; safe to call from a signal handler."""
        self._stopping = True

    def run(self) -> None:
        """Work until `stop`, then send one last decision "unknown"."""
        self.notifier.ready("starting")
        while not self._stopping:
            self.step()
        self.notifier.stopping()
        self.result = None
        self._publish_ten_hertz(self.clock())
        self._work_queue.close()
        self.bus.close()
        if self._persistence is not None:
            self._persistence.close(self.newest_posterior, self._totals())
        if self._claim is not None:
            self._claim.close()

    def step(self) -> None:
        """Receive until the next tick, then hand out, collect and publish what is due."""
        self._receive()
        if self._claim is not None:
            self._keep_address(self._claim)
        now = self.clock()
        if self.bus.is_open:
            self._hand_out(now)
        self._collect(now)
        if now >= self._next_tick:
            if now - self._next_tick > TICK:
                self.deadline_misses += 1
            window_ends = now + self.intake.next_end - self._time.present(now)
            self._next_tick = max(next_tick(self._next_tick, window_ends), now - TICK)
            self._tick(now)

    def _keep_address(self, claim: AddressClaim) -> None:
        if self.bus.counts.reopened != self._claimed_after:
            self._claimed_after = self.bus.counts.reopened
            claim.begin()
        for frame in claim.outgoing():
            self.bus.send(frame)

    def _receive(self) -> None:
        claim = self._claim
        feed, longest, now = self.intake.admission.feed, MAX_WAIT, self.clock()
        if self._work_queue and self.bus.is_open:
            undisturbed = UNDISTURBED_TIME_LARGE_BUFFER if self.bus.holds_seconds else UNDISTURBED_TIME
            self._work_queue.wait(min(self._next_tick, self._handed_out + undisturbed) - now)
            longest, now = MAX_WAIT_WHILE_SOLVING, self.clock()
        for _ in range(MAX_FRAMES_PER_ROUND):
            if self._work_queue.has_result:
                return
            wait = min(self._next_tick - now, self._time.wait(self.intake.next_end, now, longest))
            message = self.bus.receive(max(0.0, wait))
            if message is None:
                if self.bus.found_nothing:
                    self._time.took_nothing(self.clock())
                return
            now = self.clock()
            if self._time.set_ahead(message.timestamp, now):
                self.intake.begin_recording()
            feed(
                message.timestamp,
                message.arbitration_id,
                message.is_extended_id,
                message.data,
                message.is_remote_frame,
            )
            if claim is not None:
                claim.hear(message.timestamp, message.arbitration_id, message.is_extended_id, message.data)
            self._time.took(message.timestamp, now)
            if message.timestamp >= self.intake.next_end or now >= self._next_tick:
                return

    def _hand_out(self, now: float) -> None:
        """Put the windows that have ended into the work queue; it drops what the worker cannot keep up with."""
        for task in self.intake.due(self._time.heard(self.intake.next_end, now)):
            ended = now - max(0.0, self._time.at(now) - task.end)
            self.deadline_misses += self._work_queue.add(task, ended, task.epoch, now)
            self._handed_out = now

    def _collect(self, now: float) -> None:
        """Publish the windows that are solved, in their order."""
        for result, pending in self._work_queue.results(now):
            if result.failure is not None:
                self.failures[result.failure] += 1
            if pending.epoch == self.intake.epoch:  # else it is of a time that is none any more
                self._take(result, pending.at)
                present = as_of(self._vouched(result, pending.at, now), self._watch, result.t, self.config)
                for message, values in hop_frames(present):
                    self._send(message, values)
            if self.on_window is not None:
                self.on_window(result)

    def _send(self, message: str, values: Mapping[str, Any]) -> None:
        """One of our frames, unless our address is not ours."""
        if self._claim is None or self._claim.holds:
            self.bus.send(self.publisher.frame(message, values))

    def _vouched(self, result: WindowResult, ended: float, now: float) -> WindowResult:
        """The result as it may go out: valid only if it is young and no input has failed since the last of its data."""
        is_old = not self._time.at(now) - result.basis.end <= self.config.traversability.max_age  # nor nan
        is_over = _reached(result, ended) <= self._interrupted or self._interruption(now) is not None
        if result.status is Status.VALID and (is_old or is_over):
            return replace(result, status=Status.DEGRADED)
        return result

    def _take(self, result: WindowResult, ended: float) -> None:
        if result.gaps and not (self.result is not None and self.result.gaps):
            shown = ", ".join(f"{channel} {100.0 * share:.0f} %" for channel, share in result.gaps.items())
            log.warning(
                "model_gap: for minutes the model has predicted %s off; "
                "record a drive with candump -l and run: soilbus diagnose --config F LOG", shown,
            )  # fmt: skip
        if _first_word(result.reason) == "implausible" and (self.result is None or self.result.reason != result.reason):
            log.warning("%s: contradicts the other sensors, not used in this window", result.reason)
        last_failure = None if self.result is None else self.result.failure
        if result.termination is not None and result.failure not in (None, last_failure):
            log.warning("%s: solver ended by %s (%d)", result.failure, result.termination, result.iterations)
        self.result, self._ended, self._reached = result, ended, _reached(result, ended)
        if result.curve is not None:
            self._curve = result.curve, result.t

    def _tick(self, now: float) -> None:
        if self.bus.is_open:
            self.intake.ingest()
        if self.intake.epoch != self._epoch:
            self._epoch, self.result, self._watch, self._curve = self.intake.epoch, None, Watch(), (None, -math.inf)
            self._inputs_since = -math.inf
        if self._is_silent(now):
            self._inputs_since = -math.inf
        elif math.isinf(self._inputs_since):
            self._inputs_since = self._time.at(now)
        self._look_after_health(now)
        self._state = self._present_state(now)
        interruption = self._interruption(now)
        self._note_failing(interruption, now)
        if interruption is not None or self.bus.counts.lost != self._lost:
            self._interrupted, self._lost = now, self.bus.counts.lost
        self._publish_ten_hertz(now)
        for message, due in self._due.items():
            if now >= due:
                self._due[message] = max(due + self.publisher.schedule[message], now)
                self._publish_slow(message, now)
        interval = self.notifier.watchdog_interval
        if interval is not None and now >= self._next_watchdog and not self._fault:
            self._next_watchdog = now + interval
            self.notifier.watchdog()
        if self._persistence is not None:
            self._persistence.tick(now, self.newest_posterior, self._totals)

    def _look_after_health(self, now: float) -> None:
        hears = self.bus.is_open and now - self._time.last_frame <= SILENCE_TIME
        hears = hears and not (self._claim is not None and self._claim.is_lost)  # a restart would not win it back
        fault = self._health.fault(now, self._work_queue.solving_since, hears, self.bus.counts.sent) or ""
        if fault and fault != self._fault:
            log.error("fault: %s; systemd no longer hears that all is well", fault)
        self._fault = fault

    def _totals(self) -> dict[str, int]:
        return totals(
            self.windows, self.deadline_misses, self.failures, self.bus.counts, self.intake.admission.counts
        )  # fmt: skip

    def _is_silent(self, now: float) -> bool:
        return now - self._time.last_frame > SILENCE_TIME

    def _interruption(self, now: float) -> tuple[ServiceState, str] | None:
        """What ends, at this moment, the validity of every window that ended before; None where nothing does."""
        if not self.bus.is_open:
            return ServiceState.WAITING, "bus_down"
        if self.bus.state is BusState.OFF:
            return ServiceState.WAITING, f"bus_error {self.bus.state}"
        if self._is_silent(now):
            return ServiceState.LISTENING, "no_frames"
        read = self._time.read_until(now)
        if stale := self.intake.stale(read, self._inputs_since):
            return ServiceState.DEGRADED, self._why_stale(stale, read)
        if untrusted := self.intake.untrusted(read - FOREIGN_SENDER_HOLD_TIME):
            return ServiceState.DEGRADED, input_rejected(untrusted)
        if self._fault or self._guarded_estimator.in_fault:
            return ServiceState.FAULT, self._fault or INTERNAL
        if now - self.bus.last_foreign < FOREIGN_SENDER_HOLD_TIME:
            return ServiceState.DEGRADED, "foreign_sender"
        present = self._time.at(now)
        if self.intake.stale(present, self._inputs_since):
            return ServiceState.DEGRADED, f"overload frames are taken {present - read:.1f} s late"
        return None

    def _note_failing(self, interruption: tuple[ServiceState, str] | None, now: float) -> None:
        """Into the journal: the inputs that fail first, each once in a while, and frames that are taken late.

        What the bus, its controller, another sender and a fault do is said where it is found.
        """
        state, reason = interruption or (ServiceState.VALID, "none")
        if state in (ServiceState.WAITING, ServiceState.FAULT) or reason == "foreign_sender":
            reason = "none"
        kind, *what = reason.split()
        if kind == self._failing or not self.intake.last_seen:
            return
        self._failing = kind
        first = " ".join((kind, *what[:1]))
        if kind != "none" and now - self._said.get(first, -math.inf) >= SAY_AGAIN:
            self._said[first] = now
            log.warning("%s: no decision while it lasts", reason)

    def _present_state(self, now: float) -> tuple[ServiceState, str]:
        if (interruption := self._interruption(now)) is not None:
            return interruption
        ended = self._work_queue.oldest_end
        if ended is not None and now - ended > self.config.traversability.max_age:
            return ServiceState.DEGRADED, f"overload a window is not solved {now - ended:.1f} s after its end"
        result = self._last
        if result is None:
            return ServiceState.ESTIMATING, "none"
        reason = result.reason
        if result.gaps and reason.split()[0] in ("none", "model_mismatch"):
            reason = "model_gap " + " ".join(result.gaps)
        if reason == "none" and self.bus.state is BusState.PASSIVE:
            reason = f"bus_error {self.bus.state}"
        return state_after(result), reason

    def _why_stale(self, stale: list[str], read: float) -> str:
        """Reason for channels that are stale at the bus time `read`: silent from the start, silent now, or refused."""
        refused = self.intake.refused(read)
        silent = [name for name in stale if name not in refused]
        if never := [name for name in silent if name not in self.intake.last_seen]:
            return "input_missing " + " ".join(never)
        if silent:
            return "input_stale " + " ".join(silent)
        return input_rejected({name: refused[name] for name in stale})

    @property
    def _last(self) -> WindowResult | None:
        """The last window's result; None until a window has data from after the last interruption."""
        return None if self._reached <= self._interrupted else self.result

    def present_decision(self, now: float) -> Traversability:
        """Return the decision of the last window, judged at `now` [s].

        It is unknown while an input is stale or a fault holds, and until a window has data from after the last
        interruption.
        """
        if self._interruption(now) is not None:
            return Traversability()
        result = self._last
        decision, basis = (Traversability(), Basis()) if result is None else (result.traversability, result.basis)
        return at_present(decision, basis, self._watch, self._present_time(now), self.config)

    def _present_time(self, now: float) -> float:
        """The bus's time, or that of the last window's end and ours since, whichever is later: the stamps' may halt."""
        by_stamps = self._time.at(now)
        if self.result is None or math.isnan(by_stamps):
            return by_stamps
        return max(by_stamps, self.result.t + now - self._ended)

    def _present_curve(self, now: float) -> OverSlip | None:
        """Pull over slip of the last window that had one, while it is young enough to extrapolate from."""
        known, t = self._curve
        return known if self._time.at(now) - t < curve_age(self.config) else None

    def _age(self, now: float) -> float:
        """Of the data that the decision rests on [s]."""
        return math.inf if self.result is None else self._present_time(now) - self.result.basis.end

    def _since_valid(self, now: float) -> float | None:
        """Time [s] since the last valid posterior; None where there was none in this epoch."""
        if self.result is None or self.result.traversability.since_valid is None:
            return None
        return self.result.traversability.since_valid + max(self._present_time(now) - self.result.t, 0.0)

    def _publish_ten_hertz(self, now: float) -> None:
        corrections = NO_CORRECTIONS if self._last is None else self._last.corrections
        latest = self.intake.latest(self._time.at(now), corrections) if self.bus.is_open else Latest({})
        if latest.moment is not None:
            self._watch = watched(self._watch, latest.moment, self._present_curve(now), self.config)
        self._watch = seen_at(self._watch, self._time.at(now), self.config)
        decision = self.present_decision(now)
        if decision.state is State.GO and self._watch.warning is Alert.IMMOBILISATION:
            self._watch = ended(self._watch, self.config)
        known = decision.state is not State.UNKNOWN
        window = self.result.index % WINDOW_MODULUS if self.result is not None else None
        for message, values in slip_frames(latest.slip):
            self._send(message, values)
        foreseeable = self.result if known and not self._watch.stuck else None
        self._send(*forecast_frame(foreseeable, self._watch))
        self._send(*demand_frame(latest.draft, latest.pitch))
        self._send(
            "Traversability",
            {
                "State": str(decision.state),
                "LimitingCause": decision.limit if known else None,
                "Probability": decision.probability if known else None,
                "Age": max(age, 0.0) if math.isfinite(age := self._age(now)) else None,
                "SinceValid": self._since_valid(now),
                "Window": window,
            },
        )
        self._send(
            "TorqueDemand",
            {
                "TorqueRequired": decision.torque_required if known else None,
                "TorqueAvailable": decision.torque_available if known else None,
                "Window": window,
            },
        )

    def _rejected_share(self) -> float | None:
        """Share [%] of the input samples since the last call that were refused; None where there were none.

        An outlier is refused up to a hop after it came.
        """
        refusals = self.intake.refusals
        counts = refusals.refused, refusals.refused + refusals.used
        refused, received = (n - before for n, before in zip(counts, self._counted, strict=True))
        self._counted = counts
        return 100.0 * min(refused / received, 1.0) if received else None

    def _publish_slow(self, message: str, now: float) -> None:
        state, reason = self._state
        if message == "SoilbusIdentity":
            major, minor, patch = software_version()
            values = {
                "VersionMajor": major, "VersionMinor": minor, "VersionPatch": patch, "Uptime": now - self._started,
            }  # fmt: skip
            self._send(message, values)
            return
        if message == "BusHealth":
            self._send(*health_frame(self.bus.state, self.bus.counts))
            return
        self._send(
            message,
            {
                "State": str(state),
                "Reason": _first_word(reason),
                "RejectedShare": self._rejected_share(),
                "DeadlineMisses": self.deadline_misses,
                "Window": self.result.index % WINDOW_MODULUS if self.result is not None else None,
            },
        )
        text = f"{state}" if reason == "none" else f"{state}: {reason}"
        if self.result is not None and self.result.bearing is not None:
            bearing = self.result.bearing
            text += f", bearing pressure {bearing.value / 1e3:.1f} +- {bearing.std / 1e3:.1f} kPa"
            text += f", {self.present_decision(now).state}"
        if self.deadline_misses:
            text += f", deadline misses {self.deadline_misses}"
        if self.failures:
            text += ", failed solves: " + ", ".join(f"{kind} {n}" for kind, n in self.failures.most_common())
        for doubted, line in self._doubts.at(now).items():
            text += f", {line}"
            if now - self._said.get(doubted, -math.inf) >= SAY_AGAIN:
                self._said[doubted] = now
                log.warning("%s", line)
        if health := health_text(self.bus.state, self.bus.counts):
            text += f", bus: {health}"
        if self._claim is not None and (said := self._claim.status()):
            text += f", {said}"
        self.notifier.status(text)


def _reached(result: WindowResult, ended: float) -> float:
    """Monotonic time [s] of the last of a window's data, where it has any, else of its end."""
    return ended - (result.t - result.basis.end) if len(result.basis.instants) else ended


def _first_word(reason: str) -> str:
    """First word of a reason such as "input_stale load.FL": the name in the DBC's value table."""
    return reason.split()[0]


def software_version() -> tuple[int, int, int]:
    """Return the three numbers of the package's version."""
    major, minor, patch = (int(part) for part in __version__.split("."))
    return major, minor, patch
