"""Effects of the contact against integrals by scipy, hand formulas and limits."""

import math

import numpy as np
import pytest
from scipy.integrate import quad

from adaptive import adaptive_forces, exponential, rational
from soilbus.terra.effects.catalogue import CATALOGUE
from soilbus.terra.effects.effect import forces_with, wheel_with
from soilbus.terra.soils import soil_named
from soilbus.terra.wheel import WheelModel, WheelState, sinkage, state_on, wheel_forces
from wheels_around import RADIUS, WIDTH, active, one_wheel, wheels_around

MODEL = WheelModel("rational")
_, AROUND = wheels_around(size=2)
WHEELS = [state_on(soil_named(soil), angle, slip, 0.5, 0.3) for soil, angle, slip in (
    ("wet_clay", 0.5, 0.2), ("loam", 0.3, 0.6), ("dry_sand", 0.4, 0.05))]  # fmt: skip
EACH_WHEEL = pytest.mark.parametrize("state", WHEELS, ids=["clay", "loam", "sand"])


def with_effect(name: str, state: WheelState, model: WheelModel = MODEL, around=None, **values: float) -> np.ndarray:
    return forces_with([active(name, **values)], state, model, one_wheel(AROUND) if around is None else around)


def same(ours: np.ndarray, true: np.ndarray, tolerance: float = 1e-6) -> None:
    assert np.max(np.abs(ours - true)) < tolerance * true[0]


@EACH_WHEEL
@pytest.mark.parametrize(
    ("name", "values", "plain", "changed"),
    [
        # Wong and Reece's peak, before and with what a soil has of its own, and one that levels off
        ("stress_peak_shift", {"c1": -0.15, "c2": 0.3}, {}, {"peak_c1": 0.35, "peak_c2": 0.3}),
        ("stress_peak_shift", {"c1": -0.15, "c2": 0.3}, {"peak_c1": 0.45, "peak_c2": 0.1},
         {"peak_c1": 0.3, "peak_c2": 0.4}),
        ("stress_peak_shift", {"c1": -0.2, "c2": 0.3, "bend": 4.0}, {},
         {"peak_c1": 0.3, "peak_c2": 0.3, "peak_bend": 4.0}),
        # a rut that comes up by an angle of its own, and soil carried behind, on which the wheel leaves it the later
        ("rut_recovery", {"recovery": 0.1, "angle": 0.05}, {}, {"exit_ratio": -0.1, "exit_angle": -0.05}),
        ("rut_recovery", {"recovery": 0.1, "angle": 0.3}, {}, {"exit_ratio": -0.1, "exit_angle": -0.3}),
        ("rut_recovery", {"recovery": 0.1, "carried": 0.5}, {}, {"exit_ratio": -0.1, "exit_slip": -0.5}),
    ],
)  # fmt: skip
def test_an_effect_on_the_stress_is_the_integral_with_other_angles(state, name, values, plain, changed):
    ours = with_effect(name, state, WheelModel("rational", **plain), **values)
    same(ours, adaptive_forces(state, WheelModel("rational", **changed)))


@EACH_WHEEL
@pytest.mark.parametrize("share", [0.3, 1.0])
def test_a_share_of_the_exponential_law(state, share):
    true = adaptive_forces(state, MODEL, mobilised=lambda x: share * exponential(x) + (1.0 - share) * rational(x))
    same(with_effect("exponential_shear", state, share=share), true)
    if share == 1.0:
        same(with_effect("exponential_shear", state, share=1.0), wheel_forces(state, WheelModel("exponential")), 1e-12)


def test_exponential_shear_can_be_added_to_the_rational_law_only():
    assert {e.name: e.base_law for e in CATALOGUE.values() if e.base_law} == {"exponential_shear": "rational"}


def test_bulldozing_is_rankines_passive_wedge():
    soil = soil_named("wet_clay")
    state = state_on(soil, 0.5, 0.2, 0.5, 0.3)
    Kp = math.tan(math.pi / 4 + soil.phi / 2) ** 2
    z, gamma = 0.5 * (1.0 - math.cos(0.5)), 16e3
    wedge = 0.3 * (gamma * z * z * Kp / 2.0 + 2.0 * soil.c * z * math.sqrt(Kp))
    plain = wheel_forces(state, MODEL)
    ours = with_effect("bulldozing", state, density=gamma * Kp, cohesive_factor=2.0 * math.sqrt(Kp))
    assert plain - ours == pytest.approx(np.array([0.0, wedge, 0.0]), rel=1e-9, abs=1e-9)


def test_soil_set_in_motion_takes_its_momentum_from_the_wheel():
    state = state_on(soil_named("wet_clay"), 0.5, 0.2, 0.5, 0.3)
    effect, density, speed, seconds = CATALOGUE["bulldozing"], 1800.0, 1.7, 0.01
    around = one_wheel(wheels_around()[1], ground_speed=speed)
    plain = wheel_forces(state, MODEL)
    lost = (plain - effect.forces(plain, state, around, effect.neutral | {"moved": density}))[1]
    swept = density * 0.3 * 0.5 * (1.0 - math.cos(0.5)) * speed * seconds  # kg, brought to the vehicle's speed
    assert lost * seconds == pytest.approx(swept * speed, rel=1e-9)


