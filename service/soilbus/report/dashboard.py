"""A live terminal dashboard that knows the tractor only by our frames, as any dashboard ECU would."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import can
from cantools.database.can import Database
from rich.console import Console, Group
from rich.live import Live
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from soilbus.can.admission import checksum_byte_of
from soilbus.can.bus import open_bus
from soilbus.can.checksum import COUNTER, frame_checksum
from soilbus.can.dbc_files import filters_of, output_database
from soilbus.config import Config

CYCLES_UNTIL_STALE = 3
COLOURS = {"go": "green", "caution": "yellow", "no_go": "red", "unknown": "white"}
PARAMETERS = {
    "k_c": ("SoilCohesiveModulus", "kN/m^(n+1)"),
    "k_φ": ("SoilFrictionalModulus", "kN/m^(n+2)"),
    "n": ("SoilSinkageExponent", ""),
    "φ": ("SoilFrictionAngle", "°"),
    "c": ("SoilCohesion", "kPa"),
    "K": ("SoilShearModulus", "mm"),
}


class Dashboard:
    """The last good frame of each message, and how old it is."""

    def __init__(self, database: Database, clock: Callable[[], float] = time.monotonic) -> None:
        self._messages = {m.frame_id: m for m in database.messages}
        self._cycle = {m.name: (m.cycle_time or 1000) / 1000.0 for m in database.messages}
        self._clock = clock
        self._values: dict[str, dict[str, Any]] = {}
        self._seen: dict[str, float] = {}
        self.bad_frames = 0

    def receive(self, message: can.Message) -> None:
        """Take one frame; one with a wrong checksum or the counter of the one before counts as not received."""
        layout = self._messages.get(message.arbitration_id) if message.is_extended_id else None
        if layout is None or len(message.data) != layout.length:
            return
        place = checksum_byte_of(layout)
        data = bytes(message.data)
        if place is not None and data[place] != frame_checksum(message.arbitration_id, data, place):
            self.bad_frames += 1
            return
        values: dict[str, Any] = layout.decode(data)  # type: ignore[assignment]
        if COUNTER in values and values[COUNTER] == self._values.get(layout.name, {}).get(COUNTER):
            self.bad_frames += 1
            return
        self._values[layout.name] = values
        self._seen[layout.name] = self._clock()

    def value(self, message: str, signal: str) -> float | str | None:
        """A signal's value or name; None where the frame is stale or the value not available."""
        age = self._clock() - self._seen.get(message, -1e9)
        if age > CYCLES_UNTIL_STALE * self._cycle[message] + 0.2:
            return None
        value = self._values[message].get(signal)
        if isinstance(value, (int, float)):
            return float(value)
        name = str(value)
        return None if name in ("not_available", "error") else name

    def render(self) -> Panel:
        """What a driver sees."""
        way = str(self.value("Traversability", "State") or "unknown")
        head = Text(f" {way.upper().replace('_', '-')} ", style=f"bold black on {COLOURS[way]}")
        detail = "  ".join(
            filter(
                None,
                (
                    self._text("Traversability", "Probability", "p = {:.2f}"),
                    self._text("Traversability", "LimitingCause", "limit: {}"),
                    self._pair("DraftCapability", "MaxDraft", "MaxDraftStd", "max. draft {} N"),
                    self._advice(),
                    self._text("SoilClass", "Kind", "soil: {}") + self._text("SoilClass", "Probability", " ({:.2f})"),
                    self._text("SoilbusStatus", "State", "service: {}"),
                    self._text("SoilbusStatus", "Reason", "({})"),
                ),
            )
        )
        soil = Table(box=None, pad_edge=False)
        for title in ("soil", "value ± std", "unit"):
            soil.add_column(title)
        soil.add_row("bearing pressure", self._pair("SoilStrength", "BearingPressure", "BearingPressureStd"), "kPa")
        for name, (message, unit) in PARAMETERS.items():
            soil.add_row(name, self._pair(message, "Value", "Std"), unit)
        wheels = Table(box=None, pad_edge=False)
        for title in ("wheel", "slip", "sinkage, mm"):
            wheels.add_column(title)
        for i in range(1, 5):
            wheels.add_row(
                str(i),
                self._text("WheelSlip", f"SlipWheel{i}", "{:+.2f}") or "-",
                self._text("WheelSinkage", f"SinkageWheel{i}", "{:.0f}") or "-",
            )
        body = Table.grid(padding=(0, 4))
        body.add_row(soil, wheels)
        return Panel(Group(head, self._warning(), Text(detail), Text(""), body), title="soilbus", width=76)

    def _warning(self) -> Text:
        if self.value("DemandForecast", "Warning") != "immobilisation":
            return Text("")
        left = self._text("DemandForecast", "TimeLeft", " in {:.0f} s")
        return Text(f" GETTING STUCK{left} ", style="bold white on red")

    def _advice(self) -> str:
        """Slips for best efficiency, front and rear."""
        slips = (self._text("TractionAdvice", f"SlipForEfficiency{axle}", "{:.2f}") for axle in ("Front", "Rear"))
        return "best slip " + "/".join(slip or "-" for slip in slips)

    def _text(self, message: str, signal: str, form: str) -> str:
        value = self.value(message, signal)
        return "" if value is None or value == "none" else form.format(value)

    def _pair(self, message: str, value: str, std: str, form: str = "{}") -> str:
        v, s = self.value(message, value), self.value(message, std)
        return "-" if not isinstance(v, float) or not isinstance(s, float) else form.format(f"{v:.3g} ± {s:.2g}")


def watch(config: Config, seconds: float | None = None) -> None:
    """Show the dashboard of the configured bus until interrupted, or for some seconds; raises BusError."""
    database = output_database(config)
    with open_bus(config.bus.model_dump(), filters_of(database)) as bus:
        show(Dashboard(database), bus, Console(), until=None if seconds is None else time.monotonic() + seconds)


def show(
    dashboard: Dashboard,
    bus: can.BusABC,
    console: Console,
    until: float | None = None,
    done: Callable[[], bool] = lambda: False,
) -> None:
    """Feed a dashboard from a bus and redraw it five times a second until `until` (monotonic) or `done`."""
    with Live(dashboard.render(), console=console, auto_refresh=False, screen=False) as live:
        redraw = time.monotonic()
        while not done() and (until is None or time.monotonic() < until):
            message = bus.recv(max(0.0, redraw - time.monotonic()))
            if message is not None and not message.is_error_frame:
                dashboard.receive(message)
            if time.monotonic() >= redraw:
                redraw = time.monotonic() + 0.2
                live.update(dashboard.render(), refresh=True)
