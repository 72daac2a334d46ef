"""`python -m tests.lab.full_bus vcan0`: the daemon on a fully loaded bus of the kernel.

    lost = frames sent - frames that the daemon says it received
    processor ratio = processor time of the daemon / that of a bare python-can loop in the same seconds
    latency = time of the frame SoilStrength - time of the window's last mapped frame    (kernel time stamps)
    frames a second = 1 Mbit/s / 136 bits, of which a tenth is mapped

The channel must be one of our own, such as a vcan, because it is filled up.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from timeit import timeit
from typing import Any

import can
import numpy as np

from soilbus.arrays import Array
from soilbus.can.bus import BusError, open_bus
from soilbus.can.dbc_files import filters_of, load_databases, output_database
from soilbus.can.j1939 import pgn_of
from soilbus.can.publish import Frame
from soilbus.can.wire import wire_of
from soilbus.pipeline.intake import Intake
from soilbus.simulator.frames import frames
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import TRACTOR, reference_configuration
from soilbus.simulator.scenario import excited
from soilbus.trials.bench import as_results, bench_report
from soilbus.trials.bench.figure import Figure

MIN_SECONDS = 15.0
"""Least time [s] on a full bus: a window and its result."""
RECEIVED_MODULUS, WINDOW_MODULUS = 4016, 251
"""Values of the daemon's 12-bit count of received frames and of its 8-bit window number (dbc/soilbus.dbc)."""
EDGE_LEAD = 0.005
"""Time [s] before the first sample at which the daemon's bins begin."""
FULL_BUS_RATE = 7350.0
"""Frames a second of 8 bytes with 29-bit identifiers that 1 Mbit/s carries, at 136 bits each with their stuff bits."""
MAPPED_SHARE = 0.1
"""Share of the frames that is mapped."""

_POSITION = 0xFEF3
"""PGN of the vehicle position."""
_OTHERS_PERIOD = 0.01
"""Period [s] of each unmapped message."""
_OTHERS = 0x18EE0000  # address claims, which nothing is mapped to
PAUSE = 0.05
"""Time [s] between two looks of the ear: frames that the kernel's smallest buffer holds."""
N_SYSTEM_CALLS = 1000
"""How often a system call is timed."""
QUIET_TIME = 1.0
"""Time [s] without a frame after which the channel counts as unused."""
COUNT_TIME = 2.5
"""Time [s] after the last frame until its count is on the bus."""

_BARE = """
import socket, sys
import can
with can.Bus(interface="socketcan", channel=sys.argv[1]) as bus:
    bus.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
    n = 0
    try:
        print("ready", flush=True)
        while True:
            n += bus.recv() is not None
    except KeyboardInterrupt:
        print(n, flush=True)
"""
"""A loop that receives the whole bus with python-can and does nothing else."""


class NotMeasured(Exception):
    """The bus is not ours alone, or the daemon did not do its work there; one line."""


def bus_figures(channel: str, seconds: float) -> dict[str, Figure]:
    """All figures of the daemon on a full bus.

    Parameters
    ----------
    channel
        A vcan.
    seconds
        Time on a full bus [s]; half as long again with a bare python-can loop beside.

    Raises
    ------
    NotMeasured
        The bus is not ours alone, or the daemon did not do its work.
    BusError
        The channel cannot be opened.

    Notes
    -----
    A window whose result never came counts as late as the run is long.
    """
    _check_quiet(channel)
    with TemporaryDirectory() as folder, _daemon(channel, Path(folder)) as (daemon, ready):
        ear, traffic = Ear(channel), Traffic(channel, 1.5 * seconds)
        with others(channel):
            ear.start()
            traffic.start()
            time.sleep(seconds)
            late = ear.latencies()
            shares = _shares(daemon, channel, 0.5 * seconds)
            traffic.wait()
            _wait_until_counted(ear)
        ear.stop()
        memory = _peak_memory(daemon)
    if not len(late):
        raise NotMeasured(f"{channel}: no window was estimated in {seconds:g} s")
    received, overruns = ear.books()
    return {
        "bus_lost": Figure(
            traffic.sent - received, 0.0, f"kernel's drop counter: {overruns}",
            f"of {traffic.sent} frames at our filters, "
            f"{traffic.sent / (1.5 * seconds):.0f} of {FULL_BUS_RATE:.0f} a second",
            at_most=True, digits=0,
        ),
        "bus_latency_ms": _latency(np.minimum(late, seconds), ear.longest_pause()),
        "bus_processor_ratio": shares,
        "bus_memory_mb": Figure(memory / 1e6, 90.0, "", "most resident memory of the daemon", at_most=True),
        "bus_ready_s": Figure(
            ready, 1.5, "", "from start to READY=1", at_most=True, digits=2,
        ),
    }  # fmt: skip


