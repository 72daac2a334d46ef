"""Frames of a candump log (`candump -L`), a batch of lines at a time.

python-can's reader spends 7 us on a line, more than admission and binning together on its
frame.  Nearly every line of a log is a plain classic frame, so batches of such lines are cut
up here by a few calls for all of them, at 2 us a line; a batch with anything else in it (FD,
remote or error frames, empty data, garbage) goes to python-can's reader as it is, which stays
the judge of what a line means.  A second process that reads ahead was not taken: it needs a
second core, and saves no work.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from io import StringIO
from itertools import chain, islice, repeat
from operator import index

import can

Frame = tuple[float, int, bool, bytes | bytearray, bool, bool]
"""Time [s], identifier, whether extended, data, whether a remote frame, whether an error frame."""

BATCH = 128

# identifiers above 1FFFFFFF carry flags; the channel must not contain what the line is cut at
_PLAIN_LINES = re.compile(
    r"""(?:\([0-9]++\.[0-9]++\) [!"$-'*-~]++ (?:[0-9A-Fa-f]{3}|[01][0-9A-Fa-f]{7})#[0-9A-Fa-f]++\n)*+"""
).fullmatch
"""Without their directions.  Digits of data in pairs, or directions, in the pattern take it five times as long."""
_DIRECTION = re.compile(r" [RT]\n")
_CUTS = str.maketrans("()#", "   ")


def frame_of(message: can.Message) -> Frame:
    """The frame that a message of python-can stands for.

    Raises TypeError or ValueError where its time or identifier is no number, as from a damaged SQLite log.
    """
    return (
        float(message.timestamp),
        index(message.arbitration_id),
        message.is_extended_id,
        message.data,
        message.is_remote_frame,
        message.is_error_frame,
    )


def whole(message: can.Message) -> can.Message:
    """The message; ValueError where it has other than the bytes that it says: its line was cut off."""
    stated = message.dlc if message.is_fd else min(message.dlc, 8)
    if not (message.is_remote_frame or message.is_error_frame or len(message.data) == stated):
        raise ValueError(f"a frame of {stated} bytes has {len(message.data)}")
    return message


def candump_frames(lines: Iterable[str]) -> Iterator[Frame]:
    """Frames of a log's lines, the same that `can.CanutilsLogReader` reads.

    Raises what the reader (ValueError, IndexError) or `lines` raises, or ValueError for half a byte,
    after the frames before that place.
    """
    return chain.from_iterable(candump_batches(lines))


def candump_batches(lines: Iterable[str]) -> Iterator[list[Frame]]:
    """As `candump_frames`, in lists."""
    for batch in _batches(iter(lines)):
        text = "".join(batch)
        frames = _plain(_DIRECTION.sub("\n", text))
        if frames is not None:
            yield frames
        else:
            yield from ([frame_of(whole(message))] for message in can.CanutilsLogReader(StringIO(text)))


def _batches(lines: Iterator[str]) -> Iterator[list[str]]:
    """Lines in lists of BATCH; what was read before an error comes before the error."""
    full = True
    while full:
        batch: list[str] = []
        failure: Exception | None = None
        try:
            batch.extend(islice(lines, BATCH))
        except Exception as error:
            failure = error
        yield batch
        if failure is not None:
            raise failure
        full = len(batch) == BATCH


def _plain(text: str) -> list[Frame] | None:
    """Frames of plain lines without directions, four words each once cut; None where a line is another one."""
    if not _PLAIN_LINES(text):
        return None
    words = text.translate(_CUTS).split()
    identifiers = words[2::4]
    try:
        data = list(map(bytes.fromhex, words[3::4]))
    except ValueError:  # half a byte
        return None
    return list(
        zip(
            map(float, words[::4]),
            map(int, identifiers, repeat(16)),
            [len(i) > 3 for i in identifiers],
            data,
            repeat(False),
            repeat(False),
        )
    )
