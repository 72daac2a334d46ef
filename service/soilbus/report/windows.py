"""Windows of a replay as a short summary.

It counts windows by status and reason, with advice for each reason, then gives medians of the bearing
pressure, decisions, failed solves, and samples used and refused.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from soilbus.can.doubts import doubts
from soilbus.decision.traversability import State, Status
from soilbus.grouping import grouped
from soilbus.pipeline.pipeline import Pipeline
from soilbus.pipeline.result import WindowResult
from soilbus.report.advice import advice, of_use
from soilbus.report.configuration import no_slope
from soilbus.words import text_of


def summary(results: Sequence[WindowResult], pipeline: Pipeline) -> str:
    """Return the summary of a replay of logs; the pipeline counted frames and refusals while it made the windows."""
    counts, refusals = pipeline.admission.counts, pipeline.intake.refusals
    heard = f"{sum(counts.received.values())} mapped frames ({counts.unknown} of other identifiers)"
    if counts.elsewhere:
        heard += f"; {counts.elsewhere} frames of other channels left out"
    if pipeline.admission.missed:
        heard += f"; {pipeline.admission.missed} skipped by their counters"
    doubted = list(doubts(counts.received, counts.refused).values())
    return summary_of(results, heard, refusals.used, refusals.total, no_slope(pipeline.config), doubted)


def summary_of(
    results: Sequence[WindowResult],
    heard: str,
    used: int | None,
    refused: Counter[str],
    unseen_slope: str = "",
    doubted: Sequence[str] = (),
) -> str:
    """Return the summary of windows that were `heard` from any source, such as "5000 mapped frames".

    Samples used are None where they were not counted; `refused` is by reason. `unseen_slope` is said where no sensor
    shows the slope, and `doubted` of messages that cannot be trusted.
    """
    good = [r for r in results if r.status is Status.VALID]
    estimated = len(of_use(results)) - len(good)
    lines = [f"{len(results)} windows from {heard}"]
    unused = len(results) - len(of_use(results))
    lines.append(f"of use: {len(good)} valid, {estimated} with a doubtful estimate; of no use: {unused}")
    if len(logs := grouped(results, lambda r: r.log or "")) > 1:
        lines += [
            f"  {log}: {len(of)} windows, {sum(r.status is Status.VALID for r in of)} valid" for log, of in logs.items()
        ]
    for (status, reason), group in by_reason(results):
        lines.append(f"  {len(group):5d} {status}" + ("" if reason == "none" else f": {reason}"))
        what = advice(group, good)
        lines += [] if what is None else [f"        {what}"]
    if good:
        bearing = np.median([r.bearing.value for r in good if r.bearing])
        std = np.median([r.bearing.std for r in good if r.bearing])
        lines.append(f"bearing pressure {bearing / 1e3:.1f} +- {std / 1e3:.1f} kPa (medians of the valid windows)")
    lines += [line for line in [machine_line(good)] if line]
    states = Counter(str(r.traversability.state) for r in results)
    lines.append("traversability " + (", ".join(f"{s} {n}" for s, n in states.most_common()) or "unknown"))
    could_pull = [r for r in good if r.traversability.max_draft is not None]
    if any(r.traversability.state is State.UNKNOWN and r.excitation.draft is None for r in could_pull):
        lines.append("        no sensor shows the draft: no go, only what could be pulled (vehicle.towing)")
    lines += [f"        {unseen_slope}"] if unseen_slope else []
    lines.append("failed solves " + counted(Counter(r.failure for r in results if r.failure)))
    lines.append("solver ended by " + counted(Counter(r.termination for r in results if r.termination)))
    if ended := sum(r.search_ended for r in results):
        lines.append(f"search for another soil ended by its budget in {ended} windows (estimator.search_rate)")
    if used is not None:
        lines.append(f"samples {used + refused.total()}: used {used}, refused {refused.total()}")
    lines.append("refused samples " + counted(refused))
    return text_of([*lines, *doubted])


def machine_line(results: Sequence[WindowResult]) -> str | None:
    """Return what the newest window with an estimate says of the machine itself, in one line."""
    found = next((r.standing for r in reversed(of_use(results)) if r.standing), None)
    if found is None:
        return None
    units = {"relaxation_length": "m", "wheel_inertia": "kg m^2"}
    value = {name: f"{of.value:.2g} +- {of.std:.2g} {units.get(name, 's')}" for name, of in found.items()}
    parts = [f"{name.replace('_', ' ')} {value[name]}" for name in units if name in value]
    late = [
        f"{name.removeprefix('lateness.').replace('_', ' ')} by {value[name]}" for name in value if name not in units
    ]
    return "of the machine: " + ", ".join(parts) + (f"; later than the torque: {', '.join(late)}" if late else "")


def why_of_no_use(results: Sequence[WindowResult], window: float) -> str:
    """Return one line on why no window, each `window` [s] long, has an estimate."""
    if not results:
        return f"no window could be made: no recording lasts the {window:g} s of a window"
    (status, reason), group = by_reason(results)[0]
    what = advice(group, [])
    return f"no window could be used: {len(group)} of {len(results)} are {status}: {reason}" + (
        "" if what is None else f" ({what})"
    )


def by_reason(results: Sequence[WindowResult]) -> list[tuple[tuple[str, str], list[WindowResult]]]:
    """Return the windows by status and reason, the most frequent first."""
    groups = grouped(results, lambda r: (str(r.status), r.reason))
    return sorted(groups.items(), key=lambda item: -len(item[1]))


def counted(counts: Counter[str]) -> str:
    """Return counts as in "outlier 3, stale 1", the most frequent first; "none" without any."""
    return ", ".join(f"{name} {n}" for name, n in counts.most_common()) or "none"
