"""Valid windows and held intervals on drives of foreign machines: ends with 1 where a limit is missed.

    python -m tests.lab.machine_drives           four multibody drives, their first minute and a half
    python -m tests.lab.machine_drives --foreign four drives by other formulas

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
from pathlib import Path

SHARED = Path(__file__).resolve().parents[3] / "shared"
SECONDS = 90.0
"""Length [s] of a drive's part that is replayed."""
DRIVES = ("d-base-0", "d-rough-0", "d-nocell-0", "a-straight-loam")
FOREIGN = ("plain", "sinkage", "noisy", "stale")
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


def dynamic(folder: Path) -> list[str]:
    """Return a line for each limit that a multibody drive misses."""
    recordings, faults = SHARED / "dynamic" / "recordings", []
    for path in (*recordings.glob("*.toml"), *recordings.glob("*.dbc")):
        shutil.copy(path, folder)
    for name in DRIVES:
        shutil.copy(recordings / f"{name}.truth.json", folder)
        cut(recordings / f"{name}.log.gz", folder / f"{name}.log.gz", SECONDS)
    words = ["replay", "--recordings", str(folder), "--out", str(folder / "out")]
    subprocess.run([sys.executable, str(SHARED / "dynamic" / "score.py"), *words], check=True)
    for case in json.loads((folder / "out" / "scores.json").read_text())["cases"]:
        name, windows, draft = case["case"], case["windows"], case["md"]
        if windows.get("valid", 0) < LEAST_VALID * sum(windows.values()):
            faults.append(f"{name}: {windows.get('valid', 0)} of {sum(windows.values())} windows are valid")
        if not draft["n"] or draft["cover"] < LEAST_HELD or abs(draft["bias"]) > MOST_BIAS:
            faults.append(f"{name}: largest draft {draft}")
        if case["wrong_go_s"]:
            faults.append(f"{name}: go for {case['wrong_go_s']} s where it is wrong")
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
    parser.add_argument("--foreign", action="store_true")
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        faults = (foreign if chosen.foreign else dynamic)(Path(folder))
    for fault in faults:
        print(f"missed: {fault}")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
