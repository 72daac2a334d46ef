"""Plain text tables."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from soilbus.words import LONGEST_NAME, shown

AT_EDGE = "at the edge of its range"
"""Why an effect's parameter that was found has no standard deviation."""


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return the left-aligned columns under a ruled head, one line a row."""
    lines = [tuple(shown(cell, LONGEST_NAME) for cell in line) for line in (head, *rows)]
    widths = [max(len(line[i]) for line in lines) for i in range(len(head))]
    text = ["  ".join(cell.ljust(w) for cell, w in zip(line, widths, strict=True)).rstrip() for line in lines]
    text.insert(1, "  ".join("-" * w for w in widths))
    return "\n".join(text) + "\n"


def value_text(value: float, std: float, held: str = "held", sign: str = "+-") -> str:
    """Return a value with its standard deviation, or why it has none."""
    return f"{value:.4g} {sign} {std:.2g}" if std > 0.0 else f"{value:.4g} ({held})"
