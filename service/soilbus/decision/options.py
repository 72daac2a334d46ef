"""Options of the watch for immobilisation: its tuning values, each once, with unit and source or evidence.

    WatchOptions -> watch.watched, stall.stalling, margin.left_by, moments.moments

What a change of 30 % does to each: service/docs/sensitivity.md.  What an operator may change: `config.model.Warning`.
"""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["WATCH", "WatchOptions"]


@dataclass(frozen=True, slots=True)
class WatchOptions:
    """Tuning values of the watch: means, trends, and causes to warn; shares are of the largest pull."""

    moment_span: float = 0.3
    """Time [s] over which a moment's slip and pull are averaged: about half a period of loads that shake
    at 1.5 to 3 Hz.  With 0.12 s one of 122 boggings less was warned of in time on two of three machines (seed 71)."""
    slip_exponent: float = 7.5
    """b [1]: gross traction ratio mu = mu_max (1 - e^(-b s)) over slip s (Brixius 1987, tyres in fields)."""
    settling_time: float = 2.0
    """Age [s] of a trend from which it is used, and time after which what it foresaw is compared with what came."""
    slow_memory: float = 2.5
    """Time constant [s] of the trend of ground that softens over many metres, and of a demand's present value."""
    fast_memory: float = 0.8
    """Time constant [s] of the trend of ground at a soft patch's edge."""
    scatter_lag: float = 0.5
    """Time [s] after which a capacity's scatter is another: neither the same samples nor the same metre of ground.  For
    so long a demand must be near the largest pull.  At 0.4 `e-plough-loam` and `b-2wd-loam` had a false warning
    each."""
    forgetting_time: float = 5.0
    """Time [s] in which the past is forgotten: how much slip shakes, by how much a reckoned ground speed differs from
    that of the wheels, how fast a demand rises, and the last cause of a warning; ten periods of a vehicle on its tyres.
    Of a demand's slope over 2.5 s less than a sixth came true within 2 s on `b-2wd-loam`, `b-clutch-easy-0` and
    `d-bog-0`, and none within 10 s; over 10 s a grade of `decisions --boggings` is warned of 0.3 s late."""
    warning_time: float = 10.0
    """Time [s] ahead within which a capacity is to fall to the demand, or a demand is to outgrow it, and back for which
    moments are kept: some swings of a draft."""
    lasting: float = 0.2
    """Time [s] for which a trend must lead to the limit before it warns.  At 0.4 the edge of a soft patch is felt 0.2 s
    too late; at 0 `d-rough-0` warned once where nothing happened."""
    significant_sd: float = 2.5
    """Standard deviations by which a capacity must fall.  At 3 the edge of a soft patch is felt 0.2 s too late, and
    three false warnings less come in 4.65 h of other machines."""
    form_error: float = 0.1
    """Sd of the share [1] by which a curve's pull is wrong, which its std does not say.  A demand this near to the
    largest pull warns whatever its trend: in 24 drives on loam where nobody gets stuck it reaches 0.89 of it.  No
    larger std of the largest pull warns earlier.  At 0.08 two furrows of `e-plough-loam` warned, at 0.3 one of
    `b-plough-4wd`."""
    lateness: float = 0.1
    """Sd [s] of the time by which pull and slip are late beside each other: sensors of the multibody machines are 0.02
    to 0.08 s late.  Without it one of 24 drives on loam was warned of as its slip swept up from 0.06."""
    outgrows: float = 0.83
    """Probability that a demand outgrows the ground from which it counts: between the ploughing of `b-plough-4wd`
    (0.80) and the grades of `decisions --boggings`."""
    takes_all: float = 0.65
    """Least probability that a demand takes nearly all, for a warning.  At 0.5 a loader on two wheels, whose largest
    pull is known to 29 to 39 %, is warned at 0.6 of it; at 0.7 a swinging draft of `decisions --boggings` is warned of
    4 s later."""
    least_share: float = 0.7
    """Share that a demand must have reached before its rise counts: lowering an implement is no trouble.  Without it
    two furrows of `e-plough-loam` warned; at 0.8 nine false warnings less come in 4.65 h of other machines, but a grade
    is foreseen 1.5 s ahead, not 3.3 s."""
    draft_rise: float = 0.02
    """Rise of the draft above its mean of the last second, as a share of the weight, by which wheels slip more on any
    ground."""


WATCH = WatchOptions()
"""As the service watches."""
