"""Residuals of a window, weighed by the whole noise, and their derivatives.

At each instant the measured torques, the draft balance and (where there is a sensor) the
sinkages are compared with the model.  Wheel loads, wheel speeds and the ground speed are
measured too, with noise that travels through the model into every residual: they are
latent unknowns with the measurement as prior, eliminated instant by instant
(Gauss-Helmert model; cf. Foerstner & Wrobel, Photogrammetric Computer Vision, 2016,
sect. 4.8).  The entry angle of each wheel follows from its load.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from soilbus.estimation.linearised import Latents, Linearised, Optimum
from soilbus.estimation.readings import Readings
from soilbus.estimation.search_budget import Work
from soilbus.estimation.weights import diagonals, inverse_covariance
from soilbus.estimation.window import Rig, Window
from soilbus.terra.entry_angle import entry_angle_for_load
from soilbus.terra.stress import lumped_modulus
from soilbus.terra.wheel import (
    MAX_ENTRY_ANGLE,
    MIN_ENTRY_ANGLE,
    Soil,
    WheelModel,
    WheelState,
    sinkage,
    wheel_forces_and_derivatives,
)

Array = NDArray[np.float64]

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


class Lateness(NamedTuple):
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


class WindowProblem(Readings):
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

    def lateness(self, gains: Array, latents: Latents, torque: Array) -> Lateness | None:
        """Of gains (G,) and latents, with these torques (N, W) of the model; None where nothing is late."""
        return None

    def thinned(self, most: int) -> WindowProblem:
        """The same window with at most so many of its usable instants, evenly spread."""
        if self.n <= most:
            return self
        return self.part(np.linspace(0, self.n - 1, most).round().astype(int))

    def start(self, soil: Soil, guess: Array | None = None, gains: Array | None = None) -> Latents:
        """Latents at the measured values, entry angles solved for this soil (and gains) from a guess (N, W)."""
        angle = np.full((self.n, self.n_wheels), np.nan) if guess is None else guess
        return self.carried(Latents(self.load.copy(), self.speed.copy(), self.ground_speed.copy(), angle), soil, gains)

    def carried(self, latents: Latents, soil: Soil, gains: Array | None = None) -> Latents:
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

    def after(self, before: Optimum) -> tuple[Latents, Linearised]:
        """Latents and model of this window at the optimum of one that ends a little earlier.

        Instants that both share are taken over; the others are linearised at the measured
        values, with entry angles as loads and slips had them in the other window.
        """
        shared = self._shared(before.t)
        if before.at.by_latents.shape[1] != self._n_residuals:
            shared = 0
        new = self.part(slice(shared, None))
        start = new._measured_on(self._angle_curve(before.latents))
        at = new.linearise(Soil(*before.soil.tolist()), before.gains, start)
        if not shared:
            return start, at
        return before.latents.followed_by(shared, start), before.at.followed_by(shared, at)

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

    def linearise(self, soil: Soil, gains: Array, latents: Latents, by_sensors: bool = True) -> Linearised:
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
        return Linearised(
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

    def late_residuals(self, late: Lateness | None, A: Array, gains: Array) -> Array:
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

    def standardised(self, at: Linearised, gains: Array) -> tuple[Array, Array]:
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
        """Derivatives (R, 4) of the residuals by form.FORM at an optimum, and these weighed as `Linearised`."""
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

    def updated(self, at: Linearised, latents: Latents, soil_step: Array, gain_step: Array) -> Latents:
        """Latents after a step (6,) of the soil and (G,) of the gains, by the linear model."""
        N, W = self.n, self.n_wheels
        left = (at.weighed @ np.concatenate([[1.0], soil_step, gain_step])).reshape(N, 1, at.by_latents.shape[1])
        new = at.corrected - at.variance * (left @ at.by_latents)[:, 0] - at.by_gain * gain_step[W : self.n_sensors - 1]
        if len(at.by_late):
            new += np.tensordot(gain_step[self.n_sensors :], at.by_late, 1)
        load, speed, ground = new[:, :W], new[:, W : 2 * W], new[:, 2 * W]
        slip_change = (latents.ground_speed[:, None] / latents.speed - ground[:, None] / speed) / self.rig.radius
        more = load - latents.load - at.load_by_slip * slip_change
        return Latents(load, speed, ground, self.turned(at, latents.entry_angle, soil_step, gain_step, more))

    def turned(self, at: Linearised, angle: Array, soil_step: Array, gain_step: Array, more_load: Any = 0.0) -> Array:
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
