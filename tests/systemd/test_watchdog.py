"""What systemd does about a service that does not work, and what a sandbox that kills lets it do.

Each refused system call kills the process here (the shipped unit lets it fail), so that
whatever these runs do is proven to need none of them: start, bus lost and found, windows,
state written, read, refused and not written for a full disk, stop, bad configuration.
tests/daemon/test_health.py has the other faults, in a loop with a clock in hand.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from installation import REPO, prepare, properties

# OpenBLAS asks for mbind when it is loaded, and can do without.
DROPIN = ("WatchdogSec=6", "SystemCallErrorNumber=kill", "SystemCallFilter=~mbind:EPERM")


@pytest.fixture(scope="module")
def out(vcan_run, tool, field_recording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What tests/systemd/faults.sh leaves."""
    for name in ("canplayer", "systemctl", "systemd-sysusers"):
        tool(name)
    folder = tmp_path_factory.mktemp("faults")
    prepare(folder, field_recording("loam.log.gz"), 30, hooks="/opt/soilbus/hooks", dropin=DROPIN)
    done = vcan_run(
        ["sh", REPO / "tests/systemd/faults.sh", folder],
        rw=[folder],
        units=(REPO / "systemd").glob("*.service"),
        timeout=400.0,
    )
    assert done.returncode == 0, done.stdout
    assert not (folder / "never").exists(), (folder / "never").read_text()
    return folder


def _restarts(out: Path) -> dict[str, int]:
    return {name: int(n) for name, n in (line.split() for line in (out / "restarts").read_text().splitlines())}


@pytest.mark.systemd
def test_silence_and_a_bus_that_is_down_are_no_reason_to_restart(out: Path) -> None:
    assert _restarts(out)["silence"] == 0
    assert (out / "silent").read_text().startswith("listening: no_frames")
    assert (out / "down").read_text().startswith("waiting: bus_down")


@pytest.mark.systemd
@pytest.mark.parametrize("fault", ["loop", "estimator"])
def test_the_watchdog_restarts_what_hangs(out: Path, fault: str) -> None:
    assert _restarts(out)[fault] == 1
    assert (out / "watchdog.journal").read_text().count("Watchdog timeout") == 2


@pytest.mark.systemd
def test_the_status_says_what_hangs(out: Path) -> None:
    text = (out / "estimator").read_text()
    assert text.startswith("fault: overload the estimator hangs")
    assert "deadline misses" in text


@pytest.mark.systemd
def test_the_state_outlives_restarts(out: Path) -> None:
    state = json.loads((out / "kept.json").read_text())["state"]
    assert state["starts"] == 3
    assert state["totals"]["windows"] > 0  # of the last run: what the watchdog kills had no time to write
    assert state["totals"]["bus.sent"] > 100
    assert json.loads((out / "fresh.json").read_text())["state"]["starts"] == 1


@pytest.mark.systemd
@pytest.mark.parametrize(
    ("run", "why"),
    [
        ("foreign", "it is not a state of soilbus"),
        ("full", "state cannot be stored in /var/lib/soilbus/vcan1: No space left on device"),
    ],
)
def test_a_state_that_cannot_be_used_or_stored_is_one_warning(out: Path, run: str, why: str) -> None:
    journal = (out / f"{run}.journal").read_text()
    assert sum("state" in line for line in journal.splitlines()) == journal.count(why) == 1


@pytest.mark.systemd
def test_a_full_disk_changes_nothing_else(out: Path) -> None:
    assert "kPa" in (out / "full").read_text()
    assert (out / "full.files").read_text().split() == ["full"]


@pytest.mark.systemd
def test_a_configuration_that_cannot_work_is_told_once(out: Path) -> None:
    shown = properties(out, "nonsense")
    assert shown["ExecMainStatus"] == "2"
    assert shown["ActiveState"] == "failed"
    journal = (out / "nonsense.journal").read_text()
    assert journal.count("nonsense: unknown key") == 1


@pytest.mark.systemd
def test_no_system_call_was_refused_in_all_this(out: Path) -> None:
    """Those that the watchdog ended were aborted; what a refused call ends is killed by SIGSYS."""
    journal = (out / "journal").read_text()
    assert "status=6/ABRT" in journal
    assert "SYS" not in [word for line in journal.splitlines() if "status=" in line for word in line.split("/")]
    assert "status=31" not in journal
    assert "Traceback" not in journal
