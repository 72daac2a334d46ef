"""Workers that are processes of their own and see none of the batch's files: DBCs come to them, logs by URL."""

import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from soilbus.cli.main import main
from soilbus.config.file import shipped_dbc

pd = pytest.importorskip("pandas")
distributed = pytest.importorskip("distributed")
pytest.importorskip("aiohttp")
SERVICE = Path(__file__).parents[2] / "service"
SHORT = ["--set", "estimator.window=4"]


@pytest.fixture(scope="module")
def here(logs, moved, tmp_path_factory) -> Path:
    """What only the batch's own machine has: logs, and a maker's DBC with a message that must have a right checksum."""
    folder = tmp_path_factory.mktemp("here")
    (folder / "red").mkdir()
    (folder / "red/one.log").write_text(moved(0.0))
    text = shipped_dbc("tractor.dbc").read_text(encoding="utf-8")
    (folder / "maker.dbc").write_text(text, encoding="utf-8")
    return folder


@pytest.fixture(scope="module")
def address(here, tool, tmp_path_factory) -> Iterator[str]:
    """Of a scheduler with one worker; to the worker the folder `here` is empty."""
    unshare, elsewhere = tool("unshare"), tmp_path_factory.mktemp("elsewhere")
    hidden = [unshare, "--user", "--map-root-user", "--mount", "sh", "-c", 'mount -t tmpfs none "$0" && exec "$@"']
    if subprocess.run([*hidden, str(here), "true"], capture_output=True).returncode:
        pytest.skip("no mount namespace for an ordinary user on this machine")
    file = elsewhere / "scheduler.json"
    dask = [sys.executable, "-m", "dask"]
    scheduler = [*dask, "scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard"]
    worker = [*dask, "worker", "--nthreads", "1", "--no-nanny", "--no-dashboard", "--death-timeout", "60"]
    how = {"cwd": elsewhere, "env": os.environ | {"PYTHONPATH": str(SERVICE)}, "stderr": subprocess.DEVNULL}
    processes = [
        subprocess.Popen([*scheduler, "--scheduler-file", str(file)], **how),
        subprocess.Popen([*hidden, str(here), *worker, "--scheduler-file", str(file)], **how),
    ]
    try:
        with distributed.Client(scheduler_file=str(file), timeout=60) as client:
            client.wait_for_workers(1, timeout=60)
            yield client.scheduler.address
    finally:
        for process in processes:
            process.kill()
            process.wait()


@pytest.fixture(scope="module")
def url(here) -> Iterator[str]:
    """The folder `here` over HTTP."""

    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, *_: object) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(here))) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


def windows_of(tractor: str, out: Path, address: str, logs: list[str], dbc: str) -> dict[str, object]:
    """Windows by log of `soilbus batch` with one of the DBC's messages to be checked."""
    dbc_settings = ["--set", f'dbc.input=["{dbc}"]', "--set", 'dbc.checked=["MotorFL"]']
    command = ["batch", "--config", tractor, *SHORT, *dbc_settings, *logs, "--out", str(out), "--scheduler", address]
    assert main(command) == 0
    windows = pd.read_parquet(out / "windows").drop(columns=["vehicle", "day"])
    return {log: rows.drop(columns="log").reset_index(drop=True) for log, rows in windows.groupby("log")}


def test_logs_by_url_give_what_a_worker_here_finds(client, address, here, url, tractor, tmp_path, monkeypatch):
    monkeypatch.chdir(here)
    mine = windows_of(tractor, tmp_path / "mine", client.scheduler.address, ["red/one.log"], str(here / "maker.dbc"))
    logs = ["red/one.log", f"{url}/red/one.log", f"{url}/red/none.log"]
    there = windows_of(tractor, tmp_path / "there", address, logs, str(here / "maker.dbc"))
    (wanted,) = mine.values()
    assert set(there) == {f"{url}/red/one.log"}
    assert len(wanted) == 5
    for found in there.values():
        pd.testing.assert_frame_equal(found, wanted)
    faults = set(pd.read_parquet(tmp_path / "there/errors.parquet").fault)
    assert faults == {f"{here}/red/one.log: no such file", f"{url}/red/none.log: no such file"}


def test_a_manifest_over_http_names_logs_beside_it(address, here, url, tractor, tmp_path):
    (here / "fleet.csv").write_text("log,vehicle\nred/one.log,Tractor 7\n", encoding="utf-8")
    command = ["batch", "--config", tractor, *SHORT, f"{url}/fleet.csv", "--out", str(tmp_path), "--scheduler", address]
    assert main(command) == 0
    windows = pd.read_parquet(tmp_path / "windows")
    assert set(windows.log) == {f"{url}/red/one.log"}
    assert set(windows.vehicle) == {"Tractor 7"}
    assert len(windows) == 5
