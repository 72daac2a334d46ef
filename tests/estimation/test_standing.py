"""Relaxation, wheel inertia and late channels: derivatives, and drives that have them give them back."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from soilbus.can.channels import Column
from soilbus.estimation.assembly import prior_of, rig_of
from soilbus.estimation.multistart import fit_window
from soilbus.estimation.standing import STANDING, standing_std, wheel_inertia
from soilbus.simulator.recording import Recording, simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import Patch, Scenario, Swing
from soilbus.terra.soils import SOILS
from soilbus.trials.windows import observed

CONFIG = reference_configuration()
RIG = rig_of(CONFIG)
LIVELY = Scenario(
    12.0, (Patch(0.0, "loam"),), Swing(1.0, 2.0, 0.1, 0.5), slip=Swing(0.05, 0.4, 0.1, 0.5), side_shift=Swing(-0.2, 0.2)
)
"""A drive whose slips, speeds and loads move within a second."""


def test_derivatives_are_finite_differences_of_the_residuals(simulated):
    case = simulated(SOILS["loam"], 3)
    problem = case.problem()
    latents, first = problem.start(case.soil), problem.gain_names.index(STANDING[0])
    gains = problem.gain_std * np.random.default_rng(1).standard_normal(len(problem.gain_std))
    column = problem.layout.sensor_columns.start + first
    for i, name in enumerate(STANDING):
        step = 1e-3 * problem.gain_std[first + i] * (np.arange(len(gains)) == first + i)
        up, down = (problem.linearise(case.soil, gains + way * step, latents).rows[:, 0] for way in (1.0, -1.0))
        ours = problem.linearise(case.soil, gains, latents).rows[:, column + i]
        expected = (up - down) / (2.0 * step.max())
        assert np.abs(expected).max() > 0.0, name
        assert ours == pytest.approx(expected, abs=1e-5 * np.abs(expected).max()), name


def late(channel: str, by: float) -> Callable[[Recording], dict[str, Column]]:
    """Samples of a quantity, stamped later by some seconds."""

    def of(recording: Recording) -> dict[str, Column]:
        return {
            name: Column(c.t + by, c.value) if name.partition(".")[0] == channel else c
            for name, c in recording.channels.items()
        }

    return of


def relaxed(length: float) -> Callable[[Recording], dict[str, Column]]:
    """Wheels that turn so that their kinematic slip is s + (L / V) ds/dt; torque and pull are those of s."""

    def of(recording: Recording) -> dict[str, Column]:
        truth, channels = recording.truth, dict(recording.channels)
        for name, radius in zip(RIG.wheels, RIG.radius, strict=True):
            speed = channels[f"speed.{name}"]
            slip = 1.0 - truth["ground_speed"] / (radius * truth[f"speed.{name}"])
            lag = length / truth["ground_speed"] * np.gradient(slip, truth["t"])
            factor = np.interp(speed.t, truth["t"], (1.0 - slip) / (1.0 - slip - lag))
            channels[f"speed.{name}"] = Column(speed.t, speed.value * factor)
        return channels

    return of


def with_inertia(discs: float) -> Callable[[Recording], dict[str, Column]]:
    """Torques that also speed the wheels up."""

    def of(recording: Recording) -> dict[str, Column]:
        truth, channels = recording.truth, dict(recording.channels)
        for name, inertia in zip(RIG.wheels, discs * wheel_inertia(RIG), strict=True):
            torque, rate = channels[f"torque.{name}"], np.gradient(truth[f"speed.{name}"], truth["t"])
            channels[f"torque.{name}"] = Column(
                torque.t, torque.value + inertia * np.interp(torque.t, truth["t"], rate)
            )
        return channels

    return of


MACHINES = {
    "relaxation_length": (relaxed(0.15), 0.15), "wheel_inertia": (with_inertia(12.0), 12.0),
    "lateness.load": (late("load", 0.05), 0.05), "lateness.ground_speed": (late("ground_speed", 0.12), 0.12),
    "lateness.draft": (late("draft", 0.06), 0.06), "lateness.acceleration": (late("acceleration", 0.05), 0.05),
}  # fmt: skip


@pytest.mark.parametrize("name", STANDING)
def test_a_drive_gives_its_own_value_back(name):
    change, true = MACHINES[name]
    problem = observed(CONFIG, change(simulate(CONFIG, LIVELY, 5)), 10.0)
    fit = fit_window(problem, prior_of(CONFIG))
    found, std = (of[problem.gain_names.index(name)] for of in (fit.gains, problem.gain_std))
    assert found == pytest.approx(true, rel=0.3)  # slopes of what is measured have noise, which makes each less
    assert fit.mode.gain(problem.gain_names.index(name)).std < 0.2 * std


def test_a_test_rig_has_none():
    assert standing_std(replace(RIG, chassis=None)) == [0.0] * len(STANDING)
