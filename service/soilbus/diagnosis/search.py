"""Stepwise search for missing effects, with swaps.

    fall(e) = score of the model - score of the model with effect e                 (`blocks`)
    add the e of the greatest fall, while it is more probable than none, and sure where the gap is within noise
    after each addition compare every effect with all candidates in its place:
        swap it where another explains more, remove it where none is more probable

A comparison has three stages.  Score tests name the candidates that can explain something and say where their fits
begin; each is fitted to a part of the instants, from all its starts; from there those that can still win are fitted
to all instants.  FitCache keeps every fit.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

from soilbus.arrays import Array
from soilbus.diagnosis.fitted_model import FittedModel, fit_model
from soilbus.diagnosis.gap import gap_of
from soilbus.diagnosis.joint_fit import Start
from soilbus.diagnosis.options import DEFAULT, DiagnosisOptions
from soilbus.diagnosis.records import Record
from soilbus.diagnosis.score import Score, further_scores, scores
from soilbus.diagnosis.verdict import mean_soil_error_share, probabilities
from soilbus.estimation.options import SolverOptions
from soilbus.estimation.posterior import SoilPrior
from soilbus.terra.effects.effect import Effect


@dataclass(frozen=True, slots=True)
class Addition:
    """One effect that was added, compared with all candidates in its place, beside the other effects.

    Attributes
    ----------
    effect, probability
        The effect, and the probability of its name.
    alternatives
        Probability by name of the other effects that belong to the set.
    by_block
        Fall of the score of each block by name.
    soil_error_share
        Share of the change of the soil's parameters that counts as a standard deviation: root mean square over the
        set, weighted by probability.
    """

    effect: Effect
    probability: float
    alternatives: dict[str, float]
    by_block: dict[str, Array]
    soil_error_share: float = 0.0

    @property
    def falls(self) -> dict[str, float]:
        """Fall of the score by name."""
        return {name: float(falls.sum()) for name, falls in self.by_block.items()}


@dataclass(slots=True)
class Search:
    """Search beside a model that is fitted to the recordings already.

    Attributes
    ----------
    full, thinned
        Fits to all instants and to the thinned ones.
    base
        The model without any addition.
    candidates
        Effects that may be missing.
    options
        Of the diagnosis.
    bare
        Score without those effects whose sizes are fitted (see score_without_effects()).
    """

    full: FitCache
    thinned: FitCache
    base: FittedModel
    candidates: Sequence[Effect]
    options: DiagnosisOptions = DEFAULT
    bare: float = field(init=False)
    _compared: dict[frozenset[str], dict[str, FittedModel]] = field(init=False, default_factory=dict)

    def __post_init__(self) -> None:
        self.bare = score_without_effects(self.full.records, self.full.prior, self.base)

    def steps(self) -> Iterator[tuple[list[Addition], FittedModel]]:
        """After each addition and its swaps: the additions in the order of the model's effects, and the model."""
        present = self.base
        while len(self.added(present)) < self.options.max_effects:
            wider = self.best(present)
            if wider is None or self._falls_short(present, wider):
                return
            found = self.with_swaps(wider)
            if found.score > present.score - self.options.negligible_fall:
                return
            additions = [self.addition(found, effect) for effect in self.added(found)]
            if not gap_of(present).exceeds_noise(self.options) and not self._is_sure(present, additions[-1]):
                return
            present = found
            yield additions, present

    def _is_sure(self, present: FittedModel, addition: Addition) -> bool:
        """Whether something is surely missing; beside effects whose formulas may be off, whether it is this one."""
        beside = any(f.std > 0.0 for f in present.free_unheld)
        chance = addition.probability + (0.0 if beside else sum(addition.alternatives.values()))
        return chance >= self.options.named_probability

    def added(self, model: FittedModel) -> list[Effect]:
        """Effects that the model has beside those of the base."""
        return [effect for effect in model.effects if effect.name not in self.base.names]

    def best(self, model: FittedModel) -> FittedModel | None:
        """The model with the effect more that explains most; None where no candidate explains anything."""
        return min(self.compared(model).values(), key=lambda fit: fit.score, default=None)

    def with_swaps(self, model: FittedModel) -> FittedModel:
        """The model with effects swapped or removed until no swap explains more and none falls short."""
        seen = {frozenset(model.names)}
        while True:
            for effect in self.added(model):
                without = self._without(model, effect)
                if without is None:
                    continue
                other = self.best(without)
                enough = model.score - self.options.negligible_fall
                if other is not None and other.score < enough:
                    better = other
                elif self._falls_short(without, model):
                    better = without
                else:
                    continue
                if frozenset(better.names) not in seen:
                    seen.add(frozenset(better.names))
                    model = better
                    break
            else:
                return model

    def compared(self, model: FittedModel) -> dict[str, FittedModel]:
        """The model with one effect more, by the name of each candidate that explains something."""
        key = frozenset(model.names)
        if key not in self._compared:
            self._compared[key] = {
                name: fit
                for name, fit in self._fits(model)
                if fit.score < model.score and not self._is_within_a_cycle(fit)
            }
        return self._compared[key]

    def addition(self, model: FittedModel, effect: Effect) -> Addition:
        """An effect of the model compared with all candidates in its place."""
        without = self._without(model, effect)
        beside = self.base if without is None else without
        fits = self.compared(beside) | {effect.name: model}
        falls = {name: beside.blocks.neg2_log - fit.blocks.neg2_log for name, fit in fits.items()}
        chances = probabilities(falls)
        others = {n: p for n, p in chances.items() if n != effect.name and p >= self.options.set_probability}
        in_set = {n: p for n, p in chances.items() if n == effect.name or n in others}
        share = mean_soil_error_share(in_set, self.options)
        ordered = dict(sorted(falls.items(), key=lambda item: -float(item[1].sum())))
        return Addition(effect, chances[effect.name], others, ordered, share)

    def _fits(self, model: FittedModel) -> Iterator[tuple[str, FittedModel]]:
        """Fits of the candidates to all instants, by name; without those that cannot win."""
        trials: list[tuple[FittedModel, list[Score]]] = []
        limit, margin = math.inf, self.options.dominated_fall
        for of_one in self._by_score(model)[: self.options.max_candidates]:
            effects, starts = (*model.effects, of_one[0].effect), [score.starts for score in of_one]
            trial = self.thinned.fit(effects, starts, replace(self.options.compared, give_up_above=limit))
            if trial is not None:
                trials.append((trial, of_one))
                limit = min(limit, trial.neg2_log_posterior + margin)
        limit = math.inf
        for trial, of_one in sorted(trials, key=lambda one: one[0].neg2_log_posterior):
            descent = replace(self.options.compared, give_up_above=limit)
            fit = self.full.fit(trial.effects, [trial.as_starts()], descent)
            if fit is None:
                continue
            promising = [s for s in of_one if model.score + s.change < fit.score]
            fit = self.full.better(fit, [score.starts for score in promising])
            limit = min(limit, fit.neg2_log_posterior + margin)
            yield of_one[0].effect.name, fit

    def _by_score(self, model: FittedModel) -> list[list[Score]]:
        """Scores of each candidate that should explain something, one for each start, the best first."""
        possible = [effect for effect in self.candidates if effect.name not in model.names]
        if not possible:
            return []
        given = self.full.records, self.full.prior, model, possible
        found: dict[str, list[Score]] = {}
        for score in sorted([*scores(*given), *further_scores(*given)], key=lambda score: score.change):
            if score.change < 0.0:
                found.setdefault(score.effect.name, []).append(score)
        return list(found.values())

    def _without(self, model: FittedModel, effect: Effect) -> FittedModel | None:
        """The model less one effect, fitted from its optimum but for the latents, which followed that effect."""
        kept = [e for e in model.effects if e.name != effect.name]
        if len(kept) == len(self.base.effects):
            return self.base
        return self.full.fit(kept, [[start._replace(near_optimum=False) for start in model.as_starts(kept)]])

    def _is_within_a_cycle(self, model: FittedModel) -> bool:
        """Whether the last effect delays no channel by more than its sample time, for sure: stamps do that."""
        effect = model.effects[-1]
        if not effect.late:
            return False
        found, problem = model.parameters()[effect.name], self.full.records[-1].training
        return not any(
            found[late.delay].value - self.options.delay_sure_sd * found[late.delay].std > problem.sample_time(quantity)
            for quantity, late in effect.late.items()
        )

    def _falls_short(self, without: FittedModel, model: FittedModel) -> bool:
        """Whether an effect is less probable than none, or explains no more than the others' formulas may leave."""
        fall = without.blocks.neg2_log - model.blocks.neg2_log
        of_formulas = self.options.max_formula_error**2 * (self.bare - without.score)
        return probabilities({"it": fall})["it"] < 0.5 or float(fall.sum()) < of_formulas


