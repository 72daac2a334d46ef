"""The command line: parse, call one function of a room, print.

Exit codes: 0 done; 1 the work could not be done; 2 wrong usage or configuration; 130 interrupted.
"""

from __future__ import annotations

import argparse
import logging
import os
import signal
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

from soilbus.allocator import loading
from soilbus.cli.arguments import command_line
from soilbus.files import NotWritten, whole_file
from soilbus.process import output_fault, say

if TYPE_CHECKING:
    from soilbus.can.candump import Frame
    from soilbus.config.model import Config
    from soilbus.pipeline.result import WindowResult
    from soilbus.sensors.survey import Survey

DONE, FAILED, WRONG_USAGE, INTERRUPTED = 0, 1, 2, 130


class WorkError(Exception):
    """The work could not be done; the text is one line for the user."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns its exit code."""
    args = command_line().parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(message)s", handlers=[_Told()])
    logging.getLogger("matplotlib").setLevel(logging.WARNING)  # what it does for itself is no news
    logging.getLogger("can").setLevel(logging.CRITICAL)  # a bus that is away is ours to tell of, once
    with loading():
        from soilbus.config.model import ConfigError
    try:
        _WORK[args.command](args)
        sys.stdout.flush()
    except ConfigError as error:
        for fault in error.faults:
            say(fault)
        return WRONG_USAGE
    except (WorkError, NotWritten) as error:
        say(str(error))
        return FAILED
    except KeyboardInterrupt:
        return INTERRUPTED
    except OSError as error:
        of_output = output_fault()
        if isinstance(of_output or error, BrokenPipeError):  # the reader of our output has seen enough
            return DONE
        where = "standard output: " if of_output else f"{error.filename}: " if error.filename else ""
        say(f"{where}{error.strerror or error}")
        return FAILED
    except MemoryError:
        say("not enough memory")
        return FAILED
    return DONE


class _Told(logging.Handler):
    """The journal, or the terminal: whatever standard error is at the time."""

    def emit(self, record: logging.LogRecord) -> None:
        """One line."""
        say(self.format(record))


def _configured(args: argparse.Namespace) -> Config:
    from soilbus.config.file import load_config

    return load_config(args.config, args.set)


def _configured_or_demo(args: argparse.Namespace) -> Config:
    from soilbus.simulator.reference import reference_configuration

    return _configured(args) if args.config else reference_configuration(args.set)


def _demo(args: argparse.Namespace) -> None:
    from soilbus.cli.demo import run_demo

    run_demo(args.duration)


def _run(args: argparse.Namespace) -> None:
    # python-can loads asammdf where it is installed: 2 s and 97 MB for files that the service never reads.
    sys.modules.setdefault("asammdf", None)  # type: ignore[arg-type]
    with loading():
        from soilbus.can.bus import BusError
        from soilbus.daemon.start import start_service

        config = _configured(args)
        wait = args.wait or "NOTIFY_SOCKET" in os.environ
        try:
            service = start_service(config, wait)
        except BusError as error:
            raise WorkError(str(error)) from None
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: service.stop())
    service.run()


def _check(args: argparse.Namespace) -> None:
    from soilbus.config.model import ConfigError
    from soilbus.report.configuration import configuration_report, configuration_warnings, survey_report

    config = _configured(args)
    print(configuration_report(config), end="")
    warnings, faults = configuration_warnings(config), list[str]()
    if args.log is not None or args.live is not None:
        found, of_channel = _surveyed(args, config)
        print(survey_report(found), end="")
        warnings += [*of_channel, *found.warnings]
        faults = found.faults
    for line in warnings:
        say(f"warning: {line}")
    if faults:
        raise ConfigError(faults)


