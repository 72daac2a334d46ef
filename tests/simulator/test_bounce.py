"""Loads of a simulated drive that bounce: how much, how fast, and alike on an axle but for its roll."""

import numpy as np
import pytest

from soilbus.simulator.drive import drive
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import Patch, Scenario, Swing


def test_loads_bounce_by_the_given_share_at_a_few_hertz():
    config = reference_configuration()
    even = {"slip": Swing(0.2, 0.2), "slip_spread": 0.0, "side_shift": Swing(0.0, 0.0), "speed": Swing(1.2, 1.2)}
    still, rough = (
        drive(config, Scenario(60.0, (Patch(0.0, "loam"),), bounce=share, **even), 3).columns for share in (0.0, 0.08)
    )
    shaken = {w: rough[f"load.{w}"] / still[f"load.{w}"].mean() - 1.0 for w in ("FL", "FR", "RL", "RR")}
    for wheel, share in shaken.items():
        assert np.std(share) == pytest.approx(0.08, rel=0.3), wheel
        power = np.abs(np.fft.rfft(share - share.mean())) ** 2
        hertz = np.fft.rfftfreq(len(share), 0.02)
        assert 1.2 < (power @ hertz) / power.sum() < 3.5
    assert np.std(shaken["FL"] - shaken["RL"]) > 0.05  # axles bounce each by itself
