"""Two JSON outputs of soilbus, value by value: what moved, and by how much."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
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


Path = tuple[str, ...]
_Seen = tuple[Kind, Any, Any, float, str]


def moves(output: str, old: Sequence[Any], new: Sequence[Any], tolerances: Tolerances) -> list[Move]:
    """All differences of two outputs, each a list of objects; windows are known by their number."""
    before, after = _flat(list(old)), _flat(list(new))
    windows = {path for found in (before, after) for path in found if path[1:] == ("window",)}
    found = []
    for path in (*before, *(path for path in after if path not in before)):
        difference = _difference(path, before, after, tolerances)
        if difference is not None:
            part = path[0] if (*path[:1], "window") in windows else ""
            found.append(Move(output, part, ".".join(path[1:]), *difference))
    return found


def _flat(value: Any, path: Path = ()) -> dict[Path, Any]:
    """The values by the way to them; of objects and lists the type, and all that is in them."""
    if not isinstance(value, dict | list):
        return {path: value}
    inner = _by_identity(value) if isinstance(value, list) else value
    return {path: type(value)} | {
        place: v for key, one in inner.items() for place, v in _flat(one, (*path, key)).items()
    }


def _difference(path: Path, before: dict[Path, Any], after: dict[Path, Any], limits: Tolerances) -> _Seen | None:
    """Kind, old and new value, size and what a reader sees of it; None for what a parent says or no move at all."""
    here, inf = path[:-1], float("inf")
    old: Any = before.get(path)
    new: Any = after.get(path)
    if path and before.get(here) is not after.get(here):
        return None
    if path not in after:
        return Kind.GONE, _short(old), None, inf, ""
    if path not in before:
        if before[here] is list or here[-1] in BY_DATA:
            return Kind.CHANGED, None, _short(new), inf, "more than before"
        return Kind.ADDED, None, _short(new), 0.0, ""
    if _is_number(old) and _is_number(new):
        return _moved(path, old, new, before.get(_beside(path)), limits)
    return None if old == new and type(old) is type(new) else (Kind.CHANGED, _short(old), _short(new), inf, "")


def _beside(path: Path) -> Path:
    """Where the std of a value stands."""
    *there, key = path
    if key == "value":
        return (*there, "std")
    return (*there[:-1], f"{there[-1]}_std", key) if key.isdigit() else (*there, f"{key}_std")


def _moved(path: Path, old: float, new: float, std: Any, limits: Tolerances) -> _Seen | None:
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
    if abs(new - old) <= max(limit, last_digit):
        return None
    return Kind.MOVED, old, new, abs(new - old) / limit if limit > 0.0 else float("inf"), by


def _share(old: float, new: float) -> str:
    return f"{100.0 * (new - old) / abs(old):+.2g} %" if old else "from zero"


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


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
