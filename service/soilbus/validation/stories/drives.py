"""What the stories happen to: a tractor on ground whose tracker is given the truth, or one that must estimate it."""

from __future__ import annotations

import random
from functools import lru_cache

import numpy as np

from soilbus.config.model import Config
from soilbus.estimation.tracker import TrackerOutput
from soilbus.simulator.frames import START_TIME, frames
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import Patch, Scenario, Swing
from soilbus.terra.soils import SOILS
from soilbus.validation.statics import brute
from soilbus.validation.stories.onlooker import CYCLE, Drive, Moment, good_moment, good_tracked

CHEAP: Config = reference_configuration(["estimator.window=2.0", "traversability.max_age=2.0"])
REAL: Config = reference_configuration(["estimator.window=6.0"])
SECONDS = 45.0
"""Length of a real drive, longer than any story."""
EASY, IN_VAIN = (0.2, 0.6), (0.97, 1.2)
"""Draft asked for, as a share of the most that the ground can hold."""
GROUNDS = ("loam", "sandy_loam_15", "wet_clay", "clayey_soil_38")


@lru_cache
def _good() -> tuple[Moment, TrackerOutput]:
    return good_moment(), good_tracked()


def cheap() -> Drive:
    """On firm ground, with a tracker that says the truth."""
    return Drive(*_good(), CHEAP, 2.0 * CYCLE)


def real(seed: int) -> Drive:
    """A drive on one soil, measured and estimated; half of them ask for more than the ground can hold."""
    rng = random.Random(seed)
    soil, firm = rng.choice(GROUNDS), rng.random() < 0.5
    most = brute(SOILS[soil], REAL.traversability.max_slip)[0]
    low, high = ((share * most) for share in (EASY if firm else IN_VAIN))
    scenario = Scenario(SECONDS, (Patch(0.0, soil),), draft=Swing(low, high), lift_slip=Swing(0.58, 0.6))
    drive = Drive(at_ten_hertz(scenario, seed), None, REAL)
    drive.wire.soft = not firm
    return drive


def at_ten_hertz(scenario: Scenario, seed: int) -> Moment:
    """A frame of each message for every cycle of a drive."""
    config = reference_configuration()
    found: Moment = {}
    for message in frames(simulate(config, scenario, seed), config):
        found.setdefault(message.arbitration_id, []).append(message)
    cycles = START_TIME + CYCLE * (1.0 + np.arange(int(SECONDS / CYCLE) - 2))
    chosen = {}
    for i, messages in found.items():
        last = np.searchsorted([m.timestamp for m in messages], cycles) - 1
        chosen[i] = [messages[k] for k in last.tolist()]
    return chosen
