"""Effects that the catalogue does not have."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from soilbus.arrays import Array
from soilbus.simulator.recording import Recording
from soilbus.simulator.scenario import SAMPLE_RATE
from soilbus.terra.effects.effect import Surroundings
from soilbus.terra.wheel import WheelModel, WheelState
from tests.lab.blind.form import Form, Hidden, Setting, Sizes, by_hooks


def _turned(omega: Array) -> Array:
    """Angles [rad] through which wheels have turned."""
    return np.cumsum(omega, axis=0) / SAMPLE_RATE


def _ripple(torque: Array, around: Surroundings, values: Sizes) -> Array:
    """Five lugs a turn come into the ground one after the other."""
    return torque * (1.0 + values["size"] * np.sin(5.0 * _turned(around.wheel_speed)))


def _draft_leak(around: Surroundings, values: Sizes) -> Array:
    """The frame of the load cells bends under the draft: the front reads less, the rear more."""
    sign = np.where(np.asarray(around.rear), 1.0, -1.0)
    return values["size"] * np.asarray(around.draft) * sign


def _cross_talk(torque: Array, around: Surroundings, values: Sizes) -> Array:
    """Each torque takes on a share of what the other wheel of its axle has beyond it."""
    return torque + values["size"] * (torque[:, [1, 0, 3, 2]] - torque)


def _warm_torque(torque: Array, around: Surroundings, values: Sizes) -> Array:
    """The torque cells' span settles as they warm up."""
    return np.asarray(torque * (1.0 + values["size"] * np.exp(-around.t / 25.0)))


def _bouncing(around: Surroundings, values: Sizes) -> Array:
    """The axles bounce on their tyres at 1.3 Hz; the cells measure it, soil and slip do not follow."""
    phase = np.array([0.0, 0.6, 2.0, 2.6])
    return np.asarray(values["size"] * np.sin(2.0 * np.pi * 1.3 * around.t + phase) + 0.0 * around.load)


def _rows(state: WheelState, model: WheelModel, around: Surroundings, values: Sizes) -> tuple[WheelState, WheelModel]:
    """Harder and softer ground every 0.75 m, the spacing of maize, driven across; axles one wheelbase apart."""
    x = around.distance - 1.95 * np.asarray(around.rear)
    return state._replace(K_L=state.K_L * (1.0 + values["size"] * np.sin(2.0 * np.pi * x / 0.75))), model


def _saturated(draft: Array, around: Surroundings, values: Sizes) -> Array:
    """The amplifier gives no more than a part of the greatest draft."""
    greatest = (1.0 - values["size"]) * float(np.max(draft))
    return np.minimum(draft, greatest) - draft


def _sticking(draft: Array, around: Surroundings, values: Sizes) -> Array:
    """Friction in the pin: the reading follows only when the draft has moved away by more than the band."""
    return _held_back(draft, values["size"])


def _held_back(true: Array, band: float) -> Array:
    """Error (N,) of a reading that follows the truth (N,) only when that has moved away by more than the band."""
    reported = np.empty_like(true)
    held = true[0]
    for i, now in enumerate(true):
        held = min(max(held, now - band), now + band)
        reported[i] = held
    return reported - true


def _swaying(draft: Array, around: Surroundings, values: Sizes) -> Array:
    """The implement sways at the hitch every two and a half seconds, and the pin reads some of its pull sideways."""
    return values["size"] * np.sin(2.0 * np.pi * np.ravel(around.t) / 2.5) + 0.0 * draft


def _stuck_gauge(torque: Array, around: Surroundings, values: Sizes) -> Array:
    """Friction beside each torque cell takes on its share before the cell does, whichever way the torque goes."""
    return torque + np.stack([_held_back(of_wheel, values["size"]) for of_wheel in torque.T], axis=1)


def _channels(change: Callable[[str, Array, Recording, float], Array | None]) -> Callable[[float, Setting], Hidden]:
    """Hidden by a change of measured channels: factors (N,) by channel name, None for none."""

    def hide(size: float, setting: Setting) -> Hidden:
        def after(recording: Recording) -> Recording:
            changed = {}
            for name, column in recording.channels.items():
                factor = change(name, column.t, recording, size)
                if factor is not None:
                    changed[name] = replace(column, value=column.value * factor)
            return replace(recording, channels=recording.channels | changed)

        return Hidden(after=after)

    return hide


def _tooth(name: str, t: Array, recording: Recording, size: float) -> Array | None:
    """A toothed wheel that runs out of true: its teeth pass too fast and too slowly once a turn."""
    if not name.startswith("speed.") or name not in recording.truth:  # a motor has no such wheel
        return None
    turned = _turned(recording.truth[name])
    return np.asarray(1.0 + size * np.sin(np.interp(t, recording.truth["t"], turned)))


def _nodding_radar(name: str, t: Array, recording: Recording, size: float) -> Array | None:
    """The radar looks down at an angle that nods with the soil's profile, every two seconds."""
    return 1.0 + size * np.sin(2.0 * np.pi * t / 2.0) if name == "ground_speed" else None


FORMS = (
    Form("", "torque_ripple", "locked to the wheel angle", "1", (0.0012, 0.0012), 0.08, by_hooks(torque=_ripple)),
    Form("", "draft_leak", "draft in the wheel load cells", "1", (0.0055, 0.0055), 0.2, by_hooks(load=_draft_leak),
         imitable=True),
    Form("", "tooth_error", "once a turn of each wheel", "1", (0.001, 0.001), 0.02, _channels(_tooth)),
    Form("", "draft_saturated", "amplifier at its end", "1", (0.01, 0.01), 0.5, by_hooks(draft=_saturated),
         imitable=True),
    Form("", "draft_sticking", "hysteresis of the pin", "N", (8.0, 8.0), 500.0, by_hooks(draft=_sticking),
         imitable=True),
    Form("", "row_spacing", "soil changes every 0.75 m", "1", (0.003, 0.003), 0.4, by_hooks(wheel=_rows)),
    Form("", "cross_talk", "torques of an axle mixed", "1", (0.02, 0.02), 0.5, by_hooks(torque=_cross_talk)),
    Form("", "warming_torque", "span settles", "1", (0.0033, 0.0033), 0.08, by_hooks(torque=_warm_torque),
         imitable=True),
    Form("", "bouncing", "load cells at 1.3 Hz", "N", (5.5, 5.5), 600.0, by_hooks(load=_bouncing)),
    Form("", "nodding_radar", "ground speed every 2 s", "1", (0.0017, 0.0017), 0.04, _channels(_nodding_radar)),
    Form("", "hitch_sway", "draft every 2.5 s", "N", (20.0, 20.0), 600.0, by_hooks(draft=_swaying)),
    Form("", "stuck_gauge", "hysteresis of the torque cells", "N m", (3.0, 3.0), 60.0, by_hooks(torque=_stuck_gauge),
         imitable=True),
)  # fmt: skip
