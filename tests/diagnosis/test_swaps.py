"""The search over sets of effects, on scores that are given: what is added, swapped, removed and left out."""

from types import SimpleNamespace

import numpy as np
import pytest

from soilbus.diagnosis import search as search_module
from soilbus.diagnosis.search import Search
from soilbus.terra.effects.catalogue import CATALOGUE

EFFECTS = [CATALOGUE[name] for name in ("lugs", "multipass", "grade", "draft_gain")]
LUGS, MULTIPASS, GRADE, DRAFT_GAIN = (effect.name for effect in EFFECTS)
ROWS = 3000
BLOCKS = 30


class Recordings:
    """A FitCache whose fits have these falls of the score, all blocks alike, by set of names."""

    records, prior = (), None

    def __init__(self, falls: dict[frozenset[str], float]) -> None:
        self.falls = falls

    def fit(self, effects, starts=(), options=None):
        names = tuple(effect.name for effect in effects)
        value = ROWS - self.falls.get(frozenset(names), 0.0)
        return SimpleNamespace(
            effects=tuple(effects),
            names=names,
            score=value,
            neg2_log_posterior=value,
            blocks=SimpleNamespace(
                neg2_log=np.full(BLOCKS, value / BLOCKS),
                rows=np.full(BLOCKS, ROWS / BLOCKS),
                chi2=np.full(BLOCKS, 2.0 * ROWS / BLOCKS),  # a gap beyond noise
            ),
            free_unheld=(),
            as_starts=lambda effects=None: (),
        )

    def better(self, fitted, starts):
        return fitted


@pytest.fixture(autouse=True)
def scored(monkeypatch):
    """Every candidate scores alike."""

    def scores(records, prior, model, candidates):
        return [SimpleNamespace(effect=effect, change=-1.0, starts=()) for effect in candidates]

    monkeypatch.setattr(search_module, "scores", scores)
    monkeypatch.setattr(search_module, "further_scores", lambda *given: [])


def found(falls: dict[str, float]) -> list[set[str]]:
    """The sets of names that the search goes through."""
    cache = Recordings({frozenset(names.split("+")): fall for names, fall in falls.items()})
    return [{a.effect.name for a in additions} for additions, _ in Search(cache, cache, cache.fit([]), EFFECTS).steps()]


def test_one_effect_that_stood_for_two_is_swapped():
    falls = {
        LUGS: 300.0, MULTIPASS: 200.0, f"{LUGS}+{GRADE}": 350.0, f"{MULTIPASS}+{GRADE}": 900.0,
        f"{LUGS}+{MULTIPASS}": 320.0, f"{LUGS}+{MULTIPASS}+{GRADE}": 901.0,
    }  # fmt: skip
    assert found(falls) == [{LUGS}, {MULTIPASS, GRADE}]


def test_an_effect_that_explains_nothing_beside_another_is_removed():
    """Its own fit had ended at a poor optimum at first."""
    falls = {LUGS: 300.0, f"{LUGS}+{GRADE}": 800.0, f"{GRADE}+{MULTIPASS}": 801.0, GRADE: 250.0}
    cache = Recordings({frozenset(names.split("+")): fall for names, fall in falls.items()})
    steps = Search(cache, cache, cache.fit([]), EFFECTS).steps()
    assert [a.effect.name for a in next(steps)[0]] == [LUGS]
    cache.falls[frozenset([GRADE])] = 799.0
    assert [a.effect.name for a in next(steps)[0]] == [GRADE]


def test_nothing_is_added_that_is_not_more_probable_than_nothing():
    least = 2.0 * np.log(len(CATALOGUE))
    assert found({LUGS: least - 0.1}) == []
    assert found({LUGS: least + 0.1}) == [{LUGS}]


def test_a_further_effect_must_explain_more_than_the_first_ones_formula_may_leave():
    assert found({LUGS: 10000.0, f"{LUGS}+{GRADE}": 10060.0}) == [{LUGS}]
    assert found({LUGS: 10000.0, f"{LUGS}+{GRADE}": 10160.0}) == [{LUGS}, {LUGS, GRADE}]
