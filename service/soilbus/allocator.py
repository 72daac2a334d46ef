"""Hints to the allocators: the C library's, and Python's collector of garbage.

What glibc reads from the environment stands in systemd's unit for the service; here is what has to be called.
"""

from __future__ import annotations

import ctypes
import gc
from collections.abc import Iterator
from contextlib import contextmanager

_C = ctypes.CDLL(None)
_C.malloc.restype, _C.malloc.argtypes = ctypes.c_void_p, [ctypes.c_size_t]
_C.free.restype, _C.free.argtypes = None, [ctypes.c_void_p]


def keep_freed_memory() -> None:
    """Let glibc keep freed memory for the next evaluation, in processes that the unit's environment does not reach.

    Freeing one large block raises glibc's thresholds for mapping and trimming (dynamic mmap threshold, mallopt(3));
    it is never touched, so it costs no memory, and elsewhere this does nothing.  Without it a process that fits
    window after window gives memory back after each evaluation and faults it in again: 54 times the page
    faults and 1.3 times the processor time of `soilbus montecarlo --windows 6`, 100 times and 1.3 times those of
    `soilbus replay` for the rear-driven tractor.  Estimator and diagnosis call it.
    """
    _C.free(_C.malloc(31 * 2**20))


def give_back_freed_memory() -> None:
    """Hand what is free in glibc's heaps to the kernel (malloc_trim(3)); elsewhere this does nothing.

    What a rare hard window took lies between blocks in use and would stay with the process.  In 590 windows
    on changing ground 76 MB stay with it once a minute and 82 MB without, for 20 page faults a window.
    """
    trim = getattr(_C, "malloc_trim", None)
    if trim is not None:
        trim(0)


@contextmanager
def loading() -> Iterator[None]:
    """Exempt what is loaded meanwhile from garbage collection, now and later.

    Without it a start takes 1.1 times the processor time, and a full collection, which halts the loop, looks at
    58 000 objects in place of 300.
    """
    gc.disable()
    try:
        yield
        gc.freeze()
    finally:
        gc.enable()
