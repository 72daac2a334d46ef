"""Which sensor lies: never one on a good drive, however harsh, whatever the soil or effect."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import norm

from soilbus.can.dbc_files import load_databases
from soilbus.can.mapping import channels_of
from soilbus.estimation.assembly import rig_of, with_effects
from soilbus.estimation.window import Window, forward
from soilbus.sensors.bins import Bins
from soilbus.sensors.consistency import Resolution, SensorConsistency, implausible, lasts, runs
from soilbus.simulator.recording import Recording, simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import Patch, Scenario, Swing, demo, excited
from soilbus.terra.effects.catalogue import CATALOGUE

SIDES = ("FL", "FR", "RL", "RR")
CONFIG = reference_configuration([f"wheel.{w}.motor_speed=Motor{w}.ShaftSpeed" for w in SIDES])
RIG = rig_of(CONFIG)
LOAM = (Patch(0.0, "loam"),)
HARSH = Swing(0.6, 2.5, 0.2, 0.5)
STEEP = ((0.0, 0.0), (10.0, 0.15), (20.0, -0.2), (40.0, 0.2))
DRIVES = {
    "excited": excited("loam", 14.0),
    "harsh slip": Scenario(14.0, LOAM, HARSH, slip=Swing(0.02, 0.6, 0.1, 0.4)),
    "harsh draft": Scenario(14.0, LOAM, HARSH, draft=Swing(0.0, 6e3, 0.1, 0.4)),
    "no implement": Scenario(14.0, LOAM, HARSH, draft=Swing(0.0, 1.0)),
    "braking": Scenario(14.0, LOAM, HARSH, slip=Swing(-0.3, 0.3, 0.1, 0.4)),
    "steep": Scenario(20.0, LOAM, Swing(1.0, 1.6), draft=Swing(0.0, 3e3), slope=STEEP),
    "side slope": Scenario(14.0, LOAM, draft=Swing(0.0, 3e3), side_shift=Swing(-0.4, 0.4), slip_spread=0.1),
    "spinning on sand": Scenario(14.0, (Patch(0.0, "dry_sand"),), slip=Swing(0.05, 0.7)),
    "evenly": Scenario(14.0, LOAM, Swing(1.3, 1.3), draft=Swing(2.5e3, 2.5e3)),
    "border": demo(20.0),
    "border back": demo(20.0, "wet_clay", "loam"),
    "gradual border": Scenario(
        20.0, (Patch(0.0, "loam"), Patch(8.0, "wet_clay")), draft=Swing(2e3, 4e3), lift_slip=Swing(0.5, 0.65),
        transition=15.0,
    ),
}  # fmt: skip
EXTREMES = {
    "exponential_shear": 1.0, "grade": 0.15, "draft_offset": -3000.0, "draft_gain": -0.45, "rolling_radius": -0.1,
    "stress_peak_shift": 0.3, "multipass": 2.0, "lugs": 0.1, "wheel_load_offset": 2500.0, "soil_drift": 1.0,
    "inertia": 2.0, "drivetrain_loss": 0.3, "slip_sinkage": 2.0, "rate_stiffening": 0.4,
}  # fmt: skip
"""Values of effects near the ends of their ranges, where the range's own end is no drive at all."""


def named(recording: Recording) -> set[str]:
    """Every channel named in any window of a recording."""
    names: set[str] = set()
    for window, motor in windows(recording):
        names |= set(judged(window, motor))
    return names


def windows(recording: Recording):
    """Forward windows each 2 s, with the speeds of the motors."""
    length, samples = CONFIG.estimator.window, {n: (c.t, c.value) for n, c in recording.channels.items()}
    store = Bins(RIG, CONFIG.estimator.bin, 0.0)
    store.add({n: s for n, s in samples.items() if n in RIG.channels})
    for end in np.arange(length, recording.truth["t"][-1] + 0.05, 2.0).tolist():
        window = forward(store.window(end - length, end))
        motor = np.stack([np.interp(window.t, *samples[f"motor_speed.{w}"]) for w in RIG.wheels], axis=1)
        yield window, motor


def judged(window: Window, motor=None) -> tuple[str, ...]:
    return implausible(window, RIG, CONFIG.estimator, {}, motor)


@pytest.mark.parametrize("name", DRIVES)
def test_nobody_lies_on_a_good_drive(name):
    assert named(simulate(CONFIG, DRIVES[name], seed=5)) == set()


@pytest.mark.parametrize("name", CATALOGUE)
def test_an_effect_is_no_lie(name):
    first = CATALOGUE[name].parameters[0]
    config = with_effects(
        reference_configuration([f"model.shear_law={CATALOGUE[name].base_law or 'exponential'}"]),
        [f"{name}={EXTREMES.get(name, 0.6 * first.high)}"],
    )
    with_motors = config.model_copy(update={"wheel": CONFIG.wheel})
    assert named(simulate(with_motors, Scenario(12.0, LOAM, slip=Swing(0.05, 0.4)), seed=2)) == set()


