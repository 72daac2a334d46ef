"""What `soilbus check` prints: received values beside the configuration, mapped signals, what these sensors determine.

With a recording its table stands first: what was received of each signal. Then one row for each mapped signal (unit,
factor, range, cycle time), one line for each soil parameter and, on demand, one line for each setting.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from cantools.database.can import Database

from soilbus.arrays import Array
from soilbus.can.channels import Channel
from soilbus.can.dbc_files import checked_messages, load_databases, output_database
from soilbus.can.logs import Log
from soilbus.can.mapping import AXLE_ROLES, SHARED_ROLES, WHEEL_ROLES, channels_of, without_unit
from soilbus.config.model import Config, Form, Signal
from soilbus.estimation.assembly import effects_and_parameters_of, effects_of, prior_of, rig_of
from soilbus.estimation.instrumentation import channel_value, completed
from soilbus.estimation.posterior import NORMAL_95, PARAMETERS
from soilbus.estimation.window import VEHICLE_QUANTITIES, NoiseTable, made_window
from soilbus.offline.columns import SignalTable
from soilbus.pipeline.estimator import WindowEstimator
from soilbus.pipeline.intake import WindowTask
from soilbus.pipeline.modelled_drive import modelled_drive
from soilbus.pipeline.outputs import PARAMETER_FRAMES, check_cycle_times
from soilbus.report.proposal import BEARING_STD_WITHOUT_CELLS
from soilbus.report.table import table
from soilbus.sensors.survey import Survey
from soilbus.terra.effects.sensors import lateness
from soilbus.terra.soils import KINDS, SOILS
from soilbus.words import shown, text_of


def configuration_report(config: Config) -> str:
    """Return the whole report of `soilbus check`; ConfigError with one line for each fault."""
    effects_and_parameters_of(config)
    if config.table is not None:
        columns = [(role, c.column, f"{c.factor:g}") for role, c in config.table.columns.items()]
        text = table(("role", "column", "factor to SI"), columns)
    else:
        database = load_databases(config)
        channels = channels_of(config, database)
        check_cycle_times(config, output_database(config))
        assumed = {c.name for c in without_unit(channels, database)}
        checked = checked_messages(config, database)
        rows = [_row(c, database, c.name in assumed, c.message in checked) for c in channels]
        text = table(("role", "signal", "unit", "factor to SI", "plausible", "every", "status"), rows)
    text += "\nWhat these sensors determine of the soil:\n"
    text += "".join(f"{name:<8} {verdict}\n" for name, verdict in identifiable(config).items())
    text += "".join(f"\n{line}\n" for line in load_lines(config))
    if effects := effect_lines(config):
        text += "\nEffects in the model:\n" + "".join(f"{line}\n" for line in effects)
    return text + f"\nWhat is assumed of the soil before any data:\n{prior_text(config)}\n"


def configuration_warnings(config: Config) -> list[str]:
    """Return the lines on what is assumed, or cannot be estimated, because the configuration does not say it."""
    lines = []
    quantities = [q for q in _measured(config) if q not in config.noise.model_fields_set]
    if "noise" not in config.model_fields_set:
        assumed = "no [noise]: that of a well-instrumented tractor is assumed, and the error bars with it"
        lines.append(f"{assumed}; give it from data sheets or a drive on the road")
    elif quantities:
        lines.append(f"[noise] does not give {', '.join(quantities)}: the defaults below are assumed")
    if config.table is None:
        lines += _lines_of_vehicle(config)
    for role in SHARED_ROLES:
        for wheels in config.same_signal(role):
            if len(wheels) > 1:
                names, alone = " and ".join(wheel.name for wheel in wheels), ""
                if role == "load":
                    alone = "; if it is the cell of one wheel, map it for that one alone: other loads are then computed"
                of = f"{getattr(wheels[0], role).signal} is the {role} of {names}"
                mean = "one measurement of their mean, with one noise"
                lines.append(f"{of}: {mean}; what differs between them stays open{alone}")
    c = config.soil.c
    if 0.0 < c.value < MIN_COHESION and c.std > 0.0:
        lines.append(f"soil.c.value = {c.value:g} Pa is next to nothing; is it in kPa?")
    return lines


def no_slope(config: Config) -> str:
    """Return a line on a vehicle without a sensor that shows the slope; "" with one."""
    felt = config.signals.acceleration
    is_felt = config.signals.pitch is not None or (felt is not None and felt.kind == "specific_force")
    if config.vehicle is None or config.table is not None or is_felt:
        return ""
    level = "the ground counts as level, and each per cent of slope as a draft of one per cent of the weight"
    return f'neither signals.pitch nor an acceleration of kind "specific_force" is mapped: {level}'


def _lines_of_vehicle(config: Config) -> Iterator[str]:
    """A line for each signal that is needed, and for each key that contradicts what is mapped or that nothing uses."""
    vehicle, signals = config.vehicle, config.signals
    if not rig_of(config).wheels:
        yield "no wheel that drives has a torque and a speed mapped, its own or its axle's: nothing can be estimated"
    elif signals.ground_speed is None:
        yield "signals.ground_speed is not mapped: without slip nothing can be estimated"
    if vehicle is None:
        return
    if vehicle.towing == "measured" and signals.draft is None:
        what = "the draft is unknown, so there is no GO, only what could be pulled"
        yield f'signals.draft is not mapped, and vehicle.towing is not "never": {what}'
    if vehicle.towing == "unknown" and signals.draft is not None:
        what = 'if it shows all that is towed, "measured" is meant'
        yield f'vehicle.towing = "unknown": signals.draft is not used, so there is no GO; {what}'
    if line := no_slope(config):
        yield line
    if vehicle.steering == "skid" and not (vehicle.track or signals.yaw_rate):
        what = "how far the wheels slide sideways in a turn is not known"
        yield f'vehicle.steering = "skid" with neither vehicle.track nor signals.yaw_rate: {what}'
    for wheel in config.wheel:
        if wheel.gear_ratio != 1.0 and not any(getattr(wheel, role) for role in WHEEL_ROLES):
            own = f"{wheel.section}.{wheel.name}.gear_ratio = {wheel.gear_ratio:g}"
            yield f"{own} concerns no signal of it; that of the axle's motor is axle.{wheel.axle}.gear_ratio"


MAX_SOILS_NAMED = 3
"""Soils outside an interval that are named; the others are counted."""
SAMPLES_PER_SECOND = 50.0
"""Of each channel, where the DBC does not say otherwise: frames every 20 ms."""
MIN_COHESION = 70.0
"""Cohesion [Pa] below which kPa were probably meant: Wong's table has 69 kPa for stiff clay, 1 kPa for loose sand."""


