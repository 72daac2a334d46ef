"""Output files that are there whole or not at all."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO


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
        with tempfile.NamedTemporaryFile("w", dir=path.parent, prefix=f".{path.name}.", delete=False) as out:
            try:
                yield out
            except BaseException:
                os.unlink(out.name)
                raise
        os.chmod(out.name, 0o666 & ~_umask())
        os.replace(out.name, path)
    except OSError as error:
        raise NotWritten(f"{path}: {error.strerror or error}") from None


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
