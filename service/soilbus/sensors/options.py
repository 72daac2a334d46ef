"""Options of what becomes of samples, and of the sensors' consistency: each value once, with its unit and evidence.

    ReceptionOptions   -> Intake, Bins, outliers, rates
    ConsistencyOptions -> consistency.implausible, decision.traction_loss

What a change of 30 % does to each is in service/docs/sensitivity.md.
"""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["CONSISTENCY", "RECEPTION", "ConsistencyOptions", "ReceptionOptions"]


@dataclass(frozen=True, slots=True)
class ReceptionOptions:
    """Which samples are outliers, how short bins are, and which windows have data enough."""

    outlier_sd: float = 6.5
    """Distance from the line [sd of the sensor] from which a sample may be an outlier."""
    quartile_distances: float = 3.0
    """Distances of the quartiles around a sample [1] that it may always lie off: in steps and bumps real signals do."""
    vibrating_sd: float = 1.5
    """A channel that scatters by more than this [sd of the sensor] vibrates, or its noise is set too low: it is judged
    by its own scatter."""
    vibrating_outlier_sd: float = 8.0
    """Distance from the line [sd of that scatter] from which a sample of such a channel is an outlier."""
    max_loss: float = 0.1
    """Share [1] of a bin's samples that its value at one instant may cost: less than the uncertainty of the noise."""

    timeout: float = 1.0
    """Age [s] from which a channel without a configured time-out is stale; no evidence recorded."""
    covered_block: float = 0.5
    """Time [s] of a block that counts as covered if it has a sample; no evidence recorded."""
    min_coverage: float = 0.95
    """Share [1] of a window's blocks that a needed channel must cover; no evidence recorded."""
    limit_samples: int = 3
    """Number of reported torque limits whose median is in force: one outlier does not change it."""
    fix_smoothing: float = 1.0
    """Time [s] before and after, within which fixes are averaged: receivers are noisy; no evidence recorded."""


RECEPTION = ReceptionOptions()
"""As the service receives."""


@dataclass(frozen=True, slots=True)
class ConsistencyOptions:
    """When a sensor contradicts the others.

    Each limit lies beyond what soils, slopes, drivers and the effects of `terra.effects` make of good sensors
    (`tests/estimation/test_plausibility.py`); traction is torque over load and radius.
    """

    contradiction_time: float = 1.0
    """Time [s] for which a contradiction must last, and over which changes are compared; no evidence recorded."""
    significant_sd: float = 5.0
    """Standard deviations [1] by which a change must stand out of the noise, and the probability below which noise
    leaves equal readings; no evidence recorded."""
    repeated_share: float = 0.1
    """Share [1] of repeated readings elsewhere in the window by which a sensor is coarser than its signal, not frozen;
    no evidence recorded."""

    still_share: float = 0.1
    """Rim speed over ground speed [1] below which a wheel does not turn; no evidence recorded."""
    idle_traction: float = 0.01
    """Traction [1] of a wheel that drives nothing: any soil resists more."""
    driving_traction: float = 0.15
    """Traction [1] of a wheel that surely drives; no evidence recorded."""
    gear_slack: float = 0.03
    """Relative difference [1] of motor and wheel speed that gear and radius of the wheel's sensor may have; no evidence
    recorded."""
    feigned_slip: float = 0.12
    """Slip [1] that a wrong rolling radius may feign: four of its standard deviations in `terra.effects`."""

    load_sum: float = 0.15
    """Share [1] of the weight by which the loads' sum must be wrong; lost zeros and what is carried stay below it."""
    load_side: float = 0.10
    """Share [1] of an axle's load by which its left and right must differ more than the other axle's for one to be
    named, and of the weight by which the load of an axle without fault may be wrong; no evidence recorded."""
    any_load: float = 0.6
    """Wrong share [1] of the weight that nothing carried explains, so that all load cells are wrong; no evidence
    recorded."""

    opposite_share: float = 0.85
    """Share [1] of significant changes that go the wrong way; no evidence recorded."""
    opposite_time: float = 4.0
    """Time [s] of significant changes, one after the other: at the border of a soft soil a driver who lifts the
    implement may pull less and drive more for a moment."""

    scale_time: float = 3.0
    """Time [s] over which changes of speed and acceleration are compared; no evidence recorded."""
    min_speed_rms: float = 0.06
    """Rms [m/s] of the changes of speed that there must be; no evidence recorded."""
    sure_correlation: float = 0.985
    """Correlation [1] of the two at the best delay, at least; no evidence recorded."""
    possible_correlation: float = 0.9
    """Correlation [1] at another delay from which that delay is possible too; minus it at most, changes are opposite;
    no evidence recorded."""
    known_share: float = 0.9
    """Share [1] of bins with both; no evidence recorded."""
    scale_ratio: float = 1.35
    """Ratio [1] of their changes from which they contradict each other; no evidence recorded."""
    max_delay: float = 0.6
    """Greatest delay [s] between speed and acceleration; no evidence recorded."""
    jump_explained: float = 0.25
    """Share [1] of a jump of the ground speed that the acceleration about it explains, at most; with 0.74, five of
    fifteen faults of the accelerometer are taken for jumps (`validation.sensitivity`)."""


CONSISTENCY = ConsistencyOptions()
