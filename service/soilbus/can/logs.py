"""A log of any format as the frames of one channel, within its limits; its faults in one line.

file -> plain bytes (files.opened) -> frames of its format (log_formats) -> frames of one channel
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Collection, Iterator
from itertools import chain, islice, pairwise
from pathlib import Path
from statistics import median

from soilbus.can.candump import Frame, Heard
from soilbus.can.log_formats import HEAD, format_of
from soilbus.files import opened, packing, within_ratio
from soilbus.words import WorkError, one_line, shown

CHANNEL_SCAN_FRAMES = 2000  # frames of a log in which its channels are looked for: several seconds of a bus
LEAST_FRAME = 16  # bytes of a frame in memory at least: what the packed bytes of a log are compared with
MOST_BACKWARDS = 0.1  # share of stamps that may go back: two channels merged have some, relative stamps half
LEAST_STAMPS = 20  # frames from which stamps are judged


class LogError(WorkError):
    """Error of a log that cannot be read to its end."""

    windows = 0  # that ended before the damage

    def __init__(self, text: str, lasting: bool = True) -> None:
        super().__init__(shown(text))
        self.lasting = lasting  # False where the fault is of the machine that reads it, not of what is in the log


class OtherBus(LogError):
    """Error of a log without any frame of the DBC: another bus, or another vehicle."""


class Log:
    """A log that can be read once; "-" is standard input.

    `channel` is whose frames are wanted, as the log names it (can0, 1); canN is also the channel numbered N + 1, or N
    in a log whose numbers begin at 0.  Empty for all.  A log of one other channel alone is read, unless `demanded`.
    """

    def __init__(self, path: Path, channel: str = "", demanded: bool = False) -> None:
        self.path, self.wanted, self._demanded = path, channel, demanded
        self.name = "standard input" if str(path) == "-" else str(path)  # in messages
        self.kind = ""  # its format, such as "candump log, gzip", from the first frame on
        self.chosen = ""  # the channel whose frames are handed out
        self.channels: Counter[str] = Counter()  # frames by channel, as far as it was read
        self.span = 0.0  # time from the first frame to the latest one read [s]
        self._given = 0

    @property
    def left_out(self) -> int:
        """Number of frames of other channels."""
        return self.channels.total() - self.channels[self.chosen] if self.wanted else 0

    @property
    def note(self) -> str:
        """Line on the log's channels as far as it was read; empty where there is nothing to say."""
        others = sorted(self.channels.keys() - {self.chosen})
        if not self.wanted:
            mixed = f"{self.name}: frames of {_listed(others)} are read together; --channel chooses one"
            return mixed if len(others) > 1 else ""
        if others and self.chosen:
            return (
                f"{self.name}: frames of {self.chosen} are read; those of {_listed(others)} are left out"
                " (bus.channel, --channel)"
            )
        if self.chosen and _meant(self.wanted, self.channels) is None:
            return f"{self.name}: frames of {self.chosen}, where bus.channel = {self.wanted}; it has no other channel"
        return ""

    def frames(self) -> Iterator[Frame]:
        """Yield its frames; LogError where it is no whole log of frames, or has not the channel."""
        try:
            yield from self._frames()
        except Exception as error:  # readers raise all kinds on a damaged file
            raise self._fault(error) from None
        if not self.channels:
            raise LogError(f"{self.name}: no frame in it")

    def _fault(self, error: Exception) -> LogError:
        if isinstance(error, LogError):
            return error
        if isinstance(error, FileNotFoundError):
            return LogError(f"{self.name}: no such file")
        is_of_file_system = isinstance(error, OSError) and error.errno is not None and not self.channels
        if is_of_file_system or isinstance(error, (MemoryError, ModuleNotFoundError)):
            is_full = isinstance(error, MemoryError)
            why = "not enough memory to read it" if is_full else getattr(error, "strerror", None) or str(error)
            return LogError(f"{self.name}: {why}", lasting=False)
        what = f"cut off or damaged after {self._given} frames" if self._given else "not a CAN log that can be read"
        why = "a line that is no frame" if "to unpack" in str(error) else one_line(error, 150)
        return LogError(f"{self.name}: {what} ({why})")

    def _frames(self) -> Iterator[Frame]:
        with opened(self.path) as stream:
            found = format_of(stream.peek(HEAD))
            self.kind = ", ".join(filter(None, (found.name, packing(stream))))
            heard = self._counted(found.frames(stream))
            head: list[Heard] = []
            fault: Exception | None = None
            try:
                head.extend(islice(heard, CHANNEL_SCAN_FRAMES))
            except Exception as error:  # after the frames before it
                fault = error
            _check_stamps([frame[0] for _, frame in head])
            self._choose()
            for self._given, (channel, frame) in enumerate(chain(head, heard), 1):
                if self.wanted and channel != self.chosen:
                    self.chosen = self.chosen or _meant(self.wanted, self.channels) or ""  # it may begin late
                    if channel != self.chosen and (channel or not frame[5]):
                        continue
                yield frame
            if fault is not None:
                raise fault
        if self.wanted and self.channels and self.chosen not in self.channels:
            raise self._not_in_it()
        if self.wanted and self.chosen != (meant := _meant(self.wanted, self.channels)) and meant is not None:
            raise LogError(
                f"{self.name}: begins with {self.chosen} alone, but has {meant} too: read it with --channel {meant}"
            )

    def _counted(self, heard: Iterator[Heard]) -> Iterator[Heard]:
        size = self.path.stat().st_size if self.path.is_file() else math.inf
        first = 0.0
        for n, (channel, frame) in enumerate(heard, 1):
            first = frame[0] if n == 1 else first
            self.span = max(self.span, frame[0] - first)
            if channel or not frame[5]:  # candump's reader keeps no channel of error frames
                self.channels[channel] += 1
            if n % CHANNEL_SCAN_FRAMES == 0:
                within_ratio(size, LEAST_FRAME * n)
            yield channel, frame

    def _choose(self) -> None:
        """Choose the channel by the frames read so far; leave it empty where a demanded one may begin later."""
        if not self.wanted or not self.channels:
            return
        chosen = _meant(self.wanted, self.channels)
        if chosen is None and len(self.channels) == 1 and not (self._demanded and min(self.channels)):
            chosen = min(self.channels)
        if chosen is None and not self._demanded:
            raise self._not_in_it()
        self.chosen = chosen or ""

    def _not_in_it(self) -> LogError:
        there = _listed(sorted(self.channels))
        return LogError(f"{self.name}: no frame of {self.wanted}, but of {there}: choose with --channel")


