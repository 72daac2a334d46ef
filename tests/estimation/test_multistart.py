"""Fits of simulated windows: errors as reported, the same optimum from every start, missing and impossible data."""

import dataclasses

import numpy as np
import pytest

from soilbus.estimation.multistart import clip_to_prior, fit_warm, fit_window, starting_soils, warm_start
from soilbus.estimation.posterior import PARAMETERS, SoilPrior
from soilbus.estimation.standing import STANDING
from soilbus.estimation.window import Rig, Window
from soilbus.terra.soils import SOILS
from soilbus.terra.wheel import Soil
from soilbus.trials.windows import fit_from_soil

QUANTITIES = ("torque", "load", "speed", "sinkage", "ground_speed", "draft", "pitch", "acceleration")


def deviations(fit, soil):
    """Estimate less truth (F,) of the free parameters in posterior sd."""
    std = np.sqrt(np.diag(fit.posterior.log_covariance))
    free = std > 0.0
    return np.log(np.asarray(fit.posterior.soil)[free] / np.asarray(soil)[free]) / std[free]


def widths(fit):
    """Standard deviations of bearing pressure and tan phi."""
    return [quantity.std for quantity in (fit.posterior.bearing_pressure(0.02, 0.3), fit.posterior.tan_phi())]


def changed(window: Window, **changes) -> Window:
    """A copy of the window with its columns changed by functions that work in place."""
    window = window.rows(np.arange(len(window.t)))
    for quantity, change in changes.items():
        change(getattr(window, quantity))
    return window


def hit(value, *index):
    def change(column):
        column[index if len(index) > 1 else index[0]] = value

    return change


def set_nan(*index):
    return hit(np.nan, *index)


EVERYTHING = set_nan(Ellipsis)


@pytest.fixture(scope="module")
def wet_clay(simulated):
    return simulated(SOILS["wet_clay"], 50)


@pytest.fixture(scope="module")
def wet_clay_fit(wet_clay):
    return fit_window(wet_clay.problem(), wet_clay.prior)


@pytest.mark.parametrize("seed", [50, 51])
def test_fits_from_unlike_soils_end_at_the_same_optimum(seed, simulated):
    """A descent ends where 0.1 sd are left: ends differ by no more, and widths by what the curvature changes there."""
    case = simulated(SOILS["wet_clay"], seed)
    problem, prior = case.problem(), case.prior
    one = fit_window(problem, prior)
    width = widths(one)
    unlike = ("loam", "clayey_soil_38", "dry_sand", "heavy_clay_40", "wet_clay")
    for start in (Soil(*prior.median), *(clip_to_prior(prior, SOILS[name]) for name in unlike)):
        fit = fit_from_soil(problem, prior, start)
        assert fit.converged
        assert np.abs(deviations(fit, one.posterior.soil)).max() < 0.1
        assert fit.neg2_log_posterior == pytest.approx(one.neg2_log_posterior, abs=0.1)
        assert widths(fit) == pytest.approx(width, rel=0.1)


def test_a_warm_start_from_another_window_ends_at_the_optimum_of_a_cold_fit(wet_clay, wet_clay_fit, simulated):
    problem, prior = wet_clay.problem(), wet_clay.prior
    again = fit_warm(warm_start(problem, prior, wet_clay_fit))
    assert again.converged
    assert again.iterations <= 3
    assert np.abs(deviations(again, wet_clay_fit.posterior.soil)).max() < 0.05
    other = simulated(SOILS["wet_clay"], 51)
    neighbour = fit_window(other.problem(), prior)
    fit = fit_warm(warm_start(problem, prior, neighbour))
    assert fit.converged
    assert np.abs(deviations(fit, wet_clay_fit.posterior.soil)).max() < 0.05


def test_a_tighter_prior_moves_the_fit_as_bayes_rule_for_gaussians_does(wet_clay, wet_clay_fit):
    # The model is linear near the optimum.
    prior, posterior = wet_clay.prior, wet_clay_fit.posterior
    k = PARAMETERS.index("phi")
    tight = prior.log_std.copy()
    tight[k] = np.sqrt(posterior.log_covariance[k, k])
    target = posterior.soil.phi * np.exp(0.5 * tight[k])
    median = prior.median.copy()
    median[k] = target
    fit = fit_window(wet_clay.problem(), SoilPrior(median, tight))
    mean, weight = np.log(prior.median[k]), 1.0 / prior.log_std[k] ** 2
    precision = 1.0 / posterior.log_covariance[k, k] - weight + 1.0 / tight[k] ** 2
    of_data = (1.0 / posterior.log_covariance[k, k]) * np.log(posterior.soil.phi) - mean * weight
    expected = (of_data + np.log(target) / tight[k] ** 2) / precision
    assert fit.posterior.log_covariance[k, k] == pytest.approx(1.0 / precision, rel=0.02)
    assert np.log(fit.posterior.soil.phi) == pytest.approx(expected, abs=0.05 * tight[k])


