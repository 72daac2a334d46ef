"""Simulated sensor series -> CAN frames of the vehicle's own DBC, in the order of their stamps.

    raw code = round((value - offset) / scale),    stamp = start + sample time + phase of the message + jitter

Each message is sent at the rate of its fastest mapped channel. Its signals that nothing is mapped to are "not
available", save those that follow from the drive. Frames of all messages come in the order of their stamps.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any

import can
import numpy as np
from cantools.database import Database
from cantools.database.can import Message, Signal
from numpy.typing import NDArray

from soilbus.arrays import Array
from soilbus.can.channels import Channel, Column
from soilbus.can.checksum import COUNTER, checksum_byte, column_checksums
from soilbus.can.dbc_files import load_databases
from soilbus.can.mapping import channels_of
from soilbus.can.publish import ValueCodes
from soilbus.config.model import Config
from soilbus.grouping import grouped
from soilbus.simulator.recording import Recording
from soilbus.simulator.sensors import channel_rng, true_speed

__all__ = ["START_TIME", "Encoder", "Payload", "encoded", "frames"]

START_TIME = 1_700_000_000.0
"""Stamp [s, Unix] of a recording's first instant: logs hold wall clock time."""
_MAX_JITTER = 1e-3
"""Greatest jitter of a stamp [s]."""
_PHASE_STEP = 0.9e-3
"""Phase [s] between one message and the next, which begins again after _PHASES messages."""
_PHASES = 12

Payload = NDArray[np.uint8]


def frames(
    recording: Recording, config: Config, database: Database | None = None, start: float = START_TIME
) -> Iterator[can.Message]:
    """Yield the recording's frames in the order of their stamps, the first instant at `start` [s].

    Each message has a phase of its own and up to 1 ms of jitter; a slower channel of it repeats its last value.

    Raises
    ------
    ConfigError
        As `channels_of`.
    ValueError
        A mapped message cannot be encoded.
    """
    encoder = Encoder(config, recording.seed, database, start)
    yield from encoder.frames(recording.channels, recording.truth)


class Encoder:
    """Encoder of the vehicle's frames (see `frames`), step by step: counters and jitter go on."""

    def __init__(self, config: Config, seed: int, database: Database | None = None, start: float = START_TIME) -> None:
        database = database if database is not None else load_databases(config)
        self._config, self._start = config, start
        mapped = grouped(channels_of(config, database), lambda channel: channel.message).items()
        self._messages = [(database.get_message_by_name(name), of, channel_rng(seed, name)) for name, of in mapped]
        self._sent: Counter[str] = Counter()
        self._last: dict[str, Column] = {}

    def frames(self, channels: Mapping[str, Column], truth: Mapping[str, NDArray[Any]]) -> Iterator[can.Message]:
        """Yield the frames of the next step, from its samples and its true values by channel and column name."""
        held = {name: _after(self._last.get(name), column) for name, column in channels.items()}
        times: list[Array] = []
        payloads: list[Payload] = []
        messages: list[Message] = []
        for number, (message, mapped, rng) in enumerate(self._messages):
            t = max((channels[channel.name].t for channel in mapped), key=len)
            values = _sampled(held, mapped, t)
            values |= _unmapped_signals(truth, self._config, message, mapped, t)
            jitter = rng.uniform(0.0, _MAX_JITTER, len(t))
            times.append(self._start + t + _PHASE_STEP * (number % _PHASES) + jitter)
            codes = _raw_codes(message, mapped, values, len(t), self._sent[message.name])
            payloads.append(encoded(message, codes))
            messages.append(message)
            self._sent[message.name] += len(t)
        self._last = {name: Column(column.t[-1:], column.value[-1:]) for name, column in held.items()}
        if times:
            yield from _in_order(times, payloads, messages, str(self._config.bus.channel))


def _after(last: Column | None, column: Column) -> Column:
    """A column with the sample before it, which slower channels hold."""
    return column if last is None else Column(np.append(last.t, column.t), np.append(last.value, column.value))


