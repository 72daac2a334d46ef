"""Capability against brute force (nested scipy root finding)."""

import dataclasses
import math

import numpy as np
import pytest
from scipy.optimize import brentq, minimize_scalar
from scipy.stats import norm

from soilbus.decision import capability as assessment
from soilbus.decision.balance import Duty, balance
from soilbus.decision.capability import Demand, assess, slip_grid
from soilbus.decision.sigma_points import SigmaPoints
from soilbus.decision.wheels import WheelTable, wheel_table
from soilbus.estimation.assembly import prior_of, rig_of
from soilbus.estimation.multistart import fit_window
from soilbus.estimation.posterior import Posterior
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import Patch, Scenario, Swing
from soilbus.terra.soils import SOILS
from soilbus.terra.wheel import Soil
from soilbus.trials.windows import observed
from statics import MODEL, WEIGHT, WHEELS, brute, brute_with_rolling

CONFIG = reference_configuration()
RIG = rig_of(CONFIG)
NO_LIMIT = np.full(4, np.nan)
GRID = slip_grid(0.6)
NAMES = ("loam", "wet_clay", "clayey_soil_38", "dry_sand", "sandy_loam_22")
DUTIES = {
    "level": Duty(),
    "grade": Duty(0.0, None),
    "grade with draft": Duty(1500.0, None),
    "on a slope": Duty(None, 0.08),
    "down a slope": Duty(None, -0.05),
}


def table_of(*soils: Soil, slip=GRID, start: WheelTable | None = None) -> WheelTable:
    return wheel_table(np.array(soils), RIG, MODEL, slip, start, tolerance=1e-3)


def known_exactly(soil: Soil) -> Posterior:
    return Posterior(soil, np.zeros((6, 6)))


def assessed(soil: Soil, limit=NO_LIMIT, demand: Demand | None = None, max_sinkage: float = 1.0):
    """Capability of a soil that is known exactly."""
    return assess(known_exactly(soil), RIG, MODEL, demand, limit, 0.6, max_sinkage)[0]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("duty", DUTIES)
def test_the_balance_equals_brute_force(name, duty):
    found = balance(table_of(SOILS[name]), DUTIES[duty])
    exact = 1e-6 if duty == "level" else 5e-5
    for i, tolerance in ((0, exact), (20, exact), (28, 5e-5), (37, 5e-5), (40, exact)):  # 28 and 37 are interpolated
        pull, axles = brute(SOILS[name], found.slip[i], *DUTIES[duty])
        assert found.pull[0, i] == pytest.approx(pull, abs=tolerance * WEIGHT)
        for row, quantity in ((1, found.drawbar), (2, found.torque), (3, found.angle)):
            scale = WEIGHT if row == 1 else axles[row].max()
            assert quantity[0, :, i] == pytest.approx(axles[row], abs=10.0 * tolerance * scale)


def test_a_draft_at_the_height_of_the_centre_of_gravity_is_like_a_grade():
    high = dataclasses.replace(RIG, chassis=dataclasses.replace(RIG.chassis, hitch_height=0.75))
    table = wheel_table(np.array([SOILS["loam"]]), high, MODEL, GRID)
    level, graded = (balance(table, duty).pull[0] for duty in (Duty(), Duty(0.0, None)))
    second_order = (level / WEIGHT) ** 2 / 2.0  # the slope presses a little less on the ground
    assert np.all(np.abs(graded - level) < 2.0 * second_order * WEIGHT + 1.0)
    low = balance(table_of(SOILS["loam"])).pull[0]
    assert np.abs(level - low).max() > 20.0  # at its own height it is not


def test_many_soils_at_once_are_as_one_by_one():
    soils = [SOILS[name] for name in NAMES]
    together = balance(table_of(*soils), Duty(800.0, None))
    for i, soil in enumerate(soils):
        alone = balance(table_of(soil), Duty(800.0, None))
        # The second derivative by load is that of the first soil for all.
        assert together.pull[i] == pytest.approx(alone.pull[0], abs=2e-3 * WEIGHT)
        assert table_of(*soils).pull[i] == pytest.approx(table_of(soil).pull[0], abs=1e-6 * WEIGHT)


