"""Frames in, window results out: the same code for the live bus, a replay and a test.

No bus and no clock in here; time is what the frames' stamps say.  Windows are counted
from the first admitted sample, so the same frames always give the same windows.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from cantools.database.can import Database
from numpy.typing import NDArray

from soilbus.assembly import model_of, prior_of, rig_of
from soilbus.can.admission import Admission
from soilbus.can.channels import Channel, Decoded
from soilbus.can.dbc_files import checked_messages
from soilbus.can.mapping import channels_of
from soilbus.capability import PullCurve
from soilbus.config import Config
from soilbus.estimation.gauss_newton import Fit, fit_window
from soilbus.estimation.posterior import Estimate, Posterior
from soilbus.estimation.residuals import WindowProblem
from soilbus.estimation.window import BinStore, Window
from soilbus.terra.vehicle import GRAVITY, slip_ratio
from soilbus.terra.wheel import sinkage as sinkage_of
from soilbus.traversability import Demand, Status, Traversability, judge

Array = NDArray[np.float64]

DEFAULT_TIMEOUT = 1.0
COVERAGE_BLOCK = 0.5
MIN_COVERAGE = 0.95
MIN_ROWS = 60
LONGEST_GAP = 60.0
"""Silence [s] after which windows are counted anew instead of being reported one by one."""


@dataclass(frozen=True, slots=True)
class WindowResult:
    """What one window says; t is its end [s], index counts windows since the start.

    slip and sinkage [m] are means over the window by wheel name, None where unknown.
    rejected counts refused samples of the window by reason.  posterior is None where
    status is invalid.
    """

    t: float
    index: int
    status: Status
    reason: str
    posterior: Posterior | None
    bearing: Estimate | None
    slip: dict[str, float | None]
    sinkage: dict[str, float | None]
    traversability: Traversability
    chi2: float | None
    samples: int
    rejected: dict[str, int]
    iterations: int = 0


@dataclass(slots=True)
class _Refusals:
    """Refused samples by reason, kept as long as a window may ask for them."""

    entries: list[tuple[str, Array]] = field(default_factory=list)
    total: Counter[str] = field(default_factory=Counter)

    def add(self, decoded: Decoded) -> None:
        for (_, reason), times in decoded.refused.items():
            self.entries.append((str(reason), times))
            self.total[str(reason)] += len(times)

    def within(self, start: float, end: float) -> dict[str, int]:
        self.entries = [(r, t) for r, t in self.entries if t[-1] >= start]
        counts: Counter[str] = Counter()
        for reason, t in self.entries:
            counts[reason] += int(np.count_nonzero((t >= start) & (t < end)))
        return {r: n for r, n in sorted(counts.items()) if n}


class Pipeline:
    """Admission, bins, estimate and decision for one vehicle.

    Feed frames in the order of their stamps, call `advance` with the present time (or
    `finish` at the end of a log) and take the windows that have ended.  Raises
    ConfigError where configuration and database do not fit.
    """

    def __init__(self, config: Config, database: Database) -> None:
        self.config = config
        self.channels = channels_of(config, database)
        self.admission = Admission(self.channels, database, checked_messages(config))
        self.feed: Callable[..., None] = self.admission.feed
        self.rig = rig_of(config)
        self.prior = prior_of(config)
        self.model = model_of(config)
        self.refusals = _Refusals()
        self._rig_channels = frozenset(self.rig.channels)
        self.needed = tuple(c for c in self.channels if self._is_needed(c))
        self._settings = config.estimator
        self._max_torque = np.array([w.max_torque or math.nan for w in config.wheel if w.name in self.rig.wheels])
        self._limit = np.full(len(self.rig.wheels), math.nan)
        self._limit_t = np.full(len(self.rig.wheels), -math.inf)
        self._restart()
        self.index = 0

    def _is_needed(self, channel: Channel) -> bool:
        if channel.wheel:
            return channel.wheel in self.rig.wheels and channel.quantity in ("torque", "speed", "load")
        return True

    def _restart(self) -> None:
        self._bins: BinStore | None = None
        self._fit: Fit | None = None
        self._pull_curve: PullCurve | None = None
        self.next_end = math.inf
        self.last_seen: dict[str, float] = {}
        self._clock_steps = self.admission.counts.clock_steps

    def ingest(self, until: float = math.inf) -> None:
        """Decode the frames filed so far that are older than `until` and put them into bins."""
        decoded = self.admission.take(until)
        if self.admission.counts.clock_steps != self._clock_steps:
            self._restart()
        self.refusals.add(decoded)
        for name, column in decoded.columns.items():
            if not len(column.t):
                continue
            self.last_seen[name] = float(column.t[-1])
            if name.startswith("torque_limit."):
                self._note_limit(name.removeprefix("torque_limit."), column.t, column.value)
            elif name in self._rig_channels:
                self._store(float(column.t[0])).add(name, column.t, column.value)

    def _note_limit(self, wheel: str, t: Array, value: Array) -> None:
        if wheel in self.rig.wheels:
            i = self.rig.wheels.index(wheel)
            self._limit[i], self._limit_t[i] = value[-1], t[-1]

    def _store(self, t: float) -> BinStore:
        if self._bins is None:
            self._bins = BinStore(self.rig, self._settings.bin, t)
            self.next_end = t + self._settings.window
        return self._bins

    def advance(self, now: float) -> list[WindowResult]:
        """Close every window that ended at or before `now` [s]."""
        if self._bins is None:
            self.ingest(now)
        results: list[WindowResult] = []
        while self.next_end <= now:
            self.ingest(self.next_end)
            if self.next_end > now or self._bins is None:  # the clock was set meanwhile
                break
            if self.last_seen and self.next_end - max(self.last_seen.values()) > LONGEST_GAP:
                self._restart()
                break
            results.append(self._close(self._bins, self.next_end))
            self.next_end += self._settings.hop
        return results

    def finish(self, now: float) -> list[WindowResult]:
        """Windows still open at the end of a recording that lasts until `now` [s]."""
        results = self.advance(now)
        self.ingest()
        return results + self.advance(now)

    def stale(self, now: float) -> list[str]:
        """Needed channels without an admitted sample within their time-out before `now` [s]."""
        return [
            c.name
            for c in self.needed
            if now - self.last_seen.get(c.name, -math.inf) > (c.timeout or DEFAULT_TIMEOUT)
        ]

    def latest_slip(self, now: float, span: float = 0.3) -> dict[str, float | None]:
        """Slip ratio by wheel over the last `span` seconds before `now`; None where unknown."""
        if self._bins is None:
            return dict.fromkeys(self.rig.wheels)
        last = math.floor((now - self._bins.origin) / self._settings.bin) * self._settings.bin + self._bins.origin
        return self._slip(self._bins.window(last - span, last))

    def _slip(self, window: Window) -> dict[str, float | None]:
        ground = window.ground_speed[:, None]
        slip = slip_ratio(self.rig.radius, window.speed, ground)
        slip = np.where((ground > self._settings.min_speed) & (slip > -1.0), slip, np.nan)
        return dict(zip(self.rig.wheels, _means(slip), strict=True))

    def _close(self, bins: BinStore, end: float) -> WindowResult:
        start = end - self._settings.window
        window = bins.window(start, end)
        problem = WindowProblem(window, self.rig, self.model, self._settings.min_speed)
        fit = fit_window(problem, self.prior, self._fit) if problem.n_rows >= MIN_ROWS else None
        self._fit = fit if fit is not None and fit.converged else None
        status, reason = self._status(window, problem, fit, end)
        posterior = None if fit is None or status is Status.INVALID else self._honest(fit)
        way, self._pull_curve = judge(
            posterior, status, self._demand(window), self.rig, self.model, self.torque_limit(end),
            self.config.traversability, self._pull_curve,
        )  # fmt: skip
        result = WindowResult(
            t=end,
            index=self.index,
            status=status,
            reason=reason,
            posterior=posterior,
            bearing=None if posterior is None else self._bearing(posterior),
            slip=self._slip(window),
            sinkage=self._sinkage(problem, fit if posterior is not None else None),
            traversability=way,
            chi2=None if fit is None else fit.chi2,
            samples=window.samples,
            rejected=self.refusals.within(start, end),
            iterations=0 if fit is None else fit.iterations,
        )
        self.index += 1
        bins.drop_before(start + self._settings.hop)
        return result

    def torque_limit(self, now: float) -> Array:
        """Torque limit of each wheel [N m]: its signal while fresh, else the configured one, else nan."""
        fresh = now - self._limit_t < DEFAULT_TIMEOUT
        return np.where(fresh, self._limit, self._max_torque)

    def _honest(self, fit: Fit) -> Posterior:
        """Posterior with its covariance widened where the residuals are larger than the noise."""
        if fit.chi2 <= self._chi2_limit(fit):
            return fit.posterior
        return Posterior(fit.posterior.soil, fit.posterior.log_covariance * fit.chi2)

    def _chi2_limit(self, fit: Fit) -> float:
        """Reduced chi-square that noise alone reaches hardly ever with this many residuals."""
        return self._settings.max_chi2 + 4.0 * math.sqrt(2.0 / max(fit.rows, 1))

    def _bearing(self, posterior: Posterior) -> Estimate:
        return posterior.bearing_pressure(self._settings.z_ref, self._settings.b_ref)

    def _sinkage(self, problem: WindowProblem, fit: Fit | None) -> dict[str, float | None]:
        if fit is None:
            return dict.fromkeys(self.rig.wheels)
        z = np.where(problem.usable, sinkage_of(fit.latents.entry_angle, self.rig.radius), np.nan)
        return dict(zip(self.rig.wheels, _means(z), strict=True))

    def _demand(self, window: Window) -> Demand | None:
        """Draft and slope over the last hop; None where the draft is not known."""
        recent = window.t > window.t[-1] - self._settings.hop if len(window.t) else window.t > 0
        draft = window.draft[recent]
        draft = draft[np.isfinite(draft)]
        if self.rig.chassis is None or not len(draft):
            return None
        pitch = window.pitch[recent]
        slope = float(np.nanmean(np.sin(pitch))) if np.isfinite(pitch).any() else 0.0
        pull = float(draft.mean()) + self.rig.chassis.mass * GRAVITY * slope
        return Demand(pull, float(draft.std() / math.sqrt(len(draft))))

    def _status(self, window: Window, problem: WindowProblem, fit: Fit | None, end: float) -> tuple[Status, str]:
        missing = [c.name for c in self.needed if c.name not in self.last_seen]
        if not self.rig.wheels or missing:
            return Status.INVALID, "input_missing " + " ".join(missing) if missing else "input_missing wheels"
        if problem.n_rows < MIN_ROWS:
            standing = problem.standstill > 0.5 * max(len(window.t), 1)
            return (Status.NOT_EXCITED, "standstill") if standing else (Status.INVALID, "input_stale")
        if fit is None or not fit.converged:
            return Status.INVALID, "no_convergence"
        if fit.chi2 > self._chi2_limit(fit):
            return Status.DEGRADED, "model_mismatch"
        poor = [c.name for c in self.needed if _coverage(window, self.rig.wheels, c) < MIN_COVERAGE]
        stale = self.stale(end)
        if poor or stale:
            return Status.DEGRADED, "input_stale " + " ".join(dict.fromkeys(stale + poor))
        bearing, tan_phi = self._bearing(fit.posterior), fit.posterior.tan_phi()
        if bearing.std > self._settings.max_bearing_std * bearing.value:
            return Status.NOT_EXCITED, "not_excited load_range"
        if tan_phi.std > self._settings.max_tan_phi_std * tan_phi.value:
            return Status.NOT_EXCITED, "not_excited slip_range"
        return Status.VALID, "none"


def _means(rows: Array) -> list[float | None]:
    """Mean of each column over its finite entries; None for a column without any."""
    known = np.isfinite(rows)
    count = known.sum(0)
    total = np.where(known, rows, 0.0).sum(0)
    return [float(s / n) if n else None for s, n in zip(total, count, strict=True)]


def _coverage(window: Window, wheels: tuple[str, ...], channel: Channel) -> float:
    """Share of the window's half seconds in which the channel has a sample."""
    values = getattr(window, channel.quantity)
    known = np.isfinite(values if not channel.wheel else values[:, wheels.index(channel.wheel)])
    if len(known) < 2:
        return 0.0
    block = ((window.t - window.t[0]) / COVERAGE_BLOCK + 1e-6).astype(int)
    return float((np.bincount(block, weights=known) > 0).mean())
