"""The windows of one short drive with a position, and one window of which nothing is known."""

from pathlib import Path

import pytest

from soilbus.can.dbc_files import load_databases
from soilbus.can.log_writer import write_log
from soilbus.config.model import Config
from soilbus.decision.traversability import Status, Traversability
from soilbus.decision.watch import Warnings
from soilbus.offline.replay import replay
from soilbus.pipeline.pipeline import Pipeline
from soilbus.pipeline.result import WindowResult
from soilbus.simulator.course import course
from soilbus.simulator.frames import frames
from soilbus.simulator.play import scenario_over
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration


@pytest.fixture(scope="session")
def config() -> Config:
    return reference_configuration()


@pytest.fixture(scope="session")
def log(config, tmp_path_factory) -> Path:
    way = course((-17.0, 179.9999), 60.0, None)
    log = tmp_path_factory.mktemp("drive") / "drive.log"
    write_log(frames(simulate(config, scenario_over(["loam"], 14.0, way), seed=3), config), log)
    return log


@pytest.fixture(scope="session")
def windows(config, log) -> list[WindowResult]:
    results = list(replay(Pipeline(config, load_databases(config)), [log]))
    assert [str(r.status) for r in results] == ["valid"] * 4
    last = results[-1]
    nothing = WindowResult(
        last.t + 1.0, 4, Status.INVALID, "no_convergence", None, None, {"FL": None}, {}, Traversability(), None, 0, {},
        position=last.position, warnings=Warnings(since=last.t + 0.5, begun=(last.t + 0.5,)), log="drive.log",
    )  # fmt: skip
    return [*results, nothing]
