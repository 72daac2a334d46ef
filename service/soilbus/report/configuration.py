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
from soilbus.config.model import Config, Form, Signal, Table
from soilbus.estimation.assembly import effects_and_parameters_of, effects_of, rig_of
from soilbus.estimation.instrumentation import channel_value, completed
from soilbus.estimation.window import VEHICLE_QUANTITIES, NoiseTable, made_window
from soilbus.offline.columns import SignalTable
from soilbus.pipeline.estimator import WindowEstimator
from soilbus.pipeline.intake import WindowTask
from soilbus.pipeline.modelled_drive import modelled_drive
from soilbus.pipeline.outputs import check_cycle_times
from soilbus.report.proposal import BEARING_STD_WITHOUT_CELLS
from soilbus.report.soil_prior import prior_text
from soilbus.report.table import table
from soilbus.sensors.survey import Seen, Survey
from soilbus.words import shown, text_of


def configuration_report(config: Config) -> str:
    """Return the whole report of `soilbus check`; ConfigError with one line for each fault."""
    effects_and_parameters_of(config)
    if config.table is not None:
        columns = [(role, c.column, f"{c.factor:g}") for role, c in config.table.columns.items()]
        return _report(config, [table(("role", "column", "factor to SI"), columns)])
    database = load_databases(config)
    channels = channels_of(config, database)
    check_cycle_times(config, output_database(config))
    assumed = {c.name for c in without_unit(channels, database)}
    checked = checked_messages(config, database)
    rows = [_row(channel, database, channel.name in assumed, channel.message in checked) for channel in channels]
    head = ("role", "signal", "unit", "factor to SI", "plausible", "every", "status")
    return _report(config, [table(head, rows)])


def configuration_warnings(config: Config) -> list[str]:
    """Return the lines on what is assumed, or cannot be estimated, because the configuration does not say it."""
    lines = []
    quantities = [q for q in _measured(config) if q not in config.noise.model_fields_set]
    if "noise" not in config.model_fields_set:
        lines.append(
            "no [noise]: each sensor's noise is assumed to be that of a well-instrumented tractor, and the error bars"
            " with it; give it from data sheets or a drive on the road"
        )
    elif quantities:
        lines.append(f"[noise] does not give {', '.join(quantities)}: the defaults below are assumed")
    if config.table is None and not rig_of(config).wheels:
        lines.append(
            "no wheel that drives has a torque and a speed mapped, its own or its axle's: nothing can be estimated"
        )
    elif config.table is None and config.signals.ground_speed is None:
        lines.append("signals.ground_speed is not mapped: without slip nothing can be estimated")
    lines += _lines_of_vehicle(config)
    for role in SHARED_ROLES:
        for wheels in config.same_signal(role):
            if len(wheels) > 1:
                names = " and ".join(wheel.name for wheel in wheels)
                lines.append(
                    f"{getattr(wheels[0], role).signal} is the {role} of {names}: one measurement of their mean, with"
                    " one noise; what differs between them stays open"
                    + (
                        "; if it is the cell of one wheel, map it for that one alone: the loads of the others are then"
                        " computed"
                        if role == "load"
                        else ""
                    )
                )
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
    return (
        'neither signals.pitch nor an acceleration of kind "specific_force" is mapped: the ground counts as level,'
        " and each per cent of slope as a draft of one per cent of the weight"
    )


def _lines_of_vehicle(config: Config) -> Iterator[str]:
    """A line for each key of the vehicle that contradicts what is mapped, or that nothing uses."""
    if config.vehicle is None or config.table is not None:
        return
    if config.vehicle.towing == "measured" and config.signals.draft is None:
        yield (
            'signals.draft is not mapped, and vehicle.towing is not "never": the draft is unknown, so there is no GO,'
            " only what could be pulled"
        )
    if config.vehicle.towing == "unknown" and config.signals.draft is not None:
        yield (
            'vehicle.towing = "unknown": signals.draft is not used, so there is no GO; if it shows all that is towed,'
            ' "measured" is meant'
        )
    if line := no_slope(config):
        yield line
    if config.vehicle.steering == "skid" and not (config.vehicle.track or config.signals.yaw_rate):
        yield (
            'vehicle.steering = "skid" with neither vehicle.track nor signals.yaw_rate: how far the wheels slide'
            " sideways in a turn is not known"
        )
    for wheel in config.wheel:
        at_motor = (getattr(wheel, role) for role in WHEEL_ROLES)
        if wheel.gear_ratio != 1.0 and not any(at_motor):
            yield (
                f"{wheel.section}.{wheel.name}.gear_ratio = {wheel.gear_ratio:g} concerns no signal of it; that of the"
                f" axle's motor is axle.{wheel.axle}.gear_ratio"
            )


