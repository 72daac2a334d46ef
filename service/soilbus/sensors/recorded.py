"""A recording decoded whole: the samples of its channels, from the part in which most of them stand."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

import numpy as np

from soilbus.arrays import Array
from soilbus.can.admission import Admission
from soilbus.can.candump import Frame
from soilbus.can.channels import Column, Reason

Columns = dict[str, tuple[Array, Array]]
"""Times [s] and values (SI) by channel name."""

BATCH_SIZE = 5000
"""Number of frames that are decoded at a time."""


def longest_part(admission: Admission, frames: Iterable[Frame]) -> tuple[Columns, Counter[tuple[str, Reason]], int]:
    """Return the samples of the longest part with one clock, and refused values and number of frames of all parts.

    admission: of the channels wanted, it is fed and emptied; frames: of one recording.
    """
    parts: list[dict[str, list[Column]]] = [{}]
    refused: Counter[tuple[str, Reason]] = Counter()
    n = 0

    def take() -> None:
        decoded = admission.take()
        refused.update({key: len(t) for key, t in decoded.refused.items()})
        for name, column in decoded.columns.items():
            if len(column.t):
                parts[-1].setdefault(name, []).append(column)

    def begin_part() -> None:
        take()
        parts.append({})

    admission.at_break = begin_part
    for n, (t, identifier, extended, data, remote, error) in enumerate(frames, 1):
        if not error:
            admission.feed(t, identifier, extended, data, remote)
        if n % BATCH_SIZE == 0:
            take()
    take()
    longest = max(parts, key=lambda part: sum(len(c.t) for columns in part.values() for c in columns))
    joined = {
        name: (np.concatenate([c.t for c in columns]), np.concatenate([c.value for c in columns]))
        for name, columns in longest.items()
    }
    return joined, refused, n
