"""Buses between processes without SocketCAN: multicast groups, where a sender hears itself."""

import os
import re
import subprocess
import sys
from contextlib import closing, suppress
from pathlib import Path
from types import SimpleNamespace

import can
import pytest

from availability import unavailable
from soilbus.can.bus import BusError, LiveBus, open_bus
from soilbus.can.publish import Frame
from soilbus.can.wire import MulticastWire
from soilbus.simulator.reference import TRACTOR

GROUP = "239.74.163.77"
SERVICE = Path(__file__).resolve().parents[2] / "service"
OURS = Frame(0x18FF649A, True, bytes(8))


def settings(port: int) -> dict[str, object]:
    """Of a group on this host alone; a port of its own for each test process."""
    return {"interface": "udp_multicast", "channel": GROUP, "port": port + os.getpid() % 10_000, "hop_limit": 0}


@pytest.fixture
def pair():
    try:
        buses = [open_bus(settings(30_000)) for _ in range(2)]
    except BusError as error:
        unavailable(str(error))
    yield buses
    for bus in buses:
        with suppress(Exception):
            bus.shutdown()


def test_own_frames_that_come_back_are_no_other_senders(pair):
    ours, others = pair
    own = [(OURS.arbitration_id, OURS.extended)]
    with closing(LiveBus(lambda: ours, lambda: 0.0, lambda _: None, own)) as bus:
        bus.open()
        assert all(bus.send(OURS) for _ in range(3))
        heard = [others.recv(1.0) for _ in range(3)]
        assert [m.arbitration_id for m in heard] == 3 * [OURS.arbitration_id]
        assert [bus.receive(0.2) for _ in range(3)] == [None, None, None]
        assert (bus.counts.foreign, bus.counts.received, bus.counts.sent) == (0, 0, 3)
        others.send(can.Message(arbitration_id=OURS.arbitration_id, data=OURS.data))
        others.send(can.Message(arbitration_id=0x18FF1000, data=b"1"))
        bus.receive(1.0)
        assert bus.receive(1.0).data == b"1"
        assert (bus.counts.foreign, bus.counts.received) == (1, 1)


def test_an_echo_is_expected_once_for_each_frame_sent_and_not_for_ever(monkeypatch):
    now = [100.0]
    monkeypatch.setattr("soilbus.can.wire.time", SimpleNamespace(monotonic=lambda: now[0]))
    coming = []
    wire = MulticastWire(SimpleNamespace(recv=lambda _: coming.pop(0), send=coming.append, shutdown=lambda: None))
    wire.send(OURS)
    coming *= 2  # the echo, and the same frame from another sender
    assert wire.recv(0.0) is None
    assert wire.recv(0.0) is not None
    wire.send(OURS)
    now[0] += 5.0
    assert wire.recv(0.0) is not None


def test_without_its_dependency_the_bus_says_which_extra_it_needs(monkeypatch):
    monkeypatch.setattr("can.interfaces.udp_multicast.utils.msgpack", None)
    monkeypatch.setattr("soilbus.can.bus.find_spec", lambda _: None)
    with pytest.raises(BusError, match=r"needs the extra soilbus\[udp\]"):
        open_bus(settings(30_000))


def test_three_processes_meet_on_a_group(pair):
    """A simulated tractor, the service and a dashboard, each a process of its own."""
    bus = [f"bus.{key}={value}" for key, value in settings(40_000).items()]
    sets = [word for value in [*bus, "estimator.window=2.0"] for word in ("--set", value)]

    def soilbus(*words: str) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", "soilbus", *words, "--config", str(TRACTOR), *sets]
        environ = os.environ | {"PYTHONPATH": str(SERVICE), "OMP_NUM_THREADS": "1"}
        return subprocess.Popen(command, env=environ, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)

    service = soilbus("run")
    tractor = soilbus("simulate", "--bus", "--duration", "8")
    watch = soilbus("watch", "--seconds", "7")
    try:
        shown, complaints = watch.communicate(timeout=60)
        assert watch.returncode == 0, complaints
        tractor.communicate(timeout=30)
        assert tractor.returncode == 0
    finally:
        for process in (service, tractor, watch):
            process.terminate()
        said = service.communicate(timeout=30)[1]
    last = shown.splitlines()[-1]
    assert re.search(r"Slip .*, best \d+ %.* valid \d", last), last
    assert "another node" not in said
