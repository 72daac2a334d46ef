"""Derivatives that numbers carry along, against differences."""

import numpy as np
import pytest

from soilbus.terra.dual import UNIT, Dual, slope_of, value_of, weighed_sum

X, Y = np.array([0.3, 0.8, 1.7]), np.array([[0.9], [1.2]])
FUNCTIONS = {
    "sum": lambda x, y: x + 2.0 + y,
    "difference": lambda x, y: 1.0 - x - y,
    "product": lambda x, y: 3.0 * x * y * x,
    "quotient": lambda x, y: x / y / (1.0 + x),
    "power": lambda x, y: x**y + 2.0**x + y**2,
    "greatest": lambda x, y: np.maximum(x, y) * np.minimum(2.0 * x, y),
    "size": lambda x, y: -np.abs(x - y),
    "exponential": lambda x, y: np.exp(-x * y) + np.log(x + y),
    "root": lambda x, y: np.sqrt(x**2 + y),
    "circle": lambda x, y: np.sin(x) * np.cos(y) + np.tan(0.5 * x) + np.arctan(x / y),
    "part": lambda x, y: (x * y)[:, 1:] + x[1:],
    "whole": lambda x, y: (x * y).sum(axis=1),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_derivatives_are_those_of_the_function(name):
    function = FUNCTIONS[name]
    ours = function(Dual(X, {"x": UNIT}), Dual(Y, {"y": UNIT}))
    np.testing.assert_array_equal(ours.value, function(X, Y))
    for quantity, dx, dy in (("x", 1e-6, 0.0), ("y", 0.0, 1e-6)):
        expected = (function(X + dx, Y + dy) - function(X - dx, Y - dy)) / 2e-6
        np.testing.assert_allclose(np.broadcast_to(ours.by[quantity], ours.shape), expected, rtol=1e-7, atol=1e-8)


def test_an_array_before_it_leaves_it_whole():
    ours = X * Dual(2.0, {"k": 0.5})
    assert isinstance(ours, Dual)
    np.testing.assert_array_equal(ours.by["k"], 0.5 * X)


def test_a_weighed_sum_is_the_sum_of_products():
    weights = np.random.default_rng(4).standard_normal((4, 3, 2))
    numbers = [Dual(2.0, {0: 0.5, 1: -1.0}), 3.0, Dual(-1.0, {1: 4.0}), 0.0]
    ours, expected = weighed_sum(weights, numbers), sum(n * w for n, w in zip(numbers, weights, strict=True))
    np.testing.assert_allclose(ours.value, expected.value, rtol=1e-14)
    assert ours.by.keys() == {0, 1}
    for quantity in (0, 1):
        np.testing.assert_allclose(ours.by[quantity], expected.by[quantity], rtol=1e-14)
    np.testing.assert_allclose(weighed_sum(weights, [1.0, 2.0, 0.0, 1.0]), weights[0] + 2.0 * weights[1] + weights[3])


def test_what_does_not_depend_on_a_quantity_carries_nothing_of_it():
    ours = np.exp(Dual(X, {"x": UNIT})) * 2.0
    assert ours.by.keys() == {"x"}
    assert slope_of(ours, "y") == 0.0 == slope_of(X, "x")


def test_comparisons_are_of_values():
    assert (Dual(X, {"x": UNIT}) < Y).tolist() == (Y > X).tolist()
    assert value_of(Dual(X, {})) is X is value_of(X)


@pytest.mark.parametrize("function", [np.sinh, np.add.reduce, lambda x: np.add(x, 1.0, out=np.zeros(3))])
def test_functions_it_does_not_know_are_refused(function):
    with pytest.raises(TypeError):
        function(Dual(X, {"x": UNIT}))