def test_directions_that_the_data_leave_open_stay_at_the_prior(simulated):
    # One wheel's torque at one operating point determines one combination of the parameters.
    case = simulated(SOILS["loam"], 60)
    same = np.full(60, 30)
    window = case.window.rows(same)
    window = changed(window, sinkage=EVERYTHING, draft=EVERYTHING, torque=set_nan(slice(None), slice(1, None)))
    fit = fit_window(case.problem(window), case.prior)
    std = np.sqrt(np.diag(fit.posterior.log_covariance))
    assert np.all(std <= case.prior.log_std * (1.0 + 1e-9))
    scaled = fit.posterior.log_covariance / np.outer(case.prior.log_std, case.prior.log_std)
    least, *rest = np.linalg.eigvalsh(scaled)
    assert least < 0.1
    assert min(rest) > 0.99
    away = np.log(np.asarray(fit.posterior.soil) / case.prior.median) / case.prior.log_std
    assert np.abs(away).max() < 2.0


def test_a_cohesionless_soil_is_fitted_with_c_held_at_zero(simulated):
    sand = SOILS["dry_sand"]._replace(c=0.0, k_c=2e3)
    case = simulated(sand, 70, ["soil.c.value=0", "soil.c.std=0"])
    fit = fit_window(case.problem(), case.prior)
    assert fit.converged
    assert fit.posterior.soil.c == 0.0
    assert fit.chi2 == pytest.approx(1.0, abs=0.15)
    assert np.abs(deviations(fit, sand)).max() < 3.0


MISSING = {
    "torque of one wheel": {"torque": set_nan(slice(None), 0)},
    "draft": {"draft": EVERYTHING},
    "sinkage": {"sinkage": EVERYTHING},
    "pitch and acceleration": {"pitch": EVERYTHING, "acceleration": EVERYTHING},
    "load of one wheel": {"load": set_nan(slice(None), 3)},
    "two seconds of everything": dict.fromkeys(QUANTITIES, set_nan(slice(40, 60))),
    "a third of the ground speeds": {"ground_speed": set_nan(slice(None, None, 3))},
}


@pytest.mark.parametrize("what", MISSING)
def test_missing_channels_widen_the_posterior_and_do_not_bias_it(what, wet_clay, wet_clay_fit):
    problem = wet_clay.problem(changed(wet_clay.window, **MISSING[what]))
    fit = fit_window(problem, wet_clay.prior)
    assert fit.converged
    assert fit.chi2 == pytest.approx(1.0, abs=0.15)
    assert np.abs(deviations(fit, wet_clay.soil)).max() < 3.5
    bearing, full = (f.posterior.bearing_pressure(0.02, 0.3) for f in (fit, wet_clay_fit))
    assert bearing.std > 0.98 * full.std
    assert bearing.std < 0.15 * bearing.value


def test_scattered_missing_samples_leave_out_residuals_only(wet_clay, wet_clay_fit):
    rng = np.random.default_rng(2)
    holes = {}
    for quantity in QUANTITIES:
        mask = rng.random(getattr(wet_clay.window, quantity).shape) < 0.1
        holes[quantity] = lambda column, mask=mask: np.putmask(column, mask, np.nan)
    fit = fit_window(wet_clay.problem(changed(wet_clay.window, **holes)), wet_clay.prior)
    assert fit.converged
    assert fit.rows < wet_clay_fit.rows
    assert np.abs(deviations(fit, wet_clay.soil)).max() < 3.5


IMPOSSIBLE = {
    "all missing": dict.fromkeys(QUANTITIES, EVERYTHING),
    "no torque, draft or sinkage": {"torque": EVERYTHING, "draft": EVERYTHING, "sinkage": EVERYTHING},
    "huge torque": {"torque": hit(1e300, 5, 1)},
    "huge load": {"load": hit(1e300, 5, 1)},
    "infinite draft": {"draft": hit(np.inf, 7)},
    "infinite speed": {"speed": hit(np.inf, 7, 2)},
    "loads of a feather": {"load": hit(1e-9, Ellipsis)},
    "negative torques": {"torque": lambda column: np.negative(column, out=column)},
    "huge ground speed": {"ground_speed": hit(1e200, 3)},
    "loads of a ship": {"load": lambda column: np.multiply(column, 1e4, out=column)},
    "zero torque": {"torque": hit(0.0, Ellipsis)},
}


