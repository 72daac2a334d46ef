"""Pictures of a replay: the decision as a ribbon over time, curves of soil and draft, a map of the route.

Recordings follow one another on the time axis, each with its own clock.  No line goes across two recordings, and none
across windows without an estimate of the soil.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from datetime import UTC, datetime
from functools import partial
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np

from soilbus.arrays import Array
from soilbus.can.admission import LONGEST_GAP
from soilbus.config.model import Config
from soilbus.decision.traversability import State, Status
from soilbus.estimation.posterior import Estimate
from soilbus.pipeline.result import WindowResult, is_date
from soilbus.report.page import Picture, picture
from soilbus.report.windows import of_use
from soilbus.terra.earth import offset

SPACE_BETWEEN = 0.03
"""Space between two recordings in a picture, as a share of the time of all."""
TICKS = 5
"""Ticks of a time axis: as many clock times as fit side by side."""
FEW_WINDOWS = 200
"""Windows up to which each has its dot on a curve."""
BAND_SD = 2.0
"""Standard deviations of the band around a curve, each way."""


class Look(NamedTuple):
    """Name, colour, hatch and marker of a state, which differ in grey, too."""

    name: str
    colour: str
    hatch: str
    marker: str


STATES = {
    State.GO: Look("GO", "#2e9f6b", "", "o"),
    State.CAUTION: Look("CAUTION", "#f2b632", "///", "^"),
    State.NO_GO: Look("NO-GO", "#cf3f2e", "xxx", "X"),
    State.UNKNOWN: Look("unknown", "#c9c9c9", "...", "s"),
}
STATUSES = {
    Status.VALID: Look("valid", "#5b8fc7", "", "o"),
    Status.DEGRADED: Look("degraded", "#d9c27a", "\\\\\\", "o"),
    Status.NOT_EXCITED: Look("not excited", "#d5d9de", "...", "o"),
    Status.INVALID: Look("invalid", "#ffffff", "xx", "o"),
}

FRICTION = (lambda r: None if r.posterior is None else r.posterior.parameters()["phi"]), math.radians(1.0)
"""The friction angle of a window, and the unit of its picture."""
HOLD = "How well {} hold against shearing off?"


def stretches(results: Sequence[WindowResult]) -> list[list[WindowResult]]:
    """Return the windows cut where another log, or another time of its clock, begins."""
    cut: list[list[WindowResult]] = []
    for r in results:
        if not cut or r.log != cut[-1][-1].log or not 0.0 < r.t - cut[-1][-1].t <= LONGEST_GAP:
            cut.append([])
        cut[-1].append(r)
    return cut


def clock_text(t: float, form: str = "%H:%M:%S") -> str:
    """Return a stamp [s] as a time of day (UTC), or in seconds where it is none."""
    return f"{datetime.fromtimestamp(t, UTC):{form}}" if is_date(t) else f"{t:g} s"


def dates(results: Sequence[WindowResult]) -> str:
    """Return the days of the windows, as in "2026-05-04 to 2026-05-05"; empty where stamps are no dates."""
    known = sorted(r.t for r in results if is_date(r.t))
    days = dict.fromkeys(clock_text(t, "%Y-%m-%d") for t in (known[0], known[-1])) if known else {}
    return " to ".join(days)


class TimeAxis:
    """Time axis with recordings one after the other; a window's decision stands for `hop` [s]."""

    def __init__(self, results: Sequence[WindowResult], hop: float) -> None:
        self.parts, self.hop, self._results = stretches(results), hop, results
        lengths = np.array([part[-1].t - part[0].t + hop for part in self.parts])
        self.space = SPACE_BETWEEN * float(lengths.sum())
        self.begins = (np.cumsum(lengths) - lengths + self.space * np.arange(len(lengths))).tolist()
        self.shift = [begin - (part[0].t - hop) for begin, part in zip(self.begins, self.parts, strict=True)]
        self.end = self.begins[-1] + float(lengths[-1])

    def curve(self, of: Callable[[WindowResult], Any], columns: int = 1) -> Array:
        """Return the columns time and values (N, 1 + columns) of all windows; nan breaks the line at None."""
        gap = [math.nan] * columns
        rows: list[list[float]] = []
        for part, shift in zip(self.parts, self.shift, strict=True):
            last = -math.inf
            for r in part:
                if r.t - last > 1.5 * self.hop:
                    rows.append([r.t + shift, *gap])
                value, last = of(r), r.t
                rows.append([r.t + shift, *(gap if value is None else np.atleast_1d(value).tolist())])
        return np.array(rows)

    def segments(self, of: Callable[[WindowResult], Any]) -> Iterator[tuple[Any, float, float]]:
        """Yield the value, begin and length of each run of windows with the same value."""
        for part, shift in zip(self.parts, self.shift, strict=True):
            for value, group in groupby(part, of):
                members = list(group)
                begin = members[0].t - self.hop + shift
                yield value, begin, members[-1].t + shift - begin

    def dress(self, axis: Any) -> None:
        """Draw ticks with clock times, and a rule between recordings."""
        day = dates(self._results)
        places = np.linspace(0.0, self.end, TICKS)
        of_part = np.maximum(np.searchsorted(self.begins, places, "right") - 1, 0)
        stamps = [x - self.shift[i] for x, i in zip(places, of_part, strict=True)]
        axis.set_xlim(0.0, 1.01 * self.end)
        axis.set_xticks(places, [clock_text(round(t)).removesuffix(" s") for t in stamps])
        for begin in self.begins[1:]:
            axis.axvline(begin - self.space / 2.0, color="0.4", lw=0.8, ls=":")
        axis.set_xlabel(f"UTC, {day}" if day else "time of the log, s")


