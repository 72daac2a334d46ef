"""From a bare Debian to a running service by the commands of systemd/README.md, run as they are written.

A guest boots the systemd of a Debian that has nothing of this machine and no network: what `apt-get install` of a page
wants from Debian is there beforehand (guest.DEBIAN); pip finds the wheels of others in a folder.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

import pytest
from installation import REPO

import guest
import soilbus
from availability import unavailable

PAGE = (REPO / "systemd/README.md").read_text()
BUILT, WITH_THE_PACKAGE, WITHOUT = (
    [line for line in block.splitlines() if not line.startswith("#")]
    for block in re.findall(r"^```sh\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)[:3]
)
"""Commands of the page: on the machine that builds the package, on the ECU with it, and without it."""
OF_US = (
    "/opt/soilbus",
    "/usr/bin/soilbus",
    "/usr/lib/systemd/system/soilbus@.service",
    "/usr/lib/sysusers.d/soilbus.conf",
)
ENABLED = "/etc/systemd/system/multi-user.target.wants/soilbus@can0.service"
LATER = "99.0.0"


def _run(words: Sequence[str | Path], where: Path = REPO) -> None:
    done = subprocess.run(words, cwd=where, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=300.0)
    assert done.returncode == 0, done.stdout


@pytest.fixture(scope="module")
def debian() -> Path:
    """Root of a bare Debian that the guest can boot."""
    try:
        guest.prepare()
        return guest.bare_debian()
    except guest.Unavailable as reason:
        unavailable(str(reason))
        raise


@pytest.fixture(scope="module")
def installed(debian: Path, tool, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What pages.sh leaves of the package that the page's command builds, of a later version, and of a wheel."""
    tool("dpkg-deb")
    folder = tmp_path_factory.mktemp("installed")
    package, wheel = folder / "package", folder / "wheel"
    for way, commands in ((package, WITH_THE_PACKAGE), (wheel, WITHOUT)):
        way.mkdir()
        (way / "commands").write_text("".join(f"{line}\n" for line in commands))
    checkout = tmp_path_factory.mktemp("checkout") / "soilbus"
    shutil.copytree(REPO, checkout, ignore=shutil.ignore_patterns(".git", ".venv", "tests", "dist", "__pycache__"))
    _run(["sh", "-c", BUILT[1]], checkout)
    (built,) = (checkout / "dist").glob("*.deb")
    shutil.copy(built, package)
    tree = folder / "tree"
    _run(["dpkg-deb", "-R", built, tree])
    control = (tree / "DEBIAN/control").read_text()
    (tree / "DEBIAN/control").write_text(control.replace(f"Version: {soilbus.__version__}", f"Version: {LATER}"))
    (tree / "etc/soilbus/can0.link").write_text("# as a later version has it\n")
    (package / "later").mkdir()
    _run(["dpkg-deb", "--root-owner-group", "-Zzstd", "-z1", "--build", tree, package / "later"])
    shutil.rmtree(tree)
    _run(["/usr/bin/python3", "-m", "venv", folder / "venv"])
    _run([folder / "venv/bin/pip", "wheel", "-q", "-w", folder / "wheels", "."])
    (ours,) = (folder / "wheels").glob("soilbus-*.whl")
    ours.rename(wheel / ours.name)
    shutil.rmtree(folder / "venv")
    (reference,) = (REPO / "service/soilbus").rglob("tractor.toml")
    shutil.copy(reference, wheel)
    shutil.copy(REPO / "tests/systemd/pages.sh", folder)
    of_pip = ["PIP_NO_INDEX=1", f"PIP_FIND_LINKS={folder}/wheels", "PIP_NO_COMPILE=1"]  # the guest is slow
    done = guest.run(["env", *of_pip, "sh", "pages.sh"], rw=[folder], base=debian, timeout=600.0)
    assert done.returncode == 0, done.stdout
    return folder


def shown(folder: Path) -> dict[str, str]:
    """What `systemctl show` said then."""
    return dict(line.split("=", 1) for line in (folder / "show").read_text().splitlines())


def there(folder: Path) -> set[str]:
    """Files and folders of soilbus at the time."""
    return set((folder / "files").read_text().splitlines())


def promised_status() -> list[str]:
    """The lines that the page shows of `systemctl status`."""
    (block,) = re.findall(r"The last command says.*?\n```\n(.*?)```", PAGE, re.DOTALL)
    return [line.strip() for line in block.splitlines()]


def test_it_takes_ten_commands_at_most() -> None:
    assert sum(line.count(" && ") + 1 for line in [*BUILT, *WITH_THE_PACKAGE]) <= 10
    assert BUILT[0].startswith("apt-get")  # satisfied beforehand, where the test runs
    assert WITH_THE_PACKAGE[-1] == WITHOUT[-1] == "systemctl status soilbus@can0"


@pytest.mark.systemd
@pytest.mark.parametrize("way", ["package", "wheel"])
def test_the_service_runs_as_the_page_says(way: str, installed: Path) -> None:
    folder = installed / way
    status = (folder / "status").read_text()
    assert len(promised_status()) == 2
    assert [line for line in promised_status() if line not in status] == []
    assert shown(folder / "running")["UnitFileState"] == "enabled"
    assert (folder / "running/user").read_text().startswith("soilbus:")
    settings = (REPO / "systemd/soilbus.sysctl").read_text()
    assert (folder / "running/rmem_max").read_text().strip() == settings.split(" = ")[1].strip()


@pytest.mark.systemd
def test_the_package_alone_starts_nothing(installed: Path) -> None:
    assert set(OF_US) <= there(installed / "package" / "1")
    assert ENABLED not in there(installed / "package" / "1")
    assert shown(installed / "package" / "1")["ActiveState"] == "inactive"
    assert (installed / "package" / "1/user").read_text().startswith("soilbus:")
    assert os.listdir(installed / "package" / "1/etc") == ["can0.link"]


@pytest.mark.systemd
def test_an_upgrade_keeps_the_configuration_and_restarts_what_runs(installed: Path) -> None:
    before, after = shown(installed / "package" / "before"), shown(installed / "package" / "upgraded")
    assert (installed / "package" / "upgraded/version").read_text() == LATER
    assert (after["ActiveState"], after["UnitFileState"]) == ("active", "enabled")
    assert after["MainPID"] != before["MainPID"] != "0"
    assert (installed / "package" / "upgraded/etc/can0.link").read_text() == "BITRATE=500000\n"
    assert (installed / "package" / "upgraded/etc/can0.toml").read_text().endswith("# ours\n")


@pytest.mark.systemd
def test_a_removal_keeps_configuration_and_state_and_nothing_else(installed: Path) -> None:
    assert shown(installed / "package" / "removed")["ActiveState"] == "inactive"
    assert there(installed / "package" / "removed") == {"/etc/soilbus", "/var/lib/soilbus", ENABLED}
    assert (installed / "package" / "removed/etc/can0.toml").read_text().endswith("# ours\n")
    assert json.loads((installed / "package" / "removed/state.json").read_text())["state"]["starts"] == 2


@pytest.mark.systemd
def test_a_purge_leaves_nothing_but_the_user(installed: Path) -> None:
    assert there(installed / "package" / "purged") == set()
    assert (installed / "package" / "purged/user").read_text().startswith("soilbus:")
