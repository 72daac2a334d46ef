"""Why windows are of no use and what to do: said in words, with the numbers of the drive."""

import re
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from fakes import drive_messages
from soilbus.can.dbc_files import load_databases
from soilbus.can.log_writer import write_log
from soilbus.decision.traversability import Status, Traversability
from soilbus.estimation.posterior import Estimate, Posterior
from soilbus.offline.replay import replay
from soilbus.pipeline.determination import Excitation
from soilbus.pipeline.pipeline import Pipeline
from soilbus.pipeline.result import WindowResult
from soilbus.report.configuration import configuration_warnings
from soilbus.report.page import Source
from soilbus.report.replay import headline, next_steps
from soilbus.report.windows import summary, summary_of, why_of_no_use
from soilbus.simulator.frames import START_TIME, frames
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import Patch, Scenario, Swing, excited
from soilbus.terra.soils import SOILS


@pytest.fixture(scope="module")
def drives(tmp_path_factory):
    """A steady pull through wet clay and a lively drive on loam, and what replay says of both."""
    config = reference_configuration(["estimator.max_bearing_std=0.035", "estimator.max_draft_std=0.9"])
    steady = Scenario(16.0, (Patch(0.0, "wet_clay"),), Swing(1.4, 1.45), draft=Swing(2500.0, 2650.0))
    recordings = [simulate(config, scenario, seed=2) for scenario in (steady, excited("loam", 16.0))]
    logs = [tmp_path_factory.mktemp("log") / f"{name}.log" for name in ("steady", "lively")]
    for log, recording in zip(logs, recordings, strict=True):
        write_log(frames(recording, config), log)
    return recordings, list(replay(Pipeline(config, load_databases(config)), logs))


def truth_of(recording, windows) -> tuple[float, float, float]:
    """Medians over the windows of draft [N], its standard deviation [N], and that over the mean."""
    t, draft = recording.truth["t"] + START_TIME, recording.truth["draft"]
    of = [draft[(t >= w.t - 10.0) & (t < w.t)] for w in windows]
    mean, sd = np.median([(x.mean(), x.std()) for x in of], axis=0)
    return float(mean), float(sd), float(sd / mean)


def test_the_summary_says_what_did_not_move_and_by_how_much(drives):
    recordings, windows = drives
    text = summary_of(windows, "two drives", None, Counter())
    assert {(w.log, w.reason) for w in windows} == {("steady.log", "not_excited load_range"), ("lively.log", "none")}
    line = next(line for line in text.splitlines() if "vary the load" in line)
    number = r"([\d.e+]+)"
    found = re.search(f"moved by {number} % only .{number} ± {number} N.*valid windows .*moved by {number} %", line)
    share, mean, sd, lively = map(float, found.groups())
    true_mean, true_sd, true_share = truth_of(recordings[0], [w for w in windows if w.log == "steady.log"])
    assert mean == pytest.approx(true_mean, abs=0.01 * true_mean + 5.0)
    assert sd == pytest.approx(true_sd, rel=0.15, abs=2.0)  # without the load cell's 40 N
    assert share == pytest.approx(100.0 * true_share, rel=0.15, abs=0.3)
    *_, true_lively = truth_of(recordings[1], [w for w in windows if w.log == "lively.log"])
    assert lively == pytest.approx(100.0 * true_lively, rel=0.1)
    assert f"of use: {len(windows) // 2} valid, {len(windows) // 2} with a doubtful estimate; of no use: 0" in text


def window(reason: str, status: Status = Status.INVALID, **more) -> WindowResult:
    return WindowResult(
        1.0, 0, status, reason, None, None, {}, {}, Traversability(), more.pop("chi2", None), 0, {}, **more
    )


@pytest.mark.parametrize(
    ("reason", "says"),
    [
        ("input_missing load.FL draft", "no usable value of load.FL, draft ever came"),
        ("input_missing wheels", "no wheel that drives has a torque and a speed mapped"),
        ("input_stale torque.RR", "torque.RR had pauses"),
        ("implausible ground_speed", "ground_speed contradicts the other sensors"),
        ("standstill", "drive"),
        ("turning", "drive straight"),
        ("no_convergence", "check signs and scales"),
        ("not_excited few_bins", "estimator.bin"),
        ("model_mismatch", "the model predicts torque 31 % off"),
        ("internal_error", None),
    ],
)
def test_each_reason_has_its_advice(reason, says):
    unknown = [window(reason, prediction_error={"draft": 0.1, "torque": share}) for share in (0.2, 0.31, 0.9)]
    text = summary_of(unknown, "a log", 0, Counter())
    assert f"    3 invalid: {reason}\n" in text
    assert says is None or says in text
    line = why_of_no_use(unknown, 10.0)
    assert line.startswith(f"no window could be used: 3 of 3 are invalid: {reason}")
    assert says is None or says in line
    assert "\n" not in line
    for text_ in (text, line):
        assert "nan" not in text_
        assert "None" not in text_


