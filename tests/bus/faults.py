"""Runs where vcan is: a service on an interface that comes, goes, fills up and lies, step by step.

faults.py CONFIG RECORDING OUT     leaves in OUT: bus.log (candump's format), marks.json (time of each step),
status.log (what systemd is told), journal; exit status is the service's
"""

import contextlib
import json
import os
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path

import can

from soilbus.can.bus import ask_for_buffer

CHANNEL = "vcan7"
SOILBUS = [sys.executable, "-c", "import sys; from soilbus.cli.main import main; sys.exit(main())"]
STAMP = struct.Struct("@ll")
FRAME, FD_FRAME = struct.Struct("=IB3x8s"), struct.Struct("=IBB2x64s")
EXTENDED, ERROR = 1 << 31, 1 << 29
BEYOND = 150  # frames more than a receive buffer holds
BABBLE = 2.0


class Bus:
    """Plays a recording, over and over, on any CHANNEL; writes down what comes under our identifiers."""

    def __init__(self, recording: str, out: Path) -> None:
        self.frames = [parsed(line) for line in Path(recording).read_text().splitlines()]
        self.playing = threading.Event()
        self.playing.set()
        self.marks: dict[str, float] = {}
        self.status = ""
        self._log = (out / "bus.log").open("w")
        self._ear = socket.socket(socket.PF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        self._ear.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)
        self._ear.setsockopt(socket.SOL_SOCKET, 35, 1)  # SO_TIMESTAMPNS
        ours = struct.pack("=II", EXTENDED | 0x18FF009A, EXTENDED | 0x1FFF00FF)
        self._ear.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, ours)
        self._ear.bind(("",))  # every interface, also those to come
        for work in (self._listen, self._play):
            threading.Thread(target=work, daemon=True).start()

    def mark(self, step: str) -> None:
        self.marks[step] = time.time()

    def send(self, can_id: int, data: bytes, own: socket.socket | None = None) -> None:
        if own is None:
            with mouth() as own:
                self.send(can_id, data, own)
            return
        own.send(FRAME.pack(can_id, len(data), data))

    def until(self, word: str, limit: float = 6.0) -> None:
        """Wait for a status with this word, and for the frames that go with it; the tests see if none came."""
        end = time.monotonic() + limit
        while word not in self.status and time.monotonic() < end:
            time.sleep(0.02)
        time.sleep(0.3)

    def _listen(self) -> None:
        while True:
            with contextlib.suppress(OSError):
                raw, ancillary, _, _ = self._ear.recvmsg(16, 128)
                seconds, nanoseconds = STAMP.unpack(ancillary[0][2])
                word, length, data = FRAME.unpack(raw)
                name = f"{word & 0x1FFFFFFF:08X}" if word & EXTENDED else f"{word:03X}"
                self._log.write(
                    f"({seconds}.{nanoseconds // 1000:06d}) {CHANNEL} {name}#{data[:length].hex().upper()}\n"
                )
                self._log.flush()

    def _play(self) -> None:
        while True:
            with contextlib.suppress(OSError), mouth() as own:
                begin = time.monotonic()
                for t, can_id, data in self.frames:
                    ahead = t - self.frames[0][0] + begin - time.monotonic()
                    if ahead > 0.001:
                        time.sleep(ahead)
                    if not self.playing.is_set():
                        break
                    with contextlib.suppress(BlockingIOError):
                        self.send(can_id, data, own)
            self.playing.wait()
            time.sleep(0.02)


