"""Drives that end stuck or lack a motor, frame by frame, by other formulas than the simulator's.

While it drives, the simulator's quasi-static tractor; from then on kinematics and statics written down here: the ground
speed, and the rim speed and torque of each wheel.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import can
import numpy as np
from scipy.optimize import brentq

from soilbus.config.model import Config
from soilbus.estimation.assembly import chassis_of, rig_of
from soilbus.simulator.drive import Drive, drive
from soilbus.simulator.frames import frames
from soilbus.simulator.recording import Recording
from soilbus.simulator.scenario import SAMPLE_RATE, Patch, Profile, Scenario
from soilbus.simulator.sensors import measure
from soilbus.terra.soils import SOILS
from soilbus.terra.vehicle import GRAVITY, axle_loads
from soilbus.terra.wheel import Soil
from soilbus.trials.boggings import largest_draft
from soilbus.trials.windows import torque_limits
from statics import WEIGHT, brute_with_rolling, wheels

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


def start_after_stop(config: Config, rate: float, top: float, seed: int, lasts: float = 8.0) -> Story:
    """A drive on loam, a stop, a wait of 1.5 s and a start at so many m/s^2 to the speed `top` [m/s]."""
    waits = 1.5
    done = driven(config, seed, 13.0, 0.5)
    mass, drives = weight_of(config) / GRAVITY, rig_of(config).drives
    resists = 0.2 * mass * GRAVITY  # what loam holds back rolling wheels by, as by brute force

    def starting(t: np.ndarray) -> dict[str, np.ndarray]:
        ground = np.clip(rate * (t - waits - SPIN_UP), 0.0, top)
        speeds_up = np.where((ground > 0.0) & (ground < top), rate, 0.0)
        on = np.clip((t - waits) / SPIN_UP, 0.0, 1.0)
        force = on * (resists + mass * speeds_up) / drives.sum()
        slips = 0.04 + 0.04 * speeds_up  # that loam needs for so little
        rims = [ground / np.where(drive, 1.0 - slips, 1.0) for drive in drives]
        torques = [force * w.radius * drive for w, drive in zip(config.wheel, drives, strict=True)]
        return {"ground_speed": ground, "acceleration": speeds_up} | _wheels(config, rims, torques)

    return told(continued(done, config, waits + lasts, starting), config, seed, float(done.columns["t"][-1]) + waits)


def halted_by_a_patch(config: Config, seed: int, drives: float = 14.0, lasts: float = 5.0) -> Story:
    """Left wheels meet a soft patch and spin through open differentials until the vehicle stands, and go on."""
    done, deceleration = driven(config, seed, drives, None), 1.0
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


def weight_of(config: Config) -> float:
    """Of the vehicle [N]."""
    assert config.vehicle is not None
    return config.vehicle.mass * GRAVITY


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


def as_driven(config: Config, seed: int, columns: dict[str, np.ndarray]) -> Drive:
    """A drive of these columns by time, the others as at the end of a drive on loam."""
    done = driven(config, seed, 3.0, None)
    rest = {name: np.resize(column[-1:], len(columns["t"])) for name, column in done.columns.items()}
    return replace(done, columns=rest | columns)


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
    """The motors of one axle give nothing though their limit says otherwise, and the most that is then pulled [N].

    Balanced by brute force, over slips of the other axle that swing between 0.15 and 0.5.
    """
    slips = np.array([0.12, 0.18, 0.27, 0.4, 0.6])
    found = [brute_with_rolling(SOILS[soil], slip, dead) for slip in slips]
    pulls = np.array([pull for pull, _ in found])
    rng = np.random.default_rng([seed, 3])
    t = np.arange(0.0, seconds, 1.0 / SAMPLE_RATE)
    phase = rng.uniform(0.0, 6.0, 2)
    slip = 0.325 + 0.0875 * (np.sin(0.7 * t + phase[0]) + np.sin(1.1 * t + phase[1]))
    columns = {"t": t, "ground_speed": 1.3 + 0.0 * t, "acceleration": 0.0 * t, "pitch": 0.0 * t}
    columns["draft"] = np.interp(slip, slips, pulls)
    for w in config.wheel:
        load, _, torque, angle, s = np.array([axles[str(w.axle)] for _, axles in found]).T
        of_wheel = {"load": load, "torque": torque, "sinkage": w.radius * (1.0 - np.cos(angle))}
        columns |= {f"{quantity}.{w.name}": np.interp(slip, slips, column) for quantity, column in of_wheel.items()}
        columns[f"speed.{w.name}"] = 1.3 / (w.radius * (1.0 - np.interp(slip, slips, s)))
    return told(as_driven(config, seed, columns), config, seed, 0.0), float(pulls.max())


def with_a_soft_side(config: Config, soft: str, seed: int, over: float = 3.0) -> tuple[Story, float, float]:
    """From loam, with the left wheels onto a softer soil within so many seconds, under a draft that is held.

    By brute force, all wheels at one slip.  Second and third the most that is pulled afterwards [N], and the draft [N].
    """
    firm, other = (np.log(np.array(SOILS[name])) for name in ("loam", soft))
    shares, slips = np.linspace(0.0, 1.0, 4), np.array([0.03, 0.07, 0.13, 0.22, 0.36, 0.6])
    table = [[_half_on(Soil(*np.exp(firm + share * (other - firm))), slip) for slip in slips] for share in shares]
    pulls = np.array([[pull for pull, _ in row] for row in table])
    begins, most = 14.0, float(pulls[-1].max())
    rng = np.random.default_rng([seed, 5])
    t = np.arange(0.0, begins + over + 3.0, 1.0 / SAMPLE_RATE)
    held = most * rng.uniform(0.90, 0.97)
    swing = held * (1.0 - 0.45 * (1.0 + np.sin(0.8 * t + rng.uniform(0.0, 6.0))) * np.clip(begins - t, 0.0, 1.0))
    share = np.clip((t - begins) / over, 0.0, 1.0)
    columns = {"t": t, "ground_speed": 1.3 + 0.0 * t, "acceleration": 0.0 * t, "pitch": 0.0 * t, "draft": swing}

    def along(values: np.ndarray) -> np.ndarray:
        """Values (share, slip) at each instant's share, over slip."""
        return np.array([[np.interp(s, shares, column) for column in values.T] for s in share])

    slip = np.array([np.interp(p, row, slips) for p, row in zip(swing, along(pulls), strict=True)])
    for i, w in enumerate(config.wheel):
        quantities = {q: np.array([[of[i][q] for _, of in row] for row in table]) for q in table[0][0][1][i]}
        for q, values in quantities.items():
            of_time = along(values)
            columns[f"{q}.{w.name}"] = np.array(
                [np.interp(s, slips, row) for s, row in zip(slip, of_time, strict=True)]
            )
        columns[f"speed.{w.name}"] = 1.3 / (w.radius * (1.0 - slip))
    return told(as_driven(config, seed, columns), config, seed, begins), most, held


