"""Tracker: the recursion from window to window, and the states in which the soil changes.

    prior of a window = posterior of the newest window that had ended when it began, plus drift since,

        soil   covariance += drift^2 elapsed D D'     (random walk of the coordinates, D their log directions)
        gains  variance   += gain_std^2 min((elapsed + 1) / 60, 1)

    so that no sample counts twice.  Of k_c, n, phi and c the likelihood factor is carried, apart from their priors,
    since likelihoods add up in k_c, n, tan phi and c and not in their logarithms (`Gaussian.likelihood_factor`).

A window starts from the optimum of the last one (warm start).  The change detector compares the newest data
with this prediction by a generalised log likelihood ratio (GLR, see change_detection).  The states:

    STEADY       one soil; the recursion above
    SUSPECT      the GLR exceeds its limit: a change point; two soils, before and after it, do not yet explain the
                 window, or too few data are of the second
    TRANSITION   two soils have much more evidence than one: the second has the wide prior of a new soil and the
                 gains of the recursion; data between the soils are left out, for borders of growing length
    NEW_SOIL     the border is over and less than a window old; once it is out of the window, STEADY

A fit that exceeds its chi-square limit is a mismatch and never a prior.  Searches from many starts are
limited by `SearchBudget`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from soilbus.arrays import Array
from soilbus.estimation.change_detection import Transition, change_statistic, without_transition
from soilbus.estimation.drift_filter import at_window_end
from soilbus.estimation.gaussian import Gaussian
from soilbus.estimation.laplace import with_nested_laplace
from soilbus.estimation.model_form import FormPosterior, form_posterior
from soilbus.estimation.multistart import Fit, WarmStart, fit_warm, fit_window, refit_denoised, warm_start
from soilbus.estimation.nuisance_parameters import Free
from soilbus.estimation.observation_model import RESIDUAL, ObservationModel, ObservationModelWithEffects, Work
from soilbus.estimation.parametrization import Coordinates
from soilbus.estimation.path_curvature import (
    curvature_of,
    detected_curvature,
    fit_on_curved_path,
    straightened,
    with_curvature,
    without_curvature,
)
from soilbus.estimation.posterior import PARAMETERS, SoilPrior
from soilbus.estimation.solver import Objective
from soilbus.estimation.window import Rig, Window, window_of_samples
from soilbus.terra.effects.effect import Effect
from soilbus.terra.soils import SOILS
from soilbus.terra.wheel import Soil, WheelModel

__all__ = [
    "ChangePoint",
    "SearchBudget",
    "Settings",
    "Tracker",
    "TrackerOutput",
    "TrackerState",
    "gain_errors",
    "new_soil_prior",
]

MIN_ROWS = 60
"""Residuals that a window needs; no evidence recorded."""
MIN_RESIDUALS_PER_SOIL = 30
"""Residuals that each of two soils needs before they are compared; no evidence recorded."""
MISMATCH_SD = 3.5
"""Sd of reduced chi-square by which a window may exceed `max_chi2`; no evidence recorded."""
MISMATCH_SD_AFTER_MISMATCH = 0.0
"""The same after a mismatch."""
TRANSITION_SD = 1.5
"""The same just after a border: its remains in the window bias the soil long before they are a mismatch."""
SUSPECT_LOG_LIKELIHOOD_RATIO = 12.0
"""Log likelihood ratio of the change detector above which another soil is fitted; no evidence recorded."""
MIN_EVIDENCE_GAIN = 20.0
"""Fall of -2 log evidence by two soils instead of one from which the change is accepted; no evidence recorded."""
MIN_EXTENSION_GAIN = 25.0
"""Fall of -2 log posterior, beyond the number of residuals left out, from which these are part of the transition."""
MAX_SCALE_STATISTIC = 25.0
"""Score statistic, chi-square with one degree of freedom, above which sinkages are on a wrong scale: 5 sd."""
LOOK_BACK_WINDOWS = 0.2
"""Windows before the end of the last fit's data from which on changes are looked for."""
MIN_WINDOWS_TO_DETECT = 0.3
"""Windows that a new soil must fill before the next change is looked for."""
MIN_WINDOWS_TO_LEARN = 0.5
"""Windows that the data must fill for the posterior to be a later prior: with less it is not Gaussian."""
CHANGE_POINT_WINDOWS = 2.0
"""Windows after a change point during which a change may explain a mismatch."""
UNEXPLAINED_WINDOWS = 0.3
"""Windows after a change point during which data that no soil explains are not yet a mismatch."""
DRIFT_SINCE_MIDDLE_WINDOWS = 0.5
"""Windows of drift between a fit with a constant soil, whose estimate is of the window's middle, and its end."""
SETTLING_RATIO = 2.0
"""Time that a new soil must last, over that of its gradual border, until the transition is over; at most
`MIN_WINDOWS_TO_LEARN`.  No evidence recorded."""
TRANSITION_WHEELBASES = (0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 5.5, 7.5, 10.5)
"""Lengths of a transition that are tried, in wheelbases: borders are sharp or gradual."""
EXTENSION_SHARES = (0.1, 0.25, 0.45, 0.7)
"""Shares of a new soil's data that are tried as part of its transition."""
DEFAULT_WHEELBASE = 2.0
"""Length [m] that stands for the wheelbase of a rig that has none."""
GAIN_MEMORY_WINDOWS = 60.0
"""Windows in which the variance of a sensor gain may grow by its whole prior variance."""
GAIN_CORRELATION_TIME = 86400.0
"""Time [s] in which the autocorrelation of a gain error falls to 1/e: amplifiers drift, tyres wear."""
TIME_TOLERANCE = 1e-3
"""Times [s] closer than this are the same."""
_SOIL = len(PARAMETERS)


