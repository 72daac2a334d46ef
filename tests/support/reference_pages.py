"""Pages generated from the code: configuration, commands, effects.

Each page is a pure function of what it describes (the model of the configuration, the parser of the command line, the
catalogue of effects), and a test compares the pages in `service/docs` with it.

    python tests/support/reference_pages.py service/docs     writes them again
"""

import argparse
import ast
import inspect
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, get_args

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from soilbus.cli.arguments import command_line, subcommands
from soilbus.cli.effects import parameter_rows
from soilbus.config import model
from soilbus.config.model import Column, Config, Noise, Prior, RunningGear, Signal
from soilbus.config.model import Effect as EffectTable
from soilbus.terra.effects.catalogue import CATALOGUE
from soilbus.terra.effects.effect import Effect

VALUES = (Signal, Noise, Prior, Column, EffectTable)
"""Sections that are values of many keys."""
GENERATED = "<!-- generated: python tests/support/reference_pages.py service/docs -->\n\n"


def pages() -> dict[str, str]:
    """Return the text of each generated page by its file name."""
    return {
        "configuration.md": configuration_page(),
        "commands.md": commands_page(),
        "effects.md": effects_page(),
    }


def configuration_page() -> str:
    """Return every key of the TOML file with type, default and meaning, section by section."""
    text = (
        f"{GENERATED}# Configuration reference\n\nOne TOML file describes one vehicle. Values are SI; an unknown key"
        " is an error. `soilbus check --config F --settings` prints every setting in force. `--set KEY=VALUE`"
        " overrides a key by its dotted path.\n"
    )
    for heading, section in (*_sections(Config, ""), *((value.__name__, value) for value in (RunningGear, *VALUES))):
        own = inspect.get_annotations(section)
        rows = [_row(section, name, field) for name, field in section.model_fields.items() if name in own]
        text += f"\n## {heading}\n\n{inspect.getdoc(section)}\n\n| key | type | default | meaning |\n"
        text += "| - | - | - | - |\n" + "".join(rows)
    return text


def _sections(section: type[BaseModel], path: str) -> Iterator[tuple[str, type[BaseModel]]]:
    """Sections below one, each with its heading as the TOML file has it."""
    for name, field in section.model_fields.items():
        inner = _model_in(field.annotation)
        if inner is not None and inner not in VALUES:
            yield (f"[[{path}{name}]]" if _is_list(field.annotation) else f"[{path}{name}]"), inner
            yield from _sections(inner, f"{path}{name}.")


