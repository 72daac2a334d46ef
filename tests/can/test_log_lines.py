"""A text log with a line that does not end."""

from __future__ import annotations

import gzip
import tracemalloc

import can
import pytest

from soilbus.offline.replay import LogError, read_frames

N = 300


@pytest.mark.parametrize("kind", [".log", ".log.gz", ".asc", ".csv"])
def test_a_line_without_end_is_damage_and_takes_no_memory(kind, tmp_path):
    head = tmp_path / f"head{kind.removesuffix('.gz')}"
    with can.Logger(head) as writer:
        for i in range(N):
            writer(
                can.Message(timestamp=1.7e9 + i / 100.0, arbitration_id=0x123, is_extended_id=False, data=b"soilbus!")
            )
    path = tmp_path / f"endless{kind}"
    with gzip.open(path, "wb", compresslevel=1) if kind.endswith(".gz") else path.open("wb") as file:
        file.write(head.read_bytes().removesuffix(b"End TriggerBlock\n"))
        for _ in range(64):
            file.write(b"0" * 2**20)
    before = []
    tracemalloc.start()
    try:
        with pytest.raises(LogError, match=r"a line of more than \d+ characters"):
            before.extend(read_frames(path))
        assert tracemalloc.get_traced_memory()[1] < 8 * 2**20
    finally:
        tracemalloc.stop()
    assert len(before) == N
