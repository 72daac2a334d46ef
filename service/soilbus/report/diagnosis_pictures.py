"""Pictures of a diagnosis: readings beside the model's before and after, the gap of each channel, the largest draft.

All readings are of held-out blocks, which the model was not fitted to.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from soilbus.arrays import Array
from soilbus.diagnosis.fitted_model import FittedModel, Series
from soilbus.estimation.posterior import Estimate
from soilbus.grouping import grouped
from soilbus.offline.diagnose import Findings
from soilbus.report.page import Picture, picture

MAX_POINTS = 1500
"""Readings of a wheel that a picture shows; the means are of all."""
FEW_POINTS = 100
"""Readings of a wheel up to which their dots are large."""
BINS = 10
"""Equally filled bins of a picture's means."""
POINTS_SHOWN = 99.5
"""Per cent of the differences that a picture's range holds."""
MARKERS = "o^sDvP*X"
"""Of the wheels, one after the other."""
LOOKS = {"before": ("#b9b9b9", "///"), "after": ("#1f6fb4", "")}
"""Colour and hatch of bars."""


class Quantity(NamedTuple):
    """Name and unit of a quantity on pictures, and the unit's SI value."""

    name: str
    unit: str
    si: float


QUANTITIES = {
    "torque": Quantity("torque", "N m", 1.0), "draft": Quantity("draft", "N", 1.0),
    "sinkage": Quantity("sinkage", "mm", 1e-3), "slip": Quantity("slip", "%", 0.01),
    "load": Quantity("load of a wheel", "kN", 1e3), "speed": Quantity("ground speed", "m/s", 1.0),
    "since": Quantity("time", "s", 1.0),
}  # fmt: skip
"""The channels, and what differences are plotted over."""
REGRESSORS = ("slip", "load", "speed", "since")


class Agreement(NamedTuple):
    """One channel before and after: each wheel's readings, and the regressor over which most has become better."""

    channel: str
    regressor: str
    before: tuple[Series, ...]
    after: tuple[Series, ...]


def agreements(base: FittedModel, completed: FittedModel) -> list[Agreement]:
    """Return the channels, the one first that shows best what the effects explain.

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
        found.append((gains[name], Agreement(channel, name, tuple(before), tuple(after))))
    return [agreement for _, agreement in sorted(found, key=lambda pair: -pair[0])]


def _trend(series: Series, reference: Series, regressor: str) -> float:
    """Chi-square of the mean differences over bins, with the scatter of the reference's."""
    variance = float(np.var(reference.measured - reference.modelled)) or 1.0
    difference = series.measured - series.modelled
    parts = _bins(getattr(series, regressor))
    return sum(len(part) * float(difference[part].mean()) ** 2 for part in parts) / variance


def _bins(values: Array) -> list[Any]:
    """Indices of equally filled bins."""
    return [part for part in np.array_split(np.argsort(values, kind="stable"), BINS) if len(part)]


def agreement_pictures(of: Agreement, added: bool) -> Iterator[tuple[str, Picture]]:
    """Yield the caption and picture of a channel before and, where anything was added, after; in the same scales."""
    unit, name = QUANTITIES[of.channel], f"{of.channel} measured against modelled"
    shown = {"Before: ": of.before, "After: ": of.after} if added else {"": of.before}
    for when, series in shown.items():
        difference = np.concatenate([s.measured - s.modelled for s in series]) / unit.si
        typical = float(np.sqrt(np.mean(difference**2)))
        caption = f"{when}{name}; typical difference {typical:.3g} {unit.unit}."
        drawn = picture(partial(_draw_agreement, of=of, series=series), 4.6, f"{when}{name}")
        yield caption[0].upper() + caption[1:], drawn


def _ends(values: Array) -> tuple[float, float]:
    """Ends of an axis that holds nearly all of the values."""
    low, high = np.percentile(values, (100.0 - POINTS_SHOWN, POINTS_SHOWN)).tolist()
    space = 0.05 * (high - low) or 1.0
    return low - space, high + space


