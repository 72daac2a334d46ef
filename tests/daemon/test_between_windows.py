"""What is decided between two windows and in reverse, and for an axle that its clutch has left behind."""

import itertools
import json
import tomllib
from dataclasses import replace
from functools import cache
from pathlib import Path

import can
import numpy as np
import pytest

from fakes import drive_messages, fed, feed_message, in_reverse
from soilbus.can.dbc_files import load_databases, output_database
from soilbus.can.log_writer import write_log
from soilbus.cli.main import main
from soilbus.config.file import parse_config
from soilbus.decision.capability import assess
from soilbus.decision.driveline import idle
from soilbus.decision.traversability import Status
from soilbus.estimation.assembly import model_of, rig_of, with_disengaged
from soilbus.estimation.instrumentation import completed, recompleted
from soilbus.estimation.observation_model import ObservationModel
from soilbus.estimation.posterior import Posterior
from soilbus.pipeline.corrections import Corrections
from soilbus.pipeline.estimator import WindowEstimator
from soilbus.pipeline.intake import Intake
from soilbus.simulator.frames import frames
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import REFERENCES, reference_configuration
from soilbus.simulator.scenario import excited
from soilbus.terra.soils import soil_named
from soilbus.terra.vehicle import axle_loads
from soilbus.trials.windows import bins_of

REAR_DRIVEN = reference_configuration(path=REFERENCES["tractor-2wd"])
TWO_MOTORS = reference_configuration(path=REFERENCES["tractor-axles"])


def decided(config, recording):
    """Result of the first window."""
    intake, last = fed(config, frames(recording, config))
    return WindowEstimator(config).solve(intake.finish(last)[0])


def test_a_chassis_in_reverse_shifts_its_load_as_forces_the_other_way_do():
    chassis = rig_of(REAR_DRIVEN).chassis
    for draft, pitch, acceleration in itertools.product((0.0, 3000.0), (0.0, 0.15, -0.1), (0.0, 0.8)):
        backward = axle_loads(chassis.in_reverse, draft, pitch, acceleration)
        assert backward == pytest.approx(axle_loads(chassis, -draft, -pitch, -acceleration))


def test_in_reverse_a_machine_climbs_as_its_mirror_image_does_forward():
    """Rear wheels that drive backward are the front wheels of the mirrored machine: both are unloaded uphill."""
    rig, soil = rig_of(REAR_DRIVEN), Posterior(soil_named("loam"), np.zeros((6, 6)))
    ahead = rig.chassis.wheelbase - rig.chassis.cg_ahead_of_rear_axle
    mirrored = replace(rig, ahead=1.0 - rig.ahead, chassis=replace(rig.chassis, cg_ahead_of_rear_axle=ahead))
    able = [
        assess(soil, machine, model_of(REAR_DRIVEN), None, np.full(4, np.nan), 0.6, 0.5)[0]
        for machine in (rig, replace(rig, chassis=rig.chassis.in_reverse), mirrored)
    ]
    forward, backward, mirror = (one.max_grade.value for one in able)
    assert backward == pytest.approx(mirror, rel=1e-4)
    assert able[1].max_draft.value == pytest.approx(able[2].max_draft.value, rel=1e-4)
    assert backward < 0.95 * forward


def test_a_window_that_ends_in_reverse_is_judged_so():
    recording = simulate(REAR_DRIVEN, excited("loam", 10.5), seed=3)
    ahead, back = (decided(REAR_DRIVEN, r).traversability for r in (recording, in_reverse(recording)))
    assert back.max_grade.value < 0.85 * ahead.max_grade.value
    assert back.max_draft.value < 0.95 * ahead.max_draft.value


def test_an_idle_motor_does_not_keep_the_others_from_their_limit():
    intake, last = fed(TWO_MOTORS, drive_messages(TWO_MOTORS, 8.0))
    torque = dict(zip(intake.rig.wheels, intake.latest(last).moment.torque, strict=True))
    ceiling = tuple(0.9 * torque[w] if w.startswith("R") else 0.0 for w in intake.rig.wheels)
    assert not intake.latest(last).moment.at_limit
    assert intake.latest(last, Corrections(ceiling)).moment.at_limit
    assert not intake.latest(last, Corrections((np.inf,) * 4)).moment.at_limit


