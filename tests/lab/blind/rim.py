"""Stresses along the rim integrated once more, for any pressure-sinkage curve and any shape of the contact.

Written for the hidden effects, in plain sight: Wong & Reece's branches, Janosi and
Hanamoto's shear, Gauss-Legendre nodes at the square of the usual ones.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from soilbus.arrays import Array
from soilbus.terra.wheel import WheelState

_POINTS, _WEIGHTS = np.polynomial.legendre.leggauss(12)
_U = (_POINTS + 1.0) / 2.0
_X, _W = _U**2, _WEIGHTS * _U  # x = u^2 on 0..1

Pressure = Callable[[Any], Any]


def change(state: WheelState, **how: Any) -> Array:
    """What another contact (see `rim_forces`) adds to load, drawbar pull and torque: (3, ...)."""
    return rim_forces(state, **how) - rim_forces(state)


def rim_forces(
    state: WheelState,
    pressure: Pressure | None = None,
    peak: Any = 0.5,
    leave: Any = 0.0,
    sides: float = 0.0,
    tip: float = 0.0,
) -> Array:
    """Load [N], drawbar pull [N], torque [N m] (3, ...) of wheels in states that broadcast.

    pressure [Pa] of depth [m], Bekker's by default; the angle of greatest stress over the
    entry angle; the exit angle `leave` [rad]; the height [m] of lugs whose `sides` shear
    soil; how far [m] beyond the rim their `tip` shears it.
    """
    entry, slip, r, b, K_L, n, tan_phi, c, K = (np.asarray(a, float) for a in state[:9])
    carry = pressure or (lambda depth: K_L * depth**n)
    top = np.asarray(peak) * entry
    total = np.zeros((3, *np.broadcast_shapes(*(a.shape for a in (entry, slip, r, K_L, top, np.asarray(leave))))))
    for x, w in zip(_X, _W, strict=True):
        above = entry - x * (entry - top)
        depth = r * np.maximum(np.cos(above) - np.cos(entry), 0.0)
        sigma = carry(depth)  # the rear branch mirrors the front, stretched to its own length
        for angle, span in ((above, entry - top), (leave + x * (top - leave), top - leave)):
            j = (r + tip) * (entry - angle - (1.0 - slip) * (np.sin(entry) - np.sin(angle)))
            grip = np.sign(j) * -np.expm1(-np.abs(j) / K)
            tau = (c + sigma * tan_phi) * grip * b
            tau = tau + 2.0 * sides * (c + _AT_REST * sigma * tan_phi) * grip
            area = w * span * r
            total[0] += area * (sigma * b * np.cos(angle) + tau * np.sin(angle))
            total[1] += area * (tau * np.cos(angle) - sigma * b * np.sin(angle))
            total[2] += area * (r + tip) * tau
    return total


_AT_REST = 0.5
"""Pressure on the flanks of a lug over that under the wheel."""
