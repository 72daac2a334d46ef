"""Logs of two vehicles, some of them broken, and a Dask cluster within the process."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from fakes import drive_messages
from soilbus.can.log_writer import write_log
from soilbus.simulator.reference import TRACTOR, reference_configuration

SHORT = "estimator.window=4"


@pytest.fixture(scope="session")
def drive(tmp_path_factory) -> list[str]:
    """Lines of a log of nine seconds, from 14 November 2023 22:13:20 UTC on."""
    config = reference_configuration([SHORT])
    path = tmp_path_factory.mktemp("drive") / "drive.log"
    write_log(drive_messages(config, 9.0, seed=4), path)
    return path.read_text().splitlines(keepends=True)


@pytest.fixture(scope="session")
def moved(drive):
    """The log that many seconds later."""
    return lambda by: "".join(f"({float(line[1:18]) + by:.6f}){line.split(')', 1)[1]}" for line in drive)


@pytest.fixture(scope="session")
def logs(drive, moved, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("fleet")
    for vehicle in ("red", "blue"):
        (folder / vehicle).mkdir()
    (folder / "red/morning.log").write_text(moved(0.0))
    (folder / "red/midnight.log").write_text(moved(6394.5))  # from 23:59:54.5 on
    (folder / "blue/whole.log").write_text(moved(20.0))
    (folder / "blue/cut.log").write_text(moved(40.0)[: len("".join(drive)) * 4 // 5 + 20])
    (folder / "blue/garbage.log").write_text("no log at all\n")
    (folder / "blue/other.log").write_text("".join(f"({n}.0) can0 7AB#0102\n" for n in range(1, 30)))
    return folder


@pytest.fixture(scope="session")
def client(in_process) -> Iterator[Any]:
    with in_process() as (_, client):
        yield client


@pytest.fixture(scope="session")
def in_process() -> Any:
    """Opens a cluster of one thread of this process, and a client of it."""
    distributed = pytest.importorskip("distributed")
    dask = pytest.importorskip("dask")
    quick = {"distributed.comm.timeouts.connect": 1, "distributed.comm.retry.count": 0}
    logging.getLogger("distributed").setLevel(logging.CRITICAL)

    @contextmanager
    def opened() -> Iterator[tuple[Any, Any]]:
        options = {"processes": False, "threads_per_worker": 1, "dashboard_address": "127.0.0.1:0", "silence_logs": 50}
        with (
            dask.config.set(quick),
            distributed.LocalCluster(n_workers=1, **options) as local,
            distributed.Client(local, timeout=2) as client,
        ):
            yield local, client

    return opened


@pytest.fixture(scope="session")
def config() -> Any:
    return reference_configuration([SHORT])


@pytest.fixture(scope="session")
def tractor() -> str:
    return str(TRACTOR)
