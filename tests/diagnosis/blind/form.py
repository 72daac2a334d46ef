"""What a hidden effect is: effects on the simulated drive, and changes of what surrounds it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from soilbus.config.model import Config
from soilbus.simulator.recording import Recording
from soilbus.simulator.scenario import Scenario
from soilbus.terra.effects.effect import Active, Effect
from soilbus.terra.wheel import Soil

SIZES = ("small", "medium", "large")


class Setting(NamedTuple):
    """What a hidden effect may be fitted to: the soil, the sinkage [m] of the plain tractor on it, luck."""

    soil: Soil
    sinkage: float
    rng: np.random.Generator


def _same(what: Any) -> Any:
    return what


class Hidden(NamedTuple):
    """How an effect gets into a recording.

    effects: on the simulated drive.  tractor: the configuration that is truly driven, from
    the one that the diagnosis is given.  configured: that one, from the usual one.  way: the
    scenario.  after: the recording, once measured.
    """

    effects: tuple[Active, ...] = ()
    tractor: Callable[[Config], Config] = _same
    configured: Callable[[Config], Config] = _same
    way: Callable[[Scenario], Scenario] = _same
    after: Callable[[Recording], Recording] = _same


def together(parts: Sequence[Hidden]) -> Hidden:
    """All of these at once."""

    def one_by_one(steps: Sequence[Callable[[Any], Any]]) -> Callable[[Any], Any]:
        def run(what: Any) -> Any:
            for step in steps:
                what = step(what)
            return what

        return run

    effects = tuple(active for part in parts for active in part.effects)
    return Hidden(effects, *(one_by_one([part[i] for part in parts]) for i in range(1, len(Hidden._fields))))


@dataclass(frozen=True)
class Form:
    """One formula of an effect.

    effect: its name in the catalogue, "" where it is not in there.  small: the size, in
    `unit`, that is barely visible with a sinkage sensor and without; large: as great as it
    gets.  other: no parameters make the catalogue's formula this one.
    far: no parameters make the catalogue's formula nine tenths of this one.
    by_sinkage: nothing but a sinkage sensor shows it.  imitable: an effect outside the
    catalogue, more than a fifth of which one inside does to the same readings.
    """

    effect: str
    name: str
    source: str
    unit: str
    small: tuple[float, float]
    large: float
    hide: Callable[[float, Setting], Hidden]
    other: bool = True
    by_sinkage: bool = False
    imitable: bool = False
    far: bool = False

    def size(self, name: str, with_sinkage: bool) -> float:
        """One of SIZES in `unit`; the medium one lies as many times above the small as below the large one."""
        small = self.small[0 if with_sinkage else 1]
        return float(small * (self.large / small) ** (SIZES.index(name) / 2.0))

    @property
    def title(self) -> str:
        return f"{self.effect or 'outside'}:{self.name}"


def by_hooks(**hooks: Callable[..., Any]) -> Callable[[float, Setting], Hidden]:
    """Hidden by hooks of an Effect, among whose values are `size` and, as `sinkage`, the plain one."""
    effect = Effect("hidden", "", "", "", (), **hooks)
    return lambda size, setting: Hidden((Active(effect, {"size": size, "sinkage": setting.sinkage}),))
