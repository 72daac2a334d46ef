"""What the stories happen to: a tractor on ground whose tracker is given the truth, or one that must estimate it."""

from __future__ import annotations

import random
from functools import lru_cache

import numpy as np

from soilbus.config.model import Config
from soilbus.estimation.tracker import TrackerOutput
from soilbus.grouping import grouped
from soilbus.simulator.drive import drive as driven
from soilbus.simulator.frames import START_TIME, frames
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import REFERENCES, TRACTOR, reference_configuration
from soilbus.simulator.scenario import Patch, Scenario, Swing
from soilbus.terra.vehicle import GRAVITY
from tests.lab.stories.onlooker import CYCLE, Drive, Moment, good_moment, good_tracked

SECONDS = 45.0
"""Length of a real drive, longer than any story."""
EASY, IN_VAIN = (0.2, 0.6), (0.97, 1.2)
"""Draft asked for, as a share of the most that the ground can hold."""
GROUNDS = ("loam", "sandy_loam_15", "wet_clay", "clayey_soil_38")
LEAST_PULL = 0.02
"""Share of the weight that a vehicle must be able to pull on a ground to be driven over it."""


@lru_cache
def _good(machine: str) -> tuple[Moment, TrackerOutput]:
    config = reference_configuration(path=REFERENCES[machine])
    return good_moment(config), good_tracked(config)


def cheap(machine: str = TRACTOR.stem) -> Drive:
    """On firm ground, with a tracker that says the truth."""
    config = reference_configuration(["estimator.window=2.0", "traversability.max_age=2.0"], REFERENCES[machine])
    return Drive(*_good(machine), config, 2.0 * CYCLE)


def real(seed: int, machine: str = TRACTOR.stem) -> Drive:
    """A drive on one soil, measured and estimated; half of them ask for more than the ground can hold."""
    config = reference_configuration(["estimator.window=6.0"], REFERENCES[machine])
    rng = random.Random(seed)
    most_on = _largest_drafts(machine)
    soil, firm = rng.choice(tuple(most_on)), rng.random() < 0.5
    most = most_on[soil]
    low, high = ((share * most) for share in (EASY if firm else IN_VAIN))
    scenario = Scenario(SECONDS, (Patch(0.0, soil),), draft=Swing(low, high), lift_slip=Swing(0.58, 0.6))
    drive = Drive(at_ten_hertz(config, scenario, seed), None, config)
    drive.wire.soft = not firm
    return drive


@lru_cache
def _largest_drafts(machine: str) -> dict[str, float]:
    """Draft [N] that the vehicle holds at the greatest slip, on these grounds the most, where that is enough."""
    config = reference_configuration(path=REFERENCES[machine])
    assert config.vehicle is not None
    slip, found = config.traversability.max_slip, {}
    for soil in GROUNDS:
        steady = Scenario(1.0, (Patch(0.0, soil),), Swing(1.0, 1.0), slip=Swing(slip, slip), slip_spread=0.0,
                          side_shift=Swing(0.0, 0.0))  # fmt: skip
        found[soil] = float(driven(config, steady, 0).columns["draft"][-1])
    return {soil: most for soil, most in found.items() if most > LEAST_PULL * GRAVITY * config.vehicle.mass}


def at_ten_hertz(config: Config, scenario: Scenario, seed: int) -> Moment:
    """A frame of each message for every cycle of a drive."""
    found = grouped(frames(simulate(config, scenario, seed), config), lambda message: message.arbitration_id)
    cycles = START_TIME + CYCLE * (1.0 + np.arange(int(SECONDS / CYCLE) - 2))
    chosen = {}
    for i, messages in found.items():
        last = np.searchsorted([m.timestamp for m in messages], cycles) - 1
        chosen[i] = [messages[k] for k in last.tolist()]
    return chosen
