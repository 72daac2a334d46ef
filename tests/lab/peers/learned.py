"""A regressor trained on simulated windows.

Xue, Li, Zou, Zong & Huang 2016 (Aerosp. Sci. Technol. 53:154): least-squares support
vector machine; kernel ridge regression with a Gaussian kernel is the same estimator but
for its offset, here removed with the targets' mean.  Assumes: soils to come are drawn from
the prior that it was trained on; nothing else is known (c and K as given are features, so
that it knows as much as ours).  Hyper-parameters by cross validation.  No error bars.

Training windows come from a light generator, not from the full simulator: random smooth
slips and side slopes, loads balanced with the draft in one pass, the wheel model and the
noise of the sensors on top.  The windows it is tested on come from the full simulator.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from soilbus.arrays import Array
from soilbus.estimation.observation_model import ObservationModel
from soilbus.estimation.posterior import PARAMETERS, Estimate, SoilPrior
from soilbus.estimation.window import Rig, SensorNoise, window_of_samples
from soilbus.simulator.scenario import Swing, realise
from soilbus.terra.entry_angle import entry_angle_for_load
from soilbus.terra.vehicle import axle_loads
from soilbus.terra.wheel import Soil, sinkage, state_on, wheel_forces
from tests.lab.peers.windows import (
    B_REF,
    LENGTH,
    Z_REF,
    Answer,
    Case,
    assumed_of,
    configured_prior,
    fit_model,
    reference_rig,
)

TARGETS = ("bearing", "phi", "n", "c", "K")
SEED = 1_000_000
"""Seeds of training windows start here, those of test windows far below."""
INSTANTS = 50
MEAN_SLIP = 0.2
SAMPLES = {"ground_speed": 5.0}
"""Samples of the tractor's sensors in an instant of a training window; 10 of the others."""
GRID = {"kernelridge__alpha": np.logspace(-4, -1, 4), "kernelridge__gamma": np.logspace(-4, -1, 7)}


@dataclass(frozen=True)
class Regressor:
    """Features -> logarithms of TARGETS."""

    search: Any
    mean: Array

    def estimate(self, case: Case) -> Answer | None:
        """Point estimates of the targets."""
        logs = self.search.predict(features(case.problem, case.known)[None])[0] + self.mean
        return {name: Estimate(float(np.exp(v)), np.nan) for name, v in zip(TARGETS, logs, strict=True)}


def trained(windows: int) -> Regressor:
    """Train on this number of windows.  ModuleNotFoundError, with a line for the user, without scikit-learn."""
    try:
        from sklearn.kernel_ridge import KernelRidge
        from sklearn.model_selection import GridSearchCV
        from sklearn.pipeline import make_pipeline
        from sklearn.preprocessing import StandardScaler
    except ModuleNotFoundError:
        raise ModuleNotFoundError("the learned regressor needs the extra soilbus[peers]") from None
    pairs = [training_case(np.random.default_rng([SEED, i])) for i in range(windows)]
    X = np.array([features(case.problem, case.assumed) for case in pairs])
    y = np.log([targets(case.soil) for case in pairs])
    machine = make_pipeline(StandardScaler(), KernelRidge(kernel="rbf"))
    search = GridSearchCV(machine, GRID, scoring="neg_mean_squared_error", cv=5)
    return Regressor(search.fit(X, y - y.mean(0)), y.mean(0))


def targets(soil: Soil) -> list[float]:
    """Truth of TARGETS."""
    return [soil.bearing_pressure(Z_REF, B_REF), *(getattr(soil, name) for name in TARGETS[1:])]


def features(problem: ObservationModel, assumed: Soil) -> Array:
    """How sinkage, torque and pull depend on slip and load in this window, and c and K as given."""
    thrust = problem.torque / problem.rig.radius / problem.load
    log_sinkage = np.log(np.maximum(problem.sinkage, 1e-3))
    rows = []
    for axle in (problem.rig.front, ~problem.rig.front):
        slip, load = problem.slip[:, axle].ravel() - MEAN_SLIP, problem.load[:, axle].ravel()
        regressors = np.stack([np.ones_like(slip), slip, slip**2, np.log(load / load.mean())], axis=1)
        rows += [np.linalg.lstsq(regressors, y[:, axle].ravel(), rcond=None)[0] for y in (log_sinkage, thrust)]
        rows.append([np.log(load.mean())])
    slip = problem.slip.mean(1) - MEAN_SLIP
    pull = problem.demand / problem.load.sum(1)
    rows.append(np.linalg.lstsq(np.stack([np.ones_like(slip), slip, slip**2], axis=1), pull, rcond=None)[0])
    rows.append([np.log(assumed.c), np.log(assumed.K)])
    return np.concatenate(rows)


