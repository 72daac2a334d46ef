"""Linear least squares for cohesion and friction angle.

Iagnemma, Kang, Shibly & Dubowsky 2004 (IEEE Trans. Robot. 20:921); Kang 2003 (thesis, MIT).
Assumes: normal and shear stress are triangles over the contact angle, zero at entry and
exit, greatest half way; the peak shear stress obeys Mohr-Coulomb and Janosi-Hanamoto; K is
known; load, torque, slip and sinkage of each wheel are measured.  Bekker's law is not
needed.  No error bars.  Derived here from those assumptions.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from soilbus.arrays import Array
from soilbus.estimation.posterior import Estimate
from soilbus.terra.soil_laws import shear_displacement
from tests.lab.peers.windows import Answer, Case, entry_angles


def estimate(case: Case) -> Answer | None:
    """Every wheel at every instant is one linear equation for c and tan phi."""
    p = case.problem
    return solve(p.load, p.torque, entry_angles(p), p.slip, p.rig.radius, p.rig.width, case.known.K)


def solve(load: Array, torque: Array, angle: Array, slip: Array, radius: Any, width: Any, K: float) -> Answer:
    """Cohesion and friction angle from load [N], torque [N m], entry angle [rad] and slip, (N, W) each."""
    # A triangle of height 1 over 0..angle, times the cosine and the sine of the contact angle:
    along = 2.0 / angle * (2.0 * np.cos(angle / 2.0) - np.cos(angle) - 1.0)
    across = 2.0 / angle * (2.0 * np.sin(angle / 2.0) - np.sin(angle))
    shear = 2.0 * torque / (radius**2 * width * angle)
    normal = (load / (radius * width) - shear * across) / along
    mobilised = -np.expm1(-shear_displacement(angle, angle / 2.0, slip, radius) / K)
    # shear = mobilised (c + normal tan phi), over mobilised normal as in the paper
    columns = np.stack([1.0 / normal.ravel(), np.ones(normal.size)], axis=1)
    (c, tan_phi), *_ = np.linalg.lstsq(columns, (shear / mobilised / normal).ravel(), rcond=None)
    return {"c": Estimate(float(c), np.nan), "phi": Estimate(float(np.arctan(tan_phi)), np.nan)}
