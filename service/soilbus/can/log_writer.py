"""Frames -> a log as candump, Vector or spreadsheets read it, whole or not at all."""

from __future__ import annotations

import gzip
import io
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import can

from soilbus.files import placed

_WRITERS: dict[str, Callable[[Any], Any]] = {
    ".log": can.CanutilsLogWriter,
    ".asc": can.ASCWriter,
    ".csv": can.CSVWriter,
    ".blf": can.BLFWriter,
}
"""Those that write into a file that is open."""


def format_of(path: Path) -> tuple[str, bool]:
    """Return the suffix of the format, and whether to pack it; ValueError for an unknown format."""
    *_, kind, last = ("", "", *(suffix.lower() for suffix in path.suffixes))
    is_packed = last == ".gz"
    kind = kind if is_packed else last
    if kind not in _WRITERS or (is_packed and kind == ".blf"):
        raise ValueError(f"{path}: no format of a log is known by this ending; .log .log.gz .asc .blf are")
    return kind, is_packed


def write_log(messages: Iterable[can.Message], path: Path) -> None:
    """Write a log in the format of the file's suffix, whole or not at all; ValueError as `format_of`, else OSError."""
    kind, is_packed = format_of(path)
    with placed(path) as descriptor, open(descriptor, "wb+", closefd=False) as raw:
        packed = gzip.GzipFile(fileobj=raw, mode="wb") if is_packed else raw
        file = packed if kind == ".blf" else io.TextIOWrapper(packed, encoding="utf-8")
        with _WRITERS[kind](file) as log:
            if kind == ".log":
                log.last_timestamp = 0.0  # it is the least stamp that candump's writer leaves as it is
            for message in messages:
                log(message)
