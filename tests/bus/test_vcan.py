"""The daemon on a real bus says what `replay` of the same bus says.

The field recording is played onto vcan0 in real time by canplayer, candump writes the bus
down, cantools reads our frames there; `replay` of candump's log is the reference.
"""

from __future__ import annotations

import gzip
import itertools
import json
import math
import re
import subprocess
import sys
from collections import defaultdict
from pathlib import Path
from typing import Any, NamedTuple

import can
import cantools
import numpy as np
import pytest
from cantools.database.can import Database, Signal
from numpy.typing import NDArray

REPO = Path(__file__).resolve().parents[2]
CONFIG = REPO / "tests/field/field.toml"
LIVE = Path(__file__).with_name("live.py")
SOILBUS = [sys.executable, "-c", "import sys; from soilbus.cli.main import main; sys.exit(main())"]
SECONDS = 24.6  # the last window ends well before the service is stopped
HOP = 1.0
FIRST_WINDOW = 10.0
TRIES = 6
HELD_UP = 0.3
"""Seconds by which the player may be late: that is no service's doing."""

SI = {"": 1.0, "N": 1.0, "rad": 1.0, "kPa": 1e3, "mm": 1e-3, "deg": math.pi / 180}
SI |= {"kN/m^(n+1)": 1e3, "kN/m^(n+2)": 1e3}
STATUS = ["invalid", "not_excited", "degraded", "valid"]
PARAMETERS = {"k_c": "SoilCohesiveModulus", "k_phi": "SoilFrictionalModulus", "n": "SoilSinkageExponent"}
PARAMETERS |= {"phi": "SoilFrictionAngle", "c": "SoilCohesion", "K": "SoilShearModulus"}
# (message, signal) of a window's frames -> where `replay --json` has the value
SAME = {
    ("SoilStrength", "BearingPressure"): ("bearing_pressure", "value"),
    ("SoilStrength", "BearingPressureStd"): ("bearing_pressure", "std"),
    ("DraftCapability", "MaxDraft"): ("traversability", "max_draft", "value"),
    ("GradeCapability", "MaxGrade"): ("traversability", "max_grade", "value"),
    **{(message, "Value"): ("soil", name, "value") for name, message in PARAMETERS.items()},
    **{(message, "Std"): ("soil", name, "std") for name, message in PARAMETERS.items()},
    **{("WheelSinkage", f"SinkageWheel{i}"): ("sinkage", w) for i, w in enumerate(("FL", "FR", "RL", "RR"), 1)},
}


class Frame(NamedTuple):
    t: float
    arbitration_id: int
    data: bytes
    values: dict[str, Any]


class Run(NamedTuple):
    database: Database
    frames: dict[str, list[Frame]]  # ours, by message name
    windows: list[dict[str, Any]]  # what replay says
    played: NDArray[np.float64]  # stamps of the recording's frames
    filters: list[tuple[int, int]]  # id and mask, with the extended flag, of the service's sockets

    def reason(self, status: Frame) -> str:
        """What a SoilbusStatus frame gives as its reason."""
        choices = self.database.get_message_by_name("SoilbusStatus").get_signal_by_name("Reason").choices
        return str(choices[status.values["Reason"]])

    def ended(self) -> list[tuple[Frame, dict[str, Any]]]:
        """SoilStrength of each window of the recording, with that window of replay.

        Windows have the same numbers in both (the run is far shorter than the 251 numbers).
        """
        said = [(frame, self.windows[frame.values["Window"]]) for frame in self.frames["SoilStrength"]]
        return [(frame, window) for frame, window in said if window["t"] < self.played[-1]]


@pytest.fixture(scope="module")
def live(vcan_run, tool, field_recording, tmp_path_factory: pytest.TempPathFactory) -> Run:
    tool("candump"), tool("canplayer")
    out = tmp_path_factory.mktemp("live")
    _first(field_recording("loam.log.gz"), SECONDS, out / "played.log")
    return _played(vcan_run, out)


def _played(vcan_run, out: Path) -> Run:
    """out/played.log played to the service, and what replay makes of the same bus.

    Where the player itself was held up, or the service says that this machine is too slow for it, it is played
    again: what was played is another drive, and what was solved too late is degraded, as it should be.
    """
    meant = np.array([frame.timestamp for frame in can.LogReader(out / "played.log")])
    for _ in range(TRIES):
        done = vcan_run([sys.executable, LIVE, CONFIG, out / "played.log", out], rw=[out], timeout=180.0)
        assert done.returncode == 0, done.stdout
        run = _heard(out)
        assert len(run.played) == len(meant)
        held_up = np.max(run.played - run.played[0] - (meant - meant[0]))
        solved = max(frame.t - window["t"] for frame, window in run.ended())
        overloaded = any(run.reason(frame) == "overload" for frame in run.frames["SoilbusStatus"])
        if held_up < HELD_UP and solved < HOP and not overloaded:
            return run
    slow = f"the player was held up by {held_up:.1f} s, a window sent {solved:.1f} s after its end, {overloaded=}"
    raise AssertionError(f"{slow}, and the machine was too slow in each of {TRIES} runs")


