"""Machines of which not every wheel has a torque, a speed and a load: rows, derivatives, noise, intervals."""

import re
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import shaking
from driven_windows import results_of
from soilbus.can.channels import Column
from soilbus.config.file import found_configuration, load_config, parse_config
from soilbus.config.model import Axle, Signal
from soilbus.estimation.assembly import model_of, prior_of, rig_of
from soilbus.estimation.gaussian import Gaussian
from soilbus.estimation.instrumentation import channel_value, completed
from soilbus.estimation.measurements import Measurements
from soilbus.estimation.multistart import fit_window
from soilbus.estimation.observation_model import ObservationModel
from soilbus.estimation.solver import Objective
from soilbus.estimation.window import NoiseTable, forward, made_window
from soilbus.pipeline.modelled_drive import modelled_drive
from soilbus.report.configuration import load_lines
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import REFERENCES, reference_configuration
from soilbus.simulator.scenario import Patch, Scenario, Swing
from soilbus.terra.entry_angle import entry_angle_for_load
from soilbus.terra.soils import soil_named
from soilbus.terra.vehicle import GRAVITY, axle_loads
from soilbus.terra.wheel import Soil, state_on, wheel_forces
from soilbus.trials.windows import bins_of, observed
from tests.lab import computed_loads

FIELD = Path(__file__).parents[1] / "field" / "field.toml"
PLAIN = re.sub(r'\nsinkage = "[^"]*"', "", FIELD.read_text())
CLOSED = tuple(f"model.form.{key}=0" for key in ("peak", "peak_by_slip", "exit", "shear"))
"""The drives have the model's form: with the form open, intervals would be too wide for a count of coverage."""
AXLE = '[[axle]]\nname = "{}"\n{}\n'


def configured(folder: Path, text: str, *overrides: str):
    (folder / "field.dbc").write_bytes(FIELD.with_name("field.dbc").read_bytes())
    (folder / "c.toml").write_text(text)
    return load_config(folder / "c.toml", overrides)


def without(text: str, role: str, wheels: str = "FL FR RL RR") -> str:
    """The text without a role of some wheels."""
    parts = re.split(r"(?=\[\[wheel\]\])", text)
    for i, part in enumerate(parts):
        if any(f'name = "{wheel}"' in part for wheel in wheels.split()):
            parts[i] = re.sub(rf"\n{role} = .*", "", part)
    return "".join(parts)


def with_axle(text: str, name: str, keys: str) -> str:
    return text.replace("[[wheel]]", AXLE.format(name, keys) + "[[wheel]]", 1)


def rear_driven() -> str:
    """One motor on the rear axle; the front wheels roll, the left one without any sensor."""
    text = without(PLAIN, "load", "FL FR")
    text = without(without(text, "torque"), "speed", "FL RL RR")
    for wheel in ("FL", "FR"):
        text = text.replace(f'name = "{wheel}"', f'name = "{wheel}"\ndriven = false')
    return with_axle(text, "rear", 'torque = "McuRL.ShaftTorque"\nmotor_speed = "McuRL.ShaftSpeed"\ngear_ratio = 24.0')


def one_motor() -> str:
    """One motor for both axles, the shaft between them rigid, no load cell."""
    text = without(without(without(PLAIN, "load"), "torque"), "speed")
    text = with_axle(
        text, "both", 'torque = "McuRL.ShaftTorque"\nmotor_speed = "McuRL.ShaftSpeed"\ndifferential="locked"'
    )
    return with_axle(with_axle(text, "front", "gear_ratio = 20.0"), "rear", "gear_ratio = 24.8")


MACHINES = {
    "no load cells": (without(PLAIN, "load"), {"load": ["weight", "transfer", "side", "side"]}),
    "a cell of the rear axle": (
        with_axle(without(PLAIN, "load"), "rear", 'load = "AxleLoads.RL"'),
        {"load": ["channel", "weight", "side", "side"]},
    ),
    "rear driven": (
        rear_driven(),
        {
            "torque": ["channel", "free", "free", "coupling"],
            "speed": ["channel", "channel", "free", "coupling"],
            "load": ["channel", "channel", "weight", "side"],
        },
    ),
    "one motor": (
        one_motor(),
        {
            "torque": ["channel", "coupling", "coupling", "coupling"],
            "speed": ["channel", "coupling", "coupling", "coupling"],
            "load": ["weight", "transfer", "side", "side"],
        },
    ),
}


