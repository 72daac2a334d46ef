"""Turns are distinguished from wheels that spin on one side: by signs, by size, by the yaw rate if there is one."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from soilbus.estimation.measurements import Measurements
from soilbus.estimation.window import Rig, SensorNoise, Window, forward, turning
from soilbus.terra.vehicle import Chassis

MAX_TURN, TRACK = 0.15, 1.14
QUANTITIES = ("torque", "load", "speed", "sinkage", "ground_speed", "draft", "pitch", "acceleration", "yaw_rate")


def rig(track: float | None = None) -> Rig:
    noise = {q: SensorNoise(absolute=1.0) for q in QUANTITIES}
    radius = np.array([0.5, 0.5, 0.62, 0.62])
    return Rig(
        ("FL", "FR", "RL", "RR"), radius, np.full(4, 0.3), np.array([True, True, False, False]), None, noise, track
    )


def drive(rims, ground, yaw=None) -> Window:
    """Instants with these rim speeds (N, 4), ground speeds and yaw rates (N,); all else is 1."""
    speed = np.atleast_2d(np.asarray(rims, float)) / rig().radius
    n = len(speed)
    values = {q: np.ones((n, 4)) for q in ("torque", "load", "sinkage")} | {"speed": speed}
    values |= {q: np.ones(n) for q in ("draft", "pitch", "acceleration")}
    values["ground_speed"] = np.broadcast_to(np.asarray(ground, float), n).copy()
    values["yaw_rate"] = np.broadcast_to(np.asarray(np.nan if yaw is None else yaw, float), n).copy()
    return Window(
        t=np.arange(n) * 0.1, variance={q: np.ones_like(v) for q, v in values.items()}, samples=9 * n, **values
    )


def on_a_curve(radius, speed, slips, steer=0.0) -> tuple[np.ndarray, float]:
    """Rim speeds and yaw rate, the rear axle's middle `radius` from the centre of a turn (to the left if > 0).

    The wheels' paths from the geometry of a steered front axle (Ackermann), wheelbase tan(steer) = radius apart.
    """
    yaw = speed / radius
    ahead = abs(radius) * np.tan(steer)
    sides = np.array([-1.0, 1.0, -1.0, 1.0]) * TRACK / 2.0
    paths = abs(yaw) * np.hypot(radius + sides, np.array([ahead, ahead, 0.0, 0.0]))
    return paths / (1.0 - np.asarray(slips)), yaw


def skid_steered() -> Rig:
    chassis = Chassis(mass=2000.0, wheelbase=1.6, cg_ahead_of_rear_axle=0.8, cg_height=0.6, hitch_height=0.4)
    return replace(rig(TRACK), chassis=chassis, max_lateral=0.3)


slips = st.floats(0.0, 0.6)


@given(
    to=st.sampled_from([-1.0, 1.0]),
    radius=st.floats(1.6, 4.0),
    speed=st.floats(0.3, 3.0),
    slip=slips,
    steer=st.floats(0.0, 0.7),
)
def test_turns_are_found_with_and_without_a_yaw_rate(to, radius, speed, slip, steer):
    rims, yaw = on_a_curve(to * radius, speed, np.full(4, slip), steer)
    for track in (None, TRACK):
        assert turning(drive(rims, speed, yaw), rig(track), MAX_TURN).tolist() == [True]
    assert turning(drive(rims, speed), rig(), MAX_TURN).tolist() == [True]


@pytest.mark.parametrize("to", [1.0, -1.0], ids=["left", "right"])
def test_a_turn_begins_at_its_share_of_the_mean_rim_speed_whatever_the_slip(to):
    for slip in (0.05, 0.5):
        for share, expected in ((2.0, True), (1.02, True), (0.98, False), (0.3, False), (1e-9, False)):
            rims, _ = on_a_curve(to * TRACK / MAX_TURN / share, 1.4, np.full(4, slip))
            assert turning(drive(rims, 1.4), rig(), MAX_TURN).tolist() == [expected]


def test_every_known_axle_must_turn():
    nan = np.nan
    straight = drive([[2.0, 2.4, 2.0, 2.0], [2.0, 2.4, 2.0, 2.4], [2.0, 2.0, 2.0, 2.4]], 1.4)
    assert turning(straight, rig(), MAX_TURN).tolist() == [False, True, False]
    gaps = drive([[2.0, 2.4, nan, 2.4], [nan, 2.4, 2.0, nan], [nan] * 4, [2.0, nan, 2.0, 2.0], [0.0] * 4], 1.4)
    assert turning(gaps, rig(), MAX_TURN).tolist() == [True, False, False, False, False]


@given(speed=st.floats(0.2, 3.0), low=st.tuples(slips, slips), more=st.tuples(st.floats(0.1, 5.0), st.floats(0.1, 5.0)))
def test_wheels_that_spin_crosswise_are_no_turn(speed, low, more):
    # diagonal spin of open differentials: front left and rear right, or the other way round
    rims = speed / (1.0 - np.array([low[0], low[0], low[1], low[1]]))
    for spinning in ((0, 3), (1, 2)):
        spun = rims.copy()
        spun[list(spinning)] += more
        for yaw, track in ((None, None), (0.0, None), (0.0, TRACK), (None, TRACK)):
            assert not turning(drive(spun, speed, yaw), rig(track), MAX_TURN).any()


@given(speed=st.floats(0.2, 3.0), slip=st.tuples(slips, slips, slips, slips), track=st.sampled_from([None, TRACK]))
def test_without_a_yaw_rate_measured_no_slip_is_a_turn(speed, slip, track):
    rims = speed / (1.0 - np.array(slip))
    assert not turning(drive(rims, speed, 0.0), rig(track), MAX_TURN).any()


def test_one_side_that_spins_while_the_other_stands_is_no_turn():
    for spinning in ([2.0, 0.0, 2.0, 0.0], [0.02, 1.5, 0.02, 1.5]):
        assert not turning(drive(spinning, 0.3), rig(), MAX_TURN).any()


def test_a_known_yaw_rate_decides_with_a_track_even_where_slip_hides_the_turn():
    # the inner wheels slip just as much more as their path is shorter: the rims turn alike
    rims, yaw = on_a_curve(3.0, 1.0, np.zeros(4))
    hidden = np.full(4, rims.mean())
    assert turning(drive(hidden, 1.0, yaw), rig(TRACK), MAX_TURN).all()
    assert not turning(drive(hidden, 1.0), rig(TRACK), MAX_TURN).any()


def test_a_yaw_rate_to_the_other_side_is_no_proof_of_a_turn():
    rims, yaw = on_a_curve(3.0, 1.0, np.full(4, 0.1))
    assert turning(drive(rims, 1.0, yaw), rig(), MAX_TURN).all()
    assert not turning(drive(rims, 1.0, -yaw), rig(), MAX_TURN).any()
    assert not turning(drive(rims, 1.0, yaw / 100.0), rig(), MAX_TURN).any()  # a track of 100 m


def test_instants_without_a_yaw_rate_are_judged_by_their_rims():
    rims, yaw = on_a_curve(3.0, 1.0, np.zeros(4))
    window = drive(np.stack([rims, rims, rims]), 1.0, np.array([yaw, np.nan, 0.0]))
    assert turning(window, rig(TRACK), MAX_TURN).tolist() == [True, True, False]


def test_in_reverse_a_turn_stays_a_turn():
    # backwards on the same curve the outer wheels stay the faster ones; the yaw rate changes its sign
    rims, yaw = on_a_curve(3.0, 1.0, np.full(4, 0.1))
    for track in (None, TRACK):
        assert turning(forward(drive(-rims, -1.0, -yaw)), rig(track), MAX_TURN).all()


@pytest.mark.parametrize("yaw", [None, 0.0])
def test_diagonal_spin_before_a_vehicle_is_stuck_keeps_its_samples(yaw):
    # From driving with a slip of 0.2 to one wheel of each axle spinning at 3 m/s, the others at the ground's speed.
    n = 60
    into = np.linspace(0.0, 1.0, n)
    ground = 1.0 - 0.75 * into
    spinning, held = 1.25 + 1.75 * into, ground / 0.8
    rims = np.stack([spinning, held, held, spinning], axis=1)
    kept = Measurements(drive(rims, ground, yaw), rig(), 0.2, MAX_TURN)
    assert kept.turning == 0
    assert len(kept.t) == n
    assert kept.usable.all()


@given(yaw=st.floats(-0.1, 0.1), slip=st.floats(0.05, 0.6), speed=st.floats(0.5, 2.0), known=st.booleans())
def test_of_a_skid_steered_vehicle_slip_counts_where_wheels_slide_along_more_than_sideways(yaw, slip, speed, known):
    """Sideways: half the wheelbase times the yaw rate; along: r omega - V; the stress along is cos of their angle."""
    rims = (speed - yaw * TRACK / 2.0 * np.array([1.0, -1.0, 1.0, -1.0])) / (1.0 - slip)
    rate = abs(yaw) if known else abs(yaw) / (1.0 - slip)  # without a yaw rate the rims bound it
    sideways, along = rate * 1.6 / 2.0, speed / (1.0 - slip) - speed
    found = turning(drive(rims, speed, yaw if known else None), skid_steered(), MAX_TURN)[0]
    if abs(sideways / along - 0.3) > 1e-6 and TRACK * rate < 0.9 * MAX_TURN * speed:
        assert found == (sideways > 0.3 * along)
        assert found or 1.0 / np.hypot(1.0, sideways / along) > 0.957


def test_of_a_skid_steered_drive_the_straight_parts_are_used():
    straight, yaw = np.full(4, 1.25), 0.2
    turned = (1.0 - yaw * TRACK / 2.0 * np.array([1.0, -1.0, 1.0, -1.0])) / 0.8
    window = drive(np.stack([straight, straight, turned, turned, straight]), 1.0, np.array([0.0, 0.0, yaw, yaw, 0.0]))
    kept = Measurements(window, skid_steered(), 0.2, MAX_TURN)
    assert kept.turning == 2
    assert kept.t == pytest.approx([0.0, 0.1, 0.4])
    assert Measurements(window, rig(3.0 * TRACK), 0.2, 0.9).turning == 0  # steered wheels roll along their paths
