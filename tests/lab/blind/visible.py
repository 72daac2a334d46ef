"""How much of a hidden effect a recording can show at all: with a sensor of each wheel without code of the diagnosis.

The tractor drives without noise and gain errors, with the effect and without.  The plain wheel-soil model h (the rim
integral beside this file) is fitted to the readings y of the drive with it.  Unknown are the latents x of each
instant (entry angles, slips, motion) and, for the whole drive, the soil and the gain errors g, together q, with the
priors of the configuration.

    E = min over x, q of |S^-1 (y - d - (1 + g) h(x, soil))|^2 + |q / sd(q)|^2

S is the noise of the sensors, d the residual of h for the drive without the effect: another effect, and the error of
the rim integral against the simulator.  E is by how much -2 log posterior would fall for an analyst who adds the very
formula of the generator.  Where loads are computed, E is what is left of the same drive to the service's own model,
whose weights contain their uncertainty: chi-square and prior of the fit without the effect.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from soilbus.arrays import Array
from soilbus.config.model import Config
from soilbus.diagnosis.search import FitCache
from soilbus.estimation.assembly import chassis_of, prior_of, rig_of
from soilbus.offline.manoeuvre import record_of_recording
from soilbus.simulator.recording import Recording, simulate
from soilbus.simulator.scenario import SAMPLE_RATE
from soilbus.terra.vehicle import GRAVITY
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


class Shown(NamedTuple):
    """energy: E of the least visible of the hidden effects; gap: the reduced chi-square that this fit leaves, with
    noise: 1 where there is nothing."""

    energy: float
    gap: float


NOTHING = Shown(0.0, 1.0)
"""What a recording shows where nothing is hidden."""


def shown(case: Case) -> Shown:
    """What the recording shows of what is hidden in it; of two effects, of each one beside the other.

    SimulationError if it cannot be driven.
    """
    if not case.parts:
        return NOTHING
    if rig_of(case.config).instrumentation is not None:
        return shown_to_own_model(case)
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


def shown_to_own_model(case: Case) -> Shown:
    """By a fit of the service's model of plain wheels; infinite where no fit ends."""
    record = record_of_recording(case.id, driven_without_noise(case, case.parts), case.config)
    fitted = FitCache([record], prior_of(case.config), record.options).fit(record.training.effects)
    if fitted is None:
        return Shown(np.inf, np.inf)
    left = fitted.held_out_chi2 * fitted.checked_rows
    return Shown(fitted.neg2_log_posterior + left, 1.0 + fitted.held_out_chi2)


def driven_without_noise(case: Case, parts: tuple[Hidden, ...]) -> Recording:
    """The drive with these parts, and sensors without noise or gain errors."""
    how = together(parts)
    quiet = case.config.model_copy(update={"noise": case.config.noise.scaled(0.0)})
    driven = simulate(how.tractor(quiet), how.way(case.scenario), case.seed, how.effects)
    return how.after(driven)


def _readings(config: Config, with_sinkage: bool) -> Iterator[tuple[str, str]]:
    """Channel and quantity: load, torque and speed of each wheel, sinkage where measured, then what the vehicle has."""
    for quantity in ("load", "torque", "speed", *["sinkage"] * with_sinkage):
        yield from ((f"{quantity}.{wheel.name}", quantity) for wheel in config.wheel)
    for quantity in ("ground_speed", "draft", "pitch", "acceleration"):
        if getattr(config.signals, quantity) is not None:
            yield quantity, quantity


@dataclass(frozen=True)
class _Instants:
    """A drive in bins: channel and quantity of the readings, their values (N, R), and the true latents (N, X).

    Latents: entry angle and slip of each wheel, ground speed, pitch, acceleration; those of the last two that no
    sensor measures are known to be those of steady speed on level ground.  unknown: columns of the others.
    """

    config: Config
    of: tuple[tuple[str, str], ...]
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
        found = {"ground_speed": speed, "draft": draft, "pitch": pitch, "acceleration": rate}
        for quantity, values in of_wheels.items():
            found |= {f"{quantity}.{wheel.name}": values[:, i] for i, wheel in enumerate(wheels)}
        return np.stack([found[channel] for channel, _ in self.of], axis=1)

    def noise(self, value: Array) -> Array:
        """Sd of each reading (N, R) of these values."""
        sd = np.empty_like(value)
        for k, (_, quantity) in enumerate(self.of):
            noise = getattr(self.config.noise, quantity)
            of_mean = noise.of_mean * np.abs(value[:, k]).mean()
            samples = EVERY * BIN * SAMPLE_RATE / (2.0 if quantity == "ground_speed" else 1.0)
            sd[:, k] = np.sqrt((noise.absolute**2 + (noise.relative * value[:, k]) ** 2 + of_mean**2) / samples)
        return sd

    def known_to(self) -> tuple[Array, Array]:
        """Sd of the logarithms of the soil's parameters (6,), and of the gain errors (R,)."""
        priors = [self.config.soil_prior[name] for name in Soil._fields]
        soil = [float(np.sqrt(np.log1p((prior.std / prior.value) ** 2))) for prior in priors]
        return np.array(soil), np.array([getattr(self.config.noise, quantity).gain for _, quantity in self.of])


def _instants(case: Case, recording: Recording, count: int) -> _Instants:
    config, wheels = case.config, [wheel.name for wheel in case.config.wheel]
    of = tuple(_readings(config, case.with_sinkage))

    def truth(name: str) -> Array:
        return _binned(recording.truth["t"], np.asarray(recording.truth[name], float), count)

    latents = [truth(f"{quantity}.{wheel}") for quantity in ("entry_angle", "slip") for wheel in wheels]
    latents += [truth("ground_speed")]
    mapped = [getattr(config.signals, q) is not None for q in ("pitch", "acceleration")]
    latents += [truth(q) * there for q, there in zip(("pitch", "acceleration"), mapped, strict=True)]
    unknown = np.flatnonzero([True] * (len(latents) - 2) + mapped).tolist()
    readings = [_binned(recording.channels[name].t, recording.channels[name].value, count) for name, _ in of]
    log_soil = np.log(np.array(case.soil, float))
    return _Instants(config, of, np.stack(readings, axis=1), np.stack(latents, axis=1), unknown, log_soil)


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
