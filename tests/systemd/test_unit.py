"""Policy of the unit files: what must stand in them, and that a weakened unit is noticed."""

from __future__ import annotations

import json
import re
import subprocess
from pathlib import Path
from types import SimpleNamespace

import pytest

from soilbus.can.bus import ask_for_buffer
from soilbus.cli.arguments import command_line

UNITS = Path(__file__).resolve().parents[2] / "systemd"
SERVICE = (UNITS / "soilbus@.service").read_text()
LINK = (UNITS / "soilbus-link@.service").read_text()

COMMON = {
    "RestrictAddressFamilies": "",  # replaced below
    "IPAddressDeny": "any",  # no way out by IP even if a socket slips through
    "NoNewPrivileges": "yes",  # no setuid program gives back what is taken here
    "SystemCallFilter": "@system-service ~@privileged ~@resources",
    "SystemCallErrorNumber": "EPERM",  # libraries probe; faults.sh proves that none is needed
    "SystemCallArchitectures": "native",  # a 32-bit call would pass by the filter
    "MemoryDenyWriteExecute": "yes",  # no injected code
    "LockPersonality": "yes",
    "RestrictNamespaces": "yes",
    "RestrictRealtime": "yes",  # cannot starve the ECU
    "RestrictSUIDSGID": "yes",
    "ProtectSystem": "strict",  # writes nothing but its state directory
    "ProtectHome": "yes",
    "PrivateTmp": "yes",
    "PrivateMounts": "yes",  # mounts of its own reach nobody
    "PrivateDevices": "yes",  # CAN is no device node
    "DevicePolicy": "closed",
    "ProtectProc": "invisible",
    "ProcSubset": "pid",
    "ProtectClock": "yes",
    "ProtectControlGroups": "yes",
    "ProtectHostname": "yes",
    "ProtectKernelLogs": "yes",
    "ProtectKernelModules": "yes",
    "ProtectKernelTunables": "yes",
    "UMask": "0077",
    "PrivateNetwork": "no",  # the CAN interface lives in the host's namespace
}
OF_SERVICE = COMMON | {
    "Type": "notify",
    "NotifyAccess": "main",
    "WatchdogSec": "10",  # a hung loop is killed; bus silence is no hang
    "Restart": "always",  # kill -HUP is no stop
    "RestartPreventExitStatus": "2",  # a wrong configuration does not heal by restarting
    "StartLimitIntervalSec": "0",  # nobody on the field resets a failed unit
    "User": "soilbus",
    "CapabilityBoundingSet": "",  # a raw CAN socket needs none
    "AmbientCapabilities": "",
    "RestrictAddressFamilies": "AF_CAN AF_UNIX",
    "LimitCORE": "0",  # what the watchdog aborts must not fill the flash
    "MemoryMax": "512M",  # frames from anyone cannot take the ECU's memory
    "TasksMax": "32",
    "PrivateUsers": "yes",
    "StateDirectory": "soilbus/%i",
    "StateDirectoryMode": "0700",
}
OF_LINK = COMMON | {
    "Type": "oneshot",
    "RemainAfterExit": "yes",
    "CapabilityBoundingSet": "CAP_NET_ADMIN",  # what link settings need, and nothing else
    "RestrictAddressFamilies": "AF_NETLINK",
}
LISTS = {"RestrictAddressFamilies", "SystemCallFilter", "CapabilityBoundingSet", "AmbientCapabilities", "IPAddressDeny"}
# Directives that would undo a required one.
FORBIDDEN = {
    "IPAddressAllow", "DeviceAllow", "ReadWritePaths", "ExecPaths", "BindPaths", "RootDirectory",
    "PermissionsStartOnly", "SupplementaryGroups", "RuntimeDirectory", "CacheDirectory", "LogsDirectory",
    "ConfigurationDirectory",
}  # fmt: skip


def settings(unit: str) -> dict[str, str]:
    """The directives in force: a list grows with each line and an empty line clears it, else the last line counts."""
    found: dict[str, str] = {}
    for line in re.sub(r"\\\n\s*", " ", unit).splitlines():
        if line.startswith(("#", ";", "[")) or "=" not in line:
            continue
        key, value = (part.strip() for part in line.split("=", 1))
        if key not in LISTS or not value:
            found[key] = value
            continue
        words = value.split()
        if value.startswith("~"):  # the sign is the whole line's
            words = ["~" + word.removeprefix("~") for word in words]
        found[key] = " ".join(sorted({*found.get(key, "").split(), *words}))
    return found


def faults(unit: str, required: dict[str, str]) -> list[str]:
    """What breaks the policy, one line each."""
    found = settings(unit)
    wrong = [f"{key} is {found.get(key)!r}, not {want!r}" for key, want in required.items() if found.get(key) != want]
    wrong += [f"{key} must not be set" for key in FORBIDDEN & found.keys()]
    wrong += [
        f"{key} starts with full rights" for key in found if re.match(r"Exec\w+$", key) and found[key][:1] in "+!"
    ]
    return wrong


CASES = [pytest.param(SERVICE, OF_SERVICE, id="service"), pytest.param(LINK, OF_LINK, id="link")]