def with_weak_motors(
    config: Config, weak: Sequence[str], soil: str, seed: int, ceiling: float = 900.0, seconds: float = 45.0
) -> tuple[Story, Callable[[float], float], float]:
    """Some wheels' motors give no more than `ceiling` [N m] though their limit says 2400; the draft rises and falls.

    Rim speeds are controlled, the ground speed is by the equation of motion, and the driver lifts what halves it.
    Second the mean draft [N] of the second before a time of the frames, third the most that is pulled steadily [N].
    """
    tables = {axle: _over_load_and_slip(SOILS[soil], *SIZES[axle]) for axle in SIZES}
    ceilings = [ceiling if w.name in weak else 2400.0 for w in config.wheel]
    mass, rim = WEIGHT / GRAVITY, 1.4

    def wheels(slip: float, draft: float, rate: float) -> list[np.ndarray]:
        """(pull, torque, angle, slip, load) of each wheel; a motor at its ceiling slips as much as that takes."""
        front = (WEIGHT * 0.95 - draft * 0.45 - mass * rate * 0.75) / 1.95
        loads = {"front": front / 2.0, "rear": (WEIGHT - front) / 2.0}
        over_slip = {axle: _at_load(tables[axle], load) for axle, load in loads.items()}
        found = []
        for w, most_torque in zip(config.wheel, ceilings, strict=True):
            pull, torque, angle = over_slip[str(w.axle)]
            s = min(slip, float(np.interp(most_torque, torque, SLIPS)))
            found.append(np.array([*(np.interp(s, SLIPS, q) for q in (pull, torque, angle)), s, loads[str(w.axle)]]))
        return found

    def steady(slip: float) -> float:
        pull = 0.0
        for _ in range(8):
            pull = float(sum(w[0] for w in wheels(slip, pull, 0.0)))
        return pull

    most = max(steady(slip) for slip in np.linspace(0.05, 0.6, 23))
    rng = np.random.default_rng([seed, 11])
    t = np.arange(0.0, seconds, 1.0 / SAMPLE_RATE)
    at = np.arange(0.0, seconds + 3.0, 2.5)
    wanted = np.interp(t, at, rng.uniform(0.3, 1.25, len(at)) * most)
    speed, rate, down, lifts = 0.95 * rim, 0.0, 1.0, False
    rows, drafts = [], []
    for wants in wanted.tolist():
        lifts = speed < (0.9 if lifts else 0.5) * rim
        down = max(down - 0.03, 0.0) if lifts else min(down + 0.01, 1.0)
        draft = down * wants + (1.0 - down) * min(wants, 0.25 * most)
        now = wheels(float(np.clip(1.0 - speed / rim, SLIPS[0], SLIPS[-1])), draft, rate)
        rate = float(np.clip((sum(w[0] for w in now) - draft) / mass, -2.5, 2.5))
        rows.append([speed, *np.ravel(now)])
        drafts.append(draft)
        speed = max(speed + rate / SAMPLE_RATE, 0.05)
    ground, by_wheel = np.array(rows)[:, 0], np.array(rows)[:, 1:].reshape(len(t), len(config.wheel), 5)
    columns = {"t": t, "ground_speed": ground, "acceleration": np.gradient(ground, t), "draft": np.array(drafts)}
    columns["pitch"] = 0.0 * t
    for i, w in enumerate(config.wheel):
        _, torque, angle, slip, load = by_wheel[:, i].T
        columns |= {f"torque.{w.name}": torque, f"load.{w.name}": load}
        columns[f"sinkage.{w.name}"] = w.radius * (1 - np.cos(angle))
        columns[f"speed.{w.name}"] = ground / (w.radius * (1.0 - slip))
    story = told(as_driven(config, seed, columns), config, seed, 0.0)

    def asked(at: float) -> float:
        since = at - story.begins
        return float(columns["draft"][(t > since - 1.0) & (t <= since)].mean())

    return story, asked, most


