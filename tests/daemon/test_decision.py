"""Windows in, states out: the decision as the service makes it."""

from dataclasses import replace

import numpy as np
import pytest

from driven_windows import task_of, tasks, windows
from fakes import drive_messages, fed
from soilbus.decision.judgement import Basis, at_present
from soilbus.decision.traversability import State, Status, Traversability
from soilbus.decision.watch import Watch
from soilbus.estimation.assembly import effects_of, with_effects
from soilbus.estimation.tracker import TrackerOutput
from soilbus.pipeline.estimator import WindowEstimator
from soilbus.pipeline.intake import WindowTask
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import Patch, Scenario, Swing, excited
from tests.lab.stories.onlooker import good_tracked, of_soft_ground, tracked_at

CONFIG = reference_configuration()


@pytest.fixture(scope="module")
def drawn_tasks() -> list[WindowTask]:
    """Windows of a good drive, from its frames."""
    intake, last = fed(CONFIG, drive_messages(CONFIG, 16.0))
    return intake.finish(last)


@pytest.fixture(scope="module")
def firm() -> TrackerOutput:
    return good_tracked()


def decided(drawn_tasks, outputs):
    """Results of the windows, for which the tracker returns these outputs."""
    estimator = WindowEstimator(CONFIG)
    found = []
    for task, tracked in zip(drawn_tasks, outputs, strict=False):
        estimator.tracker.estimate = lambda window, end, tracked=tracked: tracked_at(
            tracked, window, since=end - CONFIG.estimator.window * tracked.since
        )
        found.append(estimator.solve_unwatched(task))
    return found


def of(tracked: TrackerOutput, share: float = 1.0, **changed) -> TrackerOutput:
    """The output for a window of which the soil fills this share."""
    return replace(tracked, since=share, **changed)


def states(drawn_tasks, outputs):
    return [result.traversability.state for result in decided(drawn_tasks, outputs)]


def test_a_better_state_needs_two_windows_in_a_row(drawn_tasks, firm):
    good, bad = of(firm), of(of_soft_ground(firm))
    assert states(drawn_tasks, [good, good]) == [State.GO, State.GO]
    found = states(drawn_tasks, [bad, good, bad, good, good])
    assert found[0] is found[2] is State.NO_GO
    assert found[1] is found[3] is not State.GO
    assert found[4] is State.GO


def test_a_fresh_window_is_not_held_back_by_hysteresis(drawn_tasks, firm):
    restarted = [drawn_tasks[0], replace(drawn_tasks[1], fresh=True)]
    assert states(restarted, [of(of_soft_ground(firm)), of(firm)]) == [State.NO_GO, State.GO]


def test_a_little_of_a_new_soil_is_no_go(drawn_tasks, firm):
    little, enough = decided(drawn_tasks[:1], [of(firm, 0.1)])[0], decided(drawn_tasks[:1], [of(firm, 0.3)])[0]
    assert (little.status, little.reason) == (Status.NOT_EXCITED, "not_excited new_soil")
    assert little.traversability.state is not State.GO
    assert (enough.status, enough.traversability.state) == (Status.VALID, State.GO)


@pytest.mark.parametrize(("ago", "state"), [(1.0, State.GO), (2.5, State.UNKNOWN)])
def test_ground_left_behind_is_unknown(ago, state, drawn_tasks, firm):
    """At more than 1 m/s the instants before the last second lie within the vehicle's length, older ones do not."""
    window = drawn_tasks[0].window
    assert window.ground_speed.min() > 1.0
    estimator = WindowEstimator(CONFIG)
    tracked = tracked_at(firm, window, since=drawn_tasks[0].start)
    optimum = replace(tracked.fit.optimum, t=tracked.fit.optimum.t - ago)
    estimator.tracker.estimate = lambda *_: replace(tracked, fit=replace(tracked.fit, optimum=optimum))
    assert estimator.solve(drawn_tasks[0]).traversability.state is state


