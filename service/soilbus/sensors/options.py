"""Options of what becomes of samples, and of the sensors' consistency: each value once, with its unit and evidence.

    ReceptionOptions   -> Intake, Bins, outliers, rates
    ConsistencyOptions -> consistency.implausible, decision.driveline

What a change of 30 % does to each is in service/docs/sensitivity.md.
"""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["CONSISTENCY", "RECEPTION", "ConsistencyOptions", "ReceptionOptions"]


@dataclass(frozen=True, slots=True)
class ReceptionOptions:
    """Tuning values of reception: outliers, length of bins, data enough for a window."""

    outlier_sd: float = 6.5
    """Distance from the line [sd] from which a sample may be an outlier, by the sensor's noise and by the channel's own
    scatter, which is more where it vibrates or its noise is set too low."""
    quartile_distances: float = 3.0
    """Distances of the quartiles around a sample [1] that it may always lie off: in steps and bumps real signals do."""
    max_loss: float = 0.1
    """Share [1] of a bin's samples that its value at one instant may cost: less than the uncertainty of the noise."""

    timeout: float = 1.0
    """Age [s] from which a channel without a configured time-out is stale."""
    covered_block: float = 0.5
    """Time [s] of a block that counts as covered if it has a sample."""
    min_coverage: float = 0.95
    """Share [1] of a window's blocks that a needed channel must cover."""
    limit_samples: int = 3
    """Number of reported torque limits whose median is in force: one outlier does not change it."""
    fix_smoothing: float = 1.0
    """Time [s] before and after, within which fixes are averaged: receivers are noisy."""


RECEPTION = ReceptionOptions()
"""As the service receives."""


@dataclass(frozen=True, slots=True)
class ConsistencyOptions:
    """Tuning values of the consistency checks: when a sensor contradicts the others.

    Each limit lies beyond what soils, slopes, drivers and the effects of `terra.effects` make of good sensors
    (`tests/estimation/test_plausibility.py`); traction is torque over load and radius.
    """

    contradiction_time: float = 1.0
    """Time [s] for which a contradiction must last, and over which values change; half of it is the longest delay
    between speed and acceleration."""
    significant_sd: float = 5.0
    """Standard deviations [1] by which a change must stand out of the noise, and the probability below which noise
    leaves equal readings."""
    repeated_share: float = 0.1
    """Share [1] of repeated readings elsewhere in the window by which a sensor is coarser than its signal, not
    frozen."""

    still_share: float = 0.1
    """Rim speed over ground speed [1] below which a wheel does not turn."""
    idle_traction: float = 0.01
    """Traction [1] of a wheel that drives nothing: any soil resists more."""
    driving_traction: float = 0.15
    """Traction [1] of a wheel that surely drives."""
    gear_slack: float = 0.03
    """Relative difference [1] of motor and wheel speed that gear and radius of the wheel's sensor may have."""
    feigned_slip: float = 0.12
    """Slip [1] that a wrong rolling radius may feign: four of its standard deviations in `terra.effects`."""

    no_slip: float = 0.006
    """Mean slip [1] of wheels below which a ground speed is made of their speeds while they surely drive: on asphalt
    tyres slip by 0.006 to 0.01 at this traction (stiffness 16 to 25, Pacejka 2012, ch. 4), in fields by more."""

    load_error: float = 0.12
    """Share [1] of the weight by which the loads' sum must be wrong, and of an axle's load by which its left and right
    must differ more than the other axle's for one to be named; lost zeros and what is carried stay below it."""
    any_load: float = 0.6
    """Wrong share [1] of the weight that nothing carried explains, so that all load cells are wrong."""

    comparison_time: float = 3.0
    """Time [s] over which changes of two quantities are compared: at the border of a soft soil a driver who lifts the
    implement may pull less and drive more for a moment."""
    usual_share: float = 0.9
    """Share [1] of these changes that must be known, and of significant ones that go the wrong way."""
    correlation: float = 0.985
    """Correlation [1] from which speed and acceleration go together at some delay."""
    scale_ratio: float = 1.35
    """Ratio [1] of their changes from which they contradict each other."""
    jump_explained: float = 0.25
    """Share [1] of a jump of the ground speed that the acceleration about it explains, at most."""


CONSISTENCY = ConsistencyOptions()
