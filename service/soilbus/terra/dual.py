"""Numbers that carry their derivatives along (forward-mode differentiation with sparse dual numbers).

Wengert 1964 (Commun. ACM 7:463).  What does not depend on a quantity carries nothing of it, so
that a small function of much costs little more than its value.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import Any

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin

__all__ = ["UNIT", "Dual", "slope_of", "value_of", "weighed_sum"]

UNIT = 1.0
"""Derivative of a quantity by itself: this very object saves a multiplication."""
_FLAT = frozenset({np.less, np.less_equal, np.greater, np.greater_equal, np.equal, np.not_equal})
_ONE, _MINUS_ONE = (lambda *_: UNIT), (lambda *_: -1.0)
_PARTIALS: dict[np.ufunc, tuple[Any, ...]] = {
    np.add: (_ONE, _ONE),
    np.subtract: (_ONE, _MINUS_ONE),
    np.multiply: (lambda out, x, y: y, lambda out, x, y: x),
    np.true_divide: (lambda out, x, y: 1.0 / y, lambda out, x, y: -out / y),
    np.power: (lambda out, x, y: y * x ** (y - 1.0), lambda out, x, y: out * np.log(x)),
    np.maximum: (lambda out, x, y: 1.0 * (x >= y), lambda out, x, y: 1.0 * (x < y)),
    np.minimum: (lambda out, x, y: 1.0 * (x <= y), lambda out, x, y: 1.0 * (x > y)),
    np.negative: (_MINUS_ONE,),
    np.absolute: (lambda out, x: np.sign(x),),
    np.exp: (lambda out, x: out,),
    np.log: (lambda out, x: 1.0 / x,),
    np.sqrt: (lambda out, x: 0.5 / out,),
    np.sin: (lambda out, x: np.cos(x),),
    np.cos: (lambda out, x: -np.sin(x),),
    np.tan: (lambda out, x: 1.0 + out * out,),
    np.arctan: (lambda out, x: 1.0 / (1.0 + x * x),),
}
"""Partial derivatives of each function by its arguments, from its value and these; where it has a kink, on one side."""


class Dual(NDArrayOperatorsMixin):
    """A value and its derivatives `by` some quantities, each a float or an array that broadcasts with the value.

    numpy's functions of _PARTIALS work on it, and comparisons, which compare values; TypeError for all others.
    """

    __slots__ = ("by", "value")

    def __init__(self, value: Any, by: dict[Any, Any]) -> None:
        self.value, self.by = value, by

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **kwargs: Any) -> Any:
        if method != "__call__" or kwargs or ufunc not in (_FLAT if ufunc in _FLAT else _PARTIALS):
            return NotImplemented
        plain = [value_of(x) for x in inputs]
        value = ufunc(*plain)
        if ufunc in _FLAT:
            return value
        by: dict[Any, Any] = {}
        for x, partial in zip(inputs, _PARTIALS[ufunc], strict=True):
            if isinstance(x, Dual) and x.by:
                slope = partial(value, *plain)
                for quantity, d in x.by.items():
                    part = d if slope is UNIT else slope if d is UNIT else slope * d
                    by[quantity] = by[quantity] + part if quantity in by else part
        return Dual(value, by)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the value."""
        return np.shape(self.value)

    @property
    def ndim(self) -> int:
        """Number of dimensions of the value."""
        return np.ndim(self.value)

    def __getitem__(self, index: Any) -> Dual:
        return self._each(lambda a: a[index])

    def sum(self, axis: int) -> Dual:
        """Return the sum over axes, as numpy does."""
        return self._each(lambda a: a.sum(axis=axis))

    def _each(self, linear: Any) -> Dual:
        shape = self.shape
        return Dual(linear(self.value), {q: linear(np.broadcast_to(d, shape)) for q, d in self.by.items()})


def weighed_sum(weights: Any, numbers: Sequence[Any]) -> Any:
    """Return the sum (...) of weights (K, ...) times K numbers, which may carry derivatives."""
    value = np.tensordot([value_of(x) for x in numbers], weights, 1)
    by: dict[Any, Any] = {}
    for x, weight in zip(numbers, weights, strict=True):
        for quantity, d in x.by.items() if isinstance(x, Dual) else ():
            by[quantity] = by[quantity] + weight * d if quantity in by else weight * d
    return Dual(value, by) if by else value


def value_of(x: Any) -> Any:
    """Return a number without its derivatives."""
    return x.value if isinstance(x, Dual) else x


def slope_of(x: Any, quantity: Hashable) -> Any:
    """Return a number's derivative by a quantity; zero where it carries none."""
    return x.by.get(quantity, 0.0) if isinstance(x, Dual) else 0.0
