"""One rigid wheel on soil: load, drawbar pull and torque with their derivatives.

Equations 20-22 of Xi et al. 2024 (Wong & Reece 1967), integrated by Gauss-Legendre
quadrature.  Both stress branches share one coordinate x: 0 where the branch starts to
carry (entry or exit angle), 1 at the angle of greatest stress.  Nodes lie at a power of
the Gauss points, which tames the x**n singularity of the normal stress for any n > 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from soilbus.terra.stress import SHEAR_LAWS, Array, lumped_modulus

EXACT_NODES = 12
"""Gauss-Legendre nodes a branch: errors below 1e-6 of W (of T: W r) for n in 0.1..1.6, K
from 5 mm, entry angles up to 0.8 rad, slip -0.3 to 0.95; 2e-6 for rational shear in skid
(tests/terra/test_wheel.py)."""
FAST_NODES = 8
"""Enough for fits: below 5e-5 in the same ranges, far below any sensor's noise."""

MIN_ENTRY_ANGLE = 1e-4
MAX_ENTRY_ANGLE = 1.4
_CHUNK = 8192

FORCES = ("load", "drawbar_pull", "torque")
INPUTS = ("entry_angle", "slip", "K_L", "n", "tan_phi", "c", "K")


@dataclass(frozen=True, slots=True)
class WheelModel:
    """The choices that make a wheel-soil model.

    The angle of greatest stress is (peak_c1 + peak_c2 slip) times the entry angle (eq. 4),
    the exit angle exit_ratio times it (0: the rut does not recover).
    """

    shear_law: str = "exponential"
    peak_c1: float = 0.5
    peak_c2: float = 0.0
    exit_ratio: float = 0.0
    nodes: int = EXACT_NODES


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
    return _in_chunks(state, model, derivatives=False)[0]


def wheel_forces_and_derivatives(state: WheelState, model: WheelModel) -> tuple[Array, Array]:
    """Forces (3, ...) and their exact derivatives (3, 7, ...) by INPUTS, radius and width held.

    Rows as FORCES, columns as INPUTS; units are those of force per unit of input.
    """
    return _in_chunks(state, model, derivatives=True)


def sinkage(entry_angle: Any, radius: Any) -> Any:
    """Sinkage [m] of a wheel with this entry angle [rad] (eq. 1)."""
    return radius * (1.0 - np.cos(entry_angle))


def entry_angle_for_load(load: Any, state: WheelState, model: WheelModel, tolerance: float = 1e-12) -> Array:
    """Entry angle [rad], in the broadcast shape, at which the soil carries the load [N].

    Newton on logarithms, where the curve is nearly straight, inside a bracket that
    bisection shrinks whenever Newton leaves it.  state.entry_angle is the first guess
    where it is finite and positive.  A load that no angle up to MAX_ENTRY_ANGLE carries
    (wheel buried), or that is not a positive number, gives nan.
    """
    load, *fields = (np.asarray(a, float) for a in np.broadcast_arrays(load, *state))
    shape = load.shape
    load, *fields = (a.ravel() for a in (load, *fields))
    guess, rest = fields[0], fields[1:]
    low = np.full(load.shape, np.log(MIN_ENTRY_ANGLE))
    high = np.full(load.shape, np.log(MAX_ENTRY_ANGLE))
    usable = np.isfinite(load) & (load > 0.0)
    target = np.log(np.where(usable, load, 1.0))
    with np.errstate(all="ignore"):
        at = np.where((guess > 0.0) & np.isfinite(guess), np.log(np.abs(guess)), _first_guess(load, *rest[1:5]))
    at = np.clip(np.where(np.isfinite(at), at, np.log(0.3)), low, high)
    todo = np.flatnonzero(usable)
    for _ in range(80):
        if not len(todo):
            break
        part = WheelState(np.exp(at[todo]), *(f[todo] for f in rest))
        W, slope = _load_and_slope(part, model)
        miss = np.where(W > 0.0, np.log(np.maximum(W, 1e-300)), -690.0) - target[todo]
        above = miss > 0.0
        high[todo] = np.where(above, at[todo], high[todo])
        low[todo] = np.where(above, low[todo], at[todo])
        with np.errstate(all="ignore"):
            step = at[todo] - miss / (slope * part.entry_angle / W)
        inside = (step > low[todo]) & (step < high[todo]) & (W > 0.0)
        new = np.where(inside, step, (low[todo] + high[todo]) / 2.0)
        done = (np.abs(miss) < tolerance) | (high[todo] - low[todo] < 1e-14)
        at[todo] = np.where(np.abs(miss) < tolerance, at[todo], new)
        todo = todo[~done]
    angle = np.exp(at)
    angle[~usable | (at > np.log(MAX_ENTRY_ANGLE) - 1e-9)] = np.nan
    return angle.reshape(shape)


