"""Which effects are worth a fit to all data: foreseen by scores, tried on a few instants."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import NamedTuple

from soilbus.diagnosis.completion import Completion
from soilbus.diagnosis.fits import Fits
from soilbus.diagnosis.score import Score
from soilbus.diagnosis.sizes import OwnParameters
from soilbus.diagnosis.verdict import hopeless, least_that_pays
from soilbus.estimation.gauss_newton import Effort, Start
from soilbus.terra.effects.effect import Effect

TRIED, FURTHER = 4, 4
"""Candidates of a round that are fitted to a few instants: the best by their scores, and by those of further starts.

Of 77 rounds of seeds 112 and 113, and of 95 of seed 127, the one that was named was among them.
"""
COUNTED, FITTED = 6, 3
"""Those of them that count, if only by what few instants foretell, and those that are fitted to all."""
THINNED = 4
"""Every so manieth instant is one of the few."""
CLEAR = 100.0
"""Foreseen fall of -2 log evidence from which a few instants tell which candidates to fit."""
BEHIND = 150.0
"""-2 log evidence by which a candidate is behind for good, foreseen from a few instants: it is not fitted to all.

Three deviations: of a difference d on every THINNED-th instant the deviation is 2 sqrt(d), and 2 sqrt(THINNED x)
of x foreseen.
"""
BEHIND_UNSETTLED = 250.0
"""Cost on a few instants above the least one's from which a candidate is given up, converged or not."""
STEPS = 12
"""Steps of the soil, and then of everything, in which a candidate that explains much is fitted."""
ROUGH = Effort(STEPS, enough=0.1, little=5e-3)
"""The same where few instants tell which candidates to fit to all."""
WORTH_TRYING = -2.0
"""Foreseen change of -2 log evidence above which a candidate does not count."""
WORTH_FITTING = 0.2
"""Share of what an effect must explain, and of what the best is foreseen to, from which it is fitted where little
is foreseen: of less the score is as good."""


class Standing(NamedTuple):
    """A model that an effect may be added to: as fitted, the fits it is one of, and the same fitted to few instants.

    The numbers are of all instants, or as the few foretell them: -2 log evidence, cost and gap, residuals held out
    and in all.
    """

    known: Completion
    fits: Fits
    few: Completion | None
    evidence: float
    cost: float
    gap: float
    checked_rows: int
    rows: int

    @classmethod
    def of(cls, known: Completion, whole: Fits, few: Fits) -> Standing:
        """A model fitted to all, and from there to the few."""
        told = known.evidence, known.cost, known.gap, known.checked_rows, known.rows
        return cls(known, whole, few.of(known.effects, [known.as_starts()], ROUGH), *told)

    @classmethod
    def foretold(cls, known: Completion, few: Fits, rows: int) -> Standing:
        """A model fitted to the few alone, of so many residuals in all."""
        times = rows / known.rows
        told = known.foreseen(rows), times * known.cost, known.gap, round(times * known.checked_rows), rows
        return cls(known, few, known, *told)

    @property
    def effects(self) -> tuple[Effect, ...]:
        """What the model has already."""
        return self.known.effects

    @property
    def names(self) -> frozenset[str]:
        """Names of the effects."""
        return frozenset(self.known.names)


class Promising(NamedTuple):
    """Candidates worth a fit of all data, with where it starts.

    Falls of -2 log evidence that scores foretell of others, and how far behind the best one a few instants put each,
    with what these foretell of the parameters that further recordings have for themselves.
    """

    fits: Sequence[tuple[Effect, Sequence[Start]]]
    foreseen: dict[str, float]
    behind: dict[str, float]
    further: dict[str, tuple[OwnParameters, ...]]


