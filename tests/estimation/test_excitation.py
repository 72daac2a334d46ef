"""Windows with too little variation: what is missing is named, what is determined is reported, intervals are right."""

import numpy as np
import pytest
from scipy.stats import binom, chi2

import driven_windows
from driven_windows import tasks
from soilbus.decision.traversability import State, Status
from soilbus.estimation.assembly import model_of, prior_of, rig_of
from soilbus.estimation.multistart import fit_window
from soilbus.estimation.posterior import NORMAL_95
from soilbus.pipeline.estimator import WindowEstimator
from soilbus.simulator.drivetrain import drivetrain_of
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import Patch, Scenario, Swing
from soilbus.terra.soils import SOILS
from soilbus.trials.draft_trials import true_largest_draft
from soilbus.trials.draws import prior_about

STILL, LEANING, ROCKING = Swing(0.0, 1e-9), Swing(-0.3, 0.3), Swing(-0.3, 0.3, 0.2, 0.4)
SLIPS = (0.05, 0.1, 0.2, 0.35)
DRIVES = 10
Z_REF, B_REF = 0.02, 0.3
CHANCE = 1e-3
"""Probability that a figure just on its target fails here."""


def rough(soil, *more):
    """Settings by which c and K are known to 25 % and k_c to 50 %."""
    k_c = SOILS[soil].k_c
    return reference_configuration(
        [*driven_windows.c_and_K_known(soil), f"soil.k_c.value={k_c}", f"soil.k_c.std={0.5 * k_c}", *more]
    )


def deviations(posterior, soil):
    """Errors of bearing pressure and tan phi in their standard deviations."""
    bearing, tan_phi = posterior.bearing_pressure(Z_REF, B_REF), posterior.tan_phi()
    off = np.log(bearing.value / SOILS[soil].bearing_pressure(Z_REF, B_REF)) / (bearing.std / bearing.value)
    return off, (tan_phi.value - np.tan(SOILS[soil].phi)) / tan_phi.std


def of_drive(soil, sinkage, seed):
    """Deviations of a window of constant slip and loads."""
    config = rough(soil)
    problem = driven_windows.observed_window(
        config, soil, 10.0, driven_windows.constant(SLIPS[seed % 4]), sinkage, 100 + seed, STILL
    )
    prior = prior_about(prior_of(config), SOILS[soil], np.random.default_rng([seed, 9]))
    return deviations(fit_window(problem, prior).posterior, soil)


@pytest.mark.parametrize(
    ("soil", "sinkage"), [("loam", True), ("loam", False), ("wet_clay", False), ("dry_sand", True)]
)
def test_constant_driving_has_right_intervals(soil, sinkage):
    z = np.array([of_drive(soil, sinkage, seed) for seed in range(DRIVES)])
    held = (np.abs(z) < NORMAL_95).sum(axis=0)
    assert (held >= binom.ppf(CHANCE, DRIVES, 0.95)).all(), held / DRIVES
    rms = np.sqrt((z**2).mean(axis=0))
    low, high = np.sqrt(chi2.ppf([CHANCE, 1.0 - CHANCE], DRIVES) / DRIVES)
    assert ((rms > 0.8 * low) & (rms < 1.25 * high)).all(), rms


# --- what is missing ---


def said(soil, slip, shift, sinkage=True, overrides=(), seconds=10.0, seed=1):
    """What the data tell, apart from what the model's form leaves open."""
    formless = [f"model.form.{name}=0" for name in ("peak", "peak_by_slip", "exit", "shear")]
    config = reference_configuration([f"estimator.window={seconds}", *formless, *overrides])
    scenario = Scenario(seconds, (Patch(0.0, soil),), slip=slip, side_shift=shift)
    return WindowEstimator(config).solve(next(tasks(config, scenario, seed, "none" if sinkage else "sinkage")))


def relative_std(estimate):
    return estimate.std / estimate.value


def largest_draft(soil):
    """True largest draft [N] of the reference tractor on the level, by the simulator's equilibrium."""
    config = reference_configuration()
    limit = np.array([wheel.max_torque or np.nan for wheel in config.wheel])
    return true_largest_draft(
        SOILS[soil], rig_of(config), limit, config.traversability.max_slip, model_of(config), np.inf,
        drivetrain_of(config),
    )  # fmt: skip


