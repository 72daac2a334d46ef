"""Bench of decoding: frames to columns, ours beside cantools frame by frame."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from soilbus.can.dbc_files import load_databases
from soilbus.can.decode import ColumnDecoder
from soilbus.can.mapping import channels_of
from soilbus.offline.replay import read_log
from soilbus.simulator.reference import reference_configuration
from soilbus.trials.bench.figure import Figure, wall_time

WINDOW_FRAMES = 500
"""Frames of a message in 10 s at 50 Hz."""


def decode_speedup(log: Path) -> Figure:
    """Mapped signals of every message, a 10 s window (500 frames) at a time, against cantools frame by frame."""
    config = reference_configuration()
    database = load_databases(config)
    wanted: dict[str, list[str]] = {}
    for channel in channels_of(config, database):
        wanted.setdefault(channel.message, []).append(channel.signal)
    payloads: dict[str, list[bytes]] = {name: [] for name in wanted}
    names = {m.frame_id: m.name for m in database.messages}
    for message in read_log(log):
        if (name := names.get(message.arbitration_id)) in payloads:
            payloads[name].append(bytes(message.data))
    decoders = {n: ColumnDecoder(database.get_message_by_name(n), s) for n, s in wanted.items()}
    windows = [(n, w) for n, f in payloads.items() for w in _batched(f, WINDOW_FRAMES)]

    def columns() -> None:
        for name, window in windows:
            raw = np.frombuffer(b"".join(window), np.uint8).reshape(len(window), -1)
            decoders[name].columns(raw)

    def one_by_one() -> None:
        for name, window in windows:
            decode = database.get_message_by_name(name).decode
            for data in window:
                decode(data, decode_choices=False)

    ours, peer = wall_time(columns, 5), wall_time(one_by_one, 2)
    return Figure(
        peer / ours, 20.0, f"cantools {peer:.3f} s, ours {ours:.4f} s",
        f"{sum(map(len, payloads.values()))} frames, windows of {WINDOW_FRAMES}",
    )  # fmt: skip


def _batched(items: Sequence[bytes], size: int) -> Iterator[Sequence[bytes]]:
    return (items[i : i + size] for i in range(0, len(items), size))
