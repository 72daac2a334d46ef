"""The frames that the service sends beside a recording: the daemon itself, on a bus that plays the recording.

    log -> PlayedBus -> Service (daemon) -> frames stamped with the recording's time

Loop, schedule, counters and checksums are the daemon's. Solving a window takes no time of the recording; a real service
sends the frames of a hop later by that time. Frames of soilbus itself in the recording are left out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path

import can

from soilbus.can.bus import LiveBus
from soilbus.can.candump import Frame
from soilbus.can.dbc_files import load_databases, output_database
from soilbus.can.publish import Publisher
from soilbus.config.model import Config
from soilbus.daemon.notify import Notifier
from soilbus.daemon.service import Service
from soilbus.offline.played_bus import InlineExecutor, PlayedBus, PlayedClock
from soilbus.offline.replay import LogError, log_of
from soilbus.pipeline.outputs import check_cycle_times
from soilbus.pipeline.pipeline import Pipeline
from soilbus.pipeline.result import WindowResult


def sent_frames(config: Config, logs: Sequence[Path]) -> Iterator[can.Message]:
    """Yield the frames that the service sends while each log is on its bus, stamped with the recording's time [s].

    It begins again with each log; one that is damaged ends where it is. ConfigError where the configuration cannot
    work, or a frame would come less often than its DBC says.
    """

    def readable(log: Path) -> Iterator[Frame]:
        with suppress(LogError):
            yield from log_of(config, log).frames()

    for log in logs:
        yield from sent_beside(config, readable(log))


def sent_beside(
    config: Config, frames: Iterator[Frame], on_window: Callable[[WindowResult], None] | None = None
) -> Iterator[can.Message]:
    """Yield what the service sends beside these frames, as `sent_frames`; they may depend on what it sent.

    `on_window` is called with each window's result.
    """
    database, ours = load_databases(config), output_database(config)
    check_cycle_times(config, ours)
    clock, pipeline = PlayedClock(), Pipeline(config, database)
    played = PlayedBus(frames, pipeline.admission.can_filters(), clock, config.bus.channel)
    bus = LiveBus(lambda: played, clock, clock.sleep)
    bus.open()
    service = Service(
        config, pipeline, bus, Publisher(ours), Notifier(), InlineExecutor(), clock, on_window, waiting=clock.wait_for
    )
    while not played.is_empty:
        service.step()
        yield from played.take_sent()
