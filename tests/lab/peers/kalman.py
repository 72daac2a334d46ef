"""Adaptive robust extended Kalman filter for friction angle and sinkage exponent.

Li, Ding, Zheng, Yang, Zhao & Liu 2018 (Mech. Syst. Signal Process. 104:758).  Assumes: all
other parameters fixed at nominal values; load, torque, slip and sinkage of each wheel and
the drawbar pull are measured.  The paper's text was not at hand: robust and adaptive parts
are those of Yang, He & Xu 2001 (J. Geodesy 75:109): large innovations are down-weighted
(Huber), and the predicted covariance is inflated where innovations exceed it.  The noise of
sinkage and slip sensors is propagated into that of the readings.  Error bars: the filter's
covariance.
"""

from __future__ import annotations

import numpy as np

from soilbus.arrays import Array
from soilbus.estimation.observation_model import ObservationModel
from soilbus.estimation.posterior import PARAMETERS, Estimate
from soilbus.terra.soil_laws import lumped_modulus
from soilbus.terra.wheel import Soil, WheelState, wheel_forces_and_derivatives
from tests.lab.peers.windows import B_REF, Z_REF, Answer, Case, bearing_pressure, entry_angles, fit_model

WALK = np.array([1e-4, 2e-4])
"""Sd of the random walk of phi [rad] and n from one instant to the next."""
LOW, HIGH = np.array([0.02, 0.05]), np.array([1.2, 2.5])
HUBER = 2.0
MEMORY = 0.95


def estimate(case: Case) -> Answer | None:
    """The state after the window's last instant, started from the prior."""
    of_phi, of_n = PARAMETERS.index("phi"), PARAMETERS.index("n")
    index = [of_phi, of_n]
    x = case.prior.median[index]
    P = np.diag((x * case.prior.log_std[index]) ** 2)
    predicted = 1.0
    for i in range(case.problem.n):
        P = P + np.diag(WALK**2)
        innovation, H, R = _reading(case.problem, i, case.known, x)
        x, P, predicted = _updated(x, P, innovation, H, R, predicted)
        x = np.clip(x, LOW, HIGH)
        if not np.isfinite(x).all():
            return None
    phi, n = x.tolist()
    std_phi, std_n = np.sqrt(np.diag(P)).tolist()
    pressure = bearing_pressure(lumped_modulus(case.known.k_c, case.known.k_phi, B_REF), n)
    spread = float(pressure.value * abs(np.log(Z_REF)) * std_n)
    return {"phi": Estimate(phi, std_phi), "n": Estimate(n, std_n), "bearing": Estimate(pressure.value, spread)}


def _reading(problem: ObservationModel, i: int, known: Soil, x: Array) -> tuple[Array, Array, Array]:
    """Innovation (2 W + 1,) of loads, torques and pull, its slopes by phi and n, and the noise's covariance."""
    rig, angle, W = problem.rig, entry_angles(problem)[i], problem.n_wheels
    K_L = lumped_modulus(known.k_c, known.k_phi, rig.width)
    tan_phi = np.tan(x[0])
    state = WheelState(angle, problem.slip[i], rig.radius, rig.width, K_L, x[1], tan_phi, known.c, known.K)
    (load, pull, torque), by = wheel_forces_and_derivatives(WheelState(*np.broadcast_arrays(*state)), fit_model())
    seen = np.concatenate([problem.load[i], problem.torque[i], [problem.demand[i]]])
    innovation = seen - np.concatenate([load, torque, [pull.sum()]])

    def rows(column: int) -> Array:
        """Of loads, torques and pull by each wheel's own input (2 W + 1, W)."""
        return np.concatenate([np.diag(by[0, column]), np.diag(by[2, column]), by[1, column][None]])

    H = np.stack([rows(4).sum(1) * (1.0 + tan_phi**2), rows(3).sum(1)], axis=1)
    angle_var = problem.sinkage_var[i] / (rig.radius * np.sin(angle)) ** 2
    rolled = (1.0 - problem.slip[i]) ** 2
    load_var, speed_var, (ground_var,) = np.split(problem.variances(np.zeros(len(problem.gain_std)))[0][i], [W, 2 * W])
    speeds = speed_var / problem.speed[i] ** 2 + ground_var / problem.ground_speed[i] ** 2
    own = np.concatenate([load_var, problem.torque_var[i], [problem.demand_var[i]]])
    R = np.diag(own) + (rows(0) * angle_var) @ rows(0).T + (rows(1) * rolled * speeds) @ rows(1).T
    return innovation, H, R


def _updated(x: Array, P: Array, innovation: Array, H: Array, R: Array, level: float) -> tuple[Array, Array, float]:
    """State, covariance and the running level of the innovations' size after one reading."""
    root = np.linalg.cholesky(R)
    d, H = np.linalg.solve(root, innovation), np.linalg.solve(root, H)
    size = np.abs(d) / np.sqrt(1.0 + np.einsum("ij,jk,ik->i", H, P, H))
    weight = np.sqrt(np.minimum(1.0, HUBER / np.maximum(size, 1e-12)))
    level = MEMORY * level + (1.0 - MEMORY) * float(np.mean((weight * size) ** 2))
    P = P * max(1.0, level)
    d, H = weight * d, weight[:, None] * H
    S = H @ P @ H.T + np.eye(len(d))
    gain = np.linalg.solve(S, H @ P).T
    keep = np.eye(len(x)) - gain @ H
    return x + gain @ d, keep @ P @ keep.T + gain @ gain.T, level
