"""What one window says."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from soilbus.config.model import Config
from soilbus.decision.immobilisation import Watch
from soilbus.decision.judgement import Basis, at_present
from soilbus.decision.traction_loss import TractionLoss
from soilbus.decision.traversability import Status, Traversability
from soilbus.pipeline.excitation import Excitation
from soilbus.pipeline.positions import Position

if TYPE_CHECKING:
    from soilbus.estimation.posterior import Estimate, Posterior


@dataclass(frozen=True, slots=True)
class WindowResult:
    """What one window says; t is its end [s], index counts windows since the start.

    slip and sinkage [m] are means over the window by wheel name, None where unknown.
    rejected counts refused samples of the window by reason.  posterior is None where
    status is invalid.  soil_class is the probability of each known soil and of `unknown`,
    the largest first.  position is in the middle of the data that count: of the window, or
    of its part on a new soil.  failure is the kind of a solve that failed, None where none did.
    watch warns of immobilisation; unknown where the loop watches ten times a second itself.  gaps: reduced
    chi-square of the channels that have not fitted for minutes, the worst first.  z_driven: sinkages [m] between
    which nine tenths of the wheels' instants lie.  search_ended: the budget of
    evaluations (estimator.search_rate, search_burst) ended the search for a soil that describes the data.
    log names the recording that the window is of; None for the live bus.  excitation: how much draft and slip
    varied.  basis: what the decision rests on.
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
    soil_class: dict[str, float] | None = None
    position: Position | None = None
    failure: str | None = None
    gaps: Mapping[str, float] = field(default_factory=dict)
    z_driven: tuple[float, float] | None = None
    search_ended: bool = False
    watch: Watch = Watch()  # noqa: RUF009, immutable
    log: str | None = None
    excitation: Excitation = Excitation()  # noqa: RUF009, immutable
    basis: Basis = Basis()  # noqa: RUF009, immutable


def as_of(result: WindowResult, loss: TractionLoss, now: float, config: Config) -> WindowResult:
    """The result with what is left of its decision at the time `now` [s]; of a stuck vehicle none is valid."""
    decision = at_present(result.traversability, result.basis, loss, now, config)
    if loss.stuck and result.status is Status.VALID:
        return replace(result, traversability=decision, status=Status.NOT_EXCITED, reason="standstill")
    return replace(result, traversability=decision)