def training_case(rng: np.random.Generator) -> Case:
    """A window on a soil drawn from the configuration's prior; soils that carry no tractor are drawn again."""
    rig = reference_rig()
    prior = SoilPrior.from_value_std(configured_prior())
    while True:
        soil = Soil(*(prior.median * np.exp(prior.log_std * rng.standard_normal(len(PARAMETERS)))).tolist())
        truth = _drive(rig, soil, rng) if soil.phi < 1.0 else None
        if truth is not None:
            break
    t, samples = truth
    fewer = {q: _averaged(noise, SAMPLES.get(q, 10.0)) for q, noise in rig.noise.items()}
    window = window_of_samples(replace(rig, noise=fewer), t, _noisy(samples, fewer, rng))
    return Case(soil, assumed_of(soil, rng), frozenset(), ObservationModel(window, rig, fit_model(), 0.2))


def _averaged(noise: SensorNoise, samples: float) -> SensorNoise:
    """Noise of the mean of some samples; a gain error is the same in each."""
    root = float(np.sqrt(samples))
    return SensorNoise(noise.absolute / root, noise.relative / root, noise.of_mean / root, noise.gain)


def _drive(rig: Rig, soil: Soil, rng: np.random.Generator) -> tuple[Array, dict[str, Array]] | None:
    """Times and true columns by channel; None where the soil does not carry the wheels."""
    assert rig.chassis is not None
    t = np.linspace(0.0, LENGTH, INSTANTS)
    common, side = realise(Swing(0.05, 0.40), t, rng).value, realise(Swing(-0.15, 0.15), t, rng).value
    spread = [realise(Swing(-0.015, 0.015), t, rng).value for _ in rig.wheels]
    slip = common[:, None] + np.stack(spread, axis=1)
    speed = realise(Swing(1.0, 1.8), t, rng)
    share = (1.0 + side[:, None] * np.array([1.0, -1.0, 1.0, -1.0])) / 2.0
    draft, angle = np.zeros(INSTANTS), np.full(slip.shape, np.nan)
    for _ in range(2):  # loads without draft, then with it
        front, rear = axle_loads(rig.chassis, draft, 0.0, speed.rate)
        load = share * np.where(rig.front, front[:, None], rear[:, None])
        state = state_on(soil, angle, slip, rig.radius, rig.width)
        angle = entry_angle_for_load(load, state, fit_model(), tolerance=1e-6)
        if not np.all(angle < 1.0):
            return None
        _, pull, torque = wheel_forces(state._replace(entry_angle=angle), fit_model())
        draft = pull.sum(1) - rig.chassis.mass * speed.rate
    turning = speed.value[:, None] / (rig.radius * (1.0 - slip))
    by_wheel = {"torque": torque, "load": load, "speed": turning, "sinkage": sinkage(angle, rig.radius)}
    columns = {f"{q}.{w}": column[:, i] for q, column in by_wheel.items() for i, w in enumerate(rig.wheels)}
    rest = {"ground_speed": speed.value, "draft": draft, "pitch": np.zeros(INSTANTS), "acceleration": speed.rate}
    return t, columns | rest


def _noisy(samples: dict[str, Array], noise: dict[str, SensorNoise], rng: np.random.Generator) -> dict[str, Array]:
    out = {}
    for name, truth in samples.items():
        n = noise[name.partition(".")[0]]
        sd = np.sqrt(n.absolute**2 + (n.relative * truth) ** 2 + (n.of_mean * np.abs(truth).mean()) ** 2)
        out[name] = truth * (1.0 + n.gain * rng.standard_normal()) + sd * rng.standard_normal(len(truth))
    return out
