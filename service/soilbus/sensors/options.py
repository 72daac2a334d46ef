"""Options of what becomes of samples, and of the sensors' consistency: each value once, with its unit and evidence.

    ReceptionOptions   -> Intake, Bins, outliers, rates
    ConsistencyOptions -> consistency.implausible, decision.driveline, checks of a recording

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
    """Silence [s] from which a channel without a configured time-out is stale; as much in a window, in halves of it, is
    too much of a needed one.  Fixes are averaged over as much before and after."""
    limit_samples: int = 3
    """Number of reported torque limits whose median is in force: one outlier does not change it."""


RECEPTION = ReceptionOptions()
"""As the service receives."""


@dataclass(frozen=True, slots=True)
class ConsistencyOptions:
    """Tuning values of the consistency checks: when a sensor contradicts the others.

    Each limit lies beyond what soils, slopes, drivers and the effects of `terra.effects` make of good sensors
    (`tests/estimation/test_plausibility.py`); traction is torque over load and radius.
    """

    comparison_time: float = 3.0
    """Time [s] over which changes of two quantities are compared: at the border of a soft soil a driver who lifts the
    implement may pull less and drive more for a moment.  It has three changes: a third is the time for which any
    contradiction must last, and over which values change."""
    significant_sd: float = 5.0
    """Standard deviations [1] by which a change must stand out of the noise, and the probability below which noise
    leaves equal readings."""
    usual_share: float = 0.9
    """Share [1] that is nearly all: of changes that are known, and that go the wrong way.  One less it is hardly any:
    of readings that repeat elsewhere, as those of a frozen sensor do not, of the speed of a wheel that stands, of the
    traction of one that drives nothing."""

    driving_traction: float = 0.15
    """Traction [1] of a wheel that surely drives."""
    gear_slack: float = 0.03
    """Relative difference [1] of motor and wheel speed that gear, radius, resolution and phase may make; any other gear
    step is larger."""
    feigned_slip: float = 0.12
    """Slip [1] that a wrong rolling radius may feign: four of its standard deviations in `terra.effects`."""
    slip_per_traction: float = 0.04
    """Slip [1] that comes with a traction of one, at least; with less a ground speed is made of wheel speeds: on
    asphalt tyres have 0.04 to 0.06 (Pacejka 2012, ch. 4), in fields 0.25 and more."""

    load_error: float = 0.12
    """Share [1] of the weight by which the loads' sum must be wrong, and of an axle's load by which its left and right
    must differ more than the other axle's for one to be named; lost zeros and what is carried stay below it."""
    any_load: float = 0.6
    """Wrong share [1] of the weight that nothing carried explains, so that all load cells are wrong."""

    scale_ratio: float = 1.35
    """Ratio [1] of the changes of speed and acceleration from which they contradict each other."""

    @property
    def idle_traction(self) -> float:
        """Traction of a wheel that drives nothing: any soil resists more."""
        return (1.0 - self.usual_share) * self.driving_traction

    @property
    def scatter(self) -> float:
        """Share of changes of speed that acceleration may leave or explain: half of what `scale_ratio` shows."""
        return (self.scale_ratio - 1.0) / 2.0


CONSISTENCY = ConsistencyOptions()
