"""What a completed model says the tractor can pull is what the simulated tractor pulls."""

from typing import NamedTuple

import numpy as np
import pytest

from fakes import drive_messages
from soilbus.can.dbc_files import load_databases
from soilbus.can.log_writer import write_log
from soilbus.decision.balance import Duty, balance
from soilbus.decision.capability import slip_grid
from soilbus.decision.wheels import Axles, wheel_table
from soilbus.estimation.assembly import effects_and_parameters_of, effects_of, rig_of, with_effects
from soilbus.estimation.nuisance_parameters import active_at
from soilbus.offline.replay import fed
from soilbus.pipeline.pipeline import Pipeline
from soilbus.simulator.drive import drive
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import Patch, Scenario, Swing
from soilbus.terra.effects.steady import CompletedModel
from soilbus.terra.soils import SOILS
from soilbus.terra.wheel import Soil, WheelModel, state_on

CONFIG = reference_configuration()
SPEED, SLIPS = 1.3, (0.08, 0.2, 0.4)
ON_WHEELS = (
    "multipass=0.5", "slip_sinkage=0.15", "stress_peak_shift.c2=0.1", "rut_recovery=0.15", "lugs=0.03",
    "bulldozing=1e5", "rate_stiffening=0.1", "tyre_deflection=4e-6", "rolling_radius.rear=0.03",
)  # fmt: skip


def completed(*effects: str) -> CompletedModel:
    return CompletedModel.of(WheelModel(), effects_of(with_effects(CONFIG, effects)), SPEED)


class Curve(NamedTuple):
    pull: np.ndarray
    torque: np.ndarray  # (W, S), as sinkage
    sinkage: np.ndarray


def curve(model: CompletedModel, soil: Soil, slips=SLIPS) -> Curve:
    table = wheel_table(np.array([soil]), rig_of(CONFIG), model, np.array(slips))
    kinds = table.axles.of_wheel
    sinkage = model.sinkage(table.at[2, 0].T, table.axles.wheel(table.load[0].T)).T
    return Curve(table.pull[0], table.at[1, 0][kinds], sinkage[kinds])


@pytest.mark.parametrize("effect", ON_WHEELS)
def test_the_pull_is_that_of_a_simulated_drive(effect):
    at = curve(completed(effect), SOILS["loam"])
    config = with_effects(CONFIG, [effect])
    plain = curve(CompletedModel(WheelModel()), SOILS["loam"]).pull
    for i, slip in enumerate(SLIPS):
        scenario = Scenario(
            0.1, (Patch(0.0, "loam"),), speed=Swing(SPEED, SPEED), slip=Swing(slip, slip), slip_spread=0.0,
            side_shift=Swing(0.0, 0.0),
        )  # fmt: skip
        truth = drive(config, scenario, 1).columns
        assert at.pull[i] == pytest.approx(truth["draft"][0], abs=0.5)
        torques = [truth[f"torque.{wheel}"][0] for wheel in ("FL", "FR", "RL", "RR")]
        assert at.torque[:, i] == pytest.approx(torques, abs=0.2)
        sinkages = [truth[f"sinkage.{wheel}"][0] for wheel in ("FL", "FR", "RL", "RR")]
        assert at.sinkage[:, i] == pytest.approx(sinkages, abs=1e-5)
    assert np.abs(at.pull - plain).max() > 10.0


@pytest.mark.parametrize("effect", ["tyre_deflection=8e-6", "rolling_radius.front=0.05"])
def test_the_sinkage_limit_is_that_of_the_wheel_with_its_effects(effect):
    model, axles = completed(effect), Axles.of(rig_of(CONFIG), np.ones(4, bool))
    wheel = axles.wheel(np.array([4000.0, 6000.0]))
    angle = model.angle_of_sinkage(0.12, wheel)
    assert model.sinkage(angle, wheel) == pytest.approx([0.12, 0.12], abs=1e-6)
    assert np.abs(angle - CompletedModel(WheelModel()).angle_of_sinkage(0.12, wheel)).max() > 0.005


def test_the_drive_line_asks_more_of_the_motors_for_the_same_pull():
    plain = curve(CompletedModel(WheelModel()), SOILS["loam"])
    lossy = curve(completed("drivetrain_loss=0.05", "drivetrain_loss.drag=20"), SOILS["loam"])
    assert lossy.pull == pytest.approx(plain.pull, abs=1e-3)
    assert lossy.torque == pytest.approx(1.05 * plain.torque + 20.0, rel=1e-6)