def _surveyed(args: argparse.Namespace, config: Config) -> tuple[Survey, list[str]]:
    """What a recording, or the bus, says of the configuration, and whether it is of the configured channel."""
    from soilbus.can.bus import BusError, heard_for
    from soilbus.can.dbc_files import load_databases
    from soilbus.config.model import ConfigError
    from soilbus.offline.replay import LogError, other_channel, read_frames
    from soilbus.report.progress import progress
    from soilbus.sensors.survey import survey

    if config.table is not None:
        raise ConfigError(["[table]: check compares no table; replay and diagnose read it"])
    database = load_databases(config)
    try:
        if args.live is not None:
            return survey(config, database, heard_for(config.bus.model_dump(), args.live)), []
        with progress("check") as step:
            return survey(config, database, _counted(read_frames(args.log), step)), other_channel(config, [args.log])
    except (LogError, BusError) as error:
        raise WorkError(str(error)) from None


def _counted(frames: Iterable[Frame], step: Callable[[int, float], None] | None) -> Iterator[Frame]:
    first = None
    for n, frame in enumerate(frames):
        if step is not None and n % 10_000 == 0:
            first = frame[0] if first is None else first
            step(n, frame[0] - first)
        yield frame


def _replay(args: argparse.Namespace) -> None:
    from soilbus.can.dbc_files import load_databases
    from soilbus.offline.replay import LogError, estimator_beside, other_channel, replay
    from soilbus.pipeline.pipeline import Pipeline
    from soilbus.report.progress import progress
    from soilbus.report.soil_map import check_position_is_mapped, soil_map
    from soilbus.report.windows import summary

    config = _configured(args)
    if args.map is not None:
        check_position_is_mapped(config)
    if args.report is not None:
        _need("matplotlib", "plots", "--report")
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
    if args.map is not None:
        map_text, left_out = soil_map(results)
        with whole_file(args.map) as out:
            out.write(map_text)
        if left_out:
            say(f"{left_out} of {len(results)} windows have no position: not on the map")
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
    """What --json and --report ask for, under a summary."""
    from soilbus.pipeline.outputs import json_line
    from soilbus.report.windows import html_report

    if args.json is not None:
        with whole_file(args.json) as out:
            for result in results:
                out.write(json_line(result, config) + "\n")
    if args.report is not None:
        with whole_file(args.report) as out:
            out.write(html_report(results, text, args.logs))


def _simulate(args: argparse.Namespace) -> None:
    from soilbus.can.bus import BusError
    from soilbus.estimation.assembly import with_effects
    from soilbus.simulator.course import course
    from soilbus.simulator.drive import SimulationError
    from soilbus.simulator.play import play, scenario_over
    from soilbus.simulator.recording import simulate

    config = with_effects(_configured_or_demo(args), args.effect)
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


def _diagnose(args: argparse.Namespace) -> None:
    from soilbus.config.edit import with_effects_text
    from soilbus.diagnosis.diagnose import NotFitted
    from soilbus.diagnosis.model_out import effect_tables
    from soilbus.diagnosis.records import TooLittle
    from soilbus.offline.diagnose import diagnose_logs
    from soilbus.offline.replay import LogError
    from soilbus.report.findings import findings_json, findings_text
    from soilbus.report.progress import phases

    config = _configured(args)
    if args.report is not None:
        _need("matplotlib", "plots", "--report")
        from soilbus.report.diagnosis import diagnosis_report
    _check_folders(args.json, args.report, args.model_out)
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
        text = with_effects_text(Path(args.config), args.set, effects, args.model_out.parent, notes)
        texts.append((args.model_out, text))
    for path, text in texts:
        with whole_file(path) as out:
            out.write(text)
    if all(str(path) != "-" for path, _ in texts):
        print(findings_text(findings), end="")


def _watch(args: argparse.Namespace) -> None:
    from soilbus.can.bus import BusError
    from soilbus.report.dashboard import watch

    config = _configured_or_demo(args)
    try:
        watch(config, args.seconds)
    except BusError as error:
        raise WorkError(str(error)) from None


