"""Windows of simulated channels: in bins, as observations, and as tasks for the service's own estimator."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from soilbus.can.channels import Column
from soilbus.config.model import Config
from soilbus.diagnosis.joint_fit import Start, fit_jointly
from soilbus.estimation.assembly import model_of, rig_of
from soilbus.estimation.gaussian import Gaussian
from soilbus.estimation.instrumentation import completed
from soilbus.estimation.multistart import Fit
from soilbus.estimation.observation_model import ObservationModel
from soilbus.estimation.options import ESTIMATOR, EstimatorOptions
from soilbus.estimation.posterior import SoilPrior
from soilbus.estimation.window import Rig, Window, forward
from soilbus.pipeline.intake import ReportedLimits, WindowTask
from soilbus.sensors.bins import Bins
from soilbus.simulator.recording import Recording
from soilbus.terra.wheel import Soil


def bins_of(config: Config, channels: Mapping[str, Column]) -> Bins:
    """Return the samples of those channels that the configured rig has, in bins from 0 s on."""
    rig = rig_of(config)
    bins = Bins(rig, config.estimator.bin, 0.0)
    bins.add({name: (c.t, c.value) for name in rig.channels if (c := channels.get(name)) is not None})
    return bins


def observed(
    config: Config, channels: Mapping[str, Column], duration: float, options: EstimatorOptions = ESTIMATOR
) -> ObservationModel:
    """Return the first `duration` [s] of the channels as one window to be fitted, without effects."""
    window = bins_of(config, channels).window(0.0, duration)
    return ObservationModel(window, rig_of(config, options), model_of(config), config.estimator.min_speed)


def torque_limits(config: Config, rig: Rig) -> NDArray[np.float64]:
    """Return the limits (W,) [N m] that the service takes where none is reported."""
    return ReportedLimits(config, rig).at(0.0)


def task_of(window: Window, end: float, config: Config, torque_limit: NDArray[np.float64], fresh: bool) -> WindowTask:
    """Return the task of a window that ends at `end` [s], without missing inputs.

    torque_limit (W,) [N m] is nan where it is unknown; `fresh` carries nothing over from the window before.
    """
    return WindowTask(
        index=0 if fresh else round((end - config.estimator.window) / config.estimator.hop),
        start=end - config.estimator.window,
        end=end,
        window=window,
        slip={wheel.name: None for wheel in config.wheel},
        torque_limit=torque_limit,
        fresh=fresh,
    )


def first_window(config: Config, recording: Recording, torque_limit: NDArray[np.float64]) -> WindowTask:
    """Return the task of a recording's first window, with nothing carried over from before."""
    end = config.estimator.window
    window = completed(forward(bins_of(config, recording.channels).window(0.0, end)), rig_of(config))
    return task_of(window, end, config, torque_limit, fresh=True)


def fit_from_soil(problem: ObservationModel, prior: SoilPrior, start: Soil) -> Fit | None:
    """Return the fit of a window from one soil, first alone, then all together; None where numbers are not finite."""
    gains, joint_prior = np.zeros(len(problem.gain_std)), Gaussian.of(prior, problem.gain_std)
    begin = Start(np.where(prior.log_std > 0.0, np.asarray(start, float), prior.median), gains)
    fits = fit_jointly([problem], prior, [joint_prior], gains > 0.0, [begin], problem.options.search.cold)
    return None if fits is None else fits[0]
