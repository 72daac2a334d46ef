"""How long a window's work alone takes where a full bus interrupts it: no service there can answer sooner."""

from __future__ import annotations

import time
from concurrent.futures import ProcessPoolExecutor
from functools import cache
from multiprocessing import get_context

import numpy as np
from cantools.database.can import Database
from numpy.typing import NDArray

from soilbus.allocator import keep_freed_memory
from soilbus.bench.bus_load import Traffic, others
from soilbus.can.dbc_files import load_databases
from soilbus.config import Config
from soilbus.daemon.intake import WindowTask
from soilbus.daemon.pipeline import Pipeline
from soilbus.simulator.frames import frames
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import excited

DRIVE = 40.0
PASSES = 3
PAUSE = 0.1
"""Seconds between two windows, so that each begins at another moment of the bus."""

Array = NDArray[np.float64]


def work_times(channel: str) -> tuple[Array, Array]:
    """Wall times (windows,) [s] of estimate and decision, with nothing beside and beside the bench's traffic.

    By a process of its own that hears nothing of the bus; without a run's first window, which searches for the soil.
    The channel must be there, up and quiet.
    """
    with ProcessPoolExecutor(1, get_context("spawn"), initializer=_begin) as worker:
        alone = worker.submit(_worked).result()
        traffic = Traffic(channel, float(alone.sum()) + PASSES * len(_tasks()) * PAUSE)
        with others(channel):
            traffic.start()
            beside = worker.submit(_worked).result()
            traffic.wait()
    return alone, beside


def _begin() -> None:
    keep_freed_memory()
    Pipeline(*_vehicle()).estimator.solve(_tasks()[0])  # not for the first time any more


@cache
def _vehicle() -> tuple[Config, Database]:
    config = reference_configuration()
    return config, load_databases(config)


@cache
def _tasks() -> list[WindowTask]:
    """The windows of a drive."""
    config, database = _vehicle()
    pipeline, last = Pipeline(config, database), 0.0
    for frame in frames(simulate(config, excited("loam", DRIVE), seed=1), config, database):
        last = frame.timestamp
        pipeline.feed(last, frame.arbitration_id, frame.is_extended_id, frame.data)
    return pipeline.intake.finish(last)


def _worked() -> Array:
    times = []
    for _ in range(PASSES):
        estimator = Pipeline(*_vehicle()).estimator
        for task in _tasks():
            time.sleep(PAUSE)
            begin = time.perf_counter()
            estimator.solve(task)
            if not task.fresh:
                times.append(time.perf_counter() - begin)
    return np.array(times)
