"""Inverse covariance of the residuals of every instant, by their structure.

Rows of an instant: torque of each wheel, the draft balance, then the sinkage of each
wheel where there are sensors.  A wheel's rows depend on its own load and speed, the
balance on those of all, and everything on the ground speed.  So the covariance is small
blocks by wheel, a border and a matrix of rank one, and two updates of rank one invert it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def inverse_covariance(A: Array, latent_var: Array, row_var: Array, n_wheels: int) -> Array:
    """(A V A' + R)^-1 (N, m, m) for A (N, m, 2 W + 1), V diagonal (N, 2 W + 1), R diagonal (N, m)."""
    W = n_wheels
    by_load, by_speed, by_ground = A[:, :, :W], A[:, :, W : 2 * W], A[:, :, 2 * W]
    # copies: what lies together is worked on several times as fast
    load_var, speed_var, ground_var = latent_var[:, :W].copy(), latent_var[:, W : 2 * W].copy(), latent_var[:, 2 * W]
    balance_load, balance_speed = by_load[:, W].copy(), by_speed[:, W].copy()

    def own(rows: slice) -> tuple[Array, Array]:
        """Derivatives (N, W) of each wheel's row by its own load and speed."""
        return diagonals(by_load[:, rows]).copy(), diagonals(by_speed[:, rows]).copy()

    load, speed = own(slice(W))
    load_weighed, speed_weighed = load * load_var, speed * speed_var
    torque = load * load_weighed + speed * speed_weighed + row_var[:, :W]
    torque_balance = load_weighed * balance_load + speed_weighed * balance_speed
    balance = (balance_load**2 * load_var + balance_speed**2 * speed_var).sum(1) + row_var[:, W]

    inverse = np.zeros((*row_var.shape, row_var.shape[1]))
    border = np.empty(row_var.shape)
    border[:, W] = -1.0
    if row_var.shape[1] > W + 1:
        z = slice(W + 1, None)
        z_load, z_speed = own(z)
        cross = load_weighed * z_load + speed_weighed * z_speed
        sinkage = z_load**2 * load_var + z_speed**2 * speed_var + row_var[:, z]
        sinkage_balance = z_load * load_var * balance_load + z_speed * speed_var * balance_speed
        determinant = torque * sinkage - cross**2
        torque_part, cross_part, sinkage_part = sinkage / determinant, -cross / determinant, torque / determinant
        border[:, :W] = torque_part * torque_balance + cross_part * sinkage_balance
        border[:, z] = sinkage_part * sinkage_balance + cross_part * torque_balance
        balance -= (sinkage_balance * border[:, z]).sum(1)
        diagonals(inverse[:, z, z])[:] = sinkage_part
        diagonals(inverse[:, :W, z])[:] = cross_part
        diagonals(inverse[:, z, :W])[:] = cross_part
    else:
        torque_part = 1.0 / torque
        border[:, :W] = torque_part * torque_balance
    balance -= (torque_balance * border[:, :W]).sum(1)
    diagonals(inverse[:, :W, :W])[:] = torque_part
    inverse += np.einsum("ni,nj->nij", border, border / balance[:, None])
    common = (inverse @ by_ground[:, :, None])[:, :, 0]
    share = ground_var / (1.0 + ground_var * np.einsum("ni,ni->n", by_ground, common))
    inverse -= np.einsum("ni,nj->nij", common, common * share[:, None])
    return inverse


def diagonals(blocks: Array) -> Array:
    """The diagonals (N, W) of blocks (N, W, W), writeable."""
    view = blocks.diagonal(axis1=1, axis2=2)
    view.flags.writeable = True  # numpy gives a view, for reading only
    return view