@pytest.fixture(params=MACHINES)
def machine(request, tmp_path):
    text, rows = MACHINES[request.param]
    return configured(tmp_path, text), rows


def window_of(config, rig, seconds=6.0, swing=1.0):
    """Bins of a drive by the model; slope and acceleration swing besides, and its draft does not follow them."""
    t = np.arange(0.05, seconds, 0.1)
    truth = modelled_drive(config, rig, t)
    truth |= {"pitch": 0.05 * swing * np.sin(t), "acceleration": 0.2 * swing * np.cos(t)}
    front, rear = axle_loads(rig.chassis, truth["draft"], truth["pitch"], truth["acceleration"])
    truth["load"] = np.where(rig.front[:, None], front / rig.front.sum(), rear / (~rig.front).sum())
    mean = np.full((len(t), len(rig.channels)), np.nan)
    mapped = {name for name in truth if getattr(config.signals, name, None) is not None}
    for i, name in enumerate(rig.channels):
        quantity, _, part = name.partition(".")
        if quantity in ("torque", "speed", "load"):
            mean[:, i] = channel_value(rig, quantity, part, truth[quantity])
        elif quantity in mapped:
            mean[:, i] = truth[quantity]
    count = 5.0 * np.isfinite(mean)
    return made_window(NoiseTable.of(rig), t, mean, count, int(count.sum()))


def test_each_machine_has_as_many_independent_rows_as_wheels(machine):
    config, wanted = machine
    given = rig_of(config).instrumentation
    for quantity, kinds in wanted.items():
        rows = getattr(given, quantity)
        assert sorted(row.kind for row in rows) == sorted(kinds)
        assert np.linalg.matrix_rank([row.weight for row in rows]) == 4


def test_loads_of_every_machine_add_up_to_the_weight(machine):
    config, _ = machine
    rig = rig_of(config)
    window = completed(forward(window_of(config, rig)), rig)
    weight = config.vehicle.mass * GRAVITY
    assert (window.load > 0.0).all()
    assert window.load.sum(axis=1) == pytest.approx(np.full(len(window.t), weight), rel=2e-3)


def test_residuals_have_the_derivatives_that_differences_show(machine):
    config, _ = machine
    rig = rig_of(config)
    problem = ObservationModel(window_of(config, rig), rig, model_of(config), 0.2)
    soil, gains = soil_named("loam"), np.zeros(problem.n_sensors)
    latents = problem.start(soil)
    at = problem.linearise(soil, gains, latents)
    rows = at.rows.reshape(problem.n, -1, at.rows.shape[1])

    def residual(soil, gains):
        here = problem.with_entry_angles(latents, soil, gains)
        return problem.linearise(soil, gains, here).rows[:, 0]

    for i, name in enumerate(soil._fields):
        step = 1e-4 * soil[i]
        moved = [residual(soil._replace(**{name: soil[i] + sign * step}), gains) for sign in (1, -1)]
        numeric = (moved[0] - moved[1]) / (2.0 * step)
        scale = np.abs(numeric).max()
        assert at.rows[:, 1 + i] == pytest.approx(numeric, rel=2e-3, abs=5e-3 * scale), name
    for i in (i for i, name in enumerate(problem.gain_names) if name in ("load.weight", "load.balance")):
        step = np.eye(len(gains))[i] * 1e-4
        moved = [problem.linearise(soil, sign * step, latents).rows[:, 0] for sign in (1, -1)]
        numeric = (moved[0] - moved[1]) / 2e-4
        free_of_noise = [row for row in range(rows.shape[1]) if row != problem.layout.balance]  # inertia: the next test
        numeric = numeric.reshape(rows.shape[:2])[:, free_of_noise]
        near = pytest.approx(numeric, rel=1e-4, abs=1e-5 * np.abs(numeric).max())
        assert rows[:, free_of_noise, 7 + i] == near, problem.gain_names[i]


