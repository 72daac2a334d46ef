"""One rigid wheel on soil: load, drawbar pull and torque with their derivatives.

Equations 20-22 of Xi et al. 2024 (Wong & Reece 1967), integrated by Gauss-Legendre
quadrature at the nodes of terra.rim.  Where a state has a contact length it is a track, whose closed forms
(terra.track) stand in for the integrals.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from soilbus.arrays import Array
from soilbus.terra.contact_stress import (
    Stress,
    by_exponential_share,
    by_leave,
    by_peak,
    entering,
    integrals,
    leaving,
    peaking,
    sheared,
    stresses,
    unit_of,
)
from soilbus.terra.hardpan import by_pan, pan_stresses, reaching
from soilbus.terra.soil_laws import lumped_modulus
from soilbus.terra.track import track_forces, track_forces_and_jacobian, track_forces_and_slopes, track_load_and_slope
from soilbus.terra.wheel_state import EXACT_NODES, FAST_NODES, WheelModel, WheelState

__all__ = [
    "EXACT_NODES", "FAST_NODES", "FORCES", "INPUTS", "SHAPE", "Soil", "WheelModel", "WheelState", "sinkage", "state_on",
    "wheel_forces", "wheel_forces_and_derivatives", "wheel_forces_and_slopes",
]  # fmt: skip

MIN_ENTRY_ANGLE = 1e-4
MAX_ENTRY_ANGLE = 1.4
_CHUNK = 16384
"""Nodes of a branch that are integrated at once: all fields of this many stay in the processor's cache.  Short
of it small chunks cost twice as much, given that the allocator keeps its memory (soilbus.allocator)."""

FORCES = ("load", "drawbar_pull", "torque")
"""What wheel_forces() returns: W [N], DP [N], T [N m]."""
INPUTS = ("entry_angle", "slip", "K_L", "n", "tan_phi", "c", "K")
"""What the forces are differentiated by, as fields of WheelState."""
SHAPE = ("peak", "leave", "exponential_share", "pan_stiffness", "pan_depth")
"""What the shape of the contact depends on: the angles of greatest stress and of exit over the entry angle, and
the fields of WheelModel by name.  A derivative by the length of a track is to be had, too; of a wheel it is zero."""
OnRim = Callable[[Stress, WheelState, WheelModel], Array]
"""Integrator of the stresses under a wheel."""
OnTrack = Callable[[WheelState, WheelModel], Array]
"""The same of a track, which needs no nodes."""


class Soil(NamedTuple):
    """Bekker-Mohr-Coulomb soil: k_c [N/m^(n+1)], k_phi [N/m^(n+2)], n, phi [rad], c [Pa], K [m]."""

    k_c: float
    k_phi: float
    n: float
    phi: float
    c: float
    K: float

    def bearing_pressure(self, z_ref: float, b_ref: float) -> float:
        """Return the pressure [Pa] that carries a plate of width b_ref [m] at the depth z_ref [m] (eq. 3)."""
        return float(lumped_modulus(self.k_c, self.k_phi, b_ref) * z_ref**self.n)


def state_on(soil: Soil, entry_angle: Any, slip: Any, radius: Any, width: Any, length: Any = 0.0) -> WheelState:
    """Return the state of a wheel (radius, width [m]), or of a track with a contact length [m], on a soil."""
    K_L = lumped_modulus(soil.k_c, soil.k_phi, width)
    return WheelState(entry_angle, slip, radius, width, K_L, soil.n, np.tan(soil.phi), soil.c, soil.K, length)


def wheel_forces(state: WheelState, model: WheelModel) -> Array:
    """Return load W [N], drawbar pull DP [N] and torque T [N m] of a wheel (eqs. 20-22 of Xi et al. 2024).

    Parameters
    ----------
    state
        Entry angle, slip, geometry and soil; fields of shapes that broadcast to (...).
    model
        Shear law, angle of greatest stress, quadrature.

    Returns
    -------
    (3, ...)
        The three forces, as FORCES names them.

    Examples
    --------
    A wheel of 0.5 m radius and 0.3 m width that sinks 6 cm into loam at 20 % slip:

    >>> from soilbus.terra.soils import soil_named
    >>> wheel = state_on(soil_named("loam"), entry_angle=0.5, slip=0.2, radius=0.5, width=0.3)
    >>> W, DP, T = wheel_forces(wheel, WheelModel())
    >>> round(float(W)), round(float(DP)), round(float(T))
    (8808, 1064, 1615)
    """
    return in_chunks(_forces, track_forces, 3, state, model)


def wheel_forces_and_derivatives(
    state: WheelState, model: WheelModel, shape: Sequence[str] = ()
) -> tuple[Array, Array]:
    """Return forces (3, ...) and exact derivatives (3, 7 + D, ...) by INPUTS and some of SHAPE.

    Rows as FORCES, columns as INPUTS and then as asked for, among which may be the `length` of a track; units are those
    of force per unit of input.
    """
    n = len(INPUTS) + len(shape)
    of_rim, of_track = partial(_forces_and_jacobian, shape=shape), partial(track_forces_and_jacobian, shape=shape)
    both = in_chunks(of_rim, of_track, 3 + 3 * n, state, model)
    return both[:3], both[3:].reshape(3, n, *both.shape[1:])


def wheel_forces_and_slopes(state: WheelState, model: WheelModel) -> tuple[Array, Array]:
    """Return forces (3, ...) and their exact derivatives (3, 2, ...) by entry angle and slip."""
    both = in_chunks(_forces_and_slopes, track_forces_and_slopes, 9, state, model)
    return both[:3], both[3:].reshape(3, 2, *both.shape[1:])


def sinkage(entry_angle: Any, radius: Any) -> Any:
    """Return the sinkage [m] of a wheel with this entry angle [rad]: r (1 - cos theta_1) (eq. 1).

    Examples
    --------
    >>> round(float(sinkage(entry_angle=0.5, radius=0.5)), 4)
    0.0612
    """
    return radius * (1.0 - np.cos(entry_angle))


def carried_and_slope(state: WheelState, model: WheelModel) -> Array:
    """Return the load and its derivative by the entry angle (2, ...)."""
    return in_chunks(_load_and_slope, track_load_and_slope, 2, state, model)


def in_chunks(integrate: OnRim, of_track: OnTrack, n_rows: int, state: WheelState, model: WheelModel) -> Array:
    """Return (n_rows, ...) of an integrator, or of the closed form of tracks, chunk by chunk; rows (N,) or floats."""
    shape = np.broadcast(*state).shape
    n_samples = math.prod(shape)
    rows = WheelState(*[
        (a if a.shape == shape else np.broadcast_to(a, shape)).reshape(n_samples)
        if a.ndim or i < 2 else float(a)  # entry angle and slip always by sample
        for i, a in enumerate(map(partial(np.asarray, dtype=float), state))
    ])  # fmt: skip
    out = np.empty((n_rows, n_samples))
    if np.any(rows.length):
        tracked = np.broadcast_to(np.asarray(rows.length) > 0.0, n_samples)
        tracks, wheels = np.flatnonzero(tracked), np.flatnonzero(~tracked)
        out[:, tracks] = of_track(_samples(rows, tracks), model)
        if len(wheels):
            samples = _samples(rows, wheels)._replace(length=0.0)
            out[:, wheels] = in_chunks(integrate, of_track, n_rows, samples, model)
        return out.reshape(n_rows, *shape)
    for run, samples, skidding in _runs(rows, model.nodes):
        out[:, run] = integrate(stresses(samples, model, skidding), samples, model)
    if model.pan_stiffness:
        for run, samples, skidding in _runs(rows._replace(c=0.0), model.nodes, reaching(rows, model)):
            out[:, run] += integrate(pan_stresses(samples, model, skidding), samples, model)
    return out.reshape(n_rows, *shape)


def _runs(
    rows: WheelState, nodes: int, chosen: NDArray[np.bool_] | None = None
) -> Iterable[tuple[slice | NDArray[np.intp], WheelState, bool]]:
    """Samples, chosen ones or all (N,), in chunks, and whether they skid: those that do need split panels."""
    skid, chunk = rows.slip < 0.0, max(_CHUNK // nodes, 1)
    if chosen is None and len(skid) <= chunk and not skid.any():
        return [(slice(None), rows, False)]
    driving, skidding = (~skid, skid) if chosen is None else (chosen & ~skid, chosen & skid)
    members = (np.flatnonzero(driving), False), (np.flatnonzero(skidding), True)
    runs = [(of[i : i + chunk], skids) for of, skids in members for i in range(0, len(of), chunk)]
    return [(run, _samples(rows, run), skids) for run, skids in runs]


def _samples(rows: WheelState, chosen: NDArray[np.intp]) -> WheelState:
    """Some samples of fields that are (N,) or floats."""
    return WheelState(*[a if isinstance(a, float) else a[chosen] for a in rows])


def _load_and_slope(at: Stress, state: WheelState, model: WheelModel) -> Array:
    """Load and its derivative by the entry angle (2, N)."""
    tau, mobilising = sheared(at, state)
    normal, shear = entering(at, state, tau, mobilising)
    sin, cos = at.rim.sin, at.rim.cos
    load, slope = np.einsum("qfbmn,fbmn->qn", [[at.normal, tau], [normal, shear]], [cos, sin])
    slope += load / state.entry_angle
    if model.exit_angle:
        rate, _ = leaving(state.entry_angle, state.slip, model)
        slope = slope + rate * by_leave(at, state, model, tau, mobilising)[0]
    return np.asarray(np.stack([load, slope]) * (state.radius * state.width * state.entry_angle))


def _forces(at: Stress, state: WheelState, model: WheelModel) -> Array:
    """W, DP and T (3, N)."""
    normal, rubbed, stuck = integrals(np.stack([at.normal, at.rubbed, at.stuck]), 1, at.rim).swapaxes(0, 1)
    return unit_of(state) * _whole(normal, rubbed, stuck, state)


def _whole(by_normal: Array, by_rubbed: Array, by_stuck: Array, state: WheelState) -> Array:
    """Integrals (3, N) of the stresses from those of the normal, the rubbed and the stuck part."""
    return np.asarray(by_normal + (state.tan_phi * by_rubbed + state.c * by_stuck))


def _forces_and_jacobian(at: Stress, state: WheelState, model: WheelModel, shape: Sequence[str] = ()) -> Array:
    """W, DP and T and their derivatives by INPUTS and some of SHAPE (3 + 21 + 3 D, N)."""
    tau, mobilising = sheared(at, state)
    fields = np.empty((9, *at.normal.shape))
    fields[0], fields[3], fields[4] = at.normal, at.rubbed, at.stuck
    np.multiply(at.steep, at.log_z, out=fields[1])
    if at.by_sill is not None:
        fields[1] += at.by_sill
    fields[2], fields[5] = entering(at, state, tau, mobilising)
    np.multiply(at.shear_share, fields[1], out=fields[6])
    np.multiply(mobilising, at.rim.travel, out=fields[7])
    np.multiply(mobilising, at.j_K, out=fields[8])
    parts = integrals(fields, 3, at.rim).swapaxes(0, 1)
    by_normal, deeper, pressed, by_rubbed, by_stuck, turned, rubbed_deeper, by_slip, by_K = parts
    turned[2] += np.einsum("bmn,bmn->n", at.normal, at.share)
    by_entry, of_slip = _reshaped(at, state, model, tau, mobilising)
    turned += by_entry
    by_slip += of_slip
    whole, unit = _whole(by_normal, by_rubbed, by_stuck, state), unit_of(state)
    columns = (
        pressed + turned + whole / state.entry_angle,
        by_slip,
        (by_normal + state.tan_phi * by_rubbed) / state.K_L,
        deeper + state.tan_phi * rubbed_deeper,
        by_rubbed,
        by_stuck,
        by_K / -state.K,
        *_by_shape(at, state, model, tau, mobilising, shape),
    )
    out = np.empty((3 + 3 * len(columns), len(state.entry_angle)))
    np.multiply(unit, whole, out=out[:3])
    jacobian = out[3:].reshape(3, len(columns), -1)
    for column, derivative in enumerate(columns):
        np.multiply(unit, derivative, out=jacobian[:, column])
    return out


def _reshaped(at: Stress, state: WheelState, model: WheelModel, tau: Array, mobilising: Array) -> tuple[Any, Any]:
    """What it adds to the derivatives (3, N) by entry angle and slip that the contact changes its shape with them."""
    by_entry: Any = 0.0
    by_slip: Any = 0.0
    if model.peak_c2:
        by_slip = peaking(state.slip, model) * by_peak(at, state, model, tau, mobilising)
    if model.exit_angle or model.exit_slip:
        later = by_leave(at, state, model, tau, mobilising)
        of_entry, of_slip = leaving(state.entry_angle, state.slip, model)
        by_entry, by_slip = of_entry * later, by_slip + of_slip * later
    return by_entry, by_slip


def _by_shape(
    at: Stress, state: WheelState, model: WheelModel, tau: Array, mobilising: Array, shape: Sequence[str]
) -> Iterator[Array]:
    """Derivatives (3, N) of the integrals by each of these."""
    own = at.by_sill is not None and {"pan_stiffness", "pan_depth"} & set(shape)  # the soil alone knows of no pan
    pan = by_pan(at, state, model) if own else (np.zeros((3, 1)),) * 2
    for name in shape:
        if name == "peak":
            yield by_peak(at, state, model, tau, mobilising)
        elif name == "leave":
            yield by_leave(at, state, model, tau, mobilising)
        elif name == "exponential_share":
            yield by_exponential_share(at, state, model)
        elif name == "length":
            yield np.zeros((3, 1))
        else:
            yield pan[name == "pan_depth"]


def _forces_and_slopes(at: Stress, state: WheelState, model: WheelModel) -> Array:
    """W, DP and T and their derivatives by entry angle and slip (3 + 6, N)."""
    tau, mobilising = sheared(at, state)
    fields = np.empty((5, *at.normal.shape))
    fields[0], fields[2] = at.normal, tau
    fields[1], fields[3] = entering(at, state, tau, mobilising)
    np.multiply(mobilising, at.rim.travel, out=fields[4])
    pressing, pressed, rubbing, turned, by_slip = integrals(fields, 2, at.rim).swapaxes(0, 1)
    turned[2] += np.einsum("bmn,bmn->n", at.normal, at.share)
    by_entry, of_slip = _reshaped(at, state, model, tau, mobilising)
    turned += by_entry
    by_slip += of_slip
    whole, unit = pressing + rubbing, unit_of(state)
    out = np.empty((9, len(state.entry_angle)))
    np.multiply(unit, whole, out=out[:3])
    slopes = out[3:].reshape(3, 2, -1)
    np.multiply(unit, pressed + turned + whole / state.entry_angle, out=slopes[:, 0])
    np.multiply(unit, by_slip, out=slopes[:, 1])
    return out
