"""A track's forces against adaptive integration of its equations, its derivatives, and calculations by hand."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.optimize import brentq

from soilbus.terra.dual import Dual
from soilbus.terra.entry_angle import entry_angle_for_load
from soilbus.terra.soils import SOILS
from soilbus.terra.tangent import forces_along
from soilbus.terra.track import MEAN_SHEAR, modulated_shear
from soilbus.terra.wheel import (
    INPUTS,
    SHAPE,
    Soil,
    WheelModel,
    WheelState,
    sinkage,
    state_on,
    wheel_forces,
    wheel_forces_and_derivatives,
    wheel_forces_and_slopes,
)

LAWS = {"exponential": lambda x: 1.0 - math.exp(-x), "rational": lambda x: x / (1.0 + x)}
MODELS = {
    "exponential": WheelModel(),
    "rational": WheelModel("rational"),
    "between": WheelModel("rational", exponential_share=0.4),
    "pan": WheelModel(pan_depth=0.02, pan_stiffness=4.0),
    "rollers": WheelModel(rollers=5, pan_depth=0.02, pan_stiffness=4.0),
    "rollers, rational": WheelModel("rational", rollers=3),
    "rollers, between": WheelModel("rational", exponential_share=0.4, rollers=4),
}
R, B, L = 0.3, 0.45, 2.2


def tracks(seed: int, size: int) -> WheelState:
    """Random tracks, a third of them skidding."""
    rng = np.random.default_rng(seed)
    return WheelState(
        entry_angle=rng.uniform(0.1, 0.9, size),
        slip=rng.uniform(-0.3, 0.6, size),
        radius=rng.uniform(0.15, 0.5, size),
        width=rng.uniform(0.2, 0.9, size),
        K_L=10.0 ** rng.uniform(4.6, 6.7, size),
        n=rng.uniform(0.1, 1.6, size),
        tan_phi=np.tan(rng.uniform(0.1, 0.65, size)),
        c=rng.uniform(0.0, 7e4, size),
        K=rng.uniform(0.005, 0.05, size),
        length=rng.uniform(0.8, 4.5, size),
    )


TRACKS = tracks(1, 24)


def integrated(state: WheelState, model: WheelModel) -> list[float]:
    """W, DP and T of one track by adaptive integration along the contact and over the depth."""
    theta, slip, r, b, K_L, n, tan_phi, c, K, length = (float(a) for a in state)

    def pressure(z: float) -> float:
        over = max(z**n - model.pan_depth**n, 0.0) if model.pan_stiffness else 0.0
        return K_L * (z**n + model.pan_stiffness * over)

    def share(x: float) -> float:
        w = model.exponential_share
        law = LAWS[model.shear_law](x)
        return math.copysign((1.0 - w) * law + w * LAWS["exponential"](x), slip)

    z = r - r * math.cos(theta)
    peak, kinks = pressure(z), [a for a in (model.pan_depth,) if 0.0 < a < z]
    p, swing = (peak / 2.0, 1.0) if model.rollers else (peak, 0.0)

    def stress(x: float) -> float:
        here = p * (1.0 + swing * math.cos(2.0 * math.pi * model.rollers * x / length))
        return (c + here * tan_phi) * share(abs(slip) * x / K)

    exact = {"epsabs": 0.0, "epsrel": 1e-12, "limit": 400}
    ends = np.unique([0.0, min(4.0 * K / abs(slip), length), *np.linspace(0.0, length, 4 * model.rollers + 2)])
    thrust = b * sum(quad(stress, *part, **exact)[0] for part in pairwise(ends))
    resistance = b * quad(pressure, 0.0, z, points=kinks, **exact)[0]
    return [b * length * p, thrust - resistance, thrust * r]


@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
def test_forces_equal_adaptive_integration(model):
    found = wheel_forces(TRACKS, model)
    for i in range(len(TRACKS.slip)):
        expected = integrated(WheelState(*(a[i] for a in TRACKS)), model)
        by_rule = model.rollers > 0 and model.shear_law == "rational"
        assert found[:, i] == pytest.approx(expected, rel=2e-8 if by_rule else 1e-9, abs=1e-10 * expected[0])


@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
@pytest.mark.parametrize("field", [*INPUTS, "length"])
def test_derivatives_equal_differences(model, field):
    _, jacobian = wheel_forces_and_derivatives(TRACKS, model, ("length",))
    at = getattr(TRACKS, field)
    step = 1e-6 * np.maximum(np.abs(at), 1e-3)
    up, down = (wheel_forces(TRACKS._replace(**{field: at + way * step}), model) for way in (1.0, -1.0))
    scale = np.abs(wheel_forces(TRACKS, model)).max(axis=0) / np.maximum(np.abs(at), 1e-3)
    ours = jacobian[:, [*INPUTS, "length"].index(field)]
    assert np.abs(ours - (up - down) / (2.0 * step)).max(axis=0) / scale == pytest.approx(np.zeros(24), abs=1e-6)


@pytest.mark.parametrize(
    ("model", "field"),
    [
        (MODELS["between"], "exponential_share"),
        (MODELS["rollers, between"], "exponential_share"),
        (MODELS["pan"], "pan_stiffness"),
        (MODELS["pan"], "pan_depth"),
        (MODELS["rollers"], "pan_depth"),
    ],
)
def test_derivatives_by_the_model_equal_differences(model, field):
    _, jacobian = wheel_forces_and_derivatives(TRACKS, model, (field,))
    step = 1e-5 * getattr(model, field)
    up, down = (wheel_forces(TRACKS, replace(model, **{field: getattr(model, field) + w * step})) for w in (1, -1))
    scale = np.abs(wheel_forces(TRACKS, model)).max(axis=0) / getattr(model, field)
    assert np.abs(jacobian[:, -1] - (up - down) / (2.0 * step)).max(axis=0) / scale == pytest.approx(
        np.zeros(24), abs=1e-6
    )


@pytest.mark.parametrize("law", MEAN_SHEAR)
@pytest.mark.parametrize("u", [1e-9, 1e-3, 0.3, 2.0, 20.0, 60.0])
@pytest.mark.parametrize("rollers", [3, 7])
def test_what_periods_of_pressure_add_equals_the_integral(law, u, rollers):
    share, slope = modulated_shear(u, rollers, law)
    by_u = {"exponential": lambda x: math.exp(-x), "rational": lambda x: (1.0 + x) ** -2}[law]
    laws = {"exponential": lambda x: -math.expm1(-x), "rational": LAWS["rational"]}
    exact = {"weight": "cos", "wvar": 2.0 * math.pi * rollers, "epsabs": 1e-14, "epsrel": 1e-12, "limit": 200}
    assert float(share) == pytest.approx(quad(lambda y: laws[law](u * y), 0.0, 1.0, **exact)[0], rel=1e-9, abs=5e-8)
    assert float(slope) == pytest.approx(quad(lambda y: y * by_u(u * y), 0.0, 1.0, **exact)[0], rel=1e-9, abs=5e-9)
    skidding = modulated_shear(-u, rollers, law)
    assert (float(skidding[0]), float(skidding[1])) == (-float(share), float(slope))


def test_peaks_below_rollers_sink_a_track_deeper():
    """A peak of twice the mean pressure presses 2^(1/n) as deep, and resists by 2^((n + 1) / n) as much."""
    uniform, peaked = WheelModel(), WheelModel(rollers=5)
    n, load = SOILS["loam"].n, 2e4
    states = [on_loam(entry_angle_for_load(load, on_loam(np.nan, 0.0), m), 0.0) for m in (uniform, peaked)]
    depth, deeper = (float(sinkage(s.entry_angle, R)) for s in states)
    resistance, more = (-wheel_forces(s, m)[1] for s, m in zip(states, (uniform, peaked), strict=True))
    assert deeper / depth == pytest.approx(2.0 ** (1.0 / n), rel=1e-6)
    assert more / resistance == pytest.approx(2.0 ** ((n + 1.0) / n), rel=1e-6)


def test_a_track_knows_no_peak_and_no_exit_angle():
    _, jacobian = wheel_forces_and_derivatives(TRACKS, WheelModel(), SHAPE)
    assert not jacobian[:, len(INPUTS) : len(INPUTS) + 2].any()


def test_slopes_are_those_of_the_jacobian():
    forces, jacobian = wheel_forces_and_derivatives(TRACKS, WheelModel())
    same, slopes = wheel_forces_and_slopes(TRACKS, WheelModel())
    assert np.array_equal(same, forces)
    assert np.array_equal(slopes, jacobian[:, :2])


def test_dual_numbers_carry_a_derivative_by_the_radius():
    def along(model):
        varied = TRACKS._replace(radius=Dual(TRACKS.radius, {"it": 1.0}))
        return np.stack([force.by["it"] for force in forces_along(varied, model)])

    for model in (MODELS["exponential"], MODELS["pan"]):
        step = 1e-6
        up, down = (wheel_forces(TRACKS._replace(radius=TRACKS.radius + w * step), model) for w in (1, -1))
        scale = np.abs(up).max()
        assert along(model) / scale == pytest.approx((up - down) / (2.0 * step) / scale, abs=1e-6)


def test_tracks_beside_wheels_are_as_alone():
    length = np.where(np.arange(24) % 3 == 0, TRACKS.length, 0.0)
    mixed = TRACKS._replace(length=length)
    whole, by = wheel_forces_and_derivatives(mixed, WheelModel())
    for members, alone in ((length > 0.0, TRACKS), (length == 0.0, TRACKS._replace(length=0.0))):
        some = WheelState(*(a[members] if np.ndim(a) else a for a in alone))
        forces, jacobian = wheel_forces_and_derivatives(some, WheelModel())
        assert np.array_equal(whole[:, members], forces)
        assert np.array_equal(by[..., members], jacobian)


@pytest.mark.parametrize("law", MEAN_SHEAR)
@pytest.mark.parametrize("u", [1e-9, 1e-4, 0.019, 0.021, 0.3, 2.0, 50.0])
def test_mean_shear_equals_the_mean_of_the_law(law, u):
    share, slope = MEAN_SHEAR[law](u)
    exact = {"epsabs": 0.0, "epsrel": 1e-12, "limit": 200, "points": [min(1.0, 3.0 / u)]}
    by_u = {"exponential": lambda x: math.exp(-x), "rational": lambda x: (1.0 + x) ** -2}[law]
    laws = {"exponential": lambda x: -math.expm1(-x), "rational": LAWS["rational"]}
    assert float(share) == pytest.approx(quad(lambda y: laws[law](u * y), 0.0, 1.0, **exact)[0], rel=1e-12)
    assert float(slope) == pytest.approx(quad(lambda y: y * by_u(u * y), 0.0, 1.0, **exact)[0], rel=1e-11)
    skidding = MEAN_SHEAR[law](-u)
    assert (float(skidding[0]), float(skidding[1])) == (-float(share), float(slope))


def on_loam(angle, slip, **changed):
    return state_on(SOILS["loam"], angle, slip, R, B, L)._replace(**changed)


@given(st.floats(1e3, 2e5), st.floats(-0.3, 0.8), st.sampled_from(sorted(SOILS)), st.sampled_from([np.nan, 0.3]))
def test_the_entry_angle_carries_the_load(load, slip, name, guess):
    soil = SOILS[name]
    state = state_on(soil, guess, slip, R, B, L)
    found = entry_angle_for_load(load, state, WheelModel())
    z = (load / (B * L) / (soil.k_c / B + soil.k_phi)) ** (1.0 / soil.n)
    if z > R * (1.0 - math.cos(1.4)):
        assert np.isnan(found)
    elif z < 1e-7:
        assert float(sinkage(found, R)) < 2e-7
    else:
        assert float(sinkage(found, R)) == pytest.approx(z, rel=1e-6)


# Two vehicles of equal weight and contact area, a wide short track beside a narrow long one: the comparison of Wong,
# Theory of Ground Vehicles, ch. 2, as we remember its inputs (no public text has them).  Calculated by hand from the
# closed formulas of Bekker, Janosi & Hanamoto and Wong that stand in the head of terra.track.
SANDY = Soil(k_c=4.37e3, k_phi=196.72e3, n=1.6, phi=math.radians(19.7), c=1.0e3, K=0.05)
WEIGHT = 135e3
"""Of a vehicle with two tracks: pressure 135 kN / 7.2 m2 = 18.75 kPa."""
WIDE, LONG = (1.0, 3.6), (0.8, 4.5)
"""Width and length of each track [m]."""


def calculated(slip: float, track: tuple[float, float]) -> np.ndarray:
    """Load, thrust and resistance [N] of the vehicle."""
    one = state_on(SANDY, np.nan, slip, 0.4, *track)
    angle = entry_angle_for_load(WEIGHT / 2.0, one, WheelModel())
    W, DP, T = wheel_forces(one._replace(entry_angle=angle), WheelModel())
    return 2.0 * np.array([W, T / 0.4, T / 0.4 - DP])


@pytest.mark.parametrize(("track", "depth"), [(WIDE, 0.22699), (LONG, 0.22622)])
def test_resistance_of_two_vehicles_calculated_by_hand(track, depth):
    """p = 18.75 kPa; K_L = 4.37/b + 196.72; z = (p/K_L)^(1/1.6); R = 2 b p z / 2.6: 3.27 and 2.61 kN."""
    assert calculated(0.1, track)[2] == pytest.approx(2.0 * track[0] * 18.75e3 * depth / 2.6, rel=3e-5)


@pytest.mark.parametrize(
    ("slip", "wide", "long"),
    [
        (0.05, 0.729812, 0.780246),
        (0.1, 0.861215, 0.888903),
        (0.2, 0.930556, 0.944444),
        (0.4, 0.965278, 0.972222),
        (0.6, 0.976852, 0.981481),
        (0.8, 0.982639, 0.986111),
    ],
)
def test_thrust_of_two_vehicles_calculated_by_hand(slip, wide, long):
    """A c + W tan phi = 7.2 + 135 * 0.35805 = 55.54 kN, times 1 - (1 - exp(-l s / K)) / (l s / K)."""
    assert calculated(slip, WIDE)[1] == pytest.approx(55.54e3 * wide, rel=2e-4)
    assert calculated(slip, LONG)[1] == pytest.approx(55.54e3 * long, rel=2e-4)


def test_slip_that_a_draft_asks_by_root_finding():
    """Drawbar pull inverted by brentq on the hand formulas and on the model is the same slip."""

    def by_hand(slip: float) -> float:
        u = slip * WIDE[1] / SANDY.K
        resistance = 2.0 * 18.75e3 * (18.75e3 / 201.09e3) ** (1.0 / 1.6) / 2.6
        strength = 7.2e3 + WEIGHT * math.tan(SANDY.phi)
        return strength * (1.0 - (1.0 - math.exp(-u)) / u) - resistance - 40e3

    ours = brentq(lambda s: calculated(s, WIDE)[1] - calculated(s, WIDE)[2] - 40e3, 0.01, 0.9)
    assert ours == pytest.approx(brentq(by_hand, 0.01, 0.9), rel=1e-9)