def _measured(config: Config) -> Iterator[str]:
    """The quantities that are mapped and whose noise counts."""
    if config.table is not None:
        names = {"wheel_load": "load", "drawbar_pull": "draft"}
        yield from (names.get(role, role) for role in config.table.columns if role != "t")
        return
    for quantity in type(config.noise).model_fields:
        of_axle = [role for role, measured in AXLE_ROLES.items() if measured == quantity]
        places = [(config.signals, quantity), *((wheel, quantity) for wheel in config.wheel)]
        places += [(axle, role) for axle in config.axle for role in of_axle]
        if any(getattr(place, name, None) is not None for place, name in places):
            yield quantity


def log_report(log: Log | SignalTable, found: Survey) -> str:
    """Return what a log is, how long, of which channels, and which of the mapped messages it holds."""
    mapped = dict.fromkeys(seen.channel.message for seen in found.seen)
    heard = {seen.channel.message for seen in found.seen if seen.count or seen.refused}
    missing = [name for name in mapped if name not in heard]
    channels = ", ".join(f"{name} {n}" for name, n in sorted(log.channels.items()) if name)
    what, parts = ("values", "columns") if isinstance(log, SignalTable) else ("frames", "messages")
    lines = [f"{log.name}: {log.kind}, {log.span:.1f} s, {log.channels.total()} {what}"]
    if isinstance(log, Log):
        lines.append(f"channels: {channels or 'not named'}" + (f"; read: {log.chosen}" if log.left_out else ""))
    absent = f"; not in it: {', '.join(missing)}" if missing else ""
    lines.append(f"mapped {parts}: {len(heard)} of {len(mapped)}{absent}")
    return text_of(lines)


