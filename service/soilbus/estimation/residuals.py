"""Residuals of a window, weighed by the whole noise, and their derivatives.

At each instant the measured torques, the draft balance and (where there is a sensor) the
sinkages are compared with the model.  Wheel loads, wheel speeds and the ground speed are
measured too, with noise that travels through the model into every residual: they are
latent unknowns with the measurement as prior, eliminated instant by instant
(Gauss-Helmert model; cf. Foerstner & Wrobel, Photogrammetric Computer Vision, 2016,
sect. 4.8).  The entry angle of each wheel follows from its load.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from soilbus.estimation.weights import diagonals, inverse_covariance
from soilbus.estimation.window import Rig, Window
from soilbus.terra.stress import lumped_modulus
from soilbus.terra.vehicle import GRAVITY
from soilbus.terra.wheel import (
    MAX_ENTRY_ANGLE,
    MIN_ENTRY_ANGLE,
    Soil,
    WheelModel,
    WheelState,
    entry_angle_for_load,
    sinkage,
    wheel_forces_and_derivatives,
)

Array = NDArray[np.float64]
Reading = tuple[Array, Array, NDArray[np.bool_]]
"""Values, variances of them, and which of them are known; zero where not."""

MAX_SLIP = 0.98
MIN_SLIP = -1.0
START_TOLERANCE = 0.02
"""Relative error of load left in the first entry angles; each linearisation mends it further."""
SAME_INSTANT = 1e-3
"""Times [s] closer than this are those of one bin."""
GAIN_QUANTITIES = ("torque", "load", "speed", "ground_speed", "draft")


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


@dataclass(slots=True)
class Linearised:
    """Residuals and derivatives at one point, with what an update of the latents needs.

    The columns of `rows` and `weighed` (R, 1 + 6 + G) are the residual and its derivatives
    by the soil parameters (SI) and the gains; `weighed` is `rows` times the inverse
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
    off: Array  # (N, W) latent load less the model's
    load_slope: Array  # (N, W) dW/d entry angle
    load_by_slip: Array
    load_by_soil: Array  # (6, N, W)

    @property
    def chi2(self) -> float:
        """Sum of squares of the whitened residuals."""
        return float(self.normal[0, 0])

    def followed_by(self, shared: int, new: Linearised) -> Linearised:
        """The last `shared` instants of this and then those of another, linearised at the same soil and gains."""
        first = len(self.off) - shared
        row = first * self.by_latents.shape[1]
        rows, weighed = (np.concatenate([a[row:], b]) for a, b in ((self.rows, new.rows), (self.weighed, new.weighed)))
        return Linearised(
            rows=rows,
            weighed=weighed,
            normal=rows.T @ weighed,
            by_latents=np.concatenate([self.by_latents[first:], new.by_latents]),
            corrected=np.concatenate([self.corrected[first:], new.corrected]),
            variance=np.concatenate([self.variance[first:], new.variance]),
            by_gain=np.concatenate([self.by_gain[first:], new.by_gain]),
            off=np.concatenate([self.off[first:], new.off]),
            load_slope=np.concatenate([self.load_slope[first:], new.load_slope]),
            load_by_slip=np.concatenate([self.load_by_slip[first:], new.load_by_slip]),
            load_by_soil=np.concatenate([self.load_by_soil[:, first:], new.load_by_soil], axis=1),
        )


@dataclass(slots=True)
class Optimum:
    """Where a fit ended: soil (6,) in SI, gains (G,), latents of the instants t (N,), and the model there."""

    t: Array
    soil: Array
    gains: Array
    latents: Latents
    at: Linearised


_BY_INSTANT = (
    "t", "usable", "torque", "torque_var", "has_torque", "sinkage", "sinkage_var", "has_sinkage", "load", "load_var",
    "speed", "speed_var", "ground_speed", "ground_speed_var", "slip", "draft", "draft_var", "demand", "demand_var",
    "has_balance", "_measured", "_measured_var", "_row_var", "_known",
)  # fmt: skip
"""Attributes of a window's problem with a row for each instant."""


