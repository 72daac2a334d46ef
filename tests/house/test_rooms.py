"""The rooms of the house: imports go one way (service/README.md has the picture)."""

import ast
import re
from functools import cache
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[2] / "service" / "soilbus"
PICTURE = PACKAGE.parent / "docs" / "rooms.dot"
ARROWS = re.findall(r"(\w+) -> (\w+);", PICTURE.read_text())


def below(room: str) -> set[str]:
    """Rooms that arrows of the picture lead to from a room, by way of others too."""
    found: set[str] = set()
    left = [room]
    while left:
        here = left.pop()
        found |= {here}
        left += [lower for upper, lower in ARROWS if upper == here and lower not in found]
    return found - {room}


ROOMS = {room for arrow in ARROWS for room in arrow}


@cache
def imports() -> list[tuple[str, str, str]]:
    """Each import: room and file that import, and the imported module."""
    found = []
    for path in sorted(PACKAGE.rglob("*.py")):
        file = path.relative_to(PACKAGE)
        room = file.parts[0] if len(file.parts) > 1 else ""
        for node in ast.walk(ast.parse(path.read_text())):
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            names += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            found += [(room, str(file), name) for name in names]
    return found


def room_of(module: str) -> str:
    """The room of one of our modules, else nothing."""
    package, _, inside = module.partition(".")
    return inside.partition(".")[0] if package == "soilbus" and inside.partition(".")[0] in ROOMS else ""


def test_the_picture_has_every_room() -> None:
    assert {path.name for path in PACKAGE.iterdir() if path.is_dir() and any(path.glob("*.py"))} == ROOMS


@pytest.mark.parametrize("room", sorted(ROOMS))
def test_a_room_imports_only_from_those_below_it(room: str) -> None:
    of_room = [(file, module) for importer, file, module in imports() if importer == room]
    assert [f"{file}: {module}" for file, module in of_room if room_of(module) not in below(room) | {room, ""}] == []


def test_the_arrows_make_no_circle() -> None:
    left = {room: below(room) for room in ROOMS}
    while left:
        lowest = {room for room, lower in left.items() if not lower & left.keys()}
        assert lowest, f"a circle among {sorted(left)}"
        left = {room: lower for room, lower in left.items() if room not in lowest}


def test_the_daemon_knows_neither_simulator_nor_trials() -> None:
    assert below("daemon").isdisjoint({"simulator", "trials", "report", "diagnosis"})
    assert "can" not in below("estimation") | below("diagnosis")
    assert below("terra") == below("config") == set()


def test_modules_outside_of_the_rooms_know_no_room_but_the_command_line() -> None:
    outside = [(file, module) for room, file, module in imports() if room == "" and file != "__main__.py"]
    assert [f"{file}: {module}" for file, module in outside if room_of(module)] == []


def test_the_library_is_what_nothing_inside_rests_on_and_nothing_rests_on_the_tests() -> None:
    assert not any(lower == "api" for _, lower in ARROWS)
    assert [file for _, file, module in imports() if module.partition(".")[0] == "tests"] == []
