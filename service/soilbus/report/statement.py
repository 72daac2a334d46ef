"""A diagnosis in sentences, which text, page and JSON print alike.

Each depends on verdict, effects added, gap that remains and places of disagreement at once, so no two contradict.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from soilbus.config.model import Config
from soilbus.diagnosis.detectable import Detectable
from soilbus.diagnosis.diagnose import Diagnosis
from soilbus.diagnosis.fitted_model import FittedModel
from soilbus.diagnosis.options import DEFAULT
from soilbus.diagnosis.search import Addition
from soilbus.diagnosis.verdict import Verdict
from soilbus.estimation.posterior import Posterior, pressure_gradient
from soilbus.terra.effects.catalogue import CATALOGUE
from soilbus.terra.effects.vehicle import GRADE_BESIDE_PITCH
from soilbus.terra.vehicle import GRAVITY

MAX_UNSEEN = 3
"""Effects that may be there unseen that the text lists."""


def statement(diagnosis: Diagnosis) -> str:
    """One line: what was found, and whether a gap remains."""
    names = [addition.effect.name for addition in diagnosis.additions]
    text, gap = _found(diagnosis, names), diagnosis.gap_after
    if diagnosis.verdict is Verdict.UNKNOWN or not diagnosis.gap_after.exceeds_noise():
        return text
    left = "; something is left besides" if names else ""
    return f"{text}{left}: the gap of {gap.value:.2f} is above {gap.limit():.2f}"


def disagrees(diagnosis: Diagnosis) -> bool:
    """Whether something disagrees by more than noise: single places, or all together."""
    return bool(diagnosis.where) or diagnosis.gap_after.exceeds_noise()


def headline(diagnosis: Diagnosis) -> str:
    """The diagnosis in a few words: what is missing."""
    names = [_named(addition) for addition in diagnosis.additions]
    if diagnosis.verdict is Verdict.NONE:
        return "No effect is found missing" if disagrees(diagnosis) else "Model and data agree"
    if diagnosis.verdict is Verdict.UNKNOWN:
        what = "that no effect tried explains" if diagnosis.base.held else "that the catalogue does not have"
        return " and ".join([f"Missing: something {what}", *names])
    return f"Missing from the model: {' and '.join(names)}"


def _named(addition: Addition) -> str:
    """The name of an effect, or of the first of a set, as in "grade, lugs or one of 2 others"."""
    names = [addition.effect.name, *addition.alternatives]
    if addition.probability >= DEFAULT.named_probability or len(names) == 1:
        return names[0]
    *most, last = names if len(names) <= 3 else [*names[:2], f"one of {len(names) - 2} others"]
    return f"{', '.join(most)} or {last}"


def plain_gap(diagnosis: Diagnosis) -> str:
    """The gap before and after in words, as a multiple of the noise: the root of the reduced chi-square."""
    before, after = math.sqrt(diagnosis.gap_before.value), math.sqrt(diagnosis.gap_after.value)
    text = f"On readings that it was not fitted to, the model is off by {before:.2f} times the sensors’ noise"
    if diagnosis.additions:
        text += f", with {' and '.join(a.effect.name for a in diagnosis.additions)} by {after:.2f} times"
    return f"{text} (noise alone makes 1)."


def to_tell_apart(diagnosis: Diagnosis) -> Iterator[tuple[str, list[str]]]:
    """What to drive or measure next: a sentence, and a line for each effect."""
    sure = [addition.effect.name for addition in diagnosis.additions if not addition.alternatives]
    if sure:
        yield f"What would confirm {'it' if len(sure) == 1 else 'them'}:", tells(sure)
    for addition in diagnosis.additions:
        if addition.alternatives:
            yield "What would tell these apart:", tells([addition.effect.name, *addition.alternatives])
    if hidden := [found.effect.name for found in diagnosis.detectable if found.size is None]:
        yield "What these recordings could not show, and what would:", tells(hidden)


def tells(names: Iterable[str]) -> list[str]:
    """What shows each effect, a line for each."""
    return [f"{name}: {CATALOGUE[name].tells}" for name in names]


def _found(diagnosis: Diagnosis, names: Sequence[str]) -> str:
    verdict, several = diagnosis.verdict, len(names) > 1
    if verdict is Verdict.NONE:
        if disagrees(diagnosis):
            return "no effect explains enough to be added, though model and data disagree by more than noise"
        return "model and data agree: nothing is missing that these recordings could have shown"
    missing = "effects are missing" if several else "an effect is missing"
    if verdict is Verdict.NAMED:
        return f"{missing}, and the data tell which"
    if verdict is Verdict.AMBIGUOUS:
        return f"{missing}, and the data do not tell for sure which"
    none = "no effect that was tried" if diagnosis.base.held else "no effect of the catalogue"
    if not names:
        return f"something is missing that {none} explains"
    there = f"{', '.join(names[:-1])} and {names[-1]} are" if several else f"{names[0]} is"
    return f"{there} there, as far as the data tell, and more is missing that {none} explains"


def no_places(diagnosis: Diagnosis) -> str:
    """The sentence where no single place of disagreement stands out."""
    if diagnosis.additions or diagnosis.verdict is not Verdict.NONE:
        return "no single place stands out from noise: what is missing shows in all of them together"
    if diagnosis.gap_after.exceeds_noise():
        return "no single place stands out from noise: all of them together do"
    return "no channel disagrees with the model anywhere by more than noise"


def doubt(diagnosis: Diagnosis) -> str | None:
    """Why the finding is doubtful, or None."""
    found = []
    if not diagnosis.base.converged:  # it has too little evidence, so each effect seems to explain too much beside it
        what = "so evidence and names are a list of what to check, no finding"
        found.append(f"the fit of the present model did not converge, {what}")
    named = {addition.effect.name for addition in diagnosis.additions}
    limits = [f for f in diagnosis.completed.at_limits if f.effect in named]
    if limits:  # the formula may be bent to what the catalogue lacks
        which = ", ".join(sorted({f"{f.effect} ({f.parameter.name} {f.value:g})" for f in limits}))
        pushed = "where something that the catalogue lacks may push it"
        found.append(f"at the edge of what is possible, {pushed}: {which}")
    found += [text for text in (_imitation(diagnosis), _held(diagnosis)) if text is not None]
    return "to be doubted: " + "; ".join(found) if found else None


def _imitation(diagnosis: Diagnosis) -> str | None:
    if not diagnosis.imitation:
        return None
    shares = zip(diagnosis.additions, diagnosis.imitation, strict=True)
    alone = ", ".join(f"{addition.effect.name} {100.0 * share:.0f} %" for addition, share in shares)
    against = [f"{a.effect.name}: {a.effect.ruled_out}" for a in diagnosis.additions if a.effect.ruled_out]
    text = f"of what they explain together each alone explains {alone}; separate faults would add up to 100 %"
    text += ", so these may be an imitation of something that the catalogue lacks"
    if against:
        text += f". What rules them out: {'; '.join(against)}"
    if any(addition.effect.of_tyre for addition in diagnosis.additions):
        text += ' (say tyre = "rigid" of such wheels)'
    return text


def _held(diagnosis: Diagnosis) -> str | None:
    """What the configuration holds is no candidate: where something is missing it may be that."""
    held = diagnosis.base.held
    if not held or not (diagnosis.additions or diagnosis.verdict is not Verdict.NONE or disagrees(diagnosis)):
        return None
    parts = ", ".join(f"{effect} ({', '.join(names)})" for effect, names in held.items())
    return f"held by the configuration and so not tried: {parts}; a std beside a value, {{ value, std }}, frees it"


def same_push(addition: Addition, completed: FittedModel) -> str | None:
    """The pitch sensor's error that does the same as an offset of the hitch; None where it is implausible."""
    problem = completed.checks[-1].problem
    chassis = problem.rig.chassis
    if addition.effect.name != "draft_offset" or chassis is None or not problem.with_pitch:
        return None
    slope = completed.parameters()["draft_offset"]["offset"].value / (chassis.mass * GRAVITY)
    if abs(slope) > GRADE_BESIDE_PITCH.parameters[0].high:
        return None
    way = "high" if slope > 0.0 else "low"
    return f"a pitch sensor that reads {abs(math.degrees(slope)):.2f} deg too {way} would do the same"