def _latency(late: Array, pause: float) -> Figure:
    """Of the windows' results (windows,) [s]; pause is the longest time [s] in which no frame came."""
    call = timeit(os.getppid, number=N_SYSTEM_CALLS) / N_SYSTEM_CALLS
    return Figure(
        1e3 * float(np.sort(late)[math.ceil(0.99 * len(late)) - 1]), 50.0,
        f"median {1e3 * np.median(late):.1f}, worst {1e3 * late.max():.0f}",
        f"from a window's last frame to its SoilStrength, 99 % of {len(late)} windows", at_most=True,
        more=(
            f"A system call takes {1e6 * call:.0f} us here; no frame came for {1e3 * pause:.0f} ms at most, "
            "as when a machine stands still.",
        ),
    )  # fmt: skip


def _wait_until_counted(ear: Ear) -> None:
    """Wait until the daemon's count of frames stays the same."""
    before = -1
    while (count := ear.books()[0]) != before:
        before = count
        time.sleep(COUNT_TIME)


def _check_quiet(channel: str) -> None:
    with open_bus({"interface": "socketcan", "channel": channel}) as bus:
        if bus.recv(QUIET_TIME) is not None:
            raise NotMeasured(f"{channel}: others are on this bus; the bench would fill it up")


@contextmanager
def _daemon(channel: str, folder: Path) -> Iterator[tuple[subprocess.Popen[bytes], float]]:
    """`soilbus run` on the channel, ready, and the wall time [s] that it took to be."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notify:
        notify.bind(str(folder / "notify"))
        run = ["run", "--config", str(TRACTOR), "--set", "bus.interface=socketcan", "--set", f"bus.channel={channel}"]
        begin = time.perf_counter()
        process = subprocess.Popen(
            [sys.executable, "-m", "soilbus", *run], env={**os.environ, "NOTIFY_SOCKET": str(folder / "notify")}
        )
        reader = threading.Thread(target=_swallow, args=(notify, process), daemon=True)
        try:
            notify.settimeout(60.0)
            while b"READY=1" not in notify.recv(4096):
                pass
            ready = time.perf_counter() - begin
            reader.start()
            yield process, ready
        except TimeoutError:
            raise NotMeasured(f"{channel}: the daemon does not become ready") from None
        finally:
            process.send_signal(signal.SIGTERM)
            process.wait(20.0)
            if reader.is_alive():
                reader.join()


def _swallow(notify: socket.socket, process: subprocess.Popen[bytes]) -> None:
    """Read what systemd would, or the daemon's messages would pile up."""
    while process.poll() is None:
        if select.select([notify], [], [], 0.5)[0]:
            notify.recv(4096)


def _processor(process: subprocess.Popen[bytes]) -> float:
    """Processor time [s] of a process so far, user and system."""
    fields = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _peak_memory(process: subprocess.Popen[bytes]) -> int:
    """Most resident memory of a process so far [bytes]."""
    lines = Path(f"/proc/{process.pid}/status").read_text().splitlines()
    return next(1024 * int(line.split()[1]) for line in lines if line.startswith("VmHWM:"))


