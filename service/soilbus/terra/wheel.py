"""One rigid wheel on soil: load, drawbar pull and torque with their derivatives.

Equations 20-22 of Xi et al. 2024 (Wong & Reece 1967), integrated by Gauss-Legendre
quadrature.  Both stress branches share one coordinate x: 0 where the branch starts to
carry (entry or exit angle), 1 at the angle of greatest stress.  Nodes lie at x = u**3,
which tames the x**n singularity of the normal stress for any n > 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from soilbus.terra.stress import SHEAR_LAWS, Array, lumped_modulus

N_NODES = 12
"""Gauss-Legendre nodes a branch: relative error below 1e-6 for n in 0.1..1.6,
K from 5 mm and entry angles up to 0.8 rad (tests/terra/test_wheel.py)."""

MIN_ENTRY_ANGLE = 1e-4
MAX_ENTRY_ANGLE = 1.4
_CHUNK = 8192

_u, _w = np.polynomial.legendre.leggauss(N_NODES)
_u, _w = (_u + 1.0) / 2.0, _w / 2.0
_X, _XW = _u**3, _w * 3.0 * _u**2  # clustered where the stress starts

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
    """Load W [N], drawbar pull DP [N] and torque T [N m]: array (3, N) (eqs. 20-22)."""
    return _in_chunks(state, model, derivatives=False)[0]


def wheel_forces_and_derivatives(state: WheelState, model: WheelModel) -> tuple[Array, Array]:
    """Forces (3, N) and their exact derivatives (3, 7, N) by INPUTS, radius and width held.

    Rows as FORCES, columns as INPUTS; units are those of force per unit of input.
    """
    return _in_chunks(state, model, derivatives=True)


def sinkage(entry_angle: Any, radius: Any) -> Any:
    """Sinkage [m] of a wheel with this entry angle [rad] (eq. 1)."""
    return radius * (1.0 - np.cos(entry_angle))


def entry_angle_for_load(load: Any, state: WheelState, model: WheelModel, tolerance: float = 1e-12) -> Array:
    """Entry angle [rad], shape (N,), at which the soil carries the load [N].

    Newton on logarithms, where the curve is nearly straight, inside a bracket that
    bisection shrinks whenever Newton leaves it.  state.entry_angle is the first guess
    where it is finite and positive.  A load that no angle up to MAX_ENTRY_ANGLE carries
    (wheel buried), or that is not a positive number, gives nan.
    """
    load, *fields = (np.atleast_1d(np.asarray(a, float)) for a in np.broadcast_arrays(load, *state))
    guess, rest = fields[0], fields[1:]
    low = np.full(load.shape, np.log(MIN_ENTRY_ANGLE))
    high = np.full(load.shape, np.log(MAX_ENTRY_ANGLE))
    usable = np.isfinite(load) & (load > 0.0)
    target = np.log(np.where(usable, load, 1.0))
    with np.errstate(all="ignore"):
        at = np.where((guess > 0.0) & np.isfinite(guess), np.log(np.abs(guess)), _first_guess(load, *rest))
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
    return angle


def _first_guess(load: Array, slip: Array, r: Array, b: Array, K_L: Array, n: Array, t: Array, c: Array, K: Array) -> Array:
    """log entry angle from the small-angle load K_L b r^(n+1) theta^(2n+1) / (n + 1.5)."""
    return np.log(load * (n + 1.5) / (0.6 * b * K_L * r ** (n + 1.0))) / (2.0 * n + 1.0)


def _load_and_slope(state: WheelState, model: WheelModel) -> tuple[Array, Array]:
    forces, jacobian = _in_chunks(state, model, derivatives=True, only_entry_angle=True)
    return forces[0], jacobian[0, 0]


def _in_chunks(
    state: WheelState, model: WheelModel, *, derivatives: bool, only_entry_angle: bool = False
) -> tuple[Array, Array]:
    shape = np.broadcast_shapes(*(np.shape(a) for a in state))
    n_samples = int(np.prod(shape, dtype=int))
    columns = [
        np.asarray(a, float).reshape(-1, 1) if np.shape(a) == shape and shape != ()
        else np.broadcast_to(np.asarray(a, float), shape).reshape(-1, 1) if np.ndim(a)
        else float(a)
        for a in state
    ]  # fmt: skip
    for i in (0, 1):  # per sample in any case
        columns[i] = np.broadcast_to(columns[i], (n_samples, 1))
    forces = np.empty((3, n_samples))
    n_inputs = 1 if only_entry_angle else len(INPUTS)
    jacobian = np.empty((3, n_inputs, n_samples if derivatives else 0))
    slip = columns[1][:, 0]
    for index in _groups(slip, n_samples):
        part = WheelState(*(a[index] if np.ndim(a) else a for a in columns))
        skid = bool(np.min(part.slip, initial=0.0) < 0.0)
        f, d = _integrate(part, model, skid, derivatives, only_entry_angle)
        forces[:, index] = f
        if derivatives:
            jacobian[:, :, index] = d
    return forces, jacobian


def _groups(slip: Array, n_samples: int) -> list[Any]:
    """Index chunks, driven wheels apart from skidding ones, which need split panels."""
    skid = slip < 0.0
    if not skid.any():
        return [slice(i, i + _CHUNK) for i in range(0, n_samples, _CHUNK)]
    groups = []
    for members in (np.flatnonzero(~skid), np.flatnonzero(skid)):
        groups += [members[i : i + _CHUNK] for i in range(0, len(members), _CHUNK)]
    return groups


def _nodes(state: WheelState, rho: Any, model: WheelModel, skid: bool) -> tuple[Array, Array]:
    """Nodes x and weights on 0..1; in skid split where the shear stress changes sign."""
    if not skid:
        return _X[None, :], _XW[None, :]
    turn = _turning_angle(state, model.exit_ratio)
    theta = state.entry_angle
    front = (theta - turn) / (theta * (1.0 - rho))
    rear = (turn - model.exit_ratio * theta) / (theta * (rho - model.exit_ratio))
    split = np.clip(np.where(turn > rho * theta, front, rear), 0.0, 1.0)
    split = np.where(np.isfinite(turn), split, 1.0)
    x = np.concatenate([split * _X, split + (1.0 - split) * _u], axis=1)
    return x, np.concatenate([split * _XW, (1.0 - split) * _w], axis=1)


def _turning_angle(state: WheelState, exit_ratio: float) -> Array:
    """Angle where the shear displacement of a skidding wheel is back at zero; nan if nowhere."""
    entry, carry = state.entry_angle, 1.0 - state.slip

    def displacement(angle: Array) -> Array:
        return np.asarray(entry - angle - carry * (np.sin(entry) - np.sin(angle)))

    # The displacement peaks where carry cos(angle) = 1 and is zero once behind that.
    high = np.where(carry * np.cos(entry) < 1.0, np.arccos(np.minimum(1.0 / carry, 1.0)), np.nan)
    low = np.broadcast_to(exit_ratio * entry, high.shape).copy()
    high = np.where(displacement(low) < 0.0, high, np.nan)
    for _ in range(50):
        middle = (low + high) / 2.0
        negative = displacement(middle) < 0.0
        low, high = np.where(negative, middle, low), np.where(negative, high, middle)
    return (low + high) / 2.0


def _integrate(
    state: WheelState, model: WheelModel, skid: bool, derivatives: bool, only_entry_angle: bool
) -> tuple[Array, Array]:
    """Forces (3, N) and derivatives (3, inputs, N); state columns are (N, 1) or floats."""
    theta1, slip, r, b, K_L, n, tan_phi, c, K = state
    rho = model.peak_c1 + model.peak_c2 * slip if model.peak_c2 else model.peak_c1
    eps = model.exit_ratio
    x, w = _nodes(state, rho, model, skid)

    # Front branch, then rear branch, side by side: 2 x nodes columns.
    share = _beside(1.0 - (1.0 - rho) * x, eps + (rho - eps) * x)
    theta = theta1 * share
    weight = theta1 * _beside((1.0 - rho) * w, (rho - eps) * w)
    sin, cos = np.sin(theta), np.cos(theta)
    sin1, cos1 = np.sin(theta1), np.cos(theta1)
    m = x.shape[1]
    share_f, sin_f, cos_f = share[:, :m], sin[:, :m], cos[:, :m]  # the rear takes the front's stress
    depth = cos_f - cos1
    log_z = np.log(r * np.maximum(depth, 1e-300))
    sigma = K_L * np.exp(n * log_z)
    sw = np.concatenate([sigma, sigma], axis=1) * weight
    j = r * (theta1 - theta - (1.0 - slip) * (sin1 - sin))
    g, dg = SHEAR_LAWS[model.shear_law](j / K)
    strength = c * weight + tan_phi * sw
    tau = strength * g

    unit = np.asarray(np.concatenate(np.broadcast_arrays(r * b, r * b, r * r * b, theta1), axis=1))[:, :3].T
    forces = unit * np.stack([_dot(sw, cos) + _dot(tau, sin), _dot(tau, cos) - _dot(sw, sin), tau.sum(1)])
    if not derivatives:
        return forces, np.empty((3, 0, 0))

    def derivative(d_log_sigma: Any, d_j: Any, d_theta: Any, d_log_weight: Any) -> Array:
        """The three integrals' change from changes of what they are made of."""
        ds = d_log_sigma * sw
        dt = (c * weight * d_log_weight + tan_phi * (ds + sw * d_log_weight)) * g + strength * dg * (d_j / K)
        ds = ds + sw * d_log_weight
        if np.ndim(d_theta):
            turn_s, turn_t = sw * d_theta, tau * d_theta
            dW = _dot(ds + turn_t, cos) + _dot(dt - turn_s, sin)
            return np.stack([dW, _dot(dt - turn_s, cos) - _dot(ds + turn_t, sin), dt.sum(1)])
        return np.stack([_dot(ds, cos) + _dot(dt, sin), _dot(dt, cos) - _dot(ds, sin), dt.sum(1)])

    d_depth = np.asarray(sin1 - sin_f * share_f) / depth
    entry = derivative(
        n * _beside(d_depth, d_depth),
        r * (1.0 - share - (1.0 - slip) * (cos1 - cos * share)),
        share,
        1.0 / theta1,
    )
    if only_entry_angle:
        return forces, (unit * entry)[:, None, :]

    slip_column = _shear_only(strength * dg * (r / K) * (sin1 - sin), sin, cos)
    if model.peak_c2:
        d_rho = model.peak_c2
        shift = theta1 * _beside(x, x)
        d_depth = -sin_f * theta1 * x / depth
        slip_column = slip_column + d_rho * derivative(
            n * _beside(d_depth, d_depth),
            -r * (1.0 - (1.0 - slip) * cos) * shift,
            shift,
            _beside(-1.0 / (1.0 - rho) + 0.0 * x, 1.0 / (rho - eps) + 0.0 * x),
        )
    sg = sw * g
    by_phi = _shear_only(sg, sin, cos)
    normal = np.stack([_dot(sw, cos), -_dot(sw, sin), np.zeros(len(sw))])
    by_K_L = (normal + np.ravel(tan_phi) * by_phi) / np.ravel(K_L)
    by_n = derivative(_beside(log_z, log_z), 0.0, 0.0, 0.0)
    by_c = _shear_only(weight * g, sin, cos)
    by_K = _shear_only(-strength * dg * j / K**2, sin, cos)
    jacobian = np.stack([entry, slip_column, by_K_L, by_n, by_phi, by_c, by_K], axis=1)
    return forces, unit[:, None, :] * jacobian


def _beside(front: Any, rear: Any) -> Array:
    return np.concatenate(np.broadcast_arrays(front, rear), axis=1)


def _dot(a: Array, b: Array) -> Array:
    return np.einsum("ij,ij->i", a, b)


def _shear_only(tau: Array, sin: Array, cos: Array) -> Array:
    return np.stack([_dot(tau, sin), _dot(tau, cos), tau.sum(1)])
