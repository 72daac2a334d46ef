"""The method of Xi et al. 2024 (World Electr. Veh. J. 15:217): one operating point, three equations.

    F = r b theta1 [K_L (normal(n) + tan(phi) rubbed(n)) + c stuck]      F = W, DP, T / r
    Newton: x <- x - J^-1 (F(x) - F measured),   x = (K_L, phi, n)       (eqs. 34-42)

Load, drawbar pull and torque at a known sinkage and slip are solved for K_L, phi and n. The integrals are Simpson sums
over three angles of each branch (eqs. 23-33). Misprints are corrected as service/docs/equations.md lists. The method is
here to be compared with: one operating point hardly separates K_L from n.
"""

from __future__ import annotations

import math
from functools import cache
from typing import NamedTuple

import numpy as np

from soilbus.arrays import Array
from soilbus.terra.rim import Quadrature, fixed_shares
from soilbus.terra.wheel import EXACT_NODES

__all__ = [
    "EXACT", "SIMPSON", "Forces", "OperatingPoint", "Solution", "Three", "Unknowns", "WheelEquations", "entry_angle",
    "moduli_from_two_widths",
]  # fmt: skip

Three = tuple[float, float, float]

MAX_ITERATIONS = 50
"""Steps after which an iteration counts as not converged."""
RELATIVE_STEP_TOLERANCE = 1e-8
"""Relative step of every unknown that ends the iteration; the paper does not print its own."""
N_STEP_TOLERANCE = 1e-4
"""Step of n that ends the elimination: Newton squares it, so n is then right to 1e-9 and K_L to 1e-7 of itself."""
N_OFFSET = 1.5
"""The forces at small angles go as 1/(n + 3/2), so Newton steps in that variable are nearly exact."""
MAX_N = 20.0
"""Exponent beyond which Newton has diverged, and powers of the sinkage would overflow."""


class OperatingPoint(NamedTuple):
    """Known quantities of the method: sinkage [m], slip [-], radius and width [m], c [Pa], K [m]."""

    sinkage: float
    slip: float
    radius: float
    width: float
    c: float
    K: float


class Unknowns(NamedTuple):
    """Unknowns of the method: K_L [N/m^(n+2)], phi [rad], n [-]."""

    K_L: float
    phi: float
    n: float

    @property
    def is_soil(self) -> bool:
        """Whether a soil can have these values."""
        return self.K_L > 0.0 and 0.0 < self.phi < math.pi / 2.0 and self.n > 0.0


class Forces(NamedTuple):
    """Load W [N], drawbar pull DP [N], torque T [N m]."""

    W: float
    DP: float
    T: float


SIMPSON, EXACT = "simpson", "gauss"
"""Rules of integration: eqs. 23-33, and Gauss' to 1e-10."""


class Solution(NamedTuple):
    """End of an iteration, its number of steps, and whether the last one was small."""

    end: Unknowns
    iterations: int
    converged: bool

    @property
    def soil(self) -> Unknowns | None:
        """Soil at the end, if the iteration converged to values that a soil can have."""
        return self.end if self.converged and self.end.is_soil else None


