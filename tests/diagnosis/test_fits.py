"""Models fitted once, and from elsewhere where they explain less than with fewer effects."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from soilbus.diagnosis import search as fits_module
from soilbus.diagnosis.search import Fits, Promising, Standing, _fitted
from soilbus.estimation.multistart import DescentOptions
from soilbus.terra.effects.catalogue import CATALOGUE

PAN, LUGS = CATALOGUE["hardpan"], CATALOGUE["lugs"]


class Told(SimpleNamespace):
    """A fit by its numbers."""

    def as_starts(self, effects=None):
        return ()


@pytest.fixture
def asked(monkeypatch):
    """Costs of the fits to come, by where they begin; what was asked for."""
    costs, calls = {}, []

    def complete(records, prior, effects, starts, effort):
        calls.append((tuple(e.name for e in effects), starts))
        cost = costs[calls[-1]]
        return (
            None
            if cost is None
            else Told(neg2_log_posterior=cost, neg2_log_evidence=cost + 10.0, converged=True, effects=tuple(effects))
        )

    monkeypatch.setattr(fits_module, "complete", complete)
    monkeypatch.setattr(fits_module, "_key", lambda starts: starts)
    return costs, calls


def test_an_effect_that_explains_nothing_is_tried_from_elsewhere(asked):
    costs, calls = asked
    costs |= {((), None): 100.0, (("hardpan",), "flat"): 100.0, (("hardpan",), ()): 99.9, (("hardpan",), "deep"): 40.0}
    fits = Fits([], None)
    assert fits.of([]).neg2_log_posterior == 100.0
    assert fits.of([PAN], ["flat"]).neg2_log_posterior == 99.9
    assert fits.of([PAN], ["deep"]).neg2_log_posterior == 40.0
    assert fits.of([PAN], ["flat"]).neg2_log_posterior == 40.0
    assert len(calls) == 4


def test_more_effects_cost_no_more_than_fewer(asked):
    """Where a fit with an effect more goes astray it begins where the one without ended."""
    costs, calls = asked
    costs |= {(("lugs",), None): 50.0, (("hardpan", "lugs"), "astray"): 9000.0, (("hardpan", "lugs"), ()): 49.0}
    fits = Fits([], None)
    fits.of([LUGS])
    assert fits.of([PAN, LUGS], ["astray"]).neg2_log_posterior == 49.0
    costs[("hardpan", "lugs"), "hopeless"] = None
    assert Fits([], None).of([PAN, LUGS], ["hopeless"], DescentOptions(give_up_above=60.0)) is None
    assert calls[-1] == (("hardpan", "lugs"), "hopeless")


def test_scores_are_worked_out_once(monkeypatch):
    calls = []
    monkeypatch.setattr(fits_module, "scores", lambda *args: calls.append(args) or [len(calls)])
    fits, model = Fits([], None), object()
    assert fits.scores(model, [PAN]) == [1] == fits.scores(model, [PAN])
    assert fits.scores(model, [PAN, LUGS]) == [2]
    assert fits.scores(object(), [PAN]) == [3]


def test_few_instants_foretell_a_model_of_all():
    few = SimpleNamespace(
        rows=100, checked_rows=30, neg2_log_posterior=70.0, gap=1.5, foreseen=lambda rows: 2.5 * rows, names=("lugs",)
    )
    standing = Standing.foretold(few, Fits([], None), 400)
    assert (standing.neg2_log_posterior, standing.neg2_log_evidence, standing.gap) == (280.0, 1000.0, 1.5)
    assert (standing.checked_rows, standing.rows) == (120, 400)
    assert standing.known is standing.few
    assert standing.names == {"lugs"}


def test_the_model_at_hand_is_not_fitted_again():
    beside = SimpleNamespace(
        names=frozenset({"hardpan"}), effects=(PAN,), neg2_log_evidence=100.0, neg2_log_posterior=90.0
    )
    at_hand = SimpleNamespace(names=("lugs", "hardpan"), neg2_log_evidence=50.0, neg2_log_posterior=40.0)
    counted = Promising([(LUGS, ())], {}, {}, {})
    no_fits = None
    fitted, _ = _fitted(no_fits, beside, counted, explained=0.0, asked=30.0, at_hand=at_hand)
    assert fitted == {"lugs": (LUGS, at_hand)}
    with pytest.raises(AttributeError):
        _fitted(no_fits, beside, counted, explained=0.0, asked=30.0, at_hand=None)
