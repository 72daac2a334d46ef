"""Drives that end stuck, frame by frame: the tractor stops on loam at the edge of a bog and starts in vain.

While it drives, the simulator's quasi-static tractor; once it stands, kinematics written down here: ground speed
zero, and rim speeds and torques of the try as named.  No model of a soil says what the sensors then show.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import can
import numpy as np

from soilbus.assembly import chassis_of
from soilbus.config import Config
from soilbus.simulator.drive import Drive, drive
from soilbus.simulator.frames import frames
from soilbus.simulator.recording import Recording
from soilbus.simulator.scenario import SAMPLE_RATE, Patch, Profile, Scenario
from soilbus.simulator.sensors import measure
from soilbus.terra.vehicle import axle_loads

CRAWL = 0.02
"""Ground speed [m/s] at which the simulated drive ends and the vehicle stands."""


class Try(NamedTuple):
    """What the wheels do while the vehicle stands: rim speeds [m/s] and torques [N m] of FL, FR, RL, RR."""

    rim: tuple[float, float, float, float]
    torque: tuple[float, float, float, float]


TRIES = {
    "all spin": Try((2.0,) * 4, (700.0, 700.0, 900.0, 900.0)),
    "left wheels spin": Try((2.0, 0.0, 2.0, 0.0), (300.0, 300.0, 400.0, 400.0)),
    "rear wheels spin": Try((0.0, 0.0, 2.0, 2.0), (150.0, 150.0, 700.0, 700.0)),
    "all spin slowly": Try((0.45,) * 4, (700.0, 700.0, 900.0, 900.0)),
    "motors stand at their limit": Try((0.0,) * 4, (2400.0,) * 4),
    "one wheel spins": Try((0.0, 0.0, 0.0, 2.0), (100.0, 100.0, 120.0, 120.0)),
    "it merely stands": Try((0.0,) * 4, (0.0,) * 4),
}
SPIN_UP = 0.3
"""Time [s] in which torque and rim speed rise."""


@dataclass(frozen=True)
class Stuck:
    """Frames of a drive, and when the vehicle stood and when the try began [s, the frames' time]."""

    messages: list[can.Message]
    stood: float
    tried: float


def stuck_after_stop(
    config: Config,
    attempt: Try,
    seed: int,
    drives: float = 24.0,
    waits: float = 1.5,
    lasts: float = 12.0,
    deceleration: float = 0.5,
    soil: str = "loam",
) -> Stuck:
    """A drive of so many seconds, a stop, a wait and a try in vain."""
    rng = np.random.default_rng([seed, 7])
    speed, draft = rng.uniform(1.2, 1.6), rng.uniform(600.0, 1500.0)
    knots_t, knots_v = _wandering(rng, speed, drives)
    stop = (knots_v[-1] - CRAWL) / deceleration
    profile = Profile([*knots_t, drives + stop], [*knots_v, CRAWL])
    draft_t = np.arange(0.0, drives, 1.0)
    value = draft * (1.0 + 0.6 * np.sin(0.5 * draft_t + rng.uniform(0.0, 6.0)) * np.sin(0.23 * draft_t))
    scenario = Scenario(
        drives + stop, [Patch(0.0, soil)], profile, draft=Profile([*draft_t, drives + stop], [*value, 0.0])
    )
    done = drive(config, scenario, seed)
    stood = float(done.columns["t"][-1])
    done = _standing(done, config, attempt, waits, lasts)
    recording = Recording(done.columns, measure(done, config, seed), seed)
    messages = list(frames(recording, config))
    begin = messages[0].timestamp
    return Stuck(messages, begin + stood, begin + stood + waits)


def _wandering(rng: np.random.Generator, speed: float, drives: float) -> tuple[list[float], list[float]]:
    t = np.arange(0.0, drives + 0.1, 4.0)
    return t.tolist(), (speed + 0.2 * rng.uniform(-1.0, 1.0, len(t))).tolist()


def _standing(done: Drive, config: Config, attempt: Try, waits: float, lasts: float) -> Drive:
    chassis = chassis_of(config)
    assert chassis is not None
    more = round((waits + lasts) * SAMPLE_RATE)
    since = np.arange(1, more + 1) / SAMPLE_RATE
    on = np.clip((since - waits) / SPIN_UP, 0.0, 1.0)
    columns = dict(done.columns)
    zero = np.zeros(more)
    front, rear = axle_loads(chassis, 0.0, 0.0, 0.0)
    new = {name: np.full(more, column[-1]) for name, column in columns.items()}
    new |= {"t": columns["t"][-1] + since, "ground_speed": zero, "acceleration": zero, "draft": zero}
    for i, wheel in enumerate(config.wheel):
        new[f"speed.{wheel.name}"] = on * attempt.rim[i] / wheel.radius
        new[f"torque.{wheel.name}"] = on * attempt.torque[i]
        new[f"load.{wheel.name}"] = zero + (front if wheel.axle == "front" else rear) / 2.0
    joined = {name: np.concatenate([columns[name], new[name]]) for name in columns}
    return replace(done, columns=joined)
