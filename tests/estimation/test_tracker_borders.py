"""How soon a new soil is estimated, and whether its intervals hold.

A window is valid once it determines the bearing pressure of a plate at a given depth.  It determines the pressure under
its own tyres at about half their sinkage, and tan phi, sooner, even where loads hardly change.
"""

from typing import NamedTuple

import numpy as np
import pytest

from driven_windows import errors, task_of, windows
from soilbus.decision.traversability import Status
from soilbus.estimation.posterior import Posterior
from soilbus.pipeline.estimator import WindowEstimator
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import Patch, Scenario, Swing, soil_along
from soilbus.terra.wheel import Soil

CONFIG = reference_configuration()
VEHICLE = CONFIG.vehicle
SPEED, TRANSITION, BEFORE, AFTER = 1.5, 1.0, 15.0, 3.0
"""Speed [m/s], length of the border [m], seconds on the first soil, at least, and on the second."""
SPREAD = 2.0
"""Seconds over which the times of the border vary: windows end at whole ones."""
OF_THIS_SOIL = ("none", "not_excited load_range", "not_excited slip_range", "not_excited load_range slip_range")
"""Reasons of windows whose estimate is of the soil under the wheels."""
KNOWN = 0.10
"""Relative standard deviation up to which something is known."""
BEST_DEPTH = 0.45
"""Depth, in units of a wheel's sinkage, at which it determines the pressure under it best."""


class Seen(NamedTuple):
    """What one window says; t [s] since the last wheel left the border.

    away: error of bearing pressure and tan phi, the larger one, in standard deviations, from the
    soil anywhere between the axles; nan without an estimate.
    of_tyres and sd_of_tyres: error, and relative sd, of the pressure under each tyre and tan phi, the larger ones.
    """

    t: float
    valid: bool
    reason: str
    away: float
    of_tyres: float
    sd_of_tyres: float

    @property
    def knows_tyres(self) -> bool:
        """Whether what the tyres measure, of this soil, is known."""
        return self.reason in OF_THIS_SOIL and self.sd_of_tyres < KNOWN


def crossed(pair: str, seed: int) -> list[Seen]:
    """The windows of a drive over a border."""
    first, second = pair.split(":")
    behind = VEHICLE.cg_ahead_of_rear_axle
    reached = BEFORE + SPREAD * float(np.random.default_rng([seed, 7]).random())
    soils = (Patch(0.0, first), Patch(reached * SPEED + VEHICLE.wheelbase - behind, second))
    left = reached + (TRANSITION + VEHICLE.wheelbase) / SPEED
    speed, slip = Swing(SPEED, SPEED + 1e-6), Swing(0.05, 0.40)
    scenario = Scenario(left + AFTER + 1.0, soils, speed, slip=slip, transition=TRANSITION)
    recording, seen = simulate(CONFIG, scenario, seed), []
    estimator, between = WindowEstimator(CONFIG), np.linspace(-behind, VEHICLE.wheelbase - behind, 17)
    for window, end in windows(CONFIG, recording):
        result = estimator.estimate(task_of(window, end, CONFIG, index=round(end - CONFIG.estimator.window))).result
        place = np.interp(end, recording.truth["t"], recording.truth["distance"])
        under = np.transpose(soil_along(soils, place + between, TRANSITION))
        posterior, away, of_tyres = result.posterior, np.nan, (np.nan, np.nan)
        if posterior is not None and result.bearing is not None:
            soils_under = [Soil(*map(float, soil)) for soil in under]
            away = min(float(np.abs(errors(posterior, soil)).max()) for soil in soils_under)
            depth = {wheel.width: BEST_DEPTH * (result.sinkage[wheel.name] or np.nan) for wheel in CONFIG.wheel}
            of_tyres = errors_of_tyres(posterior, soils_under, depth)
        seen.append(Seen(end - left, result.status is Status.VALID, result.reason, away, *of_tyres))
    return seen


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


@pytest.mark.parametrize("pair", ["loam:clayey_soil_38", "wet_clay:loam"])
def test_a_new_soil_is_valid_within_two_seconds_of_its_border(pair):
    for seed in range(3):
        valid = [w for w in crossed(pair, seed) if w.valid]
        assert min(w.t for w in valid if w.t > 0.0) <= 2.0
        assert all(w.away < 3.0 for w in valid)


# What the form leaves open takes a hop more on one of three seeds.
@pytest.mark.parametrize(("seed", "latest"), [(103, 2.0), (106, 2.0), (108, 3.0)])
def test_on_wet_clay_it_is_known_by_then_however_badly(seed, latest):
    # Intervals by the posterior alone were 2.3 to 4.3 sd off there, and all such windows had to wait.
    seen = crossed("loam:wet_clay", seed)
    of_tyres = [w for w in seen if w.knows_tyres]
    assert min(w.t for w in of_tyres if w.t > 0.0) <= latest
    assert all(w.of_tyres < 3.0 for w in of_tyres)
    known = [w for w in seen if w.t > 1.0]
    assert known[0].t <= 2.0
    for w in known:
        assert w.reason in ("none", "not_excited load_range")
        assert w.away < 3.0