@pytest.mark.parametrize(
    "effect", ["torque_lag=0.2", "draft_offset=300", "wheel_load_offset=200", "inertia=0.5", "grade=0.05"]
)
def test_sensors_and_records_do_not_change_the_pull(effect):
    plain = curve(CompletedModel(WheelModel()), SOILS["loam"])
    assert curve(completed(effect), SOILS["loam"]).pull == pytest.approx(plain.pull, abs=1e-3)


@pytest.mark.parametrize("effect", [*ON_WHEELS, "drivetrain_loss=0.05"])
@pytest.mark.parametrize("duty", [Duty(), Duty(0.0, None), Duty(None, 0.08)], ids=["level", "grade", "on a slope"])
def test_every_duty_is_in_balance_with_effects(effect, duty):
    model, soil, slips = completed(effect), SOILS["loam"], slip_grid(0.6)
    table = wheel_table(np.array([soil]), rig_of(CONFIG), model, slips)
    found, axles = balance(table, duty), table.axles
    draft, sine = duty.split(found.pull, axles.weight)
    load = axles.loads(*np.broadcast_arrays(draft, sine))[0]
    assert (axles.count * found.drawbar[0]).sum(axis=0) == pytest.approx(found.pull[0], abs=2e-4 * axles.weight)
    state = state_on(soil, found.angle[0], found.slip, axles.radius, axles.width)
    forces = model.forces(state, ~axles.front, load)
    for is_, should, tolerance in zip(
        (load, found.drawbar[0], found.torque[0]), forces, (1e-3, 5e-4, 5e-4), strict=True
    ):
        assert is_ == pytest.approx(should, abs=tolerance * axles.weight)


def test_the_demand_is_the_draft_without_the_error_of_its_load_cell(tmp_path):
    plain = reference_configuration(["noise.draft.gain=0.0"])  # else the gain as fitted is taken off besides
    config = with_effects(plain, ["draft_offset=300", "draft_gain=0.05"])
    log = tmp_path / "drive.log"
    write_log(drive_messages(config, 10.2), log)
    needs = []
    for known in (plain, config):
        pipeline = Pipeline(known, load_databases(known))
        for now in fed(pipeline.intake, log):
            needs += [pipeline.estimator.estimate(task).demand.pull for task in pipeline.intake.due(now)]
    draft, true = needs
    assert draft - true == pytest.approx(300.0 + 0.05 * true, rel=0.02)


def test_values_in_the_decision_are_those_of_the_window():
    setting = '[{name="multipass",stiffness={value=0.4,std=0.1},density=0.05},{name="soil_drift",stiffness=0.1}]'
    config = reference_configuration([f"model.effects={setting}"])
    effects, free = effects_and_parameters_of(config)
    assert [effect.name for effect in effects] == ["multipass"]  # the drift is of one record
    assert [(f.name, f.value, f.std) for f in free] == [
        ("multipass.stiffness", 0.4, 0.1), ("multipass.density", 0.05, 0.0),
        ("multipass.shear", 0.0, 0.0), ("multipass.reloading", 0.0, 0.0),
    ]  # fmt: skip
    (active,) = active_at(effects, free, np.array([1.5, 0.0, 0.0, 0.0]), 4)
    assert active.values == pytest.approx({"stiffness": 0.55, "density": 0.05, "shear": 0.0, "reloading": 0.0})
    Pipeline(config, load_databases(config))


def test_each_wheel_has_its_own_values():
    text = '[{name="wheel_load_offset",offset={FL={value=100.0,std=20.0},RR=50.0},drift={value=0.5,std=0.1}}]'
    config = reference_configuration([f"model.effects={text}"])
    _, free = effects_and_parameters_of(config)
    offsets, drifts, rates = free[:4], free[4:8], free[8:]
    assert all(f.std == 0.0 for f in rates)
    assert [(f.wheel, f.value, f.std) for f in offsets] == [
        (0, 100.0, 20.0), (1, 0.0, 0.0), (2, 0.0, 0.0), (3, 50.0, 0.0)
    ]  # fmt: skip
    assert [(f.parameter.name, f.wheel, f.value, f.std) for f in drifts] == [
        ("drift", w, 0.0, 0.0)
        for w in range(4)  # how a zero wandered is of one record
    ]
