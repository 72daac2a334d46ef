"""Fixtures of all tests."""

import os
import shutil
import signal
import subprocess
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import hypothesis
import pytest
from xdist.scheduler import LoadFileScheduling

import guest
import soilbus  # noqa: F401  # before numpy, which it keeps to one thread
from availability import unavailable
from soilbus.allocator import loading

Run = Callable[..., "subprocess.CompletedProcess[str]"]
IN_REAL_TIME = ("tests/bus/", "tests/guest/", "tests/systemd/", "tests/cli/test_demo.py")
"""What waits for a bus, a guest kernel or a service most of the time."""


hypothesis.settings.register_profile("seeded", derandomize=True, deadline=None, max_examples=50)
hypothesis.settings.load_profile("seeded")
signal.signal(signal.SIGHUP, signal.SIG_DFL)  # below nohup it is ignored, also by the processes that tests start


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Look for no garbage while tests are collected, nor later among what that has made: it took half of the time."""
    with loading():
        return (yield)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the tests in real time: one worker waits with them while the others compute."""
    items.sort(key=lambda item: not _in_real_time(item.nodeid))
    for item in items:
        if (item.get_closest_marker("vcan") or item.get_closest_marker("systemd")) and not _in_real_time(item.nodeid):
            raise pytest.UsageError(f"{item.nodeid} needs a real bus, and only tests in {IN_REAL_TIME} take turns")


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Let the processes of tests in real time go before those that compute."""
    if not _in_real_time(item.nodeid):
        os.nice(max(10 - os.nice(0), 0))


def _in_real_time(nodeid: str) -> bool:
    return nodeid.startswith(IN_REAL_TIME)


class _TakingTurns(LoadFileScheduling):
    """Give the tests of a file to one worker, for they share fixtures, and all tests in real time to one.

    There is one vcan0, and two guests beside each other spoil each other's times.
    """

    def _split_scope(self, nodeid: str) -> str:
        return "real time" if _in_real_time(nodeid) else super()._split_scope(nodeid)


def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> LoadFileScheduling:
    """Return the scheduler of pytest-xdist."""
    return _TakingTurns(config, log)


@pytest.fixture(scope="session")
def tool() -> Callable[[str], str]:
    """Path of a program of this machine that a test cannot do without."""

    def find(name: str) -> str:
        if (path := shutil.which(name)) is None:
            unavailable(f"no {name} on this machine")
        return str(path)

    return find


@pytest.fixture(scope="session")
def field_recording() -> Callable[[str], Path]:
    """Path of a recording of the field vehicle."""

    def find(name: str) -> Path:
        path = Path(__file__).resolve().parents[2] / "shared/field" / name
        if not path.exists():
            unavailable(f"no {path}")
        return path

    return find


@pytest.fixture(scope="session")
def vcan_run() -> Iterator[Run]:
    """Runs a command where vcan0 is up, as `guest.run` does: on this kernel if it can, else in the guest.

    Units are only ever started in the guest.
    """
    made = False

    def run(
        command: Sequence[str | Path], *, rw: Iterable[Path] = (), units: Iterable[Path] = (), timeout: float = 120.0
    ) -> subprocess.CompletedProcess[str]:
        nonlocal made
        if not units and not Path("/sys/class/net/vcan0").exists():
            made = _ip("link", "add", "dev", "vcan0", "type", "vcan") and _ip("link", "set", "vcan0", "up")
        if not units and Path("/sys/class/net/vcan0").exists():
            return subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=timeout)
        try:
            return guest.run(command, rw=rw, units=units, timeout=timeout)
        except guest.Unavailable as reason:
            unavailable(f"no vcan in this kernel, and {reason}")
            raise

    yield run
    if made:
        _ip("link", "del", "vcan0")


def _ip(*words: str) -> bool:
    try:
        return subprocess.run(["ip", *words], capture_output=True).returncode == 0
    except FileNotFoundError:
        return False
