"""Variance components: what each kind of sensor is worth, from the residuals of earlier windows.

With e = S^-1 r the weighed residuals of an instant and A their derivatives by the latents, a sensor of variance V has

    correction   v = V A' e    (of a row: v = R e)
    share        V A' S^-1 A   (of a row: R S^-1)         of its own noise that the corrections show
    factor       f = sum over blocks of (sum of v / sqrt V)^2  /  sum of shares           blocks of one second

so that f V is the variance that corrections of this kind have in the mean over a second (Foerstner 1979, Allg. Verm.
Nachr. 86:446; blocks: Newey & West 1987, Econometrica 55:703).  The factor is never less than that of single instants:
noise that averages out within a second is still in each instant's loads and speeds.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from soilbus.arrays import Array
from soilbus.estimation.linearisation import RESIDUAL, Linearisation, Optimum
from soilbus.estimation.observation_model import ObservationModel
from soilbus.estimation.options import VarianceOptions
from soilbus.estimation.window import Rig, Window

KINDS = {
    "torque": ("torque",), "draft": ("draft", "pitch", "acceleration"), "sinkage": ("sinkage",),
    "load": ("load",), "speed": ("speed",), "ground_speed": ("ground_speed",), "computed_load": (),
}  # fmt: skip
"""Quantities whose variance each factor scales; that of loads which no cell measures is of the rig."""


@dataclass(frozen=True, slots=True)
class VarianceComponents:
    """Factors on the sensors' variances by kind, learned from `weight` windows."""

    options: VarianceOptions
    factor: Mapping[str, float] = field(default_factory=dict)  # of the kinds seen so far; 1 of every other
    weight: float = 0.0  # windows that the factors rest on

    def scaled(self, window: Window, rig: Rig) -> Window:
        """Return the window with the variances of sensors, and of loads that none measures, times their factors."""
        variance = dict(window.variance)
        for kind, factor in self.factor.items():
            for quantity in KINDS[kind]:
                variance[quantity] = factor * variance[quantity]
        given, observations = rig.instrumentation, window.observations
        if given is not None and observations is not None:
            kinds = (given.torque, "torque", ""), (given.load, "load", "computed_load"), (given.speed, "speed", "")
            torque, load, speed = (
                [self.factor.get(measured if row.kind == "channel" else computed, 1.0) for row in rows]
                for rows, measured, computed in kinds
            )
            latents = np.array([*load, *speed, self.factor.get("ground_speed", 1.0)])
            torque_var, latents_var = observations.torque_var * torque, observations.variance * latents
            observations = observations._replace(torque_var=torque_var, variance=latents_var)
        return replace(window, variance=variance, observations=observations)

    def after(self, found: Mapping[str, float], whole: bool = False) -> VarianceComponents:
        """Return the components after a window whose corrections are `found` times those expected; whole: replaced."""
        share = 1.0 if whole else 1.0 / (min(self.weight, self.options.memory) + 1.0)
        factor = dict(self.factor)
        for kind, ratio in found.items():
            old = factor.get(kind, 1.0)
            factor[kind] = min(max(old * ratio**share, self.options.least), self.options.most)
        return replace(self, factor=factor, weight=self.weight + 1.0)


def correction_ratios(problem: ObservationModel, optimum: Optimum, options: VarianceOptions) -> dict[str, float]:
    """Return the factor of each kind of sensor by which its corrections exceed what its variance says."""
    values, expected, of_kind = corrections(problem, optimum.at, optimum.gains)
    squares = np.stack([(v**2).sum(axis=0) for v in (values, block_sums(values, problem.t, options.block))])
    shown = expected.sum(axis=0)
    totals = {kind: float(shown[columns].sum()) for kind, columns in of_kind.items()}
    return {
        kind: float(squares[:, of_kind[kind]].sum(axis=1).max()) / total
        for kind, total in totals.items()
        if total > options.least_share * problem.n
    }


def corrections(problem: ObservationModel, at: Linearisation, gains: Array) -> tuple[Array, Array, dict[str, Any]]:
    """Return sensors' corrections (N, C) in their sd, their expected squares, and the columns of each kind."""
    A, (N, m) = at.by_latents, at.by_latents.shape[:2]
    e = at.weighed[:, RESIDUAL].reshape(N, m)
    variance, row_var = problem.variances(gains)
    by_latents = (e[:, None] @ A)[:, 0]
    shares = variance * (A * (at.inverse @ A)).sum(axis=1)
    of_rows = row_var * np.einsum("nmm->nm", at.inverse)
    layout, (of_sensor, measured) = problem.layout, problem.is_measured
    known, loads = problem.known & of_sensor, layout.loads
    if problem.rig.lengths is not None:  # a track's load is the mean of a window, and single instants do not show it
        shares[:, loads] = np.where(problem.rig.lengths > 0.0, 0.0, shares[:, loads])
    expected = np.hstack([np.where(known, of_rows, 0.0), np.where(measured, shares, 0.0)])
    expected = np.hstack([expected, np.where(measured[loads], 0.0, shares[:, loads])])
    of_latents = np.sqrt(variance) * by_latents
    values = np.hstack([np.sqrt(row_var) * e, of_latents, of_latents[:, loads]])
    latents, computed = np.arange(m, m + layout.n_latents), slice(m + layout.n_latents, None)
    of_kind: dict[str, Any] = {
        "torque": layout.torques, "draft": [layout.balance], "sinkage": slice(layout.sinkages.start, m),
        "load": latents[loads], "computed_load": computed, "speed": latents[layout.speeds],
        "ground_speed": latents[[layout.ground_speed]],
    }  # fmt: skip
    return np.where(expected > 0.0, values, 0.0), expected, of_kind


def block_sums(values: Array, t: Array, block: float) -> Array:
    """Return sums (B, C) of values (N, C) at times t (N,) [s] over blocks of this length [s]."""
    number = np.floor(t / block)
    starts = np.flatnonzero(number[1:] != number[:-1]) + 1
    return np.asarray(np.add.reduceat(values, np.concatenate([[0], starts]), axis=0))
