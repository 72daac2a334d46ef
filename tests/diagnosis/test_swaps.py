"""The search over sets of effects, on evidences that are given: what is added, swapped, removed and left out."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from soilbus.diagnosis import search as search_module
from soilbus.diagnosis.search import Search
from soilbus.terra.effects.catalogue import CATALOGUE

EFFECTS = [CATALOGUE[name] for name in ("lugs", "multipass", "grade", "draft_gain")]
LUGS, MULTIPASS, GRADE, DRAFT_GAIN = (effect.name for effect in EFFECTS)
ROWS = 3000


class Recordings:
    """A FitCache whose fits have these falls of -2 log evidence, by set of names."""

    records, prior = (), None

    def __init__(self, falls: dict[frozenset[str], float], gap: float = 1.0) -> None:
        self.falls, self.gap = falls, gap

    def fit(self, effects, starts=(), options=None):
        names = tuple(effect.name for effect in effects)
        value = ROWS * self.gap - self.falls.get(frozenset(names), 0.0)
        return SimpleNamespace(
            effects=tuple(effects),
            names=names,
            neg2_log_evidence=value,
            neg2_log_posterior=value,
            excess=ROWS * (self.gap - 1.0),
            held_out_chi2=self.gap,
            checked_rows=ROWS // 3,
            rows=ROWS,
            as_starts=lambda effects=None: (),
            own_parameters=lambda effect: (),
        )

    def better(self, fitted, starts):
        return fitted


@pytest.fixture(autouse=True)
def scored(monkeypatch):
    """Every candidate scores alike."""

    def scores(records, prior, model, candidates):
        return [SimpleNamespace(effect=effect, neg2_log_evidence=-1.0, starts=()) for effect in candidates]

    monkeypatch.setattr(search_module, "scores", scores)
    monkeypatch.setattr(search_module, "further_scores", lambda *given: [])


def found(falls: dict[str, float], gap: float = 1.0) -> list[set[str]]:
    """The sets of names that the search goes through."""
    cache = Recordings({frozenset(names.split("+")): fall for names, fall in falls.items()}, gap)
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
    least = 2.0 * np.log(len(CATALOGUE)) * 2.0  # no excess: evidence counts half
    assert found({LUGS: least - 1.0}) == []
    assert found({LUGS: least + 1.0}) == [{LUGS}]


def test_an_effect_that_leaves_most_of_a_large_gap_is_not_added():
    assert found({LUGS: 100.0}, gap=1.5) == []
    assert found({LUGS: 500.0}, gap=1.5) == [{LUGS}]
