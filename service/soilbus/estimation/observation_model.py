"""How much a tracker may search: a token bucket of evaluations of the model, so that a replay is reproducible.

A window that follows the one before needs a few evaluations.  One that does not is searched for from many
soils: that is due at a start, at a border, after a gap, and soon found.  Where the model does not describe
the data no search finds anything, window after window: then the bucket is empty, and a search
is tried again whenever enough has come together (Turner 1986, IEEE Communications 24(10):8, for networks).

A window's residuals linearised at one point, as fits hand them on.

Inverse covariance of the residuals of every instant, by their structure.

Rows of an instant: torque of each wheel, the draft balance, then the sinkage of each
wheel where there are sensors.  A wheel's rows depend on its own load and speed, the
balance on those of all, and everything on the ground speed.  So the covariance is small
blocks by wheel, a border and a matrix of rank one, and two updates of rank one invert it.

Residuals of a window, weighed by the whole noise, and their derivatives.

At each instant the measured torques, the draft balance and (where there is a sensor) the
sinkages are compared with the model.  Wheel loads, wheel speeds and the ground speed are
measured too, with noise that travels through the model into every residual: they are
latent unknowns with the measurement as prior, eliminated instant by instant
(Gauss-Helmert model; cf. Foerstner & Wrobel, Photogrammetric Computer Vision, 2016,
sect. 4.8).  The entry angle of each wheel follows from its load.

A window whose derivatives do not know the noise that they are weighed against.

Loads and speeds are latent unknowns of every instant, and derivatives are taken where they
were fitted.  These fits keep part of the noise, and so even a window without any
variation seems to have some: n is told from k_phi by loads that differ, and those fitted do.
With ever more instants this grows like information, though no noise tells of a soil.  (Too
many unknowns: Neyman & Scott 1948, Econometrica 16:1.)

Instead, the derivatives are taken at what the latents are expected to be given their fits,
which leaves the score without bias and makes the information its variance (the
conditional score of Stefanski & Carroll 1987, Biometrika 74:703), and weights and the effect of
the latents' noise are those of the optimum.  What is left is a plain nonlinear regression
with known regressors.

A window's residuals under a wheel-soil model that effects complete.

The parameters of the effects take their place beside the gain errors of the sensors: each
as (parameter - value) / std, zero with variance one before any data.  Soil, latents and
parameters go through the effects' hooks with their derivatives (see terra.dual), and there
is one integration for all of them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from soilbus.arrays import Array
from soilbus.estimation.measurements import Measurements
from soilbus.estimation.nuisance_parameters import Free, active_at, varied_at
from soilbus.estimation.window import Rig, Window
from soilbus.terra.dual import UNIT, Dual, slope_of, value_of
from soilbus.terra.effects.along import through_low_pass
from soilbus.terra.effects.effect import Active, Effect, Forces, Surroundings, reactions_with, true_draft, wheel_with
from soilbus.terra.entry_angle import entry_angle_for_load
from soilbus.terra.soil_laws import lumped_modulus
from soilbus.terra.tangent import forces_along
from soilbus.terra.vehicle import GRAVITY
from soilbus.terra.wheel import (
    MAX_ENTRY_ANGLE,
    MIN_ENTRY_ANGLE,
    Soil,
    WheelModel,
    WheelState,
    sinkage,
    wheel_forces,
    wheel_forces_and_derivatives,
)


@dataclass(slots=True)
class Work:
    """Instants at which the model was evaluated."""

    instants: int = 0


@dataclass(slots=True)
class Latents:
    """Unknowns of each instant: load [N], speed [rad/s], entry_angle [rad] (N, W); ground_speed [m/s] (N,)."""

    load: Array
    speed: Array
    ground_speed: Array
    entry_angle: Array

    def followed_by(self, shared: int, new: Latents) -> Latents:
        """The last `shared` instants of these and then others."""
        return Latents(
            np.concatenate([self.load[-shared:], new.load]),
            np.concatenate([self.speed[-shared:], new.speed]),
            np.concatenate([self.ground_speed[-shared:], new.ground_speed]),
            np.concatenate([self.entry_angle[-shared:], new.entry_angle]),
        )

    def part(self, instants: NDArray[np.intp] | NDArray[np.bool_]) -> Latents:
        """Those of some instants, in this order."""
        return Latents(
            self.load[instants], self.speed[instants], self.ground_speed[instants], self.entry_angle[instants]
        )


@dataclass(slots=True)
class Linearisation:
    """Residuals and derivatives at one point, with what an update of the latents needs.

    The columns of `rows` and `weighed` (R, 1 + 6 + G) are the residual and its derivatives
    by the soil parameters (SI) and the gains (of the effects alone where the sensors' were
    not asked for); `weighed` is `rows` times the inverse
    covariance of its instant, so that `normal`, rows' weighed, holds chi-square and the
    normal equations.  Rows of missing data are zero.
    """

    rows: Array
    weighed: Array
    normal: Array
    by_latents: Array  # (N, m, 2 W + 1)
    corrected: Array  # (N, 2 W + 1) measured latents less their gain errors
    variance: Array  # of these
    by_gain: Array  # and minus their derivatives by the gain errors
    by_late: Array  # (P, N, 2 W + 1) and their derivatives by the effects' parameters; (0, N, 2 W + 1) of none
    off: Array  # (N, W) latent load less the model's
    load_slope: Array  # (N, W) dW/d entry angle
    load_by_slip: Array
    load_by_soil: Array  # (6, N, W)
    load_by_effects: Array  # (P, N, W)

    @property
    def chi2(self) -> float:
        """Sum of squares of the whitened residuals."""
        return float(self.normal[0, 0])

    def followed_by(self, shared: int, new: Linearisation) -> Linearisation:
        """The last `shared` instants of this and then those of another, linearised at the same soil and gains."""
        first = len(self.off) - shared
        row = first * self.by_latents.shape[1]
        rows, weighed = (np.concatenate([a[row:], b]) for a, b in ((self.rows, new.rows), (self.weighed, new.weighed)))
        return Linearisation(
            rows=rows,
            weighed=weighed,
            normal=rows.T @ weighed,
            by_latents=np.concatenate([self.by_latents[first:], new.by_latents]),
            corrected=np.concatenate([self.corrected[first:], new.corrected]),
            variance=np.concatenate([self.variance[first:], new.variance]),
            by_gain=np.concatenate([self.by_gain[first:], new.by_gain]),
            by_late=np.concatenate([self.by_late[:, first:], new.by_late], axis=1),
            off=np.concatenate([self.off[first:], new.off]),
            load_slope=np.concatenate([self.load_slope[first:], new.load_slope]),
            load_by_slip=np.concatenate([self.load_by_slip[first:], new.load_by_slip]),
            load_by_soil=np.concatenate([self.load_by_soil[:, first:], new.load_by_soil], axis=1),
            load_by_effects=np.concatenate([self.load_by_effects[:, first:], new.load_by_effects], axis=1),
        )


@dataclass(slots=True)
class Optimum:
    """Where a fit ended: soil (6,) in SI, gains (G,), latents of the instants t (N,), and the model there."""

    t: Array
    soil: Array
    gains: Array
    latents: Latents
    at: Linearisation


class CurvedPathFit(NamedTuple):
    """Optimum of a window before its data were freed of a bending way, and how large bends (N, K) may be beforehand."""

    optimum: Optimum
    basis: Array


def inverse_covariance(A: Array, latent_var: Array, row_var: Array, n_wheels: int) -> Array:
    """(A V A' + R)^-1 (N, m, m) for A (N, m, 2 W + 1), V diagonal (N, 2 W + 1), R diagonal (N, m)."""
    W = n_wheels
    by_load, by_speed, by_ground = A[:, :, :W], A[:, :, W : 2 * W], A[:, :, 2 * W]
    # copies: what lies together is worked on several times as fast
    load_var, speed_var, ground_var = latent_var[:, :W].copy(), latent_var[:, W : 2 * W].copy(), latent_var[:, 2 * W]
    balance_load, balance_speed = by_load[:, W].copy(), by_speed[:, W].copy()

    def own(rows: slice) -> tuple[Array, Array]:
        """Derivatives (N, W) of each wheel's row by its own load and speed."""
        return diagonals(by_load[:, rows]).copy(), diagonals(by_speed[:, rows]).copy()

    load, speed = own(slice(W))
    load_weighed, speed_weighed = load * load_var, speed * speed_var
    torque = load * load_weighed + speed * speed_weighed + row_var[:, :W]
    torque_balance = load_weighed * balance_load + speed_weighed * balance_speed
    balance = (balance_load**2 * load_var + balance_speed**2 * speed_var).sum(1) + row_var[:, W]

    inverse = np.zeros((*row_var.shape, row_var.shape[1]))
    border = np.empty(row_var.shape)
    border[:, W] = -1.0
    if row_var.shape[1] > W + 1:
        z = slice(W + 1, None)
        z_load, z_speed = own(z)
        cross = load_weighed * z_load + speed_weighed * z_speed
        sinkage = z_load**2 * load_var + z_speed**2 * speed_var + row_var[:, z]
        sinkage_balance = z_load * load_var * balance_load + z_speed * speed_var * balance_speed
        determinant = torque * sinkage - cross**2
        torque_part, cross_part, sinkage_part = sinkage / determinant, -cross / determinant, torque / determinant
        border[:, :W] = torque_part * torque_balance + cross_part * sinkage_balance
        border[:, z] = sinkage_part * sinkage_balance + cross_part * torque_balance
        balance -= (sinkage_balance * border[:, z]).sum(1)
        diagonals(inverse[:, z, z])[:] = sinkage_part
        diagonals(inverse[:, :W, z])[:] = cross_part
        diagonals(inverse[:, z, :W])[:] = cross_part
    else:
        torque_part = 1.0 / torque
        border[:, :W] = torque_part * torque_balance
    balance -= (torque_balance * border[:, :W]).sum(1)
    diagonals(inverse[:, :W, :W])[:] = torque_part
    inverse += np.einsum("ni,nj->nij", border, border / balance[:, None])
    common = (inverse @ by_ground[:, :, None])[:, :, 0]
    share = ground_var / (1.0 + ground_var * np.einsum("ni,ni->n", by_ground, common))
    inverse -= np.einsum("ni,nj->nij", common, common * share[:, None])
    return inverse


def diagonals(blocks: Array) -> Array:
    """The diagonals (N, W) of blocks (N, W, W), writeable."""
    view = blocks.diagonal(axis1=1, axis2=2)
    view.flags.writeable = True  # numpy gives a view, for reading only
    return view


THINNED_FORM = 4
"""Instants of which one is asked for its derivatives by the form, a smooth function of loads and slips: lines between
them change no std of the soil by more than 3 %."""
START_TOLERANCE = 0.02
"""Relative error of load left in the first entry angles; each linearisation mends it further."""
MAX_TURN = 0.15
"""Relative difference of an axle's rim speeds from which slip is not judged, where nobody says otherwise."""
SAME_INSTANT = 1e-3
"""Times [s] closer than this are those of one bin."""


class Response(NamedTuple):
    """Drawbar pull, torque and sinkage (3, N, W) of wheels that carry the latent loads.

    by_load, by_speed, by_ground: their derivatives (3, N, W) by the latents, by_soil
    (3, 6, N, W) and by_effects (3, P, N, W) those by the soil parameters and by what else
    the model has.  load_by_slip (N, W), load_by_soil (6, N, W), load_slope, off (N, W):
    derivatives of the load at the latent entry angle, by that angle, and how much it is off.
    pull (N,) [N] is what the wheels must pull besides what the readings ask for, with its
    derivatives by the effects (P, N).
    """

    value: Array
    by_load: Array
    by_speed: Array
    by_ground: Array
    by_soil: Array
    load_by_slip: Array
    load_by_soil: Array
    load_by_effects: Array
    load_slope: Array
    off: Array
    by_effects: Array
    pull: Array
    pull_by_effects: Array


class DelayTerms(NamedTuple):
    """What readings of channels that are not late would tell besides these, and its derivatives by the effects.

    torque (N, W) [N m], measured (N, 2 W + 1) of the latents, demand (N,) [N]; by_torque (P, N, W) and so on.
    predicted (N, W) [N m] is what a low pass makes of the torques of the model, less these.
    """

    torque: Array
    measured: Array
    demand: Array
    predicted: Array
    by_torque: Array
    by_measured: Array
    by_demand: Array
    by_predicted: Array


class ObservationModel(Measurements):
    """One window's data and the model that is to explain it, ready to be linearised at any soil."""

    def __init__(
        self, window: Window, rig: Rig, model: WheelModel, min_speed: float, max_turn: float = MAX_TURN
    ) -> None:
        super().__init__(window, rig, min_speed, max_turn)
        self.model = model
        self.work = Work()

    def allowed(self, gains: Array) -> Array:
        """Gains (G,) with what has a range kept inside it."""
        return gains

    def gain_bounds(self) -> tuple[Array, Array]:
        """Least and greatest gains (G,), infinite where any will do."""
        return np.full(len(self.gain_std), -np.inf), np.full(len(self.gain_std), np.inf)

    def lateness(self, gains: Array, latents: Latents, torque: Array) -> DelayTerms | None:
        """Of gains (G,) and latents, with these torques (N, W) of the model; None where nothing is late."""
        return None

    def thinned(self, most: int) -> ObservationModel:
        """The same window with at most so many of its usable instants, evenly spread."""
        if self.n <= most:
            return self
        return self.part(np.linspace(0, self.n - 1, most).round().astype(int))

    def start(self, soil: Soil, guess: Array | None = None, gains: Array | None = None) -> Latents:
        """Latents at the measured values, entry angles solved for this soil (and gains) from a guess (N, W)."""
        angle = np.full((self.n, self.n_wheels), np.nan) if guess is None else guess
        return self.with_entry_angles(
            Latents(self.load.copy(), self.speed.copy(), self.ground_speed.copy(), angle), soil, gains
        )

    def with_entry_angles(self, latents: Latents, soil: Soil, gains: Array | None = None) -> Latents:
        """The same latents with the entry angles at which this soil carries their loads; gains (G,) as linearise()."""
        slip = 1.0 - latents.ground_speed[:, None] / (self.rig.radius * latents.speed)
        state = self._state(soil, latents.entry_angle, slip)
        angle = entry_angle_for_load(latents.load.ravel(), state, self.model, tolerance=START_TOLERANCE)
        angle = angle.reshape(self.n, self.n_wheels)
        angle = np.where(np.isfinite(angle), angle, MAX_ENTRY_ANGLE * 0.98)
        return Latents(latents.load, latents.speed, latents.ground_speed, angle)

    def sinkages(self, soil: Soil, gains: Array, latents: Latents) -> Array:
        """Sinkage [m] of each wheel at each instant (N, W), whether it is usable or not."""
        return np.asarray(sinkage(latents.entry_angle, self.rig.radius))

    def mean_sinkage(self, soil: Soil, gains: Array, latents: Latents) -> Array:
        """Mean sinkage [m] of each wheel (W,), nan for a wheel that is never usable; gains (G,) as linearise()."""
        known = self.usable.sum(0)
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(np.where(self.usable, self.sinkages(soil, gains, latents), 0.0).sum(0) / known)

    def after(self, previous: Optimum) -> tuple[Latents, Linearisation]:
        """Latents and model of this window at the optimum of one that ends a little earlier.

        Instants that both share are taken over; the others are linearised at the measured
        values, with entry angles as loads and slips had them in the other window.
        """
        shared = self._shared(previous.t)
        if previous.at.by_latents.shape[1] != self._n_residuals:
            shared = 0
        new = self.part(slice(shared, None))
        start = new._measured_on(self._angle_curve(previous.latents))
        at = new.linearise(Soil(*previous.soil.tolist()), previous.gains, start)
        if not shared:
            return start, at
        return previous.latents.followed_by(shared, start), previous.at.followed_by(shared, at)

    def _shared(self, t: Array) -> int:
        """How many of the first instants are the last of those at t (M,)."""
        n = len(t) - int(np.searchsorted(t, self.t[0] - SAME_INSTANT))
        return n if 0 < n < self.n and np.abs(self.t[:n] - t[-n:]).max() < SAME_INSTANT else 0

    def _angle_curve(self, latents: Latents) -> Array:
        """How entry angles depend on load and slip: coefficients (W, 4).

        log entry angle = a + b log load + c slip + d slip^2, fitted wheel by wheel.
        """
        regressors = self._curve_regressors(latents.load, latents.speed, latents.ground_speed)
        target = np.log(latents.entry_angle).T[:, :, None]
        gram = regressors.transpose(0, 2, 1) @ regressors + 1e-9 * np.eye(4)
        return np.asarray(np.linalg.solve(gram, regressors.transpose(0, 2, 1) @ target)[:, :, 0])

    def _measured_on(self, curve: Array) -> Latents:
        log_angle = self._curve_regressors(self.load, self.speed, self.ground_speed) @ curve[:, :, None]
        angle = np.exp(np.clip(log_angle[:, :, 0].T, np.log(MIN_ENTRY_ANGLE), np.log(MAX_ENTRY_ANGLE)))
        return Latents(self.load.copy(), self.speed.copy(), self.ground_speed.copy(), angle)

    def _curve_regressors(self, load: Array, speed: Array, ground_speed: Array) -> Array:
        slip = 1.0 - ground_speed[:, None] / (self.rig.radius * speed)
        return np.stack([np.ones_like(load), np.log(load), slip, slip**2], axis=-1).transpose(1, 0, 2)

    def _state(self, soil: Soil, angle: Array, slip: Array) -> WheelState:
        K_L = lumped_modulus(soil.k_c, soil.k_phi, self._width)
        return WheelState(
            angle.ravel(), slip.ravel(), self._radius, self._width, K_L, soil.n, np.tan(soil.phi), soil.c, soil.K
        )

    def linearise(self, soil: Soil, gains: Array, latents: Latents, by_sensors: bool = True) -> Linearisation:
        """Whitened residuals and derivatives at a soil, gains (G,) and latents; by_sensors: also by the sensors' gains.

        Without those derivatives it serves to move the soil and the effects only.
        """
        W = self.n_wheels
        self.work.instants += self.n
        at = self._response(soil, gains, latents)
        A = self._by_latents(at)

        of_torque, of_latents, of_draft, corrected, variance, row_var = self._corrected(gains)
        late = self.lateness(gains, latents, at.value[1])
        draft, draft_var = self.draft * of_draft, self.draft_var * of_draft**2

        first_effect = 7 + (self.n_sensors if by_sensors else 0)
        rows = np.zeros((*A.shape[:2], first_effect + len(gains) - self.n_sensors))
        residual, by_soil, by_effects = rows[:, :, 0], rows[:, :, 1:7], rows[:, :, first_effect:]
        residual[:, :W] = self.torque * of_torque - at.value[1]
        residual[:, W] = self.demand - self.draft + draft + at.pull - at.value[0].sum(1)
        by_soil[:, :W] = -at.by_soil[1].transpose(1, 2, 0)
        by_soil[:, W] = -at.by_soil[0].sum(2).T
        by_effects[:, :W] = -at.by_effects[1].transpose(1, 2, 0)
        by_effects[:, W] = (at.pull_by_effects - at.by_effects[0].sum(2)).T
        if self.with_sinkage:
            residual[:, W + 1 :] = self.sinkage - at.value[2]
            by_soil[:, W + 1 :] = -at.by_soil[2].transpose(1, 2, 0)
            by_effects[:, W + 1 :] = -at.by_effects[2].transpose(1, 2, 0)
        now = np.concatenate([latents.load, latents.speed, latents.ground_speed[:, None]], axis=1)
        latent_by_gain = now * of_latents
        if by_sensors:
            by_gain = rows[:, :, 7:first_effect]
            diagonals(by_gain[:, :W, :W])[:] = -of_torque * at.value[1]
            np.multiply(A, -latent_by_gain[:, None, :], out=by_gain[:, :, W:-1])
            by_gain[:, W, -1] = -of_draft * (draft - residual[:, W] * draft_var / row_var[:, W])
        by_late = np.zeros((0, *now.shape))
        if late is not None:
            residual += self.late_residuals(late, A, gains)
            by_late = late.by_measured * of_latents
            by_effects[:, :W] += (of_torque * late.by_torque - late.by_predicted).transpose(1, 2, 0)
            by_effects[:, W] += late.by_demand.T
            by_effects += np.einsum("nml,pnl->nmp", A, by_late)
        residual += (A @ (corrected - now)[:, :, None])[:, :, 0]
        if late is not None:
            corrected = corrected + late.measured * of_latents
        if self._missing is not None:
            A[self._missing] = 0.0
            rows[self._missing] = 0.0
        weighed = inverse_covariance(A, variance, row_var, W) @ rows
        flat, weighed = rows.reshape(-1, rows.shape[2]), weighed.reshape(-1, rows.shape[2])
        return Linearisation(
            rows=flat,
            weighed=weighed,
            normal=flat.T @ weighed,
            by_latents=A,
            corrected=corrected,
            variance=variance,
            by_gain=latent_by_gain,
            by_late=by_late,
            off=at.off,
            load_slope=at.load_slope,
            load_by_slip=at.load_by_slip,
            load_by_soil=at.load_by_soil,
            load_by_effects=at.load_by_effects,
        )

    def late_residuals(self, late: DelayTerms | None, A: Array, gains: Array) -> Array:
        """What late readings are off (N, m) at gains (G,), A (N, m, 2 W + 1) the residuals' derivatives by latents."""
        residual, W = np.zeros(A.shape[:2]), self.n_wheels
        if late is not None:
            of_sensors = 1.0 / (1.0 + gains[: self.n_sensors])
            residual[:, :W] = late.torque * of_sensors[:W] - late.predicted
            residual[:, W] = late.demand
            residual += (A @ (late.measured * of_sensors[W:-1])[:, :, None])[:, :, 0]
            residual[~self._known] = 0.0
        return residual

    def variances(self, gains: Array) -> tuple[Array, Array]:
        """Variances of latents (N, 2 W + 1) and rows (N, m) at gains (G,)."""
        return self._corrected(gains)[4:]

    def torques(self, soil: Array, gains: Array, latents: Latents) -> Array:
        """Torques (N, W) [N m] of the model."""
        return np.asarray(self._response(Soil(*soil.tolist()), gains, latents).value[1])

    def _corrected(self, gains: Array) -> tuple[Array, Array, float, Array, Array, Array]:
        """Readings less their gain errors (G,): factors of torques, latents and draft; latents with variance; rows'.

        A sensor reads (1 + gain) times the truth, plus noise: readings are scaled back, and
        their noise with them, else a gain that makes everything smaller would seem to fit better.
        """
        W, of_sensors = self.n_wheels, 1.0 / (1.0 + gains[: self.n_sensors])
        of_torque, of_latents, of_draft = of_sensors[:W], of_sensors[W:-1], float(of_sensors[-1])
        row_var = self._row_var.copy()
        row_var[:, :W] *= of_torque**2
        row_var[:, W] += self.draft_var * (of_draft**2 - 1.0)
        return of_torque, of_latents, of_draft, self._measured * of_latents, self._measured_var * of_latents**2, row_var

    def standardised(self, at: Linearisation, gains: Array) -> tuple[Array, Array]:
        """Each residual given the others of its instant, over its std (N, m), and the derivatives (N, m, 6 + G).

        Rows of an instant: torque of each wheel, the draft balance, sinkage of each wheel
        where there are sensors; standard normal where model and noise are right, nan where
        there is no reading.
        """
        variance, row_var = self.variances(gains)
        inverse = inverse_covariance(at.by_latents, variance, row_var, self.n_wheels)
        root = np.sqrt(diagonals(inverse))
        weighed = at.weighed.reshape(*root.shape, -1) / root[:, :, None]
        weighed[~self._known] = np.nan
        return weighed[:, :, 0], weighed[:, :, 1:]

    def by_form(self, optimum: Optimum) -> tuple[Array, Array]:
        """Derivatives (R, 4) of the residuals by form.FORM at an optimum, and these weighed as `Linearisation`."""
        soil, gains, latents, at = Soil(*optimum.soil.tolist()), optimum.gains, optimum.latents, optimum.at
        W, (n, m) = self.n_wheels, at.by_latents.shape[:2]
        some = np.unique(np.linspace(0, n - 1, math.ceil(n / THINNED_FORM)).round().astype(int))
        by_form = _between(some, self.part(some)._contact_by_form(soil, gains, latents.part(some)), n)  # (3, 3, N, W)
        slip = 1.0 - latents.ground_speed[:, None] / (self.rig.radius * latents.speed)
        pull, torque, depth = np.concatenate([by_form[:, :1], by_form[:, :1] * slip, by_form[:, 1:]], axis=1)
        rows = np.zeros((n, m, len(pull)))
        rows[:, :W] = -torque.transpose(1, 2, 0)
        rows[:, W] = -pull.sum(2).T
        if self.with_sinkage:
            rows[:, W + 1 :] = -depth.transpose(1, 2, 0)
        rows[~self._known] = 0.0
        variance, row_var = self._corrected(gains)[4:]
        weighed = inverse_covariance(at.by_latents, variance, row_var, W) @ rows
        return rows.reshape(n * m, -1), weighed.reshape(n * m, -1)

    def _contact_by_form(self, soil: Soil, gains: Array, latents: Latents) -> Array:
        """Derivatives (3, 3, N, W) of drawbar pull, torque and sinkage of wheels that carry the latent loads.

        By the ratios of peak and exit angle, the latter behind the axle, and by the share of the other shear law.
        """
        shape, other = (self.n, self.n_wheels), 1.0
        state, model = self._wheels_in_contact(soil, gains, latents)
        if model.shear_law == "exponential":  # the same, with a share that can be taken away
            model, other = replace(model, shear_law="rational", exponential_share=1.0), -1.0
        _, d = wheel_forces_and_derivatives(state, model, ("peak", "leave", "exponential_share"))
        by_angle, by_form = d[:, 0].reshape(3, *shape), d[:, 7:].reshape(3, 3, *shape)
        by_form[:, 1] *= -1.0
        by_form[:, 2] *= other
        turned = -by_form[0] / by_angle[0]
        out = np.empty((3, 3, *shape))
        out[:2] = by_form[1:] + by_angle[1:, None] * turned
        out[2] = np.reshape(state.radius, (-1, self.n_wheels)) * np.sin(latents.entry_angle) * turned
        return out

    def _wheels_in_contact(self, soil: Soil, gains: Array, latents: Latents) -> tuple[WheelState, WheelModel]:
        """States and model of the wheels at these latents."""
        slip = 1.0 - latents.ground_speed[:, None] / (self.rig.radius * latents.speed)
        return self._state(soil, latents.entry_angle, slip), self.model

    def _response(self, soil: Soil, gains: Array, latents: Latents) -> Response:
        """The wheels with the entry angle eliminated: it follows the load."""
        shape, rim = (self.n, self.n_wheels), self.rig.radius * latents.speed
        carried = latents.ground_speed[:, None] / rim  # 1 - slip
        forces, d = wheel_forces_and_derivatives(self._state(soil, latents.entry_angle, 1.0 - carried), self.model)
        forces, d = forces.reshape(3, *shape), d.reshape(3, 7, *shape)
        slope, off = d[0, 0], latents.load - forces[0]
        load_by = self._by_slip_and_soil(d[0], soil)
        by = np.zeros((3, 7, *shape))
        by[0], by[1] = self._by_slip_and_soil(d[1], soil), self._by_slip_and_soil(d[2], soil)
        by_load = np.empty((3, *shape))
        np.divide(d[1:, 0], slope, out=by_load[:2])
        np.divide(self.rig.radius * np.sin(latents.entry_angle), slope, out=by_load[2])
        by -= by_load[:, None] * load_by
        value = by_load * off
        value[:2] += forces[1:]
        value[2] += sinkage(latents.entry_angle, self.rig.radius)
        return Response(
            value=value,
            by_load=by_load,
            by_speed=by[:, 0] * (carried / latents.speed),
            by_ground=by[:, 0] / -rim,
            by_soil=by[:, 1:],
            load_by_slip=load_by[0],
            load_by_soil=load_by[1:],
            load_by_effects=np.zeros((0, *shape)),
            load_slope=slope,
            off=off,
            by_effects=np.zeros((3, 0, *shape)),
            pull=np.zeros(self.n),
            pull_by_effects=np.zeros((0, self.n)),
        )

    def _by_slip_and_soil(self, d: Array, soil: Soil) -> Array:
        """Derivatives (7, N, W) by slip, k_c, k_phi, n, phi, c, K of one force from those by INPUTS."""
        out = np.empty(d.shape)
        out[0] = d[1]
        np.divide(d[2], self.rig.width, out=out[1])
        out[2:] = d[2:]
        out[4] *= 1.0 + np.tan(soil.phi) ** 2
        return out

    def _by_latents(self, at: Response) -> Array:
        """Derivatives A (N, m, 2 W + 1) of the residuals from those of DP, T and z."""
        N, W = self.n, self.n_wheels
        A = np.zeros((N, self._n_residuals, 2 * W + 1))
        by_load, by_speed, by_ground = -at.by_load, -at.by_speed, -at.by_ground
        A[:, W, :W], A[:, W, W : 2 * W], A[:, W, 2 * W] = by_load[0], by_speed[0], by_ground[0].sum(1)
        for kind, first in ((1, 0), (2, W + 1)) if self.with_sinkage else ((1, 0),):
            wheel_rows = A[:, first : first + W]
            diagonals(wheel_rows[:, :, :W])[:] = by_load[kind]
            diagonals(wheel_rows[:, :, W : 2 * W])[:] = by_speed[kind]
            wheel_rows[:, :, 2 * W] = by_ground[kind]
        return A

    def updated(self, at: Linearisation, latents: Latents, soil_step: Array, gain_step: Array) -> Latents:
        """Latents after a step (6,) of the soil and (G,) of the gains, by the linear model."""
        N, W = self.n, self.n_wheels
        left = (at.weighed @ np.concatenate([[1.0], soil_step, gain_step])).reshape(N, 1, at.by_latents.shape[1])
        new = at.corrected - at.variance * (left @ at.by_latents)[:, 0] - at.by_gain * gain_step[W : self.n_sensors - 1]
        if len(at.by_late):
            new += np.tensordot(gain_step[self.n_sensors :], at.by_late, 1)
        load, speed, ground = new[:, :W], new[:, W : 2 * W], new[:, 2 * W]
        slip_change = (latents.ground_speed[:, None] / latents.speed - ground[:, None] / speed) / self.rig.radius
        more = load - latents.load - at.load_by_slip * slip_change
        return Latents(
            load, speed, ground, self.stepped_entry_angle(at, latents.entry_angle, soil_step, gain_step, more)
        )

    def stepped_entry_angle(
        self, at: Linearisation, angle: Array, soil_step: Array, gain_step: Array, more_load: Any = 0.0
    ) -> Array:
        """Entry angles (N, W) after a step (6,) of the soil and (G,) of the gains, by the linear model.

        more_load (N, W) [N] is what wheels then carry besides, short of what a change of slip carries.
        """
        N, W = self.n, self.n_wheels
        change = more_load + at.off - (soil_step @ at.load_by_soil.reshape(6, -1)).reshape(N, W)
        if len(at.load_by_effects):
            change -= np.tensordot(gain_step[self.n_sensors :], at.load_by_effects, 1)
        low, high = angle * 0.6, np.minimum(angle * 1.6, MAX_ENTRY_ANGLE)
        return np.asarray(np.minimum(np.maximum(angle + change / at.load_slope, low), high))


def _between(some: NDArray[np.intp], values: Array, n: int) -> Array:
    """Values (..., S, W) at some of n instants (S,), the first and the last too, on straight lines (..., N, W)."""
    if len(some) == n:
        return values
    at = np.arange(n)
    after = np.minimum(np.searchsorted(some, at, side="right"), len(some) - 1)
    share = ((at - some[after - 1]) / (some[after] - some[after - 1]))[:, None]
    return np.asarray((1.0 - share) * values[..., after - 1, :] + share * values[..., after, :])


class DenoisedObservationModel(ObservationModel):
    """The problem near one of its optima, with latents as they are expected to be: only the entry angles follow."""

    def __init__(self, problem: ObservationModel, optimum: Optimum) -> None:
        self.__dict__.update(vars(problem))
        self._problem = problem
        W, fitted = problem.n_wheels, optimum.latents
        latents = np.concatenate([fitted.load, fitted.speed, fitted.ground_speed[:, None]], axis=1)
        self._expected = expected(latents, optimum.at.variance)
        load, speed, ground_speed = self._expected[:, :W], self._expected[:, W : 2 * W], self._expected[:, 2 * W]
        soil = Soil(*optimum.soil.tolist())
        self.latents = self.with_entry_angles(
            Latents(load, speed, ground_speed, fitted.entry_angle), soil, optimum.gains
        )
        self._by_noise = problem.linearise(soil, optimum.gains, self.latents).by_latents
        *_, variance, row_var = self._corrected(optimum.gains)
        self._inverse = inverse_covariance(self._by_noise, variance, row_var, W)

    def allowed(self, gains: Array) -> Array:
        """As the problem itself, like all that follows."""
        return self._problem.allowed(gains)

    def gain_bounds(self) -> tuple[Array, Array]:
        """Least and greatest value that each of the gains may have, (G,) each."""
        return self._problem.gain_bounds()

    def with_entry_angles(self, latents: Latents, soil: Soil, gains: Array | None = None) -> Latents:
        """The same latents with the entry angles at which this soil carries their loads."""
        return self._problem.with_entry_angles(latents, soil, gains)

    def sinkages(self, soil: Soil, gains: Array, latents: Latents) -> Array:
        """Sinkage [m] of each wheel at each instant (N, W)."""
        return self._problem.sinkages(soil, gains, latents)

    def linearise(self, soil: Soil, gains: Array, latents: Latents, by_sensors: bool = True) -> Linearisation:
        """Residuals and derivatives at the expected latents, weighed as at the optimum; updates leave these alone."""
        at = self._problem.linearise(soil, gains, latents, by_sensors)
        W, change = self.n_wheels, self._by_noise - at.by_latents
        rows = at.rows.reshape(*change.shape[:2], -1)
        rows[:, :, 0] += (change @ (at.corrected - self._expected)[:, :, None])[:, :, 0]
        if by_sensors:
            rows[:, :, 7 + W : 6 + self.n_sensors] -= change * at.by_gain[:, None, :]
        if len(at.by_late):
            rows[:, :, -len(at.by_late) :] += np.einsum("nml,pnl->nmp", change, at.by_late)
        weighed = (self._inverse @ rows).reshape(at.rows.shape)
        nothing = np.zeros_like(at.variance)
        return replace(
            at,
            weighed=weighed,
            normal=at.rows.T @ weighed,
            by_latents=self._by_noise,
            corrected=self._expected,
            variance=nothing,
            by_gain=nothing,
            by_late=at.by_late[:0],
        )


def expected(fitted: Array, variance: Array) -> Array:
    """Latents (N, L) as they are expected to be, given fits with noise of this variance (N, L).

    Best linear prediction from the window itself: whatever varies no more than noise does, in
    any direction, is the window's mean (singular values shrunk as by Gavish & Donoho 2017, IEEE
    Trans. Inf. Theory 63:2137, eq. 7).  What is known exactly stays as it is.
    """
    n = len(fitted)
    scale = np.sqrt(variance.mean(0))
    noisy = np.flatnonzero(scale > 0.0)
    mean = fitted.mean(0)
    left, size, right = np.linalg.svd((fitted - mean)[:, noisy] / scale[noisy], full_matrices=False)
    square, ratio = size**2 / n, len(noisy) / n
    kept = np.sqrt(np.maximum((square - ratio - 1.0) ** 2 - 4.0 * ratio, 0.0)) / np.maximum(square, 1e-300)
    kept[square <= (1.0 + np.sqrt(ratio)) ** 2] = 0.0
    calm = fitted.copy()
    calm[:, noisy] = mean[noisy] + (left * (size * kept)) @ right * scale[noisy]
    return calm


LOAD_ROUNDS, LITTLE_TURN = 6, 0.01
"""Steps to the entry angles that carry the loads, and the relative one that is the last."""
_LATENTS = ("entry_angle", "load", "speed", "ground_speed")
_SOIL = Soil._fields


_POWERS = tuple((i, j) for i in range(3) for j in range(5))
"""Powers of load and of slip through which torques go: within 0.1 % of the model's over a recording."""


class _Contact(NamedTuple):
    """Load, drawbar pull and torque between wheels and ground, sinkage (N, W), what effects depend on."""

    forces: Forces
    depth: Any
    around: Surroundings


class _Wheels(NamedTuple):
    """Wheels as the effects' hooks leave them, their sinkages (N, W), and what effects depend on."""

    state: WheelState
    model: WheelModel
    depth: Any
    around: Surroundings


class ObservationModelWithEffects(ObservationModel):
    """One window's data and the model with effects; `free` are the effects' parameters (P)."""

    def __init__(
        self,
        window: Window,
        rig: Rig,
        model: WheelModel,
        min_speed: float,
        max_turn: float = MAX_TURN,
        effects: Sequence[Effect] = (),
        free: Sequence[Free] = (),
    ) -> None:
        super().__init__(window, rig, model, min_speed, max_turn)
        self._complete(effects, free)

    def completed(self, effects: Sequence[Effect], free: Sequence[Free]) -> Self:
        """The same data under a model with these effects, and no others, with these parameters."""
        other = copy(self)
        other._complete(effects, free)
        return other

    def _complete(self, effects: Sequence[Effect], free: Sequence[Free]) -> None:
        self.effects, self.free = tuple(effects), tuple(free)
        self._named = {effect.name: effect for effect in self.effects}
        std = [float(f.std > 0.0) for f in self.free]
        self.gain_names = [*self.gain_names[: self.n_sensors], *(f.name for f in self.free)]
        self.gain_std = np.concatenate([self.gain_std[: self.n_sensors], std])

    def active(self, pulls: Array) -> list[Active]:
        """The effects with their values where the parameters are so many std (P,) from their prior values."""
        return active_at(self.effects, self.free, pulls, self.n_wheels)

    def allowed(self, gains: Array) -> Array:
        """Gains with the effects' parameters inside their ranges."""
        inside = [f.allowed(u) for f, u in zip(self.free, gains[self.n_sensors :].tolist(), strict=True)]
        return np.concatenate([gains[: self.n_sensors], inside])

    def gain_bounds(self) -> tuple[Array, Array]:
        """As WindowProblem; the effects' parameters stay inside their ranges."""
        low, high = super().gain_bounds()
        for i, f in enumerate(self.free, self.n_sensors):
            if f.std > 0.0:
                low[i], high[i] = (f.parameter.low - f.value) / f.std, (f.parameter.high - f.value) / f.std
        return low, high

    def with_entry_angles(self, latents: Latents, soil: Soil, gains: Array | None = None) -> Latents:
        """As WindowProblem; without gains the effects' parameters are at their prior values."""
        solved = np.isfinite(latents.entry_angle).all() and bool(self.effects)
        base = latents if solved else super().with_entry_angles(latents, soil, gains)
        if not self.effects:
            return base
        active = self.active(np.zeros(len(self.free)) if gains is None else gains[self.n_sensors :])
        angle = base.entry_angle

        def excess(angle: Array) -> Array:
            wheels = self._wheels(soil, active, base, angle)
            contact = self._contact(wheels, active, wheel_forces(wheels.state, wheels.model))
            return np.asarray(self._excess(contact, active, base))

        off = excess(angle)
        with np.errstate(all="ignore"):
            slope = (2.0 * soil.n + 1.0) * base.load  # of small angles, by the angle's logarithm
            for _ in range(LOAD_ROUNDS):
                step = np.where(slope > 0.0, -off / slope, 0.0)
                turned = np.clip(angle * np.exp(np.clip(step, -0.5, 0.5)), MIN_ENTRY_ANGLE, MAX_ENTRY_ANGLE * 0.98)
                if np.abs(step).max(initial=0.0) < LITTLE_TURN:
                    angle = turned
                    break
                still_off = excess(turned)
                along = (still_off - off) / np.log(turned / angle)  # where it tells nothing the last one serves
                slope = np.where((along > 0.0) & np.isfinite(along), along, slope)
                angle, off = turned, still_off
        return Latents(base.load, base.speed, base.ground_speed, angle)

    def sinkages(self, soil: Soil, gains: Array, latents: Latents) -> Array:
        """As WindowProblem, of the circles that the effects make of the wheels."""
        if not self.effects:
            return super().sinkages(soil, gains, latents)
        active = self.active(gains[self.n_sensors :])
        return np.broadcast_to(self._wheels(soil, active, latents, latents.entry_angle).depth, latents.load.shape)

    def _response(self, soil: Soil, gains: Array, latents: Latents) -> Response:
        if not self.effects:
            return super()._response(soil, gains, latents)
        pulls = gains[self.n_sensors :]
        active = varied_at(self.effects, self.free, pulls, self.n_wheels)
        varied = Latents(**{name: Dual(getattr(latents, name), {name: UNIT}) for name in _LATENTS})  # type: ignore[arg-type]
        wheels = self._wheels(_varied(soil), active, varied, varied.entry_angle)
        contact = self._contact(wheels, active, forces_along(wheels.state, wheels.model))
        load, drawbar, torque, depth = self._told(contact, active, varied)
        around = self._surroundings(latents)
        pull = self._pull(contact.forces[1].only(int), active, around)
        at, by_latents, by_soil, by_effects = _gathered(
            (load, drawbar, torque, depth), len(self.free), (self.n, self.n_wheels)
        )
        np.divide(by_soil[:, 1], self.rig.width, out=by_soil[:, 0])  # both act through K_L = k_c/b + k_phi
        pull_by_effects = np.zeros((len(self.free), self.n))
        for i in range(len(self.free)):
            pull_by_effects[i] = slope_of(pull, i)
        by_angle, by_load, by_speed, by_ground = by_latents.swapaxes(0, 1)
        slope, off = by_angle[0], -at[0]
        along = by_angle[1:] / slope  # what a load more turns into, by way of the entry angle

        def held(d: Array) -> Array:
            """Derivatives (3, ..., N, W) with the entry angle following the load."""
            return np.asarray(d[1:] - (along[:, None] if d.ndim == 4 else along) * d[0])

        value = at[1:] + along * off
        return Response(
            value=value,
            by_load=held(by_load),
            by_speed=held(by_speed),
            by_ground=held(by_ground),
            by_soil=held(by_soil),
            load_by_slip=by_speed[0] * self.rig.radius * latents.speed**2 / latents.ground_speed[:, None],
            load_by_soil=by_soil[0],
            load_by_effects=by_effects[0],
            load_slope=slope,
            off=off,
            by_effects=held(by_effects),
            pull=np.asarray(value_of(pull)),
            pull_by_effects=pull_by_effects,
        )

    def _wheels_in_contact(self, soil: Soil, gains: Array, latents: Latents) -> tuple[WheelState, WheelModel]:
        if not self.effects:
            return super()._wheels_in_contact(soil, gains, latents)
        wheels = self._wheels(soil, self.active(gains[self.n_sensors :]), latents, latents.entry_angle)
        return wheels.state, wheels.model

    def _wheels(self, soil: Soil, active: Sequence[Active], latents: Latents, angle: Array) -> _Wheels:
        """The wheels at given entry angles: these and the circles that effects make of the wheels give the sinkages."""
        slip = 1.0 - latents.ground_speed[:, None] / (self.rig.radius * latents.speed)
        K_L = lumped_modulus(soil.k_c, soil.k_phi, self.rig.width)
        state = WheelState(angle, slip, self.rig.radius, self.rig.width, K_L, soil.n, np.tan(soil.phi), soil.c, soil.K)
        around = self._surroundings(latents)
        state, model = wheel_with(active, state, self.model, around)
        return _Wheels(state, model, sinkage(angle, state.radius), around)

    def _contact(self, wheels: _Wheels, active: Sequence[Active], forces: Forces) -> _Contact:
        """What happens between wheels and ground, from the integrated forces."""
        forces = reactions_with(active, forces, wheels.state, wheels.around)
        return _Contact(forces, wheels.depth, wheels.around)

    def _excess(self, contact: _Contact, active: Sequence[Active], latents: Latents) -> Any:
        """Load (N, W) that the soil carries beyond what it must."""
        excess = contact.forces[0] - latents.load
        for effect, values in active:
            if effect.load is not None:
                excess = excess + effect.load(contact.around, values)
        return excess

    def _told(self, contact: _Contact, active: Sequence[Active], latents: Latents) -> tuple[Any, Any, Any, Any]:
        """Load that the soil carries beyond what it must, drawbar pull, torque reading and sinkage (N, W)."""
        _, pull, torque = contact.forces
        for effect, values in active:
            if effect.torque is not None:
                torque = effect.torque(torque, contact.around, values)
        return self._excess(contact, active, latents), pull, torque, contact.depth

    def _pull(self, pull: Dual, active: Sequence[Active], around: Surroundings) -> Any:
        """What the wheels, which pull so much (N, W), must pull besides what the readings ask for (N,) [N]."""
        missing, draft = self._unread(active, around, pull.sum(axis=1))
        return missing + draft - self.draft

    def _unread(self, active: Sequence[Active], around: Surroundings, pull: Any) -> tuple[Any, Any]:
        """Resistances (N,) in no reading, and drafts (N,) without what effects add to theirs.

        Both go by the draft and the acceleration that the whole balance tells, not by their
        readings: a reading's own noise beside the error that is proportional to it would
        make a greater draft, and a smaller mass, look better (errors in variables).
        """

        def resistance(around: Surroundings) -> Any:
            told = [effect.resistance(around, values) for effect, values in active if effect.resistance is not None]
            return sum(told, np.zeros(self.n))

        draft = true_draft(active, self.draft, around)
        off = self.demand - self.draft + draft + resistance(around) - pull
        by_draft, by_acceleration = self._shares
        told = around._replace(acceleration=around.acceleration - (by_acceleration * off)[:, None])
        errors = [(effect.draft, values) for effect, values in active if effect.draft is not None]
        if errors:
            true = draft - by_draft * off
            draft = self.draft - sum(error(true, told, values) for error, values in errors)
        return resistance(told), draft

    @property
    def _shares(self) -> tuple[Array, Array]:
        """What the noise of draft [1] and acceleration [1/kg] has of each newton that the balance is off (N,)."""
        mass = 0.0 if self.rig.chassis is None else self.rig.chassis.mass
        known = self.draft_var > 0.0
        by_draft, by_acceleration = (
            np.divide(variance, self.demand_var, out=np.zeros(self.n), where=known)
            for variance in (self.draft_var, mass * self.acceleration_var)
        )
        return by_draft, by_acceleration

    def lateness(self, gains: Array, latents: Latents, torque: Array) -> DelayTerms | None:
        """Of readings y that are late by d and a low pass of tau: x(t) = (1 + tau d/dt) y(t + d).

        y(t + d) is y(t) + s(t + d) - s(t) with the curve s of the readings (see local_cubics): the noise of an instant
        stays with it, else every delay would pair other noises and some would seem to fit better.  For torques, which
        the model predicts, the low pass goes over the prediction instead, and so do derivatives: slopes of readings
        have noise that would count as information.
        """
        places = {(f.effect, f.parameter.name): i for i, f in enumerate(self.free)}
        pulls, W, P = gains[self.n_sensors :], self.n_wheels, len(self.free)
        found: dict[str, tuple[Array, Array]] = {}
        predicted, by_predicted = self._nothing_late("torque", P)
        for effect in self.effects:
            for quantity, (delay, time_constant) in effect.late.items():
                at = places[effect.name, delay], places[effect.name, time_constant]
                if all(self.free[i].std == 0.0 and self.free[i].value == 0.0 for i in at):
                    continue
                added, by = found.setdefault(quantity, self._nothing_late(quantity, P))
                d, tau = (self.free[i].at(float(pulls[i])) for i in at)
                std, of_tau = (self.free[i].std for i in at)
                if quantity == "torque":
                    predicted, rate, by_tau = self._behind(tau, latents, torque)
                    by_predicted[at[0]], by_predicted[at[1]] = -std * rate, of_tau * by_tau
                    tau, std, of_tau = 0.0, 0.0, 0.0
                for column, series in enumerate(self._curves.of(quantity)):
                    curve = series.faithful if quantity == "torque" else series.smooth
                    value, slope, second = curve.at(self.t + d)
                    added[:, column] += np.nan_to_num(value - curve.at(self.t)[0] + tau * slope)
                    by[at[0], :, column] += std * np.nan_to_num(slope + tau * second)
                    by[at[1], :, column] += of_tau * np.nan_to_num(slope)
        if not found:
            return None
        read, load, ground, draft, pitch = (
            found.get(q) or self._nothing_late(q, P) for q in ("torque", "load", "ground_speed", "draft", "pitch")
        )
        measured, by_measured = np.zeros((self.n, 2 * W + 1)), np.zeros((P, self.n, 2 * W + 1))
        measured[:, :W], measured[:, 2 * W] = load[0] * self.usable, ground[0][:, 0]
        by_measured[:, :, :W], by_measured[:, :, 2 * W] = load[1] * self.usable, ground[1][:, :, 0]
        weight = 0.0 if self.rig.chassis is None else self.rig.chassis.mass * GRAVITY * np.cos(self.pitch)
        return DelayTerms(
            torque=read[0],
            measured=measured,
            demand=draft[0][:, 0] + weight * pitch[0][:, 0],
            predicted=predicted,
            by_torque=read[1],
            by_measured=by_measured,
            by_demand=draft[1][:, :, 0] + weight * pitch[1][:, :, 0],
            by_predicted=by_predicted,
        )

    def _behind(self, tau: float, latents: Latents, torque: Array) -> tuple[Array, Array, Array]:
        """What a low pass of tau [s] adds to the torques (N, W) of the model; the slope behind it; derivative by tau.

        Between the instants, and where some are left out, torques follow from the curves of loads and speeds: by a
        polynomial through the model's own torques over load and slip.
        """
        off, slope, by_tau = (np.zeros(torque.shape) for _ in range(3))
        loads, speeds, (ground,) = (
            [series.smooth for series in self._curves.of(q)] for q in ("load", "speed", "ground_speed")
        )
        slip = 1.0 - latents.ground_speed[:, None] / (self.rig.radius * latents.speed)
        for w, (load, speed) in enumerate(zip(loads, speeds, strict=True)):
            used = self.usable[:, w]
            if len(load.t) < 2 or np.count_nonzero(used) < 2 * len(_POWERS):
                continue
            states = np.stack([latents.load[used, w], slip[used, w]])
            rim = np.maximum(self.rig.radius[w] * speed.at(load.t)[0], 1e-3)
            way = np.clip(np.stack([load.value, 1.0 - ground.at(load.t)[0] / rim]).T, *np.sort(states)[:, [0, -1]].T)
            middle, size = states.mean(1)[:, None], np.maximum(states.std(1), 1e-9)[:, None]
            basis = _monomials((states - middle) / size)
            by_power = np.linalg.lstsq(basis, torque[used, w], rcond=None)[0]
            along = _monomials((way.T - middle) / size) @ by_power
            late = through_low_pass(load.t, along[:, None], tau)
            rate = (along[:, None] - late) / tau if tau > 0.0 else np.gradient(along, load.t)[:, None]
            behind = through_low_pass(load.t, rate, tau)
            off[:, w] = np.interp(self.t, load.t, late[:, 0] - along) * used
            slope[:, w] = np.interp(self.t, load.t, rate[:, 0]) * used
            by_tau[:, w] = -np.interp(self.t, load.t, behind[:, 0]) * used
        return off, slope, by_tau

    def _nothing_late(self, quantity: str, n_effects: int) -> tuple[Array, Array]:
        """Nothing (N, columns), with no derivatives (P, N, columns)."""
        columns = self._curves.number_of(quantity)
        return np.zeros((self.n, columns)), np.zeros((n_effects, self.n, columns))

    def _surroundings(self, latents: Latents) -> Surroundings:
        chassis = self.rig.chassis
        return Surroundings(
            t=self.since[:, None],
            distance=self.distance[:, None],
            load=latents.load,
            ground_speed=latents.ground_speed[:, None],
            wheel_speed=latents.speed,
            rear=~self.rig.front,
            draft=self.draft[:, None],
            acceleration=self.acceleration[:, None],
            mass=0.0 if chassis is None else chassis.mass,
            duration=self.duration,
            length=self.length,
        )


def _gathered(told: Sequence[Any], n_effects: int, shape: tuple[int, int]) -> tuple[Array, Array, Array, Array]:
    """Values (M, N, W), their derivatives by latents (M, 4, N, W), soil (M, 6, N, W) and parameters (M, P, N, W)."""
    kinds = (), (len(_LATENTS),), (len(_SOIL),), (n_effects,)
    at, by_latents, by_soil, by_effects = (np.zeros((len(told), *kind, *shape)) for kind in kinds)
    for i, one in enumerate(told):
        at[i] = value_of(one)
        for quantity, d in one.by.items() if isinstance(one, Dual) else ():
            if isinstance(quantity, int):
                by_effects[i, quantity] = d
            elif quantity in _LATENTS:
                by_latents[i, _LATENTS.index(quantity)] = d
            else:
                by_soil[i, _SOIL.index(quantity)] = d
    return at, by_latents, by_soil, by_effects


def _monomials(states: Array) -> Array:
    """Products (N, len(_POWERS)) of powers of load and slip (2, N)."""
    load, slip = ([value**i for i in range(most + 1)] for value, most in zip(states, _POWERS[-1], strict=True))
    return np.stack([load[i] * slip[j] for i, j in _POWERS], axis=1)


def _varied(soil: Soil) -> Soil:
    """A soil of which all but k_c carry derivatives by themselves."""
    varied = {name: Dual(getattr(soil, name), {name: UNIT}) for name in _SOIL[1:]}
    return soil._replace(**varied)  # type: ignore[arg-type]
