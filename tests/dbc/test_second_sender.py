"""No reader by the rules of dbc/README.md shows GO while soilbus says otherwise, whatever a second sender does."""

import subprocess
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

import can
import cantools
import pytest
from hypothesis import given
from hypothesis import strategies as st

from soilbus.can.checksum import frame_checksum
from soilbus.report.received_frames import ReceivedFrames

DBC = Path(__file__).resolve().parents[2] / "dbc"
DATABASE = cantools.database.load_file(DBC / "soilbus.dbc", strict=True)
IDENTIFIER = DATABASE.get_message_by_name("Traversability").frame_id
CODES = {"unknown": 0, "no_go": 1, "caution": 2, "go": 3}


class Sent(NamedTuple):
    """A frame of Traversability: time [s], counter, what it says, a byte of its own."""

    t: float
    counter: int
    state: str
    age: int = 4

    @property
    def payload(self) -> bytes:
        data = bytes([0x30 | CODES[self.state], 0xA0, 0xFF, self.age, 4, 7, 0x0F | self.counter % 16 << 4])
        return data + bytes([frame_checksum(IDENTIFIER, data + b"\0", 7)])


Shown = Callable[[list[Sent]], list[tuple[float, str]]]
"""Times at which what is shown changes, and what is shown from then on; unknown before the first."""


def shown_by_python(frames: list[Sent]) -> list[tuple[float, str]]:
    now = 0.0
    known, said = ReceivedFrames(DATABASE, lambda: now), [(0.0, "unknown")]
    for frame in frames:
        now = frame.t
        known.receive(can.Message(arbitration_id=IDENTIFIER, is_extended_id=True, data=frame.payload))
        state = str(known.value("Traversability", "State"))
        said += [(now, state)] if state != said[-1][1] else []
    return said


@pytest.fixture(scope="module", params=["python", "c"])
def shown(request, verdict_reader) -> Shown:
    def by_c(frames: list[Sent]) -> list[tuple[float, str]]:
        log = "".join(f"({f.t:.6f}) can0 {IDENTIFIER:08X}#{f.payload.hex().upper()}\n" for f in frames)
        done = subprocess.run([verdict_reader], input=log, text=True, capture_output=True, check=True)
        changes = [line.split() for line in done.stdout.splitlines()[:-1]]
        return [(0.0, "unknown"), *((float(t), state) for t, state in changes)]

    return shown_by_python if request.param == "python" else by_c


def genuine(
    seconds: float, otherwise: Callable[[float], str | None], begin: float = 10.0, phase: int = 0
) -> list[Sent]:
    """Soilbus at its cycle: go, or what is said in its place at that time since the begin."""
    times = [0.1 * i for i in range(round(10 * seconds))]
    return [Sent(begin + t, phase + i, otherwise(t) or "go") for i, t in enumerate(times)]


def wrong_go(said: list[tuple[float, str]], ours: list[Sent]) -> float:
    """Seconds for which go was shown although soilbus had said otherwise for more than 0.2 s."""
    total = 0.0
    spans = zip(said, [*said[1:], (ours[-1].t, "")], strict=True)
    go = [(a, b) for (a, state), (b, _) in spans if state == "go"]
    since = None
    for frame, after in zip(ours, [*ours[1:], ours[-1]], strict=True):
        since = None if frame.state == "go" else since if since is not None else frame.t
        if since is not None:
            begin = max(frame.t, since + 0.2)
            total += sum(max(min(b, after.t) - max(a, begin), 0.0) for a, b in go)
    return total


def merged(*senders: Iterable[Sent]) -> list[Sent]:
    return sorted((frame for sender in senders for frame in sender), key=lambda frame: frame.t)


def refuses(t: float) -> str | None:
    """Unknown from 2 s on until half a second after the stranger's end, as soilbus says when it hears one."""
    return "unknown" if 2.0 <= t < 8.5 else None


def answers(ours: list[Sent]) -> list[Sent]:
    return [Sent(f.t + 0.002, f.counter + 1, "go") for f in ours if 12.0 <= f.t < 18.0]