@pytest.mark.parametrize(("unit", "required"), CASES)
def test_units_keep_the_policy(unit: str, required: dict[str, str]) -> None:
    assert faults(unit, required) == []


def test_the_service_runs_the_interface_of_its_instance() -> None:
    found = settings(SERVICE)
    assert found["ExecStart"].endswith(" run --config /etc/soilbus/%i.toml --set bus.channel=%i")
    assert "soilbus-link@%i.service" in found["Wants"]
    assert "soilbus-link@%i.service" in found["After"]
    assert not {"Requires", "BindsTo", "Requisite"} & found.keys()  # without a bus it waits, it does not fail


@pytest.fixture
def installed(tmp_path: Path, tool) -> Path:
    """The units as systemd finds them, with a program that this machine has."""
    tool("systemd-analyze")
    for source in UNITS.glob("*.service"):
        text = source.read_text().replace("/opt/soilbus/bin/soilbus", "/bin/true")
        (tmp_path / source.name).write_text(text)
    return tmp_path


def _analyze(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["systemd-analyze", "--no-pager", *words],
        capture_output=True, text=True, cwd=folder, env={"PATH": "/usr/sbin:/usr/bin:/sbin:/bin"},
    )  # fmt: skip


@pytest.mark.parametrize("name", ["soilbus@can0.service", "soilbus-link@can0.service"])
def test_systemd_reads_the_units_without_a_complaint(installed: Path, name: str) -> None:
    done = _analyze(installed, "verify", f"./{name}")
    assert done.returncode == 0
    assert [line for line in done.stderr.splitlines() if "soilbus" in line] == []


def test_the_unit_of_the_page_sends_results_on_as_a_user_of_its_own(installed: Path) -> None:
    page = (UNITS / "README.md").read_text()
    unit = next(text for text in re.findall(r"```ini\n(.*?)```", page, re.DOTALL) if "watch --json" in text)
    assert "User=soilbus" not in unit
    assert "DynamicUser=yes" in unit
    name = "soilbus-mqtt@can0.service"
    (installed / name).write_text(unit)
    done = _analyze(installed, "verify", f"./{name}")
    assert [line for line in done.stderr.splitlines() if "soilbus" in line] == []
    words = unit.replace("\\\n", " ").partition("soilbus watch")[2].partition("|")[0].split()
    assert command_line().parse_args(["watch", *words]).channel == "%i"


@pytest.fixture
def rated(installed: Path) -> Path:
    """The same where systemd-analyze can rate a file."""
    if "offline" not in _analyze(installed, "--help").stdout:
        pytest.skip("this systemd-analyze cannot rate a file")
    return installed


@pytest.mark.parametrize(("name", "tenths"), [("soilbus@can0.service", 10), ("soilbus-link@can0.service", 15)])
def test_systemd_rates_the_exposure_low(rated: Path, name: str, tenths: int) -> None:
    done = _analyze(rated, "security", "--offline=yes", f"--threshold={tenths}", f"./{name}")
    assert done.returncode == 0, done.stdout


@pytest.mark.parametrize(("name", "unit"), [("soilbus@can0.service", SERVICE), ("soilbus-link@can0.service", LINK)])
def test_each_directive_that_leaves_exposure_is_explained_in_the_unit(rated: Path, name: str, unit: str) -> None:
    done = _analyze(rated, "security", "--offline=yes", "--json=short", f"./{name}")
    rows = [row for row in json.loads(done.stdout) if row["set"] is False and row["exposure"]]
    exposed = {re.split("[=/]", row["name"])[0] for row in rows}
    comments = re.findall(r"(?:^#.*\n)+", unit, re.MULTILINE)
    explained = {key for c in comments for key in re.findall(r"(\w+)=", c.partition("Relaxed:")[2])}
    assert "PrivateNetwork" in exposed
    assert exposed - explained == set()


def test_sysusers_makes_the_user_that_the_unit_names(tmp_path: Path, tool) -> None:
    tool("systemd-sysusers")
    (tmp_path / "etc").mkdir()
    done = subprocess.run(
        ["systemd-sysusers", f"--root={tmp_path}", UNITS / "soilbus.sysusers"], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert re.search(r"^soilbus:", (tmp_path / "etc/passwd").read_text(), re.MULTILINE)


def test_documented_units_are_all_there() -> None:
    named = set(re.findall(r"`([\w@.-]+\.(?:service|network|sysctl|sysusers))`", (UNITS / "README.md").read_text()))
    assert named == {path.name for path in UNITS.iterdir() if path.suffix != ".md"}


def test_the_kernels_receive_buffer_may_be_what_the_service_asks_for():
    settings = re.findall(r"^([\w.]+) = (\d+)$", (UNITS / "soilbus.sysctl").read_text(), re.MULTILINE)
    asked = []
    ask_for_buffer(SimpleNamespace(setsockopt=lambda level, option, size: asked.append(size)))
    assert asked
    assert settings == [("net.core.rmem_max", str(size)) for size in set(asked)]


def test_the_page_says_how_that_limit_is_installed():
    page = (UNITS / "README.md").read_text()
    assert '"$S"/soilbus.sysctl /etc/sysctl.d/80-soilbus.conf' in page
