"""`soilbus watch`: the dashboard on a terminal, of a live bus or of a recording of our frames.

source (bus or log) -> ReceivedFrames -> Dashboard -> page, five times a second; or lines; or JSON, a line a window
"""

from __future__ import annotations

import json
import math
import os
import select
import sys
import termios
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, nullcontext, suppress
from pathlib import Path
from typing import IO, Protocol

import can
from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from soilbus.can.bus import LiveBus, open_bus
from soilbus.can.dbc_files import filters_of, output_database
from soilbus.can.wire import Received
from soilbus.config.model import Config
from soilbus.offline.played_bus import PlayedBus, PlayedClock
from soilbus.offline.replay import LogError, read_frames
from soilbus.report.dashboard import Dashboard, Vehicle
from soilbus.report.driver_page import driver_page
from soilbus.report.engineer_page import engineer_page
from soilbus.report.received_frames import ReceivedFrames
from soilbus.report.received_record import gist, received_record
from soilbus.words import shown

REDRAW_PERIOD = 0.2
"""Time [s] between two pictures."""
LINE_PERIOD = 1.0
"""Least time [s] between two lines of which only figures differ."""
FIRST_VERDICT = 0.5
"""Time [s] after the start by which a verdict has come: three cycles of the fast frames, and what a bus may take."""
PAGES = {"driver": driver_page, "engineer": engineer_page}


class Source(Protocol):
    """Bus or recording that frames come from; `fault` says why there are none."""

    fault: str

    def receive(self, timeout: float, /) -> Received | can.Message | None:
        """Return the next frame, or None after at most `timeout` [s]."""


def watch(
    config: Config,
    log: Path | None = None,
    speed: float = 1.0,
    names_wheels: bool = True,
    seconds: float | None = None,
    plain: bool = False,
    as_json: bool = False,
) -> None:
    """Show the dashboard of the configured bus, or of a recording of our frames in its own time, until interrupted.

    A bus that goes away is waited for; a recording ends the command. With `names_wheels` the configuration is that of
    the vehicle that is watched. `plain` gives lines even on a terminal, `as_json` a line of JSON for each window.
    BusError where the bus cannot be opened at the start, LogError where a recording has no frame of ours.
    """
    database, until = output_database(config), math.inf if seconds is None else time.monotonic() + seconds
    filters = filters_of(database)
    source: PlayedBus | LiveBus
    if log is not None:
        clock = PlayedClock(speed)
        received, source = ReceivedFrames(database, clock), PlayedBus(read_frames(log), filters, clock)
        if source.is_empty:
            raise LogError(f"{log}: no frame of soilbus in it; soilbus replay --frames writes such a log")
    else:
        settings = config.bus.model_dump()
        received = ReceivedFrames(database)
        source = LiveBus(lambda: open_bus(settings, filters), time.monotonic, time.sleep)
        source.open()

    def done() -> bool:
        return time.monotonic() >= until or (isinstance(source, PlayedBus) and source.is_empty)

    dashboard = Dashboard(received, Vehicle.of(config, names_wheels))
    with closing(source) if isinstance(source, LiveBus) else nullcontext():
        if as_json:
            print_results(dashboard, source, sys.stdout, done)
        else:
            show(dashboard, source, Console(), plain, done, stays=log is not None and seconds is None)


def page(dashboard: Dashboard, name: str, width: int, height: int) -> Group:
    """Return a page as a picture for the terminal."""
    lines = PAGES[name](dashboard, width, height)
    for line in lines:
        line.no_wrap, line.overflow = True, "crop"
    return Group(*lines)


