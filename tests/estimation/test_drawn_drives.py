"""Drives drawn at random, and their priors."""

from types import SimpleNamespace

import numpy as np
import pytest

from soilbus.estimation.assembly import prior_of
from soilbus.estimation.posterior import PARAMETERS, SoilPrior
from soilbus.simulator.drive import SimulationError
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import Patch, Scenario
from soilbus.terra.soils import SOILS
from soilbus.trials import draws
from soilbus.trials.draws import first_drive, prior_about

CONFIG = reference_configuration()


def test_drives_are_drawn_until_the_tractor_gets_on(monkeypatch):
    ends = iter([SimulationError("nothing moves"), 1.0, None, 1.0, 1.0])

    def simulated(config, scenario, seed):
        end = next(ends)
        if isinstance(end, Exception):
            raise end
        return SimpleNamespace(bogged_at=end)

    monkeypatch.setattr(draws, "simulate", simulated)
    drawn = iter(range(5))
    draw = lambda: (next(drawn), Scenario(2.0, (Patch(0.0, "wet_clay"),)))  # noqa: E731
    assert first_drive(CONFIG, draw, 5)[0] == 2
    with pytest.raises(SimulationError, match="stuck on wet_clay"):
        first_drive(CONFIG, draw, 5, 2)


def test_a_prior_misses_by_as_much_as_it_says():
    prior = prior_of(CONFIG)
    held = SoilPrior(prior.median, np.where(np.arange(6) == 4, 0.0, prior.log_std))
    soil, rng = SOILS["wet_clay"], np.random.default_rng(1)
    drawn = [prior_about(held, soil, rng) for _ in range(4000)]
    assert all((p.log_std == held.log_std).all() for p in drawn)
    miss = np.log(np.array([p.median for p in drawn]) / np.asarray(soil))
    assert miss.std(axis=0) == pytest.approx(held.log_std, rel=0.05)
    assert np.abs(miss.mean(axis=0)).max() < 0.08
    assert not miss[:, 4].any()
    phi = PARAMETERS.index("phi")
    steep = [prior_about(prior, soil._replace(phi=1.1), rng).median[phi] for _ in range(200)]
    assert max(steep) < 1.3  # well short of a right angle, where the model ends
