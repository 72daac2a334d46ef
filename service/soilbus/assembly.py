"""Configuration -> the parts that the rooms work with."""

from __future__ import annotations

import numpy as np

from soilbus.config import Config, ConfigError
from soilbus.estimation.posterior import SoilPrior
from soilbus.estimation.window import Rig, SensorNoise
from soilbus.terra.vehicle import Chassis
from soilbus.terra.wheel import FAST_NODES, WheelModel


def rig_of(config: Config) -> Rig:
    """The vehicle with the wheels that have all of torque, speed and load."""
    wheels = [w for w in config.wheel if w.torque and w.speed and w.load]
    return Rig(
        wheels=tuple(w.name for w in wheels),
        radius=np.array([w.radius for w in wheels]),
        width=np.array([w.width for w in wheels]),
        front=np.array([w.axle == "front" for w in wheels], dtype=bool),
        chassis=chassis_of(config),
        noise={q: SensorNoise(**getattr(config.noise, q).model_dump()) for q in type(config.noise).model_fields},
    )


def chassis_of(config: Config) -> Chassis | None:
    """Mass and geometry, where the configuration has a vehicle."""
    return None if config.vehicle is None else Chassis(**config.vehicle.model_dump())


def prior_of(config: Config) -> SoilPrior:
    """The soil's prior."""
    return SoilPrior.from_value_std({name: (p.value, p.std) for name, p in config.soil_prior.items()})


def model_of(config: Config) -> WheelModel:
    """The wheel-soil model for fits; ConfigError for an effect that the catalogue lacks."""
    unknown = [e.name for e in config.model.effects]
    if unknown:
        raise ConfigError([f"model.effects: no effect is named {name}" for name in unknown])
    return WheelModel(shear_law=config.model.shear_law, nodes=FAST_NODES)
