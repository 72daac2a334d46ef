"""Assembly: the estimator's parts from the configuration.

    Config -> Rig, Chassis, SoilPrior, WheelModel, effects with values and prior sd, delays

Each function takes the validated configuration and returns one part; a ConfigError carries a line for each fault.
Without effects in model.effects the catalogue is not imported, which keeps the start short.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from soilbus.config.model import Config, ConfigError
from soilbus.config.model import Effect as EffectSetting
from soilbus.estimation.nuisance_parameters import Free
from soilbus.estimation.posterior import SoilPrior
from soilbus.estimation.window import Rig, SensorNoise
from soilbus.terra.effects.effect import Active, Effect, Parameter
from soilbus.terra.vehicle import Chassis
from soilbus.terra.wheel import FAST_NODES, WheelModel
from soilbus.words import did_you_mean


def rig_of(config: Config) -> Rig:
    """The vehicle with all its wheels, or a test rig with one.

    Parameters
    ----------
    config : Config
        Validated configuration.

    Returns
    -------
    Rig
        Without wheels if none is measured.

    Raises
    ------
    ConfigError
        With a line for each wheel that is not measured while others are, and for each axle
        without wheels: its load and rolling resistance would be attributed to the soil under the others.
    """
    of_table = config.table is not None
    if faults := [] if of_table else list(_unmeasured(config)):
        raise ConfigError(faults)
    wheels = [w for w in config.wheel if of_table or not w.lacking]
    noise = {q: SensorNoise(**getattr(config.noise, q).model_dump()) for q in type(config.noise).model_fields}
    slip = noise.pop("slip")
    if of_table:  # its speeds are computed from the slip, see tables.py
        noise |= {"speed": SensorNoise(), "ground_speed": slip}
    return Rig(
        wheels=tuple(w.name for w in wheels),
        radius=np.array([w.radius for w in wheels]),
        width=np.array([w.width for w in wheels]),
        front=np.array([of_table or w.axle == "front" for w in wheels], dtype=bool),
        chassis=chassis_of(config),
        noise=noise,
        track=None if config.vehicle is None else config.vehicle.track,
    )


def _unmeasured(config: Config) -> Iterator[str]:
    """A line for each wheel that carries the vehicle without being measured, where others are."""
    if all(w.lacking for w in config.wheel):
        return
    for w in config.wheel:
        if missing := w.lacking:
            keys = " and ".join(f"wheel.{w.name}.{role}" for role in missing)
            yield (
                f"wheel {w.name} has no {' and no '.join(missing)}: map {keys}; without, its rolling resistance"
                " would be put down to the soil under the other wheels"
            )
    if config.vehicle is not None:
        for axle in ("front", "rear"):
            if axle not in {w.axle for w in config.wheel}:
                yield f"no [[wheel]] is on the {axle} axle, which carries its share of the weight: give all wheels"


def chassis_of(config: Config) -> Chassis | None:
    """Mass and geometry; None for a test rig."""
    return None if config.vehicle is None else Chassis(**config.vehicle.model_dump(exclude={"track"}))


def prior_of(config: Config) -> SoilPrior:
    """Prior of the soil parameters."""
    return SoilPrior.from_value_std({name: (p.value, p.std) for name, p in config.soil_prior.items()})


def model_of(config: Config) -> WheelModel:
    """The wheel-soil model of fits, without effects."""
    return WheelModel(shear_law=config.model.shear_law, nodes=FAST_NODES)


def form_of(config: Config) -> tuple[float, ...]:
    """How far each of `model_form.FORM` may be from the model; 0 where an effect of the model has that parameter."""
    named, form = {effect.name for effect in config.model.effects}, config.model.form
    peak = 0.0 if "stress_peak_shift" in named else 1.0
    leave, shear = float("rut_recovery" not in named), float("exponential_shear" not in named)
    return peak * form.peak, peak * form.peak_by_slip, leave * form.exit, shear * form.shear


def effects_of(config: Config, wheels: Sequence[str] | None = None) -> tuple[Active, ...]:
    """The effects of model.effects with their values, in the order of the catalogue.

    Parameters
    ----------
    config : Config
        Validated configuration.
    wheels : Sequence of str, optional
        Wheels of the arrays (W,), by default all of the configuration.

    Returns
    -------
    tuple of Active
        A parameter is a number or, as `diagnose --model-out` writes it, {value = x, std = y};
        one not given stays neutral.  A parameter of each wheel may also be a table of these,
        {FL = x, RR = {value = y, std = z}}, and becomes an array (W,); wheels not given stay neutral.

    Raises
    ------
    ConfigError
        With a line for each unknown effect or parameter, value out of range or not a number,
        effect given twice, or shear law that the effect cannot be combined with.
    """
    if not config.model.effects:
        return ()
    from soilbus.terra.effects.catalogue import CATALOGUE  # not needed at a start without effects

    all_wheels = [wheel.name for wheel in config.wheel]
    faults: list[str] = []
    active_effects: dict[str, Active] = {}
    for setting in config.model.effects:
        try:
            if setting.name in active_effects:
                raise ConfigError([f"two effects are named {setting.name}"])
            active_effects[setting.name] = _active(setting, config.model.shear_law, all_wheels)
            if CATALOGUE[setting.name].of_tyre and not _has_tyres(config):
                raise ConfigError([f"{setting.name} is of a tyre, and every wheel is said to be rigid"])
        except ConfigError as error:
            faults += error.faults
    if faults:
        raise ConfigError(f"model.effects: {fault}" for fault in faults)
    columns = [all_wheels.index(name) for name in (all_wheels if wheels is None else wheels)]
    return tuple(
        Active(effect, {name: value[columns] if np.ndim(value) else value for name, value in values.items()})
        for effect, values in (active_effects[name] for name in CATALOGUE if name in active_effects)
    )


def possible_effects(config: Config) -> list[Effect]:
    """The effects of the catalogue that the machine can have; those of tyres only with flexible tyres."""
    from soilbus.terra.effects.catalogue import CATALOGUE

    return [effect for effect in CATALOGUE.values() if _has_tyres(config) or not effect.of_tyre]


def _has_tyres(config: Config) -> bool:
    return not config.wheel or any(wheel.tyre == "flexible" for wheel in config.wheel)


def delays_of(config: Config) -> dict[str, float]:
    """Delay [s] of each quantity by the effect channel_lag of model.effects; ConfigError as `effects_of`."""
    if not config.model.effects:
        return {}
    from soilbus.terra.effects.sensors import CHANNEL_LAG, lateness

    return lateness([active for active in effects_of(config) if active.effect is CHANNEL_LAG])


def effects_and_parameters_of(config: Config, undelayed: bool = True) -> tuple[tuple[Effect, ...], tuple[Free, ...]]:
    """The effects of the estimator's model and their parameters.

    Parameters
    ----------
    config : Config
        Validated configuration.
    undelayed : bool
        Whether the intake has already corrected the delays of channels (`delays_of`), so that channel_lag is left out.

    Returns
    -------
    effects : tuple of Effect
        Those of model.effects, without effects that describe one record only.
    parameters : tuple of Free
        Value and sd of each prior; sd 0 holds a parameter.  Parameters that describe one record
        only are held neutral.  Wheels are those of `rig_of`.

    Raises
    ------
    ConfigError
        As `effects_of`.
    """
    wheels = rig_of(config).wheels
    settings = {setting.name: setting.model_extra or {} for setting in config.model.effects}
    active = [
        a
        for a in effects_of(config, wheels)
        if not (a.effect.of_record or (undelayed and a.effect.name == "channel_lag"))
    ]
    free: list[Free] = []
    for effect, values in active:
        for parameter in effect.parameters:
            given, value = settings[effect.name].get(parameter.name), values[parameter.name]
            if not effect.each_wheel:
                free.append(Free(effect.name, parameter, None, *_prior_value_std(parameter, value, given)))
                continue
            for i, name in enumerate(wheels):
                of_wheel = given.get(name) if isinstance(given, Mapping) and _by_wheel(given) else given
                free.append(Free(effect.name, parameter, i, *_prior_value_std(parameter, value[i], of_wheel)))
    return tuple(effect for effect, _ in active), tuple(free)


def with_effects(config: Config, texts: Iterable[str]) -> Config:
    """The configuration with effects added or changed.

    Parameters
    ----------
    config : Config
        Validated configuration; not changed.
    texts : Iterable of str
        NAME=VALUE for the first parameter of an effect, NAME.PARAMETER=VALUE for another one,
        NAME.PARAMETER.WHEEL=VALUE for that of one wheel.

    Raises
    ------
    ConfigError
        For a text of another form, an unknown effect, and as `effects_of`.
    """
    effects_of(config)
    settings: dict[str, dict[str, Any]] = {e.name: dict(e.model_extra or {}) for e in config.model.effects}
    for text in texts:
        try:
            _set_effect(settings, text, [wheel.name for wheel in config.wheel])
        except ConfigError as error:
            raise ConfigError(f"--effect {text}: {fault}" for fault in error.faults) from None
    effects = [EffectSetting(name=name, **values) for name, values in settings.items()]
    changed = config.model_copy(update={"model": config.model.model_copy(update={"effects": effects})})
    effects_of(changed)
    return changed


def _set_effect(settings: dict[str, dict[str, Any]], text: str, wheels: Sequence[str]) -> None:
    key, equals, value = text.partition("=")
    name, *path = key.strip().split(".")
    if not equals or len(path) > 2 or not all([name, *path]):
        raise ConfigError(["expected NAME=VALUE, NAME.PARAMETER=VALUE or NAME.PARAMETER.WHEEL=VALUE"])
    effect, number = _effect(name), _number(value)
    setting = settings.setdefault(name, {})
    parameter, *wheel = path or [effect.parameters[0].name]
    if not wheel:
        setting[parameter] = number
        return
    previous = setting.get(parameter, {})
    setting[parameter] = {**(previous if _by_wheel(previous) else dict.fromkeys(wheels, previous)), wheel[0]: number}


def _active(setting: EffectSetting, shear_law: str, wheels: Sequence[str]) -> Active:
    effect, given = _effect(setting.name), setting.model_extra or {}
    names = [parameter.name for parameter in effect.parameters]
    faults = [
        f"{effect.name} has no parameter {key}{did_you_mean(key, names)}; known: {', '.join(names)}"
        for key in given
        if key not in names
    ]
    if effect.base_law not in (None, shear_law):
        faults.append(f"{effect.name} can be added to shear_law = {effect.base_law} only")
    values: dict[str, Any] = {}
    for parameter in effect.parameters:
        try:
            value = given.get(parameter.name, parameter.neutral)
            values[parameter.name] = (
                _of_wheels(value, parameter, wheels) if effect.each_wheel else _within(value, parameter)
            )
        except ConfigError as error:
            faults += [f"{effect.name}.{parameter.name}: {fault}" for fault in error.faults]
    if faults:
        raise ConfigError(faults)
    return Active(effect, values)


def _effect(name: str) -> Effect:
    from soilbus.terra.effects.catalogue import CATALOGUE

    if name not in CATALOGUE:
        raise ConfigError([f"no effect is named {name}{did_you_mean(name, CATALOGUE)}; known: {', '.join(CATALOGUE)}"])
    return CATALOGUE[name]


def _of_wheels(given: Any, parameter: Parameter, wheels: Sequence[str]) -> Any:
    if not _by_wheel(given):
        return np.full(len(wheels), _within(given, parameter))
    if unknown := [name for name in given if name not in wheels]:
        raise ConfigError([f"no wheel is named {name}{did_you_mean(name, wheels)}" for name in unknown])
    return np.array([_within(given.get(name, parameter.neutral), parameter) for name in wheels])


def _by_wheel(given: Any) -> bool:
    return isinstance(given, Mapping) and "value" not in given


def _within(given: Any, parameter: Parameter) -> float:
    if isinstance(given, Mapping) and set(given) <= {"value", "std"}:
        _std(given)
        given = given.get("value")
    value = _number(given)
    if not parameter.low <= value <= parameter.high:
        raise ConfigError([f"{value:g} is not within {parameter.low:g}..{parameter.high:g}"])
    return value


def _prior_value_std(parameter: Parameter, value: Any, given: Any) -> tuple[float, float]:
    """Value and sd of a parameter's prior; neutral and held where it describes one record only."""
    std = _std(given)
    return (parameter.neutral, 0.0) if parameter.of_record else (float(value), std)


def _std(given: Any) -> float:
    """The sd given with a parameter; 0 without."""
    std = _number(given.get("std", 0.0)) if isinstance(given, Mapping) else 0.0
    if std < 0.0:
        raise ConfigError([f"std {std:g} is less than 0"])
    return std


def _number(given: Any) -> float:
    try:
        value = math.nan if isinstance(given, bool) else float(given)
    except (TypeError, ValueError):
        value = math.nan
    if not math.isfinite(value):
        raise ConfigError([f"{given!r} is not a number"])
    return value
