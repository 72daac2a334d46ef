"""Effects of the vehicle and of its sensors against hand formulas, np.interp and exact derivatives."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline
from scipy.signal import lsim, lti

from soilbus.terra.effects.along import stretches
from soilbus.terra.effects.catalogue import CATALOGUE
from soilbus.terra.effects.effect import wheel_with
from soilbus.terra.effects.sensors import read_late
from soilbus.terra.vehicle import slip_ratio
from soilbus.terra.wheel import WheelModel
from wheels_around import RADIUS, REAR, active, wheels_around

STATE, AROUND = wheels_around(seed=8)
T = np.linspace(0.0, 30.0, 301)


def torque_of(name: str, torque: np.ndarray, around=AROUND, **values: float) -> np.ndarray:
    effect = CATALOGUE[name]
    told = effect.neutral | values
    if "torque" in effect.late:
        return read_late(torque, around.t[:, 0], told, effect.late["torque"])
    return effect.torque(torque, around, told)


def test_a_drive_line_takes_torque_driving_and_braking():
    torque = np.array([[500.0, -200.0], [500.0, 500.0]])
    around = AROUND._replace(wheel_speed=np.array([[2.0, 2.0], [2.0, -2.0]]))
    reading = torque_of("drivetrain_loss", torque, around, share=0.1, drag=15.0)
    assert reading == pytest.approx(np.array([[565.0, -165.0], [565.0, 435.0]]))
    churned = torque_of("drivetrain_loss", torque, around, viscous=4.0)
    assert churned == pytest.approx(np.array([[508.0, -192.0], [508.0, 492.0]]))


def test_friction_of_a_drive_line_falls_with_speed():
    """At 2.5 rad/s it is what share and drag say, at four times that 4^-0.5 of it; churning is not touched."""
    torque = np.array([[500.0, 500.0, -200.0]])
    around = AROUND._replace(wheel_speed=2.5 * np.array([[1.0, 4.0, -4.0]]))
    lost = torque_of("drivetrain_loss", torque, around, share=0.1, drag=15.0, viscous=2.0, fading=0.5) - torque
    churned = 2.0 * around.wheel_speed
    assert lost - churned == pytest.approx(np.array([[65.0, 32.5, -17.5]]))
    still = AROUND._replace(wheel_speed=np.zeros((1, 3)))
    assert np.isfinite(torque_of("drivetrain_loss", torque, still, share=0.1, fading=1.5)).all()


def test_a_slope_changes_along_the_way():
    grade = CATALOGUE["grade"]
    departures = [0.0, *np.random.default_rng(1).uniform(-0.03, 0.03, len(grade.parameters) - 1)]
    values = {f"slope_{i}": d for i, d in enumerate(departures)} | {"slope_0": 0.01}
    u = (AROUND.distance / AROUND.length)[:, 0]
    slope = 0.01 + CubicSpline(np.linspace(0.0, 1.0, len(departures)), departures, bc_type="natural")(u)
    assert grade.resistance(AROUND, values) == pytest.approx(2300.0 * 9.80665 * np.sin(slope), rel=1e-10)
    assert set(values) == set(grade.neutral)
    assert grade.of_record


def test_worn_tyres_slip_otherwise_than_they_seem():
    worn, _ = wheel_with([active("rolling_radius", front=-0.05, rear=0.03)], STATE, WheelModel(), AROUND)
    true = np.where(REAR, 1.03, 0.95) * RADIUS
    assert worn.radius == pytest.approx(true, rel=1e-12)
    assert worn.slip == pytest.approx(slip_ratio(true, AROUND.wheel_speed, AROUND.ground_speed), abs=1e-12)


def test_moving_masses_hold_back_when_speeding_up():
    inertia = CATALOGUE["inertia"]
    held = inertia.resistance(AROUND, {"mass_share": 0.4, "wheel_inertia": 0.0})
    assert held == pytest.approx(0.4 * 2300.0 * AROUND.acceleration[:, 0], rel=1e-12)


def test_spinning_wheels_take_torque():
    """omega = 2 + sin(t/2): the torque of J is J cos(t/2)/2, to the second order in the step."""
    speed = np.stack([2.0 + np.sin(0.5 * T), np.full(len(T), 2.0)], axis=1)
    around = AROUND._replace(t=T[:, None], wheel_speed=speed)
    reading = torque_of("inertia", np.full((len(T), 2), 300.0), around, wheel_inertia=40.0)
    assert reading[1:-1, 0] == pytest.approx(300.0 + 20.0 * np.cos(0.5 * T[1:-1]), abs=0.02)
    assert reading[:, 1] == pytest.approx(300.0, rel=1e-12)


@pytest.mark.parametrize("size", [1, 2])
def test_too_few_instants_have_no_rate(size):
    around = AROUND._replace(t=T[:size, None], wheel_speed=np.linspace(1.0, 2.0, size)[:, None])
    torque = np.full((size, 1), 300.0)
    assert np.array_equal(torque_of("inertia", torque, around, wheel_inertia=40.0), torque)
    assert torque_of("torque_lag", torque, around, delay=0.3) == pytest.approx(torque, rel=1e-12)


@pytest.mark.parametrize("delay", [0.03, 0.1, 0.25, 0.6])
def test_a_late_torque_is_the_torque_of_an_earlier_moment(delay):
    torque = np.stack([500.0 + 200.0 * np.sin(1.3 * T), 400.0 + 10.0 * T], axis=1)
    late = torque_of("torque_lag", torque, AROUND._replace(t=T[:, None]), delay=delay)
    begun = delay < T
    before = torque[0] + (T[~begun] - delay)[:, None] * (torque[1] - torque[0]) / (T[1] - T[0])
    assert late[~begun] == pytest.approx(before, rel=1e-9)  # straight on, beyond the first instant
    for wheel in range(2):
        assert late[begun, wheel] == pytest.approx(np.interp(T - delay, T, torque[:, wheel])[begun], rel=1e-12)
    assert late[begun, 0] == pytest.approx(500.0 + 200.0 * np.sin(1.3 * (T[begun] - delay)), abs=0.5)


@pytest.mark.parametrize("lag", [1e-4, 0.04, 0.3, 2.0])
def test_a_filtered_torque_is_that_of_a_first_order_lag(lag):
    """scipy's lsim of 1 / (lag s + 1) between straight lines, from rest at the first torque; after a delay besides."""
    torque = np.stack([500.0 + 200.0 * np.sin(1.3 * T), np.random.default_rng(2).normal(400.0, 100.0, len(T))], axis=1)
    around = AROUND._replace(t=T[:, None])
    late = torque_of("torque_lag", torque, around, time_constant=lag)
    alone = np.stack([lsim(lti([1.0], [lag, 1.0]), of_wheel - of_wheel[0], T)[1] for of_wheel in torque.T], axis=1)
    assert late == pytest.approx(torque[0] + alone, abs=1e-6)
    both = torque_of("torque_lag", torque, around, delay=0.25, time_constant=lag)
    queued = torque_of("torque_lag", torque, around, delay=0.25)
    assert both == pytest.approx(torque_of("torque_lag", queued, around, time_constant=lag), rel=1e-12)


