"""Hidden effects of the vehicle and its sensors: drive line losses, lags, slope, draft, loads, radius, inertia."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from soilbus.arrays import Array
from soilbus.config.model import Config
from soilbus.simulator.recording import Recording
from soilbus.simulator.scenario import Scenario
from soilbus.terra.effects.effect import Surroundings
from tests.lab.blind.form import Form, Hidden, Setting, Sizes, by_hooks


def _efficiency(torque: Array, around: Surroundings, values: Sizes) -> Array:
    return torque / (1.0 - values["size"])


def _dragging(torque: Array, around: Surroundings, values: Sizes) -> Array:
    return torque + values["size"]


def _viscous(torque: Array, around: Surroundings, values: Sizes) -> Array:
    return np.asarray(torque + values["size"] * around.wheel_speed)


def _delayed(torque: Array, around: Surroundings, values: Sizes) -> Array:
    """Late, as from a queue."""
    t = np.ravel(around.t)
    return np.stack([np.interp(t - values["size"], t, of_wheel) for of_wheel in torque.T], axis=1)


def _averaged(torque: Array, around: Surroundings, values: Sizes) -> Array:
    """The mean of the time `size` [s] before, as of a node that samples faster than it sends."""
    t = np.ravel(around.t)
    longer = np.concatenate([[t[0] - values["size"]], t])
    out = []
    for of_wheel in torque.T:
        since = np.concatenate([of_wheel[:1], of_wheel])
        sums = np.concatenate([[0.0], np.cumsum(np.diff(longer) * (since[1:] + since[:-1]) / 2.0)])
        out.append((sums[1:] - np.interp(t - values["size"], longer, sums)) / values["size"])
    return np.stack(out, axis=1)


def filtered(torque: Array, around: Surroundings, values: Sizes) -> Array:
    """Through a first-order low pass of this time constant."""
    share = -np.expm1(-float(around.t[1, 0] - around.t[0, 0]) / values["size"])
    out = torque.copy()
    for i in range(1, len(torque)):
        out[i] = out[i - 1] + share * (torque[i] - out[i - 1])
    return out


def _swaying_slope(around: Surroundings, values: Sizes) -> Array:
    """A constant and two sines of the way, in no reading."""
    x = np.ravel(around.distance)
    slope = values["size"] * (0.4 + np.sin(2.0 * np.pi * x / 110.0) + 0.5 * np.sin(2.0 * np.pi * x / 61.0 + 1.0))
    return np.asarray(around.mass * 9.80665 * np.sin(slope))


def _hill(size: float, setting: Setting) -> Hidden:
    """A real hill that the tractor climbs and leaves again; the pitch sensor leaves it out.

    The loads move with it, other than with a mere resistance.
    """
    top, half_width = setting.rng.uniform(60.0, 110.0), 25.0
    at = np.arange(0.0, 400.0, 4.0)

    def pitch(x: Array) -> Array:
        away = (x - top) / half_width
        return -size * 1.65 * away * np.exp(-(away**2) / 2.0)  # steepest: size

    def way(scenario: Scenario) -> Scenario:
        knots = np.array(scenario.slope)
        slope = np.interp(at, knots[:, 0], knots[:, 1]) + pitch(at)
        return replace(scenario, slope=tuple(zip(at.tolist(), slope.tolist(), strict=True)))

    def after(recording: Recording) -> Recording:
        column = recording.channels.get("pitch")
        if column is None:
            return recording
        x = np.interp(column.t, recording.truth["t"], recording.truth["distance"])
        unseen = replace(column, value=column.value - np.interp(x, at, pitch(at)))
        return replace(recording, channels=recording.channels | {"pitch": unseen})

    return Hidden(way=way, after=after)


def _no_pitch_sensor(size: float, setting: Setting) -> Hidden:
    """An undulating field, and a tractor on which nothing measures the pitch."""
    x = np.cumsum(setting.rng.uniform(15.0, 35.0, 14)) - 20.0
    slope = size * setting.rng.uniform(-1.0, 1.0, 14)

    def configured(config: Config) -> Config:
        return config.model_copy(update={"signals": config.signals.model_copy(update={"pitch": None})})

    return Hidden(
        configured=configured,
        tractor=configured,
        way=lambda scenario: replace(scenario, slope=tuple(zip(x.tolist(), slope.tolist(), strict=True))),
    )


def _towed(around: Surroundings, values: Sizes) -> Array:
    """An implement of this mass behind a hitch that measures soil forces only."""
    return np.ravel(values["size"] * np.asarray(around.acceleration))


def _flywheel(torque: Array, around: Surroundings, values: Sizes) -> Array:
    """Torque read at motors that have to spin up themselves."""
    omega, t = around.wheel_speed, around.t
    rate = np.zeros_like(omega)
    rate[1:-1] = (omega[2:] - omega[:-2]) / (t[2:] - t[:-2])
    rate[0], rate[-1] = rate[1], rate[-2]
    return np.asarray(torque + values["size"] * rate)


def _offsets(shares: tuple[float, ...]) -> Callable[[float, Setting], Hidden]:
    """On some of the wheels, in these shares of the size, on a random side."""

    def hide(size: float, setting: Setting) -> Hidden:
        order = np.array([[0, 1, 2, 3], [1, 0, 3, 2], [2, 3, 0, 1], [3, 2, 1, 0]][setting.rng.integers(4)])
        error = setting.rng.choice([-1.0, 1.0]) * size * np.array(shares)[order]
        return by_hooks(load=lambda around, values: error + 0.0 * around.load)(size, setting)

    return hide


def _constant_error(draft: Array, around: Surroundings, values: Sizes) -> Array:
    return values["size"] + 0.0 * draft


def _warming_up(draft: Array, around: Surroundings, values: Sizes) -> Array:
    """The zero is off by a quarter more while the cell gets warm: its beam soon, what it is bolted to slowly."""
    t = np.ravel(around.t)
    return values["size"] * (1.0 + 0.12 * (np.exp(-t / 10.0) + np.exp(-t / 90.0)))


def _steeper(draft: Array, around: Surroundings, values: Sizes) -> Array:
    return values["size"] * draft


def _bent(draft: Array, around: Surroundings, values: Sizes) -> Array:
    """A span that grows with the draft."""
    return values["size"] * draft * (0.7 + 0.3 * np.abs(draft) / 5000.0)


def _tyres(axles: dict[str | None, float]) -> Callable[[float, Setting], Hidden]:
    """Other tyres on the tractor than in the configuration: their radii differ by a share of the size."""

    def hide(size: float, setting: Setting) -> Hidden:
        sign = setting.rng.choice([-1.0, 1.0])

        def tractor(config: Config) -> Config:
            scale = {axle: 1.0 + sign * size * share for axle, share in axles.items()}
            fitted = [w.model_copy(update={"radius": w.radius * scale.get(w.axle, 1.0)}) for w in config.wheel]
            return config.model_copy(update={"wheel": fitted})

        return Hidden(tractor=tractor)

    return hide


def _signed(hide: Callable[[float, Setting], Hidden]) -> Callable[[float, Setting], Hidden]:
    return lambda size, setting: hide(size * setting.rng.choice([-1.0, 1.0]), setting)


FORMS = (
    Form("drivetrain_loss", "efficiency", "T / eta", "1", (0.022, 0.024), 0.15, by_hooks(torque=_efficiency)),
    Form("drivetrain_loss", "constant", "drag without load", "N m", (17.0, 40.0), 150.0, by_hooks(torque=_dragging)),
    Form("drivetrain_loss", "viscous", "churning oil", "N m s", (1.2, 1.2), 50.0, by_hooks(torque=_viscous)),
    Form("torque_lag", "delay", "as from a queue", "s", (0.01, 0.01), 0.4, by_hooks(torque=_delayed)),
    Form("torque_lag", "averaged", "mean of a time before", "s", (0.022, 0.022), 0.8, by_hooks(torque=_averaged)),
    Form("grade", "sines", "constant and sines of the way", "rad", (0.0005, 0.0005), 0.04,
         by_hooks(resistance=_swaying_slope)),
    Form("grade", "hill", "a hill with its load transfer", "rad", (0.0006, 0.0006), 0.08, _hill),
    Form("grade", "no_sensor", "undulating field, pitch not measured", "rad", (0.0006, 0.0006), 0.08,
         _no_pitch_sensor),
    Form("inertia", "towed", "implement behind the hitch", "kg", (60.0, 60.0), 1500.0, by_hooks(resistance=_towed)),
    Form("inertia", "flywheel", "motors ahead of the gears", "kg m^2", (2.2, 2.2), 120.0, by_hooks(torque=_flywheel)),
    Form("wheel_load_offset", "one", "zero of one cell", "N", (155.0, 190.0), 900.0, _offsets((1.0, 0.0, 0.0, 0.0))),
    Form("wheel_load_offset", "two", "zeros of two cells", "N", (110.0, 130.0), 900.0,
         _offsets((1.0, 0.0, 0.0, -0.6))),
    Form("draft_offset", "constant", "zero of the cell", "N", (105.0, 600.0), 1500.0,
         _signed(by_hooks(draft=_constant_error))),
    Form("draft_offset", "warming", "zero that settles with warmth", "N", (93.0, 250.0), 1500.0,
         _signed(by_hooks(draft=_warming_up))),
    Form("draft_gain", "gain", "span of the cell", "1", (0.042, 0.042), 0.25, _signed(by_hooks(draft=_steeper))),
    Form("draft_gain", "bent", "span that grows with the draft", "1", (0.04, 0.04), 0.25,
         _signed(by_hooks(draft=_bent))),
    Form("rolling_radius", "one_axle", "other tyres at the front", "1", (0.03, 0.025), 0.1, _tyres({"front": 1.0})),
    Form("rolling_radius", "both_axles", "other tyres all round", "1", (0.02, 0.018), 0.08,
         _tyres({"front": 1.0, "rear": 0.7})),
)  # fmt: skip
