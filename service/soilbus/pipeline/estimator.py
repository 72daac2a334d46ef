"""One window's data in, its result out: soil estimate, status, capability, decision, warning.

    WindowTask -> Tracker (posterior of the soil) -> status -> judge (capability, probability) -> hysteresis -> watch

`estimate` needs the estimation only and may run in another process; it returns an `Undecided`: the window's result so
far and what the decision needs.  `decide` takes these in order and holds the state from window to window: hysteresis
and watch.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from soilbus.allocator import keep_freed_memory
from soilbus.config.model import Config
from soilbus.decision.capability import Demand, OverSlip
from soilbus.decision.demand import present_demand
from soilbus.decision.driveline import idle, on_shaft, shared_out
from soilbus.decision.judgement import Basis, judge
from soilbus.decision.moments import bins_of_a_moment, moments
from soilbus.decision.torque_ceiling import TorqueCeiling
from soilbus.decision.traversability import Held, State, Status, Traversability, doubted, settled
from soilbus.decision.uncertain_model import UncertainModel
from soilbus.decision.watch import Alert, Warnings, Watch, curve_age, ended, watched
from soilbus.decision.wheels import WheelTable
from soilbus.estimation.assembly import effects_and_parameters_of, form_of, model_of, prior_of, rig_of, with_disengaged
from soilbus.estimation.gaussian import Gaussian
from soilbus.estimation.instrumentation import recompleted
from soilbus.estimation.measurements import MASS_GAIN, gains_of
from soilbus.estimation.multistart import Fit
from soilbus.estimation.nuisance_parameters import active_at
from soilbus.estimation.posterior import Estimate, Posterior
from soilbus.estimation.soil_classes import SoilClasses, guessed
from soilbus.estimation.soil_state import Reason, TrackerState
from soilbus.estimation.standing import STANDING, wheel_inertia
from soilbus.estimation.tracker import Settings, Tracker, TrackerOutput
from soilbus.estimation.window import Rig, Window, steady
from soilbus.pipeline.corrections import Corrections
from soilbus.pipeline.determination import draft_is_known, excitation_of, is_wide, lacking, sinkage_range
from soilbus.pipeline.intake import WindowTask, input_rejected
from soilbus.pipeline.model_gap import SPAN, PredictionWatch, Sums, squares
from soilbus.pipeline.result import SoilChange, WindowResult, as_of
from soilbus.terra.effects.effect import Active
from soilbus.terra.effects.steady import CompletedModel

UNSETTLED = (TrackerState.SUSPECT, TrackerState.TRANSITION)
"""States in which a window is not of the present soil alone."""


@dataclass(frozen=True, slots=True)
class Undecided:
    """Estimate of a window, its traversability unknown, with the inputs of the decision still to be made.

    posterior: of the soil, with the covariance due to the model's form that `model` has; demand: None where the draft
    is not known; torque_limit: (W,) [N m], nan where not known; driven: the window's data, its draft corrected by the
    fitted effects of the draft sensor; fresh: nothing may be carried over from the window before; model: with the
    uncertainty that the window leaves of the effects' parameters and of the form; here: whether the estimate is of the
    present ground; rig: the vehicle with its estimated mass.
    """

    result: WindowResult
    posterior: Posterior | None
    demand: Demand | None
    torque_limit: NDArray[np.float64]
    driven: Window
    fresh: bool
    model: UncertainModel
    here: bool
    rig: Rig


class WindowEstimator:
    """Estimator of one window after the other: soil, status, decision, warning.

    `tracker_of` makes the tracker from the arguments of `Tracker`; a test gives one whose soil is known.
    """

    def __init__(self, config: Config, tracker_of: Callable[..., Tracker] = Tracker) -> None:
        keep_freed_memory()
        self.config = config
        self.rig, self.prior, self.model = rig_of(config), prior_of(config), model_of(config)
        self._gain_names, self._gain_std = gains_of(self.rig)
        self._effects_and_parameters = effects_and_parameters_of(config)
        self._settings = config.estimator
        self._wheels: WheelTable | None = None
        self._gap, self._predictions = Sums(SPAN), PredictionWatch(config.estimator.window)
        shared = [f"load.{wheels[0].name}" for wheels in config.same_signal("load") if len(wheels) > 1]
        self._mismatch = " ".join(["model_mismatch", *shared])
        self._held = Held()
        self._valid_at: float | None = None
        self._watch, self._warnings = Watch(), Warnings()
        self._curve: tuple[OverSlip | None, float] = None, -np.inf
        self._idle, self._on_shaft = np.zeros(len(self.rig.wheels), bool), on_shaft(self.rig)
        self._ceiling = TorqueCeiling.unknown(len(self.rig.wheels))
        self._classes = SoilClasses.of_table(float(self.rig.width.mean())) if self.rig.wheels else None
        self._class_prior = guessed(self.prior, prior_of(Config()))
        settings = config.estimator
        of_tracker = Settings(
            settings.window, settings.min_speed, settings.max_turn, settings.soil_drift,
            form=form_of(config), search_rate=settings.search_rate, search_burst=settings.search_burst,
            hop=settings.hop,
        )  # fmt: skip
        if config.table is not None:
            of_tracker = replace(of_tracker, min_rows=1, instant=0.0, stated_noise=True)  # rows are steady, and few
        self._tracker_of = partial(tracker_of, prior=self.prior, model=self.model, settings=of_tracker)
        self._apart, self._engaged_at = np.zeros(len(self.rig.wheels), bool), -math.inf
        self._driven_rig = self.rig
        self.tracker = self._new_tracker()
        """The tracker, which carries soil and gains from window to window."""
        self._trackers = {self._apart.tobytes(): self.tracker}  # of the machine with each choice of axles

    def _new_tracker(self) -> Tracker:
        effects, free = self._effects_and_parameters
        return self._tracker_of(self._driven_rig, effects=effects, free=free)

    def _follow_clutch(self, task: WindowTask) -> Window:
        """The data after the hop in which an axle was engaged or disengaged; the tracker is of the machine now."""
        since = -math.inf if task.fresh else task.end - self._settings.hop
        self._idle = idle(task.window, self.rig, since, self._apart if task.fresh else self._idle)
        apart = self._idle & self._on_shaft
        if (apart != self._apart).any():
            self._apart, self._engaged_at = apart, task.end
            self._driven_rig = with_disengaged(self.config, self.rig, apart)
            self._gain_names, self._gain_std = gains_of(self._driven_rig)
            before, known = self.tracker, self._trackers.get(apart.tobytes())
            self.tracker = self._trackers[apart.tobytes()] = known or self._new_tracker()
            if known is None:
                self.tracker.start_from(before, task.end)
            self._predictions = PredictionWatch(self._settings.window)
        window = task.window
        if len(window.t) and window.t[0] <= self._engaged_at:
            window = window.rows(np.flatnonzero(window.t > self._engaged_at))
        return recompleted(window, self.rig, self._driven_rig)

    def solve(self, task: WindowTask) -> WindowResult:
        """Return the result of one window, with decision and watch; windows in their order."""
        return self.decide(self.estimate(task))

    def solve_unwatched(self, task: WindowTask) -> WindowResult:
        """Return the result of one window without a watch, for callers that watch more often themselves."""
        return self._decided(self.estimate(task))

    def estimate(self, task: WindowTask) -> Undecided:
        """Return soil and status of one window; windows in their order."""
        if task.fresh:
            self.tracker.reset()
            self._trackers, self._engaged_at = {self._apart.tobytes(): self.tracker}, -math.inf
        tracked = self.tracker.estimate(self._follow_clutch(task), task.end)
        fit = tracked.fit
        self._watch_model(task, tracked)
        status, reason = self._status(task, tracked)
        decided = posterior = None
        if fit is not None and status is not Status.INVALID:
            decided, posterior = self._as_decided(fit).posterior, fit.mode.posterior
            if fit.form is not None:
                prior, shift = self.tracker.soil_prior, fit.form.log_shift
                decided = decided.shifted(shift, prior)
                posterior = posterior.with_added_covariance(fit.form.log_covariance, prior, shift)
        basis, settings = self._basis(task, fit), self._settings
        if status is Status.VALID and task.end - basis.end > self.config.traversability.max_age:
            status, reason = Status.NOT_EXCITED, _gated(tracked)
        change = None if tracked.change is None else tracked.change.statistic
        limits = (None, None) if change is None else (change.ratio, change.threshold)
        result = WindowResult(
            t=task.end,
            index=task.index,
            status=status,
            reason=reason,
            posterior=posterior,
            bearing=None if posterior is None else posterior.bearing_pressure(settings.z_ref, settings.b_ref),
            slip=task.slip,
            sinkage=self._sinkage(fit if posterior is not None else None),
            traversability=Traversability(),
            chi2=None if fit is None else fit.chi2,
            samples=task.window.samples,
            rejected=task.rejected,
            iterations=0 if fit is None else fit.iterations,
            termination=None if fit is None else str(fit.termination),
            soil_class=self._soil_class(posterior),
            position=task.track.at((tracked.since + task.end) / 2.0),
            failure=self._failure(tracked),
            gaps=self._predictions.gaps(settings.max_prediction_error),
            prediction_error=self._predictions.shares(),
            standing=self._standing(fit),
            noise_factors={kind: math.sqrt(f) for kind, f in self.tracker.components.factor.items()},
            channel_chi2=self._gap.ratios(),
            excitation=excitation_of(task.window, self.rig, settings.min_speed),
            basis=basis,
            z_driven=None if fit is None or posterior is None else sinkage_range(fit, self._driven_rig),
            search_ended=tracked.search_ended,
            soil_change=SoilChange(str(tracked.state), str(tracked.reason), *limits),
            shows_strength=fit is not None and not is_wide(fit.mode.posterior.tan_phi(), settings.max_tan_phi_std),
        )
        active, free = self._effects_and_parameters
        standardised = np.zeros(len(free)) if fit is None else fit.gains[len(fit.gains) - len(free) :]
        effects = active_at(active, free, standardised, len(self.rig.wheels))
        model = self._present_model(task.window, tracked, effects)
        window = Corrections(effects=effects).corrected(steady(task.window), self.rig)
        rig = self._as_driven(tracked, window)
        demand = present_demand(window, rig.chassis, self._settings.hop, self._gain(tracked, "draft"))
        here = tracked.state not in UNSETTLED
        corrections = Corrections(self._torque_ceiling(task, window), effects)
        limit = corrections.torque_limit(shared_out(task.torque_limit, self._apart, self.rig))
        known = None if decided is None else Posterior(decided.soil, model.with_form(decided.log_covariance))
        result = replace(result, corrections=corrections)
        return Undecided(result, known, demand, limit, window, task.fresh, model, here, rig)

    def decide(self, window: Undecided) -> WindowResult:
        """Return the result with traversability and watch; windows in their order, in any process."""
        result = self._decided(window)
        self._update_watch(window)
        if result.curve is not None:
            self._curve = result.curve, result.t
        now = as_of(result, self._watch, result.t, self.config)
        if now.traversability.state is State.GO and self._watch.warning is Alert.IMMOBILISATION:
            self._watch, self._warnings = ended(self._watch, self.config), self._warnings._replace(since=None)
        return replace(now, watch=self._watch, warnings=self._warnings)

    def _decided(self, window: Undecided) -> WindowResult:
        """The result with its traversability."""
        decision, self._wheels = judge(
            window.posterior, window.result.status, window.demand, window.rig, window.model, window.torque_limit,
            self.config.traversability, None if window.fresh else self._wheels,
        )  # fmt: skip
        result = window.result
        if result.reason in ("none", "not_excited load_range") and not draft_is_known(
            decision.max_draft, window.rig, self._settings
        ):
            lacks = [*result.reason.split()[1:], "slip_range"]
            result = replace(result, status=Status.NOT_EXCITED, reason=" ".join(["not_excited", *lacks]))
            window = replace(window, result=result)
        return replace(result, traversability=self._with_state(decision, window))

    def _with_state(self, decision: Traversability, window: Undecided) -> Traversability:
        """The decision with the state after hysteresis, and the time since the last valid window."""
        if window.fresh:
            self._held, self._valid_at = Held(), None
        result = window.result
        if result.status is Status.VALID:
            self._valid_at = result.t
        if window.here:
            self._held = settled(self._held, decision.probability, result.status, self.config.traversability)
        else:  # the estimate is of the previous ground
            self._held, decision = doubted(self._held), Traversability(torque_available=decision.torque_available)
        return replace(
            decision, state=self._held.state, since_valid=None if self._valid_at is None else result.t - self._valid_at
        )

    def _torque_ceiling(self, task: WindowTask, window: Window) -> tuple[float, ...]:
        """Corrections.torque_ceiling; window: the task's, with its draft corrected."""
        hop, deviations = self._settings.hop, self.config.traversability.contradiction
        if task.fresh:
            self._ceiling = TorqueCeiling.unknown(len(self._idle))
        self._ceiling = self._ceiling.after(window, self.rig, hop, deviations)
        measured = np.where(np.isfinite(self._ceiling.limit), self._ceiling.limit, np.inf)
        return tuple(np.where(self._idle, 0.0, measured).tolist())

    def _watch_model(self, task: WindowTask, tracked: TrackerOutput) -> None:
        """Take a window's squares and predictions; those with missing or poor inputs do not count."""
        if task.fresh:
            self._gap, self._predictions = Sums(SPAN), PredictionWatch(self._settings.window)
        if tracked.fit is not None and not task.missing and not task.poor:
            self._gap.take(task.end, squares(tracked.fit.optimum.at, len(self.rig.wheels)))
            self._predictions.take(task.end, tracked.prediction)

    def _update_watch(self, window: Undecided) -> None:
        """Update the watch by the last hop, with the curve of the window before."""
        if window.fresh:
            self._watch, self._curve, self._warnings = Watch(), (None, -np.inf), Warnings()
        self._warnings = self._warnings._replace(begun=())
        since = -math.inf if window.fresh else window.result.t - self._settings.hop
        driven = window.driven
        settings, chosen = self._settings, np.flatnonzero(driven.t > since)
        bins = bins_of_a_moment(settings.bin)
        for moment in moments(driven, self.rig, window.torque_limit, self.config, chosen, bins):
            curve, t = self._curve
            known = curve if moment.t - t < curve_age(self.config) else None
            self._watch = watched(self._watch, moment, known, self.config)
            self._warnings = self._warnings.after(moment.t, self._watch.warning)

    def _present_model(self, window: Window, tracked: TrackerOutput, effects: Sequence[Active]) -> UncertainModel:
        """The model for the decision, at the window's usual speed."""
        moving, fit = window.ground_speed[window.ground_speed > self._settings.min_speed], tracked.fit
        speed = float(moving.mean()) if len(moving) else self._settings.min_speed
        if fit is None:
            return UncertainModel.over(CompletedModel.of(self.model, effects, speed))
        return UncertainModel.of(
            self.model, *self._effects_and_parameters, fit.mode, len(self.rig.wheels), speed, fit.form
        )

    def _as_decided(self, fit: Fit) -> Gaussian:
        """The estimate at the loads of decisions: of the mass as estimated, otherwise as configured."""
        rig = self._driven_rig
        rows = [] if rig.instrumentation is None else [r for r in rig.instrumentation.load if r.kind != "channel"]
        at = np.array([self._gain_names.index(f"load.{row.name}") for row in rows], int)
        at = at[np.asarray(self._gain_std)[at] > 0.0]
        mass = np.array([self._gain_names[i] == MASS_GAIN for i in at], bool)
        return fit.mode.given(at, np.where(mass, fit.gains[at], 0.0))

    def _as_driven(self, tracked: TrackerOutput, window: Window) -> Rig:
        """The rig with the mass that a window without load cells estimates, in reverse where the window ends so."""
        rig, chassis = self._driven_rig, self.rig.chassis
        if chassis is None:
            return rig
        if MASS_GAIN in self._gain_names:
            error = self._gain(tracked, MASS_GAIN)
            chassis = replace(chassis, mass=chassis.mass / (1.0 + error.value))
            rig = replace(rig, chassis=chassis, mass_std=error.std / (1.0 + error.value))
        return replace(rig, chassis=chassis.in_reverse) if (window.direction[-1:] < 0.0).any() else rig

    def _gain(self, tracked: TrackerOutput, name: str) -> Estimate:
        """A sensor's or row's gain error: posterior of the fit, else the prior."""
        index = self._gain_names.index(name)
        if tracked.fit is None or tracked.mismatch:
            return Estimate(0.0, self._gain_std[index])
        return tracked.fit.mode.gain(index)

    def _standing(self, fit: Fit | None) -> dict[str, Estimate]:
        """Return what a fit says of the standing parts that are not held, in SI."""
        if fit is None or self.rig.chassis is None:
            return {}
        unit = {"wheel_inertia": float(wheel_inertia(self.rig).mean())}
        gains = {name: fit.mode.gain(self._gain_names.index(name)) for name in STANDING}
        return {
            name: Estimate(unit.get(name, 1.0) * gain.value, unit.get(name, 1.0) * gain.std)
            for name, gain in gains.items()
            if gain.std > 0.0
        }

    def _soil_class(self, posterior: Posterior | None) -> dict[str, float] | None:
        if posterior is None or self._classes is None:
            return None
        soil_prior = self.tracker.soil_prior
        return self._classes.probabilities(posterior, self._class_prior if soil_prior is self.prior else soil_prior)

    def _sinkage(self, fit: Fit | None) -> dict[str, float | None]:
        if fit is None:
            return dict.fromkeys(self.rig.wheels)
        known = zip(self.rig.wheels, fit.sinkage.tolist(), strict=True)
        return {wheel: z if math.isfinite(z) else None for wheel, z in known}

    def _basis(self, task: WindowTask, fit: Fit | None) -> Basis:
        """The instants of a fit, and the distance driven since the last of them."""
        instants, each = np.empty(0) if fit is None else fit.optimum.t, self.tracker.instant or self._settings.bin
        end = min(instants[-1] + each / 2.0, task.end) if len(instants) else -math.inf
        since = task.window.ground_speed[task.window.t > end]
        known = since[np.isfinite(since)]
        unseen = float(known.mean()) * len(since) * self._settings.bin if len(known) else 0.0
        return Basis(instants, each, unseen, task.late)

    def _status(self, task: WindowTask, tracked: TrackerOutput) -> tuple[Status, str]:
        """Status and reason; a second sender or an implausible sensor replaces the reasons that it may have caused."""
        status, reason = self._status_without_plausibility(task, tracked)
        follows = reason.split()[0] in ("none", "input_stale", "model_mismatch", "no_convergence")
        if task.untrusted and not task.missing:
            return status if status is Status.INVALID else Status.DEGRADED, input_rejected(task.untrusted)
        return status, " ".join(["implausible", *task.implausible]) if task.implausible and follows else reason

    def _status_without_plausibility(self, task: WindowTask, tracked: TrackerOutput) -> tuple[Status, str]:
        fit = tracked.fit
        if task.missing:
            return Status.INVALID, "input_missing " + " ".join(task.missing)
        if fit is None and not tracked.mismatch:
            if tracked.standstill + tracked.turning > 0:
                return Status.NOT_EXCITED, _gated(tracked)
            if task.poor:
                return Status.INVALID, "input_stale " + " ".join(task.poor)
            is_short = tracked.reason is Reason.TOO_FEW_DATA
            return (Status.NOT_EXCITED, "not_excited few_bins") if is_short else (Status.INVALID, "no_convergence")
        if self._failure(tracked) is not None:
            return Status.INVALID, "no_convergence"
        if fit is None or not fit.converged:
            return Status.INVALID, self._mismatch
        sensors, settings = np.asarray(self._gain_std), self._settings
        far = np.abs(fit.gains[: len(sensors)]) > settings.max_gain_error * sensors  # from what is configured of them
        if tracked.mismatch or far.any() or self._predictions.error() > settings.max_prediction_error:
            return Status.DEGRADED, self._mismatch
        if task.poor:
            return Status.DEGRADED, "input_stale " + " ".join(task.poor)
        enough = self.config.traversability.min_share * self._settings.window
        if tracked.state in UNSETTLED or tracked.since > task.end - enough:
            return Status.NOT_EXCITED, "not_excited new_soil"
        if lacks := lacking(fit, self._driven_rig, self._settings):
            return Status.NOT_EXCITED, " ".join(["not_excited", *lacks])
        return Status.VALID, "none"

    def _failure(self, tracked: TrackerOutput) -> str | None:
        """Kind of failure of a solve: not_finite or no_convergence; None for none."""
        fit = tracked.fit
        if fit is None:
            return "not_finite" if tracked.mismatch and not tracked.search_ended else None
        return None if fit.converged or self.tracker.is_of_several_soils(fit) else "no_convergence"


def _gated(tracked: TrackerOutput) -> str:
    """Reason for which most instants were left out: standstill or turning."""
    return "standstill" if tracked.standstill >= tracked.turning else "turning"
