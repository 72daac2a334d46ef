"""Misprints of Xi et al. 2024, each with what it should be and a number that shows its effect."""

from __future__ import annotations

import math

import numpy as np

from soilbus.terra.soil_laws import exponential_shear, normal_stress, rational_shear, shear_displacement
from soilbus.trials.paper import (
    AS_PRINTED,
    EXACT,
    EXACT_EXPONENTIAL,
    SIMPSON,
    Equations,
    Unknowns,
    WheelEquations,
    entry_angle,
    moduli_from_two_widths,
)
from soilbus.trials.paper_tables import RUNS, TRACTOR_2, WET_CLAY, as_print, errors_in_percent, from_print


def corrections(sinkage: float) -> list[tuple[str, str, str, str]]:
    """Where the paper errs, what it prints, what it must be, and the effect on wet clay, tractor 1, at a sinkage [m]."""
    point, soil = WET_CLAY.at(sinkage), WET_CLAY.truth
    r, theta1 = point.radius, entry_angle(point)

    def shown(equations: Equations, K: float = point.K) -> str:
        W, DP, T = WheelEquations(point._replace(K=K), equations).forces(soil)
        return f"W = {W:.0f} N, DP = {DP:+.0f} N, T = {T:.0f} N m"

    exact, simpson, printed_A4 = (WheelEquations(point, e) for e in (EXACT, SIMPSON, AS_PRINTED))
    true, coarse = exact.forces(soil), simpson.forces(soil)
    j_axle = shear_displacement(theta1, 0.0, point.slip, r)
    depth = math.cos(0.75 * theta1) - math.cos(theta1)
    pressure = normal_stress(soil.K_L, soil.n, r * depth)
    share = rational_shear(shear_displacement(theta1, theta1 / 4.0, point.slip, r) / point.K)[0]
    strength = point.c + pressure * math.tan(soil.phi)
    W, DP, T = (100.0 * (a / b - 1.0) for a, b in zip(coarse, true, strict=True))
    both = {run.on: from_print(run.result).K_L for run in RUNS if run.table == 6}
    k_c, k_phi = moduli_from_two_widths(both["tractor 1"], WET_CLAY.width, both["tractor 2"], TRACTOR_2.width)
    clay = WET_CLAY.soil
    printed_K_L = from_print(RUNS[0].result)
    torque_3, torque_4 = (simpson.forces(from_print(run.result)).T for run in RUNS if run.on == "wet clay")
    printed_j = f"displacement below the axle {1e3 * r * math.sin(theta1):.0f} mm instead of {1e3 * j_axle:.0f} mm"
    printed_slip_velocity = Equations(rule="gauss", printed_slip_velocity=True)
    solutions = len(printed_A4.all_solutions(coarse))
    return [
        (
            "eq. 8", "the first cos(theta1 - ...) has lost its bracket",
            "cos(theta1 - (theta - theta2)/(theta_m - theta2) (theta1 - theta_m)) - cos(theta1)",
            f"at theta1/4 the sinkage over r is {-theta1 / 4.0:.3f} as printed, of which no power {soil.n:g} exists; "
            f"corrected {depth:.3f}, normal stress {pressure / 1e3:.1f} kPa",
        ),
        (
            "eq. 14", "V_j = V_t cos(theta)", "V_j = r omega - V cos(theta), which is eq. 15",
            f"{printed_j}: {shown(printed_slip_velocity)} instead of {shown(EXACT)}",
        ),
        (
            "section 2.4", "K is small, so j/(j+K) is extremely close to 1 and slip matters little",
            "slip and K matter",
            f"j reaches {1e3 * j_axle:.0f} mm, K = {1e3 * point.K:.0f} mm: j/(j+K) <= "
            f"{j_axle / (j_axle + point.K):.2f}; were it 1: {shown(EXACT, 1e-9)} instead of {shown(EXACT)}",
        ),
        (
            "fig. 2, eq. 12", "rational and exponential shear have almost no difference",
            "the rational law is a model error of its own",
            f"j/K = {j_axle / point.K:.2f} below the axle: {rational_shear(j_axle / point.K)[0]:.2f} against "
            f"{exponential_shear(j_axle / point.K)[0]:.2f} of the strength; {shown(EXACT)} against "
            f"{shown(EXACT_EXPONENTIAL)}",
        ),
        (
            "eqs. 24-33", "B1 is defined twice, A4 not at all", "ten integrals A1-A4, B1-B4, C1, C2",
            f"none by itself; with all ten, Simpson against the integrals: W {W:+.2f} %, DP {DP:+.2f} %, T {T:+.2f} %",
        ),
        (
            "eq. 27 (A4)", "s2(theta1/4) sin(theta1/4) + 4 s2(theta1/2) sin(theta1/2)",
            "4 s2(theta1/4) sin(theta1/4) + s2(theta1/2) sin(theta1/2)",
            f"DP = {printed_A4.forces(soil).DP:+.1f} N instead of {coarse.DP:+.1f} N (integrals: {true.DP:+.1f} N); "
            f"forces of the corrected equations have {solutions} solutions with the printed ones. The tables cannot "
            "show it: used for data and solver alike it cancels",
        ),
        (
            "eqs. 38-39", "from equations (35) and (36)", "from equations (36) and (37)",
            f"never evaluated in the paper; with its results of Table 6 k_c = {k_c / 1e3:.2f} instead of "
            f"{clay.k_c / 1e3:.2f} ({100 * (k_c / clay.k_c - 1):+.1f} %), k_phi = {k_phi / 1e3:.1f} instead of "
            f"{clay.k_phi / 1e3:.1f} ({100 * (k_phi / clay.k_phi - 1):+.1f} %)",
        ),
        (
            "eq. 41", "called Gauss-Newton", "Newton-Raphson; Gauss-Newton needs more equations than unknowns",
            _one_system(simpson, soil),
        ),
        (
            "tables 3, 4, 6, 7", "K_L of wet clay: error 1.8 %", "1.45 %",
            f"{printed_K_L.K_L / 1e3:.3f} against {soil.K_L / 1e3:.1f} is "
            f"{errors_in_percent(printed_K_L, soil)[1]:.2f} %",
        ),
        (
            "tables 3 and 4", "wet clay: K_L and n the same from both starts, phi 13.967 and 14.130",
            "a converged iteration forgets its start",
            f"a system has one torque at its solution: {torque_3:.1f} N m of Table 3's, {torque_4:.1f} N m of Table "
            f"4's, {coarse.T:.1f} N m of the true soil's",
        ),
        (
            "table 7, tractor 2", "repeats the rows of sandy loam of table 4",
            "wet clay, start 7, 298.18, 0.425", _other_soils_rows(sinkage),
        ),
        (
            "section 5", "equation (18) predicts the torque", "equation (22)",
            f"eq. 18 gives a stress, {1e-3 * strength * share:.1f} kPa at theta1/4; eq. 22 the torque, {true.T:.0f} "
            "N m",
        ),
    ]  # fmt: skip


