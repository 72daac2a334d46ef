"""A diagnosis as a self-contained HTML page; needs jinja2 and matplotlib (extra: plots)."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from soilbus.diagnosis.verdict import FALL_OF_NONE, Verdict
from soilbus.offline.diagnose import Findings
from soilbus.report.diagnosis_pictures import (
    BINS,
    agreement_pictures,
    agreements,
    draft_picture,
    gap_picture,
    residual_picture,
)
from soilbus.report.findings import (
    admission_line,
    chance_text,
    effect_lines,
    gap_line,
    place_lines,
    residual_lines,
    size_text,
    soil_rows,
)
from soilbus.report.next_drive import hope_of
from soilbus.report.page import Picture, Source, Table, page
from soilbus.report.statement import (
    doubt,
    headline,
    is_open,
    plain_gap,
    shown_lines,
    statement,
    to_tell_apart,
    why_probabilities,
)


def diagnosis_report(findings: Findings, source: Source, model_out: Path | None = None) -> str:
    """The whole page: verdict and pictures first, then soil, what to do next, and the statistics folded away.

    Parameters
    ----------
    findings
        The diagnosis.
    source
        Configuration and logs.
    model_out
        Where the completed model was written to; None where it was not.
    """
    diagnosis = findings.diagnosis
    added = diagnosis.completed is not diagnosis.base
    channels = agreements(diagnosis.base, diagnosis.completed)
    pictures = [pair for channel in channels for pair in agreement_pictures(channel, added)]
    sums = list(_sums(findings))
    lead = 2 if added else 1
    return page(
        "diagnosis.html",
        source,
        verdict=str(diagnosis.verdict),
        headline=headline(diagnosis),
        statement=statement(diagnosis),
        doubt=doubt(diagnosis),
        consequence=_consequence(findings),
        plain_gap=plain_gap(diagnosis),
        pair=pictures[:2] if added else [*pictures[:1], *sums[:1]],
        added=added,
        sums=sums if added else sums[1:],
        pictures=pictures[lead:],
        effects=list(_effects(findings)),
        shown=list(shown_lines(diagnosis, findings.config)),
        steps=list(_steps(findings, source, model_out)),
        soils=list(_soils(findings)),
        gap_line=gap_line(findings),
        candidates=list(_candidates(findings)),
        places=_places(findings),
        no_places=place_lines(findings)[0],
        residual_terms="\n".join(residual_lines(diagnosis.residual_terms)) if diagnosis.residual_terms else "",
        residuals=_residuals(findings),
        bins=BINS,
        admission=admission_line(findings),
    )


def _sums(findings: Findings) -> Iterator[tuple[str, Picture]]:
    """Caption and picture of the gaps, and of the largest draft."""
    diagnosis = findings.diagnosis
    gaps = gap_picture(diagnosis.base, diagnosis.completed)
    yield "How far each channel is from the model: 1 is as near as the sensors’ noise allows.", gaps
    drafts = draft_picture(findings)
    if drafts is not None:
        yield "Largest steady draft on the level, by the soil of each recording.", drafts


def _consequence(findings: Findings) -> str:
    """What the effects change of the soil and the largest draft of the first recording."""
    if findings.diagnosis.completed is findings.diagnosis.base:
        return ""
    settings = findings.config.estimator
    name, before, after = findings.soils()[0]
    pressures = [p.bearing_pressure(settings.z_ref, settings.b_ref).value / 1e3 for p in (before, after)]
    of = f" of {name}" if len(findings.soils()) > 1 else ""
    it = "it" if len(findings.diagnosis.additions) == 1 else "them"
    text = f"With {it} the bearing pressure{of} is {pressures[1]:.3g} kPa, not {pressures[0]:.3g}"
    _, draft_before, draft_after = findings.largest_drafts()[0]
    if draft_before is not None and draft_after is not None:
        text += f"; the largest draft {draft_after.value / 1e3:.2f} kN, not {draft_before.value / 1e3:.2f}"
    return text + "."


def _soils(findings: Findings) -> Iterator[tuple[str, Table]]:
    """Name and table of each recording's soil: before and after, or one column where nothing was added."""
    added = findings.diagnosis.completed is not findings.diagnosis.base
    head = ("", "before", "after") if added else ("", "value")
    for name, before, after in findings.soils():
        rows = soil_rows(before, after, findings.config)
        yield name, Table(head, [[cell.replace("+-", "±") for cell in row[: len(head)]] for row in rows])


