"""The checksum of frames that others act on: CRC-8 SAE J1850 over identifier and payload.

The identifier goes in first, so that a frame relayed under a wrong identifier is refused, too.
"""

from __future__ import annotations

import numpy as np
from cantools.database.can import Message
from crccheck.crc import Crc8SaeJ1850  # type: ignore[import-untyped]
from numpy.typing import NDArray

COUNTER, CHECKSUM = "Counter", "Checksum"
"""Names of the signals that make a frame checkable."""

_ID_BYTES = 4
_INIT = _XOR_OUT = np.uint8(0xFF)
_TABLE = np.array([Crc8SaeJ1850(initvalue=0).process((byte,)).value() for byte in range(256)], np.uint8)


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


def frame_checksum(arbitration_id: int, data: bytes, checksum_byte_index: int) -> int:
    """Return the checksum of one frame, 0..255: identifier (4 bytes, least significant first), then other payload.

    Raises IndexError when `data` has no byte that carries it, OverflowError for an identifier of more than 4 bytes.
    """
    if not 0 <= checksum_byte_index < len(data):
        raise IndexError(f"no byte {checksum_byte_index} in {len(data)} bytes")
    payload = bytes(data[:checksum_byte_index]) + bytes(data[checksum_byte_index + 1 :])
    return int(Crc8SaeJ1850.calc(arbitration_id.to_bytes(_ID_BYTES, "little") + payload))


def column_checksums(
    arbitration_ids: NDArray[np.int64], payload: NDArray[np.uint8], checksum_byte_index: int
) -> NDArray[np.uint8]:
    """Return `frame_checksum` of many frames at once: identifiers (N,), payload (N, length) -> (N,)."""
    identifiers = arbitration_ids.astype("<u4").view(np.uint8).reshape(-1, _ID_BYTES)
    covered = np.concatenate([identifiers, np.delete(payload, checksum_byte_index, axis=1)], axis=1)
    crc = np.full(len(payload), _INIT)
    for byte in covered.T:
        crc = _TABLE[crc ^ byte]
    return crc ^ _XOR_OUT
