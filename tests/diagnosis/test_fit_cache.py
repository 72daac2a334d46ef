"""FitCache: a model is fitted once, and from elsewhere where it explains less than one with fewer effects."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from soilbus.diagnosis import search as search_module
from soilbus.diagnosis.search import FitCache, PresentModel, Shortlist, full_fits
from soilbus.estimation.solver import SolverOptions
from soilbus.terra.effects.catalogue import CATALOGUE

PAN, LUGS = CATALOGUE["hardpan"], CATALOGUE["lugs"]


class Fitted(SimpleNamespace):
    """A fit by its numbers."""

    def as_starts(self, effects=None):
        return ()


@pytest.fixture
def asked(monkeypatch):
    """Costs of the fits to come, by where they begin; what was asked for."""
    costs, calls = {}, []

    def fit_model(records, prior, effects, starts, effort):
        calls.append((tuple(e.name for e in effects), starts))
        cost = costs[calls[-1]]
        return (
            None
            if cost is None
            else Fitted(neg2_log_posterior=cost, neg2_log_evidence=cost + 10.0, converged=True, effects=tuple(effects))
        )

    monkeypatch.setattr(search_module, "fit_model", fit_model)
    monkeypatch.setattr(search_module, "start_key", lambda starts: starts)
    return costs, calls


def test_an_effect_that_explains_nothing_is_tried_from_elsewhere(asked):
    costs, calls = asked
    costs |= {((), None): 100.0, (("hardpan",), "flat"): 100.0, (("hardpan",), ()): 99.9, (("hardpan",), "deep"): 40.0}
    fits = FitCache([], None)
    assert fits.fit([]).neg2_log_posterior == 100.0
    assert fits.fit([PAN], ["flat"]).neg2_log_posterior == 99.9
    assert fits.fit([PAN], ["deep"]).neg2_log_posterior == 40.0
    assert fits.fit([PAN], ["flat"]).neg2_log_posterior == 40.0
    assert len(calls) == 4


def test_more_effects_cost_no_more_than_fewer(asked):
    """Where a fit with an effect more ends far off it begins again where the one without ended."""
    costs, calls = asked
    costs |= {(("lugs",), None): 50.0, (("hardpan", "lugs"), "far off"): 9000.0, (("hardpan", "lugs"), ()): 49.0}
    fits = FitCache([], None)
    fits.fit([LUGS])
    assert fits.fit([PAN, LUGS], ["far off"]).neg2_log_posterior == 49.0
    costs[("hardpan", "lugs"), "given up"] = None
    assert FitCache([], None).fit([PAN, LUGS], ["given up"], SolverOptions(give_up_above=60.0)) is None
    assert calls[-1] == (("hardpan", "lugs"), "given up")


def test_scores_are_worked_out_once(monkeypatch):
    calls = []
    monkeypatch.setattr(search_module, "scores", lambda *args: calls.append(args) or [len(calls)])
    fits, model = FitCache([], None), object()
    assert fits.scores(model, [PAN]) == [1] == fits.scores(model, [PAN])
    assert fits.scores(model, [PAN, LUGS]) == [2]
    assert fits.scores(object(), [PAN]) == [3]


def test_thinned_instants_predict_a_model_of_all():
    trial = SimpleNamespace(
        rows=100,
        checked_rows=30,
        neg2_log_posterior=70.0,
        gap=1.5,
        predicted_neg2_log_evidence=lambda rows: 2.5 * rows,
        names=("lugs",),
    )
    present = PresentModel.predicted(trial, FitCache([], None), 400)
    assert (present.neg2_log_posterior, present.neg2_log_evidence, present.gap) == (280.0, 1000.0, 1.5)
    assert (present.checked_rows, present.rows) == (120, 400)
    assert present.fitted is present.trial
    assert present.names == {"lugs"}


def test_the_model_at_hand_is_not_fitted_again():
    beside = SimpleNamespace(
        names=frozenset({"hardpan"}), effects=(PAN,), neg2_log_evidence=100.0, neg2_log_posterior=90.0
    )
    at_hand = SimpleNamespace(names=("lugs", "hardpan"), neg2_log_evidence=50.0, neg2_log_posterior=40.0)
    chosen = Shortlist([(LUGS, ())], {}, {}, {})
    no_cache = None
    fitted, _ = full_fits(no_cache, beside, chosen, explained=0.0, required=30.0, at_hand=at_hand)
    assert fitted == {"lugs": (LUGS, at_hand)}
    with pytest.raises(AttributeError):
        full_fits(no_cache, beside, chosen, explained=0.0, required=30.0, at_hand=None)
