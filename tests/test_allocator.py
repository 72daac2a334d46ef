"""What is free goes back to the kernel, in a process of its own: a heap with holes."""

from __future__ import annotations

import subprocess
import sys

HOLES = """
import ctypes
from soilbus.allocator import give_back_freed_memory, keep_freed_memory

def resident():
    return int(open("/proc/self/statm").read().split()[1]) * 4096

keep_freed_memory()
malloc, free = ctypes.CDLL(None).malloc, ctypes.CDLL(None).free
malloc.restype, free.argtypes = ctypes.c_void_p, [ctypes.c_void_p]
blocks = [malloc(100_000) for _ in range(400)]
for block in blocks:
    ctypes.memset(block, 1, 100_000)
for block in blocks[:399]:
    if block != blocks[200]:
        free(block)
before = resident()
give_back_freed_memory()
print(before, resident())
"""


def test_memory_that_is_free_between_blocks_in_use_is_given_back():
    done = subprocess.run([sys.executable, "-c", HOLES], capture_output=True, text=True, check=True, timeout=60.0)
    before, after = map(int, done.stdout.split())
    assert before - after > 35e6
