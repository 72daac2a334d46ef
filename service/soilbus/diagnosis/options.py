"""Options of the diagnosis: its tuning values, each once, with unit and source or evidence.

    Record.options -> diagnose -> Search, verdict, where, delays

What a change of 30 % does to each is in service/docs/sensitivity.md.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from soilbus.estimation.options import SolverOptions

__all__ = ["DEFAULT", "DiagnosisOptions"]


@dataclass(frozen=True, slots=True)
class DiagnosisOptions:
    """Division of the recordings, search, verdict, and what is reported beside it."""

    block: float = 4.0
    """Length of a time block [s]: long beside a sensor's lag, short beside a sweep of slip."""
    folds: int = 3
    """Folds that the blocks belong to by turns; the last is held out."""
    min_sample: int = 12
    """Instants that each part of a recording must have, and residuals of a channel or region that is judged.  With 4
    and 24 instants, and with 20 residuals, no value of the golden diagnoses moves."""

    instant: float = 0.25
    """Length [s] of an instant, the mean that models are fitted to, as the service's: a machine that shakes is steady
    in the mean.  Over 0.1 s shaking passes for effects, and a hardpan and a springing rut under stale stamps are not
    seen."""
    gain_left_out: float = 0.99
    """Share [1] of a sensor gain's prior that is predicted as a block is: what no data determine keeps ten times its
    sd."""
    noise_rounds: int = 2
    """Fits [1] after which noise floors are estimated again, as each kind's depends on those of the others."""

    max_effects: int = 3
    """Effects that are added at most, and residual terms of a channel.  With 4 no value of the golden diagnoses moves,
    with 2 thrown soil is ambiguous in place of named."""
    max_candidates: int = 6
    """Candidates that a comparison fits, the best by their scores: of 82 single effects of the blind seeds 211 and 212
    the hidden one is among the first three of 77, and of the others behind the thirteenth."""
    thinning: int = 4
    """The first fit of a candidate has one instant in this many.  With 8 no verdict of the golden diagnoses moves, with
    1 thrown soil is ambiguous in place of named."""
    compared: SolverOptions = field(default_factory=lambda: SolverOptions(step_tolerance=2e-2))
    """Descent of fits that are compared by their objective: 0.02 of -2 log decides nothing."""
    negligible_fall: float = 1.0
    """Fall of -2 log posterior or evidence up to which two models are equally good: odds of e^0.5.  With 0 and 4 no
    value of the golden diagnoses moves, but with 0 a fit that found nothing is not tried from elsewhere."""
    check_rounds: int = 3
    """Linearisations that bring the latents of held-out blocks to their optimum.  With 5 eleven values of the golden
    diagnoses move, with 1 nearly six hundred."""

    dominated_fall: float = 200.0
    """-2 log posterior [1] above the best candidate's from which a fit is given up: blocks tell two models of that
    difference apart by three sd, as a half to a third of it is how blocks scatter."""
    max_formula_error: float = 0.1
    """Share [1] of what effects change by which their formulas may be off: a further one must explain more than its
    square of what they explain.  Where that is above 31 000 (seeds 301, 505, 506; 9 pairs, 2 singles) the smaller true
    effect explains 1.25 % and more, false further ones 0.12 to 0.35 %."""
    named_probability: float = 0.8
    """Probability from which a name stands alone: the meaning of `named`."""
    set_probability: float = 0.02
    """Probability from which a name belongs to the set: the meaning of `ambiguous`."""
    max_unexplained_share: float = 0.15
    """Share [1] of the gap's excess over noise that named effects may leave, as no formula is that of the field.  Of
    400 blind cases (seeds 211 to 303) 0.1 and 0.2 change one verdict each."""
    gap_limit_sd: float = 4.0
    """Standard deviations of a reduced chi-square beyond which a gap is real."""
    least_gap_limit: float = 1.04
    """Reduced chi-square [1] up to which no gap is reported, however many residuals: noise is not known better."""
    soil_error_share: float = 0.125
    """Share [1] of what an effect changes of the soil's parameters by which these are off (standard deviation), as no
    effect's formula is the field's: of the blind `tune` halves of seeds 109 to 113."""
    tyre_soil_error_share: float = 1.0
    """The same [1] for the deflection of the tyre."""
    max_overlap: float = 0.25
    """Share [1] by which the sum of what effects explain alone may differ from what they explain together: of 9 blind
    pairs (seed 132) with nothing in common it was 0.96 to 1.08, of 5 that look alike 1.1 to 1.6."""

    significance: float = 0.01
    """Probability under noise alone, corrected for all tests, below which a disagreement is reported."""

    delay_sure_sd: float = 3.0
    """Deviations by which a delay exceeds a sample time to be a name: of a thousand sound channels one does by noise.
    """


DEFAULT = DiagnosisOptions()
"""What a recording's diagnosis has unless another is given with it."""
