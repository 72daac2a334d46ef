"""Two JSON outputs of soilbus, value by value: what moved, and by how much."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, NamedTuple

DIGITS = 6
"""Significant digits that are kept of a number."""
BY_DATA = {"rejected", "gaps", "soil_class", "parameters", "model", "terms", "evidence", "tells", "slip", "sinkage"}
"""Objects whose keys are data (reasons, soils, effects, wheels): one more is a change of what is said."""
CHANCES = {"probability", "significance", "soil_class"}
IDENTITIES = (("name",), ("channel", "wheel", "region"), ("channel", "wheel"), ("log",))
"""Keys by which the objects of a list are known, whatever their order."""


@dataclass(frozen=True)
class Tolerances:
    """How far a number may move unnoticed.

    of_std: a value that has a std beside it, in units of that std.  relative: any other number and a std itself,
    as a share.  chance: a probability, absolutely.  recording: what describes a recording, as a share.
    """

    of_std: float = 0.02
    relative: float = 0.005
    chance: float = 0.005
    recording: float = 1e-4


EXACT = Tolerances(0.0, 0.0, 0.0, 0.0)
"""Nothing moves but what is beyond DIGITS."""


class Kind(StrEnum):
    """What happened to a value."""

    GONE = "gone"
    CHANGED = "changed"
    MOVED = "moved"
    ADDED = "added"


class Move(NamedTuple):
    """One difference.

    output: of which recording; part: the window, "" for a diagnosis; path: keys, joined by dots; size: how far the
    value moved over what it may (inf where it is no number); by: the same for a reader.
    """

    output: str
    part: str
    path: str
    kind: Kind
    old: Any
    new: Any
    size: float
    by: str

    @property
    def fails(self) -> bool:
        """Whether this is more than a key that older readers do not know."""
        return self.kind is not Kind.ADDED


def rounded(value: Any) -> Any:
    """The same with floats to DIGITS significant digits; times `t` to microseconds."""
    if isinstance(value, dict):
        return {key: round(v, 6) if key == "t" and isinstance(v, float) else rounded(v) for key, v in value.items()}
    if isinstance(value, list):
        return [rounded(v) for v in value]
    return float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value


def moves(output: str, old: Sequence[Any], new: Sequence[Any], tolerances: Tolerances) -> list[Move]:
    """All differences of two outputs, each a list of objects; windows are known by their number."""
    before, after = _by_identity(old), _by_identity(new)
    found: list[Move] = []
    for part in _union(before, after):
        place: tuple[str, str] = (output, part if "window" in (before.get(part) or after[part]) else "")
        if part not in after:
            found.append(Move(*place, "", Kind.GONE, _short(before[part]), None, float("inf"), ""))
        elif part not in before:
            found.append(Move(*place, "", Kind.CHANGED, None, _short(after[part]), float("inf"), "more than before"))
        else:
            found += (
                Move(place[0], place[1], *rest) for rest in _walk(before[part], after[part], (), None, tolerances)
            )
    return found


_Rest = tuple[str, Kind, Any, Any, float, str]


def _walk(old: Any, new: Any, path: tuple[str, ...], std: Any, limits: Tolerances) -> Iterator[_Rest]:
    """Differences of two values; std: what stands beside the old one as its standard deviation, None for nothing."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in _union(old, new):
            yield from _child(old, new, key, path, limits)
    elif isinstance(old, list) and isinstance(new, list):
        before, after = _by_identity(old), _by_identity(new)
        for key in _union(before, after):
            beside = std[int(key)] if isinstance(std, list) and key.isdigit() and int(key) < len(std) else None
            yield from _item(before, after, key, path, beside, limits)
    elif _is_number(old) and _is_number(new):
        yield from _number(old, new, path, std, limits)
    elif old != new or type(old) is not type(new):
        yield ".".join(path), Kind.CHANGED, _short(old), _short(new), float("inf"), ""


