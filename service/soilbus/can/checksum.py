"""The checksum of frames that others act on: CRC-8 SAE J1850 over identifier and payload.

The identifier goes in first, so that a frame relayed under a wrong identifier is refused as
well as one with a wrong payload.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from cantools.database.can import Message
from crccheck.crc import Crc8SaeJ1850  # type: ignore[import-untyped]
from numpy.typing import NDArray

COUNTER = "Counter"
CHECKSUM = "Checksum"
"""Names of the signals that make a frame checkable."""

_INIT = 0xFF
_XOR_OUT = 0xFF
_ID_BYTES = 4
_TABLE = bytes(Crc8SaeJ1850(initvalue=0).process((byte,)).value() for byte in range(256))
_TABLE_ARRAY: NDArray[np.uint8] = np.frombuffer(_TABLE, dtype=np.uint8)


def checksum_byte(message: Message) -> int | None:
    """Return the byte that carries a message's Checksum; None without one that is an aligned byte."""
    checksum = next((signal for signal in message.signals if signal.name == CHECKSUM), None)
    if checksum is None or checksum.length != 8:
        return None
    aligned = 7 if checksum.byte_order == "big_endian" else 0
    return int(checksum.start) // 8 if checksum.start % 8 == aligned else None


def checkable_byte(message: Message) -> int | None:
    """Return the byte of the Checksum of a message that has a Counter too; None of any other."""
    return checksum_byte(message) if any(signal.name == COUNTER for signal in message.signals) else None


def crc8(data: bytes) -> int:
    """Return the CRC-8 SAE J1850 (polynomial 0x1D, start 0xFF, final xor 0xFF) of `data`, 0..255."""
    crc = _INIT
    for byte in data:
        crc = _TABLE[crc ^ byte]
    return crc ^ _XOR_OUT


def frame_checksum(arbitration_id: int, data: bytes, checksum_byte_index: int) -> int:
    """Return the checksum of one frame, 0..255: identifier (4 bytes, least significant first), then payload.

    The byte that carries the checksum is left out.  Raises IndexError when `data` has no such
    byte, OverflowError when the identifier does not fit 4 bytes.
    """
    if not 0 <= checksum_byte_index < len(data):
        raise IndexError(f"no byte {checksum_byte_index} in {len(data)} bytes")
    payload = bytes(data[:checksum_byte_index]) + bytes(data[checksum_byte_index + 1 :])
    return crc8(arbitration_id.to_bytes(4, "little") + payload)


def column_checksums(
    arbitration_ids: NDArray[np.int64], payload: NDArray[np.uint8], checksum_byte_index: int
) -> NDArray[np.uint8]:
    """Return `frame_checksum` of many frames at once: identifiers (N,), payload (N, length) -> (N,)."""
    identifiers = arbitration_ids.astype("<u4").view(np.uint8).reshape(-1, _ID_BYTES)
    data = np.concatenate([identifiers, payload], axis=1)
    shares, start = _shares(data.shape[1], _ID_BYTES + checksum_byte_index)
    crc: NDArray[np.uint8] = np.bitwise_xor.reduce(shares[np.arange(len(shares)), data], axis=1, initial=start)
    return crc


@cache
def _shares(length: int, left_out: int) -> tuple[NDArray[np.uint8], np.uint8]:
    """What each byte of the data adds to the CRC, by its place and value (length, 256), and the CRC of zeros.

    A CRC is linear over GF(2): what a byte does to it does not depend on the other bytes.
    """
    shares = np.zeros((length, 256), np.uint8)
    moved_on = np.arange(256, dtype=np.uint8)  # what a byte has become when those after it have gone in
    for place in reversed(range(length)):
        if place != left_out:
            moved_on = _TABLE_ARRAY[moved_on]
            shares[place] = moved_on
    return shares, moved_on[_INIT] ^ np.uint8(_XOR_OUT)
