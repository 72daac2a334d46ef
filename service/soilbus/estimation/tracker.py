"""From window to window: what earlier windows told, and where the soil changes.

Each window is estimated from its own data and from what was known when it began: the
posterior of the newest window that had ended by then, widened by the drift of the soil
since.  No sample counts twice.  Where the newest data disagree with what was known and
another soil explains them much better, they alone count, with the configured prior for
the soil and what is known of the sensors.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from soilbus.estimation.belief import Belief
from soilbus.estimation.completed import CompletedProblem, Free
from soilbus.estimation.coordinates import Coordinates
from soilbus.estimation.gauss_newton import Fit, fit_window, foreseen, resume
from soilbus.estimation.marginal import with_whole
from soilbus.estimation.posterior import PARAMETERS, SoilPrior
from soilbus.estimation.residuals import WindowProblem
from soilbus.estimation.soil_change import Crossing, suspicion, without_crossing
from soilbus.estimation.window import Rig, Window
from soilbus.terra.effects.effect import Effect
from soilbus.terra.soils import SOILS
from soilbus.terra.wheel import WheelModel

Array = NDArray[np.float64]

MIN_ROWS, MIN_NEW_ROWS = 60, 30
"""Residuals that a window needs, and those that each of two soils needs to be told apart."""
ALARM = 12.0
"""Log likelihood ratio from which another soil is looked for."""
CHANGED = 20.0
"""Fall of -2 log evidence from which it is believed."""
TRUST, TRUST_AGAIN = 3.5, 0.0
"""Standard deviations of chi-square that a window may have above the allowed: always, and after a mismatch."""
LOOK_BACK = 0.2
"""Share of a window before the end of the last fit's data from which on a change is looked for."""
GRACE = 0.3
"""Share of a window that a new soil must fill before the next change is looked for."""
LEARNED = 0.5
"""Share of a window that its data must fill for later windows to build on it: the posterior of less is not Gaussian."""
BORDER = 0.5
"""Length after the first sign of another soil that is of neither, in wheelbases."""
GAIN_MEMORY = 60.0
"""Windows in which a sensor's gain error may change by its whole uncertainty."""
WHEELBASE = 2.0
"""Length [m] that stands for the wheelbase of a rig that has none."""
_SAME_TIME = 1e-3
_SOIL = len(PARAMETERS)


class Ground(StrEnum):
    """What the data of a window are of."""

    SAME = "same"
    NEW = "new"
    """Another soil than before, since less than a window: only its own data count."""
    CHANGING = "changing"
    """Too little of another soil is in to tell it; the estimate is of the one before."""


@dataclass(frozen=True, slots=True)
class Settings:
    """What the tracker needs to be told; times s, speeds m/s.

    drift: sd of the logarithm of each soil coordinate after one window; it grows with the
    square root of time.  min_rows: residuals below which a window is not fitted.
    """

    window: float
    min_speed: float
    max_turn: float
    max_chi2: float
    drift: float
    min_rows: int = MIN_ROWS


@dataclass(frozen=True, slots=True)
class Tracked:
    """A window's fit (None without), whether the model fails to describe its data, and of which ground they are.

    since [s] is where the data that count begin; standstill and turning count instants left out.
    """

    fit: Fit | None
    mismatch: bool
    ground: Ground
    since: float
    standstill: int = 0
    turning: int = 0


