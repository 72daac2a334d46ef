"""A diagnosis as a self-contained HTML page; needs matplotlib (extra: plots)."""

from __future__ import annotations

import html
from collections.abc import Iterator
from typing import Any

import numpy as np

from soilbus.arrays import Array
from soilbus.diagnosis.fitted_model import FittedModel
from soilbus.diagnosis.verdict import FALL_REQUIRED_ALONE, FALL_REQUIRED_BESIDE
from soilbus.offline.diagnose import Findings
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
from soilbus.report.page import html_table, page, picture
from soilbus.report.statement import doubt, shown_lines, statement, why_probabilities

REGRESSORS = ("slip", "load of a wheel, kN", "time, s")
"""Columns of the pictures."""
MAX_POINTS = 3000
"""Residuals of a channel that a picture shows; the means are of all."""
BINS = 12
"""Equally filled bins of a picture's means."""
PLOT_RANGE_SD = 5.0
"""Standard deviations that a picture shows."""


def diagnosis_report(findings: Findings) -> str:
    """The whole page: verdict, effects, candidates, places, residuals and soil before and after."""
    diagnosis = findings.diagnosis
    return page(
        "soilbus diagnose",
        ", ".join(record.name for record in findings.recordings.records),
        f"<p><b>{diagnosis.verdict}</b>: {html.escape(statement(diagnosis))}</p>",
        *(f"<p>{html.escape(line)}</p>" for line in filter(None, [doubt(diagnosis)])),
        f"<p>{html.escape(gap_line(findings))}</p>",
        *(f"<p>{html.escape(line)}</p>" for line in shown_lines(diagnosis, findings.config)),
        *_effects(findings),
        *_candidates(findings),
        "<h2>Where model and data disagreed</h2>",
        _places(findings),
        "<h2>Residuals of the held-out blocks</h2>",
        "<p>Each residual given the others of its instant, in standard deviations of the whole noise. "
        f"Lines: means over {BINS} equally filled bins; where nothing is missing they stay near 0.</p>",
        *_pictures(findings),
        *_residual_terms(findings),
        "<h2>Soil</h2>",
        *_soils(findings),
        f"<p>{html.escape(admission_line(findings))}</p>",
    )


def _effects(findings: Findings) -> Iterator[str]:
    for number, addition in enumerate(findings.diagnosis.additions, 1):
        lines = effect_lines(number, addition, findings.diagnosis.completed)
        source = f"   source: {addition.effect.source}"
        yield f"<pre>{html.escape(chr(10).join([*lines, source]))}</pre>"


def _candidates(findings: Findings) -> Iterator[str]:
    """A table for each round that added an effect."""
    for number, addition in enumerate(findings.diagnosis.additions, 1):
        chances = {addition.effect.name: addition.probability} | addition.alternatives
        rows = [
            (name, f"{fall:.1f}", f"{chances[name]:.3f}" if name in chances else "-")
            for name, fall in sorted(addition.falls.items(), key=lambda item: -item[1])
        ]
        yield f"<h2>Candidates for effect {number}</h2>"
        yield html_table(("effect", "fall of -2 log evidence", "probability"), rows)
        why = why_probabilities(addition)
        least = FALL_REQUIRED_BESIDE if addition.beside else FALL_REQUIRED_ALONE
        yield f"<p>An effect is added from a fall of {least:g} on." + (f" {html.escape(why)}.</p>" if why else "</p>")


def _places(findings: Findings) -> str:
    where = findings.diagnosis.where
    if not where:
        return f"<p>{html.escape(place_lines(findings)[0])}</p>"
    rows = [(p.channel, p.wheel or "-", p.region, size_text(p), chance_text(p.significance)) for p in where]
    return html_table(("channel", "wheel", "region", "size", "chance that noise does it"), rows)


def _residual_terms(findings: Findings) -> Iterator[str]:
    if findings.diagnosis.residual_terms:
        yield "<h2>What is left, described</h2>"
        yield f"<pre>{html.escape(chr(10).join(residual_lines(findings.diagnosis.residual_terms)))}</pre>"


def _soils(findings: Findings) -> Iterator[str]:
    for name, before, after in findings.soils():
        yield f"<h3>{html.escape(name)}</h3>"
        yield html_table(("", "before", "after"), soil_rows(before, after, findings.config))


def _pictures(findings: Findings) -> Iterator[str]:
    base, completed = findings.diagnosis.base, findings.diagnosis.completed
    before, after = findings.diagnosis.gap_before, findings.diagnosis.gap_after
    yield picture(_residuals(base, f"before: gap {before.value:.3f}"), "residuals before")
    if completed is not base:
        yield picture(_residuals(completed, f"after: gap {after.value:.3f}"), "residuals after")


def _residuals(fitted: FittedModel, title: str) -> Any:
    """Standardised residuals by channel (rows) over slip, load and time (columns); a colour for each wheel."""
    from matplotlib.figure import Figure

    clouds = _clouds(fitted)
    figure = Figure(figsize=(10, 2.4 * len(clouds)), layout="constrained")
    figure.suptitle(title)
    axes: Any = figure.subplots(len(clouds), len(REGRESSORS), sharey=True, sharex="col", squeeze=False)
    for row, (channel, of_wheels) in zip(axes, clouds.items(), strict=True):
        for wheel, table in of_wheels.items():
            for i, axis in enumerate(row):
                _cloud(axis, table[:, i], table[:, -1], wheel)
        row[0].set_ylabel(f"{channel}, σ")
        row[0].set_ylim(-PLOT_RANGE_SD, PLOT_RANGE_SD)
        if len(of_wheels) > 1:
            row[-1].legend(ncols=4, fontsize="x-small")
    for axis, name in zip(axes[-1], REGRESSORS, strict=True):
        axis.set_xlabel(name)
    return figure


def _cloud(axis: Any, x: Array, z: Array, label: str) -> None:
    step = max(len(x) // MAX_POINTS, 1)
    colour = axis.plot(x[::step], z[::step], ".", ms=2, alpha=0.3)[0].get_color()
    parts = np.array_split(np.argsort(x, kind="stable"), BINS)
    means = np.array([(x[part].mean(), z[part].mean()) for part in parts if len(part)]).reshape(-1, 2)
    axis.plot(*means.T, "-", color=colour, label=label)
    axis.axhline(0.0, color="grey", lw=0.5)


def _clouds(fitted: FittedModel) -> dict[str, dict[str, Array]]:
    """Columns slip, load [kN], time [s], residual (M, 4) of the held-out blocks by channel and wheel."""
    found: dict[str, dict[str, list[Array]]] = {}
    for check, fit in zip(fitted.checks, fitted.fits, strict=True):
        problem, latents = check.problem, check.latents
        z, _ = problem.standardised(check.at, fit.gains)
        slip = 1.0 - latents.ground_speed[:, None] / (problem.rig.radius * latents.speed)
        wheels = list(problem.rig.wheels)
        for i, (channel, wheel) in enumerate(problem.row_channels):
            one = wheels.index(wheel) if wheel else None
            of_slip, of_load = (
                (slip.mean(1), latents.load.mean(1)) if one is None else (slip[:, one], latents.load[:, one])
            )
            table = np.column_stack([of_slip, of_load / 1e3, problem.since, z[:, i]])[np.isfinite(z[:, i])]
            found.setdefault(channel, {}).setdefault(wheel, []).append(table)
    tables = {c: {w: np.concatenate(t) for w, t in of_wheels.items()} for c, of_wheels in found.items()}
    return {c: known for c, of_wheels in tables.items() if (known := {w: t for w, t in of_wheels.items() if len(t)})}
