"""A wheel-soil model with uncertain effects: its mean, and one perturbed model for each principal direction.

    effects      e_i = e + sqrt(lambda_i) v_i             lambda_i, v_i: eigenpairs of the effects' covariance C_ee
    soil         log p_i = log p + C_pe v_i / sqrt(lambda_i)     regression of the soil's logarithms on the effects

A window determines soil and effects jointly: a stronger soil goes with shorter lugs.  The rest of the soil's covariance
is independent of the effects.  The model's form (its open structure) is treated alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from soilbus.arrays import Array
from soilbus.estimation.gaussian import Gaussian
from soilbus.estimation.model_form import FORM, FormPosterior, with_form_step
from soilbus.estimation.nuisance_parameters import Free, active_at
from soilbus.estimation.posterior import PARAMETERS
from soilbus.terra.effects.effect import Effect
from soilbus.terra.effects.steady import CompletedModel, Slopes, Wheel
from soilbus.terra.wheel import WheelModel, WheelState

_SOIL = len(PARAMETERS)
_HELD_VARIANCE = 1e-8
"""Variance, in units of a parameter's prior, below which its direction counts as known exactly."""


class UncertainModel(NamedTuple):
    """The mean model, and one perturbed model for each independent direction of its uncertainty.

    shifts (Q, 6): changes of the soil's logarithms that go with the Q perturbed models, of which the last `of_form` are
    of the model's form.
    """

    mean: CompletedModel
    perturbed: tuple[CompletedModel, ...] = ()
    shifts: Array = np.empty((0, _SOIL))
    of_form: int = 0

    @classmethod
    def over(cls, model: WheelModel | CompletedModel | UncertainModel) -> UncertainModel:
        """Return an exactly known model as an UncertainModel, and an uncertain one unchanged."""
        return model if isinstance(model, UncertainModel) else cls(CompletedModel.over(model))

    @classmethod
    def of(
        cls, model: WheelModel, effects: Sequence[Effect], free: Sequence[Free], gaussian: Gaussian, n_wheels: int,
        ground_speed: float, form: FormPosterior | None = None,
    ) -> UncertainModel:  # fmt: skip
        """Return the model with the effects' parameters as a window's posterior has them.

        gaussian: posterior of soil and gains, of which the last len(free) are the effects' free parameters in prior
        standard deviations.  ground_speed [m/s]: of steady driving; only effects that act there have a perturbed model.
        form: posterior of the model's form, None where it is not uncertain.
        """
        centre = np.zeros(len(FORM)) if form is None else form.centre

        def at(standardised: Array, step: Array = centre) -> CompletedModel:
            stepped = with_form_step(model, step) if step.any() else model
            return CompletedModel.of(stepped, active_at(effects, free, standardised, n_wheels), ground_speed)

        first = len(gaussian.gains) - len(free)
        standardised = gaussian.gains[first:]
        mean = at(standardised)
        names = {active.effect.name for active in mean.effects}
        places = np.flatnonzero([f.effect in names and f.std > 0.0 for f in free])
        models, shifts = [], []
        of_effects = _SOIL + first + places
        variance, axes = np.linalg.eigh(gaussian.covariance[np.ix_(of_effects, of_effects)])
        low, high = np.array([f.bounds for f in free]).reshape(-1, 2).T
        for size, axis in zip(variance.tolist(), axes.T, strict=True):
            if size <= _HELD_VARIANCE:
                continue
            step = np.zeros(len(free))
            step[places] = axis * np.sqrt(size)
            shift = gaussian.covariance[:_SOIL, of_effects] @ axis / np.sqrt(size)
            there, other = (np.abs(np.clip(p, low, high) - p).sum() for p in (standardised + step, standardised - step))
            sign = 1.0 if there <= other else -1.0  # beyond their ranges the parameters are clipped
            models.append(at(standardised + sign * step))
            shifts.append(sign * shift)
        of_effects_alone = len(models)
        if form is not None:
            for step in _form_steps(form):
                models.append(at(standardised, centre + step))
                shifts.append(form.by_form[:_SOIL] @ step)
        return cls(mean, tuple(models), np.array(shifts).reshape(-1, _SOIL), len(models) - of_effects_alone)

    def with_form(self, log_covariance: Array) -> Array:
        """Return the covariance (6, 6) of the soil's logarithms: a fit's own plus that due to the model's form."""
        along = self.shifts[len(self.shifts) - self.of_form :]
        return np.asarray(log_covariance + along.T @ along)

    def forces_and_slopes(
        self, state: WheelState, rear: Any, load: Array, of_row: NDArray[np.intp]
    ) -> tuple[Array, Slopes]:
        """Return the forces (3, D, ...) [N, N, N m] at states and loads [N] (D, ...), and the mean model's derivatives.

        of_row (D,): index of each row's perturbed model, negative for the mean.
        """
        forces, slopes = self.mean.forces_and_slopes(state, rear, load)
        for row in np.flatnonzero(of_row >= 0):
            at = WheelState(*[a if isinstance(a, float) else a[row] for a in state])
            forces[:, row] = self.perturbed[of_row[row]].forces(at, rear, load[row])
        return forces, slopes

    def sinkage(self, angle: Array, wheel: Wheel) -> Array:
        """Return the sinkage [m] (D, A) at entry angles [rad] (D, A) of wheels (A,) with loads (D, A).

        The last rows belong to the perturbed models, here and in `angle_of_sinkage`.
        """
        found = self.mean.sinkage(angle, wheel)
        for row, model in enumerate(self.perturbed, len(angle) - len(self.perturbed)):
            found[row] = model.sinkage(angle[row], wheel._replace(load=wheel.load[row]))
        return found

    def angle_of_sinkage(self, depth: float, wheel: Wheel, n: int) -> Array:
        """Return the entry angle [rad] (n, A) at which wheels (A,) have this sinkage [m]."""
        first = [self.mean.angle_of_sinkage(depth, wheel)] * (n - len(self.perturbed))
        return np.stack([*first, *(model.angle_of_sinkage(depth, wheel) for model in self.perturbed)])


def _form_steps(form: FormPosterior) -> list[Array]:
    """One sd along each principal direction of the form's spread, on the side on which its mean lies."""
    variance, axes = np.linalg.eigh(form.spread)
    axes = axes * np.where(form.mean @ axes < 0.0, -1.0, 1.0)
    return [axes[:, i] * np.sqrt(variance[i]) for i in np.flatnonzero(variance > _HELD_VARIANCE)]
