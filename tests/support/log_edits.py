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
from soilbus.can.publish import value_codes

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
        codes = value_codes(self.message.get_signal_by_name(name)).column(values)
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

    def changed(self, name: str, edit: Callable[[Stream], Stream | None]) -> Log:
        """With one message's stream edited, or taken out (None)."""
        stream = edit(self.streams[name])
        others = {n: s for n, s in self.streams.items() if n != name}
        return Log.of(others if stream is None else others | {name: stream})


Edit = Callable[[Log, float], Log]
"""Of a log, from a time [s] on."""


def each(paths: Iterable[str], change: Callable[[Stream, str, float], Stream | None]) -> Edit:
    """The change of the streams of these messages, or of these signals MESSAGE.SIGNAL, one after the other."""

    def edit(log: Log, t: float) -> Log:
        for message, _, signal in (path.partition(".") for path in paths):
            log = log.changed(message, lambda s, name=signal: change(s, name, t))  # type: ignore[misc]
        return log

    return edit


def last_before(s: Stream, t: float) -> int:
    """Index of the last frame before t [s], else the first."""
    return max(int(np.sum(s.t < t)) - 1, 0)


def cut(message: str) -> Edit:
    """Nothing follows."""
    return each([message], lambda s, _, t: s.before(t) if (s.t < t).any() else None)


def flipped(*paths: str) -> Edit:
    """The other sign."""
    return scaled(-1.0, *paths)


def scaled(factor: float, *paths: str) -> Edit:
    """A wrong factor."""
    return each(paths, lambda s, name, t: s.with_values(name, factor * s.signal(name), s.t >= t))


def offset(by: float, *paths: str) -> Edit:
    """A lost zero."""
    return spiked(by, 1, *paths)


def spiked(by: float, every: int, *paths: str) -> Edit:
    """Every so many samples one stands out by so much."""
    return each(
        paths,
        lambda s, name, t: s.with_values(name, s.signal(name) + by, (s.t >= t) & (np.arange(len(s.t)) % every == 0)),
    )


def codes(code: int, *paths: str) -> Edit:
    """A code that means no value."""
    return each(paths, lambda s, name, t: s.with_codes(name, np.full(len(s.t), code), s.t >= t))


def frozen(*paths: str) -> Edit:
    """The signals repeat their last good value; the rest of the frame goes on."""

    def stuck(s: Stream, name: str, t: float) -> Stream:
        return s.with_codes(name, np.full(len(s.t), s.raw(name)[last_before(s, t)]), s.t >= t)

    return each(paths, stuck)


def stalled(message: str) -> Edit:
    """The whole frame is repeated, counter and checksum with it."""

    def stuck(s: Stream, _: str, t: float) -> Stream:
        return s.with_payload(np.where((s.t >= t)[:, None], s.payload[last_before(s, t)], s.payload))

    return each([message], stuck)


def delayed(by: float, *messages: str) -> Edit:
    """Frames come, and are stamped, so much later [s]."""
    return each(messages, lambda s, _, t: Stream(s.message, np.where(s.t >= t, s.t + by, s.t), s.payload))


class Restamped(Log):
    """A log of which some messages' frames, in their old places, are stamped earlier from a time [s] on."""

    def __init__(self, log: Log, messages: Iterable[str], since: float, by: float) -> None:
        self.streams, self.since, self.by = log.streams, since, by
        self.ids = {log.streams[message].message.frame_id for message in messages}

    def frames(self) -> list[Frame]:
        """As they come."""
        return [
            (t - self.by if i in self.ids and t >= self.since else t, i, extended, data)
            for t, i, extended, data in super().frames()
        ]


def stamped_early(by: float, *messages: str) -> Edit:
    """Frames come as they did, with stamps so much [s] behind those of the others."""
    return lambda log, t: Restamped(log, messages, t, by)


def swapped(a: str, b: str) -> Edit:
    """Two signals of the same layout exchanged (both messages at the same rate, as their frames come)."""

    def edit(log: Log, t: float) -> Log:
        (one, of_a), (other, of_b) = ((log.streams[m], s) for m, _, s in (path.partition(".") for path in (a, b)))
        from_b = np.interp(one.t, other.t, other.signal(of_b))
        from_a = np.interp(other.t, one.t, one.signal(of_a))
        log = each([a], lambda s, name, t: s.with_values(name, from_b, s.t >= t))(log, t)
        return each([b], lambda s, name, t: s.with_values(name, from_a, s.t >= t))(log, t)

    return edit


def duplicated(log: Log, t: float) -> Log:
    """Each frame comes twice, 0.2 ms apart."""

    def twice(s: Stream, _: str, t: float) -> Stream:
        late = s.t >= t
        stamps = np.concatenate([s.t, s.t[late] + 2e-4])
        order = np.argsort(stamps, kind="stable")
        return Stream(s.message, stamps[order], np.concatenate([s.payload, s.payload[late]])[order])

    return each(log.streams, twice)(log, t)


def both(*edits: Edit) -> Edit:
    """One after the other."""

    def edit(log: Log, t: float) -> Log:
        for change in edits:
            log = change(log, t)
        return log

    return edit
