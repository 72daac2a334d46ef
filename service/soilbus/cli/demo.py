"""`soilbus demo`: a simulated tractor, the service and a dashboard, without hardware.

Tractor and service share one bus, a vcan where the kernel has it, else python-can's in-process virtual bus.  The drive
plays SPEED times as fast as it is driven; the service runs on its time, which waits for a machine that is busy.
"""

from __future__ import annotations

import io
import logging
import re
import subprocess
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import can
from rich.console import Console, Group

from soilbus.can.bus import open_bus
from soilbus.can.candump import Frame
from soilbus.can.channels import Column
from soilbus.can.dbc_files import filters_of, output_database
from soilbus.files import write_text
from soilbus.offline.sent_frames import sent_beside
from soilbus.pipeline.result import WindowResult
from soilbus.report.dashboard import Dashboard, Vehicle
from soilbus.report.received_frames import ReceivedFrames
from soilbus.report.table import table
from soilbus.report.watch import page, show
from soilbus.simulator.frames import frames
from soilbus.simulator.recording import Recording, simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import demo as demo_scenario

SPEED = 8.0
"""Seconds of the simulated drive per second."""
SEED = 1
"""Picks the simulated drive."""
PICTURE_SIZE = 80, 24
"""Columns and rows of the pictures."""
STORY_PERIOD = 4.0
"""Time [s] of the simulated drive between two rows of the table at the end."""


def run_demo(duration: float, picture: Path | None = None) -> None:
    """Drive `duration` simulated seconds from loam onto wet clay and show what the service says.

    `picture` is where the last state of the dashboard is kept as SVG; the engineer's page has `-engineer` in its name.
    """
    console, real = Console(), reference_configuration()
    recording = simulate(real, demo_scenario(duration), SEED)
    results: list[WindowResult] = []
    logging.getLogger("soilbus").setLevel(logging.ERROR)  # the dashboard shows what the journal would say
    with _bus_settings() as overrides:
        where = "vcan" if any("socketcan" in o for o in overrides) else "the in-process virtual bus"
        console.print(f"Simulated tractor on {where}: loam, then wet clay; {SPEED:.0f} times as fast as real time.")
        config = reference_configuration(overrides)
        ours, bus = output_database(config), config.bus.model_dump()
        with open_bus(bus, []) as tractor, open_bus(bus, []) as node, open_bus(bus, filters_of(ours)) as ear:
            drive = _Drive(list(frames(_every_second(recording), real)), tractor, ear)

            def serve() -> None:
                for message in sent_beside(config, drive.heard(), results.append):
                    node.send(message)

            service = threading.Thread(target=serve, daemon=True)
            service.start()
            dashboard = Dashboard(ReceivedFrames(ours, drive.now), Vehicle.of(config), span=duration)
            show(dashboard, drive, console, done=lambda: not service.is_alive())
            pictures = {name: page(dashboard, name, *PICTURE_SIZE) for name in ("driver", "engineer")}
    if picture is not None:
        for name, path in (("driver", picture), ("engineer", picture.with_stem(f"{picture.stem}-engineer"))):
            write_text(path, _svg(pictures[name]))
    if console.is_terminal:
        console.print(pictures["driver"])
    console.print("\n" + _story(results), highlight=False, end="")


def _every_second(recording: Recording) -> Recording:
    """Half of each channel's samples: compressed time would ask too much of a small machine's bus."""
    kept = {name: Column(column.t[::2], column.value[::2]) for name, column in recording.channels.items()}
    return replace(recording, channels=kept)


class _Drive:
    """The drive on the bus, in its own time: the tractor's messages, and what the dashboard receives meanwhile."""

    fault = ""

    def __init__(self, messages: Sequence[can.Message], tractor: can.BusABC, ear: can.BusABC) -> None:
        self._messages, self._tractor, self._ear = messages, tractor, ear
        self._begin = self._now = messages[0].timestamp

    def now(self) -> float:
        """Time [s] of the drive: of the tractor's last message."""
        return self._now

    def heard(self) -> Iterator[Frame]:
        """Send the tractor's messages when they are due; yields each as the service hears it."""
        began = time.monotonic()
        for message in self._messages:
            time.sleep(max(0.0, began + (message.timestamp - self._begin) / SPEED - time.monotonic()))
            self._now = message.timestamp
            self._tractor.send(message)
            yield message.timestamp, message.arbitration_id, message.is_extended_id, bytes(message.data), False, False

    def receive(self, timeout: float) -> can.Message | None:
        """The next message for the dashboard, or None after `timeout` [s]."""
        message = self._ear.recv(timeout)
        if message is not None:
            message.timestamp = self._now
        return message


@contextmanager
def _bus_settings() -> Iterator[list[str]]:
    """Overrides for a vcan of our own if we may make one, else for the virtual bus."""
    name = "soilbusdemo"
    made = _ip("link", "add", "dev", name, "type", "vcan") and _ip("link", "set", name, "up")
    try:
        yield [f"bus.interface={'socketcan' if made else 'virtual'}", f"bus.channel={name}"]
    finally:
        if made:
            _ip("link", "del", name)


def _ip(*words: str) -> bool:
    try:
        return subprocess.run(["ip", *words], capture_output=True, check=False).returncode == 0
    except OSError:
        return False


def _svg(shown: Group) -> str:
    """A page as SVG that asks for no font from elsewhere."""
    out, width = io.StringIO(), PICTURE_SIZE[0]
    paper = Console(record=True, file=out, width=width, force_terminal=True, color_system="truecolor")
    paper.print(shown)
    return re.sub(r"@font-face \{.*?\}\s*", "", paper.export_svg(title="soilbus watch"), flags=re.DOTALL)


def _story(results: list[WindowResult]) -> str:
    """The windows some seconds apart, as a table."""
    rows, begin = [], results[0].t if results else 0.0
    due = begin
    for r in results:
        if r.t + 1e-6 < due:
            continue
        due, draft = r.t + STORY_PERIOD, r.traversability.max_draft
        rows.append((
            f"{r.t - begin + 10.0:.0f}",
            str(r.status),
            "-" if r.bearing is None else f"{r.bearing.value / 1e3:.1f} ± {r.bearing.std / 1e3:.1f}",
            "-" if draft is None else f"{draft.value:.0f} ± {draft.std:.0f}",
            str(r.traversability.state).upper().replace("_", "-"),
        ))  # fmt: skip
    return table(("tractor's s", "window", "bearing pressure, kPa", "max. draft, N", "decision"), rows)
