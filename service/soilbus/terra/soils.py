"""Known soils: Wong, Theory of Ground Vehicles (4th ed. 2008), table 2.3.

K is not in that table; the values here are planning figures (6 mm stiff clay to 30 mm
soft clay and snow, 12 mm LETE sand, 20 mm otherwise).
"""

from __future__ import annotations

import math

from soilbus.terra.wheel import Soil

__all__ = ["KINDS", "SOILS", "UNKNOWN", "soil_named"]

_WONG = {
    # name: (n, k_c [kN/m^(n+1)], k_phi [kN/m^(n+2)], c [kPa], phi [deg], K [m])
    "dry_sand": (1.10, 0.99, 1528.43, 1.04, 28.0, 0.020),
    "sandy_loam_15": (0.70, 5.27, 1515.04, 1.72, 29.0, 0.020),
    "sandy_loam_22": (0.20, 2.56, 43.12, 1.38, 38.0, 0.020),
    "sandy_loam_11_michigan": (0.90, 52.53, 1127.97, 4.83, 20.0, 0.020),
    "sandy_loam_23_michigan": (0.40, 11.42, 808.96, 9.65, 35.0, 0.020),
    "sandy_loam_26_hanamoto": (0.30, 2.79, 141.11, 13.79, 22.0, 0.020),
    "sandy_loam_32_hanamoto": (0.50, 0.77, 51.91, 5.17, 11.0, 0.020),
    "clayey_soil_38": (0.50, 13.19, 692.15, 4.14, 13.0, 0.010),
    "clayey_soil_55": (0.70, 16.03, 1262.53, 2.07, 10.0, 0.010),
    "heavy_clay_25": (0.13, 12.70, 1555.95, 68.95, 34.0, 0.006),
    "heavy_clay_40": (0.11, 1.84, 103.27, 20.69, 6.0, 0.030),
    "lean_clay_22": (0.20, 16.43, 1724.69, 68.95, 20.0, 0.006),
    "lean_clay_32": (0.15, 1.52, 119.61, 13.79, 11.0, 0.030),
    "lete_sand": (0.79, 102.0, 5301.0, 1.3, 31.1, 0.012),
    "upland_sandy_loam_51": (1.10, 74.6, 2080.0, 3.3, 33.7, 0.020),
    "rubicon_sandy_loam_43": (0.66, 6.9, 752.0, 3.7, 29.8, 0.020),
    "north_gower_clayey_loam_46": (0.73, 41.6, 2471.0, 6.1, 26.6, 0.020),
    "grenville_loam_24": (1.01, 0.06, 5880.0, 3.1, 29.8, 0.020),
    "snow_us": (1.60, 4.37, 196.72, 1.03, 19.7, 0.030),
    "snow_sweden": (1.44, 10.55, 66.08, 6.0, 20.7, 0.030),
}


def _soil(n: float, k_c: float, k_phi: float, c: float, phi_deg: float, K: float) -> Soil:
    return Soil(1e3 * k_c, 1e3 * k_phi, n, math.radians(phi_deg), 1e3 * c, K)


SOILS: dict[str, Soil] = {name: _soil(*row) for name, row in _WONG.items()}
"""The known soils by name."""
SOILS |= {
    # Table 2 of Xi et al. 2024.
    "xi_wet_clay": _soil(0.85, 43.68, 499.3, 7.58, 14.0, 0.025),
    "xi_sandy_loam": _soil(0.70, 5.3, 1515.0, 1.7, 29.0, 0.025),
}
SOILS |= {"loam": SOILS["xi_sandy_loam"], "wet_clay": SOILS["xi_wet_clay"]}  # the demo's two

KINDS = (*_WONG, "xi_wet_clay")
"""Names of the soils that differ; Xi's sandy loam is Wong's with 15 % of moisture."""
UNKNOWN = "unknown"
"""In their place: a soil that is none of them."""


def soil_named(name: str) -> Soil:
    """Return the soil of that name.

    Raises
    ------
    KeyError
        With the known names, where it is none of them.

    Examples
    --------
    >>> loam = soil_named("loam")
    >>> loam.n
    0.7
    >>> round(loam.bearing_pressure(z_ref=0.02, b_ref=0.3) / 1e3)  # kPa
    99
    """
    if name not in SOILS:
        raise KeyError(f"no soil is named {name}; known: {', '.join(SOILS)}")
    return SOILS[name]
