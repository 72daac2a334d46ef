"""Simulated drives as the daemon's estimator and the tracker see them, window by window."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace

import numpy as np

from soilbus.can.channels import Column, Decoded
from soilbus.can.dbc_files import load_databases
from soilbus.config.model import Config
from soilbus.estimation.assembly import model_of, prior_of, rig_of
from soilbus.estimation.multistart import Fit
from soilbus.estimation.observation_model import ObservationModel
from soilbus.estimation.posterior import Posterior
from soilbus.estimation.tracker import Settings, Tracker
from soilbus.estimation.window import Window
from soilbus.pipeline.intake import WindowTask
from soilbus.pipeline.pipeline import Pipeline
from soilbus.pipeline.result import WindowResult
from soilbus.simulator.recording import Recording, simulate
from soilbus.simulator.scenario import Patch, Scenario, Swing, soil_along
from soilbus.simulator.sensors import sensors, straight_on, true_reading
from soilbus.terra.soils import SOILS
from soilbus.terra.wheel import Soil
from soilbus.trials import windows as service_windows

Z_REF, B_REF = 0.02, 0.3
NAMES = ("loam", "wet_clay", "dry_sand")
EXCITED, LEANING = Swing(0.05, 0.40), Swing(-0.15, 0.15)
"""Slip of a drive, and the share of an axle's load that it shifts from side to side."""


def constant(slip: float) -> Swing:
    """A swing of no amplitude about this slip."""
    return Swing(slip, slip + 1e-6)


def c_and_K_known(soil: str) -> list[str]:
    """Settings by which c and K of a soil are known to 25 %."""
    values = {name: getattr(SOILS[soil], name) for name in ("c", "K")}
    return [f"soil.{name}.{key}={v * f}" for name, v in values.items() for key, f in (("value", 1.0), ("std", 0.25))]


def c_and_K_missed(soil: Soil, seed: int) -> list[str]:
    """Settings by which c and K of a soil are known to 25 %, and told off by as much."""
    miss = np.exp(np.sqrt(np.log1p(0.25**2)) * np.random.default_rng([seed, 77]).standard_normal(2))
    means = {"c": soil.c * miss[0], "K": soil.K * miss[1]}
    return [f"soil.{name}.{key}={v * f}" for name, v in means.items() for key, f in (("value", 1.0), ("std", 0.25))]


def observed_window(
    config: Config, soil: str, seconds: float = 10.0, slip: Swing = EXCITED, sinkage: bool = True, seed: int = 1,
    side_shift: Swing = LEANING,
) -> ObservationModel:  # fmt: skip
    """The window of a simulated drive on a soil of the table."""
    scenario = Scenario(seconds, (Patch(0.0, soil),), slip=slip, side_shift=side_shift)
    channels = simulate(config, scenario, seed).channels
    wanted = {name: c for name, c in channels.items() if sinkage or not name.startswith("sinkage")}
    return service_windows.observed(config, wanted, seconds)


def tracker_of(config: Config) -> Tracker:
    """A tracker as the service makes it."""
    s = config.estimator
    return Tracker(
        rig_of(config), prior_of(config), model_of(config),
        Settings(s.window, s.min_speed, s.max_turn, s.soil_drift, hop=s.hop),
    )  # fmt: skip


def windows(config: Config, recording: Recording) -> Iterator[tuple[Window, float]]:
    """Each window of a recording with its end [s]."""
    store, length = service_windows.bins_of(config, recording.channels), config.estimator.window
    for end in np.arange(length, recording.truth["t"][-1] + 0.05, config.estimator.hop).tolist():
        yield store.window(end - length, end), end


def last_fit(config: Config, recording: Recording) -> Fit:
    """What a tracker has fitted at the end of a recording."""
    tracker, output = tracker_of(config), None
    for window, end in windows(config, recording):
        output = tracker.estimate(window, end)
    assert output is not None
    assert output.fit is not None
    return output.fit


def results_of(config: Config, channels: Mapping[str, Column], duration: float) -> list[WindowResult]:
    """What the pipeline says of channels, of which it gets what it knows second by second."""
    pipeline = Pipeline(config, load_databases(config))
    known = {name: column for name, column in channels.items() if name in pipeline.intake.rig.channels}
    results: list[WindowResult] = []
    for since in np.arange(0.0, duration, 1.0).tolist():
        now = {name: (c.t >= since) & (c.t < since + 1.0) for name, c in known.items()}
        pipeline.intake.add(Decoded({name: Column(c.t[now[name]], c.value[now[name]]) for name, c in known.items()}))
        results += pipeline.advance(since + 1.0)
    return results


def errors(posterior: Posterior, soil: Soil) -> np.ndarray:
    """Errors (2,) of bearing pressure and tan phi, in their standard deviations."""
    estimates = posterior.bearing_pressure(Z_REF, B_REF), posterior.tan_phi()
    truth = soil.bearing_pressure(Z_REF, B_REF), np.tan(soil.phi)
    return np.array([(estimate.value - value) / estimate.std for estimate, value in zip(estimates, truth, strict=True)])


def soils_under(recording: Recording, scenario: Scenario, end: float, places: Iterable[float] = (0.0,)) -> list[Soil]:
    """The true soils at a time [s], at places so far [m] ahead of the vehicle's."""
    here = np.interp(end, recording.truth["t"], recording.truth["distance"])
    columns = soil_along(scenario.soils, here + np.array([*places]), scenario.transition)
    return [Soil(*map(float, soil)) for soil in np.transpose(columns)]


def task_of(window: Window, end: float, config: Config, index: int = 0) -> WindowTask:
    """What the intake says of a window of which nothing is missing; the first has index 0."""
    no_limit = np.full(len(config.wheel), np.nan)
    return replace(service_windows.task_of(window, end, config, no_limit, fresh=index == 0), index=index)


def tasks(config: Config, scenario: Scenario, seed: int, without: str = "none") -> Iterator[WindowTask]:
    """The windows of a drive, hop by hop, but for the channels of one quantity."""
    channels = simulate(config, scenario, seed).channels
    wanted = {name: c for name, c in channels.items() if name.partition(".")[0] != without}
    store, length = service_windows.bins_of(config, wanted), config.estimator.window
    for i, end in enumerate(np.arange(length, scenario.duration + 0.05, config.estimator.hop).tolist()):
        yield task_of(store.window(end - length, end), end, config, i)


def exact(recording: Recording, config: Config, names: Iterable[str]) -> dict[str, Column]:
    """What sensors without errors and effects would have read at the times of these channels' samples."""
    truth, times = recording.truth, {name: recording.channels[name].t for name in names}
    columns, of_channel = truth | straight_on(truth, config), {sensor.name: sensor for sensor in sensors(config)}
    readings = {name: true_reading(columns, of_channel[name].quantity, of_channel[name].weight) for name in times}
    return {name: Column(t, np.interp(t, truth["t"], readings[name])) for name, t in times.items()}