def encoded(message: Message, codes: Mapping[str, NDArray[np.int64]]) -> Payload:
    """Return the payloads (N, length) of a message from raw codes (N,) by signal name.

    Bits of no signal are ones; Checksum, where the message has one, is computed last.
    """
    length = message.length
    n_frames = len(next(iter(codes.values())))
    bits = np.ones((n_frames, 8 * length), np.uint8)  # in the order of numpy's packbits
    for signal in message.signals:
        if signal.name in codes:
            shifts = np.arange(signal.length)
            bits[:, _bit_columns(signal)] = (codes[signal.name][:, None] >> shifts) & 1
    payload = np.packbits(bits, axis=1)
    place = checksum_byte(message)
    if place is not None:
        identifiers = np.full(n_frames, message.frame_id, np.int64)
        payload[:, place] = column_checksums(identifiers, payload, place)
    return payload


def _bit_columns(signal: Signal) -> NDArray[np.intp]:
    """Columns of a signal's bits, least significant first, where column 0 is bit 7 of byte 0."""
    if signal.byte_order == "big_endian":
        last = 8 * (signal.start // 8) + 7 - signal.start % 8 + signal.length - 1
        return last - np.arange(signal.length)
    position = signal.start + np.arange(signal.length)
    return np.asarray(8 * (position // 8) + 7 - position % 8)


def _sampled(columns: Mapping[str, Column], channels: list[Channel], t: Array) -> dict[str, Array]:
    """The mapped signals of one message at its sample times t [s], in the DBC's units."""
    values = {}
    for channel in channels:
        column = columns[channel.name]
        latest = np.maximum(np.searchsorted(column.t, t + 1e-9) - 1, 0)
        values[channel.signal] = (column.value[latest] - channel.offset) / channel.factor
    return values


def _unmapped_signals(
    truth: Mapping[str, NDArray[Any]], config: Config, message: Message, channels: list[Channel], t: Array
) -> dict[str, Array]:
    """Values of unmapped signals that follow from the drive, found by their names in the DBC."""
    mapped = {channel.signal for channel in channels}
    gears = {wheel.name: wheel.gear_ratio for wheel in config.wheel} | {a.name: a.gear_ratio for a in config.axle}
    motor = next((c.wheel for c in channels if c.quantity == "torque"), None)
    known = {"GroundBasedMachineDistance": truth["distance"], "GroundBasedMachineDirection": np.ones_like(truth["t"])}
    if motor is not None:
        known["ShaftSpeed"] = true_speed(truth, config, motor) * gears[motor] * 30.0 / math.pi
    names = {signal.name for signal in message.signals} - mapped
    return {name: np.interp(t, truth["t"], known[name]) for name in known.keys() & names}


def _raw_codes(
    message: Message, channels: list[Channel], values: Mapping[str, Array], n_frames: int, sent: int
) -> dict[str, NDArray[np.int64]]:
    codes = {s.name: ValueCodes(s).column(values[s.name]) for s in message.signals if s.name in values}
    for channel in channels:
        if channel.valid_signal is not None and channel.valid_values:
            codes[channel.valid_signal] = np.full(n_frames, channel.valid_values[0])
    for signal in message.signals:
        if signal.name == COUNTER:
            codes[COUNTER] = np.arange(sent, sent + n_frames) % (1 << signal.length)
    return codes


def _in_order(
    times: list[Array], payloads: list[Payload], messages: list[Message], channel: str
) -> Iterator[can.Message]:
    stamps = np.concatenate(times)
    owner = np.repeat(np.arange(len(times)), [len(t) for t in times])
    row = np.concatenate([np.arange(len(t)) for t in times])
    data = [[bytes(line) for line in payload] for payload in payloads]
    for i in np.argsort(stamps, kind="stable"):
        message = messages[owner[i]]
        yield can.Message(
            timestamp=float(stamps[i]),
            arbitration_id=message.frame_id,
            is_extended_id=message.is_extended_frame,
            is_fd=message.is_fd,
            data=data[owner[i]][row[i]],
            channel=channel,
        )
