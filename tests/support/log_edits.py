"""Edits of a recording: what dying, lying and confused senders make of good frames.

A `Log` holds each message's frames as columns.  Edits change physical values (in the DBC's
units), payloads or stamps from a moment on and leave every other bit alone; the Checksum of
a message that has ours is made right again unless the edit is to break it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
from cantools.database import Database
from cantools.database.can import Message, Signal
from numpy.typing import NDArray

from soilbus.arrays import Array
from soilbus.can.checksum import checkable_byte, column_checksums
from soilbus.can.decode import ColumnDecoder
from soilbus.can.publish import ValueCodes

Frame = tuple[float, int, bool, bytes]
Since = NDArray[np.bool_]


class Stream:
    """The frames of one message: stamps t [s] (N,), payload (N, length)."""

    def __init__(self, message: Message, t: Array, payload: NDArray[np.uint8]) -> None:
        self.message, self.t, self.payload = message, t, payload

    def signal(self, name: str) -> Array:
        """Physical values (N,)."""
        return np.asarray(ColumnDecoder(self.message, [name]).columns(self.payload)[name].physical, float)

    def raw(self, name: str) -> NDArray[np.int64]:
        return np.asarray(ColumnDecoder(self.message, [name]).columns(self.payload)[name].raw, np.int64)

    def before(self, t: float) -> Stream:
        """The frames before t [s]."""
        return Stream(self.message, self.t[self.t < t], self.payload[self.t < t])

    def with_values(self, name: str, values: Array, where: Since) -> Stream:
        codes = ValueCodes(self.message.get_signal_by_name(name)).column(values)
        return self.with_codes(name, codes, where)

    def with_codes(self, name: str, codes: NDArray[np.int64], where: Since) -> Stream:
        """With other raw codes of a signal and the checksum that belongs to them."""
        signal = self.message.get_signal_by_name(name)
        bits = np.unpackbits(self.payload, axis=1)
        shifts = np.arange(signal.length)
        new = (codes[:, None] >> shifts) & 1
        bits[:, places(signal)] = np.where(where[:, None], new, bits[:, places(signal)])
        return self.with_payload(np.packbits(bits, axis=1)).checked()

    def with_payload(self, payload: NDArray[np.uint8]) -> Stream:
        return Stream(self.message, self.t, payload)

    def checked(self) -> Stream:
        place = checkable_byte(self.message)
        if place is None:
            return self
        payload = self.payload.copy()
        ids = np.full(len(payload), self.message.frame_id, np.int64)
        payload[:, place] = column_checksums(ids, payload, place)
        return self.with_payload(payload)


def places(signal: Signal) -> NDArray[np.intp]:
    """Columns of a signal's bits in unpackbits' order, least significant first."""
    if signal.byte_order == "big_endian":
        last = 8 * (signal.start // 8) + 7 - signal.start % 8 + signal.length - 1
        return np.asarray(last - np.arange(signal.length))
    position = signal.start + np.arange(signal.length)
    return np.asarray(8 * (position // 8) + 7 - position % 8)


class Log:
    """A recording by message name; frames of no known message are dropped."""

    def __init__(self, frames: Iterable[Frame], database: Database) -> None:
        by_id: dict[int, list[Frame]] = {}
        for frame in frames:
            by_id.setdefault(frame[1], []).append(frame)
        self.streams: dict[str, Stream] = {}
        for message in database.messages:
            if found := by_id.get(message.frame_id):
                t = np.array([f[0] for f in found])
                payload = np.frombuffer(b"".join(bytes(f[3]) for f in found), np.uint8)
                self.streams[message.name] = Stream(message, t, payload.reshape(len(t), -1))

    @classmethod
    def of(cls, streams: dict[str, Stream]) -> Log:
        new = cls.__new__(cls)
        new.streams = streams
        return new

    def frames(self) -> list[Frame]:
        """In the order of their stamps."""
        out: list[Frame] = []
        for stream in self.streams.values():
            m = stream.message
            out += [
                (t, m.frame_id, m.is_extended_frame, bytes(data))
                for t, data in zip(stream.t.tolist(), stream.payload, strict=True)
            ]
        return sorted(out, key=lambda f: f[0])


Edit = Callable[[Log, float], Log]
"""Of a log, from a time [s] on."""


def edit_of(places: Iterable[str], change: Callable[[Stream, str, Since], Stream]) -> Edit:
    """The same change of messages, or of signals `Message.Signal`, in the frames of a mask (N,)."""

    def edit(log: Log, t: float) -> Log:
        for place in places:
            message, _, signal = place.partition(".")
            stream = log.streams[message]
            log = Log.of(log.streams | {message: change(stream, signal, stream.t >= t)})
        return log

    return edit


def cut(message: str) -> Edit:
    """Nothing follows."""

    def edit(log: Log, t: float) -> Log:
        rest = log.streams[message].before(t)
        others = {name: stream for name, stream in log.streams.items() if name != message}
        return Log.of(others | ({message: rest} if len(rest.t) else {}))

    return edit


def mapped(*paths: str, by: Callable[[Array], Array]) -> Edit:
    """Values (N,) of signals replaced by a function of them."""
    return edit_of(paths, lambda s, name, late: s.with_values(name, by(s.signal(name)), late))


def flipped(*paths: str) -> Edit:
    """The other sign."""
    return mapped(*paths, by=np.negative)


def scaled(factor: float, *paths: str) -> Edit:
    """A wrong factor."""
    return mapped(*paths, by=lambda values: factor * values)


def offset(by: float, *paths: str) -> Edit:
    """A lost zero."""
    return mapped(*paths, by=lambda values: values + by)


def last_good(late: Since) -> int:
    """Number of the frame before the first late one."""
    return max(int(np.sum(~late)) - 1, 0)


def frozen(*paths: str) -> Edit:
    """The signals repeat their last good value; the rest of the frame goes on."""
    return edit_of(paths, lambda s, name, late: s.with_codes(name, s.raw(name)[[last_good(late)] * len(late)], late))


def stalled(message: str) -> Edit:
    """The whole frame is repeated, counter and checksum with it."""
    return edit_of(
        [message], lambda s, _, late: s.with_payload(np.where(late[:, None], s.payload[last_good(late)], s.payload))
    )


def spiked(by: float, every: int, *paths: str) -> Edit:
    """Every so many samples one stands out by so much."""

    def spikes(s: Stream, name: str, late: Since) -> Stream:
        return s.with_values(name, s.signal(name) + by, late & (np.arange(len(late)) % every == 0))

    return edit_of(paths, spikes)


def codes(code: int, *paths: str) -> Edit:
    """A code that means no value."""
    return edit_of(paths, lambda s, name, late: s.with_codes(name, np.full(len(late), code), late))


def delayed(by: float, *messages: str) -> Edit:
    """Frames come, and are stamped, so much later [s]."""
    return edit_of(messages, lambda s, _, late: Stream(s.message, s.t + by * late, s.payload))


class Restamped(Log):
    """A log of which some messages' frames, in their old places, are stamped earlier from a time [s] on."""

    def __init__(self, log: Log, messages: Iterable[str], since: float, by: float) -> None:
        self.streams, self.since, self.by = log.streams, since, by
        self.ids = {log.streams[message].message.frame_id for message in messages}

    def frames(self) -> list[Frame]:
        """As they come."""

        def stamped(t: float, i: int, extended: bool, data: bytes) -> Frame:
            return t - self.by if i in self.ids and t >= self.since else t, i, extended, data

        return [stamped(*frame) for frame in super().frames()]