def show(
    dashboard: Dashboard,
    source: Source,
    console: Console,
    plain: bool = False,
    done: Callable[[], bool] = lambda: False,
    clock: Callable[[], float] = time.monotonic,
    stays: bool = False,
) -> None:
    """Feed frames and show them until `done`, or until a key ends it.

    Where the console is no terminal, or moves no cursor, or with `plain`, these are lines. With `stays` the last page
    stays until a key says so.
    """
    if plain or not console.is_terminal or console.is_dumb_terminal:
        _show_lines(dashboard, source, console, done, clock)
        return
    name = "driver"
    with pressed_keys() as keys, Live(console=console, auto_refresh=False, screen=True) as live:
        redraw = clock()
        while not (is_over := done()) or (stays and keys):
            if is_over:
                dashboard.is_over = True
                time.sleep(REDRAW_PERIOD)
            else:
                _take(dashboard, source, redraw - clock())
            key = keys() if keys else ""
            if key == "q":
                return
            chosen = {"d": "driver", "e": "engineer", "\t": "engineer" if name == "driver" else "driver"}.get(key, name)
            if chosen != name or clock() >= redraw:
                name, redraw = chosen, clock() + REDRAW_PERIOD
                dashboard.sample()
                live.update(page(dashboard, name, *console.size), refresh=True)


def _show_lines(
    dashboard: Dashboard, source: Source, console: Console, done: Callable[[], bool], clock: Callable[[], float]
) -> None:
    """Print a line at once when the state or the first words of what to do change, else one a second at most."""
    last, said, line_due, redraw = "", None, clock(), clock() + REDRAW_PERIOD
    while not done():
        _take(dashboard, source, redraw - clock())
        if clock() < redraw:
            continue
        redraw = clock() + REDRAW_PERIOD
        dashboard.sample()
        verdict, line = dashboard.verdict(), ". ".join(dashboard.sentences()) + "."
        now_said = verdict.kind, verdict.todo.partition(",")[0]
        if line != last and (now_said != said or clock() >= line_due):
            last, said, line_due = line, now_said, clock() + LINE_PERIOD
            console.print(Text(line), soft_wrap=True)
            console.file.flush()


def print_results(dashboard: Dashboard, source: Source, out: IO[str], done: Callable[[], bool]) -> None:
    """Print a line of JSON for each received window, and for each change of state in between; each is flushed.

    A window's line waits for the verdict that rests on it, at most a cycle of the fast frames.
    """
    received, said, stamp = dashboard.known, None, None
    first = received.now + FIRST_VERDICT
    while not done():
        before = received.age("Traversability")
        message = _take(dashboard, source, REDRAW_PERIOD)
        stamp = stamp if message is None else message.timestamp
        age = received.age("Traversability")
        is_new = age is not None and (before is None or age < before)
        if not is_new and not (received.is_stale("Traversability") and received.now >= first):
            continue
        record = received_record(dashboard, stamp)
        if gist(record) != said:
            said = gist(record)
            out.write(json.dumps(record, allow_nan=False) + "\n")
            out.flush()


def _take(dashboard: Dashboard, source: Source, timeout: float) -> Received | can.Message | None:
    """Feed the next frame, if one comes in time."""
    message = source.receive(max(0.0, timeout))
    dashboard.fault = shown(source.fault)
    if message is not None:
        dashboard.known.receive(message)
        dashboard.sample()
    return message


@contextmanager
def pressed_keys() -> Iterator[Callable[[], str] | None]:
    """Give a function that returns the next key pressed, or "" at once; None where there is no keyboard of ours.

    Keys come one by one and are not echoed until the end; Ctrl-C stays what it is.
    """
    try:
        descriptor = sys.stdin.fileno()
        is_ours = os.isatty(descriptor) and os.tcgetpgrp(descriptor) == os.getpgrp()
    except (AttributeError, OSError, ValueError):
        is_ours = False
    if not is_ours:
        yield None
        return

    def key() -> str:
        if not select.select([descriptor], [], [], 0.0)[0]:
            return ""
        return os.read(descriptor, 1).decode("ascii", "replace").lower()

    before = termios.tcgetattr(descriptor)
    tty.setcbreak(descriptor, termios.TCSANOW)
    try:
        yield key
    finally:
        with suppress(termios.error):
            termios.tcsetattr(descriptor, termios.TCSANOW, before)
