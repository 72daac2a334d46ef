"""Hidden effects by further formulas, added when the catalogue had adopted some of the first ones.

They stand behind the first in the list of forms, so that the cases of these keep their seeds.
"""

from __future__ import annotations

import numpy as np

from soilbus.arrays import Array
from soilbus.terra.effects.effect import Surroundings
from soilbus.terra.wheel import WheelState
from tests.lab.blind.contact_forms import SOIL_WEIGHT, less_pull
from tests.lab.blind.form import Form, Sizes, by_hooks
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


FORMS = (
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
