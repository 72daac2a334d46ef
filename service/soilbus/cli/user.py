"""Commands of whoever runs soilbus on a vehicle: demo, init, run, check, watch, completion, docs.

Each function takes the parsed arguments and imports what it needs, so that `run` loads no simulator.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import signal
import sys
from collections.abc import Callable, Iterable, Iterator
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

from soilbus.allocator import loading
from soilbus.cli.common import check_outputs, configured, need_extra
from soilbus.config.model import Config, ConfigError
from soilbus.files import write_text
from soilbus.process import ENDING, say
from soilbus.words import WorkError

if TYPE_CHECKING:
    from cantools.database.can import Database

    from soilbus.can.candump import Frame
    from soilbus.can.logs import Log
    from soilbus.offline.columns import SignalTable
    from soilbus.sensors.survey import Survey


def demo(args: argparse.Namespace) -> None:
    """Run `soilbus demo`: simulated tractor, service and dashboard."""
    from soilbus.cli.demo import run_demo

    check_outputs(args.picture)
    run_demo(args.duration, args.picture)


def init(args: argparse.Namespace) -> None:
    """Run `soilbus init`: a configuration proposed from DBC files and, with a log, from what its signals do."""
    from soilbus.can.dbc_files import load_databases
    from soilbus.can.logs import Log
    from soilbus.can.role_matching import assigned, candidates
    from soilbus.config.edit import named_from
    from soilbus.config.file import located, parse_config
    from soilbus.report.progress import progress
    from soilbus.report.proposal import proposal
    from soilbus.sensors.role_evidence import Facts, Recording, facts_of, weighed

    to_stdout = str(args.out) == "-"
    if not to_stdout and args.out.exists() and not args.force:
        raise WorkError(f"{args.out} is there already; --force replaces it")
    check_outputs(None if to_stdout else args.out)
    if args.table is not None and (args.log is not None or args.channel is not None):
        raise ConfigError(["--table has the drive in it: leave out --log and --channel"])
    dbcs = [located(Path(), str(path)) for path in args.dbc or ()]
    time, recorded = "", args.table or args.log
    log: Log | SignalTable | None = None
    try:
        if args.table is not None:
            time, database, log = _of_table(args.table)
        else:
            database = load_databases(parse_config({"dbc": {"input": [str(path.absolute()) for path in dbcs]}}))
            if args.log is not None:
                log = Log(args.log, args.channel or "", demanded=True)
    except ConfigError as error:
        raise ConfigError(fault.replace("dbc.input", "--dbc") for fault in error.faults) from None
    found, facts = candidates(database), Facts()
    if log is not None:
        with progress("init") as step:
            recording = Recording(found, database, _counted(log.frames(), step))
        if log.note:
            say(log.note)
        if not recording.columns:
            source = f" in {', '.join(map(str, args.dbc))}" if args.dbc else ""
            raise WorkError(f"{recorded}: no frame of a signal{source} that could be mapped")
        found = weighed(found, recording)
        facts = facts_of(assigned(found), recording)
    files = [named_from(Path() if to_stdout else args.out.parent, path) for path in dbcs]
    with_log = [] if recorded is None else ["--log", str(recorded)]
    of = ["--table", str(args.table)] if args.table else [w for p in args.dbc for w in ("--dbc", str(p))] + with_log
    made = proposal(database, assigned(found), facts, files, shlex.join(["soilbus", "init", *of]), time)
    write_text(args.out, made.text)
    then = shlex.join(["soilbus", "check", "--config", "soilbus.toml" if to_stdout else str(args.out), *with_log])
    say(f'{made.mapped} signals mapped, {made.open} values open ("?"): fill them in, then {then}')


def _of_table(path: Path) -> tuple[str, Database, SignalTable]:
    """The column of times of a table, its columns with numbers as messages, and the table."""
    from soilbus.can.columns import column_database, unit_in
    from soilbus.config.model import Columns
    from soilbus.offline.columns import SignalTable, read_samples, time_column

    time = Columns(time=time_column(path))
    units = {name: column.unit or unit_in(name) for name, column in read_samples(path, time).items()}
    return time.time, column_database(units), SignalTable(path, time, list(units))


def run(args: argparse.Namespace) -> None:
    """Run `soilbus run`: the daemon on a live bus."""
    # python-can loads asammdf where it is installed: 2 s and 97 MB for files that the service never reads.
    sys.modules.setdefault("asammdf", None)  # type: ignore[arg-type]
    with loading():
        from soilbus.daemon.start import start_service

        config = configured(args)
        if config.table is not None or config.columns is not None:
            source = "[columns]: a table" if config.table is None else "[table]: a table of a test rig"
            raise ConfigError([f"{source} has no bus; replay and diagnose read it"])
        service = start_service(config, args.wait or "NOTIFY_SOCKET" in os.environ)
    for number in ENDING:
        if signal.getsignal(number) is not signal.SIG_IGN:  # nohup
            signal.signal(number, lambda *_: service.stop())
    service.run()


def check(args: argparse.Namespace) -> None:
    """Run `soilbus check`: the configuration, and with a recording or a live bus the data beside it."""
    from soilbus.report.configuration import (
        configuration_report,
        configuration_warnings,
        defaults_text,
        log_report,
        survey_report,
    )

    config = configured(args)
    of_configuration = configuration_report(config)
    warnings, faults = configuration_warnings(config), list[str]()
    if args.log is not None or args.live is not None:
        found, log = _surveyed(args, config)
        faults = found.faults
        for line in faults:
            say(line)
        print("" if log is None else log_report(log, found), survey_report(found), sep="")
        if log is not None and str(args.log) != "-" and not faults:
            print(_machine_of(args.log, config))
        warnings += ([log.note] if log is not None and log.note else []) + found.warnings
    print(of_configuration, end="")
    if args.settings:
        print("\nSettings in force (defaults included):", defaults_text(config), sep="\n")
    for line in warnings:
        say(f"warning: {line}")
    if faults:
        raise ConfigError([])  # each is said above, before the tables


def _surveyed(args: argparse.Namespace, config: Config) -> tuple[Survey, Log | SignalTable | None]:
    """What a recording, or the bus, says of the configuration, and the recording as far as it was read."""
    from soilbus.can.bus import heard_for
    from soilbus.can.dbc_files import load_databases
    from soilbus.offline.replay import log_of
    from soilbus.report.progress import progress
    from soilbus.sensors.survey import survey

    if config.table is not None:
        raise ConfigError(["[table]: check compares no table; replay and diagnose read it"])
    database = load_databases(config)
    if args.live is not None:
        return survey(config, database, heard_for(config.bus.model_dump(), args.live)), None
    log = log_of(config, args.log)
    with progress("check") as step:
        return survey(config, database, _counted(log.frames(), step)), log


def _machine_of(log: Path, config: Config) -> str:
    """Return what the estimator finds out of the machine in the first windows of a recording."""
    from soilbus.can.dbc_files import load_databases
    from soilbus.offline.replay import replay
    from soilbus.pipeline.pipeline import Pipeline
    from soilbus.report.windows import machine_line

    windows = replay(Pipeline(config, load_databases(config)), [log], on_fault=lambda _: None)
    line = machine_line(list(islice(windows, FIRST_WINDOWS)))
    return line or "not checkable from this log: delays, inertia and relaxation, for no window has an estimate"


FIRST_WINDOWS = 60
"""Windows [1] of a recording in which `check` looks for delays: a minute or two, after which they change little."""


def _counted(frames: Iterable[Frame], step: Callable[[int, float], None] | None) -> Iterator[Frame]:
    first = None
    for n, frame in enumerate(frames):
        if step is not None and n % 10_000 == 0:
            first = frame[0] if first is None else first
            step(n, frame[0] - first)
        yield frame


def watch(args: argparse.Namespace) -> None:
    """Run `soilbus watch`: the dashboard of the live bus or of a recording."""
    from soilbus.report.watch import watch

    if args.channel is not None:
        if args.log is not None:
            raise ConfigError([f"--channel {args.channel}: {args.log} is a recording, which has no bus"])
        args.set.append(f"bus.channel={json.dumps(args.channel)}")
    config, is_named = configured(args, or_reference=True), args.config is not None
    watch(config, args.log, args.speed, is_named, args.seconds, args.plain, args.json)


def completion(args: argparse.Namespace) -> None:
    """Run `soilbus completion`: a shell's completion of commands, options and files."""
    need_extra("completion", "completion", "shtab")
    import shtab

    from soilbus.cli.arguments import command_line, subcommands

    parser = command_line()
    for command in subcommands(parser).values():
        for action in command._actions:
            if str(action.metavar).partition(".")[0] in ("FILE", "LOG", "OUT"):
                action.complete = shtab.FILE  # type: ignore[attr-defined]
    print(shtab.complete(parser, args.shell))


def docs(args: argparse.Namespace) -> None:
    """Run `soilbus docs`: the pages of this version, and the README of `dbc` and of `systemd`."""
    from soilbus.words import did_you_mean

    package = Path(__file__).resolve().parents[1]
    places = package, package.parent, package.parents[1]  # installed; or a checkout's folders
    folders = {name: next(p / name for p in places if (p / name).is_dir()) for name in ("docs", "dbc", "systemd")}
    found = {path.stem: path for path in sorted(folders["docs"].glob("*.md"))}
    found |= {name: folders[name] / "README.md" for name in ("dbc", "systemd")}
    if args.page in found:
        print(found[args.page].read_text(encoding="utf-8"), end="")
        return
    if args.page is not None:
        raise ConfigError([f"no page {args.page}{did_you_mean(args.page, found)}"])
    for name, path in found.items():
        lines = path.read_text(encoding="utf-8").splitlines()
        print(f"{name:16}{next(line.removeprefix('# ') for line in lines if line.startswith('# '))}")
    print(f"\nsoilbus docs PAGE prints one; they lie in {folders['docs']}")
