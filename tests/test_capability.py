"""Pull curves and limits against brute force: nested scipy root finding on the wheel forces."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.optimize import brentq

from soilbus.assembly import rig_of
from soilbus.capability import PullCurve, largest_pull, pull_curve, slip_for_pull, slip_grid
from soilbus.simulator.reference import reference_configuration
from soilbus.terra.soils import SOILS
from soilbus.terra.wheel import Soil, WheelModel, state_on, wheel_forces

RIG = rig_of(reference_configuration())
MODEL = WheelModel()
WEIGHT = 2300.0 * 9.80665
NO_LIMIT = np.full(4, np.nan)
GRID = slip_grid(0.6)
FRONT_SHARE, REAR_SHARE = 0.95 / 1.95, 1.0 / 1.95
NAMES = ("loam", "wet_clay", "clayey_soil_38", "dry_sand", "sandy_loam_22")


def wheel(soil: Soil, load: float, slip: float, radius: float, width: float) -> np.ndarray:
    """(load, pull, torque, entry angle) of one wheel that carries a load."""

    def excess(angle: float) -> float:
        return wheel_forces(state_on(soil, angle, slip, radius, width), MODEL)[0] - load

    angle = brentq(excess, 1e-4, 1.39, xtol=1e-10)
    return np.append(wheel_forces(state_on(soil, angle, slip, radius, width), MODEL), angle)


def brute(soil: Soil, slip: float, graded: bool) -> tuple[float, np.ndarray]:
    """Pull at which draft (or grade) and wheels balance, and (4, axle) forces; moments written out."""

    def axles(pull: float) -> np.ndarray:
        if graded:
            across = WEIGHT * np.sqrt(1.0 - (pull / WEIGHT) ** 2)
            front = (across * 0.95 - pull * 0.75) / 1.95
        else:
            across = WEIGHT
            front = across * FRONT_SHARE - pull * 0.45 / 1.95
        rear = across - front
        return np.stack([wheel(soil, front / 2, slip, 0.50, 0.26), wheel(soil, rear / 2, slip, 0.62, 0.38)], axis=1)

    pull = brentq(lambda p: 2.0 * axles(p)[1].sum() - p, -0.75 * WEIGHT, 0.6 * WEIGHT, xtol=1e-3)
    return pull, axles(pull)


def both(soil: Soil, slip=GRID, start: PullCurve | None = None) -> tuple[PullCurve, PullCurve]:
    """Level and graded curve."""
    on_grade = np.arange(2 * len(slip)) >= len(slip)
    curve = pull_curve(soil, RIG, MODEL, np.tile(slip, 2), on_grade, start)
    return curve.part(False), curve.part(True)


@pytest.mark.parametrize("name", NAMES)
def test_pull_curve_equals_brute_force(name):
    for graded, curve in enumerate(both(SOILS[name])):
        for i in (0, 5, 9, 13):
            pull, axles = brute(SOILS[name], curve.slip[i], bool(graded))
            assert curve.pull[i] == pytest.approx(pull, abs=1e-6 * WEIGHT)
            assert curve.torque[:, i] == pytest.approx(axles[2, [0, 0, 1, 1]], rel=1e-5)
            assert curve.entry_angle[:, i] == pytest.approx(axles[3, [0, 0, 1, 1]], rel=1e-5)


def test_a_draft_at_the_height_of_the_centre_of_gravity_is_like_a_grade():
    high = dataclasses.replace(RIG, chassis=dataclasses.replace(RIG.chassis, hitch_height=0.75))
    level, graded = (pull_curve(SOILS["loam"], high, MODEL, GRID, np.full(14, g)).pull for g in (False, True))
    second_order = (level / WEIGHT) ** 2 / 2.0  # the slope presses a little less on the ground
    assert np.all(np.abs(graded - level) < 2.0 * second_order * WEIGHT)
    assert np.abs(level - both(SOILS["loam"])[0].pull).max() > 20.0  # at its own height it is not


@pytest.mark.parametrize("name", NAMES)
def test_gradients_of_a_curve_equal_finite_differences(name):
    soil = SOILS[name]
    slip = GRID[[2, 7, 13]]
    for graded in (False, True):
        here = both(soil, slip)[graded]
        for k, parameter in enumerate(Soil._fields):
            h = 1e-3 * soil[k]
            up, down = (both(soil._replace(**{parameter: soil[k] + s * h}), slip)[graded] for s in (1, -1))
            by_pull, by_torque = (up.pull - down.pull) / 2e-3, (up.torque - down.torque) / 2e-3
            assert here.pull_by_soil[k] * soil[k] == pytest.approx(by_pull, abs=5e-3 * np.abs(by_pull).max())
            assert here.torque_by_soil[:, k] * soil[k] == pytest.approx(by_torque, abs=5e-3 * np.abs(by_torque).max())


def test_a_warm_start_changes_nothing():
    for name in NAMES:
        soil = SOILS[name]
        on_grade = np.arange(28) >= 14
        cold = pull_curve(soil, RIG, MODEL, np.tile(GRID, 2), on_grade)
        near = soil._replace(k_phi=1.2 * soil.k_phi, n=0.95 * soil.n, c=0.8 * soil.c)
        start = pull_curve(near, RIG, MODEL, np.tile(GRID, 2), on_grade)
        warm = pull_curve(soil, RIG, MODEL, np.tile(GRID, 2), on_grade, start)
        assert warm.pull == pytest.approx(cold.pull, abs=1e-6 * WEIGHT)
        assert warm.torque == pytest.approx(cold.torque, rel=1e-5)
        by_cold, by_warm = (c.pull_by_soil * np.array(soil)[:, None] for c in (cold, warm))
        assert by_warm == pytest.approx(by_cold, abs=5e-3 * np.abs(by_cold).max())


def total_gradient(soil: Soil, limit: np.ndarray) -> np.ndarray:
    """Largest pull's change by relative changes of the soil, by central differences."""
    out = []
    for k, parameter in enumerate(Soil._fields):
        h = 2e-3 * soil[k]
        up, down = (
            largest_pull(both(s)[0], limit, s, RIG, MODEL).pull
            for s in (soil._replace(**{parameter: soil[k] + sign * h}) for sign in (1, -1))
        )
        out.append((up - down) / 4e-3)
    return np.array(out)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("share", [None, 0.5, 0.8])
