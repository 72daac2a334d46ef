"""Parameters of effects as unknowns of a fit: what is known of each beforehand, and effects with given values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from soilbus.arrays import Array
from soilbus.terra.dual import Dual
from soilbus.terra.effects.effect import Active, Effect, Parameter


@dataclass(frozen=True, slots=True)
class Free:
    """One parameter of an effect, of one wheel (its number) or of all (None): value and std of the prior."""

    effect: str
    parameter: Parameter
    wheel: int | None
    value: float
    std: float

    @property
    def name(self) -> str:
        """effect.parameter, with the wheel's number where it has one."""
        return f"{self.effect}.{self.parameter.name}" + ("" if self.wheel is None else f".{self.wheel}")

    def within(self, pull: float) -> bool:
        """Whether so many prior std from the prior value is inside the parameter's range."""
        return self.parameter.low <= self.value + self.std * pull <= self.parameter.high

    def allowed(self, pull: float) -> float:
        """So many prior std, kept inside the parameter's range."""
        return pull if self.within(pull) or self.std == 0.0 else self.pull_at(self.at(pull))

    def pull_at(self, value: float) -> float:
        """How many prior std a value is from the prior value, for a parameter that has a std; the inverse of at()."""
        return (value - self.value) / self.std

    def at(self, pull: float) -> float:
        """The parameter's value so many prior std from its prior value, kept inside its range."""
        return min(max(self.value + self.std * pull, self.parameter.low), self.parameter.high)


def parameters_of(effect: Effect, n_wheels: int) -> list[Free]:
    """The parameters of an effect as before any data: absent, with the catalogue's prior."""
    wheels: Sequence[int | None] = range(n_wheels) if effect.each_wheel else (None,)
    return [Free(effect.name, p, w, p.neutral, p.std) for p in effect.parameters for w in wheels]


def active_at(effects: Sequence[Effect], free: Sequence[Free], pulls: Array, n_wheels: int) -> list[Active]:
    """The effects with their values where the parameters are so many std (P,) from their prior values.

    Those of which every parameter is zero and absent there are left out: they would do nothing, at a cost.
    """
    values = _values(effects, free, [f.at(u) for f, u in zip(free, pulls.tolist(), strict=True)], n_wheels)
    return [Active(e, values[e.name]) for e in effects if not _absent(e, values[e.name])]


def varied_at(effects: Sequence[Effect], free: Sequence[Free], pulls: Array, n_wheels: int) -> list[Active]:
    """The same with values that carry their derivatives by the pulls, each by its place, where these may vary."""
    numbers = [
        Dual(f.at(u), {i: f.std}) if f.std > 0.0 else f.at(u)
        for i, (f, u) in enumerate(zip(free, pulls.tolist(), strict=True))
    ]
    values, varied = _values(effects, free, numbers, n_wheels), {f.effect for f in free if f.std > 0.0}
    return [Active(e, values[e.name]) for e in effects if e.name in varied or not _absent(e, values[e.name])]


def _values(
    effects: Sequence[Effect], free: Sequence[Free], numbers: Sequence[Any], n_wheels: int
) -> dict[str, dict[str, Any]]:
    """Parameters by effect and name; of those that every wheel has for itself one for each wheel (W,)."""
    values: dict[str, dict[str, Any]] = {e.name: {} for e in effects}
    for f, number in zip(free, numbers, strict=True):
        of_effect, name = values[f.effect], f.parameter.name
        if f.wheel is None:
            of_effect[name] = number
        else:
            alone = np.zeros(n_wheels)
            alone[f.wheel] = 1.0
            of_effect[name] = of_effect.get(name, 0.0) + alone * number
    return values


def _absent(effect: Effect, values: dict[str, Any]) -> bool:
    """Whether nothing is left of it, not even the place at which it would be: the depth of a pan without stiffness."""
    return all(neutral == 0.0 and not np.any(values[name]) for name, neutral in effect.neutral.items())
