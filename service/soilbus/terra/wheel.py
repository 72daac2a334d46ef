"""One rigid wheel on soil: load, drawbar pull and torque with their derivatives.

Equations 20-22 of Xi et al. 2024 (Wong & Reece 1967), integrated by Gauss-Legendre
quadrature at the nodes of terra.rim.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from soilbus.terra.rim import (
    Quadrature,
    Rim,
    fixed_shares,
    gauss,
    on_branches,
    place_of_depth,
    place_of_turn,
    rim_at,
    rim_of_fixed_shares,
    split_nodes,
)
from soilbus.terra.stress import SHEAR_LAWS, Array, lumped_modulus

EXACT_NODES = 12
"""Gauss-Legendre nodes a branch: errors below 1e-6 of W (of T: W r) for n in 0.1..1.6, K
from 5 mm, entry angles up to 0.8 rad, slip -0.3 to 0.95; 2e-6 for rational shear in skid
(tests/terra/test_wheel.py)."""
FAST_NODES = 8
"""Enough for fits: below 5e-5 in the same ranges, far below any sensor's noise."""

MIN_ENTRY_ANGLE = 1e-4
MAX_ENTRY_ANGLE = 1.4
_CHUNK = 16384
"""Nodes of a branch that are integrated at once: all fields of so many stay in the processor's cache.  Short
of it small chunks cost twice as much, given that the allocator keeps its memory (soilbus.allocator)."""

LONGEST = 0.95
"""Share of the entry angle that the exit angle never exceeds behind the axle: no rut comes up all the way."""

FORCES = ("load", "drawbar_pull", "torque")
INPUTS = ("entry_angle", "slip", "K_L", "n", "tan_phi", "c", "K")


@dataclass(frozen=True, slots=True)
class WheelModel:
    """The choices that make a wheel-soil model.

    The angle of greatest stress is (peak_c1 + peak_c2 slip) times the entry angle (eq. 4),
    the exit angle exit_ratio times it and exit_angle [rad] more (0: the rut does not recover;
    behind the axle both are negative), but no farther behind than LONGEST times the entry
    angle.  exponential_share of the shear strength is mobilised by the exponential law
    whatever shear_law says.  From the depth pan_depth [m] on the pressure grows by
    pan_stiffness times what the soil alone would add (0: no hard pan).  one_off: a model
    whose shape no other call will share, so that nothing of it is kept.
    """

    shear_law: str = "exponential"
    peak_c1: float = 0.5
    peak_c2: float = 0.0
    exit_ratio: float = 0.0
    nodes: int = EXACT_NODES
    exponential_share: float = 0.0
    pan_depth: float = 0.0
    pan_stiffness: float = 0.0
    exit_angle: float = 0.0
    one_off: bool = False

    @property
    def quadrature(self) -> Quadrature:
        """Nodes for a wheel without slip."""
        return Quadrature(self.nodes, 3 if self.nodes >= EXACT_NODES else 2, self.peak_c1, self.exit_ratio)


class WheelState(NamedTuple):
    """What the forces of N wheel-instants depend on; floats or arrays that broadcast.

    entry_angle [rad], slip [-], radius and width [m], K_L [N/m^(n+2)], n [-],
    tan_phi [-], c [Pa], K [m].
    """

    entry_angle: Any
    slip: Any
    radius: Any
    width: Any
    K_L: Any
    n: Any
    tan_phi: Any
    c: Any
    K: Any


class Soil(NamedTuple):
    """Bekker-Mohr-Coulomb soil: k_c [N/m^(n+1)], k_phi [N/m^(n+2)], n, phi [rad], c [Pa], K [m]."""

    k_c: float
    k_phi: float
    n: float
    phi: float
    c: float
    K: float

    def bearing_pressure(self, z_ref: float, b_ref: float) -> float:
        """Pressure [Pa] that carries a plate of width b_ref [m] at the depth z_ref [m] (eq. 3)."""
        return float(lumped_modulus(self.k_c, self.k_phi, b_ref) * z_ref**self.n)


def state_on(soil: Soil, entry_angle: Any, slip: Any, radius: Any, width: Any) -> WheelState:
    """The wheel state of a wheel (radius, width [m]) on a soil."""
    K_L = lumped_modulus(soil.k_c, soil.k_phi, width)
    return WheelState(entry_angle, slip, radius, width, K_L, soil.n, np.tan(soil.phi), soil.c, soil.K)


def wheel_forces(state: WheelState, model: WheelModel) -> Array:
    """Load W [N], drawbar pull DP [N] and torque T [N m]: array (3, ...) (eqs. 20-22).

    The dots stand for the shape that the fields of `state` broadcast to.
    """
    return in_chunks(_forces, 3, state, model)