class TrackerState(StrEnum):
    """Which soil a window's estimate is of."""

    STEADY = "same"
    """The soil of the windows before."""
    SUSPECT = "changing"
    """The newest data disagree with this soil, but are too few to estimate another; the estimate is of this soil."""
    TRANSITION = "settling"
    """Another soil; the border may not be over: its data do not agree yet or cover too little time."""
    NEW_SOIL = "new"
    """Another soil for less than a window; only its own data count."""


@dataclass(frozen=True, slots=True)
class Settings:
    """Configuration of the tracker.

    Attributes
    ----------
    window : float
        Length of a window [s].
    min_speed : float
        Ground speed [m/s] up to which instants are left out.
    max_turn : float
        Relative difference of an axle's rim speeds above which instants are left out.
    max_chi2 : float
        Reduced chi-square allowed on average.
    drift : float
        Sd of the change of each soil coordinate's logarithm in one window; it grows with the square root of time.
    min_rows : int
        Residuals below which a window is not fitted.
    form : tuple of float
        How far each of `model_form.FORM` may be from the configured model; () holds the form.
    search_rate, search_burst : float
        Evaluations of the model that searches may take, see `SearchBudget`.
    """

    window: float
    min_speed: float
    max_turn: float
    max_chi2: float
    drift: float
    min_rows: int = MIN_ROWS
    form: tuple[float, ...] = ()
    search_rate: float = 4.0
    search_burst: float = 100.0


@dataclass(frozen=True, slots=True)
class TrackerOutput:
    """Result of one window.

    Attributes
    ----------
    fit : Fit or None
        None without enough residuals or where no fit ended.
    mismatch : bool
        Whether the model fails to describe the data.
    state : TrackerState
        Which soil the estimate is of.
    since : float
        Time [s] where the data that count begin.
    standstill, turning : int
        Instants left out.
    search_ended : bool
        Whether the budget of evaluations ended the search for a soil that describes the data.
    """

    fit: Fit | None
    mismatch: bool
    state: TrackerState
    since: float
    standstill: int = 0
    turning: int = 0
    search_ended: bool = False


class ChangePoint(NamedTuple):
    """Time t [s] from which the data disagree with the present soil, and ground speed [m/s] then."""

    t: float
    speed: float


