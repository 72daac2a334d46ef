"""`python -m tests.lab.sensitivity`: what 30 % more or less of each tuning value changes.

    estimator    greatest |change of log pressure, tan phi, log n| / sd,  greatest change of an sd [%],
                 windows whose status changes,  change of the evaluations of the fits [%]
    diagnosis    cases whose verdict or names change,  greatest change of a name's probability,
                 greatest |change of log pressure| / sd,  change of the model evaluations [%]
    watch        boggings more or less in time, greatest change of a lead [s], false warnings more or less
    reception    spikes and sound samples refused more or less, windows more or less with data enough, bins of whole
                 recordings [%], windows with another torque limit, greatest change of a moment's slip [0.01] and of a
                 position [m]
    consistency  faults of sensors found more or less, windows more or less in which a sound one is named

Each field of the options is multiplied by 0.7 and by 1.3, counts rounded and changed by at least one, on fixed seeded
drives, cases, boggings and faults (`estimates`, `diagnoses`, `watches`, `receptions`,
`contradictions`).  A field of the solver is changed in the joint descent from a cold start, and in other descents where
they have a value of their own.  `--page` writes the tables of service/docs/sensitivity.md.
"""

from __future__ import annotations

import argparse
import ast
import math
import re
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from functools import cache, partial
from inspect import getsource
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from driven_windows import task_of, windows
from soilbus.arrays import Array
from soilbus.can.channels import Column, Decoded
from soilbus.can.dbc_files import load_databases
from soilbus.config.model import Config
from soilbus.decision import options as of_watch
from soilbus.decision.options import WatchOptions
from soilbus.diagnosis import options as of_diagnosis
from soilbus.diagnosis.diagnose import NotFitted, diagnose
from soilbus.diagnosis.options import DiagnosisOptions
from soilbus.diagnosis.records import Record, TooLittle, record_of
from soilbus.estimation import options as of_estimator
from soilbus.estimation.assembly import model_of, possible_effects, prior_of, rig_of
from soilbus.estimation.options import EstimatorOptions, SolverOptions
from soilbus.estimation.posterior import PARAMETERS, SoilPrior
from soilbus.estimation.tracker import Tracker
from soilbus.estimation.window import NoiseTable, Rig, Window, forward
from soilbus.pipeline.estimator import WindowEstimator
from soilbus.pipeline.intake import Intake
from soilbus.sensors import options as of_sensors
from soilbus.sensors.consistency import implausible
from soilbus.sensors.options import ConsistencyOptions, ReceptionOptions
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import AXLE_MOTORS, REAR_DRIVE, TRACTOR, reference_configuration
from soilbus.simulator.scenario import Patch, Scenario, Swing
from soilbus.terra.effects.effect import Effect
from soilbus.trials.bogging_trials import Task, WarningTrial
from soilbus.trials.boggings import KINDS
from soilbus.trials.firm_drives import EASY, FIRM_KINDS
from soilbus.trials.windows import bins_of
from tests.lab.blind.cases import Case, cases
from watched_drives import Observation, judged, observed

FACTORS = (0.7, 1.3)
EARTH_RADIUS = 6.378e6
"""[m]."""
HEAD = "| option | value | unit | -30 % | +30 % |"
SWEPT, STEADY = Swing(0.05, 0.40), Swing(0.15, 0.15 + 1e-6)
SECONDS = 40.0
"""Of each recording that is diagnosed."""
CASES: Mapping[str, Sequence[str]] = {
    "single/slip_sinkage:factor/small": (),
    "single/torque_lag:delay/medium": (),
    "single/hardpan:sharp/medium": (),
    "plain/rubicon_sandy_loam_43/bare": (),
    "outside/outside:tooth_error/large": (),
    "pair/tyre_deflection:power+drivetrain_loss:constant": (
        "tyre_deflection", "drivetrain_loss", "rut_recovery", "rolling_radius", "bulldozing", "grade",
    ),
    "single/draft_offset:constant/medium": ("draft_offset", "draft_gain", "grade"),
}  # fmt: skip
"""Beginnings of the ids of blind cases of seed 501, and their candidates where not all: these take long.  The last one
is diagnosed as two recordings of one vehicle."""


