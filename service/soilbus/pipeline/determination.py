"""Determination: whether a window determines the soil as far as the machine presses and shears it.

    excitation   sd of draft and slip = sqrt(max(sample variance - mean noise variance, 0)):  load determines the
                 bearing modulus, slip the shear strength
    load_range   lacks where  std p(z) > max_bearing_std p(z),   z: z_ref, within the depths that carry load
    slip_range   lacks where  std of the largest draft > max_draft_std max(|largest draft|, LEAST_DRAFT weight);
                 of a test rig where
                 std tan phi > max_tan_phi_std tan phi  and  std tau > max_tan_phi_std tau,
                 tau = c + p tan phi at the contact's own pressure p = W / (b l)

Below a wheel pressure rises from 0 at the edge of the contact to its sinkage: all depths from 0 to there carry load.
A track presses evenly, so only the depth of its rut carries load, and the window says nothing of other depths.  A
machine that presses with one pressure determines tau alone, which is all that its thrust depends on, and not c and
tan phi apart.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from soilbus.arrays import Array
from soilbus.config.model import Estimator
from soilbus.estimation.multistart import Fit
from soilbus.estimation.posterior import Estimate
from soilbus.estimation.window import Rig, Window
from soilbus.terra.vehicle import GRAVITY, slip_ratio
from soilbus.terra.wheel import MAX_ENTRY_ANGLE, sinkage

LEAST_DRAFT = 0.1
"""Draft [1], over the weight, below which a relative error says little: a machine that can pull nothing is known as
well as one that can.  A tenth is what wheels resist on soft fields (0.05 to 0.1, Wong 2008, fig. 2.60)."""


class Excitation(NamedTuple):
    """Mean and standard deviation of draft [N] and of the wheels' mean slip over a window, less the sensors' noise.

    None where not known.
    """

    draft: float | None = None
    draft_sd: float | None = None
    slip: float | None = None
    slip_sd: float | None = None


def excitation_of(window: Window, rig: Rig, min_speed: float) -> Excitation:
    """Return the excitation of a forward window; slip only where the ground speed exceeds min_speed [m/s]."""
    ground = np.where(window.ground_speed > min_speed, window.ground_speed, np.nan)[:, None]
    with np.errstate(invalid="ignore", divide="ignore"):
        slip = np.where(rig.drives, slip_ratio(rig.radius, window.speed, ground), np.nan)
        noise = window.variance["speed"] / window.speed**2 + window.variance["ground_speed"][:, None] / ground**2
        noise *= (1.0 - slip) ** 2
        wheels = np.isfinite(slip + noise).sum(axis=1)
        mean = np.where(wheels > 0, np.nansum(slip, axis=1) / wheels, np.nan)
        variance = np.nansum(noise, axis=1) / wheels**2
    return Excitation(*_spread(window.draft, window.variance["draft"]), *_spread(mean, variance))


def _spread(value: Array, variance: Array) -> tuple[float | None, float | None]:
    known = np.isfinite(value) & np.isfinite(variance)
    if np.count_nonzero(known) < 2:
        return None, None
    value, variance = value[known], variance[known]
    return float(value.mean()), float(np.sqrt(max(value.var(ddof=1) - variance.mean(), 0.0)))


def lacking(fit: Fit, rig: Rig, settings: Estimator) -> list[str]:
    """Return what varied too little in a window: load_range, slip_range or both.

    Of a vehicle its largest draft says whether slip varied enough, see `draft_is_known`.
    """
    posterior = fit.posterior
    low, high = loaded_depths(fit, rig)
    bearing = posterior.bearing_pressure(min(max(settings.z_ref, low), high), settings.b_ref)
    lacks = ["load_range"] if is_wide(bearing, settings.max_bearing_std) else []
    if rig.chassis is None:
        sheared = posterior.tan_phi(), posterior.shear_strength(contact_pressure(fit, rig))
        lacks += ["slip_range"] * all(is_wide(e, settings.max_tan_phi_std) for e in sheared)
    return lacks


def draft_is_known(draft: Estimate | None, rig: Rig, settings: Estimator) -> bool:
    """Return whether the largest draft is known to `max_draft_std`; True where there is none to know."""
    if draft is None or rig.chassis is None:
        return True
    size = max(abs(draft.value), LEAST_DRAFT * rig.chassis.mass * GRAVITY)
    return draft.std <= settings.max_draft_std * size


def loaded_depths(fit: Fit, rig: Rig) -> tuple[float, float]:
    """Return the least and greatest depth [m] at which the machine presses on the soil; 0 and inf if not known."""
    depths = sinkage_range(fit, rig)
    if depths is None:
        return 0.0, np.inf
    low, high = depths
    return low if rig.lengths is not None and (rig.lengths > 0.0).all() else 0.0, high


def sinkage_range(fit: Fit, rig: Rig) -> tuple[float, float] | None:
    """Return the 5 % and 95 % quantiles of the sinkage [m] over wheels and instants; None where not known."""
    depth = sinkage(fit.optimum.latents.entry_angle, rig.radius)
    known = depth[np.isfinite(depth) & (fit.optimum.latents.entry_angle < MAX_ENTRY_ANGLE)]
    if not len(known):
        return None
    place = np.arange(len(known)) / max(len(known) - 1, 1)
    low, high = np.interp((0.05, 0.95), place, np.sort(known)).tolist()
    return low, high


def contact_pressure(fit: Fit, rig: Rig) -> float:
    """Return the median of load over contact area [Pa] over wheels and instants."""
    latents = fit.optimum.latents
    length = rig.radius * np.sin(latents.entry_angle)
    if rig.lengths is not None:
        length = np.where(rig.lengths > 0.0, rig.lengths, length)
    return float(np.nanmedian(latents.load / (rig.width * length)))


def is_wide(estimate: Estimate, most: float) -> bool:
    """Return whether the standard deviation is more than this share of the value."""
    return estimate.std > most * estimate.value