def pictures(results: Sequence[WindowResult], config: Config) -> Iterator[tuple[str, Picture]]:
    """Yield the caption and picture of all that windows show, the decision first; of a test rig, of its runs."""
    if config.table is not None:
        yield from run_pictures(results)
        return
    yield "May the tractor go on, and how much could it pull?", decision_picture(results, config)
    yield from map_pictures(results)
    yield from curve_pictures(results, config)


def decision_picture(results: Sequence[WindowResult], config: Config) -> Picture:
    """Return the decision as a ribbon, the estimate's quality below, and the draft beside the largest possible."""
    from matplotlib.patches import Patch

    time = TimeAxis(results, config.estimator.hop)

    def draw(figure: Any) -> None:
        state, status, axis = figure.subplots(3, 1, sharex=True, height_ratios=[0.16, 0.1, 1.0])
        looks = _ribbon(state, time, lambda r: STATES[r.traversability.state], "may go on")
        looks |= _ribbon(status, time, lambda r: STATUSES[r.status], "estimate")
        if any(r.traversability.max_draft for r in of_use(results)):
            _band(axis, time, lambda r: r.traversability.max_draft, 1e3, "largest possible, on the level")
        pulled = time.curve(lambda r: r.excitation.draft)
        if np.isfinite(pulled[:, 1]).any():
            axis.plot(pulled[:, 0], pulled[:, 1] / 1e3, "-", color="black", lw=1.3, label="pulled")
        parts = zip(time.parts, time.shift, strict=True)
        warnings = [t + shift for part, shift in parts for r in part for t in r.warnings.begun]
        if warnings:
            axis.plot(
                warnings, np.full(len(warnings), 0.97), "v", color=STATES[State.NO_GO].colour, clip_on=False,
                transform=axis.get_xaxis_transform(), label="warning: may get stuck",
            )  # fmt: skip
        axis.set_ylabel("draft, kN")
        axis.set_ylim(bottom=min(0.0, 1.1e-3 * float(np.nanmin(pulled[:, 1], initial=0.0))))
        if axis.get_legend_handles_labels()[1]:
            axis.legend(loc="best")
        else:
            axis.text(0.5, 0.5, "no draft is known", ha="center", va="center", transform=axis.transAxes)
            axis.set_yticks([])
        time.dress(axis)
        handles = [
            Patch(facecolor=look.colour, hatch=look.hatch, edgecolor="0.25", lw=0.4, label=look.name) for look in looks
        ]
        figure.legend(handles=handles, loc="outside lower center", ncols=4, frameon=False)

    words = "over time: may the tractor go on, quality of the estimate, draft pulled and largest possible draft"
    return picture(draw, 4.0, words)


