"""A log of any format as the frames of one channel, within its limits; its faults in one line.

file -> plain bytes (files.opened) -> batches of its format (log_formats) -> frames of one channel
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from io import BufferedReader
from itertools import pairwise
from pathlib import Path
from statistics import median

from soilbus.can.candump import Batch, Frame
from soilbus.can.log_formats import HEAD, Format, format_of
from soilbus.files import opened, packing, within_ratio
from soilbus.words import WorkError, one_line, shown

CHANNEL_SCAN_FRAMES = 2000
"""Frames of a log in which its channels are looked for: several seconds of a bus."""
LEAST_FRAME = 16
"""Bytes of a frame in memory at least: what the packed bytes of a log are compared with."""
MOST_BACKWARDS = 0.1
"""Share of frames that may be stamped before the one before: two channels merged have some, relative stamps half."""
LEAST_STAMPS = 20
"""Frames from which stamps are judged."""


class LogError(WorkError):
    """Error of a log that cannot be read to its end; `windows` ended before the damage.

    `lasting` is False where the fault is of the machine that reads it, not of what is in the log.
    """

    windows = 0
    lasting = True

    def __init__(self, text: str) -> None:
        super().__init__(shown(text))


class OtherBus(LogError):
    """Error of a log without any frame of the DBC: another bus, or another vehicle."""


class Log:
    """A log that can be read once.

    Parameters
    ----------
    path
        Of the file; "-" is standard input.
    channel
        Whose frames are wanted, as the log names it (can0, 1); canN is also the channel numbered N + 1, or N in a log
        whose numbers begin at 0.  Empty for all.
    demanded
        Whether a log of one other channel alone is refused; else that channel is taken.

    Attributes
    ----------
    kind
        Its format, such as "candump log, gzip"; empty before the first frame.
    channels
        Frames by channel, as far as it was read.
    chosen
        The channel whose frames are handed out.
    span
        Time from the first frame to the latest one read [s].
    """

    def __init__(self, path: Path, channel: str = "", demanded: bool = False) -> None:
        self.path, self.wanted, self._demanded = path, channel, demanded
        self.kind, self.chosen, self.span, self._given = "", "", 0.0, 0
        self.channels: Counter[str] = Counter()
        self._is_awaited = False

    @property
    def name(self) -> str:
        """Name of the log in messages."""
        return "standard input" if str(self.path) == "-" else str(self.path)

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
        """Yield its frames.

        Raises
        ------
        LogError
            The file is missing, no log of frames, damaged, made to fill the memory, or has not the channel wanted.
        """
        try:
            yield from self._frames()
        except LogError:
            raise
        except FileNotFoundError:
            raise LogError(f"{self.name}: no such file") from None
        except ModuleNotFoundError as error:
            raise self._of_machine(str(error)) from None
        except MemoryError:
            raise self._of_machine("not enough memory to read it") from None
        except OSError as error:
            if self.channels or error.errno is None:
                raise LogError(self._damage(error)) from None
            raise self._of_machine(error.strerror or str(error)) from None
        except Exception as error:  # readers raise all kinds on a damaged file
            raise LogError(self._damage(error)) from None
        if not self.channels:
            raise LogError(f"{self.name}: no frame in it")

    def _of_machine(self, what: str) -> LogError:
        fault = LogError(f"{self.name}: {what}")
        fault.lasting = False
        return fault

    def _damage(self, error: Exception) -> str:
        what = f"cut off or damaged after {self._given} frames" if self._given else "not a CAN log that can be read"
        why = "a line that is no frame" if "to unpack" in str(error) else one_line(error, 150)
        return f"{self.name}: {what} ({why})"

    def _frames(self) -> Iterator[Frame]:
        with opened(self.path) as stream:
            found = format_of(stream.peek(HEAD))
            self.kind = ", ".join(filter(None, (found.name, packing(stream))))
            batches = self._counted(found, stream)
            head: list[Batch] = []
            fault: Exception | None = None
            try:
                for batch in batches:
                    head.append(batch)
                    if self.channels.total() >= CHANNEL_SCAN_FRAMES:
                        break
            except Exception as error:  # after the frames before it
                fault = error
            _check_stamps([frame[0] for _, frames in head for frame in frames])
            self._choose()
            for batch in head:
                yield from self._of_channel(batch)
            if fault is not None:
                raise fault
            for batch in batches:
                yield from self._of_channel(batch)
        if self._is_awaited:
            raise self._not_in_it()
        if self.wanted and self.chosen != (meant := _meant(self.wanted, self.channels)) and meant is not None:
            raise LogError(
                f"{self.name}: begins with {self.chosen} alone, but has {meant} too: read it with --channel {meant}"
            )

    def _counted(self, found: Format, stream: BufferedReader) -> Iterator[Batch]:
        size = self.path.stat().st_size if self.path.is_file() else math.inf
        first = math.nan
        for channels, frames in found.batches(stream):
            if frames:
                first = frames[0][0] if math.isnan(first) else first
                self.span = max(self.span, max(frame[0] for frame in frames) - first)
            named: Iterable[str] = channels
            if "" in channels:  # error frames of candump, whose reader keeps no channel
                named = (channel for channel, frame in zip(channels, frames, strict=True) if channel or not frame[5])
            self.channels.update(named)
            within_ratio(size, LEAST_FRAME * self.channels.total())
            yield channels, frames

    def _choose(self) -> None:
        """Choose the channel by the frames read so far."""
        if not self.wanted or not self.channels:
            return
        chosen = _meant(self.wanted, self.channels)
        if chosen is None and len(self.channels) == 1 and not (self._demanded and min(self.channels)):
            chosen = min(self.channels)
        if chosen is None and self._demanded:  # it may begin later
            self._is_awaited = True
            return
        if chosen is None:
            raise self._not_in_it()
        self.chosen = chosen

    def _not_in_it(self) -> LogError:
        there = _listed(sorted(self.channels))
        return LogError(f"{self.name}: no frame of {self.wanted}, but of {there}: choose with --channel")

    def _of_channel(self, batch: Batch) -> list[Frame]:
        channels, frames = batch
        if self._is_awaited and (meant := _meant(self.wanted, self.channels)) is not None:
            self.chosen, self._is_awaited = meant, False
        self._given += len(frames)
        if not self.wanted or set(channels) <= {self.chosen}:
            return frames
        pairs = zip(channels, frames, strict=True)
        return [frame for channel, frame in pairs if channel == self.chosen or (frame[5] and not channel)]


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
