"""How much of a hidden effect a recording can show at all, computed without any code of the diagnosis.

The tractor drives without noise and gain errors, with the effect and without.  The plain wheel-soil model h (the rim
integral beside this file) is fitted to the readings y of the drive with it.  Unknown are the latents x of each
instant (entry angles, slips, motion) and, for the whole drive, the soil and the gain errors g, together q, with the
priors of the configuration.

    E = min over x, q of |S^-1 (y - d - (1 + g) h(x, soil))|^2 + |q / sd(q)|^2

S is the noise of the sensors, d the residual of h for the drive without the effect: another effect, and the error of
the rim integral against the simulator.  E is by how much -2 log posterior would fall for an analyst who adds the very
formula of the generator.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from soilbus.arrays import Array
from soilbus.config.model import Config
from soilbus.estimation.assembly import chassis_of, rig_of
from soilbus.estimation.instrumentation import Row, unit
from soilbus.estimation.options import ESTIMATOR
from soilbus.simulator.recording import Recording, simulate
from soilbus.simulator.scenario import SAMPLE_RATE
from soilbus.terra.vehicle import GRAVITY, axle_loads
from soilbus.terra.wheel import Soil, state_on
from tests.lab.blind.cases import Case
from tests.lab.blind.form import Hidden, together
from tests.lab.blind.rim import rim_forces

BIN = 0.1
"""Time [s] over which readings are averaged, as any analyst of slow drives may."""
EVERY = 3
"""Only each third bin is used, and counts for three."""
STEP = 1e-4
"""Of the finite differences: rad, 1, m/s, m/s^2, and relative for soil parameters."""
ROUNDS, HALVINGS = 16, 6
DAMPINGS = (0.0, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 1.0)
RELAXED = 6
"""Rounds in which latents follow the unknowns of the whole drive."""
LONGEST = 0.1
"""Step [rad, 1, m/s, m/s^2] of a latent: linear is not for ever."""
ENOUGH = 0.01
"""Share of the energy by which a round must lower it, else it was the last."""
OTHER = 1.0
"""Sd of the share by which another effect may be greater or less than it is."""
BEARING = 0.004
"""Torque of a free wheel's bearing over load and radius."""


class Shown(NamedTuple):
    """energy: E of the least visible of the hidden effects; gap: the reduced chi-square that this fit leaves, with
    noise: 1 where there is nothing."""

    energy: float
    gap: float


def shown(case: Case) -> Shown:
    """What the recording shows of what is hidden in it; of two effects, of each one beside the other.

    SimulationError if it cannot be driven.
    """
    whole = driven_without_noise(case, case.parts)
    left = [driven_without_noise(case, case.parts[:i] + case.parts[i + 1 :]) for i in range(len(case.parts))]
    count = int(min(recording.truth["t"][-1] for recording in (whole, *left)) / BIN)
    found = []
    for recording in left:
        without = _instants(case, recording, count)
        others = without.readings - without.model(without.latents, without.log_soil)
        fit = _Fit(_instants(case, whole, count), others, several=len(left) > 1)
        found.append(Shown(fit.least(), fit.gap()))
    return min(found, key=lambda each: each.energy)


def driven_without_noise(case: Case, parts: tuple[Hidden, ...]) -> Recording:
    """The drive with these parts, and sensors without noise or gain errors."""
    how = together(parts)
    quiet = case.config.model_copy(update={"noise": case.config.noise.scaled(0.0)})
    driven = simulate(how.tractor(quiet), how.way(case.scenario), case.seed, how.effects)
    return how.after(driven)


class _Reading(NamedTuple):
    """What a channel reads or, where no channel is left, what is known without one (`instrumentation.Row`).

    channel: its name, or that of the row; kind: "vehicle", else that of the row; weight: of the wheels (W,).
    gain: sd of its error, and scale [N]: what that is of, where nothing is measured; bias: of a differential.
    """

    quantity: str
    channel: str
    kind: str
    weight: Array
    gain: float
    scale: float = 0.0
    bias: float = 0.0


