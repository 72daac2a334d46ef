"""Effects of the soil against integrals by scipy, hand formulas and limits."""

import math

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from adaptive import adaptive_forces
from soilbus.terra.effects.along import share_of_way, through_knots
from soilbus.terra.effects.catalogue import CATALOGUE
from soilbus.terra.effects.effect import forces_with, wheel_with
from soilbus.terra.effects.steady import CompletedModel, Wheel
from soilbus.terra.soils import soil_named
from soilbus.terra.wheel import INPUTS, WheelModel, WheelState, state_on, wheel_forces, wheel_forces_and_derivatives
from wheels_around import REAR, active, one_wheel, wheels_around

MODEL = WheelModel("rational")
STATE, AROUND = wheels_around(seed=7)
TYRE_PRESSURE = 1e5
"""Pressure [Pa] at which the stiffness of ruts is what `stiffness` says, whatever n is."""


def changed(name: str, state: WheelState = STATE, around=AROUND, **values: float) -> WheelState:
    return wheel_with([active(name, **values)], state, MODEL, around)[0]


@pytest.mark.parametrize("slip", [0.0, 0.1, 0.4, 0.8])
def test_the_sinkage_exponent_grows_with_slip(slip):
    """Ding et al. 2010: sigma = K z^(n0 + n1 s), here with the same pressure at 5 cm whatever n1."""
    state = state_on(soil_named("loam"), 0.4, slip, 0.5, 0.3)
    ours = forces_with([active("slip_sinkage", exponent=0.5)], state, MODEL, one_wheel(AROUND))
    true = adaptive_forces(state, MODEL, pressure=lambda z: state.K_L * 0.05**0.7 * (z / 0.05) ** (0.7 + 0.5 * slip))
    assert np.max(np.abs(ours - true)) < 1e-6 * true[0]


def test_softening_gives_sinkage_times_a_function_of_slip():
    """Lyasko's form: z = z0 f(s) at equal pressure is K_L f(s)^-n, here f = exp(0.9 s / n)."""
    pressure, s = 4e4, 0.35
    state = state_on(soil_named("loam"), 0.4, s, 0.5, 0.3)
    soft = changed("slip_sinkage", state, one_wheel(AROUND), softening=0.9)
    z0, z = ((pressure / K_L) ** (1.0 / state.n) for K_L in (state.K_L, soft.K_L))
    assert z / z0 == pytest.approx(math.exp(0.9 * s / state.n), rel=1e-12)


@pytest.mark.parametrize("slip", [0.05, 0.3])
def test_a_wheel_meets_the_soil_below_the_layer_that_it_throws_back(slip):
    """Reece 1965: the contact is that of a wheel less deep by what is dug; the wheel has sunk as deep as before."""
    state = state_on(soil_named("loam"), 0.45, slip, 0.5, 0.3)
    dug = 0.06
    digs = [active("slip_sinkage", dug=dug)]
    ours = forces_with(digs, state, MODEL, one_wheel(AROUND))
    left = 0.5 * (1.0 - math.cos(0.45)) - dug * slip
    met = adaptive_forces(state._replace(entry_angle=math.acos(1.0 - left / 0.5)), MODEL)
    assert np.max(np.abs(ours - met)) < 1e-8 * met[0]
    wheel = Wheel(np.array(0.5), np.array(0.3), False, np.array(5000.0))
    completed = CompletedModel.of(MODEL, digs, 1.0)
    assert completed.sinkage(np.array(0.45), wheel) == pytest.approx(0.5 * (1.0 - math.cos(0.45)), rel=1e-12)


def test_a_wheel_does_not_throw_away_all_of_its_ground():
    state = state_on(soil_named("loam"), 0.2, 0.9, 0.5, 0.3)
    angle = changed("slip_sinkage", state, one_wheel(AROUND), dug=0.3).entry_angle
    assert 1.0 - math.cos(angle) == pytest.approx(0.1 * (1.0 - math.cos(0.2)), rel=1e-9)


def test_skid_does_not_dig():
    state = STATE._replace(slip=-np.abs(STATE.slip))
    dug = changed("slip_sinkage", state, exponent=1.0, softening=2.0, dug=0.1)
    assert dug.entry_angle == pytest.approx(np.broadcast_to(state.entry_angle, dug.entry_angle.shape), rel=1e-12)
    assert np.array_equal(dug.K_L, np.broadcast_to(state.K_L, dug.K_L.shape))
    assert np.all(dug.n == state.n)


def test_an_exponent_stays_positive_on_the_softest_law():
    state = STATE._replace(n=0.11)
    assert np.all(changed("slip_sinkage", state, exponent=-0.2).n > 0.0)
    assert np.all(changed("slip_sinkage", state._replace(n=0.03)).n == 0.03)


def test_bearing_grows_with_a_power_of_the_speed():
    stiff = changed("rate_stiffening", exponent=0.2)
    assert pytest.approx(STATE.K_L * AROUND.ground_speed**0.2 * np.ones(4), rel=1e-12) == stiff.K_L
    still = changed("rate_stiffening", around=AROUND._replace(ground_speed=0.0), exponent=0.2)
    assert np.all(still.K_L > 0.3 * STATE.K_L)


