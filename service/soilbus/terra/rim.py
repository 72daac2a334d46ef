"""Where the stresses under a wheel are evaluated: quadrature nodes along the rim and their geometry.

Both stress branches share one coordinate x: 0 where the branch starts to carry (entry or
exit angle), 1 at the angle of greatest stress.  Nodes lie at a power of the Gauss points,
which tames the x**n singularity of the normal stress for any n > 0.  Equation numbers
are those of Xi et al. 2024.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from soilbus.arrays import Array

SERIES_TERMS = 10
"""Terms of the sine and cosine series: exact to rounding up to entry angles of pi/2."""


class Quadrature(NamedTuple):
    """Gauss nodes a branch, the power that clusters them, and the shape of the branches.

    peak and exit are the angles of greatest stress and of exit over the entry angle.
    """

    nodes: int
    power: int
    peak: float
    exit: Any


class Rim(NamedTuple):
    """Geometry at the nodes (2, M, N), front and rear branch.

    depth [-] and deepening [1/rad] (M, N) are sinkage over radius at the nodes of either
    branch and the derivative of its logarithm by the entry angle.  Shear displacement
    over K is creep + slip travel (eq. 16), its derivative by the entry angle creep_rate +
    slip travel_rate.
    """

    sin: Array
    cos: Array
    depth: Array
    deepening: Array
    travel: Array
    creep: Array
    travel_rate: Array
    creep_rate: Array


@cache
def gauss(nodes: int, power: int) -> tuple[Array, Array]:
    """Return the Gauss points on 0..1 clustered towards 0 by a power, and their weights; columns."""
    u, w = np.polynomial.legendre.leggauss(nodes)
    u, w = (u[:, None] + 1.0) / 2.0, w[:, None] / 2.0
    return u**power, w * power * u ** (power - 1)


def on_branches(x: Array, w: Array, peak: Any, leave: Any) -> tuple[Array, Array]:
    """Return the nodes as shares of the entry angle and weights (2, M, ...) from x and weights on 0..1 (M, ...)."""
    front, rear = 1.0 - (peak + np.zeros_like(leave)), (peak + np.zeros_like(leave)) - leave
    return np.stack([1.0 - front * x, leave + rear * x]), np.stack([front * w, rear * w])


@cache
def fixed_shares(q: Quadrature) -> tuple[Array, Array]:
    """Return the shares and weights (2, M, 1) that serve every sample alike."""
    return on_branches(*gauss(q.nodes, q.power), q.peak, q.exit)


def split_nodes(split: Array, q: Quadrature, start: Any = 0.0) -> tuple[Array, Array]:
    """Return the nodes x and weights from a start to 1, (M + 2, N) for each panel before and after a place (N,)."""
    x, xw = gauss(q.nodes + 2, 3)  # shear is steep where it changes sign
    u, w = gauss(q.nodes + 2, 2)  # the branch may start just before the split
    before, after = split - start, 1.0 - split
    return np.concatenate([start + before * x, split + after * u]), np.concatenate([before * xw, after * w])


def place_of_turn(theta: Array, slip: Array, peak: Any, q: Quadrature) -> Array:
    """Return where on 0..1 (N,) the shear of a skidding wheel changes sign; 1 if nowhere."""
    turn = _turning_angle(theta, slip, q.exit)
    front = (theta - turn) / (theta * (1.0 - peak))
    rear = (turn - q.exit * theta) / (theta * (peak - q.exit))
    split = np.clip(np.where(turn > peak * theta, front, rear), 0.0, 1.0)
    return np.asarray(np.where(np.isfinite(turn), split, 1.0))


def place_of_depth(theta: Array, depth: Any, peak: Any) -> Array:
    """Return where on 0..1 (N,) the rim reaches a depth over radius; 1 if nowhere."""
    cos = np.cos(theta) + depth
    angle = np.arccos(np.minimum(cos, 1.0))
    return np.asarray(np.clip((theta - angle) / (theta * (1.0 - peak)), 0.0, 1.0))


def _turning_angle(entry: Array, slip: Array, exit_ratio: Any) -> Array:
    """Angle a where the shear displacement of a skidding wheel is back at zero; nan if nowhere.

    0 = ln(carry cos(m) sin(d) / d),    carry = 1 - slip,    m, d = (e +- a) / 2,    e: entry angle

    which is the displacement e - a - carry (sin e - sin a) over e - a, so that the root is simple.  By Newton's method
    in q = e^2 + e a + a^2, which to third order in the angles is 6 (1 - 1 / carry).
    """
    carry = 1.0 - slip
    low = exit_ratio * entry
    turns = (carry * np.cos(entry) < 1.0) & (entry - low < carry * (np.sin(entry) - np.sin(low)))
    q = 6.0 * (1.0 - 1.0 / carry)
    for _ in range(5):  # exact to rounding up to entry angles of 1.2 rad, to 1e-6 rad beyond
        angle = np.clip((np.sqrt(np.maximum(4.0 * q - 3.0 * entry**2, 1e-12)) - entry) / 2.0, low, entry)
        middle, half = (entry + angle) / 2.0, (entry - angle) / 2.0
        off = np.log(carry * np.cos(middle) * np.sinc(half / np.pi))
        slope = np.tan(middle) - half / 3.0 * (1.0 + half**2 / 15.0 * (1.0 + 2.0 * half**2 / 21.0))  # 1 / d - cot d
        step = np.clip(2.0 * (entry + 2.0 * angle) / slope, 3.0, 12.0)  # 6 for small angles
        q = entry**2 + entry * angle + angle**2 + step * off
    return np.where(turns, angle, np.nan)


def rim_at(theta: Array, share: Array, r_K: Any) -> Rim:
    """Return the geometry for entry angles theta (N,) and shares (2, M, N); r_K is radius over K."""
    angle = theta * share
    sin = np.sin(angle)
    cos = np.sqrt(1.0 - sin * sin)  # no contact reaches a right angle
    sin1, cos1 = np.sin(theta), np.cos(theta)
    depth = np.maximum(cos[0] - cos1, 1e-300)
    travel, creep = sin1 - sin, np.subtract(theta, angle, out=angle)
    travel_rate, creep_rate = cos * share, 1.0 - share
    np.subtract(cos1, travel_rate, out=travel_rate)
    creep -= travel
    creep_rate -= travel_rate
    for lengths in (travel, creep, travel_rate, creep_rate):
        lengths *= r_K
    deepening = (sin1 - sin[0] * share[0]) / depth
    return Rim(sin, cos, depth, deepening, travel, creep, travel_rate, creep_rate)


def rim_of_fixed_shares(theta: Array, q: Quadrature, r_K: Any, one_off: bool = False) -> Rim:
    """Return `rim_at` for shares common to all samples, by series in the entry angle.

    Several times faster than sines of every angle, and free of cancellation near the entry.
    one_off: no other call will have these shares, so that nothing of them is kept.
    """
    powers = np.empty((SERIES_TERMS, 2, len(theta)))
    powers[0, 0], powers[0, 1] = 1.0, theta
    done, factor = 1, theta * theta
    while done < SERIES_TERMS:
        np.multiply(powers[: SERIES_TERMS - done][:done], factor, out=powers[done : 2 * done])
        done, factor = 2 * done, factor * factor
    even, odd = powers[:, 0], powers[:, 1]
    of_sin, of_cos, of_lag, of_rate = _series.__wrapped__(q) if one_off else _series(q)
    sin, cos, lag, rate = of_sin @ odd, of_cos @ even, of_lag @ (r_K * odd), of_rate @ (r_K * even)
    m, shape = q.nodes, (2, q.nodes, len(theta))
    depth = np.maximum(cos[2 * m :], 1e-300)
    return Rim(
        sin[: 2 * m].reshape(shape), cos[: 2 * m].reshape(shape), depth, sin[2 * m :] / depth,
        lag[: 2 * m].reshape(shape), lag[2 * m :].reshape(shape), rate[: 2 * m].reshape(shape),
        rate[2 * m :].reshape(shape),
    )  # fmt: skip


@cache
def _series(q: Quadrature) -> tuple[Array, Array, Array, Array]:
    """Coefficients (rows, SERIES_TERMS): of odd powers for sin and depth times deepening, of even
    powers for cos and depth, of odd powers for travel and creep, of even powers for their rates."""
    share, _ = fixed_shares.__wrapped__(q)
    s, front = share.reshape(-1, 1), share[0]
    k = np.arange(SERIES_TERMS)
    odd, even = (np.array([(-1.0) ** i / math.factorial(2 * i + parity) for i in k.tolist()]) for parity in (1, 0))
    lag, straight = 1.0 - s ** (2 * k + 1), (1.0 - s) * (k == 0)
    return (
        np.concatenate([s ** (2 * k + 1), 1.0 - front ** (2 * k + 2)]) * odd,
        np.concatenate([s ** (2 * k), front ** (2 * k) - 1.0]) * even,
        np.concatenate([lag * odd, straight - lag * odd]),
        np.concatenate([lag * even, straight - lag * even]),
    )
