"""The frame that all HTML reports share: template, pictures inside the file, and what a report was made from.

A report needs nothing but itself: no script and no font is loaded, and a policy tells the browser to ask for nothing.
"""

from __future__ import annotations

import base64
import hashlib
import io
import shlex
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cache
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from soilbus import __version__
from soilbus.config.file import MAX_FILE_BYTES
from soilbus.config.model import Config, Wheel
from soilbus.files import read_bounded
from soilbus.offline.replay import log_names
from soilbus.words import shown

if TYPE_CHECKING:
    from jinja2 import Environment

TEMPLATES = Path(__file__).with_name("templates")
WIDTH = 5.6
"""Width [inch] of a picture: two fill a page of 70 rem; type of 11 points in it is 10 pixels high on a telephone."""
DPI = 160
"""Pixels per inch of a picture: sharp on screens of 1.5 pixels per CSS pixel and in print."""
STYLE = {
    "font.size": 11, "axes.titlesize": 11, "axes.spines.top": False, "axes.spines.right": False,
    "axes.grid": True, "grid.color": "0.9", "axes.axisbelow": True, "legend.fontsize": 9.5, "legend.framealpha": 0.9,
    "hatch.linewidth": 0.8, "text.parse_math": False,
}  # fmt: skip
DIGEST_DIGITS = 16
"""Hexadecimal digits of a configuration's SHA-256 that a report shows."""
CITATION = (
    "the soilbus authors. soilbus: soil parameters of tractors estimated from their CAN bus (version {version}). "
    "The method follows Xi et al., Estimation of Soil Characteristic Parameters for Electric Mountain Tractor Based on "
    "Gauss–Newton Iteration Method. World Electric Vehicle Journal 15(5), 217, 2024. doi:10.3390/wevj15050217"
)
"""CITATION.cff as a sentence."""


class Picture(NamedTuple):
    """Picture as PNG in base64, with words for whoever cannot see it."""

    words: str
    png: str


class Step(NamedTuple):
    """What to do next: a sentence, a command that does it or nothing, and more lines."""

    sentence: str
    command: str = ""
    lines: Sequence[str] = ()


@dataclass(frozen=True, slots=True)
class Source:
    """Recordings and configuration of a report: the configuration's file, if any, and KEY=VALUE in force over it."""

    config: Config
    file: Path | None = None
    overrides: Sequence[str] = ()
    logs: Sequence[Path] = ()
    made: datetime = field(default_factory=lambda: datetime.now(UTC))

    @property
    def names(self) -> list[str]:
        """Names of the recordings, as short as tells them apart."""
        return log_names(self.logs)

    def rows(self) -> Iterator[tuple[str, str]]:
        """Yield the name and text of each line of a report's foot."""
        yield "soilbus", f"version {__version__}"
        yield "Recordings", ", ".join(self.names)
        yield "Configuration", self._configuration()
        if (vehicle := self.config.vehicle) is not None:
            mass = f"{vehicle.mass:g} kg" + (f" ± {vehicle.mass_std:g} kg" if vehicle.mass_std else "")
            ahead = f"centre of gravity {vehicle.cg_ahead_of_rear_axle:g} m ahead of the rear axle"
            high = f"{vehicle.cg_height:g} m high, hitch {vehicle.hitch_height:g} m high"
            yield "Vehicle", f"{mass}, wheelbase {vehicle.wheelbase:g} m, {ahead} and {high}"
        alike = groupby(self.config.wheel, _text_of)
        yield "Wheels", "; ".join(f"{', '.join(wheel.name for wheel in wheels)}: {text}" for text, wheels in alike)
        yield "Made", f"{self.made:%Y-%m-%d %H:%M} {self.made.tzname() or ''}".strip()
        yield "How to cite", CITATION.format(version=__version__)

    def command(self, name: str, file: Path | str | None = None) -> str:
        """Return a command over the same logs, with another configuration or the same."""
        overrides = [] if file else [word for override in self.overrides for word in ("--set", override)]
        config = str(file or self.file or "FILE")
        return shlex.join(["soilbus", name, "--config", config, *overrides, *map(str, self.logs)])

    def _configuration(self) -> str:
        if self.file is None:
            return "of the reference tractor"
        try:
            digest = hashlib.sha256(read_bounded(self.file, MAX_FILE_BYTES)).hexdigest()[:DIGEST_DIGITS]
            text = f"{self.file.name} (SHA-256 {digest}…)"
        except OSError:  # a pipe has been read already
            text = self.file.name
        return text + (f", with {', '.join(self.overrides)}" if self.overrides else "")


def _text_of(wheel: Wheel) -> str:
    track = f", {wheel.contact_length:g} m of track on the ground" if wheel.contact_length else ""
    return f"radius {wheel.radius:g} m, width {wheel.width:g} m{track}" + ("" if wheel.driven else ", not driven")


def page(template: str, source: Source, **content: Any) -> str:
    """Return one page of HTML from a file of `templates`, which escapes every text; the source is for its foot."""
    return _environment().get_template(template).render(source=source, **content) + "\n"


@cache
def _environment() -> Environment:
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    return Environment(
        loader=FileSystemLoader(TEMPLATES), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True, finalize=_printable,
    )  # fmt: skip


def _printable(value: Any) -> Any:
    """What a template prints: texts line by line as `shown`; markup stays markup."""
    if not isinstance(value, str) or value.isprintable():
        return value
    return type(value)("\n".join(shown(line, len(line)) for line in value.split("\n")))


def picture(draw: Callable[[Any], None], height: float, words: str) -> Picture:
    """Return a picture of this height [inch]: `draw` fills a matplotlib figure, `words` say what it shows."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    png = io.BytesIO()
    with mpl.rc_context(STYLE):  # type: ignore[arg-type]
        figure = Figure(figsize=(WIDTH, height), layout="constrained")
        draw(figure)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Glyph")  # of a log's name; the page itself has it
            figure.savefig(png, format="png", dpi=DPI)
    return Picture(words, base64.b64encode(png.getvalue()).decode())