def survey_report(found: Survey) -> str:
    """Return the received values of every mapped signal, and what the recording cannot show."""
    rows = []
    for seen in found.seen:
        of_it = [f for f in found.findings if seen.channel.name in f.channels]
        status = "plausible" if seen.count else "not heard"
        if of_it:
            status = "fault, see below" if any(f.fatal for f in of_it) else "warning, see below"
        values = [f"{x:.4g}" if seen.count else "-" for x in (seen.low, seen.median, seen.high)]
        every = f"{1e3 / seen.rate:.0f} ms" if math.isfinite(seen.rate) else "-"
        refused = str(sum(seen.refused.values()))
        rows.append((seen.channel.name, str(seen.count), every, *values, seen.unit, refused, status))
    head = ("role", "values", "every", "from", "median", "to", "unit", "refused", "beside the configuration")
    return "\n" + table(head, rows) + text_of(f"not checkable from this log: {line}" for line in found.open)


def defaults_text(config: Config) -> str:
    """Return every setting with its value in force, one dotted KEY = VALUE a line."""
    whole = config.model_dump(exclude={"signals", "folder"})
    listed = {"name", *WHEEL_ROLES, *AXLE_ROLES}  # or in the table of signals
    for kind in ("track", "axle", "wheel"):  # the wheel of a track is the track
        own = [part for part in whole[kind] if kind != "wheel" or part["name"] not in whole["track"]]
        whole[kind] = {part["name"]: {k: v for k, v in part.items() if k not in listed} for part in own}

    def lines(path: str, value: Any) -> Iterator[str]:
        if isinstance(value, Mapping):
            for key, inner in value.items():
                yield from lines(f"{path}.{key}" if path else key, inner)
        else:
            yield shown(f"{path} = {value}")

    return "\n".join(lines("", whole))


def load_lines(config: Config) -> Iterator[str]:
    """Yield what replaces missing load cells, and what that costs in a window of varied draft."""
    rig = rig_of(config)
    given = rig.instrumentation
    if given is None or rig.chassis is None or not given.computes("load").any():
        return
    shared = [[rig.wheels[i] for i in np.flatnonzero(row.weight)] for row in given.load if row.kind == "channel"]
    together = [wheels for wheels in shared if len(wheels) > 1]
    for wheels in together:
        yield f"{' and '.join(wheels)} are weighed together: what each carries follows from roll and their torques."
    computed = [rig.wheels[i] for i in np.flatnonzero(given.computes("load"))]
    if without := [wheel for wheel in computed if not any(wheel in wheels for wheels in together)]:
        of = "the load follows from mass, centre of gravity, pitch, acceleration and draft"
        instant = "in a single instant is hardly known (noise.computed_load)"
        yield f"No load cell at {', '.join(without)}: {of}, and {instant}."
    cells = [wheel.model_copy(update={"load": wheel.load or Signal(signal="A.Cell")}) for wheel in config.wheel]
    own, with_cells = _expected(config), _expected(config.model_copy(update={"wheel": cells}))
    if own is None or with_cells is None:
        return
    limit, load = config.estimator.max_bearing_std, "slope" if rig.towing == "never" else "draft"
    after = f"After {config.estimator.window:g} s of varied {load} on the soil assumed below"
    pressure = f"bearing pressure is known to {own[0]:.1%} (with load cells to {with_cells[0]:.1%})"
    friction = f"tan phi to {own[1]:.1%} ({with_cells[1]:.1%}), as far as the sensors go"
    yield f"{after}, {pressure}, {friction}; what the form of the contact leaves open comes on top."
    if own[0] > limit:
        is_usual = own[0] <= BEARING_STD_WITHOUT_CELLS
        way_out = f"set it to {BEARING_STD_WITHOUT_CELLS:g}" if is_usual else "narrow the soil's prior in [soil]"
        windows = f"Windows that know it to no better than {limit:.0%} (estimator.max_bearing_std)"
        yield f"{windows} count as not excited, and there is no GO; without load cells {way_out}."