def read_frames(path: Path, channel: str = "") -> Iterator[Frame]:
    """Return the frames of one channel of a log, of all channels by default; LogError as `Log.frames`."""
    return Log(path, channel).frames()


def _meant(wanted: str, channels: Collection[str]) -> str | None:
    """The one of a log's channels that a user means; None where none is, or several may be."""
    if wanted in channels:
        return wanted
    numbers = [channel for channel in channels if channel.isdecimal()]
    found: list[str] = []
    if wanted.isdecimal():
        found = [channel for channel in channels if re.fullmatch(rf"\D+0*{int(wanted)}", channel)]
    elif name := re.fullmatch(r"[a-z]*can(\d+)", wanted):
        found = [channel for channel in numbers if int(channel) == int(name[1]) + ("0" not in numbers)]
    return found[0] if len(found) == 1 else None


def _listed(names: Collection[str]) -> str:
    return " and ".join(name or "no channel" for name in names)


def _check_stamps(stamps: list[float]) -> None:
    """Raise ValueError where the first stamps go backwards, or only say how long after the frame before each came."""
    backwards = sum(later < earlier for earlier, later in pairwise(stamps))
    half = len(stamps) // 2
    if len(stamps) < LEAST_STAMPS or backwards <= MOST_BACKWARDS * len(stamps):
        return
    if max(stamps[half:]) < min(stamps[:half]):
        raise ValueError("its stamps go backwards: put its frames in the order of time")
    if median(stamps[half:]) < max(stamps[:half]):
        raise ValueError(
            "its stamps are relative to the frame before, as candump -td writes them: record with absolute ones (-ta)"
        )
