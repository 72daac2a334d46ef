"""Machines with two tracks, three axles or one: from configuration to soil and capability."""

import dataclasses
import math
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.optimize import brentq

from driven_windows import errors, last_fit, results_of, windows
from soilbus.config.file import load_config, machine, parse_config
from soilbus.config.model import Config, ConfigError
from soilbus.decision.balance import Duty, balance
from soilbus.decision.capability import Demand, assess, slip_grid
from soilbus.decision.traversability import Status
from soilbus.decision.wheels import wheel_table
from soilbus.estimation.assembly import model_of, motors_of, possible_effects, prior_of, rig_of
from soilbus.estimation.instrumentation import completed
from soilbus.estimation.nuisance_parameters import Free
from soilbus.estimation.observation_model import ObservationModel
from soilbus.estimation.observation_with_effects import ObservationModelWithEffects
from soilbus.estimation.posterior import Posterior
from soilbus.estimation.window import NoiseTable, forward, made_window, pairs, turning
from soilbus.simulator.drive import drive
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import Patch, Scenario, Swing
from soilbus.terra.effects.catalogue import CATALOGUE
from soilbus.terra.soils import SOILS
from soilbus.terra.wheel import Soil, WheelModel
from soilbus.trials.draft_trials import trial
from statics import MODEL, wheel

CRAWLER = Path(__file__).parents[1] / "field" / "tracked.toml"
WITH_CELLS = (
    "track.L.load=WheelLoads.FL", "track.R.load=WheelLoads.FR", "noise.load.relative=0.01", "noise.load.gain=0.005",
)  # fmt: skip
WEIGHT, R, B, L = 4500.0 * 9.80665, 0.30, 0.35, 1.6
LOAM = SOILS["loam"]
NO_LIMIT = np.full(2, np.nan)


def crawler(*overrides):
    return load_config(CRAWLER, overrides)


def pulling(soil="loam", duration=14.0):
    """A draft that swings from little to what the driver lets the tracks slip by 0.2 to 0.4 for."""
    patch = Patch(0.0, "drawn", soil) if isinstance(soil, Soil) else Patch(0.0, soil)
    return Scenario(duration, (patch,), draft=Swing(1000.0, 22000.0), lift_slip=Swing(0.2, 0.4))


def by_hand(soil: Soil, slip: float) -> tuple[float, float, float]:
    """Pull [N] of the vehicle, torque [N m] and sinkage [m] of each track, from the formulas in terra.track's head."""
    p, K_L, u = WEIGHT / (2.0 * B * L), soil.k_c / B + soil.k_phi, slip * L / soil.K
    z = (p / K_L) ** (1.0 / soil.n)
    thrust = B * L * (soil.c + p * math.tan(soil.phi)) * (1.0 - (1.0 - math.exp(-u)) / u)
    return 2.0 * (thrust - B * p * z / (soil.n + 1.0)), thrust * R, z


def test_tracks_are_a_rig_of_wheels_with_a_length():
    rig = rig_of(crawler())
    assert rig.wheels == ("L", "R")
    assert rig.length.tolist() == [L, L]
    assert rig.chassis.on_one_axle
    assert rig.max_lateral is not None  # it steers by skidding
    assert rig_of(reference_configuration()).lengths is None
    assert not any(effect.of_tyre for effect in possible_effects(crawler()))


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("track.L.contact_length=160", "is it in cm"),
        ("track.L.radius=0.3", "unknown key"),
        ("track.R.axle=front", "give the axle of all [[track]]s"),
        ("track.R.pitch=0.1", "needs sprocket_radius, or pitch and sprocket_teeth"),
        ("track.R.roller_spacing=0.4", "the same number of rollers"),
        ("track.L.roller_spacing=1.9", "greater than contact_length"),
        ("track.L.name=R", "two tracks are named R"),
    ],
)
def test_faults_of_a_track_are_said_by_its_keys(override, said):
    with pytest.raises(ConfigError, match=r".") as fault:
        crawler(override)
    assert said in str(fault.value)


