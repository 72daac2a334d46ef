"""Observation model of a window: residuals of torque, draft balance and sinkage, and their derivatives.

At each instant, with wheels w, soil, nuisance parameters g (sensor gains, effect parameters) and latents x
(wheel loads, wheel speeds, ground speed),

    r_T,w = T_w,measured / (1 + g_T,w) - T_w(soil, x)                      torque of each wheel [N m]
    r_D   = draft / (1 + g_D) + m (G sin(pitch) + a) - sum_w DP_w(soil, x)   draft balance [N]
    r_z,w = z_w,measured - z_w(soil, x)                                    sinkage of each wheel [m], if measured
    T_w(soil, s_w, x) = 0                                                  fixes the slip of a wheel that is not driven
    x     = x_measured / (1 + g_x) + noise with covariance V               measured too
    W_w(soil, entry angle_w, x) = load_w                                   fixes the entry angle of each wheel

The latents are eliminated instant by instant (Gauss-Helmert model; Foerstner & Wrobel, Photogrammetric
Computer Vision, 2016, sect. 4.8): with A = dr/dx and R the diagonal covariance of the rows,

    r <- r + A (x_measured / (1 + g_x) - x),    covariance  S = A V A' + R,    chi-square = sum r' S^-1 r.

A load that is computed, not measured, stays at its prior; what it leaves open, A V A', is a weight that models share
(`with_weights_at`), and its noise by draft and inertia is that of the balance.  Only the difference left to right of
two wheels on a load cell of the axle, with a torque sensor each, is fitted, as their torques measure it: torque and
pull are curved in the load, so that unequal loads held equal bias the soil.  Behind an open differential equal torques
and unequal slips say how they differ: T_left(W_left) = T_right(W_right) fixes the difference, as T = 0 fixes the slip
of a free wheel, and that row is used up.

`ObservationModel.linearise` returns r, its derivatives by soil and g, and S^-1 times both (`Linearisation`,
columns and rows as in `Layout`).  `ObservationModelWithEffects` adds effects to the wheel-soil model; effects
may also be delays of channels.
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
from soilbus.estimation.nuisance_parameters import Free, active_at, active_with_derivatives
from soilbus.estimation.window import TIME_TOLERANCE, Rig, Window
from soilbus.terra.dual import UNIT, Dual, slope_of, value_of
from soilbus.terra.effects.along import through_low_pass
from soilbus.terra.effects.effect import Active, Effect, Forces, Surroundings, reactions_with, true_draft, wheel_with
from soilbus.terra.entry_angle import entry_angle_for_load
from soilbus.terra.soil_laws import lumped_modulus
from soilbus.terra.tangent import forces_along
from soilbus.terra.vehicle import GRAVITY
from soilbus.terra.wheel import (
    INPUTS,
    MAX_ENTRY_ANGLE,
    MIN_ENTRY_ANGLE,
    Soil,
    WheelModel,
    WheelState,
    sinkage,
    wheel_forces,
    wheel_forces_and_derivatives,
)

RESIDUAL = 0
"""Column of `Linearisation.rows` with the residual."""
SOIL = slice(1, 1 + len(Soil._fields))
"""Columns with the derivatives by the soil parameters."""
FIRST_GAIN = SOIL.stop
"""Column of the first nuisance parameter: the sensor gains, then the effect parameters."""
_TORQUE_POWERS = tuple((i, j) for i in range(3) for j in range(5))
"""Powers of load and slip in the polynomial for torques: within 0.1 % of the model's over a recording."""
_DUAL_LATENTS = ("entry_angle", "load", "speed", "ground_speed")
_SOIL_NAMES = Soil._fields


class Layout(NamedTuple):
    """Named slices of the residuals of W wheels.

    rows of an instant (m): torques, balance, sinkages; latents (2 W + 1): loads, speeds, ground_speed.
    columns: RESIDUAL | SOIL | sensor_columns | effect_columns; within `gains` (G,): sensors (torque_gains,
    latent_gains in the order of the latents, draft_gain, standing as in `standing.STANDING`), then effects.
    """

    torques: slice
    balance: int
    sinkages: slice
    n_latents: int
    loads: slice
    speeds: slice
    ground_speed: int
    sensors: slice
    torque_gains: slice
    latent_gains: slice
    draft_gain: int
    standing: slice
    effects: slice
    sensor_columns: slice
    effect_columns: slice

    @classmethod
    def of(cls, W: int, n_sensors: int) -> Layout:
        """The slices for W wheels; without columns of the sensor gains where n_sensors is 0."""
        wheels, column = slice(W), FIRST_GAIN + n_sensors
        return cls(
            torques=wheels, balance=W, sinkages=slice(W + 1, None),
            n_latents=2 * W + 1, loads=wheels, speeds=slice(W, 2 * W), ground_speed=2 * W,
            sensors=slice(n_sensors), torque_gains=wheels, latent_gains=slice(W, 3 * W + 1),
            draft_gain=3 * W + 1, standing=slice(3 * W + 2, n_sensors), effects=slice(n_sensors, None),
            sensor_columns=slice(FIRST_GAIN, column),
            effect_columns=slice(column, None),
        )  # fmt: skip


@dataclass(slots=True)
class Work:
    """Counter of model evaluations, in instants."""

    instants: int = 0


class Latents(NamedTuple):
    """Latent unknowns of each instant: load [N], speed [rad/s], entry_angle [rad] (N, W); ground_speed [m/s] (N,)."""

    load: Array
    speed: Array
    ground_speed: Array
    entry_angle: Array

    def followed_by(self, shared: int, new: Latents) -> Latents:
        """The last `shared` instants of these, followed by `new`."""
        return Latents(*[np.concatenate([own[-shared:], other]) for own, other in zip(self, new, strict=True)])

    def joined(self) -> Array:
        """Loads, speeds and ground speed (N, 2 W + 1)."""
        return np.concatenate([self.load, self.speed, self.ground_speed[:, None]], axis=1)

    def part(self, instants: NDArray[np.intp] | NDArray[np.bool_]) -> Latents:
        """The latents of the given instants, in that order."""
        return Latents(*[own[instants] for own in self])


@dataclass(slots=True)
class Linearisation:
    """Residuals and their derivatives at one point, and the derivatives that update the latents.

    `rows` (R, 1 + 6 + G), R = N m, has the columns of `Layout`: residual, derivatives by the
    soil parameters (SI), by the sensor gains (left out with by_sensors=False) and by the
    effect parameters.  `weighed` is the inverse covariance of each instant times `rows`;
    `normal` = rows' weighed (1 + 6 + G, 1 + 6 + G) holds chi-square, half its gradient and
    the information.  Rows without a measurement are zero.
    """

    rows: Array
    weighed: Array
    normal: Array
    by_latents: Array  # (N, m, 2 W + 1) by the observations of the latents
    inverse: Array  # (N, m, m) inverse covariance of the rows of each instant
    corrected: Array  # (N, 2 W + 1) observations of the latents over 1 + gain
    variance: Array  # (N, 2 W + 1) variance of `corrected`
    by_gain: Array  # (N, 2 W + 1) minus the derivative of `corrected` by its own gain
    by_delay: Array  # (P, N, 2 W + 1) derivatives of `corrected` by the effect parameters; P = 0 without delays
    load_residual: Array  # (N, W) latent load less the model's load at the latent entry angle
    load_slope: Array  # (N, W) derivative of the model's load by the entry angle; the next three by slip, soil, effects
    load_by_slip: Array
    load_by_soil: Array  # (6, N, W)
    load_by_effects: Array  # (P, N, W)
    rolling_slip: Array  # (N, F) slips of the free wheels after a Newton step
    side_load: Array  # (N, S) loads left less right behind differentials after a Newton step
    by_sides: Array  # (N, S, m) derivatives of the rows by those of equal torques, which are used up for these loads

    @property
    def chi2(self) -> float:
        """Sum of squares of the whitened residuals."""
        return float(self.normal[0, 0])


