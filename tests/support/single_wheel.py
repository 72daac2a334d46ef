"""A simulated test rig: one wheel pulled through a soil bed at given loads and slips."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy.optimize import brentq

from soilbus.terra.effects.effect import Active, Surroundings, forces_with, wheel_with
from soilbus.terra.wheel import Soil, WheelModel, WheelState, sinkage, state_on

RADIUS, WIDTH = 0.30, 0.20
NOISE = {"load": 0.01, "slip": 0.004, "pull": 8.0, "torque": 3.0, "sink": 0.001}
"""Sd; of the load relative, else in SI."""

RIG = f"""
[[wheel]]
name = "rig"
radius = {RADIUS}
width = {WIDTH}

[table]
wheel_load = "load"
drawbar_pull = "pull"
torque = "torque"
slip = "slip"
sinkage = "sink"

[noise]
load = {{ relative = {NOISE["load"]} }}
slip = {{ absolute = {NOISE["slip"]} }}
draft = {{ absolute = {NOISE["pull"]} }}
torque = {{ absolute = {NOISE["torque"]} }}
sinkage = {{ absolute = {NOISE["sink"]} }}
"""


def sweep(
    soil: Soil, loads: Sequence[float], slips: Sequence[float], active: Sequence[Active] = (), law: str = "exponential"
) -> dict[str, np.ndarray]:
    """Columns load, slip, pull, torque, sink of every load at every slip, without noise; SI."""
    load, slip = (a.ravel() for a in np.meshgrid(loads, slips))
    model, rows = WheelModel(shear_law=law), []
    for W, s in zip(load, slip, strict=True):
        around = Surroundings(0.0, 0.0, W, 1.0 - s, 1.0 / RADIUS, False, 0.0, 0.0, 0.0, 1.0)

        def state(angle: float, s: float = s) -> WheelState:
            return state_on(soil, np.array([angle]), np.array([s]), RADIUS, WIDTH)

        angle = brentq(
            lambda a, W=W, around=around: float(forces_with(active, state(a), model, around)[0][0]) - W, 0.01, 1.3
        )
        _, pull, torque = forces_with(active, state(angle), model, around)
        radius = wheel_with(active, state(angle), model, around)[0].radius
        rows.append((W, s, pull[0], torque[0], float(np.ravel(sinkage(angle, radius))[0])))
    return dict(zip(("load", "slip", "pull", "torque", "sink"), np.array(rows, float).T, strict=True))


def noisy(columns: Mapping[str, np.ndarray], rng: np.random.Generator) -> dict[str, np.ndarray]:
    """The same as measured with NOISE."""
    n = len(columns["load"])
    sd = {name: value * columns["load"] if name == "load" else value for name, value in NOISE.items()}
    return {name: column + sd[name] * rng.standard_normal(n) for name, column in columns.items()}


def write_csv(path: Path, columns: Mapping[str, Sequence[object]]) -> Path:
    """A table with a header."""
    rows = [",".join(map(str, row)) for row in zip(*columns.values(), strict=True)]
    path.write_text("\n".join([",".join(columns), *rows]) + "\n", encoding="utf-8")
    return path