FAULTS: Mapping[str, tuple[Sequence[float], Callable[[Any, float], Any]]] = {
    "load.FL": ((1.2, 1.5, 2.0, 3.0), lambda value, size: value * size),
    "speed.FL": ((0.0, 0.7, 1.1, 1.3), lambda value, size: value * size),
    "motor_speed.RR": ((0.95, 1.1), lambda value, size: value * size),
    "torque.FL": ((0.0, -1.0), lambda value, size: value * size),
    "draft": ((-1.0,), lambda value, size: size * value + 5e3),
    "acceleration": ((-1.0, 0.6, 1.6), lambda value, size: value * size),
    "ground_speed": ((0.6, 0.9, 1.2, 1.6), lambda value, size: value * np.where(np.arange(len(value)) < 50, 1.0, size)),
    "pitch": ((7.0, 30.0), lambda value, size: np.where(np.arange(len(value)) < size, value[0], value)),
}  # fmt: skip
"""Sizes of a fault of each channel, about the limits, and what a channel with it reads: scaled, turned about, from half
the window on, or frozen for this number of bins."""
DRIVES = {
    "even slip": Scenario(10.0, (Patch(0.0, "loam"),), slip=SWEPT),
    "harsh slip": Scenario(10.0, (Patch(0.0, "loam"),), Swing(0.6, 2.5, 0.2, 0.5), slip=Swing(0.02, 0.6, 0.1, 0.4)),
    "harsh draft": Scenario(10.0, (Patch(0.0, "loam"),), Swing(0.6, 2.5, 0.2, 0.5), draft=Swing(0.0, 6e3, 0.1, 0.4)),
    "braking": Scenario(10.0, (Patch(0.0, "loam"),), Swing(0.6, 2.5, 0.2, 0.5), slip=Swing(-0.3, 0.3, 0.1, 0.4)),
    "sand": Scenario(10.0, (Patch(0.0, "dry_sand"),), slip=Swing(0.05, 0.7)),
}
"""Drives with the faults, and without any."""


class Field(NamedTuple):
    """A field of the options: its path, value, and the docstring beside it."""

    path: tuple[str, ...]
    value: float
    meaning: str

    @property
    def unit(self) -> str:
        """Unit in the docstring; counts have none."""
        found = re.search(r"\[([^]]+)\]", self.meaning)
        return found[1] if found else ("" if isinstance(self.value, int) else "1")

    def varied(self, factor: float) -> float:
        """The value times a factor; a count is rounded, and one more or less at least."""
        if not isinstance(self.value, int):
            return self.value * factor
        step = round(self.value * abs(factor - 1.0)) or 1
        return max(self.value + (step if factor > 1.0 else -step), 0)


@cache
def meanings(module: Any) -> Mapping[tuple[str, str], str]:
    """Docstrings of the fields of a module's classes, by class and field."""
    found = {}
    for one in ast.parse(getsource(module)).body:
        if isinstance(one, ast.ClassDef):
            for field, after in zip(one.body, one.body[1:], strict=False):
                if isinstance(field, ast.AnnAssign) and isinstance(after, ast.Expr):
                    found[one.name, ast.unparse(field.target)] = " ".join(ast.literal_eval(after.value).split())
    return found


def fields_of(options: Any, path: tuple[str, ...] = ()) -> Iterator[Field]:
    """All numbers of options and of the options in them; of a descent only what is its own, but for `cold`."""
    texts = {**meanings(of_estimator), **meanings(of_diagnosis), **meanings(of_watch), **meanings(of_sensors)}
    for field in fields(options):
        value, here = getattr(options, field.name), (*path, field.name)
        is_shared = isinstance(options, SolverOptions) and path[-1] != "cold" and value == field.default
        if is_dataclass(value):
            yield from fields_of(value, here)
        elif not isinstance(value, tuple) and math.isfinite(value) and value != 0.0 and not is_shared:
            yield Field(here, value, texts[type(options).__name__, field.name])


def with_field(options: Any, path: Sequence[str], value: float) -> Any:
    """The options with another value of one field."""
    first, *rest = path
    return replace(options, **{first: with_field(getattr(options, first), rest, value) if rest else value})


Figures = tuple[tuple[str, Callable[[Any, Any], float]], ...]
"""What is compared of two results, before and after: how it is printed, and its number."""


def change(figures: Figures, before: Any, after: Any) -> str:
    """The figures that do not round to zero, as they are printed; empty where nothing moved."""
    texts = [text.format(of(before, after)) for text, of in figures]
    return ", ".join(text for text in texts if re.search("[1-9]", text))


def differ(before: Sequence[Any], after: Sequence[Any]) -> int:
    """How many of the values are others."""
    return sum(a != b for a, b in zip(before, after, strict=True))


