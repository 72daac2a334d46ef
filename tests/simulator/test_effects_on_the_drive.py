"""Effects act on the simulated wheels and sensors as they say, and the balance holds with them."""

import numpy as np
import pytest

from balances import GRAVITY, WHEELS, missing_pull
from soilbus.cli.main import main
from soilbus.config.model import Config, ConfigError
from soilbus.estimation.assembly import effects_of, with_effects
from soilbus.simulator.drive import drive
from soilbus.simulator.recording import Recording, simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import Patch, Scenario, Swing
from soilbus.simulator.sensors import measure
from soilbus.terra.effects.catalogue import CATALOGUE
from soilbus.terra.effects.effect import Active, Effect
from soilbus.terra.soils import soil_named
from soilbus.terra.wheel import WheelModel, state_on, wheel_forces

MASS = 2300.0
HILLS = ((0.0, 0.0), (8.0, 0.06), (20.0, -0.03))
DRIVE = Scenario(15.0, (Patch(0.0, "loam"),), slip=Swing(0.05, 0.4), slope=HILLS)
NOISELESS = [f"noise.{q}.{kind}=0.0" for q in ("torque", "load", "draft") for kind in ("gain", "relative", "of_mean")]


def own(**hooks) -> Active:
    return Active(Effect("own", "", "", "", (), **hooks), {})


def stiffer(state, model, around, values):
    return state._replace(K_L=1.4 * state.K_L, c=0.8 * state.c), model


def rolling_loss(forces, state, around, values):
    return forces - np.stack([0.01 * forces[0], 0.03 * around.load, 0.0 * forces[2]])


@pytest.mark.parametrize("scenario", [DRIVE, Scenario(15.0, DRIVE.soils, draft=Swing(500.0, 9000.0))])
def test_an_effect_that_is_another_soil_drives_as_on_that_soil(scenario):
    config, loam = reference_configuration(), soil_named("loam")
    other = loam._replace(k_c=1.4 * loam.k_c, k_phi=1.4 * loam.k_phi, c=0.8 * loam.c)
    on_other = Scenario(
        15.0, (Patch(0.0, "other", other),), draft=scenario.draft, slip=scenario.slip, slope=scenario.slope
    )
    by_effect = drive(config, scenario, 5, [own(wheel=stiffer)]).columns
    exact = drive(config, on_other, 5).columns
    for name in set(exact) - {"soil"}:
        scale = np.nanmax(np.abs(exact[name]), initial=1e-300)
        assert by_effect[name] == pytest.approx(exact[name], abs=1e-8 * scale, nan_ok=True), name


def test_the_balance_holds_with_forces_that_depend_on_load_and_a_resistance_in_no_reading():
    def against(around, values):
        return 300.0 + 5.0 * around.t + 0.0 * around.ground_speed

    config = reference_configuration()
    columns = drive(config, DRIVE, 5, [own(forces=rolling_loss), own(resistance=against)]).columns
    more = (300.0 + 5.0 * columns["t"]) / (MASS * GRAVITY)
    assert np.abs(missing_pull(config, columns) - more).max() < 1e-8
    for wheel, radius, width in (("FL", 0.50, 0.26), ("RR", 0.62, 0.38)):
        angle, slip, load = (columns[f"{quantity}.{wheel}"] for quantity in ("entry_angle", "slip", "load"))
        of_soil = wheel_forces(state_on(soil_named("loam"), angle, slip, radius, width), WheelModel())
        assert load == pytest.approx(0.99 * of_soil[0], rel=1e-8)
        assert columns[f"drawbar_pull.{wheel}"] == pytest.approx(of_soil[1] - 0.03 * load, abs=1e-8 * MASS * GRAVITY)


