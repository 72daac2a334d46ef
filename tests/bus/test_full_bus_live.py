"""`python -m tests.lab.full_bus` on a real bus: every figure is measured; those that no busy machine can spoil hold."""

from __future__ import annotations

import json
import sys
from typing import Any

import pytest


@pytest.fixture(scope="module")
def figures(vcan_run, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    out = tmp_path_factory.mktemp("bench")
    command = [sys.executable, "-m", "tests.lab.full_bus", "vcan0", "--seconds", "15", "--json", out / "bench.json"]
    done = vcan_run(command, rw=[out], timeout=180.0)
    assert done.returncode == 0, done.stdout
    return json.loads((out / "bench.json").read_text())["details"]


@pytest.mark.vcan
def test_every_figure_stands_beside_its_target(figures: dict[str, Any]) -> None:
    targets = {name: (figure["at_most"], figure["target"]) for name, figure in figures.items()}
    assert targets == {
        "bus_lost": (True, 0.0), "bus_latency_ms": (True, 50.0), "bus_processor_ratio": (True, 2.0),
        "bus_memory_mb": (True, 90.0), "bus_ready_s": (True, 1.5),
    }  # fmt: skip
    assert 0 < figures["bus_latency_ms"]["value"] <= 15e3
    assert 0 < figures["bus_ready_s"]["value"] < 60.0


@pytest.mark.vcan
def test_frames_that_do_not_come_are_those_that_the_kernel_dropped(figures: dict[str, Any]) -> None:
    """The service itself loses none; how many the kernel drops is the machine's affair, see bench."""
    lost, dropped = figures["bus_lost"]["value"], int(figures["bus_lost"]["peer"].split()[-1])
    assert lost == dropped or dropped == 250 < lost  # the frame's count ends at 250


@pytest.mark.vcan
def test_memory_and_processor_keep_their_bounds(figures: dict[str, Any]) -> None:
    assert figures["bus_memory_mb"]["met"]
    assert figures["bus_processor_ratio"]["met"], figures["bus_processor_ratio"]
