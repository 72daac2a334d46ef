"""Tables of a test rig: rows of steady states, read as windows for the estimator and the diagnosis.

    rim speed v_r = constant,    ground speed v = v_r (1 - slip),    var(v) = v_r^2 var(slip)

A table holds slip, not speeds, so the rim speed is chosen and the whole error of the slip is in the ground speed.
Effects that depend on the true speed cannot be identified from such a table; `candidates` leaves them out.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from soilbus.arrays import Array
from soilbus.config.model import Column, Config, Table
from soilbus.diagnosis.records import Record, TooLittle, record_of_rows
from soilbus.estimation.assembly import effects_and_parameters_of, model_of, possible_effects, rig_of
from soilbus.estimation.window import Rig, Window, window_of_samples
from soilbus.offline.columns import Columns, TableError, check_columns, number, read_columns
from soilbus.offline.recordings import Recordings, check_different
from soilbus.offline.replay import log_names
from soilbus.pipeline.estimator import WindowEstimator
from soilbus.pipeline.intake import WindowTask, column_means
from soilbus.pipeline.result import WindowResult
from soilbus.terra.effects.effect import Effect
from soilbus.terra.effects.size import for_wheel
from soilbus.terra.vehicle import slip_ratio
from soilbus.words import LONGEST_NAME, shown

ROW_PERIOD = 1.0
"""Time [s] from one row to the next where the table has no times."""
RIM_SPEED_RATIO = 100.0
"""Rim speed of the stand-in over the least speed at which slip is judged, so that no slip counts as a standstill."""
OF_TRUE_SPEED = frozenset({"rate_stiffening", "inertia"})
"""Effects that depend on the true speed, which a table does not hold."""
OF_TIME = frozenset({"torque_lag", "channel_lag", "soil_drift", "grade"})
"""Effects that depend on time."""
OF_SEVERAL_WHEELS = frozenset({"multipass"})
"""Effects that need another wheel."""


@dataclass(frozen=True, slots=True)
class Run:
    """Rows of one soil bed as a window (N rows, one wheel), and rows left out by reason."""

    name: str
    window: Window
    rejected: dict[str, int]


def runs_of(config: Config, path: Path, name: str | None = None) -> list[Run]:
    """Return the runs of a CSV or Parquet file, one for each soil bed, in the order of their first rows.

    A cell that is empty or says nan, NA or null is missing; a row without load or slip is left out and counted. Cells
    of CSV are separated by commas, semicolons or tabs; beside the latter two numbers may have decimal commas. Runs are
    called by `name`, by default the file's, with the soil bed where [table] run is given.

    TableError where the file cannot be read, a column is missing, a cell is no number, or no row is left.
    """
    return _runs(config, read_columns(path, _needed(_table_of(config, str(path)))), str(path), name or path.name)


def runs_of_columns(config: Config, columns: Columns, source: str) -> list[Run]:
    """Return the runs of columns in memory, as runs_of(); None is missing, too.

    Messages and the only run are called by `source`.
    """
    check_columns(source, list(columns), _needed(_table_of(config, source)))
    return _runs(config, columns, source, source)


def _table_of(config: Config, source: str) -> Table:
    if config.table is None:
        raise TableError(f"{source}: the configuration has no [table] that maps its columns")
    return config.table


def _runs(config: Config, columns: Columns, source: str, name: str) -> list[Run]:
    """The runs of the needed columns of a table; `source` stands in messages, `name` in the runs' names."""
    table = _table_of(config, source)
    n = len(next(iter(columns.values())))
    chosen = [i for i in range(n) if all(_equal(columns[name][i], wanted) for name, wanted in table.where.items())]
    if not chosen:
        raise TableError(f"{source}: no row in it" + (" that [table] where asks for" if table.where else ""))
    values = {role: _numbers(source, columns, column, chosen) for role, column in table.columns.items()}
    names = [name] * len(chosen)
    if table.run is not None:
        names = [f"{name}, {shown(str(columns[table.run][row]).strip(), LONGEST_NAME)}" for row in chosen]
    rig, runs = rig_of(config), []
    for bed in dict.fromkeys(names):
        members = np.array([i for i, other in enumerate(names) if other == bed])
        runs.append(_run(bed, {role: v[members] for role, v in values.items()}, rig, config))
    if not any(len(run.window.t) for run in runs):
        reasons = ", ".join(sorted({reason for run in runs for reason in run.rejected}))
        raise TableError(f"{source}: no usable row in it ({reasons})")
    return runs


def replay_tables(config: Config, paths: Sequence[Path]) -> Iterator[WindowResult]:
    """Yield each run as one window of the daemon's own estimator; t is its last row's.  TableError as runs_of()."""
    named = zip(paths, log_names(paths), strict=True)
    return replay_runs(config, (run for path, name in named for run in runs_of(config, path, name)))


def replay_runs(config: Config, runs: Iterable[Run]) -> Iterator[WindowResult]:
    """Yield each run as one window of the daemon's own estimator, `log` its name; runs without rows are left out."""
    estimator = WindowEstimator(config)
    for index, run in enumerate(run for run in runs if len(run.window.t)):
        yield replace(estimator.solve(_task(index, run, estimator.rig)), log=run.name)