def test_what_effects_see_is_what_happens():
    seen = {}

    def look(torque, around, values):
        seen.update(around._asdict())
        return torque

    done = drive(reference_configuration(), DRIVE, 5)
    recording = simulate(reference_configuration(), DRIVE, 5, [own(torque=look)])
    for name in ("t", "distance", "ground_speed", "draft", "acceleration"):
        assert np.array_equal(seen[name][:, 0], done.columns[name]), name
    for i, wheel in enumerate(WHEELS):
        assert np.array_equal(seen["load"][:, i], recording.truth[f"load.{wheel}"])
        assert seen["wheel_speed"][:, i] == pytest.approx(recording.truth[f"speed.{wheel}"], rel=1e-12)
    assert seen["rear"].tolist() == [False, False, True, True]
    assert (seen["mass"], seen["duration"], seen["length"]) == (MASS, 15.0, done.columns["distance"][-1])


def test_a_worn_tyre_sinks_by_its_own_radius():
    worn = Active(CATALOGUE["rolling_radius"], {"front": -0.06, "rear": 0.0})
    columns = drive(reference_configuration(), DRIVE, 5, [worn]).columns
    for wheel, radius in (("FL", 0.47), ("RR", 0.62)):
        assert columns[f"sinkage.{wheel}"] == pytest.approx(radius * (1.0 - np.cos(columns[f"entry_angle.{wheel}"])))
    # Slip is told with the nominal radius: truly the smaller wheel slips less.
    slip = 1.0 - columns["ground_speed"] / (0.50 * columns["speed.FL"])
    assert columns["slip.FL"] == pytest.approx(slip, abs=1e-12)


def test_effects_on_sensors_leave_the_truth_and_come_before_the_noise():
    config = reference_configuration([*NOISELESS, *(f"noise.{q}.absolute=1.0" for q in ("torque", "load"))])
    effects = [
        own(torque=lambda torque, around, values: 0.9 * torque - around.wheel_speed),
        own(draft=lambda draft, around, values: 100.0 + 0.1 * draft),
        own(load=lambda around, values: np.array([0.0, 50.0, 0.0, -70.0]) + 0.0 * around.load),
    ]
    plain, told = simulate(config, DRIVE, 5), simulate(config, DRIVE, 5, effects)
    assert all(
        np.array_equal(plain.truth[n], told.truth[n], equal_nan=plain.truth[n].dtype.kind == "f") for n in plain.truth
    )

    def change(name):
        return told.channels[name].value - plain.channels[name].value

    truth = plain.truth
    assert change("draft") == pytest.approx(100.0 + 0.1 * truth["draft"], abs=1e-8)
    for wheel, offset in zip(WHEELS, (0.0, 50.0, 0.0, -70.0), strict=True):
        assert change(f"torque.{wheel}") == pytest.approx(
            -0.1 * truth[f"torque.{wheel}"] - truth[f"speed.{wheel}"], abs=1e-8
        )
        assert change(f"load.{wheel}") == pytest.approx(offset, abs=1e-8)
        assert np.array_equal(told.channels[f"speed.{wheel}"].value, plain.channels[f"speed.{wheel}"].value)


def alike(one: Recording, other: Recording) -> bool:
    return all(np.array_equal(one.channels[name].value, other.channels[name].value) for name in one.channels)


def test_configuration_and_argument_bring_the_same_effects():
    effect = CATALOGUE["slip_sinkage"]
    first, *others = effect.parameters
    value = first.neutral + 0.5 * first.std
    argument = [Active(effect, {first.name: value} | {p.name: p.neutral for p in others})]
    by_argument = simulate(reference_configuration(), DRIVE, 5, argument)
    written = reference_configuration(
        [f"model.effects=[{{name='slip_sinkage', {first.name}={{value={value}, std=0.1}}}}]"]
    )
    for config in (written, with_effects(reference_configuration(), [f"slip_sinkage={value}"])):
        assert alike(simulate(config, DRIVE, 5), by_argument)
    assert not alike(simulate(reference_configuration(), DRIVE, 5), by_argument)


def offsets(config: Config, wheels=None) -> list[float]:
    (active,) = effects_of(config, wheels)
    return active.values[active.effect.parameters[0].name].tolist()