def comes_before(ours: list[Sent]) -> list[Sent]:
    return [Sent(f.t - 0.002, f.counter, "go") for f in ours if 12.0 <= f.t < 18.0]


def ten_times(ours: list[Sent]) -> list[Sent]:
    return [Sent(12.005 + 0.01 * i, i, "go") for i in range(600)]


def sixteen_in_step(ours: list[Sent]) -> list[Sent]:
    """So many between two of ours that every counter is the next one."""
    attacked = [f for f in ours if 12.0 <= f.t < 18.0]
    return [Sent(f.t + 0.1 / 17 * (k + 1), f.counter + k + 1, "go") for f in attacked for k in range(16)]


@pytest.mark.parametrize("stranger", [answers, comes_before, ten_times, sixteen_in_step])
def test_a_spoofed_go_is_not_shown(stranger, shown):
    ours = genuine(16.0, refuses)
    said = shown(merged(ours, stranger(ours)))
    assert wrong_go(said, ours) == 0.0
    assert [t for t, state in said if state == "go" and t < 12.0] == [pytest.approx(10.5)]
    assert all(state != "go" for t, state in said if 12.0 <= t < 18.5)
    assert said[-1][1] == "go"  # again, once the stranger is gone


def test_a_second_sender_is_distrusted_for_three_seconds(shown):
    ours = genuine(10.0, lambda _: None)
    said = shown(merged(ours, [Sent(13.05, 30, "go", age=9)]))
    assert [state for _, state in said] == ["unknown", "go", "unknown", "go"]
    assert [t for t, _ in said[2:]] == [pytest.approx(13.05), pytest.approx(16.1)]


@pytest.mark.parametrize("lost", range(1, 15))
def test_a_jump_is_trusted_after_five_frames_in_a_row(lost, shown):
    ours = genuine(4.0, lambda _: None)
    heard = [f for i, f in enumerate(ours) if not 20 <= i < 20 + lost]
    said = shown(heard)
    after = ours[20 + lost].t
    assert said[-1] == (pytest.approx(after + 0.5), "go")
    assert said[-2][1] == "unknown"
    assert said[-2][0] <= after


@pytest.mark.parametrize("state", ["unknown", "no_go", "caution"])
def test_less_than_go_is_shown_at_once_and_go_again_after_five(state, shown):
    ours = genuine(4.0, lambda t: state if 1.95 <= t < 2.95 else None)
    said = shown(ours)
    assert said[-2:] == [(pytest.approx(12.0), state), (pytest.approx(13.4), "go")]


states = st.sampled_from(["go", "go", "unknown", "no_go", "caution"])
strangers = st.lists(
    st.tuples(
        st.floats(0.001, 0.2),  # since its frame before
        st.sampled_from(["next of last", "last", "own", "any"]),
        st.integers(0, 15),
        st.sampled_from(["go", "go", "go", "caution"]),
        st.integers(0, 5),
    ),
    max_size=150,
)
story = st.lists(st.tuples(states, st.integers(1, 12)), min_size=2, max_size=8)


@given(story, strangers, st.integers(0, 15))
def test_no_interleaving_with_a_stranger_shows_go_against_soilbus(shown, said_by_us, steps, phase):
    spans = ["go"] * 8 + [state for state, n in said_by_us for _ in range(n)]
    ours = genuine(len(spans) / 10.0, lambda t: spans[round(10 * t)], phase=phase)
    foreign, t = [], 10.3
    for own, (step, how, any_counter, state, age) in enumerate(steps):
        t += step
        before = max((f for f in [*ours, *foreign] if f.t < t), key=lambda f: f.t)
        counter = {"next of last": before.counter + 1, "last": before.counter, "own": own, "any": any_counter}[how]
        foreign.append(Sent(round(t, 6), counter, state, age))
    frames = merged(ours, foreign)
    assert wrong_go(shown(frames), ours) == 0.0
