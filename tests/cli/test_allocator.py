"""What is free goes back to the kernel when asked, and stays till then; each in a process of its own."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

UNIT = Path(__file__).resolve().parents[2] / "systemd" / "soilbus@.service"


def environment(of_unit: bool) -> dict[str, str]:
    """This process's environment without settings of glibc's allocator, or with those of the unit."""
    named = re.findall(r"(MALLOC_\w+)=(\d+)", UNIT.read_text())
    found = {name: value for name, value in os.environ.items() if not name.startswith("MALLOC_")}
    return found | (dict(named) if of_unit else {})


def printed(program: str, *words: str, of_unit: bool) -> list[int]:
    """Numbers that a program prints."""
    done = subprocess.run(
        [sys.executable, "-c", program, *words],
        capture_output=True, text=True, check=True, timeout=60.0, env=environment(of_unit),
    )  # fmt: skip
    return [int(word) for word in done.stdout.split()]


HOLES = """
import ctypes
from soilbus.allocator import give_back_freed_memory

def resident():
    return int(open("/proc/self/statm").read().split()[1]) * 4096

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
    before, after = printed(HOLES, of_unit=True)
    assert before - after > 35e6


EVALUATIONS = """
import ctypes, resource, sys
from soilbus.allocator import keep_freed_memory

if "called" in sys.argv:
    keep_freed_memory()
malloc, free = ctypes.CDLL(None).malloc, ctypes.CDLL(None).free
malloc.restype, free.argtypes = ctypes.c_void_p, [ctypes.c_void_p]

def evaluated():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    blocks = [malloc(1_000_000) for _ in range(8)]
    for block in blocks:
        ctypes.memset(block, 1, 1_000_000)
    for block in blocks:
        free(block)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

first = evaluated()
print(sum(evaluated() for _ in range(5)))
"""


@pytest.mark.parametrize(
    ("words", "of_unit", "least", "most"),
    [((), True, 0, 200), (("called",), False, 0, 200), ((), False, 5000, 12_000)],
    ids=["unit", "called", "neither"],
)
def test_what_an_evaluation_has_freed_the_next_takes_without_asking_the_kernel(words, of_unit, least, most):
    (faults,) = printed(EVALUATIONS, *words, of_unit=of_unit)
    assert least <= faults <= most


THREADS_IN_TURN = """
import ctypes, resource, threading

malloc, free = ctypes.CDLL(None).malloc, ctypes.CDLL(None).free
malloc.restype, free.argtypes = ctypes.c_void_p, [ctypes.c_void_p]

def used_for_a_moment():
    blocks = [malloc(100_000) for _ in range(80)]
    for block in blocks:
        ctypes.memset(block, 1, 100_000)
    for block in blocks:
        free(block)

worker = threading.Thread(target=used_for_a_moment)
worker.start()
worker.join()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
used_for_a_moment()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.parametrize(("of_unit", "least", "most"), [(True, 0, 200), (False, 1500, 2500)])
def test_what_one_thread_has_freed_another_takes_without_asking_the_kernel(of_unit, least, most):
    (faults,) = printed(THREADS_IN_TURN, of_unit=of_unit)
    assert least <= faults <= most


THREADS = """
import sys
from soilbus.cli.main import main
main(sys.argv[1:])
from threadpoolctl import threadpool_info
print(*(pool["num_threads"] for pool in threadpool_info()))
"""


@pytest.mark.parametrize(("told", "threads"), [(None, 1), ("2", 2)])
def test_a_command_works_in_one_thread_unless_told_otherwise(told, threads, tmp_path):
    environment = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    environment |= {} if told is None else {"OMP_NUM_THREADS": told}
    (tmp_path / "empty.toml").write_text("")
    command = [sys.executable, "-c", THREADS, "check", "--config", str(tmp_path / "empty.toml")]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60.0, env=environment)
    pools = done.stdout.split()
    assert pools
    assert set(pools) == {str(min(threads, len(os.sched_getaffinity(0))))}
