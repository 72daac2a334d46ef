"""Where and how wheel and soil touch: the stresses' shape, soil pushed ahead, lugs, a flexible carcass."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from soilbus.terra.effects.effect import Effect, Forces, OnSoil, Parameter, Surroundings, Values
from soilbus.terra.wheel import WheelModel, WheelState, sinkage


def _stress_peak_shift(state: WheelState, model: WheelModel, around: Surroundings, values: Values) -> OnSoil:
    """theta_m / theta_1 = peak_c1 + c1 + (peak_c2 + c2) s (1 + bend) / (1 + bend |s|)."""
    c1, c2 = model.peak_c1 + values["c1"], model.peak_c2 + values["c2"]
    return state, replace(model, peak_c1=c1, peak_c2=c2, peak_bend=values["bend"], one_off=True)


STRESS_PEAK_SHIFT = Effect(
    name="stress_peak_shift",
    physics="The greatest pressure does not sit half way round the contact, and it moves forward with slip.",
    source="theta_m = (c1 + c2 s) theta_1, c1 0.18 to 0.43, c2 0.32 in sand: Wong & Reece 1967 (J. Terramech. 4:81);"
    " that it levels off is ours: it cannot pass the entry angle, and shear stops growing once it is mobilised",
    tells="slips from 0.05 to beyond 0.4 with a sinkage sensor; a push that changes with slip is no draft offset",
    parameters=(
        Parameter("c2", "1", 0.0, 0.2, -0.1, 0.35),
        Parameter("c1", "1", 0.0, 0.12, -0.3, 0.1),
        Parameter("bend", "1", 0.0, 3.0, 0.0, 15.0, starts=(5.0,)),
    ),
    wheel=_stress_peak_shift,
)


def _rut_recovery(state: WheelState, model: WheelModel, around: Surroundings, values: Values) -> OnSoil:
    """theta_2 = -((recovery + carried s) theta_1 + angle)."""
    ratio, by_slip = model.exit_ratio - values["recovery"], model.exit_slip - values["carried"]
    angle = model.exit_angle - values["angle"]
    return state, replace(model, exit_ratio=ratio, exit_slip=by_slip, exit_angle=angle, one_off=True)


RUT_RECOVERY = Effect(
    name="rut_recovery",
    physics="The rut springs back behind the axle and pushes the wheel forward: contact ends behind the lowest point.",
    source="exit angle behind the axle: Wong & Reece 1967 (J. Terramechanics 4:81); the farther the more soil a"
    " slipping wheel carries behind itself: Ishigami et al. 2007 (J. Field Robotics 24:233)",
    tells="rut depth behind the wheel against sinkage under it; loads from light to heavy",
    parameters=(
        Parameter("recovery", "1", 0.0, 0.2, 0.0, 0.6),
        Parameter("angle", "rad", 0.0, 0.08, 0.0, 0.3),
        Parameter("carried", "1", 0.0, 0.3, 0.0, 2.0),
    ),
    wheel=_rut_recovery,
)


def _exponential_shear(state: WheelState, model: WheelModel, around: Surroundings, values: Values) -> OnSoil:
    """A share of the shear strength mobilised by 1 - exp(-j/K) instead of j/(j + K)."""
    return state, replace(model, exponential_share=model.exponential_share + values["share"], one_off=True)


EXPONENTIAL_SHEAR = Effect(
    name="exponential_shear",
    physics="Soil mobilises its shear strength faster with displacement than the rational law says: exponentially.",
    source="Janosi & Hanamoto 1961 (1st Int. Conf. Mechanics of Soil-Vehicle Systems, Turin);"
    " the rational law: Xi et al. 2024 eq. 12",
    tells="slips from 0.02 to beyond 0.4: the two laws part in between",
    parameters=(Parameter("share", "1", 0.0, 1.0, -0.3, 1.3),),
    wheel=_exponential_shear,
    base_law="rational",
)


def _bulldozing(forces: Forces, state: WheelState, around: Surroundings, values: Values) -> Forces:
    """Drawbar pull less b (density z^2 / 2 + cohesive_factor c z + moved v^2 z)."""
    z = sinkage(state.entry_angle, state.radius)
    moved = values["cohesive_factor"] * state.c + values["moved"] * around.ground_speed**2
    ahead = state.width * z * (values["density"] * z / 2.0 + moved)
    return forces[0], forces[1] - ahead, forces[2]


BULLDOZING = Effect(
    name="bulldozing",
    physics="The wheel pushes a wedge of soil ahead of it, which costs drawbar pull but no torque at the rim.",
    source="passive earth pressure b (gamma Kp z^2 / 2 + 2 c sqrt(Kp) z), or Bekker's N factors in its place:"
    " Bekker 1969; Hetherington & Littleton 1978 (J. Terramechanics 15:95); soil set in motion, rho N_a v^2 z:"
    " McKyes 1985, Soil Cutting and Tillage",
    tells="loads from light to heavy (it grows faster than the sinkage) and a sinkage sensor;"
    " a constant push is a draft offset",
    parameters=(
        Parameter("density", "N/m^3", 0.0, 2e5, 0.0, 2e6),
        Parameter("cohesive_factor", "1", 0.0, 3.0, 0.0, 30.0),
        Parameter("moved", "kg/m^3", 0.0, 2000.0, 0.0, 30000.0),
    ),
    forces=_bulldozing,
)


def _lugged_soil(state: WheelState, model: WheelModel, around: Surroundings, values: Values) -> OnSoil:
    """c (1 + 2 h/b) and tan phi (1 + 0.64 (h/b) arccot(h/b))."""
    ratio = values["height"] / state.width
    friction = 1.0 + 0.64 * ratio * (np.pi / 2.0 - np.arctan(ratio))
    return state._replace(c=state.c * (1.0 + 2.0 * ratio), tan_phi=state.tan_phi * friction), model


def _lugged_arm(forces: Forces, state: WheelState, around: Surroundings, values: Values) -> Forces:
    """Shear acts at the radius r + h share."""
    arm = 1.0 + values["height"] * values["share"] / state.radius
    return forces[0], forces[1], forces[2] * arm


LUGS = Effect(
    name="lugs",
    physics="Lugs hold a block of soil between them: it shears along their tips and along both its sides.",
    source="side shear of a grouser: Bekker 1956, Theory of Land Locomotion; Wong 2008, ch. 4; shear radius between rim"
    " and tip: Ding et al. 2011 (J. Terramechanics 48:27)",
    tells="cohesive soil, and draft beside torque; on cohesionless soil they are a greater tan phi and no data tell",
    parameters=(
        Parameter("height", "m", 0.0, 0.03, 0.0, 0.12),
        Parameter("share", "1", 0.5, 0.25, 0.0, 1.0, starts=(0.02,)),
    ),
    wheel=_lugged_soil,
    forces=_lugged_arm,
    ruled_out="a smooth rim has no lugs",
)

_EVENLY = 0.04
"""Length [m] short of which a flat grows evenly with the deflection: a chord's slope has no bound at none."""
_MOST_DEFLECTION = 0.3  # of the width; then the rim strikes through


