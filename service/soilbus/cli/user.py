"""Commands of whoever runs soilbus on a vehicle: demo, run, check, watch.

Each function takes the parsed arguments and imports what it needs, so that `run` loads no simulator.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
from collections.abc import Callable, Iterable, Iterator
from typing import TYPE_CHECKING

from soilbus.allocator import loading
from soilbus.cli.common import WorkError, configured, configured_or_reference
from soilbus.process import say

if TYPE_CHECKING:
    from soilbus.can.candump import Frame
    from soilbus.config.model import Config
    from soilbus.sensors.survey import Survey


def demo(args: argparse.Namespace) -> None:
    """`soilbus demo`: simulated tractor, service and dashboard."""
    from soilbus.cli.demo import run_demo

    run_demo(args.duration, args.picture)


def run(args: argparse.Namespace) -> None:
    """`soilbus run`: the daemon on a live bus."""
    # python-can loads asammdf where it is installed: 2 s and 97 MB for files that the service never reads.
    sys.modules.setdefault("asammdf", None)  # type: ignore[arg-type]
    with loading():
        from soilbus.can.bus import BusError
        from soilbus.daemon.start import start_service

        config = configured(args)
        wait = args.wait or "NOTIFY_SOCKET" in os.environ
        try:
            service = start_service(config, wait)
        except BusError as error:
            raise WorkError(str(error)) from None
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: service.stop())
    service.run()


def check(args: argparse.Namespace) -> None:
    """`soilbus check`: the configuration, and with a recording or a live bus the data beside it."""
    from soilbus.config.model import ConfigError
    from soilbus.report.configuration import configuration_report, configuration_warnings, survey_report

    config = configured(args)
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


def watch(args: argparse.Namespace) -> None:
    """`soilbus watch`: the dashboard of the live bus or of a recording."""
    from soilbus.can.bus import BusError
    from soilbus.offline.replay import LogError
    from soilbus.report.watch import watch, watch_log

    config, is_named = configured_or_reference(args), args.config is not None
    try:
        if args.log is None:
            watch(config, is_named, args.seconds, args.plain)
        else:
            watch_log(config, args.log, args.speed, is_named, args.seconds, args.plain)
    except (BusError, LogError) as error:
        raise WorkError(str(error)) from None