def mouth() -> socket.socket:
    own = socket.socket(socket.PF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    try:
        own.bind((CHANNEL,))
    except OSError:
        own.close()
        raise
    return own


def parsed(line: str) -> tuple[float, int, bytes]:
    t, _, frame = line.split()
    name, data = frame.split("#")
    return float(t.strip("()")), int(name, 16) | (EXTENDED if len(name) == 8 else 0), bytes.fromhex(data)


def ip(*words: str) -> None:
    subprocess.run(["ip", "link", *words], check=True)


def comes() -> None:
    ip("add", "dev", CHANNEL, "type", "vcan")
    ip("set", CHANNEL, "up")


def main(config: str, recording: str, out: Path) -> int:
    notify = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    notify.bind(str(out / "notify"))
    ready = threading.Event()
    bus = Bus(recording, out)
    threading.Thread(target=told, args=(notify, bus, ready, out / "status.log"), daemon=True).start()
    with (out / "journal").open("wb") as journal:
        service = subprocess.Popen(
            [*SOILBUS, "run", "--config", config, "--set", "bus.interface=socketcan", "--set", f"bus.channel={CHANNEL}",
             "--set", "estimator.window=4", "--set", "estimator.hop=0.5"],
            env={**os.environ, "NOTIFY_SOCKET": str(out / "notify")}, stderr=journal,
        )  # fmt: skip
        try:
            if not ready.wait(60.0):
                sys.exit("the service did not become ready in 60 s")
            steps(bus, service)
            (out / "marks.json").write_text(json.dumps(bus.marks))
            service.send_signal(signal.SIGTERM)
            return service.wait(15.0)
        finally:
            service.kill()
            ip("del", CHANNEL)


def steps(bus: Bus, service: "subprocess.Popen[bytes]") -> None:
    bus.mark("missing")
    time.sleep(1.5)
    comes()
    bus.mark("comes")
    bus.until("valid", 30.0)  # a window, and a verdict that lasts
    time.sleep(1.0)
    full(bus)
    bus.until("valid", 30.0)
    ip("set", CHANNEL, "down")
    bus.mark("down")
    time.sleep(0.7)
    ip("set", CHANNEL, "up")
    bus.mark("up")
    time.sleep(2.3)
    ip("del", CHANNEL)
    bus.mark("removed")
    time.sleep(0.7)
    ip("add", "dev", CHANNEL, "index", "77", "type", "vcan")
    time.sleep(1.2)  # there, but down
    ip("set", CHANNEL, "up")
    bus.mark("created")
    time.sleep(2.3)
    for step, error_class, controller, said in (
        ("passive", 0x004, 0x20, "1 error frames"), ("off", 0x040, 0, "2 error frames"),
        ("restarted", 0x100, 0, "3 error frames"),
    ):  # fmt: skip
        if step == "off":  # nothing is heard then
            bus.playing.clear()
            time.sleep(0.3)
        bus.mark(step)
        bus.send(ERROR | error_class, bytes((0, controller)) + bytes(6))
        bus.until(said)
    overrun(bus, service)
    babble(bus)
    bus.mark("foreign")
    bus.send(EXTENDED | 0x18FF649A, bytes.fromhex("3328FF0404075F5D"))  # dbc/README.md's example: go
    bus.until("foreign_sender")
    with mouth() as own:
        own.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FD_FRAMES, 1)
        own.send(FD_FRAME.pack(EXTENDED | 0x18FF649A, 8, 0, bytes(8)))
    bus.until("2 frames of another sender")
    time.sleep(0.5)
    bus.mark("end")


def full(bus: Bus) -> None:
    """Each send of anybody is ENOBUFS for a while."""
    tc = ["tc", "qdisc"]
    subprocess.run([*tc, "add", "dev", CHANNEL, "root", "pfifo", "limit", "0"], check=True)
    bus.mark("full")
    time.sleep(0.8)
    subprocess.run([*tc, "del", "dev", CHANNEL, "root"], check=True)
    bus.mark("room")
    time.sleep(1.5)


def overrun(bus: Bus, service: "subprocess.Popen[bytes]") -> None:
    """More frames of an input than the receive buffer holds, while nobody reads."""
    time.sleep(1.3)  # what came before is counted
    bus.mark("overrun")
    service.send_signal(signal.SIGSTOP)
    time.sleep(0.1)
    with mouth() as own:
        ask_for_buffer(own)
        burst = BEYOND + own.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) // 768
        for _ in range(burst):
            bus.send(*bus.frames[0][1:], own)
    service.send_signal(signal.SIGCONT)
    bus.mark("read")
    bus.marks["burst"] = burst + 1
    time.sleep(0.5)
    bus.send(*bus.frames[0][1:])  # the kernel tells of what it dropped beside the next frame
    bus.until("received frames lost")
    time.sleep(1.0)


def babble(bus: Bus) -> None:
    """Somebody who sends the highest priority and one of our inputs all the time, beside the traffic."""
    bus.playing.set()
    bus.mark("calm")
    time.sleep(BABBLE)
    bus.mark("babble")
    data = bus.frames[0][2]
    with can.Bus(interface="socketcan", channel=CHANNEL) as kernel:  # by the kernel's timers
        mapped = can.Message(arbitration_id=bus.frames[0][1] & 0x1FFFFFFF, is_extended_id=True, data=data)
        other = can.Message(arbitration_id=0, is_extended_id=False, data=data)
        tasks = [kernel.send_periodic(message, 0.01) for message in [mapped] * 10 + [other] * 40]
        time.sleep(BABBLE)
        for task in tasks:
            task.stop()
    bus.mark("quiet")
    time.sleep(0.5)


def told(notify: socket.socket, bus: Bus, ready: threading.Event, to: Path) -> None:
    """systemd's end of the notification socket."""
    with to.open("w") as log:
        while True:
            text = notify.recv(4096).decode()
            for line in text.splitlines():
                if line.startswith("STATUS="):
                    bus.status = line
                    log.write(f"{time.time():.3f} {line[7:]}\n")
                    log.flush()
            if "READY=1" in text:
                ready.set()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], sys.argv[2], Path(sys.argv[3])))
