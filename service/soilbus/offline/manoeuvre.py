"""What to drive next: the manoeuvre that is expected to settle an ambiguous diagnosis, or to determine a soil best.

    rivals   argmax over manoeuvres of  sum over rivals A of P(A) P(A named | S(A, .))  (S: diagnosis/separation.py)
    soil     argmin over manoeuvres of  sum of log sd of bearing pressure, phi and n    (D-optimum for what is free)

A manoeuvre is a table of steps of slip, ground speed, load from side to side, and slope.  Each candidate is simulated
without noise, as every rival in turn predicts it or on the soil found, and bounded by the vehicle's limits: slips up
to `traversability.max_slip`, torques up to those of the motors.  The search changes one column of the table at a time
and keeps what is best: one simulation for each pattern in place of one for each combination.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from soilbus.config.model import Config
from soilbus.diagnosis.diagnose import Diagnosis
from soilbus.diagnosis.options import DEFAULT
from soilbus.diagnosis.records import Record, TooLittle, record_of
from soilbus.diagnosis.separation import Truth, expected_posterior, expected_probability, separations, truths
from soilbus.estimation.assembly import effects_of, model_of, prior_of, rig_of
from soilbus.estimation.observation_with_effects import ObservationModelWithEffects
from soilbus.estimation.posterior import Posterior
from soilbus.sensors.bins import Bins
from soilbus.simulator.drive import SimulationError
from soilbus.simulator.manoeuvre import Manoeuvre
from soilbus.simulator.recording import Recording, simulate
from soilbus.simulator.scenario import Patch, Scenario
from soilbus.terra.wheel import Soil

STEP = 4.0
"""Time [s] of a step: as long as a time block of the diagnosis, several windows' bins at every step."""
RAMP = 1.0
"""Time [s] from one step to the next: at 1 m/s^2 a tractor changes its speed by what a step asks."""
BRISK_PERIOD = 2.0
"""Period [s] of a brisk swing: slow beside a sample, quick beside the lag of a sensor or a motor."""
MAX_REPEATS = 10
"""Repetitions beyond which a drive is no advice: eight minutes."""
LEAST_GAIN = 0.1
"""Gain of a score, a logarithm, for which a pattern takes the place of an easier one: a tenth."""
STEPS = 12
"""Steps of a manoeuvre: 48 s of driving."""


def _steps(levels: Sequence[float]) -> Callable[[float], float]:
    """Levels one after the other over and over, with ramps between them."""
    at = [t for i in range(STEPS) for t in (i * STEP, (i + 1) * STEP - RAMP)]
    value = [levels[i % len(levels)] for i in range(STEPS) for _ in range(2)]
    return lambda t: float(np.interp(t, at, value))


def _brisk(low: float, high: float) -> Callable[[float], float]:
    return lambda t: low + (high - low) * (0.5 - 0.5 * float(np.cos(2.0 * np.pi * t / BRISK_PERIOD)))


class Pattern(NamedTuple):
    """Course of one column: words, values by time, and whether these swing within a step."""

    words: str
    at: Callable[[float], float]
    is_brisk: bool = False


def patterns(max_slip: float) -> dict[str, list[Pattern]]:
    """Return the patterns that are tried for each column, the first to begin with."""
    top = 0.75 * max_slip
    return {
        "slip": [
            Pattern(f"slip in steps from 0.03 to {top:.2f}", _steps([0.03, 0.10, 0.20, top])),
            Pattern("slip in steps from 0.02 to 0.12", _steps([0.02, 0.05, 0.08, 0.12])),
            Pattern("slip up and down between 0.05 and 0.30 every two seconds", _brisk(0.05, 0.30), True),
        ],
        "speed": [
            Pattern("steady speed", _steps([1.2])),
            Pattern("speed in steps from 0.5 to 2 m/s", _steps([0.5, 1.0, 1.5, 2.0, 1.5, 1.0])),
            Pattern("speed up and down between 0.9 and 1.5 m/s every two seconds", _brisk(0.9, 1.5), True),
        ],
        "side_load": [
            Pattern("on the level", _steps([0.0])),
            Pattern("along a side slope, one way and back", _steps([0.3, 0.3, -0.3, -0.3])),
        ],
        "slope": [
            Pattern("", _steps([0.0])),
            Pattern("uphill and downhill by 5 per cent", _steps([0.05, 0.05, -0.05, -0.05])),
        ],
    }


def _manoeuvre(chosen: Mapping[str, Pattern]) -> Manoeuvre:
    """The table of these patterns: knots at steps and ramps, and eight a period where one is brisk."""
    knots = {0.0, STEPS * STEP, *(i * STEP for i in range(STEPS)), *((i + 1) * STEP - RAMP for i in range(STEPS))}
    if any(pattern.is_brisk for pattern in chosen.values()):
        knots |= set(np.arange(0.0, STEPS * STEP, BRISK_PERIOD / 8.0).tolist())
    t = tuple(sorted(knots))
    columns = {name: tuple(round(pattern.at(time), 4) for time in t) for name, pattern in chosen.items()}
    return Manoeuvre(t, **columns, words=", ".join(pattern.words for pattern in chosen.values() if pattern.words))


