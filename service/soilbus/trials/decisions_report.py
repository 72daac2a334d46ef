"""Report of `soilbus decisions`: figures of the decision beside their targets, a section for each question."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from typing import NamedTuple

from scipy.special import gammaincinv

from soilbus.pipeline.outputs import known
from soilbus.report.table import table
from soilbus.trials.bogging_trials import (
    MIN_LEAD_DISTANCE,
    MIN_LEAD_TIME,
    PERCEPTIBLE_DRAFT_LOSS,
    REACTION_TIME,
    WarningFigures,
)
from soilbus.trials.draft_trials import SOIL_LOG_SD, DraftFigures
from soilbus.trials.firm_drives import EASY, HARD
from soilbus.trials.verdict_trials import Reliability

SHARED = """The drives are simulated with the estimator's own wheel-soil model, noise and priors about the true soil:
the figures show that numbers and intervals follow from the model, not that the model is the field's."""
MAX_ERROR = 0.05
"""Target of the median relative error of the largest draft."""
COVERAGE = (0.90, 0.98)
"""Target of the share of 95 % intervals that hold the truth."""


def decisions_report(drafts: Sequence[DraftFigures], calls: Reliability, warnings: Sequence[WarningFigures]) -> str:
    """Return all sections of the report."""
    sections = [*_draft_section(drafts), "", *_call_section(calls), "", *_warning_section(warnings), "", SHARED]
    return "\n".join(sections) + "\n"


def _call_section(found: Reliability) -> Iterator[str]:
    yield "Probability that the present demand and its margin can be met, beside how often it truly can"
    yield ""
    head = ("probability", "calls", "mean", "came true", "95 % interval", "")
    rows = [
        (
            f"{b.low:.1f} to {b.high:.1f}", str(b.calls), f"{b.mean:.3f}", f"{b.true:.3f}",
            f"{b.least:.3f} to {b.most:.3f}", "" if b.least <= b.mean <= b.most else "*",
        )
        for b in found.bins if b.calls
    ]  # fmt: skip
    yield table(head, rows)
    brier = f"Brier score {found.brier:.4f}, {found.brier_expected:.4f} +- {found.brier_std:.4f} if calibrated;"
    yield f"{found.drives} drives, {found.failed} without a call.  {brier}"
    yield f"outcomes less probabilities {found.excess:+.1f} standard deviations; go called {found.go} times, wrongly"
    yield f"{found.wrong_go} times, {found.wrong_go_expected:.2f} expected.  * marks a mean outside its interval."


def _warning_section(warnings: Sequence[WarningFigures]) -> Iterator[str]:
    least = f"{MIN_LEAD_TIME:g} s or {MIN_LEAD_DISTANCE:g} m"
    yield f"Warning of immobilisation at least {least} before slip passes its limit"
    yield ""
    head = ("boggings", "foreseeable", "in time", "median lead", "least", "too sudden", "warned after")
    rows = [
        (
            w.kind, str(w.boggings), str(w.warned), _seconds(w.lead), _seconds(w.least), str(w.sudden),
            _seconds(w.delay),
        )
        for w in warnings if w.boggings or w.sudden
    ]  # fmt: skip
    yield table(head, rows)
    yield "Target: all that can be predicted in time.  Too sudden: from where the ground has lost"
    lost = f"{100.0 * PERCEPTIBLE_DRAFT_LOSS:.0f} % of the largest draft"
    yield f"{lost}, slip passes in less than that and {REACTION_TIME:g} s to react."
    yield ""
    firm = [found for found in warnings if found.hours]
    false = [(f.kind, f"{f.hours:.2f}", str(f.false)) for f in firm]
    yield table(("without a bogging", "hours", "false warnings"), false)
    for name, of in _pooled(firm).items():
        rate = f"{of.rate:.2f} an hour (95 % interval {of.least:.2f} to {of.most:.2f})"
        yield f"{name.capitalize()} drives: {of.false} false in {of.hours:.2f} h, {rate}."
    yield "Target: at most one false warning an hour, on hard drives alone too.  All drives have even seeds: thresholds"
    yield "are set by those of odd seeds alone."


class _Pooled(NamedTuple):
    """False warnings of some kinds together; rate [1/h] and its 95 % interval."""

    hours: float
    false: int
    rate: float
    least: float
    most: float


def _pooled(firm: Sequence[WarningFigures]) -> dict[str, _Pooled]:
    """Easy and hard drives, of which there are any."""
    out = {}
    for name, kinds in {"easy": (EASY,), "hard": HARD}.items():
        hours, false = (sum(getattr(f, of) for f in firm if f.kind in kinds) for of in ("hours", "false"))
        if hours:
            least, most = poisson_interval(false)
            out[name] = _Pooled(hours, false, false / hours, least / hours, most / hours)
    return out


def poisson_interval(count: int) -> tuple[float, float]:
    """Return the 95 % interval of the expectation of a Poisson count (Garwood 1936, Biometrika 28:437)."""
    least = float(gammaincinv(count, 0.025)) if count else 0.0
    return least, float(gammaincinv(count + 1, 0.975))


def _seconds(value: float) -> str:
    return f"{value:.1f} s" if math.isfinite(value) else "-"


def _draft_section(drafts: Sequence[DraftFigures]) -> Iterator[str]:
    low, high = (100.0 * share for share in COVERAGE)
    yield "Largest draft on the level, predicted from one window"
    yield ""
    head = ("soil", "drives", "failed", "true", "|error|", "bias", "in 95 %")
    rows = [
        (
            d.soil, str(d.drives), str(d.failed), f"{d.true:.0f} N", f"{100.0 * d.error:.2f} %",
            f"{100.0 * d.bias:+.2f} %", f"{100.0 * d.coverage:.1f}",
        )
        for d in drafts
    ]  # fmt: skip
    yield table(head, rows)
    yield f"Medians; targets: error at most {100.0 * MAX_ERROR:.0f} %, {low:.0f} to {high:.0f} % of 95 % intervals hold"
    yield f"the truth.  Each drive's soil leaves the named one by {100.0 * SOIL_LOG_SD:.0f} % in every parameter."


def as_json(
    drafts: Sequence[DraftFigures], calls: Reliability, warnings: Sequence[WarningFigures]
) -> dict[str, object]:
    """Return the figures as plain objects; null for what is not a number."""
    return dict(known({
        "max_draft": [asdict(of_soil) for of_soil in drafts],
        "calls": asdict(calls),
        "immobilisation": {
            w.kind: {
                "boggings": w.boggings, "in_time": w.warned, "lead": w.lead, "least_lead": w.least,
                "sudden": w.sudden, "delay": w.delay, "hours": w.hours, "false": w.false,
            }
            for w in warnings
        },
        "false_warnings": {name: found._asdict() for name, found in _pooled(warnings).items()},
    }))  # fmt: skip
