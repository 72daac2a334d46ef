"""What becomes of a good recording when a sender dies, lies or stammers: one table of faults.

Each row edits one good drive from a moment on and says which status and reason the last
window must have.  Of every row holds besides: a window that calls itself valid is right
(bearing pressure, tan phi and largest draft within four of its standard deviations), and GO does not outlast
a fault for which the status is not valid.
"""

import json
import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

import log_edits as le
from log_edits import Edit, Log, Stream
from soilbus.can.dbc_files import load_databases
from soilbus.config.file import load_config
from soilbus.config.model import Config
from soilbus.decision.traversability import State, Status
from soilbus.offline.replay import read_frames
from soilbus.pipeline.pipeline import Pipeline
from soilbus.pipeline.result import WindowResult
from soilbus.simulator.frames import frames
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import Patch, Scenario, Swing, excited
from soilbus.terra.soils import soil_named
from soilbus.trials.boggings import largest_draft

FIELD_TOML = Path(__file__).resolve().parents[1] / "field/field.toml"
START = 1_700_000_000.0
FAULT = START + 11.0
FROM_THE_START = START - 1.0
LENGTH, BORDER = 18.2, 16.2
"""Seconds of a recording; of one that at first looks like another soil."""
HOP = "estimator.hop=2.0"
NOTICED = 2.5
"""Seconds after which a fault must have been noticed."""
SIDES = ("FL", "FR", "RL", "RR")
BAD = frozenset({Status.DEGRADED, Status.INVALID})
GOOD = frozenset({Status.VALID})


class Fault(NamedTuple):
    """An edit, statuses and reason that the last window may have, and why samples are refused ("": none is)."""

    edit: Edit
    status: frozenset[Status]
    reason: str
    refused: str = ""
    since: float = FAULT
    length: float = LENGTH


class Drive(NamedTuple):
    """A good recording with its configuration and the truth: bearing pressure [Pa], tan phi and largest draft [N]."""

    config: Config
    log: Log
    truth: tuple[float, float, float]


def motors(message: str) -> list[str]:
    return wheels(f"wheel.{{0}}.motor_speed={message}{{0}}.ShaftSpeed")


@pytest.fixture(scope="module")
def loam(field_recording) -> Drive:
    """The field vehicle on loam."""
    config = load_config(FIELD_TOML, [HOP, *motors("Mcu")])
    soil = json.loads(field_recording("loam.soil.json").read_text())
    bearing = (soil["k_c"] / 0.3 + soil["k_phi"]) * 0.02 ** soil["n"]
    read = ((t, i, x, bytes(data)) for t, i, x, data, *_ in read_frames(field_recording("loam.log.gz")))
    truth = bearing, math.tan(math.radians(soil["phi_deg"])), largest_draft(config, "loam")
    return Drive(config, Log(read, load_databases(config)), truth)


def simulated(scenario: Scenario, soil: str) -> Drive:
    config = reference_configuration([HOP, *motors("Motor")])
    messages = frames(simulate(config, scenario, seed=3), config)
    log = Log(
        ((m.timestamp, m.arbitration_id, m.is_extended_id, bytes(m.data)) for m in messages), load_databases(config)
    )
    known = soil_named(soil)
    return Drive(config, log, (known.bearing_pressure(0.02, 0.3), math.tan(known.phi), largest_draft(config, soil)))


@pytest.fixture(scope="module")
def reference() -> Drive:
    """The reference tractor on loam: counters and checksums, motor speeds, torque limits."""
    return simulated(excited("loam", LENGTH), "loam")


@pytest.fixture(scope="module")
def clay() -> Drive:
    """The reference tractor on wet clay, at the end of its strength."""
    hard = Scenario(14.2, (Patch(0.0, "wet_clay"),), Swing(1.2, 1.6), draft=Swing(2e3, 4e3), lift_slip=Swing(0.5, 0.65))
    return simulated(hard, "wet_clay")


def run(drive: Drive, edit: Edit, since: float, length: float) -> tuple[list[WindowResult], Pipeline]:
    log = drive.log
    whole = Log.of({n: s.before(START + length) for n, s in log.streams.items()})
    pipeline = Pipeline(drive.config, load_databases(drive.config))
    results: list[WindowResult] = []
    now = 0.0
    for i, frame in enumerate(edit(whole, since).frames()):
        now = frame[0]
        if i % 400 == 0:
            results += pipeline.advance(now)
        pipeline.feed(*frame)
    return results + pipeline.finish(now), pipeline


