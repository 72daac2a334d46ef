"""Loads and pull of the vehicle against forces and moments written out point by point."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from soilbus.terra.vehicle import Chassis, axle_loads, pull_required, slip_ratio, wheel_loads

TRACTOR = Chassis(mass=2300.0, wheelbase=1.95, cg_ahead_of_rear_axle=0.95, cg_height=0.75, hitch_height=0.45)
SIDES = {"draft": st.floats(-3e3, 12e3), "pitch": st.floats(-0.4, 0.4), "acceleration": st.floats(-2.0, 2.0)}


@given(**SIDES)
def test_loads_balance_forces_and_moments_about_any_point(draft, pitch, acceleration):
    front, rear = axle_loads(TRACTOR, draft, pitch, acceleration)
    # Every force as (x, z, F_x, F_z) in the vehicle's axes, x ahead of the rear contact; d'Alembert's
    # force m a points backwards; the thrust of all wheels acts at the ground.
    m, g = TRACTOR.mass, 9.80665
    thrust = pull_required(TRACTOR, draft, pitch, acceleration)
    forces = np.array(
        [
            (0.95, 0.75, -m * g * math.sin(pitch), -m * g * math.cos(pitch)),
            (0.95, 0.75, -m * acceleration, 0.0),
            (0.0, 0.45, -draft, 0.0),
            (1.95, 0.0, 0.0, front),
            (0.0, 0.0, thrust, rear),
        ]
    )
    x, z, along, across = forces.T
    assert along.sum() == pytest.approx(0.0, abs=1e-7)
    assert across.sum() == pytest.approx(0.0, abs=1e-7)
    for px, pz in ((0.0, 0.0), (1.95, 0.0), (0.7, 1.3)):
        assert np.sum((x - px) * across - (z - pz) * along) == pytest.approx(0.0, abs=1e-6)


def test_slip_ratio():
    assert slip_ratio(0.5, 4.0, 1.5) == pytest.approx(0.25, rel=1e-12)
    assert slip_ratio(0.5, 2.0, 1.2) == pytest.approx(-0.2, rel=1e-12)
    assert slip_ratio(0.5, 2.0, 0.0) == 1.0


def test_slip_is_unknown_where_the_wheel_does_not_turn_forward_or_a_reading_is_missing():
    speed = np.array([0.0, -0.0, -3.0, np.nan, 3.0])
    ground = np.array([0.0, 1.0, 1.0, 1.0, np.nan])
    assert np.isnan(slip_ratio(0.5, speed, ground)).all()


@given(
    between=st.lists(st.floats(0.05, 1.9), max_size=2, unique=True).map(lambda x: sorted(x, reverse=True)),
    each=st.integers(1, 2),
    **SIDES,
)
def test_wheels_of_any_number_of_axles_balance_as_equal_springs_below_a_rigid_frame(
    between, each, draft, pitch, acceleration
):
    x = np.repeat([1.95, *between, 0.0], each)
    loads = wheel_loads(TRACTOR, x / 1.95, draft, pitch, acceleration)
    m, g = TRACTOR.mass, 9.80665
    along = m * (g * math.sin(pitch) + acceleration)
    moment = m * g * math.cos(pitch) * 0.95 - along * 0.75 - draft * 0.45
    assert loads.sum() == pytest.approx(m * g * math.cos(pitch), rel=1e-9)
    assert loads @ x == pytest.approx(moment, rel=1e-9, abs=1e-6)
    # the compression of a spring is heave + x pitch: the two that solve force and moment
    springs = np.stack([np.ones(len(x)), x])
    compression = np.linalg.solve(springs @ springs.T, [loads.sum(), moment]) @ springs
    assert loads == pytest.approx(compression, rel=1e-8, abs=1e-4)


def test_tracks_or_one_axle_carry_all_of_it_wherever_it_acts():
    tracked = dataclasses.replace(TRACTOR, on_one_axle=True)
    assert wheel_loads(tracked, np.ones(2), 9e3, 0.1, 0.0) == pytest.approx(
        [2300.0 * 9.80665 * math.cos(0.1) / 2.0] * 2
    )
