"""One message's frames: filed as they come, and checked as whole columns.

A check gives a mask (N,) of the frames that pass, None where all do.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from cantools.database.can import Message
from numpy.typing import NDArray

from soilbus.arrays import Mask
from soilbus.can.channels import Channel
from soilbus.can.checksum import CHECKSUM, COUNTER, checkable_byte, column_checksums
from soilbus.can.decode import Block, ColumnDecoder
from soilbus.can.j1939 import STANDARD_PGNS, SourceLock, pgn_of, source_of
from soilbus.can.plain import PlainPlan, plain_plan
from soilbus.can.validity import CodeRule, rule_of

TWICE = 0.002
"""Seconds within which a frame that equals the one before it is that frame once more: cycles are longer."""

_NO_FRAME = (-math.inf, -1, b"")

Data = bytes | bytearray
Frame = tuple[float, int, Data]


@dataclass(slots=True)
class Batch:
    """Frames of one message: times [s] (N,), identifiers (N,), payload (N, length); decoded once, when asked for."""

    t: NDArray[np.float64]
    ids: NDArray[np.int64]
    payload: NDArray[np.uint8]
    _blocks: list[Block] | None = None

    def blocks(self, decoder: ColumnDecoder) -> list[Block]:
        """The payload decoded by the message's decoder."""
        if self._blocks is None:
            self._blocks = decoder.blocks(self.payload)
        return self._blocks

    def where(self, mask: Mask) -> Batch:
        """Those of a mask (N,)."""
        return Batch(self.t[mask], self.ids[mask], self.payload[mask])


@dataclass(slots=True)
class Inbox:
    """One message: its frames not yet taken, and what must be remembered between batches."""

    message: Message
    channels: tuple[Channel, ...]
    rules: tuple[CodeRule, ...]
    decoder: ColumnDecoder
    plain: PlainPlan | None
    lock: SourceLock | None
    checksum_byte: int | None
    frames: list[Frame] = field(default_factory=list)
    late: list[float] = field(default_factory=list)
    """Stamps [s] of frames that came after others which are stamped much later."""
    last_t: float = -math.inf
    last_id: int = -1
    last_counter: int = -1
    last_frame: tuple[float, int, bytes] = _NO_FRAME
    missed: int = 0
    """Frames that the counters of a checked message skip: lost, or refused for their checksum."""

    def forget(self) -> None:
        """As if no frame had ever come."""
        self.frames.clear()
        self.late.clear()
        self.last_t, self.last_id, self.last_counter, self.last_frame = -math.inf, -1, -1, _NO_FRAME
        if self.lock is not None:
            self.lock.release()


def inbox_of(message: Message, channels: Sequence[Channel], is_open: bool, checked: bool) -> Inbox:
    """An empty inbox; is_open: heard from any source.  ValueError where a message to be checked cannot be."""
    place = checkable_byte(message) if checked else None
    if checked and place is None:
        raise ValueError(f"{message.name}: no {COUNTER} and byte-aligned 8-bit {CHECKSUM} to check")
    wanted = [c.signal for c in channels] + [c.valid_signal for c in channels if c.valid_signal is not None]
    decoder = ColumnDecoder(message, wanted + ([COUNTER] if checked else []))
    is_standard = message.is_extended_frame and pgn_of(message.frame_id) in STANDARD_PGNS
    rules = tuple(rule_of(message.get_signal_by_name(c.signal), is_standard) for c in channels)
    return Inbox(
        message=message,
        channels=tuple(channels),
        rules=rules,
        decoder=decoder,
        plain=plain_plan(message, channels, rules, decoder),
        lock=SourceLock.at_cycle(source_of(message.frame_id), (message.cycle_time or 0) / 1e3) if is_open else None,
        checksum_byte=place,
    )


def popped(inbox: Inbox, until: float) -> list[Frame]:
    """Takes the frames before `until` out of the inbox."""
    frames, inbox.frames = inbox.frames, []
    if until == math.inf:
        return frames
    inbox.frames = [f for f in frames if f[0] >= until]
    return [f for f in frames if not f[0] >= until] if inbox.frames else frames


def checksum_right(inbox: Inbox, batch: Batch) -> Mask | None:
    """False where the payload does not give the Checksum; None where it does throughout, or none is asked for."""
    if inbox.checksum_byte is None:
        return None
    due = column_checksums(batch.ids, batch.payload, inbox.checksum_byte)
    right: Mask = batch.payload[:, inbox.checksum_byte] == due
    return None if np.count_nonzero(right) == len(right) else right


def time_forward(inbox: Inbox, batch: Batch) -> Mask | None:
    """False where time goes back or is no number; None where it goes on throughout."""
    t = batch.t
    first, last = float(t[0]), float(t[-1])
    rises = np.count_nonzero(t[1:] >= t[:-1]) == len(t) - 1  # never of a nan
    if rises and first >= inbox.last_t and math.isfinite(first) and math.isfinite(last):
        inbox.last_t = last
        return None
    mask = np.zeros(len(t), dtype=np.bool_)
    for i, now in enumerate(t.tolist()):
        if math.isfinite(now) and now >= inbox.last_t:
            mask[i] = True
            inbox.last_t = now
    return mask


def counter_moved(inbox: Inbox, batch: Batch) -> Mask | None:
    """False where a frame repeats the counter of the one before it from the same sender; None where none does.

    What the counters skip is counted in `inbox.missed`.
    """
    if inbox.checksum_byte is None:
        return None
    column = inbox.decoder.columns_of(batch.blocks(inbox.decoder))[COUNTER]
    counter = column.raw.astype(np.int64)
    modulus = 1 << inbox.message.get_signal_by_name(COUNTER).length
    step = np.diff(counter, prepend=inbox.last_counter) % modulus
    follows = np.diff(batch.ids, prepend=inbox.last_id) == 0
    inbox.last_counter, inbox.last_id = int(counter[-1]), int(batch.ids[-1])
    inbox.missed += int(np.maximum(step - 1, 0)[follows].sum())
    moved: Mask = (step != 0) | ~follows
    return None if moved.all() else moved


def not_twice(inbox: Inbox, batch: Batch) -> Mask | None:
    """False where a frame comes once more: counted twice, its noise would seem smaller than it is.  None where none."""
    t_before, id_before, data_before = inbox.last_frame
    inbox.last_frame = float(batch.t[-1]), int(batch.ids[-1]), batch.payload[-1].tobytes()
    t = batch.t
    if t[0] - t_before >= TWICE and np.count_nonzero(t[1:] - t[:-1] < TWICE) == 0:
        return None
    close = np.diff(t, prepend=t_before) < TWICE
    length = batch.payload.shape[1]
    first = np.frombuffer(data_before.ljust(length, b"\0"), np.uint8).reshape(1, length)
    same = (batch.payload == np.concatenate([first, batch.payload[:-1]])).all(axis=1)
    once: Mask = ~(close & same & (batch.ids == np.concatenate([[id_before], batch.ids[:-1]])))
    return once