@pytest.fixture(scope="module")
def good() -> tuple[Window, np.ndarray]:
    return next(windows(simulate(CONFIG, excited("loam", 10.0), seed=3)))


@pytest.mark.parametrize("ratio", [0.05, 0.1, 0.14, 0.2, 0.4])
def test_a_turn_is_no_lie(ratio, good):
    window, motor = good
    speed, motor = window.speed.copy(), motor.copy()
    for wheels in (speed, motor):
        wheels[30:80, [0, 2]] *= 1.0 - ratio / 2.0
        wheels[30:80, [1, 3]] *= 1.0 + ratio / 2.0
    assert judged(replace(window, speed=speed), motor) == ()


@pytest.mark.parametrize("wheel", range(4))
@pytest.mark.parametrize("ratio", [0.3, 0.9, 1.1, 2.0])
def test_of_wheel_and_motor_the_odd_one_is_named(ratio, wheel, good):
    window, motor = good
    speed, other = window.speed.copy(), motor.copy()
    speed[:, wheel] *= ratio
    other[:, wheel] *= ratio
    assert judged(replace(window, speed=speed), motor) == (f"speed.{SIDES[wheel]}",)
    assert judged(window, other) == (f"motor_speed.{SIDES[wheel]}",)


@pytest.mark.parametrize("wheel", range(4))
@pytest.mark.parametrize("excess", [-4.5e3, 4.5e3])
def test_the_load_that_breaks_the_sum_is_named(excess, wheel, good):
    window, motor = good
    load = window.load.copy()
    load[20:, wheel] += excess
    assert judged(replace(window, load=load), motor) == (f"load.{SIDES[wheel]}",)


def test_a_lifted_implement_or_a_full_tank_is_no_lie(good):
    window, motor = good
    for by_wheel in ([-700.0, -700.0, 2700.0, 2700.0], [1200.0, 1200.0, 1200.0, 1200.0], [3e3, 3e3, -6e2, -6e2]):
        assert judged(replace(window, load=window.load + np.array(by_wheel)), motor) == ()


@pytest.fixture(scope="module")
def lively() -> Window:
    """A window whose speed changes all the time."""
    scenario = Scenario(10.0, LOAM, Swing(0.8, 1.8, 0.1, 0.3), slip=Swing(0.05, 0.3))
    return next(windows(simulate(CONFIG, scenario, seed=4)))[0]


@pytest.mark.parametrize(
    ("factor", "since", "names"),
    [
        (1.0, 0, ()),
        (0.5, 0, ("ground_speed", "acceleration")),  # great slip and a wrong accelerometer look the same
        (0.5, 40, ("ground_speed",)),
        (0.85, 0, ()),
    ],
)
def test_a_ground_speed_of_another_scale_contradicts_the_acceleration(factor, since, names, lively):
    speed = lively.ground_speed.copy()
    speed[since:] *= factor
    assert judged(replace(lively, ground_speed=speed)) == names


@pytest.mark.parametrize(("factor", "names"), [(0.9, ()), (2.0, ("acceleration",))])
def test_an_acceleration_of_another_scale_contradicts_the_ground_speed(factor, names, lively):
    assert judged(replace(lively, acceleration=factor * lively.acceleration)) == names


@pytest.mark.parametrize("late", range(-4, 5))
def test_a_radar_that_is_late_has_the_same_scale(late, lively):
    speed = np.interp(lively.t - 0.1 * late, lively.t, lively.ground_speed)
    assert judged(replace(lively, ground_speed=speed)) == ()


def test_a_blow_that_the_acceleration_tells_is_no_jump(lively):
    """The vehicle runs into something, and loses half its speed within 0.2 s."""
    speed, acceleration, wheels = (a.copy() for a in (lively.ground_speed, lively.acceleration, lively.speed))
    speed[50:] -= 0.5
    wheels[50:] -= 0.5 / RIG.radius
    acceleration[49:51] -= 2.5
    assert judged(replace(lively, ground_speed=speed, acceleration=acceleration, speed=wheels)) == ()


@pytest.mark.parametrize("wheels", [[0, 1], [2, 3], [0, 1, 2, 3]])
def test_a_ground_speed_that_is_made_of_wheel_speeds_is_named(wheels, good):
    window, motor = good
    rim = (RIG.radius * window.speed)[:, wheels].mean(axis=1)
    assert judged(replace(window, ground_speed=rim), motor) == ("ground_speed",)
    traction = window.torque / (RIG.radius * window.load)
    for radius_error in (0.0, float(np.median(traction)) / 20.0):  # of too small a radius the slip reads about 0
        on_asphalt = (window.ground_speed / (1.0 + radius_error - traction.T / 20.0) / RIG.radius[:, None]).T
        assert judged(replace(window, speed=on_asphalt), on_asphalt) == ()