class WheelEquations:
    """Eqs. 20-22 at one operating point, ready for any K_L, phi and n.

    Over the contact area r b theta1 (T: that times r) the forces are K_L (normal(n) + tan(phi) rubbed(n)) + c stuck.
    The rear branch takes the front's stress (eqs. 5-9), so one power of the sinkage at each node gives all ten
    integrals, and their derivatives.
    """

    __slots__ = ("_of_c", "_rows", "_unit", "_z")

    def __init__(self, point: OperatingPoint, rule: str = SIMPSON) -> None:
        _, slip, r, width, c, K = point
        theta = entry_angle(point)
        share, weight, of_normal = _nodes(rule)
        angle = theta * share
        directions = np.empty((3, *share.shape))  # of shear stress in W, DP and T
        sin, cos = np.sin(angle, directions[0]), np.cos(angle, directions[1])
        directions[2] = 1.0
        carried = 1.0 - slip
        # eq. 16 as terra.stress has it, over r, with the sines at hand
        j = carried * sin - angle + (theta - carried * math.sin(theta))
        mobilised = j / (j + K / r)
        fields = np.empty((5, *share.shape))  # normal stress in DP and W; shear in W, DP and T
        np.multiply(of_normal, directions[:2], out=fields[:2])
        np.multiply(weight * mobilised, directions, out=fields[2:])
        rows = np.empty((10, share.shape[1]))
        np.add(fields[:, 0], fields[:, 1], out=rows[:5])
        stuck: list[float] = (rows[2:5] @ directions[2, 0]).tolist()
        self._of_c = c * stuck[0], c * stuck[1], c * stuck[2]
        z = r * (cos[0] - math.cos(theta))
        if rule == SIMPSON:  # its first node is the entry: no normal stress
            rows[:5, 0], z[0] = 0.0, 1.0
        np.multiply(rows[:5], np.log(z), out=rows[5:])  # their derivatives by n, but for the power
        self._rows, self._z = rows, z
        area = r * width * theta
        self._unit = area, area, r * area

    def forces(self, x: Unknowns) -> Forces:
        """Return W, DP and T (eqs. 20-22) of a soil."""
        return self.forces_and_columns(x)[0]

    def forces_and_columns(self, x: Unknowns) -> tuple[Forces, tuple[Three, Three, Three]]:
        """Return forces and the columns of their Jacobian (eq. 42): by K_L, by phi [1/rad], by n."""
        K_L, phi, n = x
        b, a, w, d, t, b_n, a_n, w_n, d_n, t_n = (self._rows @ self._z**n).tolist()
        (W, DP, T), (W_c, DP_c, T_c), tan = self._unit, self._of_c, math.tan(phi)
        load, pull, torque = a + tan * w, b + tan * d, tan * t
        by_K_L = W * load, DP * pull, T * torque
        turn = K_L * (1.0 + tan * tan)
        by_phi = W * turn * w, DP * turn * d, T * turn * t
        by_n = W * K_L * (a_n + tan * w_n), DP * K_L * (b_n + tan * d_n), T * K_L * tan * t_n
        forces = Forces(W * (K_L * load + W_c), DP * (K_L * pull + DP_c), T * (K_L * torque + T_c))
        return forces, (by_K_L, by_phi, by_n)

    def newton(self, measured: Forces, start: Unknowns, most: int = MAX_ITERATIONS) -> Solution:
        """Solve by the paper's iteration: Newton's method on all three unknowns (eq. 41), undamped.

        Parameters
        ----------
        measured
            Forces.
        start
            First K_L, phi and n.
        most
            Greatest number of steps.
        """
        x = start
        for done in range(most):
            (W, DP, T), (u, v, w) = self.forces_and_columns(x)
            miss = W - measured.W, DP - measured.DP, T - measured.T
            volume = _triple(u, v, w)
            if volume == 0.0:
                return Solution(x, done, False)
            step = _triple(miss, v, w) / volume, _triple(u, miss, w) / volume, _triple(u, v, miss) / volume
            new = Unknowns(x.K_L - step[0], x.phi - step[1], x.n - step[2])
            if not (math.isfinite(new.K_L) and math.isfinite(new.phi) and abs(new.n) < MAX_N):
                return Solution(x, done, False)
            x = new
            if all(abs(s) <= RELATIVE_STEP_TOLERANCE * abs(value) for s, value in zip(step, x, strict=True)):
                return Solution(x, done + 1, True)
        return Solution(x, most, False)

    def solve(self, measured: Forces, n: float) -> Solution:
        """Solve the same equations by Newton's method on 1/(n + 3/2) alone.

        For a given n the forces are linear in K_L and in s = K_L tan(phi), so T gives s and W then K_L; the remaining
        residual of the drawbar pull must be zero.
        """
        W, DP, T = self._from_normal_stress(measured)
        done, converged, K_L, s = 0, False, math.nan, math.nan
        while done < MAX_ITERATIONS and not converged and abs(n) < MAX_N:
            b, a, w, d, t, b_n, a_n, w_n, d_n, t_n = (self._rows @ self._z**n).tolist()
            try:
                s = T / t
                s_n = -s * t_n / t
                K_L = (W - s * w) / a
                K_L_n = -(s_n * w + s * w_n + K_L * a_n) / a
                step = (K_L * b + s * d - DP) / (K_L_n * b + K_L * b_n + s_n * d + s * d_n)
                from_pole = n + N_OFFSET
                change = from_pole / max(1.0 + step / from_pole, 0.1) - from_pole
            except ZeroDivisionError:  # no shear at all, or forces of cohesion alone: n does not matter
                break
            K_L, s, n = K_L + K_L_n * change, s + s_n * change, n + change
            done, converged = done + 1, abs(change) <= N_STEP_TOLERANCE
        return Solution(Unknowns(K_L, math.atan2(s, K_L), n), done, converged)

    def all_solutions(self, measured: Forces) -> list[Unknowns]:
        """Return every soil with n up to 3 that solves the equations, from no particular start.

        They are where the residual of the drawbar pull changes sign on 100 equal steps of n.
        """
        n = np.linspace(0.03, 3.0, 100)
        b, a, w, d, t = self._rows[:5] @ self._z[:, None] ** n
        W, DP, T = self._from_normal_stress(measured)
        with np.errstate(all="ignore"):  # measured may be anything
            left = (W - T / t * w) / a * b + T / t * d - DP
        ends = (self.solve(measured, float(n[i])).soil for i in np.flatnonzero(left[1:] * left[:-1] < 0.0))
        return [end for end in ends if end is not None]

    def _from_normal_stress(self, measured: Forces) -> Three:
        """Forces over their units, without the part of cohesion."""
        (W, DP, T), (W_1, DP_1, T_1), (W_c, DP_c, T_c) = measured, self._unit, self._of_c
        return W / W_1 - W_c, DP / DP_1 - DP_c, T / T_1 - T_c


