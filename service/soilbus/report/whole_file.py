"""Output files that are there whole or not at all."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from soilbus.placed_file import placed


class NotWritten(Exception):
    """A file cannot be written; the text is one line for the user."""


@contextmanager
def whole_file(path: Path) -> Iterator[IO[str]]:
    """A text file that appears under its name only when it is complete; "-" is stdout.

    Raises NotWritten where it cannot be, and then there is none.
    """
    if str(path) == "-":
        yield sys.stdout
        return
    try:
        # a file's name need not be UTF-8: it is shown by its codes then
        with (
            placed(path) as descriptor,
            open(descriptor, "w", encoding="utf-8", errors="backslashreplace", closefd=False) as out,
        ):
            yield out
    except OSError as error:
        raise NotWritten(f"{path}: {error.strerror or error}") from None
