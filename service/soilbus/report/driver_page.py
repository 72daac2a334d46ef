"""The driver's page: state over a third of it, what to do, slip beside the best slip, draft beside the possible draft.

It fills a terminal of any size; where there is too little room for charts the page is a few lines of text.
"""

from __future__ import annotations

import textwrap

from rich.text import Text

from soilbus.report.dashboard import Dashboard, Verdict, force, percent
from soilbus.report.text_charts import area, bar, place

LEAST_WIDTH, LEAST_HEIGHT = 72, 20
"""Columns and rows below which the page is text."""
KEYS = "d driver  e engineer  q quit"
AXIS = 11
"""Columns beside the chart of the draft for its scale."""


def driver_page(dashboard: Dashboard, width: int, height: int) -> list[Text]:
    """Return the driver's page: at most `height` lines of at most `width` columns."""
    if width < LEAST_WIDTH or height < LEAST_HEIGHT:
        return small_page(dashboard, width, height)
    verdict = dashboard.verdict()
    lines = band(verdict, width, height // 3)
    lines.append(Text(verdict.todo.center(width).rstrip(), style="bold"))
    space = [Text()] * (height > LEAST_HEIGHT + 4)
    lines += [*space, *_slip(dashboard, width, max(height // 16, 1)), *space]
    return [*lines, *_draft(dashboard, width, height - len(lines) - 1), footer(dashboard, width)]


def small_page(dashboard: Dashboard, width: int, height: int) -> list[Text]:
    """Return verdict, what to do and figures as wrapped text of at most `height` lines."""
    verdict = dashboard.verdict()
    first, todo, *more = dashboard.sentences()
    lines = [Text(line.center(width), style=verdict.style) for line in textwrap.wrap(first, width)]
    lines += [Text(line, style="bold") for line in textwrap.wrap(todo, width)]
    lines += [Text(line) for said in more for line in textwrap.wrap(said, width)]
    return lines[:height]


def band(verdict: Verdict, width: int, height: int) -> list[Text]:
    """Return the verdict over the whole width: its word in the middle, and in the last line the sentence."""
    rows = [""] * height
    rows[height // 2 - 1] = " ".join(verdict.word)
    rows[-1] = textwrap.shorten(verdict.said, width, placeholder="…")
    return [Text(row.center(width), style=verdict.style) for row in rows]


def footer(dashboard: Dashboard, width: int) -> Text:
    """Return the age of the data, or why there are none, and the keys."""
    said = f"bus away: {dashboard.fault}" if dashboard.fault else dashboard.freshness()
    said = textwrap.shorten(said, width - len(KEYS) - 2, placeholder="…")
    return Text(f"{said:<{width - len(KEYS)}}{KEYS}")


def _slip(dashboard: Dashboard, width: int, height: int) -> list[Text]:
    """Title, bar of `height` rows and marks of the set-points."""
    slip, top = dashboard.slip(), dashboard.vehicle.max_slip
    value = "-" if slip.value is None else f"{percent(slip.value)} at wheel {slip.wheel}"
    value += "" if slip.best is not None else "  best -"
    scale = f"bar to {percent(top)}"
    title = Text(f"{f'SLIP  {value}':<{width - len(scale)}}{scale}", style="bold")
    filled = bar(slip.value, top, width).rstrip().ljust(width, "·")
    marks = [" "] * width
    for share, what in ((slip.best, "best"), (slip.most_pull, "most pull")):
        if share is not None:  # an arrow with its label to the right, or to the left where there is more room
            at, label = place(share, top, width), f"{what} {percent(share)}"
            said = f"▲ {label}" if at + len(label) + 2 <= width else f"{label} ▲"
            first = at if said.startswith("▲") else at - len(said) + 1
            if first >= 0 and not "".join(marks[max(first - 1, 0) : first + len(said) + 1]).strip():
                marks[first : first + len(said)] = said
    return [title, *(Text(filled) for _ in range(height)), Text("".join(marks).rstrip())]


def _draft(dashboard: Dashboard, width: int, height: int) -> list[Text]:
    """Title, chart of the last minute and axis, in `height` rows."""
    columns, rows = width - AXIS, height - 2
    draft, limit = (dashboard.history(name, columns) for name in ("draft", "max_draft"))
    top = 1.05 * max([abs(value) for value in (*draft, *limit) if value is not None], default=0.0)
    chart = area(draft, rows, top or 1.0, limit)
    scale = [f"{force(top, top) if top else '':>{AXIS - 2}} ┤", *[f"{'│':>{AXIS}}"] * (rows - 2), f"{'0 ┤':>{AXIS}}"]
    axis = f"{'':{AXIS}}{f'{dashboard.span:.0f} s ago':<{columns - 3}}now"
    legend = "█ draft  ─ possible"
    title = f"{'DRAFT  ' + '  of possible '.join(dashboard.drafts()):<{width - len(legend)}}{legend}"
    body = [Text(left + right) for left, right in zip(scale, chart, strict=True)]
    return [Text(title, style="bold"), *body, Text(axis)]
