"""A second formula of a wheel on soil: Wong & Reece 1967 by Gauss's rule over each branch, nothing of soilbus in it.

The greatest stress sits at (c1 + c2 s) of the entry angle, contact ends `exit` times the entry angle behind the
axle; the stress behind the greatest one is that in front at the same share of its branch.
Shear by Janosi & Hanamoto, 1 - exp(-j/K), or the rational law j / (j + K).
"""

from typing import Any, NamedTuple

import numpy as np

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(12)


class Contact(NamedTuple):
    """Form of the contact."""

    c1: float = 0.5
    c2: float = 0.0
    exit: float = 0.0
    rational: bool = False


def forces(soil: Any, contact: Contact, angle: Any, slip: Any, radius: float, width: float) -> tuple[Any, Any, Any]:
    """Load [N], drawbar pull [N] and torque [N m] (N,) at entry angles [rad] (N,) and slips (N,)."""
    angle, slip = np.asarray(angle, float), np.asarray(slip, float)
    front, stiffness = angle * (1.0 - contact.c1 - contact.c2 * slip), soil.k_c / width + soil.k_phi
    load, pull, torque = np.zeros((3, len(angle)))
    for node, weight in zip(((_NODES + 1.0) / 2.0).tolist(), (_WEIGHTS / 2.0).tolist(), strict=True):
        share = node**3  # nodes gather at the edges of the contact, where the stress has a root
        pressure = stiffness * (radius * (np.cos(angle - share * front) - np.cos(angle))) ** soil.n
        for edge in (angle, -contact.exit * angle):
            branch = edge - (angle - front)  # from the greatest stress to the edge
            theta = edge - share * branch
            j = radius * (angle - theta - (1.0 - slip) * (np.sin(angle) - np.sin(theta)))
            mobilised = np.abs(j) / (np.abs(j) + soil.K) if contact.rational else -np.expm1(-np.abs(j) / soil.K)
            shear = (soil.c + pressure * np.tan(soil.phi)) * np.sign(j) * mobilised
            area = radius * width * np.abs(branch) * 3.0 * node**2 * weight
            load += area * (pressure * np.cos(theta) + shear * np.sin(theta))
            pull += area * (shear * np.cos(theta) - pressure * np.sin(theta))
            torque += area * radius * shear
    return load, pull, torque


def carrying(soil: Any, contact: Contact, load: Any, slip: Any, radius: float, width: float) -> Any:
    """Entry angles [rad] (N,) at which wheels carry these loads [N] (N,): a secant in logarithms."""

    def off(log_angle: Any) -> Any:
        return np.log(forces(soil, contact, np.exp(log_angle), slip, radius, width)[0] / load)

    power = 1.0 / (2.0 * soil.n + 1.0)
    stiffness = (3.0 - soil.n) * width * (soil.k_c / width + soil.k_phi) * np.sqrt(2.0 * radius)
    depth = (3.0 * np.asarray(load) / stiffness) ** (2.0 * power)  # Bekker's rigid wheel
    before = np.log(np.clip(np.arccos(np.clip(1.0 - depth / radius, 0.2, 1.0)), 0.05, 1.2))
    of_before = off(before)
    now = before - power * of_before
    for _ in range(6):
        of_now, step = off(now), now - before
        by = np.where(np.abs(step) > 1e-12, (of_now - of_before) / np.where(step == 0.0, 1.0, step), 1.0 / power)
        before, of_before = now, of_now
        now = np.clip(now - of_now / np.where(by > 0.1, by, 1.0 / power), np.log(0.02), np.log(1.5))
    return np.exp(now)


def readings(
    soil: Any, contact: Contact, rig: Any, rng: Any, seconds: float = 10.0, rate: float = 10.0, sinkage: bool = True
) -> tuple[Any, dict[str, Any]]:
    """Times (N,) and samples by channel of a level drive: loads and slips swing slowly, all sensors noisy."""
    t = (np.arange(int(seconds * rate)) + 0.5) / rate
    W, speed = len(rig.wheels), 1.4 + 0.2 * np.sin(2.0 * np.pi * (0.07 * t + rng.random()))
    weight = 2300.0 * 9.81 / W

    def swing(low: float, high: float, slowest: float = 0.05, fastest: float = 0.12) -> Any:
        phase, f = 2.0 * np.pi * rng.random(3), rng.uniform(slowest, fastest, 3)
        wave = np.sin(2.0 * np.pi * f * t[:, None] + phase).sum(1)
        return low + (high - low) * (wave - wave.min()) / np.ptp(wave)

    common, side = swing(0.05, 0.40), swing(-0.15, 0.15)
    samples: dict[str, Any] = {"ground_speed": speed}
    pulls: Any = 0.0
    for i, name in enumerate(rig.wheels):
        load = weight * (1.0 + (-1.0) ** i * side) * (0.9 if rig.front[i] else 1.1) + 400.0 * swing(-1.0, 1.0)
        slip = np.clip(common + 0.015 * swing(-1.0, 1.0), 0.02, 0.6)
        angle = carrying(soil, contact, load, slip, rig.radius[i], rig.width[i])
        _, pull, torque = forces(soil, contact, angle, slip, rig.radius[i], rig.width[i])
        samples |= {f"load.{name}": load, f"torque.{name}": torque}
        samples[f"speed.{name}"] = speed / (rig.radius[i] * (1.0 - slip))
        if sinkage:
            samples[f"sinkage.{name}"] = rig.radius[i] * (1.0 - np.cos(angle))
        pulls = pulls + pull
    acceleration = np.gradient(speed, t)
    samples |= {"draft": pulls - 2300.0 * acceleration, "acceleration": acceleration, "pitch": 0.0 * t}
    return t, {name: noisy(values, rig.noise[name.partition(".")[0]], rng) for name, values in samples.items()}


def noisy(values: Any, noise: Any, rng: Any) -> Any:
    """Values (N,) as a sensor with this noise reads them."""
    sd = np.sqrt(noise.absolute**2 + (noise.relative * values) ** 2 + (noise.of_mean * np.abs(values).mean()) ** 2)
    return values * (1.0 + noise.gain * rng.standard_normal()) + sd * rng.standard_normal(len(values))