def _readings(config: Config, with_sinkage: bool) -> Iterator[_Reading]:
    """Load, torque and speed of each wheel, sinkage where measured, then what the vehicle has."""
    rig, W = rig_of(config), len(config.wheel)
    given, chassis = rig.instrumentation, rig.chassis
    assert chassis is not None
    static = np.where(rig.front, *axle_loads(chassis, 0.0, 0.0, 0.0)) / 2.0
    for quantity in ("load", "torque", "speed", *["sinkage"] * with_sinkage):
        rows: Sequence[Row] = () if given is None else getattr(given, quantity, ())
        for i, wheel in enumerate(config.wheel):
            row = rows[i] if rows else Row(unit(W, i), "channel", i, wheel.name, getattr(config.noise, quantity).gain)
            weight = np.array(row.weight)
            scale = float(static @ np.abs(weight)) if row.kind in ("weight", "transfer", "side") else 0.0
            bias = given.couplings[row.at].bias if given is not None and row.kind == "coupling" else 0.0
            yield _Reading(quantity, f"{quantity}.{row.name}", row.kind, weight, row.gain, scale, bias)
    for quantity in ("ground_speed", "draft", "pitch", "acceleration"):
        if getattr(config.signals, quantity) is not None:
            yield _Reading(quantity, quantity, "vehicle", np.zeros(W), getattr(config.noise, quantity).gain)


