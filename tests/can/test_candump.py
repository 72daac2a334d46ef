"""Our reading of candump lines against python-can's, line for line."""

import io
import re
from collections.abc import Iterable, Iterator

import can
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from soilbus.can.candump import Frame, frame_of, whole
from soilbus.can.candump import candump_frames as heard_in

PLAIN = "(1700000000.000266) can0 18FF2211#025415B303000000\n"

times = st.builds("({}.{:06d})".format, st.integers(0, 2_000_000_000), st.integers(0, 999_999))
channels = st.sampled_from(["can0", "vcan1", "0", "a-b.c", "!~"])
bytes_ = st.binary(min_size=1, max_size=8).map(bytes.hex)
identifiers = st.integers(0, 0x7FF).map("{:03X}".format) | st.integers(0, 0x1FFFFFFF).map("{:08X}".format)
plain_data = bytes_ | bytes_.map(str.upper)
any_data = (
    plain_data
    | st.sampled_from(["", "R", "r", "R8", "r2", "##1", "1", "123"])
    | st.builds("##{}{}".format, st.integers(0, 7), plain_data)
)
flagged = st.integers(0, 0xFFFFFFFF).map("{:08X}".format) | st.sampled_from(["20000080", "20000004", "1", "12345"])
directions = st.sampled_from(["", " R", " T"])
plain_lines = st.builds("{} {} {}#{}{}\n".format, times, channels, identifiers, plain_data, directions)
any_lines = st.builds("{} {} {}#{}{}\n".format, times, channels, identifiers | flagged, any_data, directions)
odd_lines = st.sampled_from(["\n", "  \n", "(1.5)  can0   123#00\n", "(2.5) can0 123#00 r\n", "(1e3) c#n 123#00\n"])
garbage = st.text("()#.R 0129AFcan\t", max_size=40).map("{}\n".format)


def candump_frames(lines: Iterable[str]) -> Iterator[Frame]:
    return (frame for _, frame in heard_in(lines))


def outcome(frames: Iterator[Frame]) -> tuple[list[Frame], type[Exception] | None, str]:
    """Frames until the end or an error, and the error."""
    found: list[Frame] = []
    try:
        found.extend((t, i, x, bytes(d), r, e) for t, i, x, d, r, e in frames)
    except Exception as error:
        return found, type(error), str(error)
    return found, None, ""


def peer(text: str) -> tuple[list[Frame], type[Exception] | None, str]:
    """What python-can reads of it, as far as its frames are whole and its error frames of the class that it knows.

    At a line without a stamp it ends with a reason that says so, where python-can counts words.
    """
    known = re.sub(r"(?<=[ ])[2367ABEF][0-9A-F]{7}#", "20000080#", text)
    unstamped = re.search(r"^[ \t]*[^\s(]\S*[ \t]+[0-9A-Fa-f]{3,8}#", known, re.MULTILINE)
    stamped = io.StringIO(known[: unstamped.start()] if unstamped else known)
    found = outcome(frame_of(whole(message)) for message in can.CanutilsLogReader(stamped))
    if unstamped is None or found[1] is not None:
        return found
    return found[0], ValueError, "its lines have no time stamps: record with candump -L, or candump -ta"


@given(st.lists(plain_lines | any_lines | odd_lines, max_size=20))
@example(["(1.0) c#n 123#00\n", "(1.0) c(n 123#00\n", "(1.0) can) 123#00\n"])
@example(["(1.0) c#n 123#00\n"])
@example([PLAIN, "(1.0) can0 20000080#00\n", "(1.0) can0 7FF#\n"])
def test_frames_equal_those_of_python_can(lines: list[str]) -> None:
    assert outcome(candump_frames(lines)) == peer("".join(lines))


@given(st.lists(plain_lines | garbage, max_size=10), st.booleans())
@example([PLAIN, "can0 12A#00\n", PLAIN], False)
@example([PLAIN, "\n", "(1) can0 12\n", "c1c 012# 1#00\n"], False)
@example(["c1c 012# 1#00\n"], False)
def test_garbage_gives_the_same_frames_and_then_the_same_error(lines: list[str], cut: bool) -> None:
    text = "".join(lines)[: -5 if cut else None]
    assert outcome(candump_frames(io.StringIO(text))) == peer(text)


@given(st.lists(plain_lines, min_size=1, max_size=20))
def test_plain_lines_do_not_need_python_can(lines: list[str]) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.delattr(can, "CanutilsLogReader")
        frames = list(candump_frames(lines))
    assert frames == peer("".join(lines))[0]


@pytest.mark.parametrize("n", [0, 1, 63, 64, 65, 127, 128, 129, 391, 1024])
def test_lines_before_a_failing_read_are_not_lost(n: int) -> None:
    def lines() -> Iterable[str]:
        for _ in range(n):
            yield PLAIN
        raise EOFError("cut off")

    found, error, text = outcome(candump_frames(lines()))
    assert (len(found), error, text) == (n, EOFError, "cut off")
