"""What a hidden effect is: effects on the simulated drive, and changes of what surrounds it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import numpy as np

from soilbus.arrays import Array
from soilbus.config.model import Config
from soilbus.simulator.recording import Recording
from soilbus.simulator.scenario import Scenario
from soilbus.terra.effects.effect import (
    Active,
    DraftHook,
    Effect,
    ErrorHook,
    Forces,
    Surroundings,
    TorqueHook,
    WheelHook,
)
from soilbus.terra.wheel import Soil, WheelState

SIZES = ("small", "medium", "large")
Sizes = Mapping[str, float]
"""Values that the hooks of a hidden effect get: `size` in the unit of its form, `sinkage` [m] of the plain tractor."""


T = TypeVar("T")


class Setting(NamedTuple):
    """What a hidden effect may be fitted to: the soil, the sinkage [m] of the plain tractor on it, luck."""

    soil: Soil
    sinkage: float
    rng: np.random.Generator


def _same(what: T) -> T:
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

    def one_by_one(steps: Sequence[Callable[[T], T]]) -> Callable[[T], T]:
        def run(what: T) -> T:
            for step in steps:
                what = step(what)
            return what

        return run

    return Hidden(
        effects=tuple(active for part in parts for active in part.effects),
        tractor=one_by_one([part.tractor for part in parts]),
        configured=one_by_one([part.configured for part in parts]),
        way=one_by_one([part.way for part in parts]),
        after=one_by_one([part.after for part in parts]),
    )


@dataclass(frozen=True)
class Form:
    """One formula of an effect.

    effect: its name in the catalogue, "" where it is not in there.  small: the size, in
    `unit`, that is barely visible with a sinkage sensor and without; large: as great as it
    gets.  far: no parameters make the catalogue's formula nine tenths of this one.
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


def by_hooks(
    *,
    wheel: WheelHook | None = None,
    forces: Callable[[Array, WheelState, Surroundings, Sizes], Array] | None = None,
    torque: TorqueHook | None = None,
    draft: DraftHook | None = None,
    load: ErrorHook | None = None,
    resistance: ErrorHook | None = None,
) -> Callable[[float, Setting], Hidden]:
    """Hidden by hooks of an Effect, which are given Sizes as its values."""

    def of_arrays(of_wheel: Forces, state: WheelState, around: Surroundings, values: Sizes) -> Forces:
        assert forces is not None
        return forces(np.asarray(of_wheel), state, around, values)

    effect = Effect(
        "hidden", "", "", "", (),
        wheel=wheel, forces=of_arrays if forces else None, torque=torque, draft=draft, load=load, resistance=resistance,
    )  # fmt: skip
    return lambda size, setting: Hidden((Active(effect, {"size": size, "sinkage": setting.sinkage}),))
