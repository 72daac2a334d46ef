"""Commands of the controls engineer: replay, simulate, diagnose, effects.

Each function takes the parsed arguments, imports what it needs, does the work and writes the outputs asked for.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from soilbus.cli.common import WorkError, check_folders, configured, configured_or_reference, need_extra
from soilbus.files import whole_file
from soilbus.process import say

if TYPE_CHECKING:
    from soilbus.config.model import Config
    from soilbus.pipeline.result import WindowResult


def replay(args: argparse.Namespace) -> None:
    """`soilbus replay`: the daemon's pipeline over recorded logs, or over tables of a test rig."""
    from soilbus.can.dbc_files import load_databases
    from soilbus.offline.replay import LogError, estimator_beside, other_channel, replay
    from soilbus.pipeline.pipeline import Pipeline
    from soilbus.report.progress import progress
    from soilbus.report.windows import summary

    config = configured(args)
    _check_outputs(args, config)
    if config.table is not None:
        _replay_tables(args, config)
        return
    for line in other_channel(config, args.logs):
        say(line)
    pipeline = Pipeline(config, load_databases(config))
    results: list[WindowResult] = []
    faults: list[LogError] = []
    with estimator_beside(config) as workers, progress("replay") as step:
        try:
            results.extend(replay(pipeline, args.logs, step, workers, faults.append if args.partial else None))
        except LogError as error:
            kept = [f"the {error.windows} windows before"] * (error.windows > 0) + ["the other logs"] * (
                len(args.logs) > 1
            )
            hint = f"; --partial keeps {' and '.join(kept)}" if kept else ""
            raise WorkError(f"{error}{hint}") from None
    for fault in faults:
        say(f"{fault}; {fault.windows} windows before that are kept")
    text = summary(results, pipeline)
    _write_windows(args, config, results, text)
    if "-" not in (str(args.json), str(args.map)):
        print(text, end="")
    _need_a_use(results, config)


def _need_a_use(results: Sequence[WindowResult], config: Config) -> None:
    from soilbus.report.advice import of_use
    from soilbus.report.windows import why_of_no_use

    if not of_use(results):
        raise WorkError(why_of_no_use(results, config.estimator.window))


def _replay_tables(args: argparse.Namespace, config: Config) -> None:
    from collections import Counter

    from soilbus.offline.replay import LogError
    from soilbus.offline.tables import replay_tables
    from soilbus.report.windows import summary_of

    try:
        results = list(replay_tables(config, args.logs))
    except LogError as error:
        raise WorkError(str(error)) from None
    refused = sum((Counter(result.rejected) for result in results), Counter[str]())
    text = summary_of(results, f"{len(args.logs)} tables", None, refused)
    _write_windows(args, config, results, text)
    if str(args.json) != "-":
        print(text, end="")
    _need_a_use(results, config)


def _write_windows(args: argparse.Namespace, config: Config, results: Sequence[WindowResult], text: str) -> None:
    """What the options for files ask for, under a summary."""
    from soilbus.export.geopackage import write_geopackage
    from soilbus.export.mcap_log import write_mcap
    from soilbus.export.soil_map import soil_map
    from soilbus.export.table import write_table
    from soilbus.export.task_data import write_task_data
    from soilbus.pipeline.outputs import json_line
    from soilbus.report.windows import html_report

    if args.json is not None:
        with whole_file(args.json) as out:
            for result in results:
                out.write(json_line(result, config) + "\n")
    if args.report is not None:
        with whole_file(args.report) as out:
            out.write(html_report(results, text, args.logs))
    if args.table is not None:
        write_table(args.table, results, config)
    if args.mcap is not None:
        write_mcap(args.mcap, results, config)
    if args.map is not None:
        map_text, left_out = soil_map(results)
        if args.map.suffix == ".gpkg":
            write_geopackage(args.map, map_text)
        else:
            with whole_file(args.map) as out:
                out.write(map_text)
        if left_out:
            say(f"{left_out} of {len(results)} windows have no position: not on the map")
    if args.isoxml is not None and (left_out := write_task_data(args.isoxml, results, config)):
        say(f"{left_out} of {len(results)} windows have no position or no date: not in the task data")


