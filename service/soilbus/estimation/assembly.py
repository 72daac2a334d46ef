"""Assembly: the estimator's parts from the configuration.

    Config -> Rig, Chassis, SoilPrior, WheelModel, effects with values and prior sd, delays

Each function takes the validated configuration and returns one part; a ConfigError carries a line for each fault.
Without effects in model.effects the catalogue is not imported, which keeps the start short.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import fields, replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from soilbus.arrays import Array
from soilbus.config.model import Config, ConfigError, Vehicle
from soilbus.config.model import Effect as EffectSetting
from soilbus.estimation.instrumentation import Coupling, Group, Instrumentation, Row, contrast, rows_of, unit
from soilbus.estimation.nuisance_parameters import Free
from soilbus.estimation.options import ESTIMATOR, EstimatorOptions
from soilbus.estimation.posterior import SoilPrior
from soilbus.estimation.window import Rig, SensorNoise
from soilbus.terra.effects.effect import Active, Effect, Parameter
from soilbus.terra.vehicle import Chassis, wheel_loads
from soilbus.terra.wheel import FAST_NODES, WheelModel
from soilbus.words import did_you_mean

DIFFERENTIAL_BIAS = {"open": 0.05, "limited": 0.25, "locked": 0.0}
"""Default of `config.model.Axle.torque_bias`, with its evidence there."""
UNKNOWN_SHARE = 0.02
"""Default relative sd of mass, and of the centre of gravity over the wheelbase: `config.model.Vehicle`."""


def rig_of(config: Config, options: EstimatorOptions = ESTIMATOR) -> Rig:
    """Return the vehicle with all its wheels, or a test rig with one; without wheels if no torque is measured.

    ConfigError with a line for each wheel whose motor or speed is not measured while others are, and for each axle
    without wheels: its rolling resistance would be attributed to the soil under the others.
    """
    of_table = config.table is not None
    if faults := [] if of_table else list(_unmeasured(config)):
        raise ConfigError(faults)
    measured = of_table or _torque_is_measured(config)
    wheels = config.wheel if measured else []
    noise = {q: SensorNoise(**getattr(config.noise, q).model_dump()) for q in type(config.noise).model_fields}
    slip, computed = noise.pop("slip"), noise.pop("computed_load")
    noise["differential_lock"] = SensorNoise(absolute=1.0)
    if of_table:  # its speeds are computed from the slip, see tables.py
        noise |= {"speed": SensorNoise(), "ground_speed": slip}
        # its rows are no means of several bins, whose noise is less
        steady = replace(options.tracker, several_soils=options.search.plausible_chi2)
        options = replace(options, variance=replace(options.variance, least=1.0), tracker=steady)
    rig = Rig(
        wheels=tuple(w.name for w in wheels),
        radius=np.array([w.radius for w in wheels]),
        width=np.array([w.width for w in wheels]),
        ahead=np.array([config.axles.get(str(w.axle), 1.0) for w in wheels]),
        chassis=chassis_of(config),
        noise=noise,
        lengths=np.array([w.contact_length for w in wheels]) if any(w.contact_length for w in wheels) else None,
        options=options,
    )
    if config.vehicle is None:
        return rig
    acceleration = config.signals.acceleration
    rig = replace(
        rig,
        track=config.vehicle.track,
        towing=config.vehicle.towing,
        specific_force=acceleration is not None and acceleration.kind == "specific_force",
        max_lateral=config.estimator.max_lateral if config.vehicle.steering == "skid" else None,
        driven=None if all(w.driven for w in wheels) else np.array([w.driven for w in wheels]),
    )
    return _with_instrumentation(rig, config, computed) if measured else rig


def with_disengaged(config: Config, rig: Rig, apart: NDArray[np.bool_]) -> Rig:
    """Return the rig while some of its wheels (W,) are disengaged: they roll freely, and the channels stay in place."""
    if rig.instrumentation is None or not apart.any():
        return rig
    wheels = [w.model_copy(update={"driven": w.driven and not off}) for w, off in zip(config.wheel, apart, strict=True)]
    free = rig_of(config.model_copy(update={"wheel": wheels}), rig.options)
    assert free.instrumentation is not None
    rows: dict[str, Any] = {
        quantity: tuple(
            row._replace(at=rig.names[quantity].index(row.name)) if row.kind == "channel" else row
            for row in getattr(free.instrumentation, quantity)
        )
        for quantity in ("torque", "speed", "load")
    }
    return replace(free, names=rig.names, instrumentation=replace(free.instrumentation, **rows))


def _torque_is_measured(config: Config) -> bool:
    return any(w.torque is not None for w in config.wheel) or any(a.torque is not None for a in config.axle)


def _unmeasured(config: Config) -> Iterator[str]:
    """A line for each wheel of which too little is measured, where others are."""
    if not _torque_is_measured(config):
        return
    for w in config.wheel:
        axles = [a for a in config.axle if a.name in ("both", w.axle)]
        if w.driven and w.torque is None and all(a.torque is None for a in axles):
            yield (
                f"{w.section} {w.name} has no torque: map {w.section}.{w.name}.torque or axle.{w.axle}.torque, or say"
                " driven = false if no motor drives it; else its rolling resistance would be put down to the soil under"
                " the other wheels"
            )
        if w.driven and w.speed is None and all(a.motor_speed is None for a in axles):
            yield (
                f"{w.section} {w.name} has no speed: map {w.section}.{w.name}.speed or axle.{w.axle}.motor_speed;"
                " without, it has no slip"
            )
        if w.load is None and config.vehicle is None:
            yield (
                f"{w.section} {w.name} has no load: map {w.section}.{w.name}.load, or give the [vehicle]"
                " whose weight it carries"
            )
    if config.vehicle is not None and not config.on_one_axle:
        for axle in ("front", "rear") if config.axles.keys() & {"front", "middle", "rear"} else ():
            if axle not in config.axles:
                yield f"no [[wheel]] is on the {axle} axle, which carries its share of the weight: give all wheels"


class Motor(NamedTuple):
    """Motor by the name of its wheel or axle, and the wheels that it drives."""

    name: str
    wheels: tuple[int, ...]
    share: tuple[float, ...]  # torque of each wheel for one unit of the motor's, where all slip alike
    max_torque: float  # [N m] at the wheel or the axle, nan where not known


def motors_of(config: Config, rig: Rig) -> tuple[Motor, ...]:
    """Return the motors of a rig's vehicle: of the wheels, then of the axles, then of both axles."""
    if not rig.wheels:
        return ()
    motors = [Motor(w.name, (i,), (1.0,), w.max_torque or math.nan) for i, w in enumerate(config.wheel)]
    ratio: dict[str, float] = {a.name: a.gear_ratio for a in config.axle}
    for axle in sorted(config.axle, key=lambda a: a.name == "both"):
        wheels = tuple(i for i, w in enumerate(config.wheel) if axle.name in ("both", w.axle) and w.driven)
        share = np.ones(len(wheels)) / max(len(wheels), 1)
        if axle.name == "both" and rig.chassis is not None:
            grip = wheel_loads(rig.chassis, rig.ahead, 0.0, 0.0, 0.0) * rig.radius
            grip, gear = grip[list(wheels)], np.array([ratio.get(str(config.wheel[i].axle), 1.0) for i in wheels])
            share = grip / float((grip / gear).sum())
        motors.append(Motor(axle.name, wheels, tuple(share.tolist()), axle.max_torque or math.nan))
    return tuple(motors)


