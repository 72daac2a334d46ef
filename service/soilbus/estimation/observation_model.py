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

A load that is computed stays at its prior; what it leaves open, A V A', is a weight that models share
(`with_weights_at`), and its noise by draft and inertia is that of the balance.  The difference left to right of two
wheels on a load cell of the axle, with a torque sensor each, is fitted: unequal loads held equal bias the soil.  Behind
an open differential T_left(W_left) = T_right(W_right) fixes it, as T = 0 fixes the slip of a free wheel.

`ObservationModel.linearise` returns r, its derivatives by soil and g, and S^-1 times both (`Linearisation`, columns and
rows as in `Layout`).  `observation_with_effects` adds effects to the wheel-soil model.
"""

from __future__ import annotations

import math
from copy import copy
from dataclasses import replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from soilbus.arrays import Array
from soilbus.estimation.linearisation import RESIDUAL, DelayTerms, Latents, Layout, Linearisation, Optimum, Response
from soilbus.estimation.measurements import Measurements
from soilbus.estimation.search_budget import Work
from soilbus.estimation.window import TIME_TOLERANCE, Rig, Window
from soilbus.terra.entry_angle import entry_angle_for_load
from soilbus.terra.wheel import (
    INPUTS,
    MAX_ENTRY_ANGLE,
    Soil,
    WheelModel,
    WheelState,
    sinkage,
    state_on,
    wheel_forces_and_derivatives,
)


class ObservationModel(Measurements):
    """One window's measurements and the wheel-soil model; `linearise` gives residuals and derivatives at any soil.

    min_speed, max_turn: as in `config.model.Estimator`.  The nuisance parameters, `gains` (G,), are the sensors'
    relative gain errors in the order of `gain_names`, then the effect parameters; `gain_bounds` (2, G) may be infinite.
    `work` counts evaluations.
    """

    def __init__(self, window: Window, rig: Rig, model: WheelModel, min_speed: float, max_turn: float = 0.15) -> None:
        super().__init__(window, rig, min_speed, max_turn)
        self.model = model
        self.work = Work()
        self.gain_bounds = np.full((2, len(self.gain_std)), [[-np.inf], [np.inf]])

    @property
    def layout(self) -> Layout:
        """Where rows, latents, gains and columns stand."""
        return Layout.of(self.n_wheels, self.n_sensors)

    def linearise(self, soil: Soil, gains: Array, latents: Latents, by_sensors: bool = True) -> Linearisation:
        """Residuals, their derivatives and their inverse covariance at one point, with the latents eliminated.

        gains (G,): sensor gains, then effect parameters; by_sensors: whether derivatives by the sensor gains are
        computed too.  A step of soil and gains moves the latents as `updated` says.
        """
        layout = self.layout if by_sensors else Layout.of(self.n_wheels, 0)
        torques, balance, sinkages = layout.torques, layout.balance, layout.sinkages
        self.work.instants += self.n
        at = self._mean_response(soil, gains, latents)
        rolling_slip = self._rolling_slip(at, latents)
        if self.rolls.any():
            at = at.rolling(self.rolls)
        A = self._by_observed(at)
        torque = self.torque_rows(at.value[1])

        of_torque, of_latents, of_draft, of_mass, corrected, variance, row_var = self._corrected(gains)
        delay = self.delay_terms(gains)
        draft, inertia = self.draft * of_draft, self.inertia * of_mass

        rows = np.zeros((*A.shape[:2], layout.effect_columns.start + len(gains) - self.n_sensors))
        residual, by_soil = rows[:, :, RESIDUAL], rows[:, :, layout.soil_columns]
        by_effects = rows[:, :, layout.effect_columns]
        extra, extra_by_effects = self.extra_pull(gains, latents)
        residual[:, torques], residual[:, balance] = self.torque * of_torque, inertia + draft + extra.sum(0)
        if self.with_sinkage:
            residual[:, sinkages] = self.sinkage
        predicted, by_soil[:], by_effects[:] = map(self._rows_of, (at.value, -at.by_soil, -at.by_effects))
        residual -= predicted
        by_effects[:, balance] += extra_by_effects.T
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
            late, of_rows = (A @ (delay.measured * of_latents)[:, :, None])[:, :, 0], np.append(of_torque, 1.0)
            late[:, : balance + 1] += delay.rows * of_rows
            residual += np.where(self.known, late, 0.0)
            by_delay = delay.by_measured * of_latents
            by_effects[:, : balance + 1] += (delay.by_rows * of_rows).transpose(1, 2, 0)
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
        # draft and inertia without their noise, which S^-1 r says: an error times noise would fit better when smaller
        noise = self.has_balance * (inverse[:, balance] * residual).sum(1)
        quiet, quiet_by_effects = self.extra_pull(gains, latents, noise)
        residual[:, balance] += self.has_balance * (quiet[1] - extra[1])
        by_effects[:, balance] += (self.has_balance * (quiet_by_effects - extra_by_effects)).T
        if by_sensors:
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
            response=at,
            rolling_slip=rolling_slip,
            side_load=side_load,
            by_sides=by_sides,
        )

    def _rows_of(self, forces: Array) -> Array:
        """Rows (N, m, ...) of an instant by pull, torque and sinkage of the wheels (3, ..., N, W)."""
        pull, torque, depth = forces
        parts = [self.torque_rows(torque), pull.sum(-1, keepdims=True), depth]
        rows = np.concatenate(parts[: 3 if self.with_sinkage else 2], axis=-1)
        return np.asarray(rows if rows.ndim == 2 else rows.transpose(1, 2, 0))

    def inverse_covariance(self, A: Array, variance: Array, row_var: Array) -> Array:
        """S^-1 (N, m, m) of every instant: `inverse_covariance`, and what computed loads bring; arguments as there."""
        if not self.computes_loads:
            return inverse_covariance(A, variance, row_var)
        balance, held = self.layout.balance, self.held_covariance
        further = self._by_load_noise(A, variance) if held is None else held.copy()
        known = self.has_balance & (self.demand_var > 0.0)
        for by, part in ((self.by_inertia, self.inertia_var), (self.by_draft, self.draft_var)):
            share = np.divide(part, self.demand_var, out=np.zeros(self.n), where=known)
            of_loads, noise = (A @ by[:, :, None])[:, :, 0], (share * row_var[:, balance])[:, None]
            further += of_loads[:, :, None] * (noise * of_loads)[:, None]
            further[:, balance] += noise * of_loads
            further[:, :, balance] += noise * of_loads
        return inverse_covariance(A, np.where(self._prior_only, 0.0, variance), row_var, further)

    def _by_load_noise(self, A: Array, variance: Array) -> Array:
        """Covariance (N, m, m) of the residuals by what is left open of computed loads."""
        of_loads = A[:, :, self._prior_only]
        return np.asarray((of_loads * variance[:, None, self._prior_only]) @ of_loads.swapaxes(1, 2))

    def with_weights_at(self, at: Linearisation) -> Self:
        """The same measurements with the covariance that computed loads bring held as at a linearisation.

        A V A' of a computed load is a weight; where it followed the model, one of larger A would seem to fit better
        (Carroll & Ruppert 1988, Transformation and Weighting in Regression, sect. 2.1).
        """
        held = copy(self)
        if self.computes_loads:
            held.held_covariance = self._by_load_noise(at.by_latents, at.variance)
        return held

    def extra_pull(self, gains: Array, latents: Latents, noise: Array | None = None) -> tuple[Array, Array]:
        """Pull [N] (2, N) that effects ask of the wheels beyond the measured demand, and its derivatives (P, N).

        The first is by masses and slopes, the second by errors of the draft.  noise (N,) [1/N]: S^-1 r of the balance,
        by which draft and acceleration lose their noise; None: as read.
        """
        return np.zeros((2, self.n)), np.zeros((len(gains) - self.n_sensors, self.n))

    def _side_load(self, A: Array, torque: Array, now: Array) -> Array:
        """Observations (N, S) of loads left less right after a Newton step from those `now` to equal torques (N, W)."""
        found = now[:, self._side_columns]
        off, most = self.torque_rows(torque), self.options.measurements.max_side_load
        for s, (row, column) in enumerate(self._sides):
            axle, slope = self._measured[:, column], -A[:, row, column]
            step = np.divide(-off[:, row], slope, out=np.zeros(self.n), where=slope > 0.0)
            found[:, s] += step * self._side_known[:, s]
            found[:, s] = np.clip(found[:, s], (1.0 - most) * axle, (1.0 + most) * axle)
        return found

    def _by_sides(self, A: Array) -> Array:
        """Derivatives (N, S, m) of the residuals by those of equal torques, through the side loads."""
        # With r_e the residual of equal torques and x the side load, r_e + (dr_e/dx) dx = 0 takes x out of every row:
        # r <- r - (dr/dx) / (dr_e/dx) r_e, and so of its derivatives (`_without_sides`).
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
        torque, limit = at.value[1][:, free], 0.05  # in one step: torque is curved within K over the contact's length
        step = np.where(by_slip > 0.0, -torque / np.where(by_slip > 0.0, by_slip, 1.0), -limit)
        most = self.options.measurements.max_rolling_skid
        return np.asarray(np.clip(1.0 - ratio + np.clip(step, -limit, limit), -most, 0.0))

    def _mean_response(self, soil: Soil, gains: Array, latents: Latents) -> Response:
        """The mean of an instant's response while slip swings, by two Gauss-Hermite nodes.

        They are one sd of each wheel's V / omega above and below its mean, in one evaluation of every instant twice.
        """
        if not self.swing.any():
            return self._response(soil, gains, latents)
        n, ratio = self.n, 1.0 + np.concatenate([self.swing, -self.swing])
        twice = Latents(*[np.concatenate([part, part]) for part in latents])
        at = self._response(soil, gains, twice._replace(speed=twice.speed / ratio))
        at = at._replace(by_speed=at.by_speed / ratio)
        return Response(*[0.5 * (part[..., :n, :] + part[..., n:, :]) for part in at])

    def _response(self, soil: Soil, gains: Array, latents: Latents) -> Response:
        """Response of the wheels with the entry angle eliminated: it follows from the latent load."""
        shape, rim = latents.load.shape, self.rig.radius * latents.speed
        speed_ratio = latents.ground_speed[:, None] / rim  # 1 - slip
        forces, d = wheel_forces_and_derivatives(self._state(soil, latents.entry_angle, 1.0 - speed_ratio), self.model)
        forces, d = forces.reshape(3, *shape), d.reshape(3, 7, *shape)
        slope, off = d[0, 0], latents.load - forces[0]
        given = np.empty(d.shape)  # by slip, k_c, k_phi, n, phi, c, K; d is by `wheel.INPUTS`
        given[:, 0], given[:, 2:] = d[:, 1], d[:, 2:]
        np.divide(d[:, 2], self.rig.width, out=given[:, 1])
        given[:, 4] *= 1.0 + math.tan(soil.phi) ** 2
        load_by, by = given[0], np.zeros(d.shape)
        by[:2] = given[1:]
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
        )

    def _by_observed(self, at: Response) -> Array:
        """Derivatives A (N, m, 2 W + 1) of the residuals by the observations of the latents."""
        layout = self.layout
        loads, speeds, ground, balance = layout.loads, layout.speeds, layout.ground_speed, layout.balance
        A = np.zeros((self.n, self._n_residuals, layout.n_latents))
        by_load, by_speed, by_ground = -at.by_load, -at.by_speed, -at.by_ground
        A[:, balance, loads], A[:, balance, speeds] = by_load[0], by_speed[0]
        A[:, balance, ground] = by_ground[0].sum(1)
        kinds = ((1, layout.torques), (2, layout.sinkages)) if self.with_sinkage else ((1, layout.torques),)
        for kind, rows in kinds:
            wheel_rows = A[:, rows]
            np.einsum("nww->nw", wheel_rows[:, :, loads])[:] = by_load[kind]
            np.einsum("nww->nw", wheel_rows[:, :, speeds])[:] = by_speed[kind]
            wheel_rows[:, :, ground] = by_ground[kind]
        if self._torque_matrix is None or self._from_observed is None:
            return A
        A[:, self.layout.torques] = self._torque_matrix @ A[:, self.layout.torques]
        return np.asarray(A @ self._from_observed)

    def _corrected(self, gains: Array) -> tuple[Array, Array, float, float, Array, Array, Array]:
        """Factors 1 / (1 + gain) of torques, latents, draft, mass; corrected latents; their variances; those of rows.

        Noise is divided by 1 + gain too; else a gain that makes everything smaller would seem to fit better.
        """
        layout = self.layout
        factors = 1.0 / (1.0 + gains[: layout.standing.start])
        of_torque, of_latents = factors[layout.torque_gains], factors[layout.latent_gains]
        of_draft = float(factors[layout.draft_gain])
        row_var = self._row_var.copy()
        row_var[:, layout.torques] *= of_torque**2
        of_mass = 1.0 if self._mass_gain is None else float(of_latents[self._mass_gain])
        row_var[:, layout.balance] += self.draft_var * (of_draft**2 - 1.0) + self.inertia_var * (of_mass**2 - 1.0)
        corrected, variance = self._measured * of_latents, self._measured_var * of_latents**2
        return of_torque, of_latents, of_draft, of_mass, corrected, variance, row_var

    def delay_terms(self, gains: Array) -> DelayTerms | None:
        """Corrections for delays at gains (G,); None without."""
        return None

    def updated(self, at: Linearisation, latents: Latents, soil_step: Array, gain_step: Array) -> Latents:
        """Latents at their conditional optimum after a step of the soil (6,) in SI and of gains (G,): the linear model.

        `at` is the linearisation at `latents`, with derivatives by the sensor gains.
        """
        layout = self.layout
        weighed = (at.weighed @ np.concatenate([[1.0], soil_step, gain_step])).reshape(self.n, 1, self._n_residuals)
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
        more = load - latents.load - at.response.load_by_slip * slip_change
        angle = self.stepped_entry_angle(at, latents.entry_angle, soil_step, gain_step, more)
        return Latents(load, speed, ground, angle)

    def _latents(self, joined: Array, entry_angle: Array) -> Latents:
        """Latents from loads, speeds and ground speed (N, 2 W + 1) and entry angles (N, W)."""
        at = self.layout
        return Latents(joined[:, at.loads], joined[:, at.speeds], joined[:, at.ground_speed], entry_angle)

    def stepped_entry_angle(
        self, at: Linearisation, angle: Array, soil_step: Array, gain_step: Array, more_load: Any = 0.0
    ) -> Array:
        """Entry angles (N, W) [rad] after a step (6,) of the soil and (G,) of the gains, by the linear model.

        more_load (N, W) [N] is the change of the latent loads less the part that the change of slip carries.
        """
        of, by_soil = at.response, at.response.load_by_soil.reshape(6, -1)
        change = more_load + of.load_residual - (soil_step @ by_soil).reshape(angle.shape)
        if len(of.load_by_effects):
            change -= np.tensordot(gain_step[self.layout.effects], of.load_by_effects, 1)
        return near_angle(angle, change / of.load_slope)

    def variances(self, gains: Array) -> tuple[Array, Array]:
        """Variances of latents (N, 2 W + 1) and rows (N, m) at gains (G,)."""
        return self._corrected(gains)[5:]

    def sinkages(self, soil: Soil, gains: Array, latents: Latents) -> Array:
        """Sinkage [m] (N, W) of the model, usable or not."""
        return np.asarray(sinkage(latents.entry_angle, self.rig.radius))

    def mean_sinkage(self, soil: Soil, gains: Array, latents: Latents) -> Array:
        """Mean sinkage [m] of each wheel (W,); nan for one never usable, or that MAX_ENTRY_ANGLE does not carry."""
        known, is_buried = self.usable.sum(0), latents.entry_angle >= MAX_ENTRY_ANGLE
        depth = np.where(is_buried, np.nan, self.sinkages(soil, gains, latents))
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(np.where(self.usable, depth, 0.0).sum(0) / known)

    def standardised(self, at: Linearisation) -> tuple[Array, Array]:
        """Each residual given the others of its instant, over its sd (N, m), and derivatives; nan where none.

        Standard normal where model and noise are right.
        """
        root = np.sqrt(np.einsum("nmm->nm", at.inverse))
        weighed = at.weighed.reshape(*root.shape, -1) / root[:, :, None]
        weighed[~self.known] = np.nan
        return weighed[:, :, 0], weighed[:, :, 1:]

    def by_form(self, optimum: Optimum) -> tuple[Array, Array]:
        """Derivatives (R, 4) of the residuals by `model_form.FORM` at an optimum, and these weighed by S^-1."""
        soil, gains, latents, at = Soil(*optimum.soil.tolist()), optimum.gains, optimum.latents, optimum.at
        n, m = at.by_latents.shape[:2]
        some = max(math.ceil(n / self.options.posterior.form_stride), 2)
        instants = np.unique(np.linspace(0, n - 1, some).round().astype(int))
        sparse = self._contact_by_form(soil, gains, latents, instants)
        place, number = np.interp(np.arange(n), instants, np.arange(len(instants))), np.arange(len(instants))[:, None]
        share = np.maximum(1.0 - np.abs(place - number), 0.0)  # linear between the instants
        by_form = np.einsum("fpsw,sn->fpnw", sparse, share)  # (3, 3, N, W)
        slip = 1.0 - latents.ground_speed[:, None] / (self.rig.radius * latents.speed)
        rows = -self._rows_of(np.concatenate([by_form[:, :1], by_form[:, :1] * slip, by_form[:, 1:]], axis=1))
        self._without_sides(rows, at.by_sides)
        rows[~self.known] = 0.0
        weighed = at.inverse @ rows
        return rows.reshape(n * m, -1), weighed.reshape(n * m, -1)

    def _contact_by_form(self, soil: Soil, gains: Array, latents: Latents, instants: NDArray[np.intp]) -> Array:
        """Derivatives (3, 3, S, W) of pull, torque, sinkage by peak and exit angle over entry angle, and shear law."""
        shape, other = (len(instants), self.n_wheels), 1.0
        state, model = self._wheels_in_contact(soil, gains, latents, instants)
        if model.shear_law == "exponential":  # the same law as a share of 1, which can be reduced
            model, other = replace(model, shear_law="rational", exponential_share=1.0), -1.0
        _, d = wheel_forces_and_derivatives(state, model, ("peak", "leave", "exponential_share"))
        d = d.reshape(3, -1, *shape)
        by_angle, by_slip, by_form = d[:, 0], d[:, 1], d[:, len(INPUTS) :]
        by_form[:, 1] *= -1.0
        by_form[:, 2] *= other
        by_load = by_angle / by_angle[0]
        of_sinkage = np.reshape(state.radius, (-1, self.n_wheels)) * np.sin(latents.entry_angle[instants]) / by_angle[0]
        held, held_slip = (
            np.concatenate([by[1:] - by_load[1:, None] * by[0], -of_sinkage * by[:1]])
            for by in (by_form, by_slip[:, None])
        )
        Response.eliminate_slip(held, held_slip[:, 0], self.rolls)
        return held

    def _wheels_in_contact(
        self, soil: Soil, gains: Array, latents: Latents, instants: NDArray[np.intp]
    ) -> tuple[WheelState, WheelModel]:
        """States and model of the wheels at some instants."""
        slip = 1.0 - latents.ground_speed[:, None] / (self.rig.radius * latents.speed)
        return self._state(soil, latents.entry_angle[instants], slip[instants]), self.model

    def _state(self, soil: Soil, angle: Array, slip: Array) -> WheelState:
        radius, width, length = self._geometry[:, : angle.size]
        return state_on(soil, angle.ravel(), slip.ravel(), radius, width, length)

    def start(self, soil: Soil, gains: Array | None = None) -> Latents:
        """Latents at their measured values, or on the curves of these; entry angles solved at soil and gains (G,)."""
        angle = np.full((self.n, self.n_wheels), np.nan)
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

        Entry angles of these follow, to first order, from the earlier instant at which the wheel carried most nearly
        the same.
        """
        shared, old, at = self._shared(previous.t), previous.latents, previous.at.response
        if not shared:
            return self.start(Soil(*previous.soil.tolist()), previous.gains)
        load, speed, ground = self.load[shared:], self.speed[shared:], self.ground_speed[shared:]
        near = np.abs(load[:, None] - old.load).argmin(axis=1), np.arange(self.n_wheels)
        slip_change = (old.ground_speed[:, None] / old.speed)[near] - ground[:, None] / speed
        more = load - old.load[near] + at.load_residual[near] - at.load_by_slip[near] * slip_change / self.rig.radius
        angle = near_angle(old.entry_angle[near], more / at.load_slope[near])
        new = Latents(load, speed, ground, angle)
        return Latents(*[np.concatenate([own[-shared:], other]) for own, other in zip(old, new, strict=True)])

    def _shared(self, t: Array) -> int:
        """Number of first instants that are the last ones of times t (M,) [s]."""
        n = len(t) - int(np.searchsorted(t, self.t[0] - TIME_TOLERANCE))
        return n if 0 < n < self.n and np.abs(self.t[:n] - t[-n:]).max() < TIME_TOLERANCE else 0


def near_angle(angle: Array, step: Array) -> Array:
    """Return entry angles [rad] after a step of the linear model, a factor within 0.6 and 1.6."""
    return np.asarray(np.clip(angle + step, angle * 0.6, np.minimum(angle * 1.6, MAX_ENTRY_ANGLE)))


def inverse_covariance(A: Array, variance: Array, row_var: Array, further: Array | None = None) -> Array:
    """Inverse covariance (A V A' + R + further)^-1 (N, m, m) of the residuals of every instant.

    A: derivatives of the residuals by the observations (N, m, 2 W + 1); variance (N, 2 W + 1) and row_var (N, m):
    diagonals of V and R.  Rows in N m, N and m are scaled by their sd before the inversion.
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
    except np.linalg.LinAlgError:  # one latent swamps all rows, which differ by rounding only (eps m = 1e-15)
        diagonal += 1e-10
        inverse = np.linalg.inv(S)
    return np.asarray(inverse * (scale[:, :, None] * scale[:, None, :]))
