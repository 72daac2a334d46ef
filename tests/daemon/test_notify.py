"""notify.py against a real datagram socket, as systemd's is."""

import json
import logging
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from soilbus.daemon.notify import Notifier


@pytest.fixture(params=["path", "abstract"])
def systemd(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[socket.socket, str]]:
    """The receiving socket and its name as NOTIFY_SOCKET gives it."""
    name = str(tmp_path / "notify") if request.param == "path" else f"@soilbus-test-{os.getpid()}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as receiver:
        receiver.bind(name.replace("@", "\0"))
        receiver.settimeout(5.0)
        yield receiver, name


def test_each_call_is_one_datagram(systemd: tuple[socket.socket, str]) -> None:
    receiver, name = systemd
    notifier = Notifier.from_environment({"NOTIFY_SOCKET": name, "WATCHDOG_USEC": "10000000"})
    notifier.ready("listening: too little slip")
    notifier.status("valid: Bodenstärke 84 kPa")
    notifier.watchdog()
    notifier.stopping()
    assert [receiver.recv(4096).decode() for _ in range(4)] == [
        "READY=1\nSTATUS=listening: too little slip",
        "STATUS=valid: Bodenstärke 84 kPa",
        "WATCHDOG=1",
        "STOPPING=1",
    ]


def test_status_text_cannot_smuggle_in_another_field(systemd: tuple[socket.socket, str]) -> None:
    receiver, name = systemd
    Notifier(name).status("fault: can0\nWATCHDOG=trigger\n")
    assert receiver.recv(4096) == b"STATUS=fault: can0 WATCHDOG=trigger"


def test_nothing_is_sent_where_nobody_watches(systemd: tuple[socket.socket, str]) -> None:
    receiver, name = systemd
    Notifier(name).watchdog()
    Notifier().ready("starting")
    receiver.setblocking(False)
    with pytest.raises(BlockingIOError):
        receiver.recv(4096)


def test_a_full_socket_neither_blocks_nor_raises(
    systemd: tuple[socket.socket, str], caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING):
        for _ in range(2000):  # more than net.unix.max_dgram_qlen
            if caplog.records:
                break
            Notifier(systemd[1]).status("x" * 1000)
    assert "STATUS" in caplog.text


@pytest.mark.parametrize("address", ["/nowhere/notify", "vsock:2:1234", "/" + "x" * 200])
def test_failure_is_logged_and_not_fatal(address: str, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        Notifier(address).ready("starting")
    assert "READY=1" in caplog.text


@pytest.mark.parametrize(
    ("environ", "interval"),
    [
        ({}, None),
        ({"WATCHDOG_USEC": "10000000"}, 5.0),
        ({"WATCHDOG_USEC": "3000000", "WATCHDOG_PID": str(os.getpid())}, 1.5),
        ({"WATCHDOG_USEC": "3000000", "WATCHDOG_PID": str(os.getppid())}, None),
        ({"WATCHDOG_USEC": "0"}, None),
        ({"WATCHDOG_USEC": "-5"}, None),
        ({"WATCHDOG_USEC": "soon"}, None),
    ],
)
def test_watchdog_interval_is_half_of_what_systemd_asks(environ: dict[str, str], interval: float | None) -> None:
    assert Notifier.from_environment(environ).watchdog_interval == interval


def test_a_socket_that_is_gone_is_one_warning_until_it_is_back(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    name = str(tmp_path / "notify")
    notifier = Notifier(name)
    for _ in range(2):
        for _ in range(5):
            notifier.status("valid")
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as receiver:
            receiver.bind(name)
            notifier.status("valid")
        Path(name).unlink()
    assert [record.getMessage() for record in caplog.records] == [
        "systemd not notified of STATUS=valid: No such file or directory"
    ] * 2


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_a_run_in_good_order_and_a_hang_up_does_too(tmp_path: Path, number: signal.Signals) -> None:
    """A terminal that is closed, or kill -HUP, is no reason to lose the state."""
    state = tmp_path / "state.json"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as receiver:
        receiver.bind(str(tmp_path / "notify"))
        receiver.settimeout(60.0)
        bus = ["--set", "bus.interface=virtual", "--set", "bus.channel=of_signals"]
        service = subprocess.Popen(
            [sys.executable, "-m", "soilbus", "run", "--config", "tractor", *bus],
            env={**os.environ, "NOTIFY_SOCKET": str(tmp_path / "notify"), "STATE_DIRECTORY": str(tmp_path)},
        )
        try:
            while not state.exists():  # one at the start
                receiver.recv(4096)
            state.unlink()
            service.send_signal(number)
            while b"STOPPING=1" not in receiver.recv(4096):
                pass
            assert service.wait(30.0) == 0
        finally:
            service.kill()
    assert json.loads(state.read_text())["state"]["starts"] == 1
