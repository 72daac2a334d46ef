"""Derivatives by all that effects may change about a wheel, against differences of the forces themselves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from soilbus.terra.tangent import shape_of_change, tangent
from soilbus.terra.wheel import WheelModel, WheelState, wheel_forces

ANGLE = np.array([0.2, 0.35, 0.5, 0.3, 0.4])
SLIP = np.array([0.05, 0.2, 0.4, -0.1, 0.6])
STATE = WheelState(ANGLE, SLIP, np.array(0.5), 0.26, 1.4e6, 0.9, 0.6, 4e3, 0.02)
NODES = 40
PLAIN = WheelModel(nodes=NODES)
PANNED = replace(PLAIN, pan_depth=0.02, pan_stiffness=4.0)
REBOUNDING = replace(PLAIN, exit_ratio=-0.2, exit_angle=-0.05)


def by_difference(change, step):
    up, down = (wheel_forces(*change(way * step)) for way in (1.0, -1.0))
    return (up - down) / (2.0 * step)


@pytest.mark.parametrize(
    ("model", "field", "step"),
    [
        (PLAIN, "peak_c1", 1e-5),
        (PLAIN, "peak_c2", 1e-5),
        (replace(PLAIN, peak_c1=0.4, peak_c2=0.2), "peak_c2", 1e-5),
        (PLAIN, "exit_ratio", 1e-5),
        (PLAIN, "exit_angle", 1e-5),
        (REBOUNDING, "exit_angle", 1e-5),
        (REBOUNDING, "exit_ratio", 1e-5),
        (WheelModel("rational", nodes=NODES), "exponential_share", 1e-4),
        (WheelModel("rational", nodes=NODES, exponential_share=0.6), "exponential_share", 1e-4),
        (PANNED, "pan_stiffness", 1e-3),
        (PANNED, "pan_depth", 1e-6),
        (replace(PANNED, pan_stiffness=0.0), "pan_stiffness", 1e-3),
    ],
)
def test_by_each_field_of_the_model(model, field, step):
    def change(by):
        return STATE, replace(model, **{field: getattr(model, field) + by})

    other = change(step)[1]
    near = tangent(STATE, model, shape_of_change(model, other))
    ours = (near.at(STATE, other) - near.forces) / step
    expected = by_difference(change, step)
    scale = np.abs(near.forces).max(axis=1, keepdims=True) / (abs(getattr(model, field)) + 1.0)
    assert np.abs(expected).max() > 0.0
    np.testing.assert_allclose(ours / scale, expected / scale, rtol=2e-4, atol=2e-4 * np.abs(expected / scale).max())


@pytest.mark.parametrize("model", [PLAIN, PANNED, REBOUNDING, replace(PLAIN, peak_c2=0.2)])
def test_by_the_radius(model):
    def change(by):
        return STATE._replace(radius=STATE.radius + by), model

    near = tangent(STATE, model)
    ours = (near.at(*change(1e-6)) - near.forces) / 1e-6
    expected = by_difference(change, 1e-5)
    np.testing.assert_allclose(ours, expected, rtol=1e-4, atol=1e-4 * np.abs(expected).max())


def test_changes_add_up():
    model = replace(PLAIN, peak_c1=0.45, exit_ratio=-0.1)
    near = tangent(STATE, PLAIN, shape_of_change(PLAIN, model))
    small = replace(PLAIN, peak_c1=0.5 - 1e-6, exit_ratio=-2e-6)
    state = STATE._replace(entry_angle=ANGLE * (1.0 + 1e-6), n=0.9 + 1e-6, radius=0.5 - 1e-6)
    change = near.at(state, small) - near.forces
    np.testing.assert_allclose(change, wheel_forces(state, small) - wheel_forces(STATE, PLAIN), rtol=1e-3, atol=1e-5)


def test_what_was_not_asked_for_is_refused():
    with pytest.raises(KeyError, match="peak"):
        tangent(STATE, PLAIN).at(STATE, replace(PLAIN, peak_c1=0.4))
    with pytest.raises(ValueError, match="nodes"):
        shape_of_change(PLAIN, replace(PLAIN, nodes=8))
