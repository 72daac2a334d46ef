"""One hint to the C library's allocator."""

from __future__ import annotations

import numpy as np


def keep_freed_memory() -> None:
    """Let glibc keep freed memory instead of giving it back after every evaluation.

    Freeing one large block raises glibc's trim threshold (dynamic mmap threshold,
    mallopt(3)).  Without it each model evaluation gives some 2 MB back to the kernel and
    faults it in again, which doubles its time.  The block is never touched, so it costs
    no memory; elsewhere this does nothing.
    """
    block = np.empty(31 * 2**20, dtype=np.uint8)
    del block