def _substitute_circle(state: WheelState, model: WheelModel, around: Surroundings, values: Values) -> OnSoil:
    """The greater circle through the deepest point and the point where the flattened tyre enters the soil.

    A hub at the height r - delta above the deepest point gives
    r*^2 - r* (r - delta) = delta (2 r - delta) / (2 (1 - cos theta_1)).
    """
    r, delta = state.radius, _deflection(state, around, values)
    half = (r - delta) / 2.0
    circle = half + np.sqrt(half**2 + delta * (2.0 * r - delta) / (2.0 * sinkage(state.entry_angle, 1.0)))
    slip = 1.0 - (1.0 - state.slip) * r / _rolling(r, delta)
    return state._replace(radius=circle, slip=slip), model


def _flattened_forces(forces: Forces, state: WheelState, around: Surroundings, values: Values) -> Forces:
    """What the flat behind the axle adds; torque at the arm of the rolling radius, by virtual work.

    The substitute circle ends at the axle.  Behind it, a share of the flat's half length
    carries the pressure of the deepest point and has slipped as far as the soil there; its
    shear is Janosi and Hanamoto's under any law of the model.
    """
    circle, delta = state.radius, _deflection(state, around, values)
    z = sinkage(state.entry_angle, circle)
    nominal = (z * (circle + delta) + delta**2 / 2.0) / (z + delta)  # whose substitute circle it is
    area = state.width * values["behind"] * _half_flat(nominal, delta)
    pressure = state.K_L * z**state.n
    j_K = circle / state.K * (state.entry_angle - (1.0 - state.slip) * np.sin(state.entry_angle))
    mobilised = np.exp(-np.maximum(-j_K, 0.0)) - np.exp(-np.maximum(j_K, 0.0))  # backwards where the wheel skids
    sheared = (state.c + pressure * state.tan_phi) * mobilised
    arm = _rolling(nominal, delta)
    return (forces[0] + area * pressure, forces[1] + area * sheared, (forces[2] / circle + area * sheared) * arm)


def _half_flat(radius: Any, deflection: Any) -> Any:
    """Half the length [m] of the flat, near a chord; while it is short it grows evenly with the deflection."""
    return np.sqrt(2.0 * radius * deflection + _EVENLY**2) - _EVENLY


def _deflection(state: WheelState, around: Surroundings, values: Values) -> Any:
    deflection = np.minimum(values["compliance"] * np.maximum(around.load, 0.0), _MOST_DEFLECTION * state.width)
    return deflection * np.equal(state.length, 0.0)  # a track has no tyre


def _rolling(radius: Any, deflection: Any) -> Any:
    return radius - deflection / 3.0


TYRE_DEFLECTION = Effect(
    name="tyre_deflection",
    physics="The tyre flattens under load: it touches the ground like a greater wheel, and rolls like a smaller one.",
    source="substitute circle: Bekker 1969; Schmid 1995 (J. Terramechanics 32:3); Harnisch et al. 2005 (Vehicle System"
    " Dynamics 43 suppl.:384); rolling radius less a third of the deflection: Wong 2008, ch. 1; flat of the half"
    " length sqrt(2 r delta) on both sides of the axle: ch. 2; even pressure: Fujimoto 1977 (J. Terramechanics 14:191)",
    tells="firm ground at several loads (the rolling radius shrinks), a sinkage sensor, another tyre pressure",
    parameters=(
        Parameter("compliance", "m/N", 0.0, 4e-6, 0.0, 2e-5),
        Parameter("behind", "1", 0.0, 0.5, 0.0, 1.0, starts=(0.5,)),
    ),
    wheel=_substitute_circle,
    forces=_flattened_forces,
    of_tyre=True,
    ruled_out="a rigid wheel has no tyre that could flatten",
)
