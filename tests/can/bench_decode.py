"""Decoding of a field recording: cantools frame by frame, our columns a second at a time and at once.

Run: PYTHONPATH=service python tests/can/bench_decode.py [recording.log.gz]
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

import numpy as np

from field_data import FIELD, field_database, frames_of, wanted_signals
from soilbus.can.decode import ColumnDecoder


def best_of(work: Callable[[], object], repeats: int = 3) -> float:
    """Least wall time [s] of several runs."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return min(times)


def main(path: str) -> None:
    database = field_database()
    by_message: dict[str, list[tuple[float, bytes]]] = {}
    for t, arbitration_id, _, data in frames_of(path):
        by_message.setdefault(database.get_message_by_frame_id(arbitration_id).name, []).append((t, data))
    messages = {name: database.get_message_by_name(name) for name in by_message}
    decoders = {name: ColumnDecoder(messages[name], wanted_signals(messages[name])) for name in by_message}
    whole = {name: [data for _, data in frames] for name, frames in by_message.items()}
    hops = {name: _in_hops(frames) for name, frames in by_message.items()}

    def by_cantools() -> None:
        for name, frames in whole.items():
            decode = messages[name].decode
            for data in frames:
                decode(data, decode_choices=False)

    def by_columns(batches: dict[str, list[list[bytes]]]) -> None:
        for name, chunks in batches.items():
            for chunk in chunks:
                payload = np.frombuffer(b"".join(chunk), dtype=np.uint8).reshape(-1, messages[name].length)
                decoders[name].columns(payload)

    peer = best_of(by_cantools)
    n = sum(map(len, whole.values()))
    print(f"{n} frames; cantools {1e6 * peer / n:.2f} us a frame")
    for label, batches in (("1 s hops", hops), ("at once", {k: [v] for k, v in whole.items()})):
        ours = best_of(lambda batches=batches: by_columns(batches))  # type: ignore[misc]
        print(f"columns, {label}: {1e6 * ours / n:.4f} us a frame, {peer / ours:.0f} times faster")


def _in_hops(frames: list[tuple[float, bytes]]) -> list[list[bytes]]:
    hops: dict[int, list[bytes]] = {}
    for t, data in frames:
        hops.setdefault(int(t), []).append(data)
    return list(hops.values())


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else str(FIELD / "loam.log.gz"))
