"""Options of the estimator: its tuning values, each once, with unit and source or evidence.

    Rig.options -> Measurements.options -> every function that has a window's problem

What a change of 30 % does to each is in service/docs/sensitivity.md.  What an operator may want to change is in
`config.model`.  Numbers that only keep arithmetic finite stand where they are used.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

__all__ = ["ESTIMATOR", "HELD", "EstimatorOptions", "SearchOptions", "SolverOptions", "StandingOptions"]


@dataclass(frozen=True, slots=True)
class MeasurementOptions:
    """Tuning values: which instants of a window are usable, and how their forces are computed."""

    load_tolerance: float = 0.02
    """Relative error of load [1] accepted in the first entry angles; each linearisation reduces it further."""
    max_side_load: float = 0.8
    """Largest difference of an axle's loads left and right, over their sum [1]: no wheel leaves the ground."""
    load_time_scale: float = 0.1
    """Integral time scale T [s] of loads that shake, 2 T rms^2 / bin the variance of a bin's.  With 0.02 s intervals
    are too narrow."""
    bounce_period: float = 0.5
    """Least length [s] of an instant where loads are computed: a body bounces on its tyres at 1.5 to 3 Hz, and slip
    follows loads that nobody measures.  With 0.25 a loader on two driven wheels seems to have a negative inertia."""
    unknown_slope: float = 0.4
    """Sd of a slope [rad] in one instant where no sensor shows it and nothing is towed, and of an axle's loads left
    less right over their sum where no roll is measured: 3 degrees for seconds, 0.06 sqrt(2 x 2 s / 0.1 s bin)."""
    side_slope_share: float = 0.06
    """Sd of an axle's mean loads left less right over their sum [1] on side slopes, where no roll is measured: 3
    degrees."""
    axle_share: float = 0.1
    """Sd of an axle's mean load beside the line through the others' over it [1], on three axles or more: a
    tyre deflects by 30 to 50 mm under its load, so that 4 mm of wear, or a tenth less pressure, take a tenth of it."""
    largest_draft: float = 0.5
    """Largest draft that nothing measures, over the weight [1]: where net traction ratios of tractors in fields end
    (Wismer & Luth 1974).  It shifts load to the rear in all of a window."""
    rolling_slip: float = -0.03
    """Slip [1] of a free wheel without a speed sensor before its torque row says better: a resistance of 0.05 to 0.1
    of the load takes a skid of 2 to 5 % on field soils (Wong 2008, fig. 2.60)."""
    max_rolling_skid: float = 0.5
    """Largest skid (minus slip) [1] of a wheel without torque that is tried on the way to T = 0: ten times what field
    soils take, so that none of them is cut off."""
    slip_sd: float = 0.1
    """Sd [1] of that slip, and of half the difference of two wheels' slips where only their motor's speed is
    measured."""


@dataclass(frozen=True, slots=True)
class SolverOptions:
    """Limits and tolerances of a descent."""

    max_evaluations: int = 40
    """Of the model.  Descents from random soils take 9 in the mean, 1 in 100 more than 30."""
    step_tolerance: float = 1e-6
    """Squared length of the next step in posterior sd, predicted from the ratio of the last two, from which a descent
    has converged."""
    shortening: float = 0.4
    """Factor [1] on the fraction of the step after a rejected step."""
    max_rise: float = 1.0
    """Rise of the objective that an accepted step may bring, relative to the objective and one [1]: steps that
    overshoot in a curved valley return by themselves.  It is multiplied by `shortening` after each rise."""
    max_rejected: int = 6
    """Rejected steps in a row."""
    give_up_above: float = math.inf
    """Value of the objective above which the fit is of no use: set by the caller."""


@dataclass(frozen=True, slots=True)
class SearchOptions:
    """Starts of a window's fit, steps of the soil, bounds."""

    same_end: float = 0.02
    """Relative difference of the objectives [1] below which two descents of the search have met."""
    thinned: int = 24
    """Instants of a window that the search for starts uses."""
    plausible_chi2: float = 3.0
    """Objective per residual [1] up to which an optimum of the search may be the soil's.  With 6 a window across a
    border gets an estimate."""
    implausible: float = 60.0
    """Objective per thinned instant [-2 log] above which a window cannot be of one soil.  Without this limit the
    budget of a border's search is gone before another soil is found."""
    max_implausible_evaluations: int = 5
    """Evaluations from an end whose objective exceeds `implausible`: with 10 a window across the border of
    `replay-bogging` gets an estimate."""
    typical_depth: float = 0.03
    """Sinkage [m] at which the bearing pressure is a coordinate."""
    max_log_step: float = 0.7
    """Longest step of a coordinate [1, a logarithm]: a factor of two."""
    bound_sd: float = 4.0
    """Bound of a free parameter's logarithm about the prior median [prior sd].  With 3 clay lies at a bound."""
    max_angle_change: float = 0.1
    """Relative change of an entry angle [1] above which the angles are solved again instead of extrapolated: effects
    may be curved where the soil alone is not."""
    soil_alone: SolverOptions = SolverOptions(10, step_tolerance=0.1, max_rise=0.0)
    """Descent of the soil far from the optimum, with latents as measured: where it ends the joint descent goes on."""
    cold: SolverOptions = SolverOptions(step_tolerance=1e-2)
    """Joint descent of soil, gains and latents from there."""
    warm: SolverOptions = SolverOptions(step_tolerance=1e-2)
    """Joint descent from near the optimum, to 0.1 posterior sd: nearer, valleys of a drive that shakes end at no
    optimum."""


