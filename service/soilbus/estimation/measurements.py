"""Measurements of a window as the observation model uses them: usable instants, values, variances, masks.

    slip_w = 1 - V / (r_w omega_w)                   usable where |slip| < max_slip, load > 0, V > min_speed
    demand = draft + m (G sin(pitch) + dV/dt)        drawbar pull that the wheels must give, with its variance

`Measurements` keeps the instants at which some wheel is usable: forward motion (`window.forward` mirrors reversing),
faster than `min_speed`, not in a turn (`window.turning`).  A value that is missing or has no finite variance is
zero with a false mask.  Where no acceleration is measured it is the slope of the ground speed (`differentiated_speed`).
The speed of a free wheel follows from the ground speed and has no noise of its own; the row of equal torques behind an
open differential is none of the residuals: it fixes how the two wheels share their axle's load.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from soilbus.arrays import Array
from soilbus.estimation.instrumentation import completed, matrix, rows_in, straightened
from soilbus.estimation.local_cubics import Curve, curve_of, faithful, kept_noise
from soilbus.estimation.standing import SLOPES, STANDING, standing_columns, standing_std
from soilbus.estimation.window import Rig, Window, forward, turning
from soilbus.terra.vehicle import GRAVITY

Masked = tuple[Array, Array, NDArray[np.bool_]]
"""Values, their variances, and a mask of which are known; zero where not."""

MASS_GAIN = "load.weight"
"""Name of the gain of the row that is the weight: the mass is that of the data sheet over 1 + g."""

_BY_INSTANT = (
    "t", "usable", "torque", "torque_var", "has_torque", "sinkage", "sinkage_var", "has_sinkage", "load", "speed",
    "ground_speed", "slip", "swing", "draft", "draft_var", "demand_var",
    "inertia", "inertia_var", "draft_noise", "has_balance", "pitch", "since", "distance", "wheel_angle",
    "acceleration", "acceleration_var",
    "by_inertia", "by_draft", "_measured", "_measured_var", "_latents_measured", "_row_var", "known",
    "_side_known", "standing_rows", "standing_latents", "held_covariance", "_off_curve",
)  # fmt: skip
"""Attributes of `Measurements` with a row for each instant, where they are not None."""


def gains_of(rig: Rig) -> tuple[list[str], list[float]]:
    """Names and prior sd of the sensor gains, then of STANDING; rows that no sensor measures have their own."""
    every = [(q, row) for q in ("torque", "load", "speed") for row in rows_in(rig, q)]
    rows = [(f"{q}.{row.name or f'{row.kind}{row.at}'}", row.gain) for q, row in every]
    names, std = zip(*rows, *((q, rig.noise[q].gain) for q in ("ground_speed", "draft")), strict=True)
    return [*names, *STANDING], [*std, *standing_std(rig)]


class Measurements:
    """The usable instants (N) of a window: arrays (N, W) of the wheels and (N,) of the vehicle, in SI.

    Each has its variance and a mask of what is known; all are zero where it is not.  `standstill` and `turning` count
    instants left out: up to min_speed [m/s], and with rim speeds that differ by more than max_turn of their mean.
    """

    def __init__(self, window: Window, rig: Rig, min_speed: float, max_turn: float) -> None:
        self.rig, self.options = rig, rig.options
        self._window = window = completed(forward(window), rig)
        self._curves: dict[str, list[Curve]] = {}
        self.n_wheels = n_wheels = len(rig.wheels)
        moving, in_turn = window.ground_speed > min_speed, turning(window, rig, max_turn)
        straight = moving & ~in_turn
        if np.isfinite(window.yaw_rate).any():
            window = straightened(window, rig, self.curves_of("yaw_rate")[0].at(window.t)[0])
        rim_speed = rig.radius * window.speed
        with np.errstate(invalid="ignore", divide="ignore"):
            slip = 1.0 - window.ground_speed[:, None] / rim_speed
            turns = (rim_speed > 0.0) & (np.abs(slip) < 1.0)
            usable = straight[:, None] & (window.load > 0.0) & (turns | ~rig.drives)
        kept = np.flatnonzero(usable.any(axis=1))
        self.standstill = int(np.count_nonzero(~moving & np.isfinite(window.ground_speed)))
        self.turning = int(np.count_nonzero(moving & in_turn))
        self.t, self.swing = window.t[kept], window.swing[kept]
        self.usable = usable = usable[kept]

        def masked(value: Array, variance: Array) -> Masked:
            value, variance = value[kept], variance[kept]
            known = np.isfinite(value) & np.isfinite(variance)
            return np.where(known, value, 0.0), np.where(known, variance, 0.0), known

        def take(quantity: str) -> Masked:
            return masked(getattr(window, quantity), window.variance[quantity])

        self._observe()
        if window.observations is not None and self._torque_matrix is not None:
            self.torque, self.torque_var, known = masked(window.observations.torque, window.observations.torque_var)
            usable = (~usable).astype(float) @ (np.abs(self._torque_matrix) > 0.0).T == 0.0
        else:
            self.torque, self.torque_var, known = take("torque")
        self.has_torque = known & usable
        torques, self._side_columns = [torque for torque, _ in self._sides], [load for _, load in self._sides]
        self._side_known = self.has_torque[:, torques]
        self.has_torque[:, torques] = False
        usable = self.usable
        self.sinkage, self.sinkage_var, known = take("sinkage")
        self.has_sinkage = known & usable
        self.with_sinkage = bool(self.has_sinkage.any())
        (load, load_var, _), (speed, speed_var, _) = take("load"), take("speed")
        self.ground_speed, ground_speed_var, _ = take("ground_speed")
        self.rolls = ~rig.drives
        rolling = self.ground_speed[:, None] / rig.radius / (1.0 - rig.options.measurements.rolling_slip)
        speed, speed_var = np.where(self.rolls, rolling, speed), np.where(self.rolls, 0.0, speed_var)
        if rig.lengths is not None:
            load, load_var = steady_loads(load, load_var, usable & (rig.lengths > 0.0))
        # rows of unusable wheel-instants are zero: their load [N] and slip only have to be positive
        self.load = np.where(usable, load, 1e3)
        self.speed = np.where(usable, speed, self.ground_speed[:, None] / (0.8 * rig.radius))
        self.since, steps, ground = self.t - window.t[:1], np.diff(self.t), self.ground_speed
        driven = [ground[:1] * self.since[:1], (ground[1:] + ground[:-1]) / 2.0 * steps]
        turned = [0.0 * self.speed[:1], (self.speed[1:] + self.speed[:-1]) / 2.0 * steps[:, None]]
        self.distance, self.wheel_angle = (np.cumsum(np.concatenate(part), axis=0) for part in (driven, turned))
        self.duration = float(window.t[-1] - window.t[0]) if len(window.t) else 0.0
        self.length = float(self.distance[-1]) if len(self.distance) else 0.0
        self._balance(take, usable, ground_speed_var)
        self.gain_names, gain_std = gains_of(rig)
        self.gain_std = self.sensor_std = np.array(gain_std)
        self.n_sensors = len(self.gain_names)
        self.slip = np.where(self.rolls, rig.options.measurements.rolling_slip, slip[kept])
        self._latents_measured = np.concatenate([self.load, self.speed, self.ground_speed[:, None]], axis=1)
        self.by_inertia = self.by_draft = np.zeros_like(self._latents_measured)
        if window.observations is None:
            self._measured = self._latents_measured
            of_wheels = np.where(np.tile(usable, 2), np.hstack([load_var, speed_var]), 0.0)
            self._measured_var = np.hstack([of_wheels, ground_speed_var[:, None]])
        else:
            value, variance, known = masked(window.observations.value, window.observations.variance)
            self._measured = np.where(known, value, 1.0)
            assert self._latent_matrix is not None
            others = np.ones(len(self._prior_only), bool)  # than the speeds of free wheels, which follow from V
            others[n_wheels:-1] = ~self.rolls
            self._measured_var = np.where(self._latent_matrix[:, others].any(axis=1), variance, 0.0)
            self._measured_var[:, self._side_columns] *= ~self._side_known
            self.by_inertia = window.observations.by_inertia[kept] * self.has_balance[:, None]
            self.by_draft = window.observations.by_draft[kept] * self.has_balance[:, None]
        m = 2 * n_wheels + 1 if self.with_sinkage else n_wheels + 1
        self.known = np.concatenate([self.has_torque, self.has_balance[:, None], self.has_sinkage], axis=1)[:, :m]
        """Which residuals (N, m) have a measurement."""
        row_var = np.concatenate([self.torque_var, self.demand_var[:, None], self.sinkage_var], axis=1)[:, :m]
        self._row_var = np.where(self.known, row_var, 1.0)
        self._stand(standing_columns(window, rig), kept)
        self.held_covariance: Array | None = None
        self._off_curve: Array | None = None
        self._count()

    def _stand(self, columns: tuple[Array, Array], kept: NDArray[np.intp]) -> None:
        """Set the derivatives by STANDING of the rows (N, m, S) and of the observed latents (N, 2 W + 1, S)."""
        rows, self.standing_latents = columns[0][kept], columns[1][kept]
        if self._torque_matrix is not None and self._latent_matrix is not None:
            rows[:, : self.n_wheels] = self._torque_matrix @ rows[:, : self.n_wheels]
            self.standing_latents = self._latent_matrix @ self.standing_latents
        self.standing_rows = np.zeros((*self.known.shape, len(STANDING)))
        self.standing_rows[:, : self.n_wheels + 1] = rows
        self.standing_rows[~self.known] = 0.0

    def with_own_stamps(self) -> Self:
        """The same with each torque late by a gain of its own too, and standing parts by the slopes of smooth curves.

        The prior sd of a lateness is half the channel's sample time, as a stamp is up to a cycle later than its value.
        """
        if self.rig.chassis is None:
            return self
        window, values, slopes = self._window, dict[str, Any](), list[Array]()
        for quantity in (*SLOPES, "torque"):
            smooth, slope = np.stack([curve.at(window.t)[:2] for curve in self.curves_of(quantity)], axis=2)
            values[quantity] = smooth.reshape(getattr(window, quantity).shape)
            slopes.append(slope)
        stamped, W = copy(self), self.n_wheels
        kept, of_torque = np.searchsorted(window.t, self.t), np.nan_to_num(slopes.pop())
        stamped._stand(standing_columns(replace(window, **values), self.rig, np.hstack(slopes)), kept)
        own = np.zeros((*stamped.standing_rows.shape[:2], W))
        own[:, :W] = (np.eye(W) if self._torque_matrix is None else self._torque_matrix) * of_torque[kept, None]
        own[~self.known] = 0.0
        stamped.standing_rows = np.concatenate([stamped.standing_rows, own], axis=2)
        stamped.standing_latents = np.pad(stamped.standing_latents, ((0, 0), (0, 0), (0, W)))
        first = self.n_sensors - len(STANDING)
        late = [name.removeprefix("lateness.") for name in STANDING[2:]]
        half = [self.sample_time(quantity) / 2.0 for quantity in [*late, *["torque"] * W]]
        stamped.gain_names = [*self.gain_names[: self.n_sensors], *(f"lateness.torque.{w}" for w in self.rig.wheels)]
        stamped.gain_std = stamped.sensor_std = np.concatenate([self.sensor_std[: first + 2], half])
        stamped.n_sensors = len(stamped.gain_names)
        return stamped

    def on_bumps(self) -> Self:
        """The same with a noise of the balance: bumps shorter than the vehicle pitch its body, and no slope holds it.

        var theta = mean of (theta(x) - 2 theta(x + L) + theta(x + 2 L))^2 / 6 - noise        L: wheelbase
        """
        if self.rig.chassis is None or not self.pitch.any():
            return self
        speed, step = float(self.ground_speed.mean()), float(np.median(np.diff(self.t)))
        k = max(round(self.rig.chassis.wheelbase / (speed * step)), 1)
        bend = self.pitch[2 * k :] - 2.0 * self.pitch[k:-k] + self.pitch[: -2 * k]
        shaken = max(float((bend**2).mean()) / 6.0 - self.pitch_noise, 0.0) if len(bend) else 0.0
        bumpy, added = copy(self), (self.rig.chassis.mass * GRAVITY) ** 2 * shaken * self.has_balance
        bumpy.demand_var, bumpy._row_var = self.demand_var + added, self._row_var.copy()
        bumpy._row_var[:, self.n_wheels] += added
        return bumpy

    def on_curves(self) -> Self:
        """The same with latents on smooth curves of what is measured, where two wheels share a torque and their load.

        The assumed covariance of computed loads is several times too large: latents keep their sensors' noise, and the
        Jacobian taken there correlates with the residuals.  On smooth curves it does not (regression calibration:
        Carroll et al. 2006, Measurement Error in Nonlinear Models, ch. 4).
        """
        if not self._sides:
            return self
        smooth = copy(self)
        noise = [off_curve(self.t, *column) for column in zip(self._measured.T, self._measured_var.T, strict=True)]
        of_draft = off_curve(self.t, self.draft, self.draft_var)[:, None]
        of_inertia = off_curve(self.t, self.inertia, self.inertia_var)[:, None]
        of_computed = self.by_draft * of_draft + self.by_inertia * of_inertia
        smooth._off_curve = np.where(self._prior_only, of_computed, np.stack(noise, axis=1))
        return smooth

    def _observe(self) -> None:
        """Set the matrices from torques and latents of the wheels to what is observed; None for unit matrices."""
        given = self.rig.instrumentation
        self._torque_matrix = None if given is None else matrix(given.torque)
        self._latent_matrix = None if given is None else given.latent_matrix
        self._from_observed = None if given is None else given.from_observed
        self._sides = () if given is None else given.sides
        loads = () if given is None else given.load
        self._mass_gain = next((i for i, row in enumerate(loads) if row.kind == "weight"), None)
        self._prior_only = np.zeros(2 * self.n_wheels + 1, bool)
        self._prior_only[: len(loads)] = () if given is None else given.loads_at_prior

    def observed(self, latents: Array) -> Array:
        """Observations (N, 2 W + 1) that latents (N, 2 W + 1) of the wheels would give without noise and gain error."""
        if self._latent_matrix is None:
            return latents
        return np.asarray(self._measured + (latents - self._latents_measured) @ self._latent_matrix.T)

    def from_observed(self, observed: Array) -> Array:
        """Latents (N, 2 W + 1) of the wheels from observations without noise (N, 2 W + 1)."""
        if self._from_observed is None:
            return observed
        return np.asarray(self._latents_measured + (observed - self._measured) @ self._from_observed.T)

    def torque_rows(self, torque: Array) -> Array:
        """What is measured of torques (..., W) of the wheels: sums, differences, or themselves."""
        return torque if self._torque_matrix is None else np.asarray(torque @ self._torque_matrix.T)

    def _count(self) -> None:
        """Set the numbers of instants, of an instant's residuals and of residuals with a measurement."""
        self.n, self._n_residuals, self.n_rows = len(self.t), self.known.shape[1], int(self.known.sum())
        self._missing = None if self.n_rows == self.known.size else ~self.known
        length = np.broadcast_to(self.rig.length, self.rig.radius.shape)
        self._geometry = np.tile([self.rig.radius, self.rig.width, length], 2 * self.n)  # of every instant twice

    def _balance(self, take: Callable[[str], Masked], usable: NDArray[np.bool_], ground_speed_var: Array) -> None:
        """Set draft and inertia (with slope) [N], whose sum is the demand, and their variances."""
        self.draft, draft_var, known = take("draft")
        self.with_pitch, self.pitch_noise, nothing = False, 0.0, np.zeros_like(self.draft)
        self.pitch = self.acceleration = self.acceleration_var = self.inertia = inertia_var = nothing
        if self.rig.chassis is not None:
            mass = self.rig.chassis.mass
            self.pitch, pitch_var, has_pitch = take("pitch")
            self.with_pitch = bool(has_pitch.any())
            self.pitch_noise = float(pitch_var[has_pitch].mean()) if self.with_pitch else 0.0
            if self.rig.specific_force:  # it holds the slope: pitch is needed for dv/dt only, and its noise cancels
                pitch_var = nothing
            elif self.with_pitch:
                known = known & has_pitch
            self.acceleration, self.acceleration_var, has_acceleration = take("acceleration")
            if has_acceleration.any() or self.rig.specific_force:
                known = known & has_acceleration
            else:
                slope = differentiated_speed(self.t, self.ground_speed, ground_speed_var)
                self.acceleration, self.acceleration_var = slope
            self.inertia = mass * (GRAVITY * np.sin(self.pitch) + self.acceleration)
            inertia_var = mass**2 * ((GRAVITY * np.cos(self.pitch)) ** 2 * pitch_var + self.acceleration_var)
        self.demand_var = draft_var + inertia_var
        self.has_balance = known & usable.all(axis=1)
        self.draft_var, self.inertia_var = np.where(self.has_balance, [draft_var, inertia_var], 0.0)
        stepped = float((np.diff(self.draft[self.has_balance]) ** 2).sum())  # holds the noise of readings twice
        self.draft_noise = self.draft_var * min(1.0, stepped / max(2.0 * float(self.draft_var.sum()), 1e-9))

    @property
    def demand(self) -> Array:
        """Pull [N] (N,) for draft, slope and inertia."""
        return self.draft + self.inertia

    @property
    def computes_loads(self) -> bool:
        """Whether a load stays at its prior, which neither a load cell nor torques measure."""
        return bool(self._prior_only.any())

    @property
    def row_channels(self) -> list[tuple[str, str]]:
        """Quantity, and wheel or axle, of each residual of an instant."""
        names = [("torque", row.name) for row in rows_in(self.rig, "torque")] + [("draft", "")]
        return names + ([("sinkage", wheel) for wheel in self.rig.wheels] if self.with_sinkage else [])

    @property
    def row_wheels(self) -> list[list[int]]:
        """Indices of the wheels of each residual of an instant: of the draft all of them."""
        every = range(self.n_wheels)
        torques = [np.flatnonzero(row.weight).tolist() for row in rows_in(self.rig, "torque")]
        return [*torques, [*every], *([i] for i in every if self.with_sinkage)]

    @property
    def readings(self) -> Array:
        """What the sensors read in the rows of an instant (N, m): torques [N m], draft [N], sinkages [m]."""
        return np.hstack([self.torque, self.draft[:, None], self.sinkage])[:, : self._n_residuals]

    @property
    def wheel_torque(self) -> Array:
        """Torques (N, W) [N m] of the wheels by the rows of torques; differentials share equally."""
        if self._torque_matrix is None:
            return self.torque
        return np.asarray(np.linalg.solve(self._torque_matrix, self.torque.T).T)

    @property
    def is_measured(self) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Which residuals (m,) and latents (2 W + 1,) a sensor measures; differentials and geometry give the others."""
        torque, load, speed = ([r.kind == "channel" for r in rows_in(self.rig, q)] for q in ("torque", "load", "speed"))
        return np.array([*torque, *[True] * (self._n_residuals - self.n_wheels)]), np.array([*load, *speed, True])

    def curves_of(self, quantity: str) -> list[Curve]:
        """Return the smooth curves of a measured quantity: one for each wheel, or one for the vehicle."""
        if quantity not in self._curves:
            t, given, values = self._window.t, self._window.curves, getattr(self._window, quantity)
            names = [quantity] if values.ndim == 1 else [f"{quantity}.{wheel}" for wheel in self.rig.wheels]
            columns = (part.reshape(len(t), -1).T for part in (values, self._window.variance[quantity]))
            if all(name in given for name in names):
                self._curves[quantity] = [given[name] for name in names]
            else:
                pairs = [(y, var, np.isfinite(y) & np.isfinite(var)) for y, var in zip(*columns, strict=True)]
                self._curves[quantity] = [curve_of(t[known], y[known], var[known]) for y, var, known in pairs]
        return self._curves[quantity]

    def sample_time(self, quantity: str) -> float:
        """Time [s] between samples of a quantity, the longest of its channels; 0 where only bins are known."""
        names = (quantity, *(f"{quantity}.{wheel}" for wheel in self.rig.wheels))
        curves = self._window.curves
        return max((curves[name].step for name in names if name in curves), default=0.0)

    def shifted(self, quantity: str, column: int, curve: Curve, delay: float) -> Array:
        """Return by how much a column of a quantity (N,) changes where a delay [s] is taken out."""
        t = self._window.t
        values = getattr(self._window, quantity).reshape(len(t), -1)[np.searchsorted(t, self.t), column]
        here, kept = curve.at(self.t)[0], self._kept_noise(quantity, column, curve, delay)
        return np.asarray(curve.at(self.t + delay)[0] - here + (kept - 1.0) * (values - here))

    def _kept_noise(self, quantity: str, column: int, curve: Curve, delay: float) -> float:
        """Return the factor on what is beside a curve, with which a delay [s] keeps the noise of instants."""
        of_value = self.curves_of(quantity)[column].half_width
        if not (curve.half_width and of_value and self.n > 1):
            return 1.0
        length = float(np.median(np.diff(self._window.t)))
        first, end = (np.searchsorted(curve.t, self.t + part * length) for part in (-0.5, 0.5))
        n = max(round(float(np.median(end - first))), 1)
        middle = curve.t[np.minimum(first, len(curve.t) - n)] + (n - 1) / 2.0 * curve.step
        phase = round(float(np.median(self.t - middle)) / curve.step, 2)
        return kept_noise(curve.half_width, n, phase, of_value, curve.parts, delay / curve.step)

    def moves(self, quantity: str) -> bool:
        """Whether what a quantity varies by is mostly no noise: successive samples correlate by more than a half."""
        if getattr(self._window, quantity).size == 0:
            return False
        samples = [value[np.isfinite(value)] for value in np.atleast_2d(getattr(self._window, quantity).T)]
        off = [value - value.mean() for value in samples if len(value) > 2]
        return any(float(one[1:] @ one[:-1]) > 0.5 * float(one @ one) for one in off)

    def part(self, instants: slice | NDArray[np.intp]) -> Self:
        """The same with the given instants only."""
        part = copy(self)
        for name in _BY_INSTANT:
            values = getattr(self, name)
            setattr(part, name, None if values is None else values[instants])
        part._count()
        return part


def steady_loads(load: Array, variance: Array, tracks: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Return loads (N, W) and variances, with the mean in place of a track's loads that vary no more than their noise.

    A track presses evenly, so that only its load tells c and tan phi apart; Gauss-Newton takes noise in a regressor for
    information (Neyman & Scott 1948, Econometrica 16:1).
    """
    load, variance = load.copy(), variance.copy()
    for w in range(load.shape[1]):
        on = tracks[:, w] & (variance[:, w] > 0.0)
        n = int(on.sum())
        if n > 1 and load[on, w].var() < 2.0 * variance[on, w].mean():  # half of it is noise
            load[on, w], variance[on, w] = load[on, w].mean(), variance[on, w].mean() / n
    return load, variance


