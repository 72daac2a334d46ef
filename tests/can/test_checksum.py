"""CRC-8 SAE J1850 and the checksum of a frame."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from soilbus.can.checksum import column_checksums, frame_checksum


def test_published_check_value() -> None:
    """Of "123456789", the first four bytes as identifier."""
    assert frame_checksum(int.from_bytes(b"1234", "little"), b"56789\0", 5) == 0x4B


@given(st.integers(0, 2**29 - 1), st.binary(min_size=1, max_size=64), st.data())
def test_covers_everything_but_its_own_byte(arbitration_id: int, data: bytes, draw: st.DataObject) -> None:
    own = draw.draw(st.integers(0, len(data) - 1))
    due = frame_checksum(arbitration_id, data, own)
    bit = draw.draw(st.integers(0, 8 * len(data) - 1))
    flipped = bytearray(data)
    flipped[bit // 8] ^= 1 << bit % 8
    same = frame_checksum(arbitration_id, bytes(flipped), own) == due
    assert same == (bit // 8 == own)
    assert frame_checksum(arbitration_id ^ 1 << draw.draw(st.integers(0, 28)), data, own) != due


@given(st.lists(st.integers(0, 2**29 - 1), min_size=1, max_size=5), st.integers(1, 64), st.data())
def test_columns_equal_single_frames(ids: list[int], length: int, draw: st.DataObject) -> None:
    rows = [draw.draw(st.binary(min_size=length, max_size=length)) for _ in ids]
    own = draw.draw(st.integers(0, length - 1))
    payload = np.frombuffer(b"".join(rows), dtype=np.uint8).reshape(-1, length)
    due = [frame_checksum(i, row, own) for i, row in zip(ids, rows, strict=True)]
    assert column_checksums(np.array(ids), payload, own).tolist() == due


@pytest.mark.parametrize("own", [-1, 8])
def test_byte_outside_the_frame(own: int) -> None:
    with pytest.raises(IndexError):
        frame_checksum(0x18FF2210, bytes(8), own)
