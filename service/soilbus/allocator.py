"""Hints to the allocators: the C library's, and Python's collector of garbage."""

from __future__ import annotations

import ctypes
import gc
import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_C = ctypes.CDLL(None)
_C.malloc.restype, _C.malloc.argtypes = ctypes.c_void_p, [ctypes.c_size_t]
_C.free.restype, _C.free.argtypes = None, [ctypes.c_void_p]
SMALL, OF_EACH = 1024, 7
"""Bytes from which numpy keeps no freed blocks, and how many it keeps of each size below (NBUCKETS, NCACHE)."""
_STATM = Path("/proc/self/statm")
_M_ARENA_MAX = -8  # malloc.h
_BLOCK = 100_000
"""Bytes of a block as an evaluation takes it, of the columns of one window."""


def keep_freed_memory() -> None:
    """Let glibc keep freed memory instead of giving it back after every evaluation, for whatever thread needs it next.

    Freeing one large block raises glibc's trim threshold (dynamic mmap threshold,
    mallopt(3)).  Without it each model evaluation gives some 2 MB back to the kernel and
    faults it in again, which doubles its time.  The block is never touched, so it costs
    no memory; elsewhere this does nothing.  Threads would each have an arena of their own
    (mallopt(3)), and the loop would wait page by page for memory that the worker has done with;
    Python lets only one of them work at a time as it is.  To be called before there is a second one.
    """
    mallopt = getattr(_C, "mallopt", None)
    if mallopt is not None:
        mallopt(_M_ARENA_MAX, 1)
    _C.free(_C.malloc(31 * 2**20))


def give_back_freed_memory() -> bool:
    """Hand what is free in glibc's heaps to the kernel (malloc_trim(3)); False where that is not to be had.

    What a rare hard window took would stay with the process for ever: it lies between blocks
    that are in use.  It takes a millisecond or two.
    """
    trim = getattr(_C, "malloc_trim", None)
    if trim is not None:
        trim(0)
    return trim is not None


class Tidying:
    """Gives back freed memory from time to time, each time but for what leaves the process as large as the first time.

    `needed` bytes at least are taken from the kernel again at once, for the calling thread's next evaluation,
    which else would wait for them page by page; at first `spare` more.  As free memory that cannot be
    given back gathers between blocks in use, for hours, it takes the place of these; growth beyond them shows.
    """

    def __init__(self, needed: int, spare: int) -> None:
        self._needed, self._spare = needed, spare
        self._size: int | None = None

    def __call__(self) -> None:
        """Tidy up; elsewhere than on Linux with glibc this does nothing."""
        if not _STATM.exists() or not give_back_freed_memory():
            return
        private = _private_memory()
        if self._size is None:
            self._size = private + self._needed + self._spare
        blocks = [bytearray(_BLOCK) for _ in range(max(self._needed, self._size - private) // _BLOCK)]
        del blocks


def _private_memory() -> int:
    """What of this process is resident and of no file [bytes] (proc_pid_statm(5))."""
    _, resident, shared, *_ = map(int, _STATM.read_text().split())
    return (resident - shared) * resource.getpagesize()


def take_small_blocks() -> None:
    """Let numpy have now all the small blocks that it will ever keep: 3.5 MB.

    Of each size below a kilobyte it keeps as many freed ones as OF_EACH, for good.  Taken one by one, as arrays of
    one size after another come by, they would make the process grow for a day, and lie scattered between other blocks.
    """
    import numpy as np

    blocks = [np.empty(size, np.uint8) for size in range(1, SMALL) for _ in range(OF_EACH)]
    del blocks


@contextmanager
def loading() -> Iterator[None]:
    """What is loaded meanwhile stays: nothing is collected, and no later collection looks at what is there by then.

    Looking through it again and again is a tenth of the time that loading takes, and later
    halts the loop for as long as several frames.
    """
    gc.disable()
    try:
        yield
        gc.freeze()
    finally:
        gc.enable()