def off_curve(t: Array, value: Array, variance: Array) -> Array:
    """By how much values (N,) at times t (N,) [s] differ from their smooth curve; 0 where their variance is."""
    off, noisy = np.zeros(len(t)), variance > 0.0
    if noisy.any():
        off[noisy] = value[noisy] - curve_of(t[noisy], value[noisy], variance[noisy]).value
    return off


def differentiated_speed(t: Array, speed: Array, variance: Array) -> tuple[Array, Array]:
    """Acceleration as the slope of the ground speed's smooth curve (`local_cubics`), and its variance.

        var a = max(mean var V, mean (V - curve)^2) * sum of squared weights of the slope,  over a cubic's samples

    Both (N,); 0 and 1 of fewer than three speeds.  The misfit counts as noise where it is more, so that harsh driving
    does not pass for precise data.
    """
    if len(t) < 3:
        return np.zeros(len(t)), np.full(len(t), 1.0)
    curve = faithful(curve_of(t, speed, variance), speed)
    near = np.ones(2 * max(curve.half_width, 1) + 1)
    spread, noise = (np.convolve(a, near, "same") for a in ((speed - curve.value) ** 2, variance))
    count = np.convolve(np.ones(len(t)), near, "same")
    return curve.slope, np.maximum(spread, noise) / count * curve.slope_gain