def _first_guess(load: Array, radius: Array, width: Array, K_L: Array, n: Array) -> Array:
    """log entry angle from the small-angle load K_L b r^(n+1) theta^(2n+1) / (n + 1.5)."""
    scale = 0.6 * width * K_L * radius ** (n + 1.0)
    return np.asarray(np.log(load * (n + 1.5) / scale) / (2.0 * n + 1.0))


def _load_and_slope(state: WheelState, model: WheelModel) -> tuple[Array, Array]:
    forces, jacobian = _in_chunks(state, model, derivatives=True, only_entry_angle=True)
    return forces[0], jacobian[0, 0]


def _in_chunks(
    state: WheelState, model: WheelModel, *, derivatives: bool, only_entry_angle: bool = False
) -> tuple[Array, Array]:
    shape = np.broadcast_shapes(*(np.shape(a) for a in state))
    n_samples = int(np.prod(shape, dtype=int))
    rows = WheelState(*(
        np.broadcast_to(a, shape).reshape(n_samples)
        if np.ndim(a) or i < 2 else float(a)  # entry angle and slip always by sample
        for i, a in enumerate(state)
    ))  # fmt: skip
    forces = np.empty((3, n_samples))
    n_inputs = 1 if only_entry_angle else len(INPUTS)
    jacobian = np.empty((3, n_inputs, n_samples if derivatives else 0))
    for index in _groups(rows.slip, n_samples):
        part = WheelState(*(a[index] if np.ndim(a) else a for a in rows))
        skid = bool(np.min(part.slip, initial=0.0) < 0.0)
        forces[:, index], d = _integrate(part, model, skid, derivatives, only_entry_angle)
        if derivatives:
            jacobian[:, :, index] = d
    return forces.reshape(3, *shape), jacobian.reshape(3, n_inputs, *shape) if derivatives else jacobian


def _groups(slip: Array, n_samples: int) -> list[Any]:
    """Index chunks, driven wheels apart from skidding ones, which need split panels."""
    skid = slip < 0.0
    if not skid.any():
        return [slice(i, i + _CHUNK) for i in range(0, n_samples, _CHUNK)]
    groups = []
    for members in (np.flatnonzero(~skid), np.flatnonzero(skid)):
        groups += [members[i : i + _CHUNK] for i in range(0, len(members), _CHUNK)]
    return groups


@cache
def _gauss(nodes: int, power: int) -> tuple[Array, Array]:
    """Gauss points on 0..1 clustered towards 0 by a power, and their weights; columns."""
    u, w = np.polynomial.legendre.leggauss(nodes)
    u, w = (u[:, None] + 1.0) / 2.0, w[:, None] / 2.0
    return u**power, w * power * u ** (power - 1)


def _nodes(state: WheelState, rho: Any, model: WheelModel, skid: bool) -> tuple[Array, Array]:
    """Nodes x and weights on 0..1, (M, 1); in skid (2 M + 4, N), split where shear changes sign."""
    if not skid:
        return _gauss(model.nodes, 3 if model.nodes >= EXACT_NODES else 2)
    x, xw = _gauss(model.nodes + 2, 3)  # shear is steep where it changes sign
    u, w = _gauss(model.nodes + 2, 2)  # the branch may start just before the split
    turn = _turning_angle(state, model.exit_ratio)
    theta = state.entry_angle
    front = (theta - turn) / (theta * (1.0 - rho))
    rear = (turn - model.exit_ratio * theta) / (theta * (rho - model.exit_ratio))
    split = np.clip(np.where(turn > rho * theta, front, rear), 0.0, 1.0)
    split = np.where(np.isfinite(turn), split, 1.0)
    x = np.concatenate([split * x, split + (1.0 - split) * u])
    return x, np.concatenate([split * xw, (1.0 - split) * w])


def _turning_angle(state: WheelState, exit_ratio: float) -> Array:
    """Angle where the shear displacement of a skidding wheel is back at zero; nan if nowhere."""
    entry, carry = state.entry_angle, 1.0 - state.slip

    def displacement(angle: Array) -> Array:
        return np.asarray(entry - angle - carry * (np.sin(entry) - np.sin(angle)))

    # The displacement peaks where carry cos(angle) = 1 and is zero once behind that.
    high = np.where(carry * np.cos(entry) < 1.0, np.arccos(np.minimum(1.0 / carry, 1.0)), np.nan)
    low = exit_ratio * entry
    high = np.where(displacement(low) < 0.0, high, np.nan)
    for _ in range(50):
        middle = (low + high) / 2.0
        negative = displacement(middle) < 0.0
        low, high = np.where(negative, middle, low), np.where(negative, high, middle)
    return np.asarray((low + high) / 2.0)