def test_the_simulated_crawler_obeys_its_formulas():
    truth = drive(crawler(), pulling(), seed=3).columns
    pull = truth["drawbar_pull.L"] + truth["drawbar_pull.R"]
    assert pull == pytest.approx(truth["draft"] + 4500.0 * truth["acceleration"], abs=1e-3)
    for name in "LR":
        p, u = truth[f"load.{name}"] / (B * L), truth[f"slip.{name}"] * L / LOAM.K
        z = (p / (LOAM.k_c / B + LOAM.k_phi)) ** (1.0 / LOAM.n)
        mobilised = np.sign(u) * (1.0 + np.expm1(-np.abs(u)) / np.abs(u))
        assert truth[f"sinkage.{name}"] == pytest.approx(z, rel=1e-6)
        assert truth[f"torque.{name}"] == pytest.approx(
            R * B * L * (LOAM.c + p * math.tan(LOAM.phi)) * mobilised, rel=1e-6, abs=1e-3
        )


def observed(config, cls=ObservationModel, **more):
    window, _ = next(windows(config, simulate(config, pulling(duration=11.0), 1)))
    return cls(window, rig_of(config), model_of(config), config.estimator.min_speed, **more)


def test_residuals_by_the_soil_equal_differences():
    problem = observed(crawler(*WITH_CELLS))
    start = problem.start(LOAM)
    gains = np.zeros(len(problem.gain_std))
    at = problem.linearise(LOAM, gains, start)
    for i, (name, value) in enumerate(LOAM._asdict().items()):
        step = 1e-4 * value
        up, down = (
            problem.linearise(soil, gains, problem.with_entry_angles(start, soil)).rows[:, 0]
            for soil in (LOAM._replace(**{name: value + step}), LOAM._replace(**{name: value - step}))
        )
        column = at.rows[:, 1 + i]
        assert column == pytest.approx((up - down) / (2.0 * step), abs=5e-3 * np.abs(column).max()), name


@pytest.mark.parametrize("parameter", ["slip_sinkage.softening", "bulldozing.cohesive_factor", "hardpan.stiffness"])
def test_residuals_by_an_effect_equal_differences(parameter):
    name, _, key = parameter.partition(".")
    effect = CATALOGUE[name]
    values = {p.name: max(p.neutral, 1e-3 * p.std) for p in effect.parameters} | {
        "depth": 0.003
    }  # above the ruts' floor
    free = tuple(Free(name, p, None, values[p.name], p.std if p.name == key else 0.0) for p in effect.parameters)
    problem = observed(crawler(*WITH_CELLS), ObservationModelWithEffects, effects=(effect,), free=free)
    place = problem.n_sensors + [p.name for p in effect.parameters].index(key)
    gains, step = np.zeros(len(problem.gain_std)), np.eye(len(problem.gain_std))[place] * 1e-3
    start = problem.start(LOAM, gains)
    at = problem.linearise(LOAM, gains, start)
    up, down = (problem.linearise(LOAM, g, problem.with_entry_angles(start, LOAM, g)).rows[:, 0]
                for g in (gains + step, gains - step))  # fmt: skip
    column = at.rows[:, 7 + place]
    assert np.abs(column).max() > 0.0
    assert column == pytest.approx((up - down) / 2e-3, abs=1e-2 * np.abs(column).max())


@pytest.mark.parametrize("name", ["loam", "wet_clay", "dry_sand"])
def test_the_balance_over_slip_equals_the_formulas(name):
    rig = rig_of(crawler())
    found = balance(wheel_table(np.array([SOILS[name]]), rig, WheelModel(), slip_grid(0.6)), Duty())
    for i in range(0, len(found.slip), 20):  # at the slips of the grid
        pull, torque, z = by_hand(SOILS[name], found.slip[i])
        assert found.pull[0, i] == pytest.approx(pull, abs=1e-6 * WEIGHT)
        assert found.torque[0, :, i] == pytest.approx(torque, rel=1e-5)
        assert R * (1.0 - np.cos(found.angle[0, :, i])) == pytest.approx(z, rel=1e-5)