def test_a_warm_start_changes_nothing():
    for name in NAMES:
        soil = SOILS[name]
        near = soil._replace(k_phi=1.2 * soil.k_phi, n=0.95 * soil.n, c=0.8 * soil.c)
        cold, warm = table_of(soil), table_of(soil, start=table_of(near))
        assert warm.pull == pytest.approx(cold.pull, abs=1e-6 * WEIGHT)
        assert warm.at[1] == pytest.approx(cold.at[1], rel=1e-5)
        assert warm.by_slip == pytest.approx(cold.by_slip, rel=1e-2, abs=1e-3 * np.abs(cold.by_slip).max())


def test_buried_wheels_have_no_capability():
    slush = SOILS["heavy_clay_40"]._replace(k_c=10.0, k_phi=500.0, c=50.0, phi=0.02)
    both = table_of(SOILS["loam"], slush)
    assert both.balanced.tolist() == [[True] * 9, [False] * 9]
    assert np.isnan(both.pull[1]).all()
    assert assessed(slush) is None


def test_a_rig_without_a_chassis_is_refused():
    bench = dataclasses.replace(RIG, chassis=None)
    with pytest.raises(ValueError, match="mass and geometry"):
        wheel_table(np.array([SOILS["loam"]]), bench, MODEL, GRID)


@pytest.mark.parametrize("name", NAMES)
def test_unlimited_pull_is_the_best_over_slip(name):
    soil = SOILS[name]
    able = assessed(soil)
    best = minimize_scalar(lambda s: -brute(soil, s)[0], bounds=(0.02, 0.6), method="bounded", options={"xatol": 1e-3})
    assert able.max_draft.value == pytest.approx(max(-best.fun, brute(soil, 0.6)[0]), abs=2e-4 * WEIGHT)
    assert able.limit == ("slip" if best.x > 0.59 else "traction")
    steepest = max(brute(soil, s, 0.0, None)[0] for s in (best.x, 0.6))
    assert able.max_grade.value == pytest.approx(math.asin(steepest / WEIGHT), abs=3e-4)


@pytest.mark.parametrize(("name", "dead"), [("loam", "front"), ("wet_clay", "rear"), ("dry_sand", "front")])
def test_a_wheel_that_cannot_drive_rolls(name, dead):
    # Its limit is 0: it holds the vehicle back as a rolling wheel does, and no more.
    soil, limit = SOILS[name], np.where(RIG.front == (dead == "front"), 0.0, np.nan)
    able = assessed(soil, limit)
    pulls = [brute_with_rolling(soil, slip, dead)[0] for slip in (0.1, 0.3, 0.45, 0.6)]
    found = able.over_slip
    assert np.interp([0.1, 0.3, 0.45, 0.6], found.slip, found.pull) == pytest.approx(pulls, abs=4e-3 * WEIGHT)
    assert able.max_draft.value == pytest.approx(max(pulls), abs=6e-3 * WEIGHT)
    assert able.set_points[dead] == assessment.SetPoint(None, None)
    if name == "loam":
        assert able.set_points["rear" if dead == "front" else "front"].pull is not None


def test_a_vehicle_whose_wheels_all_roll_must_be_pulled():
    able = assessed(SOILS["loam"], np.zeros(4))
    slip = brentq(lambda s: brute(SOILS["loam"], s)[1][2].sum(), -0.3, 0.02, xtol=1e-5)
    assert able.max_draft.value == pytest.approx(brute(SOILS["loam"], slip)[0], abs=6e-3 * WEIGHT)
    assert set(able.set_points.values()) == {assessment.SetPoint(None, None)}


@pytest.mark.parametrize("name", ["loam", "wet_clay", "sandy_loam_22"])
@pytest.mark.parametrize("duty", [Duty(), Duty(0.0, None)], ids=["level", "grade"])
def test_torque_limit_is_met_exactly(name, duty):
    soil = SOILS[name]
    low, high = (brute(soil, s, *duty)[1][2, WHEELS] for s in (0.02, 0.6))
    for share in (np.full(4, 0.7), np.array([np.nan, 0.6, 0.9, np.nan])):
        # A front wheel may need less torque the more the draft lifts it: its limit must not bind at the start.
        limit = np.where(np.isnan(share), np.nan, np.fmax(low + share * (high - low), 1.001 * low))
        able = assessed(soil, limit)
        assert able.limit == "torque"
        known = np.isfinite(limit)

        def usage(slip: float, limit: np.ndarray = limit, known: np.ndarray = known) -> float:
            return (brute(soil, slip, *duty)[1][2, WHEELS] / limit)[known].max() - 1.0

        pull = brute(soil, brentq(usage, 0.02, 0.6, xtol=1e-5), *duty)[0]
        found = able.max_draft.value if duty == Duty() else WEIGHT * math.sin(able.max_grade.value)
        assert found == pytest.approx(pull, abs=2e-4 * WEIGHT)