def greatest(values: Any) -> float:
    """The greatest of numbers, of which some are nan; 0 for none."""
    return float(np.nanmax(np.asarray(values, float), initial=0.0))


class Drive(NamedTuple):
    """Windows of a drive with their ends [s]."""

    config: Config
    windows: list[tuple[Window, float]]


@cache
def drives() -> tuple[Drive, ...]:
    """Three soils from cold to warm, constant slip, short windows, two borders, free wheels,
    one motor's speed for two wheels, no load cells, an effect."""
    loam = _drive([], "loam", 11.0)
    slip_sinkage = {"name": "slip_sinkage", "exponent": {"value": 0.3, "std": 0.1}}
    effect = loam.config.model.model_validate({"effects": [slip_sinkage]})
    return (
        loam,
        _drive([], "wet_clay", 11.0, sinkage=False),
        _drive([], "dry_sand", 11.0),
        _drive([], "dry_sand", 10.0, sinkage=False),
        _drive([], "loam", 10.0, slip=STEADY, sinkage=False),
        *(_drive(["estimator.window=2"], soil, 2.0, sinkage=False) for soil in ("loam", "wet_clay", "dry_sand")),
        _drive([], "loam", 24.0, then="wet_clay"),
        _drive([], "wet_clay", 24.0, then="loam"),
        _drive([], "loam", 10.0, path=REAR_DRIVE),
        _drive([], "wet_clay", 10.0, path=REAR_DRIVE, wheel_speeds=False),
        _drive([], "wet_clay", 10.0, path=AXLE_MOTORS),
        Drive(loam.config.model_copy(update={"model": effect}), loam.windows[:1]),
    )


def _drive(
    settings: list[str], soil: str, seconds: float, slip: Swing = SWEPT, sinkage: bool = True, then: str | None = None,
    path: Path = TRACTOR, wheel_speeds: bool = True,
) -> Drive:  # fmt: skip
    config = reference_configuration(settings, path)
    if not wheel_speeds:
        wheels = [wheel.model_copy(update={"speed": None}) for wheel in config.wheel]
        config = config.model_copy(update={"wheel": wheels})
    patches = (Patch(0.0, soil),) if then is None else (Patch(0.0, soil), Patch(16.0, then))
    recording = simulate(config, Scenario(seconds, patches, slip=slip), 501)
    if not sinkage:
        kept = {name: c for name, c in recording.channels.items() if not name.startswith("sinkage")}
        recording = replace(recording, channels=kept)
    return Drive(config, list(windows(config, recording)))


def estimates(options: EstimatorOptions) -> SimpleNamespace:
    """Of every window of the drives: status, [log pressure, tan phi, log n] and their sd; evaluations of all fits."""
    status, value, sd, work = [], [], [], 0
    for config, data in drives():
        estimator = WindowEstimator(config, partial(_tracker, rig_of(config, options)))
        for i, (window, end) in enumerate(data):
            result = estimator.estimate(task_of(window, end, config, i)).result
            status.append(result.status)
            work += result.iterations
            if (posterior := result.posterior) is None:
                value.append([math.nan] * 3)
                sd.append([math.nan] * 3)
                continue
            pressure = posterior.bearing_pressure(config.estimator.z_ref, config.estimator.b_ref)
            n, tan_phi = PARAMETERS.index("n"), posterior.tan_phi()
            value.append([math.log(pressure.value), tan_phi.value, math.log(posterior.soil.n)])
            sd.append([pressure.std / pressure.value, tan_phi.std, math.sqrt(posterior.log_covariance[n, n])])
    return SimpleNamespace(status=status, value=np.array(value), sd=np.array(sd), work=work)


OF_ESTIMATES: Figures = (
    ("{:.2f} sd", lambda a, b: greatest(np.abs(b.value - a.value) / a.sd)),
    ("sd {:.0f} %", lambda a, b: 100.0 * greatest(np.abs(np.log(b.sd / a.sd)))),
    ("{} status", lambda a, b: differ(a.status, b.status)),
    ("work {:+.0f} %", lambda a, b: 100.0 * (b.work / a.work - 1.0)),
)


def _tracker(rig: Rig, _: Rig, *further: Any) -> Tracker:
    """A tracker of a rig with other options in place of the configured one."""
    return Tracker(rig, *further)


