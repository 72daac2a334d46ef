"""A batch whose processes are killed, none of which another user can reach, and the memory that a long log takes."""

import glob
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest

from soilbus.offline.batch import run_batch
from soilbus.offline.jobs import jobs_of

psutil = pytest.importorskip("psutil")
pytest.importorskip("distributed")
SHORT = "estimator.window=4"
LISTENS = "0A"
"""State of a listening socket in /proc/net/tcp (include/net/tcp_states.h)."""


def listening(processes: set[int]) -> list[str]:
    """Local addresses at which these processes listen or take datagrams by IP, by proc(5)."""
    inodes = set()
    for process in processes:
        for link in glob.glob(f"/proc/{process}/fd/*"):
            with suppress(OSError):  # closed by now
                inodes |= set(re.findall(r"^socket:\[(\d+)\]$", os.readlink(link)))
    found = []
    for table in ("tcp", "tcp6", "udp", "udp6"):
        path = Path("/proc/net", table)
        for line in path.read_text().splitlines()[1:] if path.exists() else []:
            _, local, _, state, *_, inode = line.split()[:10]
            if inode in inodes and (state == LISTENS or table.startswith("udp")):
                found.append(f"{table} {local}")
    return found


def wait_for(what: Callable[[], bool], seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < end
        time.sleep(0.02)


def test_the_table_of_listening_sockets_is_read_right():
    before = set(listening({os.getpid()}))  # of tests before this one
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        assert set(listening({os.getpid()})) - before == {f"tcp 0100007F:{port:04X}"}


def test_killed_workers_are_replaced_and_a_killed_batch_goes_on_to_the_same_bytes(
    client, config, moved, tractor, tmp_path
):
    logs = tmp_path / "fleet/red"
    logs.mkdir(parents=True)
    for n in range(8):
        (logs / f"{n}.log").write_text(moved(100.0 * n))
    out, parts = tmp_path / "out", tmp_path / "out/parts"
    command = ["batch", "--config", tractor, "--set", SHORT, str(logs), "--out", str(out)]
    batch = subprocess.Popen([sys.executable, "-m", "soilbus", *command], stderr=subprocess.PIPE, text=True)
    seen: list[str] = []

    def has_done(more_than: int) -> bool:
        family = {batch.pid, *(p.pid for p in psutil.Process(batch.pid).children(recursive=True))}
        seen.extend(listening(family))
        return len(list(parts.glob("*.json"))) > more_than

    try:
        wait_for(lambda: has_done(0))
        workers = [
            p for p in psutil.Process(batch.pid).children(recursive=True) if "spawn_main" in " ".join(p.cmdline())
        ]
        assert workers
        for worker in workers:
            worker.kill()
        n = len(list(parts.glob("*.json")))
        wait_for(lambda: has_done(n))
        left = psutil.Process(batch.pid).children(recursive=True)
    finally:
        batch.send_signal(signal.SIGKILL)
    said = batch.communicate(timeout=20)[1]
    assert "Traceback" not in said
    assert seen == []
    done = len(list(parts.glob("*.json")))
    assert n < done < 8
    wait_for(lambda: not any(p.is_running() and p.status() != psutil.STATUS_ZOMBIE for p in left))
    jobs = jobs_of(config, Path(tractor).name, [str(logs)], lambda path: config)
    assert run_batch(client, jobs, out).resumed == done
    run_batch(client, jobs, tmp_path / "whole")
    assert {path.relative_to(out): path.read_bytes() for path in out.rglob("*") if path.is_file()} == {
        path.relative_to(tmp_path / "whole"): path.read_bytes()
        for path in (tmp_path / "whole").rglob("*")
        if path.is_file()
    }


MEMORY = """
import resource, sys
from soilbus.config.file import load_config
from soilbus.offline.parts import Job, part_of, setup_of
setup = setup_of(load_config(sys.argv[1], ["estimator.window=30", "estimator.hop=30"]), "tractor")
for log in sys.argv[2:]:
    outcome, part = part_of(Job(log, "red", setup))
    assert outcome.fault is None and part, outcome.fault
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024)
"""


def test_memory_does_not_grow_with_a_log(moved, tractor, tmp_path):
    short, long = tmp_path / "short.log", tmp_path / "long.log"
    short.write_text("".join(moved(9.0 * n) for n in range(4)))
    with long.open("w") as out:
        for n in range(24):
            out.write(moved(9.0 * n))
    command = [sys.executable, "-c", MEMORY, tractor, str(short), str(long)]
    run = subprocess.run(command, capture_output=True, text=True, timeout=120.0, check=True, env=os.environ)
    before, after = map(int, run.stdout.split())
    assert after - before < 0.5 * (long.stat().st_size - short.stat().st_size)
