"""The real unit, started by a real systemd (PID 1 of the guest), on a bus with the field recording on it."""

from __future__ import annotations

import gzip
import itertools
import os
import re
import shutil
import sys
from pathlib import Path

import can
import cantools
import pytest

REPO = Path(__file__).resolve().parents[2]
STATES = {"starting", "waiting", "listening", "estimating", "valid", "degraded", "fault"}
PER_SECOND = 475  # frames of the recording
UNTIL_WINDOW = 13  # s; the first window is full after 10 s
PLAYED = 40  # s; the player still plays while the service restarts


@pytest.fixture(scope="module")
def out(vcan_run, tool, field_recording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What tests/systemd/drive.sh leaves."""
    for name in ("candump", "canplayer", "systemctl", "systemd-sysusers"):
        tool(name)
    folder = tmp_path_factory.mktemp("service")
    with gzip.open(field_recording("loam.log.gz"), "rt") as lines:
        (folder / "played.log").write_text("".join(itertools.islice(lines, PER_SECOND * PLAYED)))
    (folder / "frames-until-window").write_text(str(50 * UNTIL_WINDOW))
    shutil.copytree(REPO / "tests/field", folder / "config", ignore=shutil.ignore_patterns("*.py", "__pycache__"))
    (folder / "soilbus").write_text(
        f"#!/bin/sh\nexec env PYTHONPATH={_python_path()} {sys.executable} -c "
        f"'import sys; from soilbus.cli import main; sys.exit(main())' \"$@\"\n"
    )
    (folder / "soilbus").chmod(0o755)
    (folder / "dropin.conf").write_text(_dropin())
    done = vcan_run(
        ["sh", REPO / "tests/systemd/drive.sh", folder],
        rw=[folder],
        units=(REPO / "systemd").glob("*.service"),
        timeout=240.0,
    )
    assert done.returncode == 0, done.stdout
    return folder


def _python_path() -> str:
    return os.pathsep.join(os.path.abspath(p) for p in os.environ.get("PYTHONPATH", "").split(os.pathsep) if p)


def _dropin() -> str:
    """Lets the sandbox see this checkout and its Python, wherever they are."""
    places = {REPO, Path(sys.prefix), Path(sys.base_prefix), *map(Path, filter(None, _python_path().split(os.pathsep)))}
    hidden = [str(p) for p in sorted(places) if p.is_relative_to("/root") or p.parts[1] in ("home", "tmp", "var")]
    return "[Service]\nProtectHome=tmpfs\n" + "".join(f"BindReadOnlyPaths={p}\n" for p in hidden)


def _shown(out: Path, when: str) -> dict[str, str]:
    return dict(line.split("=", 1) for line in (out / f"{when}.show").read_text().splitlines())


@pytest.mark.systemd
def test_it_becomes_active_on_the_link_that_the_link_unit_made(out: Path) -> None:
    shown = _shown(out, "started")
    assert (shown["ActiveState"], shown["SubState"]) == ("active", "running")
    assert "vcan" in (out / "link").read_text()
    assert "UP" in (out / "link").read_text()


@pytest.mark.systemd
def test_the_running_process_is_confined(out: Path) -> None:
    process = dict(line.split(":", 1) for line in (out / "process").read_text().splitlines())
    assert process["Uid"].split()[0] != "0"
    for capabilities in ("CapEff", "CapPrm", "CapBnd", "CapAmb"):
        assert int(process[capabilities], 16) == 0
    assert process["NoNewPrivs"].strip() == "1"
    assert process["Seccomp"].strip() == "2"


@pytest.mark.systemd
@pytest.mark.parametrize(
    ("when", "states"), [("started", STATES - {"fault", "valid"}), ("playing", {"estimating", "valid", "degraded"})]
)
def test_status_shows_state_and_reason(out: Path, when: str, states: set[str]) -> None:
    text = _shown(out, when)["StatusText"]
    state, reason = re.fullmatch(r"(\w+)(?:: (\S.*?))?(?:, .*)?", text).groups()
    assert state in states
    assert reason or state not in {"waiting", "listening", "degraded", "fault"}  # these say why
    # systemctl status was asked a moment after the text: the figures may have moved, the form has not.
    shown = re.search(r'Status: "(\w+)', (out / f"{when}.status").read_text())
    assert shown
    assert shown[1] in states


@pytest.mark.systemd
def test_it_broadcasts(out: Path) -> None:
    database = cantools.database.load_file(REPO / "dbc/soilbus.dbc")
    names = {message.frame_id: message.name for message in database.messages}
    heard = [names[m.arbitration_id] for m in can.LogReader(out / "bus.log") if m.arbitration_id in names]
    assert heard.count("SoilStrength") >= UNTIL_WINDOW - 10
    assert heard.count("SoilbusStatus") >= UNTIL_WINDOW - 1
    assert heard.count("Traversability") >= 10 * (UNTIL_WINDOW - 1)
    assert heard.count("WheelSlip") >= 10 * (UNTIL_WINDOW - 1)


@pytest.mark.systemd
def test_it_comes_back_after_sigkill(out: Path) -> None:
    before, after = _shown(out, "playing"), _shown(out, "restarted")
    assert (before["NRestarts"], after["NRestarts"]) == ("0", "1")
    assert after["ActiveState"] == "active"
    assert after["MainPID"] != before["MainPID"]


@pytest.mark.systemd
def test_it_stops_cleanly_on_sigterm(out: Path) -> None:
    assert _shown(out, "stopped")["ActiveState"] == "inactive"
    # systemd forgets the exit status of a stopped instance, its journal does not
    stopping = (out / "journal").read_text().rpartition(": Stopping ")[2]
    assert "Deactivated successfully" in stopping
    assert [word for word in ("Main process exited", "timed out", "Failed") if word in stopping] == []
