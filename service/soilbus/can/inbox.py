"""One message's frames: filed as they come, and checked as whole columns.

A check gives a mask (N,) of the frames that pass, None where all do; CHECKS has their order.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from cantools.database.can import Message
from numpy.typing import NDArray

from soilbus.arrays import Array, Mask
from soilbus.can.channels import Channel, Reason
from soilbus.can.checksum import CHECKSUM, COUNTER, checkable_byte, column_checksums
from soilbus.can.decode import ColumnDecoder, SignalColumn
from soilbus.can.j1939 import STANDARD_PGNS, SourceLock, pgn_of, source_of
from soilbus.can.validity import CodeRule

TWICE = 0.002  # seconds within which a frame that equals the one before it is that frame once more: cycles are longer

COUNTER_ERRORS = 5  # net errors of a counter [frames] from which its message is not trusted (opendbc, MAX_BAD_COUNTER)

Data = bytes | bytearray
Frame = tuple[float, int, Data]


@dataclass(slots=True)
class Batch:
    """Frames of one message: times [s] (N,), identifiers (N,), payload (N, length); decoded once, when asked for."""

    t: Array
    ids: NDArray[np.int64]
    payload: NDArray[np.uint8]
    _columns: dict[str, SignalColumn] | None = None

    def columns(self, decoder: ColumnDecoder) -> dict[str, SignalColumn]:
        """Return the payload as the message's decoder decodes it."""
        if self._columns is None:
            self._columns = decoder.columns(self.payload)
        return self._columns

    def where(self, mask: Mask) -> Batch:
        """Return the frames of a mask (N,)."""
        return Batch(self.t[mask], self.ids[mask], self.payload[mask])


class Inbox:
    """Inbox of one message: frames not yet taken, and what is remembered between batches.

    `is_open`: it hears any source.  ValueError where a message cannot be checked.
    """

    def __init__(self, message: Message, channels: Sequence[Channel], is_open: bool, checked: bool) -> None:
        self.message, self.channels = message, channels
        self.checksum_byte = checkable_byte(message) if checked else None
        if checked and self.checksum_byte is None:
            raise ValueError(f"{message.name}: no {COUNTER} and byte-aligned 8-bit {CHECKSUM} to check")
        wanted = [c.signal for c in channels] + [c.valid_signal for c in channels if c.valid_signal is not None]
        self.decoder = ColumnDecoder(message, wanted + ([COUNTER] if checked else []))
        is_standard = message.is_extended_frame and pgn_of(message.frame_id) in STANDARD_PGNS
        self.rules = [CodeRule(message.get_signal_by_name(c.signal), is_standard) for c in channels]
        own, cycle_time = source_of(message.frame_id), (message.cycle_time or 0) / 1e3
        self.lock = SourceLock.at_cycle(own, cycle_time) if is_open else None
        self.missed = 0  # frames that the counters of a checked message skip: lost, or refused for their checksum
        self.untrusted: Mask | None = None  # which frames of the last batch came while the message was not trusted
        self.forget()

    def forget(self) -> None:
        """Forget all frames of this message, and its last stamp, counter and sender."""
        self.frames: list[Frame] = []
        self.late: list[float] = []  # stamps [s] of frames that came after much later ones
        self.last_t, self.last_id, self.last_counter, self.last_data = -math.inf, -1, -1, b""
        self.last_frame = -math.inf, -1, b""
        self.counter_errors = 0  # frames whose counter did not go on by one, less those whose did, to COUNTER_ERRORS
        self.is_untrusted = False  # whether the errors have reached COUNTER_ERRORS and are not back at 0 yet
        if self.lock is not None:
            self.lock.release()


def checksum_right(inbox: Inbox, batch: Batch) -> Mask | None:
    """Return False where the payload does not give the Checksum; None where none is asked for."""
    if inbox.checksum_byte is None:
        return None
    due = column_checksums(batch.ids, batch.payload, inbox.checksum_byte)
    return np.asarray(batch.payload[:, inbox.checksum_byte] == due)


