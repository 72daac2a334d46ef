"""A second generator of recordings: the field vehicle on a rough field, by formulas and dynamics of its own.

Nothing of soilbus is used.  Body bounce, pitch and roll (2 to 5 Hz) shake the wheel loads; the motors hold
their rim speeds and the ground speed follows by m dV/dt = sum DP - D - m g sin(slope), integrated at STEP.
The contact is that of `other_wheel`.  Each message has its own rate, phase and jitter, each channel its own
delay, first-order lag, noise and fixed gain error (shared/field/README.md).
"""

import gzip
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import cantools
import numpy as np
from numpy.typing import NDArray

from other_wheel import Contact, carrying, forces

Array = NDArray[Any]

STEP = 0.005
"""Step of the integration, and of the truth [s]."""
GRAVITY = 9.80665
MASS, WHEELBASE, CG_AHEAD, CG_HEIGHT, HITCH = 2300.0, 1.95, 0.95, 0.75, 0.45
WHEELS = ("FL", "FR", "RL", "RR")
RADIUS, WIDTH = np.array([0.50, 0.50, 0.62, 0.62]), np.array([0.26, 0.26, 0.38, 0.38])
GEAR = 24.0
START = 1.7e9


class Ground(NamedTuple):
    """Bekker and Mohr-Coulomb parameters: k_c [N/m^(n+1)], k_phi [N/m^(n+2)], n, phi [rad], c [Pa], K [m]."""

    k_c: float = 5300.0
    k_phi: float = 1.515e6
    n: float = 0.7
    phi: float = math.radians(29.0)
    c: float = 1700.0
    K: float = 0.025

    def bearing_pressure(self, depth: float = 0.02, width: float = 0.3) -> float:
        """Pressure [Pa] under a plate of a width [m] at a depth [m]."""
        return float((self.k_c / width + self.k_phi) * depth**self.n)


LOAM = Ground()
CLAY = Ground(13_190.0, 692_150.0, 0.5, math.radians(22.0), 4140.0, 0.01)
STUBBLE = Ground(8_000.0, 2.2e6, 0.8, math.radians(31.0), 2500.0, 0.02)

PERIODS = {
    "McuFL": 0.02, "McuFR": 0.02, "McuRL": 0.02, "McuRR": 0.02, "WheelSpeeds": 0.02, "AxleLoads": 0.02,
    "DrawbarPin": 0.02, "GroundBasedSpeedAndDistance": 0.04, "Attitude": 0.02, "RideHeight": 0.02,
}  # fmt: skip
"""Seconds between two frames of a message."""
_CARRIES = {
    "torque": "Mcu", "speed": "WheelSpeeds", "load": "AxleLoads", "draft": "DrawbarPin", "pitch": "Attitude",
    "ground_speed": "GroundBasedSpeedAndDistance", "acceleration": "Attitude",
}  # fmt: skip
_NOISE = {  # absolute, relative, of the mean; sd of the fixed gain error
    "torque": (0.0, 0.0, 0.01, 0.005), "load": (0.0, 0.01, 0.0, 0.005), "speed": (0.0, 0.002, 0.0, 0.0015),
    "ground_speed": (0.0, 0.008, 0.0, 0.002), "draft": (40.0, 0.0, 0.0, 0.005), "pitch": (0.002, 0.0, 0.0, 0.0),
    "acceleration": (0.0, 0.0, 0.0, 0.0),
}  # fmt: skip
_MODES = ((2.6, 0.12), (4.0, 0.12), (3.3, 0.15))
"""Natural frequency [Hz] and damping ratio of bounce, pitch and roll on the tyres."""


@dataclass(frozen=True)
class Recording:
    """Samples (t [s], value in SI) by channel name, and the truth: columns by name at instants STEP apart."""

    channels: dict[str, tuple[Array, Array]]
    truth: dict[str, Array]
    ground: Ground

    def write(self, path: Path, dbc: Path) -> Path:
        """The recording as a candump log (gzipped where the name ends so) of the frames of field.dbc."""
        database: Any = cantools.database.load_file(dbc)
        lines: list[tuple[float, str]] = []
        for message in database.messages:
            signals = _signals(message.name)
            known = {s: self.channels[n] for s, (n, _) in signals.items() if n in self.channels}
            if not known:
                continue
            factors = {s: f for s, (_, f) in signals.items()}
            unmapped: dict[str, Any] = {s.name: 0 for s in message.signals if s.name not in known}
            rest = unmapped | {"State": 3, "Valid": 1}
            rest = {name: value for name, value in rest.items() if name in {s.name for s in message.signals}}
            times = next(iter(known.values()))[0]
            width = "08X" if message.is_extended_frame else "03X"
            for i, t in enumerate(times.tolist()):
                values = {s: float(v[i]) * factors[s] for s, (_, v) in known.items()}
                data = message.encode(rest | values, strict=False).hex().upper()
                lines.append((t, f"({START + t:.6f}) can0 {message.frame_id:{width}}#{data}\n"))
        text = "".join(line for _, line in sorted(lines, key=lambda line: line[0]))
        path.write_bytes(gzip.compress(text.encode(), 1) if path.suffix == ".gz" else text.encode())
        return path


