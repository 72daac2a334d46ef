"""What the service does on a real bus that is missing, goes down, is removed, fills up, errs, babbles, is overheard.

`faults.py` does it to the bus, once; the tests read what went over it.
"""

from __future__ import annotations

import gzip
import itertools
import json
import re
import sys
from collections import defaultdict
from pathlib import Path
from typing import Any, NamedTuple

import cantools
import pytest

REPO = Path(__file__).resolve().parents[2]
CONFIG = REPO / "tests/field/field.toml"
FAULTS = Path(__file__).with_name("faults.py")
RECORDED = 20_000  # frames, 42 s
RETURN = 2.0
"""Seconds that the service may take to be back."""


class Run(NamedTuple):
    frames: dict[str, list[dict[str, Any]]]  # ours by message name, with "at" [s]
    at: dict[str, float]  # time of each step [s]
    status: list[tuple[float, str]]
    journal: list[str]

    def within(self, name: str, begin: str, end: str) -> list[dict[str, Any]]:
        return [f for f in self.frames[name] if self.at[begin] < f["at"] < self.at[end]]


@pytest.fixture(scope="module")
def run(vcan_run, tool, field_recording, tmp_path_factory: pytest.TempPathFactory) -> Run:
    tool("tc")
    out = tmp_path_factory.mktemp("faults")
    with gzip.open(field_recording("loam.log.gz"), "rt") as lines:
        (out / "played.log").write_text("".join(itertools.islice(lines, RECORDED)))
    done = vcan_run([sys.executable, FAULTS, CONFIG, out / "played.log", out], rw=[out], timeout=120.0)
    assert done.returncode == 0, done.stdout  # the service's: it lived through all of it
    return read(out)


def read(out: Path) -> Run:
    """What faults.py left."""
    names = {m.frame_id: m for m in cantools.database.load_file(REPO / "dbc/soilbus.dbc").messages}
    frames = defaultdict(list)
    for line in (out / "bus.log").read_text().splitlines():
        t, _, frame = line.split()
        name, data = frame.split("#")
        if len(name) == 8 and int(name, 16) in names and data != "3328FF0404075F5D":  # but the foreign one
            message = names[int(name, 16)]
            frames[message.name].append({"at": float(t.strip("()")), **message.decode(bytes.fromhex(data))})
    marks = json.loads((out / "marks.json").read_text())
    told = [line.split(" ", 1) for line in (out / "status.log").read_text().splitlines()]
    status = [(float(t), text) for t, text in told]
    return Run(frames, marks, status, (out / "journal").read_text().splitlines())


@pytest.mark.vcan
def test_a_missing_interface_is_waited_for_and_found(run: Run) -> None:
    waiting = {text.split(",")[0] for t, text in run.status if run.at["missing"] + 0.5 < t < run.at["comes"]}
    assert waiting == {"waiting: bus_down"}
    assert run.frames["Traversability"][0]["at"] - run.at["comes"] < RETURN


@pytest.mark.vcan
@pytest.mark.parametrize(("gone", "back", "end"), [("down", "up", "removed"), ("removed", "created", "passive")])
def test_after_an_outage_the_first_frames_say_what_holds_now(run: Run, gone: str, back: str, end: str) -> None:
    assert str(run.within("Traversability", "comes", "down")[-1]["State"]) != "unknown"  # that could be stale
    assert run.within("Traversability", gone, back) == []
    verdicts = run.within("Traversability", back, end)
    assert verdicts[0]["at"] - run.at[back] < RETURN
    first = verdicts[0]["at"]
    assert str(verdicts[0]["State"]) == "unknown"
    assert all(str(f["State"]) == "unknown" or f["Age"] <= f["at"] - run.at[back] for f in verdicts)
    assert str(next(f for f in run.within("SoilbusStatus", back, end))["State"]) != "valid"
    assert any(f["at"] - first < 1.2 for f in run.within("SoilbusStatus", back, end))
    assert {f["Reopened"] for f in run.within("BusHealth", back, end)} == {2 if back == "up" else 3}