@dataclass(slots=True)
class Optimum:
    """End point of a fit: soil (6,) in SI, gains (G,), latents at times t (N,) [s], and the linearisation there."""

    t: Array
    soil: Array
    gains: Array
    latents: Latents
    at: Linearisation


class Response(NamedTuple):
    """Drawbar pull [N], torque [N m] and sinkage [m], value (3, N, W), of wheels that carry the latent loads.

    by_load, by_speed, by_ground (3, N, W), by_soil (3, 6, N, W) and by_effects (3, P, N, W)
    are their derivatives by the latents, the soil parameters and the effect parameters.
    load_by_slip (N, W), load_by_soil (6, N, W), load_by_effects (P, N, W) and load_slope
    (N, W) are derivatives of the load at the latent entry angle, the last by that angle;
    load_residual (N, W) [N] is the latent load less the model's.  extra_pull (N,) [N] is the
    pull that effects ask of the wheels beyond the measured demand; extra_pull_by_effects
    (P, N) its derivatives.
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
    load_residual: Array
    by_effects: Array
    extra_pull: Array
    extra_pull_by_effects: Array

    def rolling(self, free: NDArray[np.bool_]) -> Response:
        """The response with the slips of free wheels (mask (W,)) eliminated by T = 0, to first order.

        y <- y - (dy/ds) / (dT/ds) T for pull and sinkage and all their derivatives; nothing depends on their speeds.
        """
        torque = self.by_speed[1][:, free]
        ratio = self.by_speed[:, :, free] / np.where(torque == 0.0, np.inf, torque)
        for values in (self.value, self.by_load):
            values[:, :, free] -= ratio * values[1][:, free]
        for values in (self.by_soil, self.by_effects):
            values[..., free] -= ratio[:, None] * values[1][..., free]
        self.by_speed[:, :, free] = 0.0
        self.by_ground[:, :, free] = 0.0
        return self


class DelayTerms(NamedTuple):
    """Corrections of the measurements for delays, and their derivatives by the P effect parameters.

    torque (N, W) [N m], measured (N, 2 W + 1) of the latents and demand (N,) [N] are the
    measurements without delay less those taken; by_torque (P, N, W), by_measured and
    by_demand are their derivatives.  predicted (N, W) [N m] is the model's torque after a low
    pass less that before; by_predicted (P, N, W) its derivatives.
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
    """One window's measurements and the wheel-soil model; `linearise` gives residuals and derivatives at any soil.

    Parameters
    ----------
    window : Window
        Bin means and variances.
    rig : Rig
        Wheels, geometry and sensor noise.
    model : WheelModel
        The wheel-soil model.
    min_speed : float
        Ground speed [m/s] up to which instants are left out.
    max_turn : float
        Relative difference of an axle's rim speeds above which instants are left out; as in `config.model.Estimator`.

    Notes
    -----
    The nuisance parameters, `gains` (G,) throughout, are the sensors' relative gain errors
    in the order of `gain_names`, then the effect parameters; `gain_bounds` (2, G) are the lowest and the highest
    values, infinite where there is none.  `work` counts evaluations.
    """

    def __init__(self, window: Window, rig: Rig, model: WheelModel, min_speed: float, max_turn: float = 0.15) -> None:
        super().__init__(window, rig, min_speed, max_turn)
        self.model = model
        self.work = Work()
        self.layout = Layout.of(self.n_wheels, self.n_sensors)
        self.gain_bounds = np.full((2, len(self.gain_std)), [[-np.inf], [np.inf]])

    def with_own_stamps(self) -> Self:
        """As `Measurements.with_own_stamps`; without effects."""
        stamped = super().with_own_stamps()
        stamped.layout = Layout.of(self.n_wheels, stamped.n_sensors)
        stamped.gain_bounds = np.full((2, stamped.n_sensors), [[-np.inf], [np.inf]])
        return stamped

    def linearise(self, soil: Soil, gains: Array, latents: Latents, by_sensors: bool = True) -> Linearisation:
        """Residuals, their derivatives and their inverse covariance at one point.

        Parameters
        ----------
        soil : Soil
            Six parameters in SI.
        gains : Array
            Sensor gains, then effect parameters (G,).
        latents : Latents
            Of all N instants.
        by_sensors : bool
            Whether derivatives by the sensor gains are computed too.

        Returns
        -------
        Linearisation
            With the latents eliminated: a step of soil and gains moves them as `updated` says.
        """
        layout = self.layout if by_sensors else Layout.of(self.n_wheels, 0)
        torques, balance, sinkages = layout.torques, layout.balance, layout.sinkages
        self.work.instants += self.n
        at = self._response(soil, gains, latents)
        rolling_slip = self._rolling_slip(at, latents)
        if self.rolls.any():
            at = at.rolling(self.rolls)
        A = self._by_observed(self._by_latents(at))
        torque = self.torque_rows(at.value[1])

        of_torque, of_latents, of_draft, of_mass, corrected, variance, row_var = self._corrected(gains)
        delay = self.delay_terms(gains, latents, at.value[1])
        draft, inertia = self.draft * of_draft, self.inertia * of_mass

        rows = np.zeros((*A.shape[:2], layout.effect_columns.start + len(gains) - self.n_sensors))
        residual, by_soil, by_effects = rows[:, :, RESIDUAL], rows[:, :, SOIL], rows[:, :, layout.effect_columns]
        residual[:, torques] = self.torque * of_torque - torque
        residual[:, balance] = inertia + draft + at.extra_pull - at.value[0].sum(1)
        by_soil[:, torques] = self.torque_rows(-at.by_soil[1]).transpose(1, 2, 0)
        by_soil[:, balance] = -at.by_soil[0].sum(2).T
        by_effects[:, torques] = self.torque_rows(-at.by_effects[1]).transpose(1, 2, 0)
        by_effects[:, balance] = (at.extra_pull_by_effects - at.by_effects[0].sum(2)).T
        if self.with_sinkage:
            residual[:, sinkages] = self.sinkage - at.value[2]
            by_soil[:, sinkages] = -at.by_soil[2].transpose(1, 2, 0)
            by_effects[:, sinkages] = -at.by_effects[2].transpose(1, 2, 0)
        standing = gains[self.layout.standing]
        corrected += self.standing_latents @ standing
        residual += self.standing_rows @ standing
        now = self.observed(latents.joined())
        latent_by_gain = now * of_latents
        if by_sensors:
            by_gain = rows[:, :, layout.sensor_columns]
            np.einsum("nww->nw", by_gain[:, torques, layout.torque_gains])[:] = -of_torque * torque
            np.multiply(A, -latent_by_gain[:, None, :], out=by_gain[:, :, layout.latent_gains])
            by_gain[:, :, layout.standing] = self.standing_rows + A @ self.standing_latents
        by_delay = np.zeros((0, *now.shape))
        if delay is not None:
            residual += self.delay_residuals(delay, A, gains)
            by_delay = delay.by_measured * of_latents
            by_effects[:, torques] += (of_torque * delay.by_torque - delay.by_predicted).transpose(1, 2, 0)
            by_effects[:, balance] += delay.by_demand.T
            by_effects += np.einsum("nml,pnl->nmp", A, by_delay)
        side_load = self._side_load(A, at.value[1], now)
        corrected[:, self._side_columns] = now[:, self._side_columns]
        residual += (A @ (corrected - now)[:, :, None])[:, :, 0]
        by_sides = self._by_sides(A)
        for values in (rows, A):
            self._without_sides(values, by_sides)
        if delay is not None:
            corrected = corrected + delay.measured * of_latents
        if self._missing is not None:
            A[self._missing] = 0.0
            rows[self._missing] = 0.0
        inverse = self.inverse_covariance(A, variance, row_var)
        if by_sensors:
            # draft and inertia without their noise, which S^-1 r says: a gain times noise would fit better when smaller
            noise = (inverse[:, balance] * residual).sum(1)
            true_draft = self.has_balance * (draft - self.draft_noise * of_draft**2 * noise)
            by_gain[:, balance, layout.draft_gain] = -of_draft * true_draft
            if self._mass_gain is not None:
                true_inertia = self.has_balance * (inertia - self.inertia_var * of_mass**2 * noise)
                by_gain[:, balance, layout.latent_gains][:, self._mass_gain] -= of_mass * true_inertia
        weighed = inverse @ rows
        flat, weighed = rows.reshape(-1, rows.shape[2]), weighed.reshape(-1, rows.shape[2])
        return Linearisation(
            rows=flat,
            weighed=weighed,
            normal=flat.T @ weighed,
            by_latents=A,
            inverse=inverse,
            corrected=corrected,
            variance=variance,
            by_gain=latent_by_gain,
            by_delay=by_delay,
            load_residual=at.load_residual,
            load_slope=at.load_slope,
            load_by_slip=at.load_by_slip,
            load_by_soil=at.load_by_soil,
            load_by_effects=at.load_by_effects,
            rolling_slip=rolling_slip,
            side_load=side_load,
            by_sides=by_sides,
        )

    def inverse_covariance(self, A: Array, variance: Array, row_var: Array) -> Array:
        """S^-1 (N, m, m) of every instant: `inverse_covariance`, and what computed loads bring.

        Parameters
        ----------
        A : Array
            Derivatives of the residuals by the observations (N, m, 2 W + 1).
        variance, row_var : Array
            From `variances`.
        """
        if not self.computes_loads:
            return inverse_covariance(A, variance, row_var)
        balance, held = self.layout.balance, self.held_covariance
        further = self._by_load_noise(A, variance) if held is None else held.copy()
        for by, share in zip((self.by_inertia, self.by_draft), self._demand_shares, strict=True):
            of_loads, noise = (A @ by[:, :, None])[:, :, 0], (share * row_var[:, balance])[:, None]
            further += of_loads[:, :, None] * (noise * of_loads)[:, None]
            further[:, balance] += noise * of_loads
            further[:, :, balance] += noise * of_loads
        return inverse_covariance(A, np.where(self._prior_only, 0.0, variance), row_var, further)

    def _by_load_noise(self, A: Array, variance: Array) -> Array:
        """Covariance (N, m, m) of the residuals by what is left open of computed loads."""
        of_loads = A[:, :, self._prior_only]
        return np.asarray((of_loads * variance[:, None, self._prior_only]) @ of_loads.swapaxes(1, 2))

    @property
    def _demand_shares(self) -> tuple[Array, Array]:
        """Shares of inertia and draft (N,) in the variance of the demand."""
        known = self.has_balance & (self.demand_var > 0.0)
        shares = (
            np.divide(v, self.demand_var, out=np.zeros(self.n), where=known) for v in (self.inertia_var, self.draft_var)
        )
        return next(shares), next(shares)

    def with_weights_at(self, at: Linearisation) -> Self:
        """The same measurements with the covariance that computed loads bring held as at a linearisation.

        A computed load has no noise of its own that tells it from what it should be: A V A' of it is a weight.  Where
        that followed the model, one of larger A would seem to fit better (generalised least squares: Carroll & Ruppert
        1988, Transformation and Weighting in Regression, sect. 2.1).  The same where all loads are measured.
        """
        held = copy(self)
        if self.computes_loads:
            held.held_covariance = self._by_load_noise(at.by_latents, at.variance)
        return held

    def _side_load(self, A: Array, torque: Array, now: Array) -> Array:
        """Observations (N, S) of loads left less right after a Newton step to equal torques.

        A: derivatives of the residuals by the observations; torque: of the wheels (N, W) [N m]; now: observations of
        the latents, in which equal loads are the axle's load.
        """
        found = now[:, self._side_columns]
        off, most = self.torque_rows(torque), self.options.measurements.max_side_load
        for s, (row, column) in enumerate(self._sides):
            axle, slope = self._measured[:, column], -A[:, row, column]
            step = np.divide(-off[:, row], slope, out=np.zeros(self.n), where=slope > 0.0)
            found[:, s] += step * self._side_known[:, s]
            found[:, s] = np.clip(found[:, s], (1.0 - most) * axle, (1.0 + most) * axle)
        return found

    def _by_sides(self, A: Array) -> Array:
        """Derivatives (N, S, m) of the residuals by those of equal torques, through the side loads; A (N, m, 2 W + 1).

        With r_e the residual of equal torques of two wheels and x their side load, r_e + (dr_e/dx) dx = 0 takes x out
        of every other row: r <- r - (dr/dx) / (dr_e/dx) r_e, and so of its derivatives (`_without_sides`).
        """
        by_sides = np.zeros((self.n, len(self._sides), A.shape[1]))
        for s, (row, column) in enumerate(self._sides):
            slope = np.where(self._side_known[:, s] & (A[:, row, column] != 0.0), A[:, row, column], np.inf)
            by_sides[:, s] = A[:, :, column] / slope[:, None]
        return by_sides

    def _without_sides(self, values: Array, by_sides: Array) -> None:
        """Take the side loads out of values (N, m, ...) of the rows, in place."""
        for s, (row, _) in enumerate(self._sides):
            values -= by_sides[:, s, :, None] * values[:, row][:, None, :]

    def _rolling_slip(self, at: Response, latents: Latents) -> Array:
        """Slips (N, F) of the F free wheels after one Newton step to T = 0."""
        free = self.rolls
        if not free.any():
            return np.zeros((self.n, 0))
        ratio = latents.ground_speed[:, None] / (self.rig.radius[free] * latents.speed[:, free])  # 1 - slip
        by_slip = at.by_speed[1][:, free] * latents.speed[:, free] / ratio
        return rolling_step(1.0 - ratio, at.value[1][:, free], by_slip, self.options.measurements.max_rolling_skid)

    def _response(self, soil: Soil, gains: Array, latents: Latents) -> Response:
        """Response of the wheels with the entry angle eliminated: it follows from the latent load."""
        shape, rim = (self.n, self.n_wheels), self.rig.radius * latents.speed
        speed_ratio = latents.ground_speed[:, None] / rim  # 1 - slip
        forces, d = wheel_forces_and_derivatives(self._state(soil, latents.entry_angle, 1.0 - speed_ratio), self.model)
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
            by_speed=by[:, 0] * (speed_ratio / latents.speed),
            by_ground=by[:, 0] / -rim,
            by_soil=by[:, 1:],
            load_by_slip=load_by[0],
            load_by_soil=load_by[1:],
            load_by_effects=np.zeros((0, *shape)),
            load_slope=slope,
            load_residual=off,
            by_effects=np.zeros((3, 0, *shape)),
            extra_pull=np.zeros(self.n),
            extra_pull_by_effects=np.zeros((0, self.n)),
        )

    def _by_slip_and_soil(self, d: Array, soil: Soil) -> Array:
        """Derivatives (7, N, W) of one force by slip, k_c, k_phi, n, phi, c, K from those by `wheel.INPUTS`."""
        out = np.empty(d.shape)
        out[0] = d[1]
        np.divide(d[2], self.rig.width, out=out[1])
        out[2:] = d[2:]
        out[4] *= 1.0 + np.tan(soil.phi) ** 2
        return out

    def _by_latents(self, at: Response) -> Array:
        """Derivatives A (N, m, 2 W + 1) of the residuals by the latents."""
        layout = self.layout
        loads, speeds, ground, balance = layout.loads, layout.speeds, layout.ground_speed, layout.balance
        A = np.zeros((self.n, self._n_residuals, layout.n_latents))
        by_load, by_speed, by_ground = -at.by_load, -at.by_speed, -at.by_ground
        A[:, balance, loads], A[:, balance, speeds], A[:, balance, ground] = (
            by_load[0],
            by_speed[0],
            by_ground[0].sum(1),
        )
        kinds = ((1, layout.torques), (2, layout.sinkages)) if self.with_sinkage else ((1, layout.torques),)
        for kind, rows in kinds:
            wheel_rows = A[:, rows]
            np.einsum("nww->nw", wheel_rows[:, :, loads])[:] = by_load[kind]
            np.einsum("nww->nw", wheel_rows[:, :, speeds])[:] = by_speed[kind]
            wheel_rows[:, :, ground] = by_ground[kind]
        return A

    def _by_observed(self, A: Array) -> Array:
        """Derivatives (N, m, 2 W + 1) of rows by observations, from those of the wheels' rows by their latents."""
        if self._torque_matrix is None or self._from_observed is None:
            return A
        A[:, self.layout.torques] = self._torque_matrix @ A[:, self.layout.torques]
        return np.asarray(A @ self._from_observed)

    def _corrected(self, gains: Array) -> tuple[Array, Array, float, float, Array, Array, Array]:
        """Factors 1 / (1 + gain) of torques, latents, draft, mass; corrected latents; their variances; those of rows.

        A sensor reads (1 + gain) times the truth, plus noise.  Measurements are divided by
        1 + gain and their noise too; else a gain that makes everything smaller would seem to
        fit better.
        """
        layout = self.layout
        gain_factors = 1.0 / (1.0 + gains[: layout.standing.start])
        of_torque, of_latents = gain_factors[layout.torque_gains], gain_factors[layout.latent_gains]
        of_draft = float(gain_factors[layout.draft_gain])
        row_var = self._row_var.copy()
        row_var[:, layout.torques] *= of_torque**2
        of_mass = 1.0 if self._mass_gain is None else float(of_latents[self._mass_gain])
        row_var[:, layout.balance] += self.draft_var * (of_draft**2 - 1.0) + self.inertia_var * (of_mass**2 - 1.0)
        corrected, variance = self._measured * of_latents, self._measured_var * of_latents**2
        return of_torque, of_latents, of_draft, of_mass, corrected, variance, row_var

    def delay_terms(self, gains: Array, latents: Latents, torque: Array) -> DelayTerms | None:
        """Corrections for delays at gains (G,) and latents; torque (N, W) [N m] is the model's.  None without."""
        return None

    def delay_residuals(self, delay: DelayTerms | None, A: Array, gains: Array) -> Array:
        """Part (N, m) of the residuals due to delays.

        Parameters
        ----------
        delay : DelayTerms or None
            From `delay_terms`.
        A : Array
            Derivatives of the residuals by the latents (N, m, 2 W + 1).
        gains : Array
            Sensor gains, then effect parameters (G,).
        """
        residual, layout = np.zeros(A.shape[:2]), self.layout
        if delay is not None:
            gain_factors = 1.0 / (1.0 + gains[: layout.standing.start])
            residual[:, layout.torques] = delay.torque * gain_factors[layout.torque_gains] - delay.predicted
            residual[:, layout.balance] = delay.demand
            residual += (A @ (delay.measured * gain_factors[layout.latent_gains])[:, :, None])[:, :, 0]
            residual[~self._known] = 0.0
        return residual

    def updated(self, at: Linearisation, latents: Latents, soil_step: Array, gain_step: Array) -> Latents:
        """Latents at their conditional optimum, or on their curves, after a step of soil and gains: the linear model.

        Parameters
        ----------
        at : Linearisation
            With derivatives by the sensor gains, at `latents`.
        latents : Latents
            Where `at` was linearised.
        soil_step, gain_step : Array
            (6,) in SI and (G,).
        """
        layout = self.layout
        weighed = (at.weighed @ np.concatenate([[1.0], soil_step, gain_step])).reshape(
            self.n, 1, at.by_latents.shape[1]
        )
        noise = self._off_curve
        if noise is None:
            noise = np.where(self._prior_only, 0.0, at.variance) * (weighed @ at.by_latents)[:, 0]
        new = at.corrected - noise - at.by_gain * gain_step[layout.latent_gains]
        new += self.standing_latents @ gain_step[layout.standing]
        if len(at.by_delay):
            new += np.tensordot(gain_step[layout.effects], at.by_delay, 1)
        new[:, self._side_columns] = at.side_load
        load, speed, ground, _ = self._latents(self.from_observed(new), latents.entry_angle)
        if self.rolls.any():
            speed = speed.copy()
            speed[:, self.rolls] = ground[:, None] / (self.rig.radius[self.rolls] * (1.0 - at.rolling_slip))
        slip_change = (latents.ground_speed[:, None] / latents.speed - ground[:, None] / speed) / self.rig.radius
        more = load - latents.load - at.load_by_slip * slip_change
        return Latents(
            load, speed, ground, self.stepped_entry_angle(at, latents.entry_angle, soil_step, gain_step, more)
        )

    def _latents(self, joined: Array, entry_angle: Array) -> Latents:
        """Latents from loads, speeds and ground speed (N, 2 W + 1) and entry angles (N, W)."""
        layout = self.layout
        return Latents(
            joined[:, layout.loads], joined[:, layout.speeds], joined[:, layout.ground_speed], entry_angle
        )  # fmt: skip

    def stepped_entry_angle(
        self, at: Linearisation, angle: Array, soil_step: Array, gain_step: Array, more_load: Any = 0.0
    ) -> Array:
        """Entry angles (N, W) [rad] after a step (6,) of the soil and (G,) of the gains, by the linear model.

        more_load (N, W) [N] is the change of the latent loads less the part that the change of slip carries.
        A step changes an angle by a factor within 0.6 and 1.6.
        """
        N, W = self.n, self.n_wheels
        change = more_load + at.load_residual - (soil_step @ at.load_by_soil.reshape(6, -1)).reshape(N, W)
        if len(at.load_by_effects):
            change -= np.tensordot(gain_step[self.layout.effects], at.load_by_effects, 1)
        low, high = angle * 0.6, np.minimum(angle * 1.6, MAX_ENTRY_ANGLE)
        return np.asarray(np.minimum(np.maximum(angle + change / at.load_slope, low), high))

    def allowed(self, gains: Array) -> Array:
        """Gains (G,) clipped to their ranges."""
        return np.asarray(np.clip(gains, *self.gain_bounds))

    def variances(self, gains: Array) -> tuple[Array, Array]:
        """Variances of latents (N, 2 W + 1) and rows (N, m) at gains (G,)."""
        return self._corrected(gains)[5:]

    def torques(self, soil: Array, gains: Array, latents: Latents) -> Array:
        """Torques (N, W) [N m] of the model at a soil (6,) in SI."""
        return np.asarray(self._response(Soil(*soil.tolist()), gains, latents).value[1])

    def sinkages(self, soil: Soil, gains: Array, latents: Latents) -> Array:
        """Sinkage [m] (N, W) of the model, usable or not."""
        return np.asarray(sinkage(latents.entry_angle, self.rig.radius))

    def mean_sinkage(self, soil: Soil, gains: Array, latents: Latents) -> Array:
        """Mean sinkage [m] of each wheel (W,); nan for one never usable, or that MAX_ENTRY_ANGLE does not carry."""
        known, is_buried = self.usable.sum(0), latents.entry_angle >= MAX_ENTRY_ANGLE
        depth = np.where(is_buried, np.nan, self.sinkages(soil, gains, latents))
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(np.where(self.usable, depth, 0.0).sum(0) / known)

    def standardised(self, at: Linearisation, gains: Array) -> tuple[Array, Array]:
        """Each residual given the others of its instant, over its sd, and its derivatives in the same units.

        Returns
        -------
        residual : Array
            (N, m), standard normal where model and noise are right; nan without a measurement.
        derivatives : Array
            (N, m, 6 + G).
        """
        variance, row_var = self.variances(gains)
        inverse = self.inverse_covariance(at.by_latents, variance, row_var)
        root = np.sqrt(np.einsum("nmm->nm", inverse))
        weighed = at.weighed.reshape(*root.shape, -1) / root[:, :, None]
        weighed[~self._known] = np.nan
        return weighed[:, :, 0], weighed[:, :, 1:]

    def by_form(self, optimum: Optimum) -> tuple[Array, Array]:
        """Derivatives (R, 4) of the residuals by `model_form.FORM` at an optimum, and these weighed by S^-1."""
        soil, gains, latents, at = Soil(*optimum.soil.tolist()), optimum.gains, optimum.latents, optimum.at
        layout, (n, m) = self.layout, at.by_latents.shape[:2]
        some = max(math.ceil(n / self.options.posterior.form_stride), 2)
        instants = np.unique(np.linspace(0, n - 1, some).round().astype(int))
        sparse = self.part(instants)._contact_by_form(soil, gains, latents.part(instants))
        by_form = _interpolated(instants, sparse, n)  # (3, 3, N, W)
        slip = 1.0 - latents.ground_speed[:, None] / (self.rig.radius * latents.speed)
        pull, torque, depth = np.concatenate([by_form[:, :1], by_form[:, :1] * slip, by_form[:, 1:]], axis=1)
        rows = np.zeros((n, m, len(pull)))
        rows[:, layout.torques] = self.torque_rows(-torque).transpose(1, 2, 0)
        rows[:, layout.balance] = -pull.sum(2).T
        if self.with_sinkage:
            rows[:, layout.sinkages] = -depth.transpose(1, 2, 0)
        self._without_sides(rows, at.by_sides)
        rows[~self._known] = 0.0
        weighed = at.inverse @ rows
        return rows.reshape(n * m, -1), weighed.reshape(n * m, -1)

    def _contact_by_form(self, soil: Soil, gains: Array, latents: Latents) -> Array:
        """Derivatives (3, 3, N, W) of drawbar pull, torque and sinkage by three form parameters, at the latent loads.

        The form parameters are the ratio of the angle of greatest stress to the entry angle, the
        ratio of the exit angle (positive behind the axle) to it, and the share of the other shear law.
        """
        shape, other = (self.n, self.n_wheels), 1.0
        state, model = self._wheels_in_contact(soil, gains, latents)
        if model.shear_law == "exponential":  # the same law as a share of 1, which can be reduced
            model, other = replace(model, shear_law="rational", exponential_share=1.0), -1.0
        _, d = wheel_forces_and_derivatives(state, model, ("peak", "leave", "exponential_share"))
        by_angle, by_form = d[:, 0].reshape(3, *shape), d[:, len(INPUTS) :].reshape(3, 3, *shape)
        by_form[:, 1] *= -1.0
        by_form[:, 2] *= other
        angle_by_form = -by_form[0] / by_angle[0]
        out = np.empty((3, 3, *shape))
        out[:2] = by_form[1:] + by_angle[1:, None] * angle_by_form
        out[2] = np.reshape(state.radius, (-1, self.n_wheels)) * np.sin(latents.entry_angle) * angle_by_form
        return out

    def _wheels_in_contact(self, soil: Soil, gains: Array, latents: Latents) -> tuple[WheelState, WheelModel]:
        """States and model of the wheels at the latents."""
        slip = 1.0 - latents.ground_speed[:, None] / (self.rig.radius * latents.speed)
        return self._state(soil, latents.entry_angle, slip), self.model

    def _state(self, soil: Soil, angle: Array, slip: Array) -> WheelState:
        K_L = lumped_modulus(soil.k_c, soil.k_phi, self._width)
        return WheelState(
            angle.ravel(), slip.ravel(), self._radius, self._width, K_L, soil.n, np.tan(soil.phi), soil.c, soil.K,
            self._length,
        )  # fmt: skip

    def start(self, soil: Soil, guess: Array | None = None, gains: Array | None = None) -> Latents:
        """Latents at their measured values, or on the curves of these; entry angles solved at soil and gains (G,).

        guess: entry angles (N, W) [rad] to begin with.
        """
        angle = np.full((self.n, self.n_wheels), np.nan) if guess is None else guess
        latents = Latents(self.load.copy(), self.speed.copy(), self.ground_speed.copy(), angle)
        if self._off_curve is not None:
            latents = self._latents(self.from_observed(self._measured - self._off_curve), angle)
        return self.with_entry_angles(latents, soil, gains)

    def with_entry_angles(self, latents: Latents, soil: Soil, gains: Array | None = None) -> Latents:
        """The same latents with the entry angles at which this soil carries their loads at gains (G,)."""
        slip = 1.0 - latents.ground_speed[:, None] / (self.rig.radius * latents.speed)
        state = self._state(soil, latents.entry_angle, slip)
        tolerance = self.options.measurements.load_tolerance
        angle = entry_angle_for_load(latents.load.ravel(), state, self.model, tolerance=tolerance)
        angle = angle.reshape(self.n, self.n_wheels)
        angle = np.where(np.isfinite(angle), angle, MAX_ENTRY_ANGLE * 0.98)
        return Latents(latents.load, latents.speed, latents.ground_speed, angle)

    def thinned(self, max_instants: int) -> ObservationModel:
        """The same window with at most `max_instants` of its usable instants, evenly spread."""
        if self.n <= max_instants:
            return self
        return self.part(np.linspace(0, self.n - 1, max_instants).round().astype(int))

    def after(self, previous: Optimum) -> Latents:
        """Latents of this window at the optimum of an earlier one: of the instants of both as there, else as measured.

        Parameters
        ----------
        previous : Optimum
            End point of the fit of the earlier window.
        """
        shared = self._shared(previous.t)
        new = self.part(slice(shared, None)).start(Soil(*previous.soil.tolist()), gains=previous.gains)
        return previous.latents.followed_by(shared, new) if shared else new

    def _shared(self, t: Array) -> int:
        """Number of first instants that are the last ones of times t (M,) [s]."""
        n = len(t) - int(np.searchsorted(t, self.t[0] - TIME_TOLERANCE))
        return n if 0 < n < self.n and np.abs(self.t[:n] - t[-n:]).max() < TIME_TOLERANCE else 0


