"""What the tracker is told, and what it says of a window.

What one run knew of the sensors, for the next run: the soil may be another by then, the sensors are the same.

Sinkages on a scale of their own: what a window's chi-square as a whole does not see.

Sinkage sensors that read a tenth too little make another soil of it, which explains the
rest nearly as well: chi-square rises by a tenth, no more than what passes for noise, and
bearing pressures go astray by a fifth.  But nothing in a soil makes all sinkages, or those of one wheel,
proportionally larger, so that along this one direction the data tell it from any soil: a score test
(Rao 1948, Proc. Camb. Phil. Soc. 44:50), at the optimum of the fit, with no fit of its own.

From window to window: what earlier windows told, and where the soil changes.

Each window is estimated from its own data and from what was known when it began: the
posterior of the newest window that had ended by then, widened by the drift of the soil
since.  No sample counts twice.  Of k_c it is carried what data told, apart from its prior,
since they add up in k_c and not in its logarithm (Belief.apart_from).
Where the newest data disagree with what was known and another soil explains them much better,
they alone count, with the configured prior for the soil and what is known of the sensors.
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
from soilbus.estimation.model_form import FormLeft, form_left
from soilbus.estimation.multistart import Fit, WarmStart, fit_warm, fit_window, refit_denoised, warm_start
from soilbus.estimation.nuisance_parameters import Free
from soilbus.estimation.observation_model import ObservationModel, ObservationModelWithEffects, Work
from soilbus.estimation.parametrization import Coordinates
from soilbus.estimation.path_curvature import (
    curve_of,
    detected_curvature,
    fit_on_curved_path,
    straightened,
    with_curve,
    without_curve,
)
from soilbus.estimation.posterior import PARAMETERS, SoilPrior
from soilbus.estimation.solver import Objective
from soilbus.estimation.window import Rig, Window, window_of_samples
from soilbus.terra.effects.effect import Effect
from soilbus.terra.soils import SOILS
from soilbus.terra.wheel import Soil, WheelModel

__all__ = ["ChangePoint", "Ground", "SearchBudget", "Settings", "Tracker", "TrackerOutput", "elsewhere", "gain_errors"]

MIN_ROWS = 60
"""Residuals that a window needs."""


class Ground(StrEnum):
    """What the data of a window are of."""

    SAME = "same"
    NEW = "new"
    """Another soil than before, since less than a window: only its own data count."""
    CHANGING = "changing"
    """Too little of another soil is in to tell it; the estimate is of the one before."""
    SETTLING = "settling"
    """Another soil than before, whose border may go on: its data do not agree, or are of too little time."""


@dataclass(frozen=True, slots=True)
class Settings:
    """What the tracker needs to be told; times s, speeds m/s.

    drift: sd of the logarithm of each soil coordinate after one window; it grows with the
    square root of time.  min_rows: residuals below which a window is not fitted.
    search_rate, search_burst: evaluations of the model that searches may take, see SearchBudget.
    form: how far each of model_form.FORM may be from the configured model's; () leaves none of it open.
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
    """A window's fit (None without), whether the model fails to describe its data, and of which ground they are.

    since [s] is where the data that count begin; standstill and turning count instants left out.
    search_ended: the budget of evaluations ended the search for a soil that describes the data.
    """

    fit: Fit | None
    mismatch: bool
    ground: Ground
    since: float
    standstill: int = 0
    turning: int = 0
    search_ended: bool = False


PERSISTENCE = 86400.0
"""Time [s] in which a gain error forgets all but 1/e of what it was: amplifiers drift, tyres wear."""
_SOIL = len(PARAMETERS)