def test_noise_of_draft_and_inertia_draws_neither_gain_away_from_the_truth(tmp_path):
    """A noisy regressor pulls a gain to where noise times gain is least (errors in variables); the score must not."""
    config = configured(tmp_path, MACHINES["no load cells"][0])
    rig = rig_of(config)
    problem = ObservationModel(window_of(config, rig), rig, model_of(config), 0.2)
    soil, gains = soil_named("loam"), np.zeros(problem.n_sensors)
    latents, clean = problem.start(soil), {name: getattr(problem, name).copy() for name in ("draft", "inertia")}
    columns = [7 + problem.gain_names.index(name) for name in ("draft", "load.weight")]
    rng, scores = np.random.default_rng(1), []
    silent = problem.linearise(soil, gains, latents)
    at_truth = silent.rows[:, columns].T @ silent.weighed[:, 0]
    for _ in range(300):
        for name, variance in (("draft", problem.draft_var), ("inertia", problem.inertia_var)):
            setattr(problem, name, clean[name] + rng.standard_normal(problem.n) * np.sqrt(variance))
        at = problem.linearise(soil, gains, latents)
        scores.append(at.rows[:, columns].T @ at.weighed[:, 0] - at_truth)
    error = np.std(scores, axis=0) / np.sqrt(len(scores))
    assert np.abs(np.mean(scores, axis=0)) == pytest.approx(np.zeros(2), abs=4.0 * error.max())
    assert (np.abs(np.mean(scores, axis=0)) < 4.0 * error).all()


def test_a_signal_of_two_wheels_says_less_than_two_sensors(tmp_path):
    apart = configured(tmp_path, PLAIN)
    text = PLAIN.replace("AxleLoads.FR", "AxleLoads.FL").replace("WheelSpeeds.RR", "WheelSpeeds.RL")
    shared = configured(tmp_path, text)
    assert rig_of(shared).instrumentation is not None
    assert rig_of(apart).instrumentation is None  # four motors and four cells need none
    said, soil = [], np.array(soil_named("loam"))
    for config in (apart, shared):
        rig, prior = rig_of(config), prior_of(config)
        problem = ObservationModel(window_of(config, rig), rig, model_of(config), 0.2)
        objective = Objective(problem, prior, Gaussian.of(prior, problem.gain_std))
        model = objective.quadratic_model(objective.start(soil))
        there = objective.gaussian(soil, np.zeros(len(problem.gain_std)), np.linalg.inv(model.information))
        said.append(there.posterior.tan_phi().std)
    assert said[1] > said[0]


def test_a_lock_that_falls_silent_is_neither_open_nor_locked(tmp_path):
    """Locked wheels share a torque anyhow, open ones turn anyhow: of a silent lock neither is known."""
    text = rear_driven().replace("[vehicle]", '[vehicle]\ndifferential_lock = "McuRL.State"')
    rig, unmapped = (rig_of(configured(tmp_path, each)) for each in (text, rear_driven()))
    window = window_of(configured(tmp_path, text), rig)
    values = {"open": 0.0, "locked": 1.0, "silent": np.nan}
    lock = {state: np.full(len(window.t), value) for state, value in values.items()}
    seen = {state: completed(replace(window, differential_lock=lock[state]), rig).observations for state in values}
    seen["unmapped"] = completed(window, unmapped).observations
    sharing, turning = (
        {state: float(getattr(each, variance)[:, place].mean()) for state, each in seen.items()}
        for variance, place in (("torque_var", 3), ("variance", 7))
    )
    assert np.isfinite(sharing["open"])
    assert sharing["unmapped"] == sharing["open"]
    assert np.isnan([sharing["locked"], sharing["silent"]]).all()
    assert turning["silent"] == turning["open"] == turning["unmapped"] > turning["locked"]


def test_specific_force_holds_the_slope_whatever_the_pitch_sensor_says(tmp_path):
    text = PLAIN.replace(
        'acceleration = "Attitude.LongAccel"',
        'acceleration = { signal = "Attitude.LongAccel", kind = "specific_force" }',
    )
    config = configured(tmp_path, text)
    rig = rig_of(config)
    window = window_of(config, rig)
    one = Measurements(window, rig, 0.2, 0.15)
    other = Measurements(replace(window, pitch=window.pitch + 0.1), rig, 0.2, 0.15)
    force = config.vehicle.mass * window.acceleration
    assert one.demand == pytest.approx(one.draft + force)
    assert other.demand == pytest.approx(one.demand)
    assert one.demand_var == pytest.approx(one.draft_var + config.vehicle.mass**2 * window.variance["acceleration"])


def test_nothing_towed_is_a_draft_of_zero_and_not_an_unknown_one(tmp_path):
    text = PLAIN.replace("[vehicle]", '[vehicle]\ntowing = "never"')
    text = re.sub(r"\[signals\.draft\]\n(?:.+\n)*|\ndraft = \{ signal.*|\ndraft = \"[^\"]*\"", "\n", text, count=1)
    config = configured(tmp_path, text)
    rig = rig_of(config)
    problem = Measurements(window_of(config, rig), rig, 0.2, 0.15)
    assert problem.has_balance.all()
    assert (problem.draft == 0.0).all()


