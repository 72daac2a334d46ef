"""A batch on this machine: no port that another user could reach, and a process that dies costs its own task alone."""

from __future__ import annotations

import glob
import os
import re
import signal
import socket
import stat
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path

import pytest

from soilbus.offline.batch import run_batch
from soilbus.offline.cluster import cluster, done_in_turn
from soilbus.offline.jobs import jobs_of
from soilbus.offline.local_workers import KilledWorker, local_workers

psutil = pytest.importorskip("psutil")
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


def test_the_table_of_listening_sockets_is_read_right():
    before = set(listening({os.getpid()}))  # of tests before this one
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        assert set(listening({os.getpid()})) - before == {f"tcp 0100007F:{port:04X}"}


def test_no_process_of_a_batch_listens(moved, tractor, tmp_path):
    logs = tmp_path / "fleet/red"
    logs.mkdir(parents=True)
    for n in range(3):
        (logs / f"{n}.log").write_text(moved(100.0 * n))
    command = ["batch", "--config", tractor, "--set", SHORT, str(logs), "--out", str(tmp_path / "out")]
    seen: set[str] = set()
    most = looks = 0
    with subprocess.Popen(
        [sys.executable, "-m", "soilbus", *command], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as batch:
        while batch.poll() is None:
            try:
                family = {batch.pid, *(p.pid for p in psutil.Process(batch.pid).children(recursive=True))}
            except psutil.NoSuchProcess:
                break
            seen |= set(listening(family))
            most, looks = max(most, len(family)), looks + 1
            time.sleep(0.02)
        said = batch.communicate()[1]
    assert (batch.returncode, said) == (0, b"")
    assert most >= 2
    assert looks >= 50
    assert seen == set()


def squared(n: int) -> int:
    """The square; a process that gets a negative number dies of it."""
    if n < 0:
        os.kill(os.getpid(), signal.SIGKILL)
    return n * n


def swallowed(share: float) -> int:
    """Ask for a share of the machine's memory."""
    return len(bytearray(int(share * os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))))


def here(_: int) -> tuple[str, int]:
    """The folder of the process's temporary files, and its threads."""
    return tempfile.gettempdir(), int(os.environ["OMP_NUM_THREADS"])


def test_a_process_that_dies_costs_its_own_task_and_each_has_a_share_of_memory_and_a_folder_of_its_user(monkeypatch):
    monkeypatch.setattr("soilbus.offline.local_workers.TRIES", 2)
    numbers = [*range(8), -1, *range(8, 16)]
    with local_workers(2) as client:
        assert sum(client.nthreads().values()) == 2
        found = dict(done_in_turn(client, squared, ((str(n), (n,)) for n in numbers)))
        assert isinstance(found.pop("-1"), KilledWorker)
        assert found == {str(n): n * n for n in range(16)}
        assert dict(done_in_turn(client, squared, [("7", (7,))])) == {"7": 49}

        tasks = [(str(n), ()) for n in range(2)]
        for _, process in done_in_turn(client, os.getpid, tasks):
            with suppress(ProcessLookupError):  # the same process twice
                os.kill(process, signal.SIGKILL)
        assert dict(done_in_turn(client, squared, ((str(n), (n,)) for n in range(5)))) == {
            str(n): n * n for n in range(5)
        }

        # memory is shared out, and files are of this user alone
        found = dict(done_in_turn(client, swallowed, [("much", (0.75,)), ("little", (1e-3,))]))
        assert isinstance(found["much"], MemoryError)
        assert found["little"] > 0
        ((folder, threads),) = set(dict(done_in_turn(client, here, [("0", (0,)), ("1", (1,))])).values())
        assert threads == 1
        assert stat.S_IMODE(os.stat(folder).st_mode) == 0o700
    assert not os.path.exists(folder)


def test_processes_here_give_the_bytes_of_a_dask_cluster(client, config, logs, tmp_path):
    """Also of those that fail."""
    jobs = jobs_of(config, "t", [str(logs)], lambda _: config)
    with cluster(None, processes=2) as mine:
        run_batch(mine, jobs, tmp_path / "mine")
    run_batch(client, jobs, tmp_path / "dask")
    found = {path.relative_to(tmp_path / "mine"): path.read_bytes() for path in (tmp_path / "mine").rglob("*.*")}
    assert len(found) > 10
    assert found == {
        path.relative_to(tmp_path / "dask"): path.read_bytes() for path in (tmp_path / "dask").rglob("*.*")
    }
