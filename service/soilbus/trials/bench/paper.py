"""Bench of the paper's 3x3 problem: ours beside scipy.optimize.fsolve on scipy.integrate.quad."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from timeit import timeit
from typing import Any

import numpy as np
from scipy.integrate import quad
from scipy.optimize import fsolve

from soilbus.trials.bench.figure import Figure
from soilbus.trials.paper import EXACT, Forces, OperatingPoint, Unknowns, WheelEquations, entry_angle
from soilbus.trials.paper_tables import SINKAGE, TRIALS

ROUNDS = 6
"""Timed runs, of which the shortest counts."""
SOLVES = 300
"""Of ours in a row: they take about as long as one of the peer's, so that both suffer alike from a busy machine."""
MAX_RELATIVE_DIFFERENCE = 1e-6
"""Largest relative difference of K_L, phi and n between the two; quad and fsolve stop at 1.5e-8."""

Problem = tuple[OperatingPoint, Forces, Unknowns]


def paper_solve_speedup() -> Figure:
    """Compare our solution of the paper's three wheels with fsolve's, one solve at a time."""
    problems = paper_problems()

    def ours(problem: Problem) -> Unknowns:
        point, measured, start = problem
        return WheelEquations(point, EXACT).solve(measured, start.n).end

    def peer(problem: Problem) -> Any:
        point, measured, start = problem
        return fsolve(balance(point, measured), start)

    apart = max(float(np.max(np.abs(np.array(ours(p)) / peer(p) - 1.0))) for p in problems)
    if not apart < MAX_RELATIVE_DIFFERENCE:
        raise AssertionError(f"ours and fsolve are {apart:.1e} apart")
    times = np.array([
        [(timeit(partial(peer, p), number=1), timeit(partial(ours, p), number=SOLVES) / SOLVES) for p in problems]
        for _ in range(ROUNDS)
    ])  # fmt: skip
    slow, fast = times.min(axis=0).mean(axis=0).tolist()
    return Figure(
        slow / fast, 300.0, f"fsolve on quad {1e3 * slow:.1f} ms, ours {1e6 * fast:.0f} us",
        f"3x3 problem of Xi et al., mean of {len(problems)}, same solution to {apart:.0e}",
    )  # fmt: skip


def paper_problems() -> list[Problem]:
    """Return operating point, forces and start of the paper's three wheels at 20 % and 50 % off."""
    problems = []
    for trial in TRIALS.values():
        point = trial.at(SINKAGE)
        measured = WheelEquations(point, EXACT).forces(trial.truth)
        problems += [(point, measured, Unknowns(*(share * x for x in trial.truth))) for share in (0.8, 0.5)]
    return problems


def balance(point: OperatingPoint, measured: Forces) -> Callable[[Any], list[float]]:
    """Return eqs. 20-22 less the measured forces, for fsolve: the paper's ten integrals, each by quad."""
    r, area = point.radius, point.radius * point.width
    c, K, advance = point.c, point.K, 1.0 - point.slip
    theta1 = entry_angle(point)
    middle, sin1, cos1 = theta1 / 2.0, math.sin(theta1), math.cos(theta1)
    sin, cos, power = math.sin, math.cos, math.pow

    def share(angle: float) -> float:
        j = r * (theta1 - angle - advance * (sin1 - sin(angle)))
        return j / (j + K)

    def left(unknowns: Any) -> list[float]:
        K_L, phi, n = (float(x) for x in unknowns)  # twice as fast as numpy's scalars
        modulus, tan = K_L * power(r, n), math.tan(phi)

        def front(angle: float) -> float:
            return modulus * power(cos(angle) - cos1, n)

        def rear(angle: float) -> float:
            return modulus * power(cos(theta1 - angle) - cos1, n)

        def shear_front(angle: float) -> float:
            return (c + front(angle) * tan) * share(angle)

        def shear_rear(angle: float) -> float:
            return (c + rear(angle) * tan) * share(angle)

        def integral(before: Callable[[float], float], after: Callable[[float], float]) -> float:
            return float(quad(before, middle, theta1)[0] + quad(after, 0.0, middle)[0])

        load = integral(lambda a: front(a) * cos(a), lambda a: rear(a) * cos(a))
        load += integral(lambda a: shear_front(a) * sin(a), lambda a: shear_rear(a) * sin(a))
        pull = integral(lambda a: shear_front(a) * cos(a), lambda a: shear_rear(a) * cos(a))
        pull -= integral(lambda a: front(a) * sin(a), lambda a: rear(a) * sin(a))
        turn = integral(shear_front, shear_rear)
        return [area * load - measured.W, area * pull - measured.DP, area * r * turn - measured.T]

    return left