def wheel_forces_and_derivatives(state: WheelState, model: WheelModel) -> tuple[Array, Array]:
    """Forces (3, ...) and their exact derivatives (3, 7, ...) by INPUTS, radius and width held.

    Rows as FORCES, columns as INPUTS; units are those of force per unit of input.
    """
    both = in_chunks(_forces_and_jacobian, 3 + 3 * len(INPUTS), state, model)
    return both[:3], both[3:].reshape(3, len(INPUTS), *both.shape[1:])


def wheel_forces_and_slopes(state: WheelState, model: WheelModel) -> tuple[Array, Array]:
    """Forces (3, ...) and their exact derivatives (3, 2, ...) by entry angle and slip; cheaper than by all inputs."""
    both = in_chunks(_forces_and_slopes, 9, state, model)
    return both[:3], both[3:].reshape(3, 2, *both.shape[1:])


def sinkage(entry_angle: Any, radius: Any) -> Any:
    """Sinkage [m] of a wheel with this entry angle [rad] (eq. 1)."""
    return radius * (1.0 - np.cos(entry_angle))


def in_chunks(
    integrate: Callable[[WheelState, WheelModel, bool], Array], n_rows: int, state: WheelState, model: WheelModel
) -> Array:
    """(n_rows, ...) of an integrator of samples, which gets the state as rows (N,) or floats, and whether they skid."""
    shape = np.broadcast(*state).shape
    n_samples = math.prod(shape)
    fields = [np.asarray(a, float) for a in state]
    rows = WheelState(*(
        (a if a.shape == shape else np.broadcast_to(a, shape)).reshape(n_samples)
        if a.ndim or i < 2 else float(a)  # entry angle and slip always by sample
        for i, a in enumerate(fields)
    ))  # fmt: skip
    skid, chunk = rows.slip < 0.0, max(_CHUNK // model.nodes, 1)
    out = np.empty((n_rows, n_samples))
    if not skid.any():
        if n_samples <= chunk:
            return integrate(rows, model, False).reshape(n_rows, *shape)
        for i in range(0, n_samples, chunk):
            run = slice(i, i + chunk)
            out[:, run] = integrate(_samples(rows, run), model, False)
        return out.reshape(n_rows, *shape)
    for skidding in (False, True):  # skidding wheels need split panels
        members = np.flatnonzero(skid == skidding)
        for i in range(0, len(members), chunk):
            index = members[i : i + chunk]
            out[:, index] = integrate(_samples(rows, index), model, skidding)
    return out.reshape(n_rows, *shape)


def _samples(rows: WheelState, chosen: slice | NDArray[np.intp]) -> WheelState:
    """Some samples of fields that are (N,) or floats."""
    return WheelState(*(a if isinstance(a, float) else a[chosen] for a in rows))


class _Stress(NamedTuple):
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


def _stress(state: WheelState, model: WheelModel, skid: bool) -> _Stress:
    theta, slip, r, _, K_L, n, _, _, K = state
    q = model.quadrature
    if model.exit_angle:
        q = q._replace(exit=_leave(theta, model))
    if skid or model.peak_c2 or model.pan_stiffness or model.exit_angle:
        peak = np.asarray(model.peak_c1 + model.peak_c2 * slip)
        splits = [place_of_turn(theta, slip, peak, q)] if skid else []
        if model.pan_stiffness:
            splits.append(place_of_depth(theta, model.pan_depth / r, peak))
        x, w = split_nodes(splits, q) if splits else gauss(q.nodes, q.power)
        share, weight = on_branches(x, w, peak, q.exit)
        rim = rim_at(theta, share, r / K)
    else:
        share, weight = fixed_shares.__wrapped__(q) if model.one_off else fixed_shares(q)
        rim = rim_of_fixed_shares(theta, q, r / K, model.one_off)
    log_z = np.log(r * rim.depth)
    sigma = np.exp(n * log_z + np.log(K_L))  # the rear takes the front's stress (eqs. 5-9)
    normal = steep = sigma * weight
    by_sill = None
    if model.pan_stiffness:
        below = r * rim.depth > model.pan_depth
        sill = model.pan_stiffness * K_L * model.pan_depth**n * below * weight
        steep = normal * (1.0 + model.pan_stiffness * below)
        normal = steep - sill
        by_sill = -sill * np.log(max(model.pan_depth, 1e-300))
    j_K = slip * rim.travel
    j_K += rim.creep
    g, dg = _mobilised(j_K, model)
    return _Stress(rim, q.exit, share, weight, log_z, normal, steep, by_sill, normal * g, weight * g, g, dg, j_K)


def _leave(theta: Array, model: WheelModel) -> Array:
    """Exit angle over entry angle (N,)."""
    return np.maximum(model.exit_ratio + model.exit_angle / theta, -LONGEST)


def _leaving(theta: Array, model: WheelModel) -> Array:
    """Its derivative (N,) by the entry angle."""
    return np.where(_leave(theta, model) > -LONGEST, -model.exit_angle / theta**2, 0.0)


def _mobilised(j_K: Array, model: WheelModel) -> tuple[Any, Any]:
    """Mobilised share of the shear strength and its derivative by j/K."""
    share, slope = SHEAR_LAWS[model.shear_law](j_K)
    if not model.exponential_share:
        return share, slope
    w, (other, other_slope) = model.exponential_share, SHEAR_LAWS["exponential"](j_K)
    return (1.0 - w) * share + w * other, (1.0 - w) * slope + w * other_slope


def _shear(at: _Stress, state: WheelState) -> tuple[Array, Array]:
    """Shear stress and its derivative by j/K."""
    tau = state.tan_phi * at.rubbed + state.c * at.stuck
    mobilising = state.tan_phi * at.normal
    mobilising += state.c * at.weight
    mobilising *= at.shear_slope
    return tau, mobilising


def _entering(at: _Stress, state: WheelState, tau: Array, mobilising: Array) -> tuple[Array, Array]:
    """Fields by the entry angle: stresses grow, and the nodes turn with it.  The torque wants Q + share normal."""
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


def _unit(state: WheelState) -> Array:
    """What turns an integral over shares of the entry angle into W, DP and T (3, N)."""
    area = state.radius * state.width * state.entry_angle
    return np.asarray(np.stack([area, area, state.radius * area]))


def _dot(field: Array, rows: Array) -> Array:
    return np.asarray(np.einsum("bmn,bmn->n", field, rows))


def load_and_slope(state: WheelState, model: WheelModel, skid: bool) -> Array:
    """Load and its derivative by the entry angle (2, N)."""
    at = _stress(state, model, skid)
    tau, mobilising = _shear(at, state)
    normal, shear = _entering(at, state, tau, mobilising)
    sin, cos = at.rim.sin, at.rim.cos
    load = _dot(at.normal, cos) + _dot(tau, sin)
    slope = _dot(normal, cos) + _dot(shear, sin) + load / state.entry_angle
    if model.exit_angle:
        slope = slope + _leaving(state.entry_angle, model) * _by_leave(at, state, model, tau, mobilising)[0]
    return np.asarray(np.stack([load, slope]) * (state.radius * state.width * state.entry_angle))


def _forces(state: WheelState, model: WheelModel, skid: bool) -> Array:
    """W, DP and T (3, N)."""
    at = _stress(state, model, skid)
    normal, rubbed, stuck = _integrals(np.stack([at.normal, at.rubbed, at.stuck]), 1, at.rim).swapaxes(0, 1)
    return _unit(state) * _whole(normal, rubbed, stuck, state)


def _integrals(fields: Array, n_normal: int, rim: Rim) -> Array:
    """What fields (F, 2, M, N), the first few of normal stress and the rest of shear, add to W, DP and T (3, F, N)."""
    along, across = (np.einsum("fbmn,bmn->fn", fields, rows) for rows in (rim.cos, rim.sin))
    out = np.empty((3, *along.shape))
    normal, shear = slice(n_normal), slice(n_normal, None)
    out[0, normal], out[0, shear] = along[normal], across[shear]
    out[1, normal], out[1, shear] = -across[normal], along[shear]
    out[2, normal] = 0.0
    fields[shear].sum(axis=(1, 2), out=out[2, shear])
    return out


def _whole(by_normal: Array, by_rubbed: Array, by_stuck: Array, state: WheelState) -> Array:
    """Integrals (3, N) of the stresses from those of the normal, the rubbed and the stuck part."""
    return np.asarray(by_normal + (state.tan_phi * by_rubbed + state.c * by_stuck))


def _forces_and_jacobian(state: WheelState, model: WheelModel, skid: bool) -> Array:
    """W, DP and T and their derivatives by INPUTS (3 + 21, N)."""
    at = _stress(state, model, skid)
    tau, mobilising = _shear(at, state)
    fields = np.empty((9, *at.normal.shape))
    fields[0], fields[3], fields[4] = at.normal, at.rubbed, at.stuck
    np.multiply(at.steep, at.log_z, out=fields[1])
    if at.by_sill is not None:
        fields[1] += at.by_sill
    fields[2], fields[5] = _entering(at, state, tau, mobilising)
    np.multiply(at.shear_share, fields[1], out=fields[6])
    np.multiply(mobilising, at.rim.travel, out=fields[7])
    np.multiply(mobilising, at.j_K, out=fields[8])
    by_normal, deeper, pressed, by_rubbed, by_stuck, turned, rubbed_deeper, by_slip, by_K = _integrals(
        fields, 3, at.rim
    ).swapaxes(0, 1)
    turned[2] += _dot(at.normal, np.broadcast_to(at.share, at.normal.shape))
    if model.peak_c2:
        by_slip = by_slip + model.peak_c2 * _by_peak(at, state, model, tau, mobilising)
    if model.exit_angle:
        turned += _leaving(state.entry_angle, model) * _by_leave(at, state, model, tau, mobilising)
    whole, unit = _whole(by_normal, by_rubbed, by_stuck, state), _unit(state)
    columns = (
        pressed + turned + whole / state.entry_angle,
        by_slip,
        (by_normal + state.tan_phi * by_rubbed) / state.K_L,
        deeper + state.tan_phi * rubbed_deeper,
        by_rubbed,
        by_stuck,
        by_K / -state.K,
    )
    out = np.empty((3 + 3 * len(INPUTS), len(state.entry_angle)))
    np.multiply(unit, whole, out=out[:3])
    jacobian = out[3:].reshape(3, len(INPUTS), -1)
    for column, derivative in enumerate(columns):
        np.multiply(unit, derivative, out=jacobian[:, column])
    return out


def _forces_and_slopes(state: WheelState, model: WheelModel, skid: bool) -> Array:
    """W, DP and T and their derivatives by entry angle and slip (3 + 6, N)."""
    at = _stress(state, model, skid)
    tau, mobilising = _shear(at, state)
    fields = np.empty((5, *at.normal.shape))
    fields[0], fields[2] = at.normal, tau
    fields[1], fields[3] = _entering(at, state, tau, mobilising)
    np.multiply(mobilising, at.rim.travel, out=fields[4])
    pressing, pressed, rubbing, turned, by_slip = _integrals(fields, 2, at.rim).swapaxes(0, 1)
    turned[2] += _dot(at.normal, np.broadcast_to(at.share, at.normal.shape))
    if model.peak_c2:
        by_slip = by_slip + model.peak_c2 * _by_peak(at, state, model, tau, mobilising)
    if model.exit_angle:
        turned += _leaving(state.entry_angle, model) * _by_leave(at, state, model, tau, mobilising)
    whole, unit = pressing + rubbing, _unit(state)
    out = np.empty((9, len(state.entry_angle)))
    np.multiply(unit, whole, out=out[:3])
    slopes = out[3:].reshape(3, 2, -1)
    np.multiply(unit, pressed + turned + whole / state.entry_angle, out=slopes[:, 0])
    np.multiply(unit, by_slip, out=slopes[:, 1])
    return out


def _by_peak(at: _Stress, state: WheelState, model: WheelModel, tau: Array, mobilising: Array) -> Array:
    """Derivatives (3, N) of the integrals by the ratio of the angle of greatest stress to the entry angle."""
    rim, peak = at.rim, model.peak_c1 + model.peak_c2 * state.slip
    turn = state.entry_angle * (1.0 - at.share[0]) / (1.0 - peak)
    spread = np.stack([-1.0 / (1.0 - peak), np.broadcast_to(1.0 / (peak - at.leave), np.shape(peak))])[:, None]
    shallower = state.n * rim.sin[0] * turn / rim.depth
    normal = at.normal * spread - at.steep * shallower
    glide = state.radius / state.K * ((1.0 - state.slip) * rim.cos - 1.0)
    shear = state.tan_phi * at.shear_share * normal + mobilising * glide * turn + state.c * at.stuck * spread
    normal = normal + turn * tau
    around = shear.sum((0, 1))
    shear = shear - turn * at.normal
    load = _dot(normal, rim.cos) + _dot(shear, rim.sin)
    return np.stack([load, _dot(shear, rim.cos) - _dot(normal, rim.sin), around])


def _by_leave(at: _Stress, state: WheelState, model: WheelModel, tau: Array, mobilising: Array) -> Array:
    """Derivatives (3, N) of the integrals by the ratio of the exit angle to the entry angle: of the rear branch."""
    sin, cos = at.rim.sin[1], at.rim.cos[1]
    length = model.peak_c1 + model.peak_c2 * state.slip - at.leave
    turn = state.entry_angle * (at.leave + length - at.share[1]) / length
    glide = state.radius / state.K * ((1.0 - state.slip) * cos - 1.0)
    normal = -at.normal[1] / length
    shear = mobilising[1] * glide * turn - tau[1] / length
    around = shear.sum(0)
    normal, shear = normal + turn * tau[1], shear - turn * at.normal[1]
    return np.stack([(normal * cos + shear * sin).sum(0), (shear * cos - normal * sin).sum(0), around])
