"""Hidden effects by further formulas, added when the catalogue had adopted some of the first ones.

They stand behind the first in the list of forms, in this order, so that earlier cases keep their seeds: FURTHER ones;
FAR ones, of whose effect the catalogue's own leave more than a tenth unexplained; LATE ones, delays of channels other
than the torque.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from soilbus.arrays import Array
from soilbus.can.channels import Column
from soilbus.simulator.recording import Recording
from soilbus.simulator.scenario import SAMPLE_RATE
from soilbus.terra.effects.effect import Surroundings
from soilbus.terra.wheel import WheelModel, WheelState
from tests.lab.blind.contact_forms import SOIL_WEIGHT, less_pull
from tests.lab.blind.form import Form, Hidden, Setting, Sizes, by_hooks
from tests.lab.blind.rim import change
from tests.lab.blind.vehicle_forms import filtered

_GRAVITY = 9.80665


def _unloading(forces: Array, state: WheelState, around: Surroundings, values: Sizes) -> Array:
    """What is pressed to the depth z springs back by p(z) / (k_0 + A_u z): stiffer the deeper it was pressed.

    `size` is the share that comes back from the plain sinkage, where both terms are as great.
    """
    z, plain = state.radius * (1.0 - np.cos(state.entry_angle)), values["sinkage"]
    back = values["size"] * plain * (z / plain) ** state.n * 2.0 / (1.0 + z / plain)
    return forces + change(state, leave=-np.arccos(1.0 - back / state.radius))


def _transported(forces: Array, state: WheelState, around: Surroundings, values: Sizes) -> Array:
    """The faster the rim slips the more soil it carries behind itself, on which it leaves the ground the later.

    What it tears off and how fast it flings that backwards both grow with the slip.
    """
    share = values["size"] * (0.5 + 3.0 * np.maximum(state.slip, 0.0) ** 2)
    return forces + change(state, leave=-np.arccos(1.0 - share * (1.0 - np.cos(state.entry_angle))))


def _thrown(forces: Array, state: WheelState, around: Surroundings, values: Sizes) -> Array:
    """A vertical blade's N factors, that grow with speed, and the soil set in motion besides, with its square.

    (gamma N_g z^2 + c N_c z) (1 + B v) b + rho N_a u^2 z b: drafts of tools have both parts, and the tread throws
    soil at its own speed u.
    """
    z = state.radius * (1.0 - np.cos(state.entry_angle))
    root = np.tan(np.pi / 4.0 + np.arctan(state.tan_phi) / 2.0)
    still = SOIL_WEIGHT * z**2 * root**2 / 2.0 + 2.0 * state.c * z * root
    moving = SOIL_WEIGHT / _GRAVITY * (state.radius * around.wheel_speed) ** 2 * z
    faster = 1.0 + _BY_SPEED * around.ground_speed
    return less_pull(forces, values["size"] * state.width * (still * faster + moving))


_BY_SPEED = 0.2  # s/m


def _mesh(torque: Array, around: Surroundings, values: Sizes) -> Array:
    """Friction between teeth falls with speed^0.7 and load^0.4; `size` is the share lost at 500 N m and 2.5 rad/s."""
    speed, load = np.maximum(np.abs(around.wheel_speed), 0.1) / 2.5, np.maximum(np.abs(torque), 1.0) / 500.0
    return np.asarray(torque + values["size"] * np.abs(torque) * speed**-0.7 * load**-0.4)


def _twice_filtered(torque: Array, around: Surroundings, values: Sizes) -> Array:
    """Through two low passes of this time constant, one after the other."""
    return filtered(filtered(torque, around, values), around, values)


def _creeping(around: Surroundings, values: Sizes) -> Array:
    """One cell's zero, that creeps with the logarithm of time, as what is loaded does."""
    crept = np.log1p(around.t / _CREEP)
    return np.asarray(values["size"] * (0.6 + 0.25 * crept) * np.array([0.0, 0.0, 1.0, 0.0]) + 0.0 * around.load)


_CREEP = 5.0  # s


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


def _from_a_receiver(size: float, setting: Setting) -> Hidden:
    """The ground speed of a receiver of positions: whole samples late."""

    def late(recording: Recording) -> Recording:
        column = recording.channels["ground_speed"]
        behind = round(size / float(np.median(np.diff(column.t))))
        value = column.value[np.maximum(np.arange(len(column.t)) - behind, 0)]
        return replace(recording, channels=recording.channels | {"ground_speed": Column(column.t, value)})

    return Hidden(after=late)


def _averaged_draft(draft: Array, around: Surroundings, values: Sizes) -> Array:
    """The error of a draft that is the mean over the last `size` [s]."""
    t = np.ravel(around.t)
    area = np.concatenate([[0.0], np.cumsum((draft[1:] + draft[:-1]) / 2.0 * np.diff(t))])
    begin = np.maximum(t - values["size"], t[0])
    span = np.maximum(t - begin, 1e-9)
    return np.asarray(np.where(t > t[0], (area - np.interp(begin, t, area)) / span, draft) - draft)


FURTHER = (
    Form("rut_recovery", "unloading", "unloading line k_0 + A_u z: Wong 2008, ch. 2", "1", (0.0037, 0.04), 0.15,
         by_hooks(forces=_unloading)),
    Form("rut_recovery", "transported", "soil carried behind the wheel: Ishigami et al. 2007", "1", (0.0037, 0.04),
         0.15, by_hooks(forces=_transported)),
    Form("bulldozing", "thrown",
         "soil set in motion: McKyes 1985, Soil Cutting and Tillage; A + B S + C S^2: ASABE D497", "widths",
         (0.1, 0.3), 1.5, by_hooks(forces=_thrown)),
    Form("drivetrain_loss", "mesh", "friction of teeth: ISO/TR 14179-1:2001", "1", (0.02, 0.022), 0.12,
         by_hooks(torque=_mesh)),
    Form("torque_lag", "two_stage", "two low passes", "s", (0.006, 0.006), 0.2, by_hooks(torque=_twice_filtered)),
    Form("wheel_load_offset", "creeping", "zero that creeps", "N", (150.0, 180.0), 900.0, by_hooks(load=_creeping)),
)  # fmt: skip
FAR = (
    Form("multipass", "kneaded", "by the slip of the wheel before: Senatore & Sandu 2011", "1",
         (0.04, 0.4), 1.5, by_hooks(wheel=_rolled_by_slip), far=True),
    Form("bulldozing", "dug_up", "heap grows with slip: Wong 2008, ch. 2; McKyes 1985", "widths",
         (0.1, 0.3), 1.5, by_hooks(forces=_dug_up), far=True),
    Form("inertia", "sprung", "implement on a drawbar that gives", "kg",
         (60.0, 60.0), 1500.0, by_hooks(resistance=_sprung), far=True),
    Form("draft_gain", "settling", "span of a cold cell", "1",
         (0.042, 0.042), 0.25, by_hooks(draft=_settling_span), far=True),
)  # fmt: skip
LATE = (
    Form("channel_lag", "receiver", "speed of a receiver of positions, 0.1 to 0.3 s late", "s", (0.04, 0.04), 0.4,
         _from_a_receiver),
    Form("channel_lag", "averaged_draft", "mean of a time before", "s", (0.06, 0.06), 0.8,
         by_hooks(draft=_averaged_draft)),
)  # fmt: skip
