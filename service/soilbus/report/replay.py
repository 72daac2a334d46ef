"""A replay as a self-contained HTML page; needs jinja2 and matplotlib (extra: plots)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np

from soilbus.arrays import Array
from soilbus.config.model import Config
from soilbus.decision.traversability import State, Status
from soilbus.pipeline.result import WindowResult
from soilbus.report.configuration import no_slope
from soilbus.report.page import Source, Step, page
from soilbus.report.replay_pictures import STATES, clock_text, pictures
from soilbus.report.windows import advice, by_reason, machine_line, of_use, why_of_no_use


def replay_report(results: Sequence[WindowResult], text: str, source: Source) -> str:
    """Return the whole page of a replay, with the text of its summary."""
    config, shown = source.config, list(pictures(results, source.config) if results else ())
    curves = "The strip above a curve is the decision. A curve is interrupted where a window gave no estimate"
    curves += "; its band is 95 % wide."
    return page(
        "replay.html",
        source,
        command="replay",
        headline=headline(results, config),
        paragraphs=[" ".join(sentences(results))],
        pair=shown[:2],
        sections=[("Soil and wheels", curves, shown[2:])],
        steps=list(next_steps(results, source)),
        config=config,
        details="Counts of windows, samples and refusals",
        text=text,
    )


def headline(results: Sequence[WindowResult], config: Config) -> str:
    """Return what the decisions come to, in one sentence."""
    known = of_use(results)
    if not known:
        text = why_of_no_use(results, config.estimator.window)
        return text[0].upper() + text[1:]
    states = Counter(r.traversability.state for r in results)
    if states[State.UNKNOWN] == len(results):
        what = "windows" if config.table is None else "runs"
        valid = sum(r.status is Status.VALID for r in results)
        if valid:
            return f"The soil is known in {valid} of {len(results)} {what}"
        (status, reason), group = by_reason(results)[0]
        of = f"{len(group)} are {status}: {reason}"
        return f"The soil is known in none of {len(results)} {what}, doubtful in {len(known)}; {of}"
    (name, n), *others = [(look.name, states[state]) for state, look in STATES.items() if states[state]]
    return ", ".join([f"{name} in {n} of {len(results)} windows", *(f"{name} in {n}" for name, n in others)])


def sentences(results: Sequence[WindowResult]) -> Iterator[str]:
    """Yield the soil and draft in numbers, in words of the field."""
    good = [r for r in results if r.status is Status.VALID]
    used, doubtful = (good, "") if good else (of_use(results), ", but no window is valid: doubtful")
    pressures = [(r.bearing.value / 1e3, r.bearing.std / 1e3) for r in used if r.bearing is not None]
    if pressures:
        value, std = np.array(pressures).T
        about = f"bearing pressure, in each window known to about ± {2.0 * float(np.median(std)):.2g} kPa{doubtful}"
        yield f"The ground carried {_range(value, 'kPa')} ({about})."
    drafts = [d.value / 1e3 for r in used if (d := r.traversability.max_draft) is not None]
    pulled = [r.excitation.draft / 1e3 for r in results if r.excitation.draft is not None]
    if drafts:
        of_windows = f"; the windows’ mean draft was {_range(pulled, 'kN')}" if pulled else ""
        yield f"The largest possible draft was {_range(drafts, 'kN')}{of_windows}."
    if machine := machine_line(results):
        yield f"{machine[0].upper()}{machine[1:]}."
    warnings = [t for r in results for t in r.warnings.begun]
    if warnings:
        times = {1: "once", 2: "twice"}.get(len(warnings), f"{len(warnings)} times")
        yield f"A warning that the vehicle may get stuck began {times}, first at {clock_text(warnings[0])}."


def _range(values: Sequence[float] | Array, unit: str) -> str:
    """Such as "22 to 99 kPa": from the 5 % to the 95 % quantile; one number where both are written alike."""
    low, high = (f"{float(f'{q:.2g}'):g}" if abs(q) < 99.5 else f"{q:.0f}" for q in np.percentile(values, (5.0, 95.0)))
    return f"{low} {unit}" if low == high else f"{low} to {high} {unit}"


def next_steps(results: Sequence[WindowResult], source: Source) -> Iterator[Step]:
    """Yield what to do about windows of no or little use, and what to map."""
    config = source.config
    good = [r for r in results if r.status is Status.VALID]
    for (status, reason), group in by_reason(results):
        if what := advice(group, good):
            why = reason.removeprefix(f"{status} ").replace("_", " ")
            yield Step(f"{len(group)} of {len(results)} windows were {str(status).replace('_', ' ')} ({why}): {what}.")
    if any(r.reason.split()[0] in ("model_mismatch", "no_convergence") for r in results):
        yield Step("Find what the model misses:", f"{source.command('diagnose')} --report diagnosis.html")
    if config.table is not None:
        return
    if line := no_slope(config):
        yield Step(f"{line[0].upper()}{line[1:]}.")
    if config.signals.latitude is None:
        yield Step("For a map of the route, map a position: signals.latitude and signals.longitude.")
    if not any(wheel.sinkage is not None for wheel in config.wheel):
        yield Step("A sinkage sensor (wheel.sinkage) narrows the error bars of the soil; none is mapped.")
