"""Pictures of a diagnosis: readings beside the model's before and after, the gap of each channel, the largest draft.

All readings are of held-out blocks, which the model was not fitted to.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from soilbus.arrays import Array
from soilbus.diagnosis.fitted_model import FittedModel, Series
from soilbus.offline.diagnose import Findings
from soilbus.report.page import Picture, picture

MAX_POINTS = 1500
"""Readings of a wheel that a picture shows; the means are of all."""
BINS = 10
"""Equally filled bins of a picture's means."""
PLOT_RANGE_SD = 5.0
"""Standard deviations that a picture of standardised residuals shows."""
POINTS_SHOWN = 99.5
"""Per cent of the differences that a picture's range holds."""
MARKERS = "o^sDvP*X"
"""Of the wheels, one after the other."""
BEFORE_COLOUR, AFTER_COLOUR = "#b9b9b9", "#1f6fb4"


class Quantity(NamedTuple):
    """Symbolic name's unit on pictures, its SI value, and the unit of its picture."""

    unit: str
    si: float


QUANTITIES = {"torque": Quantity("N m", 1.0), "draft": Quantity("N", 1.0), "sinkage": Quantity("mm", 1e-3)}
"""Unit of each channel in pictures."""
REGRESSORS = {
    "slip": Quantity("%", 0.01), "load": Quantity("kN", 1e3), "speed": Quantity("m/s", 1.0), "since": Quantity("s", 1.0)
}  # fmt: skip
"""What differences are plotted over, with its unit."""
REGRESSOR_NAMES = {"slip": "slip", "load": "load of a wheel", "speed": "ground speed", "since": "time"}


class Agreement(NamedTuple):
    """One channel before and after: each wheel's readings, and the regressor over which most has become better."""

    channel: str
    regressor: str
    gain: float
    before: tuple[Series, ...]
    after: tuple[Series, ...]


def agreements(base: FittedModel, completed: FittedModel) -> list[Agreement]:
    """The channels, the one first that shows best what the effects explain.

    Of each channel that regressor is taken over whose bins' mean differences have come nearest to zero, in chi-square;
    with nothing added, over whose bins they are largest.
    """
    of_base, of_completed = base.held_out_series(), completed.held_out_series()
    found = []
    for channel in dict.fromkeys(series.channel for series in of_base):
        before, after = ([s for s in series if s.channel == channel] for series in (of_base, of_completed))
        left = 0.0 if completed is base else 1.0
        gains = {
            name: sum(_trend(b, a, name) - left * _trend(a, a, name) for b, a in zip(before, after, strict=True))
            for name in REGRESSORS
        }
        name = max(gains, key=lambda name: gains[name])
        found.append(Agreement(channel, name, gains[name], tuple(before), tuple(after)))
    return sorted(found, key=lambda agreement: -agreement.gain)


def _trend(series: Series, reference: Series, regressor: str) -> float:
    """Chi-square of the mean differences over bins, with the scatter of the reference's."""
    variance = float(np.var(reference.measured - reference.modelled)) or 1.0
    difference = series.measured - series.modelled
    parts = _bins(getattr(series, regressor))
    return sum(len(part) * float(difference[part].mean()) ** 2 for part in parts) / variance


def _bins(values: Array) -> list[Any]:
    """Indices of equally filled bins."""
    return [part for part in np.array_split(np.argsort(values, kind="stable"), BINS) if len(part)]


def agreement_pictures(of: Agreement, completed: bool) -> Iterator[tuple[str, Picture]]:
    """Caption and picture of a channel before and, where anything was added, after; in the same scales."""
    difference = np.concatenate([s.measured - s.modelled for s in (*of.before, *of.after)])
    unit = QUANTITIES[of.channel]
    half = float(np.percentile(np.abs(difference), POINTS_SHOWN)) / unit.si
    name = f"{of.channel} measured against modelled"
    for when, series in (("Before", of.before), ("After", of.after))[: 1 + completed]:
        scatter = float(np.sqrt(np.mean(np.concatenate([s.measured - s.modelled for s in series]) ** 2))) / unit.si
        words = f"{name}, {when.lower()}"
        caption = f"{when}: {name}; typical difference {scatter:.3g} {unit.unit}."
        yield caption, picture(lambda figure, series=series: _draw_agreement(figure, of, series, half), 4.6, words)  # type: ignore[misc]