def test_more_torque_never_pulls_less():
    soil = SOILS["loam"]
    top = assessed(soil).over_slip.torque[-1] / 3.0
    pulls = [assessed(soil, np.full(4, t)).max_draft.value for t in np.linspace(0.3, 1.2, 19) * top]
    assert np.all(np.diff(pulls) > -1e-4 * WEIGHT)
    assert pulls[-1] == assessed(soil).max_draft.value


@pytest.mark.parametrize(("name", "share"), [("loam", 0.3), ("wet_clay", 0.9), ("dry_sand", 0.5)])
def test_motors_too_weak_to_turn_the_wheels_without_a_push(name, share):
    # The motors give less than the least slip asks for: only wheels that skid need so little.
    soil = SOILS[name]
    limit = share * brute(soil, 0.02)[1][2].min()
    able = assessed(soil, np.full(4, limit))
    slip = brentq(lambda s: brute(soil, s)[1][2].max() - limit, -0.3, 0.02, xtol=1e-5)
    assert able.limit == "torque"
    assert able.max_draft.value == pytest.approx(brute(soil, slip)[0], abs=1e-3 * WEIGHT)
    assert able.max_draft.value < -1000.0
    assert able.set_points["front"] == assessment.SetPoint(None, None)


def test_motors_too_weak_even_for_skid_push_back():
    able = assessed(SOILS["sandy_loam_22"], np.full(4, 1.0))
    assert able.max_draft.value < able.over_slip.pull.min() - 1000.0
    assert able.limit == "torque"


def test_a_sinkage_limit_ends_the_pull():
    assert assessed(SOILS["dry_sand"], max_sinkage=0.05) is None
    loam = SOILS["loam"]
    # With its weight behind, the rear wheels sink the more the harder the vehicle pulls.
    heavy = dataclasses.replace(
        RIG, chassis=dataclasses.replace(RIG.chassis, cg_ahead_of_rear_axle=0.5, hitch_height=0.8)
    )
    driving = balance(wheel_table(np.array([loam]), heavy, MODEL, GRID))
    depth = 0.62 * (1.0 - np.cos(driving.angle[0, 1]))
    limit = float(depth[12] + depth[13]) / 2.0
    assert np.all(np.diff(depth[:20]) > 0.0)
    able = assess(known_exactly(loam), heavy, MODEL, None, NO_LIMIT, 0.6, limit)[0]
    assert able.limit == "sinkage"
    assert able.max_draft.value == pytest.approx(float(driving.pull[0, 12] + driving.pull[0, 13]) / 2.0, rel=2e-3)


def test_set_points_are_the_best_slips_of_each_axle():
    soil = SOILS["loam"]
    able = assessed(soil)
    for i, axle in enumerate(("front", "rear")):

        def efficiency(slip: float, i: int = i) -> float:
            _, pull, torque, _ = brute(soil, slip)[1][:, i]
            return pull * (1.0 - slip) * (0.50, 0.62)[i] / torque

        best = minimize_scalar(lambda s: -efficiency(s), bounds=(0.02, 0.6), method="bounded", options={"xatol": 1e-4})
        assert able.set_points[axle].efficiency.value == pytest.approx(best.x, abs=5e-3)
        assert efficiency(able.set_points[axle].efficiency.value) == pytest.approx(-best.fun, rel=1e-4)
        assert able.set_points[axle].pull.value == pytest.approx(0.6)
    held = assessed(soil, np.full(4, 700.0)).set_points["rear"]
    reached = brentq(lambda s: brute(soil, s)[1][2].max() - 700.0, 0.02, 0.6, xtol=1e-5)
    assert held.pull.value == pytest.approx(reached, rel=5e-3)
    assert held.efficiency.value <= held.pull.value + 1e-9


