"""Simulated sensors: sampling rates, delays, effects on sensors, gain errors, noise.

    reading(t) = (1 + gain error) truth(t - delay) + sd e(t),    e ~ N(0, 1)
    sd^2 = absolute^2 + (relative truth)^2 + (of_mean window mean)^2

A torque or load of an axle is the sum over its wheels, a motor's speed and one signal mapped for several wheels are
means of theirs; a torque before a differential between the axles is that of its shaft. The gain error is drawn once
for a drive from config [noise]. Quantisation comes with the frames (simulator/frames.py).
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from soilbus.arrays import Array
from soilbus.can.channels import Column
from soilbus.can.mapping import AXLE_ROLES, LOCK, POSITION_ROLES, SHARED_ROLES, VEHICLE_ROLES, WHEEL_ROLES
from soilbus.config.model import Axle, Config, Noise, Signal, Wheel
from soilbus.simulator.drive import Drive, joined, latest
from soilbus.simulator.scenario import SAMPLE_RATE
from soilbus.terra.earth import SEMI_MAJOR_AXIS, wrapped
from soilbus.terra.effects.sensors import read_late
from soilbus.terra.vehicle import GRAVITY

_RATE_DIVIDERS = {"ground_speed": 2, "latitude": 5, "longitude": 5}
"""Samples of the truth (50 Hz) per sample of the sensor: radars give 25 Hz, position receivers 10 Hz, others 50."""
HISTORY = 10.0
"""Time [s] before a step that is kept: five of the longest time constants of `torque_lag` and `channel_lag`."""
POSITION_SD = 0.02
"""Standard deviation of a position, north and east [m]: a receiver with real-time corrections."""
_MEASURED_QUANTITY = {"motor_speed": "speed"}
"""Quantities that measure the same truth as another sensor, with the same noise."""
_NOISELESS = frozenset({"torque_limit", LOCK})
"""Sent by the motor controller or switched by the driver, not measured."""


def channel_rng(seed: int, name: str) -> np.random.Generator:
    """Return random numbers of one channel or message, whichever other channels exist."""
    return np.random.default_rng([seed, zlib.crc32(name.encode())])


class Sensor(NamedTuple):
    """A mapped signal: what it measures, of which wheel or axle ("": of the vehicle).

    weight: of the wheels' true values, by name of the wheel; empty where the truth is the vehicle's.
    """

    quantity: str
    part: str
    mapped: Signal
    weight: Mapping[str, float]

    @property
    def name(self) -> str:
        """Name of its channel."""
        return f"{self.quantity}.{self.part}" if self.part else self.quantity


def sensors(config: Config) -> Iterator[Sensor]:
    """Yield every sensor that the configuration maps, in the order of its channels."""
    for wheel in config.wheel:
        for quantity in WHEEL_ROLES:
            mapped = getattr(wheel, quantity)
            same = [wheel.name]
            if mapped is not None and quantity in SHARED_ROLES:
                same = next([w.name for w in of] for of in config.same_signal(quantity) if wheel in of)
            if mapped is not None and same[0] == wheel.name:
                yield Sensor(quantity, wheel.name, mapped, dict.fromkeys(same, 1.0 / len(same)))
    for axle in config.axle:
        for role, quantity in AXLE_ROLES.items():
            if (mapped := getattr(axle, role)) is not None:
                yield Sensor(quantity, axle.name, mapped, _of_axle(config, axle, quantity))
    for quantity in VEHICLE_ROLES:
        if (mapped := getattr(config.signals, quantity)) is not None:
            yield Sensor(quantity, "", mapped, {})
    if config.vehicle is not None and config.vehicle.differential_lock is not None:
        yield Sensor(LOCK, "", config.vehicle.differential_lock, {})


def _of_axle(config: Config, axle: Axle, quantity: str) -> dict[str, float]:
    """Weights of the wheels in a quantity of an axle, or of the shaft that drives both."""
    wheels = [w for w in config.wheel if axle.name in ("both", w.axle) and (w.driven or quantity == "load")]

    def turns(wheel: Wheel) -> float:
        """Of the shaft for one of the wheel."""
        own = config.axle_named(wheel.axle) if axle.name == "both" else None
        return 1.0 if own is None else own.gear_ratio

    if quantity == "speed":
        return {wheel.name: turns(wheel) / len(wheels) for wheel in wheels}
    return {wheel.name: 1.0 if quantity == "load" else 1.0 / turns(wheel) for wheel in wheels}


def measure(drive: Drive, config: Config, seed: int, vehicle_seed: int | None = None) -> dict[str, Column]:
    """Return the noisy samples of every mapped channel in SI, by channel name, of the true values of a drive.

    [noise] gives gain errors and noise, `delay` of a signal its delay [s]. The seed picks both, `vehicle_seed` gain
    errors in its place.
    """
    return Instruments(config, seed, vehicle_seed).measure(drive)


class Instruments:
    """Sensors of one vehicle, which measure a drive step by step (see `measure`).

    Gain errors are drawn once and noise goes on from step to step. What delays and low passes need of the time before a
    step is kept for HISTORY seconds.
    """

    def __init__(self, config: Config, seed: int, vehicle_seed: int | None = None) -> None:
        self._config = config
        self._limits = {axle.name: axle.max_torque or np.nan for axle in config.axle}
        self._sensors = list(sensors(config))
        self._noise = {sensor.name: channel_rng(seed, sensor.name) for sensor in self._sensors}
        self._gain = {
            sensor.name: _noise_of(config, sensor).gain
            * (self._noise[sensor.name] if vehicle_seed is None else channel_rng(vehicle_seed, sensor.name))
            .standard_normal()
            for sensor in self._sensors
            if sensor.quantity not in POSITION_ROLES and sensor.quantity not in _NOISELESS
        }  # fmt: skip
        self._before: Drive | None = None
        self._seen = 0

    def measure(self, step: Drive) -> dict[str, Column]:
        """Return the samples of the next step of a drive, as `measure`."""
        n = len(step.columns["t"])
        known = step if self._before is None else joined([self._before, step])
        self._before = latest(known, round(HISTORY * SAMPLE_RATE))
        t, true_columns = known.columns["t"], known.columns | _with_sensor_effects(known, self._config)
        columns: dict[str, Column] = {}
        for sensor in self._sensors:
            divider = _RATE_DIVIDERS.get(sensor.quantity, 1)
            every = slice(-self._seen % divider, None, divider)
            read = self._read(sensor, t, true_columns, n)
            columns[sensor.name] = Column(t[len(t) - n :][every].copy(), read[every].copy())
        self._seen += n
        return columns

    def _read(self, sensor: Sensor, t: Array, true_columns: Mapping[str, NDArray[Any]], n: int) -> Array:
        """The last n readings at 50 Hz."""
        quantity, rng, new = sensor.quantity, self._noise[sensor.name], slice(len(t) - n, None)
        if quantity == "torque_limit" and sensor.part in self._limits:
            truth = np.full_like(t, self._limits[sensor.part])
        else:
            truth = true_reading(true_columns, quantity, sensor.weight)
        if sensor.mapped.delay != 0.0:
            truth = np.interp(t - sensor.mapped.delay, t, truth)
        if quantity in _NOISELESS:
            return truth[new]
        if quantity in POSITION_ROLES:
            parallel = 1.0 if quantity == "latitude" else np.cos(true_columns["latitude"][new])
            return wrapped(truth[new] + POSITION_SD / (SEMI_MAJOR_AXIS * parallel) * rng.standard_normal(n))
        sd = noise_sd(truth, _noise_of(self._config, sensor), self._config.estimator.window)[new]
        return np.asarray((1.0 + self._gain[sensor.name]) * truth[new] + sd * rng.standard_normal(n))


def _noise_of(config: Config, sensor: Sensor) -> Noise:
    noise: Noise = getattr(config.noise, _MEASURED_QUANTITY.get(sensor.quantity, sensor.quantity))
    return noise


def true_speed(true_columns: Mapping[str, NDArray[Any]], config: Config, part: str) -> Array:
    """Return the rotation [rad/s] (N,) of a wheel, or the mean of an axle's wheels."""
    axle = next((axle for axle in config.axle if axle.name == part), None)
    weight = {part: 1.0} if axle is None else _of_axle(config, axle, "speed")
    return true_reading(true_columns, "speed", weight)


