"""Windows in, states out: the decision as the service makes it, with a tracker that returns given outputs."""

from dataclasses import replace

import numpy as np
import pytest

from fakes import feed_message
from soilbus.can.dbc_files import load_databases
from soilbus.decision.judgement import Basis, at_present
from soilbus.decision.traversability import State, Status, Traversability
from soilbus.decision.watch import Watch
from soilbus.estimation.tracker import TrackerOutput
from soilbus.pipeline.estimator import WindowEstimator
from soilbus.pipeline.intake import WindowTask
from soilbus.pipeline.pipeline import Pipeline
from soilbus.simulator.frames import frames
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import excited
from tests.lab.stories.onlooker import good_tracked, of_soft_ground, tracked_at

CONFIG = reference_configuration()


@pytest.fixture(scope="module")
def tasks() -> list[WindowTask]:
    """Windows of a good drive, from its frames."""
    pipeline = Pipeline(CONFIG, load_databases(CONFIG))
    for message in frames(simulate(CONFIG, excited("loam", 16.0), 3), CONFIG):
        feed_message(pipeline.admission, message)
    return pipeline.intake.finish(message.timestamp)


@pytest.fixture(scope="module")
def firm() -> TrackerOutput:
    return good_tracked()


def decided(tasks, outputs):
    """Results of the windows, for which the tracker returns these outputs."""
    estimator = WindowEstimator(CONFIG)
    found = []
    for task, tracked in zip(tasks, outputs, strict=False):
        estimator.tracker.estimate = lambda window, end, tracked=tracked: tracked_at(
            tracked, window, since=end - CONFIG.estimator.window * tracked.since
        )
        found.append(estimator.solve_unwatched(task))
    return found


def of(tracked: TrackerOutput, share: float = 1.0, **changed) -> TrackerOutput:
    """The output for a window of which the soil fills this share."""
    return replace(tracked, since=share, **changed)


def states(tasks, outputs):
    return [result.traversability.state for result in decided(tasks, outputs)]


def test_a_better_state_needs_two_windows_in_a_row(tasks, firm):
    good, bad = of(firm), of(of_soft_ground(firm))
    assert states(tasks, [good, good]) == [State.GO, State.GO]
    found = states(tasks, [bad, good, bad, good, good])
    assert found[0] is found[2] is State.NO_GO
    assert found[1] is found[3] is not State.GO
    assert found[4] is State.GO


def test_a_fresh_window_is_not_held_back_by_hysteresis(tasks, firm):
    restarted = [tasks[0], replace(tasks[1], fresh=True)]
    assert states(restarted, [of(of_soft_ground(firm)), of(firm)]) == [State.NO_GO, State.GO]


def test_a_little_of_a_new_soil_is_no_go(tasks, firm):
    little, enough = decided(tasks[:1], [of(firm, 0.1)])[0], decided(tasks[:1], [of(firm, 0.3)])[0]
    assert (little.status, little.reason) == (Status.NOT_EXCITED, "not_excited new_soil")
    assert little.traversability.state is not State.GO
    assert (enough.status, enough.traversability.state) == (Status.VALID, State.GO)


@pytest.mark.parametrize(("ago", "state"), [(1.0, State.GO), (2.5, State.UNKNOWN)])
def test_ground_left_behind_is_unknown(ago, state, tasks, firm):
    """At more than 1 m/s the instants before the last second lie within the vehicle's length, older ones do not."""
    window = tasks[0].window
    assert window.ground_speed.min() > 1.0
    estimator = WindowEstimator(CONFIG)
    tracked = tracked_at(firm, window, since=tasks[0].start)
    optimum = replace(tracked.fit.optimum, t=tracked.fit.optimum.t - ago)
    estimator.tracker.estimate = lambda *_: replace(tracked, fit=replace(tracked.fit, optimum=optimum))
    assert estimator.solve(tasks[0]).traversability.state is state


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