@dataclass(frozen=True, slots=True)
class PosteriorOptions:
    """How a fit becomes a posterior: form of the contact, soil classes."""

    max_log_variance: float = 4.0
    """Variance of a parameter's logarithm [1] from which it is open, in what is reported: one that may be anywhere
    within `bound_sd` prior sd (of 0.83, std = value) has 4^2 0.83^2 / 3 = 3.7.  Without it k_phi had an std of 1e155 on
    snow."""
    form_discount: float = 3.0
    """Residuals [1] that say as much of the contact's form as one would say without errors of the model that all
    share."""
    form_stride: int = 4
    """One instant of this many gets derivatives by the form parameters, which are interpolated between them.  It is no
    mere saving: by those of every instant the sd of tan phi differs."""


@dataclass(frozen=True, slots=True)
class TrackerOptions:
    """When the soil has changed, and how one window's posterior is the next one's prior."""

    instant: float = 0.25
    """Length of an instant [s], over which bins are averaged: tyres that relax over 0.3 m at 1.2 m/s take as long."""
    false_alarms_per_hour: float = 1.0
    """Windows an hour [1/h] in which noise alone makes the change detector search for another soil."""
    steady_drift: float = 4.0
    """Prior sd of a steady change of the soil in one window, in units of `Settings.drift` [1]: a field that changes as
    one goes, beside a random walk."""
    several_soils: float = 6.0
    """Chi-square per residual [1], in units of what the windows before left, above which another soil is looked for.
    Instants of two or three bins have less noise than single ones, for which 3 would do."""
    first_rounds: int = 4
    """Fits of a first window, each with the variance components that the one before left: the factors of `d-base-0`
    then change by less than a tenth."""
    significance: float = 25.0
    """Fall of -2 log evidence by two soils instead of one [1] from which a change is accepted: 5 sd of one unknown."""
    min_to_detect: float = 0.3
    """Windows [1] that a soil must fill before a change from it is looked for, that lie before the end of the last
    fit's data and are looked at again, and after a change point during which data that no soil explains may be of a
    border.  With 0.5 some faults of sensors are called another soil."""
    min_to_learn: float = 0.5
    """Windows [1] that the data must fill for the posterior to be a later prior: with less it is not Gaussian."""
    max_unexplained: float = 2.0
    """Windows [1] after a change point during which a change may explain a mismatch."""
    transition_lengths: tuple[float, ...] = (0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 5.5, 7.5, 10.5)
    """Lengths of a transition that are tried [wheelbases; of a rig wheel diameters]: borders are sharp or gradual."""
    gain_memory: float = 6.0
    """Windows [1] whose findings on a sensor's gain weigh against its prior: all repeat the errors of one model.  With
    60 the weight of a loader on two driven wheels ends 12 % off; with 5 the friction of a turning robot is missed."""
    gain_correlation_time: float = 86400.0
    """Time [s] in which the autocorrelation of a gain error falls to 1/e: amplifiers drift, tyres wear."""


@dataclass(frozen=True, slots=True)
class StandingOptions:
    """Prior sd of the parts that stand in every model (`standing`); 0 holds one at none."""

    relaxation_length: float = 0.1
    """[m]: tyres relax over 0.05 to 0.3 m (Pacejka 2012, ch. 7)."""
    wheel_inertia: float = 10.0
    """[`wheel_mass_share` discs]: a motor behind its gear adds many times the wheel's own inertia."""
    wheel_mass_share: float = 0.03
    """Mass of a wheel over that of the vehicle [1]: 2.4 to 3.6 % of a robot, a tractor and a loader."""
    load: float = 0.04
    """Lateness of loads and acceleration beside torque and wheel speed [s]: a cycle of 20 ms, a filter of 20 to 30."""
    ground_speed: float = 0.15
    """[s]: a radar 0.05 to 0.15 s, receivers of positions 0.1 to 0.3 s."""
    draft: float = 0.05
    """[s]: as `load`, and a filter against the hitch's vibration."""


HELD = StandingOptions(0.0, 0.0, StandingOptions().wheel_mass_share, 0.0, 0.0, 0.0)
"""None of them."""


@dataclass(frozen=True, slots=True)
class VarianceOptions:
    """Tuning values: how variance components are learned from residuals (`variance_components`)."""

    block: float = 1.0
    """Length of a block [s]: an axle bounces at 1.5 to 3 Hz, so that a second holds whole cycles of it."""
    memory: float = 30.0
    """Windows [1] over which factors are averaged, one a hop: half a minute of the same ground."""
    least: float = 0.25
    """Least factor on a variance [1]: sensors twice as good as their data sheets say."""
    most: float = 400.0
    """Largest factor on a variance [1]: twenty times the sd of a data sheet, as loads that shake by 12 % have beside
    cells of 0.8 %.  Without it torques of the wrong sign count as noise."""
    least_share: float = 0.02
    """Share of its own noise [1] an instant that corrections of a kind must show for its factor to be learned."""


@dataclass(frozen=True, slots=True)
class EstimatorOptions:
    """All tuning values of the estimator."""

    measurements: MeasurementOptions = MeasurementOptions()
    search: SearchOptions = SearchOptions()
    posterior: PosteriorOptions = PosteriorOptions()
    tracker: TrackerOptions = TrackerOptions()
    standing: StandingOptions = StandingOptions()
    variance: VarianceOptions = VarianceOptions()


ESTIMATOR = EstimatorOptions()
"""As the service estimates."""