def curve_pictures(results: Sequence[WindowResult], config: Config) -> Iterator[tuple[str, Picture]]:
    """Yield the caption and picture of each quantity over time that is known anywhere, the bearing pressure first."""
    time = TimeAxis(results, config.estimator.hop)
    plate = f"a plate of {100 * config.estimator.b_ref:g} cm at {1e3 * config.estimator.z_ref:g} mm depth"
    firm = f"How firm is the ground? Pressure that carries {plate}."
    agreement = "How well do model and sensors agree? At 1 as well as the sensors’ noise allows."

    def draw_gap(axis: Any) -> None:
        _band(axis, time, lambda r: None if r.chi2 is None else Estimate(math.sqrt(r.chi2), 0.0), 1.0)
        axis.axhline(1.0, color="0.3", lw=1.0, ls="--")
        low, high = axis.get_ylim()
        axis.set_ylim(min(low, 0.5), max(high, 1.5))

    if of_use(results):
        yield firm, _over_time(time, "bearing pressure, kPa", lambda a: _band(a, time, lambda r: r.bearing, 1e3))
        yield HOLD.format("does the ground"), _over_time(time, "friction angle, °", lambda a: _band(a, time, *FRICTION))
        yield agreement, _over_time(time, "model’s error, × noise", draw_gap)
    for caption, label, quantity, unit in (
        ("How much does each wheel slip?", "slip of each wheel, %", "slip", 0.01),
        ("How deep does each wheel sink, by the estimated soil?", "sinkage of each wheel, mm", "sinkage", 1e-3),
    ):
        if any(value is not None for r in results for value in getattr(r, quantity).values()):
            draw = partial(_draw_wheels, time=time, wheels=list(results[0].slip), quantity=quantity, unit=unit)
            yield caption, _over_time(time, label, draw)


def run_pictures(results: Sequence[WindowResult]) -> Iterator[tuple[str, Picture]]:
    """Yield the caption and picture of the soil in each run of a test rig."""

    def drawn(label: str, of: Callable[[WindowResult], Estimate | None], unit: float) -> Picture:
        known = [(i + 1, e.value / unit, e.std / unit) for i, r in enumerate(results) if (e := of(r)) is not None]

        def draw(figure: Any) -> None:
            axis = figure.subplots()
            if known:
                x, y, sd = np.array(known).T
                axis.errorbar(x, y, BAND_SD * sd, fmt="o", capsize=3)
            axis.set_xlim(0.5, len(results) + 0.5)
            axis.xaxis.get_major_locator().set_params(integer=True)
            axis.set_xlabel("run")
            axis.set_ylabel(label)

        return picture(draw, 3.2, f"{label} of each run")

    yield "How firm was the ground in each run?", drawn("bearing pressure, kPa", lambda r: r.bearing, 1e3)
    yield HOLD.format("did it"), drawn("friction angle, °", *FRICTION)