@pytest.mark.parametrize("sine", [0.0, 0.05])
def test_the_forecast_meets_the_demand(sine):
    soil = SOILS["loam"]
    for part in (0.3, 0.9):
        wanted = part * assessed(soil, demand=Demand(0.0, 1.0, sine)).max_pull.value
        forecast = assessed(soil, demand=Demand(wanted, 1.0, sine)).forecast
        exact = brentq(lambda s, wanted=wanted: brute(soil, s, None, sine)[0] - wanted, 0.02, 0.6, xtol=1e-5)
        _, axles = brute(soil, exact, None, sine)
        assert forecast.slip.value == pytest.approx(exact, rel=2e-3)
        assert forecast.torque.value == pytest.approx(2.0 * axles[2].sum(), rel=1e-3)
        depth = np.array([0.50, 0.50, 0.62, 0.62]) * (1.0 - np.cos(axles[3, WHEELS]))
        assert [e.value for e in forecast.sinkage.values()] == pytest.approx(depth, rel=1e-3)
        assert forecast.deepest.value == pytest.approx(depth.max(), rel=1e-3)
    assert assessed(soil, demand=Demand(1e5, 1.0, sine)).forecast is None
    pushed = assessed(soil, demand=Demand(-1e4, 1.0, sine)).forecast
    assert pushed.slip.value == pytest.approx(0.02)


def test_torque_over_slip_is_that_of_equation_22():
    able = assessed(SOILS["wet_clay"])
    for slip, pull, torque in zip(able.over_slip.slip, able.over_slip.pull, able.over_slip.torque, strict=True):
        exact, axles = brute(SOILS["wet_clay"], slip)
        assert pull == pytest.approx(exact, abs=1e-5 * WEIGHT)
        assert torque == pytest.approx(2.0 * axles[2].sum(), rel=1e-5)


# --- the posterior's spread ---


def spread_of(*std: float) -> SigmaPoints:
    """Points of loam with independent logarithms of these standard deviations."""
    return SigmaPoints.of(Posterior(SOILS["loam"], np.diag([*std, *[0.0] * (6 - len(std))]) ** 2))


@pytest.mark.parametrize(("axis", "degree"), [(0, 1), (0, 2), (1, 1), (1, 2), (2, 1), (2, 2)])
def test_powers_along_an_axis_have_the_moments_of_a_normal(axis, degree):
    points = spread_of(0.3, 0.2, 0.1)
    x = np.log(points.soils / points.soils[0])[:, axis] / (0.3, 0.2, 0.1)[axis]
    power, square = norm().moment(degree), norm().moment(2 * degree)
    assert points.mean_and_std(x**degree) == pytest.approx((power, math.sqrt(square - power**2)), abs=1e-9)


def test_values_along_several_axes_add_up():
    """Mean and std of a lognormal force along the ridge and of two more axes, beside 400 000 draws."""
    points = spread_of(0.5, 0.2, 0.1)

    def force(soils):
        k_c, k_phi, n = (np.log(soils / np.asarray(SOILS["loam"]))[:, i] for i in range(3))
        return np.exp(0.4 * k_c) + 0.5 * np.tanh(2.0 * k_phi) + n**2

    drawn = np.asarray(SOILS["loam"]) * np.exp(
        np.random.default_rng(3).normal(0.0, [0.5, 0.2, 0.1, 0.0, 0.0, 0.0], (400_000, 6))
    )
    mean, std = points.mean_and_std(force(points.soils))
    assert mean == pytest.approx(force(drawn).mean(), rel=1e-3)
    assert std == pytest.approx(force(drawn).std(), rel=0.01)


def test_points_have_the_posterior_s_covariance():
    root = np.random.default_rng(1).normal(0.0, 0.1, (6, 6)) * np.array([1.0, 0.5, 0.1, 0.1, 1.0, 0.0])[:, None]
    posterior = Posterior(SOILS["loam"]._replace(K=0.0), root @ root.T)
    points = SigmaPoints.of(posterior)
    mean, std = points.mean_and_std(np.log(points.soils[:, :5]))
    assert mean == pytest.approx(np.log(posterior.soil[:5]))
    assert std == pytest.approx(np.sqrt(np.diag(posterior.log_covariance)[:5]))
    assert not points.soils[:, 5].any()


def test_first_order_is_exact_for_what_is_linear_and_blind_to_what_only_bends():
    root = np.random.default_rng(2).normal(0.0, 0.1, (6, 6))
    root[1] *= 3.0  # what bends is not well known
    posterior = Posterior(SOILS["loam"], root @ root.T)
    points = SigmaPoints.of(posterior)
    logs = np.log(points.soils / points.soils[0])
    gradient = np.array([3.0, -1.0, 2.0, 0.5, -4.0, 1.0])
    found = points.likely(7.0 + logs @ gradient)
    assert found.value == 7.0
    assert found.std == pytest.approx(math.sqrt(gradient @ posterior.log_covariance @ gradient))
    bending = 7.0 + logs @ gradient + 5.0 * logs[:, 1] ** 2
    bent = points.likely(bending)
    assert (bent.value, bent.std) == pytest.approx((found.value, found.std))
    mean, _ = points.mean_and_std(bending)
    assert mean == pytest.approx(7.0 + 5.0 * posterior.log_covariance[1, 1])