class Tracker:
    """Recursive estimator over windows; it holds all state from window to window.

    Parameters
    ----------
    rig : Rig
        Wheels, geometry and sensor noise.
    prior : SoilPrior
        Configured prior of the soil.
    model : WheelModel
        Wheel-soil model without effects.
    settings : Settings
    effects : Sequence of Effect
        Effects of the model.
    free : Sequence of Free
        Their parameters.
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
        self.rig, self.prior, self.model, self.settings = rig, prior, model, settings
        self.effects, self.free = tuple(effects), tuple(free)
        self._last_run: tuple[Gaussian, float] | None = None
        self.reset()

    @property
    def soil_prior(self) -> SoilPrior:
        """Prior of the present soil: the configured one, or the wider one of a new soil."""
        return self._soil_prior

    @property
    def newest_posterior(self) -> Gaussian | None:
        """Posterior of the newest window that serves as a prior; None before the first."""
        return self._newest_posterior

    def start_from_last_run(self, gaussian: Gaussian, elapsed: float) -> None:
        """Take the gains of the last run, `elapsed` seconds ago, as prior now and after each reset."""
        self._last_run = gaussian, elapsed

    def reset(self) -> None:
        """Forget all windows."""
        self._soil_prior = self.prior
        self._was_mismatch = False  # of the last window
        self._in_transition = False  # and it was of a transition
        self._budget = SearchBudget(self.settings.search_rate, self.settings.search_burst)
        self._fit: Fit | None = None
        self._good_until = -math.inf
        self._change_point: ChangePoint | None = None
        self._transition: Transition | None = None
        self._posteriors: list[tuple[float, Gaussian]] = []
        self._newest_posterior: Gaussian | None = None

    def estimate(self, window: Window, end: float) -> TrackerOutput:
        """Estimate one window; windows come in their order.

        Parameters
        ----------
        window : Window
            Bin means and variances.
        end : float
            Time [s] of the window's end.

        Returns
        -------
        TrackerOutput
        """
        self._budget.next_window(len(window.t), end - self._good_until <= CHANGE_POINT_WINDOWS * self.settings.window)
        return replace(self._estimate(window, end), search_ended=self._budget.ended)

    def _estimate(self, window: Window, end: float) -> TrackerOutput:
        """One step of the recursion: warm start, change detection, states, report."""
        start = end - self.settings.window
        transition = self._transition
        new_soil = transition is not None and (self._in_transition or start < transition.end)
        window = self._of_present_soil(window)
        problem = self._problem(window)
        since = max(transition.end, start) if new_soil and transition else start
        left_out = problem.standstill, problem.turning
        if problem.n_rows < self.settings.min_rows:
            self._fit = None
            return TrackerOutput(None, False, TrackerState.STEADY, since, *left_out)
        self._discard_before(start)
        joint_prior = self._prior_at(since, problem)
        if self._change_point is not None and self._change_point.t <= end - CHANGE_POINT_WINDOWS * self.settings.window:
            self._change_point = None  # a new soil would have been found by now
        last = self._fit
        two_soils = None
        if last is None or (last.second_mode is not None and self._budget.allows()):
            objective, fit = self._search_either_soil(window, problem, joint_prior)
            if self.mismatch(fit) and self._change_point is not None:
                two_soils = self._fit_two_soils(window, self._change_point, fit, joint_prior, None)
        else:
            warm = warm_start(problem, self._soil_prior, last, joint_prior)
            objective, fit = warm.objective, fit_warm(warm)
            if fit is not None and not fit.converged and fit.chi2 <= self.chi2_limit(fit):
                fit = refit_denoised(objective, fit)  # slow convergence in a valley is no sign of a new soil
            if fit is None or not fit.converged:
                fit = self._search(problem, self._soil_prior, joint_prior) or fit
            objective, fit = self._with_path_curvature(window, objective, fit)
            self._change_point = self._change_point_in(window, warm, last, fit, end - since)
            if self._change_point is not None:
                two_soils = self._fit_two_soils(window, self._change_point, fit, joint_prior, last)
            if two_soils is None and self.mismatch(fit) and self._budget.allows():
                objective, fit = self._search_either_soil(window, problem, joint_prior)
        if two_soils is not None:
            return self._stored(replace(two_soils, standstill=left_out[0], turning=left_out[1]), end, problem)
        new_soil = new_soil or self._transition is not transition
        if new_soil and fit is not None and self._is_unsettled(fit):
            objective, fit = self._extend_transition(window, objective, fit)
        fit = self._reported(objective, fit)
        if new_soil and self._transition:
            since, state = max(self._transition.end, start), self._state_after(self._transition, fit, end)
        else:
            state = TrackerState.STEADY
        return self._stored(TrackerOutput(fit, self.mismatch(fit), state, since, *left_out), end, problem)

    def _prior_at(self, t: float, problem: ObservationModel) -> Gaussian:
        """Joint prior of a window from t [s] on: soil, gains, and the window's own unknown path curvature."""
        return with_curvature(self._prior_without_path_curvature(t, problem), curvature_of(problem))

    def _prior_without_path_curvature(self, t: float, problem: ObservationModel) -> Gaussian:
        """Posterior of the newest window that ended by t [s], plus drift since."""
        ended = self._ended(t)
        if not ended:
            return self._initial_prior(problem)
        end, gaussian = self._posteriors[ended[-1]]
        elapsed = (t - end) / self.settings.window
        gains = problem.gain_std**2 * min((elapsed + 1.0) / GAIN_MEMORY_WINDOWS, 1.0)
        if self._transition is not None and end <= self._transition.end:
            return gaussian.with_prior_soil(self._soil_prior).drifted(np.zeros((_SOIL, _SOIL)), gains)
        form = (
            None if gaussian.form is None else gaussian.form.drifted(self.settings.form, elapsed / GAIN_MEMORY_WINDOWS)
        )
        return replace(gaussian.drifted(self._drift(gaussian, elapsed), gains), form=form)

    def _initial_prior(self, problem: ObservationModel) -> Gaussian:
        """Prior of the first window: with the gains of the last run if they pass the prior-conflict test."""
        if self._last_run is not None:
            joint_prior = prior_from_last_run(self._last_run[0], self._soil_prior, problem.gain_std, self._last_run[1])
            if passes_prior_conflict_test(problem, self._soil_prior, joint_prior):
                return joint_prior
            self._last_run = None
        return Gaussian.of(self._soil_prior, problem.gain_std)

    def _drift(self, gaussian: Gaussian, elapsed: float) -> Array:
        """Covariance (6, 6) of the drift of the soil's logarithms in `elapsed` windows."""
        directions = Coordinates(self._soil_prior, float(self.rig.width.mean())).log_directions(gaussian.soil)
        return np.asarray(self.settings.drift**2 * elapsed * (directions @ directions.T))

    def _ended(self, t: float) -> list[int]:
        """Indices of the posteriors of windows that ended by t [s]."""
        return [i for i, (end, _) in enumerate(self._posteriors) if end <= t + TIME_TOLERANCE]

    def _discard_before(self, start: float) -> None:
        """Discard posteriors that no window from `start` [s] on can use as prior."""
        self._posteriors = self._posteriors[max([0, *self._ended(start)]) :]

    def mismatch(self, fit: Fit | None) -> bool:
        """Whether a fit failed or its chi-square exceeds the limit."""
        return fit is None or not fit.converged or fit.chi2 > self.chi2_limit(fit)

    def chi2_limit(self, fit: Fit) -> float:
        """Limit of a fit's reduced chi-square: `max_chi2` + `MISMATCH_SD` sqrt(2 / residuals)."""
        deviations = MISMATCH_SD_AFTER_MISMATCH if self._was_mismatch else MISMATCH_SD
        return self.settings.max_chi2 + deviations * math.sqrt(2.0 / max(fit.rows, 1))

    def _change_point_in(
        self, window: Window, warm: WarmStart, last: Fit, fit: Fit | None, filled: float
    ) -> ChangePoint | None:
        """The change point in a window of which the present soil fills `filled` [s]; None without one.

        While nothing explains the data since, the change point stays what it was.
        """
        end, length = float(window.t[-1]), self.settings.window
        if self._change_point is not None and self.mismatch(fit):
            return self._change_point
        if self._good_until <= end - length or filled <= MIN_WINDOWS_TO_DETECT * length:
            return None
        if fit is not None and fit.curved_path and not self._is_unsettled(fit):
            return None  # path curvature explains the disagreement
        t = warm.objective.problem.t
        first = int(np.searchsorted(t, float(last.optimum.t[-1]) - LOOK_BACK_WINDOWS * length))
        centred = replace(last.reported, soil=last.optimum.soil, gains=last.optimum.gains)
        predicted = centred.drifted(self._drift(centred, DRIFT_SINCE_MIDDLE_WINDOWS), np.zeros(len(centred.gains)))
        statistic = change_statistic(
            warm.objective, predicted, warm.iterate, warm.linearisation, first, SUSPECT_LOG_LIKELIHOOD_RATIO
        )
        if statistic.ratio <= SUSPECT_LOG_LIKELIHOOD_RATIO and fit is not None and fit.chi2 <= self.chi2_limit(fit):
            return None
        begin = float(t[statistic.instant])
        near = window.ground_speed[(window.t >= begin - 1.0) & (window.t <= begin)]
        return ChangePoint(begin, max(float(np.nanmean(near)), self.settings.min_speed))

    def _fit_two_soils(
        self, window: Window, change: ChangePoint, one: Fit | None, joint_prior: Gaussian, last: Fit | None
    ) -> TrackerOutput | None:
        """The window as two soils, the second from the change point on; None where one soil is not much less likely.

        `one` is the fit of one soil.  Without a last fit, or with too few data of the first soil,
        the second soil is fitted alone.
        """
        first = self._problem(window.rows(np.flatnonzero(window.t < change.t - TIME_TOLERANCE)))
        warm = None
        if last is not None and first.n_rows >= MIN_RESIDUALS_PER_SOIL:
            warm = warm_start(first, self._soil_prior, last, joint_prior)
        old = None if warm is None else fit_warm(warm)
        if self.mismatch(old):
            old = None
        if old is None and not self.mismatch(one):
            return None
        new_prior = new_soil_prior(self.prior)
        waits = True
        for transition in self._candidate_transitions(change, float(window.t[0])):
            separated = without_transition(window, transition, self.rig.front)
            second = self._problem(separated.rows(np.flatnonzero(separated.t >= transition.end)))
            arrived = transition.end + transition.lag if self._was_mismatch else transition.end
            if second.n_rows < MIN_RESIDUALS_PER_SOIL or window.t[-1] < arrived:
                break  # after a mismatch both axles and the draft must agree on the new soil
            waits = self.mismatch(one) and window.t[-1] < change.t + UNEXPLAINED_WINDOWS * self.settings.window
            new_joint_prior = self._prior_at(change.t, second).with_prior_soil(new_prior)
            new = self._search(second, new_prior, new_joint_prior)
            if new is None or self.mismatch(new):
                continue
            if old is not None and not self._two_soils_are_likelier(
                old, new, self._search_one_soil(separated, self._problem(separated), joint_prior)[1]
            ):
                return None
            self._transition, self._soil_prior = transition, new_prior
            reported = self._reported(Objective(second, new_prior, new_joint_prior), new)
            return TrackerOutput(
                reported, False, self._state_after(transition, reported, float(window.t[-1])), transition.end
            )
        if warm is None or old is None or not waits:
            return None
        return TrackerOutput(self._reported(warm.objective, old), False, TrackerState.SUSPECT, float(window.t[0]))

    def _candidate_transitions(self, change: ChangePoint, start: float) -> list[Transition]:
        """Transitions of growing length from the change point on; of those over before `start` [s] only the last."""
        chassis = self.rig.chassis
        lag = (DEFAULT_WHEELBASE if chassis is None else chassis.wheelbase) / change.speed
        ends = [change.t + share * lag for share in TRANSITION_WHEELBASES]
        n_over = sum(end <= start for end in ends)
        rear_lag = 0.0 if chassis is None else lag
        return [Transition(change.t - TIME_TOLERANCE, end, rear_lag) for end in ends[max(n_over - 1, 0) :]]

    def _two_soils_are_likelier(self, old: Fit, new: Fit, one: Fit | None) -> bool:
        """Whether two soils have much more evidence than one, of the same data."""
        return (
            one is None
            or not one.converged
            or one.neg2_log_evidence - old.neg2_log_evidence - new.neg2_log_evidence >= MIN_EVIDENCE_GAIN
        )

    def _state_after(self, transition: Transition, fit: Fit | None, end: float) -> TrackerState:
        """State at `end` [s] after a transition: NEW_SOIL once it is over, else TRANSITION."""
        length = transition.end - transition.begin
        sharp = length < transition.lag + self.settings.window / 100.0  # shorter than the vehicle
        needed = 0.0 if sharp else min(SETTLING_RATIO * length, MIN_WINDOWS_TO_LEARN * self.settings.window)
        is_over = end - transition.end >= needed and fit is not None and not self._is_unsettled(fit)
        return TrackerState.NEW_SOIL if is_over else TrackerState.TRANSITION

    def _is_unsettled(self, fit: Fit) -> bool:
        """Whether the chi-square of a new soil's fit exceeds its limit just after a border."""
        return not fit.converged or fit.chi2 > self.settings.max_chi2 + TRANSITION_SD * math.sqrt(
            2.0 / max(fit.rows, 1)
        )

    def _extend_transition(self, window: Window, objective: Objective, fit: Fit) -> tuple[Objective, Fit]:
        """The fit after a longer transition, if the data that it leaves out are why the others do not agree."""
        transition = self._transition
        assert transition is not None  # only called after one
        begin = max(transition.end, float(window.t[0]))
        for end in (begin + share * (float(window.t[-1]) - begin) for share in EXTENSION_SHARES):
            extended = transition._replace(end=end)
            separated = without_transition(window, extended, self.rig.front)
            problem = self._problem(separated.rows(np.flatnonzero(separated.t >= extended.end)))
            if problem.n_rows < 2 * MIN_RESIDUALS_PER_SOIL:
                break
            joint_prior = objective.joint_prior
            shorter = self._search(problem, self._soil_prior, joint_prior)
            if shorter is None or self._is_unsettled(shorter):
                continue
            fall, noise = fit.neg2_log_posterior - shorter.neg2_log_posterior, fit.rows - shorter.rows
            if fall > noise + MIN_EXTENSION_GAIN:
                self._transition = extended
                return Objective(problem, self._soil_prior, joint_prior), shorter
        return objective, fit

    def _search_either_soil(
        self, window: Window, problem: ObservationModel, joint_prior: Gaussian
    ) -> tuple[Objective, Fit | None]:
        """A searched fit of one soil: the present one, or a new one where that one's prior conflicts with the data."""
        objective, fit = self._search_one_soil(window, problem, joint_prior)
        if self.mismatch(fit) and self._posteriors:
            new_prior = new_soil_prior(self.prior)
            new_joint_prior = joint_prior.with_prior_soil(new_prior)
            other = self._search(problem, new_prior, new_joint_prior)
            if not self.mismatch(other):
                begin = float(problem.t[0])
                self._transition, self._soil_prior = Transition(begin, begin, 0.0), new_prior
                return Objective(problem, new_prior, new_joint_prior), other
        return objective, fit

    def _search_one_soil(
        self, window: Window, problem: ObservationModel, joint_prior: Gaussian
    ) -> tuple[Objective, Fit | None]:
        """A searched fit of a window as one soil, the present one."""
        fit = self._search(problem, self._soil_prior, joint_prior)
        return self._with_path_curvature(window, Objective(problem, self._soil_prior, joint_prior), fit)

    def _search(self, problem: ObservationModel, prior: SoilPrior, joint_prior: Gaussian) -> Fit | None:
        """A fit from many starts; None also where the budget allows no search."""
        if not self._budget.allows():
            return None
        work_before = self._budget.work.instants
        fit = fit_window(problem, prior, joint_prior)
        self._budget.spend(work_before)
        return fit

    def _with_path_curvature(
        self, window: Window, objective: Objective, fit: Fit | None
    ) -> tuple[Objective, Fit | None]:
        """The fit with detected path curvature removed; not just after a border, whose residuals that would hide."""
        if self._transition is not None and float(window.t[-1]) < self._transition.end + self.settings.window:
            return objective, fit
        path = detected_curvature(objective, fit)
        if fit is None or path is None:
            return objective, fit
        return fit_on_curved_path(objective, fit, path, self._problem(straightened(window, self.rig, path)))

    def _reported(self, objective: Objective, fit: Fit | None) -> Fit | None:
        """The fit as it is reported: with nested Laplace moments and open form, of the soil at the window's end."""
        if fit is None or not fit.converged:
            return fit
        if not self.mismatch(fit):
            off_scale = sinkages_off_scale(objective, fit)
            fit = with_nested_laplace(objective.problem, objective.coordinates.prior, objective.joint_prior, fit)
            fit = replace(fit, off_scale=off_scale)
        fit = replace(fit, form=self._form_posterior(objective, fit))
        return at_window_end(objective, fit, self.settings.window, self.settings.drift)

    def _form_posterior(self, objective: Objective, fit: Fit) -> FormPosterior | None:
        """Part of a fit that the form of the model leaves open; None where the form is held."""
        if not any(self.settings.form):
            return None
        joint_prior = objective.joint_prior.form or FormPosterior.of(self.settings.form, len(fit.gains))
        with np.errstate(all="ignore"):
            return form_posterior(objective, fit, joint_prior)

    def _stored(self, tracked: TrackerOutput, end: float, problem: ObservationModel) -> TrackerOutput:
        """Store the result for later windows and return it; a mismatch does not become a prior."""
        fit = tracked.fit
        self._fit = None
        if fit is not None and fit.converged:  # the next window's data have their path curvature again
            self._fit = (
                fit if fit.curved_path is None else replace(fit, optimum=fit.curved_path.optimum, curved_path=None)
            )
        if fit is not None:
            self._was_mismatch = tracked.mismatch
            self._in_transition = tracked.mismatch and tracked.state is TrackerState.TRANSITION
        if fit is not None and not tracked.mismatch:
            self._good_until = end
            learned = end - tracked.since >= MIN_WINDOWS_TO_LEARN * self.settings.window and fit.is_gaussian
            if learned and tracked.state in (TrackerState.STEADY, TrackerState.NEW_SOIL):
                curvature = curvature_of(problem)
                posterior = without_curvature(fit.mode.likelihood_factor(self._soil_prior), curvature)
                self._posteriors.append((end, replace(posterior, form=fit.form)))
                self._newest_posterior = without_curvature(fit.reported, curvature)
        return tracked

    def _of_present_soil(self, window: Window) -> Window:
        """The window's data after the last transition."""
        if self._transition is None:
            return window
        window = without_transition(window, self._transition, self.rig.front)
        return window.rows(np.flatnonzero(window.t >= self._transition.end))

    def _problem(self, window: Window) -> ObservationModel:
        speed, turn = self.settings.min_speed, self.settings.max_turn
        problem = ObservationModelWithEffects(window, self.rig, self.model, speed, turn, self.effects, self.free)
        problem.work = self._budget.work
        return problem


