"""Recordings divided for the diagnosis: training blocks that models are fitted to, and held-out blocks.

    fold = floor(t / block) mod folds,  the last fold is held out

Successive instants are correlated, so whole time blocks are held out.  A table of
steady states has no time: each third row in the order of slip is held out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from soilbus.diagnosis.options import DEFAULT, DiagnosisOptions
from soilbus.estimation.gaussian import Gaussian
from soilbus.estimation.instants import averaged, instant_of
from soilbus.estimation.linearisation import Linearisation
from soilbus.estimation.nuisance_parameters import Free
from soilbus.estimation.observation_with_effects import ObservationModelWithEffects
from soilbus.estimation.options import SolverOptions
from soilbus.estimation.variance_components import VarianceComponents
from soilbus.estimation.window import Rig, Window
from soilbus.terra.effects.effect import Effect
from soilbus.terra.wheel import WheelModel
from soilbus.words import WorkError

__all__ = ["Record", "TooLittle", "record_of", "record_of_rows"]


class TooLittle(WorkError, ValueError):
    """A recording holds too little to be divided; the text says what."""


@dataclass(frozen=True, slots=True)
class Record:
    """One recording: training blocks and held-out blocks.

    Attributes
    ----------
    name
        Of the log or table.
    training, held_out
        Observation models of the two parts.
    joint_prior
        Posterior of soil, gains and parameters from an earlier fit on the same soil; it replaces the prior of a single
        recording.
    whole
        Observation model of all instants; None of a table.
    bins
        The same of all bins, of which instants are means.
    options
        Of its diagnosis.
    source
        Window, rig, model and limits of speed and turn that it was made of; None of a table.
    noise
        Factor on [noise]'s variances by kind of sensor (`noise_floor`).
    """

    name: str
    training: ObservationModelWithEffects
    held_out: ObservationModelWithEffects
    joint_prior: Gaussian | None = None
    whole: ObservationModelWithEffects | None = None
    bins: ObservationModelWithEffects | None = None
    options: DiagnosisOptions = DEFAULT
    source: tuple[Window, Rig, WheelModel, float, float] | None = None
    noise: Mapping[str, float] = field(default_factory=dict)

    def block_numbers(self, part: ObservationModelWithEffects, held_out: bool) -> NDArray[np.intp]:
        """The block (N,) of each instant of a part; a table has its folds."""
        if self.source is None:
            rank = np.argsort(np.argsort(part.slip.mean(1), kind="stable"))
            return np.full(part.n, self.options.folds) if held_out else np.asarray(rank % (self.options.folds - 1))
        return np.asarray((part.since / block_length(part.duration, self.options)).astype(int))

    def with_noise(self, factor: Mapping[str, float]) -> Record:
        """The same with the variances of each kind of sensor times a factor; a table as it is."""
        if self.source is None:
            return self
        window, rig, model, min_speed, max_turn = self.source
        scaled = VarianceComponents(rig.options.variance).after(factor, whole=True).scaled(window, rig)
        effects, free = self.training.effects, self.training.free
        again = record_of(self.name, scaled, rig, model, min_speed, max_turn, self.options)
        again = again.with_effects(effects, free, self.joint_prior)
        return replace(again, source=self.source, noise=factor)

    def with_effects(
        self, effects: Sequence[Effect], free: Sequence[Free], joint_prior: Gaussian | None = None
    ) -> Record:
        """The same under a model with these effects and parameters."""
        training, held_out = (part.with_effects(effects, free) for part in (self.training, self.held_out))
        whole = None if self.whole is None else self.whole.with_effects(effects, free)
        return replace(self, training=training, held_out=held_out, joint_prior=joint_prior, whole=whole)

    def with_weights_at(self, training: Linearisation, held_out: Linearisation) -> Record:
        """The same with the weights of a model in which the parts were linearised; see `ObservationModel`."""
        parts = [part.with_weights_at(at) for part, at in ((self.training, training), (self.held_out, held_out))]
        return replace(self, training=parts[0], held_out=parts[1])

    def thinned(self, every: int) -> Record:
        """The same with each `every`-th instant; a table of few rows keeps all of them."""
        parts = self.training, self.held_out
        least = self.options.min_sample
        training, held_out = (part.part(slice(None, None, min(every, part.n // least + 1))) for part in parts)
        return replace(self, training=training, held_out=held_out, whole=None, bins=None)


def diagnosed(rig: Rig) -> Rig:
    """Return the rig with the inertia of bare wheels, what is more is an effect; descents end nearer."""
    search = replace(rig.options.search, cold=SolverOptions(100), warm=SolverOptions(100, step_tolerance=2e-4))
    standing = replace(rig.options.standing, wheel_inertia=1.0)
    return replace(rig, options=replace(rig.options, search=search, standing=standing))


def record_of(
    name: str,
    window: Window,
    rig: Rig,
    model: WheelModel,
    min_speed: float,
    max_turn: float,
    options: DiagnosisOptions = DEFAULT,
) -> Record:
    """One recording divided into blocks.

    Parameters
    ----------
    name
        Of the log.
    window
        All of the recording.
    rig, model
        The vehicle and its wheel-soil model.
    min_speed, max_turn
        Limits within which an instant is usable: speed [m/s], relative difference of an axle's rim speeds [1].
    options
        Of its diagnosis.

    Raises
    ------
    TooLittle
        Where the recording has not enough usable instants.
    """
    end, span = (float(window.t[-1]), float(np.ptp(window.t))) if len(window.t) else (0.0, 0.0)
    length = min(instant_of(rig, options.instant), span / (2 * options.folds * options.min_sample))
    bins, problem = (
        ObservationModelWithEffects(part, diagnosed(rig), model, min_speed, max_turn).with_own_stamps().on_curves()
        for part in (window, averaged(window, end, length))
    )
    problem = problem.on_bumps()
    fold = folds(problem.since, options)
    is_held_out = fold == options.folds - 1
    parts = np.flatnonzero(~is_held_out), np.flatnonzero(is_held_out)
    if min(map(len, parts)) < options.min_sample:
        raise TooLittle(f"{name}: {problem.n} usable instants are too few to learn from some and check with others")
    training, held_out = (problem.part(part) for part in parts)
    if not (training.n_rows and held_out.n_rows):
        raise TooLittle(f"{name}: neither a torque nor a draft is known with its load, slip and slope at once")
    source = window, rig, model, min_speed, max_turn
    return Record(name, training, held_out, whole=problem, bins=bins, options=options, source=source)


def record_of_rows(
    name: str, window: Window, rig: Rig, model: WheelModel, options: DiagnosisOptions = DEFAULT
) -> Record:
    """A table of steady states, of which a third is held out.

    Rows are not correlated in time as the instants of a drive are, and blocks of them would only separate small slips
    from large.  So each third row in the order of slip is held out, with its neighbours in training.

    Raises
    ------
    TooLittle
        Where the table has not enough usable rows.
    """
    problem = ObservationModelWithEffects(window, diagnosed(rig), model, min_speed=0.0)
    if problem.n < 5:
        raise TooLittle(f"{name}: {problem.n} usable rows are too few to learn from some and check with others")
    rank = np.argsort(np.argsort(problem.slip.mean(1), kind="stable"))
    held_out_rows = rank % options.folds == options.folds // 2
    training, held_out = (problem.part(np.flatnonzero(part)) for part in (~held_out_rows, held_out_rows))
    return Record(name, training, held_out, options=options)


def folds(since: NDArray[np.float64], options: DiagnosisOptions) -> NDArray[np.intp]:
    """Fold (N,) of instants at these times (N,) [s] since the start: blocks by turns."""
    length = block_length(float(since[-1] - since[0]) if len(since) else 0.0, options)
    return np.asarray((since / max(length, 1e-9)).astype(int) % options.folds)


def block_length(span: float, options: DiagnosisOptions) -> float:
    """Length [s] of the blocks of a recording of this span [s]: three at least of each fold."""
    return min(options.block, span / (3 * options.folds)) if span > 0.0 else options.block
