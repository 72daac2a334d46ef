"""The real unit, started by a real systemd (PID 1 of the guest), on a bus with the field recording on it.

What systemd does about a service that does not work, and what a sandbox that kills lets it do.  Each refused system
call kills the process here (the shipped unit lets it fail), so that whatever these runs do is proven to need none of
them: start, bus lost and found, windows, state written, read, refused and not written for a full disk, stop, bad
configuration.  tests/daemon/test_health.py has the other faults, in a loop with a clock in hand.
"""

from __future__ import annotations

import json
import re
from pathlib import Path

import can
import cantools
import pytest
from installation import REPO, prepare, properties

STATES = {"starting", "waiting", "listening", "estimating", "valid", "degraded", "fault"}
WINDOW, UNTIL_WINDOW = 4, 7  # s; the first window is full after WINDOW
PLAYED = 30  # s, again and again
# OpenBLAS asks for mbind when it is loaded, and can do without.
DROPIN = ("WatchdogSec=6", "SystemCallErrorNumber=kill", "SystemCallFilter=~mbind:EPERM")


@pytest.fixture(scope="module")
def out(vcan_run, tool, field_recording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What tests/systemd/faults.sh leaves."""
    for name in ("candump", "canplayer", "systemctl", "systemd-sysusers"):
        tool(name)
    folder = tmp_path_factory.mktemp("service")
    prepare(folder, field_recording("loam.log.gz"), PLAYED, hooks="/opt/soilbus/hooks", dropin=DROPIN)
    (folder / "frames-until-window").write_text(str(50 * UNTIL_WINDOW))
    page = (REPO / "systemd/README.md").read_text()
    unit = next(text for text in re.findall(r"```ini\n(.*?)```", page, re.DOTALL) if "watch --json" in text)
    (folder / "soilbus-mqtt@.service").write_text(unit)
    done = vcan_run(
        ["sh", REPO / "tests/systemd/faults.sh", folder],
        rw=[folder],
        units=(REPO / "systemd").glob("*.service"),
        timeout=500.0,
    )
    assert done.returncode == 0, done.stdout
    assert not (folder / "never").exists(), (folder / "never").read_text()
    return folder


@pytest.mark.systemd
def test_it_becomes_active_on_the_link_that_the_link_unit_made(out: Path) -> None:
    shown = properties(out, "started")
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
def test_the_running_process_can_write_its_state_and_nothing_that_stays(out: Path) -> None:
    mounts = [line.split() for line in (out / "mounts").read_text().splitlines()]
    writable = {fields[4] for fields in mounts if "rw" in fields[5].split(",")}
    passing = ("proc", "tmpfs", "devpts", "mqueue", "hostfs")  # hostfs is the guest's own, see guest-init
    kernels = {fields[4] for fields in mounts if fields[fields.index("-") + 1] in passing}
    assert "/var/lib/soilbus/vcan1" in writable
    private = {"/tmp", "/var/tmp"}  # gone with the service
    assert writable - kernels <= {"/var/lib/soilbus/vcan1", *private}


@pytest.mark.systemd
@pytest.mark.parametrize(
    ("when", "states"), [("started", STATES - {"fault", "valid"}), ("playing", {"estimating", "valid", "degraded"})]
)
def test_status_shows_state_and_reason(out: Path, when: str, states: set[str]) -> None:
    text = properties(out, when)["StatusText"]
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
    assert heard.count("SoilStrength") >= UNTIL_WINDOW - WINDOW
    assert heard.count("SoilbusStatus") >= UNTIL_WINDOW - 1
    assert heard.count("Traversability") >= 10 * (UNTIL_WINDOW - 1)
    assert heard.count("WheelSlip") >= 10 * (UNTIL_WINDOW - 1)


@pytest.mark.systemd
def test_results_reach_the_program_that_sends_them_on_as_a_user_of_its_own(out: Path) -> None:
    said = (out / "results").read_text()
    user, options, arguments = re.findall(r"^user: (.*); options: (.*); arguments: (.*)$", said, re.M)[0]
    assert user not in ("root", "soilbus")
    assert (options, arguments) == ("-h 192.0.2.10", "-l -q 1 -t farm/tractor7/window")
    lines = [json.loads(line) for line in said.splitlines() if line.startswith("{")]
    windows = {line["window"]: line for line in lines if line["window"] is not None}
    assert {0, 1, 2} <= windows.keys()
    assert windows[2]["status"] == "valid"
    assert set(windows[2]["slip"]) == {"FL", "FR", "RL", "RR"}
    assert properties(out, "results") == {"NRestarts": "0", "Result": "success"}


@pytest.mark.systemd
def test_it_comes_back_after_sigkill(out: Path) -> None:
    before, after = properties(out, "playing"), properties(out, "restarted")
    assert (before["NRestarts"], after["NRestarts"]) == ("0", "1")
    assert after["ActiveState"] == "active"
    assert after["MainPID"] != before["MainPID"]


@pytest.mark.systemd
def test_it_stops_cleanly_on_sigterm(out: Path) -> None:
    assert properties(out, "stopped")["ActiveState"] == "inactive"
    # systemd forgets the exit status of a stopped instance, its journal does not
    stopping = (out / "drive.journal").read_text().rpartition(": Stopping ")[2]
    assert "Deactivated successfully" in stopping
    assert [word for word in ("Main process exited", "timed out", "Failed") if word in stopping] == []


@pytest.mark.systemd
def test_its_state_outlives_sigkill(out: Path) -> None:
    state = json.loads((out / "killed.json").read_text())["state"]
    assert state["starts"] == 2
    assert state["totals"]["frames"] > 0


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
    assert state["starts"] == 5
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
