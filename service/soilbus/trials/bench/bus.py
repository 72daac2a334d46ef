"""The daemon on a fully loaded bus of the kernel: losses, latency, processor, memory, start.

    lost = frames sent - frames that the daemon says it received
    processor ratio = processor time of the daemon / that of a bare python-can loop in the same seconds

The channel must be one of our own, such as a vcan, because it is filled up.
"""

from __future__ import annotations

import math
import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from timeit import timeit

import numpy as np

from soilbus.arrays import Array
from soilbus.can.bus import open_bus
from soilbus.simulator.reference import TRACTOR
from soilbus.trials.bench.bus_ear import Ear
from soilbus.trials.bench.bus_load import FULL_BUS_RATE, Traffic, others
from soilbus.trials.bench.figure import Figure

N_STARTS, N_SYSTEM_CALLS = 3, 1000
"""How often a start and a system call are timed."""
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


_LIBRARIES = """
import can, cantools, numpy
from pydantic import BaseModel
class Anything(BaseModel):
    number: float = 0.0
"""
"""The libraries that the daemon cannot start without; pydantic loads most of itself for a first model."""


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
    ready, libraries, bare = zip(
        *((_time_to_ready(channel), _time_of(_LIBRARIES), _time_of("")) for _ in range(N_STARTS)), strict=True
    )
    with TemporaryDirectory() as folder, _daemon(channel, Path(folder)) as daemon:
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
            float(np.median([wall for wall, _ in ready])), 1.5,
            f"python with its libraries: {np.median(libraries):.2f} s, without: {np.median(bare):.2f} s",
            f"from start to READY=1, median of {N_STARTS}: " + ", ".join(f"{wall:.2f}" for wall, _ in ready) + " s",
            at_most=True, digits=2,
            more=("Processor time to READY=1: " + ", ".join(f"{used:.2f}" for _, used in ready) + " s.",),
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
def _daemon(channel: str, folder: Path) -> Iterator[subprocess.Popen[bytes]]:
    """`soilbus run` on the channel, ready."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notify:
        notify.bind(str(folder / "notify"))
        run = ["run", "--config", str(TRACTOR), "--set", "bus.interface=socketcan", "--set", f"bus.channel={channel}"]
        process = subprocess.Popen(
            [sys.executable, "-m", "soilbus", *run], env={**os.environ, "NOTIFY_SOCKET": str(folder / "notify")}
        )
        reader = threading.Thread(target=_swallow, args=(notify, process), daemon=True)
        try:
            notify.settimeout(60.0)
            while b"READY=1" not in notify.recv(4096):
                pass
            reader.start()
            yield process
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


def _time_to_ready(channel: str) -> tuple[float, float]:
    """Wall and processor time [s] from start to READY=1."""
    with TemporaryDirectory() as folder:
        begin = time.perf_counter()
        with _daemon(channel, Path(folder)) as process:
            return time.perf_counter() - begin, _processor(process)


def _time_of(program: str) -> float:
    """Wall time [s] of a program in a new process."""
    begin = time.perf_counter()
    subprocess.run([sys.executable, "-c", program], check=True)
    return time.perf_counter() - begin


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