def _shares(daemon: subprocess.Popen[bytes], channel: str, seconds: float) -> Figure:
    """The daemon's processor share over that of a bare loop which receives the whole bus, in the same seconds."""
    with subprocess.Popen([sys.executable, "-c", _BARE, channel], stdout=subprocess.PIPE) as bare:
        assert bare.stdout is not None
        bare.stdout.readline()
        before = np.array([_processor(daemon), _processor(bare)])
        begin = time.perf_counter()
        time.sleep(seconds)
        used = np.array([_processor(daemon), _processor(bare)]) - before
        span = time.perf_counter() - begin
        bare.send_signal(signal.SIGINT)
        heard = int(bare.stdout.readline()) / span
    ours, theirs = 100.0 * used / span
    return Figure(
        float(ours / theirs), 2.0, f"bare loop: {theirs:.1f} % for {heard:.0f} frames/s",
        f"daemon: {ours:.1f} % of a processor, estimates included", at_most=True, digits=2,
    )  # fmt: skip


class Ear:
    """Receives the mapped messages and the daemon's on a channel, with the kernel's time stamps.

    It must be made while the channel is quiet: a socket receives all frames until its filters are set, and a foreign
    one would pass for the first mapped one.
    """

    def __init__(self, channel: str) -> None:
        self._config = reference_configuration()
        self._ours = output_database(self._config)
        mapped = Intake(self._config, load_databases(self._config)).admission.can_filters()
        filters = mapped + filters_of(self._ours)
        self._wire = wire_of(open_bus({"interface": "socketcan", "channel": channel}, filters))
        self._mapped: list[float] = []
        self._said: dict[int, list[tuple[float, bytes]]] = {m.frame_id: [] for m in self._ours.messages}
        self._on = True
        self._thread = threading.Thread(target=self._listen, daemon=True)

    def start(self) -> None:
        """Begin to listen; the first mapped frame to come must be the first that the daemon gets."""
        self._thread.start()

    def stop(self) -> None:
        """Stop listening."""
        self._on = False
        self._thread.join()
        self._wire.shutdown()

    def _listen(self) -> None:
        while self._on:
            frame = self._wire.recv(0.0)
            if frame is None:
                time.sleep(PAUSE)  # the kernel stamps frames, and listening takes the daemon time
                continue
            if frame.arbitration_id in self._said:
                self._said[frame.arbitration_id].append((frame.timestamp, bytes(frame.data)))
            else:
                self._mapped.append(frame.timestamp)

    def latencies(self) -> Array:
        """Time [s] from the last mapped frame of each window so far to its frame SoilStrength."""
        said = self._of("SoilStrength", "Window")
        settings = self._config.estimator
        return latencies(np.array(self._mapped), np.array(said), settings.window, settings.hop)

    def longest_pause(self) -> float:
        """The longest time [s] in which no mapped frame came."""
        return float(np.diff(self._mapped).max(initial=0.0))

    def books(self) -> tuple[int, int]:
        """Frames that the daemon says it received, and that were dropped before it (up to 250)."""
        received = np.array([0.0] + [n for _, n in self._of("BusHealth", "Received")])
        dropped = [n for _, n in self._of("BusHealth", "Overruns")]
        return int((np.diff(received) % RECEIVED_MODULUS).sum()), int(max(dropped, default=0))

    def _of(self, message: str, signal: str) -> list[tuple[float, float]]:
        layout = self._ours.get_message_by_name(message)
        decoded: list[tuple[float, Any]] = [
            (t, layout.decode(data, decode_choices=False)) for t, data in self._said[layout.frame_id]
        ]
        return [(t, float(values[signal])) for t, values in decoded]


