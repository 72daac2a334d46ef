"""A slower descent for models whose optimum is far away, or along a valley that bends, where the fast one goes astray.

The cost of a soil with gains and effects depends on where the latents are, and one linear
step does not bring them to their best where residuals are many standard deviations: then
the fast descent refuses good steps and creeps.  Here the latents follow at every place
before its cost counts, and no step is taken that does not lower it (Levenberg-Marquardt on
what is left: variable projection, Golub & Pereyra 1973, SIAM J. Numer. Anal. 10:413).
Nearer the optimum steps bend as the residuals do (geodesic acceleration: Transtrum & Sethna
2012, arXiv:1201.5885).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from soilbus.arrays import Array
from soilbus.estimation.multistart import DescentOptions, Fit
from soilbus.estimation.observation_model import Linearisation, Optimum
from soilbus.estimation.solver import Iterate, Objective, QuadraticModel

MAX_STEPS = 15
ENOUGH_FAR = 2e-3
"""Share of what the cost is above NEAR that is no fall worth a step."""
DAMPING, EASED, HELD_BACK = 1e-2, 0.3, 10.0
"""The damping of the first step, and what one that lowers the cost, and one that does not, makes of it."""
MOST_DAMPING = 1e4
NEAR = 2.0
"""Cost for each residual below which one linear step brings the latents to their best."""
EVEN = 1e-2
"""Share of the cost that a further one changes where it does so elsewhere."""
MAX_TRIED = 3
"""Shares of a full step that are tried before damping."""
GOOD, AS_FORETOLD = 0.3, 0.85
"""Shares of the foretold fall that a good step brings, and one that comes out as foretold."""
SHORT, LONGER = 0.15, 2.0
"""Share of a full step below which the next one is longer where it came out as foretold, and how much."""
LEAST = 1e-4
"""Share of a full step that is none."""
BENT, SHORTER = 4.0, 0.5
"""How far a bent step goes over how far a straight one could, and how much shorter it is if that was too far."""


class _Here(NamedTuple):
    """A place and the normal equations there."""

    place: Iterate
    point: QuadraticModel


def descended(fitting: Objective, fast: Fit, effort: DescentOptions) -> Fit | None:
    """The optimum below where the fast descent ended.

    It ends where no more is foreseen than decides nothing, or what is foreseen is above what is hopeless.  None where
    the numbers are not finite.
    """
    ground, end = _Ground(fitting), fast.optimum
    with np.errstate(all="ignore"):
        ended = Iterate(end.soil, fitting.problem.allowed(end.gains), end.latents, fast.neg2_log_posterior, 0)
        point = fitting.with_prior(ended, end.at)
        if point is None or _foreseen(point, point.step()) > effort.give_up_above:
            return None
        here = ground.at(ended, end.at)
        if here is None:
            return None
        valley, damping, falling, steps = _Valley(fitting), DAMPING, np.inf, 0
        while damping < MOST_DAMPING and steps < MAX_STEPS:
            enough, full = _enough(fitting, here.point, effort.stall_tolerance), here.point.step()
            worth = min(here.point.neg2_log_posterior - effort.stall_tolerance, effort.give_up_above)
            if full is None or falling < enough or _foreseen(here.point, full) > worth:
                break
            there, tried = valley.along(here, full) if ground.is_even(here.point) else (None, 0)
            steps += tried
            if there is None and (honest := ground.honest(here, enough)) is not None:
                here, steps = honest, steps + 1
                continue
            if there is None:
                there, steps = ground.damped(here, damping), steps + 1
                damping *= HELD_BACK if there is None else EASED
            if there is not None:
                falling, here = here.point.neg2_log_posterior - there.point.neg2_log_posterior, there
        return _fit(fitting, *here, steps, converged=steps < MAX_STEPS)


@dataclass(slots=True)
class _Ground:
    """Places with their latents where they fit best; `even` where the linear model brings them there by itself."""

    fitting: Objective
    even: bool = False

    def is_even(self, point: QuadraticModel) -> bool:
        """Whether one linear step brings the latents to their best: where the last one did, and near the optimum."""
        return self.even or point.neg2_log_posterior < NEAR * self.fitting.problem.n_rows

    def at(self, place: Iterate, at: Linearisation | None = None) -> _Here | None:
        """A place, which may be linearised already, with its latents at their best, and the normal equations there."""
        point = self.fitting.quadratic_model(place) if at is None else self.fitting.with_prior(place, at)
        if point is None:
            return None
        here = _Here(place, point)
        if self.is_even(point):
            return here
        there = _followed(self.fitting, here)
        self.even = (
            there is not None
            and abs(there.point.neg2_log_posterior - point.neg2_log_posterior) < EVEN * point.neg2_log_posterior
        )
        return there

    def damped(self, here: _Here, damping: float) -> _Here | None:
        """The place after a damped step, where it costs less."""
        step = here.point.step(damping)
        there = None if step is None else self.at(self.fitting.stepped(*here, step))
        return there if there is not None and there.point.neg2_log_posterior < here.point.neg2_log_posterior else None

    def honest(self, here: _Here, enough: float) -> _Here | None:
        """The same place with its latents at their best where that costs more: no step lowers what it seemed to cost.

        None where it does not, or where every place that is tried is so anyway.
        """
        if not self.is_even(here.point):
            return None
        there, self.even = _followed(self.fitting, here), False
        return (
            there
            if there is not None and there.point.neg2_log_posterior > here.point.neg2_log_posterior + enough
            else None
        )


@dataclass(slots=True)
class _Valley:
    """Steps along a valley that bends.

    share: of a full step that the next one takes; bend (R,): second derivative of the
    residuals along a full step as the last ones foretell it, None where they do not.
    """

    fitting: Objective
    share: float = 1.0
    second_derivative: Array | None = None

    def along(self, here: _Here, full: Array) -> tuple[_Here | None, int]:
        """The place after a part of a full step (F + A,), None where none lowers the cost, and how many were tried."""
        place, point = here
        length, least = point.squared_length(full), None
        for tried in range(1, MAX_TRIED + 1):
            share = self.share
            step = (
                share * full
                if self.second_derivative is None
                else self.fitting.geodesic_step(place, point, share, self.second_derivative)
            )
            if step is not None:
                reach = self.fitting.step_fraction(place, step)
                share, step = reach * share, reach * step
            there = None
            if step is not None and share > LEAST:
                there = _at(self.fitting, self.fitting.stepped(place, point, step))
            if step is None or there is None:
                self.share, self.second_derivative = SHORTER * self.share, None
                continue
            foretold, fall = share * (2.0 - share) * length, point.neg2_log_posterior - there.point.neg2_log_posterior
            second_derivative = self.fitting.second_derivative(place, point, step, there.point) / share**2
            if fall > GOOD * foretold:
                left = 1.0 - share
                further = LONGER if share < SHORT and fall > AS_FORETOLD * foretold else 1.0
                self.share = min(further * share / left, 1.0) if left > 0.0 else 1.0
                self.second_derivative = second_derivative * left**2 if left > 0.0 else None
                return there, tried
            if fall > 0.0 and (least is None or there.point.neg2_log_posterior < least.point.neg2_log_posterior):
                least = there
            straight = share * (length * share / (foretold - fall)) ** (1.0 / 3.0)  # the bend costs share^4
            self.share = min(share, BENT * straight) if self.second_derivative is None else SHORTER * share
            self.second_derivative = second_derivative
        return least, MAX_TRIED


def _foreseen(point: QuadraticModel, full: Array | None) -> float:
    """The cost after a full step (F + A,), if all were linear; infinite where there is none."""
    return np.inf if full is None else point.neg2_log_posterior - point.squared_length(full)


def _at(fitting: Objective, place: Iterate) -> _Here | None:
    point = fitting.quadratic_model(place)
    return None if point is None else _Here(place, point)


def _followed(fitting: Objective, here: _Here) -> _Here | None:
    """The place with its latents where the linear model there says that they fit best."""
    return _at(fitting, fitting.stepped(*here, np.zeros(len(here.point.gradient))))


def _enough(fitting: Objective, point: QuadraticModel, nothing: float) -> float:
    """Fall of the cost at a point below which a step was the last."""
    return max(nothing, ENOUGH_FAR * (point.neg2_log_posterior - NEAR * fitting.problem.n_rows))


def _fit(fitting: Objective, place: Iterate, point: QuadraticModel, steps: int, converged: bool) -> Fit | None:
    gaussians = fitting.gaussians_at(place, point, place.soil)
    if gaussians is None:
        return None
    return Fit(
        gaussian=gaussians[1],
        mode=gaussians[1],
        sinkage=fitting.problem.mean_sinkage(place.as_soil(), place.gains, place.latents),
        optimum=Optimum(fitting.problem.t, place.soil, place.gains, place.latents, point.linearisation),
        neg2_log_posterior=point.neg2_log_posterior,
        neg2_log_evidence=point.neg2_log_evidence,
        rows=fitting.problem.n_rows,
        iterations=steps,
        converged=converged,
    )