class Recorded(NamedTuple):
    """What the diagnosis of a case is given: the windows of its recordings, divided for each diagnosis."""

    case: Case
    windows: tuple[Window, ...]
    rig: Rig
    prior: SoilPrior
    effects: tuple[Effect, ...]

    def records(self, options: DiagnosisOptions) -> list[Record]:
        """Its recordings, divided."""
        settings, model = self.case.config.estimator, model_of(self.case.config)
        limits = settings.min_speed, settings.max_turn
        return [record_of(f"{i}", w, self.rig, model, *limits, options) for i, w in enumerate(self.windows)]


@cache
def recorded() -> tuple[Recorded, ...]:
    """The cases, simulated."""
    return tuple(_recorded(name) for name in CASES)


def _recorded(name: str) -> Recorded:
    case = next(case for case in cases(name.partition("/")[0], 501) if case.id.startswith(name))
    store = bins_of(case.config, case.recording.channels)
    parts = 2 if name == list(CASES)[-1] else 1
    found = tuple(store.window(SECONDS * i, SECONDS * (i + 1)) for i in range(parts))
    effects = [e for e in possible_effects(case.config) if not CASES[name] or e.name in CASES[name]]
    return Recorded(case, found, store.rig, prior_of(case.config), tuple(effects))


def diagnoses(options: DiagnosisOptions) -> SimpleNamespace:
    """Of every case: verdict, probability by name, log pressure and its sd; model evaluations [instants] of all."""
    found: list[tuple[str, dict[str, float], float, float]] = []
    work = 0
    for one in recorded():
        try:
            records = one.records(options)
            told = diagnose(records, one.prior, list(one.effects))
        except (NotFitted, TooLittle, np.linalg.LinAlgError):
            found.append(("failed", {}, math.nan, math.nan))
            continue
        settings = one.case.config.estimator
        pressure = told.soil_after(0).bearing_pressure(settings.z_ref, settings.b_ref)
        names = {addition.effect.name: addition.probability for addition in told.additions}
        work += sum(record.training.work.instants for record in records)
        found.append((str(told.verdict), names, math.log(pressure.value), pressure.std / pressure.value))
    verdicts, chances, pressures, sds = zip(*found, strict=True)
    return SimpleNamespace(
        verdicts=verdicts, names=[set(of) for of in chances], chances=chances, pressure=np.array(pressures),
        sd=np.array(sds), work=work,
    )  # fmt: skip


OF_DIAGNOSES: Figures = (
    ("{} verdict", lambda a, b: differ(a.verdicts, b.verdicts)),
    ("{} names", lambda a, b: differ(a.names, b.names)),
    ("p {:.2f}", lambda a, b: greatest([
        abs(old[n] - new[n]) for old, new in zip(a.chances, b.chances, strict=True) for n in old.keys() & new.keys()
    ])),
    ("{:.2f} sd", lambda a, b: greatest(np.abs(b.pressure - a.pressure) / a.sd)),
    ("work {:+.0f} %", lambda a, b: 100.0 * (b.work / a.work - 1.0)),
)  # fmt: skip


@cache
def boggings() -> tuple[tuple[str, Observation], ...]:
    """A bogging of each kind and three drives on firm ground, on four motors and on one; kind and what the watch sees.

    Moments are means over `moment_span`, which is therefore not varied.
    """
    tasks = [
        Task(reference_configuration(path=path), kind, 501 + i)
        for path in (TRACTOR, REAR_DRIVE)
        for i, kind in enumerate((*KINDS, EASY, "headland", "stop_and_go"))
    ]
    return tuple((task.kind, observed(task)) for task in tasks)


def watches(options: WatchOptions) -> list[WarningTrial]:
    """The warnings of every drive."""
    return [judged(kind, observation, options) for kind, observation in boggings()]


OF_WATCHES: Figures = (
    ("{:+d} in time", lambda a, b: sum(one.in_time for one in b) - sum(one.in_time for one in a)),
    ("{:.1f} s", lambda a, b: greatest([abs(new.lead - old.lead) for old, new in zip(a, b, strict=True)])),
    ("{:+d} false", lambda a, b: _false(b) - _false(a)),
)


def _false(trials: Sequence[WarningTrial]) -> int:
    return sum(one.warnings for one in trials if one.kind in FIRM_KINDS)


SILENCES: Mapping[str, tuple[tuple[float, float], ...]] = {
    "load.FL": ((15.2, 0.4), (19.2, 0.5), (23.2, 0.6)), "speed.RR": ((34.2, 0.8),), "torque.FR": ((49.0, 1.2),),
    "ground_speed": ((63.0, 1.0), (78.0, 1.5)),
}  # fmt: skip
"""Times [s] at which channels say nothing, and for how long [s]."""
SPIKES, SPIKE_SD = 0.01, (4.0, 16.0)
"""Share [1] of the samples that are spikes, and their sizes [sd of the sensor]: a factor of about two on both sides of
the limits of 6.5 and 8 sd, so that these decide."""