def _effects(findings: Findings) -> Iterator[dict[str, Any]]:
    """Name, physics, how sure, and all figures of each effect added."""
    for number, addition in enumerate(findings.diagnosis.additions, 1):
        others = ", ".join(f"{name} {_per_cent(p)}" for name, p in addition.alternatives.items())
        lines = effect_lines(number, addition, findings.diagnosis.completed)
        yield {
            "name": addition.effect.name,
            "physics": addition.effect.physics,
            "sure": _per_cent(addition.probability) + (f"; else {others}" if others else ""),
            "lines": "\n".join([*lines, f"   source: {addition.effect.source}"]),
        }


def _per_cent(probability: float) -> str:
    return "over 99 %" if probability > 0.99 else f"{100.0 * probability:.0f} %"


def _steps(findings: Findings, source: Source, model_out: Path | None) -> Iterator[tuple[str, str, list[str]]]:
    """What to do next: a sentence, a command that does it or nothing, and more lines."""
    diagnosis = findings.diagnosis
    if diagnosis.additions and model_out is None:
        yield "Write a configuration that has what was found:", f"{source.command('diagnose')} --model-out new.toml", []
    if diagnosis.additions:
        file = "new.toml" if model_out is None else str(model_out)
        command = f"{source.command('replay', file)} --report replay.html"
        yield "See what the service makes of the recording with it:", command, []
    if diagnosis.verdict is Verdict.UNKNOWN:
        yield "Check mass, radii, gear ratios, signs and mounting of the channels that disagree most.", "", []
    if diagnosis.verdict is Verdict.NONE and is_open(diagnosis):
        yield "Compare the noise that the configuration states with that of the sensors; measure wheel loads.", "", []
    elif diagnosis.verdict is Verdict.NONE:
        yield "Nothing is to be added. Smaller effects show in longer recordings that vary the load more.", "", []
    for sentence, lines in to_tell_apart(diagnosis):
        yield sentence, "", lines
    if findings.plan is not None:
        command = f"{source.command('diagnose')} --manoeuvre-out drive.json"
        sentence = f"Drive for {findings.plan.manoeuvre.duration:.0f} s what decides between these best:"
        yield sentence, command, [findings.plan.manoeuvre.words, hope_of(findings.plan)]
    if not any(check.problem.with_sinkage for check in diagnosis.base.checks) and source.config.table is None:
        yield "Map a sinkage sensor (wheel.sinkage) if there is one: it tells many effects apart.", "", []


def _candidates(findings: Findings) -> Iterator[tuple[int, Table, str]]:
    """Number, table and words of each round that added an effect."""
    for number, addition in enumerate(findings.diagnosis.additions, 1):
        chances = {addition.effect.name: addition.probability} | addition.alternatives
        rows = [
            (name, f"{fall:.1f}", f"{chances[name]:.3f}" if name in chances else "-")
            for name, fall in sorted(addition.falls.items(), key=lambda item: -item[1])
        ]
        why = why_probabilities(addition)
        words = f"An effect is added from a fall of {FALL_OF_NONE:.0f} on, where the blocks agree." + (
            f" {why}." if why else ""
        )
        yield (
            number,
            Table(("effect", "fall of -2 log predictive likelihood", "probability"), rows, frozenset({1, 2})),
            words,
        )


def _places(findings: Findings) -> Table | None:
    rows = [
        (p.channel, p.wheel or "-", p.region, size_text(p), chance_text(p.significance), p.log or "-")
        for p in findings.diagnosis.where
    ]
    return Table(("channel", "wheel", "region", "size", "chance that noise does it", "log"), rows) if rows else None


def _residuals(findings: Findings) -> list[Picture]:
    diagnosis = findings.diagnosis
    shown = [residual_picture(diagnosis.base, f"before: gap {diagnosis.gap_before.value:.3f}")]
    if diagnosis.completed is not diagnosis.base:
        shown.append(residual_picture(diagnosis.completed, f"after: gap {diagnosis.gap_after.value:.3f}"))
    return shown