class SearchBudget:
    """Token bucket of model evaluations for searches, counted in whole windows, so that a replay is reproducible.

    Parameters
    ----------
    rate : float
        Evaluations that each window adds.
    burst : float
        Most evaluations that are kept for later.

    Notes
    -----
    A window that follows another needs a few evaluations.  At a start, a border or after a gap
    a search from many soils is due, and soon succeeds.  Where the model does not describe the
    data no search succeeds, window after window; the empty bucket then limits the cost.

    References
    ----------
    Turner 1986, IEEE Communications 24(10):8.

    Examples
    --------
    >>> budget = SearchBudget(rate=4.0, burst=10.0)
    >>> budget.next_window(instants=200)
    >>> budget.allows()
    True
    >>> before = budget.work.instants
    >>> budget.work.instants += 2000  # ten evaluations of the window
    >>> budget.spend(before)
    >>> budget.allows()
    False
    """

    def __init__(self, rate: float, burst: float) -> None:
        self.work = Work()
        self._rate, self._burst = rate, burst
        self._remaining, self._window = burst, 1
        self.ended = False

    def next_window(self, instants: int, refill: bool = False) -> None:
        """A window of N instants begins; refill: the model described recent data, so the bucket is filled."""
        self._remaining = self._burst if refill else min(self._remaining + self._rate, self._burst)
        self._window = max(instants, 1)
        self.ended = False

    def allows(self) -> bool:
        """Whether evaluations remain for a search; if not, `ended` is set."""
        self.ended = self.ended or self._remaining <= 0.0
        return self._remaining > 0.0

    def spend(self, work_before: int) -> None:
        """Take the evaluations since `work_before` [instants] from the bucket, which one search may overdraw."""
        self._remaining -= (self.work.instants - work_before) / self._window


