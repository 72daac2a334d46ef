"""Reading a file that a user names, whatever it turns out to be: a device without end, a pipe, a folder."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path


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