@pytest.mark.parametrize("soil", ["wet_clay", "xi_wet_clay", "dry_sand"])
def test_constant_loads_with_varied_slip_lack_a_range_of_loads(soil):
    narrower = []
    for seed in (1, 2):
        short = said(soil, driven_windows.EXCITED, STILL, sinkage=False, seconds=5.0, seed=seed)
        assert short.status is Status.NOT_EXCITED
        assert "load_range" in short.reason.split()
        assert short.traversability.state is not State.GO
        assert np.abs(deviations(short.posterior, soil)).max() < 3.0
        varied = said(soil, driven_windows.EXCITED, ROCKING, sinkage=False, seconds=5.0, seed=seed)
        assert np.abs(deviations(varied.posterior, soil)).max() < 3.0
        narrower.append(relative_std(varied.bearing) / relative_std(short.bearing))
    assert max(narrower) < 1.0
    assert np.mean(narrower) < 0.8


def between(one, other):
    """A limit between the relative deviations of two estimates, of which the first is at least a sixth wider."""
    wide, narrow = relative_std(one), relative_std(other)
    assert wide > 7.0 / 6.0 * narrow
    return np.sqrt(wide * narrow)


@pytest.mark.parametrize("seed", [1, 2])
def test_constant_loads_on_dry_sand_lack_a_range_of_loads_and_nothing_else(seed):
    def drives(*overrides):
        shifts = (STILL, LEANING)
        return [said("dry_sand", driven_windows.EXCITED, s, True, overrides, 2.0, seed) for s in shifts]

    limit = between(*(result.bearing for result in drives()))
    still, varied = drives(f"estimator.max_bearing_std={limit}")
    assert (still.status, still.reason) == (Status.NOT_EXCITED, "not_excited load_range")
    assert (varied.status, varied.reason) == (Status.VALID, "none")


@pytest.mark.parametrize(("soil", "seed"), [("loam", 1), ("lete_sand", 2), ("sandy_loam_23_michigan", 1)])
def test_varied_loads_with_constant_slip_lack_a_range_of_slips(soil, seed):
    def drives(*overrides):
        slips = (driven_windows.constant(0.05), driven_windows.EXCITED)
        return [said(soil, slip, LEANING, overrides=overrides, seed=seed) for slip in slips]

    limit = between(*(result.traversability.max_draft for result in drives()))
    still, varied = drives(f"estimator.max_draft_std={limit}")
    assert (still.status, still.reason) == (Status.NOT_EXCITED, "not_excited slip_range")
    assert (varied.status, varied.reason) == (Status.VALID, "none")
    assert varied.posterior.tan_phi().std < 0.7 * still.posterior.tan_phi().std
    for result in (still, varied):
        draft = result.traversability.max_draft
        assert abs(draft.value - largest_draft(soil)) < 2.5 * draft.std


@pytest.mark.parametrize("soil", ["wet_clay", "dry_sand", "clayey_soil_38"])
def test_both_are_named_where_both_are_missing(soil):
    strict = ["estimator.max_draft_std=0.03", "estimator.max_bearing_std=0.01"]
    result = said(soil, driven_windows.constant(0.05), STILL, sinkage=False, overrides=strict, seconds=2.0)
    assert (result.status, result.reason) == (Status.NOT_EXCITED, "not_excited load_range slip_range")


@pytest.mark.parametrize("soil", ["loam", "clayey_soil_38"])
def test_the_pressure_at_the_depth_of_the_wheels_is_reported_all_the_same(soil):
    result = said(
        soil, driven_windows.constant(0.15), STILL, seconds=2.0, overrides=["estimator.max_bearing_std=0.005"]
    )
    assert result.status is Status.NOT_EXCITED
    width = 0.38
    at_wheel = result.posterior.bearing_pressure(result.sinkage["RL"], width)
    truth = SOILS[soil].bearing_pressure(result.sinkage["RL"], width)
    assert at_wheel.std < 0.102 * at_wheel.value
    assert abs(at_wheel.value - truth) < 3.0 * at_wheel.std + 0.02 * truth
    assert all(e.std > 0.0 for e in result.posterior.parameters().values())
    away = result.posterior.bearing_pressure(10.0 * result.sinkage["RL"], width)
    assert away.std / away.value > at_wheel.std / at_wheel.value
