"""A diagnosis as `soilbus diagnose` prints it: JSON (keys: docs/json.md) and text, which say the same.

The sentences are made in `statement`.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from typing import Any

from soilbus.config.model import Config
from soilbus.diagnosis.detectable import Detectable
from soilbus.diagnosis.diagnose import Diagnosis
from soilbus.diagnosis.fitted_model import FittedModel
from soilbus.diagnosis.residual_terms import WARNING, ResidualTerms
from soilbus.diagnosis.search import Addition
from soilbus.diagnosis.where import Disagreement
from soilbus.estimation.posterior import Posterior
from soilbus.offline.diagnose import Findings
from soilbus.offline.manoeuvre import MAX_REPEATS, Plan
from soilbus.pipeline.outputs import PARAMETER_FRAMES, known, value_std, values_std
from soilbus.report.statement import (
    doubt,
    no_places,
    same_push,
    shown_lines,
    statement,
    tells,
    unseen_errors,
    why_probabilities,
)
from soilbus.report.table import AT_EDGE, table, value_text
from soilbus.simulator.manoeuvre import Manoeuvre
from soilbus.terra.effects.catalogue import CATALOGUE
from soilbus.terra.effects.effect import Effect
from soilbus.words import text_of

MAX_PLACES = 8
"""Places of disagreement that the text lists."""
PLACE = ("channel", "wheel", "region", "size", "significance", "log")
"""What JSON says of a place of disagreement."""
UNITS = {"torque": "N m", "draft": "N", "sinkage": "m"}
"""Unit of each channel's residuals."""


def findings_json(findings: Findings) -> str:
    """All findings as one JSON object (docs/json.md), with null for numbers that are not finite."""
    return json.dumps(findings_record(findings), indent=1, allow_nan=False) + "\n"


def findings_record(findings: Findings) -> dict[str, Any]:
    """The same as nested dicts and lists, None for numbers that are not finite."""
    diagnosis, recordings, after = findings.diagnosis, findings.recordings, findings.diagnosis.gap_after
    models = {"before": diagnosis.base, "after": diagnosis.completed}
    gap = {"before": diagnosis.gap_before.value, "after": after.value, "noise_floor": 1.0, "limit": after.limit()}
    soils = [
        {"log": name, "before": _soil(b, findings), "after": _soil(a, findings)} for name, b, a in findings.soils()
    ]
    document = {
        "verdict": str(diagnosis.verdict),
        "sentence": statement(diagnosis),
        "doubt": doubt(diagnosis),
        "where": [{name: getattr(place, name) for name in PLACE} for place in diagnosis.where],
        "effects": [_effect(addition, diagnosis.completed) for addition in diagnosis.additions],
        "gap": {**gap, "residuals": after.rows, "open": after.exceeds_noise()},
        "solver": {when: [str(fit.termination) for fit in model.fits] for when, model in models.items()},
        **_shown(findings),
        "soil_before": soils[0]["before"],
        "soil_after": soils[0]["after"],
        "soils": soils,
        "configured": {name: values_std(values) for name, values in diagnosis.base.prior_parameters().items()},
        "model": {name: values_std(values) for name, values in diagnosis.completed.parameters().items()},
        "manoeuvre": None if findings.plan is None else findings.plan.as_json(),
        "learned": [
            {
                **{name: getattr(description, name) for name in ("channel", "wheel", "formula", "explained")},
                "terms": {term.regressor: term.coefficient for term in description.terms},
            }
            for description in diagnosis.residual_terms
        ],
        "warning": WARNING if diagnosis.residual_terms else None,
        "samples": recordings.samples,
        "rejected": recordings.rejected,
        "too_short": list(recordings.too_short),
        "seconds": round(findings.seconds, 3),
    }
    return dict(known(document))


def _shown(findings: Findings) -> dict[str, Any]:
    """What the recordings could have shown, from which size on, and what not; null unless the verdict is `none`."""
    diagnosis = findings.diagnosis
    if not diagnosis.detectable:
        return {"could_show": None, "could_not_show": None, "unseen": None}

    def of(found: Detectable, **more: Any) -> dict[str, Any]:
        return {"name": found.effect.name, "parameter": found.parameter.name, "unit": found.parameter.unit, **more}

    return {
        "could_show": [of(found, size=found.size) for found in diagnosis.detectable if found.size is not None],
        "could_not_show": [found.effect.name for found in diagnosis.detectable if found.size is None],
        "unseen": [
            of(found, size=found.unseen, bearing_pressure_error=error, bearing_pressure_std=std)
            for found, error, std in unseen_errors(diagnosis, findings.config)
        ],
    }