def _with_instrumentation(rig: Rig, config: Config, computed: SensorNoise) -> Rig:
    """The rig with what is measured of it, where that is not a torque, a speed and a load of each wheel."""
    n, vehicle, chassis = len(rig.wheels), config.vehicle, rig.chassis
    assert vehicle is not None
    assert chassis is not None
    axles = (*config.axles, "both")
    of_axle = {name: tuple(i for i, w in enumerate(config.wheel) if name in ("both", w.axle)) for name in axles}
    axle_ratio: dict[str, float] = {a.name: a.gear_ratio for a in config.axle}
    ratio = np.array([axle_ratio.get(str(w.axle), 1.0) for w in config.wheel])
    groups = {
        quantity: [
            Group(tuple(rig.wheels.index(w.name) for w in same), (1.0 / len(same),) * len(same), same[0].name)
            for same in config.same_signal(quantity)
        ]
        for quantity in ("torque", "speed", "load")
    }
    for a in config.axle:
        wheels = tuple(i for i in of_axle[a.name] if rig.drives[i])
        shaft = ratio[list(wheels)] if a.name == "both" else np.ones(len(wheels))
        if a.torque is not None:
            groups["torque"].append(Group(wheels, tuple((1.0 / shaft).tolist()), a.name))
        if a.motor_speed is not None:
            groups["speed"].append(Group(wheels, tuple((shaft / len(wheels)).tolist()), a.name))
        if a.load is not None:
            groups["load"].append(Group(of_axle[a.name], (1.0,) * len(of_axle[a.name]), a.name))
    couplings = tuple(_couplings(config, of_axle, rig.drives, groups))
    side = math.hypot(computed.gain, rig.options.measurements.side_slope_share if config.signals.roll is None else 0.0)
    otherwise = {
        "torque": _torque_rows(rig, couplings, ratio),
        "speed": _speed_rows(rig, couplings, ratio, groups["speed"]),
        "load": _load_rows(rig, vehicle, side, config.measures_draft or vehicle.towing == "never"),
    }
    torque, speed, load = (rows_of(n, groups[q], rig.noise[q].gain, rows) for q, rows in otherwise.items())
    plain = np.eye(n)
    if all(np.array_equal([row.weight for row in rows], plain) and all(row.kind == "channel" for row in rows)
           for rows, _ in (torque, speed, load)):  # fmt: skip
        return rig
    motors = tuple(group for group in groups["torque"] if len(group.wheels) > 1)
    load_noise = computed.relative * math.sqrt(2.0 * rig.options.measurements.load_time_scale / config.estimator.bin)
    given = Instrumentation(torque[0], speed[0], load[0], couplings, ratio, load_noise, motors)
    return replace(rig, instrumentation=given, names={"torque": torque[1], "speed": speed[1], "load": load[1]})


