"""Valid windows and held intervals on drives of foreign machines: ends with 1 where a limit is missed.

    python -m tests.lab.machine_drives           four multibody drives, their first minute and a half
    python -m tests.lab.machine_drives --foreign four drives by other formulas
    python -m tests.lab.machine_drives --sensors each sensor left out in turn: more sensors make no result worse

Drives, truth and score lie beside the clone, in ../shared/dynamic and ../shared/foreign.
"""

from __future__ import annotations

import argparse
import gzip
import json
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

SHARED = Path(__file__).resolve().parents[3] / "shared"
SECONDS = 90.0
"""Length [s] of a drive's part that is replayed."""
DRIVES = ("d-base-0", "d-rough-0", "d-nocell-0", "a-straight-loam")
FOREIGN = ("plain", "sinkage", "noisy", "stale")
MEASURED = ("d-base-0", "d-rough-0")
SENSORS = ("load", "draft", "pitch", "acceleration", "yaw_rate", "motor_speed", "torque_limit")
CHANCE = 0.05
"""Share of windows [1], or relative sd [1], by which a result with all sensors may look worse: four of 80 windows."""
LEAST_VALID, LEAST_HELD, MOST_BIAS = 0.7, 0.9, 0.15
"""Share of windows that are valid, share of 95 % intervals of the largest draft that hold, its median error [1]."""


def cut(source: Path, target: Path, seconds: float) -> None:
    """Write the first part of a gzipped candump log."""
    with gzip.open(source, "rt") as lines, gzip.open(target, "wt") as out:
        first: float | None = None
        for line in lines:
            t = float(line[1 : line.index(")")])
            first = t if first is None else first
            if t - first > seconds:
                return
            out.write(line)


def scores(folder: Path, names: Sequence[str], without: str | None = None) -> list[dict[str, Any]]:
    """Return what score.py says of the first part of drives, of the machine without one of its sensors."""
    recordings, of = SHARED / "dynamic" / "recordings", folder / (without or "all")
    of.mkdir()
    for path in recordings.glob("*.dbc"):
        shutil.copy(path, of)
    for path in recordings.glob("*.toml"):
        lines = path.read_text().splitlines(keepends=True)
        kept = [line for line in lines if without is None or not re.match(rf"{without}\s*=", line)]
        (of / path.name).write_text("".join(kept))
    for name in names:
        shutil.copy(recordings / f"{name}.truth.json", of)
        cut(recordings / f"{name}.log.gz", of / f"{name}.log.gz", SECONDS)
    words = ["replay", "--recordings", str(of), "--out", str(of / "out")]
    subprocess.run([sys.executable, str(SHARED / "dynamic" / "score.py"), *words], check=True)
    return list(json.loads((of / "out" / "scores.json").read_text())["cases"])


def dynamic(folder: Path) -> list[str]:
    """Return a line for each limit that a multibody drive misses."""
    faults = []
    for case in scores(folder, DRIVES):
        name, draft = case["case"], case["md"]
        if valid_share(case) < LEAST_VALID:
            faults.append(f"{name}: {case['windows']}")
        if not draft["n"] or draft["cover"] < LEAST_HELD or abs(draft["bias"]) > MOST_BIAS:
            faults.append(f"{name}: largest draft {draft}")
        if case["wrong_go_s"]:
            faults.append(f"{name}: go for {case['wrong_go_s']} s where it is wrong")
    return faults


def valid_share(case: dict[str, Any]) -> float:
    """Return the share of valid windows of a case."""
    return float(case["windows"].get("valid", 0) / sum(case["windows"].values()))


def sensors(folder: Path) -> list[str]:
    """Return a line for each sensor without which a drive has more valid windows, or a better largest draft."""
    faults, whole = [], {case["case"]: case for case in scores(folder, MEASURED)}
    for sensor in SENSORS:
        for less in scores(folder, MEASURED, sensor):
            name, of_all, draft = less["case"], whole[less["case"]], whole[less["case"]]["md"]
            if valid_share(of_all) < valid_share(less) - CHANCE:
                faults.append(f"{name}: {of_all['windows']} with, {less['windows']} without {sensor}")
            if not less["md"]["n"]:
                continue
            if draft["sd"] > less["md"]["sd"] + CHANCE or draft["cover"] < min(less["md"]["cover"], LEAST_HELD):
                faults.append(f"{name}: largest draft {draft} with, {less['md']} without {sensor}")
    return faults


def foreign(folder: Path) -> list[str]:
    """Return a line for each limit that a drive by other formulas misses."""
    faults, score = [], [sys.executable, str(SHARED / "foreign" / "score.py"), "soil"]
    for kind in FOREIGN:
        done = subprocess.run(
            [*score, f"null-sandy_loam-{kind}-1", "--out", str(folder)], capture_output=True, text=True, check=True
        )
        print(f"{kind}: {done.stdout.strip()}", flush=True)
        found = re.match(r"(\d+) valid windows: .*held by ([\d.]+)%", done.stdout)
        if found is None or int(found[1]) < LEAST_VALID * 12 or float(found[2]) < 100.0 * LEAST_HELD:
            faults.append(f"{kind}: {done.stdout.strip()}")
    return faults


def main() -> int:
    """Run the drives and say what is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--foreign", dest="drives", action="store_const", const=foreign, default=dynamic)
    which.add_argument("--sensors", dest="drives", action="store_const", const=sensors)
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        faults = chosen.drives(Path(folder))
    for fault in faults:
        print(f"missed: {fault}")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