def capability(soil, limit=math.inf, demand=None):
    exactly = Posterior(soil, np.zeros((6, 6)))
    limits = np.full(2, limit if math.isfinite(limit) else np.nan)
    return assess(exactly, rig_of(crawler()), WheelModel(), demand, limits, 0.6, 0.25)[0]


def test_a_torque_limit_ends_the_draft_where_root_finding_says():
    found = capability(LOAM, 3000.0)
    slip = brentq(lambda s: by_hand(LOAM, s)[1] - 3000.0, 1e-4, 0.6)
    assert found.limit == "torque"
    assert found.max_draft.value == pytest.approx(by_hand(LOAM, slip)[0], rel=1e-3)


@pytest.mark.parametrize("pull", [12000.0, 16000.0, 22000.0])
def test_the_slip_of_a_demand_is_that_of_root_finding(pull):
    forecast = capability(LOAM, demand=Demand(pull, 0.0)).forecast
    slip = brentq(lambda s: by_hand(LOAM, s)[0] - pull, 1e-4, 0.6)
    assert forecast.slip.value == pytest.approx(slip, abs=5e-4)
    assert forecast.sinkage["L"].value == pytest.approx(by_hand(LOAM, slip)[2], rel=1e-3)


def soils_of_the_prior(config, seed: int):
    """Soils with c, phi and K drawn from the prior, and the bearing of loam, which carries the crawler."""
    prior, rng = prior_of(config), np.random.default_rng(seed)
    while True:
        drawn = Soil(*(prior.median * np.exp(prior.log_std * rng.standard_normal(6))).tolist())
        if drawn.phi < 0.8:
            yield LOAM._replace(c=drawn.c, phi=drawn.phi, K=drawn.K)


@pytest.mark.parametrize(("swing", "cells"), [(0.0, ()), (0.15, ()), (0.15, WITH_CELLS)])
def test_intervals_hold_on_soils_drawn_from_the_prior(swing, cells):
    """A track at one load shows A c + W tan phi: intervals are then wide, and hold window after window."""
    config, drives = crawler(*cells, "estimator.hop=10"), 6
    found = []
    for seed, soil in zip(range(drives), soils_of_the_prior(config, 7), strict=False):
        ground = replace(pulling(soil, 30.0), side_shift=Swing(-swing, swing))
        found.append(errors(last_fit(config, simulate(config, ground, seed)).posterior, soil))
    rms, covered = np.sqrt(np.square(found).mean(axis=0)), np.mean(np.abs(found) < 1.96, axis=0)
    judged = slice(1, 2) if swing and not cells else slice(2)  # loads that shift unseen for seconds bias the pressure
    assert covered[judged].min() > 0.7  # at 0.95 each, fewer than 5 of 6 happen once in 30
    assert rms[judged].max() < 1.6


@pytest.mark.parametrize("name", ["loam", "dry_sand"])
@pytest.mark.parametrize("cells", [(), WITH_CELLS], ids=["weight alone", "load cells"])
def test_a_draft_that_hardly_moves_is_enough_for_strength_and_thrust(cells, name):
    """The draft moves by 3 %: c + p tan phi at the tracks' pressure is determined, its two parts are not."""
    soil, pressure = SOILS[name], WEIGHT / (2.0 * B * L)
    ground = replace(pulling(name, 20.0), draft=Swing(0.97 * 18e3, 1.03 * 18e3))
    config = crawler(*cells)
    results = results_of(config, simulate(config, ground, 3).channels, ground.duration)
    assert len(results) >= 10
    assert {result.status for result in results} == {Status.VALID}
    for result in results[::5]:
        strength, most = result.posterior.shear_strength(pressure), result.traversability.max_draft
        true = soil.c + pressure * math.tan(soil.phi)
        assert abs(strength.value - true) < 2.5 * strength.std
        assert strength.std < 0.2 * strength.value
        assert abs(most.value - by_hand(soil, 0.6)[0]) < 2.5 * most.std


def test_a_crawler_that_pulls_nothing_lacks_a_range_of_slips():
    recording = simulate(crawler(), replace(pulling("loam", 14.0), draft=Swing(0.0, 1.0)), 3)
    results = results_of(crawler(), recording.channels, 14.0)
    assert {result.reason for result in results} == {"not_excited slip_range"}