def _heard(out: Path) -> Run:
    """What live.py left in out, and what replay makes of it."""
    subprocess.run(
        [*SOILBUS, "replay", "--config", CONFIG, out / "bus.log", "--json", out / "replay.jsonl"], check=True
    )
    database = cantools.database.load_file(REPO / "dbc/soilbus.dbc")
    frames = defaultdict(list)
    names = {message.frame_id: message.name for message in database.messages}
    played = []
    for frame in can.LogReader(out / "bus.log"):
        if name := frame.is_extended_id and names.get(frame.arbitration_id):
            values = database.decode_message(name, bytes(frame.data), decode_choices=False)
            frames[name].append(Frame(frame.timestamp, frame.arbitration_id, bytes(frame.data), values))
        else:
            played.append(frame.timestamp)
    windows = [json.loads(line) for line in (out / "replay.jsonl").read_text().splitlines()]
    # the last frame that is not ours is live.py's
    return Run(database, frames, windows, np.array(played[:-1]), _filters((out / "filters").read_text()))


def _first(recording: Path, seconds: float, to: Path) -> None:
    with gzip.open(recording, "rt") as lines:
        first = next(lines)
        end = float(first[1 : first.index(")")]) + seconds
        rest = itertools.takewhile(lambda line: float(line[1 : line.index(")")]) < end, lines)
        to.write_text(first + "".join(rest))


def _filters(lists: str) -> list[tuple[int, int]]:
    """The kernel's receive lists of vcan0, without candump's one entry for everything."""
    found = re.findall(r"^ +vcan0 +([0-9a-f]+) +([0-9a-f]+) ", lists, re.MULTILINE | re.IGNORECASE)
    pairs = [(int(i, 16), int(mask, 16)) for i, mask in found]
    pairs.remove((0, 0))
    return pairs


@pytest.mark.vcan
def test_the_kernel_passes_mapped_frames_and_our_identifiers_only(live: Run) -> None:
    def passes(i: int) -> bool:
        return any(i & mask == wanted & mask for wanted, mask in live.filters)

    extended = 1 << 31
    ours = [extended | message.frame_id for message in live.database.messages]  # of a second sender
    mapped = [*ours, 0x510, 0x520, 0x530, 0x540, 0x550, *(extended | i for i in (0x18FF2210, 0x18FF2213, 0x18FE4997))]
    assert [hex(i) for i in mapped if not passes(i)] == []
    beside = [i + 0x100 for i in ours[-1:]] + [i ^ 1 for i in ours] + [i & 0x7FF for i in ours]
    assert [hex(i) for i in (0x123, 0x7FF, extended | 0x18FF2214, extended | 0x18FEF197, *beside) if passes(i)] == []


@pytest.mark.vcan
def test_windows_carry_the_numbers_of_replay(live: Run) -> None:
    ended = live.ended()
    assert [w["t"] for _, w in ended] == [w["t"] for w in live.windows if w["t"] < live.played[-1]]
    assert len(ended) >= (SECONDS - FIRST_WINDOW) / HOP - 1
    assert sum(window["status"] == "valid" for _, window in ended) >= 10
    wrong = []
    for soil, window in ended:
        assert STATUS[soil.values["Status"]] == window["status"]
        for (message, signal), path in SAME.items():
            frame = _sibling(live, message, soil)
            told = _told(window, path)
            if not _same(live.database.get_message_by_name(message).get_signal_by_name(signal), frame, told):
                wrong.append((window["t"], message, signal, frame.values[signal], told))
    assert wrong == []


@pytest.mark.vcan
def test_each_window_is_sent_within_its_hop(live: Run) -> None:
    late = [frame.t - window["t"] for frame, window in live.ended()]
    assert min(late) >= 0.0
    assert max(late) < HOP, late


@pytest.mark.vcan
def test_traversability_carries_the_verdict_of_replay(live: Run) -> None:
    states = ["unknown", "no_go", "caution", "go"]
    verdict = live.database.get_message_by_name("Traversability")
    assert {c: str(t) for c, t in verdict.get_signal_by_name("State").choices.items() if c < 4} == dict(
        enumerate(states)
    )
    for soil, window in live.ended():
        told = window["traversability"]
        frame = _sibling(live, "Traversability", soil)
        assert states[frame.values["State"]] == told["state"]
        assert _same(verdict.get_signal_by_name("Probability"), frame, told["probability"])


@pytest.mark.vcan
def test_frames_keep_their_cycle(live: Run) -> None:
    for name in ("WheelSlip", "Traversability", "SoilbusStatus"):
        cycle = live.database.get_message_by_name(name).cycle_time / 1000
        frames = live.frames[name]
        duration = frames[-1].t - frames[0].t
        assert duration > SECONDS - 1
        assert len(frames) == pytest.approx(duration / cycle, rel=0.05, abs=2)


def _sibling(live: Run, message: str, soil: Frame) -> Frame:
    """The first frame of that name that carries the same window number, within the same hop."""
    same = (f for f in live.frames[message] if soil.t - HOP / 2 < f.t < soil.t + HOP)
    return next(f for f in same if f.values["Window"] == soil.values["Window"])


def _told(window: dict[str, Any], path: tuple[str, ...]) -> float | None:
    here: Any = window
    for key in path:
        here = None if here is None else here.get(key)
    return here


def _same(signal: Signal, frame: Frame, told: float | None) -> bool:
    """Equal within the signal's resolution; a value it cannot carry is one of its codes above the maximum."""
    got, factor = frame.values[signal.name], SI[signal.unit or ""]
    if told is None or not signal.minimum <= told / factor <= signal.maximum:
        return got >= signal.maximum
    return abs(got - told / factor) <= signal.scale
