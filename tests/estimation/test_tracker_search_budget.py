"""Windows that the model does not describe cost no more than others: a budget ends searches that find nothing."""

from dataclasses import replace

import numpy as np
import pytest

from driven_windows import tasks
from soilbus.decision.traversability import Status
from soilbus.estimation.observation_model import ObservationModel
from soilbus.estimation.search_budget import SearchBudget
from soilbus.pipeline.estimator import WindowEstimator
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import excited

CONFIG = reference_configuration()
UNLIMITED = reference_configuration(["estimator.search_rate=1e9", "estimator.search_burst=1e9"])


@pytest.fixture(scope="module")
def drive():
    return list(tasks(CONFIG, excited("loam", 48.0), seed=3))


def with_draft(task, sign):
    return replace(task, window=replace(task.window, draft=sign * task.window.draft))


def solved(config, drive, monkeypatch):
    """Results of a drive, and the evaluations of a whole window that each took."""
    count, linearise = [0], ObservationModel.linearise

    def counted(self, *args, **kwargs):
        count[0] += self.n
        return linearise(self, *args, **kwargs)

    monkeypatch.setattr(ObservationModel, "linearise", counted)
    estimator, results, spent = WindowEstimator(config), [], []
    for task in drive:
        before = count[0]
        results.append(estimator.solve(task))
        spent.append((count[0] - before) / len(task.window.t))
    monkeypatch.undo()
    return results, np.array(spent)


def test_a_draft_of_the_wrong_sign_costs_no_more_than_one_of_the_right_sign(drive, monkeypatch):
    good, right = solved(CONFIG, drive, monkeypatch)
    assert not any(r.search_ended for r in good)
    wrong = [with_draft(task, -1.0) for task in drive]
    results, spent = solved(CONFIG, wrong, monkeypatch)
    _, without = solved(UNLIMITED, wrong[:6], monkeypatch)
    late = slice(26, None)  # what was kept for a start is spent by then
    assert spent[late].mean() < 2.0 * right[late].mean() + 4.0
    assert without.mean() > 2.0 * spent[late].mean()
    assert any(r.search_ended for r in results)
    assert all(r.status is not Status.VALID and r.reason == "model_mismatch" for r in results)


def test_what_is_well_again_is_soon_found(drive):
    estimator = WindowEstimator(CONFIG)
    healed = 30
    results = [estimator.solve(with_draft(task, -1.0 if i < healed else 1.0)) for i, task in enumerate(drive)]
    first = next(i for i, r in enumerate(results) if r.status is Status.VALID)
    assert healed <= first <= healed + 6


def test_windows_that_no_soil_explains_say_nothing_of_the_sensors(drive):
    """What is learned as noise from them hides a fault of the same size that comes later."""
    estimator, sound, bad = WindowEstimator(CONFIG), WindowEstimator(CONFIG), 10
    for i, task in enumerate(drive[: bad + 6]):
        result, expected = estimator.solve(with_draft(task, -1.0 if i < bad else 1.0)), sound.solve(task)
    assert result.status is Status.VALID
    assert result.noise_factors == pytest.approx(expected.noise_factors, rel=0.3)
    assert result.bearing.std < 1.3 * expected.bearing.std


def test_a_bucket_gives_its_rate_for_ever_and_its_burst_once():
    budget, searches = SearchBudget(rate=4.0, burst=100.0), 0
    for _ in range(1000):
        budget.next_window(instants=50)
        while budget.allows():
            begun = budget.work.instants
            budget.work.instants += 20 * 50
            budget.spend(begun)
            searches += 1
        assert budget.ended
    assert searches * 20 == pytest.approx(100 + 1000 * 4, abs=20)
