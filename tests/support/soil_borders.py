"""Drives over borders: how soon a valid estimate of the new soil comes, and whether any valid one is wrong.

A window is valid once it determines the bearing pressure of a plate at a given depth.  It determines the pressure under
its own tyres at about half their sinkage, and tan phi, sooner, even where loads hardly change.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from cramer_rao import cramer_rao
from driven_windows import errors, exact, task_of, windows
from soilbus.config.model import Config, Vehicle
from soilbus.decision.traversability import Status
from soilbus.estimation.assembly import model_of, prior_of, rig_of
from soilbus.estimation.change_detection import Transition, without_transition
from soilbus.estimation.observation_with_effects import ObservationModelWithEffects
from soilbus.estimation.posterior import Posterior
from soilbus.estimation.tracker import new_soil_prior
from soilbus.pipeline.estimator import WindowEstimator
from soilbus.simulator.recording import Recording, simulate
from soilbus.simulator.scenario import Patch, Scenario, Swing, soil_along
from soilbus.terra.wheel import Soil
from soilbus.trials.windows import bins_of

BEFORE, AFTER = 15.0, 10.0
"""Seconds on the first soil, at least, and on the second."""
SPREAD = 2.0
"""Seconds over which the times of the border vary: windows end at whole ones."""
WRONG = 3.0
"""Standard deviations."""
OF_THIS_SOIL = ("none", "not_excited load_range", "not_excited slip_range", "not_excited load_range slip_range")
"""Reasons of windows whose estimate is of the soil under the wheels."""
KNOWN = 0.10
"""Relative standard deviation up to which something is known."""
BEST_DEPTH = 0.45
"""Depth, in units of a wheel's sinkage, at which it determines the pressure under it best."""


class Seen(NamedTuple):
    """What one window says; t [s] since the last wheel left the border.

    away: error of bearing pressure and tan phi, the larger one, in standard deviations, from the
    soil anywhere between the axles; nan without an estimate.  sd: that of bearing pressure over its value.
    of_tyres and sd_of_tyres: the same of the pressure under each tyre and tan phi, the larger ones.
    """

    t: float
    valid: bool
    reason: str
    away: float
    sd: float
    of_tyres: float
    sd_of_tyres: float

    @property
    def knows_tyres(self) -> bool:
        """Whether what the tyres measure, of this soil, is known."""
        return self.reason in OF_THIS_SOIL and self.sd_of_tyres < KNOWN


class Drive(NamedTuple):
    """What is driven and measured; the first wheels are on the second soil from `on`, the last from `left` [s]."""

    recording: Recording
    soils: tuple[Patch, Patch]
    on: float
    left: float


def drive(config: Config, pair: str, speed: float, transition: float, seed: int, after: float = AFTER) -> Drive:
    """A drive at a constant speed [m/s] over a border of some length [m], and some seconds after it."""
    first, second = pair.split(":")
    vehicle = _vehicle(config)
    reached = BEFORE + SPREAD * float(np.random.default_rng([seed, 7]).random())
    at = reached * speed + vehicle.wheelbase - vehicle.cg_ahead_of_rear_axle
    soils = (Patch(0.0, first), Patch(at, second))
    on = reached + transition / speed
    left = on + vehicle.wheelbase / speed
    scenario = Scenario(
        left + after + 1.0, soils, Swing(speed, speed + 1e-6), slip=Swing(0.05, 0.40), transition=transition
    )
    return Drive(simulate(config, scenario, seed), soils, on, left)


def crossed(config: Config, pair: str, speed: float, transition: float, seed: int, after: float = AFTER) -> list[Seen]:
    """The windows of such a drive."""
    recording, soils, _, left = drive(config, pair, speed, transition, seed, after)
    vehicle = _vehicle(config)
    behind = vehicle.cg_ahead_of_rear_axle
    estimator, between = WindowEstimator(config), np.linspace(-behind, vehicle.wheelbase - behind, 17)
    seen = []
    for window, end in windows(config, recording):
        result = estimator.estimate(task_of(window, end, config, index=round(end - config.estimator.window))).result
        place = np.interp(end, recording.truth["t"], recording.truth["distance"])
        under = np.transpose(soil_along(soils, place + between, transition))
        posterior, away, sd, of_tyres = result.posterior, np.nan, np.nan, (np.nan, np.nan)
        if posterior is not None and result.bearing is not None:
            soils_under = [Soil(*map(float, soil)) for soil in under]
            away = min(float(np.abs(errors(posterior, soil)).max()) for soil in soils_under)
            sd = result.bearing.std / result.bearing.value
            depth = {wheel.width: BEST_DEPTH * (result.sinkage[wheel.name] or np.nan) for wheel in config.wheel}
            of_tyres = errors_of_tyres(posterior, soils_under, depth)
        seen.append(Seen(end - left, result.status is Status.VALID, result.reason, away, sd, *of_tyres))
    return seen


def _vehicle(config: Config) -> Vehicle:
    """The vehicle of the reference tractor, not of a rig."""
    assert config.vehicle is not None
    return config.vehicle


def errors_of_tyres(posterior: Posterior, soils: list[Soil], depth: dict[float, float]) -> tuple[float, float]:
    """Error of what the tyres measure from the nearest soil, in standard deviations, and the largest relative sd.

    Of tan phi and of the pressure under tyres by their width [m], at these depths [m].
    """
    seen = [posterior.tan_phi(), *(posterior.bearing_pressure(z, b) for b, z in depth.items())]
    away = [
        max(abs(one.value - true) / one.std for one, true in zip(seen, truth, strict=True))
        for truth in ([np.tan(soil.phi), *(soil.bearing_pressure(z, b) for b, z in depth.items())] for soil in soils)
    ]
    return min(away), max(one.std / one.value for one in seen)


def least_sd(config: Config, driven: Drive, t: float) -> float:
    """Relative sd of the bearing pressure that no unbiased estimate goes below t [s] after the last wheel's border.

    The Cramér-Rao bound of all that the wheels measured on the second soil, where the
    border is known, and the sensors' gain errors.
    """
    recording, end = driven.recording, driven.left + t
    rig = rig_of(config)
    rig = replace(rig, noise={name: noise._replace(gain=0.0) for name, noise in rig.noise.items()})
    store = bins_of(config, exact(recording, config, recording.channels))
    border = Transition(driven.on, driven.on, driven.left - driven.on)
    window = without_transition(store.window(driven.on, end), border, rig.ahead)
    settings = config.estimator
    problem = ObservationModelWithEffects(window, rig, model_of(config), settings.min_speed, settings.max_turn)
    bound = cramer_rao(problem, new_soil_prior(prior_of(config)), driven.soils[1].parameters())
    bearing = bound.bearing_pressure(settings.z_ref, settings.b_ref)
    return bearing.std / bearing.value


def first_valid(seen: list[Seen]) -> float:
    """Seconds from the border until a window is valid; inf if none is."""
    return min((w.t for w in seen if w.valid and w.t > 0.0), default=np.inf)


def first_of_tyres(seen: list[Seen]) -> float:
    """Seconds from the border until a window knows what its tyres measure to a tenth; inf if none does."""
    return min((w.t for w in seen if w.knows_tyres and w.t > 0.0), default=np.inf)


def wrong_of_tyres(seen: list[Seen]) -> list[Seen]:
    """Windows that know what their tyres measure, and are beyond what they say."""
    return [w for w in seen if w.knows_tyres and not w.of_tyres < WRONG]


def wrong(seen: list[Seen]) -> list[Seen]:
    """Windows that are valid and beyond what they say."""
    return [w for w in seen if w.valid and not w.away < WRONG]