def straight_on(true_columns: Mapping[str, NDArray[Any]], config: Config) -> dict[str, NDArray[Any]]:
    """Return the acceleration (N,) as its sensor feels it, and what is zero on a straight way."""
    felt = dict.fromkeys(("yaw_rate", "steering_angle", LOCK), np.zeros(len(true_columns["t"])))
    mapped = config.signals.acceleration
    if mapped is not None and mapped.kind == "specific_force":
        felt["acceleration"] = true_columns["acceleration"] + GRAVITY * np.sin(true_columns["pitch"])
    return felt


def true_reading(true_columns: Mapping[str, NDArray[Any]], quantity: str, weight: Mapping[str, float]) -> Array:
    """Return what a sensor without errors reads (N,) of a quantity, by the weights of the wheels, if any."""
    quantity = _MEASURED_QUANTITY.get(quantity, quantity)
    if not weight:
        return np.asarray(true_columns[quantity])
    first, *others = (share * true_columns[f"{quantity}.{wheel}"] for wheel, share in weight.items())
    return np.asarray(sum(others, start=first))


def _with_sensor_effects(drive: Drive, config: Config) -> dict[str, NDArray[Any]]:
    """Columns (N,) that sensors see by effects and gravity, before noise, and those that are zero on a straight way."""
    around, wheels = drive.surroundings, [wheel.name for wheel in config.wheel]
    torque, load = (np.stack([drive.columns[f"{q}.{wheel}"] for wheel in wheels], axis=1) for q in ("torque", "load"))
    draft = drive.columns["draft"]
    for effect, values in drive.effects:
        if effect.torque is not None:
            torque = effect.torque(torque, around, values)
        if effect.load is not None:
            load = load + effect.load(around, values)
        if effect.draft is not None:
            draft = draft + np.ravel(effect.draft(drive.columns["draft"], around, values))
    changed = {"draft": draft} | straight_on(drive.columns, config)
    for i, wheel in enumerate(wheels):
        changed |= {f"torque.{wheel}": torque[:, i], f"load.{wheel}": load[:, i]}
    return changed | _late(drive, drive.columns | changed, wheels)


