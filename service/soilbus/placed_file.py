"""Files that are there whole or not at all, even when the process that writes them is killed."""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

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