class ObservationModelWithEffects(ObservationModel):
    """An observation model whose wheel-soil model has effects; `free` are the effects' P parameters.

    In `gains` they follow the sensor gains, standardised: (value - prior value) / prior sd,
    so zero with variance one before any data.  Soil, latents and parameters go through the
    effects' hooks with their derivatives (see terra.dual) in one integration.
    """

    def __init__(
        self,
        window: Window,
        rig: Rig,
        model: WheelModel,
        min_speed: float,
        max_turn: float = 0.15,
        effects: Sequence[Effect] = (),
        free: Sequence[Free] = (),
    ) -> None:
        super().__init__(window, rig, model, min_speed, max_turn)
        self._set_effects(effects, free)

    def with_effects(self, effects: Sequence[Effect], free: Sequence[Free]) -> Self:
        """The same measurements under a model with these effects alone and their free parameters."""
        other = copy(self)
        other._set_effects(effects, free)
        return other

    def _set_effects(self, effects: Sequence[Effect], free: Sequence[Free]) -> None:
        self.effects, self.free = tuple(effects), tuple(free)
        self._named = {effect.name: effect for effect in self.effects}
        std = [float(f.std > 0.0) for f in self.free]
        self.gain_names = [*self.gain_names[: self.n_sensors], *(f.name for f in self.free)]
        self.gain_std = np.concatenate([self._sensor_std(), std])
        bounds = np.array([f.bounds for f in self.free]).reshape(-1, 2)
        self.gain_bounds = np.hstack([self.gain_bounds[:, : self.n_sensors], bounds.T])

    def _sensor_std(self) -> Array:
        """Return the prior sd of the sensors' gains; a channel that an effect delays has no lateness beside it.

        Two shifts of opposite sign would leave a second difference, which takes up noise.
        """
        fitted = {(f.effect, f.parameter.name) for f in self.free if f.std > 0.0}
        late = [q for e in self.effects for q, names in e.late.items() if (e.name, names.delay) in fitted]
        names, std = [name.split(".") for name in self.gain_names[: self.n_sensors]], self.sensor_std.copy()
        for quantity in late:  # of torques the first one's: the others' may differ from it
            std[next((i for i, name in enumerate(names) if name[:2] == ["lateness", quantity]), len(std)) :][:1] = 0.0
        return std

    def active(self, standardised: Array) -> list[Active]:
        """The effects with their values at standardised parameters (P,)."""
        return active_at(self.effects, self.free, standardised, self.n_wheels)

    def _response(self, soil: Soil, gains: Array, latents: Latents) -> Response:
        if not self.effects:
            return super()._response(soil, gains, latents)
        standardised = gains[self.layout.effects]
        active = active_with_derivatives(self.effects, self.free, standardised, self.n_wheels)
        varied = Latents(**{name: Dual(getattr(latents, name), {name: UNIT}) for name in _DUAL_LATENTS})  # type: ignore[arg-type]
        wheels = self._wheels(_varied(soil), active, varied, varied.entry_angle)
        contact = self._contact(wheels, active, forces_along(wheels.state, wheels.model))
        load, drawbar, torque, depth = self._predicted(contact, active, varied)
        surroundings = self._surroundings(latents)
        pull = self._extra_pull(contact.forces[1].only(int), active, surroundings)
        at, by_latents, by_soil, by_effects = _gathered(
            (load, drawbar, torque, depth), len(self.free), (self.n, self.n_wheels)
        )
        np.divide(by_soil[:, 1], self.rig.width, out=by_soil[:, 0])  # both act through K_L = k_c/b + k_phi
        pull_by_effects = np.zeros((len(self.free), self.n))
        for i in range(len(self.free)):
            pull_by_effects[i] = slope_of(pull, i)
        by_angle, by_load, by_speed, by_ground = by_latents.swapaxes(0, 1)
        slope, off = by_angle[0], -at[0]
        by_carried_load = by_angle[1:] / slope  # derivatives by the load through the entry angle

        def held(d: Array) -> Array:
            """Derivatives (3, ..., N, W) with the entry angle following the load."""
            return np.asarray(d[1:] - (by_carried_load[:, None] if d.ndim == 4 else by_carried_load) * d[0])

        value = at[1:] + by_carried_load * off
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
            load_residual=off,
            by_effects=held(by_effects),
            extra_pull=np.asarray(value_of(pull)),
            extra_pull_by_effects=pull_by_effects,
        )

    def _wheels(self, soil: Soil, active: Sequence[Active], latents: Latents, angle: Array) -> _Wheels:
        """The wheels at entry angles (N, W) [rad], with the radii and sinkages that the effects give them."""
        slip = 1.0 - latents.ground_speed[:, None] / (self.rig.radius * latents.speed)
        K_L = lumped_modulus(soil.k_c, soil.k_phi, self.rig.width)
        state = WheelState(
            angle, slip, self.rig.radius, self.rig.width, K_L, soil.n, np.tan(soil.phi), soil.c, soil.K, self.rig.length
        )
        surroundings = self._surroundings(latents)
        state, model = wheel_with(active, state, self.model, surroundings)
        return _Wheels(state, model, sinkage(angle, state.radius), surroundings)

    def _contact(self, wheels: _Wheels, active: Sequence[Active], forces: Forces) -> _Contact:
        """Contact of wheels and ground, from the integrated forces."""
        forces = reactions_with(active, forces, wheels.state, wheels.surroundings)
        return _Contact(forces, wheels.depth, wheels.surroundings)

    def _excess_load(self, contact: _Contact, active: Sequence[Active], latents: Latents) -> Any:
        """Load [N] (N, W) that the soil carries in excess of the latent load."""
        excess = contact.forces[0] - latents.load
        for effect, values in active:
            if effect.load is not None:
                excess = excess + effect.load(contact.surroundings, values)
        return excess

    def _predicted(self, contact: _Contact, active: Sequence[Active], latents: Latents) -> tuple[Any, Any, Any, Any]:
        """Excess load [N], drawbar pull [N], predicted torque measurement [N m] and sinkage [m] (N, W)."""
        _, pull, torque = contact.forces
        for effect, values in active:
            if effect.torque is not None:
                torque = effect.torque(torque, contact.surroundings, values)
        return self._excess_load(contact, active, latents), pull, torque, contact.depth

    def _extra_pull(self, pull: Dual, active: Sequence[Active], surroundings: Surroundings) -> Any:
        """Pull [N] (N,) asked of the wheels beyond the measured demand; pull (N, W) [N] is the wheels' own."""
        missing, draft = self._unmeasured(active, surroundings, pull.sum(axis=1))
        return missing + draft - self.draft

    def _unmeasured(self, active: Sequence[Active], surroundings: Surroundings, pull: Any) -> tuple[Any, Any]:
        """Resistances [N] (N,) that no sensor measures, and drafts [N] (N,) less the sensor errors of effects.

        Both use the draft and the acceleration estimated from the whole balance, not their
        measurements: a measurement's own noise, beside an error proportional to it, would
        make a larger draft and a smaller mass fit better (errors in variables).
        """

        def resistance(surroundings: Surroundings) -> Any:
            parts = [
                effect.resistance(surroundings, values) for effect, values in active if effect.resistance is not None
            ]
            return sum(parts, np.zeros(self.n))

        draft = true_draft(active, self.draft, surroundings)
        off = self.inertia + draft + resistance(surroundings) - pull
        by_draft, by_acceleration = self._noise_shares
        estimated = surroundings._replace(acceleration=surroundings.acceleration - (by_acceleration * off)[:, None])
        errors = [(effect.draft, values) for effect, values in active if effect.draft is not None]
        if errors:
            true = draft - by_draft * off
            draft = self.draft - sum(error(true, estimated, values) for error, values in errors)
        return resistance(estimated), draft

    @property
    def _noise_shares(self) -> tuple[Array, Array]:
        """Shares of draft [1] and acceleration [1/kg] (N,) in a residual of 1 N of the balance, by their noise."""
        mass = 0.0 if self.rig.chassis is None else self.rig.chassis.mass
        known = self.draft_var > 0.0
        by_draft, by_acceleration = (
            np.divide(variance, self.demand_var, out=np.zeros(self.n), where=known)
            for variance in (self.draft_var, mass * self.acceleration_var)
        )
        return by_draft, by_acceleration

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

    def delay_terms(self, gains: Array, latents: Latents, torque: Array) -> DelayTerms | None:
        """Corrections for measurements y late by d and by a low pass of tau: x(t) = (1 + tau d/dt) y(t + d).

        Parameters
        ----------
        gains : Array
            Sensor gains, then effect parameters (G,).
        latents : Latents
            Of all N instants.
        torque : Array
            Torques of the model (N, W) [N m].

        Notes
        -----
        y(t + d) = s(t + d) + c (y(t) - s(t)) with the smooth curve s of the measurements (see
        local_cubics): the noise of an instant stays with it, and c keeps its variance.  Else every
        delay would pair other noises or cancel a part, and some would seem to fit better.
        Torques are predicted by the model: there the low pass and the derivatives act on the
        prediction, since slopes of measurements have noise that would count as information.
        """
        places = {(f.effect, f.parameter.name): i for i, f in enumerate(self.free)}
        standardised, P = gains[self.layout.effects], len(self.free)
        found: dict[str, tuple[Array, Array]] = {}
        predicted, by_predicted = np.zeros_like(torque), np.zeros((P, *torque.shape))
        for effect in self.effects:
            for quantity, (delay, time_constant) in effect.late.items():
                at = places[effect.name, delay], places[effect.name, time_constant]
                if all(self.free[i].std == 0.0 and self.free[i].value == 0.0 for i in at):
                    continue
                added, by = found.setdefault(quantity, self._no_delay(quantity, P))
                d, tau = (self.free[i].at(float(standardised[i])) for i in at)
                std, of_tau = (self.free[i].std for i in at)
                if quantity == "torque":
                    predicted, rate, by_tau = self._low_pass_terms(tau, latents, torque)
                    by_predicted[at[0]], by_predicted[at[1]] = -std * rate, of_tau * by_tau
                    tau, std, of_tau = 0.0, 0.0, 0.0
                for column, series in enumerate(self._curves.of(quantity)):
                    curve = series.smooth
                    _, slope, second = curve.at(self.t + d)
                    added[:, column] += np.nan_to_num(self.shifted(quantity, column, curve, d, tau))
                    by[at[0], :, column] += std * np.nan_to_num(slope + tau * second)
                    by[at[1], :, column] += of_tau * np.nan_to_num(slope)
        if not found:
            return None
        torques, load, ground, draft, pitch = (
            found.get(q) or self._no_delay(q, P) for q in ("torque", "load", "ground_speed", "draft", "pitch")
        )
        loads, speed = self.layout.loads, self.layout.ground_speed
        measured = np.zeros((self.n, self.layout.n_latents))
        by_measured = np.zeros((P, *measured.shape))
        measured[:, loads], measured[:, speed] = load[0] * self.usable, ground[0][:, 0]
        by_measured[:, :, loads], by_measured[:, :, speed] = load[1] * self.usable, ground[1][:, :, 0]
        weight = 0.0 if self.rig.chassis is None else self.rig.chassis.mass * GRAVITY * np.cos(self.pitch)
        if self._latent_matrix is not None:
            measured, by_measured = measured @ self._latent_matrix.T, by_measured @ self._latent_matrix.T
        return DelayTerms(
            torque=self.torque_rows(torques[0]),
            measured=measured,
            demand=draft[0][:, 0] + weight * pitch[0][:, 0],
            predicted=self.torque_rows(predicted),
            by_torque=self.torque_rows(torques[1]),
            by_measured=by_measured,
            by_demand=draft[1][:, :, 0] + weight * pitch[1][:, :, 0],
            by_predicted=self.torque_rows(by_predicted),
        )

    def _low_pass_terms(self, tau: float, latents: Latents, torque: Array) -> tuple[Array, Array, Array]:
        """Change [N m] of the model's torques (N, W) by a low pass of tau [s]; their slope after it; derivative by tau.

        Between instants and where some are left out, torques follow from the curves of loads
        and speeds by a polynomial in load and slip through the model's own torques.
        """
        off, slope, by_tau = (np.zeros(torque.shape) for _ in range(3))
        loads, speeds, (ground,) = (
            [series.smooth for series in self._curves.of(q)] for q in ("load", "speed", "ground_speed")
        )
        slip = 1.0 - latents.ground_speed[:, None] / (self.rig.radius * latents.speed)
        for w, (load, speed) in enumerate(zip(loads, speeds, strict=True)):
            used = self.usable[:, w]
            if len(load.t) < 2 or np.count_nonzero(used) < 2 * len(_TORQUE_POWERS):
                continue
            states = np.stack([latents.load[used, w], slip[used, w]])
            middle, size = states.mean(1)[:, None], np.maximum(states.std(1), 1e-9)[:, None]
            basis = _monomials((states - middle) / size)
            by_power = np.linalg.lstsq(basis, torque[used, w], rcond=None)[0]

            def along_at(latents: Array, w: int = w, states: Array = states, by_power: Array = by_power) -> Array:
                """Torques (N,) at load, speed and ground speed (3, N)."""
                rim = np.maximum(self.rig.radius[w] * latents[1], 1e-3)
                path = np.clip(np.stack([latents[0], 1.0 - latents[2] / rim]).T, *np.sort(states)[:, [0, -1]].T).T
                middle, size = states.mean(1)[:, None], np.maximum(states.std(1), 1e-9)[:, None]
                return np.asarray(_monomials((path - middle) / size) @ by_power)

            along = along_at(np.stack([load.value, speed.at(load.t)[0], ground.at(load.t)[0]]))
            filtered = through_low_pass(load.t, along[:, None], tau)
            rate = (along[:, None] - filtered) / tau if tau > 0.0 else np.gradient(along, load.t)[:, None]
            behind = through_low_pass(load.t, rate, tau)
            change = np.interp(self.t, load.t, filtered[:, 0] - along)
            curves = [("load", w, load), ("speed", w, speed), ("ground_speed", 0, ground)]
            smooth = np.stack([curve.at(self.t)[0] for _, _, curve in curves])
            noisy = smooth.copy()
            for row, (quantity, column, curve) in zip(noisy, curves, strict=True):  # noise stays as large as it is
                kept = self.kept_noise(quantity, column, curve, 0.0, 0.0, tau)
                row += (kept - 1.0) * np.nan_to_num(self.off_curve(quantity, column, curve))
            change += along_at(noisy) - along_at(smooth)
            off[:, w] = np.nan_to_num(change) * used
            slope[:, w] = np.interp(self.t, load.t, rate[:, 0]) * used
            by_tau[:, w] = -np.interp(self.t, load.t, behind[:, 0]) * used
        return off, slope, by_tau

    def _no_delay(self, quantity: str, n_effects: int) -> tuple[Array, Array]:
        """Zero corrections (N, columns) and derivatives (P, N, columns)."""
        columns = self._curves.number_of(quantity)
        return np.zeros((self.n, columns)), np.zeros((n_effects, self.n, columns))

    def with_entry_angles(self, latents: Latents, soil: Soil, gains: Array | None = None) -> Latents:
        """As `ObservationModel.with_entry_angles`; without gains the effect parameters are at their prior values."""
        solved = np.isfinite(latents.entry_angle).all() and bool(self.effects)
        base = latents if solved else super().with_entry_angles(latents, soil, gains)
        if not self.effects:
            return base
        active = self.active(np.zeros(len(self.free)) if gains is None else gains[self.layout.effects])
        angle = base.entry_angle

        def excess(angle: Array) -> Array:
            wheels = self._wheels(soil, active, base, angle)
            contact = self._contact(wheels, active, wheel_forces(wheels.state, wheels.model))
            return np.asarray(self._excess_load(contact, active, base))

        off = excess(angle)
        with np.errstate(all="ignore"):
            slope = (2.0 * soil.n + 1.0) * base.load  # by the angle's logarithm, for small angles; then secants
            for _ in range(6):
                step = np.where(slope > 0.0, -off / slope, 0.0)
                new_angle = np.clip(angle * np.exp(np.clip(step, -0.5, 0.5)), MIN_ENTRY_ANGLE, MAX_ENTRY_ANGLE * 0.98)
                if np.abs(step).max(initial=0.0) < 0.01:
                    angle = new_angle
                    break
                new_excess = excess(new_angle)
                secant = (new_excess - off) / np.log(new_angle / angle)  # where not positive the last slope stays
                slope = np.where((secant > 0.0) & np.isfinite(secant), secant, slope)
                angle, off = new_angle, new_excess
        return Latents(base.load, base.speed, base.ground_speed, angle)

    def sinkages(self, soil: Soil, gains: Array, latents: Latents) -> Array:
        """As `ObservationModel.sinkages`, with the radii that the effects give the wheels."""
        if not self.effects:
            return super().sinkages(soil, gains, latents)
        active = self.active(gains[self.layout.effects])
        return np.broadcast_to(self._wheels(soil, active, latents, latents.entry_angle).depth, latents.load.shape)

    def _wheels_in_contact(self, soil: Soil, gains: Array, latents: Latents) -> tuple[WheelState, WheelModel]:
        if not self.effects:
            return super()._wheels_in_contact(soil, gains, latents)
        wheels = self._wheels(soil, self.active(gains[self.layout.effects]), latents, latents.entry_angle)
        return wheels.state, wheels.model


