"""The comparison of outputs fails where it must and where it must only."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import pytest

from . import __main__ as command
from . import outputs
from .compare import EXACT, Kind, Move, Tolerances, moves, rounded, summary
from .outputs import Output, Source


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


def test_nothing_moved_is_nothing() -> None:
    assert moves("drive", OLD, copy.deepcopy(OLD), EXACT) == []
    assert summary([]) == "nothing moved"


@pytest.mark.parametrize(
    ("path", "value", "by"),
    [
        ("soil.n.value", 0.705, "+0.50 std"),
        ("soil.n.std", 0.012, "+20 %"),
        ("capability.over_slip.pull.1", 1470.0, "-0.50 std"),
        ("traversability.probability", 0.91, "+0.010"),
        ("chi2", 1.03, "+2 %"),
        ("samples", 399, "-1"),
    ],
)
def test_a_moved_value_is_told_in_its_own_unit(path: str, value: Any, by: str) -> None:
    (move,) = failures(changed(path, value))
    assert (move.output, move.part, move.path, move.kind, move.new, move.by) == (
        "drive", "1", path, Kind.MOVED, value, by,
    )  # fmt: skip
    assert move.size > 1.0


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("soil.n.value", 0.7001),
        ("soil.n.std", 0.01002),
        ("capability.over_slip.pull.1", 1500.9),
        ("traversability.probability", 0.902),
        ("chi2", 1.012),
    ],
)
def test_a_small_move_passes_unless_nothing_may_move(path: str, value: Any) -> None:
    assert failures(changed(path, value)) == []
    assert [move.path for move in failures(changed(path, value), EXACT)] == [path]


@pytest.mark.parametrize(
    ("path", "value", "kind"),
    [
        ("status", "degraded", Kind.CHANGED),
        ("reason", "new_soil", Kind.CHANGED),
        ("slip.FR", 0.0, Kind.CHANGED),
        ("slip.FL", None, Kind.CHANGED),
        ("chi2", ..., Kind.GONE),
        ("soil.n", ..., Kind.GONE),
        ("traversability", ..., Kind.GONE),
        ("capability.over_slip.pull.1", ..., Kind.GONE),
        ("rejected.stale", 3, Kind.CHANGED),
        ("slip.RL", 0.1, Kind.CHANGED),
    ],
)
def test_a_change_of_what_is_said_is_told_whatever_the_tolerance(path: str, value: Any, kind: Kind) -> None:
    (move,) = failures(changed(path, value), Tolerances(1e9, 1e9, 1e9, 1e9))
    assert (move.part, move.path, move.kind) == ("1", path, kind)


def test_a_window_more_or_less_is_told_once() -> None:
    (gone,) = failures(OLD[:2])
    assert (gone.part, gone.path, gone.kind) == ("2", "", Kind.GONE)
    (more,) = failures([*OLD, window(3)])
    assert (more.part, more.path, more.kind) == ("3", "", Kind.CHANGED)
    assert failures(OLD[1:])[0].part == "0"


def test_a_new_key_is_told_and_no_failure() -> None:
    found = moves("drive", OLD, changed("traversability.age", 0.3), EXACT)
    assert [(move.path, move.fails) for move in found] == [("traversability.age", False)]
    assert "allowed" in summary(found)
    assert "traversability.age" in summary(found)


def test_effects_and_places_are_known_by_name_not_by_position() -> None:
    def diagnosis(*effects: str) -> Output:
        return [{"verdict": "named", "effects": [{"name": name, "probability": 0.5} for name in effects]}]

    assert moves("case", diagnosis("lugs", "grade"), diagnosis("grade", "lugs"), EXACT) == []
    found = moves("case", diagnosis("lugs"), diagnosis("grade"), Tolerances())
    assert {(move.path, move.kind) for move in found} == {
        ("effects.lugs", Kind.GONE), ("effects.grade", Kind.CHANGED),
    }  # fmt: skip


def test_the_summary_has_the_gravest_first_and_counts_by_key() -> None:
    new = copy.deepcopy(OLD)
    for number, at in enumerate(new):
        at["soil"]["n"]["value"] += 0.001 * (number + 1)
    new[2]["status"] = "invalid"
    lines = summary(moves("drive", OLD, new, Tolerances()), first=2).splitlines()
    assert lines[0] == "4 values moved in 1 outputs:"
    assert lines[1] == "  drive window 2 status: valid -> invalid"
    assert lines[2] == "  drive window 2 soil.n.value: 0.7 -> 0.703  (+0.30 std)"
    assert lines[3] == "  and 2 more"
    assert "       3  soil.n.value  at most +0.30 std" in lines


def test_what_is_kept_is_rounded_and_the_same_bytes_each_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert rounded({"t": 1700000009.9952661, "x": [0.123456789, None, 3, "a", True]}) == {
        "t": 1700000009.995266, "x": [0.123457, None, 3, "a", True],
    }  # fmt: skip
    monkeypatch.setattr(outputs, "HERE", tmp_path)
    source = Source("made", lambda folder: copy.deepcopy(OLD))
    assert source.golden() == []
    source.keep(source.now(tmp_path))
    first = source.kept.read_bytes()
    assert source.golden() == OLD
    source.keep(source.now(tmp_path))
    assert source.kept.read_bytes() == first


def test_the_command_compares_renews_and_says_so_by_its_exit_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    said = {"windows": OLD}
    monkeypatch.setattr(outputs, "HERE", tmp_path)
    monkeypatch.setattr(command, "replays", lambda: [Source("made", lambda folder: said["windows"])])
    monkeypatch.setattr(command, "diagnoses", lambda: [Source("field", lambda folder: [], tmp_path / "absent.log")])
    assert command.main([]) == 1
    assert command.main(["--renew"]) == 0
    capsys.readouterr()
    assert command.main([]) == 0
    assert f"field: left out: no {tmp_path / 'absent.log'}" in capsys.readouterr().out
    said["windows"] = changed("soil.n.value", 0.8)
    rows = tmp_path / "rows.jsonl"
    assert command.main(["--json", str(rows)]) == 1
    assert "made window 1 soil.n.value: 0.7 -> 0.8  (+10.00 std)" in capsys.readouterr().out
    assert [json.loads(line)["path"] for line in rows.read_text().splitlines()] == ["soil.n.value"]
    assert command.main(["--renew"]) == 0
    assert command.main([]) == 0
