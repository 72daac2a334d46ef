"""Fixtures of all tests."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
from xdist.scheduler import LoadFileScheduling

import guest
import soilbus  # noqa: F401  # before numpy, which it keeps to one thread
from availability import unavailable

Run = Callable[..., "subprocess.CompletedProcess[str]"]
REAL_BUS = tuple(f"tests/{folder}/" for folder in ("bus", "guest", "systemd"))
"""Folders of the tests that need vcan0 or a guest kernel."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begins with the tests on a real bus: they mostly wait, and the other worker runs the rest meanwhile."""
    items.sort(key=lambda item: not item.nodeid.startswith(REAL_BUS))
    strays = {item.nodeid for item in items if item.get_closest_marker("vcan") or item.get_closest_marker("systemd")}
    if strays := [name for name in sorted(strays) if not name.startswith(REAL_BUS)]:
        raise pytest.UsageError(f"only tests in {', '.join(REAL_BUS)} have a real bus for themselves: {strays[0]}")


class _OneRealBus(LoadFileScheduling):
    """One worker runs the tests of a file, for they share fixtures, and one those that need a real bus.

    There is one vcan0, and beside a second guest kernel times measured in the first are another machine's.
    """

    def _split_scope(self, nodeid: str) -> str:
        return "real bus" if nodeid.startswith(REAL_BUS) else super()._split_scope(nodeid)


def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> LoadFileScheduling:
    """The scheduler of pytest-xdist."""
    return _OneRealBus(config, log)


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
    made = _ip("link", "add", "dev", "vcan0", "type", "vcan") and _ip("link", "set", "vcan0", "up")

    def run(
        command: Sequence[str | Path], *, rw: Iterable[Path] = (), units: Iterable[Path] = (), timeout: float = 120.0
    ) -> subprocess.CompletedProcess[str]:
        if not units and (made or Path("/sys/class/net/vcan0").exists()):
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