@pytest.mark.parametrize("what", IMPOSSIBLE)
def test_impossible_data_raise_nothing_and_never_fit_well(what, wet_clay):
    problem = wet_clay.problem(changed(wet_clay.window, **IMPOSSIBLE[what]))
    fit = fit_window(problem, wet_clay.prior)
    if fit is None:
        return
    assert np.isfinite(np.asarray(fit.posterior.soil)).all()
    assert np.isfinite(fit.posterior.log_covariance).all()
    good = fit.converged and fit.chi2 < 1.1 + 3.5 * np.sqrt(2.0 / max(fit.rows, 1))
    if what in ("all missing", "no torque, draft or sinkage"):
        assert fit.rows == 0
        assert np.abs(np.log(np.asarray(fit.posterior.soil) / wet_clay.prior.median)).max() < 1e-6
    elif what in ("infinite draft", "infinite speed", "huge ground speed"):
        assert fit.rows < wet_clay.problem().n_rows  # such a sample is not used
    else:
        assert not good


def test_shuffled_torques_never_fit_well(wet_clay):
    def shuffle(column):
        np.random.default_rng(0).shuffle(column)

    fit = fit_window(wet_clay.problem(changed(wet_clay.window, torque=shuffle)), wet_clay.prior)
    assert fit is None or not fit.converged or fit.chi2 > 2.0


def test_the_order_of_wheels_changes_nothing(wet_clay, wet_clay_fit):
    order = [2, 0, 3, 1]
    rig = wet_clay.rig
    mixed = Rig(
        tuple(rig.wheels[i] for i in order), rig.radius[order], rig.width[order], rig.front[order],
        rig.chassis, rig.noise,
    )  # fmt: skip
    wheel = {q: getattr(wet_clay.window, q)[:, order] for q in ("torque", "load", "speed", "sinkage")}
    variance = {q: v[:, order] if v.ndim == 2 else v for q, v in wet_clay.window.variance.items()}
    window = dataclasses.replace(wet_clay.window, variance=variance, **wheel)
    fit = fit_window(wet_clay.problem(window, mixed), wet_clay.prior)
    assert np.abs(deviations(fit, wet_clay_fit.posterior.soil)).max() < 1e-3
    assert fit.neg2_log_posterior == pytest.approx(wet_clay_fit.neg2_log_posterior, rel=1e-6)
    assert fit.sinkage == pytest.approx(wet_clay_fit.sinkage[order], rel=1e-4)


def test_a_wrong_gain_is_estimated_as_a_gain(wet_clay, wet_clay_fit):
    def off(column):
        column[:, 2] *= 1.02  # four times the load cell's gain error

    fit = fit_window(wet_clay.problem(changed(wet_clay.window, load=off)), wet_clay.prior)
    names = wet_clay.problem().gain_names
    change = fit.gains - wet_clay_fit.gains
    of_sensors = change[: names.index(STANDING[0])]
    assert names[int(np.argmax(of_sensors))] == "load.RL"
    assert 0.005 < of_sensors.max() < 0.02


def test_a_wheel_that_no_entry_angle_carries_has_no_sinkage(wet_clay, wet_clay_fit):
    optimum = wet_clay_fit.optimum
    angle = optimum.latents.entry_angle.copy()
    angle[np.flatnonzero(wet_clay.problem().usable[:, 1])[0], 1] = 1.5  # nearly a right angle
    depth = wet_clay.problem().mean_sinkage(
        Soil(*optimum.soil), optimum.gains, optimum.latents._replace(entry_angle=angle)
    )
    assert np.isnan(depth).tolist() == [False, True, False, False]


def test_starts_stay_near_the_prior_and_keep_held_parameters(wet_clay):
    prior = SoilPrior.from_value_std(dict(zip(PARAMETERS, [(v, 0.3 * v) for v in SOILS["loam"]], strict=True)))
    prior.log_std[4] = 0.0
    first, *others = starting_soils(wet_clay.problem(), prior)
    assert first == pytest.approx(Soil(*prior.median))
    assert len(others) == 3
    for soil in others:
        assert soil.c == SOILS["loam"].c
        free = prior.free
        away = np.log(np.asarray(soil)[free] / prior.median[free]) / prior.log_std[free]
        assert np.abs(away).max() < 2.0 + 1e-9
