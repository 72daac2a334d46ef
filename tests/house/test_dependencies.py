"""What soilbus depends on, within which bounds."""

import ast
import sys
import tomllib
from importlib.metadata import PackageNotFoundError, version
from itertools import chain
from pathlib import Path

import pytest
from packaging.requirements import Requirement

REPO = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((REPO / "pyproject.toml").read_text())
EXTRAS = PROJECT["project"]["optional-dependencies"]
ALL = sorted(
    {*PROJECT["build-system"]["requires"], *PROJECT["project"]["dependencies"], *chain.from_iterable(EXTRAS.values())}
)
LOADED_BY_THE_WORKER = ("soilbus.pipeline.estimator", "soilbus.daemon.state_persistence", "soilbus.daemon.warm_up")
OF_THE_DAEMON = {"numpy", "cantools", "can", "crccheck", "pydantic"}


@pytest.mark.parametrize("text", ALL)
def test_each_has_a_lower_and_an_upper_bound_and_what_is_here_is_within(text: str) -> None:
    requirement = Requirement(text)
    assert {">=", "<"} <= {bound.operator for bound in requirement.specifier}
    try:
        assert requirement.specifier.contains(version(requirement.name))
    except PackageNotFoundError:
        return  # an extra that is not installed here


def test_one_package_has_the_same_bounds_wherever_it_is_named() -> None:
    names = [Requirement(text).name for text in ALL]
    assert len(names) == len(set(names))


def imported(module: str, seen: set[str], everywhere: bool = False) -> set[str]:
    """Top-level packages, ours aside, that a module of ours and what it imports at its head import.

    `everywhere`: also what they import inside functions and for type checking alone.
    """
    path = REPO / "service" / Path(*module.split("."))
    path = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    if module in seen or not path.is_file():
        return set()
    seen.add(module)
    found: set[str] = set()
    tree = ast.parse(path.read_text())
    for node in ast.walk(tree) if everywhere else tree.body:
        names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
        if isinstance(node, ast.ImportFrom):
            names = [node.module or "", *(f"{node.module}.{a.name}" for a in node.names)]
        for name in names:
            found |= imported(name, seen, everywhere) if name.startswith("soilbus") else {name.partition(".")[0]}
    return found


def test_the_daemon_imports_no_more_than_it_may() -> None:
    modules = ("soilbus.daemon.start", *LOADED_BY_THE_WORKER)
    foreign = set().union(*(imported(module, set()) for module in modules)) - sys.stdlib_module_names
    assert foreign <= OF_THE_DAEMON


def test_no_module_of_the_wheel_needs_an_extra_to_be_imported() -> None:
    package = REPO / "service" / "soilbus"
    modules = {".".join(path.relative_to(package.parent).with_suffix("").parts) for path in package.rglob("*.py")}
    needed = {Requirement(text).name for text in PROJECT["project"]["dependencies"]}
    allowed = sys.stdlib_module_names | needed - {"python-can"} | {"can"}
    foreign = {module: imported(module, modules - {module}) - allowed for module in sorted(modules)}
    assert {module: found for module, found in foreign.items() if found} == {}


def test_no_module_that_the_daemon_can_load_imports_scipy_even_inside_a_function() -> None:
    seen: set[str] = set()
    foreign = set().union(*(imported(module, seen, True) for module in ("soilbus.daemon.start", *LOADED_BY_THE_WORKER)))
    assert {"soilbus.estimation.tracker", "soilbus.decision.capability", "soilbus.can.bus"} <= seen
    assert "numpy" in foreign
    assert "scipy" not in foreign


def test_what_only_the_worker_needs_is_in_nobody_elses_way() -> None:
    seen: set[str] = set()
    imported("soilbus.daemon.start", seen)
    assert seen.isdisjoint(LOADED_BY_THE_WORKER)
    assert "soilbus.estimation.tracker" not in seen
    assert (
        imported("soilbus.cli.main", set()) <= sys.stdlib_module_names
    )  # the rest comes without a collector in the way