def _model_in(annotation: Any) -> type[BaseModel] | None:
    """The section that a field holds, be it one, a list of them, or optional."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    found = (_model_in(part) for part in get_args(annotation))
    return next((part for part in found if part is not None), None)


def _is_list(annotation: Any) -> bool:
    return getattr(annotation, "__origin__", None) is list


def _row(section: type[BaseModel], name: str, field: FieldInfo) -> str:
    if (inner := _model_in(field.annotation)) is not None and inner not in VALUES:
        return ""  # a section of its own
    default = "required" if field.is_required() else _value(field.get_default(call_default_factory=True))
    meaning = _attribute_docs(section).get(name, "")
    return f"| `{name}` | {_type(field.annotation)} | {default} | {meaning} |\n"


def _type(annotation: Any) -> str:
    """A type in the words of a TOML file."""
    inner = _model_in(annotation)
    if inner is not None:
        return f"list of {inner.__name__}" if _is_list(annotation) else inner.__name__
    parts = get_args(annotation)
    names = {float: "number", int: "whole number", str: "text", bool: "true or false", dict: "table", Path: "path"}
    if annotation in names:
        return names[annotation]
    if type(None) in parts:
        return _type(parts[0])
    if getattr(annotation, "__origin__", None) in (list, tuple, dict):
        return "table" if annotation.__origin__ is dict else f"list of {_type(parts[0])}"
    if parts and all(isinstance(part, (str, int)) for part in parts):
        return " or ".join(f"`{part!r}`".replace("'", '"') for part in parts)
    return _type(parts[0]) if parts else str(annotation)


def _value(default: Any) -> str:
    if default is None:
        return ""
    if isinstance(default, BaseModel):
        kept = {k: v for k, v in default.model_dump().items() if v not in (0.0, None)}
        return "`{ " + ", ".join(f"{k} = {_toml(v)}" for k, v in kept.items()) + " }`" if kept else "`{}`"
    return f"`{_toml(default)}`"


def _toml(value: Any) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(map(_toml, value))}]"
    if isinstance(value, bool):
        return str(value).lower()
    return f'"{value}"' if isinstance(value, str) else f"{value:g}" if isinstance(value, float) else str(value)


@cache
def _parsed_model() -> list[ast.stmt]:
    return ast.parse(inspect.getsource(model)).body


@cache
def _attribute_docs(section: type[BaseModel]) -> dict[str, str]:
    """The text below each attribute of a section, in one line."""
    found: dict[str, str] = {}
    for node in _parsed_model():
        if isinstance(node, ast.ClassDef) and node.name == section.__name__:
            for attribute, below in zip(node.body, node.body[1:], strict=False):
                text = getattr(getattr(below, "value", None), "value", None)
                if isinstance(attribute, ast.AnnAssign) and isinstance(below, ast.Expr) and isinstance(text, str):
                    found[ast.unparse(attribute.target)] = " ".join(text.split())
    return found


def commands_page() -> str:
    """Return the help of every command."""
    text = (
        f"{GENERATED}# Commands\n\nExit codes: 0 done; 1 the work could not be done (one line on stderr); 2 wrong usage"
        " or configuration. An output file is there whole or not at all; workers end with the command.\n\n"
        "`--config FILE` names the configuration, or a reference machine: `tractor`, `tractor-2wd`, `tractor-axles`."
        " `--set KEY=VALUE` overrides a value by its dotted path, as in `--set soil.c.value=5000` or"
        " `--set wheel.FL.radius=0.51`. Commands that take both say so, with the configuration that they take"
        " otherwise.\n\nLogs are recognised by content, whatever their name: candump (`-L`, or its console output with"
        " stamps), SavvyCAN (GVRET), CANedge and python-can CSV, BUSMASTER, PCAN TRC, Vector ASC and BLF, MF4,"
        " MCAP of `replay --mcap`, SQLite of python-can; plain or packed by gzip, bzip2, xz or zstd. `-` is standard"
        " input. Stamps by date count as UTC. Of a log with several channels `bus.channel` is read, or `--channel`; the"
        " others are counted and said. `canN` is also the channel numbered N + 1, or N in a log whose numbers begin at"
        " 0; a log of one other channel is read, with a line that says so.\n\n"
        "MF4 needs the extra `mf4`, MCAP `mcap`, zstd `tables`, `--report` `plots`, `bench` `peers`, `completion`"
        " the extra of its name.\n"
    )
    for name, command in subcommands(command_line()).items():
        text += f"\n## soilbus {name}\n\n{command.description}\n\n{_arguments(command)}"
        text += f"\n```sh\n{(command.epilog or '').splitlines()[-1].strip()}\n```\n"
    return text


def _arguments(command: argparse.ArgumentParser) -> str:
    rows, taken = [], ""
    for action in command._actions:
        if isinstance(action, argparse._HelpAction) or action.dest == "set":
            continue
        if action.dest == "config":
            taken = f"Takes `--config` (default: {(action.help or '').rpartition('default: ')[2]}) and `--set`.\n\n"
            continue
        metavar = action.metavar if isinstance(action.metavar, str) else " ".join(action.metavar or ())
        shown = f"{', '.join(action.option_strings)} {metavar}".strip() or action.dest
        rows.append(f"| `{shown}`{' (required)' if action.required else ''} | {action.help or ''} |\n")
    return taken + ("| argument | meaning |\n| - | - |\n" + "".join(rows) if rows else "")


def effects_page() -> str:
    """Return the catalogue of effects: physics, parameters with unit and range, source, what shows it."""
    text = (
        f"{GENERATED}# Effects\n\nWhat can be added to the wheel–soil model, to the balance of the vehicle or to a"
        " sensor: by `soilbus diagnose`, by `[model] effects` of a configuration, or by `soilbus simulate --effect"
        " NAME=VALUE`, which sets the first parameter. Each parameter has a value at which the effect is absent.\n"
    )
    return text + "".join(_effect(effect) for effect in CATALOGUE.values())


def _effect(effect: Effect) -> str:
    alike: dict[tuple[str, ...], list[str]] = {}  # of a spline, say: one row for all its knots
    for name, *others in parameter_rows(effect):
        alike.setdefault((name.rstrip("0123456789"), *others), []).append(f"`{name}`")
    head = ("parameter", "unit", "absent at", "prior std", "range")
    rows = ([", ".join(names), *others] for (_, *others), names in alike.items())
    return (
        f"\n## {effect.name}\n\n{effect.physics}\n\n*Shown by:* {effect.tells}\n\n*Source:* {effect.source}\n\n"
        + "".join(f"| {' | '.join(row)} |\n" for row in (head, ["-"] * len(head), *rows))
    )


def main(folder: Path) -> None:
    """Write every page into a folder."""
    for name, text in pages().items():
        (folder / name).write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