def test_only_rear_wheels_run_in_ruts():
    factors = {"stiffness": 2.5, "density": 1.2, "shear": 1.6, "reloading": 1.3}
    effect = active("multipass", **{name: math.log(factor) for name, factor in factors.items()})
    ours, plain = forces_with([effect], STATE, MODEL, AROUND), wheel_forces(STATE, MODEL)
    n = STATE.n / 1.3
    depth = (TYRE_PRESSURE / STATE.K_L) ** (1.0 / STATE.n)
    K_L = 2.5 * TYRE_PRESSURE / depth**n
    packed = STATE._replace(n=n, K_L=K_L, c=1.2 * STATE.c, tan_phi=1.2 * STATE.tan_phi, K=STATE.K / 1.6)
    assert np.array_equal(ours[..., ~REAR], plain[..., ~REAR])
    assert ours[..., REAR] == pytest.approx(wheel_forces(packed, MODEL)[..., REAR], rel=1e-10)


@pytest.mark.parametrize("depth", [0.005, 0.02, 0.035])
@pytest.mark.parametrize("soil", ["wet_clay", "loam", "dry_sand"])
def test_a_hard_pan_adds_to_the_pressure_below_its_depth(soil, depth):
    state = state_on(soil_named(soil), 0.45, 0.2, 0.5, 0.3)

    def pressure(z: float) -> float:
        own = state.K_L * z**state.n
        return own if z < depth else own + 6.0 * (own - state.K_L * depth**state.n)

    ours = forces_with([active("hardpan", stiffness=6.0, depth=depth)], state, MODEL, one_wheel(AROUND))
    true = adaptive_forces(state, MODEL, pressure=pressure, kink=depth)
    assert np.max(np.abs(ours - true)) < 1e-8 * true[0]


def test_a_hard_pan_that_is_not_reached_changes_nothing():
    state = STATE._replace(entry_angle=0.3)
    plain = wheel_forces(state, MODEL)
    ours = forces_with([active("hardpan", stiffness=20.0, depth=0.3)], state, MODEL, AROUND)
    assert np.max(np.abs(ours - plain), axis=(1, 2)) / np.max(plain[0]) == pytest.approx(0.0, abs=1e-7)


@pytest.mark.parametrize("name", INPUTS)
def test_derivatives_know_of_the_pan(name):
    """Central differences, in drive and in skid, with a peak that moves and a rut that recovers."""
    model = WheelModel("rational", 0.45, 0.2, -0.2, pan_depth=0.02, pan_stiffness=6.0)
    forces, jacobian = wheel_forces_and_derivatives(STATE, model)
    at = np.asarray(getattr(STATE, name))
    step = 1e-5 * np.abs(at)
    up, down = (wheel_forces(STATE._replace(**{name: at + way * step}), model) for way in (1.0, -1.0))
    miss = np.abs((up - down) / (2.0 * step) - jacobian[:, INPUTS.index(name)]) * np.abs(at)
    assert np.max(miss) < 1e-7 * np.max(forces[0])


def test_the_soil_drifts_along_the_way():
    """By curves that are zero where the way is half done: the soil's own parameters are those of there."""
    values = {"stiffness": 0.8, "stiffness_1": 0.3, "stiffness_2": -0.2, "stiffness_4": 0.1, "strength": -0.4,
              "strength_2": 0.15}  # fmt: skip
    soil = changed("soil_drift", **values)
    u = AROUND.distance / AROUND.length
    n_knots = sum(p.name.startswith("stiffness_") for p in CATALOGUE["soil_drift"].parameters)
    knots = np.linspace(0.0, 1.0, n_knots + 2)
    rest = [0.0] * (n_knots - 4)
    bend = CubicSpline(knots, [0.0, 0.3, -0.2, 0.0, 0.1, *rest, 0.0], bc_type="natural")(u) - 0.1
    assert np.log(soil.K_L / STATE.K_L) == pytest.approx((0.8 * (u - 0.5) + bend) * np.ones(4), rel=1e-10)
    bend = CubicSpline(knots, [0.0, 0.0, 0.15, 0.0, 0.0, *rest, 0.0], bc_type="natural")(u)
    for strength in (soil.tan_phi / STATE.tan_phi, soil.c / STATE.c):
        assert np.log(strength) == pytest.approx((-0.4 * (u - 0.5) + bend) * np.ones(1), rel=1e-10)
    assert CATALOGUE["soil_drift"].of_record


def test_the_share_of_the_way_is_told_by_distance_else_by_time():
    assert share_of_way(AROUND)[-1, 0] == pytest.approx(1.0)
    assert share_of_way(AROUND._replace(length=0.0)) == pytest.approx(AROUND.t / AROUND.duration)
    assert np.all(share_of_way(AROUND._replace(length=0.0, duration=0.0)) == 0.0)


def test_the_curve_through_knots_is_the_natural_spline_and_level_beyond():
    heights = [0.1, -0.4, 0.3, 0.2, 0.9, -0.1, 0.0]
    u = np.linspace(0.0, 1.0, 97)
    true = CubicSpline(np.linspace(0.0, 1.0, 7), heights, bc_type="natural")(u)
    assert through_knots(u, heights) == pytest.approx(true, abs=1e-13)
    assert through_knots([-0.5, 1.5], heights) == pytest.approx([0.1, 0.0], abs=1e-13)
    assert np.isnan(through_knots(np.nan, heights))
