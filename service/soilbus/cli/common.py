"""What the commands share: the error for failed work, the configuration of a command, checks before the work."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from soilbus.config.model import Config


class WorkError(Exception):
    """The work could not be done; the text is one line for the user."""


def configured(args: argparse.Namespace) -> Config:
    """The configuration that --config and --set name, or soilbus.toml in the current folder."""
    from soilbus.config.file import found_configuration, load_config

    return load_config(found_configuration(args.config), args.set)


def configured_or_reference(args: argparse.Namespace) -> Config:
    """The same, or that of our reference tractor where none is named."""
    from soilbus.simulator.reference import reference_configuration

    return configured(args) if args.config else reference_configuration(args.set)


def need_extra(module: str, extra: str, what: str) -> None:
    """Raise WorkError where the module of an extra is not installed."""
    from importlib.util import find_spec

    if find_spec(module) is None:
        raise WorkError(f"{what} needs the extra soilbus[{extra}]")


def check_folders(*paths: Path | None) -> None:
    """Long work asks first whether there is a place for what comes of it."""
    for path in paths:
        if path is not None and not path.parent.is_dir():
            raise WorkError(f"{path}: no folder {path.parent}")


def check_log_to_write(path: Path | None) -> None:
    """The same of a log: a format that can be written, in a folder that is there."""
    from soilbus.can.log_writer import check_is_a_format

    if path is None:
        return
    try:
        check_is_a_format(path)
    except ValueError as error:
        raise WorkError(str(error)) from None
    check_folders(path)
