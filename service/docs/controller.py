"""A traction controller on soilbus's frames: it sets the draft so that the rear wheels slip as advised (control.md)."""

import sys
from pathlib import Path

import can
import cantools

DBC = Path(__file__).parents[2] / "dbc"
OURS, TRACTOR = (cantools.database.load_file(DBC / name) for name in ("soilbus.dbc", "tractor.dbc"))
LAYOUTS = {message.frame_id: message for message in OURS.messages}
COMMAND = TRACTOR.get_message_by_name("DriveCommand")
NO_SPEED = 65.535  # not available: the speed is the driver's
OWN_SLIP, LEAST_DRAFT, NO_LIMIT = 0.15, 300.0, 1e5  # what holds without advice; drafts in N


def crc(identifier: int, data: bytes) -> int:
    """Checksum of dbc/README.md."""
    value = 0xFF
    for byte in identifier.to_bytes(4, "little") + bytes(data[:7]):
        value ^= byte
        for _ in range(8):
            value = (value << 1 & 0xFF) ^ (0x1D if value & 0x80 else 0)
    return value ^ 0xFF


class Stream:
    """Frames of one message by the rules of dbc/README.md; times in s."""

    def __init__(self, cycle: float) -> None:
        self.cycle, self.last, self.heard, self.distrusted_until, self.row = cycle, b"", -1e9, -1e9, []

    def takes(self, now: float, data: bytes) -> bool:
        """Take a frame with a right checksum; return whether its counter has moved and no second sender sends it."""
        step = ((data[6] >> 4) - (self.last[6] >> 4)) % 16 if self.last else None
        if step == 0:
            if data != self.last:
                self.distrusted_until, self.row = now + 3.0, []
            return False
        in_a_row = step == 1 and now - self.heard <= 3.0 * self.cycle
        self.row = [*self.row, (now, data[0] & 15)][-5:] if in_a_row else []
        self.last, self.heard = data, now
        return now >= self.distrusted_until

    def is_verdict(self, now: float) -> bool:
        """Return whether the verdict to show is not unknown."""
        if not self.last or now - self.heard > 3.0 * self.cycle:
            return False
        if self.last[0] & 15 == 1:  # no_go
            return True
        is_row = len(self.row) == 5 and self.row[-1][0] - self.row[0][0] >= 2.0 * self.cycle
        return is_row and all(1 <= state <= 3 for _, state in self.row)


def follow(bus: can.BusABC) -> None:
    """Command a draft with each WheelSlip frame, for as long as frames come."""
    draft, wanted, limit, advised, counter = LEAST_DRAFT, OWN_SLIP, NO_LIMIT, -1e9, 0
    streams = {layout.name: Stream(layout.cycle_time / 1e3) for layout in OURS.messages}
    for frame in bus:
        layout, now, data = LAYOUTS.get(frame.arbitration_id), frame.timestamp, bytes(frame.data)
        if layout is None or frame.is_fd or len(data) != 8 or crc(frame.arbitration_id, data) != data[7]:
            continue
        name = layout.name
        if not streams[name].takes(now, data):
            continue
        values = layout.decode(data)
        one_sender = all(now >= stream.distrusted_until for stream in streams.values())
        is_valid = values.get("Status") == "valid" and one_sender and streams["Traversability"].is_verdict(now)
        known = {signal: value for signal, value in values.items() if isinstance(value, (int, float))}
        if name == "TractionAdvice" and is_valid and "SlipForEfficiencyRear" in known:
            wanted, advised = known["SlipForEfficiencyRear"], now
        elif name == "TractionLimits" and is_valid and {"MaxDraft", "MaxDraftStd"} <= known.keys():
            limit = max(known["MaxDraft"] - 2.0 * known["MaxDraftStd"], LEAST_DRAFT)
        elif name == "WheelSlip":
            if now - advised > 3.0:  # no valid advice for three cycles
                wanted, limit = OWN_SLIP, NO_LIMIT
            slip = max((known[wheel] for wheel in ("SlipWheel3", "SlipWheel4") if wheel in known), default=wanted)
            draft *= 1.0 + min(max(0.5 * (wanted - slip), -0.3), 0.05)
            draft = min(max(draft, LEAST_DRAFT), limit)
            command = {"Draft": draft, "Speed": NO_SPEED, "Counter": counter % 16, "Checksum": 0}
            data = COMMAND.encode(command, strict=False, padding=True)[:7]
            bus.send(can.Message(arbitration_id=COMMAND.frame_id, data=data + bytes([crc(COMMAND.frame_id, data)])))
            counter += 1


if __name__ == "__main__":
    with can.Bus(interface=sys.argv[1], channel=sys.argv[2]) as bus:
        follow(bus)
