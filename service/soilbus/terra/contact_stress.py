"""Stresses along a wheel's rim and what they add up to, with what changes them when the contact changes its shape.

Equations 5-9, 11-12 and 16 of Xi et al. 2024 at the nodes of terra.rim.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from soilbus.arrays import Array
from soilbus.terra.rim import (
    Rim,
    fixed_shares,
    gauss,
    on_branches,
    place_of_turn,
    rim_at,
    rim_of_fixed_shares,
    split_nodes,
)
from soilbus.terra.soil_laws import SHEAR_LAWS
from soilbus.terra.wheel_state import LONGEST, PEAK, WheelModel, WheelState


class Stress(NamedTuple):
    """Stresses at the nodes (2, M, N), front and rear branch, weighted for the integral.

    A field of normal stress P with one of shear stress Q adds P cos + Q sin to the load,
    Q cos - P sin to the drawbar pull and Q to the torque.  normal is the normal stress;
    the shear stress is tan_phi rubbed + c stuck; mobilising is its derivative by the
    displacement j_K over K.  steep is the derivative of normal by the logarithm of the
    depth, over n; with by_sill, steep log_z + by_sill is its derivative by n.
    """

    rim: Rim
    leave: Any
    share: Array
    weight: Array
    log_z: Array  # (M, N)
    normal: Array
    steep: Array
    by_sill: Array | None
    rubbed: Array
    stuck: Array
    shear_share: Array
    shear_slope: Array
    j_K: Array


def stresses(state: WheelState, model: WheelModel, skid: bool) -> Stress:
    """Return the stresses of the soil alone, without a hardpan."""
    theta, slip, r, _, K_L, n, _, _, K, _ = state
    q, exit_varies = model.quadrature, model.exit_angle or model.exit_slip
    if exit_varies:
        q = q._replace(exit=model.leave(theta, slip))
    if skid or model.peak_c2 or exit_varies:
        peak = model.peak(slip)
        x, w = gauss(q.nodes, q.power)
        if skid:
            x, w = split_nodes(place_of_turn(theta, slip, peak, q), q)
        share, weight = on_branches(x, w, peak, q.exit)
        rim = rim_at(theta, share, r / K)
    else:
        share, weight = fixed_shares.__wrapped__(q) if model.one_off else fixed_shares(q)
        rim = rim_of_fixed_shares(theta, q, r / K, model.one_off)
    log_z = np.log(r * rim.depth)
    normal = np.exp(n * log_z + np.log(K_L)) * weight  # the rear takes the front's stress (eqs. 5-9)
    j_K = slip * rim.travel
    j_K += rim.creep
    g, dg = mobilised(j_K, model)
    return Stress(rim, q.exit, share, weight, log_z, normal, normal, None, normal * g, weight * g, g, dg, j_K)


def peaking(slip: Array, model: WheelModel) -> Array:
    """Return the derivative (N,) by slip of the angle of greatest stress over the entry angle."""
    share = model.peak(slip)
    slope = model.peak_c2 * (1.0 + model.peak_bend) / (1.0 + model.peak_bend * np.abs(slip)) ** 2
    return np.where((share > PEAK[0]) & (share < PEAK[1]), slope, 0.0)


def leaving(theta: Array, slip: Array, model: WheelModel) -> tuple[Array, Array]:
    """Return the derivatives (N,) by entry angle and slip of the exit angle over the entry angle."""
    free = model.leave(theta, slip) > -LONGEST
    return np.where(free, -model.exit_angle / theta**2, 0.0), np.where(free & (slip > 0.0), model.exit_slip, 0.0)


def mobilised(j_K: Array, model: WheelModel) -> tuple[Any, Any]:
    """Return the mobilised share of the shear strength and its derivative by j/K."""
    share, slope = SHEAR_LAWS[model.shear_law](j_K)
    if not model.exponential_share:
        return share, slope
    w, (other, other_slope) = model.exponential_share, SHEAR_LAWS["exponential"](j_K)
    return (1.0 - w) * share + w * other, (1.0 - w) * slope + w * other_slope


def sheared(at: Stress, state: WheelState) -> tuple[Array, Array]:
    """Return the shear stress and its derivative by j/K."""
    tau = state.tan_phi * at.rubbed + state.c * at.stuck
    mobilising = state.tan_phi * at.normal
    mobilising += state.c * at.weight
    mobilising *= at.shear_slope
    return tau, mobilising


def entering(at: Stress, state: WheelState, tau: Array, mobilising: Array) -> tuple[Array, Array]:
    """Return the derivatives of the stresses by the entry angle, which also turns the nodes."""
    normal = at.steep * (state.n * at.rim.deepening)
    rate = state.slip * at.rim.travel_rate
    rate += at.rim.creep_rate
    rate *= mobilising
    shear = at.shear_share * normal
    shear *= state.tan_phi
    shear += rate
    shear -= at.share * at.normal
    normal += at.share * tau
    return normal, shear


def unit_of(state: WheelState) -> Array:
    """Return the factors (3, N) from an integral over shares of the entry angle to W, DP and T."""
    area = state.radius * state.width * state.entry_angle
    unit = np.empty((3, *area.shape))
    unit[:2] = area
    np.multiply(state.radius, area, out=unit[2])
    return unit


def integrals(fields: Array, n_normal: int, rim: Rim) -> Array:
    """Return what fields (F, 2, M, N), of normal stress first, then of shear, add to W, DP and T (3, F, N)."""
    along, across = np.einsum("fbmn,bmn->fn", fields, rim.cos), np.einsum("fbmn,bmn->fn", fields, rim.sin)
    out = np.empty((3, *along.shape))
    normal, shear = slice(n_normal), slice(n_normal, None)
    out[0, normal], out[0, shear] = along[normal], across[shear]
    out[1, normal], out[1, shear] = -across[normal], along[shear]
    out[2, normal] = 0.0
    fields[shear].sum(axis=(1, 2), out=out[2, shear])
    return out


def by_peak(at: Stress, state: WheelState, model: WheelModel, tau: Array, mobilising: Array) -> Array:
    """Return the derivatives (3, N) of the integrals by the angle of greatest stress over the entry angle."""
    rim, peak = at.rim, model.peak(state.slip)
    turn = state.entry_angle * (1.0 - at.share[0]) / (1.0 - peak)
    spread = np.stack([-1.0 / (1.0 - peak), np.broadcast_to(1.0 / (peak - at.leave), np.shape(peak))])[:, None]
    shallower = state.n * rim.sin[0] * turn / rim.depth
    normal = at.normal * spread - at.steep * shallower
    glide = state.radius / state.K * ((1.0 - state.slip) * rim.cos - 1.0)
    shear = state.tan_phi * at.shear_share * normal + mobilising * glide * turn + state.c * at.stuck * spread
    normal = normal + turn * tau
    whole = integrals(np.stack([normal, shear - turn * at.normal]), 1, rim).sum(axis=1)
    whole[2] = shear.sum((0, 1))  # a turn of the normal stress has no torque
    return np.asarray(whole)


def by_leave(at: Stress, state: WheelState, model: WheelModel, tau: Array, mobilising: Array) -> Array:
    """Return the derivatives (3, N) of the integrals by the exit angle over the entry angle."""
    sin, cos = at.rim.sin[1], at.rim.cos[1]
    length = model.peak(state.slip) - at.leave
    turn = state.entry_angle * (at.leave + length - at.share[1]) / length
    glide = state.radius / state.K * ((1.0 - state.slip) * cos - 1.0)
    normal = -at.normal[1] / length
    shear = mobilising[1] * glide * turn - tau[1] / length
    around = shear.sum(0)
    normal, shear = normal + turn * tau[1], shear - turn * at.normal[1]
    return np.stack([(normal * cos + shear * sin).sum(0), (shear * cos - normal * sin).sum(0), around])


def by_exponential_share(at: Stress, state: WheelState, model: WheelModel) -> Array:
    """Return the derivatives (3, N) of the integrals by the share of the strength that is mobilised exponentially."""
    more = SHEAR_LAWS["exponential"](at.j_K)[0] - SHEAR_LAWS[model.shear_law](at.j_K)[0]
    return integrals(((state.tan_phi * at.normal + state.c * at.weight) * more)[None], 0, at.rim)[:, 0]
