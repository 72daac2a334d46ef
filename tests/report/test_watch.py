"""`soilbus watch` on a terminal, in a pipe, of a bus that goes away and of a recording."""

import errno
import fcntl
import io
import itertools
import os
import pty
import re
import select
import struct
import subprocess
import sys
import termios
import time
from pathlib import Path
from types import SimpleNamespace

import can
import pytest
from rich.console import Console

from fakes import FakeClock, ScriptedBus, sent_by
from soilbus.can.bus import BusError, LiveBus
from soilbus.can.candump import frame_of
from soilbus.can.dbc_files import filters_of, output_database
from soilbus.can.log_writer import write_log
from soilbus.can.publish import Publisher
from soilbus.cli.main import main
from soilbus.offline.played_bus import PlayedBus, PlayedClock
from soilbus.report.dashboard import Dashboard
from soilbus.report.received_frames import ReceivedFrames
from soilbus.report.watch import show
from soilbus.simulator.reference import reference_configuration

DATABASE = output_database(reference_configuration())
BEGIN = 1.7e9


def sent(seconds: float, state="go", publisher: Publisher | None = None) -> list[can.Message]:
    """Frames of some seconds of a service that says the same all the time, or goes on from what it sent before."""
    publisher, found = publisher or Publisher(DATABASE), []
    for i in range(round(10 * seconds)):
        values = {
            "Traversability": {"State": state, "Probability": 0.99, "Age": 0.5, "SinceValid": 0.5, "Window": 1},
            "WheelSlip": {f"SlipWheel{k}": 0.1 + 0.001 * (i % 40) for k in range(1, 5)},
            "DemandForecast": {"Warning": "none"},
            "PresentDemand": {"Draft": 3000.0, "Slope": 0.0},
        }
        if i % 10 == 0:
            values["SoilbusStatus"] = {"State": "valid", "Reason": "none", "Window": 1}
        found += sent_by(publisher, values, BEGIN + 0.1 * i)
    return found


def played(messages: list[can.Message], clock: PlayedClock) -> PlayedBus:
    """The recording of these messages, played by a clock."""
    return PlayedBus(map(frame_of, messages), filters_of(DATABASE), clock)


def lines_of(source, clock, done, plain=False, **console) -> list[tuple[float, str]]:
    """What `show` prints where there is no terminal, or none to draw on, with the time of each line."""

    class Paper(io.StringIO):
        def write(self, text: str) -> int:
            said.extend((clock.now - begin, line) for line in text.splitlines() if line.strip())
            return len(text)

    said: list[tuple[float, str]] = []
    begin = clock.now
    dashboard = Dashboard(ReceivedFrames(DATABASE, clock))
    show(dashboard, source, Console(file=Paper(), width=40, **console), plain, done, clock)
    return said


def test_a_recording_is_played_in_its_own_time_or_faster(monkeypatch):
    for speed in (1.0, 4.0):
        real = FakeClock()
        monkeypatch.setattr("soilbus.offline.played_bus.time", SimpleNamespace(monotonic=real, sleep=real.sleep))
        messages, begin = sent(3.0), real.now
        log = played(messages, PlayedClock(speed))
        taken = []
        while not log.is_empty:
            message = log.receive(0.05)
            if message is not None:
                taken.append((real.now - begin, message.timestamp - BEGIN))
        assert len(taken) == len(messages)
        assert [at for at, _ in taken] == pytest.approx([stamp / speed for _, stamp in taken], abs=1e-5)


def test_a_stamp_that_goes_back_holds_nothing_up():
    clock = FakeClock()
    early, late = sent(0.2)[0], sent(0.2)[-1]
    log = played([late, early], clock)
    assert [log.receive(1.0).timestamp for _ in range(2)] == [late.timestamp, early.timestamp]
    assert log.is_empty


def test_a_clock_that_was_set_while_recording_holds_nothing_up():
    """By NTP an hour after the start, and back again."""
    clock = FakeClock()
    messages, begin = sent(1.0) + sent(1.0) + sent(1.0), clock.now
    third = len(messages) // 3
    for message in messages[third : 2 * third]:
        message.timestamp += 1.7e9
    log = played(messages, clock)
    taken = [log.receive(100.0).timestamp for _ in messages]
    assert taken == [message.timestamp for message in messages]
    assert clock.now - begin < 3.0 + 60.0


def test_the_end_of_a_recording_ends_it_and_its_silences_are_silences():
    clock = FakeClock()
    late = sent(2.0)
    for message in late:
        message.timestamp += 20.0
    source = played(sent(5.0) + late, clock)
    said = lines_of(source, clock, lambda: source.is_empty)
    assert clock.now - 1000.0 == pytest.approx(21.9, abs=0.3)
    assert said[0][1].startswith("UNKNOWN: waiting for 5 frames in a row")
    assert [text[:3] for t, text in said[1:] if t < 5.0] == ["GO,"] * 5
    assert re.match("UNKNOWN: soilbus is gone, for 7 s", next(text for t, text in said if t > 11.9))
    assert said[-1][1].startswith("GO, p = 0.99. Keep going. Slip ")


