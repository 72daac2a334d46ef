"""The commands and their arguments, for argparse.

Numbers have parsers of their own (`between`, `natural`, `counted`), which refuse a value with one clear line.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NoReturn

from soilbus import __version__
from soilbus.words import shown


class _Parser(argparse.ArgumentParser):
    """A parser whose errors show names of files as a terminal may have them: a shell makes arguments of names."""

    def error(self, message: str) -> NoReturn:
        """Print usage and error, and leave with exit code 2."""
        super().error(shown(message))


def between(low: float, high: float) -> Callable[[str], float]:
    """Return the parser of a number in a range, for argparse."""

    def number(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"{text} is not a number from {low:g} to {high:g}")
        return value

    return number


def natural(text: str) -> int:
    """Return the parser of a whole number that is not negative, for argparse."""
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"{text} is not a whole number from 0 up")
    return int(text)


def counted(text: str) -> int:
    """Return the parser of a whole number above zero, for argparse."""
    number = natural(text)
    if number == 0:
        raise argparse.ArgumentTypeError("0 is not enough")
    return number


class Once(argparse.Action):
    """Action that keeps the value of an option that may stand once; argparse would drop the first of two."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        option_string: str | None = None,
    ) -> None:
        """Set the value; the parser's error where the option has one already."""
        given: set[str] = vars(namespace).setdefault("given", set())
        if self.dest in given:
            parser.error(f"argument {'/'.join(self.option_strings)}: given twice")
        given.add(self.dest)
        setattr(namespace, self.dest, values)


EXAMPLES: Mapping[str, str] = {
    "demo": "soilbus demo --picture dashboard.svg",
    "init": "soilbus init --dbc vehicle.dbc --log drive.log -o soilbus.toml",
    "run": "soilbus run --config soilbus.toml --set bus.channel=can1",
    "check": "soilbus check --config soilbus.toml --log drive.log",
    "replay": "soilbus replay --config soilbus.toml drive.log --json windows.jsonl --report drive.html",
    "simulate": "soilbus simulate --config tractor-2wd --soil loam --effect slip_sinkage=0.4 --log drive.log",
    "diagnose": "soilbus diagnose --config soilbus.toml drive.log --report findings.html --model-out better.toml",
    "effects": "soilbus effects slip_sinkage",
    "batch": "soilbus batch --config soilbus.toml logs/ --out results --diagnose",
    "watch": "soilbus watch --config soilbus.toml",
    "completion": "soilbus completion bash >/etc/bash_completion.d/soilbus",
    "docs": "soilbus docs systemd",
    "paper": "soilbus paper --sinkage 0.05",
    "decisions": "soilbus decisions --drives 20 --json figures.json",
    "bench": "soilbus bench --json figures.json",
}
"""A line that works, for the end of each command's help."""


def named(*suffixes: str) -> Callable[[str], Path]:
    """Return a parser of the path of a file to write, whose name must end in one of `suffixes`."""

    def path(text: str) -> Path:
        if Path(text).suffix not in suffixes:
            raise argparse.ArgumentTypeError(f"{text} does not end in {' or '.join(suffixes)}")
        return Path(text)

    return path