def _draw_agreement(figure: Any, of: Agreement, series: Sequence[Series]) -> None:
    """Above: measured over modelled. Below: the difference over the regressor, with means over bins."""
    whole, part = figure.subplots(2, 1, height_ratios=[1.1, 1.0])
    unit, regressor = QUANTITIES[of.channel], QUANTITIES[of.regressor]
    both = of.before + of.after  # whose scales are the same
    readings = _ends(np.concatenate([values for s in both for values in (s.measured, s.modelled)]) / unit.si)
    along = _ends(np.concatenate([getattr(s, of.regressor) for s in both]) / regressor.si)
    off = float(np.percentile(np.abs(np.concatenate([s.measured - s.modelled for s in both])), POINTS_SHOWN)) / unit.si
    for i, one in enumerate(series):
        step = max(len(one.measured) // MAX_POINTS, 1)
        measured, modelled = one.measured / unit.si, one.modelled / unit.si
        x, difference = getattr(one, of.regressor) / regressor.si, measured - modelled
        look = {"color": f"C{i}", "marker": MARKERS[i % len(MARKERS)]}
        points = look | {"ls": "", "mew": 0}
        size = 2.5 if len(measured) > FEW_POINTS else 5.0
        whole.plot(modelled[::step], measured[::step], ms=size, alpha=0.35, label=one.wheel or of.channel, **points)
        part.plot(x[::step], difference[::step], ms=2, alpha=0.15, **points)
        means = np.array([(x[b].mean(), difference[b].mean()) for b in _bins(x)])
        part.plot(*means.T, ls="-", ms=5, lw=1.6, mec="white", mew=0.6, **look)
    whole.plot(readings, readings, "-", color="black", lw=1.0, zorder=0.5)
    whole.set(xlim=readings, ylim=readings)
    whole.set_xlabel(f"modelled {of.channel}, {unit.unit}")
    whole.set_ylabel(f"measured, {unit.unit}")
    if len(series) > 1:
        legend = whole.legend(ncols=2, loc="upper left", markerscale=2.5)
        for handle in legend.legend_handles:
            handle.set_alpha(1.0)
    part.axhline(0.0, color="black", lw=1.0)
    part.set(xlim=along, ylim=(-off, off))
    part.set_xlabel(f"{regressor.name}, {regressor.unit}")
    part.set_ylabel(f"difference, {unit.unit}")


def gap_picture(base: FittedModel, completed: FittedModel) -> Picture:
    """Return the root of the gap of each channel, before and after, as bars."""
    models = {"before": base} if base is completed else {"before": base, "after": completed}
    bars: dict[str, dict[str, float]] = {}
    for when, model in models.items():
        found = grouped(model.held_out_series(), lambda series: series.channel)
        errors = {channel: np.concatenate([part.standardised for part in of]) for channel, of in found.items()}
        bars[when] = {channel: float(np.mean(error**2)) ** 0.5 for channel, error in errors.items()}
    sizes_of = {when: [f"{channel} {size:.2f}" for channel, size in of.items()] for when, of in bars.items()}
    words = "; ".join(" ".join([when, *said]) for when, said in sizes_of.items())
    height = 1.2 + 0.62 * len(bars["before"]) * (1.0 if len(bars) > 1 else 0.7)

    def draw(figure: Any) -> None:
        axis = figure.subplots()
        noise = axis.axvline(1.0, color="black", lw=1.2, ls="--", label="noise alone")
        sizes = {when: list(of.values()) for when, of in bars.items()}
        labels = {when: [f"{size:.2f}" for size in of] for when, of in sizes.items()}
        drawn = _bars(axis, sizes, 0.8 / len(bars) if len(bars) > 1 else 0.6, labels)
        axis.set_yticks(range(len(bars["before"])), list(bars["before"]))
        axis.set_xlabel("model’s error, × noise of the sensors")
        figure.legend(handles=[*drawn, noise], loc="outside lower center", ncols=3, frameon=False)

    return picture(draw, height, f"error of the model over noise: {words}")


def _bars(
    axis: Any, bars: Mapping[str, Sequence[float]], height: float, labels: Mapping[str, Sequence[str]],
    sd: Mapping[str, Sequence[float]] | None = None,
) -> list[Any]:  # fmt: skip
    """Draw groups of horizontal bars, before above after, labelled at their ends; returns one for each of two looks."""
    drawn = []
    for i, (when, sizes) in enumerate(bars.items()):
        colour, hatch = LOOKS[when] if len(bars) > 1 else LOOKS["after"]
        y = np.arange(len(sizes)) + (i - (len(bars) - 1) / 2.0) * height
        error = {} if sd is None else {"xerr": 2.0 * np.array(sd[when]), "capsize": 3}
        look = {"color": colour, "hatch": hatch, "edgecolor": "0.3", "lw": 0.4}
        bar = axis.barh(y, sizes, 0.92 * height, label=when, **look, **error)
        axis.bar_label(bar, labels[when], padding=5, fontsize=10)
        drawn += [bar] if len(bars) > 1 else []
    axis.invert_yaxis()
    axis.set_xlim(min(0.0, axis.get_xlim()[0]), 1.16 * axis.get_xlim()[1])
    axis.grid(axis="y", visible=False)
    return drawn


def draft_picture(findings: Findings) -> Picture | None:
    """Return the largest draft on each log's soil before and after, beside drafts pulled; None without a vehicle."""
    drafts = findings.largest_drafts()
    if all(before is None and after is None for _, before, after in drafts):
        return None
    names = [name for name, _, _ in drafts]
    bars = {"before": [before for _, before, _ in drafts]}
    if findings.diagnosis.completed is not findings.diagnosis.base:
        bars["after"] = [after for _, _, after in drafts]
    parts = [findings.diagnosis.base.checks[i].problem for i in findings.recordings.first]
    measured = findings.config.signals.draft is not None
    pulled = [part.draft[part.has_balance] / 1e3 if measured else part.draft[:0] for part in parts]
    labels = {when: [_kilonewtons(e) for e in of] for when, of in bars.items()}
    said = (" ".join([name, *(f"{when} {of[i]}" for when, of in labels.items())]) for i, name in enumerate(names))
    words = "; ".join(said)

    def draw(figure: Any) -> None:
        axis, none = figure.subplots(), Estimate(0.0, 0.0)
        sizes = {when: [(e or none).value / 1e3 for e in of] for when, of in bars.items()}
        sds = {when: [(e or none).std / 1e3 for e in of] for when, of in bars.items()}
        handles = _bars(axis, sizes, 0.55 / len(bars), labels, sds)
        look, lines = {"color": "black", "lw": 3.0, "label": "pulled, 95 % of the time"}, []
        for i, draft in enumerate(pulled):
            if len(draft):
                lines += axis.plot(np.percentile(draft, (2.5, 97.5)), [i + 0.38] * 2, "-", **look)
        axis.set_yticks(range(len(names)), [name if len(name) <= 14 else name[:13] + "…" for name in names])
        axis.set_xlabel("draft, kN")
        if handles := [*handles, *lines[:1]]:
            figure.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False)

    return picture(draw, 1.6 + 0.75 * len(drafts), f"largest draft: {words}")


def _kilonewtons(draft: Estimate | None) -> str:
    return "none within the limits" if draft is None else f"{draft.value / 1e3:.2f} kN"
