"""Windows of a replay as a short summary and as an HTML report with plots over time.

The summary counts windows by status and reason, with advice for each reason, then gives medians of the bearing
pressure, decisions, failed solves, and samples used and refused.
"""

from __future__ import annotations

import html
import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from soilbus.can.admission import LONGEST_GAP
from soilbus.decision.traversability import Status
from soilbus.pipeline.pipeline import Pipeline
from soilbus.pipeline.result import WindowResult
from soilbus.report.advice import advice, of_use
from soilbus.report.page import html_table, page, picture

RECORDING_GAP = 5.0
"""Space [s] between two recordings in a plot."""


def summary(results: Sequence[WindowResult], pipeline: Pipeline) -> str:
    """Summary of a replay of logs.

    Parameters
    ----------
    results
        Every window.
    pipeline
        Counted frames and refusals while it made them.
    """
    counts, refusals = pipeline.admission.counts, pipeline.intake.refusals
    heard = f"{sum(counts.received.values())} mapped frames ({counts.unknown} of other identifiers)"
    return summary_of(results, heard, refusals.used, refusals.total)


def summary_of(results: Sequence[WindowResult], heard: str, used: int | None, refused: Counter[str]) -> str:
    """Summary of windows from any source.

    Parameters
    ----------
    results
        Every window.
    heard
        What they were made from, such as "5000 mapped frames".
    used
        Samples used; None where that was not counted.
    refused
        Samples refused by reason.
    """
    good = [r for r in results if r.status is Status.VALID]
    estimated = len(of_use(results)) - len(good)
    lines = [f"{len(results)} windows from {heard}"]
    lines.append(f"of use: {len(good)} valid, {estimated} with a doubtful estimate; of no use: {unused(results)}")
    lines += _by_log(results)
    for (status, reason), group in _groups(results):
        lines.append(f"  {len(group):5d} {status}" + ("" if reason == "none" else f": {reason}"))
        what = advice(group, good)
        lines += [] if what is None else [f"        {what}"]
    if good:
        bearing = np.median([r.bearing.value for r in good if r.bearing])
        std = np.median([r.bearing.std for r in good if r.bearing])
        lines.append(f"bearing pressure {bearing / 1e3:.1f} +- {std / 1e3:.1f} kPa (medians of the valid windows)")
    states = Counter(str(r.traversability.state) for r in results)
    lines.append("traversability " + (", ".join(f"{s} {n}" for s, n in states.most_common()) or "unknown"))
    lines.append("failed solves " + counted(Counter(r.failure for r in results if r.failure)))
    if ended := sum(r.search_ended for r in results):
        lines.append(f"search for another soil ended by its budget in {ended} windows (estimator.search_rate)")
    if used is not None:
        lines.append(f"samples {used + refused.total()}: used {used}, refused {refused.total()}")
    lines.append("refused samples " + counted(refused))
    return "\n".join(lines) + "\n"


def unused(results: Sequence[WindowResult]) -> int:
    """Number of windows without an estimate of the soil."""
    return len(results) - len(of_use(results))


def why_of_no_use(results: Sequence[WindowResult], window: float) -> str:
    """One line on windows of which none has an estimate.

    Parameters
    ----------
    results
        Every window.
    window
        Length of a window [s].
    """
    if not results:
        return f"no window could be made: no recording lasts the {window:g} s of a window"
    (status, reason), group = _groups(results)[0]
    what = advice(group, [])
    return f"no window could be used: {len(group)} of {len(results)} are {status}: {reason}" + (
        "" if what is None else f" ({what})"
    )


def _groups(results: Sequence[WindowResult]) -> list[tuple[tuple[str, str], list[WindowResult]]]:
    """The windows by status and reason, the most frequent first."""
    groups: dict[tuple[str, str], list[WindowResult]] = {}
    for r in results:
        groups.setdefault((str(r.status), r.reason), []).append(r)
    return sorted(groups.items(), key=lambda item: -len(item[1]))


def _by_log(results: Sequence[WindowResult]) -> list[str]:
    """A line for each of several logs."""
    logs: dict[str, list[WindowResult]] = {}
    for r in results:
        logs.setdefault(r.log or "", []).append(r)
    if len(logs) < 2:
        return []
    return [
        f"  {log}: {len(of)} windows, {sum(r.status is Status.VALID for r in of)} valid" for log, of in logs.items()
    ]


