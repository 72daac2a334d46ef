"""The rooms of the house: imports go one way (service/README.md has the picture)."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "service" / "soilbus"
MAY_IMPORT = {
    "terra": set(),
    "config": set(),
    "can": {"config"},
    "estimation": {"config", "terra"},
    "sensors": {"config", "can", "estimation", "terra"},
    "decision": {"config", "sensors", "estimation", "terra"},
    "pipeline": {"config", "can", "decision", "sensors", "estimation", "terra"},
    "daemon": {"pipeline", "config", "can", "decision", "sensors", "estimation", "terra"},
    "diagnosis": {"estimation", "terra"},
    "offline": {"pipeline", "diagnosis", "config", "can", "sensors", "estimation", "terra"},
    "simulator": {"config", "can", "estimation", "terra"},
    "report": {"offline", "pipeline", "diagnosis", "config", "can", "decision", "sensors", "estimation", "terra"},
}
"""Rooms that a room may import from; `cli` and `validation` may import from all, and nothing from them."""


def imports() -> list[tuple[str, str, str]]:
    """Each import of one of our modules: room and file that import, and the imported module."""
    found = []
    for path in sorted(PACKAGE.rglob("*.py")):
        file = path.relative_to(PACKAGE)
        room = file.parts[0] if len(file.parts) > 1 else ""
        for node in ast.walk(ast.parse(path.read_text())):
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            names += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            found += [(room, str(file), name) for name in names if name.startswith("soilbus.")]
    return found


IMPORTS = imports()
ROOMS = {room for room, _, _ in IMPORTS if room}


def test_each_room_has_its_arrows() -> None:
    folders = {path.name for path in PACKAGE.iterdir() if path.is_dir() and any(path.glob("*.py"))}
    assert folders == {*MAY_IMPORT, "cli", "validation"}


@pytest.mark.parametrize("room", sorted(MAY_IMPORT))
def test_a_room_imports_only_from_those_below_it(room: str) -> None:
    allowed = MAY_IMPORT[room] | {room}
    wrong = [
        f"{file}: {module}"
        for importer, file, module in IMPORTS
        if importer == room and (part := module.split(".")[1]) in ROOMS and part not in allowed
    ]
    assert wrong == []


def test_the_arrows_make_no_circle() -> None:
    left = dict(MAY_IMPORT)
    while left:
        lowest = {room for room, below in left.items() if not below & left.keys()}
        assert lowest, f"a circle among {sorted(left)}"
        left = {room: below for room, below in left.items() if room not in lowest}


def test_modules_outside_of_the_rooms_know_no_room_but_the_command_line() -> None:
    assert [
        f"{file}: {module}"
        for room, file, module in IMPORTS
        if room == "" and module.split(".")[1] in ROOMS and file != "__main__.py"
    ] == []