def _effect(addition: Addition, completed: FittedModel) -> dict[str, Any]:
    effect = addition.effect
    return {
        "name": effect.name,
        "parameters": values_std(completed.parameters()[effect.name]),
        "probability": addition.probability,
        "alternatives": [{"name": name, "probability": p} for name, p in addition.alternatives.items()],
        "sentence": effect.physics,
        "source": effect.source,
        "why_ambiguous": why_ambiguous(addition),
        "why_probabilities": why_probabilities(addition),
        "ruled_out": effect.ruled_out or None,
        "same_as": same_push(addition, completed),
        "tells": {name: CATALOGUE[name].tells for name in (effect.name, *addition.alternatives)},
        "evidence": dict(sorted(addition.falls.items(), key=lambda item: -item[1])),
    }


def why_ambiguous(addition: Addition) -> str | None:
    """Why the alternatives of an effect stay in the set; None where it has none."""
    if not addition.alternatives:
        return None
    best = addition.falls[addition.effect.name]
    others = ", ".join(f"{name} by {addition.falls[name]:.0f}" for name in addition.alternatives)
    lowers = f"{addition.effect.name} lowers -2 log evidence by {best:.0f}, {others}"
    return f"{lowers}: in this recording they change torque, draft and sinkage alike"


def _soil(posterior: Posterior, findings: Findings) -> dict[str, Any]:
    settings = findings.config.estimator
    plate = {"z_ref": settings.z_ref, "b_ref": settings.b_ref}
    bearing = plate | value_std(posterior.bearing_pressure(settings.z_ref, settings.b_ref))
    return {**values_std(posterior.parameters()), "bearing_pressure": bearing}


def findings_text(findings: Findings) -> str:
    """All findings for a reader at a terminal."""
    diagnosis = findings.diagnosis
    before, after = diagnosis.gap_before, diagnosis.gap_after
    lines = [f"{diagnosis.verdict}: {statement(diagnosis)}", *filter(None, [doubt(diagnosis)]), ""]
    gap = f"gap {before.value:.3f} -> {after.value:.3f} (reduced chi-square of {after.rows} held-out residuals"
    lines.append(f"{gap}; noise alone: 1, hardly ever above {after.limit():.2f})")
    lines += [f"  {line}" for line in place_lines(findings)]
    lines += [*configured_lines(diagnosis), *shown_lines(diagnosis, findings.config)]
    for number, addition in enumerate(diagnosis.additions, 1):
        lines += ["", *effect_lines(number, addition, diagnosis.completed)]
    if findings.plan is not None:
        lines += ["", *plan_lines(findings.plan)]
    if diagnosis.residual_terms:
        lines += ["", "what is left, described:"]
        for terms in diagnosis.residual_terms:
            formula = f"{_channel(terms)}: reading less model = {terms.formula} [{UNITS[terms.channel]}]"
            lines.append(f"  {formula} ({100 * terms.explained:.0f} % of the held-out excess)")
        lines.append(f"  {WARNING}")
    recordings = findings.recordings
    refused = ", ".join(f"{reason} {n}" for reason, n in recordings.rejected.items()) or "none"
    short = f"; too short to use: {', '.join(recordings.too_short)}" if recordings.too_short else ""
    logs = "one log" if len(recordings.first) == 1 else f"{len(recordings.first)} logs"
    used = f"{recordings.samples} samples of {logs}; refused samples: {refused}{short}"
    return text_of([*lines, "", *_soil_lines(findings), "", used])


def place_lines(findings: Findings) -> list[str]:
    """The places of disagreement, the clearest first."""
    where = findings.diagnosis.where
    if not where:
        return [no_places(findings.diagnosis)]
    has_several = len(findings.diagnosis.base.fits) > 1
    shown = [
        f"{f'{p.log}: ' if has_several and p.log else ''}{_channel(p)}, {p.region}: {_size_text(p)} "
        f"(chance {f'{p.significance:.0e}' if p.significance > 0.0 else '< 1e-300'})"
        for p in where[:MAX_PLACES]
    ]
    left = len(where) - len(shown)
    return [*shown, f"and {left} more"] if left else shown


def _channel(place: Disagreement | ResidualTerms) -> str:
    return f"{place.channel}.{place.wheel}" if place.wheel else place.channel


def _size_text(place: Disagreement) -> str:
    if place.region == "scatter":
        return f"residuals {place.size:.2f} times the noise"
    if place.region == "gain":
        return f"an implausible gain error of {100 * place.size:+.2f} %"
    if place.region.startswith("parameter "):
        unit = _unit_of(place.region.removeprefix("parameter "), CATALOGUE[place.channel])
        return f"fitted less configured {place.size:+.3g}{unit}"
    return f"reading less model {place.size:+.3g} {UNITS.get(place.channel, '')}".rstrip()