def test_a_value_that_is_missing_leaves_what_does_not_follow_from_it(tmp_path):
    rig = rig_of(configured(tmp_path, without(PLAIN, "load")))
    whole = window_of(configured(tmp_path, without(PLAIN, "load")), rig)
    torque, speed = whole.torque.copy(), whole.speed.copy()
    torque[7, 1] = speed[9, 2] = np.nan
    one, other = completed(replace(whole, torque=torque, speed=speed), rig), completed(whole, rig)
    assert np.argwhere(np.isnan(one.torque)).tolist() == [[7, 1]]
    assert np.argwhere(np.isnan(one.speed)).tolist() == [[9, 2]]
    known = np.isfinite(one.speed)
    assert one.speed[known] == pytest.approx(other.speed[known])
    assert np.isfinite(one.variance["speed"][known]).all()


def test_wheels_on_a_differential_of_one_measured_speed_are_all_missing_with_it(tmp_path):
    config = configured(tmp_path, rear_driven())
    rig = rig_of(config)
    whole = window_of(config, rig)
    rear = [rig.wheels.index("RL"), rig.wheels.index("RR")]
    speed = whole.speed.copy()
    speed[5, rear] = np.nan  # the motor's, in the column of its first wheel
    one = completed(replace(whole, speed=speed), rig)
    assert np.isnan(one.speed[5, rear]).all()
    assert np.isfinite(one.speed[5, [rig.wheels.index("FL"), rig.wheels.index("FR")]]).all()


def test_a_wheel_with_a_sensor_of_its_own_keeps_it_beside_that_of_its_axle(tmp_path):
    """Speed and load of RL are measured, those of RR follow from the motor's speed and the axle's load."""
    text = without(without(without(PLAIN, "load", "FL FR RR"), "torque"), "speed", "FL FR RR")
    for wheel in ("FL", "FR"):
        text = text.replace(f'name = "{wheel}"', f'name = "{wheel}"\ndriven = false')
    keys = 'torque = "McuRL.ShaftTorque"\nmotor_speed = "McuRL.ShaftSpeed"\nload = "AxleLoads.RR"'
    config = configured(tmp_path, with_axle(text, "rear", keys))
    rig = rig_of(config)
    truth = modelled_drive(config, rig, np.arange(0.05, 3.0, 0.1))
    left, right = rig.wheels.index("RL"), rig.wheels.index("RR")
    for quantity in ("speed", "load"):
        truth[quantity][right] *= 1.2
        raw = np.full((len(truth["ground_speed"]), 4), np.nan)
        for column, name in enumerate(rig.names[quantity]):
            if name:
                raw[:, column] = channel_value(rig, quantity, name, truth[quantity])
        one = completed(replace(window_of(config, rig, 3.0), **{quantity: raw}), rig)
        for wheel in (left, right):
            assert getattr(one, quantity)[:, wheel] == pytest.approx(truth[quantity][wheel])


def test_a_free_wheel_rolls_at_the_slip_that_needs_no_torque(tmp_path):
    config = configured(tmp_path, rear_driven())
    rig = rig_of(config)
    truth = modelled_drive(config, rig, np.arange(0.05, 6.0, 0.1))
    problem = ObservationModel(window_of(config, rig, swing=0.0), rig, model_of(config), 0.2)
    fit = fit_window(problem, prior_of(config))
    assert fit.converged
    latents = fit.optimum.latents
    slip = 1.0 - latents.ground_speed[:, None] / (rig.radius * latents.speed)
    true = 1.0 - truth["ground_speed"] / (rig.radius[0] * truth["speed"][0])
    left = rig.wheels.index("FL")  # it has no speed sensor
    assert slip[:, left].mean() == pytest.approx(true.mean(), abs=0.02)  # side loads that swing are not measured
    assert slip[:, left] == pytest.approx(true, abs=0.06)
    tan_phi = fit.posterior.tan_phi()
    assert tan_phi.value == pytest.approx(np.tan(prior_of(config).median[3]), abs=0.5 * tan_phi.std)