def elsewhere(prior: SoilPrior) -> SoilPrior:
    """Prior of a soil that the vehicle came upon: at least as wide as known soils differ, what is held stays held."""
    soils = np.log(list(SOILS.values()))
    return SoilPrior(prior.median, np.where(prior.log_std > 0.0, np.maximum(prior.log_std, soils.std(0)), 0.0))


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
        self.forget()

    @property
    def here(self) -> SoilPrior:
        """Prior of the present soil: the configured one, or a wider one after the soil has changed."""
        return self._here

    def forget(self) -> None:
        """Begin anew."""
        self._here = self.prior  # of the present soil
        self._distrusted = False
        self._fit: Fit | None = None
        self._good_until = -math.inf
        self._crossing: Crossing | None = None
        self._beliefs: list[tuple[float, Belief]] = []

    def estimate(self, window: Window, end: float) -> Tracked:
        """One window that ends at `end` [s]; windows in their order."""
        start = end - self.settings.window
        new = self._crossing is not None and start < self._crossing.end
        window = self._of_this_soil(window)
        problem = self._problem(window)
        since = self._crossing.end if new and self._crossing else start
        left_out = problem.standstill, problem.turning
        if problem.n_rows < self.settings.min_rows:
            self._fit = None
            return Tracked(None, False, Ground.SAME, since, *left_out)
        before = self._known_at(since, problem)
        last = self._fit
        if last is None or last.rival is not None:
            fit = self._afresh(problem, before)
        else:
            ahead = foreseen(problem, self._here, last, before)
            fit = resume(ahead)
            if fit is None or not fit.converged:  # a long valley is no sign of another soil
                fit = fit_window(problem, self._here, before)
            if self._good_until > end - self.settings.window and end - since > GRACE * self.settings.window:
                known = ahead.fitting.given(last.whole)
                sure = float(last.optimum.t[-1]) - LOOK_BACK * self.settings.window
                first = int(np.searchsorted(problem.t, sure))
                doubt = suspicion(known, ahead.place, ahead.at, first, ALARM)
                if doubt.ratio > ALARM or self.mismatch(fit):
                    changed = self._two_soils(window, float(problem.t[doubt.instant]), before, last)
                    if changed is not None:
                        return self._remembered(replace(changed, standstill=left_out[0], turning=left_out[1]), end)
            if self.mismatch(fit):
                fit = self._afresh(problem, before)
        if fit is not None and not self.mismatch(fit):
            fit = with_whole(problem, self._here, before, fit)
        ground = Ground.NEW if new else Ground.SAME
        return self._remembered(Tracked(fit, self.mismatch(fit), ground, since, *left_out), end)

    def _afresh(self, problem: WindowProblem, before: Belief) -> Fit | None:
        """A fit that starts anywhere; what was known of the soil counts only where it agrees with the data."""
        fit = fit_window(problem, self._here, before)
        if not self.mismatch(fit) or not self._beliefs:
            return fit
        there = elsewhere(self.prior)
        other = fit_window(problem, there, before.of_another_soil(there))
        if self.mismatch(other):
            return fit
        self._here = there
        return other

    def mismatch(self, fit: Fit | None) -> bool:
        """Whether a fit failed or leaves more than noise."""
        return fit is None or not fit.converged or fit.chi2 > self.chi2_limit(fit)

    def chi2_limit(self, fit: Fit) -> float:
        """Reduced chi-square that noise alone reaches hardly ever with this many residuals."""
        deviations = TRUST_AGAIN if self._distrusted else TRUST
        return self.settings.max_chi2 + deviations * math.sqrt(2.0 / max(fit.rows, 1))

    def _remembered(self, tracked: Tracked, end: float) -> Tracked:
        """The same, taken note of; a failed or bad fit leaves what is known alone."""
        fit = tracked.fit
        self._fit = fit if fit is not None and fit.converged else None
        if fit is not None:
            self._distrusted = tracked.mismatch
        if fit is not None and not tracked.mismatch:
            self._good_until = end
            learned = end - tracked.since >= LEARNED * self.settings.window and fit.is_gaussian
            if learned and tracked.ground is not Ground.CHANGING:
                self._beliefs.append((end, fit.whole))
        return tracked

    def _known_at(self, t: float, problem: WindowProblem) -> Belief:
        """What windows that had ended by t [s] tell of the soil from t on."""
        ended = [i for i, (end, _) in enumerate(self._beliefs) if end <= t + _SAME_TIME]
        if not ended:
            return Belief.of(self._here, problem.gain_std)
        self._beliefs = self._beliefs[ended[-1] :]
        end, belief = self._beliefs[0]
        elapsed = (t - end) / self.settings.window + 1.0
        gains = problem.gain_std**2 * min(elapsed / GAIN_MEMORY, 1.0)
        if self._crossing is not None and end <= self._crossing.end:
            return belief.of_another_soil(self._here).drifted(np.zeros((_SOIL, _SOIL)), gains)
        coordinates = Coordinates(self._here, float(self.rig.width.mean()))
        directions = coordinates.log_directions(belief.soil)
        return belief.drifted(self.settings.drift**2 * elapsed * (directions @ directions.T), gains)

    def _two_soils(self, window: Window, t: float, before: Belief, last: Fit) -> Tracked | None:
        """The window as two soils of which the second begins at t [s], if that is much likelier than one; else None."""
        near = (window.t >= t - 1.0) & (window.t <= t)
        speed = max(float(np.nanmean(window.ground_speed[near])), self.settings.min_speed)
        length = WHEELBASE if self.rig.chassis is None else self.rig.chassis.wheelbase
        lag = length / speed
        crossing = Crossing(t - _SAME_TIME, t + BORDER * lag, 0.0 if self.rig.chassis is None else lag)
        apart = without_crossing(window, crossing, self.rig.front)
        first = self._problem(apart.rows(np.flatnonzero(apart.t < crossing.begin)))
        second = self._problem(apart.rows(np.flatnonzero(apart.t >= crossing.end)))
        old = resume(foreseen(first, self._here, last, before)) if first.n_rows >= MIN_NEW_ROWS else None
        if old is None or self.mismatch(old):
            return None
        if second.n_rows < MIN_NEW_ROWS:
            return Tracked(old, False, Ground.CHANGING, float(apart.t[0]))
        there = elsewhere(self.prior)
        new = fit_window(second, there, self._known_at(t, second).of_another_soil(there))
        if new is None or self.mismatch(new):
            return None
        one = fit_window(self._problem(apart), self._here, before)
        if one is not None and one.converged and one.evidence - old.evidence - new.evidence < CHANGED:
            return None
        self._crossing, self._here = crossing, there
        return Tracked(new, False, Ground.NEW, crossing.end)

    def _of_this_soil(self, window: Window) -> Window:
        if self._crossing is None:
            return window
        window = without_crossing(window, self._crossing, self.rig.front)
        return window.rows(np.flatnonzero(window.t >= self._crossing.end))

    def _problem(self, window: Window) -> WindowProblem:
        speed, turn = self.settings.min_speed, self.settings.max_turn
        return CompletedProblem(window, self.rig, self.model, speed, turn, self.effects, self.free)