def test_pitch_in_gaps_is_no_level_ground_between_windows():
    """A pitch sensor that was silent for the last 0.4 s: the slope goes on."""
    recording = simulate(REAR_DRIVEN, replace(excited("loam", 8.0), slope=((0.0, 0.0), (1.0, 0.1))), seed=3)
    pitch = load_databases(REAR_DRIVEN).get_message_by_name(REAR_DRIVEN.signals.pitch.signal.partition(".")[0])
    heard = list(frames(recording, REAR_DRIVEN))
    silent = [m for m in heard if m.arbitration_id != pitch.frame_id or m.timestamp < heard[0].timestamp + 7.55]
    known, gone = (intake.latest(last) for intake, last in (fed(REAR_DRIVEN, some) for some in (heard, silent)))
    assert known.pitch == pytest.approx(0.1, abs=0.01)
    assert gone.pitch is None
    assert gone.moment.given == pytest.approx(known.moment.given, abs=300.0)  # the whole slope is 2200 N


def test_frames_and_lines_judge_a_corrected_draft_alike(tmp_path):
    """A load cell that reads 2500 N too little, of which the configuration knows.

    So short a drive says too little of the largest draft of a machine without load cells for the default limit.
    """
    recording = simulate(REAR_DRIVEN, excited("loam", 20.0), seed=5)
    draft = recording.channels["draft"]
    changed = {**recording.channels, "draft": replace(draft, value=draft.value - 2500.0)}
    write_log(frames(replace(recording, channels=changed), REAR_DRIVEN), tmp_path / "drive.log")
    effect = 'model.effects=[{name="draft_offset", offset=-2500.0}]'
    outputs = ["--json", str(tmp_path / "out.jsonl"), "--frames", str(tmp_path / "frames.log")]
    wide = ["--set", "estimator.max_draft_std=0.5"]
    arguments = ["--config", "tractor-2wd", "--set", effect, *wide, str(tmp_path / "drive.log"), *outputs]
    assert main(["replay", *arguments]) == 0
    lines = [json.loads(line) for line in Path(tmp_path / "out.jsonl").read_text().splitlines()]
    database, frames_of = output_database(REAR_DRIVEN), can.LogReader(tmp_path / "frames.log")
    states = []
    for message in frames_of:
        if database.get_message_by_frame_id(message.arbitration_id).name == "Traversability":
            states.append(str(database.decode_message(message.arbitration_id, message.data)["State"]))
    said = {line["traversability"]["state"] for line in lines[-4:]}
    assert said == {"go"}
    assert set(states[-30:]) == said


def test_bins_that_leave_too_few_values_are_said_to():
    config = reference_configuration(["estimator.bin=0.5", "estimator.window=3.0"], REFERENCES["tractor-2wd"])
    result = decided(config, simulate(config, excited("loam", 10.5), seed=3))
    assert (result.status, result.reason) == (Status.NOT_EXCITED, "not_excited few_bins")
    assert result.posterior is None


# --- mechanical front-wheel drive: an axle that its clutch has left behind pulls nothing ---


def with_a_shaft_to_both_axles(lead: float = 1.0):
    """The rear motor as that of both axles, geared so that they turn alike; lead: of the front wheels' rims."""
    raw = tomllib.loads(REFERENCES["tractor-2wd"].read_text())
    rear = raw["axle"][0]
    radius = {wheel["axle"]: wheel["radius"] for wheel in raw["wheel"]}
    load = {"name": "rear", "differential": "open", "load": rear.pop("load")}
    front = {"name": "front", "differential": "open", "gear_ratio": radius["front"] / radius["rear"] / lead}
    raw["axle"] = [rear | {"name": "both", "differential": "locked"}, load, front]
    for wheel in raw["wheel"]:
        wheel.pop("driven", None)
    return parse_config(raw, REFERENCES["tractor-2wd"].parent)


def largest_draft(truth, config, seed: int):
    """Of the last window of a drive on loam."""
    intake, last = fed(config, drive_messages(truth, 14.5, seed))
    estimator = WindowEstimator(config)
    return [estimator.solve(task) for task in intake.finish(last)][-1].traversability.max_draft