def _expected(config: Config) -> tuple[float, float] | None:
    """Relative sd of bearing pressure and tan phi after one window of `modelled_drive`; None where no fit converges.

    By the sensors alone: with the form of the contact as the model has it.
    """
    closed = Form(peak=0.0, peak_by_slip=0.0, exit=0.0, shear=0.0)
    config = config.model_copy(update={"model": config.model.model_copy(update={"form": closed})})
    s, estimator = config.estimator, WindowEstimator(config)
    rig = estimator.rig
    t = np.asarray((np.arange(round(s.window / s.bin)) + 0.5) * s.bin, np.float64)
    truth = modelled_drive(config, rig, t)
    mean: Array = np.full((len(t), len(rig.channels)), np.nan)
    mapped = {name for name in VEHICLE_QUANTITIES if getattr(config.signals, name, None) is not None}
    if any(wheel.sinkage is not None for wheel in config.wheel):
        mapped.add("sinkage")
    for i, name in enumerate(rig.channels):
        quantity, _, part = name.partition(".")
        if quantity in ("torque", "speed", "load") or quantity in mapped:
            mean[:, i] = channel_value(rig, quantity, part, truth[quantity]) if part else truth[quantity]
    count = np.isfinite(mean) * s.bin * SAMPLES_PER_SECOND
    window = completed(made_window(NoiseTable.of(rig), t, mean, count, int(count.sum())), rig)
    task = WindowTask(
        index=0, start=0.0, end=s.window, window=window, slip=dict.fromkeys(rig.wheels),
        torque_limit=np.full(len(rig.wheels), np.nan), fresh=True,
    )  # fmt: skip
    posterior = estimator.estimate(task).result.posterior
    if posterior is None:
        return None
    bearing, tan_phi = posterior.bearing_pressure(s.z_ref, s.b_ref), posterior.tan_phi()
    of_bearing, of_tan_phi = (e.std / e.value if e.std else 0.0 for e in (bearing, tan_phi))  # a held one may be 0
    return of_bearing, of_tan_phi


def effect_lines(config: Config) -> list[str]:
    """Return a line for each effect: which of its parameters are estimated and which held, or why it does not count."""
    effects, free = effects_and_parameters_of(config)
    lines = []
    for active in effects_of(config):
        effect = active.effect
        if effect.late:
            late = ", ".join(f"{quantity} {delay:.3g} s" for quantity, delay in lateness([active]).items())
            lines.append(f"{effect.name}: taken out of the samples' stamps: {late}")
        elif effect not in effects:
            lines.append(f"{effect.name}: for simulate only; it describes the ground of one recording, no other's")
        else:
            found: dict[str, dict[str, None]] = {}
            for f in free:
                if f.effect == effect.name:
                    found.setdefault("estimated" if f.std > 0.0 else "held", {})[f.parameter.name] = None
            parts = (f"{what}: {', '.join(names)}" for what, names in sorted(found.items()))
            lines.append(f"{effect.name}: {'; '.join(parts)}")
    return lines


