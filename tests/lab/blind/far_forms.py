"""Formulas that the catalogue's own cannot imitate well: more than a tenth of what they do stays unexplained.

They are the last of the list of forms, so that earlier cases stay what they were; pairs do not have them.
"""

from __future__ import annotations

import numpy as np

from soilbus.arrays import Array
from soilbus.simulator.scenario import SAMPLE_RATE
from soilbus.terra.effects.effect import Surroundings
from soilbus.terra.wheel import WheelModel, WheelState
from tests.lab.blind.contact_forms import SOIL_WEIGHT, less_pull
from tests.lab.blind.form import Form, Sizes, by_hooks


def _rolled_by_slip(
    state: WheelState, model: WheelModel, around: Surroundings, values: Sizes
) -> tuple[WheelState, WheelModel]:
    """The front wheel kneads the soil as well as it presses it: the rut is the firmer the more it slipped."""
    front = np.maximum(state.slip[..., :2], 0.0)[..., [0, 1, 0, 1]]
    firmer = 1.0 + values["size"] * np.where(np.asarray(around.rear), 0.2 + 2.0 * front, 0.0)
    return state._replace(K_L=state.K_L * firmer), model


def _dug_up(forces: Array, state: WheelState, around: Surroundings, values: Sizes) -> Array:
    """A wheel that slips digs up the soil that it then pushes: a heap of its slip times its sinkage."""
    z = state.radius * (1.0 - np.cos(state.entry_angle))
    heap = z * (1.0 + 8.0 * np.maximum(state.slip, 0.0))
    root = np.tan(np.pi / 4.0 + np.arctan(state.tan_phi) / 2.0)
    push = 0.5 * SOIL_WEIGHT * heap**2 * root**2 + 2.0 * state.c * z * root * np.maximum(state.slip, 0.0)
    return less_pull(forces, values["size"] * state.width * push)


def _sprung(around: Surroundings, values: Sizes) -> Array:
    """A towed mass behind a drawbar that gives: its force follows the acceleration, and swings after it."""
    a, step = np.ravel(around.acceleration), 1.0 / SAMPLE_RATE
    rate, damping, force, change = 2.0 * np.pi * 0.5, 0.4, np.zeros(len(a)), 0.0
    for i in range(1, len(a)):
        change += step * (rate**2 * (a[i] - force[i - 1]) - 2.0 * damping * rate * change)
        force[i] = force[i - 1] + step * change
    return values["size"] * force


def _settling_span(draft: Array, around: Surroundings, values: Sizes) -> Array:
    """The span of a cell that has been cold: wrong at first, right when warm."""
    return values["size"] * draft * (0.2 + np.exp(-np.ravel(around.t) / 40.0))


FORMS = (
    Form("multipass", "kneaded", "by the slip of the wheel before: Senatore & Sandu 2011", "1",
         (0.04, 0.4), 1.5, by_hooks(wheel=_rolled_by_slip), far=True),
    Form("bulldozing", "dug_up", "heap grows with slip: Wong 2008, ch. 2; McKyes 1985", "widths",
         (0.1, 0.3), 1.5, by_hooks(forces=_dug_up), far=True),
    Form("inertia", "sprung", "implement on a drawbar that gives", "kg",
         (60.0, 60.0), 1500.0, by_hooks(resistance=_sprung), far=True),
    Form("draft_gain", "settling", "span of a cold cell", "1",
         (0.042, 0.042), 0.25, by_hooks(draft=_settling_span), far=True),
)  # fmt: skip
