"""The intake's own ear for sensors that lie: what `estimation.plausibility` must know besides the window."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np
from cantools.database.can import Database
from numpy.typing import NDArray

from soilbus.can.channels import Channel
from soilbus.config import Estimator
from soilbus.estimation.plausibility import implausible, without
from soilbus.estimation.scene import Resolution
from soilbus.estimation.window import Rig, Window

Array = NDArray[np.float64]

MOTOR_SPEED = "motor_speed"


class Screened(NamedTuple):
    """A window without the channels that lie in it, and which these are."""

    window: Window
    implausible: tuple[str, ...]


class Plausibility:
    """Judges windows; the speeds of the motors, which no estimate needs, are kept here."""

    def __init__(self, rig: Rig, channels: Iterable[Channel], database: Database, settings: Estimator) -> None:
        self._rig, self._settings = rig, settings
        listed = tuple(channels)
        self._resolution = {c.name: resolution_of(c, database) for c in listed}
        self._motors = [w for w in rig.wheels if any(c.name == f"{MOTOR_SPEED}.{w}" for c in listed)]
        self.forget()

    def forget(self) -> None:
        """Begin anew."""
        self._heard: dict[str, list[tuple[Array, Array]]] = {wheel: [] for wheel in self._motors}

    def add(self, samples: Mapping[str, tuple[Array, Array]]) -> None:
        """Samples (t [s], value in SI; both (N,)) by channel; only the motors' speeds are kept."""
        for wheel, heard in self._heard.items():
            if found := samples.get(f"{MOTOR_SPEED}.{wheel}"):
                heard.append(found)

    def screened(self, window: Window) -> Screened:
        """A forward window (`window.forward`) without what lies in it."""
        s = self._settings
        names = implausible(
            window, self._rig, s.min_speed, s.max_turn, s.bin, self._resolution, self._motor_speed(window)
        )  # fmt: skip
        return Screened(without(window, self._rig, set(names)), names)

    def drop_before(self, t: float) -> None:
        """Forget what was heard before t [s]."""
        for wheel, heard in self._heard.items():
            self._heard[wheel] = [part for part in heard if part[0][-1] >= t]

    def _motor_speed(self, window: Window) -> Array | None:
        """Mean speeds [rad/s] of the motors in the window's bins (N, W), forward; nan where unknown."""
        if not self._motors or not len(window.t):
            return None
        n = len(window.t)
        speed = np.full((n, len(self._rig.wheels)), np.nan)
        begin = window.t[0] - self._settings.bin / 2.0
        for wheel, heard in self._heard.items():
            if not heard:
                continue
            t, value = (np.concatenate(parts) for parts in zip(*heard, strict=True))
            bins = np.floor((t - begin) / self._settings.bin + 1e-6).astype(np.intp)
            inside = (bins >= 0) & (bins < n)
            count = np.bincount(bins[inside], minlength=n)
            total = np.bincount(bins[inside], np.abs(value[inside]), minlength=n)
            with np.errstate(invalid="ignore", divide="ignore"):
                speed[:, self._rig.wheels.index(wheel)] = total / count
        return speed


def resolution_of(channel: Channel, database: Database) -> Resolution:
    """The step of a channel's signal in SI, and whether zero is the end of its range."""
    signal = database.get_message_by_name(channel.message).get_signal_by_name(channel.signal)
    step = 0.0 if signal.conversion.is_float else abs(channel.factor * float(signal.scale))
    ends = (signal.minimum, signal.maximum)
    unsigned = not signal.is_signed and float(signal.offset) == 0.0
    return Resolution(step, unsigned or any(end is not None and float(end) == 0.0 for end in ends))