def _one_system(wheel: WheelEquations, soil: Unknowns) -> str:
    """How far the steps of Newton and Gauss-Newton are apart, and the condition of the system."""
    F, x, y = wheel.jacobian(soil), np.array(soil), np.array(wheel.forces(soil))
    miss = np.array(wheel.forces(Unknowns(*(0.9 * x).tolist()))) - y
    apart = np.max(np.abs(np.linalg.lstsq(F * x, miss, rcond=None)[0] / np.linalg.solve(F * x, miss) - 1.0))
    return (
        f"none: the steps of both agree to {apart:.0e}. Square means that noise is not averaged: "
        f"condition number {np.linalg.cond(F * x / y[:, None]):.1e} of relative forces by relative unknowns"
    )


def _other_soils_rows(sinkage: float) -> str:
    """Where the iteration ends from the printed start of table 7, tractor 2."""
    wheel = WheelEquations(TRACTOR_2.at(sinkage))
    (row,) = (r for r in RUNS if (r.table, r.on) == (7, "tractor 2"))
    end = wheel.newton(wheel.forces(TRACTOR_2.truth), from_print(row.start))
    if end.soil is None:
        return "eq. 41 does not converge from the printed start values to wet clay"
    phi, K_L, n = as_print(end.soil)
    return f"from the printed start values eq. 41 finds wet clay: phi = {phi:.3f}, K_L = {K_L:.2f}, n = {n:.4f}"
