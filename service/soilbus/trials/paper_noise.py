"""What sensor noise does to the paper's one operating point, beside a window of many.

    one instant: cov(K_L, phi, n) = J^-1 cov(W, DP, T) J^-T

The same wheel, soil, equations and noise, once at one instant as Xi et al. 2024 have it, once over instants with varied
load and slip by our own estimator.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from soilbus.arrays import Array
from soilbus.estimation.multistart import fit_window
from soilbus.estimation.observation_model import ObservationModel
from soilbus.estimation.posterior import SoilPrior
from soilbus.estimation.window import Rig, SensorNoise, window_of_samples
from soilbus.terra.entry_angle import entry_angle_for_load
from soilbus.terra.soil_laws import lumped_modulus
from soilbus.terra.wheel import WheelModel, WheelState, sinkage, wheel_forces
from soilbus.trials.paper import EXACT, Equations, Forces, OperatingPoint, Unknowns, WheelEquations
from soilbus.trials.paper_tables import Trial

__all__ = ["LEVELS", "Noise", "best_depth", "bounds", "cramer_rao", "one_instant", "relative_errors", "windows_of"]

RIM_SPEED = 1.0
"""Of the window's wheel [m/s]; the ground speed's noise then is that of the slip."""

INSTANTS = 100
"""Of the window."""


class Noise(NamedTuple):
    """Standard deviations: relative of W, DP and T, absolute of sinkage [m] and slip [-]."""

    W: float
    DP: float
    T: float
    sinkage: float
    slip: float


LEVELS = {
    "0.1 %": Noise(0.001, 0.001, 0.001, 0.0001, 0.001),
    "1 %": Noise(0.01, 0.01, 0.02, 0.003, 0.01),
}
"""Levels of noise by name."""


def cramer_rao(point: OperatingPoint, x: Unknowns, noise: Noise, equations: Equations = EXACT) -> Array:
    """Least covariance (3, 3) of the relative errors of K_L, phi and n from one operating point.

    Three equations, three unknowns: the inverse Jacobian (eq. 42) takes the noise of the
    forces, and of sinkage and slip through the forces, straight to the unknowns.
    """
    wheel = WheelEquations(point, equations)
    y = np.array(wheel.forces(x))
    covariance = np.diag((np.array(noise[:3]) * y) ** 2)
    for field, sd in (("sinkage", noise.sinkage), ("slip", noise.slip)):
        h = 1e-5 * getattr(point, field)
        ends = (point._replace(**{field: getattr(point, field) + d}) for d in (h, -h))
        high, low = (np.array(WheelEquations(p, equations).forces(x)) for p in ends)
        covariance += sd**2 * np.outer(high - low, high - low) / (2.0 * h) ** 2
    inverse = np.linalg.inv(wheel.jacobian(x)) / np.array(x)[:, None]
    return np.asarray(inverse @ covariance @ inverse.T)


def best_depth(covariance: Array, n: float) -> float:
    """Depth [m] at which the bearing pressure K_L z^n has the least relative variance."""
    return math.exp(-covariance[0, 2] / (covariance[2, 2] * n))


def bounds(covariance: Array, n: float, depth: float) -> Array:
    """Relative standard deviations (4,) of K_L, phi, n and of the bearing pressure at a depth [m]."""
    by_pressure = np.array([1.0, 0.0, n * math.log(depth)])
    variance = [*np.diag(covariance).tolist(), float(by_pressure @ covariance @ by_pressure)]
    return np.sqrt(variance)


def relative_errors(found: Array, truth: Unknowns, depth: float) -> Array:
    """Relative errors (N, 4) of K_L, phi, n and the bearing pressure at a depth [m], from soils (N, 3)."""
    true = np.array(truth)
    pressure = found[:, 0] / truth.K_L * depth ** (found[:, 2] - truth.n)
    return np.asarray(np.column_stack([found / true, pressure]) - 1.0)


def one_instant(trial: Trial, depth: float, noise: Noise, draws: int, seed: int) -> Array:
    """Soils (N, 3) from `draws` noisy instants at a sinkage [m]; N counts those that have any solution.

    Data and solver share the equations, so noise is all that is wrong; of several
    solutions the one nearest the truth counts.
    """
    rng = np.random.default_rng(seed)
    point, truth = trial.at(depth), trial.truth
    exact = np.array([*WheelEquations(point, EXACT).forces(truth), depth, point.slip])
    sd = np.array(noise) * np.array([*np.abs(exact[:3]), 1.0, 1.0])
    found: list[Unknowns] = []
    for W, DP, T, z, slip in (exact + sd * rng.standard_normal((draws, 5))).tolist():
        if 0.0 < z < trial.radius:
            ends = WheelEquations(trial.at(z, slip), EXACT).all_solutions(Forces(W, DP, T))
            found += sorted(ends, key=lambda end: abs(math.log(end.K_L / truth.K_L)))[:1]
    return np.array(found).reshape(-1, 3)


def windows_of(trial: Trial, depth: float, noise: Noise, windows: int, seed: int) -> Array:
    """Soils (N, 3) by our estimator from windows of noisy instants; N counts the fits that converged.

    Load +-30 % about that of the sinkage [m], slip 0.05 to 0.4; the shear law is the
    paper's, c and K are known.  The prior is half the truth, with a standard deviation as
    large as itself.
    """
    rng = np.random.default_rng(seed)
    model = WheelModel(shear_law="rational")
    rig, prior = _rig(trial, noise), _prior(trial)
    load, slip, pull, torque, z = _drive(trial, depth, model, INSTANTS)
    found = []
    for _ in range(windows):
        by_W, by_DP, by_T, by_z, by_slip = np.array(noise)[:, None] * rng.standard_normal((5, INSTANTS))
        samples = {
            "load.wheel": load * (1.0 + by_W), "draft": pull * (1.0 + by_DP), "torque.wheel": torque * (1.0 + by_T),
            "sinkage.wheel": z + by_z, "ground_speed": RIM_SPEED * (1.0 - slip - by_slip),
            "speed.wheel": np.full(INSTANTS, RIM_SPEED / trial.radius),
        }  # fmt: skip
        window = window_of_samples(rig, np.arange(INSTANTS, dtype=np.float64), samples)
        fit = fit_window(ObservationModel(window, rig, model, 0.1), prior)
        if fit is not None and fit.converged:
            soil = fit.posterior.soil
            found.append((lumped_modulus(soil.k_c, soil.k_phi, trial.width), soil.phi, soil.n))
    return np.array(found).reshape(-1, 3)


def _rig(trial: Trial, noise: Noise) -> Rig:
    """A test rig of one wheel whose sensors have this noise; its rim speed is known."""
    sensors = {
        "load": SensorNoise(relative=noise.W), "draft": SensorNoise(relative=noise.DP),
        "torque": SensorNoise(relative=noise.T), "sinkage": SensorNoise(absolute=noise.sinkage),
        "ground_speed": SensorNoise(absolute=noise.slip * RIM_SPEED), "speed": SensorNoise(absolute=1e-9),
        "pitch": SensorNoise(), "acceleration": SensorNoise(), "yaw_rate": SensorNoise(),
    }  # fmt: skip
    return Rig(("wheel",), np.array([trial.radius]), np.array([trial.width]), np.array([False]), None, sensors)


def _prior(trial: Trial) -> SoilPrior:
    """With one tyre width K_L is all k_phi."""
    truth = trial.truth
    guess = {"k_phi": truth.K_L / 2.0, "phi": truth.phi / 2.0, "n": truth.n / 2.0}
    held = {"k_c": (1.0, 0.0), "c": (trial.soil.c, 0.0), "K": (trial.soil.K, 0.0)}
    return SoilPrior.from_value_std(held | {name: (value, value) for name, value in guess.items()})


def _drive(trial: Trial, depth: float, model: WheelModel, instants: int) -> tuple[Array, Array, Array, Array, Array]:
    """Load, slip, drawbar pull, torque and sinkage (instants,) of an excited drive without noise."""
    truth, soil = trial.truth, trial.soil
    middle = WheelEquations(trial.at(depth), EXACT).forces(truth).W
    phase = 2.0 * np.pi * np.arange(instants) / instants
    load, slip = middle * (1.0 + 0.3 * np.sin(3.0 * phase)), 0.225 - 0.175 * np.cos(phase)
    state = WheelState(
        np.full(instants, 0.3), slip, trial.radius, trial.width, truth.K_L, truth.n, math.tan(truth.phi), soil.c, soil.K
    )
    angle = entry_angle_for_load(load, state, model)
    _, pull, torque = wheel_forces(state._replace(entry_angle=angle), model)
    return load, slip, pull, torque, np.asarray(sinkage(angle, trial.radius))
