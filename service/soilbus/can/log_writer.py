"""Frames -> a log in any format that python-can writes, whole or not at all."""

from __future__ import annotations

import gzip
import io
import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import can
from can.io.logger import MESSAGE_WRITERS

from soilbus.files import placed

_WRITERS: dict[str, Callable[[Any], Any]] = {
    ".log": can.CanutilsLogWriter,
    ".asc": can.ASCWriter,
    ".csv": can.CSVWriter,
    ".blf": can.BLFWriter,
}
"""Those that write into a file that is open."""


def check_is_a_format(path: Path) -> None:
    """Raise ValueError with one line where no writer knows the file's suffix: long work asks first."""
    suffixes = [suffix.lower() for suffix in path.suffixes]
    kind = suffixes[-2] if suffixes[-1:] == [".gz"] and len(suffixes) > 1 else "".join(suffixes[-1:])
    if kind not in MESSAGE_WRITERS:
        raise ValueError(f"{path}: no format of a log is known by this ending; .log .log.gz .asc .blf are")


def write_log(messages: Iterable[can.Message], path: Path) -> None:
    """Write a log in the format of the file's suffix (.log, .asc, .blf, .log.gz ...); it appears only when complete.

    Raises
    ------
    ValueError
        The suffix is unknown.
    OSError
        The file cannot be written.
    """
    *_, kind, last = ("", "", *(suffix.lower() for suffix in path.suffixes))
    is_packed = last == ".gz"
    kind = kind if is_packed else last
    if kind not in _WRITERS or (is_packed and kind == ".blf"):
        _write_by_name(messages, path, kind + last if is_packed else kind)
        return
    with placed(path) as descriptor, open(descriptor, "wb+", closefd=False) as raw:
        packed = gzip.GzipFile(fileobj=raw, mode="wb") if is_packed else raw
        file = packed if kind == ".blf" else io.TextIOWrapper(packed, encoding="utf-8")
        with _WRITERS[kind](file) as log:
            for message in messages:
                log(message)


def _write_by_name(messages: Iterable[can.Message], path: Path, suffix: str) -> None:
    """Write a log of a format that its writer opens itself, under a hidden name first."""
    part = path.with_name(f".soilbus-{os.getpid()}{suffix}")
    try:
        with can.Logger(part) as log:
            for message in messages:
                log(message)
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
