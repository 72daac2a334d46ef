"""The lines of a text log, none of which takes more memory than a line of a log may need."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from io import TextIOBase
from itertools import chain, islice

LONGEST_LINE = 1 << 16
"""Characters: a frame of CAN FD takes 200, a comment in a log seldom a thousand."""


class LogLines:
    """In place of a text file for whoever goes through it line by line; ValueError for a line that is too long.

    A byte order mark at its begin, which editors on Windows write, is left out.
    """

    def __init__(self, file: TextIOBase) -> None:
        self._file = file
        self._lines = self._bounded()

    def _bounded(self) -> Iterator[str]:
        lines = iter(partial(self._file.readline, LONGEST_LINE), "")
        for line in chain((line.removeprefix("\ufeff") for line in islice(lines, 1)), lines):
            if len(line) == LONGEST_LINE and line[-1] != "\n":
                raise ValueError(f"a line of more than {LONGEST_LINE} characters")
            yield line

    def __iter__(self) -> Iterator[str]:
        return self._lines

    def __next__(self) -> str:
        return next(self._lines)

    def close(self) -> None:
        """Close the file."""
        self._file.close()