def deviations(result: WindowResult, truth: tuple[float, float, float]) -> list[float]:
    told = result.bearing, result.posterior.tan_phi(), result.traversability.max_draft
    return [abs(e.value - value) / e.std for e, value in zip(told, truth, strict=True)]


def judge(drive: Drive, fault: Fault) -> None:
    results, pipeline = run(drive, fault.edit, fault.since, fault.length)
    last, refused = results[-1], pipeline.intake.refusals.total
    assert (last.status in fault.status, last.reason) == (True, fault.reason), (last.status, last.reason)
    assert set(refused) == set(fault.refused.split())
    for r in results:
        assert r.status is not Status.VALID or max(deviations(r, drive.truth)) < 4.0, (r.t, deviations(r, drive.truth))
        if fault.status is not GOOD and r.t > fault.since + NOTICED:
            assert r.traversability.state is not State.GO, r.t


def wheels(pattern: str) -> list[str]:
    return [pattern.format(w) for w in SIDES]


TORQUES, MOTORS = wheels("Mcu{}.ShaftTorque"), wheels("Mcu{}.ShaftSpeed")
SPEEDS, LOADS, SINKS = wheels("WheelSpeeds.{}"), wheels("AxleLoads.{}"), wheels("RideHeight.Sink{}")
RADAR = "GroundBasedSpeedAndDistance"
GROUND, DRAFT = f"{RADAR}.GroundBasedMachineSpeed", "DrawbarPin.Draft"
PITCH, ACCELERATION = "Attitude.Pitch", "Attitude.LongAccel"
STREAMS = {
    "McuFL": "torque.FL",
    "WheelSpeeds": " ".join(wheels("speed.{}")),
    "AxleLoads": " ".join(wheels("load.{}")),
    "DrawbarPin": "draft",
    RADAR: "ground_speed",
    "Attitude": "pitch acceleration",
}


def lies(*names: str) -> str:
    return " ".join(["implausible", *names])


def of_all(quantity: str) -> list[str]:
    return wheels(quantity + ".{}")


