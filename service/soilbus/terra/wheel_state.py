"""What a wheel's forces depend on: its state and the choices that make a wheel-soil model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from soilbus.arrays import Array
from soilbus.terra.rim import Quadrature

EXACT_NODES = 12
"""Gauss-Legendre nodes a branch: errors below 1e-6 of W (of T: W r) for n in 0.1..1.6, K
from 5 mm, entry angles up to 0.8 rad, slip -0.3 to 0.95; 2e-6 for rational shear in skid
(tests/terra/test_wheel.py)."""
FAST_NODES = 7
"""Enough for fits: below 5e-5 in the same ranges, far below any sensor's noise."""

LONGEST = 0.95
"""Share of the entry angle that the exit angle never exceeds behind the axle: no rut comes up all the way."""
PEAK = 0.05, 0.8
"""Shares of the entry angle between which the greatest stress stays; Wong & Reece measured up to 0.43 + 0.32."""


@dataclass(frozen=True, slots=True)
class WheelModel:
    """Choices that make a wheel-soil model.

    The angle of greatest stress is peak_c1 + peak_c2 s (1 + peak_bend) / (1 + peak_bend |s|)
    times the entry angle at the slip s (eq. 4 where it does not bend; at s = 1 always c1 + c2),
    a share that stays between those of PEAK.  The exit angle is exit_ratio + exit_slip s
    times it, s the slip where the wheel drives, and exit_angle [rad] more (0: the rut does
    not recover; behind the axle all are negative), but no farther behind than LONGEST times
    the entry angle.  exponential_share of the shear strength is mobilised by the exponential law
    under any shear_law.  From the depth pan_depth [m] on the pressure grows by
    pan_stiffness times what the soil alone would add (0: no hard pan).  A track's pressure has
    rollers periods along its contact (0: it is uniform).  one_off: a model whose shape no other
    call will share, so that nothing of it is kept.
    """

    shear_law: str = "exponential"
    peak_c1: float = 0.5
    peak_c2: float = 0.0
    exit_ratio: float = 0.0
    nodes: int = EXACT_NODES
    exponential_share: float = 0.0
    pan_depth: float = 0.0
    pan_stiffness: float = 0.0
    exit_angle: float = 0.0
    exit_slip: float = 0.0
    peak_bend: float = 0.0
    rollers: int = 0
    one_off: bool = False

    @property
    def quadrature(self) -> Quadrature:
        """Quadrature nodes for a wheel without slip."""
        return Quadrature(self.nodes, 3 if self.nodes >= EXACT_NODES else 2, self.peak_c1, self.exit_ratio)

    def peak(self, slip: Any) -> Any:
        """Return the angle of greatest stress over entry angle, like the slips."""
        share = self.peak_c1 + self.peak_c2 * slip * (1.0 + self.peak_bend) / (1.0 + self.peak_bend * np.abs(slip))
        return np.minimum(np.maximum(share, PEAK[0]), PEAK[1])

    def leave(self, entry_angle: Array, slip: Any) -> Any:
        """Return the exit angle over entry angle (N,)."""
        ratio = self.exit_ratio + self.exit_slip * np.maximum(slip, 0.0)
        return np.maximum(ratio + self.exit_angle / entry_angle, -LONGEST)


class WheelState(NamedTuple):
    """What the forces of N wheel-instants depend on; floats or arrays that broadcast.

    entry_angle [rad], slip [-], radius and width [m], K_L [N/m^(n+2)], n [-],
    tan_phi [-], c [Pa], K [m].  length [m] is the contact length of a track, 0 of a wheel; radius is then the
    sprocket's, entry_angle the one at which a wheel of that radius has sunk as deep (terra.track).
    """

    entry_angle: Any
    slip: Any
    radius: Any
    width: Any
    K_L: Any
    n: Any
    tan_phi: Any
    c: Any
    K: Any
    length: Any = 0.0