def _couplings(
    config: Config, of_axle: Mapping[str, tuple[int, ...]], drives: NDArray[np.bool_], groups: Mapping[str, list[Group]]
) -> Iterator[Coupling]:
    """The differentials: of each axle, and between the axles; wheels on one signal of speed turn together."""
    is_switched = config.vehicle is not None and config.vehicle.differential_lock is not None
    together = [set(group.wheels) for group in groups["speed"] if len(group.wheels) > 1 and group.name not in of_axle]
    for name in config.axles:
        wheels, axle = [i for i in of_axle[name] if drives[i]], config.axle_named(name)
        kind = "open" if axle is None else axle.differential
        bias = DIFFERENTIAL_BIAS[kind] if axle is None or axle.torque_bias is None else axle.torque_bias
        for one, other in pairwise(wheels):
            rigid = any({one, other} <= wheels_together for wheels_together in together)
            yield Coupling((one,), (other,), bias, kind == "locked" or rigid, kind == "open", is_switched=is_switched)
    centre = config.axle_named("both")
    driven = [on for name in config.axles if (on := tuple(i for i in of_axle[name] if drives[i]))]
    for front, rear in pairwise(driven):
        kind = "locked" if centre is None else centre.differential
        bias = DIFFERENTIAL_BIAS[kind] if centre is None or centre.torque_bias is None else centre.torque_bias
        yield Coupling(front, rear, bias, kind == "locked", kind == "open", of_axle=False)