FAULTS = {
    "nothing": Fault(le.both(), GOOD, "none"),
    # silent from the start, and from a moment on
    **{
        f"{m} deleted": Fault(
            le.cut(m), frozenset({Status.INVALID}), f"input_missing {STREAMS[m]}", since=FROM_THE_START
        )
        for m in ("AxleLoads", RADAR)
    },
    **{f"{m} cut": Fault(le.cut(m), BAD, f"input_stale {STREAMS[m]}") for m in ("McuFL", "Attitude")},
    "RideHeight deleted": Fault(le.cut("RideHeight"), GOOD, "none", since=FROM_THE_START),
    "RideHeight cut": Fault(le.cut("RideHeight"), GOOD, "none"),
    # the same reading for ever, in frames that go on
    "torque frozen": Fault(le.frozen(TORQUES[0]), BAD, lies("torque.FL")),
    "all speeds frozen": Fault(le.frozen(*SPEEDS), BAD, lies(*of_all("speed"))),
    "ground speed frozen": Fault(le.frozen(GROUND), BAD, lies("ground_speed")),
    "sinkage frozen": Fault(le.frozen(SINKS[3]), GOOD, lies("sinkage.RR")),
    "everything frozen": Fault(
        le.frozen(*TORQUES, *SPEEDS, *LOADS, *SINKS, GROUND, DRAFT, PITCH), BAD,
        lies(*of_all("torque"), *of_all("load"), *of_all("speed"), *of_all("sinkage"), "ground_speed draft pitch"),
    ),
    # dead at zero
    "torque zero": Fault(le.scaled(0.0, TORQUES[3]), BAD, lies("torque.RR")),
    "ground speed zero": Fault(le.scaled(0.0, GROUND), frozenset({Status.NOT_EXCITED}), "standstill"),
    # single wild readings, and so many that they are no longer single
    "torque spiked": Fault(le.spiked(100.0, 50, TORQUES[0]), GOOD, "none", "outlier"),
    "draft spiked": Fault(le.spiked(8e3, 50, DRAFT), GOOD, "none", "outlier"),
    "load spiked often": Fault(le.spiked(5e3, 5, LOADS[0]), BAD, "model_mismatch", "outlier", length=BORDER),
    # late
    "speeds 50 ms late": Fault(le.delayed(0.05, "WheelSpeeds"), GOOD, "none"),
    "attitude 200 ms late": Fault(le.delayed(0.2, "Attitude"), GOOD, "none"),
    "motor 200 ms late": Fault(le.delayed(0.2, "McuFL"), BAD, lies("motor_speed.FL"), length=BORDER),
    "loads 1 s late": Fault(le.delayed(1.0, "AxleLoads"), BAD, "model_mismatch", length=BORDER),
    "ground speed 1 s late": Fault(le.delayed(1.0, RADAR), BAD, "input_stale ground_speed"),
    "attitude 1 s late": Fault(le.delayed(1.0, "Attitude"), BAD, "model_mismatch"),
    "speeds stamped 50 ms early": Fault(le.stamped_early(0.05, "WheelSpeeds"), GOOD, "none", "time_backwards"),
    "loads stamped 0.5 s early": Fault(
        le.stamped_early(0.5, "AxleLoads"), BAD, "input_stale load.FL load.FR load.RL load.RR", "time_backwards"
    ),
    # mounted or wired wrongly
    "torque sign": Fault(le.flipped(TORQUES[1]), BAD, lies("torque.FR")),
    "all torques sign": Fault(le.flipped(*TORQUES), BAD, lies(*of_all("torque"))),
    "speed sign": Fault(le.flipped(SPEEDS[0]), BAD, "input_stale speed.FL", "error"),
    "sinkage sign": Fault(le.flipped(SINKS[0]), BAD, "model_mismatch", "implausible"),
    "draft sign": Fault(le.flipped(DRAFT), BAD, lies("draft"), since=FROM_THE_START, length=12.2),
    "acceleration sign": Fault(le.flipped(ACCELERATION), GOOD, "none", since=FAULT + 5.0),
    "speeds swapped": Fault(
        le.swapped(SPEEDS[0], SPEEDS[2]), BAD, lies("speed.FL", "speed.RL"), since=FROM_THE_START, length=12.2
    ),
    "torques swapped": Fault(le.swapped(TORQUES[0], TORQUES[2]), BAD, "model_mismatch", length=BORDER),
    "left and right swapped whole": Fault(
        le.both(*(le.swapped(q[0], q[1]) for q in (TORQUES, MOTORS, SPEEDS, LOADS, SINKS))), GOOD, "none"
    ),
    # another gear, another pulse wheel, another bridge
    "motor of another gear": Fault(le.scaled(0.75, MOTORS[0], TORQUES[0]), BAD, lies("motor_speed.FL"), length=BORDER),
    "all motors of another gear": Fault(
        le.scaled(0.75, *MOTORS, *TORQUES), BAD, lies(*of_all("speed"), *of_all("motor_speed"))
    ),
    "speed of another pulse wheel": Fault(le.scaled(1.3, SPEEDS[2]), BAD, lies("speed.RL")),
    "ground speed doubled": Fault(le.scaled(2.0, GROUND), BAD, lies("ground_speed")),
    "ground speed halved": Fault(le.scaled(0.5, GROUND), BAD, lies("ground_speed"), length=BORDER),
    "ground speed halved from the start": Fault(
        le.scaled(0.5, GROUND), BAD, lies("ground_speed", "acceleration"), since=FROM_THE_START, length=12.2
    ),
    "load doubled": Fault(le.scaled(2.0, LOADS[3]), BAD, lies("load.RR")),
    "all loads doubled": Fault(le.scaled(2.0, *LOADS), BAD, lies(*of_all("load"))),
    "load zero lost": Fault(le.offset(1500.0, LOADS[0]), BAD, "model_mismatch", length=BORDER),
    # codes that are no values
    "torque not valid": Fault(le.codes(0, "McuFL.State"), BAD, "input_stale torque.FL", "not_valid"),
    "ground speed reserved": Fault(le.codes(0xFB80, GROUND), BAD, "input_stale ground_speed", "reserved"),
    "sinkage out of reason": Fault(le.codes(0x7FF0, SINKS[0]), GOOD, "none", "implausible"),
    # stammering senders
    "duplicated": Fault(le.duplicated, GOOD, "none", "duplicate"),
}  # fmt: skip


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_has_its_status_its_reason_and_no_wrong_valid_window(name, loam):
    judge(loam, FAULTS[name])