@dataclass(frozen=True, slots=True)
class Plan:
    """The manoeuvre, and between which names it decides.

    `separations` holds S by the name that is true and by its rival, `expected_probability` that of the right name after
    one such drive, whichever it is. After `repeats` drives, as S grows with the time, the right name stands alone; None
    for more than MAX_REPEATS.
    """

    manoeuvre: Manoeuvre
    between: tuple[str, ...]
    separations: Mapping[str, Mapping[str, float]]
    expected_probability: float
    repeats: int | None

    def as_json(self) -> dict[str, Any]:
        """Return the keys of `manoeuvre` in the JSON of a diagnosis."""
        return {
            "between": list(self.between),
            "separations": {name: dict(row) for name, row in self.separations.items()},
            "expected_probability": self.expected_probability,
            "repeats": self.repeats,
            **self.manoeuvre.as_json(),
        }


def what_to_drive(diagnosis: Diagnosis, config: Config) -> Plan | None:
    """Return the manoeuvre that best tells the rivals of a diagnosis apart.

    None where there are none, and for a vehicle that the simulator cannot drive.
    """
    if len(diagnosis.rivals) < 2 or config.vehicle is None:
        return None
    true = truths(diagnosis.rivals)
    names = tuple(one.name for one in true)
    least = min(diagnosis.additions, key=lambda a: a.probability if a.alternatives else np.inf)
    chances = {least.effect.name: least.probability, **least.alternatives}
    weight = np.array([chances[name] for name in names])

    def chance(found: Sequence[Sequence[float]], times: int = 1) -> float:
        """Expected probability of the right name after this number of drives."""
        rows = [{n: times * s for n, s in zip(names, row, strict=True)} for row in found]
        after = [expected_probability(least, name, row) for name, row in zip(names, rows, strict=True)]
        return float(weight @ after / weight.sum()) if after else 0.0

    def score(manoeuvre: Manoeuvre) -> float:
        found = _separations(diagnosis, config, manoeuvre, true)
        return -math.log(max(1.0 - chance(found), sys.float_info.epsilon)) if found else -np.inf

    best = _best(config, score)
    if best is None:
        return None
    found = _separations(diagnosis, config, best, true)
    enough = (times for times in range(1, MAX_REPEATS + 1) if chance(found, times) >= DEFAULT.named_probability)
    rows = {name: zip(names, row, strict=True) for name, row in zip(names, found, strict=True)}
    separations = {name: {other: s for other, s in row if other != name} for name, row in rows.items()}
    return Plan(best, names, separations, chance(found), next(enough, None))


def what_excites(config: Config, soil: Soil) -> tuple[Manoeuvre, Posterior] | None:
    """Return the manoeuvre that determines a soil best, and its expected posterior.

    None for a vehicle that the simulator cannot drive.
    """
    if config.vehicle is None:
        return None
    settings = config.estimator

    def expected(manoeuvre: Manoeuvre) -> Posterior | None:
        drive = _noise_free(config, manoeuvre, Truth("", soil, effects_of(config)))
        return None if drive is None else expected_posterior(drive, prior_of(config), soil)

    def precision(manoeuvre: Manoeuvre) -> float:
        posterior = expected(manoeuvre)
        if posterior is None:
            return -np.inf
        parameters, pressure = posterior.parameters(), posterior.bearing_pressure(settings.z_ref, settings.b_ref)
        free = {name for name in parameters if config.soil_prior[name].std > 0.0}
        stds = [parameters[name].std for name in ("phi", "n") if name in free]
        stds += [pressure.std] if free & {"k_c", "k_phi", "n"} else []
        return -sum(map(math.log, stds))

    found = _best(config, precision)
    posterior = None if found is None else expected(found)
    return None if found is None or posterior is None else (found, posterior)


def _best(config: Config, score: Callable[[Manoeuvre], float]) -> Manoeuvre | None:
    """The manoeuvre of the highest score, a logarithm, column after column; None where the best score is -inf."""
    columns = patterns(config.traversability.max_slip)
    chosen = {column: tried[0] for column, tried in columns.items()}
    best = score(_manoeuvre(chosen))
    for column, tried in columns.items():
        for pattern in tried[1:]:
            changed = {**chosen, column: pattern}
            found = score(_manoeuvre(changed))
            if found > best + LEAST_GAIN:
                best, chosen = found, changed
    return _manoeuvre(chosen) if np.isfinite(best) else None


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
    no_effects = config.model.model_copy(update={"effects": []})
    silent = config.model_copy(update={"noise": config.noise.scaled(0.0), "model": no_effects})
    ground = Scenario(manoeuvre.duration, (Patch(0.0, "the soil found", truth.soil),), slip_spread=0.0)
    scenario = manoeuvre.over(ground, config.tows_nothing)
    try:
        recording = simulate(silent, scenario, 0, truth.effects)
        true, wheels = recording.truth, [wheel.name for wheel in config.wheel]
        beyond_motors = any(bool(np.any(true[f"torque.{w}"] > true[f"torque_limit.{w}"])) for w in wheels)
        if recording.bogged_at is not None or beyond_motors:
            return None
        return record_of_recording("manoeuvre", recording, config).whole
    except (SimulationError, TooLittle):
        return None


def record_of_recording(name: str, recording: Recording, config: Config) -> Record:
    """Return a simulated recording in the form that the diagnosis takes; TooLittle without enough usable instants."""
    rig, settings = rig_of(config), config.estimator
    store = Bins(rig, settings.bin, 0.0)
    columns = {name: (c.t, c.value) for name, c in recording.channels.items() if name in rig.channels}
    store.add(columns)
    end = max(float(t[-1]) for t, _ in columns.values())
    return record_of(name, store.window(0.0, end), rig, model_of(config), settings.min_speed, settings.max_turn)
