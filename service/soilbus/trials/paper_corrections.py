"""Misprints of Xi et al. 2024, each with what it should be and a number that shows its effect."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from soilbus.terra.soil_laws import exponential_shear, normal_stress, rational_shear, shear_displacement
from soilbus.trials.paper import (
    AS_PRINTED,
    EXACT,
    EXACT_EXPONENTIAL,
    SIMPSON,
    Equations,
    OperatingPoint,
    Unknowns,
    WheelEquations,
    entry_angle,
    moduli_from_two_widths,
)
from soilbus.trials.paper_tables import RUNS, TRACTOR_2, WET_CLAY, as_print, errors_in_percent, from_print


class Correction(NamedTuple):
    """Where the paper errs, what it prints, what it must be, and the effect in numbers."""

    where: str
    printed: str
    corrected: str
    effect: str


def corrections(sinkage: float) -> list[Correction]:
    """All of them; numbers are for wet clay on tractor 1 at a sinkage [m]."""
    point = WET_CLAY.at(sinkage)
    return [
        Correction(where, printed, corrected, effect(point, WET_CLAY.truth))
        for where, printed, corrected, effect in _CORRECTIONS
    ]


def _forces(point: OperatingPoint, soil: Unknowns, equations: Equations) -> str:
    W, DP, T = WheelEquations(point, equations).forces(soil)
    return f"W = {W:.0f} N, DP = {DP:+.0f} N, T = {T:.0f} N m"


def _lost_bracket(point: OperatingPoint, soil: Unknowns) -> str:
    theta1 = entry_angle(point)
    depth = math.cos(0.75 * theta1) - math.cos(theta1)
    pressure = normal_stress(soil.K_L, soil.n, point.radius * depth) / 1e3
    return (
        f"at theta1/4 the sinkage over r is {-theta1 / 4.0:.3f} as printed, of which no power {soil.n:g} exists; "
        f"corrected {depth:.3f}, normal stress {pressure:.1f} kPa"
    )


def _slip_velocity(point: OperatingPoint, soil: Unknowns) -> str:
    theta1 = entry_angle(point)
    printed = point.radius * math.sin(theta1)
    right = shear_displacement(theta1, 0.0, point.slip, point.radius)
    wrong = _forces(point, soil, Equations(rule="gauss", printed_slip_velocity=True))
    return (
        f"displacement below the axle {1e3 * printed:.0f} mm instead of {1e3 * right:.0f} mm: "
        f"{wrong} instead of {_forces(point, soil, EXACT)}"
    )


def _simpson(point: OperatingPoint, soil: Unknowns) -> str:
    coarse, exact = (WheelEquations(point, e).forces(soil) for e in (SIMPSON, EXACT))
    W, DP, T = (100.0 * (a / b - 1.0) for a, b in zip(coarse, exact, strict=True))
    return f"none by itself; with all ten, Simpson against the integrals: W {W:+.2f} %, DP {DP:+.2f} %, T {T:+.2f} %"


def _swapped_weights(point: OperatingPoint, soil: Unknowns) -> str:
    right, printed = (WheelEquations(point, e) for e in (SIMPSON, AS_PRINTED))
    found = len(printed.all_solutions(right.forces(soil)))
    return (
        f"DP = {printed.forces(soil).DP:+.1f} N instead of {right.forces(soil).DP:+.1f} N (integrals: "
        f"{WheelEquations(point, EXACT).forces(soil).DP:+.1f} N); forces of the corrected equations have {found} "
        "solutions with the printed ones. The tables cannot show it: used for data and solver alike it cancels"
    )


def _rational_law(point: OperatingPoint, soil: Unknowns) -> str:
    ratio = shear_displacement(entry_angle(point), 0.0, point.slip, point.radius) / point.K
    return (
        f"j/K = {ratio:.2f} below the axle: {rational_shear(ratio)[0]:.2f} against {exponential_shear(ratio)[0]:.2f} "
        f"of the strength; {_forces(point, soil, EXACT)} against {_forces(point, soil, EXACT_EXPONENTIAL)}"
    )


def _small_K(point: OperatingPoint, soil: Unknowns) -> str:
    j = shear_displacement(entry_angle(point), 0.0, point.slip, point.radius)
    full = _forces(point._replace(K=1e-9), soil, EXACT)
    return (
        f"j reaches {1e3 * j:.0f} mm, K = {1e3 * point.K:.0f} mm: j/(j+K) <= {j / (j + point.K):.2f}; were it 1: "
        f"{full} instead of {_forces(point, soil, EXACT)}"
    )


def _wrong_equation(point: OperatingPoint, soil: Unknowns) -> str:
    theta1 = entry_angle(point)
    z = point.radius * (math.cos(0.75 * theta1) - math.cos(theta1))
    strength = point.c + normal_stress(soil.K_L, soil.n, z) * math.tan(soil.phi)
    share = rational_shear(shear_displacement(theta1, theta1 / 4.0, point.slip, point.radius) / point.K)[0]
    torque = WheelEquations(point, EXACT).forces(soil).T
    return f"eq. 18 gives a stress, {1e-3 * strength * share:.1f} kPa at theta1/4; eq. 22 the torque, {torque:.0f} N m"


def _one_system(point: OperatingPoint, soil: Unknowns) -> str:
    wheel = WheelEquations(point)
    F, x = wheel.jacobian(soil), np.array(soil)
    miss = np.array(wheel.forces(Unknowns(*(0.9 * x).tolist()))) - np.array(wheel.forces(soil))
    relative = F * x / np.array(wheel.forces(soil))[:, None]
    newton = np.linalg.solve(F * x, miss)
    gauss_newton = np.linalg.lstsq(F * x, miss, rcond=None)[0]
    apart = np.max(np.abs(gauss_newton / newton - 1.0))
    return (
        f"none: the steps of both agree to {apart:.0e}. Square means that noise is not averaged: "
        f"condition number {np.linalg.cond(relative):.1e} of relative forces by relative unknowns"
    )


def _two_widths(point: OperatingPoint, soil: Unknowns) -> str:
    (one,) = (r for r in RUNS if (r.table, r.on) == (6, "tractor 1"))
    (two,) = (r for r in RUNS if (r.table, r.on) == (6, "tractor 2"))
    K_L1, K_L2 = from_print(one.result).K_L, from_print(two.result).K_L
    k_c, k_phi = moduli_from_two_widths(K_L1, WET_CLAY.width, K_L2, TRACTOR_2.width)
    true = WET_CLAY.soil
    return (
        f"never evaluated in the paper; with its results of Table 6 k_c = {k_c / 1e3:.2f} instead of "
        f"{true.k_c / 1e3:.2f} ({100 * (k_c / true.k_c - 1):+.1f} %), k_phi = {k_phi / 1e3:.1f} instead of "
        f"{true.k_phi / 1e3:.1f} ({100 * (k_phi / true.k_phi - 1):+.1f} %)"
    )


def _error_of_K_L(point: OperatingPoint, soil: Unknowns) -> str:
    printed = from_print(RUNS[0].result)
    return f"{printed.K_L / 1e3:.3f} against {soil.K_L / 1e3:.1f} is {errors_in_percent(printed, soil)[1]:.2f} %"


def _same_system_two_angles(point: OperatingPoint, soil: Unknowns) -> str:
    torque_3, torque_4 = (WheelEquations(point).forces(from_print(r.result)).T for r in RUNS if r.on == "wet clay")
    return (
        f"a system has one torque at its solution: {torque_3:.1f} N m of Table 3's, {torque_4:.1f} N m of Table 4's, "
        f"{WheelEquations(point).forces(soil).T:.1f} N m of the true soil's"
    )


def _other_soils_rows(point: OperatingPoint, soil: Unknowns) -> str:
    wheel = WheelEquations(TRACTOR_2.at(point.sinkage))
    (row,) = (r for r in RUNS if (r.table, r.on) == (7, "tractor 2"))
    end = wheel.newton(wheel.forces(TRACTOR_2.truth), from_print(row.start))
    if end.soil is None:
        return "eq. 41 does not converge from the printed start values to wet clay"
    phi, K_L, n = as_print(end.soil)
    return f"from the printed start values eq. 41 finds wet clay: phi = {phi:.3f}, K_L = {K_L:.2f}, n = {n:.4f}"


_CORRECTIONS: tuple[tuple[str, str, str, Callable[[OperatingPoint, Unknowns], str]], ...] = (
    (
        "eq. 8", "the first cos(theta1 - ...) has lost its bracket",
        "cos(theta1 - (theta - theta2)/(theta_m - theta2) (theta1 - theta_m)) - cos(theta1)", _lost_bracket,
    ),
    ("eq. 14", "V_j = V_t cos(theta)", "V_j = r omega - V cos(theta), which is eq. 15", _slip_velocity),
    (
        "section 2.4", "K is small, so j/(j+K) is extremely close to 1 and slip matters little",
        "slip and K matter", _small_K,
    ),
    (
        "fig. 2, eq. 12", "rational and exponential shear have almost no difference",
        "the rational law is a model error of its own", _rational_law,
    ),
    ("eqs. 24-33", "B1 is defined twice, A4 not at all", "ten integrals A1-A4, B1-B4, C1, C2", _simpson),
    (
        "eq. 27 (A4)", "s2(theta1/4) sin(theta1/4) + 4 s2(theta1/2) sin(theta1/2)",
        "4 s2(theta1/4) sin(theta1/4) + s2(theta1/2) sin(theta1/2)", _swapped_weights,
    ),
    ("eqs. 38-39", "from equations (35) and (36)", "from equations (36) and (37)", _two_widths),
    (
        "eq. 41", "called Gauss-Newton",
        "Newton-Raphson; Gauss-Newton needs more equations than unknowns", _one_system,
    ),
    ("tables 3, 4, 6, 7", "K_L of wet clay: error 1.8 %", "1.45 %", _error_of_K_L),
    (
        "tables 3 and 4", "wet clay: K_L and n the same from both starts, phi 13.967 and 14.130",
        "a converged iteration forgets its start", _same_system_two_angles,
    ),
    (
        "table 7, tractor 2", "repeats the rows of sandy loam of table 4",
        "wet clay, start 7, 298.18, 0.425", _other_soils_rows,
    ),
    ("section 5", "equation (18) predicts the torque", "equation (22)", _wrong_equation),
)  # fmt: skip
