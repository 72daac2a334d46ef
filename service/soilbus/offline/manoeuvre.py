"""What to drive next: the manoeuvre that is expected to settle an ambiguous diagnosis.

    best manoeuvre = argmax over manoeuvres of  min over rivals A, B of  S(A, B)      (S: diagnosis/separation.py)

A manoeuvre is a table of steps of slip, ground speed, load from side to side, and slope.  Each candidate is simulated
without noise as every rival in turn predicts it, and bounded by the vehicle's limits: slips up to
`traversability.max_slip`, torques up to those of the motors.  The search changes one column of the table at a time
and keeps what is best: one simulation for each pattern in place of one for each combination.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from soilbus.config.model import Config, Noise
from soilbus.diagnosis.diagnose import Diagnosis
from soilbus.diagnosis.records import Record, TooLittle, record_of
from soilbus.diagnosis.separation import Truth, expected_probability, separations, truths
from soilbus.estimation.assembly import model_of, prior_of, rig_of
from soilbus.estimation.observation_model import ObservationModelWithEffects
from soilbus.sensors.bins import Bins
from soilbus.simulator.drive import SimulationError
from soilbus.simulator.recording import Recording, simulate
from soilbus.simulator.scenario import Patch, Profile, Scenario

__all__ = ["Manoeuvre", "Plan", "of_json", "record_of_recording", "what_to_drive"]

STEP = 4.0
"""Time [s] of a step: as long as a time block of the diagnosis, several windows' bins at every step."""
RAMP = 1.0
"""Time [s] from one step to the next: at 1 m/s^2 a tractor changes its speed by what a step asks."""
BRISK_PERIOD = 2.0
"""Period [s] of a brisk swing: slow beside a sample, quick beside the lag of a sensor or a motor."""
STEPS = 12
"""Steps of a manoeuvre: 48 s of driving."""


@dataclass(frozen=True, slots=True)
class Manoeuvre:
    """Values at times, with straight lines between them.

    Attributes
    ----------
    t
        [s], ascending from 0.
    slip
        Common slip of the driven wheels.
    speed
        Ground speed [m/s].
    side_load
        Share of an axle's load that a side slope moves to its left wheel.
    slope
        [rad], uphill positive.
    words
        What varies, in words.
    """

    t: tuple[float, ...]
    slip: tuple[float, ...]
    speed: tuple[float, ...]
    side_load: tuple[float, ...]
    slope: tuple[float, ...]
    words: str

    @property
    def duration(self) -> float:
        """[s]."""
        return self.t[-1]

    def scenario(self, soil: Patch, nothing_towed: bool = False) -> Scenario:
        """The drive on one soil; a vehicle that tows nothing finds its own slopes for the slip."""
        t, speed = np.array(self.t), np.array(self.speed)
        distance = np.concatenate([[0.0], np.cumsum((speed[1:] + speed[:-1]) / 2.0 * np.diff(t))])
        slope = ((0.0, 0.0),) if nothing_towed else tuple(zip(distance.tolist(), self.slope, strict=True))
        return Scenario(
            self.duration,
            (soil,),
            speed=Profile(self.t, self.speed),
            slip=Profile(self.t, self.slip),
            side_shift=Profile(self.t, self.side_load),
            slope=slope,
        )

    def as_json(self) -> dict[str, Any]:
        """Plain objects, which of_json() reads."""
        return asdict(self)


def of_json(text: str) -> Manoeuvre:
    """A manoeuvre from JSON: of its own, or the `manoeuvre` of a diagnosis.

    Raises
    ------
    ValueError
        The text is no JSON, or has no manoeuvre.
    """
    document = json.loads(text)
    table = document.get("manoeuvre", document) if isinstance(document, Mapping) else None
    columns = ("t", "slip", "speed", "side_load", "slope")
    if not isinstance(table, Mapping) or not all(isinstance(table.get(name), list) for name in columns):
        raise ValueError(f"no manoeuvre in it: lists {', '.join(columns)}")
    rows = [tuple(float(x) for x in table[name]) for name in columns]
    lengths = {len(row) for row in rows}
    if len(lengths) != 1 or len(rows[0]) < 2 or any(b <= a for a, b in zip(rows[0], rows[0][1:], strict=False)):
        raise ValueError("lists of a manoeuvre are of one length, at ascending times")
    return Manoeuvre(*rows, str(table.get("words", "")))


