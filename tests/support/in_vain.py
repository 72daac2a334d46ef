"""Drives that end stuck or lack a motor, frame by frame.

While it drives, the simulator's quasi-static tractor; where it stands, starts or lacks torque, kinematics and statics
written down here: the ground speed, and the rim speed and torque of each wheel.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import can
import numpy as np

from soilbus.config.model import Config
from soilbus.estimation.assembly import chassis_of, rig_of
from soilbus.simulator.drive import Drive, drive
from soilbus.simulator.frames import frames
from soilbus.simulator.recording import Recording
from soilbus.simulator.scenario import SAMPLE_RATE, Patch, Profile, Scenario, Swing
from soilbus.simulator.sensors import measure
from soilbus.terra.effects.effect import Active, Effect, Surroundings
from soilbus.terra.soil_laws import lumped_modulus
from soilbus.terra.soils import SOILS
from soilbus.terra.vehicle import axle_loads
from soilbus.terra.wheel import Soil, WheelModel, WheelState
from soilbus.trials.boggings import largest_draft
from soilbus.trials.windows import torque_limits

CRAWL = 0.02
"""Ground speed [m/s] at which the simulated drive ends and the vehicle stands."""
SPIN_UP = 0.3
"""Time [s] in which torque and rim speed of a try rise."""


class Try(NamedTuple):
    """What the wheels do while the vehicle stands: rim speeds [m/s] and torques [N m] of FL, FR, RL, RR.

    Of motors with a limit of 2400 N m at each wheel; those of another machine give the same share of theirs.
    """

    rim: tuple[float, float, float, float]
    torque: tuple[float, float, float, float]

    def of(self, config: Config) -> Try:
        """The same of this machine's driven wheels; the others roll free."""
        rig = rig_of(config)
        share = torque_limits(config, rig) / 2400.0
        rims = np.where(rig.drives, self.rim, 0.0)
        return Try(tuple(rims.tolist()), tuple((share * self.torque).tolist()))


TRIES = {
    "all wheels spin": Try((2.0,) * 4, (700.0, 700.0, 900.0, 900.0)),
    "left wheels spin": Try((2.0, 0.0, 2.0, 0.0), (300.0, 300.0, 400.0, 400.0)),
    "rear wheels spin": Try((0.0, 0.0, 2.0, 2.0), (150.0, 150.0, 700.0, 700.0)),
    "one wheel spins": Try((0.0, 0.0, 0.0, 2.0), (100.0, 100.0, 120.0, 120.0)),
    "diagonal wheels spin": Try((1.5, 0.0, 0.0, 1.5), (200.0, 200.0, 250.0, 250.0)),
    "all wheels spin slowly": Try((0.45,) * 4, (700.0, 700.0, 900.0, 900.0)),
    "motors at their limit": Try((0.0,) * 4, (2400.0,) * 4),
    "half of the limit": Try((0.0,) * 4, (1200.0,) * 4),
}
STANDS = Try((0.0,) * 4, (0.0,) * 4)


@dataclass(frozen=True)
class Story:
    """Frames of a drive, and when what it is about begins [s, the frames' time]."""

    messages: list[can.Message]
    begins: float


def stop_and_try(config: Config, attempt: Try, seed: int, drives: float = 13.0, lasts: float = 8.0) -> Story:
    """A drive on loam of so many seconds, a stop at 0.5 m/s^2, a wait of 1.5 s and a try in vain."""
    waits, attempt = 1.5, attempt.of(config)
    done = driven(config, seed, drives, 0.5)

    def standing(t: np.ndarray) -> dict[str, np.ndarray]:
        on = np.clip((t - waits) / SPIN_UP, 0.0, 1.0)
        return {"ground_speed": 0.0 * t} | _wheels(
            config, [on * rim for rim in attempt.rim], [on * torque for torque in attempt.torque]
        )

    return told(continued(done, config, waits + lasts, standing), config, seed, float(done.columns["t"][-1]) + waits)