@cache
def exact_drafts() -> tuple[float, float]:
    """Largest draft [N] on loam with the rear wheels and with all wheels."""
    soil = Posterior(soil_named("loam"), np.zeros((6, 6)))
    limits = ((REAR_DRIVEN, [0.0, 0.0, np.nan, np.nan]), (with_a_shaft_to_both_axles(), [np.nan] * 4))
    rear, both = (
        assess(soil, rig_of(config), model_of(config), None, np.array(limit), 0.6, 0.5)[0].max_draft.value
        for config, limit in limits
    )
    return rear, both


@pytest.mark.parametrize(("lead", "seed"), [(1.0, 3), (1.05, 4)])
def test_a_front_axle_that_is_not_engaged_does_not_count_for_the_largest_draft(lead, seed):
    rear, both = exact_drafts()
    assert both > 1.5 * rear
    found = largest_draft(REAR_DRIVEN, with_a_shaft_to_both_axles(lead), seed)
    assert abs(found.value - rear) < 3.0 * np.hypot(found.std, 0.05 * rear)
    assert found.value + 3.0 * found.std < both


@pytest.mark.parametrize("lead", [0.95, 1.0, 1.05])
def test_an_engaged_front_axle_counts_also_where_its_gear_is_not_known_well(lead):
    rear, both = exact_drafts()
    found = largest_draft(with_a_shaft_to_both_axles(), with_a_shaft_to_both_axles(lead), 3)
    assert abs(found.value - both) < 3.0 * found.std
    assert found.value - 3.0 * found.std > rear


def test_a_front_axle_stays_disengaged_while_its_speeds_are_silent():
    intake, last = fed(with_a_shaft_to_both_axles(), drive_messages(REAR_DRIVEN, 10.5))
    window, rig = intake.finish(last)[0].window, intake.rig
    apart = idle(window, rig, -np.inf, np.zeros(4, bool))
    assert apart.tolist() == rig.front.tolist()
    silent = replace(window, speed=np.where(rig.front, np.nan, window.speed))
    for before in (apart, np.zeros(4, bool)):
        assert idle(silent, rig, -np.inf, before).tolist() == before.tolist()


def test_a_disengaged_axle_has_the_rows_of_one_that_is_configured_to_roll_freely():
    config = with_a_shaft_to_both_axles()
    wheels = [w.model_copy(update={"driven": w.axle == "rear"}) for w in config.wheel]
    free = config.model_copy(update={"wheel": wheels})
    channels, soil = simulate(REAR_DRIVEN, excited("loam", 10.5), 3).channels, soil_named("loam")
    engaged, configured = rig_of(config), rig_of(free)
    rig = with_disengaged(config, engaged, engaged.front)
    given = completed(bins_of(config, channels).window(0.0, 10.0), engaged)
    ours = ObservationModel(recompleted(given, engaged, rig), rig, model_of(config), 0.2)
    other = ObservationModel(bins_of(free, channels).window(0.0, 10.0), configured, model_of(free), 0.2)
    assert ours.gain_names == other.gain_names
    assert ours.gain_std == pytest.approx(other.gain_std)
    assert ours.n_rows == other.n_rows
    one, two = (p.linearise(soil, np.zeros(len(p.gain_std)), p.start(soil)) for p in (ours, other))
    assert one.rows == pytest.approx(two.rows, rel=1e-9, abs=1e-9)
    assert one.weighed == pytest.approx(two.weighed, rel=1e-9, abs=1e-12)
    assert one.chi2 == pytest.approx(two.chi2)


def test_each_choice_of_axles_keeps_what_it_has_learned():
    """Four wheels drive, two, and four again: the third part goes on from the first, and knows more than it did."""
    config = with_a_shaft_to_both_axles(1.05)
    intake, estimator = Intake(config, load_databases(config)), WindowEstimator(config)
    trackers, drafts = [], []
    for part, truth in enumerate((config, REAR_DRIVEN, config)):
        begin = 0.0
        for message in drive_messages(truth, 18.0, 5 + part):
            begin = begin or message.timestamp
            message.timestamp += 18.0 * part
            feed_message(intake.admission, message)
        intake.ingest()
        found = [estimator.solve(task) for task in intake.due(begin + 18.0 * (part + 1) - 0.2)]
        trackers.append(estimator.tracker)
        drafts.append(found[-1].traversability.max_draft)
    assert trackers[0] is trackers[2] is not trackers[1]
    assert drafts[2].std < drafts[0].std
    assert abs(drafts[2].value - exact_drafts()[1]) < 2.5 * drafts[2].std
    assert drafts[1].value < 0.8 * drafts[2].value
