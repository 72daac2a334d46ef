"""Commands of the controls engineer: replay, simulate, diagnose, batch.

Each function takes the parsed arguments, does the work and writes the outputs asked for.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from soilbus.can.candump import Frame
from soilbus.can.dbc_files import load_databases
from soilbus.can.log_writer import write_log
from soilbus.cli.common import check_log_to_write, check_outputs, configured, need_extra, reading_or_writing
from soilbus.config.edit import with_effects_text
from soilbus.config.file import found_configuration, load_config
from soilbus.config.model import Config, ConfigError
from soilbus.files import read_bounded, whole_file, write_text
from soilbus.offline.replay import LogError, channel_notes, estimator_beside, log_of
from soilbus.offline.replay import replay as replay_logs
from soilbus.pipeline.outputs import json_line
from soilbus.pipeline.pipeline import Pipeline
from soilbus.pipeline.result import WindowResult
from soilbus.process import say
from soilbus.report.page import Source
from soilbus.report.progress import phases, progress
from soilbus.report.windows import of_use, summary, summary_of, why_of_no_use
from soilbus.simulator.scenario import Scenario
from soilbus.words import WorkError


def replay(args: argparse.Namespace) -> None:
    """Run `soilbus replay`: the daemon's pipeline over recorded logs, or over tables of a test rig."""
    config = configured(args)
    _check_files(args, config)
    results, text = (_replay_logs if config.table is None else _replay_tables)(args, config)
    _write_windows(args, config, results, text)
    drive = "" if config.table is not None else _what_to_drive(args, config, results)
    if "-" not in (str(args.json), str(args.map)):
        print(text + drive, end="")
    if not of_use(results):
        raise WorkError(why_of_no_use(results, config.estimator.window))
    if args.manoeuvre_out is not None and not drive:
        raise WorkError("--manoeuvre-out: no manoeuvre of the table can be driven by this vehicle on this soil")


def _replay_logs(args: argparse.Namespace, config: Config) -> tuple[list[WindowResult], str]:
    """The windows of logs and their summary."""
    for line in channel_notes(config, args.logs):
        say(line)
    pipeline = Pipeline(config, load_databases(config))
    faults: list[LogError] = []
    with estimator_beside(config) as workers, progress("replay") as step:
        try:
            results = list(replay_logs(pipeline, args.logs, step, workers, faults.append if args.partial else None))
        except LogError as error:
            kept = ["the other logs"] * (len(args.logs) > 1)
            if error.windows:
                kept.insert(0, f"the {error.windows} windows before")
            raise WorkError(f"{error}; --partial keeps {' and '.join(kept)}" if kept else str(error)) from None
    for fault in faults:
        say(f"{fault}; {fault.windows} windows before that are kept")
    return results, summary(results, pipeline)


def _replay_tables(args: argparse.Namespace, config: Config) -> tuple[list[WindowResult], str]:
    """The windows of a test rig's tables and their summary."""
    from soilbus.offline.tables import replay_tables

    results = list(replay_tables(config, args.logs))
    refused = sum((Counter(result.rejected) for result in results), Counter[str]())
    return results, summary_of(results, f"{len(args.logs)} tables", None, refused)


def _what_to_drive(args: argparse.Namespace, config: Config, results: Sequence[WindowResult]) -> str:
    """What to drive to know the soil better, where most windows are not excited or --manoeuvre-out asks for it."""
    useful = of_use(results)
    weak = sum(result.reason.startswith("not_excited") for result in useful)
    if not useful or (args.manoeuvre_out is None and 2 * weak < len(useful)):
        return ""
    now = useful[-1].posterior
    assert now is not None  # of_use sees to it
    from soilbus.offline.manoeuvre import what_excites  # the diagnosis and scipy, which few replays need
    from soilbus.report.findings import excitation_lines

    found = what_excites(config, now.soil)
    if found is None:
        return ""
    if args.manoeuvre_out is not None:
        write_text(args.manoeuvre_out, json.dumps(found[0].as_json(), indent=1) + "\n")
    return "\n".join(excitation_lines(*found, now, config)) + "\n"


