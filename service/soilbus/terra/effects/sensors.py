"""What sensors tell wrongly: the load cells of hitch and wheels, channels that come late."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from soilbus.arrays import Array
from soilbus.terra.effects.along import earlier, instants, through_low_pass
from soilbus.terra.effects.effect import Active, Effect, Late, Parameter, Surroundings, Values

_LOAD_CELLS = (
    "zero and span of load cells: OIML R 60 (2021); draft cells 6.5 to 7.2 % off in the field: Cogent Eng. 2024"
)
_WANDERING = "; zero with temperature and in time: OIML R 60 (2021), 5.5 and 5.6; warming by Newton's law of cooling"
_WANDERS = (
    Parameter("drift", "N/s", 0.0, 2.0, -50.0, 50.0, of_record=True),
    Parameter("settling", "1/s", 0.01, 0.02, 5e-4, 0.2, starts=(0.06,), of_record=True),
)


def _zero(t: Any, duration: float, values: Values) -> Any:
    """Towards that at the end of the record, at a rate that starts as `drift` and fades by `settling`."""
    rate = values["settling"]
    to_go = (np.exp(-rate * duration) - np.exp(-rate * t)) / rate
    return values["offset"] + values["drift"] * to_go


def _draft_offset(draft: Any, around: Surroundings, values: Values) -> Any:
    return _zero(instants(around.t), around.duration, values) + np.zeros(np.shape(draft))


DRAFT_OFFSET = Effect(
    name="draft_offset",
    physics="The load cell at the hitch has lost its zero: it adds a force, which may wander, to every draft.",
    source=_LOAD_CELLS + _WANDERING,
    tells="a stretch with the implement lifted: the draft must then read zero",
    parameters=(Parameter("offset", "N", 0.0, 300.0, -5000.0, 5000.0), *_WANDERS),
    draft=_draft_offset,
)


def _draft_gain(draft: Any, around: Surroundings, values: Values) -> Any:
    return values["gain"] * draft


DRAFT_GAIN = Effect(
    name="draft_gain",
    physics="The load cell at the hitch tells every draft too great or too small by the same share.",
    source=_LOAD_CELLS,
    tells="drafts from none to great at one slip, a weight hung on the hitch",
    parameters=(Parameter("gain", "1", 0.0, 0.1, -0.5, 0.5),),
    draft=_draft_gain,
)


def late_by(values: Values, late: Late) -> float:
    """Return the total delay [s] of a channel: its dead time plus the time constant of its lag."""
    return float(values[late.delay]) + float(values.get(late.time_constant, 0.0))


def lateness(active: Sequence[Active]) -> dict[str, float]:
    """Return the total delay [s] of each quantity by these effects."""
    found: dict[str, float] = {}
    for effect, values in active:
        for quantity, late in effect.late.items():
            found[quantity] = found.get(quantity, 0.0) + late_by(values, late)
    return found


def read_late(truth: Array, t: Array, values: Values, late: Late) -> Array:
    """Return values (N, W) at times t [s] (N,) late by a delay and through a low pass.

    On straight lines between instants, and on beyond the first one of a run.
    """
    first, second, part = earlier(t, values[late.delay])
    part = part[:, None]
    queued = (1.0 - part) * truth[first] + part * truth[second]
    return through_low_pass(t, queued, values.get(late.time_constant, 0.0))


_DELAY_AND_LAG = "delay and first-order lag of a channel: Ljung, System Identification (2nd ed. 1999)"
_TORQUE = Late("delay", "time_constant")

TORQUE_LAG = Effect(
    name="torque_lag",
    physics="The torque comes late: filtered or queued on its way, it belongs to a moment that has passed.",
    source=_DELAY_AND_LAG,
    tells="quick changes of draft or speed; driving evenly hides it",
    parameters=(
        Parameter(_TORQUE.delay, "s", 0.0, 0.2, 0.0, 0.6),
        Parameter(_TORQUE.time_constant, "s", 0.0, 0.2, 0.0, 2.0, starts=(0.1,)),
    ),
    late={"torque": _TORQUE},
)

_OTHERS = {q: Late(f"{q}_delay", f"{q}_time_constant") for q in ("ground_speed", "draft", "load", "pitch")}

CHANNEL_LAG = Effect(
    name="channel_lag",
    physics="A channel comes late: ground speed, draft, loads or pitch belong to a moment that has passed.",
    source=_DELAY_AND_LAG + "; receivers of positions tell speeds 0.1 to 0.3 s late",
    tells="quick changes of draft or speed; driving evenly hides it",
    parameters=tuple(Parameter(name, "s", 0.0, 0.2, 0.0, 1.0) for late in _OTHERS.values() for name in late),
    late=_OTHERS,
)


def _wheel_load_offset(around: Surroundings, values: Values) -> Any:
    return _zero(np.asarray(around.t), around.duration, values) + np.zeros(np.shape(around.load))


WHEEL_LOAD_OFFSET = Effect(
    name="wheel_load_offset",
    physics="The load cell of a wheel has lost its zero: it adds a force to every load, that may wander as it warms.",
    source=_LOAD_CELLS + _WANDERING,
    tells="weighing the vehicle standing, before and after: the loads must add up to its weight",
    parameters=(Parameter("offset", "N", 0.0, 200.0, -3000.0, 3000.0), *_WANDERS),
    each_wheel=True,
    load=_wheel_load_offset,
)
