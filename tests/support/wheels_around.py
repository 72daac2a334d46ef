"""Four wheels on a soil and all that effects may depend on, made from one seed."""

from typing import Any

import numpy as np

from soilbus.terra.effects.catalogue import CATALOGUE
from soilbus.terra.effects.effect import Active, Surroundings
from soilbus.terra.soils import soil_named
from soilbus.terra.wheel import WheelState, state_on

RADIUS = np.array([0.5, 0.5, 0.62, 0.62])
WIDTH = np.array([0.26, 0.26, 0.32, 0.32])
REAR = np.array([False, False, True, True])


def active(name: str, **values: float) -> Active:
    """An effect with these values, and neutral ones else."""
    return Active(CATALOGUE[name], CATALOGUE[name].neutral | values)


def wheels_around(
    soil: str = "wet_clay", size: int = 24, seed: int = 0, slip: tuple[float, float] = (-0.2, 0.9)
) -> tuple[WheelState, Surroundings]:
    """States (N, 4) and their surroundings, a sample each 0.1 s."""
    rng = np.random.default_rng(seed)
    t = 0.1 * np.arange(size)[:, None]
    state = state_on(soil_named(soil), rng.uniform(0.1, 0.7, (size, 4)), rng.uniform(*slip, (size, 4)), RADIUS, WIDTH)
    speed = rng.uniform(0.3, 3.0, (size, 1))
    around = Surroundings(
        t=t,
        distance=np.cumsum(0.1 * speed, axis=0),
        load=rng.uniform(2e3, 9e3, (size, 4)),
        ground_speed=speed,
        wheel_speed=speed / (RADIUS * (1.0 - state.slip)),
        rear=REAR,
        draft=rng.uniform(0.0, 6e3, (size, 1)),
        acceleration=rng.normal(0.0, 0.5, (size, 1)),
        mass=2300.0,
        duration=0.1 * size,
        length=float(0.1 * speed.sum()),
    )
    return state, around


def one_wheel(around: Surroundings, **changes: Any) -> Surroundings:
    """The surroundings of a single wheel at one instant."""
    alone = around._replace(
        t=0.0, distance=0.0, load=5e3, ground_speed=1.0, wheel_speed=2.0, rear=False, draft=2e3, acceleration=0.0
    )
    return alone._replace(**changes)