def _write_windows(args: argparse.Namespace, config: Config, results: Sequence[WindowResult], text: str) -> None:
    """What the options for files ask for, under a summary."""
    from soilbus.export.geopackage import write_geopackage
    from soilbus.export.mcap_log import write_mcap
    from soilbus.export.soil_map import soil_map
    from soilbus.export.table import write_table
    from soilbus.export.task_data import write_task_data

    if args.json is not None:
        with whole_file(args.json) as out:
            for result in results:
                out.write(json_line(result, config) + "\n")
    if args.report is not None:
        from soilbus.report.replay import replay_report

        write_text(args.report, replay_report(results, text, _source(args, config)))
    if args.table is not None:
        write_table(args.table, results, config)
    if args.mcap is not None:
        write_mcap(args.mcap, results, config, _frames_read(args, config))
    if args.map is not None:
        map_text, left_out = soil_map(results)
        (write_geopackage if args.map.suffix == ".gpkg" else write_text)(args.map, map_text)
        if left_out:
            say(f"{left_out} of {len(results)} windows have no position: not on the map")
    if args.isoxml is not None and (left_out := write_task_data(args.isoxml, results, config)):
        say(f"{left_out} of {len(results)} windows have no position or no date: not in the task data")
    if args.frames is not None:
        from soilbus.offline.sent_frames import sent_frames

        with reading_or_writing(args.frames):
            write_log(sent_frames(config, args.logs), args.frames)


def _frames_read(args: argparse.Namespace, config: Config) -> Iterator[tuple[str, Frame]]:
    """The frames of the logs with their channels, read again; none of tables and of standard input."""
    if config.columns is not None or config.table is not None:
        return
    if "-" in map(str, args.logs):
        say("--mcap: standard input cannot be read again, so the file holds no frames and cannot be replayed")
        return
    for path in args.logs:
        log = log_of(config, path)
        with suppress(LogError):  # said before; the frames before the damage count
            yield from ((log.chosen, frame) for frame in log.frames())


def _check_files(args: argparse.Namespace, config: Config) -> None:
    """Ask before the work whether what the options for files need is there."""
    from soilbus.export.soil_map import check_position_is_mapped

    for path, option in ((args.map, "--map"), (args.isoxml, "--isoxml")):
        if path is not None:
            check_position_is_mapped(config, option)
    if args.report is not None:
        need_extra("plots", "--report", "jinja2", "matplotlib")
    if args.table is not None and args.table.suffix == ".parquet":
        need_extra("tables", "--table OUT.parquet", "pyarrow")
    if args.mcap is not None:
        need_extra("mcap", "--mcap", "mcap")
    if args.map is not None and args.map.suffix == ".gpkg":
        need_extra("geo", "--map OUT.gpkg", "pyogrio")
    check_log_to_write(args.frames)
    written = args.json, args.report, args.table, args.mcap, args.map, args.frames, args.manoeuvre_out
    check_outputs(*written, read=_read_files(args, config))
    if args.frames is not None and "-" in map(str, args.logs):
        raise ConfigError(["--frames reads each log again, which standard input cannot be"])
    if args.frames is not None and config.table is not None:
        raise ConfigError(["--frames: a table of a test rig has no bus to send on"])
    if args.manoeuvre_out is not None and config.table is not None:
        raise ConfigError(["--manoeuvre-out: a test rig is no vehicle to drive"])


def _read_files(args: argparse.Namespace, config: Config) -> list[Path]:
    """What replay and diagnose read: logs, configuration and DBCs."""
    return [*args.logs, Path(found_configuration(args.config)), *map(Path, config.dbc.input)]


def _source(args: argparse.Namespace, config: Config) -> Source:
    """What a report is made from."""
    return Source(config, found_configuration(args.config), args.set, args.logs)


def simulate(args: argparse.Namespace) -> None:
    """Run `soilbus simulate`: the simulated tractor, to a bus or a log."""
    from soilbus.estimation.assembly import with_effects
    from soilbus.simulator.course import course
    from soilbus.simulator.manoeuvre import LARGEST, of_json
    from soilbus.simulator.play import scenario_over

    check_log_to_write(args.log)
    check_outputs(args.truth, args.log)
    if args.truth is not None and args.truth.suffix == ".parquet":
        need_extra("tables", "--truth OUT.parquet", "pyarrow")
    config = with_effects(configured(args, or_reference=True), args.effect)
    try:
        way = course(args.start, args.heading, args.rows)
        soils, grade = args.soil or ["loam"], args.slope / 100.0
        scenario = scenario_over(soils, args.duration, way, args.draft, grade, args.speed, args.vehicle_seed)
        if config.tows_nothing and args.slope:
            scenario = replace(scenario, slip=None)  # which would make slopes of its own
        if args.manoeuvre is not None:
            if args.draft is not None or args.slope or args.speed is not None:
                raise ValueError("--manoeuvre has its own pull, slopes and speeds: leave out --draft, --slope, --speed")
            with reading_or_writing(args.manoeuvre):
                manoeuvre = of_json(read_bounded(args.manoeuvre, LARGEST).decode())
            scenario = manoeuvre.over(scenario, config.tows_nothing)
        bogged_at = _simulate_live(args, config, scenario) if args.bus else _simulate_log(args, config, scenario)
    except (KeyError, ValueError) as error:
        raise WorkError(str(error.args[0])) from None
    if bogged_at is not None:
        say(f"the tractor is stuck after {bogged_at:.1f} s")