SAMPLES_PER_SECOND = 50.0
"""Of each channel, where the DBC does not say otherwise: frames every 20 ms."""
MIN_COHESION = 70.0
"""Cohesion [Pa] below which kPa were probably meant: Wong's table has 69 kPa for stiff clay, 1 kPa for loose sand."""


def _measured(config: Config) -> Iterator[str]:
    """The quantities that are mapped and whose noise counts."""
    names = {"wheel_load": "load", "drawbar_pull": "draft"}
    if config.table is not None:
        yield from (names.get(role, role) for role in config.table.columns if role != "t")
        return
    for quantity in type(config.noise).model_fields:
        wheels = any(getattr(wheel, quantity, None) is not None for wheel in config.wheel)
        axles = any(
            getattr(a, role) is not None for a in config.axle for role in AXLE_ROLES if AXLE_ROLES[role] == quantity
        )
        if wheels or axles or getattr(config.signals, quantity, None) is not None:
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
    rows = [_heard_row(seen, found) for seen in found.seen]
    head = ("role", "values", "every", "from", "median", "to", "unit", "refused", "beside the configuration")
    return "\n" + table(head, rows) + text_of(f"not checkable from this log: {line}" for line in found.open)


def _heard_row(seen: Seen, found: Survey) -> tuple[str, ...]:
    of_it = [f for f in found.findings if seen.channel.name in f.channels]
    status = "fault, see below" if any(f.fatal for f in of_it) else "warning, see below" if of_it else "plausible"
    if not seen.count:
        status = status if of_it else "not heard"
    return (
        seen.channel.name,
        str(seen.count),
        f"{1e3 / seen.rate:.0f} ms" if math.isfinite(seen.rate) else "-",
        f"{seen.low:.4g}" if seen.count else "-",
        f"{seen.median:.4g}" if seen.count else "-",
        f"{seen.high:.4g}" if seen.count else "-",
        seen.unit,
        str(sum(seen.refused.values())),
        status,
    )


def _report(config: Config, parts: list[str]) -> str:
    effects = effect_lines(config)
    parts += [f"{name:<8} {verdict}\n" for name, verdict in identifiable(config)]
    parts += [f"\n{line}\n" for line in load_lines(config)]
    if effects:
        parts.append("\nEffects in the model:\n" + "".join(f"{line}\n" for line in effects))
    parts.append("\nWhat is assumed of the soil before any data:\n" + prior_text(config) + "\n")
    return "\n".join(parts[:1]) + "\nWhat these sensors determine of the soil:\n" + "".join(parts[1:])


def defaults_text(config: Config) -> str:
    """Return every setting with its value in force, one dotted KEY = VALUE a line."""
    lines: list[str] = []

    def walk(prefix: str, value: Any) -> None:
        if isinstance(value, Mapping):
            for k, v in value.items():
                walk(f"{prefix}.{k}" if prefix else k, v)
        elif prefix in ("axle", "wheel", "track"):
            for part in value:
                walk(f"{prefix}.{part['name']}", {k: v for k, v in part.items() if k not in _LISTED})
        else:
            lines.append(shown(f"{prefix} = {value}"))

    whole = config.model_dump(exclude={"signals", "folder"})
    tracks = {track["name"] for track in whole["track"]}
    whole["wheel"] = [wheel for wheel in whole["wheel"] if wheel["name"] not in tracks]
    walk("", whole)
    return "\n".join(lines)


_LISTED = {"name", *WHEEL_ROLES, *AXLE_ROLES}
"""Keys of a wheel, track or axle that say nothing beside the table of signals."""