def _steps(levels: Sequence[float]) -> Callable[[float], float]:
    """Levels one after the other over and over, with ramps between them."""
    at = [t for i in range(STEPS) for t in (i * STEP, (i + 1) * STEP - RAMP)]
    value = [levels[i % len(levels)] for i in range(STEPS) for _ in range(2)]
    return lambda t: float(np.interp(t, at, value))


def _brisk(low: float, high: float) -> Callable[[float], float]:
    return lambda t: low + (high - low) * (0.5 - 0.5 * float(np.cos(2.0 * np.pi * t / BRISK_PERIOD)))


Pattern = tuple[str, Callable[[float], float]]


def patterns(max_slip: float) -> dict[str, list[Pattern]]:
    """Of each column the patterns that are tried, the first of them to begin with."""
    top = 0.75 * max_slip
    return {
        "slip": [
            (f"slip in steps from 0.03 to {top:.2f}", _steps([0.03, 0.10, 0.20, top])),
            ("slip in steps from 0.02 to 0.12", _steps([0.02, 0.05, 0.08, 0.12])),
            ("slip up and down between 0.05 and 0.30 every two seconds", _brisk(0.05, 0.30)),
        ],
        "speed": [
            ("steady speed", _steps([1.2])),
            ("speed in steps from 0.5 to 2 m/s", _steps([0.5, 1.0, 1.5, 2.0, 1.5, 1.0])),
            ("speed up and down between 0.9 and 1.5 m/s every two seconds", _brisk(0.9, 1.5)),
        ],
        "side_load": [
            ("on the level", _steps([0.0])),
            ("along a side slope, one way and back", _steps([0.3, 0.3, -0.3, -0.3])),
        ],
        "slope": [("", _steps([0.0])), ("uphill and downhill by 5 per cent", _steps([0.05, 0.05, -0.05, -0.05]))],
    }


def _manoeuvre(chosen: Mapping[str, Pattern]) -> Manoeuvre:
    """The table of these patterns: knots at steps and ramps, and eight a period where one is brisk."""
    knots = {0.0, STEPS * STEP, *(i * STEP for i in range(STEPS)), *((i + 1) * STEP - RAMP for i in range(STEPS))}
    if any("every two seconds" in words for words, _ in chosen.values()):
        knots |= set(np.arange(0.0, STEPS * STEP, BRISK_PERIOD / 8.0).tolist())
    t = tuple(sorted(knots))
    columns = (tuple(round(of_time(at), 4) for at in t) for _, of_time in chosen.values())
    return Manoeuvre(t, *columns, ", ".join(words for words, _ in chosen.values() if words))


@dataclass(frozen=True, slots=True)
class Plan:
    """The manoeuvre, between which names it decides, and the least probability that the right one is to have then."""

    manoeuvre: Manoeuvre
    between: tuple[str, ...]
    separation: float
    expected_probability: float

    def as_json(self) -> dict[str, Any]:
        """Keys of `manoeuvre` in the JSON of a diagnosis."""
        return {
            "between": list(self.between),
            "separation": self.separation,
            "expected_probability": self.expected_probability,
            **self.manoeuvre.as_json(),
        }


