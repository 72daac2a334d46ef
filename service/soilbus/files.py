"""Bounded reading of files that a user names, and outputs that are there whole or not at all.

What is read may be a device without end, a pipe, a folder; what is written stays whole even when its process is killed.
"""

from __future__ import annotations

import errno
import os
import stat
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO


def read_bounded(path: Path, largest: int, regular: bool = True) -> bytes:
    """Content of a file of `largest` bytes at most; with `regular` of nothing but a regular file, and never waiting.

    Raises OSError with a reason that can be printed.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | (os.O_NONBLOCK if regular else 0))
    with open(descriptor, "rb") as file:
        if regular and not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise OSError(errno.EINVAL, "not a regular file", str(path))
        content = file.read(largest + 1)
    if len(content) > largest:
        raise OSError(errno.EFBIG, f"larger than {largest / 2**20:g} MiB", str(path))
    return content


_NO_UNNAMED_FILES = {errno.EOPNOTSUPP, errno.EISDIR, errno.EINVAL}


@contextmanager
def placed(path: Path) -> Iterator[int]:
    """Descriptor of a new file that gets its name when the context is left without an exception.

    What was there before is replaced then; a link stays one, and what is no regular file is written to as it is.
    Until then the file has no name where the file system can do that (O_TMPFILE, open(2)), else a hidden one.
    The descriptor is the context's to close.  Raises OSError.
    """
    path = Path(os.path.realpath(path))
    if path.exists() and not stat.S_ISREG(path.stat().st_mode):
        descriptor = os.open(path, os.O_WRONLY | os.O_CLOEXEC)
        with _closing(descriptor):
            yield descriptor
        return
    spare = path.with_name(f".soilbus-{os.getpid()}")
    descriptor, is_named = _new(path.parent, spare)
    try:
        with _closing(descriptor):
            yield descriptor
            if not is_named:
                _name(descriptor, spare)
                is_named = True
        os.replace(spare, path)
    except BaseException:
        if is_named:
            with suppress(OSError):
                spare.unlink()
        raise


@contextmanager
def _closing(descriptor: int) -> Iterator[None]:
    try:
        yield
    finally:
        os.close(descriptor)


def _new(folder: Path, spare: Path) -> tuple[int, bool]:
    """Descriptor of a new file, and whether it has the spare name already."""
    try:
        return os.open(folder, os.O_TMPFILE | os.O_RDWR | os.O_CLOEXEC, 0o666), False
    except OSError as error:
        if error.errno not in _NO_UNNAMED_FILES:
            raise
    return os.open(spare, os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666), True


def _name(descriptor: int, spare: Path) -> None:
    """Give an unnamed file a name in its folder."""
    spare.unlink(missing_ok=True)  # of a process that was killed
    folder = os.open(spare.parent, os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC)
    with _closing(folder):  # with a folder Python calls linkat(2), which alone follows the link in /proc
        os.link(f"/proc/self/fd/{descriptor}", spare.name, src_dir_fd=folder, dst_dir_fd=folder)


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


def write_text(path: Path, text: str) -> None:
    """Write a text file as `whole_file` does."""
    with whole_file(path) as out:
        out.write(text)


@contextmanager
def whole_file_of_bytes(path: Path) -> Iterator[IO[bytes]]:
    """A binary file that appears under its name only when it is complete.

    Raises NotWritten where it cannot be, and then there is none.
    """
    try:
        with placed(path) as descriptor, open(descriptor, "wb", closefd=False) as out:
            yield out
    except OSError as error:
        raise NotWritten(f"{path}: {error.strerror or error}") from None