@pytest.mark.vcan
def test_without_room_only_the_newest_frame_is_kept_and_the_others_are_counted(run: Run) -> None:
    assert run.within("Traversability", "full", "room")[5:] == []  # tc itself takes its time
    assert run.within("Traversability", "room", "down")[0]["at"] - run.at["room"] < 0.5
    health = run.within("BusHealth", "comes", "down")
    lost = 0
    for name in run.frames:
        frames = [f for f in run.frames[name] if health[0]["at"] <= f["at"] <= health[-1]["at"]]
        lost += sum((b["Counter"] - a["Counter"] - 1) % 16 for a, b in itertools.pairwise(frames))
    assert lost > 10
    assert health[-1]["Dropped"] == min(health[0]["Dropped"] + lost, 250)  # where the signal's range ends it stays
    assert any("send queue full" in line for line in run.journal)


@pytest.mark.vcan
def test_error_frames_and_bus_off_are_reported(run: Run) -> None:
    for step, end, state in (
        ("passive", "off", "error_passive"), ("off", "restarted", "bus_off"), ("restarted", "overrun", "error_active")
    ):  # fmt: skip
        assert str(run.within("BusHealth", step, end)[-1]["BusState"]) == state
    status = run.within("SoilbusStatus", "off", "restarted")[-1]
    assert (str(status["State"]), str(status["Reason"])) == ("waiting", "bus_error")
    assert run.frames["BusHealth"][-1]["ErrorFrames"] == 3


def lost_until(run: Run, step: str) -> int:
    """Received frames that the kernel dropped, as the service told it last before a step."""
    told = [re.search(r"(\d+) received frames lost", text) for t, text in run.status if t < run.at[step]]
    return int(told[-1][1]) if told[-1] else 0


@pytest.mark.vcan
def test_overruns_are_counted_by_the_kernel_to_the_frame(run: Run) -> None:
    before = run.within("BusHealth", "restarted", "overrun")[-1]
    after = run.within("BusHealth", "read", "calm")[-1]
    lost = lost_until(run, "calm") - lost_until(run, "overrun")
    assert lost > 0
    assert after["Overruns"] == min(lost_until(run, "calm"), 250)
    assert (after["Received"] - before["Received"] + lost - run.at["burst"]) % 4016 == 0


@pytest.mark.vcan
def test_a_babbling_node_does_not_stop_the_beat(run: Run) -> None:
    """As many beats as without it, on whatever machine: 4000 frames/s beside the traffic and 1000 of our input."""
    calm, loud = run.within("Traversability", "calm", "babble"), run.within("Traversability", "babble", "quiet")
    assert len(loud) / (run.at["quiet"] - run.at["babble"]) > 0.7 * len(calm) / (run.at["babble"] - run.at["calm"])


@pytest.mark.vcan
def test_a_second_sender_under_our_identifiers_is_told_of(run: Run) -> None:
    status = run.within("SoilbusStatus", "foreign", "end")
    assert (str(status[-1]["State"]), str(status[-1]["Reason"])) == ("degraded", "foreign_sender")
    assert run.within("BusHealth", "foreign", "end")[-1]["ForeignFrames"] == 2  # one of classic CAN, one of CAN FD
    told = next(f["at"] for f in status if str(f["Reason"]) == "foreign_sender")
    assert {str(f["State"]) for f in run.within("Traversability", "foreign", "end") if f["at"] > told} == {"unknown"}
    assert sum("another node sends our frame 18FF649A" in line for line in run.journal) == 1


@pytest.mark.vcan
def test_the_journal_says_each_fault_once(run: Run) -> None:
    assert len(run.journal) <= 20, run.journal
    assert not [line for line in run.journal if "Traceback" in line or not line.startswith("soilbus: ")]