def why_probabilities(addition: Addition) -> str | None:
    """How probabilities follow from the falls of the score; None where there is one name only."""
    if len(addition.by_block) < 2:
        return None
    judged = "probabilities: each effect is judged by what it predicts of blocks that it was not fitted to"
    return f"{judged}, and a probability is the share of random weights of the blocks for which it predicts best"


def pressure_error(found: Detectable, before: Sequence[Posterior], config: Config) -> tuple[float, float]:
    """Return relative error and reported relative std of the bearing pressure under an effect that stays unseen.

    They are of the recording in which their ratio is greatest; `before` is the soil of each as reported.
    """
    errors = []
    for posterior, soil_error in zip(before, found.soil_error, strict=True):
        at = config.estimator.z_ref, config.estimator.b_ref
        pressure = posterior.bearing_pressure(*at)
        by_logs = pressure_gradient(posterior.soil, *at) * np.array(posterior.soil) / pressure.value
        errors.append((float(np.expm1(by_logs @ soil_error)), pressure.std / pressure.value))
    return max(errors, key=lambda error: abs(error[0]) / max(error[1], 1e-12))


def unseen_errors(diagnosis: Diagnosis, config: Config) -> list[tuple[Detectable, float, float]]:
    """Return each effect that may be there unseen and moves the bearing pressure by more than its std, with both."""
    before = [diagnosis.soil_before(i) for i in range(len(diagnosis.base.fits))]
    errors = [(found, *pressure_error(found, before, config)) for found in diagnosis.detectable]
    return [(found, error, std) for found, error, std in errors if abs(error) > std]


def shown_lines(diagnosis: Diagnosis, config: Config) -> Iterator[str]:
    """What these recordings could have shown, what not, and what that may do to the bearing pressure."""

    def text_of(found: Detectable, size: float) -> str:
        unit = found.parameter.unit
        return f"{found.effect.name} {size:.2g}" + ("" if unit == "1" else f" {unit}")

    if sizes := [text_of(found, found.size) for found in diagnosis.detectable if found.size is not None]:
        yield f"these recordings could have shown, from about these sizes on: {', '.join(sizes)}"
    if hidden := [found.effect.name for found in diagnosis.detectable if found.size is None]:
        yield f"they could not have shown, at any usual size: {', '.join(hidden)}"
    if unseen := sorted(unseen_errors(diagnosis, config), key=lambda e: -abs(e[1])):
        parts = [f"{text_of(found, found.unseen)} by {100.0 * error:+.1f} %" for found, error, _ in unseen[:MAX_UNSEEN]]
        more = f" (and {len(unseen) - MAX_UNSEEN} more by less)" if len(unseen) > MAX_UNSEEN else ""
        what = ["sizes just below these"] * any(found.size is not None for found, _, _ in unseen)
        what += ["what they could not have shown"] * any(found.size is None for found, _, _ in unseen)
        moved = f"{' and '.join(what)} may move the bearing pressure by more than its +- {100.0 * unseen[0][2]:.1f} %"
        yield f"{moved}: {', '.join(parts)}{more}"
