"""`soilbus bench`: every performance figure beside its peer, both measured in one run.

    speed-up = time of the peer / our time

Times are the least of several rounds, taken in turn, so that a busy machine slows both alike.
"""

from __future__ import annotations

import platform
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from soilbus.can.dbc_files import load_databases
from soilbus.can.log_writer import write_log
from soilbus.report.progress import phases
from soilbus.report.table import table
from soilbus.simulator.frames import frames
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import excited
from soilbus.trials.bench import growth, on_log, paper, window
from soilbus.trials.bench.figure import Figure

RECORDING_TIME = 120.0
"""Length of the simulated log [s]."""
THREADS = 1
"""Threads of linear algebra, as in the service's unit: two would wait for each other, and both would be counted."""

Measurement = Callable[[Path], Mapping[str, Figure]]
"""Figures by name, from a recorded log that they may use."""

MEASUREMENTS: tuple[Measurement, ...] = (
    lambda log: {"decode_speedup": on_log.decode_speedup(log)},
    lambda log: on_log.replay_factors(log, RECORDING_TIME),
    lambda _: {"paper_solve_speedup": paper.paper_solve_speedup()},
    lambda _: {"window_solve_speedup": window.window_solve_speedup()},
    on_log.window_times,
    lambda _: growth.exponents(),
)


def run_bench() -> dict[str, Any]:
    """Return the value of every figure by its name, beside "details" of each and the "machine".

    ModuleNotFoundError where threadpoolctl is not installed; AssertionError where ours and a peer come to different
    results.
    """
    try:
        from threadpoolctl import threadpool_limits
    except ModuleNotFoundError:
        raise ModuleNotFoundError("the bench needs the extra soilbus[peers]") from None
    with threadpool_limits(THREADS):
        return as_results(_figures())


def _figures() -> dict[str, Figure]:
    """All of them, one after the other."""
    config = reference_configuration()
    figures: dict[str, Figure] = {}
    with TemporaryDirectory() as folder:
        log = Path(folder) / "bench.log"
        recording = simulate(config, excited("loam", RECORDING_TIME), seed=1)
        write_log(frames(recording, config, load_databases(config)), log)
        with phases("bench") as say:
            for i, measure in enumerate(MEASUREMENTS, 1):
                if say is not None:
                    say(f"{i} of {len(MEASUREMENTS)}")
                figures |= measure(log)
    return figures


def as_results(figures: Mapping[str, Figure]) -> dict[str, Any]:
    """Return the value by figure's name, beside "details" of each and the "machine"."""
    details = {name: asdict(figure) | {"met": figure.met} for name, figure in figures.items()}
    machine = {"python": platform.python_version(), "numpy": np.__version__, "machine": platform.machine()}
    return {name: figure.value for name, figure in figures.items()} | {"details": details, "machine": machine}


def bench_report(results: Mapping[str, Any]) -> str:
    """Return what run_bench() measured as a table, beside targets and peers."""
    details = {name: {k: v for k, v in of.items() if k != "met"} for name, of in results["details"].items()}
    figures = {name: Figure(**detail) for name, detail in details.items()}
    rows = [(name, f"{f.value:.{f.digits}f}", f.aim, f.peer, f.what) for name, f in figures.items()]
    extra = [line for f in figures.values() for line in ("", *f.more) if f.more]
    return table(("figure", "value", "target", "beside", "what"), rows) + "".join(f"{line}\n" for line in extra)
