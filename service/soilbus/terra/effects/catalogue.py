"""Every effect that the model can take on, by name."""

from __future__ import annotations

from soilbus.terra.effects.contact import (
    BULLDOZING,
    EXPONENTIAL_SHEAR,
    LUGS,
    RUT_RECOVERY,
    STRESS_PEAK_SHIFT,
    TYRE_DEFLECTION,
)
from soilbus.terra.effects.effect import Effect
from soilbus.terra.effects.sensors import CHANNEL_LAG, DRAFT_GAIN, DRAFT_OFFSET, TORQUE_LAG, WHEEL_LOAD_OFFSET
from soilbus.terra.effects.soil import HARDPAN, MULTIPASS, RATE_STIFFENING, SLIP_SINKAGE, SOIL_DRIFT
from soilbus.terra.effects.vehicle import DRIVETRAIN_LOSS, GRADE, INERTIA, ROLLING_RADIUS

__all__ = ["CATALOGUE"]

CATALOGUE: dict[str, Effect] = {
    effect.name: effect
    for effect in (
        SLIP_SINKAGE, STRESS_PEAK_SHIFT, RUT_RECOVERY, EXPONENTIAL_SHEAR, BULLDOZING, LUGS, RATE_STIFFENING, MULTIPASS,
        HARDPAN, TYRE_DEFLECTION, DRIVETRAIN_LOSS, GRADE, DRAFT_OFFSET, DRAFT_GAIN, ROLLING_RADIUS, TORQUE_LAG,
        CHANNEL_LAG, INERTIA, WHEEL_LOAD_OFFSET, SOIL_DRIFT,
    )
}  # fmt: skip
