"""What the commands say of the golden recordings now, and where it is kept of old."""

from __future__ import annotations

import gzip
import json
import lzma
from collections.abc import Callable, Iterator
from contextlib import redirect_stdout
from dataclasses import dataclass
from io import BytesIO, StringIO
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit

from soilbus.can.log_writer import write_log
from soilbus.cli.main import main
from soilbus.simulator.frames import frames
from soilbus.simulator.recording import Recording
from soilbus.simulator.reference import TRACTOR
from tests.lab.blind.cases import Case, cases

from .compare import rounded

HERE = Path(__file__).parent
FIELD = Path(__file__).resolve().parents[3] / "shared/field"
CONFIGS = Path(__file__).resolve().parents[1] / "field"

FIELD_LOGS = {
    "loam": "field.toml", "clay": "field.toml", "stubble": "field.toml",
    "deere-5055e-start": "deere.toml", "deere-5055e-in-gear": "deere.toml",
}  # fmt: skip
DRIVES = ("sand", "ruts", "crossing", "bogging")
"""Names in recordings/; `drives` makes them.  They are kept so that a change of the simulator hides nothing."""
CASES = (
    "plain/rubicon_sandy_loam_43", "plain/loam", "hard/", "hard/loam",
    "single/multipass:density/medium", "single/rate_stiffening:penetration/medium", "single/soil_drift:ramp/medium",
    "single/torque_lag:averaged/medium", "single/inertia:flywheel/medium", "single/hardpan:graded/large",
    "single/rolling_radius:one_axle/medium", "single/slip_sinkage:factor/medium", "single/bulldozing:thrown/large",
    "single/tyre_deflection:power/large", "single/draft_gain:bent/medium", "single/slip_sinkage:offset/small",
    "pair/multipass:density+tyre_deflection:spring/medium", "pair/draft_gain:bent+rate_stiffening:log/large",
    "outside/outside:torque_ripple/medium", "outside/outside:tooth_error/large", "outside/outside:cross_talk/medium",
)  # fmt: skip
"""Starts of the ids of blind cases of seed 1: the first that fits."""
CHEAP = (
    "plain/loam", "single/multipass:density/medium", "single/rolling_radius:one_axle/medium",
    "single/tyre_deflection:power/large", "outside/outside:torque_ripple/medium",
)  # fmt: skip
"""Those that every run of the tests diagnoses: none takes longer than a few seconds."""
FLEETING = {"seconds"}
"""Keys that differ from run to run."""

Output = list[dict[str, Any]]


@dataclass(frozen=True)
class Source:
    """Something to be replayed or diagnosed; missing: what it needs and is not on this machine, None if nothing."""

    name: str
    make: Callable[[Path], Output]
    missing: Path | None = None

    @property
    def kept(self) -> Path:
        """Where its output is kept."""
        return HERE / "outputs" / f"{self.name}.jsonl.gz"

    def now(self, folder: Path) -> Output:
        """What is said now; `folder` is for files on the way."""
        made: Output = rounded(self.make(folder))
        return made

    def golden(self) -> Output:
        """What was said; empty where nothing is kept yet."""
        if not self.kept.exists():
            return []
        return [json.loads(line) for line in gzip.decompress(self.kept.read_bytes()).decode().splitlines()]

    def keep(self, output: Output) -> None:
        """Keeps an output; the same one gives the same bytes."""
        text = "".join(json.dumps(each, separators=(",", ":"), sort_keys=True) + "\n" for each in output)
        packed = BytesIO()
        with gzip.GzipFile("", "wb", 9, packed, mtime=0) as out:
            out.write(text.encode())
        self.kept.parent.mkdir(exist_ok=True)
        self.kept.write_bytes(packed.getvalue())


def replays() -> Iterator[Source]:
    """The recordings of field vehicles and the simulated drives."""
    for name, config in FIELD_LOGS.items():
        log = FIELD / f"{name}.log.gz"
        yield Source(f"replay-{name}", _replayed(log, CONFIGS / config), None if log.exists() else log)
    for name in DRIVES:
        yield Source(f"replay-{name}", _replayed(HERE / f"recordings/{name}.log.xz", TRACTOR))


def diagnoses(starts: tuple[str, ...] = CASES) -> Iterator[Source]:
    """The blind cases."""
    for start in starts:
        name = start.strip("/").replace("/", "-").replace(":", "-")
        yield Source(f"diagnose-{name}", _diagnosed(start))


def _replayed(log: Path, config: Path) -> Callable[[Path], Output]:
    def make(folder: Path) -> Output:
        here = log
        if log.suffix == ".xz":
            here = folder / log.stem
            here.write_bytes(lzma.decompress(log.read_bytes()))
        return _said("replay", config, here, folder)

    return make


def _diagnosed(start: str) -> Callable[[Path], Output]:
    def make(folder: Path) -> Output:
        case = the_case(start)
        config, log = folder / "case.toml", folder / "case.log"
        config.write_text(tomlkit.dumps(case.config.model_dump(mode="json", exclude_none=True, exclude={"folder"})))
        write_log(frames(case.recording, case.config), log)
        (found,) = _said("diagnose", config, log, folder)
        return [{"case": case.id, "recording": _described(case.recording), **found}]

    return make


def the_case(start: str) -> Case:
    """The first blind case of seed 1 whose id begins so."""
    return next(case for case in cases(start.partition("/")[0], 1) if case.id.startswith(start))


def _described(recording: Recording) -> dict[str, list[float]]:
    """Mean and sd of each channel: these move with the simulator, or the generator, alone."""
    return {
        name: [float(np.nanmean(column.value)), float(np.nanstd(column.value))]
        for name, column in recording.channels.items()
    }


def _said(command: str, config: Path, log: Path, folder: Path) -> Output:
    """The JSON that a command writes, without what differs from run to run."""
    out = folder / "said.json"
    with redirect_stdout(StringIO()):
        code = main([command, "--config", str(config), str(log), "--json", str(out)])
    if not out.exists():  # a replay without a window of use ends with 1, and writes all the same
        raise RuntimeError(f"soilbus {command} {log} ended with {code}")
    text = out.read_text()
    found = [json.loads(line) for line in text.splitlines()] if command == "replay" else [json.loads(text)]
    return [{key: value for key, value in each.items() if key not in FLEETING} for each in found]