@cache
def heard_drives() -> tuple[tuple[Config, Mapping[str, Column]], ...]:
    """A smooth drive and one with loads that shake, as they are; the second one with spikes, and with silences."""
    config = reference_configuration()
    smooth, shaking = (
        dict(simulate(config, Scenario(90.0, (Patch(0.0, "loam"),), slip=SWEPT, bounce=bounce), 521).channels)
        for bounce in (0.0, 0.12)
    )
    sd, rng = NoiseTable.of(rig := rig_of(config)), np.random.default_rng(522)
    spiked, silent = dict(shaking), dict(shaking)
    for name, column in shaking.items():
        t, value = column.t, column.value
        size = np.where(rng.random(len(t)) < SPIKES, rng.uniform(*SPIKE_SD, len(t)), 0.0) * rng.choice((-1, 1), len(t))
        if name in rig.channels:
            spiked[name] = Column(t, value + size * np.sqrt(sd.of_samples(value, rig.channels.index(name))))
        elif name.startswith("torque_limit"):
            spiked[name] = Column(t, np.where(size == 0.0, value, 0.0))
        in_silence = [(t >= begin) & (t < begin + length) for begin, length in SILENCES.get(name, ())]
        kept = ~np.any(in_silence, axis=0) if in_silence else np.ones(len(t), bool)
        silent[name] = Column(t[kept], value[kept])
    return tuple((config, channels) for channels in (smooth, shaking, spiked, silent))


def receptions(options: ReceptionOptions) -> list[SimpleNamespace]:
    """What the intake makes of every drive: samples refused, whether each window has data enough, torque limits,
    moments' slips and positions at the windows' ends, and the bin length of the whole drive."""
    return [_heard(config, channels, options) for config, channels in heard_drives()]


def _heard(config: Config, channels: Mapping[str, Column], options: ReceptionOptions) -> SimpleNamespace:
    intake = Intake(config, load_databases(config), options=options)
    enough, limit, slip, position = [], [], [], []
    for now in np.arange(config.estimator.hop, 90.0, config.estimator.hop).tolist():
        intake.add(_decoded(channels, now - config.estimator.hop, now))
        for task in intake.due(now):
            enough.append(not task.poor)
            limit.append(task.torque_limit)
            position.append(task.track.at((task.start + task.end) / 2.0) or (math.nan, math.nan))
        slip.append([math.nan if s is None else s for s in intake.latest(now).slip.values()])
    whole = Intake(config, load_databases(config), options=options)
    whole.add(_decoded(channels, 0.0, 20.0))
    window = whole.taken_whole()
    length = math.nan if window is None else float(window.t[1] - window.t[0])
    return SimpleNamespace(
        refused=intake.refusals.refused, enough=sum(enough), limit=np.array(limit), slip=np.array(slip),
        position=np.array(position), length=length,
    )  # fmt: skip


def _decoded(channels: Mapping[str, Column], begin: float, end: float) -> Decoded:
    parts = {name: slice(*np.searchsorted(c.t, (begin, end))) for name, c in channels.items()}
    return Decoded({name: Column(c.t[parts[name]], c.value[parts[name]]) for name, c in channels.items()})


def each(name: str) -> Callable[[Any, Any], Any]:
    """Of each drive, how much more a figure is than before."""
    return lambda a, b: [getattr(new, name) - getattr(old, name) for old, new in zip(a, b, strict=True)]


OF_RECEPTIONS: Figures = (
    ("{:+d} found", lambda a, b: each("refused")(a, b)[2] - each("refused")(a, b)[1]),
    ("{:+d} false", lambda a, b: sum(each("refused")(a, b)[:2])),
    ("{:+d} enough", lambda a, b: sum(each("enough")(a, b))),
    ("bins {:+.0f} %", lambda a, b: 100.0 * max(
        (new.length / old.length - 1.0 for old, new in zip(a, b, strict=True)), key=abs
    )),
    ("{} limits", lambda a, b: sum(
        int((old.limit != new.limit).any(axis=1).sum()) for old, new in zip(a, b, strict=True)
    )),
    ("slip {:.2f}", lambda a, b: max(greatest(np.abs(more)) for more in each("slip")(a, b))),
    ("{:.1f} m", lambda a, b: EARTH_RADIUS * max(greatest(np.abs(more)) for more in each("position")(a, b))),
)  # fmt: skip