def effect_lines(number: int, addition: Addition, completed: FittedModel) -> list[str]:
    """One effect: its physics, parameters, alternatives, and what would distinguish it from these."""
    effect = addition.effect
    lines = [f"{number}. {effect.name}, probability {addition.probability:.2f}", f"   {effect.physics}"]
    for name, estimate in completed.parameters()[effect.name].items():
        lines.append(f"   {name} = {value_text(estimate.value, estimate.std, AT_EDGE)}{_unit_of(name, effect)}")
    if same := same_push(addition, completed):
        lines.append(f"   {same}")
    if addition.alternatives:
        others = ", ".join(f"{name} {p:.2f}" for name, p in addition.alternatives.items())
        lines += [f"   or: {others}", f"   {why_ambiguous(addition)}", f"   {why_probabilities(addition)}"]
        lines += ["   what would tell them apart:"]
        lines += [f"   - {line}" for line in tells([effect.name, *addition.alternatives])]
    return lines


def _unit_of(name: str, effect: Effect) -> str:
    """The unit of a parameter, or of a wheel's own, to be written after its value."""
    units = {parameter.name: parameter.unit for parameter in effect.parameters}
    unit = units.get(name) or units[name.rpartition("_")[0]]
    return "" if unit == "1" else f" {unit}"


def configured_lines(diagnosis: Diagnosis) -> Iterator[str]:
    """The effects that the configuration gives and a fit moves: values there and as fitted."""
    fitted = diagnosis.completed.parameters()
    for effect in diagnosis.base.effects:
        priors = diagnosis.base.prior_parameters()[effect.name]
        found = []
        for name in [name for name, prior in priors.items() if prior.std > 0.0]:
            prior, one, unit = priors[name], fitted[effect.name][name], _unit_of(name, effect)
            given = f"{name} {value_text(prior.value, prior.std)}{unit}"
            found.append(f"{given}, fitted {value_text(one.value, one.std, AT_EDGE)}{unit}")
        if found:
            yield f"in the configuration, {effect.name}: {'; '.join(found)}"


def _soil_lines(findings: Findings) -> Iterator[str]:
    """Bearing pressure and soil parameters of each recording, value and std before and after."""
    settings, several = findings.config.estimator, len(findings.recordings.first) > 1
    for log, *both in findings.soils():
        rows: dict[str, list[str]] = {}
        for posterior in both:
            found = {"bearing pressure, kPa": (posterior.bearing_pressure(settings.z_ref, settings.b_ref), 1e3)}
            for name, estimate in posterior.parameters().items():
                _, unit, size = PARAMETER_FRAMES[name]
                found[f"{name}, {unit}".rstrip(", ")] = estimate, size
            for name, (of, size) in found.items():
                rows.setdefault(name, []).append(value_text(of.value / size, of.std / size))
        head = (f"soil of {log}" if several else "soil", "before", "after")
        yield from table(head, [(name, *texts) for name, texts in rows.items()]).splitlines()


def plan_lines(plan: Plan) -> list[str]:
    """Return what to drive next, and what it is expected to settle."""
    between, seconds = ", ".join(plan.between), plan.manoeuvre.duration
    head = f"what to drive next, to decide between {between} ({seconds:.0f} s; --manoeuvre-out keeps it):"
    return [head, f"  {plan.manoeuvre.words}", f"  {hope_of(plan)}"]


def hope_of(plan: Plan) -> str:
    """Return what a plan is expected to settle, and how often it must be driven."""
    if plan.repeats is None:
        return f"even {MAX_REPEATS} such drives are not expected to settle it: rather take one of the sensors above"
    times = "once" if plan.repeats == 1 else f"{plan.repeats} times"
    return f"driven {times} and diagnosed together with what there is, it is expected to settle the name"


def excitation_lines(manoeuvre: Manoeuvre, expected: Posterior, now: Posterior, config: Config) -> list[str]:
    """Return a manoeuvre, and the standard deviations of the soil that are expected after it."""
    z_ref, b_ref = config.estimator.z_ref, config.estimator.b_ref
    shares = []
    for posterior in (now, expected):
        pressure = posterior.bearing_pressure(z_ref, b_ref)
        shares.append((100.0 * pressure.std / pressure.value, math.degrees(posterior.parameters()["phi"].std)))
    (pressure_now, phi_now), (pressure_then, phi_then) = shares
    now_known = f"bearing pressure is known to +- {pressure_now:.2g} % and phi to +- {phi_now:.2g} deg"
    then = f"the sensors alone would then allow {pressure_then:.2g} % and {phi_then:.2g} deg"
    head = f"what to drive next ({manoeuvre.duration:.0f} s; --manoeuvre-out keeps it): {manoeuvre.words}"
    return [head, f"  {now_known}; {then}"]
