"""What the commands share: the error for failed work, the configuration of a command, checks before the work."""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from soilbus.config.file import found_configuration, load_config
from soilbus.config.model import Config
from soilbus.files import write_text
from soilbus.words import WorkError


def configured(args: argparse.Namespace, or_reference: bool = False) -> Config:
    """Return the configuration of --config and --set; by default soilbus.toml here, or our reference tractor."""
    if or_reference and not args.config:
        from soilbus.simulator.reference import reference_configuration

        return reference_configuration(args.set)
    config = load_config(found_configuration(args.config), args.set)
    return config.model_copy(update={"log_channel": getattr(args, "channel", None)})


def need_extra(extra: str, what: str, *modules: str) -> None:
    """Raise WorkError where a module of an extra is not installed."""
    from importlib.util import find_spec

    if not all(map(find_spec, modules)):
        raise WorkError(f"{what} needs the extra soilbus[{extra}]")


def report(path: Path | None, record: Any, text: str) -> None:
    """Write a record as JSON where --json says, and print the text unless standard output is for the JSON."""
    if path is not None:
        write_text(path, json.dumps(record, indent=1) + "\n")
    if str(path) != "-":
        print(text, end="")


@contextmanager
def reading_or_writing(path: Path) -> Iterator[None]:
    """Turn an error of a file into one line with its name."""
    try:
        yield
    except OSError as error:
        raise WorkError(f"{path}: {error.strerror or error}") from None
    except ValueError as error:
        raise WorkError(f"{path}: {error}") from None


def check_outputs(*written: Path | None, read: Iterable[Path] = ()) -> None:
    """Check before long work that each file to write has a folder, and is none that is read."""
    inputs, outputs = {os.path.realpath(path) for path in read}, set[str]()
    for path in written:
        if path is None:
            continue
        if not path.parent.is_dir():
            raise WorkError(f"{path}: no folder {path.parent}")
        name = os.path.realpath(path)
        if os.path.exists(name) and not os.path.isfile(name):
            continue
        if name in inputs:
            raise WorkError(f"{path} is read by this command: name another file to write")
        if name in outputs:
            raise WorkError(f"{path} is named for two outputs")
        outputs.add(name)


def check_log_to_write(path: Path | None) -> None:
    """Check that a log to write has a known format, and a folder that is there."""
    from soilbus.can.log_writer import format_of

    if path is None:
        return
    try:
        format_of(path)
    except ValueError as error:
        raise WorkError(str(error)) from None
    check_outputs(path)