def test_the_same_slope_loads_the_same_axle_forward_and_in_reverse(tmp_path):
    config = configured(tmp_path, without(PLAIN, "load"))
    rig = rig_of(config)
    window = replace(window_of(config, rig), pitch=np.full(60, 0.2))
    back = replace(window, speed=-window.speed, ground_speed=-window.ground_speed, draft=window.draft)
    ahead, behind = (completed(forward(w), rig) for w in (window, back))
    assert behind.load == pytest.approx(ahead.load)


@pytest.fixture(scope="module")
def shaken() -> list[shaking.Recording]:
    """Drives of another generator, whose loads shake by 13 %."""
    grounds = (shaking.LOAM, shaking.CLAY, shaking.STUBBLE, shaking.LOAM)
    return [shaking.drive(seed, ground, duration=31.0, shake=4.0) for seed, ground in enumerate(grounds)]


@pytest.mark.parametrize("machine", ["a cell of the rear axle", "no load cells"])
def test_intervals_hold_the_truth_on_shaking_loads_without_cells(machine, shaken, tmp_path):
    """Mass, centre of gravity, c and K drawn as their priors say."""
    off = []
    for seed, drive in enumerate(shaken):
        ground = drive.ground
        rng = np.random.default_rng([seed, 7])
        of_c, of_K, of_mass, of_cg = rng.standard_normal(4).tolist()
        config = configured(
            tmp_path, MACHINES[machine][0], *CLOSED, "estimator.hop=5.0",
            f"vehicle.mass={{value={2300.0 + 46.0 * of_mass}, std=46.0}}",
            f"vehicle.cg_ahead_of_rear_axle={{value={0.95 + 0.039 * of_cg}, std=0.039}}",
            f"soil.c={{value={ground.c * (1.0 + 0.25 * of_c)}, std={0.25 * ground.c}}}",
            f"soil.K={{value={ground.K * (1.0 + 0.25 * of_K)}, std={0.25 * ground.K}}}",
        )  # fmt: skip
        for result in estimated(config, drive)[::2]:
            tan_phi, pressure = result.posterior.tan_phi(), result.bearing
            off.append((tan_phi.value - np.tan(ground.phi)) / tan_phi.std)
            off.append(np.log(pressure.value / ground.bearing_pressure()) * pressure.value / pressure.std)
    assert len(off) == 24
    assert np.mean(np.abs(off) < 1.96) >= 0.85  # at 0.95 each, fewer than 21 of 24 happen once in 30
    assert 0.3 < np.sqrt(np.mean(np.square(off))) < 1.4


def test_an_axle_without_a_cell_does_not_lose_what_bouncing_adds_to_the_other():
    """Front loads as computed beside those of the simulator, whose axles bounce each on its own tyres."""
    config = reference_configuration(path=REFERENCES["tractor-2wd"])
    scenario = Scenario(20.0, (Patch(0.0, "loam"),), slip=Swing(0.05, 0.3), bounce=0.12)
    recording, rig = simulate(config, scenario, 7), rig_of(config)
    window = completed(forward(bins_of(config, recording.channels).window(0.0, 20.0)), rig)
    front, rear = (
        np.sum([np.interp(window.t, recording.truth["t"], recording.truth[f"load.{w}"]) for w in wheels], axis=0)
        for wheels in (("FL", "FR"), ("RL", "RR"))
    )
    known = np.isfinite(window.load).all(axis=1)
    miss = (window.load[:, rig.front].sum(axis=1) - front)[known]
    assert abs(np.corrcoef(miss, rear[known])[0, 1]) < 0.3
    assert np.std(miss) < 1.2 * np.std(front)


def test_torques_of_the_two_wheels_of_an_axle_show_how_its_load_is_shared_at_each_instant():
    """And so pressure is not off by what unequal loads resist more than equal ones."""
    config = reference_configuration()
    wheels = [wheel.model_copy(update={"load": None, "sinkage": None}) for wheel in config.wheel]
    axles = [Axle(name=name, load=Signal(signal=f"AxleLoads.{name}")) for name in ("front", "rear")]
    config = config.model_copy(update={"wheel": wheels, "axle": axles})
    scenario = Scenario(10.0, (Patch(0.0, "loam"),), slip=Swing(0.05, 0.4), bounce=0.12)
    recording, rig = simulate(config, scenario, 3), rig_of(config)
    problem = observed(config, recording.channels, 10.0)
    fit = fit_window(problem, prior_of(config))
    for left, right in ((0, 1), (2, 3)):
        of_wheels = [np.interp(problem.t, recording.truth["t"], recording.truth[f"load.{rig.wheels[i]}"])
                     for i in (left, right)]  # fmt: skip
        fitted, true = fit.optimum.latents.load[:, left] - fit.optimum.latents.load[:, right], np.subtract(*of_wheels)
        assert np.std(fitted - true) < 0.3 * np.std(true)