def new_soil_prior(prior: SoilPrior) -> SoilPrior:
    """Prior of a new soil: log sd at least the spread of the soils in `terra.soils`; held parameters stay held."""
    soils = np.log(list(SOILS.values()))
    return SoilPrior(prior.median, np.where(prior.log_std > 0.0, np.maximum(prior.log_std, soils.std(0)), 0.0))


def prior_from_last_run(gaussian: Gaussian, soil: SoilPrior, gain_std: Array, elapsed: float) -> Gaussian:
    """Joint prior of a run from the posterior of the last one: the soil's prior, and gains drawn back to theirs.

    Parameters
    ----------
    gaussian : Gaussian
        Posterior at the end of the last run.
    soil : SoilPrior
        Prior of the soil; the vehicle may stand on another one now.
    gain_std : Array
        Prior sd of the gains (G,).
    elapsed : float
        Time since then [s].

    Returns
    -------
    Gaussian
        Gains k g with variance k^2 var + (1 - k^2) gain_std^2, k = exp(-elapsed / GAIN_CORRELATION_TIME).

    References
    ----------
    Gain errors as a stationary process: Uhlenbeck & Ornstein 1930, Phys. Rev. 36, 823.
    """
    kept = math.exp(-elapsed / GAIN_CORRELATION_TIME) * (gain_std > 0.0)
    covariance = np.zeros_like(gaussian.covariance)
    covariance[:_SOIL, :_SOIL] = np.diag(soil.log_std**2)
    of_gains = kept[:, None] * gaussian.covariance[_SOIL:, _SOIL:] * kept
    covariance[_SOIL:, _SOIL:] = of_gains + np.diag((1.0 - kept**2) * gain_std**2)
    return Gaussian(soil.median, kept * gaussian.gains, covariance)


