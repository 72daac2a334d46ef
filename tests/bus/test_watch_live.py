"""`soilbus watch --json` on a real bus says of each window what it says of the log that was played."""

from __future__ import annotations

import itertools
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

REPO = Path(__file__).resolve().parents[2]
WATCHING = Path(__file__).with_name("watching.py")
SECONDS = 16.0


def of_windows(lines: list[str]) -> dict[int, dict[str, Any]]:
    """The last line of each window, without stamps and counts of the listener."""
    records = [json.loads(line) for line in lines]
    return {
        record["window"]: {key: value for key, value in record.items() if key not in ("t", "text", "bad_frames")}
        for record in records
        if record["window"] is not None
    }


def test_windows_on_a_bus_are_those_of_the_log(vcan_run, tool, tmp_path: Path) -> None:
    tool("canplayer")
    log, out = tmp_path / "ours.log", tmp_path / "lines"
    with (REPO / "dbc/sample.log").open() as sample:
        begin = float(next(sample)[1:18])
    with (REPO / "dbc/sample.log").open() as sample:
        log.write_text("".join(itertools.takewhile(lambda line: float(line[1:18]) < begin + SECONDS, sample)))
    done = vcan_run([sys.executable, WATCHING, log, out], rw=[tmp_path], timeout=180.0)
    assert done.returncode == 0, done.stdout
    live = out.read_text().splitlines()
    assert json.loads(live[0])["traversability"]["state"] == "unknown"
    command = [sys.executable, "-m", "soilbus", "watch", "--json", log, "--speed", "1000"]
    played = subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()
    wanted, heard = of_windows(played), of_windows(live)
    assert len(wanted) >= 5
    last = max(wanted)  # the end of the log may be heard as a silence
    assert {n: record for n, record in heard.items() if n < last} == {n: wanted[n] for n in wanted if n < last}