@pytest.mark.parametrize(
    ("valid", "said"),
    [
        (0, "The soil is known in none of 3 windows, doubtful in 3; 3 are degraded: not_excited"),
        (2, "The soil is known in 2 of 5 windows"),
    ],
)
def test_where_nothing_decides_the_page_says_first_in_how_many_windows_the_soil_is_known(valid, said):
    loam = Posterior(SOILS["loam"], 0.1 * np.eye(6))
    doubtful, good = window("not_excited", Status.DEGRADED), window("none", Status.VALID)
    results = [replace(each, posterior=loam) for each in [doubtful] * 3 + [good] * valid]
    assert headline(results, reference_configuration()) == said


def test_a_draft_about_zero_has_no_share():
    windows = [window("not_excited", Status.NOT_EXCITED, excitation=Excitation(3.0, 160.0, 0.02, 0.01))]
    text = summary_of(windows, "a log", None, Counter())
    assert "vary the load more: the draft was 3 ± 160 N, slip was 2.0 ± 1.0 %" in text


def test_one_cell_for_two_wheels_is_warned_of_and_widens_what_it_is_worth(tmp_path):
    recording = simulate(reference_configuration(), excited("loam", 14.0), seed=2)
    write_log(frames(recording, reference_configuration()), log := tmp_path / "drive.log")
    shared, alone = reference_configuration(["wheel.FR.load=WheelLoads.FL"]), reference_configuration()
    alone = alone.model_copy(
        update={"wheel": [w.model_copy(update={"load": None}) if w.name == "FR" else w for w in alone.wheel]}
    )
    of_shared, of_alone = (list(replay(Pipeline(config, load_databases(config)), [log])) for config in (shared, alone))
    assert {w.reason for w in of_alone} == {"none"}
    true = SOILS["loam"].bearing_pressure(shared.estimator.z_ref, shared.estimator.b_ref)
    for one, other in zip(of_shared, of_alone, strict=True):
        assert abs(one.bearing.value - true) < 1.96 * one.bearing.std
        assert max(one.noise_factors.values()) > max(other.noise_factors.values())
    assert any("WheelLoads.FL" in line and "for that one alone" in line for line in configuration_warnings(shared))


def test_a_draft_that_never_is_is_not_said_to_have_moved():
    nothing = window("not_excited", Status.NOT_EXCITED, excitation=Excitation(0.0, 0.0, 0.2, 0.05))
    text = summary_of([nothing], "a drive", None, Counter())
    assert "vary the load more: slip was 20.0 ± 5.0 %" in text


@pytest.mark.parametrize("draft", [None, 900.0])
def test_the_summary_says_why_no_go_is_given_without_a_draft(draft):
    could = Traversability(max_draft=Estimate(9000.0, 500.0))
    seen = window("none", Status.VALID, excitation=Excitation(draft, draft))
    seen = replace(seen, traversability=could, bearing=Estimate(1e5, 5e3))
    text = summary_of([seen], "a log", None, Counter())
    assert ("no sensor shows the draft" in text) is (draft is None)


def test_a_replay_says_that_no_sensor_shows_the_slope(tmp_path):
    config = reference_configuration()
    level = config.model_copy(update={"signals": config.signals.model_copy(update={"pitch": None})})
    log = tmp_path / "drive.log"
    write_log(drive_messages(config, 12.0, seed=2), log)
    said = {}
    for name, own in (("measured", config), ("level", level)):
        pipeline = Pipeline(own, load_databases(own))
        results = list(replay(pipeline, [log]))
        steps = " ".join(step.sentence for step in next_steps(results, Source(own)))
        said[name] = (summary(results, pipeline), steps)
    assert all("the ground counts as level" in text for text in said["level"])
    assert not any("the ground counts as level" in text for text in said["measured"])