SIZES = {"front": (0.50, 0.26), "rear": (0.62, 0.38)}
LOADS = np.linspace(500.0, 12500.0, 9)
SLIPS = np.array([-0.12, -0.06, 0.0, 0.02, 0.04, 0.07, 0.1, 0.14, 0.19, 0.25, 0.33, 0.45, 0.6])


def _over_load_and_slip(soil: Soil, radius: float, width: float) -> np.ndarray:
    """Pull [N], torque [N m] and entry angle [rad] of one wheel (3, slip, load)."""
    sizes = np.full(len(LOADS), radius), np.full(len(LOADS), width)
    return np.stack([wheels(soil, LOADS, slip, *sizes)[1:] for slip in SLIPS], axis=1)


def _at_load(table: np.ndarray, load: float) -> np.ndarray:
    """The table over slip (3, slip) at a load [N], on straight lines between LOADS."""
    i = int(np.clip(np.searchsorted(LOADS, load) - 1, 0, len(LOADS) - 2))
    share = np.clip((load - LOADS[i]) / (LOADS[i + 1] - LOADS[i]), 0.0, 1.0)
    return np.asarray((1.0 - share) * table[..., i] + share * table[..., i + 1])


def _half_on(left: Soil, slip: float) -> tuple[float, list[dict[str, float]]]:
    """Level pull [N] with left wheels on a soil and right ones on loam, and each wheel's load, torque, sinkage."""
    radius, width = np.array(list(SIZES.values())).T

    def sides(pull: float) -> list[np.ndarray]:
        """(load, pull, torque, entry angle) of the front and the rear wheel (4, 2) on the left, and on the right."""
        front = (WEIGHT * 0.95 - pull * 0.45) / 1.95
        loads = np.array([front, WEIGHT - front]) / 2.0
        return [wheels(soil, loads, slip, radius, width) for soil in (left, SOILS["loam"])]

    pull = float(brentq(lambda p: sum(side[1].sum() for side in sides(p)) - p, -0.75 * WEIGHT, 0.6 * WEIGHT, xtol=1.0))
    load, _, torque, angle = np.stack(sides(pull), axis=2).reshape(4, -1)  # FL, FR, RL, RR
    depth = np.repeat(radius, 2) * (1.0 - np.cos(angle))
    return pull, [{"load": w, "torque": t, "sinkage": z} for w, t, z in zip(load, torque, depth, strict=True)]
