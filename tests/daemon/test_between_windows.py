"""What is decided between two windows, and in reverse, has the same inputs and the same vehicle as the windows."""

import itertools
import json
from dataclasses import replace
from pathlib import Path

import can
import numpy as np
import pytest

from fakes import feed_message, in_reverse
from soilbus.can.dbc_files import load_databases, output_database
from soilbus.can.log_writer import write_log
from soilbus.cli.main import main
from soilbus.decision.capability import assess
from soilbus.decision.traversability import Status
from soilbus.estimation.assembly import model_of, rig_of
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

REAR_DRIVEN = reference_configuration(path=REFERENCES["tractor-2wd"])
TWO_MOTORS = reference_configuration(path=REFERENCES["tractor-axles"])


def fed(config, recording, silent: str = "", since: float = np.inf) -> tuple[Intake, float]:
    """An intake with the frames of a recording, but for one message from a time [s] on, and the time of the last."""
    database = load_databases(config)
    intake = Intake(config, database)
    begin = None
    for message in frames(recording, config, database):
        begin = message.timestamp if begin is None else begin
        name = database.get_message_by_frame_id(message.arbitration_id).name
        if name != silent or message.timestamp - begin < since:
            feed_message(intake.admission, message)
    intake.ingest()
    return intake, message.timestamp


def decided(config, recording):
    """Result of the first window."""
    intake, last = fed(config, recording)
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
    intake, last = fed(TWO_MOTORS, simulate(TWO_MOTORS, excited("loam", 8.0), seed=3))
    torque = dict(zip(intake.rig.wheels, intake.latest(last).moment.torque, strict=True))
    ceiling = tuple(0.9 * torque[w] if w.startswith("R") else 0.0 for w in intake.rig.wheels)
    assert not intake.latest(last).moment.at_limit
    assert intake.latest(last, Corrections(ceiling)).moment.at_limit
    assert not intake.latest(last, Corrections((np.inf,) * 4)).moment.at_limit


def test_pitch_in_gaps_is_no_level_ground_between_windows():
    """A pitch sensor that was silent for the last 0.4 s: the slope goes on."""
    recording = simulate(REAR_DRIVEN, replace(excited("loam", 8.0), slope=((0.0, 0.0), (1.0, 0.1))), seed=3)
    message = REAR_DRIVEN.signals.pitch.signal.partition(".")[0]
    heard, silent = (fed(REAR_DRIVEN, recording, message, since) for since in (np.inf, 7.55))
    known, gone = (intake.latest(last) for intake, last in (heard, silent))
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