class WindowProblem:
    """One window's data with masks, ready to be linearised at any soil."""

    def __init__(self, window: Window, rig: Rig, model: WheelModel, min_speed: float) -> None:
        self.rig, self.model = rig, model
        n_wheels = len(rig.wheels)
        moving = window.ground_speed > min_speed
        rim = rig.radius * window.speed
        with np.errstate(invalid="ignore", divide="ignore"):
            slip = 1.0 - window.ground_speed[:, None] / rim
            usable = moving[:, None] & (window.load > 0.0) & (rim > 0.0) & (slip < MAX_SLIP) & (slip > MIN_SLIP)
        kept = np.flatnonzero(usable.any(axis=1))
        self.standstill = int(np.count_nonzero(~moving & np.isfinite(window.ground_speed)))
        self.t = window.t[kept]
        self.usable = usable = usable[kept]
        self.n_wheels = n_wheels

        def take(quantity: str) -> Reading:
            value = getattr(window, quantity)[kept]
            variance = window.variance[quantity][kept]
            known = np.isfinite(value) & np.isfinite(variance)
            return np.where(known, value, 0.0), np.where(known, variance, 0.0), known

        self.torque, self.torque_var, known = take("torque")
        self.has_torque = known & usable
        self.sinkage, self.sinkage_var, known = take("sinkage")
        self.has_sinkage = known & usable
        self.with_sinkage = bool(self.has_sinkage.any())
        load, load_var, _ = take("load")
        speed, speed_var, _ = take("speed")
        self.ground_speed, self.ground_speed_var, _ = take("ground_speed")
        # Unusable wheel-instants get a harmless stand-in; none of their rows counts.
        self.load = np.where(usable, load, 1e3)
        self.speed = np.where(usable, speed, self.ground_speed[:, None] / (0.8 * rig.radius))
        self.load_var, self.speed_var = np.where(usable, load_var, 0.0), np.where(usable, speed_var, 0.0)
        self._balance(take, usable)
        self.gain_names, self.gain_std = self._gains()
        self.slip = slip[kept]
        self._measured = np.concatenate([self.load, self.speed, self.ground_speed[:, None]], axis=1)
        self._measured_var = np.concatenate([self.load_var, self.speed_var, self.ground_speed_var[:, None]], axis=1)
        known_rows = [self.has_torque, self.has_balance[:, None], self.has_sinkage]
        row_var = [self.torque_var, self.demand_var[:, None], self.sinkage_var]
        n_kinds = 3 if self.with_sinkage else 2
        known = np.concatenate(known_rows[:n_kinds], axis=1)
        self._row_var = np.where(known, np.concatenate(row_var[:n_kinds], axis=1), 1.0)
        self._known = known
        self._count()

    def _count(self) -> None:
        """What follows from the number of instants and the masks."""
        self.n = len(self.t)
        self._n_known = int(self._known.sum())
        self._missing = None if self._n_known == self._known.size else ~self._known
        self._radius, self._width = (np.tile(a, self.n) for a in (self.rig.radius, self.rig.width))

    def _balance(self, take: Callable[[str], Reading], usable: NDArray[np.bool_]) -> None:
        """The pull that draft, slope and inertia ask of the wheels, and its variance."""
        self.draft, draft_var, known = take("draft")
        demand, variance = self.draft.copy(), draft_var.copy()
        if self.rig.chassis is not None:
            mass = self.rig.chassis.mass
            pitch, pitch_var, has_pitch = take("pitch")
            if has_pitch.any():
                known = known & has_pitch
            acceleration, acceleration_var, has_acceleration = take("acceleration")
            if has_acceleration.any():
                known = known & has_acceleration
            else:
                acceleration, acceleration_var = differentiated_speed(self.t, self.ground_speed, self.ground_speed_var)
            demand += mass * (GRAVITY * np.sin(pitch) + acceleration)
            variance += mass**2 * ((GRAVITY * np.cos(pitch)) ** 2 * pitch_var + acceleration_var)
        self.demand, self.demand_var = demand, variance
        self.draft_var = np.where(known & usable.all(axis=1), draft_var, 0.0)
        self.has_balance = known & usable.all(axis=1)

    def _gains(self) -> tuple[list[str], Array]:
        names, std = [], []
        for quantity in GAIN_QUANTITIES:
            per_wheel = quantity in ("torque", "load", "speed")
            for name in [f"{quantity}.{w}" for w in self.rig.wheels] if per_wheel else [quantity]:
                names.append(name)
                std.append(self.rig.noise[quantity].gain)
        return names, np.array(std)

    @property
    def _n_residuals(self) -> int:
        """Residuals of an instant."""
        return int(self._row_var.shape[1])

    @property
    def n_rows(self) -> int:
        """Number of residuals that count."""
        return self._n_known

    def thinned(self, most: int) -> WindowProblem:
        """The same window with at most so many of its usable instants, evenly spread."""
        if self.n <= most:
            return self
        return self._part(np.linspace(0, self.n - 1, most).round().astype(int))

    def _part(self, instants: slice | NDArray[np.intp]) -> WindowProblem:
        """The same with only these instants."""
        part = copy(self)
        for name in _BY_INSTANT:
            setattr(part, name, getattr(self, name)[instants])
        part._count()
        return part

    def start(self, soil: Soil, guess: Array | None = None) -> Latents:
        """Latents at the measured values, entry angles solved for this soil from a guess (N, W)."""
        angle = np.full((self.n, self.n_wheels), np.nan) if guess is None else guess
        return self.carried(Latents(self.load.copy(), self.speed.copy(), self.ground_speed.copy(), angle), soil)

    def carried(self, latents: Latents, soil: Soil) -> Latents:
        """The same latents with the entry angles at which this soil carries their loads."""
        slip = 1.0 - latents.ground_speed[:, None] / (self.rig.radius * latents.speed)
        state = self._state(soil, latents.entry_angle, slip)
        angle = entry_angle_for_load(latents.load.ravel(), state, self.model, tolerance=START_TOLERANCE)
        angle = angle.reshape(self.n, self.n_wheels)
        angle = np.where(np.isfinite(angle), angle, MAX_ENTRY_ANGLE * 0.98)
        return Latents(latents.load, latents.speed, latents.ground_speed, angle)

    def sinkages(self, latents: Latents) -> Array:
        """Sinkage [m] of each wheel at each instant (N, W), nan where the wheel is not usable."""
        return np.where(self.usable, sinkage(latents.entry_angle, self.rig.radius), np.nan)

    def mean_sinkage(self, latents: Latents) -> Array:
        """Mean sinkage [m] of each wheel (W,), nan for a wheel that is never usable."""
        known = self.usable.sum(0)
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(np.where(self.usable, self.sinkages(latents), 0.0).sum(0) / known)

    def after(self, before: Optimum) -> tuple[Latents, Linearised]:
        """Latents and model of this window at the optimum of one that ends a little earlier.

        Instants that both share are taken over; the others are linearised at the measured
        values, with entry angles as loads and slips had them in the other window.
        """
        shared = self._shared(before.t)
        if before.at.by_latents.shape[1] != self._n_residuals:
            shared = 0
        new = self._part(slice(shared, None))
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

    def linearise(self, soil: Soil, gains: Array, latents: Latents) -> Linearised:
        """Whitened residuals and derivatives at a soil, gains (G,) and latents."""
        N, W = self.n, self.n_wheels
        r = self.rig.radius
        rim = r * latents.speed
        carried = latents.ground_speed[:, None] / rim  # 1 - slip
        state = self._state(soil, latents.entry_angle, 1.0 - carried)
        forces, d = wheel_forces_and_derivatives(state, self.model)
        forces, d = forces.reshape(3, N, W), d.reshape(3, 7, N, W)

        # Eliminate the entry angle: it follows the load.
        slope = d[0, 0]
        off = latents.load - forces[0]
        load_by = self._by_slip_and_soil(d[0], soil)
        by = np.zeros((3, 7, N, W))  # of (DP, T, z), by slip and soil
        by[0], by[1] = self._by_slip_and_soil(d[1], soil), self._by_slip_and_soil(d[2], soil)
        ratio = np.empty((3, N, W))  # by load
        np.divide(d[1:, 0], slope, out=ratio[:2])
        np.divide(r * np.sin(latents.entry_angle), slope, out=ratio[2])
        by -= ratio[:, None] * load_by
        value = ratio * off
        value[:2] += forces[1:]
        value[2] += sinkage(latents.entry_angle, r)

        A = self._by_latents(ratio, by[:, 0], carried / latents.speed, -1.0 / rim)
        # A sensor reads (1 + gain) times the truth, plus noise: readings are scaled back, and their
        # noise with them, else a gain that makes everything smaller would seem to fit better.
        scale = 1.0 / (1.0 + gains)
        of_torque, of_latents, of_draft = scale[:W], scale[W:-1], scale[-1]
        corrected, variance = self._measured * of_latents, self._measured_var * of_latents**2
        rows = np.zeros((*A.shape[:2], 7 + len(gains)))
        residual, by_soil = rows[:, :, 0], rows[:, :, 1:7]
        draft, draft_var = self.draft * of_draft, self.draft_var * of_draft**2
        row_var = self._row_var.copy()
        row_var[:, :W] *= of_torque**2
        row_var[:, W] += draft_var - self.draft_var
        residual[:, :W] = self.torque * of_torque - value[1]
        residual[:, W] = self.demand - self.draft + draft - value[0].sum(1)
        likely_draft = draft - residual[:, W] * draft_var / row_var[:, W]
        by_soil[:, :W] = -by[1, 1:].transpose(1, 2, 0)
        by_soil[:, W] = -by[0, 1:].sum(2).T
        if self.with_sinkage:
            residual[:, W + 1 :] = self.sinkage - value[2]
            by_soil[:, W + 1 :] = -by[2, 1:].transpose(1, 2, 0)
        now = np.concatenate([latents.load, latents.speed, latents.ground_speed[:, None]], axis=1)
        residual += (A @ (corrected - now)[:, :, None])[:, :, 0]
        by_gain = now * of_latents
        diagonals(rows[:, :W, 7 : 7 + W])[:] = -of_torque * value[1]
        np.multiply(A, -by_gain[:, None, :], out=rows[:, :, 7 + W : -1])
        rows[:, W, -1] = -of_draft * likely_draft
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
            by_gain=by_gain,
            off=off,
            load_slope=slope,
            load_by_slip=load_by[0],
            load_by_soil=load_by[1:],
        )

    def _by_slip_and_soil(self, d: Array, soil: Soil) -> Array:
        """Derivatives (7, N, W) by slip, k_c, k_phi, n, phi, c, K of one force from those by INPUTS."""
        out = np.empty(d.shape)
        out[0] = d[1]
        np.divide(d[2], self.rig.width, out=out[1])
        out[2:] = d[2:]
        out[4] *= 1.0 + np.tan(soil.phi) ** 2
        return out

    def _by_latents(self, by_load: Array, by_slip: Array, slip_by_speed: Array, slip_by_ground: Array) -> Array:
        """Derivatives A (N, m, 2 W + 1) of the residuals from those of DP, T and z (3, N, W)."""
        N, W = self.n, self.n_wheels
        by_speed, by_ground = by_slip * slip_by_speed, by_slip * slip_by_ground
        A = np.zeros((N, self._n_residuals, 2 * W + 1))
        A[:, W, :W], A[:, W, W : 2 * W], A[:, W, 2 * W] = by_load[0], by_speed[0], by_ground[0].sum(1)
        for kind, first in ((1, 0), (2, W + 1)) if self.with_sinkage else ((1, 0),):
            wheel_rows = A[:, first : first + W]
            diagonals(wheel_rows[:, :, :W])[:] = by_load[kind]
            diagonals(wheel_rows[:, :, W : 2 * W])[:] = by_speed[kind]
            wheel_rows[:, :, 2 * W] = by_ground[kind]
        return np.negative(A, out=A)

    def updated(self, at: Linearised, latents: Latents, soil_step: Array, gain_step: Array) -> Latents:
        """Latents after a step (6,) of the soil and (G,) of the gains, by the linear model."""
        N, W = self.n, self.n_wheels
        left = (at.weighed @ np.concatenate([[1.0], soil_step, gain_step])).reshape(N, 1, at.by_latents.shape[1])
        new = at.corrected - at.variance * (left @ at.by_latents)[:, 0] - at.by_gain * gain_step[W:-1]
        load, speed, ground = new[:, :W], new[:, W : 2 * W], new[:, 2 * W]
        slip_change = (latents.ground_speed[:, None] / latents.speed - ground[:, None] / speed) / self.rig.radius
        change = load - latents.load + at.off - at.load_by_slip * slip_change
        change -= (soil_step @ at.load_by_soil.reshape(6, -1)).reshape(N, W)
        low, high = latents.entry_angle * 0.6, np.minimum(latents.entry_angle * 1.6, MAX_ENTRY_ANGLE)
        angle = np.clip(latents.entry_angle + change / at.load_slope, low, high)
        return Latents(load, speed, ground, angle)


def differentiated_speed(t: Array, speed: Array, variance: Array, half_width: int = 3) -> tuple[Array, Array]:
    """Acceleration [m/s^2] and its variance from ground speed by local straight lines.

    t [s], speed [m/s] and variance of speed, all (N,).  The misfit of the line adds to
    the variance, so that harsh driving is not mistaken for a precise reading.
    """
    n = len(t)
    a, var = np.zeros(n), np.full(n, np.inf)
    if n < 3:
        return a, np.full(n, 1.0)
    for i in range(n):
        part = slice(max(i - half_width, 0), min(i + half_width + 1, n))
        x = t[part] - t[part].mean()
        sxx = float(x @ x)
        y = speed[part] - speed[part].mean()
        a[i] = (x @ y) / sxx
        misfit = y - a[i] * x
        spread = max(float(variance[part].mean()), float(misfit @ misfit) / max(len(x) - 2, 1))
        var[i] = spread / sxx
    return a, var