def prior_from_last_run(gaussian: Gaussian, soil: SoilPrior, gain_std: Array, elapsed: float) -> Gaussian:
    """What is left of a belief after a pause of so many seconds: gains (G,), each drawn back to its prior.

    Of the soil nothing is left but its prior: where the vehicle stands now nobody has
    measured, and a window that tells little would agree with any soil.  Gain errors wander
    about zero with the prior's std as their stationary one (Uhlenbeck & Ornstein 1930,
    Phys. Rev. 36, 823), so that a long pause leaves the prior.
    """
    kept = math.exp(-elapsed / PERSISTENCE) * (gain_std > 0.0)
    covariance = np.zeros_like(gaussian.covariance)
    covariance[:_SOIL, :_SOIL] = np.diag(soil.log_std**2)
    of_gains = kept[:, None] * gaussian.covariance[_SOIL:, _SOIL:] * kept
    covariance[_SOIL:, _SOIL:] = of_gains + np.diag((1.0 - kept**2) * gain_std**2)
    return Gaussian(soil.median, kept * gaussian.gains, covariance)


def passes_prior_conflict_test(problem: ObservationModel, soil: SoilPrior, known: Gaussian) -> bool:
    """Whether a window's data are at least as likely with what is known of the gains as with their prior alone.

    A sensor that was exchanged or calibrated meanwhile has another error than it had.
    """
    anew = fit_window(problem, soil, Gaussian.of(soil, problem.gain_std))
    fit = fit_window(problem, soil, known)
    if fit is None or not fit.converged:
        return False
    return anew is None or not anew.converged or fit.neg2_log_evidence <= anew.neg2_log_evidence


def gain_errors(rig: Rig, model: WheelModel, free: Sequence[Free]) -> tuple[list[str], Array]:
    """Names and prior std (G,) of the gain errors that every window of a vehicle has, its effects' parameters last."""
    problem = ObservationModelWithEffects(window_of_samples(rig, np.array([0.5]), {}), rig, model, 0.0, free=free)
    return problem.gain_names, problem.gain_std


OFF_SCALE = 25.0
"""Fall of the cost, if sinkages were measured on another scale, from which that is no noise."""


def sinkages_off_scale(fitting: Objective, fit: Fit) -> bool:
    """Whether the sinkages of all wheels, or of one, would fit much better on another scale; no where there are none.

    The information that the noise of loads and speeds leaves of the scale is taken too
    large, as if there were none: the fall of the cost is a little underestimated.
    """
    problem, optimum = fitting.problem, fit.optimum
    approximation = fitting.approximation_at(optimum)
    if not problem.with_sinkage or approximation is None:
        return False
    at, soil = optimum.at, Soil(*optimum.soil.tolist())
    (n, m), wheels = at.by_latents.shape[:2], problem.n_wheels
    sinkage = np.where(problem.has_sinkage, problem.sinkages(soil, optimum.gains, optimum.latents), 0.0)
    weighed = at.weighed.reshape(n, m, -1)[:, m - wheels :]
    of_wheels = np.einsum("iw,iwk->wk", sinkage, weighed)
    of_gradient, of_information = approximation.explained(of_wheels @ approximation.directions)
    gradient = of_wheels[:, 0] - of_gradient
    square = np.divide(sinkage**2, problem.sinkage_var, where=problem.has_sinkage, out=np.zeros((n, wheels)))
    information = np.diag(square.sum(axis=0)) - of_information
    scales = np.vstack([np.ones(wheels), np.eye(wheels)[sinkage.any(axis=0)]])
    fall = (scales @ gradient) ** 2 / np.einsum("sw,wv,sv->s", scales, information, scales)
    return bool(fall.max() > OFF_SCALE)