def _child(old: dict[str, Any], new: dict[str, Any], key: str, path: tuple[str, ...], limits: Tolerances) -> Any:
    if key not in old and not BY_DATA & {*path[-1:]}:
        yield ".".join((*path, key)), Kind.ADDED, None, _short(new[key]), 0.0, ""
        return
    beside = old.get("std") if key == "value" else old.get(f"{key}_std")
    yield from _item(old, new, key, path, beside, limits)


def _item(
    old: dict[str, Any], new: dict[str, Any], key: str, path: tuple[str, ...], std: Any, limits: Tolerances
) -> Iterator[_Rest]:
    here = (*path, key)
    if key not in new:
        yield ".".join(here), Kind.GONE, _short(old[key]), None, float("inf"), ""
    elif key not in old:
        yield ".".join(here), Kind.CHANGED, None, _short(new[key]), float("inf"), "more than before"
    else:
        yield from _walk(old[key], new[key], here, std, limits)


def _number(old: float, new: float, path: tuple[str, ...], std: Any, limits: Tolerances) -> Iterator[_Rest]:
    apart = abs(new - old)
    if isinstance(old, int) and isinstance(new, int):
        limit, by = 0.0, f"{new - old:+d}"
    elif "recording" in path:
        limit, by = limits.recording * abs(old), _share(old, new)
    elif CHANCES & set(path):
        limit, by = limits.chance, f"{new - old:+.3f}"
    elif _is_number(std) and std > 0.0:
        limit, by = limits.of_std * std, f"{(new - old) / std:+.2f} std"
    else:
        limit, by = limits.relative * abs(old), _share(old, new)
    last_digit = 10.0 ** (1 - DIGITS) * max(abs(old), abs(new)) if limit > 0.0 else 0.0
    if apart > max(limit, last_digit):
        size = apart / limit if limit > 0.0 else float("inf")
        yield ".".join(path), Kind.MOVED, old, new, size, by


def _share(old: float, new: float) -> str:
    return f"{100.0 * (new - old) / abs(old):+.2g} %" if old else "from zero"


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _union(old: dict[str, Any], new: dict[str, Any]) -> list[str]:
    return [*old, *(key for key in new if key not in old)]


def _by_identity(items: Sequence[Any]) -> dict[str, Any]:
    """The items by window, name or place, else by position."""
    if items and all(isinstance(item, dict) for item in items):
        for keys in (("window",), *IDENTITIES):
            if all(key in item for key in keys for item in items):
                found = {" ".join(str(item[key]) for key in keys if item[key] is not None): item for item in items}
                if len(found) == len(items):
                    return found
    return {str(i): item for i, item in enumerate(items)}


def _short(value: Any) -> Any:
    text = str(value)
    return value if len(text) <= 60 else text[:57] + "..."


def summary(found: Sequence[Move], first: int = 30) -> str:
    """The failures, what is not a number first, then the largest, and their count by key; then the additions by key."""
    failed = sorted((move for move in found if move.fails), key=lambda move: -move.size)
    added = Counter(_key(move) for move in found if not move.fails)
    lines = []
    if failed:
        lines.append(f"{len(failed)} values moved in {len({move.output for move in failed})} outputs:")
        lines += [f"  {_line(move)}" for move in failed[:first]]
        if len(failed) > first:
            lines.append(f"  and {len(failed) - first} more")
        lines.append("by key:")
        for key, number in Counter(map(_key, failed)).most_common():
            largest = next(move for move in failed if _key(move) == key)
            lines.append(f"  {number:6}  {key}  at most {largest.by or f'{largest.old} -> {largest.new}'}")
    if added:
        lines.append("keys that are new, which is allowed:")
        lines += [f"  {number:6}  {key}" for key, number in added.most_common()]
    return "\n".join(lines or ["nothing moved"])


def _line(move: Move) -> str:
    window = f" window {move.part}" if move.part else ""
    old, new = ("nothing" if value is None else value for value in (move.old, move.new))
    return f"{move.output}{window} {move.path or '(all of it)'}: {old} -> {new}" + (f"  ({move.by})" if move.by else "")


def _key(move: Move) -> str:
    return re.sub(r"(?<=\.)\d+(?=\.|$)", "*", move.path) or "(all of it)"