OURS = {
    "nothing": Fault(le.both(), GOOD, "none"),
    "draft's counter stuck": Fault(le.stalled("DrawbarPin"), BAD, "input_stale draft", "bad_counter"),
    "draft frozen with running counter": Fault(le.frozen("DrawbarPin.Draft"), BAD, lies("draft")),
    "torque limit lost": Fault(le.codes(0xFFFF, "MotorFL.TorqueLimit"), GOOD, "none", "not_available"),
    "motor speed of another gear": Fault(le.scaled(0.75, "MotorFR.ShaftSpeed"), GOOD, lies("motor_speed.FR")),
    "motor speed stands": Fault(le.scaled(0.0, "MotorRL.ShaftSpeed"), GOOD, lies("motor_speed.RL")),
    "acceleration sign": Fault(le.flipped("Attitude.LongAccel"), BAD, lies("acceleration"), since=FROM_THE_START),
    "draft error": Fault(le.codes(0xFEFF, "DrawbarPin.Draft"), BAD, "input_stale draft", "error"),
}


@pytest.mark.parametrize("name", OURS)
def test_the_reference_tractor_too(name, reference):
    judge(reference, OURS[name])


FLOAT_DRAFT = """\
BO_ 1328 DrawbarPin: 8 HITCH
 SG_ Draft : 0|32@1- (1,0) [0|0] "N" TERRAIN
 SG_ Valid : 32|2@1+ (1,0) [0|3] "" TERRAIN
"""


@pytest.mark.parametrize("value", [np.nan, 3.0e38])
def test_a_float_that_is_no_number_is_refused(value, loam, tmp_path):
    lines = (FIELD_TOML.parent / "field.dbc").read_text().splitlines(keepends=True)
    at = next(i for i, line in enumerate(lines) if "DrawbarPin" in line)
    valtype = "\nSIG_VALTYPE_ 1328 Draft : 1;\n"
    (tmp_path / "field.dbc").write_text("".join([*lines[:at], FLOAT_DRAFT, *lines[at + 3 :], valtype]))
    (tmp_path / "field.toml").write_text(FIELD_TOML.read_text())
    config = load_config(tmp_path / "field.toml", [HOP])
    message = load_databases(config).get_message_by_name("DrawbarPin")

    def as_float(log: Log, t: float) -> Log:
        draft = log.streams["DrawbarPin"]
        payload = np.zeros((len(draft.t), 8), np.uint8)
        payload[:, :4] = np.where(draft.t < t, draft.signal("Draft"), value).astype("<f4")[:, None].view(np.uint8)
        payload[:, 4] = 1
        return Log.of({**log.streams, "DrawbarPin": Stream(message, draft.t, payload)})

    reason = "not_finite" if not np.isfinite(value) else "implausible"
    judge(Drive(config, loam.log, loam.truth), Fault(as_float, BAD, "input_stale draft", reason))


def test_the_sensor_is_believed_again_when_the_lie_has_left_the_window(loam):
    mended = le.both(le.frozen(TORQUES[0]), lambda log, t: Log.of({**log.streams, "McuFL": _mended(loam, log)}))
    results, _ = run(loam, mended, FAULT, 25.2)
    assert [r.reason for r in results if r.t > FAULT + 2.0][:2] == [lies("torque.FL")] * 2
    assert (results[-1].status, results[-1].reason) == (Status.VALID, "none")


def _mended(drive: Drive, log: Log):
    """The edited stream until 2 s after the fault, the good one from then on."""
    bad, good = log.streams["McuFL"], drive.log.streams["McuFL"].before(START + 25.2)
    payload = np.where((bad.t < FAULT + 2.0)[:, None], bad.payload, good.payload)
    return bad.with_payload(payload)


LIES_ON_CLAY: dict[str, Edit] = {
    "nothing": le.both(),
    "torques zero": le.scaled(0.0, *wheels("Motor{}.ShaftTorque")),
    "torques three quarters": le.scaled(0.75, *wheels("Motor{}.ShaftTorque")),
    "draft zero": le.scaled(0.0, "DrawbarPin.Draft"),
    "draft three quarters": le.scaled(0.75, "DrawbarPin.Draft"),
    "ground speed a third too high": le.scaled(1.33, GROUND),
    "wheel speeds three quarters": le.scaled(0.75, *SPEEDS),
    "loads a tenth too low": le.scaled(0.9, *wheels("WheelLoads.{}")),
    "sinkages a third too low": le.scaled(0.67, *SINKS),
    "torque sign": le.flipped("MotorFL.ShaftTorque"),
}


@pytest.mark.parametrize("name", LIES_ON_CLAY)
def test_no_lie_turns_no_go_into_go(name, clay):
    results, _ = run(clay, LIES_ON_CLAY[name], FROM_THE_START, 14.2)
    assert len(results) == 3
    states = {r.traversability.state for r in results}
    assert State.GO not in states
    assert name != "nothing" or states == {State.NO_GO}
