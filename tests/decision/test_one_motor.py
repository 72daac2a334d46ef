"""What a machine with one motor can pull: wheels that are not driven roll, a motor's limit is that of all its wheels.

Brute force: the slip is scanned, the draft of each slip found by root finding, each free wheel's slip by T = 0.
"""

import math

import numpy as np
import pytest
from scipy.optimize import brentq

from soilbus.config.model import Config
from soilbus.decision.capability import assess
from soilbus.estimation.assembly import model_of, rig_of
from soilbus.estimation.posterior import Posterior
from soilbus.pipeline.intake import ReportedLimits
from soilbus.terra.entry_angle import entry_angle_for_load
from soilbus.terra.soils import soil_named
from soilbus.terra.wheel import state_on, wheel_forces

MASS, L, AHEAD, HIGH, HITCH = 4000.0, 2.4, 1.0, 0.9, 0.5
RADIUS, WIDTH = {"front": 0.55, "rear": 0.75}, {"front": 0.30, "rear": 0.45}
MAX_SLIP = 0.6


def machine(driven: tuple[str, ...], axles: list[dict]) -> Config:
    wheels = [
        {"name": name, "axle": axle, "radius": RADIUS[axle], "width": WIDTH[axle], "driven": axle in driven}
        for axle, names in (("front", ("FL", "FR")), ("rear", ("RL", "RR")))
        for name in names
    ]
    vehicle = {"mass": MASS, "wheelbase": L, "cg_ahead_of_rear_axle": AHEAD, "cg_height": HIGH, "hitch_height": HITCH}
    return Config.model_validate(
        {"vehicle": vehicle, "wheel": wheels, "axle": axles, "signals": {"ground_speed": "G.V"}}
    )


def forces(config: Config, soil, axle: str, load: float, slip: float) -> tuple[float, float]:
    """Drawbar pull [N] and torque [N m] of one wheel."""
    state = state_on(soil, 0.3, slip, RADIUS[axle], WIDTH[axle])
    state = state._replace(entry_angle=entry_angle_for_load(load, state, model_of(config)))
    _, pull, torque = wheel_forces(state, model_of(config))
    return float(pull), float(torque)


def of_free(config: Config, soil, axle: str, load: float) -> tuple[float, float]:
    slip = brentq(lambda s: forces(config, soil, axle, load, s)[1], -0.5, 0.0)
    return forces(config, soil, axle, load, slip)


def brute_force(config: Config, soil, driven: tuple[str, ...], weights: dict[str, float], limit: float) -> float:
    """Largest draft [N] over slip with sum(weight T) of the motor's wheels within its limit."""
    weight = MASS * 9.80665

    def at(slip: float, draft: float) -> tuple[float, float]:
        front = (weight * AHEAD - draft * HITCH) / L
        pull = torque = 0.0
        for axle, load in (("front", front / 2.0), ("rear", (weight - front) / 2.0)):
            P, T = forces(config, soil, axle, load, slip) if axle in driven else of_free(config, soil, axle, load)
            pull += 2.0 * P
            torque += 2.0 * weights.get(axle, 0.0) * T
        return pull, torque

    def draft_at(slip: float) -> float:
        if at(slip, -6000.0)[0] < -6000.0:
            return -math.inf  # it cannot even be pushed at this slip
        return brentq(lambda D: at(slip, D)[0] - D, -6000.0, 25000.0, xtol=20.0)

    slips = np.linspace(0.04, MAX_SLIP, 9).tolist()
    drafts = [draft_at(slip) for slip in slips]
    spare = [limit - at(slip, max(draft, -6000.0))[1] for slip, draft in zip(slips, drafts, strict=True)]
    best = max((draft for draft, left in zip(drafts, spare, strict=True) if left >= 0.0), default=-math.inf)
    for low, high, *left in zip(slips, slips[1:], spare, spare[1:], strict=False):
        if left[0] > 0.0 > left[1]:
            meets = brentq(lambda s: limit - at(s, draft_at(s))[1], low, high, xtol=4e-3)
            best = max(best, draft_at(meets))
    return best


CASES = {
    "rear driven": (("rear",), [{"name": "rear", "torque": "M.T", "motor_speed": "M.S", "max_torque": 30000.0}]),
    "rear driven, weak": (("rear",), [{"name": "rear", "torque": "M.T", "motor_speed": "M.S", "max_torque": 5000.0}]),
    "a motor on each axle": (
        ("front", "rear"),
        [
            {"name": "rear", "torque": "M.T", "motor_speed": "M.S", "max_torque": 5000.0},
            {"name": "front", "torque": "N.T", "motor_speed": "N.S", "max_torque": 90000.0},
        ],
    ),
    "both axles": (
        ("front", "rear"),
        [
            {"name": "both", "torque": "M.T", "motor_speed": "M.S", "differential": "locked", "max_torque": 700.0},
            {"name": "front", "gear_ratio": 11.0},
            {"name": "rear", "gear_ratio": 15.0},
        ],
    ),
}


@pytest.mark.parametrize(
    ("case", "soil"), [(case, "sandy_loam_11_michigan" if case == "rear driven" else "loam") for case in CASES]
)
def test_the_largest_draft_is_that_of_brute_force(case, soil):
    driven, axles = CASES[case]
    config, true_soil = machine(driven, axles), soil_named(soil)
    rig = rig_of(config)
    limits = ReportedLimits(config, rig).at(0.0)
    assert (limits > 0.0).tolist() == [axle in driven for axle in ("front", "front", "rear", "rear")]
    able, _ = assess(Posterior(true_soil, np.zeros((6, 6))), rig, model_of(config), None, limits, MAX_SLIP, 0.5)
    of_both = axles[0]["name"] == "both"
    weights = {"front": 1.0 / 11.0, "rear": 1.0 / 15.0} if of_both else {"rear": 1.0}
    expected = brute_force(config, true_soil, driven, weights, axles[0]["max_torque"])
    assert able.max_draft.value == pytest.approx(expected, rel=0.04, abs=0.01 * MASS * 9.80665)
    if case == "rear driven":  # believed to drive on all four it would be said to pull much more
        everywhere, _ = assess(
            Posterior(true_soil, np.zeros((6, 6))), rig, model_of(config), None, np.full(4, np.nan), MAX_SLIP, 0.5
        )
        assert everywhere.max_draft.value > 1.15 * able.max_draft.value
    assert able.set_points["front"].pull is None or "front" in driven
