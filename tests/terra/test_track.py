"""A track's forces against adaptive integration of its equations, its derivatives, and calculations by hand."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad

from soilbus.terra.entry_angle import entry_angle_for_load
from soilbus.terra.soils import SOILS
from soilbus.terra.track import MEAN_SHEAR, modulated_shear
from soilbus.terra.wheel import (
    INPUTS,
    SHAPE,
    WheelModel,
    WheelState,
    sinkage,
    state_on,
    wheel_forces,
    wheel_forces_and_derivatives,
    wheel_forces_and_slopes,
)

LAWS = {"exponential": lambda x: -math.expm1(-x), "rational": lambda x: x / (1.0 + x)}
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


@pytest.mark.parametrize(
    ("model", "field"),
    [
        *((model, field) for model in MODELS for field in (*INPUTS, "length")),
        ("between", "exponential_share"), ("rollers, between", "exponential_share"), ("pan", "pan_stiffness"),
        ("pan", "pan_depth"), ("rollers", "pan_depth"),
    ],
)  # fmt: skip
def test_derivatives_equal_differences(model, field):
    of_state, model = field in (*INPUTS, "length"), MODELS[model]
    _, jacobian = wheel_forces_and_derivatives(TRACKS, model, () if field in INPUTS else (field,))
    at = getattr(TRACKS if of_state else model, field)
    size = np.maximum(np.abs(at), 1e-3 * of_state)
    step = (1e-6 if of_state else 1e-5) * size

    def forces(value):
        return wheel_forces(*((TRACKS._replace(**{field: value}), model) if of_state else
                              (TRACKS, replace(model, **{field: value}))))  # fmt: skip

    scale = np.abs(wheel_forces(TRACKS, model)).max(axis=0) / size
    ours = jacobian[:, INPUTS.index(field) if field in INPUTS else -1]
    difference = (forces(at + step) - forces(at - step)) / (2.0 * step)
    assert np.abs(ours - difference).max(axis=0) / scale == pytest.approx(np.zeros(24), abs=1e-6)


SLOPES = {"exponential": lambda x: math.exp(-x), "rational": lambda x: (1.0 + x) ** -2}


@pytest.mark.parametrize("law", MEAN_SHEAR)
@pytest.mark.parametrize("u", [1e-9, 1e-4, 1e-3, 0.019, 0.021, 0.3, 2.0, 20.0, 60.0])
@pytest.mark.parametrize("rollers", [0, 3, 7])
def test_mean_shear_equals_the_integral_of_the_law_also_below_periods_of_pressure(law, u, rollers):
    def mean(slip):
        return modulated_shear(slip, rollers, law) if rollers else MEAN_SHEAR[law](slip)

    exact = {"epsabs": 1e-14 if rollers else 0.0, "epsrel": 1e-12, "limit": 200}
    exact |= {"weight": "cos", "wvar": 2.0 * math.pi * rollers} if rollers else {"points": [min(1.0, 3.0 / u)]}
    share, slope = mean(u)
    expected = [quad(f, 0.0, 1.0, **exact)[0] for f in (lambda y: LAWS[law](u * y), lambda y: y * SLOPES[law](u * y))]
    (rel, least), (rel_slope, least_slope) = ((1e-9, 5e-8), (1e-9, 5e-9)) if rollers else ((1e-12, 0.0), (1e-11, 0.0))
    assert float(share) == pytest.approx(expected[0], rel=rel, abs=least)
    assert float(slope) == pytest.approx(expected[1], rel=rel_slope, abs=least_slope)
    assert [float(x) for x in mean(-u)] == [-float(share), float(slope)]


def test_a_track_knows_no_peak_and_no_exit_angle():
    _, jacobian = wheel_forces_and_derivatives(TRACKS, WheelModel(), SHAPE)
    assert not jacobian[:, len(INPUTS) : len(INPUTS) + 2].any()


def test_slopes_are_those_of_the_jacobian():
    forces, jacobian = wheel_forces_and_derivatives(TRACKS, WheelModel())
    same, slopes = wheel_forces_and_slopes(TRACKS, WheelModel())
    assert np.array_equal(same, forces)
    assert np.array_equal(slopes, jacobian[:, :2])


def test_tracks_beside_wheels_are_as_alone():
    length = np.where(np.arange(24) % 3 == 0, TRACKS.length, 0.0)
    mixed = TRACKS._replace(length=length)
    whole, by = wheel_forces_and_derivatives(mixed, WheelModel())
    for members, alone in ((length > 0.0, TRACKS), (length == 0.0, TRACKS._replace(length=0.0))):
        some = WheelState(*(a[members] if np.ndim(a) else a for a in alone))
        forces, jacobian = wheel_forces_and_derivatives(some, WheelModel())
        assert np.array_equal(whole[:, members], forces)
        assert np.array_equal(by[..., members], jacobian)


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