def test_what_does_not_last_or_is_not_driven_is_not_judged(good):
    window, motor = good
    speed = window.speed.copy()
    speed[40:49, 1] *= 0.05
    assert judged(replace(window, speed=speed), motor) == ()
    speed[40:50, 1] = 0.05 * window.speed[40:50, 1]
    assert judged(replace(window, speed=speed), motor) == ("speed.FR",)
    standing = np.full_like(window.ground_speed, 0.1)
    assert judged(replace(window, speed=speed, ground_speed=standing), motor) == ()


def test_readings_may_repeat_as_often_as_their_noise_lets_them(good):
    """With steps of s and noise sd the chance of n equal readings is at most (P(|x| < s / 2))^(n - 1)."""
    window, _ = good
    noise = RIG.noise["draft"]
    draft = window.draft.copy()
    draft[20:60] = 3000.0
    frozen = replace(window, draft=draft)
    samples = float((noise.absolute**2 / window.variance["draft"][20:60]).sum())
    for step in (1.0, 40.0, 100.0, 150.0, 200.0, 400.0):
        same = 1.0 - 2.0 * norm.sf(step / 2.0 / noise.absolute)
        expected = ("draft",) if (samples - 1.0) * math.log(same) < math.log(1e-12) else ()
        told = implausible(frozen, RIG, CONFIG.estimator, {"draft": Resolution(step, False)})
        assert told == expected, step
    at_rest = replace(window, draft=np.zeros_like(draft))
    for rests, names in ((True, ()), (False, ("draft",))):
        given = {"draft": Resolution(1.0, rests)}
        assert implausible(at_rest, RIG, CONFIG.estimator, given) == names


def test_a_radar_coarser_than_its_signal_is_not_frozen(good):
    """Steps of 0.1 km/h inside a sensor whose signal has steps of 1 mm/s: readings stay for seconds, here and there."""
    window, _ = good
    step = 0.1 / 3.6
    slowly = 1.3 + 0.08 * np.sin(2.0 * np.pi * (window.t - window.t[0]) / 25.0)
    coarse = step * np.round(slowly / step)
    same = np.diff(coarse) == 0.0
    assert max(end - first for first, end in runs(same)) > 10
    speed = slowly[:, None] / RIG.radius / 0.8
    assert judged(replace(window, ground_speed=coarse, speed=speed), None) == ()
    alive = slowly + 0.01 * np.random.default_rng(1).standard_normal(len(coarse))
    alive[50:] = alive[50]
    assert judged(replace(window, ground_speed=alive, speed=speed), None) == ("ground_speed",)


@pytest.mark.parametrize(("every", "names"), [(45, ("ground_speed",)), (15, ("ground_speed",)), (4, ()), (2, ())])
def test_how_often_readings_repeat_elsewhere_tells_coarse_from_frozen(every, names, good):
    """Half the window alive, with one of `every` readings said twice, then the same reading for five seconds."""
    window, _ = good
    reading = window.ground_speed + 0.01 * np.random.default_rng(1).standard_normal(len(window.t))
    reading[every:50:every] = reading[every - 1 : 49 : every]
    reading[50:] = reading[50]
    assert sum(np.diff(reading[:51]) == 0.0) == 49 // every
    assert judged(replace(window, ground_speed=reading)) == names


@given(st.lists(st.booleans(), max_size=40), st.integers(1, 12))
def test_runs(holds, bins):
    mask = np.array(holds, bool)
    text = "".join("x" if h else " " for h in holds)
    assert ["x" * (end - first) for first, end in runs(mask)] == text.split()
    assert all(mask[first:end].all() for first, end in runs(mask))
    assert lasts(mask, bins) == ("x" * bins in text)


def test_motor_speeds_are_binned_as_the_window_is(good):
    """Against plain means of the samples of each bin."""
    recording = simulate(CONFIG, excited("loam", 12.0), seed=3)
    database = load_databases(CONFIG)
    ear = SensorConsistency(RIG, channels_of(CONFIG, database), database, CONFIG.estimator)
    heard = {n: (c.t + 5.0, c.value) for n, c in recording.channels.items() if n.startswith("motor_speed")}
    for part in (slice(0, 170), slice(170, 171), slice(171, None)):
        ear.add({n: (t[part], v[part]) for n, (t, v) in heard.items()})
    window = good[0]
    speed = ear._motor_speed(replace(window, t=window.t + 6.0))
    t, value = heard["motor_speed.RL"]
    begin = window.t[0] + 6.0 - 0.05
    for k in (0, 1, 50, 99):
        inside = (t >= begin + 0.1 * k - 1e-9) & (t < begin + 0.1 * (k + 1) - 1e-9)
        assert speed[k, 2] == pytest.approx(value[inside].mean(), rel=1e-12)
