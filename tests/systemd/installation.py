"""What a script in the guest installs: the units, this checkout's service, the field vehicle's configuration."""

from __future__ import annotations

import gzip
import itertools
import os
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

REPO = Path(__file__).resolve().parents[2]
PER_SECOND = 475  # frames of the recording


def prepare(folder: Path, recording: Path, seconds: int, *, hooks: str, dropin: Sequence[str]) -> None:
    """Puts into the folder what tests/systemd/faults.sh wants, and the first seconds of a recording as played.log.

    hooks: a folder of the guest whose sitecustomize.py the service's Python is to run;
    dropin: directives for the unit besides those that a checkout needs.
    """
    with gzip.open(recording, "rt") as lines:
        (folder / "played.log").write_text("".join(itertools.islice(lines, PER_SECOND * seconds)))
    shutil.copytree(REPO / "tests/field", folder / "config", ignore=shutil.ignore_patterns("*.py", "__pycache__"))
    path = os.pathsep.join(filter(None, (hooks, _python_path())))
    (folder / "soilbus").write_text(f'#!/bin/sh\nexec env PYTHONPATH={path} {sys.executable} -m soilbus "$@"\n')
    (folder / "soilbus").chmod(0o755)
    (folder / "checkout.conf").write_text(_dropin())
    (folder / "faults.conf").write_text("\n".join(["[Service]", *dropin, ""]))


def properties(folder: Path, when: str) -> dict[str, str]:
    """What `systemctl show` said then."""
    return dict(line.split("=", 1) for line in (folder / f"{when}.show").read_text().splitlines())


def _python_path() -> str:
    return os.pathsep.join(os.path.abspath(p) for p in os.environ.get("PYTHONPATH", "").split(os.pathsep) if p)


def _dropin() -> str:
    """Lets the sandbox see this checkout and its Python, wherever they are."""
    places = {REPO, Path(sys.prefix), Path(sys.base_prefix), *map(Path, filter(None, _python_path().split(os.pathsep)))}
    hidden = [str(p) for p in sorted(places) if p.is_relative_to("/root") or p.parts[1] in ("home", "tmp", "var")]
    return "[Service]\nProtectHome=tmpfs\n" + "".join(f"BindReadOnlyPaths={p}\n" for p in hidden)
