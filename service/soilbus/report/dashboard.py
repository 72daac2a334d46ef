"""A live terminal dashboard that reads only our frames, as any dashboard ECU would.

Grey figures have a Status other than valid: they are guesses that must not be acted on. "-" is a value that is not
available or too old.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import closing

from rich.console import Console, Group
from rich.live import Live
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from soilbus.can.bus import LiveBus, open_bus
from soilbus.can.dbc_files import filters_of, output_database
from soilbus.config.model import Config
from soilbus.report.received_frames import ReceivedFrames

COLOURS = {"go": "green", "caution": "yellow", "no_go": "red", "unknown": "white"}
PARAMETERS = {
    "k_c": ("SoilCohesiveModulus", "kN/m^(n+1)"),
    "k_φ": ("SoilFrictionalModulus", "kN/m^(n+2)"),
    "n": ("SoilSinkageExponent", ""),
    "φ": ("SoilFrictionAngle", "°"),
    "c": ("SoilCohesion", "kPa"),
    "K": ("SoilShearModulus", "mm"),
}
LIMITS = {
    "on the level": ("DraftCapability", "GradeCapability"),
    "here and now": ("TractionLimits", "TractionLimits"),
}
"""Messages of draft and of slope, by what they hold for."""
ADVICE = {"efficiency": "SlipForEfficiency", "pull": "SlipForPull"}
FAULTS_OF_BUS = {
    "Overruns": "overruns",
    "Dropped": "dropped",
    "ForeignFrames": "foreign",
    "ErrorFrames": "errors",
    "Reopened": "reopened",
}
WIDTH = 78
"""Characters of the dashboard."""


def panel(known: ReceivedFrames, fault: str = "") -> Panel:
    """The dashboard's picture.

    Parameters
    ----------
    known
        The received frames.
    fault
        Why the bus is away; empty while it is there.
    """
    decision = str(known.value("Traversability", "State"))
    decision = decision if decision in COLOURS else "unknown"
    head = Text(f" {decision.upper().replace('_', '-')} ", style=f"bold black on {COLOURS[decision]}")
    ground, task = (Table.grid(padding=(0, 4)) for _ in range(2))
    ground.add_row(_soil(known), _wheels(known))
    task.add_row(_limits(known), _advice(known))
    lines = (Text("  ".join(words)) for words in (_detail(known), _demand(known)))
    parts = (head, _warning(known), *lines, Text(" ".join(_kind(known))), Text(""))
    service, bus = (Text("  ".join(words)) for words in (_service(known), _bus(known)))
    last = (Text(""), task, Text(""), service, Text(f"bus: away ({fault})") if fault else bus)
    return Panel(Group(*parts, ground, *last), title="soilbus", width=WIDTH)


def _detail(known: ReceivedFrames) -> Iterator[str]:
    """Of the verdict."""
    yield from _measured(known, "Traversability", "Probability", "p = {:.2f}")
    yield from _said(known, "Traversability", "LimitingCause", "limit: {}")
    yield from _measured(known, "Traversability", "Age", "{:.1f} s old")
    yield from _measured(known, "Traversability", "SinceValid", "valid {:.1f} s ago")


def _kind(known: ReceivedFrames) -> Iterator[str]:
    yield from _said(known, "SoilClass", "Kind", "soil: {}")
    yield from _measured(known, "SoilClass", "Probability", "({:.2f})")
    yield from _measured(known, "SoilClass", "UnknownProbability", "none of the known {:.2f}")


def _demand(known: ReceivedFrames) -> Iterator[str]:
    """Torque that the present demand needs, and the slip and sinkage predicted for it."""
    needed, there = (known.number("TorqueDemand", f"Torque{what}") for what in ("Required", "Available"))
    if needed is not None or there is not None:
        yield "torque {} of {} N m".format(*("-" if x is None else f"{x:.0f}" for x in (needed, there)))
    yield from _measured(known, "DemandForecast", "Slip", "slip to come {:.2f}")
    yield from _measured(known, "DemandForecast", "Sinkage", "sinkage {:.0f} mm")


def _service(known: ReceivedFrames) -> Iterator[str]:
    version = [known.number("SoilbusIdentity", f"Version{part}") for part in ("Major", "Minor", "Patch")]
    if None not in version:
        yield "soilbus " + ".".join(f"{part:.0f}" for part in version)
    yield from _said(known, "SoilbusStatus", "State", "service: {}")
    yield from _said(known, "SoilbusStatus", "Reason", "({})")
    yield from _measured(known, "SoilbusStatus", "RejectedShare", "refused {:.1f} %")
    if known.bad_frames:
        yield f"bad frames {known.bad_frames}"


def _bus(known: ReceivedFrames) -> Iterator[str]:
    """How the bus does, by what the service counted on it."""
    yield from _said(known, "BusHealth", "BusState", "bus: {}")
    for signal, what in FAULTS_OF_BUS.items():
        if count := known.number("BusHealth", signal):
            yield f"{what} {count:.0f}"


def _soil(known: ReceivedFrames) -> Table:
    soil = _table("soil", "value ± std", "unit")
    soil.add_row("bearing pressure", _pair(known, "SoilStrength", "BearingPressure"), "kPa")
    for name, (message, unit) in PARAMETERS.items():
        soil.add_row(name, _pair(known, message, "Value", "Std"), unit)
    soil.add_row("fit, chi-square", _one(known, "SoilStrength", "Chi2", "{:.1f}"), "")
    return soil


def _limits(known: ReceivedFrames) -> Table:
    limits = _table("largest", "draft, N", "slope, rad")
    for name, (of_draft, of_slope) in LIMITS.items():
        limits.add_row(name, _pair(known, of_draft, "MaxDraft"), _pair(known, of_slope, "MaxGrade"))
    return limits


def _advice(known: ReceivedFrames) -> Table:
    advice = _table("best slip for", "front", "rear")
    for name, signal in ADVICE.items():
        axles = [_one(known, "TractionAdvice", f"{signal}{axle}", "{:.2f}") for axle in ("Front", "Rear")]
        advice.add_row(name, *axles)
    return advice


def _wheels(known: ReceivedFrames) -> Table:
    """One row for each wheel; wheels 5 to 8 only where they have a value."""
    wheels = _table("wheel", "slip", "sinkage, mm")
    for i in range(1, 9):
        more = "2" if i > 4 else ""
        slip = _one(known, f"WheelSlip{more}", f"SlipWheel{i}", "{:+.2f}")
        depth = _one(known, f"WheelSinkage{more}", f"SinkageWheel{i}", "{:.0f}")
        if i <= 4 or {slip.plain, depth.plain} != {"-"}:
            wheels.add_row(str(i), slip, depth)
    return wheels


def _warning(known: ReceivedFrames) -> Text:
    if known.value("DemandForecast", "Warning") != "immobilisation":
        return Text("")
    left = "".join(_measured(known, "DemandForecast", "TimeLeft", " in {:.0f} s"))
    return Text(f" GETTING STUCK{left} ", style="bold white on red")


def _table(*titles: str) -> Table:
    table = Table(box=None, pad_edge=False)
    for title in titles:
        table.add_column(title, no_wrap=True)
    return table


def _said(known: ReceivedFrames, message: str, signal: str, form: str) -> Iterator[str]:
    """A named value in words, nothing where it is not known."""
    value = known.value(message, signal)
    if value is not None and value != "none":
        yield form.format(value)


def _measured(known: ReceivedFrames, message: str, signal: str, form: str) -> Iterator[str]:
    """A number in words, nothing where it is not known."""
    value = known.number(message, signal)
    if value is not None:
        yield form.format(value)


def _one(known: ReceivedFrames, message: str, signal: str, form: str) -> Text:
    value = known.number(message, signal)
    return Text("-" if value is None else form.format(value), style="" if known.is_valid(message) else "dim")


def _pair(known: ReceivedFrames, message: str, signal: str, std: str | None = None) -> Text:
    value, spread = known.number(message, signal), known.number(message, std or f"{signal}Std")
    figure = "-" if value is None or spread is None else f"{_figures(value, spread)}"
    return Text(figure, style="" if known.is_valid(message) else "dim")


def _figures(value: float, spread: float) -> str:
    """Value and std, without powers of ten."""
    large = max(abs(value), spread) >= 100.0
    return f"{value:.0f} ± {spread:.0f}" if large and spread >= 1.0 else f"{value:.3g} ± {spread:.2g}"


def watch(config: Config, seconds: float | None = None) -> None:
    """Show the dashboard of the configured bus until interrupted or for some seconds; wait for a bus that goes away.

    Raises
    ------
    BusError
        The bus cannot be opened at the start.
    """
    database = output_database(config)
    settings, filters = config.bus.model_dump(), filters_of(database)
    with closing(LiveBus(lambda: open_bus(settings, filters), time.monotonic, time.sleep)) as bus:
        bus.open()
        show(ReceivedFrames(database), bus, Console(), until=None if seconds is None else time.monotonic() + seconds)


def show(
    known: ReceivedFrames,
    bus: LiveBus,
    console: Console,
    until: float | None = None,
    done: Callable[[], bool] = lambda: False,
) -> None:
    """Feed received frames from a bus and redraw five times a second.

    Parameters
    ----------
    known
        Takes the frames.
    bus
        The open bus.
    console
        Where to draw.
    until
        Monotonic time [s] at which to stop; None for never.
    done
        Whether to stop, asked in every round.
    """
    with Live(panel(known), console=console, auto_refresh=False, screen=False) as live:
        redraw = time.monotonic()
        while not done() and (until is None or time.monotonic() < until):
            message = bus.receive(max(0.0, redraw - time.monotonic()))
            if message is not None:
                known.receive(message)
            if time.monotonic() >= redraw:
                redraw = time.monotonic() + 0.2
                live.update(panel(known, bus.fault), refresh=True)