MIN_NEW_ROWS = 30
"""Residuals that each of two soils needs to be told apart."""
ALARM = 12.0
"""Log likelihood ratio from which another soil is looked for."""
CHANGED = 20.0
"""Fall of -2 log evidence from which it is believed."""
TRUST, TRUST_AGAIN = 3.5, 0.0
"""Standard deviations of chi-square that a window may have above the allowed: always, and after a mismatch."""
SETTLED = 1.5
"""The same just after a border: what is left of it in the window misleads long before it is a mismatch."""
AS_LONG = 2.0
"""Times a gradual border for which a new soil must last until that is over; at most as long as until it is learned."""
LOOK_BACK = 0.2
"""Share of a window before the end of the last fit's data from which on a change is looked for."""
RECENT = 2.0
"""Windows after the first sign of another soil within which it may be why the model fails; then something else is."""
PATIENCE = 0.3
"""Share of a window after the first sign of another soil until its data, if no soil explains them, are a mismatch."""
SINCE_THE_MIDDLE = 0.5
"""Windows that a soil may have drifted since it was what a fit that takes it for constant says."""
GRACE = 0.3
"""Share of a window that a new soil must fill before the next change is looked for."""
LEARNED = 0.5
"""Share of a window that its data must fill for later windows to build on it: the posterior of less is not Gaussian."""
BORDERS = (0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 5.5, 7.5, 10.5)
"""Lengths after the first sign of another soil that may be of neither, in wheelbases: borders are sharp or gradual."""
LONGER = (0.1, 0.25, 0.45, 0.7)
"""Shares of the data of a new soil that may turn out to be of its border after all."""
OF_BORDER = 25.0
"""Fall of the cost, beyond that of as many residuals of noise, from which data are of the border after all."""
GAIN_MEMORY = 60.0
"""Windows in which a sensor's gain error may change by its whole uncertainty."""
WHEELBASE = 2.0
"""Length [m] that stands for the wheelbase of a rig that has none."""
_SAME_TIME = 1e-3


class ChangePoint(NamedTuple):
    """When the data first disagreed with the soil known [s], and how fast the vehicle then was [m/s]."""

    t: float
    speed: float


def elsewhere(prior: SoilPrior) -> SoilPrior:
    """Prior of a soil that the vehicle came upon: at least as wide as known soils differ, what is held stays held."""
    soils = np.log(list(SOILS.values()))
    return SoilPrior(prior.median, np.where(prior.log_std > 0.0, np.maximum(prior.log_std, soils.std(0)), 0.0))


class SearchBudget:
    """Evaluations of whole windows: `rate` come with each window, at most `burst` are kept for later."""

    def __init__(self, rate: float, burst: float) -> None:
        self.work = Work()
        self._rate, self._burst = rate, burst
        self._left, self._window = burst, 1
        self.ended = False

    def next_window(self, instants: int, renewed: bool = False) -> None:
        """A window of so many instants begins; renewed: the model described data lately, and may again."""
        self._left = self._burst if renewed else min(self._left + self._rate, self._burst)
        self._window = max(instants, 1)
        self.ended = False

    def allows(self) -> bool:
        """Whether there is anything left for a search; where not, the window's search has ended."""
        self.ended = self.ended or self._left <= 0.0
        return self._left > 0.0

    def spend(self, begun: int) -> None:
        """A search has ended that began at so many instants of work; the last one may cost more than was left."""
        self._left -= (self.work.instants - begun) / self._window


