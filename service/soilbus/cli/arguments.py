"""The commands and their arguments, for argparse; one line adds an argument of a kind (file, number, word, flag)."""

from __future__ import annotations

import math
from argparse import Action, ArgumentParser, ArgumentTypeError, RawDescriptionHelpFormatter, _SubParsersAction
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn

from soilbus import __version__
from soilbus.words import shown

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
FOUND, REFERENCE = "soilbus.toml in this folder", "the simulated tractor"
"""Configurations that commands take without --config."""


class _Parser(ArgumentParser):
    """A parser whose errors show names of files as a terminal may have them: a shell makes arguments of names."""

    def error(self, message: str) -> NoReturn:
        """Print usage and error, and leave with exit code 2."""
        super().error(shown(message))


class Once(Action):
    """Action that keeps the value of an option that may stand once; argparse would drop the first of two."""

    def __call__(self, parser: ArgumentParser, namespace: Any, values: Any, option_string: Any = None) -> None:
        """Set the value; the parser's error where the option has one already."""
        given: set[str] = vars(namespace).setdefault("given", set())
        if self.dest in given:
            parser.error(f"argument {'/'.join(self.option_strings)}: given twice")
        given.add(self.dest)
        setattr(namespace, self.dest, values)


def _word(to: Any, name: str, metavar: Any, text: str, **more: Any) -> None:
    to.add_argument(name, metavar=metavar, help=text, **more)


def _words(to: Any, name: str, metavar: str, text: str) -> None:
    _word(to, name, metavar, text, action="append", default=[])


def _file(to: Any, name: str, metavar: str, text: str, **more: Any) -> None:
    _word(to, name, metavar, text, type=Path, **more)


def _flag(to: Any, name: str, text: str) -> None:
    to.add_argument(name, action="store_true", help=text)


def _channel(to: Any) -> None:
    _word(to, "--channel", "NAME", "of logs with several, as they name it: can1, 2 (default: bus.channel)")


def _table(to: Any, name: str, text: str) -> None:
    def path(given: str) -> Path:
        if Path(given).suffix not in (".csv", ".parquet"):
            raise ArgumentTypeError(f"{given} does not end in .csv or .parquet")
        return Path(given)

    _word(to, name, "OUT", f"{text}: .csv, or .parquet (extra: tables)", type=path)


def _with_default(text: str, default: float | None) -> str:
    return text if default is None else f"{text} (default {default:g})"


def _number(to: Any, name: str, ends: tuple[float, float], metavar: str, text: str, default: Any = None) -> None:
    def number(given: str) -> float:
        try:
            value = float(given)
        except ValueError:
            value = math.nan
        if not ends[0] <= value <= ends[1]:
            raise ArgumentTypeError(f"{given} is not a number from {ends[0]:g} to {ends[1]:g}")
        return value

    _word(to, name, metavar, _with_default(text, default), type=number, default=default)


def _whole(to: Any, name: str, least: int, metavar: str | None, text: str, default: int | None = None) -> None:
    def number(given: str) -> int:
        if not given.isdecimal() or int(given) < least:
            raise ArgumentTypeError(f"{given} is not a whole number from {least} up")
        return int(given)

    _word(to, name, metavar, _with_default(text, default), type=number, default=default)