class _Contact(NamedTuple):
    """Load [N], drawbar pull [N] and torque [N m] between wheels and ground, sinkage [m] (N, W), surroundings."""

    forces: Forces
    depth: Any
    surroundings: Surroundings


class _Wheels(NamedTuple):
    """Wheel states and model after the effects' `wheel` hooks, sinkages [m] (N, W), surroundings."""

    state: WheelState
    model: WheelModel
    depth: Any
    surroundings: Surroundings


def _gathered(predicted: Sequence[Any], n_effects: int, shape: tuple[int, int]) -> tuple[Array, Array, Array, Array]:
    """Values (M, N, W), their derivatives by latents (M, 4, N, W), soil (M, 6, N, W) and parameters (M, P, N, W)."""
    kinds = (), (len(_DUAL_LATENTS),), (len(_SOIL_NAMES),), (n_effects,)
    at, by_latents, by_soil, by_effects = (np.zeros((len(predicted), *kind, *shape)) for kind in kinds)
    for i, one in enumerate(predicted):
        at[i] = value_of(one)
        for quantity, d in one.by.items() if isinstance(one, Dual) else ():
            if isinstance(quantity, int):
                by_effects[i, quantity] = d
            elif quantity in _DUAL_LATENTS:
                by_latents[i, _DUAL_LATENTS.index(quantity)] = d
            else:
                by_soil[i, _SOIL_NAMES.index(quantity)] = d
    return at, by_latents, by_soil, by_effects


