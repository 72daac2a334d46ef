"""FitCache: a model is fitted once, and from elsewhere where it explains less than one with fewer effects."""

from types import SimpleNamespace

import pytest

from soilbus.diagnosis import search as search_module
from soilbus.diagnosis.search import FitCache
from soilbus.estimation.options import SolverOptions
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

    def fit_model(records, prior, effects, starts, options=None):
        calls.append((tuple(e.name for e in effects), starts))
        if (cost := costs[calls[-1]]) is None:
            return None
        names = tuple(e.name for e in effects)
        return Fitted(neg2_log_posterior=cost, converged=True, effects=tuple(effects), names=names)

    monkeypatch.setattr(search_module, "fit_model", fit_model)
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
