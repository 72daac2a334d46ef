"""What the soil does that Bekker's curve does not know: it is dug out, hurried, driven over, layered, changing."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from soilbus.terra.effects.along import curve_of, share_of_way, through_knots
from soilbus.terra.effects.effect import Effect, OnSoil, Parameter, Surroundings, Values
from soilbus.terra.wheel import WheelModel, WheelState, sinkage

__all__ = ["HARDPAN", "MULTIPASS", "RATE_STIFFENING", "SLIP_SINKAGE", "SOIL_DRIFT"]

REFERENCE_SPEED = 1.0
"""Ground speed [m/s] for which the soil's own K_L holds."""
TYPICAL_DEPTH = 0.05
"""Depth [m] at which a change of n with slip leaves the pressure as it is, so that the two parameters act apart."""
TYPICAL_PRESSURE = 1e5
"""Pressure [Pa] at which a change of n in ruts does: that of tyres, on any soil."""
_LEAST_SPEED = 0.05
_LEAST_EXPONENT = 0.05
_LEAST_CONTACT = 0.1  # of the sinkage: a wheel cannot throw away all of its ground


def _slip_sinkage(state: WheelState, model: WheelModel, around: Surroundings, values: Values) -> OnSoil:
    """n + exponent s, K_L exp(-softening s), contact below a layer dug s, for slips s > 0.

    At TYPICAL_DEPTH the exponent does nothing.
    """
    slip = np.maximum(state.slip, 0.0)
    n = np.maximum(state.n + values["exponent"] * slip, np.minimum(state.n, _LEAST_EXPONENT))
    softer = values["softening"] * slip + (n - state.n) * np.log(TYPICAL_DEPTH)
    whole = sinkage(state.entry_angle, 1.0)
    left = np.maximum(whole - values["dug"] * slip / state.radius, _LEAST_CONTACT * whole)
    angle = 2.0 * np.arctan(np.sqrt(left / (2.0 - left)))
    return state._replace(entry_angle=angle, n=n, K_L=state.K_L * np.exp(-softer)), model


SLIP_SINKAGE = Effect(
    name="slip_sinkage",
    physics="A slipping wheel digs: it carries soil away from under itself and sinks deeper than its load asks.",
    source="n = n0 + n1 s: Ding et al. 2010 (J. Central South Univ. Technol. 17:129); sinkage times a function of slip,"
    " which a softer K_L gives: Lyasko 2010 (J. Terramechanics 47:21); a layer that is thrown back, below which the"
    " wheel meets the soil, deeper with slip: Reece 1965, Principles of Soil-Vehicle Mechanics (Proc. IMechE 180)",
    tells="a sinkage sensor, and slips from 0.05 to beyond 0.4 at one load",
    parameters=(
        Parameter("softening", "1", 0.0, 0.6, -2.0, 4.0),
        Parameter("exponent", "1", 0.0, 0.3, -0.5, 1.5),
        Parameter("dug", "m", 0.0, 0.02, 0.0, 0.3),
    ),
    wheel=_slip_sinkage,
)


def _rate_stiffening(state: WheelState, model: WheelModel, around: Surroundings, values: Values) -> OnSoil:
    """K_L (V / V0)^m."""
    speed = np.maximum(np.abs(around.ground_speed), _LEAST_SPEED)
    return state._replace(K_L=state.K_L * (speed / REFERENCE_SPEED) ** values["exponent"]), model


RATE_STIFFENING = Effect(
    name="rate_stiffening",
    physics="Soil and its pore water need time to give way: pressed faster, the ground carries more.",
    source="pressure grows with a power of the sinkage rate: Pope 1969 (J. Terramechanics 6); Grahn 1991 (ibid. 28)",
    tells="the same ground at two speeds, a factor of two or more apart",
    parameters=(Parameter("exponent", "1", 0.0, 0.15, -0.3, 0.6),),
    wheel=_rate_stiffening,
)


def _multipass(state: WheelState, model: WheelModel, around: Surroundings, values: Values) -> OnSoil:
    """Rear wheels: p_0 (K_L z^n / p_0)^exp(-reloading) exp(stiffness); c and tan phi exp(density); K exp(-shear).

    The power does nothing at TYPICAL_PRESSURE p_0.
    """
    rear = np.asarray(around.rear, float)
    strength, power = np.exp(values["density"] * rear), np.exp(-values["reloading"] * rear)
    K_L = TYPICAL_PRESSURE * np.exp(power * np.log(state.K_L / TYPICAL_PRESSURE) + values["stiffness"] * rear)
    K = state.K * np.exp(-values["shear"] * rear)
    changed = state._replace(n=power * state.n, K_L=K_L, c=state.c * strength, tan_phi=state.tan_phi * strength, K=K)
    return changed, model