def score_without_effects(records: Sequence[Record], prior: SoilPrior, present: FittedModel) -> float:
    """Return the score of the model without those effects whose sizes are fitted, at least that of the present one.

    What a fitted effect explains counts as what a search explains where a configuration has put it into the model: its
    formula is not the field's either.
    """
    fitted = {f.effect for f in present.free_unheld if f.std > 0.0}
    kept = [effect for effect in present.effects if effect.name not in fitted]
    given = [f for f in present.free_unheld if f.effect not in fitted]
    without = fit_model([record.with_effects(kept, given) for record in records], prior, kept) if fitted else None
    return present.score if without is None else max(present.score, without.score)


class FitCache:
    """The models fitted to the same recordings.

    A set of effects whose fit converged is not fitted again, except where a model with fewer effects explains as much.
    """

    def __init__(self, records: Sequence[Record], prior: SoilPrior, options: DiagnosisOptions = DEFAULT) -> None:
        self.records, self.prior, self.options = tuple(records), prior, options
        self._converged: dict[frozenset[str], FittedModel] = {}

    def fit(
        self,
        effects: Sequence[Effect],
        starts: Sequence[Sequence[Start]] = (),
        options: SolverOptions | None = None,
    ) -> FittedModel | None:
        """The best fit with these effects.

        Parameters
        ----------
        effects
            Of the model.
        starts
            Each a Start for each recording; none searches from several.
        options
            When a descent stops or is given up; by default as DiagnosisOptions says.

        Returns
        -------
        FittedModel or None
            None where all fits fail.
        """
        names = frozenset(effect.name for effect in effects)
        best, fewer = self._converged.get(names), self._with_fewer(names)
        if best is not None and not self._explains_nothing(best, fewer):
            return best
        for start in starts or (None,):
            best = _better(best, fit_model(self.records, self.prior, effects, start, options))
        may_give_up = options is not None and math.isfinite(options.give_up_above)
        if fewer is not None and not may_give_up and self._explains_nothing(best, fewer):
            best = _better(best, fit_model(self.records, self.prior, effects, fewer.as_starts(effects), options))
        return self._kept(best)

    def better(self, fitted: FittedModel, starts: Sequence[Sequence[Start]]) -> FittedModel:
        """The best of a model as fitted and of fits from further starts."""
        best: FittedModel | None = fitted
        for start in starts:
            best = _better(best, fit_model(self.records, self.prior, fitted.effects, start))
        return self._kept(best) or fitted

    def _kept(self, fitted: FittedModel | None) -> FittedModel | None:
        if fitted is not None and fitted.converged:
            self._converged[frozenset(fitted.names)] = fitted
        return fitted

    def _with_fewer(self, names: frozenset[str]) -> FittedModel | None:
        """Of the models with a subset of the effects, the one of least -2 log posterior: a bound for the full set."""
        fits = [fit for fewer, fit in self._converged.items() if fewer < names]
        return min(fits, key=lambda fit: fit.neg2_log_posterior, default=None)

    def _explains_nothing(self, fit: FittedModel | None, with_fewer: FittedModel | None) -> bool:
        """Whether a model fits no better than one with a subset of its effects: from another start it may."""
        return with_fewer is not None and (
            fit is None or fit.neg2_log_posterior > with_fewer.neg2_log_posterior - self.options.negligible_fall
        )


def _better(one: FittedModel | None, other: FittedModel | None) -> FittedModel | None:
    return one if other is None or (one is not None and one.neg2_log_posterior <= other.neg2_log_posterior) else other