def _integrate(
    state: WheelState, model: WheelModel, skid: bool, derivatives: bool, only_entry_angle: bool
) -> tuple[Array, Array]:
    """Forces (3, N) and derivatives (3, inputs, N) of a state of rows (N,) or floats.

    Arrays inside are (nodes, N): the nodes of the front branch, then those of the rear.
    """
    theta1, slip, r, b, K_L, n, tan_phi, c, K = state
    rho = model.peak_c1 + model.peak_c2 * slip if model.peak_c2 else model.peak_c1
    eps = model.exit_ratio
    x, w = _nodes(state, rho, model, skid)
    m = len(x)

    share = _stack(1.0 - (1.0 - rho) * x, eps + (rho - eps) * x)
    weight = _stack((1.0 - rho) * w, (rho - eps) * w)
    theta = theta1 * share
    sin = np.sin(theta)
    cos = np.sqrt(1.0 - sin * sin)
    sin1, cos1 = np.sin(theta1), np.cos(theta1)
    depth = np.maximum(cos[:m] - cos1, 1e-300)
    log_z = np.log(r * depth)
    sigma = K_L * np.exp(n * log_z)  # the rear takes the front's stress (eqs. 5-9)
    sw = _stack(sigma, sigma) * weight
    travel = sin1 - sin
    j_K = (r / K) * ((theta1 - theta) - (1.0 - slip) * travel)
    g, dg = SHEAR_LAWS[model.shear_law](j_K)
    tg = tan_phi * g
    tau = tg * sw + (c * g) * weight

    area = r * b * theta1
    unit = np.stack([area, area, r * area])
    ones = np.ones_like(sin)
    # Rows of W, DP and T as a normal and as a shear stress enter them.
    enters = np.stack([_contract(sw, cos), -_contract(sw, sin), 0.0 * area])
    rim = np.stack([sin, cos, ones])
    integral = enters + _contract(tau, rim)
    forces = unit * integral
    if not derivatives:
        return forces, np.empty((3, 0, 0))

    mobilising = (c * weight + tan_phi * sw) * dg
    deepening = (sin1 - sin[:m] * share[:m]) / depth
    entry_normal = n * sw * _stack(deepening, deepening)
    entry_shear = mobilising * ((r / K) * ((1.0 - share) - (1.0 - slip) * (cos1 - cos * share)))
    turned = np.stack([tau * cos - sw * sin, -tau * sin - sw * cos])

    def by_turning(turn: Array) -> Array:
        """Change when the nodes move by an angle, the stresses held."""
        return np.concatenate([_contract(np.broadcast_to(turn, sin.shape), turned), 0.0 * area[None, :]])

    shared = np.stack([cos, -sin, 0.0 * sin]) + tg * rim  # a normal stress with the shear it mobilises
    if only_entry_angle:
        entry = _contract(entry_normal, shared) + _contract(entry_shear, rim) + by_turning(share) + integral / theta1
        return forces, (unit * entry)[:, None, :]

    normal = [entry_normal, sw, sw * _stack(log_z, log_z)]
    shear = [entry_shear, mobilising * travel, sw * g, weight * g, mobilising * j_K]
    entry, by_K_L, by_n = _contract(np.stack(normal), shared)
    entry_by_shear, by_slip, by_phi, by_c, by_K = _contract(np.stack(shear), rim)
    by_slip = by_slip * (r / K)
    if model.peak_c2:
        shift = theta1 * _stack(x, x)
        lift = -sin[:m] * shift[:m] / depth
        spread = _stack(0.0 * x - 1.0 / (1.0 - rho), 0.0 * x + 1.0 / (rho - eps))
        by_slip = by_slip + model.peak_c2 * (
            _contract(n * sw * _stack(lift, lift) + sw * spread, shared)
            + _contract(mobilising * ((r / K) * ((1.0 - slip) * cos - 1.0) * shift) + c * g * weight * spread, rim)
            + by_turning(shift)
        )
    entry = entry + entry_by_shear + by_turning(share) + integral / theta1
    jacobian = np.stack([entry, by_slip, by_K_L / K_L, by_n, by_phi, by_c, by_K / -K], axis=1)
    return forces, unit[:, None, :] * jacobian


def _stack(front: Any, rear: Any) -> Array:
    return np.concatenate([front, rear])


def _contract(fields: Array, rows: Array) -> Array:
    """Sums over the nodes of fields (..., nodes, N) times rows (..., nodes, N): (fields, rows, N)."""
    subscripts = "...mn,rmn->...rn" if rows.ndim == 3 else "mn,mn->n"
    return np.asarray(np.einsum(subscripts, fields, rows))
