"""Bytes -> frames: what a fuzzer's bytes mean on the bus.

Each frame takes RECORD bytes: what kind of identifier, which message, a step of time, flags and
length, eight bytes of payload.  So a mutated byte changes one frame in one way.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

RECORD = 12
STEPS = (
    0.0, 1e-4, 1e-3, 2e-3, 5e-3, 1e-2, 2e-2, 5e-2, 0.1, 0.3, 1.0, 2.5, 70.0, 3600.0, -1e-3, -0.3, -0.9, -1.5, -10.0,
    -3600.0, 1e5, -1e5, 1.7e9, -1.7e9, 1e12, -1e12, 1e300, -1e300, math.inf, -math.inf, math.nan,
)  # fmt: skip
"""Steps of time [s]; most bytes stand for the usual ones."""
USUAL = 10


class Known(NamedTuple):
    """A frame of a good drive: identifier, whether extended, payload."""

    identifier: int
    extended: bool
    data: bytes


class Fed(NamedTuple):
    """One frame as `Admission.feed` takes it."""

    t: float
    identifier: int
    extended: bool
    data: bytes
    remote: bool


def frames_of(data: bytes, known: Sequence[Known]) -> Iterator[Fed]:
    """The frames that `data` stands for; what is left of less than a record is dropped.

    A step that is no number is that of one frame only, as a wild stamp is.
    """
    now = 1.7e9
    for i in range(0, len(data) - RECORD + 1, RECORD):
        kind, which, step, flags = data[i : i + 4]
        payload = data[i + 4 : i + RECORD]
        by = STEPS[step % len(STEPS)] if step > 200 else STEPS[step % USUAL]
        t = now + by
        if math.isfinite(t) and abs(t) < 1e11:
            now = t
        base = known[which % len(known)]
        if kind & 7 < 4:  # a good frame, or one with bits turned over
            mask = payload if kind & 4 == 0 and flags & 1 else bytes(8)
            content = bytes(a ^ b for a, b in zip(base.data, mask, strict=False))
            yield Fed(t, base.identifier, base.extended, content, False)
        elif kind & 7 < 7:  # its identifier with any payload of any length
            yield Fed(t, base.identifier ^ (which >> 7), base.extended, payload[: flags % 9], flags > 250)
        else:
            identifier = int.from_bytes(payload[:4], "little")
            yield Fed(t, identifier & 0x1FFFFFFF, bool(flags & 1), payload * (1 + flags % 8), flags > 250)
