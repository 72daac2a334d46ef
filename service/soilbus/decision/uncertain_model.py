"""A wheel-soil model whose effects are known to within a covariance, beside that of the soil.

What a window determines of the soil and of the effects belongs together: a soil that looks
stronger goes with lugs that look shorter.  So each principal direction of the effects'
covariance, one standard deviation long, is a model of its own, and brings the soil along by
its regression on the effects; what is left of the soil's covariance is independent of them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from soilbus.arrays import Array
from soilbus.estimation.gaussian import Gaussian
from soilbus.estimation.model_form import FormLeft, formed
from soilbus.estimation.nuisance_parameters import Free, active_at
from soilbus.estimation.posterior import PARAMETERS
from soilbus.terra.effects.effect import Effect
from soilbus.terra.effects.steady import CompletedModel, Slopes, Wheel
from soilbus.terra.wheel import WheelModel, WheelState

_Rows = slice | NDArray[np.intp]

_SOIL = len(PARAMETERS)
FORMS = 2
"""Directions of the model's form that have a model of their own in decisions.  Pull at loads and slips that were
driven is measured: soil and form cancel there, and with two directions the std of the largest draft is within 7 % of
that with all four (loam, wet clay, dry sand); a soil as badly known as by the form, on a model that is not, has 5 to 15
times as much."""
_LEAST = 1e-8
"""Variance, in units of a parameter's prior, below which its direction counts as held."""


class Doubt(NamedTuple):
    """The model one standard deviation away along one direction, and the change (6,) of the soil's logarithms there."""

    model: CompletedModel
    shift: Array


@dataclass(frozen=True, slots=True)
class UncertainModel:
    """The model as it most likely is, and one for each direction in which it may be otherwise; independent.

    The last `of_form` doubts are of the model's form.
    """

    mean: CompletedModel
    doubts: tuple[Doubt, ...] = ()
    of_form: int = 0

    @classmethod
    def over(cls, model: WheelModel | CompletedModel | UncertainModel) -> UncertainModel:
        """A model that is known as one without doubts."""
        return model if isinstance(model, UncertainModel) else cls(CompletedModel.over(model))

    @classmethod
    def of(
        cls, model: WheelModel, effects: Sequence[Effect], free: Sequence[Free], gaussian: Gaussian, n_wheels: int,
        ground_speed: float, widening: float = 1.0, form: FormLeft | None = None,
    ) -> UncertainModel:  # fmt: skip
        """With what a window has left of the effects' parameters, at a ground speed [m/s].

        Their places are the last of the belief's gains, in prior standard deviations.  Only
        effects that count in steady driving do so here.  widening is that of `Posterior.widened`.
        """

        def at(pulls: Array, model: WheelModel = model) -> CompletedModel:
            return CompletedModel.of(model, active_at(effects, free, pulls, n_wheels), ground_speed)

        first = len(gaussian.gains) - len(free)
        pulls = gaussian.gains[first:]
        mean = at(pulls)
        names = {active.effect.name for active in mean.effects}
        places = np.flatnonzero([f.effect in names and f.std > 0.0 for f in free])
        of_form = [] if form is None else _of_form(form, lambda step: at(pulls, formed(model, step)))
        if not len(places):
            return cls(mean, tuple(of_form), len(of_form))
        of_effects = _SOIL + first + places
        variance, axes = np.linalg.eigh(gaussian.covariance[np.ix_(of_effects, of_effects)])
        doubts = []
        for size, axis in zip(variance.tolist(), axes.T, strict=True):
            if size <= _LEAST:
                continue
            step = np.zeros(len(free))
            step[places] = axis * np.sqrt(size)
            shift = gaussian.covariance[:_SOIL, of_effects] @ axis / np.sqrt(size)
            way = _way_inside(free, pulls, step)
            scale = way * np.sqrt(widening / (1.0 + (widening - 1.0) * min(size, 1.0)))
            doubts.append(Doubt(at(pulls + scale * step), scale * shift))
        return cls(mean, tuple(doubts + of_form), len(of_form))

    @property
    def shifts(self) -> Array:
        """Of the soil's logarithms, one row for each doubt (Q, 6)."""
        return np.array([doubt.shift for doubt in self.doubts]).reshape(-1, _SOIL)

    def with_form(self, log_covariance: Array) -> Array:
        """A fit's own covariance (6, 6) of the soil's logarithms, and what the doubts of the form bring along."""
        along = self.shifts[len(self.doubts) - self.of_form :]
        return np.asarray(log_covariance + along.T @ along)

    def of_rows(self, n: int) -> ModelOfRows:
        """The models of n rows of soils, of which the doubts' are the last."""
        known = n - len(self.doubts)
        row = np.concatenate([np.zeros(known, int), 1 + np.arange(len(self.doubts))])
        return ModelOfRows((self.mean, *(doubt.model for doubt in self.doubts)), row)


