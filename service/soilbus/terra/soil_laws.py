"""Stresses under a rolling wheel: pressure-sinkage, shear laws, shear displacement.

Every function works on floats or broadcastable arrays, in SI units.  Equation numbers
are those of Xi et al. 2024 (World Electr. Veh. J. 15:217) unless another source stands
beside them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

__all__ = [
    "SHEAR_LAWS", "ShearLaw", "exponential_shear", "lumped_modulus", "normal_stress", "rational_shear",
    "shear_displacement",
]  # fmt: skip

ShearLaw = Callable[[Any], tuple[Any, Any]]
"""Shear displacement over K -> mobilised share of the strength, and its derivative."""


def normal_stress(K_L: Any, n: Any, sinkage: Any) -> Any:
    """Return Bekker's pressure [Pa] at a sinkage [m] (eq. 3).

    K_L [N/m^(n+2)] is the lumped modulus k_c/b + k_phi (eq. 35); negative sinkage, that
    is above the ground, carries nothing.
    """
    return K_L * np.maximum(sinkage, 0.0) ** n


def lumped_modulus(k_c: Any, k_phi: Any, width: Any) -> Any:
    """Return K_L = k_c/b + k_phi [N/m^(n+2)] of a tyre of width b [m] (eq. 35)."""
    return k_c / width + k_phi


def shear_displacement(entry_angle: Any, angle: Any, slip: Any, radius: Any) -> Any:
    """Return the soil displacement j [m] along the rim since it was entered (eq. 16).

    Angles in rad from the vertical; slip = 1 - V/(r omega).  With negative slip (skid)
    the displacement first grows, then turns back and may change sign.
    """
    return radius * (entry_angle - angle - (1.0 - slip) * (np.sin(entry_angle) - np.sin(angle)))


def exponential_shear(ratio: Any) -> tuple[Any, Any]:
    """Return the mobilised share of shear strength for j/K, and its derivative (eq. 11).

    Janosi & Hanamoto 1961; odd in j/K, so that skid brakes.
    """
    decay = np.exp(-np.abs(ratio))
    return np.copysign(1.0 - decay, ratio), decay


def rational_shear(ratio: Any) -> tuple[Any, Any]:
    """Return the paper's substitute x/(1+x) for eq. 11, and its derivative (eq. 12).

    Not a good approximation of the exponential law (shared/paper/notes.md); it is here
    to reproduce the paper.
    """
    share = 1.0 / (1.0 + np.abs(ratio))
    return ratio * share, share**2


SHEAR_LAWS: dict[str, ShearLaw] = {"exponential": exponential_shear, "rational": rational_shear}
"""Shear laws by the name that the configuration has for them."""