def test_lugs_shear_at_their_sides_as_bekker_has_it():
    soil = soil_named("wet_clay")
    state = state_on(soil, 0.5, 0.2, 0.5, 0.3)
    h, b = 0.04, 0.3
    arccot = math.atan2(b, h)  # of h/b
    stronger = state._replace(
        c=soil.c * (1.0 + 2.0 * h / b), tan_phi=math.tan(soil.phi) * (1.0 + 0.64 * h / b * arccot)
    )
    true = wheel_forces(stronger, MODEL)
    W, DP, T = with_effect("lugs", state, height=h, share=1.0)
    assert pytest.approx(tuple(true[:2]), rel=1e-12) == (W, DP)
    assert pytest.approx(true[2] * 0.54 / 0.5, rel=1e-12) == T
    assert with_effect("lugs", state, height=h, share=0.0)[2] == pytest.approx(true[2], rel=1e-12)


def test_a_soft_tyre_touches_where_its_undeformed_circle_enters_the_soil():
    """The substitute circle goes through both points; geometry by hand."""
    state = state_on(soil_named("loam"), 0.35, 0.15, 0.5, 0.3)
    around, delta = one_wheel(AROUND, load=8e3), 0.032
    changed, _ = wheel_with([active("tyre_deflection", compliance=4e-6, behind=0.0)], state, MODEL, around)
    z, half_chord = sinkage(0.35, changed.radius), changed.radius * math.sin(0.35)
    hub_above_surface = 0.5 - delta - z
    assert math.hypot(hub_above_surface, half_chord) == pytest.approx(0.5, rel=1e-12)
    assert changed.radius > 0.5
    # 1 - V / (r omega) with V = 1 m/s, omega as the nominal slip has it
    omega = 1.0 / (0.5 * (1.0 - 0.15))
    assert changed.slip == pytest.approx(1.0 - 1.0 / ((0.5 - delta / 3.0) * omega), rel=1e-12)


def test_a_soft_tyres_torque_acts_at_its_rolling_radius():
    state = state_on(soil_named("loam"), 0.35, 0.15, 0.5, 0.3)
    around, delta = one_wheel(AROUND, load=8e3), 0.032
    effect = active("tyre_deflection", compliance=delta / 8e3, behind=0.0)
    changed, model = wheel_with([effect], state, MODEL, around)
    rigid = adaptive_forces(changed, model)
    W, DP, T = forces_with([effect], state, MODEL, around)
    assert pytest.approx(tuple(rigid[:2]), rel=1e-6, abs=1e-3) == (W, DP)
    assert pytest.approx(rigid[2] / changed.radius * (0.5 - delta / 3.0), rel=1e-6) == T


@pytest.mark.parametrize("slip", [0.15, -0.3])
def test_the_flat_behind_the_axle_is_a_plate_that_has_slipped(slip):
    """A plate of half the flat's length under the pressure of its depth, in the shear of its front edge.

    The displacement there is integrated along the rim; the plate is shorter than the chord, the less the longer it is.
    """
    state = state_on(soil_named("loam"), 0.35, slip, 0.5, 0.3)
    around, delta, share = one_wheel(AROUND, load=8e3), 0.032, 0.7
    flat, none = ([active("tyre_deflection", compliance=delta / 8e3, behind=behind)] for behind in (share, 0.0))
    with_flat, without = (forces_with(effects, state, MODEL, around) for effects in (flat, none))
    circle, slip = wheel_with(flat, state, MODEL, around)[0][2::-1][:2]
    z = circle * (1.0 - math.cos(0.35))
    pressure = state.K_L * z**state.n
    chord = math.sqrt(0.5**2 - (0.5 - delta) ** 2)
    j, _ = quad(lambda theta: circle * (1.0 - (1.0 - slip) * math.cos(theta)), 0.0, 0.35)
    shear = (state.c + pressure * state.tan_phi) * math.copysign(-math.expm1(-abs(j) / state.K), j)
    added = with_flat - without
    area = added[0] / pressure
    assert chord - 0.04 < area / (0.3 * share) < chord
    assert added[1] == pytest.approx(area * shear, rel=1e-9)
    assert added[2] == pytest.approx(area * shear * (0.5 - delta / 3.0), rel=1e-9)


def test_a_stiff_tyre_is_a_rigid_wheel_and_a_softer_one_sinks_less():
    state, around = wheels_around("loam", seed=6, slip=(0.02, 0.6))

    def forces(compliance: float) -> np.ndarray:
        return with_effect("tyre_deflection", state, around=around, compliance=compliance, behind=0.5)

    rigid = wheel_forces(state, MODEL)
    small, smaller = (np.max(np.abs(forces(x) - rigid)) for x in (1e-10, 1e-11))
    assert smaller == pytest.approx(small / 10.0, rel=0.01)  # linear in the limit
    assert np.all(forces(3e-6)[0] > rigid[0])


def test_a_deflection_stops_where_the_rim_strikes_through():
    state, around = wheels_around("loam", seed=6)
    soft = [active("tyre_deflection", compliance=2e-5, behind=0.0)]
    at_limit, beyond = (
        wheel_with(soft, state, MODEL, around._replace(load=load)) for load in (0.3 * WIDTH / 2e-5, 9e4)
    )
    assert beyond[0].radius == pytest.approx(at_limit[0].radius, rel=1e-12)
    assert np.all(np.isfinite(beyond[0].radius))
    assert np.all(beyond[0].radius > RADIUS)