def test_nothing_is_late_or_fast_across_a_gap():
    """Two runs with a minute between: each as if alone."""
    t = np.concatenate([T[:50], T[:50] + 65.0])
    torque, around = np.repeat([200.0, 900.0], 50)[:, None], AROUND._replace(t=t[:, None])
    assert torque_of("torque_lag", torque, around, delay=0.4, time_constant=0.3) == pytest.approx(torque, rel=1e-12)
    around = around._replace(wheel_speed=np.repeat([1.0, 3.0], 50)[:, None])
    assert torque_of("inertia", torque, around, wheel_inertia=30.0) == pytest.approx(torque, rel=1e-12)


def test_runs_end_at_gaps_and_where_time_goes_back():
    t = np.array([0.0, 0.1, 0.2, 5.0, 5.1, 4.0, 4.1])
    assert [run.tolist() for run in stretches(t)] == [[0, 1, 2], [3, 4], [5, 6]]
    assert [run.tolist() for run in stretches(t[:1])] == [[0]]


def test_the_hitchs_load_cell_has_zero_and_span():
    draft = np.array([-500.0, 0.0, 4000.0])
    offset, gain = CATALOGUE["draft_offset"], CATALOGUE["draft_gain"]
    values = {"offset": 250.0, "drift": 0.0, "settling": 0.01}
    assert offset.draft(draft, AROUND._replace(t=np.zeros((3, 1))), values).tolist() == [250.0, 250.0, 250.0]
    assert gain.draft(draft, AROUND, {"gain": -0.1}) == pytest.approx([50.0, 0.0, -400.0])


@pytest.mark.parametrize("settling", [5e-4, 0.01, 0.2])
def test_a_zero_settles_as_what_warms_up(settling):
    """Newton's law: the rate fades at `settling`; integrated step by step, to the zero at the end of the record."""
    t = np.array([0.0, 60.0, 180.0])
    around = AROUND._replace(t=t[:, None], load=np.zeros((3, 4)), duration=180.0)
    hitch = CATALOGUE["draft_offset"].draft(np.zeros(3), around, {"offset": 250.0, "drift": 0.5, "settling": settling})
    found = solve_ivp(
        lambda _, zero_and_rate: (zero_and_rate[1], -settling * zero_and_rate[1]), (0.0, 180.0), (hitch[0], 0.5),
        t_eval=t, rtol=1e-10, atol=1e-9,
    )  # fmt: skip
    assert hitch == pytest.approx(found.y[0], rel=1e-7)
    assert hitch[-1] == 250.0
    of_wheels = {"offset": np.array([100.0, 0.0, 0.0, 50.0]), "drift": np.array([0.0, 2.0, -0.5, 0.0])}
    wheels = CATALOGUE["wheel_load_offset"].load(around, of_wheels | {"settling": np.full(4, settling)})
    assert wheels == pytest.approx(of_wheels["offset"] + (hitch[:, None] - 250.0) * of_wheels["drift"] / 0.5, abs=1e-9)


def test_the_wheels_load_cells_alone_have_parameters_of_their_own():
    assert [e.name for e in CATALOGUE.values() if e.each_wheel] == ["wheel_load_offset"]