def test_parameters_of_single_wheels():
    name = CATALOGUE["wheel_load_offset"].parameters[0].name
    config = with_effects(reference_configuration(), [f"wheel_load_offset.{name}.RL=120"])
    assert offsets(config) == [0.0, 0.0, 120.0, 0.0]
    assert offsets(config, ["RR", "RL"]) == [0.0, 120.0]
    assert offsets(with_effects(config, ["wheel_load_offset=-40"])) == [-40.0] * 4
    twice = with_effects(reference_configuration(), ["wheel_load_offset=-40", f"wheel_load_offset.{name}.FR=10"])
    assert offsets(twice) == [-40.0, 10.0, -40.0, -40.0]
    table = f"model.effects=[{{name='wheel_load_offset', {name}={{FL=1, RR={{value=2, std=3}}}}}}]"
    assert offsets(reference_configuration([table])) == [1.0, 0.0, 0.0, 2.0]


def test_effects_come_in_the_order_of_the_catalogue_whoever_wrote_them():
    order = [
        active.effect.name
        for active in effects_of(with_effects(reference_configuration(), ["inertia=0", "slip_sinkage=0"]))
    ]
    assert order == sorted(order, key=list(CATALOGUE).index)
    assert set(order) == {"inertia", "slip_sinkage"}


@pytest.mark.parametrize(
    ("effects", "says"),
    [
        ("{name='cheese'}", "no effect is named cheese; known: slip_sinkage, "),
        ('{name="che\\nese\\u001b[2J"}', r"no effect is named che\nese\x1b[2J; known: "),
        ("{name='slip_sinkage', smell=1.0}", "slip_sinkage has no parameter smell; known: "),
        ("{name='slip_sinkage'}, {name='slip_sinkage'}", "two effects are named slip_sinkage"),
        ("{name='exponential_shear'}", "exponential_shear can be added to shear_law = rational only"),
        ("{name='wheel_load_offset', offset={XX=1.0}}", "no wheel is named XX"),
        ("{name='grade', PARAMETER=true}", "True is not a number"),
        ("{name='grade', PARAMETER='steep'}", "'steep' is not a number"),
        ("{name='grade', PARAMETER={std=1.0}}", "None is not a number"),
        ("{name='grade', PARAMETER=1e9}", "1e+09 is not within"),
    ],
)
def test_effects_that_cannot_be_are_one_line_each(effects, says):
    text = effects.replace("PARAMETER", CATALOGUE["grade"].parameters[0].name)
    with pytest.raises(ConfigError) as error:
        drive(reference_configuration([f"model.effects=[{text}]"]), DRIVE, 5)
    (line,) = error.value.faults
    assert line.isprintable()
    assert line.startswith("model.effects: ")
    assert says in line


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("slip_sinkage", "expected NAME=VALUE"),
        ("slip_sinkage.a.b.c=1", "expected NAME=VALUE"),
        ("slip_sinkage=much", "'much' is not a number"),
    ],
)
def test_a_wrong_effect_on_the_command_line_is_one_line_and_exit_2(text, says, tmp_path, capsys):
    assert main(["simulate", "--duration", "2", "--effect", text, "--log", str(tmp_path / "x.log")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert says in line
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", list(CATALOGUE))
def test_every_effect_of_the_catalogue_can_be_driven(name):
    effect = CATALOGUE[name]
    config = reference_configuration([f"model.shear_law={effect.base_law or 'exponential'}"])
    values = {p.name: np.clip(p.neutral + 0.5 * p.std, p.low, p.high) for p in effect.parameters}
    if effect.each_wheel:
        values = {parameter: np.full(4, value) for parameter, value in values.items()}
    scenario = Scenario(6.0, DRIVE.soils, slip=Swing(0.1, 0.3))
    done = drive(config, scenario, 5, [Active(effect, values)])
    assert done.bogged_at is None
    changed, plain = measure(done, config, 5), simulate(config, scenario, 5).channels
    assert any(not np.array_equal(changed[name].value, plain[name].value) for name in plain)
    more = 0.0 if effect.resistance is None else np.ravel(effect.resistance(done.surroundings, values))
    assert np.abs(missing_pull(config, done.columns) - more / (MASS * GRAVITY)).max() < 1e-8
