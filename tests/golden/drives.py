"""The simulated drives of recordings/, as they were made; made again only where they must change."""

from __future__ import annotations

import lzma
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from soilbus.can.log_writer import write_log
from soilbus.simulator.frames import frames
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import Patch, Scenario, Swing
from soilbus.terra.effects.catalogue import CATALOGUE
from soilbus.terra.effects.effect import Active
from soilbus.trials.boggings import BoggingDrive, bogging

SLIP = Swing(0.05, 0.40)


def _troubles() -> Iterator[tuple[str, BoggingDrive, int]]:
    """Name, drive and seed: one soil, one effect, two soils, and ground that softens until the tractor is stuck."""
    yield "sand", BoggingDrive(Scenario(22.0, (Patch(0.0, "dry_sand"),), slip=SLIP)), 21
    ruts = Active(CATALOGUE["multipass"], {"stiffness": 0.15, "density": 0.015, "shear": 0.0, "reloading": 0.0})
    yield "ruts", BoggingDrive(Scenario(22.0, (Patch(0.0, "loam"),), slip=SLIP), (ruts,)), 22
    yield "crossing", BoggingDrive(Scenario(34.0, (Patch(0.0, "loam"), Patch(24.0, "wet_clay")), slip=SLIP)), 23
    stuck = bogging(reference_configuration(), "softening", np.random.default_rng(6))
    yield "bogging", stuck._replace(scenario=replace(stuck.scenario, duration=31.0)), 6


def drive_again(folder: Path) -> None:
    """Simulates the drives and writes their logs."""
    config = reference_configuration()
    folder.mkdir(exist_ok=True)
    with TemporaryDirectory() as elsewhere:
        log = Path(elsewhere) / "drive.log"
        for name, trouble, seed in _troubles():
            write_log(frames(simulate(config, trouble.scenario, seed, trouble.effects), config), log)
            packed = lzma.compress(log.read_bytes(), preset=9 | lzma.PRESET_EXTREME)
            (folder / f"{name}.log.xz").write_bytes(packed)
