"""Hidden effects of the contact: bulldozing, lugs, peak stress, exit angle, shear law, tyre deflection."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from soilbus.arrays import Array
from soilbus.simulator.scenario import Swing
from soilbus.terra.effects.effect import Surroundings
from soilbus.terra.wheel import WheelModel, WheelState
from tests.lab.blind.form import Form, Hidden, Setting, Sizes, by_hooks
from tests.lab.blind.rim import change, rim_forces

Deflection = Callable[[Any, float], Any]
SOIL_WEIGHT = 16e3
"""Of moist soil [N/m^3]."""


def less_pull(forces: Array, push: Any) -> Array:
    return np.stack([forces[0], forces[1] - push, forces[2]])


def _rankine(forces: Array, state: WheelState, around: Surroundings, values: Sizes) -> Array:
    """Passive earth pressure on `size` widths of the wheel, under a heap of the soil pushed up."""
    z = state.radius * (1.0 - np.cos(state.entry_angle))
    phi = np.arctan(state.tan_phi)
    passive = np.tan(np.pi / 4.0 + phi / 2.0) ** 2
    heap = SOIL_WEIGHT * z**2 / (z + 0.1)  # grows with the sinkage until it runs off at the sides
    push = 0.5 * SOIL_WEIGHT * z**2 * passive + heap * z * passive + 2.0 * state.c * z * np.sqrt(passive)
    return less_pull(forces, values["size"] * state.width * push)


def _cutting(forces: Array, state: WheelState, around: Surroundings, values: Sizes) -> Array:
    """Bekker's bulldozing resistance by Terzaghi's bearing capacity at local shear, a share `size` of it."""
    r, z = state.radius, state.radius * (1.0 - np.cos(state.entry_angle))
    tan_phi, c = 2.0 / 3.0 * state.tan_phi, 2.0 / 3.0 * state.c
    phi = np.arctan(tan_phi)
    N_q = np.exp((1.5 * np.pi - phi) * tan_phi) / (2.0 * np.cos(np.pi / 4.0 + phi / 2.0) ** 2)
    N_c, N_g = (N_q - 1.0) / tan_phi, 2.0 * (N_q + 1.0) * tan_phi / (1.0 + 0.4 * np.sin(4.0 * phi))
    K_c = (N_c - tan_phi) * np.cos(phi) ** 2
    K_g = (2.0 * N_g / tan_phi + 1.0) * np.cos(phi) ** 2
    approach = np.arccos(np.clip(1.0 - z / r, 0.0, 1.0))
    wedge = np.sin(approach + phi) / (2.0 * np.sin(approach) * np.cos(phi))
    ruptured = z * np.tan(np.pi / 4.0 - phi / 2.0) ** 2
    sides = SOIL_WEIGHT * np.pi * ruptured**3 * (np.pi / 2.0 - phi) / 3.0 + c * ruptured**2 * (
        np.pi + np.tan(np.pi / 4.0 + phi / 2.0)
    )
    push = state.width * wedge * (2.0 * z * c * K_c + SOIL_WEIGHT * z**2 * K_g) + sides
    return less_pull(forces, values["size"] * push)


def _flanks(forces: Array, state: WheelState, around: Surroundings, values: Sizes) -> Array:
    """Both sides of the lugs shear soil that presses on them as at rest."""
    return forces + change(state, sides=values["size"])


def _tips(forces: Array, state: WheelState, around: Surroundings, values: Sizes) -> Array:
    """Soil is sheared at the tips, which move farther and pull on a longer arm than the rim."""
    return forces + change(state, tip=values["size"], sides=0.5 * values["size"])


def _constant_exit(forces: Array, state: WheelState, around: Surroundings, values: Sizes) -> Array:
    return forces + change(state, leave=-values["size"] + 0.0 * state.entry_angle)


def _rebound(forces: Array, state: WheelState, around: Surroundings, values: Sizes) -> Array:
    """The rut comes up again by a share of the sinkage."""
    up = np.arccos(1.0 - values["size"] * (1.0 - np.cos(state.entry_angle)))
    return forces + change(state, leave=-up)


def _peak_constant(forces: Array, state: WheelState, around: Surroundings, values: Sizes) -> Array:
    return forces + change(state, peak=0.5 - values["size"])


def _peak_linear(forces: Array, state: WheelState, around: Surroundings, values: Sizes) -> Array:
    return forces + change(state, peak=np.clip(0.5 + values["size"] * (0.32 * state.slip - 0.07), 0.05, 0.95))


def _peak_mobilised(forces: Array, state: WheelState, around: Surroundings, values: Sizes) -> Array:
    """Forward as far as shear is mobilised at the deepest point."""
    j = state.radius * np.maximum(state.slip, 0.0) * state.entry_angle
    return forces + change(state, peak=0.5 - values["size"] * np.exp(-j / (2.0 * state.K)))


def _slower(deflection: Deflection) -> Callable[..., Any]:
    """Slip from the smaller rolling radius of a flattened tyre, as a `wheel` hook."""

    def wheel(
        state: WheelState, model: WheelModel, around: Surroundings, values: Sizes
    ) -> tuple[WheelState, WheelModel]:
        flattened = deflection(np.maximum(around.load, 1.0), values["size"]) / state.radius
        return state._replace(slip=1.0 - (1.0 - state.slip) / _rolls(flattened)), model

    return wheel


def _flat_tyre(deflection: Deflection) -> Callable[[float, Setting], Hidden]:
    """A flat in the middle of the contact, and the round tyre, pushed down by it, before and behind."""

    def forces(forces: Array, state: WheelState, around: Surroundings, values: Sizes) -> Array:
        r, delta = state.radius, deflection(np.maximum(around.load, 1.0), values["size"])
        z = r * (1.0 - np.cos(state.entry_angle))
        entry, flat = np.arccos(1.0 - (z + delta) / r), np.arccos(1.0 - delta / r)
        tyre = rim_forces(
            state._replace(entry_angle=entry),
            pressure=lambda depth: state.K_L * np.minimum(depth, z) ** state.n,
            leave=-flat,
        )
        tyre[2] *= _rolls(delta / r)
        return forces + tyre - rim_forces(state)

    return by_hooks(wheel=_slower(deflection), forces=forces)


def _round_tyre(deflection: Deflection) -> Callable[[float, Setting], Hidden]:
    """Schmid's substitute circle, sqrt(r* z) = sqrt(r (z + delta)) + sqrt(r delta)."""

    def wheel(
        state: WheelState, model: WheelModel, around: Surroundings, values: Sizes
    ) -> tuple[WheelState, WheelModel]:
        r, delta = state.radius, deflection(np.maximum(around.load, 1.0), values["size"])
        slower, model = _slower(deflection)(state, model, around, values)
        return slower._replace(radius=r + 2.0 * np.sqrt(delta * r / (1.0 - np.cos(state.entry_angle)))), model

    def forces(forces: Array, state: WheelState, around: Surroundings, values: Sizes) -> Array:
        delta = deflection(np.maximum(around.load, 1.0), values["size"])
        shift = delta / (1.0 - np.cos(state.entry_angle))
        r = (np.sqrt(state.radius + shift) - np.sqrt(shift)) ** 2  # of the tyre without load
        return np.stack([forces[0], forces[1], forces[2] * (r * _rolls(delta / r) / state.radius)])

    return by_hooks(wheel=wheel, forces=forces)


