"""Configurations as tomlkit writes them: a file with other effects, where all else stays, comments included."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import tomlkit
from tomlkit import TOMLDocument

from soilbus.config.file import load_config, located, overridden
from soilbus.config.model import ConfigError
from soilbus.words import shown

EffectTable = Mapping[str, Any]
"""name, and for each parameter {value, std} or, where wheels have their own, such a table for each wheel."""


def with_effects_text(
    path: Path, overrides: Iterable[str], effects: Sequence[EffectTable], place: Path, notes: Sequence[str] = ()
) -> str:
    """Return the text of a configuration file with overrides KEY=VALUE in force and other [model] effects.

    DBC files are named so that they are found from the folder `place`, in which the text will be kept. Notes are
    comments below the effects, in the same array: there they may stand in every form of the table. ConfigError as
    load_config().
    """
    config = load_config(path, overrides)
    document = overridden(tomlkit.parse(path.read_text(encoding="utf-8-sig")), overrides)
    if "model" not in document:
        document["model"] = tomlkit.table()
    document["model"]["effects"] = _array(effects, notes)
    if config.dbc.input:
        document["dbc"]["input"] = [_from(place, config.folder, name) for name in config.dbc.input]
    if (renamed := _from(place, config.folder, config.output.dbc)) != config.output.dbc:
        document.setdefault("output", tomlkit.table())["dbc"] = renamed
    return tomlkit.dumps(document)


def _array(effects: Sequence[EffectTable], notes: Sequence[str]) -> Any:
    array = tomlkit.array()
    for effect in effects:
        array.add_line(_inline(effect))
    for note in notes:
        array.add_line(comment=shown(note))
    if effects or notes:
        array.add_line(indent="")
    return array


def _inline(table: Mapping[str, Any]) -> Any:
    inline = tomlkit.inline_table()
    for key, value in table.items():
        inline[key] = _inline(value) if isinstance(value, Mapping) else value
    return inline


def _from(place: Path, folder: Path, name: str) -> str:
    """How a DBC file that a configuration in `folder` calls `name` is called by one in `place`."""
    file = located(folder, name)
    return name if located(place, name).resolve() == file.resolve() else named_from(place, file)


def named_from(place: Path, file: Path) -> str:
    """Return the name by which a configuration in a folder calls a DBC file; ConfigError where TOML cannot hold it."""
    is_beside = located(place, file.name).resolve() == file.resolve()
    name = file.name if is_beside else os.path.relpath(file.resolve(), place.resolve())
    try:
        name.encode()
    except UnicodeEncodeError:
        raise ConfigError([f"{name}: not UTF-8, so no TOML file can name it: rename it"]) from None
    return name


def toml_text(document: TOMLDocument) -> str:
    """Return the text of a document with unprintable characters as escapes of TOML."""
    lines = tomlkit.dumps(document).split("\n")
    return "\n".join("".join(c if c.isprintable() else f"\\U{ord(c):08X}" for c in line) for line in lines)