def _draw_agreement(figure: Any, of: Agreement, series: Sequence[Series], half: float) -> None:
    """Above: measured over modelled. Below: the difference over the regressor, with means over bins."""
    whole, part = figure.subplots(2, 1, height_ratios=[1.1, 1.0])
    unit, regressor = QUANTITIES[of.channel], REGRESSORS[of.regressor]
    ends = np.array(
        [s.modelled[[i]] for s in (*of.before, *of.after) for i in (s.modelled.argmin(), s.modelled.argmax())]
    )
    line = np.array([ends.min(), ends.max()]) / unit.si
    for i, one in enumerate(series):
        step = max(len(one.measured) // MAX_POINTS, 1)
        measured, modelled = one.measured / unit.si, one.modelled / unit.si
        x = getattr(one, of.regressor) / regressor.si
        whole.plot(
            modelled[::step], measured[::step], MARKERS[i % 8], ms=2.5, mew=0, alpha=0.35, color=f"C{i}",
            label=one.wheel or of.channel,
        )  # fmt: skip
        part.plot(x[::step], (measured - modelled)[::step], MARKERS[i % 8], ms=2, mew=0, alpha=0.15, color=f"C{i}")
        means = np.array([(x[b].mean(), (measured - modelled)[b].mean()) for b in _bins(x)])
        part.plot(*means.T, "-", marker=MARKERS[i % 8], ms=5, lw=1.6, color=f"C{i}", mec="white", mew=0.6)
    whole.plot(line, line, "-", color="black", lw=1.0, zorder=0.5)
    whole.set_xlabel(f"modelled {of.channel}, {unit.unit}")
    whole.set_ylabel(f"measured, {unit.unit}")
    if len(series) > 1:
        legend = whole.legend(ncols=2, loc="upper left", markerscale=2.5)
        for handle in legend.legend_handles:
            handle.set_alpha(1.0)
    part.axhline(0.0, color="black", lw=1.0)
    part.set_ylim(-half, half)
    part.set_xlabel(f"{REGRESSOR_NAMES[of.regressor]}, {regressor.unit}")
    part.set_ylabel(f"difference, {unit.unit}")


def channel_gaps(fitted: FittedModel) -> dict[str, float]:
    """Mean square of the standardised residuals of each channel's held-out readings; 1 is noise."""
    found: dict[str, list[Array]] = {}
    for series in fitted.held_out_series():
        found.setdefault(series.channel, []).append(series.standardised)
    return {channel: float(np.mean(np.concatenate(parts) ** 2)) for channel, parts in found.items()}


def gap_picture(base: FittedModel, completed: FittedModel) -> Picture:
    """Root of the gap of each channel, before and after, as bars."""
    before, after = channel_gaps(base), channel_gaps(completed)
    bars = {"before": before} if completed is base else {"before": before, "after": after}
    words = "; ".join(
        f"{when}: " + ", ".join(f"{channel} {gap**0.5:.2f}" for channel, gap in gaps.items())
        for when, gaps in bars.items()
    )
    return picture(lambda figure: _draw_gaps(figure, bars), 1.3 + 0.62 * len(before), f"gap of each channel, {words}")


def _draw_gaps(figure: Any, bars: Mapping[str, Mapping[str, float]]) -> None:
    axis = figure.subplots()
    channels = list(bars["before"])
    looks = {"before": (BEFORE_COLOUR, "///"), "after": (AFTER_COLOUR, "")}
    height = 0.8 / len(bars)
    for i, (when, gaps) in enumerate(bars.items()):
        colour, hatch = looks[when]
        y = np.arange(len(channels)) + (i - (len(bars) - 1) / 2.0) * height
        size = [gaps[channel] ** 0.5 for channel in channels]
        drawn = axis.barh(y, size, 0.92 * height, color=colour, hatch=hatch, edgecolor="0.3", lw=0.4, label=when)
        axis.bar_label(drawn, [f"{s:.2f}" for s in size], padding=3, fontsize=10)
    axis.axvline(1.0, color="black", lw=1.2, ls="--", label="noise alone")
    axis.set_yticks(range(len(channels)), channels)
    axis.invert_yaxis()
    axis.margins(x=0.12)
    axis.grid(axis="y", visible=False)
    axis.set_xlabel("model’s error, × noise of the sensors")
    figure.legend(loc="outside lower center", ncols=3, frameon=False)


def draft_picture(findings: Findings) -> Picture | None:
    """Largest draft on each log's soil before and after, beside the drafts that were pulled; None without a vehicle."""
    drafts = [(name, b, a) for name, b, a in findings.largest_drafts() if b is not None and a is not None]
    if not drafts:
        return None
    words = "; ".join(f"{name}: {b.value / 1e3:.2f} kN before, {a.value / 1e3:.2f} kN after" for name, b, a in drafts)
    pulled = [findings.diagnosis.base.checks[i].problem.draft / 1e3 for i in findings.recordings.first]
    added = findings.diagnosis.completed is not findings.diagnosis.base
    return picture(
        lambda figure: _draw_drafts(figure, drafts, pulled, added), 1.6 + 0.75 * len(drafts), f"largest draft, {words}"
    )


def _draw_drafts(figure: Any, drafts: Sequence[Any], pulled: Sequence[Array], added: bool) -> None:
    axis = figure.subplots()
    bars = {"before": 1, "after": 2} if added else {"before": 1}
    looks = {"before": (BEFORE_COLOUR, "///"), "after": (AFTER_COLOUR, "")}
    height = 0.55 / len(bars)
    for k, (when, column) in enumerate(bars.items()):
        colour, hatch = looks[when]
        value, sd = np.array([(d[column].value, d[column].std) for d in drafts]).T / 1e3
        y = np.arange(len(drafts)) + (k - len(bars) / 2.0) * height
        drawn = axis.barh(
            y, value, 0.92 * height, xerr=2.0 * sd, capsize=3, color=colour, hatch=hatch, edgecolor="0.3", lw=0.4,
            label=f"largest draft{', ' + when if added else ''}",
        )  # fmt: skip
        axis.bar_label(drawn, [f"{v:.2f}" for v in value], padding=4, fontsize=10)
    for i, draft in enumerate(pulled):
        low, high = np.percentile(draft, (2.5, 97.5))
        axis.plot(
            [low, high], [i + 0.36] * 2, "-", color="black", lw=3.0, label="" if i else "pulled (95 % of the time)"
        )
    axis.set_yticks(range(len(drafts)), [d[0] if len(d[0]) <= 14 else d[0][:13] + "…" for d in drafts])
    axis.invert_yaxis()
    axis.set_xlim(left=min(0.0, axis.get_xlim()[0]))
    axis.margins(x=0.12)
    axis.grid(axis="y", visible=False)
    axis.set_xlabel("draft, kN")
    figure.legend(loc="outside lower center", ncols=2, frameon=False)


def residual_picture(fitted: FittedModel, title: str) -> Picture:
    """Standardised residuals by channel (rows) over slip, load and time (columns)."""
    channels: dict[str, list[Series]] = {}
    for series in fitted.held_out_series():
        channels.setdefault(series.channel, []).append(series)
    return picture(
        lambda figure: _draw_residuals(figure, channels, title), 0.6 + 2.2 * len(channels), f"residuals {title}", 10.0
    )


def _draw_residuals(figure: Any, channels: Mapping[str, Sequence[Series]], title: str) -> None:
    figure.suptitle(title)
    names = ("slip", "load", "since")
    axes = figure.subplots(len(channels), len(names), sharey=True, sharex="col", squeeze=False)
    for row, (channel, of_wheels) in zip(axes, channels.items(), strict=True):
        for one in of_wheels:
            step = max(len(one.since) // MAX_POINTS, 1)
            for axis, name in zip(row, names, strict=True):
                x, z = getattr(one, name) / REGRESSORS[name].si, one.standardised
                colour = axis.plot(x[::step], z[::step], ".", ms=2, alpha=0.3)[0].get_color()
                means = np.array([(x[part].mean(), z[part].mean()) for part in _bins(x)])
                axis.plot(*means.T, "-", color=colour, label=one.wheel)
        for axis in row:
            axis.axhline(0.0, color="grey", lw=0.5)
        row[0].set_ylabel(f"{channel}, σ")
        row[0].set_ylim(-PLOT_RANGE_SD, PLOT_RANGE_SD)
        if len(of_wheels) > 1:
            row[-1].legend(ncols=4, fontsize="x-small")
    for axis, name in zip(axes[-1], names, strict=True):
        axis.set_xlabel(f"{REGRESSOR_NAMES[name]}, {REGRESSORS[name].unit}")
