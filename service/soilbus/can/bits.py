"""Bits of a payload column: eight bytes of every frame as one 64-bit word."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

# a byteswap of this gives the big-endian number on either kind of machine: on a big-endian one
# numpy itself converts when it computes
_LITTLE = np.dtype("<u8")


class Place(NamedTuple):
    """Eight bytes from `first` on, as one number; `spill` is the count of leading bits to skip.

    spill > 0 only where a signal touches nine bytes, so that no eight hold it.
    """

    first: int
    big_endian: bool
    spill: int


def place_of(start: int, length: int, big_endian: bool, message_length: int) -> tuple[Place, int]:
    """Return where a signal lies: the word to load, and the left shift that brings its top bit to bit 63.

    `start` counts as in a DBC: the signal's least significant bit (little endian) or its most
    significant (big endian), bit 0 of a byte being the least significant.  Raises ValueError
    when the signal does not lie within the message.
    """
    first_bit = 8 * (start // 8) + (7 - start % 8) if big_endian else start
    if not (1 <= length <= 64 and first_bit >= 0 and first_bit + length <= 8 * message_length):
        raise ValueError(f"{length} bits from {start} do not lie within {message_length} bytes")
    byte, skip = divmod(first_bit, 8)
    if skip + length > 64:
        return Place(byte, big_endian, skip), 0 if big_endian else 64 - length
    # one word for as many signals as can share it
    window = 0 if message_length <= 8 else min(byte // 8 * 8, message_length - 8)
    if first_bit + length > 8 * window + 64:
        window = min(byte, message_length - 8)
    inside = first_bit - 8 * window
    return Place(window, big_endian, 0), inside if big_endian else 64 - length - inside


def top_aligned(payload: NDArray[np.uint8], place: Place) -> NDArray[np.uint64]:
    """Return the word of `place` in every row of a payload (N, length), as (1, N)."""
    block = payload[:, place.first : place.first + 8]
    if block.shape[1] < 8:
        padded = np.zeros((len(payload), 8), dtype=np.uint8)
        padded[:, : block.shape[1]] = block
        block = padded
    words: NDArray[np.uint64] = np.ascontiguousarray(block).view(_LITTLE)
    words = (words.byteswap() if place.big_endian else words).T
    if not place.spill:
        return words
    ninth = payload[:, place.first + 8].astype(np.uint64)
    if place.big_endian:
        return (words << np.uint64(place.spill)) | (ninth >> np.uint64(8 - place.spill))
    return (words >> np.uint64(place.spill)) | (ninth << np.uint64(64 - place.spill))