def _signals(message: str) -> dict[str, tuple[str, float]]:
    """Channel and factor from SI of each signal that a message carries."""
    if message.startswith("Mcu"):
        return {"ShaftTorque": (f"torque.{message[3:]}", 1.0 / GEAR)}
    return {
        "WheelSpeeds": {w: (f"speed.{w}", 1.0) for w in WHEELS},
        "AxleLoads": {w: (f"load.{w}", 1.0) for w in WHEELS},
        "DrawbarPin": {"Draft": ("draft", 1.0)},
        "GroundBasedSpeedAndDistance": {"GroundBasedMachineSpeed": ("ground_speed", 1.0)},
        "Attitude": {"Pitch": ("pitch", 1.0), "LongAccel": ("acceleration", 1.0)},
    }.get(message, {})


def drive(
    seed: int,
    ground: Ground = LOAM,
    duration: float = 80.0,
    shake: float = 1.0,
    delays: Mapping[str, float] | None = None,
    lags: Mapping[str, float] | None = None,
) -> Recording:
    """Drive with a draft that wanders and jerks, over a rough field (`shake` 0: a smooth one; 1: loads shake by
    3 % (sd), 4: by 13 %).

    delays and lags [s] by quantity ("torque", "load", ...): a sample with the stamp t reads what was at t - delay,
    behind a first-order lag.
    """
    rng = np.random.default_rng([seed, 20260])
    truth = _truth(rng, ground, duration, shake)
    t = truth["t"]
    clocks = {name: _clock(rng, period, duration) for name, period in PERIODS.items()}
    channels: dict[str, tuple[Array, Array]] = {}
    for quantity, message in _CARRIES.items():
        of_wheels = f"{quantity}.FL" in truth
        for wheel in WHEELS if of_wheels else ("",):
            name = f"{quantity}.{wheel}" if wheel else quantity
            stamps = clocks[message + wheel if message == "Mcu" else message]
            late = _lagged(truth[name], (lags or {}).get(quantity, 0.0))
            value = np.interp(stamps - (delays or {}).get(quantity, 0.0), t, late)
            channels[name] = stamps, _disturbed(rng, value, *_NOISE[quantity])
    return Recording(channels, truth, ground)


def _clock(rng: np.random.Generator, period: float, duration: float) -> Array:
    """Stamps of a message: a period off by up to 200 ppm, a phase of its own, queues of up to 0.5 ms."""
    own = period * (1.0 + rng.uniform(-2e-4, 2e-4))
    stamps = rng.uniform(0.0, own) + own * np.arange(int(duration / own) - 1)
    return np.asarray(stamps + rng.uniform(0.0, 5e-4, len(stamps)))


def _lagged(value: Array, lag: float) -> Array:
    if lag <= 0.0:
        return value
    keep, out = math.exp(-STEP / lag), np.empty(len(value))
    state = value[0]
    mid = np.concatenate([value[:1], (value[1:] + value[:-1]) / 2.0])
    for i, v in enumerate(mid.tolist()):
        state = keep * state + (1.0 - keep) * v
        out[i] = state
    return out


def _disturbed(
    rng: np.random.Generator, value: Array, absolute: float, relative: float, of_mean: float, gain: float
) -> Array:
    sd = np.sqrt(absolute**2 + (relative * value) ** 2 + (of_mean * np.abs(value).mean()) ** 2)
    return np.asarray((1.0 + gain * rng.standard_normal()) * value + sd * rng.standard_normal(len(value)))


def _wander(rng: np.random.Generator, t: Array, slowest: float, fastest: float, waves: int = 5) -> Array:
    """Sum of sines between two frequencies [Hz], of unit standard deviation."""
    edges = np.geomspace(slowest, fastest, waves + 1)
    f, phase = rng.uniform(edges[:-1], edges[1:]), rng.uniform(0.0, 2.0 * math.pi, waves)
    return np.asarray(np.sqrt(2.0 / waves) * np.sin(2.0 * math.pi * f[:, None] * t + phase[:, None]).sum(0))


def _truth(rng: np.random.Generator, ground: Ground, duration: float, shake: float) -> dict[str, Array]:
    t = np.arange(round(duration / STEP)) * STEP
    weight = MASS * GRAVITY
    most = 0.55 * weight * math.tan(ground.phi) + 4.0 * ground.c * 0.06
    draft = np.clip(
        most * (0.36 + 0.20 * _wander(rng, t, 0.03, 0.3) + 0.05 * _wander(rng, t, 0.4, 1.5)), 200.0, 0.85 * most
    )
    slope = 0.03 * _wander(rng, t, 0.01, 0.05)
    rim = 1.6 + 0.35 * _wander(rng, t, 0.02, 0.12)
    spread = 1.0 + 0.012 * np.stack([_wander(rng, t, 0.05, 0.4) for _ in WHEELS])
    omega = np.clip(rim, 0.8, 2.6) * spread / RADIUS[:, None]
    rough = shake * 0.01 * weight * np.stack([rng.standard_normal(len(t)) for _ in _MODES])
    load, speed, acceleration = _integrated(ground, draft, slope, omega, rough)
    slip = 1.0 - speed / (RADIUS[:, None] * omega)
    columns = {"t": t, "ground_speed": speed, "acceleration": acceleration, "draft": draft, "pitch": slope}
    for i, wheel in enumerate(WHEELS):
        angle = carrying(ground, Contact(), load[i], slip[i], RADIUS[i], WIDTH[i])
        torque = forces(ground, Contact(), angle, slip[i], RADIUS[i], WIDTH[i])[2]
        columns |= {f"load.{wheel}": load[i], f"torque.{wheel}": torque, f"speed.{wheel}": omega[i]}
        columns[f"slip.{wheel}"] = slip[i]
    return columns


