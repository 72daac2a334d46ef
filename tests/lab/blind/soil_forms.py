"""Hidden effects of the soil: slip sinkage, compacted ruts, stiffening by rate, a hardpan, drift along the field."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from soilbus.arrays import Array
from soilbus.simulator.scenario import Patch, Scenario
from soilbus.terra.effects.effect import Surroundings
from soilbus.terra.wheel import Soil, WheelModel, WheelState
from tests.lab.blind.form import Form, Hidden, Setting, Sizes, by_hooks
from tests.lab.blind.rim import change


def _ding(state: WheelState, model: WheelModel, around: Surroundings, values: Sizes) -> tuple[WheelState, WheelModel]:
    slip = np.maximum(state.slip, 0.0)
    return state._replace(n=state.n + values["size"] * (slip + 1.5 * slip**2)), model


def _lyasko(state: WheelState, model: WheelModel, around: Surroundings, values: Sizes) -> tuple[WheelState, WheelModel]:
    """z = z_0 ((1 + s) / (1 - 0.5 s))^m: that share of the depth carries nothing."""
    slip = np.maximum(state.slip, 0.0)
    deeper = ((1.0 + slip) / (1.0 - 0.5 * slip)) ** values["size"]
    return state._replace(K_L=state.K_L * deeper**-state.n), model


def _reece(state: WheelState, model: WheelModel, around: Surroundings, values: Sizes) -> tuple[WheelState, WheelModel]:
    """z = z_0 + h s / (1 - s): the wheel enters the soil below a layer that it has thrown back."""
    slip = np.clip(state.slip, 0.0, 0.9)
    lost = values["size"] * slip / (1.0 - slip) / state.radius
    reach = 1.0 - np.cos(state.entry_angle)
    left = reach - 0.9 * reach * np.tanh(lost / (0.9 * reach))  # it cannot throw away all of its ground
    return state._replace(entry_angle=np.arccos(1.0 - left)), model


def _compacted(
    state: WheelState, model: WheelModel, around: Surroundings, values: Sizes
) -> tuple[WheelState, WheelModel]:
    """Ruts are stiffer, in pressing and in shearing, the more so the more the wheels before slipped."""
    worked = -np.expm1(-np.maximum(state.slip, 0.0) / _WORKED)
    more = 1.0 + values["size"] * np.asarray(around.rear, float) * (0.5 + 0.5 * worked)
    return state._replace(K_L=state.K_L * more, K=state.K / np.sqrt(more)), model


_WORKED = 0.1  # slip


def _denser(state: WheelState, model: WheelModel, around: Surroundings, values: Sizes) -> tuple[WheelState, WheelModel]:
    """With the density, cohesion grows faster than friction, and stiffness faster than both."""
    more = values["size"] * np.asarray(around.rear, float)
    return state._replace(
        K_L=state.K_L * (1.0 + 6.0 * more), c=state.c * (1.0 + 3.0 * more), tan_phi=state.tan_phi * (1.0 + more)
    ), model


def _in_the_rut(forces: Array, state: WheelState, around: Surroundings, values: Sizes) -> Array:
    """Rear wheels load soil that has borne the pressure at the depth of the rut: stiff up to there, then virgin."""
    rut = values["size"] * values["sinkage"] * np.asarray(around.rear, float)
    borne, stiff = state.K_L * rut**state.n, _STIFFER * state.K_L * values["sinkage"] ** (state.n - 1.0)

    def pressure(depth: Any) -> Any:
        return np.where(
            depth * stiff < borne, depth * stiff, state.K_L * np.maximum(depth - borne / stiff + rut, 0.0) ** state.n
        )

    return forces + change(state, pressure=pressure)


_STIFFER = 8.0
"""Slope of loading again over that of a chord to the plain sinkage."""


def _logarithm(
    state: WheelState, model: WheelModel, around: Surroundings, values: Sizes
) -> tuple[WheelState, WheelModel]:
    faster = np.log(np.maximum(around.ground_speed, 0.05) / 1.0)
    return state._replace(K_L=state.K_L * np.maximum(1.0 + values["size"] * faster, 0.1)), model


def _penetration(
    state: WheelState, model: WheelModel, around: Surroundings, values: Sizes
) -> tuple[WheelState, WheelModel]:
    """A power of the speed with which the rim enters the soil, V sin(theta_1)."""
    down = np.maximum(around.ground_speed, 0.05) * np.sin(state.entry_angle)
    return state._replace(K_L=state.K_L * (down / 0.4) ** values["size"]), model


def _sharp(forces: Array, state: WheelState, around: Surroundings, values: Sizes) -> Array:
    """Below the pan a linear bed of springs beside the soil, `size` times as stiff as the soil to there."""
    pan = 0.7 * values["sinkage"]
    bed = values["size"] * state.K_L * pan ** (state.n - 1.0)
    return forces + change(
        state, pressure=lambda depth: state.K_L * depth**state.n + bed * np.maximum(depth - pan, 0.0)
    )


def _graded(forces: Array, state: WheelState, around: Surroundings, values: Sizes) -> Array:
    """Ever denser with depth."""
    scale = values["sinkage"]
    return forces + change(
        state, pressure=lambda depth: state.K_L * depth**state.n * (1.0 + values["size"] * (depth / scale) ** 3)
    )


def _scaled(soil: Soil, size: float) -> Soil:
    return soil._replace(
        k_c=soil.k_c * (1.0 + size),
        k_phi=soil.k_phi * (1.0 + size),
        c=soil.c * (1.0 + 0.4 * size),
        phi=soil.phi * (1.0 + 0.2 * size),
    )


def _ramp(size: float, setting: Setting) -> Hidden:
    """One soil turns into another over the whole way, each parameter in a straight line."""
    ends = [_scaled(setting.soil, sign * size / 2.0) for sign in (-1.0, 1.0)]

    def way(scenario: Scenario) -> Scenario:
        length = scenario.duration * (scenario.speed.low + scenario.speed.high) / 2.0
        return replace(scenario, soils=(Patch(-1.0, "start", ends[0]), Patch(0.0, "end", ends[1])), transition=length)

    return Hidden(way=way)


def _border(state: WheelState, model: WheelModel, around: Surroundings, values: Sizes) -> tuple[WheelState, WheelModel]:
    """A soft border between two soils half way."""
    return _along(state, np.tanh((around.distance / around.length - 0.5) / 0.1) * values["size"] / 2.0), model


def _undulating(
    state: WheelState, model: WheelModel, around: Surroundings, values: Sizes
) -> tuple[WheelState, WheelModel]:
    """Once wetter and drier along the way."""
    return _along(state, np.sin(2.0 * np.pi * around.distance / around.length) * values["size"] / 2.0), model


def _along(state: WheelState, more: Any) -> WheelState:
    return state._replace(
        K_L=state.K_L * (1.0 + more), c=state.c * (1.0 + 0.4 * more), tan_phi=state.tan_phi * (1.0 + 0.2 * more)
    )


FORMS = (
    Form("slip_sinkage", "exponent", "Ding et al. 2010: n0 + n1 s + n2 s^2", "1", (0.006, 0.016), 0.4,
         by_hooks(wheel=_ding)),
    Form("slip_sinkage", "factor", "Lyasko 2010: (1 + s) / (1 - 0.5 s)", "1", (0.02, 0.05), 1.2,
         by_hooks(wheel=_lyasko)),
    Form("slip_sinkage", "offset", "Reece 1965: h s / (1 - s)", "m", (0.0013, 0.0013), 0.03, by_hooks(wheel=_reece),
         by_sinkage=True),
    Form("multipass", "stiffness", "Holm 1969, with K and slip: Senatore & Sandu 2011", "1", (0.04, 0.4), 1.5,
         by_hooks(wheel=_compacted)),
    Form("multipass", "density", "Wong 2008, ch. 2, in proportions of his own", "1", (0.0075, 0.02), 0.2,
         by_hooks(wheel=_denser)),
    Form("multipass", "rut", "reloading: Wong 2008, ch. 2", "sinkages", (0.02, 0.045), 0.6,
         by_hooks(forces=_in_the_rut)),
    Form("rate_stiffening", "log", "logarithm of the loading rate", "1", (0.012, 0.02), 0.25,
         by_hooks(wheel=_logarithm)),
    Form("rate_stiffening", "penetration", "penetration velocity: Grahn 1991", "1", (0.012, 0.02), 0.25,
         by_hooks(wheel=_penetration), far=True),
    Form("hardpan", "sharp", "bed of springs", "1", (0.8, 0.9), 8.0, by_hooks(forces=_sharp)),
    Form("hardpan", "graded", "denser with depth", "1", (0.3, 0.33), 2.0, by_hooks(forces=_graded)),
    Form("soil_drift", "ramp", "straight line in each parameter", "1", (0.006, 0.009), 0.6, _ramp),
    Form("soil_drift", "border", "tanh", "1", (0.004, 0.006), 0.6, by_hooks(wheel=_border)),
    Form("soil_drift", "undulating", "sine", "1", (0.005, 0.007), 0.6, by_hooks(wheel=_undulating)),
)  # fmt: skip