def _paper(args: argparse.Namespace) -> None:
    from soilbus.validation.paper_report import paper_report

    print(paper_report(args.sinkage, args.seed), end="")


def _montecarlo(args: argparse.Namespace) -> None:
    import json

    from soilbus.simulator.drive import SimulationError
    from soilbus.simulator.reference import reference_configuration
    from soilbus.validation.monte_carlo import ROUGHLY_KNOWN, as_json, monte_carlo, processes
    from soilbus.validation.monte_carlo_report import monte_carlo_report, with_progress

    config = _configured(args) if args.config else reference_configuration([*ROUGHLY_KNOWN, *args.set])
    try:
        with processes(os.cpu_count() or 1) as each:
            more = {"exact": args.exact, "around": args.around}
            cells = list(with_progress(monte_carlo(config, args.windows, args.seed, each=each, **more)))
    except SimulationError as error:
        raise WorkError(str(error)) from None
    if args.json is not None:
        with whole_file(args.json) as out:
            out.write(json.dumps([as_json(cell) for cell in cells], indent=1) + "\n")
    if str(args.json) != "-":
        print(monte_carlo_report(cells), end="")


def _decisions(args: argparse.Namespace) -> None:
    import json

    from soilbus.simulator.drive import SimulationError
    from soilbus.validation.bogging_trials import warning_trials
    from soilbus.validation.decisions_report import as_json, decisions_report
    from soilbus.validation.draft_trials import draft_trials
    from soilbus.validation.monte_carlo import processes
    from soilbus.validation.verdict_trials import verdict_trials

    config = _configured_or_demo(args)
    try:
        with processes(os.cpu_count() or 1) as each:
            drafts = list(draft_trials(config, args.drives, args.seed, each=each))
            calls = verdict_trials(config, args.calls, args.seed, each=each)
            warnings = warning_trials(config, args.boggings, args.hours, args.seed, each=each)
    except SimulationError as error:
        raise WorkError(str(error)) from None
    if args.json is not None:
        with whole_file(args.json) as out:
            out.write(json.dumps(as_json(drafts, calls, warnings), indent=1) + "\n")
    if str(args.json) != "-":
        print(decisions_report(drafts, calls, warnings), end="")


def _bench(args: argparse.Namespace) -> None:
    import json

    from soilbus.can.bus import BusError
    from soilbus.validation.bench import as_results, bench_report, run_bench
    from soilbus.validation.bench.bus import NotMeasured, bus_figures

    if args.bus is None:
        _need("scipy", "peers", "bench")
    with nullcontext() if args.json is None else whole_file(args.json) as out:  # first, for it takes a minute
        try:
            results = run_bench() if args.bus is None else as_results(bus_figures(args.bus, args.seconds))
        except (AssertionError, BusError, ModuleNotFoundError, NotMeasured) as error:
            raise WorkError(f"bench: {error}") from None
        if out is not None:
            out.write(json.dumps(results, indent=1) + "\n")
    if str(args.json) != "-":
        print(bench_report(results), end="")


def _need(module: str, extra: str, what: str) -> None:
    from importlib.util import find_spec

    if find_spec(module) is None:
        raise WorkError(f"{what} needs the extra soilbus[{extra}]")


def _check_folders(*paths: Path | None) -> None:
    """Long work asks first whether there is a place for what comes of it."""
    for path in paths:
        if path is not None and not path.parent.is_dir():
            raise WorkError(f"{path}: no folder {path.parent}")


_WORK: dict[str, Callable[[argparse.Namespace], None]] = {
    "demo": _demo,
    "run": _run,
    "check": _check,
    "replay": _replay,
    "simulate": _simulate,
    "diagnose": _diagnose,
    "watch": _watch,
    "paper": _paper,
    "montecarlo": _montecarlo,
    "decisions": _decisions,
    "bench": _bench,
}


if __name__ == "__main__":
    from soilbus.__main__ import program

    program()