def _torque_rows(rig: Rig, couplings: Sequence[Coupling], ratio: Array) -> list[Row]:
    """Free wheels, differentials; at last what nothing is known of."""
    n = len(rig.wheels)
    free = [Row(unit(n, i), "free", i, rig.wheels[i]) for i in np.flatnonzero(~rig.drives).tolist()]
    sums = [contrast(n, c.one, c.other, np.where(np.isin(np.arange(n), c.one), len(c.one), len(c.other)) / ratio)
            for c in couplings]  # fmt: skip
    of_couplings = [
        Row(weight, "coupling", i, "-".join("".join(rig.wheels[w] for w in part) for part in (c.one, c.other)))
        for i, (weight, c) in enumerate(zip(sums, couplings, strict=True))
    ]
    return [*free, *of_couplings, *(Row(unit(n, i), "unknown", i, rig.wheels[i]) for i in range(n))]


def _speed_rows(rig: Rig, couplings: Sequence[Coupling], ratio: Array, groups: Sequence[Group]) -> list[Row]:
    """Wheels on one signal, differentials, wheels without a sensor."""
    n = len(rig.wheels)
    same = [
        Row(contrast(n, [one], [other], np.ones(n)), "same", one, "")
        for group in groups
        if group.name in rig.wheels
        for one, other in pairwise(group.wheels)
    ]
    of_couplings = [Row(contrast(n, c.one, c.other, ratio), "coupling", i, "") for i, c in enumerate(couplings)]
    return [*same, *of_couplings, *(Row(unit(n, i), "free", i, rig.wheels[i]) for i in range(n))]


def _load_rows(rig: Rig, vehicle: Vehicle, side: float, knows_draft: bool) -> list[Row]:
    """Weight, transfer to the front axle, axles between beside the others' line, and left less right; side: sd."""
    # a draft that nothing measures, anywhere from 0 to the largest, shifts load in all of a window
    n, chassis = len(rig.wheels), rig.chassis
    assert chassis is not None
    mass_std = UNKNOWN_SHARE if vehicle.mass_std is None else vehicle.mass_std / vehicle.mass
    cg_std = UNKNOWN_SHARE * vehicle.wheelbase if vehicle.cg_std is None else vehicle.cg_std
    share = chassis.cg_ahead_of_rear_axle / chassis.wheelbase
    transfer = rig.ahead - share
    shifted = 0.0 if knows_draft else rig.options.measurements.largest_draft / math.sqrt(12.0) * chassis.hitch_height
    balance_std = math.hypot(cg_std, shifted) / chassis.cg_ahead_of_rear_axle
    rows = [
        Row((1.0,) * n, "weight", 0, "weight", mass_std),
        Row(tuple(transfer.tolist()), "transfer", 0, "balance", balance_std),
    ]
    line = np.stack([np.ones(n), rig.ahead])
    for axle in rig.axles[1:-1]:
        alone = np.isin(np.arange(n), axle).astype(float)
        alone -= line.T @ np.linalg.lstsq(line.T, alone, rcond=None)[0]
        name = "share-" + "-".join(rig.wheels[i] for i in axle)
        rows.append(Row(tuple(alone.tolist()), "frame", axle[0], name, rig.options.measurements.axle_share))
    for axle in rig.axles:
        for one, other in pairwise(axle):
            name = f"{rig.wheels[one]}-{rig.wheels[other]}"
            rows.append(Row(contrast(n, [one], [other], np.ones(n)), "side", one, name, side))
    return rows


def chassis_of(config: Config) -> Chassis | None:
    """Return the mass and geometry; None for a test rig."""
    if config.vehicle is None:
        return None
    given = config.vehicle.model_dump(include={f.name for f in fields(Chassis)})
    return Chassis(**given, on_one_axle=config.on_one_axle)


def prior_of(config: Config) -> SoilPrior:
    """Return the prior of the soil parameters."""
    return SoilPrior.from_value_std({name: (p.value, p.std) for name, p in config.soil_prior.items()})


def model_of(config: Config) -> WheelModel:
    """Return the wheel-soil model of fits, without effects."""
    return WheelModel(shear_law=config.model.shear_law, nodes=FAST_NODES, rollers=config.rollers)