def command_line() -> ArgumentParser:
    """Return the parser of the whole command line; `command` names the one to do."""
    parser = _Parser(prog="soilbus", description="What soil a tractor is driving on, from its CAN bus.")
    parser.add_argument("--version", action="version", version=f"soilbus {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def command(name: str, text: str, config: str = "") -> ArgumentParser:
        sub = commands.add_parser(
            name, help=text, description=text, epilog=f"example:\n  {EXAMPLES[name]}",
            formatter_class=RawDescriptionHelpFormatter,
        )  # fmt: skip
        sub.register("action", None, Once)
        if config:
            _word(sub, "--config", "FILE", f"TOML configuration or a reference machine's name; default: {config}")
            _words(sub, "--set", "KEY=VALUE", "override a value (dotted TOML path)")
        return sub

    sub = command("demo", "simulated tractor, service and dashboard; needs no hardware, ends by itself")
    _number(sub, "--duration", (1.0, 3600.0), "S", "simulated seconds", 42.0)
    _file(sub, "--picture", "OUT.svg", "keep the last driver's page, and the engineer's in OUT-engineer.svg")

    sub = command("init", "propose a configuration from the vehicle's DBC and a log, or from a table of signals")
    source = sub.add_mutually_exclusive_group(required=True)
    _file(source, "--dbc", "FILE", "of the vehicle; repeat it for more", action="append")
    _file(source, "--table", "LOG", "in place of DBC and log: decoded signals over time (CSV, Parquet, MF4)")
    _file(sub, "--log", "LOG", "a drive with varied load, to see what each signal does")
    _channel(sub)
    text = "file to write (default: stdout)"
    sub.add_argument("-o", "--out", type=Path, default=Path("-"), metavar="OUT.toml", help=text)
    _flag(sub, "--force", "replace a file that is there already")

    sub = command("run", "the service on a live bus", FOUND)
    _flag(sub, "--wait", "wait for an interface that is not there yet")

    sub = command("check", "check configuration and DBCs, list every mapped signal", FOUND)
    heard = sub.add_mutually_exclusive_group()
    _file(heard, "--log", "LOG", "and compare them with a recording (- for stdin)")
    _number(heard, "--live", (1.0, 3600.0), "SECONDS", "and with SECONDS of the configured bus")
    _channel(sub)
    _flag(sub, "--settings", "list every setting in force, defaults included")

    sub = command("replay", "the service's own pipeline over recorded logs", FOUND)
    _file(sub, "logs", "LOG", "recording; - for stdin", nargs="+")
    _channel(sub)
    _file(sub, "--json", "OUT", "one JSON object a line per window; - for stdout")
    _file(sub, "--report", "OUT.html", "self-contained HTML with plots (extra: plots)")
    _file(sub, "--frames", "OUT", "log of the frames that the service sends (.log .log.gz .asc .blf)")
    _table(sub, "--table", "windows as rows")
    _file(sub, "--mcap", "OUT.mcap", "windows, positions, warnings, frames, for Foxglove or PlotJuggler (extra: mcap)")
    _file(sub, "--map", "OUT", "a point for each window, GeoJSON or .gpkg (extra: geo); needs a mapped position")
    _file(sub, "--isoxml", "FOLDER", "ISO 11783-10 task data for farm software; needs a mapped position")
    _file(sub, "--manoeuvre-out", "OUT.json", "what to drive to know the soil better (see simulate)")
    _flag(sub, "--partial", "keep the windows before the point where a log is damaged")

    sub = command("simulate", "simulated tractor, to a bus in real time or to a log", REFERENCE)
    _words(sub, "--soil", "NAME", "soil; repeat it for a sequence")
    _words(sub, "--effect", "NAME=VALUE", "on wheels or sensors; NAME.PARAMETER=VALUE beyond its first parameter")
    _number(sub, "--duration", (0.1, 1e6), "S", "of the drive", 120.0)
    _whole(sub, "--seed", 0, None, "of ground and sensor noise", 1)
    _word(sub, "--start", ("LAT", "LON"), "where it starts [deg]", nargs=2, type=float)
    _number(sub, "--heading", (-360.0, 360.0), "DEG", "clockwise from north", 0.0)
    _word(sub, "--rows", ("LENGTH", "SPACING"), "up and down a field [m], not straight on", nargs=2, type=float)
    _number(sub, "--draft", (0.0, 128_000.0), "N", "of an implement that nobody lifts; without, slip is swept")
    _number(sub, "--slope", (-60.0, 60.0), "PERCENT", "uphill is positive", 0.0)
    _number(sub, "--speed", (0.2, 20.0), "M_PER_S", "over ground (default: swings from 1.0 to 1.8)")
    _whole(sub, "--vehicle-seed", 0, "N", "of true mass (vehicle.mass_std) and gains; without, --seed picks the gains")
    _table(sub, "--truth", "true values as rows: soil, slip, draft, load, sinkage, torque")
    _file(sub, "--manoeuvre", "FILE", "drive what --manoeuvre-out has written")
    target = sub.add_mutually_exclusive_group(required=True)
    _flag(target, "--bus", "drive on the configured bus in real time, by its commands (dbc/tractor.dbc)")
    _file(target, "--log", "OUT", "write a log (.log .log.gz .asc .blf)")

    sub = command("diagnose", "what the model misses: find, name, add, show", FOUND)
    _file(sub, "logs", "LOG", "recordings of one vehicle", nargs="+")
    _channel(sub)
    _file(sub, "--json", "OUT", "write the findings as JSON; - for stdout")
    _file(sub, "--report", "OUT.html", "self-contained HTML with plots (extra: plots)")
    _file(sub, "--model-out", "OUT.toml", "the configuration with the effects found, for any command")
    _file(sub, "--manoeuvre-out", "OUT.json", "of an ambiguous diagnosis, what to drive to settle it")

    sub = command("batch", "many logs of many vehicles, on all cores or on a Dask cluster (extra: batch)", FOUND)
    manifest = "manifest: a CSV or Parquet file with log, vehicle, configuration, start"
    _word(sub, "logs", "LOG", f"log, folder, glob, URL, or {manifest}", nargs="+")
    _file(sub, "--out", "DIR", "folder for the results", required=True)
    _channel(sub)
    _word(sub, "--scheduler", "ADDRESS", "of Dask, such as tls://10.0.0.1:8786; default: processes of this machine")
    _flag(sub, "--resume", "go on with DIR: logs that are done are not read again")
    _flag(sub, "--retry", "as --resume, but logs that failed or are damaged are read again")
    _flag(sub, "--diagnose", "and say which vehicles have which fault, in DIR/diagnosis.json")

    sub = command("watch", "terminal dashboard that reads only our frames, of the bus or of a recording", REFERENCE)
    _file(sub, "log", "LOG", "a recording of our frames, played in real time", nargs="?")
    _word(sub, "--channel", "NAME", "of the bus to listen to, such as can0 (default: bus.channel)")
    _number(sub, "--speed", (0.1, 1000.0), "X", "play LOG X times as fast", 1.0)
    lines = sub.add_mutually_exclusive_group()
    _flag(lines, "--plain", "lines of text, for a screen reader; also in a pipe")
    _flag(lines, "--json", "a line of JSON for each window, for programs that send results on")
    _number(sub, "--seconds", (0.0, 1e6), "S", "stop after this time")

    sub = command("effects", "the catalogue of effects: physics, parameters, ranges, source, what tells it apart")
    _word(sub, "name", "NAME", "one effect in full (default: a line for each)", nargs="?")
    _file(sub, "--json", "OUT", "write them as JSON; - for stdout")

    sub = command("completion", "completion of commands and options for a shell (extra: completion)")
    _word(sub, "shell", None, "the shell; its output belongs where that shell looks", choices=("bash", "zsh"))

    sub = command("docs", "the pages of this version, which need no network")
    _word(sub, "page", "PAGE", "print this one; without it: which there are, and where", nargs="?")

    sub = command("paper", "the tables of Xi et al. 2024 beside ours, and what holds of its method")
    _number(sub, "--sinkage", (0.005, 0.2), "M", "of the simulated wheels; the paper prints none", 0.05)

    sub = command("decisions", "what soilbus predicts, beside what simulated drives then do", REFERENCE)
    _whole(sub, "--drives", 1, "N", "on each soil", 150)
    _whole(sub, "--calls", 1, "N", "of go, caution, no-go", 600)
    _whole(sub, "--boggings", 1, "N", "drives into trouble", 40)
    _number(sub, "--hours", (0.0, 100.0), "H", "on firm ground", 1.0)
    _whole(sub, "--seed", 0, None, "of soils, drives, noise and priors", 1)
    _file(sub, "--json", "OUT", "write the figures as JSON")

    sub = command("bench", "every performance figure beside its peer, in one run")
    _file(sub, "--json", "OUT", "write the figures as JSON")
    return parser


def subcommands(parser: ArgumentParser) -> dict[str, ArgumentParser]:
    """Return the parser of each command by its name."""
    return next(dict(action.choices) for action in parser._actions if isinstance(action, _SubParsersAction))