def passes_prior_conflict_test(problem: ObservationModel, soil: SoilPrior, joint_prior: Gaussian) -> bool:
    """Whether a window's evidence with the gains of the last run is at least that with their prior alone.

    A sensor exchanged or calibrated since then has another gain error and fails the test.
    """
    other = fit_window(problem, soil, Gaussian.of(soil, problem.gain_std))
    fit = fit_window(problem, soil, joint_prior)
    if fit is None or not fit.converged:
        return False
    return other is None or not other.converged or fit.neg2_log_evidence <= other.neg2_log_evidence


def gain_errors(rig: Rig, model: WheelModel, free: Sequence[Free]) -> tuple[list[str], Array]:
    """Names and prior sd (G,) of a vehicle's nuisance parameters: sensor gains, then effect parameters."""
    problem = ObservationModelWithEffects(window_of_samples(rig, np.array([0.5]), {}), rig, model, 0.0, free=free)
    return problem.gain_names, problem.gain_std


def sinkages_off_scale(objective: Objective, fit: Fit) -> bool:
    """Whether the sinkages of all wheels, or of one wheel, would fit much better times a factor.

    Parameters
    ----------
    objective : Objective
        Of the fitted window.
    fit : Fit
        Its fit.

    Returns
    -------
    bool
        False where sinkage is not measured.

    Notes
    -----
    Sinkage sensors that read 10 % too little lead to another soil, which explains the rest
    nearly as well: chi-square rises by a tenth, which passes for noise, while bearing pressures
    are wrong by a fifth.  But no soil makes all sinkages, or those of one wheel, proportionally
    larger, so a score test along this direction separates the two, at the optimum and without
    another fit.  The information of the scale is taken as if loads and speeds had no noise,
    so the statistic is a little underestimated.

    References
    ----------
    Rao 1948, Proc. Camb. Phil. Soc. 44:50.
    """
    problem, optimum = objective.problem, fit.optimum
    approximation = objective.approximation_at(optimum)
    if not problem.with_sinkage or approximation is None:
        return False
    at, soil = optimum.at, Soil(*optimum.soil.tolist())
    (n, m), wheels = at.by_latents.shape[:2], problem.n_wheels
    sinkage = np.where(problem.has_sinkage, problem.sinkages(soil, optimum.gains, optimum.latents), 0.0)
    weighed = at.weighed.reshape(n, m, -1)[:, problem.layout.sinkages]
    of_wheels = np.einsum("iw,iwk->wk", sinkage, weighed)
    of_gradient, of_information = approximation.explained(of_wheels @ approximation.directions)
    gradient = of_wheels[:, RESIDUAL] - of_gradient
    square = np.divide(sinkage**2, problem.sinkage_var, where=problem.has_sinkage, out=np.zeros((n, wheels)))
    information = np.diag(square.sum(axis=0)) - of_information
    scales = np.vstack([np.ones(wheels), np.eye(wheels)[sinkage.any(axis=0)]])
    fall = (scales @ gradient) ** 2 / np.einsum("sw,wv,sv->s", scales, information, scales)
    return bool(fall.max() > MAX_SCALE_STATISTIC)