def counted(counts: Counter[str]) -> str:
    """As in "outlier 3, stale 1", the most frequent first; "none" without any."""
    return ", ".join(f"{name} {n}" for name, n in counts.most_common()) or "none"


def html_report(results: Sequence[WindowResult], text: str, logs: Sequence[Path]) -> str:
    """A self-contained page: summary, plots over time, one row for each window; needs matplotlib (extra: plots)."""
    rows = [
        (
            r.log or "-",
            f"{r.t:.1f}",
            str(r.status) + ("" if r.reason == "none" else f" ({r.reason})"),
            "-" if r.bearing is None else f"{r.bearing.value / 1e3:.2f} ± {r.bearing.std / 1e3:.2f}",
            "-" if r.chi2 is None else f"{r.chi2:.2f}",
            str(r.traversability.state),
            ", ".join(f"{k} {v}" for k, v in r.rejected.items()) or "-",
        )
        for r in results
    ]
    head = ("log", "t, s", "status", "bearing pressure, kPa", "chi²", "traversability", "refused samples")
    return page(
        "soilbus replay",
        ", ".join(p.name for p in logs),
        f"<pre>{html.escape(text)}</pre>",
        picture(_plots(results), "estimates over time"),
        html_table(head, rows),
    )


def _plots(results: Sequence[WindowResult]) -> Any:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 9), layout="constrained")
    axes: Any = figure.subplots(4, 1, sharex=True)
    begin, cut, several = 0.0, stretches(results), len({r.log for r in results}) > 1
    for stretch in cut:
        shift = begin - stretch[0].t
        _stretch(axes, stretch, shift)
        if begin:
            for axis in axes:
                axis.axvline(begin, color="0.8", linewidth=0.8)
        if several:
            axes[0].annotate(stretch[0].log, (begin, 1.0), xycoords=("data", "axes fraction"), fontsize=7, rotation=20)
        begin = stretch[-1].t + shift + RECORDING_GAP
    labels = ("bearing pressure, kPa", "friction angle, °", "max. draft, kN", "slip")
    for axis, label in zip(axes, labels, strict=True):
        axis.set_ylabel(label)
    axes[3].set_xlabel("end of window, s" + ("; one recording after the other" if len(cut) > 1 else ""))
    if results and results[0].slip:
        axes[3].legend(list(results[0].slip), ncols=4)
    return figure


def stretches(results: Sequence[WindowResult]) -> list[list[WindowResult]]:
    """The windows cut where another log, or another time of its clock, begins."""
    cut: list[list[WindowResult]] = []
    for r in results:
        if not cut or r.log != cut[-1][-1].log or not 0.0 < r.t - cut[-1][-1].t <= LONGEST_GAP:
            cut.append([])
        cut[-1].append(r)
    return cut


def _stretch(axes: Any, results: Sequence[WindowResult], shift: float) -> None:
    """One stretch in all plots, its times moved by `shift` [s]."""
    known = [r for r in results if r.bearing is not None and r.posterior is not None]
    t = [r.t + shift for r in known]
    _band(axes[0], t, [(r.bearing.value / 1e3, r.bearing.std / 1e3) for r in known if r.bearing])
    phi = [r.posterior.parameters()["phi"] for r in known if r.posterior]
    _band(axes[1], t, [(float(np.degrees(e.value)), float(np.degrees(e.std))) for e in phi])
    pulls = [(r.t + shift, r.traversability.max_draft) for r in results if r.traversability.max_draft]
    _band(axes[2], [p[0] for p in pulls], [(p[1].value / 1e3, p[1].std / 1e3) for p in pulls if p[1]])
    for i, wheel in enumerate(results[0].slip):
        axes[3].plot([r.t + shift for r in results], [_number(r.slip[wheel]) for r in results], color=f"C{i}")


def _number(value: float | None) -> float:
    return math.nan if value is None else value


def _band(axis: Any, t: Sequence[float], values: Sequence[tuple[float, float]]) -> None:
    value, std = np.array(values).reshape(-1, 2).T
    axis.plot(t, value, ".-", color="C0")
    axis.fill_between(t, value - 2 * std, value + 2 * std, alpha=0.25, color="C0")