def _rolls(flattened: Any) -> Any:
    """Rolling radius over the radius of a tyre flattened by a share of it: the chord in place of the arc."""
    half = np.arccos(1.0 - flattened)
    return np.sin(half) / half


def _shear(size: float, setting: Setting) -> Hidden:
    """Exponential data, rational model; how well the two are distinguished depends on the range of slip."""

    def law(name: str) -> Any:
        return lambda config: config.model_copy(update={"model": config.model.model_copy(update={"shear_law": name})})

    return Hidden(
        tractor=law("exponential"),
        configured=law("rational"),
        way=lambda scenario: replace(scenario, slip=Swing(0.05, size)),
    )


FORMS = (
    Form("bulldozing", "earth_pressure", "Rankine's passive pressure with a heap", "widths", (0.17, 0.6), 2.5,
         by_hooks(forces=_rankine)),
    Form("bulldozing", "cutting", "Bekker 1969, Hetherington & Littleton 1978", "1", (0.03, 0.14), 0.4,
         by_hooks(forces=_cutting)),
    Form("lugs", "flanks", "side shear of each lug, mobilised along the rim", "m", (0.06, 0.06), 0.12,
         by_hooks(forces=_flanks), far=True),
    Form("lugs", "tips", "shear radius at the tip: Ding et al. 2011", "m", (0.014, 0.015), 0.06,
         by_hooks(forces=_tips)),
    Form("rut_recovery", "constant", "an exit angle of its own", "rad", (0.011, 0.09), 0.2,
         by_hooks(forces=_constant_exit)),
    Form("rut_recovery", "rebound", "a share of the sinkage comes back", "1", (0.0037, 0.04), 0.15,
         by_hooks(forces=_rebound)),
    Form("stress_peak_shift", "constant", "Wong & Reece 1967, c1", "1", (0.036, 0.15), 0.3,
         by_hooks(forces=_peak_constant)),
    Form("stress_peak_shift", "linear", "Wong & Reece 1967, c1 and c2", "1", (0.053, 0.09), 1.0,
         by_hooks(forces=_peak_linear)),
    Form("stress_peak_shift", "mobilised", "with the shear mobilised", "1", (0.01, 0.017), 0.25,
         by_hooks(forces=_peak_mobilised)),
    Form("tyre_deflection", "spring", "flat and round parts: Fujimoto 1977; deflection in proportion to load", "m/N",
         (2e-07, 8e-07), 6e-06, _flat_tyre(lambda load, k: k * load)),
    Form("tyre_deflection", "power", "Schmid 1995, deflection of a power of the load", "m at 6 kN", (0.001, 0.02),
         0.05, _round_tyre(lambda load, k: k * (load / 6000.0) ** 0.65), far=True),
    Form("exponential_shear", "range", "Janosi & Hanamoto 1961; slips to", "1", (0.15, 0.18), 0.4, _shear),
)  # fmt: skip