def _simulate_log(args: argparse.Namespace, config: Config, scenario: Scenario) -> float | None:
    """Write the log; when the tractor bogged down [s]."""
    from soilbus.simulator.drive import drive
    from soilbus.simulator.frames import START_TIME, frames
    from soilbus.simulator.recording import recorded
    from soilbus.simulator.truth import write_truth

    done = drive(config, scenario, args.seed)
    with reading_or_writing(args.log):
        write_log(frames(recorded(done, config, scenario, args.seed), config), args.log)
    if args.truth is not None:
        write_truth(done, args.truth, START_TIME)
    return done.bogged_at


def _simulate_live(args: argparse.Namespace, config: Config, scenario: Scenario) -> float | None:
    """Drive on the bus; when the tractor bogged down [s]. An interrupted drive leaves its true values too."""
    from soilbus.simulator.drive import Drive, joined
    from soilbus.simulator.live import drive_live
    from soilbus.simulator.truth import write_truth

    driven: deque[Drive] = deque(maxlen=1 if args.truth is None else None)
    begin = time.time()
    try:
        begin = drive_live(config, scenario, args.seed, driven)
    finally:
        if args.truth is not None and driven:
            write_truth(joined(driven), args.truth, begin)
    return driven[-1].bogged_at


def diagnose(args: argparse.Namespace) -> None:
    """Run `soilbus diagnose`: find, name, add, show, and say what to drive next."""
    from soilbus.diagnosis.model_out import effect_tables
    from soilbus.offline.diagnose import diagnose_logs
    from soilbus.report.findings import findings_json, findings_text

    config = configured(args)
    if config.table is not None and args.manoeuvre_out is not None:
        raise ConfigError(["--manoeuvre-out: a test rig is no vehicle to drive"])
    if args.report is not None:
        need_extra("plots", "--report", "jinja2", "matplotlib")
        from soilbus.report.diagnosis import diagnosis_report
    check_outputs(args.json, args.report, args.model_out, args.manoeuvre_out, read=_read_files(args, config))
    for line in channel_notes(config, args.logs) if config.table is None else []:
        say(line)
    with phases("diagnose") as phase:
        findings = diagnose_logs(config, args.logs, phase)
    texts: list[tuple[Path, str]] = []
    if args.json is not None:
        texts.append((args.json, findings_json(findings)))
    if args.report is not None:
        texts.append((args.report, diagnosis_report(findings, _source(args, config), args.model_out)))
    if args.model_out is not None:
        effects, notes = effect_tables(findings.diagnosis.completed)
        text = with_effects_text(found_configuration(args.config), args.set, effects, args.model_out.parent, notes)
        texts.append((args.model_out, text))
    if args.manoeuvre_out is not None and findings.plan is not None:
        texts.append((args.manoeuvre_out, json.dumps(findings.plan.as_json(), indent=1) + "\n"))
    for path, text in texts:
        write_text(path, text)
    if all(str(path) != "-" for path, _ in texts):
        print(findings_text(findings), end="")
    if args.manoeuvre_out is not None and findings.plan is None:
        raise WorkError("--manoeuvre-out: no names are left to decide between that a drive would tell apart")


def batch(args: argparse.Namespace) -> None:
    """Run `soilbus batch`: many logs, on all cores or on a Dask cluster."""

    def own(path: Path) -> Config:
        return load_config(found_configuration(str(path)), args.set).model_copy(update={"log_channel": args.channel})

    config = configured(args)
    need_extra("batch", "batch", "distributed", "pyarrow")
    from soilbus.offline.batch import check_out, results_in, run_batch
    from soilbus.offline.cluster import cluster
    from soilbus.offline.jobs import jobs_of
    from soilbus.report.batch import batch_text

    check_outputs(args.out)
    check_out(args.out, args.resume or args.retry)
    try:
        parts = args.out / "parts" if args.resume or args.retry else None
        jobs = jobs_of(config, Path(args.config or found_configuration(None)).name, args.logs, own, parts)
        with phases("batch") as progress, cluster(args.scheduler) as client, results_in(args.out):
            done = run_batch(client, jobs, args.out, progress or (lambda _: None), args.diagnose, args.retry)
    except KeyboardInterrupt:
        say("stopped; --resume goes on from here")
        raise
    print(batch_text(done, args.out), end="")
    if not done.windows:
        raise WorkError(f"no log gave a window; each with its reason in {args.out / 'errors.parquet'}")
