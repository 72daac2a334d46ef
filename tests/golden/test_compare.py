"""The comparison of outputs fails where it must and where it must only."""

from __future__ import annotations

import copy
from typing import Any

import pytest

from .compare import EXACT, Kind, Move, Tolerances, moves
from .outputs import Output


def window(number: int) -> dict[str, Any]:
    return {
        "t": 10.0 + number,
        "window": number,
        "status": "valid",
        "reason": None,
        "soil": {"n": {"value": 0.7, "std": 0.01}},
        "slip": {"FL": 0.2, "FR": None},
        "traversability": {"probability": 0.9, "limit": "slip"},
        "capability": {"over_slip": {"slip": [0.1, 0.2], "pull": [900.0, 1500.0], "pull_std": [50.0, 60.0]}},
        "chi2": 1.01,
        "samples": 400,
        "rejected": {},
    }


OLD = [window(i) for i in range(3)]


def changed(path: str, value: Any, number: int = 1) -> Output:
    """The windows with one value changed, or taken away where it is ...; lists by position."""
    new = copy.deepcopy(OLD)
    here: Any = new[number]
    *way, last = [int(key) if key.isdigit() else key for key in path.split(".")]
    for key in way:
        here = here[key]
    if value is ...:
        del here[last]
    else:
        here[last] = value
    return new


def failures(new: Output, limits: Tolerances | None = None) -> list[Move]:
    return [move for move in moves("drive", OLD, new, limits or Tolerances()) if move.fails]


@pytest.mark.parametrize(
    ("path", "value", "by"),
    [
        ("soil.n.value", 0.705, "+0.50 std"), ("soil.n.std", 0.012, "+20 %"),
        ("capability.over_slip.pull.1", 1470.0, "-0.50 std"), ("traversability.probability", 0.91, "+0.010"),
        ("chi2", 1.03, "+2 %"), ("samples", 399, "-1"),
    ],
)  # fmt: skip
def test_a_moved_value_is_told_in_its_own_unit(path: str, value: Any, by: str) -> None:
    (move,) = failures(changed(path, value))
    assert (move.output, move.part, move.path, move.kind, move.new, move.by) == (
        "drive", "1", path, Kind.MOVED, value, by,
    )  # fmt: skip
    assert move.size > 1.0


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("soil.n.value", 0.7001), ("soil.n.std", 0.01002), ("capability.over_slip.pull.1", 1500.9),
        ("traversability.probability", 0.902), ("chi2", 1.012),
    ],
)  # fmt: skip
def test_a_small_move_passes_unless_nothing_may_move(path: str, value: Any) -> None:
    assert failures(changed(path, value)) == []
    assert [move.path for move in failures(changed(path, value), EXACT)] == [path]


@pytest.mark.parametrize(
    ("path", "value", "kind"),
    [
        ("status", "degraded", Kind.CHANGED), ("reason", "new_soil", Kind.CHANGED), ("slip.FR", 0.0, Kind.CHANGED),
        ("slip.FL", None, Kind.CHANGED), ("rejected.stale", 3, Kind.CHANGED), ("slip.RL", 0.1, Kind.CHANGED),
        ("chi2", ..., Kind.GONE), ("soil.n", ..., Kind.GONE), ("traversability", ..., Kind.GONE),
        ("capability.over_slip.pull.1", ..., Kind.GONE),
    ],
)  # fmt: skip
def test_a_change_of_what_is_said_is_told_whatever_the_tolerance(path: str, value: Any, kind: Kind) -> None:
    (move,) = failures(changed(path, value), Tolerances(1e9, 1e9, 1e9, 1e9))
    assert (move.part, move.path, move.kind) == ("1", path, kind)


def test_a_window_more_or_less_is_told_once() -> None:
    (gone,) = failures(OLD[:2])
    assert (gone.part, gone.path, gone.kind) == ("2", "", Kind.GONE)
    (more,) = failures([*OLD, window(3)])
    assert (more.part, more.path, more.kind) == ("3", "", Kind.CHANGED)
    assert failures(OLD[1:])[0].part == "0"


def test_effects_and_places_are_known_by_name_not_by_position() -> None:
    def diagnosis(*effects: str) -> Output:
        return [{"verdict": "named", "effects": [{"name": name, "probability": 0.5} for name in effects]}]

    assert moves("case", diagnosis("lugs", "grade"), diagnosis("grade", "lugs"), EXACT) == []
    found = moves("case", diagnosis("lugs"), diagnosis("grade"), Tolerances())
    assert {(move.path, move.kind) for move in found} == {
        ("effects.lugs", Kind.GONE), ("effects.grade", Kind.CHANGED),
    }  # fmt: skip