@pytest.mark.parametrize("name", ["dry_sand", "loam", "wet_clay"])
def test_strength_and_shear_modulus_from_sprocket_torque_speed_and_ground_speed(name, tmp_path):
    """As Le, Rye & Durrant-Whyte (1997): no load, draft or sinkage measured."""
    text = CRAWLER.read_text(encoding="utf-8").split("[signals.draft]")[0]
    text = "".join(line for line in text.splitlines(keepends=True) if not line.startswith("sinkage"))
    text = text.replace("[vehicle]", '[vehicle]\ntowing = "unknown"') + "[estimator]\nhop = 10.0\n"
    (tmp_path / "vehicle.toml").write_text(text, encoding="utf-8")
    config, soil, pressure = load_config(tmp_path / "vehicle.toml"), SOILS[name], WEIGHT / (2.0 * B * L)
    towed, found = crawler(), []
    for seed in range(2):
        recording = simulate(towed, replace(pulling(name, 20.0), side_shift=Swing(0.0, 0.0)), seed)
        channels = {c: v for c, v in recording.channels.items() if c.partition(".")[0] not in ("draft", "sinkage")}
        fit = last_fit(config, replace(recording, channels=channels))
        posterior, K = fit.posterior, fit.posterior.parameters()["K"]
        strength = posterior.soil.c + pressure * posterior.tan_phi().value
        assert strength == pytest.approx(soil.c + pressure * np.tan(soil.phi), rel=0.05)
        assert K.std < 0.22 * K.value  # an instant's load is left to the torques
        found.append([(K.value - soil.K) / K.std, *errors(posterior, soil)])
    assert np.abs(found).max() < 2.8


def test_a_crawler_with_peaks_below_its_rollers_is_simulated_and_estimated_with_them():
    config = crawler("track.L.roller_spacing=0.32", "track.R.roller_spacing=0.32", *WITH_CELLS)
    assert model_of(config).rollers == 5
    recording = simulate(config, pulling("loam", 12.0), seed=2)
    truth = recording.truth
    for name in "LR":  # the rut is as deep as twice the mean pressure presses it
        z = (2.0 * truth[f"load.{name}"] / (B * L) / (LOAM.k_c / B + LOAM.k_phi)) ** (1.0 / LOAM.n)
        assert truth[f"sinkage.{name}"] == pytest.approx(z, rel=1e-6)
    assert np.abs(errors(last_fit(config, recording).posterior, LOAM)).max() < 3.0
    uniform = assess(Posterior(LOAM, np.zeros((6, 6))), rig_of(config), WheelModel(), None, NO_LIMIT, 0.6, 0.25)[0]
    peaked = assess(Posterior(LOAM, np.zeros((6, 6))), rig_of(config), model_of(config), None, NO_LIMIT, 0.6, 0.25)[0]
    assert peaked.max_draft.value < uniform.max_draft.value  # more resistance, a little less thrust


def test_the_sprocket_radius_follows_from_pitch_and_teeth(tmp_path):
    text = CRAWLER.read_text(encoding="utf-8").replace("sprocket_radius = 0.30", "pitch = 0.1\nsprocket_teeth = 19")
    (tmp_path / "vehicle.toml").write_text(text, encoding="utf-8")
    assert rig_of(load_config(tmp_path / "vehicle.toml")).radius == pytest.approx([19 * 0.1 / (2.0 * math.pi)] * 2)


# --- three axles: how they share their load, what they know of the soil, how much they can pull ---

MIDDLE = 1.5
"""Distance of the middle axle ahead of the rear one [m], of 2.4 m between the first and the last."""
PLACES = {"front": 2.4, "middle": MIDDLE, "rear": 0.0}


