"""What a stiffer layer below a depth, a hard pan, adds to the stresses along a wheel's rim.

Below it the pressure is stiffness K_L (z^n - depth^n) more than the soil's own, and with it
the friction; cohesion stays.  Its integrals run from where the rim reaches the pan, so that
those of the soil alone need no nodes of their own for it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from soilbus.arrays import Array
from soilbus.terra.contact_stress import Stress, integrals, mobilised
from soilbus.terra.rim import gauss, on_branches, place_of_depth, place_of_turn, rim_at, split_nodes
from soilbus.terra.wheel_state import WheelModel, WheelState

POWER, FEWER = 2, 2
"""Nodes cluster where the rim reaches the pan, as a shallow one's pressure bends most there; errors are as small as
those of the soil alone, with FEWER nodes less."""


def reaching(state: WheelState, model: WheelModel) -> NDArray[np.bool_]:
    """Return which wheels (N,) reach the pan with the angle of greatest stress."""
    return np.asarray(_start(state, model) < 1.0)


def pan_stresses(state: WheelState, model: WheelModel, skid: bool) -> Stress:
    """Return what the pan adds under wheels that reach it; leave cohesion out of the state."""
    theta, slip, r, _, K_L, n, _, _, K, _ = state
    q, peak, start = model.quadrature._replace(exit=model.leave(theta, slip)), model.peak(slip), _start(state, model)
    if skid:
        x, w = split_nodes(np.maximum(place_of_turn(theta, slip, peak, q), start), q, start)
    else:
        u, w = gauss(q.nodes - FEWER, POWER)
        x, w = start + (1.0 - start) * u, (1.0 - start) * w
    share, weight = on_branches(x, w, peak, q.exit)
    rim = rim_at(theta, share, r / K)
    log_z = np.log(r * rim.depth)
    scaled = model.pan_stiffness * K_L * weight
    steep, sill = scaled * np.exp(n * log_z), scaled * model.pan_depth**n
    normal = steep - sill
    j_K = slip * rim.travel
    j_K += rim.creep
    g, dg = mobilised(j_K, model)
    by_sill = -np.log(model.pan_depth) * sill
    nothing = np.zeros_like(normal)
    return Stress(rim, q.exit, share, weight, log_z, normal, steep, by_sill, normal * g, nothing, g, dg, j_K)


def by_pan(at: Stress, state: WheelState, model: WheelModel) -> tuple[Array, Array]:
    """Return the derivatives (3, N) by stiffness and by depth of what the pan adds to the integrals."""
    scaled, sill = state.K_L * at.weight, model.pan_depth**state.n
    stiffer = scaled * (np.exp(state.n * at.log_z) - sill)
    deeper = -model.pan_stiffness * state.n * sill / model.pan_depth * scaled
    rubbed = state.tan_phi * at.shear_share
    added = integrals(np.stack([stiffer, deeper, rubbed * stiffer, rubbed * deeper]), 2, at.rim)
    return added[:, 0] + added[:, 2], added[:, 1] + added[:, 3]


def _start(state: WheelState, model: WheelModel) -> Array:
    """Where on 0..1 (N,) the rim reaches the pan; 1 where it does not."""
    return place_of_depth(state.entry_angle, model.pan_depth / state.radius, model.peak(state.slip))