def form_of(config: Config) -> tuple[float, ...]:
    """Return how far each of `model_form.FORM` may be from the model; 0 where an effect has that parameter."""
    named, form = {effect.name for effect in config.model.effects}, config.model.form
    peak = 0.0 if "stress_peak_shift" in named else 1.0
    leave, shear = float("rut_recovery" not in named), float("exponential_shear" not in named)
    return peak * form.peak, peak * form.peak_by_slip, leave * form.exit, shear * form.shear


def effects_of(config: Config, wheels: Sequence[str] | None = None) -> tuple[Active, ...]:
    """Return the effects of model.effects with their values, in the order of the catalogue.

    wheels: those of the arrays (W,), by default all.  A parameter is a number or, as `diagnose --model-out` writes it,
    {value = x, std = y}; one of each wheel may be a table of these, {FL = x, RR = {value = y, std = z}}, and becomes an
    array.  What is not given stays neutral.

    Raises
    ------
    ConfigError
        With a line for each unknown effect or parameter, value out of range or not a number,
        effect given twice, or shear law that the effect cannot be combined with.
    """
    return tuple(
        Active(effect, {name: value for name, (value, _) in given.items()})
        for effect, given in _given_effects(config, wheels)
    )


Given = dict[str, tuple[Any, Any]]
"""Value and sd of each parameter, numbers or (W,)."""


def _given_effects(config: Config, wheels: Sequence[str] | None = None) -> list[tuple[Effect, Given]]:
    """Effects of model.effects with what is given of each parameter, as `effects_of`."""
    if not config.model.effects:
        return []
    from soilbus.terra.effects.catalogue import CATALOGUE  # not needed at a start without effects

    all_wheels = [wheel.name for wheel in config.wheel]
    columns = [all_wheels.index(name) for name in (all_wheels if wheels is None else wheels)]
    faults: list[str] = []
    found: dict[str, Given] = {}
    for setting in config.model.effects:
        try:
            if setting.name in found:
                raise ConfigError([f"two effects are named {setting.name}"])
            found[setting.name] = _given(setting, config.model.shear_law, all_wheels, columns)
            if CATALOGUE[setting.name].of_tyre and not _has_tyres(config):
                raise ConfigError([f"{setting.name} is of a tyre, and every wheel is said to be rigid"])
        except ConfigError as error:
            faults += error.faults
    if faults:
        raise ConfigError(f"model.effects: {fault}" for fault in faults)
    return [(effect, found[name]) for name, effect in CATALOGUE.items() if name in found]


def possible_effects(config: Config) -> list[Effect]:
    """Return the effects of the catalogue that the machine can have, with its tyres and sensors."""
    from soilbus.terra.effects.catalogue import CATALOGUE

    return [e for e in CATALOGUE.values() if (_has_tyres(config) or not e.of_tyre) and _read(config, e)]


def _read(config: Config, effect: Effect) -> bool:
    """Whether the machine has the sensors that an effect is an error of."""
    if config.table is not None:
        return True
    has_cells = any(w.load is not None for w in config.wheel) or any(a.load is not None for a in config.axle)
    return (effect.load is None or has_cells) and (effect.draft is None or config.measures_draft)


def _has_tyres(config: Config) -> bool:
    return not config.wheel or any(wheel.tyre == "flexible" for wheel in config.wheel)


def delays_of(config: Config) -> dict[str, float]:
    """Return the delay [s] of each quantity by the effects of model.effects; ConfigError as `effects_of`."""
    if not config.model.effects:
        return {}
    from soilbus.terra.effects.sensors import lateness

    return lateness(effects_of(config))


