"""A second generator of drives for the reference machines, by formulas and dynamics of its own.

    wheel         pull and torque of load and slip by one of three laws: `Bekker`, `Cone`, `Rim`
    motor         J dw/dt = clip(G (command - w), limit) - sum of T_i,   w: mean speed of its wheels
    differential  J d(w_l - w_r)/dt = T_r - T_l - friction |T_l + T_r| tanh((w_l - w_r) / w_0)
    free wheel    J dw/dt = -T - drag load radius
    vehicle       m dV/dt = sum of P_i - draft - m g sin(pitch)

Nothing of soilbus is used; a machine is read from its TOML.  Bounce and roll of each axle on its tyres (1.5 to 3 Hz,
lightly damped, driven by a random ground) shake the wheel loads, and the body leans with a lag.  Each message has its
own rate, phase, jitter and delay, each channel its noise and fixed gain error.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RectBivariateSpline

import other_wheel

Array = NDArray[Any]

STEP = 0.005
"""Step of the integration, and of the truth [s]."""
GRAVITY = 9.80665
INERTIA = 15.0
"""Of a wheel with its share of the drive line [kg m^2]."""
DROOP = 0.1
"""Speed [rad/s] by which a motor falls behind its command at full torque."""
SLIDING = 0.05
"""Difference of speeds [rad/s] at which the friction of a differential is three quarters of its own."""
LEAN = 0.1
"""Time constant [s] with which the body leans over on its tyres."""
DELAYS = (0.02, 0.06)
"""Range of the delay of a message [s]."""
MODES = (1.5, 3.0)
"""Range of the natural frequencies of bounce and roll of an axle [Hz]."""
DAMPING = 0.12
"""Damping ratio of these: tyres without dampers."""


class Bekker(NamedTuple):
    """Plate sinkage and shear of a flat contact: Bekker 1960, in closed form.

    z = (3 W / ((3 - n) b K_L sqrt(2 r)))^(2 / (2 n + 1)), l = sqrt(2 r z - z^2), R = b K_L z^(n+1) / (n + 1)
    H = (b l c + W tan phi) (1 - K / (s l) (1 - exp(-s l / K))), P = H - R, T = r H
    """

    k_c: float = 5300.0
    k_phi: float = 1.515e6
    n: float = 0.7
    phi: float = math.radians(29.0)
    c: float = 1700.0
    K: float = 0.025

    def forces(self, load: Array, slip: Array, radius: float, width: float) -> tuple[Array, Array, Array]:
        """Pull [N], torque [N m] and sinkage [m]."""
        stiffness = self.k_c / width + self.k_phi
        depth = (3.0 * load / ((3.0 - self.n) * width * stiffness * math.sqrt(2.0 * radius))) ** (
            2.0 / (2.0 * self.n + 1.0)
        )
        depth = np.minimum(depth, 0.9 * radius)
        length = np.sqrt(2.0 * radius * depth - depth**2)
        resistance = width * stiffness * depth ** (self.n + 1.0) / (self.n + 1.0)
        sheared = np.maximum(np.abs(slip) * length / self.K, 1e-9)
        share = np.sign(slip) * (1.0 + np.expm1(-sheared) / sheared)
        thrust = (width * length * self.c + load * math.tan(self.phi)) * share
        return thrust - resistance, radius * thrust, depth


class Cone(NamedTuple):
    """Mobility number of a bias-ply tyre: Brixius 1987, as the MAVS code has it, for a cone index [Pa].

    B = CI b d / W (1 + 5 delta/h) / (1 + 3 b/d), gross traction 0.88 (1 - exp(-0.1 B)) (1 - exp(-7.5 s)),
    motion resistance 1 / B + 0.04 + 0.5 s / sqrt(B), both over the load
    """

    cone_index: float = 9.0e5
    deflection: float = 0.2

    def forces(self, load: Array, slip: Array, radius: float, width: float) -> tuple[Array, Array, Array]:
        """Pull [N], torque [N m]; no sinkage."""
        across = 2.0 * radius
        number = self.cone_index * width * across / load * (1.0 + 5.0 * self.deflection) / (1.0 + 3.0 * width / across)
        gross = 0.88 * -np.expm1(-0.1 * number) * np.sign(slip) * -np.expm1(-7.5 * np.abs(slip))
        resistance = 1.0 / number + 0.04 + 0.5 * np.abs(slip) / np.sqrt(number)
        return load * (gross - resistance), radius * load * gross, np.full(np.broadcast(load, slip).shape, np.nan)


class Rim(NamedTuple):
    """Stresses along the rim: Wong & Reece 1967, by `other_wheel`, with a form of the contact of its own."""

    soil: Bekker = Bekker()
    contact: other_wheel.Contact = other_wheel.Contact()

    def forces(self, load: Array, slip: Array, radius: float, width: float) -> tuple[Array, Array, Array]:
        """Pull [N], torque [N m] and sinkage [m]."""
        load, slip = np.broadcast_arrays(load, slip)
        flat = load.ravel(), slip.ravel()
        angle = other_wheel.carrying(self.soil, self.contact, *flat, radius, width)
        _, pull, torque = other_wheel.forces(self.soil, self.contact, angle, flat[1], radius, width)
        return tuple(a.reshape(load.shape) for a in (pull, torque, radius * (1.0 - np.cos(angle))))


Law = Bekker | Cone | Rim


class Machine(NamedTuple):
    """A two-axle vehicle with its wheels FL, FR, RL, RR; lengths m, mass kg, torques N m.

    motors: wheels of each; limit: greatest torque of each, sum over its wheels; track is 1.3 m where not given.
    noise: absolute, relative, of the mean, and gain error by quantity.
    """

    mass: float
    wheelbase: float
    cg_ahead: float
    cg_height: float
    hitch: float
    track: float
    radius: tuple[float, ...]
    width: tuple[float, ...]
    motors: tuple[tuple[int, ...], ...]
    limit: tuple[float, ...]
    specific_force: bool
    noise: dict[str, tuple[float, float, float, float]]

    @property
    def free(self) -> tuple[int, ...]:
        """Wheels without a motor."""
        return tuple(i for i in range(4) if all(i not in motor for motor in self.motors))

    def axles(self, draft: Any, along: Any) -> tuple[Any, Any]:
        """Loads [N] of the front and the rear axle at a draft [N] and a force of slope and inertia [N]."""
        weight = self.mass * GRAVITY
        front = (weight * self.cg_ahead - draft * self.hitch - along * self.cg_height) / self.wheelbase
        return front, weight - front


WHEELS = ("FL", "FR", "RL", "RR")
_NOISE = {
    "torque": (0.0, 0.0, 0.02, 0.01), "load": (0.0, 0.02, 0.0, 0.01), "speed": (0.0, 0.003, 0.0, 0.002),
    "ground_speed": (0.0, 0.01, 0.0, 0.003), "draft": (60.0, 0.0, 0.0, 0.01), "sinkage": (0.005, 0.0, 0.0, 0.0),
    "pitch": (0.003, 0.0, 0.0, 0.0), "acceleration": (0.02, 0.0, 0.0, 0.0), "yaw_rate": (0.01, 0.0, 0.0, 0.0),
    "roll": (0.005, 0.0, 0.0, 0.0),
}  # fmt: skip


def machine(path: Path) -> Machine:
    """The machine of a configuration whose wheels are FL, FR, RL, RR and whose motors are of wheels or of axles."""
    raw = tomllib.loads(path.read_text(encoding="utf-8"))
    vehicle, wheels = raw["vehicle"], raw["wheel"]
    if [wheel["name"] for wheel in wheels] != list(WHEELS):
        raise ValueError(f"{path}: the wheels must be {', '.join(WHEELS)}")

    def number(key: str) -> float:
        value = vehicle[key]
        return float(value["value"] if isinstance(value, dict) else value)

    motors: list[tuple[int, ...]] = []
    limits: list[float] = []
    for axle in raw.get("axle", []):
        motors.append(tuple(i for i, wheel in enumerate(wheels) if wheel["axle"] == axle["name"]))
        limits.append(float(axle["max_torque"]))
    for i, wheel in enumerate(wheels):
        if "torque" in wheel:
            motors.append((i,))
            limits.append(float(wheel["max_torque"]))
    keys = ("absolute", "relative", "of_mean", "gain")
    given = {name: tuple(float(of.get(key, 0.0)) for key in keys) for name, of in raw.get("noise", {}).items()}
    acceleration = raw["signals"].get("acceleration", "")
    return Machine(
        number("mass"), number("wheelbase"), number("cg_ahead_of_rear_axle"), number("cg_height"),
        number("hitch_height"), number("track") if "track" in vehicle else 1.3,
        tuple(float(wheel["radius"]) for wheel in wheels), tuple(float(wheel["width"]) for wheel in wheels),
        tuple(motors), tuple(limits),
        isinstance(acceleration, dict) and acceleration.get("kind") == "specific_force",
        _NOISE | given,  # type: ignore[arg-type]
    )  # fmt: skip


@dataclass(frozen=True)
class Recording:
    """Samples (t [s], value in SI) by channel name, and the truth.

    channels: all that the machine could measure, torque.W, speed.W, load.W, sinkage.W of each wheel, torque.A, speed.A,
    load.A of each axle, and of the vehicle; a test takes those that its configuration maps.
    truth: columns by name at instants STEP apart, with slip.W and drawbar_pull.W; largest_draft [N] on the level.
    """

    channels: dict[str, tuple[Array, Array]]
    truth: dict[str, Array]
    machine: Machine
    law: Law
    largest_draft: float

    def samples(self, names: Iterable[str]) -> dict[str, tuple[Array, Array]]:
        """Those of some channels, as `soilbus.sensors.bins.Bins.add` takes them."""
        return {name: self.channels[name] for name in names if name in self.channels}


def largest_draft(machine: Machine, law: Law, max_slip: float = 0.6) -> float:
    """Largest draft [N] on level ground, by trying slips; nan where the machine cannot move.

    By trying: at each slip of all motors the draft is bisected that all wheels together pull, loads shifted by it, free
    wheels at the slip without torque, both sides alike; drafts at which a motor would pass its limit do not count.
    """
    slips = np.linspace(0.01, max_slip, 60)
    rolling = {i: _slip_without_torque(machine, law, i) for i in machine.free}
    torque = np.zeros((4, len(slips)))
    low, high = np.full(len(slips), -machine.mass * GRAVITY), np.full(len(slips), machine.mass * GRAVITY)
    for _ in range(24):
        draft = (low + high) / 2.0
        pull = np.zeros(len(slips))
        for axle, on_axle in zip((0, 2), machine.axles(draft, 0.0), strict=True):
            load = np.maximum(on_axle / 2.0, 100.0)
            at = np.interp(load, *rolling[axle]) if axle in rolling else slips
            force, torque[axle], _ = law.forces(load, at, machine.radius[axle], machine.width[axle])
            torque[axle + 1] = torque[axle]
            pull += 2.0 * force
        low, high = np.where(pull > draft, draft, low), np.where(pull > draft, high, draft)
    weak = [torque[list(motor)].sum(0) > most for motor, most in zip(machine.motors, machine.limit, strict=True)]
    possible = low[(low > 0.0) & ~np.any(weak, axis=0)]
    return float(possible.max()) if len(possible) else math.nan


def _slip_without_torque(machine: Machine, law: Law, wheel: int) -> tuple[Array, Array]:
    """Loads [N] and the slips at which a free wheel under them has no torque."""
    loads, slips = machine.mass * GRAVITY * np.linspace(0.02, 0.6, 16), np.linspace(-0.6, 0.1, 36)
    load, slip = np.meshgrid(loads, slips, indexing="ij")
    torque = law.forces(load, slip, machine.radius[wheel], machine.width[wheel])[1]
    return loads, np.array([np.interp(0.0, row, slips) for row in torque])


def drive(
    machine: Machine,
    law: Law,
    seed: int,
    duration: float = 80.0,
    shake: float = 0.10,
    friction: float = 0.05,
    drag: float = 0.004,
    work: tuple[float, float] = (0.40, 0.18),
    steepest: float = 0.04,
) -> Recording:
    """Drive with a draft that wanders about a share of the largest one, over a rough field.

    Parameters
    ----------
    machine, law
        What drives, and on what.
    seed
        Picks the drive and all errors.
    duration
        [s].
    shake
        Rms of a wheel's load about its static one, over it.
    friction
        Of a differential: greatest difference of its torques over their sum.
    drag
        Torque of a free wheel's bearing over load and radius.
    work
        Mean and sd of the draft over the largest one on the level, which it passes only if the mean does; (0, 0) tows
        nothing.
    steepest
        Sd of the slope [rad].
    """
    rng = np.random.default_rng([seed, 20261])
    most = largest_draft(machine, law)
    t = np.arange(round(duration / STEP)) * STEP
    mean, sd = work
    draft = most * (mean + sd * wander(rng, t, 0.03, 0.3) + 0.2 * sd * wander(rng, t, 0.4, 1.5))
    draft = np.clip(draft, min(200.0, mean * most), max(0.9, mean) * most)
    pitch, roll = steepest * wander(rng, t, 0.01, 0.06), 0.03 * wander(rng, t, 0.02, 0.1)
    rim = np.clip(1.6 + 0.35 * wander(rng, t, 0.02, 0.12), 0.8, 2.6)
    command = [rim * (1.0 + 0.012 * wander(rng, t, 0.05, 0.4)) / machine.radius[motor[0]] for motor in machine.motors]
    shaken = np.stack([_mode(rng, len(t), shake / math.sqrt(2.0)) for _ in range(4)])  # bounce, roll of each axle
    truth = _integrated(
        machine, law, {"t": t, "draft": draft, "pitch": pitch, "roll": roll}, command, shaken, (friction, drag)
    )
    return Recording(_measured(machine, truth, rng), truth, machine, law, most)


def _integrated(
    machine: Machine,
    law: Law,
    given: dict[str, Array],
    command: Sequence[Array],
    shaken: Array,
    losses: tuple[float, float],
) -> dict[str, Array]:
    """The drive: each speed by a linearly implicit step, as the soil is stiff."""
    heaviest = 0.7 * machine.mass * GRAVITY
    tables = [_table(law, machine.radius[i], machine.width[i], heaviest) for i in range(4)]
    r, n = machine.radius, len(given["t"])
    names = ("load", "torque", "speed", "slip", "drawbar_pull", "sinkage")
    out = {name: np.empty((4, n)) for name in names}
    speed, acceleration, motor_torque = np.empty(n), np.empty(n), np.empty((len(command), n))
    omega = [float(command[0][0]) * r[machine.motors[0][0]] / r[i] for i in range(4)]
    v, a = 0.85 * omega[0] * r[0], 0.0
    drafts, slopes, rolls = given["draft"].tolist(), np.sin(given["pitch"]).tolist(), np.sin(given["roll"]).tolist()
    commands, shakes = [c.tolist() for c in command], shaken.T.tolist()
    on_front, on_rear = machine.axles(drafts[0], 0.0)
    friction, drag = losses
    for k in range(n):
        along = machine.mass * (a + GRAVITY * slopes[k])
        front, rear = machine.axles(drafts[k], along)
        on_front += (front - on_front) * STEP / LEAN
        on_rear += (rear - on_rear) * STEP / LEAN
        tilt = 2.0 * machine.cg_height / machine.track * rolls[k]
        x = shakes[k]
        load = [
            max(0.5 * on_front * (1.0 + x[0] + x[1] - tilt), 200.0),
            max(0.5 * on_front * (1.0 + x[0] - x[1] + tilt), 200.0),
            max(0.5 * on_rear * (1.0 + x[2] + x[3] - tilt), 200.0),
            max(0.5 * on_rear * (1.0 + x[2] - x[3] + tilt), 200.0),
        ]
        slip = [1.0 - v / (r[i] * omega[i]) for i in range(4)]
        here = [tables[i].at(load[i], slip[i]) for i in range(4)]
        beyond = [tables[i].at(load[i], slip[i] + 1e-3) for i in range(4)]
        pull, torque = [f[0] for f in here], [f[1] for f in here]
        by_slip = [((b[0] - f[0]) / 1e-3, (b[1] - f[1]) / 1e-3) for f, b in zip(here, beyond, strict=True)]
        stiff = [by_slip[i][1] * v / (r[i] * omega[i] ** 2) for i in range(4)]  # torque by speed of the wheel
        for m, wheels in enumerate(machine.motors):
            limit = machine.limit[m]
            now = sum(omega[i] for i in wheels) / len(wheels)
            given_torque = max(min((commands[m][k] - now) * limit / DROOP, limit), -limit)
            held = limit / DROOP if abs(given_torque) < limit else 0.0
            resisting = sum(torque[i] for i in wheels)
            inertia = INERTIA * len(wheels)
            change = (
                STEP * (given_torque - resisting) / (inertia + STEP * (held + max(sum(stiff[i] for i in wheels), 0.0)))
            )
            motor_torque[m, k] = given_torque - held * change
            half = 0.0
            if len(wheels) == 2:
                left, right = wheels
                apart = omega[left] - omega[right]
                rubbing = friction * abs(resisting)
                split = torque[right] - torque[left] - rubbing * math.tanh(apart / SLIDING)
                slope = (stiff[left] + stiff[right]) / 2.0 + rubbing / SLIDING / math.cosh(
                    min(abs(apart) / SLIDING, 30.0)
                ) ** 2
                half = 0.5 * STEP * split / (INERTIA + STEP * max(slope, 0.0))
            for i, sign in zip(wheels, (1.0, -1.0), strict=False):
                omega[i] = max(omega[i] + change + sign * half, 0.05 / r[i])
        for i in machine.free:
            free = -torque[i] - drag * load[i] * r[i]
            omega[i] = max(omega[i] + STEP * free / (INERTIA + STEP * max(stiff[i], 0.0)), 0.05 / r[i])
        a = (sum(pull) - drafts[k]) / machine.mass - GRAVITY * slopes[k]
        by_v = -sum(by_slip[i][0] / (r[i] * omega[i]) for i in range(4)) / machine.mass
        a /= 1.0 - STEP * min(by_v, 0.0)
        speed[k], acceleration[k] = v, a
        for i in range(4):
            for name, value in zip(names, (load[i], torque[i], omega[i], slip[i], pull[i], here[i][2]), strict=True):
                out[name][i, k] = value
        v = max(v + STEP * a, 0.02)
    truth = given | {"ground_speed": speed, "acceleration": acceleration, "distance": np.cumsum(speed) * STEP}
    truth |= {f"{name}.{wheel}": out[name][i] for name in names for i, wheel in enumerate(WHEELS)}
    for m, wheels in enumerate(machine.motors):
        name = WHEELS[wheels[0]] if len(wheels) == 1 else {0: "front", 2: "rear"}[wheels[0]]
        truth[f"motor_torque.{name}"] = motor_torque[m]
    return truth


class _Table:
    """Pull, torque and sinkage of a wheel on straight lines between near loads and slips."""

    SLIPS = np.arange(-0.6, 0.95, 0.005)
    KNOTS = np.concatenate([np.arange(-0.6, -0.1, 0.05), np.arange(-0.1, 0.2, 0.01), np.arange(0.2, 0.96, 0.05)])

    def __init__(self, law: Law, radius: float, width: float, heaviest: float) -> None:
        self.loads = np.linspace(0.02, 1.0, 50) * heaviest
        coarse, slips = (self.loads, self.SLIPS) if not isinstance(law, Rim) else (self.loads[::7], self.KNOTS)
        load, slip = np.meshgrid(coarse, slips, indexing="ij")
        rows: Sequence[Array] = law.forces(load, slip, radius, width)
        if isinstance(law, Rim):
            rows = [RectBivariateSpline(coarse, slips, row, kx=3, ky=3)(self.loads, self.SLIPS) for row in rows]
        self.rows = np.stack(rows, axis=-1).tolist()
        self.low, self.step = float(self.loads[0]), float(self.loads[1] - self.loads[0])

    def at(self, load: float, slip: float) -> list[float]:
        """Pull [N], torque [N m], sinkage [m]."""
        x, y = (load - self.low) / self.step, (slip + 0.6) / 0.005
        i, j = min(max(int(x), 0), len(self.rows) - 2), min(max(int(y), 0), len(self.SLIPS) - 2)
        x, y = min(max(x - i, 0.0), 1.0), min(max(y - j, 0.0), 1.0)
        p, q = self.rows[i], self.rows[i + 1]
        return [
            (1.0 - x) * ((1.0 - y) * p0 + y * p1) + x * ((1.0 - y) * q0 + y * q1)
            for p0, p1, q0, q1 in zip(p[j], p[j + 1], q[j], q[j + 1], strict=True)
        ]


@cache
def _table(law: Law, radius: float, width: float, heaviest: float) -> _Table:
    """The table of a wheel under loads up to the heaviest [N], made once."""
    return _Table(law, radius, width, heaviest)


def wander(rng: np.random.Generator, t: Array, slowest: float, fastest: float, waves: int = 5) -> Array:
    """Sum of sines between two frequencies [Hz], of unit standard deviation."""
    edges = np.geomspace(slowest, fastest, waves + 1)
    f, phase = rng.uniform(edges[:-1], edges[1:]), rng.uniform(0.0, 2.0 * math.pi, waves)
    return np.asarray(np.sqrt(2.0 / waves) * np.sin(2.0 * math.pi * f[:, None] * t + phase[:, None]).sum(0))


def _mode(rng: np.random.Generator, n: int, rms: float) -> Array:
    """A lightly damped oscillation (n,) driven by a random ground."""
    w = 2.0 * math.pi * rng.uniform(*MODES)
    x, v = 0.0, 0.0
    out = np.empty(n)
    for i, ground in enumerate((math.sqrt(4.0 * DAMPING * w**3 / STEP) * rng.standard_normal(n)).tolist()):
        v += STEP * (ground - 2.0 * DAMPING * w * v - w**2 * x)
        x += STEP * v
        out[i] = x
    return rms * out


def _measured(machine: Machine, truth: Mapping[str, Array], rng: np.random.Generator) -> dict[str, tuple[Array, Array]]:
    """Late and noisy samples of all that could be measured."""
    t = truth["t"]
    felt = truth["acceleration"] + (GRAVITY * np.sin(truth["pitch"]) if machine.specific_force else 0.0)
    columns = {name: truth[name] for name in ("draft", "pitch", "roll", "ground_speed")} | {"acceleration": felt}
    columns |= {"yaw_rate": np.zeros(len(t))}
    for quantity in ("speed", "load", "sinkage", "torque"):
        columns |= {f"{quantity}.{wheel}": truth[f"{quantity}.{wheel}"] for wheel in WHEELS}
    for axle, wheels in (("front", WHEELS[:2]), ("rear", WHEELS[2:])):
        columns[f"load.{axle}"] = sum((truth[f"load.{w}"] for w in wheels), start=np.zeros(len(t)))
        columns[f"speed.{axle}"] = sum((truth[f"speed.{w}"] for w in wheels), start=np.zeros(len(t))) / 2.0
    columns |= {name.removeprefix("motor_"): truth[name] for name in truth if name.startswith("motor_torque.")}
    channels: dict[str, tuple[Array, Array]] = {}
    clocks: dict[str, tuple[Array, float]] = {}
    for name, column in columns.items():
        quantity, _, part = name.partition(".")
        message = f"{quantity}.{part}" if quantity == "torque" else quantity
        if message not in clocks:
            clocks[message] = (
                _clock(rng, 0.04 if quantity == "ground_speed" else 0.02, float(t[-1])),
                rng.uniform(*DELAYS),
            )
        stamps, delay = clocks[message]
        channels[name] = stamps, _disturbed(rng, np.interp(stamps - delay, t, column), *machine.noise[quantity])
    return channels


def _clock(rng: np.random.Generator, period: float, duration: float) -> Array:
    """Stamps of a message: a period off by up to 200 ppm, a phase of its own, queues of up to 0.5 ms."""
    own = period * (1.0 + rng.uniform(-2e-4, 2e-4))
    stamps = rng.uniform(0.0, own) + own * np.arange(int(duration / own) - 1)
    return np.asarray(stamps + rng.uniform(0.0, 5e-4, len(stamps)))


def _disturbed(
    rng: np.random.Generator, value: Array, absolute: float, relative: float, of_mean: float, gain: float
) -> Array:
    sd = np.sqrt(absolute**2 + (relative * value) ** 2 + (of_mean * np.abs(value).mean()) ** 2)
    return np.asarray((1.0 + gain * rng.standard_normal()) * value + sd * rng.standard_normal(len(value)))