def _monomials(states: Array) -> Array:
    """Products (N, len(_TORQUE_POWERS)) of powers of load and slip (2, N)."""
    load, slip = (
        [value**i for i in range(highest + 1)] for value, highest in zip(states, _TORQUE_POWERS[-1], strict=True)
    )
    return np.stack([load[i] * slip[j] for i, j in _TORQUE_POWERS], axis=1)


def _varied(soil: Soil) -> Soil:
    """The soil with derivatives by each parameter but k_c, whose derivative is that of k_phi over the width."""
    varied = {name: Dual(getattr(soil, name), {name: UNIT}) for name in _SOIL_NAMES[1:]}
    return soil._replace(**varied)  # type: ignore[arg-type]


def rolling_step(slip: Array, torque: Array, by_slip: Array, most: float) -> Array:
    """Slips (N, F) of free wheels after one Newton step towards zero torque [N m]; most: greatest skid [1]."""
    limit = 0.05  # in one step: the torque is curved within K over the contact's length of zero
    step = np.where(by_slip > 0.0, -torque / np.where(by_slip > 0.0, by_slip, 1.0), -limit)
    return np.asarray(np.clip(slip + np.clip(step, -limit, limit), -most, 0.0))


SINGULAR_RIDGE = 1e-10
"""Added to the squares of rows in their sd where these are linearly dependent within rounding (eps m = 1e-15)."""