@cache
def faulty_windows() -> tuple[tuple[str, Window, Array], ...]:
    """Channel with a fault, forward window and the motors' speeds (N, W), of each drive and fault."""
    config = reference_configuration([f"wheel.{w}.motor_speed=Motor{w}.ShaftSpeed" for w in ("FL", "FR", "RL", "RR")])
    rig, found = rig_of(config), []
    for seed, scenario in enumerate(DRIVES.values(), start=511):
        channels = simulate(config, scenario, seed).channels
        window = forward(bins_of(config, channels).window(0.0, config.estimator.window))
        of_motor = [channels[f"motor_speed.{w}"] for w in rig.wheels]
        motor = np.stack([np.interp(window.t, c.t, c.value) for c in of_motor], axis=1)
        found.append(("", window, motor))
        for channel, (sizes, reads) in FAULTS.items():
            quantity, _, wheel = channel.partition(".")
            of_wheel = rig.wheels.index(wheel) if wheel else slice(None)
            for size in sizes:
                values = (motor if quantity == "motor_speed" else getattr(window, quantity)).copy()
                values[..., of_wheel] = reads(values[..., of_wheel], size)
                if quantity == "motor_speed":
                    found.append((channel, window, values))
                else:
                    changed: dict[str, Any] = {quantity: values}
                    found.append((channel, replace(window, **changed), motor))
    return tuple(found)


def contradictions(options: ConsistencyOptions) -> SimpleNamespace:
    """Of each window: whether the channel with a fault is named, and whether a sound one is."""
    config = reference_configuration()
    rig = rig_of(config)
    named = [
        (fault, implausible(window, rig, config.estimator, {}, motor, options))
        for fault, window, motor in faulty_windows()
    ]
    return SimpleNamespace(
        found=sum(fault in names for fault, names in named),
        false=sum(bool({*names} - {fault}) for fault, names in named),
    )


OF_CONTRADICTIONS: Figures = (
    ("{:+d} found", lambda a, b: b.found - a.found),
    ("{:+d} false", lambda a, b: b.false - a.false),
)


def rows(name: str, options: Any, run: Callable[[Any], Any], figures: Figures, only: str) -> Iterator[str]:
    """Lines of the table, one for each field with `only` in its path."""
    before = run(options)
    for field in fields_of(options):
        path = ".".join(field.path)
        if only in f"{name}.{path}":
            less, more = (
                change(figures, before, run(with_field(options, field.path, field.varied(factor))))
                for factor in FACTORS
            )
            yield f"| `{path}` | {field.value:g} | {field.unit} | {less} | {more} |"


TABLES: tuple[tuple[str, Any, Callable[[Any], Any], Figures], ...] = (
    ("estimator", EstimatorOptions(), estimates, OF_ESTIMATES),
    ("diagnosis", DiagnosisOptions(), diagnoses, OF_DIAGNOSES),
    ("watch", WatchOptions(), watches, OF_WATCHES),
    ("reception", ReceptionOptions(), receptions, OF_RECEPTIONS),
    ("consistency", ConsistencyOptions(), contradictions, OF_CONTRADICTIONS),
)
"""Name, options, what they are tried on, and what is compared of two results."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse, run, print."""
    parser = argparse.ArgumentParser(prog="python -m tests.lab.sensitivity", description=__doc__)
    parser.add_argument("--only", default="", help="fields with this in their path, as estimator.search. (all)")
    parser.add_argument("--page", type=Path, help="write the tables into this Markdown page, in the place of its own")
    chosen = parser.parse_args(arguments)
    if chosen.only and chosen.page is not None:
        parser.error("--page needs the tables of all fields: leave out --only")
    lines: list[str] = []
    for name, options, run, figures in TABLES:
        if not any(chosen.only in f"{name}.{'.'.join(field.path)}" for field in fields_of(options)):
            continue
        began = time.process_time()
        lines += ["", f"## {name.capitalize()}", "", HEAD, "| - | - | - | - | - |"]
        for line in rows(name, options, run, figures, chosen.only):
            print(line, flush=True)
            lines.append(line)
        print(f"{name}: {time.process_time() - began:.0f} s of processor time", flush=True)
    if chosen.page is not None:
        text = chosen.page.read_text(encoding="utf-8").partition("\n## ")[0].rstrip()
        chosen.page.write_text("\n".join([text, *lines, ""]), encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