def effects_and_parameters_of(config: Config, undelayed: bool = True) -> tuple[tuple[Effect, ...], tuple[Free, ...]]:
    """Return the effects of the estimator's model, and their parameters with value and sd of each prior.

    undelayed: whether the intake has already corrected the delays of channels (`delays_of`), so that effects which make
    channels late are left out.  Effects that describe one record only are left out, such parameters are held neutral.
    Wheels are those of `rig_of`; ConfigError as `effects_of`.
    """
    wheels, effects, free = rig_of(config).wheels, list[Effect](), list[Free]()
    for effect, given in _given_effects(config, wheels):
        if effect.of_record or (undelayed and effect.late):
            continue
        effects.append(effect)
        for parameter in effect.parameters:
            given_or_neutral = (parameter.neutral, 0.0) if parameter.of_record else given[parameter.name]
            shape = len(wheels) if effect.each_wheel else 1
            value, std = (np.broadcast_to(part, shape).tolist() for part in given_or_neutral)
            for i in range(shape):
                free.append(Free(effect.name, parameter, i if effect.each_wheel else None, value[i], std[i]))
    return tuple(effects), tuple(free)


def with_effects(config: Config, texts: Iterable[str]) -> Config:
    """Return the configuration with effects added or changed; ConfigError as `effects_of`.

    texts: NAME=VALUE for the first parameter of an effect, NAME.PARAMETER=VALUE for another one,
    NAME.PARAMETER.WHEEL=VALUE for that of one wheel.
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


def _given(setting: EffectSetting, shear_law: str, wheels: Sequence[str], columns: Sequence[int]) -> Given:
    """What is given of an effect's parameters, arrays of the wheels in these columns."""
    effect, given = _effect(setting.name), setting.model_extra or {}
    names = [parameter.name for parameter in effect.parameters]
    faults = [
        f"{effect.name} has no parameter {key}{did_you_mean(key, names)}; known: {', '.join(names)}"
        for key in given
        if key not in names
    ]
    if effect.base_law not in (None, shear_law):
        faults.append(f"{effect.name} can be added to shear_law = {effect.base_law} only: set model.shear_law")
    found: Given = {}
    for parameter in effect.parameters:
        try:
            value = given.get(parameter.name, parameter.neutral)
            found[parameter.name] = (
                _of_wheels(value, parameter, wheels, columns) if effect.each_wheel else _value_std(value, parameter)
            )
        except ConfigError as error:
            faults += [f"{effect.name}.{parameter.name}: {fault}" for fault in error.faults]
    if faults:
        raise ConfigError(faults)
    return found


def _effect(name: str) -> Effect:
    from soilbus.terra.effects.catalogue import CATALOGUE

    if name not in CATALOGUE:
        raise ConfigError([f"no effect is named {name}{did_you_mean(name, CATALOGUE)}; known: {', '.join(CATALOGUE)}"])
    return CATALOGUE[name]


def _of_wheels(given: Any, parameter: Parameter, wheels: Sequence[str], columns: Sequence[int]) -> tuple[Any, Any]:
    by_wheel = given if _by_wheel(given) else dict.fromkeys(wheels, given)
    if unknown := [name for name in by_wheel if name not in wheels]:
        raise ConfigError([f"no wheel is named {name}{did_you_mean(name, wheels)}" for name in unknown])
    pairs = [_value_std(by_wheel.get(name, parameter.neutral), parameter) for name in wheels]
    value, std = np.array(pairs).reshape(-1, 2).T[:, columns]
    return value, std


def _by_wheel(given: Any) -> bool:
    return isinstance(given, Mapping) and "value" not in given


def _value_std(given: Any, parameter: Parameter) -> tuple[float, float]:
    """Value within the parameter's range, and the sd given with it, else 0."""
    std = 0.0
    if isinstance(given, Mapping) and set(given) <= {"value", "std"}:
        std, given = _number(given.get("std", 0.0)), given.get("value")
        if std < 0.0:
            raise ConfigError([f"std {std:g} is less than 0"])
    value = _number(given)
    if not parameter.low <= value <= parameter.high:
        raise ConfigError([f"{value:g} is not within {parameter.low:g}..{parameter.high:g}"])
    return value, std


def _number(given: Any) -> float:
    try:
        value = math.nan if isinstance(given, bool) else float(given)
    except (TypeError, ValueError):
        value = math.nan
    if not math.isfinite(value):
        raise ConfigError([f"{given!r} is not a number"])
    return value