def test_lines_come_once_a_second_and_at_once_when_the_state_changes():
    clock, publisher = FakeClock(), Publisher(DATABASE)
    good, worse = sent(3.5, "go", publisher), sent(3.0, "no_go", publisher)
    for message in worse:
        message.timestamp += 3.5
    wire = ScriptedBus(clock, good + worse, BEGIN)
    bus = LiveBus(lambda: wire, clock, clock.sleep)
    bus.open()
    said = lines_of(bus, clock, lambda: clock.now > 1006.4)
    said = said[1:]  # the first one waits for frames in a row
    times = [t for t, _ in said]
    turned = next(t for t, text in said if text.startswith("NO-GO"))
    assert turned == pytest.approx(3.5, abs=0.25)
    assert all(b - a >= 0.99 for a, b in itertools.pairwise(times) if b != turned)
    assert 6 <= len(said) <= 8
    for _, text in said:
        assert "\x1b" not in text
        assert re.search(r"Slip 1\d % at wheel \d\. Draft 3\.0 kN\. Data 0\.5 s old, valid 0\.5 s ago\.$", text)


@pytest.mark.parametrize(("plain", "kind"), [(True, "xterm-256color"), (False, "dumb")])
def test_lines_come_on_a_terminal_too_where_they_are_asked_for_or_nothing_else_is_possible(plain, kind):
    clock = FakeClock()
    source = played(sent(4.0), clock)
    terminal = {"force_terminal": True, "_environ": {"TERM": kind}}
    said = lines_of(source, clock, lambda: source.is_empty, plain, **terminal)
    assert 3 <= len(said) <= 5
    assert "\x1b" not in "".join(text for _, text in said)


def test_a_bus_that_goes_is_said_and_waited_for():
    clock = FakeClock()
    wire = ScriptedBus(clock, sent(4.0), BEGIN)
    wire.fail_receive.append(can.CanOperationError("Network is down", errno.ENETDOWN))
    tries = []

    def opened():
        tries.append(clock.now)
        if 1 < len(tries) < 6:
            raise BusError("bus socketcan:can0: Network is down", may_come=True)
        return wire

    bus = LiveBus(opened, clock, clock.sleep)
    bus.open()
    said = lines_of(bus, clock, lambda: clock.now > 1003.9)
    assert len(tries) == 6
    assert said[0][1].startswith("UNKNOWN: no frame of soilbus yet")
    assert said[0][1].endswith("Bus away: bus socketcan:can0: Network is down.")
    assert said[-1][1].startswith("GO")
    assert "away" not in said[-1][1]


class Terminal:
    """A terminal of a given size with `soilbus watch` on it."""

    def __init__(self, *arguments: str, columns: int = 80, rows: int = 24) -> None:
        self.near, far = pty.openpty()
        fcntl.ioctl(far, termios.TIOCSWINSZ, struct.pack("HHHH", rows, columns, 0, 0))
        self.usual = termios.tcgetattr(far)
        self.far = far
        self.process = subprocess.Popen(
            [sys.executable, "-m", "soilbus", "watch", *arguments],
            stdin=far, stdout=far, stderr=far, start_new_session=True,
            preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),
            env={**os.environ, "TERM": "xterm-256color"},
        )  # fmt: skip
        self.seen = ""

    def until(self, words: str) -> str:
        """What came up to these words."""
        end = time.monotonic() + 20.0
        while words not in self.seen and time.monotonic() < end:
            if select.select([self.near], [], [], 0.1)[0]:
                self.seen += os.read(self.near, 65536).decode("utf-8", "replace")
        assert words in self.seen, self.seen[-2000:]
        before, self.seen = self.seen, ""
        return before

    def press(self, key: str) -> None:
        os.write(self.near, key.encode())

    def quit(self) -> None:
        self.press("q")
        assert self.process.wait(timeout=20.0) == 0
        self.left = termios.tcgetattr(self.far)
        os.close(self.near)
        os.close(self.far)


def test_keys_turn_pages_and_leave_the_terminal_as_it_was(tmp_path: Path):
    log = tmp_path / "ours.log"
    write_log(sent(60.0), log)
    terminal = Terminal(str(log))
    assert "gap" not in terminal.until("DRAFT")
    terminal.press("e")
    terminal.until("gap (chi-square)")
    terminal.press("\t")
    terminal.until("DRAFT")
    terminal.press("x")
    terminal.quit()
    assert terminal.left == terminal.usual


def test_the_last_page_of_a_recording_stands_until_a_key_ends_it(tmp_path: Path):
    log = tmp_path / "ours.log"
    write_log(sent(3.0), log)
    terminal = Terminal(str(log), "--speed", "10")
    terminal.until("end of the recording")
    time.sleep(1.0)  # 10 s of the recording: frames would be stale
    terminal.press("e")
    assert "GO, p = 0.99" in terminal.until("gap (chi-square)")
    terminal.quit()


def test_a_recording_in_a_pipe_is_lines_that_name_the_configured_wheels(tmp_path: Path, capfd):
    log = tmp_path / "ours.asc"
    write_log(sent(20.0), log)
    assert main(["watch", str(log), "--speed", "50", "--config", "tractor"]) == 0
    said, faults = capfd.readouterr()
    assert faults == ""
    assert re.search(r"^GO, p = 0\.99\. Keep going\. Slip 1\d % at wheel FL\.", said, re.M)
    assert "\x1b" not in said


def test_a_recording_without_a_frame_of_ours_is_said_in_one_line(tmp_path: Path, capfd):
    log = tmp_path / "foreign.log"
    write_log([can.Message(timestamp=1.0, arbitration_id=0x123, is_extended_id=False, data=b"1")], log)
    assert main(["watch", str(log)]) == 1
    said, faults = capfd.readouterr()
    assert (said, faults.count("\n")) == ("", 1)
    assert "no frame of soilbus in it" in faults