@dataclass(frozen=True)
class _Instants:
    """A drive in bins: what the readings are of, their values (N, R), and the true latents (N, X).

    Latents: entry angle and slip of each wheel, ground speed, pitch, acceleration; those of the last two that no
    sensor measures are known to be those of steady speed on level ground.  unknown: columns of the others.
    Specific force without a pitch sensor is a steady vehicle's acceleration on level ground: the balances ask no more.
    """

    config: Config
    of: tuple[_Reading, ...]
    readings: Array
    latents: Array
    unknown: list[int]
    log_soil: Array

    def model(self, latents: Array, log_soil: Array) -> Array:
        """What plain wheels in these states, and sensors without error, say: (N, R)."""
        return self._rows(latents, self._forces(latents, log_soil))

    def by_latents(self, latents: Array, log_soil: Array) -> Array:
        """Derivatives (N, R, X) of the model."""
        W, there = len(self.config.wheel), self._forces(latents, log_soil)
        plain = self._rows(latents, there)
        columns = []
        moved = [latents.copy(), latents.copy()]  # all entry angles, all slips: wheels know nothing of each other
        for k, one in enumerate(moved):
            one[:, k * W : (k + 1) * W] += STEP
        forces = [self._forces(one, log_soil) for one in moved]
        for k in self.unknown:
            at = latents.copy()
            at[:, k] += STEP
            mixed = there.copy()
            if k < 2 * W:
                mixed[:, :, k % W] = forces[k // W][:, :, k % W]
            columns.append((self._rows(at, mixed) - plain) / STEP)
        return np.stack(columns, axis=2)

    def _forces(self, latents: Array, log_soil: Array) -> Array:
        """Load, pull, torque of each wheel (3, N, W)."""
        W = len(self.config.wheel)
        radius, width = (
            np.array([getattr(wheel, size) for wheel in self.config.wheel]) for size in ("radius", "width")
        )
        return rim_forces(state_on(Soil(*np.exp(log_soil)), latents[:, :W], latents[:, W : 2 * W], radius, width))

    def _rows(self, latents: Array, forces: Array) -> Array:
        """Readings (N, R) of wheels with these forces."""
        wheels, chassis = self.config.wheel, chassis_of(self.config)
        assert chassis is not None
        W = len(wheels)
        angle, slip, (speed, pitch, rate) = latents[:, :W], latents[:, W : 2 * W], latents[:, 2 * W :].T
        radius, (load, pull, torque) = np.array([wheel.radius for wheel in wheels]), forces
        draft = pull.sum(axis=1) - chassis.mass * (GRAVITY * np.sin(pitch) + rate)
        of_wheels = {"load": load, "torque": torque, "speed": speed[:, None] / (radius * (1.0 - slip))}
        of_wheels["sinkage"] = radius * (1.0 - np.cos(angle))
        felt = rate + GRAVITY * np.sin(pitch) * _feels_gravity(self.config)
        whole = {"ground_speed": speed, "draft": draft, "pitch": pitch, "acceleration": felt}
        on_axles = np.stack(axle_loads(chassis, draft, pitch, rate), axis=1)
        front = np.array([wheel.axle == "front" for wheel in wheels])
        columns = []
        for row in self.of:
            column = whole[row.quantity] if row.kind == "vehicle" else of_wheels[row.quantity] @ row.weight
            if row.kind in ("weight", "transfer"):
                column = column - on_axles @ [row.weight[front].mean(), row.weight[~front].mean()]
            columns.append(column + row.scale)
        return np.stack(columns, axis=1)

    def noise(self, value: Array) -> Array:
        """Sd of each reading (N, R) of these values."""
        sd, options = np.empty_like(value), ESTIMATOR.measurements
        computed = self.config.noise.computed_load.relative * np.sqrt(2.0 * options.load_time_scale / BIN)
        of_slope = options.unknown_slope * (self.config.signals.roll is None)
        load, _, torque = self._forces(self.latents, self.log_soil)
        grip = load * [wheel.radius for wheel in self.config.wheel]
        for k, row in enumerate(self.of):
            if row.kind not in ("channel", "vehicle"):
                of_row = {
                    "weight": computed / 2.0 * row.scale, "transfer": computed / 2.0 * row.scale,
                    "side": np.hypot(computed / np.sqrt(2.0), of_slope) * row.scale,
                    "free": BEARING * grip @ np.abs(row.weight),
                    "coupling": row.bias * np.abs(torque) @ np.abs(row.weight),
                }  # fmt: skip
                sd[:, k] = of_row[row.kind] / np.sqrt(EVERY)
                continue
            noise = getattr(self.config.noise, row.quantity)
            of_mean = noise.of_mean * np.abs(value[:, k]).mean()
            samples = EVERY * BIN * SAMPLE_RATE / (2.0 if row.quantity == "ground_speed" else 1.0)
            sd[:, k] = np.sqrt((noise.absolute**2 + (noise.relative * value[:, k]) ** 2 + of_mean**2) / samples)
        return sd

    def known_to(self) -> tuple[Array, Array]:
        """Sd of the logarithms of the soil's parameters (6,), and of the gain errors (R,)."""
        priors = [self.config.soil_prior[name] for name in Soil._fields]
        soil = [float(np.sqrt(np.log1p((prior.std / prior.value) ** 2))) for prior in priors]
        return np.array(soil), np.array([row.gain for row in self.of])


def _instants(case: Case, recording: Recording, count: int) -> _Instants:
    config, wheels = case.config, [wheel.name for wheel in case.config.wheel]
    of = tuple(_readings(config, case.with_sinkage))

    def truth(name: str) -> Array:
        return _binned(recording.truth["t"], np.asarray(recording.truth[name], float), count)

    latents = [truth(f"{quantity}.{wheel}") for quantity in ("entry_angle", "slip") for wheel in wheels]
    latents += [truth("ground_speed")]
    mapped = [getattr(config.signals, q) is not None for q in ("pitch", "acceleration")]
    latents += [truth(q) * there for q, there in zip(("pitch", "acceleration"), mapped, strict=True)]
    if _feels_gravity(config) and not mapped[0]:
        latents[-1] = latents[-1] + GRAVITY * np.sin(truth("pitch"))
    unknown = np.flatnonzero([True] * (len(latents) - 2) + mapped).tolist()
    readings = []
    for row in of:
        if row.kind in ("channel", "vehicle"):
            channel = recording.channels[row.channel]
            readings.append(_binned(channel.t, channel.value, count))
        else:
            readings.append(np.full(len(latents[0]), row.scale))
    log_soil = np.log(np.array(case.soil, float))
    return _Instants(config, of, np.stack(readings, axis=1), np.stack(latents, axis=1), unknown, log_soil)


def _feels_gravity(config: Config) -> bool:
    mapped = config.signals.acceleration
    return mapped is not None and mapped.kind == "specific_force"


def _binned(t: Array, value: Array, count: int) -> Array:
    """Means of samples (N,) over each EVERY-th of `count` bins."""
    place = np.floor(t / BIN + 1e-9).astype(int)
    kept = place < count
    means = np.bincount(place[kept], value[kept], count) / np.bincount(place[kept], minlength=count)
    return np.asarray(means[::EVERY])


class _Unknowns(NamedTuple):
    """Latents (N, X), and over the whole drive, each less the truth: logarithms of the soil, gains, the share."""

    latents: Array
    soil: Array
    gains: Array
    other: Array

    @property
    def of_drive(self) -> Array:
        return np.concatenate([self.soil, self.gains, self.other])


class _Fit:
    """The plain model, with what is there besides (others, (N, R)), fitted to the readings from the truth on."""

    def __init__(self, drive: _Instants, others: Array, several: bool) -> None:
        self.drive, self.others = drive, others
        soil_sd, gain_sd = drive.known_to()
        self.prior_sd = np.concatenate([soil_sd, gain_sd, [OTHER if several else 0.0]])
        self.free = np.flatnonzero(self.prior_sd > 0.0)
        self.S = drive.noise(drive.model(drive.latents, drive.log_soil))
        self.at = _Unknowns(drive.latents, np.zeros(len(soil_sd)), np.zeros(len(gain_sd)), np.zeros(1))

    def residuals(self, at: _Unknowns) -> Array:
        """Readings less the model, in noise (N, R)."""
        with np.errstate(all="ignore"):
            plain = self.drive.model(at.latents, self.drive.log_soil + at.soil)
        left = self.drive.readings - (1.0 + at.gains) * plain - (1.0 + at.other[0]) * self.others
        return np.asarray(np.nan_to_num(left / self.S, nan=1e9, posinf=1e9, neginf=-1e9))

    def energy(self, at: _Unknowns) -> float:
        """What is to be least."""
        standardised = at.of_drive[self.free] / self.prior_sd[self.free]
        return float(np.sum(self.residuals(at) ** 2) + np.sum(standardised**2))

    def least(self) -> float:
        """Gauss-Newton: a step of all unknowns, after which the latents follow those of the whole drive."""
        self.at = self.relaxed(self.at)
        least = self.energy(self.at)
        for _ in range(ROUNDS):
            tries = (_Unknowns(*(a + b for a, b in zip(self.at, step, strict=True))) for step in self.steps())
            better = next(((e, one) for one in map(self.relaxed, tries) if (e := self.energy(one)) < least), None)
            if better is None:
                break
            before, (least, self.at) = least, better
            if least > (1.0 - ENOUGH) * before:
                break
        return least

    def gap(self) -> float:
        """Reduced chi-square."""
        freedom = self.S.shape[1] - len(self.drive.unknown)
        return float(1.0 + np.sum(self.residuals(self.at) ** 2) / (EVERY * len(self.S) * freedom))

    def relaxed(self, at: _Unknowns) -> _Unknowns:
        """The same with the likeliest latents, each instant for itself."""
        r = self.residuals(at)
        for _ in range(RELAXED):
            step, before = self._latents_step(at, r), np.sum(r**2, axis=1)
            share = np.ones(len(step))
            for _ in range(HALVINGS):
                moved = at._replace(latents=at.latents + share[:, None] * step)
                s = self.residuals(moved)
                worse = np.sum(s**2, axis=1) > before
                if not worse.any():
                    break
                share[worse] /= 2.0
            at = at._replace(latents=np.where(worse[:, None], at.latents, moved.latents))
            r = np.where(worse[:, None], r, s)
            if np.sum(r**2) > (1.0 - ENOUGH) * before.sum():
                break
        return at

    def _latents_step(self, at: _Unknowns, r: Array) -> Array:
        H = self._by_latents(at)
        across, step = np.swapaxes(H, 1, 2), np.zeros_like(at.latents)
        step[:, self.drive.unknown] = np.linalg.solve(across @ H, across @ r[:, :, None])[:, :, 0]
        return np.clip(step, -LONGEST, LONGEST)

    def _by_latents(self, at: _Unknowns) -> Array:
        H = self.drive.by_latents(at.latents, self.drive.log_soil + at.soil)
        return np.asarray(H * ((1.0 + at.gains) / self.S)[:, :, None])

    def steps(self) -> Iterator[_Unknowns]:
        """The Gauss-Newton step and ever more damped ones (Levenberg-Marquardt).

        The latents are eliminated, then the few unknowns of the drive solved for.
        """
        at, drive, S = self.at, self.drive, self.S
        log_soil = drive.log_soil + at.soil
        plain, H = drive.model(at.latents, log_soil), self._by_latents(at)
        soils = [drive.model(at.latents, log_soil + step) - plain for step in STEP * np.eye(6)]
        of_soil = np.stack(soils, axis=2) / STEP * ((1.0 + at.gains) / S)[:, :, None]
        of_gains = np.eye(S.shape[1]) * (plain / S)[:, :, None]
        J = np.concatenate([of_soil, of_gains, (self.others / S)[:, :, None]], axis=2)[:, :, self.free]
        columns, across = np.concatenate([self.residuals(at)[:, :, None], J], axis=2), np.swapaxes(H, 1, 2)
        answer = np.linalg.solve(across @ H, across @ columns)
        left = (columns - H @ answer).reshape(S.size, -1)
        r, J = left[:, 0], left[:, 1:]
        weight = self.prior_sd[self.free] ** -2.0
        information = J.T @ J + np.diag(weight)
        size = np.sqrt(np.diag(information))
        scaled, downhill = information / np.outer(size, size), (J.T @ r - weight * at.of_drive[self.free]) / size
        for damping in DAMPINGS:
            q = np.linalg.solve(scaled + damping * np.eye(len(size)), downhill) / size
            of_drive, latents = np.zeros(len(self.prior_sd)), np.zeros_like(at.latents)
            of_drive[self.free] = q
            latents[:, drive.unknown] = np.clip(answer[:, :, 0] - answer[:, :, 1:] @ q, -LONGEST, LONGEST)
            yield _Unknowns(latents, of_drive[:6], of_drive[6:-1], of_drive[-1:])