def _integrated(ground: Ground, draft: Array, slope: Array, omega: Array, rough: Array) -> tuple[Array, Array, Array]:
    """Wheel loads (4, N) [N], ground speed (N,) [m/s] and acceleration (N,), by the implicit midpoint for the speed."""
    front, rear = _pull_table(ground, 0), _pull_table(ground, 2)
    pulls = front, front, rear, rear
    level_rear = MASS * GRAVITY * (WHEELBASE - CG_AHEAD) / WHEELBASE
    n = len(draft)
    load, speed, acceleration = np.empty((4, n)), np.empty(n), np.empty(n)
    v, a = 0.85 * float((RADIUS * omega[:, 0]).mean()), 0.0
    modes = [_Mode(f, z) for f, z in _MODES]
    rims = (RADIUS[:, None] * omega).T.tolist()
    noise, slopes = rough.T.tolist(), np.sin(slope).tolist()
    transfer = 0.0
    for i, pull in enumerate(draft.tolist()):
        wanted = (pull * HITCH + MASS * (a + GRAVITY * slopes[i]) * CG_HEIGHT) / WHEELBASE
        bounce, pitch, roll = (m.step(x) for m, x in zip(modes, noise[i], strict=True))
        transfer += (wanted - transfer) * STEP / 0.08  # the body leans over on its tyres
        on_rear = level_rear + transfer + 0.55 * bounce + pitch
        on_front = MASS * GRAVITY - level_rear - transfer + 0.45 * bounce - pitch
        half, tilt = (0.5 * on_front, 0.5 * on_rear), (0.4 * roll, 0.6 * roll)
        loads = half[0] + tilt[0], half[0] - tilt[0], half[1] + tilt[1], half[1] - tilt[1]

        def rate(at: float, loads: tuple[float, ...] = loads, i: int = i, pull: float = pull) -> float:
            given = sum(p.at(w, 1.0 - at / rim) for p, w, rim in zip(pulls, loads, rims[i], strict=True))
            return float((given - pull) / MASS - GRAVITY * slopes[i])

        a, more = rate(v), rate(v + 1e-4)
        load[:, i], speed[i], acceleration[i] = loads, v, a
        v += STEP * a / (1.0 - 0.5 * STEP * (more - a) / 1e-4)
    return load, speed, acceleration


class _Mode:
    """A damped oscillation driven by white noise, with unit gain from the noise's sd to its own, about."""

    def __init__(self, frequency: float, damping: float) -> None:
        self.w, self.z = 2.0 * math.pi * frequency, damping
        self.x, self.v = 0.0, 0.0
        self.gain = math.sqrt(4.0 * self.z * self.w**3 / STEP)

    def step(self, noise: float) -> float:
        self.v += STEP * (self.gain * noise - 2.0 * self.z * self.w * self.v - self.w**2 * self.x)
        self.x += STEP * self.v
        return self.x


class _PullTable:
    """Drawbar pull [N] of a wheel over load and slip, on straight lines between near nodes."""

    LOADS, SLIPS = 300.0 + 200.0 * np.arange(70), -0.3 + 0.01 * np.arange(111)

    def __init__(self, ground: Ground, wheel: int) -> None:
        load, slip = (a.ravel() for a in np.meshgrid(self.LOADS, self.SLIPS, indexing="ij"))
        angle = carrying(ground, Contact(), load, slip, RADIUS[wheel], WIDTH[wheel])
        pull = forces(ground, Contact(), angle, slip, RADIUS[wheel], WIDTH[wheel])[1]
        self.rows = pull.reshape(len(self.LOADS), -1).tolist()

    def at(self, load: float, slip: float) -> float:
        x, y = (load - 300.0) / 200.0, (slip + 0.3) / 0.01
        i, j = min(max(int(x), 0), len(self.LOADS) - 2), min(max(int(y), 0), len(self.SLIPS) - 2)
        x, y = x - i, y - j
        low, high = self.rows[i], self.rows[i + 1]
        return float((1 - x) * ((1 - y) * low[j] + y * low[j + 1]) + x * ((1 - y) * high[j] + y * high[j + 1]))


@cache
def _pull_table(ground: Ground, wheel: int) -> _PullTable:
    """The table of a wheel on a ground, made once."""
    return _PullTable(ground, wheel)
