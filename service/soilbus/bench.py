"""`soilbus bench`: every performance figure beside its peer, both measured in one run."""

from __future__ import annotations

import platform
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from cantools.database.can import Database

from soilbus.can.dbc_files import load_databases
from soilbus.can.decode import ColumnDecoder
from soilbus.can.mapping import channels_of
from soilbus.daemon.pipeline import Pipeline
from soilbus.daemon.replay import estimator_beside, read_log, replay
from soilbus.report.table import table
from soilbus.simulator.frames import frames, write_log
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import excited

REPEATS = 5
RECORDING = 120.0
WINDOW_FRAMES = 500


def run_bench() -> dict[str, Any]:
    """Measure, print a table, and return the figures by name."""
    config = reference_configuration()
    database = load_databases(config)
    with TemporaryDirectory() as folder:
        log = Path(folder) / "bench.log"
        write_log(frames(simulate(config, excited("loam", RECORDING), seed=1), config, database), log)
        figures = {"decode_speedup": _decode(log, database), "replay_realtime_factor": _replay(log)}
    rows = [
        (name, f"{f['value']:.1f}", f">= {f['target']}", f["peer"], f["what"])
        for name, f in figures.items()
    ]  # fmt: skip
    print(table(("figure", "value", "target", "beside", "what"), rows), end="")
    machine = {"python": platform.python_version(), "numpy": np.__version__, "machine": platform.machine()}
    return {name: f["value"] for name, f in figures.items()} | {"details": figures, "machine": machine}


def _best(work: Callable[[], Any], repeats: int = REPEATS) -> float:
    """Shortest wall time of several runs [s]: what else the machine does only adds."""
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        work()
        times.append(time.perf_counter() - begin)
    return min(times)


def _batched(items: Sequence[bytes], size: int) -> Iterator[Sequence[bytes]]:
    return (items[i : i + size] for i in range(0, len(items), size))


def _decode(log: Path, database: Database) -> dict[str, Any]:
    """Mapped signals of every message, a 10 s window (500 frames) at a time, against cantools frame by frame."""
    channels = channels_of(reference_configuration(), database)
    wanted: dict[str, list[str]] = {}
    for channel in channels:
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

    ours, peer = _best(columns), _best(one_by_one, 2)
    return {
        "value": peer / ours, "target": 20, "peer": f"cantools {peer:.3f} s, ours {ours:.4f} s",
        "what": f"{sum(map(len, payloads.values()))} frames, windows of {WINDOW_FRAMES}",
    }  # fmt: skip


def _replay(log: Path) -> dict[str, Any]:
    """A 120 s recording through the daemon's pipeline, 1 s hop, against reading it with python-can alone."""
    config = reference_configuration()

    def whole() -> None:
        with estimator_beside(config) as workers:
            for _ in replay(Pipeline(config, load_databases(config)), [log], workers=workers):
                pass

    def only_read() -> None:
        for _ in read_log(log):
            pass

    ours, peer = _best(whole, 3), _best(only_read, 3)
    return {
        "value": RECORDING / ours, "target": 150, "peer": f"reading alone {peer:.2f} s, whole replay {ours:.2f} s",
        "what": f"{RECORDING:.0f} s, four wheels, 1 s hop",
    }  # fmt: skip
