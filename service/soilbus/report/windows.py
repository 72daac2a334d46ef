"""Windows of a replay as a short summary.

It counts windows by status and reason, each with advice in one line: why there is no valid estimate, what to do, and
how much draft and slip varied within a window; then medians, decisions, failed solves, and samples used and refused.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from soilbus.can.admission import doubts
from soilbus.decision.traversability import State, Status
from soilbus.grouping import grouped
from soilbus.pipeline.pipeline import Pipeline
from soilbus.pipeline.result import WindowResult
from soilbus.report.configuration import no_slope
from soilbus.words import text_of

DIAGNOSE = "record it and run soilbus diagnose"
ADVICE = {
    "not_excited new_soil": "the ground had just changed: nothing to do but drive on",
    "not_excited few_bins": "too few values in a window: set a shorter estimator.bin or a longer estimator.window",
    "standstill": "the vehicle stood or crept, or slipped beyond traversability.max_slip: drive on, with less pull",
    "turning": "the vehicle turned, so its wheels have no common ground speed: drive straight",
    "input_stale": "{} had pauses: check the sender and the wiring, or set a timeout that fits its rate",
    "input_rejected": "{}: the counters do not go on by one: look for a second sender, or for lost frames",
    "implausible": "{} contradicts the other sensors: check mounting, sign, scale and wiring",
}
"""What to do by reason, or by the first word of it, with the channels that it names."""


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
    estimated, unused = len(of_use(results)) - len(good), len(results) - len(of_use(results))
    lines = [f"{len(results)} windows from {heard}"]
    lines.append(f"of use: {len(good)} valid, {estimated} with a doubtful estimate; of no use: {unused}")
    logs = grouped(results, lambda r: r.log or "")
    for log, of in logs.items() if len(logs) > 1 else ():
        lines.append(f"  {log}: {len(of)} windows, {sum(r.status is Status.VALID for r in of)} valid")
    for (status, reason), group in by_reason(results):
        lines.append(f"  {len(group):5d} {status}" + ("" if reason == "none" else f": {reason}"))
        if what := advice(group, good):
            lines.append(f"        {what}")
    if good:
        bearing = np.median([r.bearing.value for r in good if r.bearing])
        std = np.median([r.bearing.std for r in good if r.bearing])
        lines.append(f"bearing pressure {bearing / 1e3:.1f} +- {std / 1e3:.1f} kPa (medians of the valid windows)")
    if machine := machine_line(good):
        lines.append(machine)
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
    others = {name.removeprefix("lateness."): text for name, text in value.items() if name not in units}
    late = ", ".join(f"{name.replace('_', ' ')} by {text}" for name, text in others.items())
    return "of the machine: " + ", ".join(parts) + (f"; later than the torque: {late}" if late else "")


def why_of_no_use(results: Sequence[WindowResult], window: float) -> str:
    """Return one line on why no window, each `window` [s] long, has an estimate."""
    if not results:
        return f"no window could be made: no recording lasts the {window:g} s of a window"
    (status, reason), group = by_reason(results)[0]
    line = f"no window could be used: {len(group)} of {len(results)} are {status}: {reason}"
    what = advice(group, [])
    return f"{line} ({what})" if what else line


def by_reason(results: Sequence[WindowResult]) -> list[tuple[tuple[str, str], list[WindowResult]]]:
    """Return the windows by status and reason, the most frequent first."""
    groups = grouped(results, lambda r: (str(r.status), r.reason))
    return sorted(groups.items(), key=lambda item: -len(item[1]))


def counted(counts: Counter[str]) -> str:
    """Return counts as in "outlier 3, stale 1", the most frequent first; "none" without any."""
    return ", ".join(f"{name} {n}" for name, n in counts.most_common()) or "none"


def advice(windows: Sequence[WindowResult], valid: Sequence[WindowResult]) -> str:
    """Return one line on windows of one status and reason beside the valid ones of the run; "" without advice."""
    reason = windows[0].reason
    kind, *names = reason.split()
    if said := ADVICE.get(reason) or ADVICE.get(kind):
        return said.format(", ".join(name for name in names if not name.startswith("(")))
    if kind == "input_missing":
        silent = ", ".join(name for name in names if name != "wheels")
        came = f"no usable value of {silent} ever came: check the mapping, and that this bus carries it"
        wheels = "no wheel that drives has a torque and a speed mapped, its own or its axle's"
        return "; ".join([came] * bool(silent) + [wheels] * ("wheels" in names))
    if kind == "not_excited":
        here, there = _draft(windows), _draft(valid)
        if here is None or there is None:
            return f"vary the load more: {_moved(windows)}"
        if here[1] < there[1]:
            return f"vary the load: {_moved(windows, ' only')}; in the valid windows {_moved(valid)}"
        return f"vary the load for longer on one ground: {_moved(windows)}, as much as in the valid windows"
    if kind == "no_convergence":
        return f"no soil explains these data ({_moved(windows)}): check signs and scales; else {DIAGNOSE}"
    if kind != "model_mismatch":
        return ""
    said = f"check mass, radii, gear ratios, signs, slope and [noise]; else {DIAGNOSE}"
    if what := ", ".join(names):
        said = f"{what} is mapped for several wheels: if it is the cell of one, map it for that one alone; or {said}"
    channels = sorted({name for w in windows for name in w.prediction_error})
    shares = {c: float(np.median([w.prediction_error.get(c, 0.0) for w in windows])) for c in channels}
    worst = max(shares, key=shares.__getitem__, default=None)
    return said if worst is None else f"the model predicts {worst} {100.0 * shares[worst]:.0f} % off: {said}"


def _moved(windows: Sequence[WindowResult], only: str = "") -> str:
    """How much draft and slip vary within a window (standard deviations), as medians of the windows."""
    draft, slip = _draft(windows), _typical([(w.excitation.slip, w.excitation.slip_sd) for w in windows])
    said = []
    if draft is not None:
        mean, sd = draft
        newtons = f"{mean:.0f} ± {sd:.0f} N"
        moved = f"moved by {100.0 * sd / abs(mean):.2g} %{only} ({newtons})" if abs(mean) > sd else f"was {newtons}"
        said.append(f"the draft {moved}")
    if slip is not None:
        said.append("slip was {:.1f} ± {:.1f} %".format(*(100.0 * of for of in slip)))
    return ", ".join(said) or "draft and slip are not known"


def _draft(windows: Sequence[WindowResult]) -> tuple[float, float] | None:
    """Of what is towed; None where nothing ever is."""
    drafts = [(w.excitation.draft, w.excitation.draft_sd) for w in windows]
    return None if all(draft == (0.0, 0.0) for draft in drafts) else _typical(drafts)


def _typical(of: Sequence[tuple[float | None, float | None]]) -> tuple[float, float] | None:
    """Medians of known means and standard deviations."""
    known = [(mean, sd) for mean, sd in of if mean is not None and sd is not None]
    if not known:
        return None
    mean, sd = np.median(known, axis=0).tolist()
    return mean, sd


def of_use(windows: Sequence[WindowResult]) -> list[WindowResult]:
    """Return the windows with an estimate of the soil, of any status."""
    return [window for window in windows if window.status is not Status.INVALID and window.posterior is not None]