@pytest.mark.parametrize(("last", "state"), [(8.0, State.GO), (9.0, State.CAUTION)])
def test_a_little_measured_since_a_wheel_spun_is_no_go(last, state):
    basis = Basis(np.arange(0.0, 10.0, 0.1), 0.1)
    way = at_present(Traversability(State.GO, 1.0), basis, Watch(t=10.0, last=last), 10.0, CONFIG)
    assert way.state is state


@pytest.mark.parametrize(
    ("before", "after"),
    [
        (State.GO, State.CAUTION),
        (State.CAUTION, State.CAUTION),
        (State.NO_GO, State.NO_GO),
        (State.UNKNOWN, State.CAUTION),
    ],
)
def test_a_wheel_that_spins_is_caution_at_best_and_at_least(before, after):
    basis = Basis(np.arange(0.0, 10.0, 0.1), 0.1)
    loss = Watch(t=10.0, spinning=True)
    way = at_present(Traversability(before, None if before is State.UNKNOWN else 0.9), basis, loss, 10.0, CONFIG)
    assert way.state is after


# --- noise configured wrong, and new ground that is not valid yet ---

FORMLESS = [f"model.form.{name}=0" for name in ("peak", "peak_by_slip", "exit", "shear")]


@pytest.mark.parametrize("share", [0.25, 4.0])
def test_noise_configured_otherwise_than_it_is_leaves_values_and_stds(share):
    config = reference_configuration(FORMLESS)
    task = next(tasks(config, excited("dry_sand", 10.5), seed=2))
    variance = {name: share * values for name, values in task.window.variance.items()}
    right, wrong = WindowEstimator(config), WindowEstimator(config)
    one, other = right.solve(task), wrong.solve(replace(task, window=replace(task.window, variance=variance)))
    assert (one.status, other.status) == (Status.VALID, Status.VALID)
    for known, found in ((one.bearing, other.bearing), (one.posterior.tan_phi(), other.posterior.tan_phi())):
        assert found.value == pytest.approx(known.value, abs=0.3 * known.std)
        assert found.std == pytest.approx(known.std, rel=0.2)


@pytest.mark.parametrize(("first", "second"), [("wet_clay", "loam"), ("dry_sand", "loam")])
def test_ground_that_has_just_begun_is_not_valid(first, second):
    config = reference_configuration(["estimator.hop=0.25"])
    border, swing = 18.0, Swing(1.4, 1.8)
    soils = (Patch(0.0, first), Patch(border, second))
    scenario = Scenario(13.5, soils, swing, slip=Swing(0.05, 0.4), transition=0.2)
    truth = simulate(config, scenario, seed=2).truth
    begun = float(np.interp(border, truth["distance"], truth["t"]))
    estimator, seen = WindowEstimator(config), 0
    for task in tasks(config, scenario, seed=2):
        result = estimator.solve(task)
        if begun + 0.4 < task.end < begun + 1.4:
            seen += 1
            assert result.status is not Status.VALID
            assert result.traversability.state.value != "go"
    assert seen >= 3


# --- the watch on what the model predicts wrong ---

SECONDS = 75.0
LIMIT = 0.02
"""Share [1] of the pull above which its error is a gap: the driven slope is missing."""
MINUTE = 60.0


def results(effects):
    """Window results of a drive with effects that the configuration does not know of."""
    config = reference_configuration([f"estimator.max_prediction_error={LIMIT}", "estimator.hop=2.0"])
    hidden = effects_of(with_effects(config, effects))
    recording = simulate(config, excited("loam", SECONDS), 4, hidden)
    estimator = WindowEstimator(config)
    for i, (window, end) in enumerate(windows(config, recording)):
        yield estimator.solve(task_of(window, end, config, i))


def test_a_missing_effect_is_told_after_a_minute_by_its_channels():
    told = list(results(["grade=0.1"]))
    first = next(r for r in told if r.gaps)
    assert MINUTE <= first.t - told[0].t < MINUTE + 3.0
    assert next(iter(told[-1].gaps)) == "draft"
    assert told[-1].gaps["draft"] > LIMIT
    assert told[-1].gaps.keys() <= told[-1].prediction_error.keys()


def test_where_nothing_is_missing_no_gap_is_reported():
    assert not any(r.gaps for r in results([]))