def time_forward(inbox: Inbox, batch: Batch) -> Mask:
    """Return False where time goes back or is no number."""
    is_time = np.isfinite(batch.t)
    t = np.where(is_time, batch.t, -math.inf)
    newest = np.maximum.accumulate(np.concatenate([[inbox.last_t], t]))
    inbox.last_t = float(newest[-1])
    return np.asarray(is_time & (t >= newest[:-1]))


def counter_moved(inbox: Inbox, batch: Batch) -> Mask | None:
    """Return False where a frame repeats its sender's last counter; keep what cannot be trusted for `of_one_sender`."""
    inbox.untrusted = None
    if inbox.checksum_byte is None:
        return None
    counter = batch.columns(inbox.decoder)[COUNTER].raw.astype(np.int64)
    modulus = 1 << inbox.message.get_signal_by_name(COUNTER).length
    step = np.diff(counter, prepend=inbox.last_counter) % modulus
    follows = np.diff(batch.ids, prepend=inbox.last_id) == 0
    moved: Mask = (step != 0) | ~follows
    untrusted = _untrusted(inbox, batch, step, follows)
    inbox.last_counter, inbox.last_id = int(counter[-1]), int(batch.ids[-1])
    inbox.last_data = batch.payload[-1].tobytes()
    inbox.missed += int(np.maximum(step - 1, 0)[follows if untrusted is None else follows & ~untrusted].sum())
    if untrusted is not None:
        inbox.untrusted = untrusted[moved]
    return moved


def _untrusted(inbox: Inbox, batch: Batch, step: NDArray[np.int64], follows: Mask) -> Mask | None:
    """True from the frame whose error is the last of COUNTER_ERRORS until no error is left; None without any error.

    A counter that does not go on by one is an error; one that does takes one back.  The same counter with another
    payload is COUNTER_ERRORS at once: only a second or a broken sender sends it.
    """
    wrong = follows & (step != 1)
    if not inbox.counter_errors and not wrong.any():
        return None
    before = [inbox.last_data, *(row.tobytes() for row in batch.payload)]
    untrusted = np.zeros(len(step), dtype=np.bool_)
    for i in np.flatnonzero(follows).tolist():
        is_twin = step[i] == 0 and before[i] != before[i + 1]
        change = -1 if not wrong[i] else COUNTER_ERRORS if is_twin else 1
        inbox.counter_errors = min(max(inbox.counter_errors + change, 0), COUNTER_ERRORS)
        inbox.is_untrusted = inbox.counter_errors == COUNTER_ERRORS or (inbox.is_untrusted and inbox.counter_errors > 0)
        untrusted[i] = inbox.is_untrusted
    return untrusted


def of_one_sender(inbox: Inbox, batch: Batch) -> Mask | None:
    """Return False where a second sender makes the counters useless; None where there is none."""
    return None if inbox.untrusted is None else ~inbox.untrusted


def not_twice(inbox: Inbox, batch: Batch) -> Mask | None:
    """Return False where a frame comes a second time, as its noise would count twice; None where none does."""
    t_before, id_before, data_before = inbox.last_frame
    inbox.last_frame = float(batch.t[-1]), int(batch.ids[-1]), batch.payload[-1].tobytes()
    close = np.diff(batch.t, prepend=t_before) < TWICE
    if not close.any():
        return None
    first = np.frombuffer(data_before or bytes(batch.payload.shape[1]), np.uint8)
    same = (np.diff(batch.payload, axis=0, prepend=first[None]) == 0).all(axis=1)
    return np.asarray(~(close & same & (np.diff(batch.ids, prepend=id_before) == 0)))


CHECKS: Mapping[Reason, Callable[[Inbox, Batch], Mask | None]] = {
    Reason.BAD_CHECKSUM: checksum_right,
    Reason.TIME_BACKWARDS: time_forward,
    Reason.BAD_COUNTER: counter_moved,
    Reason.SECOND_SENDER: of_one_sender,
    Reason.DUPLICATE: not_twice,
}
"""Why a check refuses a frame, and the check, in their order."""
