"""One track on soil: load, drawbar pull and sprocket torque with their derivatives, in closed form.

    sinkage       z = r (1 - cos theta)
    pressure      p = K_L z^n                  uniform over the contact of length L and width b
    load          W = b L p
    thrust        F = b int_0^L (c + p tan phi) f(s x / K) dx = (b L c + W tan phi) g(s L / K)
    resistance    R = b int_0^z K_L zeta^n d zeta = b K_L z^(n+1) / (n+1)
    drawbar pull  DP = F - R,    torque  T = F r

The shear displacement of a track grows evenly from its front, j = s x, so that the mean of the mobilised share f over
the contact is a function g of u = s L / K alone:

    exponential   f = 1 - exp(-j/K)     g = 1 - (1 - exp(-u)) / u
    rational      f = (j/K) / (1 + j/K) g = 1 - log(1 + u) / u

Where links are short and rollers far apart, pressure peaks below the rollers.  With N of them, one each L / N, it is

    pressure      p(x) = p (1 + cos(2 pi N x / L)),    p = W / (b L) its mean,    K_L z^n = 2 p its peak
    thrust        F = b L c g(u) + W tan phi (g(u) + h(u)),    h = int_0^1 cos(2 pi N y) f(u y) dy
    exponential   h = -u (1 - exp(-u)) / (u^2 + (2 pi N)^2);    rational: by Gauss' rule in each period

and the rut is as deep as the peaks press it; so is the resistance.

A track is described by the same state as a wheel: r is the pitch radius of the sprocket, slip s = 1 - V / (r omega),
and the angle theta stands for the sinkage.  Losses inside the track are those of a drivetrain (effect
drivetrain_loss).  A hard pan below the depth d adds pan_stiffness K_L (z^n - d^n) to the pressure.

References
----------
Bekker 1956, Theory of Land Locomotion, and 1969, Introduction to Terrain-Vehicle Systems: compaction resistance.
Wong, Theory of Ground Vehicles (4th ed. 2008), ch. 2: thrust and slip of a track with uniform pressure.
Wills 1963 (J. Agric. Eng. Res. 8:115): thrust of tracks with sinusoidal and other pressures; taken up by Wong, ch. 2.
Janosi & Hanamoto 1961 (1st Int. Conf. Mechanics of Soil-Vehicle Systems, Turin): exponential law, j = s x.
Le, Rye & Durrant-Whyte 1997 (IEEE Int. Conf. Robotics and Automation, 2:1388): soil estimated from a track.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from soilbus.arrays import Array
from soilbus.terra.wheel_state import WheelModel, WheelState

__all__ = [
    "MEAN_SHEAR", "mean_exponential_shear", "mean_rational_shear", "modulated_shear", "track_forces",
    "track_forces_and_jacobian", "track_forces_and_slopes", "track_load_and_slope",
]  # fmt: skip

SERIES_BELOW = 0.02
"""u below which g and its derivative are power series: above, rounding costs them less than 1e-13 of their value."""
SERIES_TERMS = 9
"""Terms of these: the first one left out is below 1e-16 of the sum."""
NODES_PER_PERIOD = 32
"""Gauss nodes in each period of the pressure: 1e-8 of the thrust where j grows to 200 K on three rollers."""


def _from_series(u: Array, near: Array, by_u: Array, coefficients: Sequence[float]) -> tuple[Array, Array]:
    """An odd function of u and its derivative: `near` and by_u (N,) are those of |u|, small u from sum a_k |u|^k."""
    x = np.abs(u)
    small = np.minimum(x, SERIES_BELOW)
    value, slope = np.zeros_like(x), np.zeros_like(x)
    for k in range(len(coefficients), 0, -1):
        value = (value + coefficients[k - 1]) * small
        slope = slope * small + k * coefficients[k - 1]
    is_small = x < SERIES_BELOW
    return np.copysign(np.where(is_small, value, near), u), np.where(is_small, slope, by_u)


_OF_EXPONENTIAL = tuple((-1.0) ** (k + 1) / math.factorial(k + 1) for k in range(1, SERIES_TERMS + 1))
_OF_RATIONAL = tuple((-1.0) ** (k + 1) / (k + 1) for k in range(1, SERIES_TERMS + 1))


def mean_exponential_shear(u: Any) -> tuple[Array, Array]:
    """Return the mean of the exponential law over a contact with j/K from 0 to u, and its derivative by u.

    Odd in u, so that skid brakes.

    Examples
    --------
    >>> share, slope = mean_exponential_shear(1.0)
    >>> round(float(share), 6), round(float(slope), 6)
    (0.367879, 0.264241)
    """
    u = np.asarray(u, float)
    x = np.maximum(np.abs(u), SERIES_BELOW)
    risen = -np.expm1(-x)
    return _from_series(u, 1.0 - risen / x, (risen - x * np.exp(-x)) / x**2, _OF_EXPONENTIAL)


def mean_rational_shear(u: Any) -> tuple[Array, Array]:
    """Return the mean of the rational law, as mean_exponential_shear().

    Examples
    --------
    >>> share, slope = mean_rational_shear(1.0)
    >>> round(float(share), 6), round(float(slope), 6)
    (0.306853, 0.193147)
    """
    u = np.asarray(u, float)
    x = np.maximum(np.abs(u), SERIES_BELOW)
    log = np.log1p(x)
    return _from_series(u, 1.0 - log / x, (log - x / (1.0 + x)) / x**2, _OF_RATIONAL)


def modulated_shear(u: Any, rollers: int, law: str) -> tuple[Array, Array]:
    """Return what a periodic pressure adds to the mean of a shear law, h(u), and its derivative; odd in u.

    Examples
    --------
    >>> share, slope = modulated_shear(10.0, 5, "exponential")
    >>> round(float(share), 6), round(float(slope), 6)
    (-0.0092, -0.000751)
    """
    u, wave = np.asarray(u, float), 2.0 * math.pi * rollers
    x = np.abs(u)
    if law == "exponential":
        risen, square = -np.expm1(-x), x**2 + wave**2
        share = -x * risen / square
        return np.copysign(share, -u), -(risen + x * np.exp(-x)) / square + 2.0 * x**2 * risen / square**2
    node, weight = np.polynomial.legendre.leggauss(NODES_PER_PERIOD)
    y = ((node + 1.0) / 2.0 + np.arange(rollers)[:, None]).ravel() / rollers
    weight = np.tile(weight, rollers) / (2.0 * rollers) * np.cos(wave * y)
    mobilised = 1.0 + x[..., None] * y
    return np.copysign(1.0, u) * ((1.0 - 1.0 / mobilised) @ weight), (y / mobilised**2) @ weight


MEAN_SHEAR: dict[str, Callable[[Any], tuple[Array, Array]]] = {
    "exponential": mean_exponential_shear,
    "rational": mean_rational_shear,
}
"""Means of soil_laws.SHEAR_LAWS over a track, by the same names."""


class _Pressed(NamedTuple):
    """Sinkage z and, over K_L, the pressure and its integral over the depth; (N,).

    by_angle, by_n: derivatives (pressure, integral) of both.  over, over_integral: what the soil below the pan's depth
    adds for a pan_stiffness of 1.
    """

    pressure: Array
    integral: Array
    by_angle: tuple[Array, Array]
    by_n: tuple[Array, Array]
    over: Array
    over_integral: Array
    by_depth: tuple[Array, Array]


def _power(z: Any, n: Any) -> tuple[Any, Any, Any, Any]:
    """z^n and its integral from 0 to z, and the derivatives of both by n."""
    power, log = z**n, np.log(np.maximum(z, 1e-300))
    integral = power * z / (n + 1.0)
    return power, integral, power * log, integral * (log - 1.0 / (n + 1.0))


def _pressed(state: WheelState, model: WheelModel) -> _Pressed:
    half, n = state.entry_angle / 2.0, state.n
    z, by_angle = 2.0 * state.radius * np.sin(half) ** 2, state.radius * np.sin(state.entry_angle)
    pressure, integral, pressure_by_n, integral_by_n = _power(z, n)
    steep = n * z ** (n - 1.0)
    k, d = model.pan_stiffness, model.pan_depth
    deep = np.maximum(z, d)
    at_pan, to_pan, at_pan_by_n, to_pan_by_n = _power(d, n)
    below, to_below, below_by_n, to_below_by_n = _power(deep, n)
    over, over_integral = below - at_pan, to_below - to_pan - at_pan * (deep - d)
    sill = np.where(z > d, n * d ** (n - 1.0) if d else 0.0, 0.0)
    steeper = steep + k * np.where(z > d, n * deep ** (n - 1.0), 0.0)
    whole, whole_integral = pressure + k * over, integral + k * over_integral
    by_n = pressure_by_n + k * (below_by_n - at_pan_by_n)
    integral_of_n = integral_by_n + k * (to_below_by_n - to_pan_by_n - at_pan_by_n * (deep - d))
    of_angle, of_depth = (steeper * by_angle, whole * by_angle), (-k * sill, -k * sill * (deep - d))
    return _Pressed(whole, whole_integral, of_angle, (by_n, integral_of_n), over, over_integral, of_depth)


class _Mobilised(NamedTuple):
    """Mean share of the strength c + p tan phi that is mobilised along a track: of c, of p tan phi, each (N,)."""

    of_c: Array
    of_load: Array

    def mixed(self, other: _Mobilised, share: Any) -> _Mobilised:
        """This with 1 - share, the other with share."""
        return _Mobilised(*((1.0 - share) * one + share * two for one, two in zip(self, other, strict=True)))


def _by_law(u: Array, law: str, rollers: int) -> tuple[_Mobilised, _Mobilised]:
    """What a law mobilises at u = s L / K, and its derivative by u."""
    share, slope = MEAN_SHEAR[law](u)
    if not rollers:
        return _Mobilised(share, share), _Mobilised(slope, slope)
    more, more_slope = modulated_shear(u, rollers, law)
    return _Mobilised(share, share + more), _Mobilised(slope, slope + more_slope)


def _mean_mobilised(u: Array, model: WheelModel) -> tuple[_Mobilised, _Mobilised]:
    """What is mobilised along the track, and its derivative by u = s L / K."""
    share, slope = _by_law(u, model.shear_law, model.rollers)
    if not model.exponential_share:
        return share, slope
    other, other_slope = _by_law(u, "exponential", model.rollers)
    return share.mixed(other, model.exponential_share), slope.mixed(other_slope, model.exponential_share)


def _columns(state: WheelState, model: WheelModel, shape: Sequence[str]) -> Iterator[tuple[Any, Any, Any]]:
    """Load, thrust and resistance (N,), then their derivatives by wheel.INPUTS and by some of wheel.SHAPE."""
    _, slip, _, width, K_L, _, tan_phi, c, K, length = state
    at, area, u = _pressed(state, model), width * length, slip * length / K
    mean = area * K_L / (2.0 if model.rollers else 1.0)  # load for a peak pressure of 1, over K_L
    share, slope = _mean_mobilised(u, model)
    load, resistance = mean * at.pressure, width * K_L * at.integral

    def strength(mobilised: _Mobilised) -> Any:
        return area * c * mobilised.of_c + load * tan_phi * mobilised.of_load

    def pressing(pressure: Any, integral: Any) -> tuple[Any, Any, Any]:
        """Of a change of pressure and of its integral over the depth, both over K_L."""
        more = mean * pressure
        return more, tan_phi * share.of_load * more, width * K_L * integral

    none = np.zeros_like(load)
    thrust, by_u = strength(share), strength(slope)
    yield load, thrust, resistance
    yield pressing(*at.by_angle)
    yield none, by_u * length / K, none
    yield load / K_L, tan_phi * share.of_load * load / K_L, resistance / K_L
    yield pressing(*at.by_n)
    yield none, load * share.of_load, none
    yield none, area * share.of_c, none
    yield none, -by_u * u / K, none
    for name in shape:
        if name == "exponential_share":
            other = (_by_law(u, law, model.rollers)[0] for law in ("exponential", model.shear_law))
            exponential, own = map(strength, other)
            yield none, exponential - own, none
        elif name == "pan_stiffness":
            yield pressing(at.over, at.over_integral)
        elif name == "pan_depth":
            yield pressing(*at.by_depth)
        elif name == "length":
            yield load / length, (thrust + by_u * u) / length, none
        else:  # where the stress of a rim peaks and where it ends
            yield none, none, none


def _forces(state: WheelState, model: WheelModel, n_columns: int, shape: Sequence[str] = ()) -> Array:
    """W, DP and T (3, n_columns, N): the forces, then their first derivatives as `_columns` yields them."""
    out = np.empty((3, n_columns, len(state.entry_angle)))
    for i, (load, thrust, resistance) in zip(range(n_columns), _columns(state, model, shape), strict=False):
        out[0, i], out[1, i], out[2, i] = load, thrust - resistance, thrust * state.radius
    return out


def _with_derivatives(found: Array) -> Array:
    """Forces (3, 1 + D, N) as rows: the forces themselves, then all derivatives (3 + 3 D, N)."""
    return np.concatenate([found[:, 0], found[:, 1:].reshape(-1, found.shape[2])])


def track_forces(state: WheelState, model: WheelModel) -> Array:
    """Return the load W [N], drawbar pull DP [N] and sprocket torque T [N m] of tracks (3, N).

    Parameters
    ----------
    state
        Angles (N,), slips (N,), geometry and soil, each (N,) or a float; length > 0.
    model
        Shear law and hard pan; the shape of a rim's contact does not matter.
    """
    return np.asarray(_forces(state, model, 1)[:, 0])


def track_forces_and_jacobian(state: WheelState, model: WheelModel, shape: Sequence[str] = ()) -> Array:
    """Return the forces and their derivatives by wheel.INPUTS and some of SHAPE or the length (3 + 21 + 3 D, N)."""
    return _with_derivatives(_forces(state, model, 8 + len(shape), shape))


def track_forces_and_slopes(state: WheelState, model: WheelModel) -> Array:
    """Return the forces and their derivatives by angle and slip (3 + 6, N)."""
    return _with_derivatives(_forces(state, model, 3))


def track_load_and_slope(state: WheelState, model: WheelModel) -> Array:
    """Return the load and its derivative by the angle (2, N)."""
    return np.asarray(_forces(state, model, 2)[0])