def map_pictures(results: Sequence[WindowResult]) -> Iterator[tuple[str, Picture]]:
    """Yield the caption and picture of the route by decision; none without positions."""
    placed = [r for r in results if r.position is not None]
    if len(placed) < 2:
        return

    def draw(figure: Any) -> None:
        axis = figure.subplots()
        latitude, longitude = np.array([r.position for r in placed]).T
        first = float(latitude[0]), float(longitude[0])
        north, east = offset(*first, latitude, longitude)
        begin = 0
        for part in stretches(placed):
            end = begin + len(part)
            axis.plot(east[begin:end], north[begin:end], "-", color="0.6", lw=0.8, zorder=1)
            begin = end
        at = np.column_stack([east, north])
        for state, look in STATES.items():
            here = at[[r.traversability.state is state for r in placed]]
            if len(here):
                shown = {"c": look.colour, "marker": look.marker, "label": look.name}
                axis.scatter(*here.T, s=34, edgecolors="0.25", linewidths=0.5, **shown)
        axis.legend(loc="best")
        axis.annotate("start", (east[0], north[0]), (-8, -4), textcoords="offset points", fontsize=10, ha="right")
        axis.set_aspect("equal", adjustable="datalim")
        axis.margins(0.08)
        sides = zip(first, ("SN", "WE"), strict=True)
        place = ", ".join(f"{abs(math.degrees(angle)):.5f}° {side[angle >= 0]}" for angle, side in sides)
        axis.set_xlabel(f"m east of the start ({place})")
        axis.set_ylabel("m north")

    yield "The route by decision.", picture(draw, 4.0, "map of the route, coloured by decision")


def _over_time(time: TimeAxis, label: str, draw_curve: Callable[[Any], None]) -> Picture:
    """A curve under a thin ribbon of the decision."""

    def draw(figure: Any) -> None:
        ribbon, axis = figure.subplots(2, 1, sharex=True, height_ratios=[0.07, 1.0])
        _ribbon(ribbon, time, lambda r: STATES[r.traversability.state])
        draw_curve(axis)
        axis.set_ylabel(label)
        time.dress(axis)

    return picture(draw, 3.2, f"{label.partition(',')[0]} over time")


def _ribbon(axis: Any, time: TimeAxis, look_of: Callable[[WindowResult], Look], label: str = "") -> set[Look]:
    """Draw a segment for each run of windows with one look; returns the looks."""
    seen: set[Look] = set()
    for look, begin, length in time.segments(look_of):
        axis.broken_barh([(begin, length)], (0, 1), facecolor=look.colour, hatch=look.hatch, edgecolor="0.25", lw=0.4)
        seen.add(look)
    axis.set_ylabel(label, rotation=0, ha="right", va="center", fontsize=9.5)
    axis.set_ylim(0, 1)
    axis.set_yticks([])
    axis.grid(False)
    axis.spines[:].set_visible(False)
    axis.tick_params(bottom=False, labelbottom=False)
    return seen


def _band(
    axis: Any, time: TimeAxis, of: Callable[[WindowResult], Estimate | None], unit: float, label: str | None = None
) -> None:
    """A curve with its band where windows have an estimate."""

    def known(r: WindowResult) -> tuple[float, float] | None:
        estimate = of(r) if of_use([r]) else None
        return None if estimate is None else (estimate.value / unit, estimate.std / unit)

    t, value, std = time.curve(known, 2).T
    axis.plot(t, value, ".-" if len(t) <= FEW_WINDOWS else "-", color="#1f6fb4", ms=4, lw=1.4, label=label)
    axis.fill_between(t, value - BAND_SD * std, value + BAND_SD * std, color="#1f6fb4", alpha=0.25, lw=0)
    if not (value < 0.0).any():
        axis.set_ylim(bottom=max(axis.get_ylim()[0], 0.0))


def _draw_wheels(axis: Any, time: TimeAxis, wheels: Sequence[str], quantity: str, unit: float) -> None:
    styles = ("-", "--", "-.", ":")
    for i, wheel in enumerate(wheels):
        t, value = time.curve(lambda r, wheel=wheel: getattr(r, quantity)[wheel]).T  # type: ignore[misc]
        axis.plot(t, value / unit, styles[i % 4], color=f"C{i}", lw=1.4, label=wheel)
    axis.legend(ncols=4, loc="best")