def estimated(config, drive):
    channels = {name: Column(t, value) for name, (t, value) in drive.channels.items()}
    (t, left), (_, right) = drive.channels["load.RL"], drive.channels["load.RR"]
    return results_of(config, channels | {"load.rear": Column(t, left + right)}, drive.truth["t"][-1])


@pytest.mark.parametrize("name", ["tractor-2wd", "tractor-axles"])
def test_check_says_that_a_missing_load_cell_costs_precision(name):
    (line,) = [line for line in load_lines(load_config(found_configuration(name))) if "with load cells" in line]
    pressure, with_cells, tan_phi, tan_phi_with_cells = (float(x) for x in re.findall(r"([\d.]+)%", line))
    assert with_cells < pressure < 2.0 * with_cells
    assert tan_phi > 0.95 * tan_phi_with_cells


def never_towing():
    """The machine with a motor on each axle, which tows nothing."""
    raw = tomllib.loads(found_configuration("tractor-axles").read_text())
    del raw["signals"]["draft"]
    raw["vehicle"]["towing"] = "never"
    return parse_config(raw)


def test_where_nothing_is_towed_slopes_take_the_pull_of_the_modelled_drive():
    config = never_towing()
    rig, model = rig_of(config), model_of(config)
    truth = modelled_drive(config, rig, np.arange(0.05, 10.0, 0.1))
    radius, width = rig.radius[:, None], rig.width[:, None]
    slip = 1.0 - truth["ground_speed"] / (radius * truth["speed"])
    state = state_on(Soil(*prior_of(config).median), np.nan, slip, radius, width)
    entry = entry_angle_for_load(truth["load"], state, model)
    pull = wheel_forces(state._replace(entry_angle=entry), model)[1].sum(axis=0)
    assert np.ptp(truth["pitch"]) > 0.1
    assert np.all(truth["draft"] == 0.0)
    assert pull == pytest.approx(rig.chassis.mass * GRAVITY * np.sin(truth["pitch"]), rel=0.02, abs=50.0)


@pytest.mark.parametrize("felt", ["pitch", "specific force", "nothing"])
def test_where_nothing_is_towed_the_balance_counts_only_where_a_sensor_shows_the_slope(felt):
    rig = replace(rig_of(never_towing()), specific_force=felt == "specific force")
    window = window_of(never_towing(), rig)
    unknown = np.full(len(window.t), np.nan)
    window = replace(window, pitch=np.zeros(len(window.t)) if felt == "pitch" else unknown)
    window = completed(window if felt == "specific force" else replace(window, acceleration=unknown), rig)
    weight = rig.chassis.mass * GRAVITY
    assert np.all(window.draft == 0.0)
    assert np.all(window.variance["draft"] == 0.0) == (felt != "nothing")
    assert felt != "nothing" or np.all(window.variance["draft"] > (0.1 * weight) ** 2)


def test_check_predicts_the_errors_of_a_machine_that_tows_nothing():
    (line,) = [line for line in load_lines(never_towing()) if "with load cells" in line]
    assert "varied slope" in line


def test_a_draft_that_nothing_measures_does_not_bias_a_machine_without_load_cells(monkeypatch):
    """Rear-driven, nothing but torque, speeds, pitch: 16 windows on sand; tan phi was 1.8 sd too low in the mean."""
    known = computed_loads.configured("tractor-2wd")
    bare = known.model_copy(update={
        "signals": known.signals.model_copy(update={"draft": None}),
        "axle": [axle.model_copy(update={"load": None}) for axle in known.axle],
    })  # fmt: skip
    monkeypatch.setattr(computed_loads, "configured", lambda machine: bare)
    tasks = [computed_loads.Task("tractor-2wd", "dry_sand", 0.03, seed) for seed in range(16)]
    off = np.array([one for one in map(computed_loads.errors, tasks) if one is not None])
    assert len(off) >= 15
    assert np.all(np.abs(off.mean(axis=0)) < 1.2)
    assert np.all((np.abs(off) < 1.96).mean(axis=0) > 0.8)