def halted_by_a_patch(config: Config, seed: int, deceleration: float = 1.0, lasts: float = 8.0) -> Story:
    """Left wheels meet a soft patch and spin through open differentials until the vehicle stands, and go on."""
    done = driven(config, seed, 14.0, None)
    speed = float(done.columns["ground_speed"][-1])

    def halting(t: np.ndarray) -> dict[str, np.ndarray]:
        ground = np.maximum(speed - deceleration * t, 0.0)
        spin = speed + (2.0 - speed) * np.clip(t / 0.5, 0.0, 1.0)
        left = Try((1.0, 0.0) * 2, (300.0, 300.0, 400.0, 400.0)).of(config)
        rims = [spin if spins else ground for spins in left.rim]
        torques = [np.full_like(t, torque) for torque in left.torque]
        rate = np.where(ground > 0.0, -deceleration, 0.0)
        return {"ground_speed": ground, "acceleration": rate} | _wheels(config, rims, torques)

    story = continued(done, config, lasts, halting)
    return told(story, config, seed, float(done.columns["t"][-1]) + speed / deceleration)


def driven(config: Config, seed: int, seconds: float, deceleration: float | None, soil: str = "loam") -> Drive:
    """So many seconds on loam at 1.0 to 1.8 m/s under a draft that varies, then to a stop unless that is None."""
    rng = np.random.default_rng([seed, 7])
    t = np.arange(0.0, seconds + 0.1, seconds / 4.0)
    v = rng.uniform(1.2, 1.6) + 0.2 * rng.uniform(-1.0, 1.0, len(t))
    stop = 0.0 if deceleration is None else (float(v[-1]) - CRAWL) / deceleration
    ends = [seconds + stop] if deceleration is not None else []
    speed = Profile([*t.tolist(), *ends], [*v.tolist(), *[CRAWL for _ in ends]])
    at = np.arange(0.0, seconds, 1.0)
    mean, phase = rng.uniform(0.094, 0.235) * largest_draft(config, soil), rng.uniform(0.0, 6.0)
    draft = mean * (1.0 + 0.6 * np.sin(0.9 * at + phase))
    load = Profile([*at.tolist(), *ends], [*draft.tolist(), *[0.0 for _ in ends]])
    return drive(config, Scenario(seconds + stop, [Patch(0.0, soil)], speed, draft=load), seed)


def continued(
    done: Drive, config: Config, seconds: float, then: Callable[[np.ndarray], dict[str, np.ndarray]]
) -> Drive:
    """The drive with what `then` says of the time after it; without draft, loads at rest, the rest as it was."""
    chassis = chassis_of(config)
    assert chassis is not None
    since = np.arange(1, round(seconds * SAMPLE_RATE) + 1) / SAMPLE_RATE
    zero = np.zeros(len(since))
    front, rear = axle_loads(chassis, 0.0, 0.0, 0.0)
    new = {name: np.full(len(since), column[-1]) for name, column in done.columns.items()}
    new |= {"t": done.columns["t"][-1] + since, "acceleration": zero, "draft": zero, "pitch": zero}
    new |= {f"load.{w.name}": zero + (front if w.axle == "front" else rear) / 2.0 for w in config.wheel}
    new |= then(since)
    return replace(done, columns={name: np.concatenate([done.columns[name], new[name]]) for name in done.columns})


def told(done: Drive, config: Config, seed: int, begins: float) -> Story:
    """What the sensors send of it."""
    messages = list(frames(Recording(done.columns, measure(done, config, seed), seed), config))
    return Story(messages, messages[0].timestamp + begins)


def _wheels(config: Config, rims: Sequence[np.ndarray], torques: Sequence[np.ndarray]) -> dict[str, np.ndarray]:
    speeds = {f"speed.{w.name}": rim / w.radius for w, rim in zip(config.wheel, rims, strict=True)}
    return speeds | {f"torque.{w.name}": torque for w, torque in zip(config.wheel, torques, strict=True)}