def _of_form(form: FormLeft, at: Callable[[Array], CompletedModel]) -> list[Doubt]:
    """A doubt for each of the leading directions of what the form leaves open, each to the side that its mean is on."""
    variance, axes = np.linalg.eigh(form.moment)
    axes = axes * np.where(form.mean @ axes < 0.0, -1.0, 1.0)
    steps = (axes * np.sqrt(np.maximum(variance, 0.0))).T[-FORMS:][variance[-FORMS:] > _LEAST]
    return [Doubt(at(step), form.by_form[:_SOIL] @ step) for step in steps]


def _way_inside(free: Sequence[Free], pulls: Array, step: Array) -> float:
    """1 or -1: the way along a step (P,) that leaves the parameters' ranges less; there they are held back."""

    def lost(way: float) -> float:
        there = (pulls + way * step).tolist()
        return math.fsum(abs(f.allowed(u) - u) for f, u in zip(free, there, strict=True))

    return 1.0 if lost(1.0) <= lost(-1.0) else -1.0


@dataclass(frozen=True, slots=True)
class ModelOfRows:
    """Models for arrays (D, ...) whose row i belongs to models[row[i]]; interface and units as CompletedModel."""

    models: tuple[CompletedModel, ...]
    row: NDArray[np.intp]

    @property
    def first(self) -> CompletedModel:
        """That of the first row."""
        return self.models[int(self.row[0])]

    def of(self, rows: NDArray[np.intp]) -> ModelOfRows:
        """The same of some of the rows."""
        return ModelOfRows(self.models, self.row[rows])

    def forces_and_slopes(self, state: WheelState, rear: Any, load: Array) -> tuple[Array, Slopes]:
        """Forces (3, D, ...) and slopes of states and loads (D, ...)."""

        def rows(model: CompletedModel, at: _Rows) -> Array:
            forces, slopes = model.forces_and_slopes(WheelState(*(a[at] for a in state)), rear, load[at])
            return np.stack([forces, *slopes])

        found = self._by_model(rows, (4, 3, *load.shape), 2)
        return found[0], Slopes(*found[1:])

    def sinkage(self, angle: Array, wheel: Wheel) -> Array:
        """Sinkage [m] (D, A) at entry angles [rad] (D, A) of wheels (A,) with loads (D, A)."""
        return self._by_model(
            lambda model, at: model.sinkage(angle[at], wheel._replace(load=wheel.load[at])), angle.shape
        )

    def angle_of_sinkage(self, depth: float, wheel: Wheel) -> Array:
        """Entry angle [rad] (D, A) at which wheels (A,) have sunk so deep [m]."""
        shape = (len(self.row), *np.shape(wheel.radius))
        return self._by_model(
            lambda model, at: np.broadcast_to(
                model.angle_of_sinkage(depth, wheel), (len(self.row[at]), *shape[1:])
            ), shape,
        )  # fmt: skip

    def _by_model(self, rows: Callable[[CompletedModel, _Rows], Array], shape: tuple[int, ...], axis: int = 0) -> Array:
        """An array of this shape from what each model says of its rows, which are along an axis."""
        if len(self.models) == 1:
            return np.asarray(rows(self.models[0], slice(None)))
        out = np.empty(shape)
        for i, model in enumerate(self.models):
            at = np.flatnonzero(self.row == i)
            if len(at):
                out[(slice(None),) * axis + (at,)] = rows(model, at)
        return out
