"""The first windows are rehearsed where nothing depends on them, and nothing of it is left behind."""

import gc
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from soilbus.allocator import loading
from soilbus.can.dbc_files import load_databases, output_database
from soilbus.can.wire import MessageWire
from soilbus.config.file import load_config
from soilbus.config.model import ConfigError
from soilbus.daemon import start
from soilbus.daemon.warm_up import warm_up
from soilbus.decision.traversability import Status
from soilbus.simulator.reference import reference_configuration

FIELD = Path(__file__).resolve().parents[1] / "field"
REHEARSED = range(2, 7)
"""Windows of a rehearsal: one that searches for the soil, one that follows it, and few, for a start waits for them."""
VIRTUAL = ("bus.interface=virtual", "bus.channel=warm-up")


@pytest.fixture
def started(monkeypatch):
    """Starts the service of a configuration, and hands out what its rehearsal came to."""
    rehearsals, services, pools = [], [], []

    def pool(*args, **kwargs):
        pools.append(ThreadPoolExecutor(*args, **kwargs))
        return pools[-1]

    def noted(config, database, ours):
        rehearsals.append(warm_up(config, database, ours))

    monkeypatch.setattr("soilbus.daemon.warm_up.warm_up", noted)
    monkeypatch.setattr(start, "ThreadPoolExecutor", pool)

    def of(config):
        services.append(start.start_service(config, wait=False))
        pools[-1].shutdown(wait=True)
        return services[-1], rehearsals

    yield of
    for service in services:
        service.bus.close()


@pytest.mark.parametrize("path", ["field.toml", None])
def test_all_that_a_valid_window_takes_is_rehearsed(path):
    config = reference_configuration() if path is None else load_config(FIELD / path)
    results = warm_up(config, load_databases(config), output_database(config))
    assert len(results) in REHEARSED
    assert {result.status for result in results} == {Status.VALID}
    assert all(result.traversability.capability is not None for result in results)


def test_a_start_rehearses_and_knows_nothing_of_it(started):
    service, rehearsals = started(reference_configuration(VIRTUAL))
    assert len(rehearsals) == 1
    assert service.newest_posterior is None
    assert service.intake.last_seen == {}
    assert service.intake.admission.counts.received.total() == 0
    counters = {name: service.publisher.frame(name, {}).data for name in ("Traversability", "SoilStrength")}
    fresh = start.Publisher(output_database(service.config))
    assert counters == {name: fresh.frame(name, {}).data for name in counters}


def test_an_effect_that_cannot_be_is_told_at_the_start_and_not_by_the_worker():
    config = reference_configuration([*VIRTUAL, 'model.effects=[{name="lugs", hight=0.03}]'])
    with pytest.raises(ConfigError, match="lugs has no parameter hight"):
        start.start_service(config, wait=False)


@pytest.mark.parametrize(("room", "where"), [(8 << 20, "estimate_0"), (425_984, "MainThread")])
def test_the_estimator_is_loaded_while_the_bus_waits_where_it_has_room_for_seconds(started, monkeypatch, room, where):
    threads = []
    monkeypatch.setattr(MessageWire, "room", room)
    monkeypatch.setattr(start, "_load", lambda: threads.append(threading.current_thread().name))
    started(reference_configuration(VIRTUAL))
    assert threads == [where]


def test_a_vehicle_that_cannot_be_simulated_starts_all_the_same(started):
    service, rehearsals = started(load_config(FIELD / "deere.toml", VIRTUAL))
    assert rehearsals == []
    service.step()
    assert service.bus.is_open


DAEMON = """
import os, signal, sys, threading
from soilbus.cli.main import main

def noted(frame, event, value):
    if event == "return" and frame.f_code.co_name == "warm_up":
        print(*(result.status for result in value))
        os.kill(os.getpid(), signal.SIGTERM)

threading.setprofile(noted)
status = main(["run", *sys.argv[1:]])
print(*(name for name, module in sys.modules.items() if module))
sys.exit(status)
"""
EXTRAS = {"scipy", "matplotlib", "pandas", "dask", "asammdf", "rich"}
"""Packages that only other commands need."""


def test_a_daemon_that_has_rehearsed_has_loaded_nothing_of_other_commands():
    options = [word for setting in VIRTUAL for word in ("--set", setting)]
    command = [sys.executable, "-c", DAEMON, "--config", str(FIELD / "field.toml"), *options]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60.0)
    statuses, modules = (line.split() for line in done.stdout.splitlines())
    assert len(statuses) in REHEARSED
    assert set(statuses) == {Status.VALID}
    assert "soilbus.estimation.tracker" in modules
    rooms = {module.split(".")[1] for module in modules if module.startswith("soilbus.")}
    assert not rooms & {"simulator", "trials", "diagnosis", "offline", "report"}
    assert not {module.partition(".")[0] for module in modules} & EXTRAS


def test_nothing_is_collected_while_loading_and_what_is_loaded_is_left_alone():
    kept = gc.get_freeze_count()
    try:
        with loading():
            assert not gc.isenabled()
            loaded = [[] for _ in range(10)]
        assert gc.isenabled()
        assert gc.get_freeze_count() >= kept + len(loaded)
        with pytest.raises(ConfigError), loading():
            raise ConfigError(["wrong"])
        assert gc.isenabled()
    finally:
        gc.unfreeze()
