"""Unit spellings found in DBC files -> SI."""

from __future__ import annotations

import math
from typing import NamedTuple

STANDARD_GRAVITY = 9.80665  # m/s^2, CGPM 1901


class Unit(NamedTuple):
    """Unit with its factor: `value in SI = factor * value`; none of our quantities has an offset."""

    dimension: str
    factor: float


SI = {
    "torque": "N.m",
    "rotation": "rad/s",
    "force": "N",
    "mass": "kg",
    "length": "m",
    "speed": "m/s",
    "angle": "rad",
    "acceleration": "m/s^2",
}
"""SI unit of each dimension."""
_RPM = math.pi / 30.0

_SPELLINGS: dict[tuple[str, float], str] = {
    ("torque", 1.0): "nm n.m n*m n-m newtonmeter newtonmetre",
    ("torque", 1e3): "knm kn.m kn*m kn-m",
    ("torque", 1e-2): "ncm n.cm n*cm",
    ("torque", 1.3558179483314004): "lbft lbfft lbf.ft lb.ft ftlb ft.lb ft.lbf",
    ("rotation", 1.0): "rad/s rad/sec rad.s-1 rads-1",
    ("rotation", 2.0 * math.pi): "rev/s r/s rps turns/s u/s tr/s",
    ("rotation", _RPM): "rpm 1/min r/min rev/min u/min min-1 /min rot/min tr/min tr/mn giri/min obr/min ot/min",
    ("rotation", math.pi / 180.0): "deg/s deg/sec °/s degree/s degrees/s",
    ("force", 1.0): "n newton newtons",
    ("force", 10.0): "dan",
    ("force", 1e3): "kn",
    ("force", STANDARD_GRAVITY): "kgf kp",
    ("force", 4.4482216152605): "lbf",
    ("mass", 1.0): "kg kilogram kilograms",
    ("mass", 1e3): "t ton tonne tonnes",
    ("length", 1.0): "m meter metre meters metres",
    ("length", 1e-2): "cm",
    ("length", 1e-3): "mm",
    ("length", 0.0254): "in inch inches",
    ("length", 0.3048): "ft",
    ("speed", 1.0): "m/s m/sec mps ms-1 m.s-1",
    ("speed", 1e-3): "mm/s",
    ("speed", 1e-2): "cm/s",
    ("speed", 1.0 / 3.6): "km/h kmh kph kmph km/hr",
    ("speed", 0.44704): "mph mi/h mile/h miles/h",
    ("speed", 1852.0 / 3600.0): "kt kts knot knots",
    ("angle", 1.0): "rad radian radians",
    ("angle", 1e-3): "mrad",
    ("angle", math.pi / 180.0): "deg ° degree degrees",
    ("acceleration", 1.0): "m/s2 m/s/s m/sec2 ms-2 m.s-2 mps2",
    ("acceleration", 1e-3): "mm/s2",
    ("acceleration", 1e-2): "cm/s2",
    ("acceleration", STANDARD_GRAVITY): "g g0 gn",
}

_UNITS = {
    spelling: Unit(dimension, factor)
    for (dimension, factor), spellings in _SPELLINGS.items()
    for spelling in spellings.split()
}
_PREFIXED = {
    prefix + spelling: Unit(unit.dimension, factor * unit.factor)
    for prefix, factor in (("M", 1e6), ("m", 1e-3))
    for spelling, unit in _UNITS.items()
    if spelling.startswith("n")
}
"""Units of newtons with mega or milli, which their case alone tells apart; of MNM it says nothing."""
_SAME_CHARACTER = str.maketrans(
    {"·": ".", "⋅": ".", "∙": ".", "•": ".", "×": "*", "²": "2", "⁻": "-", "¹": "1", "º": "°", "^": ""}
)

_WHY_NOT = {
    "%": "a percentage is not a quantity of its own; give the signal that carries the physical value",
    "hz": "Hz may be turns or sensor pulses; write rpm, rev/s or rad/s in the DBC",
}


def unit_of(text: str | None) -> Unit | None:
    """Return the unit that a DBC's text means, None when it is empty; ValueError says why it is none of ours."""
    tidy = (text or "").translate(_SAME_CHARACTER).replace("**", "").replace("(", "").replace(")", "")
    tidy = "".join(tidy.split()).removeprefix("[").removesuffix("]")
    if not tidy or tidy in ("-", "1"):
        return None
    prefix, rest = tidy[:1], tidy[1:].casefold()
    if prefix + rest in _PREFIXED and len(rest) > 1 and tidy.isupper():
        raise ValueError(f"unit {tidy} may be mega or milli; write N{rest[1:]} after M or m in the DBC")
    unit = _PREFIXED.get(prefix + rest) or _UNITS.get(tidy.casefold())
    if unit is None:
        raise ValueError(_WHY_NOT.get(tidy.casefold(), f"unit {text!r} is not known"))
    return unit
