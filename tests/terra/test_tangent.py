"""Derivatives by all that effects may change about a wheel, against differences of the forces themselves."""

from dataclasses import replace

import numpy as np
import pytest

from soilbus.terra.dual import Dual
from soilbus.terra.tangent import forces_along
from soilbus.terra.wheel import WheelModel, WheelState, wheel_forces

ANGLE = np.array([0.2, 0.35, 0.5, 0.3, 0.4])
SLIP = np.array([0.05, 0.2, 0.4, -0.1, 0.6])
STATE = WheelState(ANGLE, SLIP, np.array(0.5), 0.26, 1.4e6, 0.9, 0.6, 4e3, 0.02)
NODES = 40
PLAIN = WheelModel(nodes=NODES)
PANNED = replace(PLAIN, pan_depth=0.02, pan_stiffness=4.0)
REBOUNDING = replace(PLAIN, exit_ratio=-0.2, exit_angle=-0.05)


def along(state, model):
    """Derivatives of the forces (3, N) by what the state and the model carry derivatives by."""
    return np.stack([force.by["it"] for force in forces_along(state, model)])


def varying(value, slope=1.0):
    return Dual(value, {"it": slope})


def by_difference(change, step):
    up, down = (wheel_forces(*change(way * step)) for way in (1.0, -1.0))
    return (up - down) / (2.0 * step)


@pytest.mark.parametrize(
    ("model", "field", "step"),
    [
        (PLAIN, "peak_c1", 1e-5), (PLAIN, "peak_c2", 1e-5),
        (replace(PLAIN, peak_c1=0.4, peak_c2=0.2), "peak_c2", 1e-5),
        (replace(PLAIN, peak_c1=0.3, peak_c2=0.3, peak_bend=4.0), "peak_c2", 1e-5),
        (replace(PLAIN, peak_c1=0.3, peak_c2=0.3, peak_bend=4.0), "peak_bend", 1e-4),
        (PLAIN, "exit_ratio", 1e-5), (PLAIN, "exit_angle", 1e-5), (PLAIN, "exit_slip", 1e-5),
        (REBOUNDING, "exit_angle", 1e-5), (REBOUNDING, "exit_ratio", 1e-5),
        (replace(REBOUNDING, exit_slip=-0.5), "exit_slip", 1e-5),
        (WheelModel("rational", nodes=NODES), "exponential_share", 1e-4),
        (WheelModel("rational", nodes=NODES, exponential_share=0.6), "exponential_share", 1e-4),
        (PANNED, "pan_stiffness", 1e-3), (PANNED, "pan_depth", 1e-6),
        (replace(PANNED, pan_stiffness=0.0), "pan_stiffness", 1e-3),
        (PLAIN, "radius", 1e-5), (PANNED, "radius", 1e-5), (REBOUNDING, "radius", 1e-5),
        (replace(PLAIN, peak_c2=0.2), "radius", 1e-5),
    ],
)  # fmt: skip
def test_by_each_field_of_the_model_and_the_radius(model, field, step):
    def put(value):
        return (STATE._replace(radius=value), model) if field == "radius" else (STATE, replace(model, **{field: value}))

    at = getattr(STATE if field == "radius" else model, field)
    ours, expected = along(*put(varying(at))), by_difference(lambda by: put(at + by), step)
    scale = np.abs(wheel_forces(STATE, model)).max(axis=1, keepdims=True) / (np.abs(at) + 1.0)
    assert np.abs(expected).max() > 0.0
    near = 1e-4 if field == "radius" else 2e-4
    np.testing.assert_allclose(ours / scale, expected / scale, rtol=near, atol=near * np.abs(expected / scale).max())


def test_changes_add_up():
    def change(by):
        model = replace(PLAIN, peak_c1=0.5 - by, exit_ratio=-0.1 - 2.0 * by)
        return STATE._replace(entry_angle=ANGLE * (1.0 + by), n=0.9 + by, radius=0.5 - by), model

    model = replace(PLAIN, peak_c1=varying(0.5, -1.0), exit_ratio=varying(-0.1, -2.0))
    state = STATE._replace(entry_angle=varying(ANGLE, ANGLE), n=varying(0.9), radius=varying(np.array(0.5), -1.0))
    np.testing.assert_allclose(along(state, model), by_difference(change, 1e-6), rtol=1e-6, atol=1e-3)


def test_forces_are_those_without_derivatives():
    forces = forces_along(STATE._replace(slip=varying(SLIP)), PANNED)
    np.testing.assert_array_equal([force.value for force in forces], wheel_forces(STATE, PANNED))


@pytest.mark.parametrize(
    ("state", "model", "name"),
    [(STATE, replace(PLAIN, nodes=varying(NODES)), "nodes"), (STATE._replace(width=varying(0.26)), PLAIN, "width")],
)
def test_what_has_no_derivative_is_refused(state, model, name):
    with pytest.raises(ValueError, match=name):
        forces_along(state, model)