def turned_onto(config: Config, soil: str, seed: int, lasts: float = 8.0) -> Story:
    """From loam onto another soil, whose edge the front wheels meet as a turn begins.

    There rim speeds of left and right differ by 0.3 of their mean for so long.
    """
    begins = 14.0
    speed = 1.2
    scenario = Scenario(
        begins + lasts + 6.0,
        [Patch(0.0, "loam"), Patch(speed * begins + 1.2, soil)],
        Profile([0.0, 60.0], [speed, speed]),
        draft=Profile([0.0, 3.0, 6.0, 9.0, 12.0, 60.0], [600.0, 1400.0, 700.0, 1500.0, 800.0, 800.0]),
    )
    done = drive(config, scenario, seed)
    t = done.columns["t"]
    turns = np.where((t >= begins) & (t < begins + lasts), 0.15, 0.0)
    side = {w.name: 1.0 if w.name.endswith("L") else -1.0 for w in config.wheel}
    speeds = {f"speed.{w}": done.columns[f"speed.{w}"] * (1.0 - side[w] * turns) for w in side}
    return told(replace(done, columns=done.columns | speeds), config, seed, begins)


def with_a_dead_axle(config: Config, dead: str, soil: str, seed: int, seconds: float = 15.0) -> tuple[Story, float]:
    """The motors of one axle give nothing though their limit says otherwise, and the most that is then pulled [N]."""
    wheels = [w.model_copy(update={"driven": w.axle != dead}) for w in config.wheel]
    truth = config.model_copy(update={"wheel": wheels})
    scenario = Scenario(seconds, [Patch(0.0, soil)], Swing(1.3, 1.3), slip=Swing(0.15, 0.5), slip_spread=0.0)
    done = with_full_limits(drive(truth, scenario, seed), config)
    return told(done, config, seed, 0.0), largest_draft(truth, soil)


def with_a_soft_side(config: Config, soft: str, seed: int, over: float = 3.0) -> tuple[Story, float, float]:
    """From loam, with the left wheels onto a softer soil within so many seconds, under a draft that is held.

    Second and third the most that is pulled afterwards [N], and the draft [N].
    """
    begins, left = 14.0, np.array([w.name.endswith("L") for w in config.wheel])
    firm, other = (np.log(np.array(SOILS[name])) for name in ("loam", soft))

    def softer(since: float) -> Active:
        def act(state: WheelState, model: WheelModel, around: Surroundings, _: object) -> tuple[WheelState, WheelModel]:
            share = left * np.clip((around.t - since) / over, 0.0, 1.0)
            soil = Soil(*(np.exp(a + share * (b - a)) for a, b in zip(firm, other, strict=True)))
            K_L = lumped_modulus(soil.k_c, soil.k_phi, state.width)
            return state._replace(K_L=K_L, n=soil.n, tan_phi=np.tan(soil.phi), c=soil.c, K=soil.K), model

        return Active(Effect("softer", "", "", "", (), wheel=act), {})

    even = Scenario(
        0.1, [Patch(0.0, "loam")], Swing(1.3, 1.3), slip=Swing(0.6, 0.6), slip_spread=0.0, side_shift=Swing(0.0, 0.0)
    )
    pulled = (
        drive(config, replace(even, slip=Swing(slip, slip)), seed, [softer(-over)]).columns["draft"]
        for slip in (0.2, 0.3, 0.45, 0.6)
    )
    most = max(float(draft[-1]) for draft in pulled)
    rng = np.random.default_rng([seed, 5])
    held = most * rng.uniform(0.90, 0.97)
    t = np.arange(0.0, begins + over + 3.0, 0.25)
    swing = held * (1.0 - 0.45 * (1.0 + np.sin(0.8 * t + rng.uniform(0.0, 6.0))) * np.clip(begins - t, 0.0, 1.0))
    draft = Profile(t.tolist(), swing.tolist())
    scenario = replace(even, duration=float(t[-1]), slip=None, draft=draft)
    done = drive(config, scenario, seed, [softer(begins)])
    return told(done, config, seed, begins), most, held


def with_full_limits(done: Drive, config: Config) -> Drive:
    """The drive with motors that all report the limit that the configuration has."""
    limits = {f"torque_limit.{w.name}": np.full(len(done.columns["t"]), w.max_torque) for w in config.wheel}
    return replace(done, columns=done.columns | limits)
