"""One wheel's forces against adaptive integration of the paper's equations, and its derivatives."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from adaptive import adaptive_forces
from soilbus.terra.entry_angle import entry_angle_for_load
from soilbus.terra.soils import SOILS
from soilbus.terra.wheel import (
    EXACT_NODES,
    FAST_NODES,
    INPUTS,
    Soil,
    WheelModel,
    WheelState,
    state_on,
    wheel_forces,
    wheel_forces_and_derivatives,
    wheel_forces_and_slopes,
)

R, B = 0.5, 0.3
DEEPEST = 1.4
"""Largest entry angle [rad] of any load that soil carries: a wheel in the ground by 83 % of its radius."""


def wheels(seed: int, size: int, slip: tuple[float, float] = (0.0, 0.95), c: float = 70e3) -> WheelState:
    """Random wheels over the ranges that EXACT_NODES promises for."""
    rng = np.random.default_rng(seed)
    return WheelState(
        entry_angle=rng.uniform(0.05, 0.8, size),
        slip=rng.uniform(*slip, size),
        radius=rng.choice([0.3, 0.5, 0.62, 0.9], size),
        width=rng.uniform(0.15, 0.6, size),
        K_L=10.0 ** rng.uniform(4.6, 6.7, size),
        n=rng.uniform(0.1, 1.6, size),
        tan_phi=np.tan(rng.uniform(0.1, 0.65, size)),
        c=rng.uniform(0.0, c, size),
        K=rng.uniform(0.005, 0.025, size),
    )


def one(state: WheelState, i: int) -> WheelState:
    return WheelState(*(np.broadcast_to(a, np.shape(state.slip))[i] for a in state))


MODELS = {
    "exponential": WheelModel(),
    "rational": WheelModel(shear_law="rational"),
    "peak shift": WheelModel(peak_c1=0.35, peak_c2=0.3),
    "peak that levels off": WheelModel(peak_c1=0.3, peak_c2=0.3, peak_bend=4.0),
    "rut recovery": WheelModel(exit_ratio=-0.4),
    "everything": WheelModel("rational", 0.25, 0.35, -0.25),
    "exit with slip": WheelModel("rational", 0.4, 0.2, -0.1, exit_slip=-0.6),
    "exit angle": WheelModel("rational", 0.4, 0.2, -0.1, exit_angle=-0.1),
}


def corners(slips: tuple[float, ...]) -> WheelState:
    """Every corner of n, K, entry angle and slip."""
    grid = np.meshgrid([0.1, 1.6], [0.005, 0.025], [0.05, 0.8], slips, indexing="ij")
    n, K, angle, slip = (g.ravel() for g in grid)
    return WheelState(angle, slip, R, B, 6e5, n, math.tan(0.4), 5e3, K)


SITUATIONS = {"drive": wheels(1, 24), "skid": wheels(2, 16, slip=(-0.3, 0.0)), "no slip": wheels(3, 4, slip=(0.0, 0.0))}
CORNERS = {"drive": corners((0.0, 0.3, 0.95)), "skid": corners((-0.3, -0.02))}


def error(state: WheelState, model: WheelModel, nodes: int) -> np.ndarray:
    """Worst error (3,) of W, DP and T: W and T of drive to their own size, the rest to W (and W r).

    In skid T passes through zero, as DP does wherever motion resistance eats the thrust.
    """
    ours = wheel_forces(state, replace(model, nodes=nodes))
    worst = np.zeros(3)
    for i in range(len(state.slip)):
        part = one(state, i)
        true = adaptive_forces(part, model)
        size = np.array([true[0], true[0], true[0] * part.radius if part.slip < 0.0 else true[2]])
        worst = np.maximum(worst, np.abs(ours[:, i] - true) / size)
    return worst


@pytest.mark.parametrize("state", SITUATIONS.values(), ids=SITUATIONS)
def test_a_peak_of_stress_goes_no_farther_than_it_may(state):
    assert np.all(error(state, WheelModel(peak_c1=0.3, peak_c2=5.0), EXACT_NODES) < 2e-6)


@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
@pytest.mark.parametrize("state", SITUATIONS.values(), ids=SITUATIONS)
def test_forces_equal_adaptive_integration(state, model):
    assert np.all(error(state, model, EXACT_NODES) < 1e-6)


@pytest.mark.parametrize("law", ["exponential", "rational"])
@pytest.mark.parametrize("state", CORNERS.values(), ids=CORNERS)
def test_forces_equal_adaptive_integration_in_every_corner(state, law):
    model = WheelModel(shear_law=law)
    exact, fast = error(state, model, EXACT_NODES), error(state, model, FAST_NODES)
    assert np.all(exact < 1e-6)
    assert np.all(fast < 5e-5)


def central(state: WheelState, model: WheelModel, name: str, step: float) -> np.ndarray:
    """(3, N) central differences by one input, the step relative to its value."""
    at = np.asarray(getattr(state, name))
    h = step * np.abs(at)
    up, down = (wheel_forces(state._replace(**{name: at + s * h}), model) for s in (1.0, -1.0))
    return (up - down) / (2.0 * h)


def relative(difference: np.ndarray, state: WheelState, model: WheelModel, name: str) -> np.ndarray:
    """Derivatives (3, N) as relative change of W (W r for T) by relative change of the input."""
    W = wheel_forces(state, model)[0]
    size = np.stack([W, W, W * state.radius])
    return difference * getattr(state, name) / size


@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
@pytest.mark.parametrize("name", INPUTS)
def test_derivatives_equal_central_differences_with_second_order(name, model):
    state = wheels(4, 300, slip=(0.03, 0.92))
    _, jacobian = wheel_forces_and_derivatives(state, model)
    ours = jacobian[:, INPUTS.index(name)]

    def miss(step: float) -> float:
        difference = relative(central(state, model, name, step) - ours, state, model, name)
        return float(np.sqrt(np.mean(difference**2)))

    if name in ("K_L", "tan_phi", "c"):  # the forces are linear in these: no truncation error at any step
        assert miss(1e-1) < 1e-11
        return
    errors = [miss(h) for h in (1e-2, 1e-3, 1e-4)]
    orders = -np.diff(np.log10(errors))
    assert orders == pytest.approx([2.0, 2.0], abs=0.05)
    assert errors[-1] < 1e-6


@pytest.mark.parametrize("name", INPUTS)
def test_derivatives_of_a_skidding_wheel(name):
    # The panels' split moves with slip and entry angle, which the derivatives do not count:
    # they are as good as the quadrature, not exact derivatives of it.
    state = wheels(5, 1000, slip=(-0.3, -0.002), c=10e3)
    for law, most in (("exponential", 2e-6), ("rational", 5e-4)):
        fine = WheelModel(shear_law=law, nodes=60)
        _, jacobian = wheel_forces_and_derivatives(state, WheelModel(shear_law=law))
        miss = central(state, fine, name, 1e-5) - jacobian[:, INPUTS.index(name)]
        miss = np.abs(relative(miss, state, fine, name)).max(axis=0)
        assert np.quantile(miss, 0.98) < 1e-6
        assert miss.max() < most


def test_many_samples_equal_the_same_in_pieces():
    state = wheels(6, 20_000, slip=(-0.3, 0.95))
    forces, jacobian = wheel_forces_and_derivatives(state, WheelModel(nodes=FAST_NODES))
    for i in (0, 8_000, 8_191, 8_192, 16_383, 19_900):
        piece = slice(i, i + 100)
        part, part_jacobian = wheel_forces_and_derivatives(
            WheelState(*(a[piece] for a in state[:9])), WheelModel(nodes=FAST_NODES)
        )
        assert forces[:, piece] == pytest.approx(part, rel=1e-12, abs=1e-9)
        assert jacobian[:, :, piece] == pytest.approx(part_jacobian, rel=1e-9, abs=1e-6)


SOIL = st.sampled_from(list(SOILS.values()))
ANY_SOIL = st.builds(
    Soil,
    k_c=st.floats(0.0, 1e5),
    k_phi=st.floats(3e4, 6e6),
    n=st.floats(0.1, 1.6),
    phi=st.floats(0.05, 0.7),
    c=st.floats(0.0, 7e4),
    K=st.floats(0.005, 0.05),
)
LAWS = st.sampled_from([WheelModel(), WheelModel("rational"), WheelModel(nodes=FAST_NODES), WheelModel(peak_c2=0.3)])


@given(
    soil=SOIL | ANY_SOIL,
    angle=st.floats(0.01, 1.2),
    slip=st.floats(0.0, 0.95),
    radius=st.floats(0.2, 1.0),
    model=LAWS,
    guess=st.floats(1e-6, 1.39) | st.sampled_from([math.nan, math.inf, -1.0, 0.0]),
)
def test_entry_angle_carries_the_load_of_a_driven_wheel(soil, angle, slip, radius, model, guess):
    load = wheel_forces(state_on(soil, angle, slip, radius, 0.3), model)[0]
    found = entry_angle_for_load(load, state_on(soil, guess, slip, radius, 0.3), model)
    assert found.shape == ()
    carried = wheel_forces(state_on(soil, found, slip, radius, 0.3), model)[0]
    assert carried == pytest.approx(load, rel=1e-9)
    assert found == pytest.approx(angle, rel=1e-7)  # driven, load grows with depth: there is one answer


@given(
    soil=SOIL | ANY_SOIL, load=st.floats(100.0, 3e4), slip=st.floats(-0.3, 0.0), guess=st.floats(1e-6, 1.39), model=LAWS
)
def test_entry_angle_carries_the_load_of_a_skidding_wheel(soil, load, slip, guess, model):
    found = entry_angle_for_load(load, state_on(soil, guess, slip, R, B), model)
    if not np.isfinite(found):  # only what nothing carries may be refused
        every = np.linspace(1e-3, DEEPEST - 1e-6, 400)
        assert load > 0.999 * wheel_forces(state_on(soil, every, slip, R, B), model)[0].max()
        return
    carried = wheel_forces(state_on(soil, found, slip, R, B), model)[0]
    assert carried == pytest.approx(load, rel=1e-9)


@given(
    load=st.floats() | st.sampled_from([0.0, -1.0, math.nan, math.inf, -math.inf, 1e300, 1e-300]),
    slip=st.floats(-1.0, 1.0),
    guess=st.floats(),
    soil=SOIL | ANY_SOIL,
)
def test_impossible_loads_give_nan_and_nothing_is_raised(load, slip, guess, soil):
    state = state_on(soil, guess, slip, R, B)
    with np.errstate(all="ignore"):
        found = entry_angle_for_load(load, state, WheelModel())
        most = wheel_forces(state._replace(entry_angle=DEEPEST), WheelModel())[0]
    if not (math.isfinite(load) and load > 0.0) or (slip >= 0.0 and load > most * (1.0 + 1e-6)):
        assert np.isnan(found)
    else:
        assert np.isnan(found) or 0.0 < found < DEEPEST


def test_good_loads_among_bad_ones():
    load = np.array([[3000.0, -1.0, np.nan], [np.inf, 1e9, 5000.0]])
    state = state_on(SOILS["loam"], np.nan, 0.1, R, B)
    found = entry_angle_for_load(load, state, WheelModel())
    assert np.isfinite(found).tolist() == [[True, False, False], [False, False, True]]
    alone = [float(entry_angle_for_load(x, state, WheelModel())) for x in (3000.0, 5000.0)]
    assert found[np.isfinite(found)] == pytest.approx(alone, rel=1e-12)


@pytest.mark.parametrize("model", [WheelModel(), WheelModel(peak_c2=0.3), MODELS["peak that levels off"]])
def test_slopes_are_the_first_columns_of_the_derivatives(model):
    slip = np.linspace(-0.2, 0.6, 9)  # skid and drive
    state = state_on(SOILS["wet_clay"], np.linspace(0.2, 0.6, 9), slip, 0.5, 0.3)
    forces, jacobian = wheel_forces_and_derivatives(state, model)
    same, slopes = wheel_forces_and_slopes(state, model)
    assert same == pytest.approx(forces, rel=1e-12)
    assert slopes == pytest.approx(jacobian[:, :2], rel=1e-9, abs=1e-9 * np.abs(jacobian[:, :2]).max())
