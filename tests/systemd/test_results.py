"""The page's unit that sends results on, started by a real systemd: lines of JSON, by a user of its own."""

from __future__ import annotations

import itertools
import json
import re
from pathlib import Path

import pytest
from installation import REPO, prepare, properties

SECONDS = 14.0


@pytest.mark.systemd
def test_results_reach_the_program_that_sends_them_on(vcan_run, tool, field_recording, tmp_path: Path) -> None:
    for name in ("canplayer", "systemctl", "systemd-sysusers"):
        tool(name)
    prepare(tmp_path, field_recording("loam.log.gz"), 1)
    page = (REPO / "systemd/README.md").read_text()
    unit = next(text for text in re.findall(r"```ini\n(.*?)```", page, re.DOTALL) if "watch --json" in text)
    (tmp_path / "soilbus-mqtt@.service").write_text(unit)
    with (REPO / "dbc/sample.log").open() as sample:
        first = next(sample)
        end = float(first[1:18]) + SECONDS
        rest = itertools.takewhile(lambda line: float(line[1:18]) < end, sample)
        (tmp_path / "frames.log").write_text(first + "".join(rest))
    done = vcan_run(
        ["sh", REPO / "tests/systemd/results.sh", tmp_path],
        rw=[tmp_path],
        units=(REPO / "systemd").glob("*.service"),
        timeout=240.0,
    )
    assert done.returncode == 0, done.stdout
    said = (tmp_path / "results").read_text()
    user, options, arguments = re.findall(r"^user: (.*); options: (.*); arguments: (.*)$", said, re.M)[0]
    assert user not in ("root", "soilbus")
    assert options == "-h 192.0.2.10"
    assert arguments == "-l -q 1 -t farm/tractor7/window"
    lines = [json.loads(line) for line in said.splitlines() if line.startswith("{")]
    windows = {line["window"]: line for line in lines if line["window"] is not None}
    assert {0, 1, 2} <= windows.keys()
    assert windows[2]["status"] == "valid"
    assert set(windows[2]["slip"]) == {"FL", "FR", "RL", "RR"}
    assert properties(tmp_path, "results") == {"NRestarts": "0", "Result": "success"}