def load_lines(config: Config) -> list[str]:
    """Return what replaces missing load cells, and what that costs in a window of varied draft."""
    rig = rig_of(config)
    given = rig.instrumentation
    if given is None or rig.chassis is None or not given.computes("load").any():
        return []
    wheels = [wheel.model_copy(update={"load": wheel.load or Signal(signal="A.Cell")}) for wheel in config.wheel]
    own, with_cells = _expected(config), _expected(config.model_copy(update={"wheel": wheels}))
    shared = [[rig.wheels[i] for i in np.flatnonzero(row.weight)] for row in given.load if row.kind == "channel"]
    of_sums = {wheel for wheels in shared for wheel in wheels if len(wheels) > 1}
    without = [rig.wheels[i] for i in np.flatnonzero(given.computes("load")) if rig.wheels[i] not in of_sums]
    lines = [
        f"{' and '.join(wheels)} are weighed together: what each carries follows from roll and their torques."
        for wheels in shared
        if len(wheels) > 1
    ]
    if without:
        lines.append(
            f"No load cell at {', '.join(without)}: the load follows from mass, centre of gravity, pitch, acceleration"
            " and draft, and in a single instant is hardly known (noise.computed_load)."
        )
    if own is None or with_cells is None:
        return lines
    limit, load = config.estimator.max_bearing_std, "slope" if rig.towing == "never" else "draft"
    way_out = "what is known of the soil, in [soil], narrows it"
    if limit < own[0] <= BEARING_STD_WITHOUT_CELLS:
        way_out = f"without load cells set it to {BEARING_STD_WITHOUT_CELLS:g}"
    too_wide = [
        f"Windows that know it to no better than {limit:.0%} (estimator.max_bearing_std) count as not excited, and"
        f" there is no GO; {way_out}."
    ]
    return [
        *lines,
        f"After {config.estimator.window:g} s of varied {load} on the soil assumed below, bearing pressure is known to"
        f" {own[0]:.1%} (with load cells to {with_cells[0]:.1%}), tan phi to {own[1]:.1%} ({with_cells[1]:.1%}), as far"
        " as the sensors go; what the form of the contact leaves open comes on top.",
        *(too_wide if own[0] > limit else []),
    ]


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
    from soilbus.terra.effects.sensors import lateness  # not needed at a start without effects

    effects, free = effects_and_parameters_of(config)
    lines = []
    for active in effects_of(config):
        effect = active.effect
        if effect.late:
            late = ", ".join(f"{quantity} {delay:.3g} s" for quantity, delay in lateness([active]).items())
            lines.append(f"{effect.name}: taken out of the samples' stamps: {late}")
            continue
        if effect not in effects:
            lines.append(f"{effect.name}: for simulate only; it describes the ground of one recording, no other's")
            continue
        own = [f for f in free if f.effect == effect.name]
        estimated, held = (
            list(dict.fromkeys(f.parameter.name for f in own if (f.std > 0.0) == e)) for e in (True, False)
        )
        parts = [f"{what} {', '.join(names)}" for what, names in (("estimated:", estimated), ("held:", held)) if names]
        lines.append(f"{effect.name}: {'; '.join(parts)}")
    return lines


def _row(channel: Channel, database: Database, unit_assumed: bool, checked: bool) -> tuple[str, ...]:
    message = database.get_message_by_name(channel.message)
    signal = message.get_signal_by_name(channel.signal)
    status = "SI assumed: no unit given" if unit_assumed else "ok"
    if channel.valid_signal:
        status += f", valid while {channel.valid_signal} is {'/'.join(map(str, channel.valid_values))}"
    if channel.delay:
        status += f", late by {channel.delay:g} s"
    if checked:
        status += ", counter and CRC required"
    every = f"{message.cycle_time} ms" if message.cycle_time else "not given"
    return (
        channel.name,
        channel.path,
        signal.unit or "-",
        f"{channel.factor:g}" + (f", + {channel.offset:g}" if channel.offset else ""),
        f"{channel.low:.4g} .. {channel.high:.4g}",
        every,
        status,
    )


def identifiable(config: Config) -> list[tuple[str, str]]:
    """Return each soil parameter with the sensors that determine it, or why none does."""
    rig = rig_of(config)
    held = {name for name, prior in config.soil_prior.items() if prior.std == 0.0}
    if config.table is not None:
        verdicts = _verdicts_of_table(config.table)
    elif not rig.wheels or config.signals.ground_speed is None:
        verdicts = dict.fromkeys(config.soil_prior, "no: needs torque, speed and load of a wheel and a ground speed")
    else:
        draft = config.measures_draft
        widths = len({float(b) for b in rig.width}) > 1
        sinkage = any(w.sinkage for w in config.wheel if w.name in rig.wheels)
        both = "yes: torque and draft over varied load and slip"
        alone = "weakly: torque alone; a draft signal would help"
        verdicts = {
            "k_c": "weakly: two tyre widths" if widths else "no: needs two tyre widths (prior kept)",
            "k_phi": (both if draft else alone) + (", and sinkage" if sinkage else ""),
            "n": (both if draft else alone) + (", and sinkage" if sinkage else ""),
            "phi": both if draft else alone,
            "c": "partly: torque over varied load; the prior counts",
            "K": "yes: torque over varied slip",
        }
    return [(name, "held by the configuration" if name in held else text) for name, text in verdicts.items()]


def _verdicts_of_table(columns: Table) -> dict[str, str]:
    """What the columns of a test rig determine of each soil parameter."""
    forces = " and ".join(role.replace("_", " ") for role in ("torque", "drawbar_pull") if role in columns.columns)
    depth = "yes: sinkage over varied load" if columns.sinkage else f"weakly: {forces} alone; sinkage would help"
    strength = f"{forces} over varied" if forces else "no: needs torque or drawbar pull (prior kept)"
    return {
        "k_c": "no: needs two tyre widths (prior kept)",
        "k_phi": depth,
        "n": depth,
        "phi": f"yes: {strength} load and slip" if forces else strength,
        "c": f"partly: {strength} load; the prior counts" if forces else strength,
        "K": f"yes: {strength} slip" if forces else strength,
    }
