"""Newton-Raphson for friction angle, shear modulus K and lumped pressure-sinkage modulus.

Hutangkabodee, Zweiri, Seneviratne & Althoefer 2006 (ICRA, p. 3356).  Assumes: c and n are
known; load, torque, slip and sinkage of each wheel and the drawbar pull are measured, the
sinkage without error.  The paper integrates by the composite Simpson rule; ours is used
here, which can only help.  With more readings than unknowns a Newton-Raphson step becomes
a least-squares (Gauss-Newton) step on relative misfits; undamped, as there.  Each tyre
width has its own lumped modulus; only the pull of all wheels together is known on a
tractor.  No error bars.
"""

from __future__ import annotations

import numpy as np

from soilbus.arrays import Array, Indices
from soilbus.estimation.observation_model import ObservationModel
from soilbus.estimation.posterior import Estimate
from soilbus.terra.wheel import Soil, WheelState, wheel_forces_and_derivatives
from tests.lab.peers.windows import B_REF, Answer, Case, bearing_pressure, entry_angles, fit_model

MAX_STEPS = 50
CONVERGED = 1e-8


def estimate(case: Case) -> Answer | None:
    """From the prior's median; None where the steps do not settle at positive values."""
    problem, start = case.problem, Soil(*case.prior.median.tolist())
    widths, tyre = np.unique(problem.rig.width, return_inverse=True)
    x = np.array([np.tan(start.phi), start.K, *(start.k_c / widths + start.k_phi)])
    for _ in range(MAX_STEPS):
        residual, jacobian = _relative_misfit(problem, case.known, x, tyre)
        if not (np.isfinite(residual).all() and np.isfinite(jacobian).all()):
            return None
        step = np.linalg.lstsq(jacobian * x, -residual, rcond=None)[0]
        x = x * (1.0 + step)
        if np.any(x <= 0.0):
            return None
        if np.abs(step).max() < CONVERGED:
            break
    else:
        return None
    K_L = float(np.interp(1.0 / B_REF, 1.0 / widths[::-1], x[2:][::-1]))  # linear in 1/b (eq. 35)
    return {
        "phi": Estimate(float(np.arctan(x[0])), np.nan),
        "K": Estimate(float(x[1]), np.nan),
        "bearing": bearing_pressure(K_L, case.known.n),
    }


def _relative_misfit(problem: ObservationModel, known: Soil, x: Array, tyre: Indices) -> tuple[Array, Array]:
    """Model less reading over reading, of loads, torques and the pull, and derivatives by the unknowns."""
    rig, shape = problem.rig, problem.load.shape
    K_L = np.broadcast_to(x[2:][tyre], shape)
    state = WheelState(
        entry_angles(problem), problem.slip, rig.radius, rig.width, K_L, known.n, x[0], known.c, x[1]
    )  # fmt: skip
    with np.errstate(all="ignore"):
        force, by = wheel_forces_and_derivatives(WheelState(*np.broadcast_arrays(*state)), fit_model())
    own = (tyre == np.arange(len(x) - 2)[:, None])[:, None, :]  # which modulus is whose
    by = np.concatenate([by[:, [4, 6]], by[:, 2][:, None] * own], axis=1)  # (3, unknowns, N, W)
    total = np.broadcast_to(problem.load.sum(1), (len(problem.load),))
    size = (problem.load, rig.radius * problem.load, total)
    miss = (force[0] - problem.load, force[2] - problem.torque, force[1].sum(1) - problem.demand)
    slopes = (by[0], by[2], by[1].sum(-1))
    residual = np.concatenate([(m / s).ravel() for m, s in zip(miss, size, strict=True)])
    jacobian = np.concatenate([(d / s).reshape(len(x), -1) for d, s in zip(slopes, size, strict=True)], axis=1)
    return residual, jacobian.T
