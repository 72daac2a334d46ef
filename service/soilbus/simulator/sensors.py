"""Simulated sensors: sampling rates, delays, effects on sensors, gain errors, noise.

    reading(t) = (1 + gain error) truth(t - delay) + sd e(t),    e ~ N(0, 1)
    sd^2 = absolute^2 + (relative truth)^2 + (of_mean window mean)^2

The gain error is drawn once for a drive from config [noise]. Quantisation comes with the frames (simulator/frames.py).
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from soilbus.arrays import Array
from soilbus.can.channels import Column
from soilbus.config.model import Config, Noise
from soilbus.simulator.drive import Drive
from soilbus.simulator.scenario import SAMPLE_RATE
from soilbus.terra.earth import SEMI_MAJOR_AXIS, wrapped
from soilbus.terra.effects.sensors import read_late

_RATE_DIVIDERS = {"ground_speed": 2, "latitude": 5, "longitude": 5}
"""Samples of the truth (50 Hz) per sample of the sensor: radars give 25 Hz, position receivers 10 Hz, others 50."""
POSITION_SD = 0.02
"""Standard deviation of a position, north and east [m]: a receiver with real-time corrections."""
_MEASURED_QUANTITY = {"motor_speed": "speed"}
"""Quantities that measure the same truth as another sensor, with the same noise."""
_NOISELESS = frozenset({"torque_limit"})  # sent by the motor controller, not measured


def channel_rng(seed: int, name: str) -> np.random.Generator:
    """Random numbers of one channel or message; they do not depend on which other channels exist."""
    return np.random.default_rng([seed, zlib.crc32(name.encode())])


def fitted(config: Config) -> Iterator[tuple[str, str]]:
    """(quantity, wheel or "") of every channel that the configuration maps."""
    for wheel in config.wheel:
        for quantity in ("torque", "speed", "load", "sinkage", "torque_limit", "motor_speed"):
            if getattr(wheel, quantity) is not None:
                yield quantity, wheel.name
    for quantity in ("ground_speed", "draft", "pitch", "acceleration", "yaw_rate", "latitude", "longitude"):
        if getattr(config.signals, quantity) is not None:
            yield quantity, ""


def measure(drive: Drive, config: Config, seed: int) -> dict[str, Column]:
    """Noisy samples of every mapped channel.

    Parameters
    ----------
    drive
        True values, with the effects that acted.
    config
        Maps channels; [noise] gives gain errors and noise, `delay` of a signal its delay [s].
    seed
        Picks gain errors and noise.

    Returns
    -------
    SI, by channel name (can.channels).
    """
    columns: dict[str, Column] = {}
    wheels = {wheel.name: wheel for wheel in config.wheel}
    t, true_columns = (
        drive.columns["t"],
        drive.columns | _with_sensor_effects(drive, [wheel.name for wheel in config.wheel]),
    )
    true_columns = true_columns | {"yaw_rate": np.zeros(len(t))}  # the drives are straight
    for quantity, wheel in fitted(config):
        name = f"{quantity}.{wheel}" if wheel else quantity
        every = slice(None, None, _RATE_DIVIDERS.get(quantity, 1))
        measured = _MEASURED_QUANTITY.get(quantity, quantity)
        truth, rng = true_columns[f"{measured}.{wheel}" if wheel else measured], channel_rng(seed, name)
        if (delay := getattr(wheels[wheel] if wheel else config.signals, quantity).delay) != 0.0:
            truth = np.interp(t - delay, t, truth)
        if quantity in ("latitude", "longitude"):
            parallel = 1.0 if quantity == "latitude" else np.cos(drive.columns["latitude"])
            truth = wrapped(truth + POSITION_SD / (SEMI_MAJOR_AXIS * parallel) * rng.standard_normal(len(t)))
        elif quantity not in _NOISELESS:
            truth = disturbed(truth, getattr(config.noise, measured), config.estimator.window, rng)
        columns[name] = Column(t[every].copy(), truth[every].copy())
    return columns


def _with_sensor_effects(drive: Drive, wheels: list[str]) -> dict[str, NDArray[Any]]:
    """Columns (N,) that effects on sensors change, before noise."""
    around = drive.surroundings
    torque, load = (np.stack([drive.columns[f"{q}.{wheel}"] for wheel in wheels], axis=1) for q in ("torque", "load"))
    draft = drive.columns["draft"]
    for effect, values in drive.effects:
        if effect.torque is not None:
            torque = effect.torque(torque, around, values)
        if effect.load is not None:
            load = load + effect.load(around, values)
        if effect.draft is not None:
            draft = draft + np.ravel(effect.draft(drive.columns["draft"], around, values))
    changed = {"draft": draft}
    for i, wheel in enumerate(wheels):
        changed |= {f"torque.{wheel}": torque[:, i], f"load.{wheel}": load[:, i]}
    return changed | _late(drive, drive.columns | changed, wheels)


def _late(drive: Drive, true_columns: dict[str, NDArray[Any]], wheels: list[str]) -> dict[str, NDArray[Any]]:
    """Columns (N,) of channels that an effect delays."""
    changed: dict[str, NDArray[Any]] = {}
    for effect, values in drive.effects:
        for quantity, late in effect.late.items():
            names = (
                [f"{quantity}.{wheel}" for wheel in wheels] if f"{quantity}.{wheels[0]}" in true_columns else [quantity]
            )
            columns = np.stack([changed.get(name, true_columns[name]) for name in names], axis=1)
            changed |= dict(zip(names, read_late(columns, true_columns["t"], values, late).T, strict=True))
    return changed


def disturbed(truth: Array, noise: Noise, window: float, rng: np.random.Generator) -> Array:
    """Truth with a gain error and noise.

    Parameters
    ----------
    truth
        (N,) at SAMPLE_RATE.
    noise
        Its sd; `of_mean` refers to the mean over the window.
    window
        [s].
    rng
        Picks gain error and noise.
    """
    gain = 1.0 + noise.gain * rng.standard_normal()
    mean = _running_mean(np.abs(truth), round(window * SAMPLE_RATE))
    sd = np.sqrt(noise.absolute**2 + (noise.relative * truth) ** 2 + (noise.of_mean * mean) ** 2)
    return np.asarray(gain * truth + sd * rng.standard_normal(len(truth)))


def _running_mean(values: Array, width: int) -> Array:
    """Mean over up to `width` samples around each one, fewer at the ends."""
    total = np.concatenate([[0.0], np.cumsum(values)])
    index = np.arange(len(values))
    first = np.maximum(index - width // 2, 0)
    last = np.minimum(first + max(width, 1), len(values))
    return np.asarray((total[last] - total[first]) / (last - first))