def test_wheels_of_one_width_know_their_modulus_whatever_its_parts():
    """k_phi is a hundredth of K_L and its logarithm open; K_L, known to 3 %, is that of every point."""
    width, soil = 0.3, SOILS["loam"]._replace(k_c=1e5, k_phi=3e3)
    of_k_c = soil.k_c / width
    by_k_c = np.array([0.3, -0.3 * of_k_c / soil.k_phi])  # k_c for k_phi at one K_L
    by_K_L = 0.03 * np.array([1.0, 1.0])
    covariance = np.zeros((6, 6))
    covariance[:2, :2] = np.outer(by_k_c, by_k_c) + np.outer(by_K_L, by_K_L)
    points = SigmaPoints.of(Posterior(soil, covariance), width=width)
    K_L = points.soils[:, 0] / width + points.soils[:, 1]
    assert (points.soils[:, :2] > 0.0).all()
    mean, std = points.mean_and_std(np.log(K_L))
    assert (mean, std) == pytest.approx((math.log(of_k_c + soil.k_phi), 0.03), rel=0.01)


def test_a_shift_adds_its_square_to_the_variance():
    """Another uncertain quantity has one point, one sd away, and is part of the posterior's covariance."""
    shift = np.array([[0.1, -0.2, 0.0, 0.0, 0.3, 0.0]])
    covariance = np.diag([0.04, 0.09, 0.0, 0.0, 0.01, 0.0]) + shift.T @ shift
    points = SigmaPoints.of(Posterior(SOILS["loam"], covariance), shift)
    gradient = np.array([1.0, 2.0, 0.0, 0.0, -1.0, 0.0])
    values = np.log(points.soils / points.soils[0]) @ gradient
    exact = pytest.approx(math.sqrt(gradient @ covariance @ gradient))
    assert points.mean_and_std(values)[1] == exact
    assert points.likely(values).std == exact


def test_a_mean_that_is_not_known_has_no_std():
    points = spread_of(0.2, 0.1)
    samples = np.full((len(points.soils), 2), np.nan)
    samples[:, 0], samples[1:, 1] = np.arange(len(samples)), 1.0
    mean, std = points.mean_and_std(samples)
    assert np.isfinite(mean).tolist() == np.isfinite(std).tolist() == [True, False]
    assert points.likely(samples[:, 1]) is None
    assert points.estimates(samples[:, 1], None, samples[:, 0])[:2] == [None, None]


def test_a_point_without_a_value_is_mirrored():
    points = spread_of(0.2, 0.1)
    samples = 1000.0 + 100.0 * np.log(points.soils[:, 0])
    whole = points.mean_and_std(samples)
    for i in range(1, len(samples)):
        known = np.arange(len(samples)) != i
        assert points.filled(np.where(known, samples, 1e6), known) == pytest.approx(samples)
        assert np.array(points.mean_and_std(np.where(known, samples, np.nan))) == pytest.approx(np.array(whole))
        assert points.likely(np.where(known, samples, np.nan)).std == pytest.approx(whole[1])
    assert points.filled(samples, np.arange(len(samples)) == 0) == pytest.approx(np.full(len(samples), samples[0]))


def fitted(name: str, slip: Swing) -> Posterior:
    """What 10 s of a drive tell of a soil."""
    recording = simulate(CONFIG, Scenario(10.0, (Patch(0.0, name),), slip=slip), 3)
    return fit_window(observed(CONFIG, recording.channels, 10.0), prior_of(CONFIG)).posterior


def test_the_spread_of_the_largest_draft_equals_that_of_brute_force():
    posterior = fitted("wet_clay", Swing(0.08, 0.15))
    able = assess(posterior, RIG, MODEL, None, NO_LIMIT, 0.6, 0.25)[0]
    logs = np.random.default_rng(5).multivariate_normal(np.log(posterior.soil), posterior.log_covariance, 75)
    drafts = [brute(Soil(*row), 0.6)[0] for row in np.exp(logs)]
    assert able.max_draft.std == pytest.approx(np.std(drafts), rel=0.2)  # sampling: 8 %
    assert able.max_draft.value == pytest.approx(np.mean(drafts), abs=0.3 * able.max_draft.std)
