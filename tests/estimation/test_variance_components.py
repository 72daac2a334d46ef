"""Variance components: what sensors are worth is learned from residuals, and errors that last count for as much."""

from dataclasses import replace

import numpy as np
import pytest

from soilbus.estimation.multistart import fit_window
from soilbus.estimation.options import ESTIMATOR
from soilbus.estimation.variance_components import VarianceComponents, block_sums, correction_ratios
from soilbus.estimation.window import Window
from soilbus.terra.soils import SOILS

BINS = 10
"""Bins of 0.1 s in a second."""


@pytest.fixture(scope="module")
def drive(simulated):
    return simulated(SOILS["loam"], 3)


def learned(drive, window: Window, rounds: int = 5) -> VarianceComponents:
    """Components of a window alone, refined until they stay."""
    components = VarianceComponents(ESTIMATOR.variance)
    for _ in range(rounds):
        problem = drive.problem(components.scaled(window, drive.rig))
        fit = fit_window(problem, drive.prior)
        components = components.after(correction_ratios(problem, fit.optimum, ESTIMATOR.variance), whole=True)
    return components


def with_noise(window: Window, quantity: str, times: float, lasts: int, seed: int = 1) -> Window:
    """More noise, so that its sd is this many times that of the window's own; the same for a number of bins."""
    value, rng = getattr(window, quantity), np.random.default_rng(seed)
    drawn = rng.standard_normal((len(window.t) // lasts, *value.shape[1:])).repeat(lasts, axis=0)
    sd = np.sqrt(window.variance[quantity] * (times**2 - 1.0))
    return replace(window, **{quantity: value + sd * drawn})


def test_white_noise_as_configured_has_factors_of_one(drive):
    found = learned(drive, drive.window).factor
    assert set(found) >= {"torque", "draft", "load"}
    for kind, factor in found.items():
        assert 0.5 < factor < 2.0, kind


def variance_of_torques(drive, window: Window, components: VarianceComponents) -> float:
    """Mean variance [N2 m2] of what torques less those of the model have, by all sensors."""
    problem = drive.problem(components.scaled(window, drive.rig))
    optimum = fit_window(problem, drive.prior).optimum
    variance, row_var = problem.variances(optimum.gains)
    of_latents = np.einsum("nml,nl->nm", optimum.at.by_latents**2, variance)
    return float((row_var + of_latents)[:, problem.layout.torques].mean())


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize(("lasts", "times"), [(1, 9.0), (BINS, 1.0 + BINS * 8.0)], ids=["a bin", "a second"])
@pytest.mark.parametrize("quantity", ["load", "torque"])
def test_noise_of_three_times_the_sd_is_found(quantity, lasts, times, seed, drive):
    """Noise that stays for a second counts as one look: its mean over a second has ten times the variance.

    Which of torque and load shakes shows slowly, since both move the same residual; what both do to it shows at once.
    """
    shaken, none = with_noise(drive.window, quantity, 3.0, lasts, seed), VarianceComponents(ESTIMATOR.variance)
    found, true = learned(drive, shaken), replace(none, factor={quantity: times})
    ratio = variance_of_torques(drive, shaken, found) / variance_of_torques(drive, shaken, true)
    assert ratio == pytest.approx(1.0, abs=0.3)
    if quantity == "load":
        assert np.sqrt(found.factor["load"] / times) == pytest.approx(1.0, abs=0.3)


def test_factors_scale_the_variances_of_their_own_quantities(drive):
    components = replace(VarianceComponents(ESTIMATOR.variance), factor={"load": 9.0, "draft": 4.0})
    scaled, before = components.scaled(drive.window, drive.rig).variance, drive.window.variance
    times = {"load": 9.0, "draft": 4.0, "pitch": 4.0, "acceleration": 4.0}
    for quantity, variance in scaled.items():
        assert variance == pytest.approx(times.get(quantity, 1.0) * before[quantity], nan_ok=True), quantity


def test_factors_are_geometric_means_within_their_bounds():
    options = replace(ESTIMATOR.variance, memory=4.0, least=0.5, most=8.0)
    components = VarianceComponents(options)
    for ratio in (2.0, 0.5, 2.0):
        components = components.after({"draft": ratio})
    assert components.weight == 3.0
    assert components.factor["draft"] == pytest.approx(2.0 * 0.5 ** (1 / 2) * 2.0 ** (1 / 3))
    assert components.after({"draft": 1e9}, whole=True).factor["draft"] == 8.0
    assert components.after({"draft": 1e-9}, whole=True).factor["draft"] == 0.5


def test_blocks_are_those_of_the_clock_and_empty_ones_are_left_out():
    t, values = np.array([0.2, 0.9, 1.1, 5.0, 5.5]), np.arange(10.0).reshape(5, 2)
    expected = [values[:2].sum(axis=0), values[2], values[3:].sum(axis=0)]
    assert block_sums(values, t, 1.0) == pytest.approx(np.array(expected))