def what_to_drive(diagnosis: Diagnosis, config: Config) -> Plan | None:
    """The manoeuvre that tells the rivals of an ambiguous diagnosis apart best; None where there are none.

    Parameters
    ----------
    diagnosis
        The diagnosis.
    config
        Its vehicle; None for one that the simulator cannot drive.
    """
    if len(diagnosis.rivals) < 2 or config.vehicle is None:
        return None
    true = truths(diagnosis.rivals)
    columns = patterns(config.traversability.max_slip)
    chosen = {column: tried[0] for column, tried in columns.items()}
    best = _separations(diagnosis, config, _manoeuvre(chosen), true)
    for column, tried in columns.items():
        for pattern in tried[1:]:
            changed = {**chosen, column: pattern}
            found = _separations(diagnosis, config, _manoeuvre(changed), true)
            if _least(found) > _least(best):
                best, chosen = found, changed
    if not best:
        return None
    least = min(diagnosis.additions, key=lambda a: a.probability if a.alternatives else np.inf)
    explained = diagnosis.base.neg2_log_evidence - diagnosis.completed.neg2_log_evidence - max(least.falls.values())
    names = tuple(one.name for one in true)
    chance = min(
        expected_probability(least, name, dict(zip(names, gains, strict=True)), max(explained, 0.0))
        for name, gains in zip(names, best, strict=True)
    )
    return Plan(_manoeuvre(chosen), names, _least(best), chance)


def _least(found: Sequence[Sequence[float]]) -> float:
    """The least S of two different rivals; -inf where the manoeuvre cannot be driven."""
    return min((gain for i, row in enumerate(found) for j, gain in enumerate(row) if i != j), default=-np.inf)


def _separations(
    diagnosis: Diagnosis, config: Config, manoeuvre: Manoeuvre, true: Sequence[Truth]
) -> list[tuple[float, ...]]:
    """S(A, B) of all rivals; empty where one of them cannot drive it within the vehicle's limits."""
    found = []
    for i, one in enumerate(true):
        drive = _noise_free(config, manoeuvre, one)
        if drive is None:
            return []
        found.append(separations(drive, prior_of(config), diagnosis.rivals, i))
    return found


def _noise_free(config: Config, manoeuvre: Manoeuvre, truth: Truth) -> ObservationModelWithEffects | None:
    """The manoeuvre as a rival predicts it; None where it cannot be driven."""
    quiet = {name: Noise.model_construct(absolute=0.0, relative=0.0, of_mean=0.0, gain=0.0) for name in
             type(config.noise).model_fields}  # fmt: skip
    silent = config.model_copy(
        update={
            "noise": config.noise.model_copy(update=quiet),
            "model": config.model.model_copy(update={"effects": []}),
        }
    )
    nothing_towed = config.vehicle is not None and config.vehicle.towing == "never"
    scenario = replace(manoeuvre.scenario(Patch(0.0, "the soil found", truth.soil), nothing_towed), slip_spread=0.0)
    try:
        recording = simulate(silent, scenario, 0, truth.effects)
        if recording.bogged_at is not None or _beyond_motors(recording, config):
            return None
        return record_of_recording("manoeuvre", recording, config).whole
    except (SimulationError, TooLittle):
        return None


def _beyond_motors(recording: Recording, config: Config) -> bool:
    """Whether a torque exceeds its motor's limit, where that is known."""
    pairs: Iterator[tuple[Any, Any]] = (
        (recording.truth[f"torque.{wheel.name}"], recording.truth[f"torque_limit.{wheel.name}"])
        for wheel in config.wheel
    )
    return any(bool(np.any(torque > limit)) for torque, limit in pairs)


def record_of_recording(name: str, recording: Recording, config: Config) -> Record:
    """A simulated recording as the diagnosis takes it.

    Raises
    ------
    TooLittle
        It has not enough usable instants.
    """
    rig, settings = rig_of(config), config.estimator
    store = Bins(rig, settings.bin, 0.0)
    columns = {name: (c.t, c.value) for name, c in recording.channels.items() if name in rig.channels}
    store.add(columns)
    end = max(float(t[-1]) for t, _ in columns.values())
    return record_of(name, store.window(0.0, end), rig, model_of(config), settings.min_speed, settings.max_turn)

