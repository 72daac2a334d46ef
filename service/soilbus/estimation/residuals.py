"""Residuals of a window, weighed by the whole noise, and their derivatives.

At each instant the measured torques, the draft balance and (where there is a sensor) the
sinkages are compared with the model.  Wheel loads, wheel speeds and the ground speed are
measured too, with noise that travels through the model into every residual: they are
latent unknowns with the measurement as prior, eliminated instant by instant
(Gauss-Helmert model; cf. Foerstner & Wrobel, Photogrammetric Computer Vision, 2016,
sect. 4.8).  The entry angle of each wheel follows from its load.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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

MAX_SLIP = 0.98
MIN_SLIP = -1.0
START_TOLERANCE = 0.02
"""Relative error of load left in the first entry angles; each linearisation mends it further."""
GAIN_QUANTITIES = ("torque", "load", "speed", "ground_speed", "draft")


@dataclass(slots=True)
class Latents:
    """Unknowns of each instant: load [N], speed [rad/s], entry_angle [rad] (N, W); ground_speed [m/s] (N,)."""

    load: Array
    speed: Array
    ground_speed: Array
    entry_angle: Array


@dataclass(slots=True)
class Linearised:
    """Residuals and derivatives at one point, with what an update of the latents needs.

    The columns of `rows` and `weighed` (R, 1 + 6 + G) are the residual and its derivatives
    by the soil parameters (SI) and the gains; `weighed` is `rows` times the inverse
    covariance of its instant, so that rows' weighed are the normal equations.  Rows of
    missing data are zero; `known` counts the others.
    """

    rows: Array
    weighed: Array
    known: int
    latent_gain: Array  # (N, 2 W + 1, m): covariance of latents times A'
    corrected: Array  # (N, 2 W + 1) measured latents less their gain errors
    load_slope: Array  # (N, W) dW/d entry angle
    load_by_slip: Array
    load_by_soil: Array  # (N, W, 6)
    model_load: Array

    @property
    def chi2(self) -> float:
        """Sum of squares of the whitened residuals."""
        return float(self.rows[:, 0] @ self.weighed[:, 0])


class WindowProblem:
    """One window's data with masks, ready to be linearised at any soil."""

    def __init__(self, window: Window, rig: Rig, model: WheelModel, min_speed: float) -> None:
        self.rig, self.model = rig, model
        self._window, self._min_speed = window, min_speed
        n_wheels = len(rig.wheels)
        moving = window.ground_speed > min_speed
        rim = rig.radius * window.speed
        with np.errstate(invalid="ignore", divide="ignore"):
            slip = 1.0 - window.ground_speed[:, None] / rim
            usable = moving[:, None] & (window.load > 0.0) & (rim > 0.0) & (slip < MAX_SLIP) & (slip > MIN_SLIP)
        kept = np.flatnonzero(usable.any(axis=1))
        self.standstill = int(np.count_nonzero(~moving & np.isfinite(window.ground_speed)))
        self._kept = kept
        self.t = window.t[kept]
        self.usable = usable = usable[kept]
        self.n, self.n_wheels = len(kept), n_wheels

        def take(quantity: str) -> tuple[Array, Array, NDArray[np.bool_]]:
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

    def _balance(self, take, usable: NDArray[np.bool_]) -> None:  # type: ignore[no-untyped-def]
        """The pull that draft, slope and inertia ask of the wheels, and its variance."""
        self.draft, variance, known = take("draft")
        demand = self.draft.copy()
        variance = variance.copy()
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
    def n_rows(self) -> int:
        """Number of residuals that count."""
        return int(self.has_torque.sum() + self.has_balance.sum() + self.has_sinkage.sum())

    def thinned(self, most: int) -> WindowProblem:
        """The same window with at most so many of its usable instants, evenly spread."""
        if self.n <= most:
            return self
        keep = self._kept[np.linspace(0, self.n - 1, most).round().astype(int)]
        return WindowProblem(self._window.rows(keep), self.rig, self.model, self._min_speed)

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

    def angle_curve(self, latents: Latents) -> Array:
        """How the entry angles depend on load and slip here: coefficients (W, 4) for `start_on`.

        log entry angle = a + b log load + c slip + d slip^2, fitted wheel by wheel.
        """
        regressors = self._curve_regressors(latents.load, latents.speed, latents.ground_speed)
        target = np.log(latents.entry_angle).T[:, :, None]
        gram = regressors.transpose(0, 2, 1) @ regressors + 1e-9 * np.eye(4)
        return np.asarray(np.linalg.solve(gram, regressors.transpose(0, 2, 1) @ target)[:, :, 0])

    def start_on(self, curve: Array) -> Latents:
        """Latents at the measured values with entry angles from a neighbouring window's curve."""
        log_angle = self._curve_regressors(self.load, self.speed, self.ground_speed) @ curve[:, :, None]
        angle = np.exp(np.clip(log_angle[:, :, 0].T, np.log(MIN_ENTRY_ANGLE), np.log(MAX_ENTRY_ANGLE)))
        return Latents(self.load.copy(), self.speed.copy(), self.ground_speed.copy(), angle)

    def _curve_regressors(self, load: Array, speed: Array, ground_speed: Array) -> Array:
        slip = 1.0 - ground_speed[:, None] / (self.rig.radius * speed)
        return np.stack([np.ones_like(load), np.log(load), slip, slip**2], axis=-1).transpose(1, 0, 2)

    def _state(self, soil: Soil, angle: Array, slip: Array) -> WheelState:
        tile = np.broadcast_to
        shape = angle.shape
        K_L = lumped_modulus(soil.k_c, soil.k_phi, self.rig.width)
        return WheelState(
            angle.ravel(), slip.ravel(), tile(self.rig.radius, shape).ravel(), tile(self.rig.width, shape).ravel(),
            tile(K_L, shape).ravel(), soil.n, np.tan(soil.phi), soil.c, soil.K,
        )  # fmt: skip

    def linearise(self, soil: Soil, gains: Array, latents: Latents) -> Linearised:
        """Whitened residuals and derivatives at a soil, gains (G,) and latents."""
        N, W = self.n, self.n_wheels
        r = self.rig.radius
        rim = r * latents.speed
        slip = 1.0 - latents.ground_speed[:, None] / rim
        state = self._state(soil, latents.entry_angle, slip)
        forces, d = wheel_forces_and_derivatives(state, self.model)
        forces, d = forces.reshape(3, N, W), d.reshape(3, 7, N, W)

        # Eliminate the entry angle: it follows the load.
        slope = d[0, 0]
        off = latents.load - forces[0]
        z = sinkage(latents.entry_angle, r)
        z_angle = r * np.sin(latents.entry_angle)
        ratio = np.stack([d[1, 0], d[2, 0], z_angle]) / slope  # (DP, T, z) by load
        value = np.stack([forces[1], forces[2], z]) + ratio * off
        load_by_soil = self._by_soil(d[0], soil)
        by_slip = np.stack([d[1, 1], d[2, 1], np.zeros((N, W))]) - ratio * d[0, 1]
        by_soil = np.stack([self._by_soil(d[1], soil), self._by_soil(d[2], soil), np.zeros((N, W, 6))])
        by_soil -= ratio[..., None] * load_by_soil
        by_speed = by_slip * (latents.ground_speed[:, None] / (rim * latents.speed))
        by_ground = by_slip * (-1.0 / rim)

        gain = dict(zip(self.gain_names, gains.tolist(), strict=True))
        g_torque, g_load, g_speed = (np.array([gain[f"{q}.{w}"] for w in self.rig.wheels]) for q in GAIN_QUANTITIES[:3])
        corrected = np.concatenate(
            [
                self.load * (1 - g_load),
                self.speed * (1 - g_speed),
                (self.ground_speed * (1 - gain["ground_speed"]))[:, None],
            ],
            axis=1,
        )
        now = np.concatenate([latents.load, latents.speed, latents.ground_speed[:, None]], axis=1)

        m = W + 1 + (W if self.with_sinkage else 0)
        residual = np.zeros((N, m))
        A = np.zeros((N, m, 2 * W + 1))
        J = np.zeros((N, m, 6))
        R = np.zeros((N, m))
        i = np.arange(W)
        residual[:, :W] = self.torque * (1 - g_torque) - value[1]
        A[:, i, i], A[:, i, W + i], A[:, :W, 2 * W] = -ratio[1], -by_speed[1], -by_ground[1]
        J[:, :W] = -by_soil[1]
        R[:, :W] = self.torque_var
        residual[:, W] = self.demand - gain["draft"] * self.draft - value[0].sum(1)
        A[:, W, :W], A[:, W, W : 2 * W], A[:, W, 2 * W] = -ratio[0], -by_speed[0], -by_ground[0].sum(1)
        J[:, W] = -by_soil[0].sum(1)
        R[:, W] = self.demand_var
        known = np.concatenate([self.has_torque, self.has_balance[:, None]], axis=1)
        if self.with_sinkage:
            s = slice(W + 1, m)
            residual[:, s] = self.sinkage - value[2]
            A[:, W + 1 + i, i], A[:, W + 1 + i, W + i], A[:, s, 2 * W] = -ratio[2], -by_speed[2], -by_ground[2]
            J[:, s] = -by_soil[2]
            R[:, s] = self.sinkage_var
            known = np.concatenate([known, self.has_sinkage], axis=1)

        residual += np.einsum("nij,nj->ni", A, corrected - now)
        G = self._by_gain(A)
        latent_var = np.concatenate([self.load_var, self.speed_var, self.ground_speed_var[:, None]], axis=1)
        for array in (residual, A, J, G, R):
            array[~known] = 0.0
        AV = A * latent_var[:, None, :]
        S = AV @ A.transpose(0, 2, 1)
        S[:, np.arange(m), np.arange(m)] += np.where(known, R, 1.0)
        rows = np.concatenate([residual[:, :, None], J, G], axis=2)
        weighed = np.linalg.solve(S, rows)
        return Linearised(
            rows=rows.reshape(N * m, -1), weighed=weighed.reshape(N * m, -1), known=int(known.sum()),
            latent_gain=AV.transpose(0, 2, 1), corrected=corrected, load_slope=slope, load_by_slip=d[0, 1],
            load_by_soil=load_by_soil, model_load=forces[0],
        )  # fmt: skip

    def _by_soil(self, d: Array, soil: Soil) -> Array:
        """Derivatives (N, W, 6) by k_c, k_phi, n, phi, c, K of one force from those by INPUTS (7, N, W)."""
        sec2 = 1.0 + np.tan(soil.phi) ** 2
        return np.stack([d[2] / self.rig.width, d[2], d[3], d[4] * sec2, d[5], d[6]], axis=-1)

    def _by_gain(self, A: Array) -> Array:
        """Derivatives (N, m, G): a torque or draft gain scales the reading, a latent's gain acts through A."""
        N, m, _ = A.shape
        W = self.n_wheels
        G = np.zeros((N, m, 3 * W + 2))
        i = np.arange(W)
        G[:, i, i] = -self.torque
        G[:, :, W : 2 * W] = -A[:, :, :W] * self.load[:, None, :]
        G[:, :, 2 * W : 3 * W] = -A[:, :, W : 2 * W] * self.speed[:, None, :]
        G[:, :, 3 * W] = -A[:, :, 2 * W] * self.ground_speed[:, None]
        G[:, W, 3 * W + 1] = -self.draft
        return G

    def updated(self, at: Linearised, latents: Latents, soil_step: Array, gain_step: Array) -> Latents:
        """Latents after a step (6,) of the soil and (G,) of the gains, by the linear model."""
        N, W = self.n, self.n_wheels
        left = at.weighed @ np.concatenate([[1.0], soil_step, gain_step])
        new = at.corrected - (at.latent_gain @ left.reshape(N, -1, 1))[:, :, 0]
        scale = np.concatenate([self.load, self.speed, self.ground_speed[:, None]], axis=1)
        new = new - scale * self._latent_gain_steps(gain_step)
        load, speed, ground = new[:, :W], new[:, W : 2 * W], new[:, 2 * W]
        old_slip = 1.0 - latents.ground_speed[:, None] / (self.rig.radius * latents.speed)
        slip = 1.0 - ground[:, None] / (self.rig.radius * speed)
        change = load - at.model_load - at.load_by_slip * (slip - old_slip) - at.load_by_soil @ soil_step
        low, high = latents.entry_angle * 0.6, np.minimum(latents.entry_angle * 1.6, MAX_ENTRY_ANGLE)
        angle = np.clip(latents.entry_angle + change / at.load_slope, low, high)
        return Latents(load, speed, ground, angle)

    def _latent_gain_steps(self, gain_step: Array) -> Array:
        W = self.n_wheels
        return np.concatenate([gain_step[W : 3 * W], gain_step[3 * W : 3 * W + 1]])


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
