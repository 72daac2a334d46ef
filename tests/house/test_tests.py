"""Tests rest on what modules offer: no tuning value and no private name of ours is imported by one."""

import ast
import importlib
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

TESTS = Path(__file__).resolve().parents[1]
FILES = sorted(TESTS.rglob("*.py"))


def imports(text: str) -> Iterator[tuple[str, str]]:
    """Module and name of each import from a module of ours; of a whole module its path's parts."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "soilbus":
            yield from ((str(node.module), alias.name) for alias in node.names)
            yield from ((str(node.module), part) for part in str(node.module).split("."))
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names if alias.name.split(".")[0] == "soilbus"]
            yield from ((name, part) for name in names for part in name.split("."))


def faults(text: str) -> list[str]:
    """Imports that are private, or in capitals and not in their module's `__all__`."""
    found = []
    for module, name in imports(text):
        if name.startswith("_"):
            found.append(f"{module}.{name} is private")
        elif re.fullmatch(r"[A-Z][A-Z0-9_]+", name):
            offered = getattr(importlib.import_module(module), "__all__", ())
            found += [] if name in offered else [f"{module}.{name} is not in its __all__"]
    return found


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(TESTS)))
def test_no_tuning_value_and_no_private_name_is_imported(path: Path) -> None:
    assert faults(path.read_text(encoding="utf-8")) == []


@pytest.mark.parametrize(
    ("line", "fault"),
    [
        ("from soilbus.daemon.health import LONGEST_SOLVE, Health", "soilbus.daemon.health.LONGEST_SOLVE is not in"),
        ("from soilbus.daemon.service import _kind as kind", "soilbus.daemon.service._kind is private"),
        ("def late():\n    from soilbus.can.bus import LATE", "soilbus.can.bus.LATE is not in its"),
        ("import soilbus._hidden", "soilbus._hidden._hidden is private"),
    ],
)
def test_such_an_import_is_found(line: str, fault: str) -> None:
    (found,) = faults(line)
    assert found.startswith(fault)