def latencies(mapped: Array, results: Array, window: float, hop: float) -> Array:
    """From the last mapped frame of a window to its result, (windows,) [s]; inf for one that never came.

    mapped (N,) are the times of mapped frames, ascending [s]; results (M, 2) time and number of the windows
    whose results came, numbers modulo WINDOW_MODULUS from 0.
    """
    if not len(results):
        return np.empty(0)
    number = np.unwrap(results[:, 1], period=WINDOW_MODULUS).astype(int)
    late = np.full(number[-1] + 1, np.inf)
    end = mapped[0] - EDGE_LEAD + window + hop * number
    late[number] = results[:, 0] - mapped[np.searchsorted(mapped, end) - 1]
    return late


class Traffic:
    """Plays a simulated drive onto a channel in real time; `sent` counts its frames, all of them mapped.

    The drive alone is less than a tenth of a full bus, so its position is sent more often, which adds no information.
    """

    def __init__(self, channel: str, seconds: float) -> None:
        self.sent = 0
        config = reference_configuration()
        drive = list(frames(simulate(config, excited("loam", seconds), seed=1), config))
        self.played = _thickened(drive, FULL_BUS_RATE * MAPPED_SHARE)
        """Each frame with its time [s] since an origin of its own, in their order."""
        self._channel = channel
        self._thread = threading.Thread(target=self._play, daemon=True)

    def start(self) -> None:
        """Begin to send."""
        self._thread.start()

    def wait(self) -> None:
        """Until the drive is over."""
        self._thread.join()

    def _play(self) -> None:
        bus = open_bus({"interface": "socketcan", "channel": self._channel}, [])
        wire = wire_of(bus)
        begin = time.monotonic() - self.played[0][0]
        for t, frame in self.played:
            if (ahead := begin + t - time.monotonic()) > 0.0005:
                time.sleep(ahead)
            wire.send(frame)
            self.sent += 1
        wire.shutdown()


def _thickened(drive: Sequence[can.Message], rate: float) -> list[tuple[float, Frame]]:
    """The drive's frames with their times [s], with copies of the position to make up the rate [1/s]."""
    span = drive[-1].timestamp - drive[0].timestamp
    spoken = sum(pgn_of(m.arbitration_id) == _POSITION for m in drive)
    copies = max(0, round((rate * span - len(drive)) / spoken))
    return [
        (message.timestamp, Frame(message.arbitration_id, message.is_extended_id, bytes(message.data)))
        for message in drive
        for _ in range(1 + (copies if pgn_of(message.arbitration_id) == _POSITION else 0))
    ]


@contextmanager
def others(channel: str) -> Iterator[None]:
    """The rest of a full bus, sent by the kernel's own timers."""
    with can.Bus(interface="socketcan", channel=channel, can_filters=[]) as bus:
        tasks = [
            bus.send_periodic(can.Message(arbitration_id=_OTHERS + i, data=bytes(8)), _OTHERS_PERIOD)
            for i in range(round(FULL_BUS_RATE * (1.0 - MAPPED_SHARE) * _OTHERS_PERIOD))
        ]
        try:
            yield
        finally:
            for task in tasks:
                task.stop()


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print the figures beside their targets, and keep them as JSON if asked."""
    parser = argparse.ArgumentParser(prog="python -m tests.lab.full_bus", description=__doc__)
    parser.add_argument("channel", help="a vcan, never a vehicle's")
    parser.add_argument("--seconds", type=float, default=120.0, help="of a full bus, at least 15 (120)")
    parser.add_argument("--json", type=Path, help="write the figures as JSON")
    chosen = parser.parse_args(arguments)
    if not chosen.seconds >= MIN_SECONDS:
        parser.error(f"--seconds: a window needs {MIN_SECONDS:g} s at least")
    try:
        results = as_results(bus_figures(chosen.channel, chosen.seconds))
    except (BusError, NotMeasured) as error:
        print(f"full_bus: {error}", file=sys.stderr)
        return 1
    if chosen.json is not None:
        chosen.json.write_text(json.dumps(results))
    print(bench_report(results), end="")
    return 0


if __name__ == "__main__":
    sys.exit(main())