def entry_angle(point: OperatingPoint) -> float:
    """Return the entry angle [rad] of the sinkage (eq. 1); ValueError for one that is not from 0 to the radius."""
    if not 0.0 < point.sinkage < point.radius:
        raise ValueError(f"a sinkage of {point.sinkage:g} m is not between 0 and the radius {point.radius:g} m")
    return math.acos(1.0 - point.sinkage / point.radius)


def moduli_from_two_widths(K_L1: float, b1: float, K_L2: float, b2: float) -> tuple[float, float]:
    """Return k_c [N/m^(n+1)] and k_phi [N/m^(n+2)] from K_L at two tyre widths [m] (eqs. 38-39)."""
    return (K_L1 - K_L2) * b1 * b2 / (b2 - b1), (K_L2 * b2 - K_L1 * b1) / (b2 - b1)


def _triple(u: Three, v: Three, w: Three) -> float:
    """Determinant of three columns."""
    return u[0] * (v[1] * w[2] - v[2] * w[1]) + u[1] * (v[2] * w[0] - v[0] * w[2]) + u[2] * (v[0] * w[1] - v[1] * w[0])


@cache
def _nodes(rule: str) -> tuple[Array, Array, Array]:
    """Angles as shares of the entry angle and weights (2, M), and weights (2, 2, M) of normal stress in DP and W.

    Front branch from the entry, then rear branch from the exit, both to the middle (eq. 19).
    """
    if rule == EXACT:
        share, weight = (a[..., 0] for a in fixed_shares(Quadrature(EXACT_NODES, 3, peak=0.5, exit=0.0)))
    else:
        share = np.array([[1.0, 0.75, 0.5], [0.0, 0.25, 0.5]])
        weight = np.array([[1.0, 4.0, 1.0], [1.0, 4.0, 1.0]]) / 12.0
    return share, weight, np.stack([-weight, weight])
