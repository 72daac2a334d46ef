"""Are reported class probabilities calibrated?  Simulated windows on soils drawn from the classes and `unknown`.

`python -m tests.lab.class_reliability 300 [--seconds 10] [--slip 0.4]` prints the table.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from soilbus.config.model import Config
from soilbus.estimation.assembly import prior_of, rig_of
from soilbus.estimation.multistart import fit_window
from soilbus.estimation.observation_model import ObservationModel
from soilbus.estimation.options import ESTIMATOR, SearchOptions
from soilbus.estimation.soil_classes import PRIOR_UNKNOWN, SoilClasses
from soilbus.simulator.drive import SimulationError
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import Patch, Scenario, Swing
from soilbus.terra.soils import UNKNOWN
from soilbus.terra.wheel import Soil
from soilbus.trials.windows import observed

__all__ = [
    "WIDE_COHESION",
    "Prediction",
    "drawn",
    "driven",
    "shortfall",
    "windows",
]

WIDE_COHESION = ("soil.c.value=5000", "soil.c.std=8000")
"""The table has cohesions up to 69 kPa, 23 times the default prior's median."""
EDGES = (0.0, 0.02, 0.1, 0.3, 0.5, 0.7, 0.9, 0.98, 1.0)


class Prediction(NamedTuple):
    """Class probabilities of a window, and the class of its soil."""

    probability: dict[str, float]
    truth: str


def drawn(classes: SoilClasses, rng: np.random.Generator) -> tuple[str, Soil | None]:
    """A class by its prior probability, and a soil of it; None where that is not physical."""
    known = len(classes.names) - 1
    i = known if rng.random() < PRIOR_UNKNOWN else int(rng.integers(known))
    log_k_c, log_p, *logs = classes.centre[i] + classes.spread[i] * rng.standard_normal(6)
    k_c, (n, phi, c, K) = math.exp(log_k_c), np.exp(logs).tolist()
    k_phi = math.exp(log_p) / SearchOptions().typical_depth ** n - k_c / classes.width
    soil = Soil(k_c, k_phi, n, phi, c, K)
    return classes.names[i], soil if k_phi > 0.0 and phi < 1.2 else None


def windows(count: int, seed: int, seconds: float, slip: float = 0.4) -> Iterator[Prediction]:
    """Predictions for `count` drawn soils, without those that the tractor cannot drive on."""
    config = reference_configuration(WIDE_COHESION)
    classes, prior = SoilClasses.of_table(float(rig_of(config).width.mean())), prior_of(config)
    for i in range(count):
        truth, soil = drawn(classes, np.random.default_rng([seed, i]))
        problem = None if soil is None else driven(config, soil, [seed, i], seconds, slip)
        fit = None if problem is None else fit_window(problem, prior)
        if (
            fit is None
            or not fit.converged
            or fit.chi2 > 1.1 + ESTIMATOR.tracker.mismatch_sd * math.sqrt(2.0 / fit.rows)
        ):
            continue  # the service reports such a window as degraded or invalid
        yield Prediction(classes.probabilities(fit.posterior, prior), truth)


def driven(config: Config, soil: Soil, seed: list[int], seconds: float, slip: float = 0.4) -> ObservationModel | None:
    """One window on a soil; None where the tractor cannot drive on it."""
    scenario = Scenario(seconds, (Patch(0.0, "this", soil),), slip=Swing(0.05, slip))
    try:
        recording = simulate(config, scenario, int(np.random.SeedSequence(seed).generate_state(1)[0]))
    except SimulationError:
        return None
    if recording.bogged_at is not None:
        return None
    return observed(config, recording.channels, seconds)


def shortfall(predictions: list[Prediction]) -> float:
    """Brier score above its expectation by the probabilities, in sd of chance."""
    got = promised = variance = 0.0
    for probability, truth in predictions:
        p = np.array([*probability.values()])
        got += probability[truth]
        promised += p @ p
        variance += p @ p**2 - (p @ p) ** 2
    return (promised - got) / math.sqrt(variance)


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("count", type=int)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--slip", type=float, default=0.4)
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    predictions = list(windows(args.count, args.seed, args.seconds, args.slip))
    first = [(max(p.values()), next(iter(p)) == truth) for p, truth in predictions]
    unknown = [(p[UNKNOWN], truth == UNKNOWN) for p, truth in predictions]
    every = [(value, name == truth) for p, truth in predictions for name, value in p.items()]
    right = np.mean([r for _, r in first])
    print(f"{len(predictions)} of {args.count} windows; the likeliest class is right in {right:.1%}")
    brier = np.mean([1.0 + sum(q**2 for q in p.values()) - 2.0 * p[truth] for p, truth in predictions])
    print(f"Brier score {brier:.3f}; above its expectation by {shortfall(predictions):+.1f} standard deviations")
    for title, pairs in (("likeliest", first), ("unknown", unknown), ("every class", every)):
        print(f"\n{title:<12}  windows  mean   true   by chance +-")
        for low, high in pairwise(EDGES):
            part = np.array([pair for pair in pairs if low <= pair[0] < high or pair[0] == high == 1.0], float)
            if len(part):
                (p, true), n = part.T, len(part)
                chance = math.sqrt((p * (1.0 - p)).sum()) / n
                print(f"{low:.2f} - {high:.2f}  {n:7d}  {p.mean():.3f}  {true.mean():.3f}  {chance:.3f}")


if __name__ == "__main__":
    main()
