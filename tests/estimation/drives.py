"""Simulated drives as the tracker sees them, window by window."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from soilbus.assembly import model_of, prior_of, rig_of
from soilbus.config import Config
from soilbus.estimation.posterior import Posterior
from soilbus.estimation.tracker import Settings, Tracker
from soilbus.estimation.window import BinStore, Window
from soilbus.simulator.recording import Recording
from soilbus.terra.wheel import Soil

Z_REF, B_REF = 0.02, 0.3


def tracker_of(config: Config) -> Tracker:
    """A tracker as the service makes it."""
    s = config.estimator
    return Tracker(
        rig_of(config), prior_of(config), model_of(config),
        Settings(s.window, s.min_speed, s.max_turn, s.max_chi2, s.soil_drift),
    )  # fmt: skip


def windows(config: Config, recording: Recording) -> Iterator[tuple[Window, float]]:
    """Each window of a recording with its end [s]."""
    rig, length = rig_of(config), config.estimator.window
    store = BinStore(rig, config.estimator.bin, 0.0)
    store.add({n: (c.t, c.value) for n, c in recording.channels.items() if n in rig.channels})
    for end in np.arange(length, recording.truth["t"][-1] + 0.05, config.estimator.hop).tolist():
        yield store.window(end - length, end), end


def errors(posterior: Posterior, soil: Soil) -> np.ndarray:
    """Errors (2,) of bearing pressure and tan phi, in their standard deviations."""
    told = posterior.bearing_pressure(Z_REF, B_REF), posterior.tan_phi()
    truth = soil.bearing_pressure(Z_REF, B_REF), np.tan(soil.phi)
    return np.array([(estimate.value - value) / estimate.std for estimate, value in zip(told, truth, strict=True)])