def six_wheels(cells: bool = True, axle: list[dict[str, Any]] | None = None, motors: bool = True) -> Config:
    """Its configuration, signals of names that no DBC has."""
    raw = tomllib.loads(machine("tractor").read_text(encoding="utf-8"))
    raw["vehicle"] = {
        "mass": 3600.0, "wheelbase": 2.4, "cg_ahead_of_rear_axle": 1.25, "cg_height": 0.8, "hitch_height": 0.5,
    }  # fmt: skip
    raw["axle"] = [{"name": "middle", "ahead_of_rear_axle": MIDDLE}] if axle is None else axle
    raw["wheel"] = []
    for name, letter in (("front", "F"), ("middle", "M"), ("rear", "R")):
        for corner in (letter + side for side in "LR"):
            of_wheel = {"name": corner, "axle": name, "radius": 0.52, "width": 0.36, "speed": f"Speeds.{corner}"}
            of_motor = {"gear_ratio": 28.0, "max_torque": 2600.0, "torque": f"Motor{corner}.Torque"}
            raw["wheel"].append(
                of_wheel | (of_motor if motors else {}) | ({"load": f"Loads.{corner}"} if cells else {})
            )
    raw["estimator"] = {} if cells else {"max_bearing_std": 0.2}
    return parse_config(raw, folder=Path())


WEIGHT_OF_SIX = 3600.0 * 9.80665


def of_springs(draft: float) -> np.ndarray:
    """Loads [N] of the front, middle and rear axle on the level, each axle a spring below a rigid frame."""
    stiffness, x = 2.0e5, np.array([*PLACES.values()])
    moment = WEIGHT_OF_SIX * 1.25 - draft * 0.5  # about the rear contact
    of_heave_and_pitch = stiffness * np.array([[3.0, x.sum()], [x.sum(), (x**2).sum()]])
    heave, pitch = np.linalg.solve(of_heave_and_pitch, [WEIGHT_OF_SIX, moment])
    return np.asarray(stiffness * (heave + pitch * x))


@pytest.mark.parametrize("cells", [True, False])
def test_the_largest_draft_of_six_wheels_on_loam_is_within_its_interval(cells):
    config = six_wheels(cells)
    found = [trial(config, "loam", seed) for seed in range(16)]
    off = np.array([(each.predicted - each.true) / each.std for each in found])
    assert np.isfinite(off).all()
    assert (np.abs(off) < 1.96).sum() >= 14  # of sixteen 95 % intervals: two misses at most in 96 of 100 cases
    assert np.median([abs(each.predicted / each.true - 1.0) for each in found]) < 0.1
    assert np.median([each.std / each.true for each in found]) < 0.2


def test_the_pull_of_six_wheels_is_that_of_each_wheel_under_its_load():
    found = balance(wheel_table(np.array([SOILS["loam"]]), rig_of(six_wheels()), MODEL, np.array([0.1, 0.3])), Duty())
    for slip, pull in zip(found.slip, found.pull[0], strict=True):
        if slip not in (0.1, 0.3):
            continue
        loads = of_springs(pull)
        assert 2.0 * sum(wheel(SOILS["loam"], load / 2.0, slip, 0.52, 0.36)[1] for load in loads) == pytest.approx(
            pull, abs=1e-4 * WEIGHT_OF_SIX
        )


def window_of(rig, truth):
    """A second of one state, each channel as the truth has it; nan where it says nothing."""
    t = np.arange(0.05, 1.0, 0.1)
    columns = [np.full(len(t), truth.get(name, np.nan)) for name in rig.channels]
    mean = np.stack(columns, axis=1)
    count = 5.0 * np.isfinite(mean)
    return completed(forward(made_window(NoiseTable.of(rig), t, mean, count, int(count.sum()))), rig)


def driving(rig, **more):
    each = {f"torque.{w}": 800.0 for w in rig.wheels} | {f"speed.{w}": 2.5 for w in rig.wheels}
    return each | {"ground_speed": 1.2, "draft": 6000.0, "pitch": 0.0, "acceleration": 0.0} | more


def test_loads_that_no_cell_measures_are_those_of_a_frame_on_springs():
    rig = rig_of(six_wheels(cells=False))
    load = window_of(rig, driving(rig)).load[0]
    assert load == pytest.approx(np.repeat(of_springs(6000.0), 2) / 2.0, rel=1e-9)