def inverse_covariance(A: Array, variance: Array, row_var: Array, further: Array | None = None) -> Array:
    """Inverse covariance (A V A' + R)^-1 (N, m, m) of the residuals of every instant.

    Parameters
    ----------
    A : Array
        Derivatives of the residuals by the observations (N, m, 2 W + 1).
    variance, row_var : Array
        Diagonals of V (N, 2 W + 1) and R (N, m): variances of observations and rows.
    further : Array, optional
        Covariance (N, m, m) besides.

    Notes
    -----
    Rows are in N m, N and m; they are scaled by their sd before the inversion.  At a trial point far from any soil one
    latent may swamp all rows, which then differ by rounding only: SINGULAR_RIDGE keeps that a point of finite cost.
    """
    S = (A * variance[:, None, :]) @ A.swapaxes(1, 2)
    diagonal = np.einsum("nmm->nm", S)  # a view
    diagonal += row_var
    if further is not None:
        S += further
    scale = 1.0 / np.sqrt(diagonal)
    S *= scale[:, :, None] * scale[:, None, :]
    try:
        inverse = np.linalg.inv(S)
    except np.linalg.LinAlgError:
        diagonal += SINGULAR_RIDGE
        inverse = np.linalg.inv(S)
    return np.asarray(inverse * (scale[:, :, None] * scale[:, None, :]))


def _interpolated(instants: NDArray[np.intp], values: Array, n: int) -> Array:
    """Linear interpolation (..., N, W) of values (..., S, W) at S of n instants, the first and the last among them."""
    if len(instants) == n:
        return values
    at = np.arange(n)
    after = np.minimum(np.searchsorted(instants, at, side="right"), len(instants) - 1)
    share = ((at - instants[after - 1]) / (instants[after] - instants[after - 1]))[:, None]
    return np.asarray((1.0 - share) * values[..., after - 1, :] + share * values[..., after, :])
