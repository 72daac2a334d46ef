"""The engineer's page: every value of our frames, with history, chi-square of each channel and refused inputs.

Grey figures have a Status other than valid: guesses that must not be acted on; "-" is not available or too old.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from rich.text import Text

from soilbus.pipeline.outputs import PARAMETER_FRAMES
from soilbus.report.dashboard import Dashboard, percent
from soilbus.report.driver_page import LEAST_HEIGHT, LEAST_WIDTH, footer, small_page
from soilbus.report.received_frames import BUS_COUNTS, ReceivedFrames
from soilbus.report.text_charts import sparkline

COLUMN = 38
"""Columns that a block needs at least."""
GAP = 2
"""Columns between two blocks."""
LIMITS = {"on the level": ("DraftCapability", "GradeCapability"), "here": ("TractionLimits", "TractionLimits")}
"""Messages of draft and of slope, by what they hold for."""
CHARTS = {
    "slip": "slip, %",
    "draft": "draft, kN",
    "max_draft": "possible, kN",
    "bearing": "bearing, kPa",
    "chi2": "chi-square",
    "rejected": "refused",
}
"""Histories, the most useful first."""
IN_UNITS = {"slip": 100.0, "draft": 1e-3, "max_draft": 1e-3}
LABEL = 22
"""Columns for the name and the present value beside a chart."""
LEAST_CHARTS = 4
"""Rows for all charts, as sparklines."""

Row = tuple[Text | str, ...]


def engineer_page(dashboard: Dashboard, width: int, height: int) -> list[Text]:
    """Return the engineer's page: at most `height` lines of at most `width` columns."""
    if width < LEAST_WIDTH or height < LEAST_HEIGHT:
        return small_page(dashboard, width, height)
    verdict, known = dashboard.verdict(), dashboard.known
    soil = _said(known, "SoilClass", "Kind", "soil: {}") + _said(known, "SoilClass", "Probability", "  ({:.2f})")
    state = f" {verdict.said}"
    state = f"{state:<{max(width - len(soil) - 1, len(state) + 2)}}{soil} "[:width].ljust(width)
    head = [Text(state, style=verdict.style), fitted(Text(_forecast(known)), width)]
    blocks, columns = [block(dashboard) for block in BLOCKS], max(width // (COLUMN + GAP), 1)
    body = [Text(), *packed(blocks, columns, width, 1), Text()]
    if len(body) + LEAST_CHARTS > height - len(head) - 1:
        body = packed(blocks, columns, width, 0)
    lines = [*head, *body][: height - 1]
    each = (width - GAP) // 2
    charts = [_chart(dashboard, name, each) for name in CHARTS]
    pairs = [Text(f"{left:<{each + GAP}}{right}") for left, right in zip(charts[::2], charts[1::2], strict=True)]
    lines += [Text(f"last {dashboard.span:.0f} s", style="bold"), *pairs][: max(height - len(lines) - 1, 0)]
    lines += [Text()] * (height - 1 - len(lines))
    return [*lines, footer(dashboard, width)]


def fitted(text: Text, width: int) -> Text:
    """Return the text, with an ellipsis for what is beyond `width` columns."""
    text.truncate(width, overflow="ellipsis")
    return text


def packed(blocks: list[list[Text]], columns: int, width: int, space: int) -> list[Text]:
    """Return blocks packed into `columns` of equal width, each put into the shortest column so far."""
    each = (width - GAP * (columns - 1)) // columns
    stacks: list[list[Text]] = [[] for _ in range(columns)]
    for block in blocks:
        stack = min(stacks, key=len)
        stack += [Text()] * (space if stack else 0) + [fitted(line, each) for line in block]
    lines = []
    for i in range(max(map(len, stacks))):
        line = Text()
        for column, stack in enumerate(stacks):
            line.pad_right(column * (each + GAP) - line.cell_len)
            line.append_text(stack[i] if i < len(stack) else Text())
        lines.append(line)
    return lines


def grid(*rows: Row) -> list[Text]:
    """Return the rows in columns as wide as their widest cell; the first, of texts, is a bold title."""
    title, *others = rows
    cells = [[Text(str(cell), style="bold") for cell in title]]
    cells += [[Text(cell) if isinstance(cell, str) else cell for cell in row] for row in others]
    widths = [max(cell.cell_len for cell in column) for column in zip(*cells, strict=True)]
    lines = []
    for row in cells:
        line = Text()
        for cell, wide in zip(row, widths, strict=True):
            line.append_text(cell)
            line.pad_right(wide - cell.cell_len + GAP)
        line.rstrip()
        lines.append(line)
    return lines


def _forecast(known: ReceivedFrames) -> str:
    """Torque that the present demand needs, and the slip and sinkage predicted for it."""
    needed, there = (known.number("TorqueDemand", f"Torque{what}") for what in ("Required", "Available"))
    slip = known.number("DemandForecast", "Slip")
    said = []
    if needed is not None or there is not None:
        said.append("torque {} of {} N m".format(*("-" if x is None else f"{x:.0f}" for x in (needed, there))))
    if slip is not None:
        said.append(f"slip to come {percent(slip)}")
    said.append(_said(known, "DemandForecast", "Sinkage", "sinkage to come {:.0f} mm"))
    return "  ".join(said)


def _soil(dashboard: Dashboard) -> list[Text]:
    known = dashboard.known
    rows: list[Row] = [("bearing", _pair(known, "SoilStrength", "BearingPressure"), "kPa")]
    for name, (message, unit, _) in PARAMETER_FRAMES.items():
        rows.append((name.replace("phi", "φ"), _pair(known, message, "Value", "Std"), unit.replace("deg", "°")))
    return grid(("soil", "value ± std", "unit"), *rows)


def _wheels(dashboard: Dashboard) -> list[Text]:
    rows: list[Row] = []
    for i in dashboard.wheels():
        slip, depth = dashboard.wheel_slip(i), dashboard.wheel_sinkage(i)
        shown = _cell(dashboard.known, "WheelSinkage" if i < 4 else "WheelSinkage2", depth, "{:.0f}")
        rows.append((dashboard.vehicle.name(i), "-" if slip is None else f"{100.0 * slip:+.1f}", shown))
    return grid(("wheel", "slip, %", "sinkage, mm"), *rows)


def _limits(dashboard: Dashboard) -> list[Text]:
    """Largest draft and slope beside the present ones; a slope in per cent is 100 times its tangent."""
    known = dashboard.known

    def slope_of(message: str) -> Text:
        angle, spread = known.number(message, "MaxGrade"), known.number(message, "MaxGradeStd")
        if angle is None or spread is None or abs(angle) >= math.pi / 2.0:
            return _cell(known, message, None)
        slope = math.tan(angle)
        return _cell(known, message, _figures(100.0 * slope, 100.0 * spread * (1.0 + slope**2)))

    rows: list[Row] = [(name, _pair(known, of, "MaxDraft"), slope_of(grade)) for name, (of, grade) in LIMITS.items()]
    draft, pitch = (known.number("PresentDemand", name) for name in ("Draft", "Slope"))
    now = ("now", "-" if draft is None else f"{draft:.0f}", "-" if pitch is None else f"{100.0 * math.tan(pitch):.1f}")
    return grid(("largest", "draft, N", "slope, %"), *rows, now)


def _advice(dashboard: Dashboard) -> list[Text]:
    def cell(signal: str) -> Text:
        share = dashboard.known.number("TractionAdvice", signal)
        return _cell(dashboard.known, "TractionAdvice", None if share is None else 100.0 * share, "{:.0f}")

    kinds = {"efficiency": "Efficiency", "most pull": "Pull"}
    rows = ((name, cell(f"SlipFor{kind}Front"), cell(f"SlipFor{kind}Rear")) for name, kind in kinds.items())
    return grid(("best slip, %, for", "front", "rear"), *rows)


def _gap(dashboard: Dashboard) -> list[Text]:
    known = dashboard.known
    rows: list[Row] = [("window", _cell(known, "SoilStrength", known.number("SoilStrength", "Chi2"), "{:.1f}"))]
    for channel in ("Torque", "Draft", "Sinkage"):
        chi2 = known.number("WindowQuality", f"Chi2{channel}")
        rows.append((channel.lower(), _cell(known, "WindowQuality", chi2, "{:.2f}")))
    return grid(("gap (chi-square)", "1 is noise"), *rows)


def _refused(dashboard: Dashboard) -> list[Text]:
    """Samples refused by the service, and frames of ours that we refused ourselves."""
    known = dashboard.known
    count = known.number("WindowQuality", "Rejected")
    most = _said(known, "WindowQuality", "RejectedReason", ", most {}") if count else ""
    return grid(
        ("refused", ""),
        ("inputs", _said(known, "SoilbusStatus", "RejectedShare", "{:.1f} % of samples") or "-"),
        ("in window", "-" if count is None else f"{count:.0f}{most}"),
        ("late windows", _said(known, "SoilbusStatus", "DeadlineMisses", "{:.0f}") or "-"),
        ("bad frames", str(known.bad_frames)),
    )


def _service(dashboard: Dashboard) -> list[Text]:
    """The service and its bus, by what the service says."""
    known = dashboard.known
    state = _said(known, "SoilbusStatus", "State", "{}") + _said(known, "SoilbusStatus", "Reason", "  ({})")
    version = [known.number("SoilbusIdentity", f"Version{part}") for part in ("Major", "Minor", "Patch")]
    shown = "-" if None in version else ".".join(f"{part:.0f}" for part in version)
    shown += _said(known, "SoilbusIdentity", "Uptime", ", up {:.0f} s")
    counts = ((key.partition("_")[0], known.number("BusHealth", signal)) for signal, key in BUS_COUNTS.items())
    faults = [f"{what} {count:.0f}" for what, count in counts if count]
    pairs = [("", " ".join(faults[i : i + 2])) for i in range(0, len(faults), 2)]
    bus = _said(known, "BusHealth", "BusState", "{}") or "-"
    return grid(("service", ""), ("state", state or "-"), ("version", shown), ("bus", bus), *pairs)


BLOCKS: tuple[Callable[[Dashboard], list[Text]], ...] = (_soil, _wheels, _limits, _gap, _advice, _refused, _service)


def _chart(dashboard: Dashboard, name: str, width: int) -> str:
    """Name and present value beside a sparkline."""
    values = dashboard.history(name, width - LABEL)
    now = next((value for value in reversed(values) if value is not None), None)
    said = "-" if now is None else f"{now * IN_UNITS.get(name, 1.0):.3g}"
    return f"{CHARTS[name]:<12}{said:>8}  "[:LABEL] + sparkline(values)


def _said(known: ReceivedFrames, message: str, signal: str, form: str) -> str:
    """A value in words, nothing where it is not known."""
    value = known.value(message, signal)
    return "" if value is None or value == "none" else form.format(value)


def _cell(known: ReceivedFrames, message: str, value: object, form: str = "{}") -> Text:
    """Grey where the message must not be acted on; None: not known."""
    return Text("-" if value is None else form.format(value), style="" if known.is_valid(message) else "dim")


def _pair(known: ReceivedFrames, message: str, signal: str, std: str | None = None) -> Text:
    value, spread = known.number(message, signal), known.number(message, std or f"{signal}Std")
    return _cell(known, message, None if value is None or spread is None else _figures(value, spread))


def _figures(value: float, spread: float) -> str:
    """Value and std, without powers of ten."""
    large = max(abs(value), spread) >= 100.0
    return f"{value:.0f} ± {spread:.0f}" if large and spread >= 1.0 else f"{value:.3g} ± {spread:.2g}"
