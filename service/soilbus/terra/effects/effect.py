"""What an effect is: a small change of the wheel-soil model, of a force, or of what a sensor reads.

An effect has parameters, each with a value at which the effect is absent and a prior
range, and up to five hooks, all pure functions.  `wheel` and `forces` are elementwise, for
arrays of any shape that broadcast with those of Surroundings; the others work on instants
(N,) and wheels (N, W).  Loads, speeds, forces, soil and parameters that they are given may
be Duals (see terra.dual): they keep to functions that these know.  Effects are off by
default and may be combined in any order of the catalogue: first every `wheel`, then the
integrals, then every `forces`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from soilbus.arrays import Array
from soilbus.terra.wheel import WheelModel, WheelState, wheel_forces

DRAFT_ROUNDS = 3
"""Fixed-point rounds from a reading of the hitch to the draft: its error is a few per cent of it."""

Values = Mapping[str, Any]
"""Parameters of an effect by name: floats, or one for each wheel (W,)."""
Forces = Sequence[Any] | Array
"""Load W [N], drawbar pull DP [N] and torque T [N m], three arrays alike."""


class Surroundings(NamedTuple):
    """What effects may depend on besides the wheel state; (N, W), (N, 1) or (W,), broadcasting with it.

    t [s] and distance [m] since the start of the record; load of the wheel [N];
    ground_speed [m/s]; wheel_speed [rad/s]; rear says which wheels run in the rut of
    another; draft [N] and acceleration [m/s^2] of the vehicle, mass [kg] of it; duration
    [s] and length [m] of the whole record (length 0: unknown).  Slips are those of the
    nominal radius, 1 - V/(r omega).
    """

    t: Any
    distance: Any
    load: Any
    ground_speed: Any
    wheel_speed: Any
    rear: Any
    draft: Any
    acceleration: Any
    mass: float
    duration: float
    length: float = 0.0


class Knot(NamedTuple):
    """Knot of a curve along the way: `number` of 0..intervals; knots that are no parameters are zero."""

    curve: str
    number: int
    intervals: int


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter of an effect: absent at `neutral`, prior sd `std` about it, confined to low..high; SI unit.

    `starts`: further values that a search does well to begin at, where the sensitivity at
    `neutral` alone may be blind (the depth of a pan below all sinkages of a record).
    `of_record`: it describes one record and means nothing in another.
    `of_vehicle`: it is the same in all records, though its effect is of the record.
    `knot`: it is the height of a curve there.
    """

    name: str
    unit: str
    neutral: float
    std: float
    low: float
    high: float
    starts: tuple[float, ...] = ()
    of_record: bool = False
    knot: Knot | None = None
    of_vehicle: bool = False


OnSoil = tuple[WheelState, WheelModel]
"""A wheel on its soil, and the model of the two."""
WheelHook = Callable[[WheelState, WheelModel, Surroundings, Values], OnSoil]
ForcesHook = Callable[[Forces, WheelState, Surroundings, Values], Forces]
TorqueHook = Callable[[Any, Surroundings, Values], Any]
DraftHook = Callable[[Any, Surroundings, Values], Any]
ErrorHook = Callable[[Surroundings, Values], Any]


class Late(NamedTuple):
    """Names of the parameters [s] by which a channel is late: a dead time, and a low pass's time constant if any."""

    delay: str
    time_constant: str = ""


@dataclass(frozen=True)
class Effect:
    """Physical or sensor effect with its parameters.

    `physics` is the sentence a report prints, `source` where its equation comes from,
    `tells` the manoeuvre or sensor that shows it apart from others.  The first of the
    parameters is the one that `simulate --effect NAME=VALUE` sets.  With `each_wheel` every
    wheel has parameters of its own.

    wheel: state and model before the stresses are integrated.  forces: load, drawbar pull
    and torque (3, ...) between wheel and ground, after it.  torque: what the sensors read
    (N, W) of the torques at the wheels.  draft: error [N] (N,) of the load cell at the
    hitch, reading less truth, of true drafts (N,).  load: errors [N] (N, W) of the wheel
    load cells.  resistance: force [N] (N,) that holds the vehicle back and is in no reading.
    base_law: the shear law of models to which the effect can be added, None for any.
    late: quantities of which the effect's samples are late, each by the parameters named.
    of_record: its parameters describe the ground of one record and mean nothing in another.
    of_tyre: it is there only where a wheel has a tyre.
    ruled_out: what on the vehicle makes it impossible, where anything does.
    """

    name: str
    physics: str
    source: str
    tells: str
    parameters: tuple[Parameter, ...]
    each_wheel: bool = False
    wheel: WheelHook | None = None
    forces: ForcesHook | None = None
    torque: TorqueHook | None = None
    draft: DraftHook | None = None
    load: ErrorHook | None = None
    resistance: ErrorHook | None = None
    base_law: str | None = None
    of_record: bool = False
    of_tyre: bool = False
    ruled_out: str = ""
    late: Mapping[str, Late] = field(default_factory=dict, hash=False)

    @property
    def neutral(self) -> dict[str, float]:
        """Values at which the effect is absent."""
        return {p.name: p.neutral for p in self.parameters}

    def own_in_each_record(self, parameter: Parameter) -> bool:
        """Return whether every record has its own value of one of the parameters."""
        return (self.of_record and not parameter.of_vehicle) or parameter.of_record


class Active(NamedTuple):
    """Effect with values of all its parameters."""

    effect: Effect
    values: Values


def wheel_with(active: Sequence[Active], state: WheelState, model: WheelModel, around: Surroundings) -> OnSoil:
    """Return state and model of wheels with these effects."""
    for effect, values in active:
        if effect.wheel is not None:
            state, model = effect.wheel(state, model, around, values)
    return state, model


def forces_with(active: Sequence[Active], state: WheelState, model: WheelModel, around: Surroundings) -> Array:
    """Return the load W [N], drawbar pull DP [N] and torque T [N m] of wheels with these effects: array (3, ...)."""
    state, model = wheel_with(active, state, model, around)
    return np.stack(list(reactions_with(active, wheel_forces(state, model), state, around)))


def reactions_with(active: Sequence[Active], forces: Forces, state: WheelState, around: Surroundings) -> Forces:
    """Return `forces_with` from the integrated forces of a state that already has these effects."""
    for effect, values in active:
        if effect.forces is not None:
            forces = effect.forces(forces, state, around, values)
    return forces


def true_draft(active: Sequence[Active], reading: Any, around: Surroundings) -> Any:
    """Return the draft [N] (N,) for which the load cell, with the errors of these effects, gives the reading (N,)."""
    errors = [(effect.draft, values) for effect, values in active if effect.draft is not None]
    draft = reading
    for _ in range(DRAFT_ROUNDS if errors else 0):
        draft = reading - sum(error(draft, around, values) for error, values in errors)
    return draft