def promising(
    few: Fits, present: Standing, candidates: Sequence[Effect], explained: float, again: Collection[str] | None
) -> Promising:
    """The few candidates that count beside the present model, which explains so much (fall of -2 log evidence).

    Foreseen by scores, tried on a few instants; where little is foreseen these tell nothing, and scores are as good
    as fits.  `again` are names that were fitted in an earlier round for the same place.
    """
    before, foreseen = present.few, present.fits.scores(present.known, candidates)
    if before is not None:
        further = few.further_scores(before, candidates)
        of_all = ((present.rows / fit.rows, found) for fit, found in ((present.known, foreseen), (before, further)))
        most = max(times * -score.evidence for times, found in of_all for score in found)
        if most >= CLEAR or present.known is before:
            trials = _trials(few, before, worth_trying(foreseen, further, again), present.rows)
            return _of_trials(trials, explained, present.rows)
    return _of_scores([*foreseen, *present.fits.further_scores(present.known, candidates)], least_that_pays(explained))


class _Trial(NamedTuple):
    """A candidate's fit to a few instants, and the fall of -2 log evidence of all that it foretells."""

    effect: Effect
    completion: Completion
    fall: float


def _trials(few: Fits, before: Completion, found: Mapping[str, Sequence[Score]], rows: int) -> list[_Trial]:
    """The fits to the few of those found, the best first, with falls foretold of so many residuals."""
    trials: list[_Trial] = []
    least = math.inf
    for of_one in found.values():
        completion = fitted_to_few(few, before, of_one, least + BEHIND_UNSETTLED)
        if completion is not None:
            trials.append(_Trial(of_one[0].effect, completion, fall_foretold(before, completion, rows)))
            least = min(least, completion.cost)
    return sorted(trials, key=lambda trial: -trial.fall)


def _of_trials(trials: Sequence[_Trial], explained: float, rows: int) -> Promising:
    """Those that count, the best first; to be fitted to all are the first ones that are not behind for good."""
    best = trials[0].fall if trials else 0.0
    settled = bool(trials) and trials[0].completion.converged
    kept = [t for t in trials if t.fall > 0.0 and not hopeless(best - t.fall, explained + best)][:COUNTED]
    open_still = [t for t in kept if not (settled and t.completion.converged and best - t.fall > BEHIND)]
    fits = [(t.effect, t.completion.as_starts()) for t in open_still[:FITTED]]
    behind = {t.effect.name: best - t.fall for t in kept}
    return Promising(
        fits,
        {},
        behind,
        {t.effect.name: t.completion.further_parameters(t.effect, rows / t.completion.rows) for t in kept},
    )


def _of_scores(found: Iterable[Score], least: float) -> Promising:
    """The best score of each candidate that counts; those that come near what they must explain are fitted."""
    best: dict[str, Score] = {}
    for score in sorted(found, key=lambda score: score.evidence):
        if score.evidence < WORTH_TRYING:
            best.setdefault(score.effect.name, score)
    chosen = list(best.values())[:COUNTED]
    enough = WORTH_FITTING * max([least, *(-s.evidence for s in chosen)])
    fitted = [(s.effect, s.starts) for s in chosen if -s.evidence > enough]
    return Promising(fitted, {s.effect.name: -s.evidence for s in chosen[len(fitted) :]}, {}, {})


def fall_foretold(before: Completion, after: Completion, rows: int) -> float:
    """Fall of -2 log evidence between two fits to the few, foretold of so many residuals."""
    return before.foreseen(rows) - after.foreseen(rows)


def worth_trying(
    foreseen: Sequence[Score], further: Sequence[Score], again: Collection[str] | None
) -> dict[str, list[Score]]:
    """Scores of the candidates that count by name, the best foreseen first; `again` as of promising()."""
    first = foreseen[:TRIED]
    named = [score for score in foreseen[len(first) :] if again is not None and score.effect.name in again]
    found: dict[str, list[Score]] = {}
    for score in (*first, *named, *sorted(further, key=lambda score: score.evidence)[:FURTHER]):
        if score.evidence < WORTH_TRYING:
            found.setdefault(score.effect.name, []).append(score)
    return found


def fitted_to_few(few: Fits, present: Completion, found: Sequence[Score], hopeless: float) -> Completion | None:
    """The best fit of one candidate to a few instants; from further starts only where more is foreseen of them."""
    starts, foreseen = [s.starts for s in found], [present.evidence + s.evidence for s in found]
    return few.of((*present.effects, found[0].effect), starts, ROUGH._replace(hopeless=hopeless), foreseen)