def _row(channel: Channel, database: Database, unit_assumed: bool, checked: bool) -> tuple[str, ...]:
    message = database.get_message_by_name(channel.message)
    unit = message.get_signal_by_name(channel.signal).unit
    status = "SI assumed: no unit given" if unit_assumed else "ok"
    if channel.valid_signal:
        status += f", valid while {channel.valid_signal} is {'/'.join(map(str, channel.valid_values))}"
    if channel.delay:
        status += f", late by {channel.delay:g} s"
    if checked:
        status += ", counter and CRC required"
    factor = f"{channel.factor:g}" + (f", + {channel.offset:g}" if channel.offset else "")
    every = f"{message.cycle_time} ms" if message.cycle_time else "not given"
    return channel.name, channel.path, unit or "-", factor, f"{channel.low:.4g} .. {channel.high:.4g}", every, status


def identifiable(config: Config) -> dict[str, str]:
    """Return what determines each soil parameter, or why nothing does."""
    rig, columns = rig_of(config), config.table
    if columns is not None:
        forces = [role.replace("_", " ") for role in ("torque", "drawbar_pull") if role in columns.columns]
        sinkage, widths = columns.sinkage is not None, False
    else:
        sinkage = any(wheel.sinkage for wheel in config.wheel if wheel.name in rig.wheels)
        widths = len({float(width) for width in rig.width}) > 1
        has_slip = bool(rig.wheels) and config.signals.ground_speed is not None
        forces = (["torque", "draft"] if config.measures_draft else ["torque"]) if has_slip else []
    if not forces and not sinkage:
        verdicts = dict.fromkeys(config.soil_prior, "no: needs torque, speed and load of a wheel and a ground speed")
    else:
        is_sure = len(forces) == 2
        known = f"{'yes' if is_sure else 'weakly'}: {', '.join(forces)}"
        strength = known if forces else "no: needs torque or drawbar pull"
        depth = f"{'yes' if is_sure or sinkage else 'weakly'}: {', '.join([*forces, *['sinkage'] * sinkage])}"
        verdicts = {
            "k_c": "weakly: two tyre widths" if widths else "no: needs two tyre widths (prior kept)",
            "k_phi": f"{depth} over varied load",
            "n": f"{depth} over varied load",
            "phi": f"{strength} over varied load and slip",
            "c": f"{strength.replace('yes', 'partly')} over varied load; the prior counts",
            "K": f"{strength.replace('weakly', 'yes')} over varied slip",
        }
    held = {name for name, prior in config.soil_prior.items() if prior.std == 0.0}
    return {name: "held by the configuration" if name in held else text for name, text in verdicts.items()}


def prior_text(config: Config) -> str:
    """Return the 95 % interval of each parameter before any data, and the known soils that lie outside of it.

    On a soil outside, a badly determined parameter would stay near the prior, with too small an sd.
    """
    prior, rows = prior_of(config), list[tuple[str, ...]]()
    for name, median, log_std in zip(PARAMETERS, prior.median.tolist(), prior.log_std.tolist(), strict=True):
        _, unit, size = PARAMETER_FRAMES[name]
        if log_std == 0.0:
            rows.append((name, f"{median / size:.3g}", "held", "", unit, ""))
            continue
        low, high = (median * math.exp(way * NORMAL_95 * log_std) for way in (-1.0, 1.0))
        values = {kind: getattr(SOILS[kind], name) for kind in KINDS}
        outside = sorted((kind for kind, v in values.items() if not low <= v <= high), key=lambda kind: -values[kind])
        named = ", ".join(f"{kind} ({values[kind] / size:.3g})" for kind in outside[:MAX_SOILS_NAMED])
        more = f" and {len(outside) - MAX_SOILS_NAMED} more" if len(outside) > MAX_SOILS_NAMED else ""
        rows.append((name, *(f"{x / size:.3g}" for x in (median, low, high)), unit, named + more or "none"))
    text = table(("parameter", "assumed", "95 % from", "to", "unit", "known soils outside"), rows)
    text += "\nOn a soil outside, a badly determined parameter stays near the prior, with a deviation too small; set"
    return f"{text}\n[soil] there.  Bearing pressure, drafts and slopes depend on what the sensors determine well."