def test_gradient_of_the_largest_pull_equals_finite_differences(name, share):
    soil = SOILS[name]
    level = both(soil)[0]
    limit = NO_LIMIT if share is None else np.full(4, share * level.torque.max())
    found = largest_pull(level, limit, soil, RIG, MODEL)
    if share is not None:
        assert found.limit == "torque"
    expected = total_gradient(soil, limit)
    assert found.gradient * np.asarray(soil) == pytest.approx(expected, abs=0.02 * np.abs(expected).max())


@pytest.mark.parametrize("name", NAMES)
def test_unlimited_pull_is_the_best_over_slip(name):
    soil = SOILS[name]
    for graded in (False, True):
        found = largest_pull(both(soil)[graded], NO_LIMIT, soil, RIG, MODEL)
        fine = both(soil, np.linspace(0.02, 0.6, 200))[graded]
        assert found.pull == pytest.approx(fine.pull.max(), abs=2e-3 * WEIGHT)
        assert found.limit == ("slip" if np.argmax(fine.pull) == 199 else "traction")


@pytest.mark.parametrize("name", ["loam", "wet_clay", "sandy_loam_22"])
@pytest.mark.parametrize("graded", [False, True])
def test_torque_limit_is_met_exactly(name, graded):
    soil = SOILS[name]
    curve = both(soil)[graded]
    low, high = curve.torque[:, 0], curve.torque[:, -1]
    for share in (np.full(4, 0.7), np.array([np.nan, 0.6, 0.9, np.nan])):
        # A front wheel may need less torque the more the draft lifts it: its limit must not bind at the start.
        limit = np.where(np.isnan(share), np.nan, np.fmax(low + share * (high - low), 1.001 * low))
        found = largest_pull(curve, limit, soil, RIG, MODEL)
        assert found.limit == "torque"
        known = np.isfinite(limit)

        def usage(slip: float, limit: np.ndarray = limit, known: np.ndarray = known) -> float:
            return (brute(soil, slip, graded)[1][2, [0, 0, 1, 1]] / limit)[known].max() - 1.0

        slip = brentq(usage, 0.02, 0.6, xtol=1e-5)
        _, axles = brute(soil, found.slip, graded)
        assert (axles[2, [0, 0, 1, 1]] / limit)[known].max() < 1.0 + 2e-4
        assert found.slip == pytest.approx(slip, rel=1e-2)  # torque hardly changes with slip
        assert found.pull == pytest.approx(brute(soil, slip, graded)[0], abs=1e-5 * WEIGHT)