def test_a_cell_of_one_axle_leaves_the_others_to_weight_and_moment():
    middle = {"name": "middle", "ahead_of_rear_axle": MIDDLE, "load": "Loads.Middle"}
    rig = rig_of(six_wheels(cells=False, axle=[middle]))
    load = window_of(rig, driving(rig) | {"load.middle": 5000.0}).load[0]
    front, rear = load[:2].sum(), load[4:].sum()
    assert load[2:4].sum() == pytest.approx(5000.0)
    assert front + rear == pytest.approx(WEIGHT_OF_SIX - 5000.0)
    assert front * 2.4 + 5000.0 * MIDDLE == pytest.approx(WEIGHT_OF_SIX * 1.25 - 6000.0 * 0.5)


def test_an_axle_whose_share_is_not_sure_makes_the_loads_less_sure_and_their_sum_no_less():
    rig = rig_of(six_wheels(cells=False))
    rows = {row.kind: row for row in rig.instrumentation.load}
    frame = np.array(rows["frame"].weight)
    assert frame @ np.ones(6) == pytest.approx(0.0, abs=1e-12)
    assert frame @ np.repeat([*PLACES.values()], 2) == pytest.approx(0.0, abs=1e-12)
    assert rows["frame"].gain > 0.0
    assert sorted(row.kind for row in rig.instrumentation.load) == ["frame", *["side"] * 3, "transfer", "weight"]


def test_every_axle_has_its_left_and_right_wheel_in_a_turn():
    rig = dataclasses.replace(rig_of(six_wheels()), track=1.6)
    assert pairs(rig).T.tolist() == [[0, 1], [2, 3], [4, 5]]
    left_turn = {f"speed.{w}": 2.0 if w.endswith("L") else 3.0 for w in rig.wheels}
    assert turning(window_of(rig, driving(rig) | left_turn), rig, 0.15).all()
    one_spins = {"speed.ML": 5.0}
    assert not turning(window_of(rig, driving(rig) | one_spins), rig, 0.15).any()


def test_a_shaft_drives_three_axles_by_their_grip():
    shaft = {"name": "both", "torque": "Shaft.Torque", "motor_speed": "Shaft.Speed", "differential": "locked"}
    config = six_wheels(axle=[{"name": "middle", "ahead_of_rear_axle": MIDDLE}, shaft], motors=False)
    rig = rig_of(config)
    between = [c for c in rig.instrumentation.couplings if not c.of_axle]
    assert [(c.one, c.other, c.locked) for c in between] == [((0, 1), (2, 3), True), ((2, 3), (4, 5), True)]
    (motor,) = [m for m in motors_of(config, rig) if m.name == "both"]
    assert motor.share == pytest.approx(np.repeat(of_springs(0.0), 2) / 2.0 / WEIGHT_OF_SIX)


def test_the_wheels_of_a_single_axle_carry_all_of_the_weight():
    raw = tomllib.loads(machine("tractor").read_text(encoding="utf-8"))
    wheels = [{k: v for k, v in of.items() if k != "load"} | {"axle": "only"} for of in raw["wheel"][2:]]
    vehicle = {"mass": 500.0, "cg_height": 0.6, "hitch_height": 0.4}
    config = parse_config(raw | {"vehicle": vehicle, "wheel": wheels, "axle": [{"name": "only"}]}, folder=Path())
    rig = rig_of(config)
    assert window_of(rig, driving(rig)).load[0] == pytest.approx([500.0 * 9.80665 / 2.0] * 2)
    assert config.vehicle.wheelbase == pytest.approx(2.0 * 0.62)


@pytest.mark.parametrize(
    ("axle", "ahead"),
    [
        ([], [1.0, 0.5, 0.0]),
        ([{"name": "rear"}, {"name": "middle", "ahead_of_rear_axle": 0.6}], [1.0, 0.25, 0.0]),
    ],
)
def test_axles_stand_front_to_rear_equally_far_apart_or_where_they_are_said_to(axle, ahead):
    assert rig_of(six_wheels(axle=axle)).ahead == pytest.approx(np.repeat(ahead, 2))