def stamped_early(by: float, *messages: str) -> Edit:
    """Frames come as they did, with stamps so much [s] behind those of the others."""
    return lambda log, t: Restamped(log, messages, t, by)


def swapped(a: str, b: str) -> Edit:
    """Two signals of the same layout exchanged (both messages at the same rate, as their frames come)."""

    def edit(log: Log, t: float) -> Log:
        old = dict(log.streams)

        def of_the_other(s: Stream, name: str, late: Since) -> Stream:
            message, _, signal = (b if f"{s.message.name}.{name}" == a else a).partition(".")
            other = old[message]
            return s.with_values(name, np.interp(s.t, other.t, other.signal(signal)), late)

        return edit_of((a, b), of_the_other)(log, t)

    return edit


def duplicated(log: Log, t: float) -> Log:
    """Each frame comes twice, 0.2 ms apart."""

    def twice(s: Stream, _: str, late: Since) -> Stream:
        return with_added(s, s.t[late] + 2e-4, s.payload[late])

    return edit_of(log.streams, twice)(log, t)


def with_added(s: Stream, t: Array, payload: NDArray[np.uint8]) -> Stream:
    """With more frames, in the order of their stamps."""
    stamps = np.concatenate([s.t, t])
    order = np.argsort(stamps, kind="stable")
    return Stream(s.message, stamps[order], np.concatenate([s.payload, payload])[order])


def both(*edits: Edit) -> Edit:
    """One after the other."""

    def edit(log: Log, t: float) -> Log:
        for each in edits:
            log = each(log, t)
        return log

    return edit