def _check_outputs(args: argparse.Namespace, config: Config) -> None:
    """Ask before the work whether what the options for files need is there."""
    from soilbus.export.soil_map import check_position_is_mapped

    for path, option in ((args.map, "--map"), (args.isoxml, "--isoxml")):
        if path is not None:
            check_position_is_mapped(config, option)
    if args.report is not None:
        need_extra("matplotlib", "plots", "--report")
    if args.table is not None and args.table.suffix == ".parquet":
        need_extra("pyarrow", "tables", "--table OUT.parquet")
    if args.mcap is not None:
        need_extra("mcap", "mcap", "--mcap")
    if args.map is not None and args.map.suffix == ".gpkg":
        need_extra("pyogrio", "geo", "--map OUT.gpkg")
    check_folders(args.table, args.mcap, args.map)


def simulate(args: argparse.Namespace) -> None:
    """`soilbus simulate`: the simulated tractor, to a bus or a log."""
    from soilbus.can.bus import BusError
    from soilbus.estimation.assembly import with_effects
    from soilbus.simulator.course import course
    from soilbus.simulator.drive import SimulationError
    from soilbus.simulator.play import play, scenario_over
    from soilbus.simulator.recording import simulate

    config = with_effects(configured_or_reference(args), args.effect)
    try:
        way = course(args.start, args.heading, args.rows)
        recording = simulate(config, scenario_over(args.soil or ["loam"], args.duration, way), args.seed)
        play(recording, config, args.log)
    except (SimulationError, KeyError, ValueError, BusError) as error:
        raise WorkError(str(error.args[0])) from None
    except OSError as error:
        raise WorkError(f"{args.log or 'bus'}: {error.strerror or error}") from None
    if recording.bogged_at is not None:
        say(f"the tractor is stuck after {recording.bogged_at:.1f} s")


def effects(args: argparse.Namespace) -> None:
    """`soilbus effects`: the catalogue."""
    from soilbus.cli.effects import effect_text, effects_json, overview
    from soilbus.config.model import ConfigError
    from soilbus.terra.effects.catalogue import CATALOGUE
    from soilbus.words import did_you_mean

    if args.name is not None and args.name not in CATALOGUE:
        raise ConfigError([f"no effect {args.name}{did_you_mean(args.name, CATALOGUE)}"])
    wanted = [CATALOGUE[args.name]] if args.name else list(CATALOGUE.values())
    if args.json is not None:
        with whole_file(args.json) as out:
            out.write(effects_json(wanted) + "\n")
    if str(args.json) != "-":
        print(effect_text(wanted[0]) if args.name else overview(wanted), end="")


def diagnose(args: argparse.Namespace) -> None:
    """`soilbus diagnose`: find, name, add, show."""
    from soilbus.config.edit import with_effects_text
    from soilbus.config.file import found_configuration
    from soilbus.diagnosis.diagnose import NotFitted
    from soilbus.diagnosis.model_out import effect_tables
    from soilbus.diagnosis.records import TooLittle
    from soilbus.offline.diagnose import diagnose_logs
    from soilbus.offline.replay import LogError
    from soilbus.report.findings import findings_json, findings_text
    from soilbus.report.progress import phases

    config = configured(args)
    if args.report is not None:
        need_extra("matplotlib", "plots", "--report")
        from soilbus.report.diagnosis import diagnosis_report
    check_folders(args.json, args.report, args.model_out)
    try:
        with phases("diagnose") as say:
            findings = diagnose_logs(config, args.logs, say)
    except (LogError, NotFitted, TooLittle) as error:
        raise WorkError(str(error)) from None
    texts: list[tuple[Path, str]] = []
    if args.json is not None:
        texts.append((args.json, findings_json(findings)))
    if args.report is not None:
        texts.append((args.report, diagnosis_report(findings)))
    if args.model_out is not None:
        effects, notes = effect_tables(findings.diagnosis.completed)
        text = with_effects_text(found_configuration(args.config), args.set, effects, args.model_out.parent, notes)
        texts.append((args.model_out, text))
    for path, text in texts:
        with whole_file(path) as out:
            out.write(text)
    if all(str(path) != "-" for path, _ in texts):
        print(findings_text(findings), end="")