MULTIPASS = Effect(
    name="multipass",
    physics="Rear wheels run in ruts that the front wheels have compacted: there the soil is stiffer and stronger.",
    source="Holm 1969 (J. Terramechanics 6); density form: Wong, Theory of Ground Vehicles (4th ed. 2008), ch. 2;"
    " a smaller shear deformation modulus besides: Senatore & Sandu 2011 (J. Terramechanics 48:265);"
    " soil that has been loaded before resists at once and gains less with depth: repetitive loading, Wong 2008",
    tells="driving one axle beside the other's ruts (crab steering, reversing), a sinkage sensor at both axles",
    parameters=(
        Parameter("stiffness", "1", 0.0, 0.5, -0.7, 2.5),
        Parameter("density", "1", 0.0, 0.1, -0.3, 0.6),
        Parameter("shear", "1", 0.0, 0.3, -0.7, 2.0),
        Parameter("reloading", "1", 0.0, 0.2, -0.7, 2.0),
    ),
    wheel=_multipass,
    ruled_out="a wheel with none ahead of it runs in no rut",
)


def _hardpan(state: WheelState, model: WheelModel, around: Surroundings, values: Values) -> OnSoil:
    """From a depth on, pressure grows (1 + stiffness) times as fast as the soil's own."""
    return state, replace(model, pan_depth=values["depth"], pan_stiffness=values["stiffness"], one_off=True)


HARDPAN = Effect(
    name="hardpan",
    physics="Below the tilled layer lies a stiffer one: once a wheel reaches it, it hardly sinks further.",
    source="two-layer pressure-sinkage curve: Bekker, Introduction to Terrain-Vehicle Systems (1969);"
    " Wong, Terramechanics and Off-Road Vehicle Engineering (2nd ed. 2010), ch. 4",
    tells="loads from light to heavy, a sinkage sensor",
    parameters=(
        Parameter("stiffness", "1", 0.0, 5.0, 0.0, 50.0),
        Parameter("depth", "m", 0.04, 0.04, 0.002, 0.3, starts=(0.01, 0.02, 0.03, 0.06)),
    ),
    wheel=_hardpan,
)

DRIFT_KNOTS = 7
"""Between the ends of the way: a soft border half way is no longer than two of them are apart."""


def _drift_of(name: str, share: np.ndarray, values: Values) -> Any:
    """Nothing at the middle of the way: the soil's own parameters are those of there."""
    bends = [0.0, *(values[f"{name}_{i + 1}"] for i in range(DRIFT_KNOTS)), 0.0]
    return values[name] * (np.clip(share, 0.0, 1.0) - 0.5) + through_knots(share, bends) - bends[len(bends) // 2]


def _soil_drift(state: WheelState, model: WheelModel, around: Surroundings, values: Values) -> OnSoil:
    """K_L, and c and tan phi together, times the exponential of a line along the way that may bend."""
    share = share_of_way(around)
    strength = np.exp(_drift_of("strength", share, values))
    K_L = state.K_L * np.exp(_drift_of("stiffness", share, values))
    return state._replace(K_L=K_L, c=state.c * strength, tan_phi=state.tan_phi * strength), model


SOIL_DRIFT = Effect(
    name="soil_drift",
    physics="The soil itself changes along the field: moisture and texture, and stiffness and strength with them.",
    source="log-normal variation along the way: Oliver & Webster 2014 (Catena 113:56)",
    tells="driving the same way back: what belongs to the place comes again, what belongs to time does not",
    parameters=(
        Parameter("stiffness", "1", 0.0, 0.4, -3.0, 3.0),
        *curve_of("stiffness", "1", range(1, DRIFT_KNOTS + 1), DRIFT_KNOTS + 1, 0.2, 1.5),
        Parameter("strength", "1", 0.0, 0.15, -1.0, 1.0),
        *curve_of("strength", "1", range(1, DRIFT_KNOTS + 1), DRIFT_KNOTS + 1, 0.08, 0.5),
    ),
    wheel=_soil_drift,
    of_record=True,
)