def command_line() -> argparse.ArgumentParser:
    """Return the parser of the whole command line; `command` names the one to do."""
    parser = _Parser(prog="soilbus", description="What soil a tractor is driving on, from its CAN bus.")
    parser.add_argument("--version", action="version", version=f"soilbus {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def command(name: str, text: str, config: str = "found") -> argparse.ArgumentParser:
        sub = commands.add_parser(
            name, help=text, description=text, epilog=f"example:\n  {EXAMPLES[name]}",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )  # fmt: skip
        sub.register("action", None, Once)
        if config:
            default = "soilbus.toml in this folder" if config == "found" else "the simulated tractor"
            sub.add_argument(
                "--config", metavar="FILE", help=f"TOML configuration or a reference machine's name; default: {default}"
            )
            sub.add_argument(
                "--set", action="append", default=[], metavar="KEY=VALUE", help="override a value (dotted TOML path)"
            )
        return sub

    def channel(sub: argparse.ArgumentParser) -> None:
        sub.add_argument(
            "--channel", metavar="NAME", help="of logs with several, as they name it: can1, 2 (default: bus.channel)"
        )

    def figures(sub: argparse.ArgumentParser, seed_of: str = "") -> None:
        if seed_of:
            sub.add_argument("--seed", type=natural, default=1, help=f"of {seed_of} (default 1)")
        sub.add_argument("--json", type=Path, metavar="OUT", help="write the figures as JSON")

    sub = command("demo", "simulated tractor, service and dashboard; needs no hardware, ends by itself", "")
    sub.add_argument(
        "--duration", type=between(1.0, 3600.0), default=42.0, metavar="S", help="simulated seconds (default 42)"
    )
    sub.add_argument(
        "--picture", type=Path, metavar="OUT.svg",
        help="keep the dashboard's last state: the driver's page, and the engineer's in OUT-engineer.svg",
    )  # fmt: skip

    sub = command(
        "init", "propose a configuration from the vehicle's DBC and a log of a drive, or from a table of signals", ""
    )
    source = sub.add_mutually_exclusive_group(required=True)
    source.add_argument("--dbc", action="append", type=Path, metavar="FILE", help="of the vehicle; repeat it for more")
    source.add_argument(
        "--table",
        type=Path,
        metavar="LOG",
        help="in place of DBC and log: decoded signals over time (CSV, Parquet, MF4)",
    )
    sub.add_argument("--log", type=Path, metavar="LOG", help="a drive with varied load, to see what each signal does")
    channel(sub)
    sub.add_argument(
        "-o", "--out", type=Path, default=Path("-"), metavar="OUT.toml", help="file to write (default: stdout)"
    )
    sub.add_argument("--force", action="store_true", help="replace a file that is there already")

    sub = command("run", "the service on a live bus")
    sub.add_argument("--wait", action="store_true", help="wait for an interface that is not there yet")

    sub = command("check", "check configuration and DBCs, list every mapped signal")
    heard = sub.add_mutually_exclusive_group()
    heard.add_argument("--log", type=Path, metavar="LOG", help="and compare them with a recording (- for stdin)")
    heard.add_argument(
        "--live", type=between(1.0, 3600.0), metavar="SECONDS", help="and with SECONDS of the configured bus"
    )
    channel(sub)
    sub.add_argument("--settings", action="store_true", help="list every setting in force, defaults included")

    sub = command("replay", "the service's own pipeline over recorded logs")
    sub.add_argument("logs", nargs="+", type=Path, metavar="LOG", help="recording; - for stdin")
    channel(sub)
    sub.add_argument("--json", type=Path, metavar="OUT", help="one JSON object a line per window; - for stdout")
    sub.add_argument("--report", type=Path, metavar="OUT.html", help="self-contained HTML with plots (extra: plots)")
    sub.add_argument(
        "--frames", type=Path, metavar="OUT", help="log of the frames that the service sends (.log .log.gz .asc .blf)"
    )
    sub.add_argument(
        "--table", type=named(".csv", ".parquet"), metavar="OUT",
        help="windows as rows: .csv, or .parquet (extra: tables)",
    )  # fmt: skip
    sub.add_argument(
        "--mcap", type=Path, metavar="OUT.mcap",
        help="windows, positions, warnings and the frames, for Foxglove, PlotJuggler, replay (extra: mcap)",
    )  # fmt: skip
    sub.add_argument(
        "--map", type=Path, metavar="OUT",
        help="a point for each window, GeoJSON or .gpkg (extra: geo); needs a mapped position",
    )  # fmt: skip
    sub.add_argument(
        "--isoxml", type=Path, metavar="FOLDER",
        help="ISO 11783-10 task data for farm software; needs a mapped position",
    )  # fmt: skip
    sub.add_argument(
        "--manoeuvre-out", type=Path, metavar="OUT.json", help="what to drive to know the soil better (see simulate)"
    )
    sub.add_argument("--partial", action="store_true", help="keep the windows before the point where a log is damaged")

    sub = command("simulate", "simulated tractor, to a bus in real time or to a log", "optional")
    sub.add_argument("--soil", action="append", default=[], metavar="NAME", help="soil; repeat it for a sequence")
    sub.add_argument(
        "--effect", action="append", default=[], metavar="NAME=VALUE",
        help="an effect on wheels or sensors; NAME.PARAMETER=VALUE for another than its first parameter; repeatable",
    )  # fmt: skip
    sub.add_argument(
        "--duration", type=between(0.1, 1e6), default=120.0, metavar="S", help="of the drive (default 120)"
    )
    sub.add_argument("--seed", type=natural, default=1, help="of ground and sensor noise (default 1)")
    sub.add_argument("--start", nargs=2, type=float, metavar=("LAT", "LON"), help="where it starts [deg]")
    sub.add_argument(
        "--heading", type=between(-360.0, 360.0), default=0.0, metavar="DEG", help="clockwise from north (default 0)"
    )
    sub.add_argument(
        "--rows", nargs=2, type=float, metavar=("LENGTH", "SPACING"), help="up and down a field [m], not straight on"
    )
    sub.add_argument(
        "--draft", type=between(0.0, 128_000.0), metavar="N",
        help="draft of an implement that nobody lifts; without it slip is swept from 0.05 to 0.40",
    )  # fmt: skip
    sub.add_argument(
        "--slope", type=between(-60.0, 60.0), default=0.0, metavar="PERCENT", help="uphill is positive (default 0)"
    )
    sub.add_argument(
        "--speed", type=between(0.2, 20.0), metavar="M_PER_S", help="over ground (default: swings from 1.0 to 1.8)"
    )
    sub.add_argument(
        "--vehicle-seed", type=natural, metavar="N",
        help="picks true mass (by vehicle.mass_std) and sensor gains; without it --seed picks the gains",
    )  # fmt: skip
    sub.add_argument(
        "--truth", type=named(".csv", ".parquet"), metavar="OUT",
        help="true values as rows: soil, slip, draft, load, sinkage, torque: .csv, or .parquet (extra: tables)",
    )  # fmt: skip
    sub.add_argument("--manoeuvre", type=Path, metavar="FILE", help="drive what --manoeuvre-out has written")
    target = sub.add_mutually_exclusive_group(required=True)
    target.add_argument(
        "--bus", action="store_true", help="drive on the configured bus in real time, by its commands (dbc/tractor.dbc)"
    )
    target.add_argument("--log", type=Path, metavar="OUT", help="write a log (.log .log.gz .asc .blf)")

    sub = command("diagnose", "what the model misses: find, name, add, show")
    sub.add_argument("logs", nargs="+", type=Path, metavar="LOG", help="recordings of one vehicle")
    channel(sub)
    sub.add_argument("--json", type=Path, metavar="OUT", help="write the findings as JSON; - for stdout")
    sub.add_argument("--report", type=Path, metavar="OUT.html", help="self-contained HTML with plots (extra: plots)")
    sub.add_argument(
        "--model-out", type=Path, metavar="OUT.toml", help="the configuration with the effects found, for any command"
    )
    sub.add_argument(
        "--manoeuvre-out", type=Path, metavar="OUT.json", help="of an ambiguous diagnosis, what to drive to settle it"
    )

    sub = command("batch", "many logs of many vehicles, on all cores or on a Dask cluster (extra: batch)")
    sub.add_argument(
        "logs", nargs="+", metavar="LOG",
        help="log, folder, glob, URL, or manifest: a CSV or Parquet file with log, vehicle, configuration, start",
    )  # fmt: skip
    sub.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the results")
    channel(sub)
    sub.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="of Dask, such as tls://10.0.0.1:8786; by default processes of this machine, which open no port",
    )
    sub.add_argument("--resume", action="store_true", help="go on with DIR: logs that are done are not read again")
    sub.add_argument(
        "--retry", action="store_true", help="as --resume, but logs that failed or are damaged are read again"
    )
    sub.add_argument(
        "--diagnose", action="store_true", help="and say which vehicles have which fault, in DIR/diagnosis.json"
    )

    sub = command("watch", "terminal dashboard that reads only our frames, of the bus or of a recording", "optional")
    sub.add_argument("log", nargs="?", type=Path, metavar="LOG", help="a recording of our frames, played in real time")
    sub.add_argument("--channel", metavar="NAME", help="of the bus to listen to, such as can0 (default: bus.channel)")
    sub.add_argument(
        "--speed", type=between(0.1, 1000.0), default=1.0, metavar="X", help="play LOG X times as fast (default 1)"
    )
    lines = sub.add_mutually_exclusive_group()
    lines.add_argument("--plain", action="store_true", help="lines of text, for a screen reader; also in a pipe")
    lines.add_argument(
        "--json", action="store_true", help="a line of JSON for each window, for programs that send results on"
    )
    sub.add_argument("--seconds", type=between(0.0, 1e6), metavar="S", help="stop after this time")

    sub = command("effects", "the catalogue of effects: physics, parameters, ranges, source, what tells it apart", "")
    sub.add_argument("name", nargs="?", metavar="NAME", help="one effect in full (default: a line for each)")
    sub.add_argument("--json", type=Path, metavar="OUT", help="write them as JSON; - for stdout")

    sub = command("completion", "completion of commands and options for a shell (extra: completion)", "")
    sub.add_argument("shell", choices=("bash", "zsh"), help="the shell; its output belongs where that shell looks")

    sub = command("docs", "the pages of this version, which need no network", "")
    sub.add_argument("page", nargs="?", metavar="PAGE", help="print this one; without it: which there are, and where")

    sub = command("paper", "the tables of Xi et al. 2024 beside ours, and what holds of its method", "")
    sub.add_argument(
        "--sinkage", type=between(0.005, 0.2), default=0.05, metavar="M",
        help="of the simulated wheels, 0.005 to 0.2 m; the paper does not print its own (default 0.05)",
    )  # fmt: skip

    sub = command("decisions", "what soilbus predicts, beside what simulated drives then do", "optional")
    sub.add_argument("--drives", type=counted, default=150, metavar="N", help="on each soil (default 150)")
    sub.add_argument("--calls", type=counted, default=600, metavar="N", help="of go, caution, no-go (default 600)")
    sub.add_argument("--boggings", type=counted, default=40, metavar="N", help="drives into trouble (default 40)")
    sub.add_argument("--hours", type=between(0.0, 100.0), default=1.0, metavar="H", help="on firm ground (default 1)")
    figures(sub, "soils, drives, noise and priors")

    sub = command("bench", "every performance figure beside its peer, in one run", "")
    figures(sub)
    return parser


def subcommands(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    """Return the parser of each command by its name."""
    return next(dict(a.choices) for a in parser._actions if isinstance(a, argparse._SubParsersAction))
