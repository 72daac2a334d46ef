"""Which frames count: all of a frame or nothing, each refusal with a reason and a counter.

`feed` only files a frame under its message; all else happens in `take` on whole columns, once a hop.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from cantools.database.can import Database, Message

from soilbus.arrays import Array
from soilbus.can.channels import Channel, Column, Decoded, Reason
from soilbus.can.decode import SignalColumn
from soilbus.can.inbox import CHECKS, Batch, Data, Frame, Inbox
from soilbus.can.j1939 import STANDARD_PGNS, group_mask, pgn_of, source_of
from soilbus.can.validity import REASONS, CodeRule, in_si, judge_codes, judge_validity
from soilbus.grouping import grouped

OUT_OF_ORDER = 0.1  # seconds by which a frame may be stamped before an earlier one: drivers hand them over in bunches
CLOCK_STEP = 1.0  # the same, above which the clock was set and the new time is believed
LONGEST_GAP = 60.0  # seconds without a mapped frame after which a new recording begins: the bus slept, a clock was set
LAST_TIME = 1e10  # stamps [s] beyond it, either way, are no times: a clock that ticks in seconds would not move
MAX_LISTED_UNKNOWN = 1024
WRONG_CHECKSUMS = 0.05  # share of a message's frames from which wrong checksums are said; a good bus has none
SPAN = 10.0  # time [s] over which a service counts them: a default window

_EXTENDED = 1 << 31
_FOLLOWS = LONGEST_GAP + OUT_OF_ORDER

MEANING = {
    Reason.BAD_CHECKSUM: "wrong Checksum: a second sender or a bad connection; where nearly all are wrong, another"
    " maker's checksum (dbc.checked, dbc/README.md)",
    Reason.SECOND_SENDER: "the Counter does not go on by one: a second sender, or most frames are lost",
}
"""Why a message cannot be trusted, in words of a vehicle engineer."""


@dataclass(slots=True)
class Counts:
    """Frames since the start: by message name, by (message name, reason), by identifier.

    `unknown_ids` lists the first MAX_LISTED_UNKNOWN, extended ones with bit 31; `unknown` counts all.
    """

    received: Counter[str] = field(default_factory=Counter)
    admitted: Counter[str] = field(default_factory=Counter)
    refused: Counter[tuple[str, Reason]] = field(default_factory=Counter)
    unknown: int = 0
    unknown_ids: Counter[int] = field(default_factory=Counter)
    error_frames: int = 0
    elsewhere: int = 0  # frames of other channels of a log
    clock_steps: int = 0
    senders: dict[str, set[int]] = field(default_factory=dict)
    """Source addresses of a message by its name, where several sent it and none of them is the DBC's."""

    def unknown_of_group(self, arbitration_id: int) -> list[int]:
        """Return the unknown identifiers of the same parameter group as a 29-bit one, smallest first."""
        unknown = (key & ~_EXTENDED for key in self.unknown_ids if key & _EXTENDED)
        return sorted(identifier for identifier in unknown if pgn_of(identifier) == pgn_of(arbitration_id))


def doubts(received: Counter[str], refused: Counter[tuple[str, Reason]]) -> dict[str, str]:
    """Return a line for each message with a second sender or with many wrong checksums, by message and reason."""
    lines = {}
    for (name, reason), n in sorted(refused.items()):
        share = n / max(received[name], n)
        if n and (reason is Reason.SECOND_SENDER or (reason is Reason.BAD_CHECKSUM and share >= WRONG_CHECKSUMS)):
            said = f"{share:.0%} of {received[name]} frames of {name} are refused"
            lines[f"{name} {reason}"] = f"{said}: {MEANING[reason]}"
    return lines


class RecentDoubts:
    """The doubts of the last SPAN seconds of counts that go on."""

    def __init__(self, counts: Counts) -> None:
        self._counts = counts
        self._before: deque[tuple[float, Counter[str], Counter[tuple[str, Reason]]]] = deque()

    def at(self, now: float) -> dict[str, str]:
        """Return the lines of `doubts` at `now` [s], which does not go back; call it about once a second."""
        received, refused = self._counts.received.copy(), self._counts.refused.copy()
        self._before.append((now, received, refused))
        while self._before[0][0] < now - SPAN:
            self._before.popleft()
        _, received_before, refused_before = self._before[0]
        return doubts(received - received_before, refused - refused_before)


