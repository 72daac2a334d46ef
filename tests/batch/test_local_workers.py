"""A batch on this machine: a process that dies costs its own task alone, and the results are those of a cluster."""

import os
import signal
import stat
import tempfile
from contextlib import suppress

import pytest

from soilbus.offline.batch import run_batch
from soilbus.offline.cluster import cluster, done_in_turn
from soilbus.offline.jobs import jobs_of
from soilbus.offline.local_workers import KilledWorker, local_workers

psutil = pytest.importorskip("psutil")


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
