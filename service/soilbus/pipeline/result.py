"""The result of one window, and the same result some time later.

WindowResult          estimate, status, decision and warning at the window's end
as_of(result, now)    the decision overruled by age, distance and what the watch has seen since
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, NamedTuple

from soilbus.config.model import Config
from soilbus.decision.judgement import Basis, at_present
from soilbus.decision.traversability import Status, Traversability
from soilbus.decision.watch import Warnings, Watch
from soilbus.pipeline.corrections import NO_CORRECTIONS, Corrections
from soilbus.pipeline.determination import Excitation
from soilbus.pipeline.positions import Position

if TYPE_CHECKING:
    from soilbus.decision.capability import OverSlip
    from soilbus.estimation.posterior import Estimate, Posterior


FIRST_DATE, LAST_DATE = 946684800.0, 4102444800.0
"""1 January of 2000 and of 2100 [s]: other stamps count from the start of a log or of a logger, and are no dates."""


def is_date(t: float) -> bool:
    """Return whether a stamp [s] is a date, not seconds from some start."""
    return FIRST_DATE <= t < LAST_DATE


class SoilChange(NamedTuple):
    """Which soil a window is of (`soil_state.TrackerState`), and why (`soil_state.Reason`).

    The change statistic and its threshold are None without a change point.
    """

    state: str
    reason: str
    statistic: float | None
    threshold: float | None


@dataclass(frozen=True, slots=True)
class WindowResult:
    """Result of one window; None where nothing is known.

    Attributes
    ----------
    t, index, log
        End [s], number of the window since the start, name of the recording (None for the live bus).
    status, reason, failure
        Whether the estimate may be used, why not, and the kind of failure of a solve.
    posterior, bearing, soil_class
        Of the soil, its bearing pressure [Pa], and the probability of each known soil and of `unknown`, the largest
        first; None where status is invalid.
    slip, sinkage, z_driven
        Means over the window by wheel, sinkage in m; 5 % and 95 % quantiles of the sinkage [m].
    traversability, basis, watch, warnings
        The decision and the data that it rests on; immobilisation warning (unknown where the live loop computes it ten
        times a second), and when it began.
    chi2, samples, rejected, channel_chi2
        Reduced chi-square, number of samples, refused samples by reason; chi-square of every channel over minutes.
    iterations, termination, search_ended
        Evaluations of the model by the solver, why it ended (`solver.Termination`), and whether the budget of
        evaluations (estimator.search_rate, search_burst) ended the search for a soil.
    position
        In the middle of the data used: of the window, or of its part on a new soil.
    prediction_error, gaps
        By channel, how far off the model predicts new data, as a share of their size (`estimation.prediction`); of
        channels that it has predicted badly for minutes, the worst first.
    standing, noise_factors
        Standing parts of the model (`estimation.standing`): relaxation length [m], inertia of a mean wheel [kg m^2],
        lateness of channels beside torque and wheel speed [s]; sd of each kind of sensor over the configured one.
    soil_change, excitation, shows_strength
        Which soil the window is of, and why; how much draft and slip varied; whether tan phi is known to
        `estimator.max_tan_phi_std`.
    corrections
        Of what is read after the window.
    """

    t: float
    index: int
    status: Status
    reason: str
    posterior: Posterior | None
    bearing: Estimate | None
    slip: dict[str, float | None]
    sinkage: dict[str, float | None]
    traversability: Traversability
    chi2: float | None
    samples: int
    rejected: dict[str, int]
    iterations: int = 0
    termination: str | None = None
    soil_class: dict[str, float] | None = None
    position: Position | None = None
    failure: str | None = None
    gaps: Mapping[str, float] = field(default_factory=dict)
    channel_chi2: Mapping[str, float] = field(default_factory=dict)
    standing: Mapping[str, Estimate] = field(default_factory=dict)
    noise_factors: Mapping[str, float] = field(default_factory=dict)
    prediction_error: Mapping[str, float] = field(default_factory=dict)
    z_driven: tuple[float, float] | None = None
    search_ended: bool = False
    watch: Watch = Watch()  # noqa: RUF009, immutable
    warnings: Warnings = Warnings()  # noqa: RUF009, immutable
    log: str | None = None
    soil_change: SoilChange | None = None
    excitation: Excitation = Excitation()  # noqa: RUF009, immutable
    basis: Basis = Basis()  # noqa: RUF009, immutable
    shows_strength: bool = False
    corrections: Corrections = NO_CORRECTIONS

    @property
    def curve(self) -> OverSlip | None:
        """Pull over slip, along which the warning extrapolates; None where the window does not determine it.

        That takes a model that fits and slips that show the soil's strength.  How deep the soil bears, which a window
        without load cells seldom tells, matters little: only what the pull still gains beyond the present slip is taken
        from the curve, and the pull itself is measured.
        """
        able = self.traversability.capability
        fits = self.status is Status.VALID or (self.status is Status.NOT_EXCITED and self.shows_strength)
        return able.over_slip if able is not None and fits else None


def as_of(result: WindowResult, watch: Watch, now: float, config: Config) -> WindowResult:
    """Return the result as it stands at the time `now` [s] of the data, when the watch says this.

    A stuck vehicle has no valid result.
    """
    decision = at_present(result.traversability, result.basis, watch, now, config)
    if watch.stuck and result.status is Status.VALID:
        return replace(result, traversability=decision, status=Status.NOT_EXCITED, reason="standstill")
    return replace(result, traversability=decision)
