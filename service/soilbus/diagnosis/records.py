"""Recordings as the diagnosis wants them: time blocks to learn from, and others to check with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from soilbus.estimation.gaussian import Gaussian
from soilbus.estimation.nuisance_parameters import Free
from soilbus.estimation.observation_model import ObservationModelWithEffects
from soilbus.estimation.window import Rig, Window
from soilbus.terra.effects.effect import Effect
from soilbus.terra.wheel import WheelModel

__all__ = ["Record", "TooLittle", "record_of", "record_of_rows"]

BLOCK = 4.0
"""Length of a time block [s]: long beside a sensor's lag, short beside a sweep of slip."""
CHECKED = 3
"""Every so manieth block is held out."""
HELD_OUT = CHECKED - 1
"""Which of them."""
FEWEST = 12
"""Instants that each part of a recording must have."""
FEWEST_ROWS = 5
"""Rows that a table must have."""


class TooLittle(ValueError):
    """A recording holds too little to be divided; the text says what."""


@dataclass(frozen=True, slots=True)
class Record:
    """One recording: the instants that models are fitted to, and those held out.

    known is what an earlier fit on the same soil left behind of soil, gains and the
    parameters that the model has; it counts in place of the prior in the first recording.
    whole are all instants and fold (N,) which of CHECKED folds each is in, the last one held
    out; None where others cannot be held out in its place.
    """

    name: str
    learned: ObservationModelWithEffects
    checked: ObservationModelWithEffects
    known: Gaussian | None = None
    whole: ObservationModelWithEffects | None = None
    fold: NDArray[np.intp] | None = None

    def completed(self, effects: Sequence[Effect], free: Sequence[Free], known: Gaussian | None = None) -> Record:
        """The same under a model with these effects and parameters, of which so much is known."""
        learned, checked = (part.completed(effects, free) for part in (self.learned, self.checked))
        whole = None if self.whole is None else self.whole.completed(effects, free)
        return Record(self.name, learned, checked, known, whole, self.fold)

    def with_held_out(self, fold: int) -> Record | None:
        """The same with another fold held out; None where that cannot be."""
        if self.whole is None or self.fold is None:
            return None
        learned, checked = (self.whole.part(np.flatnonzero(part)) for part in (self.fold != fold, self.fold == fold))
        return replace(self, learned=learned, checked=checked)

    def thinned(self, every: int) -> Record:
        """The same with every so manieth instant; a table of few rows stays whole."""
        parts = self.learned, self.checked
        learned, checked = (part.part(slice(None, None, min(every, part.n // FEWEST + 1))) for part in parts)
        return Record(self.name, learned, checked, self.known)


def record_of(name: str, window: Window, rig: Rig, model: WheelModel, min_speed: float, max_turn: float) -> Record:
    """One recording divided into blocks; TooLittle where it has not enough usable instants."""
    problem = ObservationModelWithEffects(window, rig, model, min_speed, max_turn)
    fold = folds(problem.since)
    parts = np.flatnonzero(fold != HELD_OUT), np.flatnonzero(fold == HELD_OUT)
    if min(map(len, parts)) < FEWEST:
        raise TooLittle(f"{name}: {problem.n} usable instants are too few to learn from some and check with others")
    learned, checked = (problem.part(part) for part in parts)
    return Record(name, learned, checked, whole=problem, fold=fold)


def record_of_rows(name: str, window: Window, rig: Rig, model: WheelModel) -> Record:
    """A table of steady states, of which a third is held out; TooLittle where it has not enough usable rows.

    Rows do not hang together in time as the instants of a drive do, and blocks of them would
    only part small slips from large.  So it is every third row in the order of slip, that
    has its neighbours among the others.
    """
    problem = ObservationModelWithEffects(window, rig, model, min_speed=0.0)
    if problem.n < FEWEST_ROWS:
        raise TooLittle(f"{name}: {problem.n} usable rows are too few to learn from some and check with others")
    rank = np.argsort(np.argsort(problem.slip.mean(1), kind="stable"))
    held_out = rank % CHECKED == CHECKED // 2
    learned, checked = (problem.part(np.flatnonzero(part)) for part in (~held_out, held_out))
    return Record(name, learned, checked)


def folds(since: NDArray[np.float64]) -> NDArray[np.intp]:
    """Which fold instants, so many seconds since the start (N,), are in: blocks by turns."""
    span = float(since[-1] - since[0]) if len(since) else 0.0
    length = min(BLOCK, span / (3 * CHECKED)) if span > 0.0 else BLOCK
    return np.asarray((since / max(length, 1e-9)).astype(int) % CHECKED)
