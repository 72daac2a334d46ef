"""What the can room works on: channels, their samples, and why a sample was refused."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

WHOLE = ""
"""Name of the signal that is the whole of its message: a column of a table."""


class Reason(StrEnum):
    """Reason why a frame or a value was not admitted; each is counted."""

    WRONG_LENGTH = "wrong_length"
    WRONG_SOURCE = "wrong_source"
    BAD_CHECKSUM = "bad_checksum"
    BAD_COUNTER = "bad_counter"
    SECOND_SENDER = "second_sender"
    DUPLICATE = "duplicate"
    REMOTE_FRAME = "remote_frame"
    TIME_BACKWARDS = "time_backwards"
    BAD_TIME = "bad_time"
    NOT_AVAILABLE = "not_available"
    ERROR = "error"
    RESERVED = "reserved"
    OUT_OF_RANGE = "out_of_range"
    SATURATED = "saturated"
    NOT_FINITE = "not_finite"
    IMPLAUSIBLE = "implausible"
    NOT_VALID = "not_valid"


def path_of(message: str, signal: str) -> str:
    """Return `Message.Signal`, or the name of a column."""
    return message if signal == WHOLE else f"{message}.{signal}"


@dataclass(frozen=True, slots=True)
class Channel:
    """One quantity and the signal that carries it: value in SI = factor * physical value of the DBC + offset.

    Values outside low..high (SI) are implausible.  `valid_signal` (same message) must hold one of `valid_values` (raw
    codes).  `quantity` is the role, e.g. "torque"; `wheel` the wheel's name or "" for the vehicle.  What a sample
    reports was true `delay` [s] before its stamp; `key` of the configuration maps it.
    """

    quantity: str
    wheel: str
    message: str
    signal: str
    factor: float
    offset: float
    low: float
    high: float
    valid_signal: str | None = None
    valid_values: tuple[int, ...] = ()
    timeout: float | None = None
    delay: float = 0.0
    key: str = ""

    @property
    def name(self) -> str:
        """Name such as "torque.FL", or "draft" for a channel of the whole vehicle."""
        return f"{self.quantity}.{self.wheel}" if self.wheel else self.quantity

    @property
    def path(self) -> str:
        """`Message.Signal`, or the name of a column."""
        return path_of(self.message, self.signal)


@dataclass(slots=True)
class Column:
    """Admitted samples of one channel: times t [s] (N,), values (N,) in SI."""

    t: NDArray[np.float64]
    value: NDArray[np.float64]


@dataclass(slots=True)
class Decoded:
    """Admitted samples by channel, times of refused ones by channel and reason, and refused ones without a time."""

    columns: dict[str, Column] = field(default_factory=dict)
    refused: dict[tuple[str, Reason], NDArray[np.float64]] = field(default_factory=dict)
    untimed: Counter[Reason] = field(default_factory=Counter)
