"""The windows of a replay as a short summary and as an HTML report."""

from __future__ import annotations

import html
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from soilbus.daemon.pipeline import Pipeline
from soilbus.daemon.result import WindowResult
from soilbus.report.page import html_table, page, picture
from soilbus.traversability import Status


def summary(results: Sequence[WindowResult], pipeline: Pipeline) -> str:
    """A few lines: windows by status, soil, decisions, failed solves by kind, refused samples by reason."""
    counts = pipeline.admission.counts
    heard = f"{sum(counts.received.values())} mapped frames ({counts.unknown} of other identifiers)"
    return summary_of(results, heard, pipeline.intake.refusals.total)


def summary_of(results: Sequence[WindowResult], heard: str, refused: Counter[str]) -> str:
    """The same of windows from anything that `heard` tells of, with the samples refused by reason."""
    lines = [f"{len(results)} windows from {heard}"]
    for (status, reason), n in Counter((str(r.status), r.reason) for r in results).most_common():
        lines.append(f"  {n:5d} {status}" + ("" if reason == "none" else f": {reason}"))
    good = [r for r in results if r.status is Status.VALID]
    if good:
        bearing = np.median([r.bearing.value for r in good if r.bearing])
        std = np.median([r.bearing.std for r in good if r.bearing])
        lines.append(f"bearing pressure {bearing / 1e3:.1f} +- {std / 1e3:.1f} kPa (medians of the valid windows)")
    states = Counter(str(r.traversability.state) for r in results)
    lines.append("traversability " + (", ".join(f"{s} {n}" for s, n in states.most_common()) or "unknown"))
    lines.append("failed solves " + counted(Counter(r.failure for r in results if r.failure)))
    if ended := sum(r.search_ended for r in results):
        lines.append(f"search for another soil ended by its budget in {ended} windows (estimator.search_rate)")
    lines.append("refused samples " + counted(refused))
    return "\n".join(lines) + "\n"


def counted(counts: Counter[str]) -> str:
    """As in "wild 3, stale 1", the most frequent first; "none" without any."""
    return ", ".join(f"{name} {n}" for name, n in counts.most_common()) or "none"


def html_report(results: Sequence[WindowResult], text: str, logs: Sequence[Path]) -> str:
    """A self-contained page with plots over time under a summary; needs matplotlib (extra: plots)."""
    rows = [
        (
            f"{r.t:.1f}",
            str(r.status) + ("" if r.reason == "none" else f" ({r.reason})"),
            "-" if r.bearing is None else f"{r.bearing.value / 1e3:.2f} ± {r.bearing.std / 1e3:.2f}",
            "-" if r.chi2 is None else f"{r.chi2:.2f}",
            str(r.traversability.state),
            ", ".join(f"{k} {v}" for k, v in r.rejected.items()) or "-",
        )
        for r in results
    ]
    head = ("t, s", "status", "bearing pressure, kPa", "chi²", "traversability", "refused samples")
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
    start = results[0].t if results else 0.0
    known = [r for r in results if r.bearing is not None and r.posterior is not None]
    t = [r.t - start for r in known]
    bearing = [(r.bearing.value / 1e3, r.bearing.std / 1e3) for r in known if r.bearing]
    _band(axes[0], t, bearing, "bearing pressure, kPa")
    phi = [r.posterior.parameters()["phi"] for r in known if r.posterior]
    _band(axes[1], t, [(float(np.degrees(e.value)), float(np.degrees(e.std))) for e in phi], "friction angle, °")
    pulls = [(r.t - start, r.traversability.max_draft) for r in known if r.traversability.max_draft]
    _band(axes[2], [p[0] for p in pulls], [(p[1].value / 1e3, p[1].std / 1e3) for p in pulls if p[1]], "max. draft, kN")
    for wheel in results[0].slip if results else ():
        axes[3].plot([r.t - start for r in results], [r.slip[wheel] for r in results], label=wheel)
    axes[3].set_ylabel("slip")
    axes[3].set_xlabel("end of window, s")
    if results and results[0].slip:
        axes[3].legend(ncols=4)
    return figure


def _band(axis: Any, t: Sequence[float], values: Sequence[tuple[float, float]], label: str) -> None:
    value, std = np.array(values).reshape(-1, 2).T
    axis.plot(t, value, ".-")
    axis.fill_between(t, value - 2 * std, value + 2 * std, alpha=0.25)
    axis.set_ylabel(label)