def test_more_torque_never_pulls_less():
    soil = SOILS["loam"]
    level = both(soil)[0]
    top = level.torque.max()
    pulls = [largest_pull(level, np.full(4, t), soil, RIG, MODEL).pull for t in np.linspace(0.3, 1.2, 19) * top]
    assert np.all(np.diff(pulls) > -1e-4 * WEIGHT)
    assert pulls[-1] == largest_pull(level, NO_LIMIT, soil, RIG, MODEL).pull


@pytest.mark.parametrize(("name", "share"), [("loam", 0.0), ("wet_clay", 0.9), ("dry_sand", 0.5)])
def test_motors_too_weak_to_turn_the_wheels_without_a_push(name, share):
    # The motors give less than the least slip of the curve asks for: only wheels that skid need so little.
    soil = SOILS[name]
    level = both(soil)[0]
    limit = share * level.torque[:, 0].min()
    found = largest_pull(level, np.full(4, limit), soil, RIG, MODEL)
    slip = brentq(lambda s: brute(soil, s, False)[1][2].max() - limit, -0.3, 0.02, xtol=1e-5)
    assert found.limit == "torque"
    assert found.slip == pytest.approx(slip, abs=1e-3)
    assert found.pull == pytest.approx(brute(soil, slip, False)[0], abs=1e-4 * WEIGHT)
    assert found.pull < -1000.0
    expected = total_gradient(soil, np.full(4, limit))
    assert found.gradient * np.asarray(soil) == pytest.approx(expected, abs=0.02 * np.abs(expected).max())


def test_motors_too_weak_even_for_skid_push_back():
    soil = SOILS["sandy_loam_22"]
    level = both(soil)[0]
    found = largest_pull(level, np.full(4, 1.0), soil, RIG, MODEL)
    assert found.pull < level.pull.min() - 1000.0
    assert found.limit == "torque"


def test_buried_wheels_have_no_capability():
    slush = SOILS["heavy_clay_40"]._replace(k_c=10.0, k_phi=500.0, c=50.0, phi=0.02)
    level, graded = both(slush)
    assert np.isnan(level.pull).all()
    assert largest_pull(level, NO_LIMIT, slush, RIG, MODEL) is None
    assert largest_pull(graded, NO_LIMIT, slush, RIG, MODEL) is None


def test_slip_for_a_pull_lies_on_the_curve():
    soil = SOILS["loam"]
    level = both(soil)[0]
    for part in (0.3, 0.9):
        wanted = part * level.pull.max()
        slip, torque = slip_for_pull(level, wanted)
        exact = brentq(lambda s, wanted=wanted: brute(soil, s, False)[0] - wanted, 0.02, 0.6, xtol=1e-5)
        assert slip == pytest.approx(exact, rel=0.05)
        assert torque == pytest.approx(2.0 * brute(soil, exact, False)[1][2].sum(), rel=0.01)
    assert slip_for_pull(level, 1.01 * level.pull.max()) is None
    assert slip_for_pull(level, level.pull[0] - 1.0) == pytest.approx((0.02, level.torque[:, 0].sum()))


def test_a_rig_without_a_chassis_is_refused():
    bench = dataclasses.replace(RIG, chassis=None)
    with pytest.raises(ValueError, match="mass and geometry"):
        pull_curve(SOILS["loam"], bench, MODEL, GRID, np.zeros(14, bool))