def _task(index: int, run: Run, rig: Rig) -> WindowTask:
    window, t = run.window, run.window.t
    slip = slip_ratio(rig.radius, window.speed, window.ground_speed[:, None])
    return WindowTask(
        index=index, start=float(t[0]), end=float(t[-1]), window=window, rejected=run.rejected, fresh=True,
        slip=dict(zip(rig.wheels, column_means(slip), strict=True)), torque_limit=np.full(len(rig.wheels), math.nan),
    )  # fmt: skip


def recordings_of_tables(config: Config, paths: Sequence[Path]) -> Recordings:
    """Return the runs of tables in the form that the diagnosis takes.

    TableError as runs_of(), LogError for a table given twice, TooLittle for a table of short runs.
    """
    check_different(paths)
    rig, model = rig_of(config), model_of(config)
    effects, free = effects_and_parameters_of(config)
    records: list[Record] = []
    first, too_short, rejected, samples = [], [], Counter[str](), 0
    for path in paths:
        first.append(len(records))
        for run in runs_of(config, path):
            samples += run.window.samples
            rejected += Counter(run.rejected)
            try:
                record = record_of_rows(run.name, run.window, rig, model)
            except TooLittle as error:
                too_short.append(run.name)
                fault = error
                continue
            records.append(record.with_effects(effects, free))
        if len(records) == first[-1]:
            raise fault
    return Recordings(tuple(records), tuple(first), samples, dict(rejected.most_common()), tuple(too_short))


def candidates(config: Config, records: Sequence[Record]) -> list[Effect]:
    """Return the effects that a table can identify and the wheel can have, with priors for its size and load.

    Effects of the true speed and of other wheels are left out; without a column of times those of time are too, because
    rows are often ordered by slip or load.
    """
    unknown = OF_TRUE_SPEED | OF_SEVERAL_WHEELS
    if config.table is None or config.table.t is None:
        unknown |= OF_TIME
    load = float(np.mean(np.concatenate([record.training.load[:, 0] for record in records])))
    radius = config.wheel[0].radius
    return [for_wheel(effect, load, radius) for effect in possible_effects(config) if effect.name not in unknown]


def _run(name: str, values: Mapping[str, Array], rig: Rig, config: Config) -> Run:
    n = len(values["slip"])
    t = np.asarray(values.get("t", np.arange(n) * ROW_PERIOD), np.float64)
    load, slip = values["wheel_load"], values["slip"]
    with np.errstate(invalid="ignore"):
        faults = {
            "no_load": ~np.isfinite(load),
            "no_slip": ~np.isfinite(slip),
            "no_time": ~np.isfinite(t),
            "load_range": load <= 0.0,
            "slip_range": np.abs(slip) >= 1.0,
        }
    reasons = [next((reason for reason, at in faults.items() if at[i]), "") for i in range(n)]
    kept = np.flatnonzero([not reason for reason in reasons])
    kept = kept[np.argsort(t[kept], kind="stable")]
    rejected = Counter(reason for reason in reasons if reason)
    rim_speed = RIM_SPEED_RATIO * config.estimator.min_speed
    window = window_of_rows(rig, t[kept], {role: v[kept] for role, v in values.items()}, rim_speed)
    return Run(name, window, dict(sorted(rejected.items())))


def window_of_rows(rig: Rig, t: Array, values: Mapping[str, Array], rim_speed: float = 1.0) -> Window:
    """Return a window of rows of one wheel at times [s] (N,), with quantities (N,) in SI by the roles of a table.

    nan is missing. The stand-in's rim speed [m/s] is exact; the ground speed gets the slip's variance.
    """
    wheel, slip, noise = rig.wheels[0], values["slip"], rig.noise["ground_speed"]
    samples = {
        f"load.{wheel}": values["wheel_load"],
        f"speed.{wheel}": np.full(len(t), rim_speed) / rig.radius[0],
        "ground_speed": rim_speed * (1.0 - slip),
    }
    for role, name in (("drawbar_pull", "draft"), ("torque", f"torque.{wheel}"), ("sinkage", f"sinkage.{wheel}")):
        if role in values:
            samples[name] = values[role]
    window = window_of_samples(rig, t, samples)
    level = float(np.abs(slip).mean()) if len(slip) else 0.0
    variance = noise.absolute**2 + (noise.relative * slip) ** 2 + (noise.of_mean * level) ** 2
    return replace(window, variance={**window.variance, "ground_speed": rim_speed**2 * variance})


def _needed(table: Table) -> list[str]:
    """Names of the columns that must be there."""
    mapped = [column.column for column in table.columns.values()]
    return list(dict.fromkeys([*mapped, *([table.run] if table.run else []), *table.where]))


def _equal(cell: Any, wanted: Any) -> bool:
    if isinstance(wanted, str):
        return str(cell).strip() == wanted
    try:
        return math.isclose(float(cell), wanted, rel_tol=1e-6, abs_tol=1e-12)
    except (TypeError, ValueError):
        return False


def _numbers(source: str, columns: Columns, column: Column, rows: Sequence[int]) -> Array:
    """A column's numbers in SI at these rows, nan where missing."""
    cells = columns[column.column]
    values = np.array([number(cells[row]) for row in rows])
    for row, value in zip(rows, values.tolist(), strict=True):
        if math.isinf(value):
            raise TableError(f"{source}: row {row + 1}, column {column.column}: {cells[row]!r} is not a number")
    return np.asarray(values * column.factor)
