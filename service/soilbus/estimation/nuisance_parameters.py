"""Effect parameters as nuisance parameters of a fit.

    u = (value - prior value) / prior sd,    u ~ N(0, 1) before any data

A fit works with the standardised u of each free parameter.  `active_at` turns standardised values into
effects with values, and with derivatives by each u where asked.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from soilbus.arrays import Array
from soilbus.terra.dual import Dual
from soilbus.terra.effects.effect import Active, Effect, Parameter


@dataclass(frozen=True, slots=True)
class Free:
    """Free parameter of an effect, of one wheel (its number) or of all (None), with value and sd of its prior."""

    effect: str
    parameter: Parameter
    wheel: int | None
    value: float
    std: float

    @property
    def name(self) -> str:
        """effect.parameter, with the wheel's number where it has one."""
        return f"{self.effect}.{self.parameter.name}" + ("" if self.wheel is None else f".{self.wheel}")

    @property
    def bounds(self) -> tuple[float, float]:
        """The parameter's range, standardised; infinite where the parameter is held."""
        if self.std == 0.0:
            return -math.inf, math.inf
        return self.standardised(self.parameter.low), self.standardised(self.parameter.high)

    def standardised(self, value: float) -> float:
        """Return the standardised u of a value, the inverse of `at`; needs a prior sd above 0."""
        return (value - self.value) / self.std

    def at(self, u: float) -> float:
        """Return the value at a standardised u, clipped to the parameter's range."""
        return min(max(self.value + self.std * u, self.parameter.low), self.parameter.high)


def parameters_of(effect: Effect, n_wheels: int) -> list[Free]:
    """Return the parameters of an effect at their neutral values, with the catalogue's prior sd."""
    wheels: Sequence[int | None] = range(n_wheels) if effect.each_wheel else (None,)
    return [Free(effect.name, p, w, p.neutral, p.std) for p in effect.parameters for w in wheels]


def active_at(
    effects: Sequence[Effect], free: Sequence[Free], standardised: Array, n_wheels: int, derivatives: bool = False
) -> list[Active]:
    """Return the effects that have an influence at standardised parameters (P,), with their values, float or (W,).

    derivatives: values that vary are Duals, with derivatives by the standardised parameters.
    """
    values: dict[str, dict[str, Any]] = {e.name: {} for e in effects}
    for i, (f, u) in enumerate(zip(free, standardised.tolist(), strict=True)):
        number = Dual(f.at(u), {i: f.std}) if derivatives and f.std > 0.0 else f.at(u)
        of_effect, name = values[f.effect], f.parameter.name
        if f.wheel is None:
            of_effect[name] = number
        else:
            own_wheel = np.zeros(n_wheels)
            own_wheel[f.wheel] = 1.0
            of_effect[name] = of_effect.get(name, 0.0) + own_wheel * number
    varied = {f.effect for f in free if derivatives and f.std > 0.0}

    def is_absent(effect: Effect) -> bool:
        own = values[effect.name]
        return all(neutral == 0.0 and not np.any(own[name]) for name, neutral in effect.neutral.items())

    return [Active(e, values[e.name]) for e in effects if e.name in varied or not is_absent(e)]