class Admission:
    """Collects frames and hands out the admitted samples of `channels`, whose messages `database` describes.

    `checked` names the messages whose Counter and Checksum (see `can.checksum`) must be right.  A message of a standard
    parameter group (`j1939.STANDARD_PGNS`) is heard from any source and priority, one source at a time, unless the
    database has several messages of that group.

    `at_break` is called before a frame is filed that does not follow the ones before it: its clock was set back, then
    what is not taken is refused, or there was none for LONGEST_GAP.

    Raises ValueError when two messages share an identifier or a checked one cannot be checked, or as `ColumnDecoder`
    does; KeyError for a message or signal that is not in the database.
    """

    def __init__(self, channels: Iterable[Channel], database: Database, checked: Collection[str] = ()) -> None:
        self.counts = Counts()
        self._inboxes: list[Inbox] = []
        self._by_key: dict[int, Inbox] = {}
        self._groups: dict[int, Inbox] = {}
        self.at_break: Callable[[], None] = lambda: None
        self._earliest = math.inf  # an earlier stamp is out of order; inf: there is none yet
        self._untimed: Counter[Reason] = Counter()
        for name, members in grouped(channels, lambda channel: channel.message).items():
            message = database.get_message_by_name(name)
            is_open = hears_any_source(message, database)
            inbox = Inbox(message, members, is_open, name in checked)
            key = message.frame_id | _EXTENDED if message.is_extended_frame else message.frame_id
            if key in self._by_key:
                raise ValueError(f"{name}: another mapped message has the identifier {message.frame_id:#x} too")
            self._by_key[key] = inbox
            if is_open:
                self._groups[pgn_of(message.frame_id)] = inbox
            self._inboxes.append(inbox)

    def feed(self, t: float, arbitration_id: int, extended: bool, data: Data, remote: bool = False) -> None:
        """File one data or remote frame received at t [s]; `data` is kept, not copied."""
        key = arbitration_id | _EXTENDED if extended else arbitration_id
        inbox = self._by_key.get(key)
        if inbox is None:
            inbox = self._groups.get(pgn_of(arbitration_id)) if extended else None
            if inbox is None:
                self.counts.unknown += 1
                if key in self.counts.unknown_ids or len(self.counts.unknown_ids) < MAX_LISTED_UNKNOWN:
                    self.counts.unknown_ids[key] += 1
                return
            self._by_key[key] = inbox
        if not 0.0 <= t - self._earliest <= _FOLLOWS and not self._is_time(inbox, t):
            return
        if t - OUT_OF_ORDER > self._earliest:
            self._earliest = t - OUT_OF_ORDER
        if remote:
            self._refuse_unheard(inbox, Reason.REMOTE_FRAME)
        else:
            inbox.frames.append((t, arbitration_id, data))

    def take(self, until: float = math.inf) -> Decoded:
        """Return the samples of all frames filed so far with t < until [s]; later frames stay.

        Every channel has a column, perhaps empty, whose times do not decrease.  A refused frame counts as a refused
        sample of each of its channels; those of another source, of remote frames and without a time are in `untimed`.
        """
        out = Decoded(untimed=self._untimed)
        self._untimed = Counter()
        for inbox in self._inboxes:
            frames, inbox.frames = inbox.frames, [f for f in inbox.frames if f[0] >= until and until < math.inf]
            self._open(inbox, [f for f in frames if not f[0] >= until] if inbox.frames else frames, out)
        return out

    @property
    def newest(self) -> float:
        """The latest stamp [s] that is believed; minus infinity before the first."""
        return self._earliest + OUT_OF_ORDER if math.isfinite(self._earliest) else -math.inf

    @property
    def missed(self) -> int | None:
        """Frames that the counters of checked messages skip; None where no message is checked."""
        checked = [inbox.missed for inbox in self._inboxes if inbox.checksum_byte is not None]
        return sum(checked) if checked else None

    def cut_short(self, arbitration_id: int, extended: bool, data: Data) -> Message | None:
        """Return the mapped message of a frame that is shorter than the DBC says, unlike others of it."""
        inbox = self._by_key.get(arbitration_id | _EXTENDED if extended else arbitration_id)
        if inbox is None or len(data) >= inbox.message.length or not self.counts.admitted[inbox.message.name]:
            return None
        return inbox.message

    def can_filters(self) -> list[dict[str, Any]]:
        """Return the filters for python-can that pass exactly the frames of the mapped messages."""
        filters: list[dict[str, Any]] = []
        for inbox in self._inboxes:
            number, extended = inbox.message.frame_id, inbox.message.is_extended_frame
            whole = 0x1FFFFFFF if extended else 0x7FF
            mask = whole if inbox.lock is None else group_mask(number)
            filters.append({"can_id": number & mask, "can_mask": mask, "extended": extended})
        return filters

    def _is_time(self, inbox: Inbox, t: float) -> bool:
        """Whether a stamp that does not follow the last ones is of a clock that was set; else its frame is refused."""
        if t < -LAST_TIME or t > LAST_TIME:
            self._refuse_unheard(inbox, Reason.BAD_TIME)
            return False
        if self._earliest == math.inf:
            self._earliest = -math.inf
        elif t < self._earliest + OUT_OF_ORDER - CLOCK_STEP:
            self.at_break()
            self.counts.clock_steps += 1
            self._earliest = -math.inf
            for other in self._inboxes:  # what nobody took of the old time has no place in the new one
                for _ in range(len(other.frames) + len(other.late)):
                    self._refuse_unheard(other, Reason.TIME_BACKWARDS)
                other.forget()
        elif t < self._earliest:
            inbox.late.append(t)
            return False
        elif t - self._earliest > _FOLLOWS:
            self.at_break()
        return True

    def _open(self, inbox: Inbox, frames: list[Frame], out: Decoded) -> None:
        self.counts.received[inbox.message.name] += len(frames) + len(inbox.late)
        batch = self._checked_batch(inbox, frames, out) if frames else None
        if inbox.late:
            self._refuse(inbox, np.array(inbox.late), Reason.TIME_BACKWARDS, out)
            inbox.late = []
        if batch is None:
            out.columns |= {channel.name: Column(np.empty(0), np.empty(0)) for channel in inbox.channels}
            return
        self.counts.admitted[inbox.message.name] += len(batch.t)
        columns = batch.columns(inbox.decoder)
        for channel, rule in zip(inbox.channels, inbox.rules, strict=True):
            _judge(channel, rule, inbox.message, batch.t, columns, out)

    def _checked_batch(self, inbox: Inbox, frames: list[Frame], out: Decoded) -> Batch | None:
        """The frames that pass every frame-level check; None when there are none."""
        length = inbox.message.length
        good = [f for f in frames if len(f[2]) == length]
        if wrong := [f[0] for f in frames if len(f[2]) != length]:
            self._refuse(inbox, np.array(wrong), Reason.WRONG_LENGTH, out)
        if inbox.lock is not None:
            heard = [f for f in good if inbox.lock.admits(f[0], source_of(f[1]))]
            self._refuse_untimed(inbox, len(good) - len(heard), Reason.WRONG_SOURCE)
            if len(heard) < len(good) and inbox.lock.source != inbox.lock.own:
                self.counts.senders.setdefault(inbox.message.name, set()).update(source_of(f[1]) for f in good)
            good = heard
        if not good:
            return None
        times, ids, datas = zip(*good, strict=True)
        payload = np.frombuffer(b"".join(datas), dtype=np.uint8).reshape(-1, length)
        batch = Batch(np.array(times, dtype=np.float64), np.array(ids, dtype=np.int64), payload)
        for reason, check in CHECKS.items():
            mask = check(inbox, batch)
            if mask is None or mask.all():
                continue
            self._refuse(inbox, batch.t[~mask], reason, out)
            if not mask.any():
                return None
            batch = batch.where(mask)
        return batch

    def _refuse(self, inbox: Inbox, t: Array, reason: Reason, out: Decoded) -> None:
        self.counts.refused[inbox.message.name, reason] += len(t)
        for channel in inbox.channels:
            before = out.refused.get((channel.name, reason))
            out.refused[channel.name, reason] = t if before is None else np.sort(np.concatenate([before, t]))

    def _refuse_unheard(self, inbox: Inbox, reason: Reason) -> None:
        """One frame that is not even filed."""
        self.counts.received[inbox.message.name] += 1
        self._refuse_untimed(inbox, 1, reason)

    def _refuse_untimed(self, inbox: Inbox, n: int, reason: Reason) -> None:
        if n:
            self.counts.refused[inbox.message.name, reason] += n
            self._untimed[reason] += n * len(inbox.channels)