class Tracker:
    """Solves one window after the other; all state from window to window is here."""

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
        self._recalled: tuple[Gaussian, float] | None = None
        self.forget()

    @property
    def here(self) -> SoilPrior:
        """Prior of the present soil: the configured one, or a wider one after the soil has changed."""
        return self._here

    @property
    def newest(self) -> Gaussian | None:
        """What the newest window told of which later ones build on the data; None before there is one."""
        return self._newest

    def recall(self, gaussian: Gaussian, elapsed: float) -> None:
        """Begin, now and whenever anew, with what another run knew of the gains so many seconds ago."""
        self._recalled = gaussian, elapsed

    def forget(self) -> None:
        """Begin anew."""
        self._here = self.prior  # of the present soil
        self._distrusted = self._in_border = False  # the last window was a mismatch; and of no soil since a border
        self._budget = SearchBudget(self.settings.search_rate, self.settings.search_burst)
        self._fit: Fit | None = None
        self._good_until = -math.inf
        self._alarm: ChangePoint | None = None
        self._crossing: Transition | None = None
        self._gaussians: list[tuple[float, Gaussian]] = []
        self._newest: Gaussian | None = None

    def estimate(self, window: Window, end: float) -> TrackerOutput:
        """One window that ends at `end` [s]; windows in their order."""
        self._budget.next_window(len(window.t), end - self._good_until <= RECENT * self.settings.window)
        return replace(self._estimate(window, end), search_ended=self._budget.ended)

    def _estimate(self, window: Window, end: float) -> TrackerOutput:
        start = end - self.settings.window
        crossing = self._crossing
        new = crossing is not None and (self._in_border or start < crossing.end)
        window = self._of_this_soil(window)
        problem = self._problem(window)
        since = max(crossing.end, start) if new and crossing else start
        left_out = problem.standstill, problem.turning
        if problem.n_rows < self.settings.min_rows:
            self._fit = None
            return TrackerOutput(None, False, Ground.SAME, since, *left_out)
        self._forget_before(start)
        joint_prior = self._known_at(since, problem)
        if self._alarm is not None and self._alarm.t <= end - RECENT * self.settings.window:
            self._alarm = None  # another soil would have been found by now
        last = self._fit
        changed = None
        if last is None or (last.second_mode is not None and self._budget.allows()):
            fitting, fit = self._afresh(window, problem, joint_prior)
            if self.mismatch(fit) and self._alarm is not None:
                changed = self._another_soil(window, self._alarm, fit, joint_prior, None)
        else:
            ahead = warm_start(problem, self._here, last, joint_prior)
            fitting, fit = ahead.fitting, fit_warm(ahead)
            if fit is not None and not fit.converged and fit.chi2 <= self.chi2_limit(fit):
                fit = refit_denoised(fitting, fit)  # a long valley is no sign of another soil
            if fit is None or not fit.converged:
                fit = self._searched(problem, self._here, joint_prior) or fit
            fitting, fit = self._on_the_way(window, fitting, fit)
            self._alarm = self._alarm_in(window, ahead, last, fit, end - since)
            if self._alarm is not None:
                changed = self._another_soil(window, self._alarm, fit, joint_prior, last)
            if changed is None and self.mismatch(fit) and self._budget.allows():
                fitting, fit = self._afresh(window, problem, joint_prior)
        if changed is not None:
            return self._remembered(replace(changed, standstill=left_out[0], turning=left_out[1]), end, problem)
        new = new or self._crossing is not crossing
        if new and fit is not None and self._unsettled(fit):
            fitting, fit = self._past_the_border(window, fitting, fit)
        fit = self._told(fitting, fit)
        if new and self._crossing:
            since, ground = max(self._crossing.end, start), self._new_ground(self._crossing, fit, end)
        else:
            ground = Ground.SAME
        return self._remembered(TrackerOutput(fit, self.mismatch(fit), ground, since, *left_out), end, problem)

    def _alarm_in(
        self, window: Window, ahead: WarmStart, last: Fit, fit: Fit | None, filled: float
    ) -> ChangePoint | None:
        """The first sign of another soil in a window of which the present one fills so much [s], if there is any.

        As long as nothing explains the data since, the alarm stays what it was.
        """
        end, length = float(window.t[-1]), self.settings.window
        if self._alarm is not None and self.mismatch(fit):
            return self._alarm
        if self._good_until <= end - length or filled <= GRACE * length:
            return None
        if fit is not None and fit.curved_path and not self._unsettled(fit):
            return None  # a curve is why
        t = ahead.fitting.problem.t
        first = int(np.searchsorted(t, float(last.optimum.t[-1]) - LOOK_BACK * length))
        place = replace(last.reported, soil=last.optimum.soil, gains=last.optimum.gains)
        known = place.drifted(self._drift(place, SINCE_THE_MIDDLE), np.zeros(len(place.gains)))
        doubt = change_statistic(ahead.fitting, known, ahead.place, ahead.at, first, ALARM)
        if doubt.ratio <= ALARM and fit is not None and fit.chi2 <= self.chi2_limit(fit):
            return None
        begin = float(t[doubt.instant])
        near = window.ground_speed[(window.t >= begin - 1.0) & (window.t <= begin)]
        return ChangePoint(begin, max(float(np.nanmean(near)), self.settings.min_speed))

    def _afresh(self, window: Window, problem: ObservationModel, joint_prior: Gaussian) -> tuple[Objective, Fit | None]:
        """A fit that starts anywhere; what was known of the soil counts only where it agrees with the data."""
        fitting, fit = self._as_one(window, problem, joint_prior)
        if self.mismatch(fit) and self._gaussians:
            there = elsewhere(self.prior)
            known = joint_prior.of_another_soil(there)
            other = self._searched(problem, there, known)
            if not self.mismatch(other):
                begin = float(problem.t[0])
                self._crossing, self._here = Transition(begin, begin, 0.0), there
                return Objective(problem, there, known), other
        return fitting, fit

    def _told(self, fitting: Objective, fit: Fit | None) -> Fit | None:
        """A fit that is going to be reported: with the whole posterior, of the soil at the window's end."""
        if fit is None or not fit.converged:
            return fit
        if not self.mismatch(fit):
            off_scale = sinkages_off_scale(fitting, fit)
            fit = with_nested_laplace(fitting.problem, fitting.coordinates.prior, fitting.joint_prior, fit)
            fit = replace(fit, off_scale=off_scale)
        fit = replace(fit, form=self._form_left(fitting, fit))
        return at_window_end(fitting, fit, self.settings.window, self.settings.drift)

    def _form_left(self, fitting: Objective, fit: Fit) -> FormLeft | None:
        """What the form of the model leaves open of a fit."""
        if not any(self.settings.form):
            return None
        joint_prior = fitting.joint_prior.form or FormLeft.of(self.settings.form, len(fit.gains))
        with np.errstate(all="ignore"):
            return form_left(fitting, fit, joint_prior)

    def mismatch(self, fit: Fit | None) -> bool:
        """Whether a fit failed or leaves more than noise."""
        return fit is None or not fit.converged or fit.chi2 > self.chi2_limit(fit)

    def chi2_limit(self, fit: Fit) -> float:
        """Reduced chi-square that noise alone reaches hardly ever with this many residuals."""
        deviations = TRUST_AGAIN if self._distrusted else TRUST
        return self.settings.max_chi2 + deviations * math.sqrt(2.0 / max(fit.rows, 1))

    def _remembered(self, tracked: TrackerOutput, end: float, problem: ObservationModel) -> TrackerOutput:
        """The same, taken note of; a failed or bad fit leaves what is known alone."""
        fit = tracked.fit
        self._fit = None
        if fit is not None and fit.converged:  # the next window has all its bends again
            self._fit = (
                fit if fit.curved_path is None else replace(fit, optimum=fit.curved_path.optimum, curved_path=None)
            )
        if fit is not None:
            self._distrusted = tracked.mismatch
            self._in_border = tracked.mismatch and tracked.ground is Ground.SETTLING
        if fit is not None and not tracked.mismatch:
            self._good_until = end
            learned = end - tracked.since >= LEARNED * self.settings.window and fit.is_gaussian
            if learned and tracked.ground in (Ground.SAME, Ground.NEW):
                curve = curve_of(problem)
                told = without_curve(fit.mode.likelihood_factor(self._here), curve)
                self._gaussians.append((end, replace(told, form=fit.form)))
                self._newest = without_curve(fit.reported, curve)
        return tracked

    def _known_at(self, t: float, problem: ObservationModel) -> Gaussian:
        """What windows that had ended by t [s] tell of the soil from t on, and of the sensors on whatever curve."""
        return with_curve(self._told_by(t, problem), curve_of(problem))

    def _told_by(self, t: float, problem: ObservationModel) -> Gaussian:
        ended = self._ended(t)
        if not ended:
            return self._known_at_first(problem)
        end, gaussian = self._gaussians[ended[-1]]
        elapsed = (t - end) / self.settings.window
        gains = problem.gain_std**2 * min((elapsed + 1.0) / GAIN_MEMORY, 1.0)
        if self._crossing is not None and end <= self._crossing.end:
            return gaussian.of_another_soil(self._here).drifted(np.zeros((_SOIL, _SOIL)), gains)
        form = None if gaussian.form is None else gaussian.form.drifted(self.settings.form, elapsed / GAIN_MEMORY)
        return replace(gaussian.drifted(self._drift(gaussian, elapsed), gains), form=form)

    def _ended(self, t: float) -> list[int]:
        return [i for i, (end, _) in enumerate(self._gaussians) if end <= t + _SAME_TIME]

    def _known_at_first(self, problem: ObservationModel) -> Gaussian:
        """Before any window: the prior, and the gains of another run unless the data speak against them."""
        if self._recalled is not None:
            known = prior_from_last_run(self._recalled[0], self._here, problem.gain_std, self._recalled[1])
            if passes_prior_conflict_test(problem, self._here, known):
                return known
            self._recalled = None
        return Gaussian.of(self._here, problem.gain_std)

    def _forget_before(self, start: float) -> None:
        """Only the newest of the beliefs that windows from `start` [s] on may build on is kept, and what follows it."""
        self._gaussians = self._gaussians[max([0, *self._ended(start)]) :]

    def _drift(self, gaussian: Gaussian, elapsed: float) -> Array:
        """Covariance (6, 6) by which the soil's logarithms drift in so many windows."""
        directions = Coordinates(self._here, float(self.rig.width.mean())).log_directions(gaussian.soil)
        return np.asarray(self.settings.drift**2 * elapsed * (directions @ directions.T))

    def _another_soil(
        self, window: Window, alarm: ChangePoint, one: Fit | None, joint_prior: Gaussian, last: Fit | None
    ) -> TrackerOutput | None:
        """The window as two soils, the second from the alarm on, if that is much likelier than `one`; else None.

        Without a last fit, or where the first soil is out of the window, the second alone.
        """
        first = self._problem(window.rows(np.flatnonzero(window.t < alarm.t - _SAME_TIME)))
        ahead = None
        if last is not None and first.n_rows >= MIN_NEW_ROWS:
            ahead = warm_start(first, self._here, last, joint_prior)
        old = None if ahead is None else fit_warm(ahead)
        if self.mismatch(old):
            old = None
        if old is None and not self.mismatch(one):
            return None
        there = elsewhere(self.prior)
        waits = True
        for crossing in self._crossings(alarm, float(window.t[0])):
            apart = without_transition(window, crossing, self.rig.front)
            second = self._problem(apart.rows(np.flatnonzero(apart.t >= crossing.end)))
            arrived = crossing.end + crossing.lag if self._distrusted else crossing.end
            if second.n_rows < MIN_NEW_ROWS or window.t[-1] < arrived:
                break  # after a mismatch the wheels of both axles must agree, and agree with the draft
            waits = self.mismatch(one) and window.t[-1] < alarm.t + PATIENCE * self.settings.window
            known = self._known_at(alarm.t, second).of_another_soil(there)
            new = self._searched(second, there, known)
            if new is None or self.mismatch(new):
                continue
            if old is not None and not self._likelier(
                old, new, self._as_one(apart, self._problem(apart), joint_prior)[1]
            ):
                return None
            self._crossing, self._here = crossing, there
            told = self._told(Objective(second, there, known), new)
            return TrackerOutput(told, False, self._new_ground(crossing, told, float(window.t[-1])), crossing.end)
        if ahead is None or old is None or not waits:
            return None
        return TrackerOutput(self._told(ahead.fitting, old), False, Ground.CHANGING, float(window.t[0]))

    def _new_ground(self, crossing: Transition, fit: Fit | None, end: float) -> Ground:
        """Whether the border before a window that ends at `end` [s] is over: a long one may go on."""
        length = crossing.end - crossing.begin
        sharp = length < crossing.lag + self.settings.window / 100.0  # shorter than the vehicle
        needed = 0.0 if sharp else min(AS_LONG * length, LEARNED * self.settings.window)
        over = end - crossing.end >= needed and fit is not None and not self._unsettled(fit)
        return Ground.NEW if over else Ground.SETTLING

    def _unsettled(self, fit: Fit) -> bool:
        """Whether a fit of a new soil leaves more than noise alone mostly does."""
        return not fit.converged or fit.chi2 > self.settings.max_chi2 + SETTLED * math.sqrt(2.0 / max(fit.rows, 1))

    def _past_the_border(self, window: Window, fitting: Objective, fit: Fit) -> tuple[Objective, Fit]:
        """The fit of the data after a border longer than was thought, if those left out are why they do not agree."""
        crossing = self._crossing
        assert crossing is not None  # else there is no border
        begin = max(crossing.end, float(window.t[0]))
        for end in (begin + share * (float(window.t[-1]) - begin) for share in LONGER):
            longer = crossing._replace(end=end)
            apart = without_transition(window, longer, self.rig.front)
            problem = self._problem(apart.rows(np.flatnonzero(apart.t >= longer.end)))
            if problem.n_rows < 2 * MIN_NEW_ROWS:
                break
            known = fitting.joint_prior
            later = self._searched(problem, self._here, known)
            if later is None or self._unsettled(later):
                continue
            fall, noise = fit.neg2_log_posterior - later.neg2_log_posterior, fit.rows - later.rows
            if fall > noise + OF_BORDER:
                self._crossing = longer
                return Objective(problem, self._here, known), later
        return fitting, fit

    def _crossings(self, alarm: ChangePoint, start: float) -> list[Transition]:
        """Borders of growing length that begin at the alarm; of those over before `start` [s] only the last."""
        chassis = self.rig.chassis
        lag = (WHEELBASE if chassis is None else chassis.wheelbase) / alarm.speed
        ends = [alarm.t + share * lag for share in BORDERS]
        over = sum(end <= start for end in ends)
        apart = 0.0 if chassis is None else lag
        return [Transition(alarm.t - _SAME_TIME, end, apart) for end in ends[max(over - 1, 0) :]]

    def _as_one(self, window: Window, problem: ObservationModel, joint_prior: Gaussian) -> tuple[Objective, Fit | None]:
        """A window as one soil, this one, from any start."""
        fit = self._searched(problem, self._here, joint_prior)
        return self._on_the_way(window, Objective(problem, self._here, joint_prior), fit)

    def _on_the_way(self, window: Window, fitting: Objective, fit: Fit | None) -> tuple[Objective, Fit | None]:
        """A fit of a window freed of the bends of its way, where it has any; just after a border that would hide it."""
        if self._crossing is not None and float(window.t[-1]) < self._crossing.end + self.settings.window:
            return fitting, fit
        way = detected_curvature(fitting, fit)
        if fit is None or way is None:
            return fitting, fit
        return fit_on_curved_path(fitting, fit, way, self._problem(straightened(window, self.rig, way)))

    def _searched(self, problem: ObservationModel, prior: SoilPrior, joint_prior: Gaussian) -> Fit | None:
        """A fit from any start; None also where the budget allows no further search."""
        if not self._budget.allows():
            return None
        begun = self._budget.work.instants
        fit = fit_window(problem, prior, joint_prior)
        self._budget.spend(begun)
        return fit

    def _likelier(self, old: Fit, new: Fit, one: Fit | None) -> bool:
        """Whether two soils explain much better what one, of the same data, explains."""
        return (
            one is None
            or not one.converged
            or one.neg2_log_evidence - old.neg2_log_evidence - new.neg2_log_evidence >= CHANGED
        )

    def _of_this_soil(self, window: Window) -> Window:
        if self._crossing is None:
            return window
        window = without_transition(window, self._crossing, self.rig.front)
        return window.rows(np.flatnonzero(window.t >= self._crossing.end))

    def _problem(self, window: Window) -> ObservationModel:
        speed, turn = self.settings.min_speed, self.settings.max_turn
        problem = ObservationModelWithEffects(window, self.rig, self.model, speed, turn, self.effects, self.free)
        problem.work = self._budget.work
        return problem
