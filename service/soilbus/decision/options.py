"""Options of the watch for immobilisation: its tuning values, each once, with unit and source or evidence.

    WatchOptions -> immobilisation.watched, traction_loss.bins_of_a_moment

What a change of 30 % does to each is in service/docs/sensitivity.md.  What an operator may want to change is in
`config.model.Warning`.
"""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["WATCH", "WatchOptions"]


@dataclass(frozen=True, slots=True)
class WatchOptions:
    """Moments, memories of the regressions, and causes to warn; shares are of the capacity."""

    moment_span: float = 0.3
    """Time [s] over which a moment's slip and pull are averaged: about half a period of loads that shake at 1.5 to
    3 Hz.  With 0.12 s one bogging less was warned of in time on two of three machines (122 boggings, seed 71)."""
    slip_exponent: float = 7.5
    """b [1]: gross traction ratio mu = mu_max (1 - e^(-b s)) over slip s (Brixius 1987, tyres in fields)."""
    settling_time: float = 2.0
    """Age [s] of a trend from which it is used."""

    long_memory: float = 2.5
    """Time constant [s] of forgetting a capacity: of ground that softens over many metres."""
    short_memory: float = 0.8
    """Time constant [s] of forgetting a capacity: of a soft patch's edge."""
    scatter_memory: float = 10.0
    """Time constant [s] of forgetting how much a capacity scatters and a demand swings; moments are kept as long for
    the next curve."""
    scatter_lag: float = 0.5
    """Time [s] after which a capacity's scatter is another: neither the same samples nor the same metre of ground."""
    demand_memory: float = 4.0
    """Time constant [s] of forgetting slip, pull, and a demand, of which a line is to show a rise and not a swing."""
    swing_time: float = 1.5
    """Time [s] after which a demand that swings is another: draft swings within some seconds."""
    peak_memory: float = 300.0
    """A peak of the demand is remembered this long [s] at least, and at most twice as long."""

    warning_time: float = 10.0
    """Time left [s] below which the warning is given."""
    hold: float = 5.0
    """Time [s] after its last cause at which the warning ends."""
    sure_rise_share: float = 0.71
    """Share [1] from which a significant rise of draft and slope beyond their last peaks is extrapolated."""
    any_rise_share: float = 0.79
    """Share [1] that draft and slope ask for from which a rise is extrapolated, significant or not, and from which a
    warning does not end."""
    rising_share: float = 0.85
    """Share [1] that draft and slope ask for from which any rise or swing of theirs may become too much."""
    steepening: float = 1.6
    """Ratio [1] of the short memory's loss to the long one's from which the loss is expected to grow by this factor
    again: front wheels meet an edge first, rear ones a wheelbase later."""
    significant_sd: float = 2.5
    """Standard deviations [sd] by which a loss of capacity, and a rise of the demand, must differ from zero."""
    steady_rise: float = 0.003
    """Rise, as a share of the capacity [1/s]: of the pull given, up to which growing slip is due to the ground; of
    draft and slope, beyond which they may become too much (while also given: a vehicle that slows down gives less)."""

    @property
    def capacity_memories(self) -> tuple[float, ...]:
        """Time constants [s] of the trends of a `Capacity`, in their order."""
        long, short = self.long_memory, self.short_memory
        return long, short, long, short, short, self.scatter_memory


WATCH = WatchOptions()
"""As the service watches."""
