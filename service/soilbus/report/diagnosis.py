"""A diagnosis as a self-contained HTML page; needs jinja2 and matplotlib (extra: plots)."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from soilbus.diagnosis.verdict import Verdict
from soilbus.offline.diagnose import Findings
from soilbus.report.diagnosis_pictures import agreement_pictures, agreements, draft_picture, gap_picture
from soilbus.report.findings import findings_text, hope_of
from soilbus.report.page import Source, Step, page
from soilbus.report.statement import doubt, headline, plain_gap, statement, to_tell_apart


def diagnosis_report(findings: Findings, source: Source, model_out: Path | None = None) -> str:
    """Return the whole page: verdict and pictures first, then what to do next, and all findings folded away.

    `model_out` is where the completed model was written to.
    """
    diagnosis = findings.diagnosis
    added = diagnosis.completed is not diagnosis.base
    channels = agreements(diagnosis.base, diagnosis.completed)
    pictures = [pair for channel in channels for pair in agreement_pictures(channel, added)]
    gaps = gap_picture(diagnosis.base, diagnosis.completed)
    sums = [("How far each channel is from the model: 1 is as near as the sensors’ noise allows.", gaps)]
    if (drafts := draft_picture(findings)) is not None:
        sums.append(("Largest steady draft on the level, by the soil of each recording.", drafts))
    lead = f"{diagnosis.verdict}: {statement(diagnosis)}. {plain_gap(diagnosis)} {_consequence(findings)}"
    by_channel = (
        "Each reading beside what the model makes of the other sensors’ readings. Only readings that the model was not"
        " fitted to are shown. Below: measured less modelled, with means as lines; where nothing is missing they stay"
        " near 0."
    )
    return page(
        "report.html",
        source,
        command="diagnose",
        headline=headline(diagnosis),
        paragraphs=[lead, *filter(None, [doubt(diagnosis)])],
        pair=pictures[:2] if added else [*pictures[:1], *sums[:1]],
        sections=[
            ("What it changes" if added else "What the tractor can pull", "", sums if added else sums[1:]),
            ("Channel by channel", by_channel, pictures[2 if added else 1 :]),
        ],
        steps=list(_steps(findings, source, model_out)),
        details="All findings: places, effects, residuals, soil, samples",
        text=findings_text(findings),
    )


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


def _steps(findings: Findings, source: Source, model_out: Path | None) -> Iterator[Step]:
    """What to do next."""
    diagnosis = findings.diagnosis
    if diagnosis.additions and model_out is None:
        command = f"{source.command('diagnose')} --model-out new.toml"
        yield Step("Write a configuration that has what was found:", command)
    if diagnosis.additions:
        command = f"{source.command('replay', model_out or 'new.toml')} --report replay.html"
        yield Step("See what the service makes of the recording with it:", command)
    if diagnosis.verdict is Verdict.UNKNOWN:
        yield Step("Check mass, radii, gear ratios, signs and mounting of the channels that disagree most.")
    if diagnosis.verdict is Verdict.NONE:
        what = "Nothing is to be added. Smaller effects show in longer recordings that vary the load more."
        if diagnosis.gap_after.exceeds_noise():
            what = "Compare the noise that the configuration states with that of the sensors; measure wheel loads."
        yield Step(what)
    for sentence, lines in to_tell_apart(diagnosis):
        yield Step(sentence, lines=lines)
    if findings.plan is not None:
        command = f"{source.command('diagnose')} --manoeuvre-out drive.json"
        sentence = f"Drive for {findings.plan.manoeuvre.duration:.0f} s what decides between these best:"
        yield Step(sentence, command, [findings.plan.manoeuvre.words, hope_of(findings.plan)])
    if not any(check.problem.with_sinkage for check in diagnosis.base.checks) and source.config.table is None:
        yield Step("Map a sinkage sensor (wheel.sinkage) if there is one: it tells many effects apart.")
