"""`soilbus demo`: a simulated tractor, the service and a dashboard, without hardware.

Three parties share one bus: the tractor's ECUs (simulator) send, the service estimates, the dashboard reads only the
service's frames. The bus is a vcan where the kernel has it, else python-can's in-process virtual bus. The simulated
drive plays TIME_COMPRESSION times as fast as real time, so the service's times are shortened by the same factor.  Each
frame carries the time at which it is due.

    soilbus demo --picture service/docs/dashboard.svg     draws the README's pictures: dashboard.svg, the driver's page
                                                          at the end of the drive, and dashboard-engineer.svg
"""

from __future__ import annotations

import io
import logging
import re
import subprocess
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path

import can
from rich.console import Console, Group

from soilbus.can.bus import BusError, LiveBus, open_bus
from soilbus.can.channels import Column
from soilbus.can.dbc_files import filters_of, output_database
from soilbus.config.model import Config
from soilbus.daemon.start import start_service
from soilbus.files import write_text
from soilbus.pipeline.result import WindowResult
from soilbus.report.dashboard import Dashboard, Vehicle
from soilbus.report.received_frames import ReceivedFrames
from soilbus.report.table import table
from soilbus.report.watch import page, show
from soilbus.simulator.frames import frames
from soilbus.simulator.play import send_in_time
from soilbus.simulator.recording import Recording, simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import demo as demo_scenario

TIME_COMPRESSION = 8.0
"""Seconds of the simulated drive per second."""
SEED = 1
"""Picks the simulated drive."""
PICTURE_SIZE = 80, 24
"""Columns and rows of the pictures."""
_STAMPED_BY_SENDER = {"preserve_timestamps": True}
"""Setting of python-can's virtual bus: frames keep the stamps of their sender. A vcan ignores it and stamps them."""
STORY_PERIOD = 4.0
"""Time [s] of the simulated drive between two rows of the table at the end."""


def run_demo(duration: float, picture: Path | None = None) -> None:
    """Drive `duration` simulated seconds from loam onto wet clay and show what the service says.

    `picture` is where the last state of the dashboard is kept as SVG; the engineer's page has `-engineer` in its name.
    """
    console = Console()
    real = reference_configuration()
    recording = simulate(real, demo_scenario(duration), SEED)
    messages = _from_now_on(frames(_every_second(recording), real))
    results: list[WindowResult] = []
    with _bus_settings() as overrides, _without_journal():
        where = "vcan" if any("socketcan" in o for o in overrides) else "the in-process virtual bus"
        console.print(
            f"Simulated tractor on {where}: loam, then wet clay; {TIME_COMPRESSION:.0f} times as fast as real time."
        )
        config = reference_configuration(overrides + _compressed(real))
        ours = output_database(config)
        bus = config.bus.model_dump()
        ear = LiveBus(lambda: open_bus(bus, filters_of(ours)), time.monotonic, time.sleep)
        with open_bus(bus | _STAMPED_BY_SENDER, []) as tractor, closing(ear):
            ear.open()
            service = start_service(config, wait=False, on_window=results.append, rehearse=False)
            sender = threading.Thread(target=send_in_time, args=(messages, tractor.send), daemon=True)
            worker = threading.Thread(target=service.run, daemon=True)
            worker.start()
            sender.start()
            dashboard = Dashboard(ReceivedFrames(ours), Vehicle.of(config), span=duration / TIME_COMPRESSION)
            show(dashboard, ear, console, done=lambda: not (sender.is_alive() or service.has_open_windows))
            pictures = {name: page(dashboard, name, *PICTURE_SIZE) for name in ("driver", "engineer")}
            service.stop()
            worker.join(timeout=2.0)
    if picture is not None:
        for name, path in (("driver", picture), ("engineer", picture.with_stem(f"{picture.stem}-engineer"))):
            write_text(path, _svg(pictures[name]))
    if console.is_terminal:
        console.print(pictures["driver"])
    console.print("\n" + _story(results), highlight=False, end="")