def _late(drive: Drive, true_columns: dict[str, NDArray[Any]], wheels: list[str]) -> dict[str, NDArray[Any]]:
    """Columns (N,) of channels that an effect delays."""
    changed: dict[str, NDArray[Any]] = {}
    for effect, values in drive.effects:
        for quantity, late in effect.late.items():
            of_wheels = [f"{quantity}.{wheel}" for wheel in wheels]
            names = of_wheels if of_wheels[0] in true_columns else [quantity]
            columns = np.stack([changed.get(name, true_columns[name]) for name in names], axis=1)
            changed |= dict(zip(names, read_late(columns, true_columns["t"], values, late).T, strict=True))
    return changed


def noise_sd(truth: Array, noise: Noise, window: float) -> Array:
    """Return the standard deviation of the noise of each reading.

    Parameters
    ----------
    truth
        (N,) at SAMPLE_RATE.
    noise
        Its sd; `of_mean` refers to the mean over the window.
    window
        [s].
    """
    mean = _running_mean(np.abs(truth), round(window * SAMPLE_RATE))
    return np.sqrt(noise.absolute**2 + (noise.relative * truth) ** 2 + (noise.of_mean * mean) ** 2)


def _running_mean(values: Array, width: int) -> Array:
    """Mean over up to `width` samples around each one, fewer at the ends."""
    total = np.concatenate([[0.0], np.cumsum(values)])
    index = np.arange(len(values))
    first = np.maximum(index - width // 2, 0)
    last = np.minimum(first + max(width, 1), len(values))
    return np.asarray((total[last] - total[first]) / (last - first))
