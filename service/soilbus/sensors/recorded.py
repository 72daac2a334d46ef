"""A recording decoded whole: the samples of its channels, from the part in which most of them stand."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable

import numpy as np

from soilbus.arrays import Array
from soilbus.can.admission import LONGEST_GAP, Admission
from soilbus.can.candump import Frame
from soilbus.can.channels import Reason

Columns = dict[str, tuple[Array, Array]]
"""Times [s] and values (SI) by channel name."""

BATCH_SIZE = 5000
"""Number of frames that are decoded at a time."""


def longest_part(admission: Admission, frames: Iterable[Frame]) -> tuple[Columns, Counter[tuple[str, Reason]], int]:
    """Return the samples of the longest part with one clock, and refused values and number of frames of all parts.

    admission: of the channels wanted, it is fed and emptied; frames: of one recording.
    """
    pieces: list[list[Columns]] = [[]]
    refused: Counter[tuple[str, Reason]] = Counter()
    last, n, steps = math.nan, 0, 0

    def take() -> None:
        decoded = admission.take()
        refused.update({key: len(t) for key, t in decoded.refused.items()})
        pieces[-1].append({name: (c.t, c.value) for name, c in decoded.columns.items() if len(c.t)})

    for t, identifier, extended, data, remote, error in frames:
        n += 1
        if error:
            continue
        if abs(t - last) > LONGEST_GAP:
            take()
            pieces.append([])
        last = t
        admission.feed(t, identifier, extended, data, remote)
        if n % BATCH_SIZE == 0:
            if admission.counts.clock_steps != steps:
                steps = admission.counts.clock_steps
                pieces.append([])
            take()
    take()
    parts = [_joined(piece) for piece in pieces]
    return max(parts, key=lambda part: sum(len(t) for t, _ in part.values())), refused, n


def _joined(pieces: list[Columns]) -> Columns:
    parts: dict[str, list[tuple[Array, Array]]] = {}
    for piece in pieces:
        for name, column in piece.items():
            parts.setdefault(name, []).append(column)
    return {
        name: (np.concatenate([t for t, _ in of]), np.concatenate([v for _, v in of])) for name, of in parts.items()
    }