def hears_any_source(message: Message, database: Database) -> bool:
    """Return whether a message is taken by its parameter group, from any source address."""
    pgn, groups = pgn_of(message.frame_id), [pgn_of(m.frame_id) for m in database.messages if m.is_extended_frame]
    return message.is_extended_frame and pgn in STANDARD_PGNS and groups.count(pgn) == 1


def _judge(
    channel: Channel, rule: CodeRule, message: Message, t: Array, columns: dict[str, SignalColumn], out: Decoded
) -> None:
    """Put one channel's samples into `out`: each one admitted, or refused for one reason."""
    column = columns[channel.signal]
    verdict = judge_codes(rule, column.raw, column.physical)
    if channel.valid_signal is not None:
        vouching = message.get_signal_by_name(channel.valid_signal)
        other = judge_validity(channel, vouching.length, vouching.is_signed, columns[channel.valid_signal])
        verdict = np.where(verdict == 0, other, verdict)
    value = in_si(channel, column.physical, verdict)
    if column.present is not None:
        t, value, verdict = t[column.present], value[column.present], verdict[column.present]
    if not verdict.any():
        out.columns[channel.name] = Column(t, value)
        return
    admitted = verdict == 0
    out.columns[channel.name] = Column(t[admitted], value[admitted])
    for code in np.unique(verdict[~admitted]).tolist():
        out.refused[channel.name, REASONS[code - 1]] = t[verdict == code]
