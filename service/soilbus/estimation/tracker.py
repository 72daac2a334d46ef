"""Tracker: the recursion from window to window, and the states in which the soil changes.

    prior of a window = posterior of the newest window that had ended when it began, plus drift since,

        soil   covariance += drift^2 elapsed D D'     (random walk of the coordinates, D their log directions)
        gains  p <- p^k p_0^(1 - k)                   (stabilised forgetting, k = exp(-1 / gain_memory) in a window)

    so that no sample counts twice.

A window is fitted as one soil, from the optimum of the last one (warm start).  Where the newest data disagree with
that soil (change_detection) or it does not describe the window, another soil is searched for (`Tracker._explained`),
and `soil_state` says which soil the estimate is of.

A fit that does not describe its data is a mismatch and never a prior.  Searches from many starts are
limited by `SearchBudget`.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from operator import itemgetter
from typing import NamedTuple

import numpy as np

from soilbus.arrays import Array
from soilbus.estimation.change_detection import Transition, change_statistic, without_transition
from soilbus.estimation.gaussian import Gaussian
from soilbus.estimation.instants import averaged, instant_of
from soilbus.estimation.model_form import form_posterior
from soilbus.estimation.multistart import Fit, WarmStart, fit_warm, fit_window, warm_start
from soilbus.estimation.nuisance_parameters import Free
from soilbus.estimation.observation_model import ObservationModel
from soilbus.estimation.observation_with_effects import ObservationModelWithEffects
from soilbus.estimation.options import ESTIMATOR
from soilbus.estimation.parametrization import coordinates_of
from soilbus.estimation.posterior import PARAMETERS, SoilPrior
from soilbus.estimation.prediction import Share, prediction_shares
from soilbus.estimation.search_budget import SearchBudget
from soilbus.estimation.soil_state import ChangePoint, Reason, Shown, SoilState, TrackerState, next_state
from soilbus.estimation.solver import Objective
from soilbus.estimation.variance_components import VarianceComponents, correction_ratios
from soilbus.estimation.window import TIME_TOLERANCE, Rig, Window, window_of_samples
from soilbus.terra.effects.effect import Effect
from soilbus.terra.soils import SOILS
from soilbus.terra.wheel import WheelModel

__all__ = ["Settings", "Tracker", "TrackerOutput", "gain_errors", "new_soil_prior"]

_SOIL = len(PARAMETERS)


@dataclass(frozen=True, slots=True)
class Settings:
    """Configuration of the tracker."""

    window: float  # length of a window [s]
    min_speed: float  # ground speed [m/s] up to which instants are left out
    max_turn: float  # relative difference of an axle's rim speeds above which instants are left out
    # sd of the change of each soil coordinate's logarithm in one window; it grows with the square root of time
    drift: float
    min_rows: int = 15  # residuals below which a window is not fitted
    # how far each of `model_form.FORM` may be from the configured model; () holds the form
    form: tuple[float, ...] = ()
    search_rate: float = 4.0  # evaluations of the model that searches may take, see `SearchBudget`
    search_burst: float = 100.0
    hop: float = 1.0  # time [s] from one window to the next
    # length [s] of the instants that bins are averaged to (`instants`); 0 keeps the bins
    instant: float = ESTIMATOR.tracker.instant
    # whether a first fit that leaves more than the stated noise is a mismatch: of rows without shaking or lateness
    stated_noise: bool = False


@dataclass(frozen=True, slots=True)
class TrackerOutput:
    """Result of one window."""

    fit: Fit | None  # None without enough residuals or where no fit ended
    mismatch: bool  # whether the model fails to describe the data
    state: TrackerState  # which soil the estimate is of
    since: float  # time [s] where the data that count begin
    standstill: int = 0  # instants left out
    turning: int = 0
    search_ended: bool = False  # whether the budget of evaluations ended the search for a soil that describes the data
    reason: Reason = Reason.ONE_SOIL  # why the state is so
    change: ChangePoint | None = None  # the present change point
    # by channel, how far the newest data are from what the windows before predict
    prediction: Mapping[str, Share] = field(default_factory=dict)


class _Present(NamedTuple):
    """A window without data before the last transition: what is fitted, with which joint prior, from `since` on [s]."""

    window: Window
    problem: ObservationModel
    joint_prior: Gaussian
    since: float
    end: float


class _Explanation(NamedTuple):
    """How a window is explained: objective and fit of its data from `since` on [s]; the warm start, if there was one.

    found: why these data are of another soil, or of the soil before a change point; transition: the one to that soil.
    """

    objective: Objective
    fit: Fit | None
    since: float
    warm: WarmStart | None = None
    found: Reason | None = None
    transition: Transition | None = None


class Tracker:
    """Recursive estimator over windows; it holds all state from window to window.

    prior: the configured one of the soil; model: without effects; effects, free: of the model, and their parameters.
    state: which soil the last window was of; newest_posterior: of the newest window that serves as a prior, None before
    the first; components: of the sensors' variance, learned so far; instant: its length [s].
    """

    def __init__(
        self,
        rig: Rig,
        prior: SoilPrior,
        model: WheelModel,
        settings: Settings,
        effects: Sequence[Effect] = (),
        free: Sequence[Free] = (),
    ) -> None:
        self.rig, self.prior, self.model, self.settings, self.options = rig, prior, model, settings, rig.options.tracker
        self.effects, self.free = tuple(effects), tuple(free)
        self.instant = instant_of(rig, settings.instant)
        self._new_soil_prior = new_soil_prior(prior)
        self._last_run: tuple[Gaussian, float] | None = None
        self.reset()

    @property
    def soil_prior(self) -> SoilPrior:
        """Prior of the present soil: the configured one, or the wider one of a new soil."""
        return self.prior if self.state.transition is None else self._new_soil_prior

    def start_from_last_run(self, gaussian: Gaussian, elapsed: float) -> None:
        """Take the gains of the last run, `elapsed` seconds ago, as prior now and after each reset."""
        self._last_run = gaussian, elapsed

    def start_from(self, other: Tracker, t: float) -> None:
        """Take the soil that another tracker knows as prior from `t` [s] on, as when the machine changes."""
        known = other.newest_posterior
        if known is None:
            return
        gaussian = replace(Gaussian.of(self.prior, gain_errors(self.rig, self.model, self.free)[1]), soil=known.soil)
        gaussian.covariance[:_SOIL, :_SOIL] = known.covariance[:_SOIL, :_SOIL]
        self._posteriors.append((t, gaussian))

    def reset(self) -> None:
        """Forget all windows."""
        self.state = SoilState()
        self.newest_posterior: Gaussian | None = None
        self.components = VarianceComponents(self.rig.options.variance)
        self._budget = SearchBudget(self.settings.search_rate, self.settings.search_burst)
        self._fit: Fit | None = None
        self._good_until = -math.inf
        self._posteriors: list[tuple[float, Gaussian]] = []

    def estimate(self, window: Window, end: float) -> TrackerOutput:
        """Estimate one window of bin means that ends at `end` [s]; windows come in their order."""
        recent = end - self._good_until <= self.options.max_unexplained * self.settings.window
        self._budget.next_window(len(window.t), refill=recent)
        if not recent:  # what windows before left is no measure of ground that none of them was on
            self.components = VarianceComponents(self.rig.options.variance)
        return replace(self._estimate(averaged(window, end, self.instant), end), search_ended=self._budget.ended)

    def _estimate(self, window: Window, end: float) -> TrackerOutput:
        """One step of the recursion: data of the present soil, explanation, next state, report."""
        present = self._present(window, end)
        left_out = present.problem.standstill, present.problem.turning
        if present.problem.n_rows < self.settings.min_rows:
            self._fit = None
            return TrackerOutput(None, False, TrackerState.STEADY, present.since, *left_out, reason=Reason.TOO_FEW_DATA)
        self._posteriors = self._posteriors[max(self._newest_ended(end - self.settings.window), 0) :]
        one = self._one_soil(present)
        if not self.components.weight and not (self.settings.stated_noise and self.mismatch(one.fit)):
            present, one = self._with_components(present, window, end, one)
        change = self._change_point(present, one)
        explanation = self._explained(present, one, change)
        fit = explanation.fit
        shown = Shown(explanation.found, explanation.transition, change, self.mismatch(fit))
        state = next_state(self.state, shown, end, self.settings.window)
        tracked = TrackerOutput(
            self._reported(explanation.objective, fit), shown.mismatch, state.name, explanation.since, *left_out,
            reason=state.reason, change=state.change, prediction=self._prediction(one),
        )  # fmt: skip
        self._store(tracked, state, end, explanation.objective.problem)
        return tracked

    def _present(self, window: Window, end: float) -> _Present:
        """The window's data of the present soil."""
        start, transition = end - self.settings.window, self.state.transition
        since = start if transition is None else max(transition.end, start)
        if transition is not None:
            window = without_transition(window, transition, self.rig.ahead)
            window = window.rows(np.flatnonzero(window.t >= transition.end))
        problem = self._problem(window)
        return _Present(window, problem, self._prior_at(since, problem), since, end)

    def _problem(self, window: Window) -> ObservationModel:
        speed, turn = self.settings.min_speed, self.settings.max_turn
        window = self.components.scaled(window, self.rig)
        problem = ObservationModelWithEffects(window, self.rig, self.model, speed, turn, self.effects, self.free)
        problem.work = self._budget.work
        return problem

    def _one_soil(self, present: _Present) -> _Explanation:
        """The window as one soil, the present one: from the optimum of the last window, else from many starts."""
        if self._fit is None:
            return self._searched(present)
        warm = warm_start(present.problem, self.soil_prior, self._fit, present.joint_prior)
        fit = fit_warm(warm)
        if fit is None or not fit.converged:
            fit = self._search(present.problem, self.soil_prior, present.joint_prior) or fit
        return _Explanation(warm.objective, fit, present.since, warm, transition=self.state.transition)

    def _searched(self, present: _Present) -> _Explanation:
        """The window as one soil, the present one, from many starts."""
        fit = self._search(present.problem, self.soil_prior, present.joint_prior)
        objective = Objective(present.problem, self.soil_prior, present.joint_prior)
        return _Explanation(objective, fit, present.since, transition=self.state.transition)

    def _with_components(
        self, present: _Present, window: Window, end: float, one: _Explanation
    ) -> tuple[_Present, _Explanation]:
        """The first window again, until its own residuals say what its sensors are worth."""
        for _ in range(self.options.first_rounds):
            fit, work_before = one.fit, self._budget.work.instants
            if fit is None or not self._budget.allows():
                break
            ratios = correction_ratios(one.objective.problem, fit.optimum, self.components.options)
            self.components = self.components.after(ratios, whole=True)
            present = self._present(window, end)
            warm = warm_start(present.problem, self.soil_prior, fit, present.joint_prior)
            one = _Explanation(warm.objective, fit_warm(warm) or fit, present.since, None, transition=one.transition)
            self._budget.spend(work_before)
        if self.mismatch(one.fit):  # what no soil explains says nothing of the sensors
            self.components = VarianceComponents(self.rig.options.variance)
        return present, one

    def _prediction(self, one: _Explanation) -> Mapping[str, Share]:
        """The newest data beside their prediction by the last window's estimate."""
        if one.warm is None or one.warm.model is None or self._fit is None:
            return {}
        problem, last = one.warm.objective.problem, float(self._fit.optimum.t[-1])
        return prediction_shares(problem, one.warm.model.linearisation, last, self.rig.options.variance.block)

    def _change_point(self, present: _Present, one: _Explanation) -> ChangePoint | None:
        """Where the newest data disagree with the present soil; what it was while nothing explains the data since."""
        options, length, change, last = self.options, self.settings.window, self.state.change, self._fit
        if change is not None and change.t <= present.end - options.max_unexplained * length:
            change = None  # a new soil would have been found by now
        fit, warm = one.fit, one.warm
        at = None if warm is None else warm.model
        if warm is None or at is None or last is None or (change is not None and self.mismatch(fit)):
            return change if self.mismatch(fit) else None
        if self._good_until <= present.end - length or present.end - present.since <= options.min_to_detect * length:
            return None
        t = warm.objective.problem.t
        first = int(np.searchsorted(t, float(last.optimum.t[-1]) - options.min_to_detect * length))
        centred = replace(last.mode, soil=last.optimum.soil, gains=last.optimum.gains)
        predicted = centred.drifted(self._drift(centred, 0.5))  # from the middle of the last window
        false_alarms = options.false_alarms_per_hour * self.settings.hop / 3600.0
        found = change_statistic(warm.objective, predicted, warm.iterate, at.linearisation, first, false_alarms)
        if not found.is_alarm and not self.mismatch(fit):
            return None
        begin, window = float(t[found.instant]), present.window
        near = window.ground_speed[(window.t >= begin - 1.0) & (window.t <= begin)]
        return ChangePoint(begin, max(float(np.nanmean(near)), self.settings.min_speed), found)

    def _explained(self, present: _Present, one: _Explanation, change: ChangePoint | None) -> _Explanation:
        """The window as two soils from the change point on, or as another soil."""
        two = None if change is None else self._two_soils(present, one, change)
        if two is not None:
            return two
        if (one.warm is None or self.mismatch(one.fit)) and self._budget.allows():
            one = self._another_soil(present, one if one.warm is None else self._searched(present))
        return one

    def _two_soils(self, present: _Present, one: _Explanation, change: ChangePoint) -> _Explanation | None:
        """The window as two soils, the second from the change point on; None where one soil is not much less likely."""
        # Without a last fit, or with too few data of the first soil, the second soil is fitted alone; where too few
        # data are of the second, the window's data before the change point.
        window, end = present.window, present.end
        first = self._problem(window.rows(np.flatnonzero(window.t < change.t - TIME_TOLERANCE)))
        warm = None
        if one.warm is not None and self._fit is not None and first.n_rows >= self.settings.min_rows:
            warm = warm_start(first, self.soil_prior, self._fit, present.joint_prior)
        old = None if warm is None else fit_warm(warm)
        old = None if self.mismatch(old) else old
        if old is None and not self.mismatch(one.fit):
            return None
        joint_prior = self._prior_at(change.t, present.problem).with_prior_soil(self._new_soil_prior)
        new = self._after_transition(window, change, joint_prior)
        if new is not None and new.transition is not None:
            separated = without_transition(window, new.transition, self.rig.ahead)
            whole = present._replace(window=separated, problem=self._problem(separated))
            together = None if old is None else self._searched(whole).fit
            if old is not None and new.fit is not None and together is not None and together.converged:
                gain = together.neg2_log_evidence - old.neg2_log_evidence - new.fit.neg2_log_evidence
                if gain < self.options.significance:
                    return None
            return new._replace(found=Reason.TWO_SOILS)
        if warm is None or old is None or end >= change.t + self.options.min_to_detect * self.settings.window:
            return None
        reason = Reason.CHANGE_STATISTIC if change.statistic.is_alarm else Reason.MISMATCH
        return _Explanation(warm.objective, old, float(window.t[0]), warm, reason, self.state.transition)

    def _after_transition(self, window: Window, change: ChangePoint, joint_prior: Gaussian) -> _Explanation | None:
        """The data after the first candidate transition that leaves one new soil; None where none does."""
        prior = self._new_soil_prior
        for transition in self._candidate_transitions(change, float(window.t[0])):
            separated = without_transition(window, transition, self.rig.ahead)
            problem = self._problem(separated.rows(np.flatnonzero(separated.t >= transition.end)))
            arrived = transition.end + transition.lag if self.state.mismatch else transition.end
            if problem.n_rows < self.settings.min_rows or window.t[-1] < arrived:
                return None  # after a mismatch both axles and the draft must agree on the new soil
            fit = self._search(problem, prior, joint_prior)
            if not self.mismatch(fit):
                return _Explanation(Objective(problem, prior, joint_prior), fit, transition.end, None, None, transition)
        return None

    def _candidate_transitions(self, change: ChangePoint, start: float) -> list[Transition]:
        """Transitions of growing length from the change point on; of those over before `start` [s] only the last."""
        chassis, wheel = self.rig.chassis, 2.0 * float(self.rig.radius.max())
        lag = (wheel if chassis is None else chassis.wheelbase) / change.speed
        ends = [change.t + length * lag for length in self.options.transition_lengths]
        n_over = sum(end <= start for end in ends)
        return [Transition(change.t - TIME_TOLERANCE, end, lag) for end in ends[max(n_over - 1, 0) :]]

    def _another_soil(self, present: _Present, one: _Explanation) -> _Explanation:
        """The window as one soil, a new one where the prior of the present one conflicts with the data."""
        if not self._posteriors:
            return one
        joint_prior = present.joint_prior.with_prior_soil(self._new_soil_prior)
        fit, other = one.fit, self._search(present.problem, self._new_soil_prior, joint_prior)
        if other is None or self.mismatch(other):
            return one
        gain = math.inf if fit is None or self.mismatch(fit) else fit.neg2_log_evidence - other.neg2_log_evidence
        if gain < self.options.significance:
            return one
        begin = float(present.problem.t[0])
        objective = Objective(present.problem, self._new_soil_prior, joint_prior)
        return _Explanation(objective, other, begin, None, Reason.ANOTHER_SOIL, Transition(begin, begin, 0.0))

    def _search(self, problem: ObservationModel, prior: SoilPrior, joint_prior: Gaussian) -> Fit | None:
        """A fit from many starts; None also where the budget allows no search."""
        if not self._budget.allows():
            return None
        work_before = self._budget.work.instants
        fit = fit_window(problem, prior, joint_prior)
        self._budget.spend(work_before)
        return fit

    def mismatch(self, fit: Fit | None) -> bool:
        """Return whether a fit failed, or fits much worse than the windows before, as on several soils."""
        return fit is None or not fit.converged or self.is_of_several_soils(fit)

    def is_of_several_soils(self, fit: Fit) -> bool:
        """Return whether residuals are larger than what earlier windows left: data of several soils, or a new fault."""
        return math.isfinite(fit.chi2) and fit.chi2 > self.options.several_soils

    def _prior_at(self, t: float, problem: ObservationModel) -> Gaussian:
        """Posterior of the newest window that ended by t [s], plus drift since."""
        newest = self._newest_ended(t)
        if newest < 0:
            return self._initial_prior(problem)
        end, gaussian = self._posteriors[newest]
        elapsed = (t - end) / self.settings.window + 1.0  # from the middle of that window to the middle of this one
        forgotten = 1.0 / self.options.gain_memory + (t - end) / self.options.gain_correlation_time
        gaussian = gaussian.forgotten(math.exp(-forgotten), problem.gain_std)
        if self.state.transition is not None and end <= self.state.transition.end:
            return gaussian.with_prior_soil(self.soil_prior)
        return gaussian.drifted(self._drift(gaussian, elapsed))

    def _initial_prior(self, problem: ObservationModel) -> Gaussian:
        """Prior of the first window: with the gains of the last run where it is at least as likely as without.

        A sensor exchanged or calibrated since then has another gain error.
        """
        without = Gaussian.of(self.soil_prior, problem.gain_std)
        if self._last_run is None:
            return without
        last, elapsed = self._last_run
        kept = math.exp(-elapsed / self.options.gain_correlation_time)
        with_gains = last.with_prior_soil(self.soil_prior).wandered(kept, problem.gain_std)
        fits = (fit_window(problem, self.soil_prior, prior) for prior in (without, with_gains))
        other, fit = (fit if fit is not None and fit.converged else None for fit in fits)
        if fit is not None and (other is None or fit.neg2_log_evidence <= other.neg2_log_evidence):
            return with_gains
        self._last_run = None
        return without

    def _drift(self, gaussian: Gaussian, elapsed: float) -> Array:
        """Covariance (6, 6) of the drift of the soil's logarithms in `elapsed` windows."""
        coordinates = coordinates_of(self.soil_prior, self.rig.mean_width, self.rig.options.search)
        directions = coordinates.log_directions(gaussian.soil)
        return np.asarray(self.settings.drift**2 * elapsed * (directions @ directions.T))

    def _newest_ended(self, t: float) -> int:
        """Index of the newest posterior of a window that ended by t [s]; -1 without one."""
        return bisect_right(self._posteriors, t + TIME_TOLERANCE, key=itemgetter(0)) - 1

    def _reported(self, objective: Objective, fit: Fit | None) -> Fit | None:
        """The fit as it is reported: with what the form of the contact leaves open."""
        if fit is None or not fit.converged:
            return fit
        half = (self.options.steady_drift / 2.0) ** 2  # from a window's middle to its end
        mode = fit.mode.drifted(self._drift(fit.mode, half))
        form = form_posterior(objective, fit, self.settings.form) if any(self.settings.form) else None
        return replace(fit, mode=mode, form=form)

    def _store(self, tracked: TrackerOutput, state: SoilState, end: float, problem: ObservationModel) -> None:
        """Store the result for later windows; a mismatch does not become a prior."""
        fit, self.state = tracked.fit, state
        self._fit = fit if fit is not None and fit.converged else None
        if fit is None or tracked.mismatch:
            return
        self._good_until = end
        ratios = correction_ratios(problem, fit.optimum, self.components.options)
        self.components = self.components.after(ratios)
        learned = end - tracked.since >= self.options.min_to_learn * self.settings.window
        if learned and state.name in (TrackerState.STEADY, TrackerState.NEW_SOIL):
            self._posteriors.append((end, replace(fit.mode, form=fit.form)))
            self.newest_posterior = fit.mode


def new_soil_prior(prior: SoilPrior) -> SoilPrior:
    """Return the prior of a new soil, at least as wide as the soils in `terra.soils`; held parameters stay."""
    soils = np.log(list(SOILS.values()))
    return SoilPrior(prior.median, np.where(prior.log_std > 0.0, np.maximum(prior.log_std, soils.std(0)), 0.0))


def gain_errors(rig: Rig, model: WheelModel, free: Sequence[Free]) -> tuple[list[str], Array]:
    """Return names and prior sd (G,) of the nuisance parameters: sensor gains, then effect parameters."""
    problem = ObservationModelWithEffects(window_of_samples(rig, np.array([0.5]), {}), rig, model, 0.0, free=free)
    return problem.gain_names, problem.gain_std