@contextmanager
def _without_journal() -> Iterator[None]:
    """The dashboard shows what the service's journal would say."""
    journal = logging.getLogger("soilbus")
    before = journal.level
    journal.setLevel(logging.ERROR)
    try:
        yield
    finally:
        journal.setLevel(before)


def _every_second(recording: Recording) -> Recording:
    """Half of each channel's samples: compressed time would ask too much of a small machine's bus."""
    kept = {name: Column(column.t[::2], column.value[::2]) for name, column in recording.channels.items()}
    return replace(recording, channels=kept)


def _from_now_on(messages: Iterable[can.Message]) -> Iterator[can.Message]:
    """Messages of the compressed drive, stamped as they are due; the first is due when it is asked for.

    A machine with other work sends some late, but the service still reads when they were due.
    """
    first: float | None = None
    begin = 0.0
    for message in messages:
        if first is None:
            first, begin = message.timestamp, time.time()
        message.timestamp = begin + (message.timestamp - first) / TIME_COMPRESSION
        yield message


def _compressed(config: Config) -> list[str]:
    """Overrides that shorten the service's times as the tractor's time is shortened.

    And the vehicle's lengths with them: it drives past a border in so much less time, and
    loads only know their ratios.
    """
    sizes = {
        "estimator.window": config.estimator.window,
        "estimator.hop": 2.0 * config.estimator.hop,
        "estimator.bin": config.estimator.bin,
    }
    if config.vehicle is not None:
        lengths = config.vehicle.model_dump(exclude={"mass", "mass_std"}, exclude_none=True)
        sizes |= {f"vehicle.{name}": length for name, length in lengths.items() if isinstance(length, float)}
    return [f"{key}={size / TIME_COMPRESSION}" for key, size in sizes.items()]


@contextmanager
def _bus_settings() -> Iterator[list[str]]:
    """Overrides for a vcan of our own if we may make one, else for the virtual bus."""
    name = "soilbusdemo"
    made = _ip("link", "add", "dev", name, "type", "vcan") and _ip("link", "set", name, "up")
    try:
        overrides = ["bus.interface=socketcan", f"bus.channel={name}"]
        if made and _works(overrides):
            yield overrides
        else:
            yield ["bus.interface=virtual", f"bus.channel={name}"]
    finally:
        if made:
            _ip("link", "del", name)


def _works(overrides: list[str]) -> bool:
    try:
        open_bus(reference_configuration(overrides).bus.model_dump()).shutdown()
    except BusError:
        return False
    return True


def _ip(*words: str) -> bool:
    try:
        return subprocess.run(["ip", *words], capture_output=True, check=False).returncode == 0
    except OSError:
        return False


def _svg(shown: Group) -> str:
    """A page as SVG that asks for no font from elsewhere."""
    paper = Console(
        record=True, file=io.StringIO(), width=PICTURE_SIZE[0], force_terminal=True, color_system="truecolor"
    )
    paper.print(shown)
    return re.sub(r"@font-face \{.*?\}\s*", "", paper.export_svg(title="soilbus watch"), flags=re.DOTALL)


def _story(results: list[WindowResult]) -> str:
    """The windows some seconds apart, as a table."""
    rows, due = [], 0.0
    start = results[0].t if results else 0.0
    for r in results:
        t = (r.t - start) * TIME_COMPRESSION
        if t + 1e-6 < due:
            continue
        due = t + STORY_PERIOD
        draft = r.traversability.max_draft
        rows.append(
            (
                f"{t + 10.0:.0f}",
                str(r.status),
                "-" if r.bearing is None else f"{r.bearing.value / 1e3:.1f} ± {r.bearing.std / 1e3:.1f}",
                "-" if draft is None else f"{draft.value:.0f} ± {draft.std:.0f}",
                str(r.traversability.state).upper().replace("_", "-"),
            )
        )
    return table(("tractor's s", "window", "bearing pressure, kPa", "max. draft, N", "decision"), rows)
