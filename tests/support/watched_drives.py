"""The watch for immobilisation on simulated drives, with options that may differ from the service's."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from soilbus.arrays import Array
from soilbus.config.model import Config
from soilbus.decision.capability import OverSlip
from soilbus.decision.moments import Moment, Sample, bins_of_a_moment, moments
from soilbus.decision.options import WATCH, WatchOptions
from soilbus.decision.watch import Alert, Watch, watched
from soilbus.estimation.assembly import rig_of
from soilbus.estimation.instrumentation import completed
from soilbus.estimation.window import forward
from soilbus.pipeline.estimator import WindowEstimator
from soilbus.terra.vehicle import GRAVITY
from soilbus.trials.bogging_trials import Drive, Task, WarningTrial, driven, rated
from soilbus.trials.windows import bins_of, task_of, torque_limits


def look(t: float, slip: float | None, pull: float | None, inertia: float = 0.0) -> Moment:
    """What a vehicle of 2300 kg at 1 m/s shows at a slip and a pull [N]; None: not known."""
    weight, given = 2300.0 * GRAVITY, math.nan if pull is None else pull
    common = slip if slip is not None and slip < 1.0 else math.nan
    rim = 1.0 / (1.0 - common)
    last = Sample(t, 1.0, 1e-4, rim, 1e-4, given / weight, draft=(given - inertia) / weight)
    return Moment(t, 1.0, [rim] * 4, 0.0, False, last=last, common=common, given=given, inertia=inertia, mass=2300.0)


class Observation(NamedTuple):
    """One drive as the watch sees it.

    Attributes
    ----------
    drive
        When it is watched, and how it ends.
    moments
        What the watch reads at each look.
    curves
        Times [s] from which on a curve of pull over slip is known, and the curve.
    config
        Of the vehicle.
    """

    drive: Drive
    moments: list[Moment]
    curves: list[tuple[float, OverSlip]]
    config: Config = Config()


def observed(task: Task) -> Observation:
    """Simulate one drive and estimate every hop."""
    config, (recording, drive) = task.config, driven(task)
    rig, settings = rig_of(config), config.estimator
    estimator, limit = WindowEstimator(config), torque_limits(config, rig)
    store = bins_of(config, recording.channels)
    curves = []
    for due in np.arange(settings.window, drive.end, settings.hop).tolist():
        window = completed(forward(store.window(due - settings.window, due)), rig)
        result = estimator.solve_unwatched(task_of(window, due, config, limit, fresh=due == settings.window))
        if result.curve is not None:
            curves.append((due, result.curve))
    seen = completed(forward(store.window(0.0, drive.end)), rig)
    bins, ends = bins_of_a_moment(settings.bin), np.arange(len(seen.t))
    return Observation(drive, moments(seen, rig, limit, config, ends, bins), curves, config)


def watch(observation: Observation, options: WatchOptions = WATCH) -> tuple[Array, NDArray[np.bool_]]:
    """Times [s] (N,) of the looks, and whether each warned."""
    state, curve, curves, out = Watch(), None, iter(observation.curves), []
    due = next(curves, None)
    for moment in observation.moments:
        while due is not None and moment.t >= due[0]:
            curve, due = due[1], next(curves, None)
        state = watched(state, moment, curve, observation.config, options)
        out.append((moment.t, state.warning is Alert.IMMOBILISATION))
    t, warned = np.array(out, float).reshape(-1, 2).T
    return t, warned > 0.5


def judged(kind: str, observation: Observation, options: WatchOptions = WATCH) -> WarningTrial:
    """The trial's result from what the watch saw."""
    t, warned = watch(observation, options)
    return rated(kind, observation.drive, t[1:][warned[1:] & ~warned[:-1]].tolist(), bool(warned[-1]))
