"""The catalogue's priors are for wheels of tractors; here they are brought to another wheel's size."""

from __future__ import annotations

from dataclasses import replace

from soilbus.terra.effects.effect import Effect, Parameter

__all__ = ["LOAD", "RADIUS", "for_wheel"]

LOAD = 5600.0
"""Load [N] of the wheels that the catalogue's priors are for."""
RADIUS = 0.56
"""Radius [m] of these wheels."""


def for_wheel(effect: Effect, load: float, radius: float) -> Effect:
    """Return the effect with priors scaled to a wheel of this load [N] and radius [m].

    Load cells are chosen by the load, lugs and the depth that a wheel feels grow with the
    radius, the drag of seals with circumference times arm.  Everything else of an effect is
    the soil's or a share, and stays.  Without this a load cell's zero with a prior sd of
    300 N could never be identified on a wheel that carries 80 N.
    """
    force, length = load / LOAD, radius / RADIUS
    of_unit = {"N": force, "N/s": force, "N m": length**2, "m": length, "m/N": length / force}
    return replace(effect, parameters=tuple(_times(p, of_unit.get(p.unit, 1.0)) for p in effect.parameters))


def _times(p: Parameter, scale: float) -> Parameter:
    neutral, std, low, high, *starts = (value * scale for value in (p.neutral, p.std, p.low, p.high, *p.starts))
    return replace(p, neutral=neutral, std=std, low=low, high=high, starts=tuple(starts))
