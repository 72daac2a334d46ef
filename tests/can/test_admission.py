"""Which frames count, and what each refusal is called."""

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cantools.database.can import Database
from hypothesis import given
from hypothesis import strategies as st

from soilbus.can.admission import Admission
from soilbus.can.channels import Channel, Decoded, Reason
from soilbus.can.checksum import frame_checksum
from soilbus.can.j1939 import SourceLock

DBC = """
BO_ 256 Loads: 4 X
 SG_ Left : 0|16@1+ (1,0) [0|64255] "N" X
 SG_ Right : 16|16@1+ (1,0) [0|64255] "N" X
BO_ 2147483904 SameNumberExtended: 4 X
 SG_ Value : 0|16@1+ (1,0) [0|64255] "N" X
BO_ 257 Guarded: 4 X
 SG_ Value : 0|16@1+ (0.5,0) [0|1000] "N" X
 SG_ Counter : 16|4@1+ (1,0) [0|15] "" X
 SG_ Checksum : 24|8@1+ (1,0) [0|255] "" X
BO_ 2566801815 GroundSpeed: 8 X
 SG_ Speed : 0|16@1+ (0.001,0) [0|64.255] "m/s" X
BO_ 2566801431 GuardedGroup: 3 X
 SG_ Value : 0|8@1+ (1,0) [0|250] "m/s" X
 SG_ Counter : 8|4@1+ (1,0) [0|15] "" X
 SG_ Checksum : 23|8@0+ (1,0) [0|255] "" X
BO_ 2566857232 Exact: 2 X
 SG_ Value : 0|16@1+ (1,0) [0|64255] "N" X
BO_ 2566857233 ExactToo: 2 X
 SG_ Value : 0|16@1+ (1,0) [0|64255] "N" X
BO_ 258 Muxed: 3 X
 SG_ Page M : 0|8@1+ (1,0) [0|3] "" X
 SG_ A m0 : 8|16@1+ (1,0) [0|64255] "N" X
 SG_ B m1 : 8|16@1+ (1,0) [0|64255] "N" X
"""

LEFT = ("Loads", "Left")
SPEED = 0x18FE4997
COMMON: dict[str, Any] = {"factor": 1.0, "offset": 0.0, "low": -math.inf, "high": math.inf}


def database() -> Database:
    found = Database()
    found.add_dbc_string(DBC)
    return found


def admission(*signals: tuple[str, str], checked: Iterable[str] = ()) -> Admission:
    channels = [Channel(quantity=s, wheel="", message=m, signal=s, **COMMON) for m, s in signals]
    return Admission(channels, database(), tuple(checked))


def guarded(value: int, counter: int, identifier: int = 257) -> bytes:
    data = bytearray(value.to_bytes(2, "little") + bytes([counter, 0]))
    data[3] = frame_checksum(identifier, bytes(data), 3)
    return bytes(data)


def values(out: Decoded, name: str) -> list[tuple[float, float]]:
    column = out.columns[name]
    return list(zip(column.t.tolist(), column.value.tolist(), strict=True))


def refused(out: Decoded) -> dict[tuple[str, str], list[float]]:
    return {(name, str(reason)): t.tolist() for (name, reason), t in out.refused.items()}


def test_samples_in_order_of_time_and_taken_once() -> None:
    a = admission(LEFT, ("Loads", "Right"))
    a.feed(1.0, 256, False, b"\x01\x00\x02\x00")
    a.feed(1.5, 256, False, b"\x03\x00\xff\xff")
    out = a.take()
    assert values(out, "Left") == [(1.0, 1.0), (1.5, 3.0)]
    assert values(out, "Right") == [(1.0, 2.0)]
    assert refused(out) == {("Right", "not_available"): [1.5]}
    assert values(a.take(), "Left") == []
    assert (a.counts.received["Loads"], a.counts.admitted["Loads"], sum(a.counts.refused.values())) == (2, 2, 0)


def test_take_until_leaves_the_rest() -> None:
    a = admission(LEFT)
    for t in (0.0, 0.5, 1.0, 1.5):
        a.feed(t, 256, False, bytes(4))
    assert a.take(1.0).columns["Left"].t.tolist() == [0.0, 0.5]
    assert a.take(1.0).columns["Left"].t.tolist() == []
    assert a.take().columns["Left"].t.tolist() == [1.0, 1.5]


def test_standard_and_extended_identifiers_are_different_frames() -> None:
    a = admission(LEFT, ("SameNumberExtended", "Value"))
    a.feed(0.0, 256, False, b"\x01\x00\x00\x00")
    a.feed(0.0, 256, True, b"\x02\x00\x00\x00")
    out = a.take()
    assert values(out, "Left") == [(0.0, 1.0)]
    assert values(out, "Value") == [(0.0, 2.0)]


@pytest.mark.parametrize("data", [b"", b"\x01\x00\x02", b"\x01\x00\x02\x00\x00"])
def test_wrong_length_refuses_the_whole_frame(data: bytes) -> None:
    a = admission(LEFT, ("Loads", "Right"))
    a.feed(0.0, 256, False, bytes(4))
    a.feed(0.1, 256, False, data)
    a.feed(0.2, 256, False, bytes(4))
    out = a.take()
    assert out.columns["Left"].t.tolist() == [0.0, 0.2]
    assert refused(out) == {("Left", "wrong_length"): [0.1], ("Right", "wrong_length"): [0.1]}
    assert a.counts.refused == {("Loads", Reason.WRONG_LENGTH): 1}


def test_remote_and_unknown_frames_are_counted_only() -> None:
    a = admission(LEFT)
    a.feed(0.0, 256, False, b"", remote=True)
    a.feed(0.0, 256, False, bytes(4))
    for i in range(2000):
        a.feed(0.0, 1000 + i, True, b"")
    out = a.take()
    assert (out.columns["Left"].t.tolist(), out.refused) == ([0.0], {})
    assert a.counts.refused == {("Loads", Reason.REMOTE_FRAME): 1}
    assert (a.counts.unknown, len(a.counts.unknown_ids)) == (2000, 1024)
    assert a.counts.received["Loads"] == 2


def test_time_may_stand_still_but_not_go_back() -> None:
    a = admission(LEFT)
    for i, t in enumerate((1.0, 1.0, 0.9, 1.1, math.nan, 1.05)):
        a.feed(t, 256, False, bytes([i, 0, 0, 0]))
    out = a.take()
    assert out.columns["Left"].t.tolist() == [1.0, 1.0, 1.1]
    assert np.isnan(out.refused["Left", Reason.TIME_BACKWARDS]).sum() == 1
    a.feed(1.0, 256, False, bytes(4))  # also across batches
    assert refused(a.take()) == {("Left", "time_backwards"): [1.0]}


def test_a_frame_stamped_long_before_one_that_came_earlier_is_refused() -> None:
    a = admission(LEFT, ("Guarded", "Value"))
    for i, (guarded_at, left_at) in enumerate([(9.9, 9.91), (10.0, 9.92), (10.1, 9.6), (10.2, 9.7), (10.3, 10.21)]):
        a.feed(guarded_at, 257, False, guarded(i, 5))
        a.feed(left_at, 256, False, bytes([i, 0, 0, 0]))
    out = a.take()
    assert out.columns["Left"].t.tolist() == [9.91, 9.92, 10.21]  # 0.1 s is a bunch
    assert out.columns["Value"].t.tolist() == [9.9, 10.0, 10.1, 10.2, 10.3]
    assert refused(out) == {("Left", "time_backwards"): [9.6, 9.7]}
    a.feed(10.0, 256, False, bytes([7, 0, 0, 0]))
    a.feed(8.0, 256, False, bytes(4))  # the clock was set; what waits has no place in the new time
    assert a.counts.clock_steps == 1
    assert a.take().columns["Left"].t.tolist() == [8.0]
    assert a.counts.received["Loads"] == a.counts.admitted["Loads"] + sum(
        n for (name, _), n in a.counts.refused.items() if name == "Loads"
    )


def test_a_frame_that_comes_once_more_is_refused() -> None:
    a = admission(LEFT)
    for t, data in ((1.0, 1), (1.0004, 1), (1.0008, 2), (1.0012, 1), (1.0213, 1), (1.0214, 1)):
        a.feed(t, 256, False, bytes([data, 0, 0, 0]))
    out = a.take()
    assert out.columns["Left"].t.tolist() == [1.0, 1.0008, 1.0012, 1.0213]
    assert refused(out) == {("Left", "duplicate"): [1.0004, 1.0214]}
    a.feed(1.0216, 256, False, bytes([1, 0, 0, 0]))  # also across batches
    a.feed(1.0416, 256, False, bytes([1, 0, 0, 0]))
    out = a.take()
    assert (out.columns["Left"].t.tolist(), refused(out)) == ([1.0416], {("Left", "duplicate"): [1.0216]})
    assert a.counts.received["Loads"] == a.counts.admitted["Loads"] + sum(a.counts.refused.values())


def test_a_clock_set_back_starts_afresh() -> None:
    a = admission(LEFT, ("Guarded", "Value"), checked=["Guarded"])
    a.feed(100.0, 257, False, guarded(1, 5))
    a.take()
    a.feed(100.5, 256, False, bytes(4))
    a.feed(50.0, 257, False, guarded(1, 5))
    a.feed(50.1, 256, False, bytes(4))
    out = a.take()
    assert out.columns["Left"].t.tolist() == [50.1]
    assert out.columns["Value"].t.tolist() == [50.0]
    assert a.counts.clock_steps == 1
    assert a.counts.refused == {("Loads", Reason.TIME_BACKWARDS): 1}


def test_backward_jump_of_a_second_is_no_clock_step() -> None:
    a = admission(LEFT)
    a.feed(10.0, 256, False, bytes(4))
    a.feed(9.0, 256, False, bytes(4))
    assert a.take().columns["Left"].t.tolist() == [10.0]
    assert a.counts.clock_steps == 0


def test_checksum_and_counter() -> None:
    a = admission(("Guarded", "Value"), checked=["Guarded"])
    good = [guarded(10 * i, i) for i in range(4)]
    broken = bytes([good[2][0] ^ 1]) + good[2][1:]
    for i, data in enumerate([good[0], good[1], good[1], broken, good[2], good[0]]):
        a.feed(float(i), 257, False, data)
    out = a.take()
    assert values(out, "Value") == [(0.0, 0.0), (1.0, 5.0), (4.0, 10.0), (5.0, 0.0)]
    assert refused(out) == {("Value", "bad_counter"): [2.0], ("Value", "bad_checksum"): [3.0]}
    a.feed(6.0, 257, False, good[0])  # stuck, seen across batches
    assert refused(a.take()) == {("Value", "bad_counter"): [6.0]}


def test_frames_that_a_counter_skips_are_counted_across_batches_and_its_turn() -> None:
    a = admission(LEFT, ("Guarded", "Value"), checked=["Guarded"])
    for t, counter in ((0.0, 12), (0.1, 13), (0.2, 15), (0.5, 2)):  # 14 never came; 0 and 1 neither
        a.feed(t, 257, False, guarded(5, counter))
    a.take()
    a.feed(0.6, 257, False, guarded(5, 6))  # 3, 4, 5 neither
    a.take()
    assert a.missed == 6
    assert admission(LEFT).missed is None  # nothing counts there: not 0


def reasons_of(frames: Iterable[tuple[int, int]], split: int | None = None) -> list[str]:
    """Of frames by counter and value, 0.1 s apart, why each is refused ("": it is not); split: taken in two batches."""
    frames = list(frames)
    a = admission(("Guarded", "Value"), checked=["Guarded"])
    said = [""] * len(frames)
    for i, (counter, value) in enumerate(frames):
        a.feed(0.1 * i, 257, False, guarded(value, counter % 16))
        if i + 1 in (split, len(frames)):
            for (_, reason), t in a.take().refused.items():
                for when in t.tolist():
                    said[round(10 * when)] = str(reason)
    return said


def test_five_net_errors_of_the_counter_are_a_second_sender_until_five_are_made_good() -> None:
    good, jumps = [(i, 5) for i in range(10)], [(9 + 3 * i, 5) for i in range(1, 9)]
    after = [(jumps[-1][0] + i, 5) for i in range(1, 8)]
    assert reasons_of(good + jumps + after) == [""] * 14 + ["second_sender"] * 8 + [""] * 3


def test_one_loss_in_four_frames_is_no_second_sender() -> None:
    assert set(reasons_of((i + i // 4, 5) for i in range(100))) == {""}


def test_the_same_counter_with_another_payload_is_a_second_sender_at_once() -> None:
    frames = [(0, 5), (1, 5), (1, 5), (2, 5), (3, 5), (3, 6), (4, 5), (5, 5), (6, 5), (7, 5), (8, 5), (9, 5)]
    assert reasons_of(frames) == ["", "", "bad_counter", "", "", "bad_counter", *["second_sender"] * 4, "", ""]


@given(st.integers(1, 3), st.integers(2, 14), st.integers(1, 60))
def test_whoever_mixes_into_a_message_with_a_counter_of_its_own_is_found_in_any_batches(rate, ahead, split) -> None:
    """Up to twice as many frames as the true sender's; counters run on for both."""
    foreign = 0
    frames: list[tuple[int, int]] = []
    for i in range(60):
        frames.append((i, 5))
        for _ in range(min(rate, 2) if i >= 20 else 0):
            foreign += 1
            frames.append((i + ahead + foreign, 900))
    said = reasons_of(frames)
    assert said == reasons_of(frames, split)
    assert set(said[:20]) == {""}
    assert "second_sender" in said[20:50]


@given(st.integers(0, 31))
def test_any_flipped_bit_of_a_guarded_frame_is_refused(bit: int) -> None:
    a = admission(("Guarded", "Value"), checked=["Guarded"])
    data = bytearray(guarded(123, 4))
    data[bit // 8] ^= 1 << bit % 8
    a.feed(0.0, 257, False, bytes(data))
    assert refused(a.take()) == {("Value", "bad_checksum"): [0.0]}


def test_another_makers_checksum_is_not_judged() -> None:
    a = admission(("Guarded", "Value"))
    for t in (0.0, 1.0):
        a.feed(t, 257, False, b"\x02\x00\x00\x00")
    assert values(a.take(), "Value") == [(0.0, 1.0), (1.0, 1.0)]


def test_checked_message_must_have_both_signals() -> None:
    with pytest.raises(ValueError, match="Loads: no Counter"):
        admission(LEFT, checked=["Loads"])


@pytest.mark.parametrize("identifier", [SPEED, 0x0CFE4947, 0x1CFE49FE])
def test_standard_group_counts_from_any_source_and_priority(identifier: int) -> None:
    a = admission(("GroundSpeed", "Speed"))
    a.feed(0.0, identifier, True, b"\xe8\x03" + b"\xff" * 6)
    assert values(a.take(), "Speed") == [(0.0, 1.0)]


@pytest.mark.parametrize("identifier", [0x18FE4897, 0x19FE4997, 0x18FF2212, 0x0CFF2210])
def test_other_identifiers_do_not(identifier: int) -> None:
    a = admission(("GroundSpeed", "Speed"), ("Exact", "Value"))
    a.feed(0.0, identifier, True, bytes(8))
    a.take()
    assert (a.counts.unknown, a.counts.received.total()) == (1, 0)


def feed_sources(a: Admission, frames: Iterable[tuple[float, int]]) -> list[float]:
    for t, source in frames:
        a.feed(t, 0x18FE4900 | source, True, source.to_bytes(2, "little") + b"\xff" * 6)
    return [round(1000 * v) for _, v in values(a.take(), "Speed")]


def test_one_source_at_a_time() -> None:
    a = admission(("GroundSpeed", "Speed"))
    assert feed_sources(a, [(0.0, 0x47), (0.1, 0x1C), (0.2, 0x47)]) == [0x47, 0x47]
    assert feed_sources(a, [(0.3, 0x1C), (2.2, 0x1C)]) == []
    assert feed_sources(a, [(2.3, 0x1C), (2.4, 0x47), (2.5, 0x1C)]) == [0x1C, 0x1C]
    assert a.counts.refused == {("GroundSpeed", Reason.WRONG_SOURCE): 4}


def test_the_dbcs_own_source_takes_over() -> None:
    a = admission(("GroundSpeed", "Speed"))
    assert feed_sources(a, [(0.0, 0x47), (0.1, 0x97), (0.2, 0x47), (0.3, 0x97)]) == [0x47, 0x97, 0x97]
    assert (a.counts.received["GroundSpeed"], a.counts.admitted["GroundSpeed"]) == (4, 3)


def test_each_source_counts_for_itself() -> None:
    """The same counter value from the next source is no repeat; the identifier is in the checksum."""
    a = admission(("GuardedGroup", "Value"), checked=["GuardedGroup"])
    for t, identifier in ((0.0, 0x18FE4847), (5.0, 0x18FE481C)):
        data = bytes([7, 3, frame_checksum(identifier, bytes([7, 3, 0]), 2)])
        a.feed(t, identifier, True, data)
    assert values(a.take(), "Value") == [(0.0, 7.0), (5.0, 7.0)]


def test_group_that_the_dbc_gives_to_several_sources_goes_by_identifier() -> None:
    several = database()
    several.add_dbc_string('BO_ 2566801688 Second: 8 X\n SG_ Speed : 0|16@1+ (0.001,0) [0|64.255] "m/s" X\n')
    several.add_dbc_string('BO_ 2566801816 Third: 8 X\n SG_ Speed : 0|16@1+ (0.001,0) [0|64.255] "m/s" X\n')
    a = Admission([Channel("Speed", "", "GroundSpeed", "Speed", **COMMON)], several)
    for identifier in (SPEED, SPEED + 1, 0x0CFE4997):
        a.feed(0.0, identifier, True, bytes(8))
    assert len(a.take().columns["Speed"].t) == 1
    assert a.counts.unknown == 2
    assert a.can_filters() == [{"can_id": SPEED, "can_mask": 0x1FFFFFFF, "extended": True}]


@given(st.lists(st.tuples(st.integers(0, 30), st.sampled_from([1, 2, 3])), max_size=30))
def test_lock_never_mixes_sources_within_its_silence(steps: list[tuple[int, int]]) -> None:
    lock, t, heard = SourceLock(own=1), 0, (None, -math.inf)
    for step, source in steps:
        t += step
        if lock.admits(t / 10, source):
            assert source in (1, heard[0]) or t / 10 - heard[1] > 2.0
            heard = (source, t / 10)
        else:
            assert source != heard[0]
            assert source != 1


def test_a_source_that_comes_every_5_s_is_not_lost_between_two_frames() -> None:
    lock = SourceLock.at_cycle(own=1, cycle_time=5.0)
    said = [(0.0, 7), (2.5, 9), (5.0, 7), (7.5, 9), (10.0, 7), (24.9, 9), (25.1, 9), (26.0, 7), (27.0, 1), (28.0, 9)]
    assert [source for t, source in said if lock.admits(t, source)] == [7, 7, 7, 9, 1]
    assert SourceLock.at_cycle(own=1, cycle_time=0.1).patience == SourceLock(own=1).patience == 2.0


def test_of_two_receivers_one_counts_though_positions_come_every_5_s() -> None:
    database = Database()
    database.add_dbc_file(Path(__file__).resolve().parents[2] / "dbc" / "iso11783.dbc")
    channel = Channel("latitude", "", "VehiclePosition", "Latitude", **COMMON)
    a = Admission([channel], database)
    place = database.get_message_by_name("VehiclePosition").frame_id & ~0xFF
    for i in range(8):
        a.feed(2.5 * i, place | (0x40, 0x41)[i % 2], True, bytes.fromhex("00752B7D00752B7D"))
    assert a.take().columns["latitude"].t.tolist() == [0.0, 5.0, 10.0, 15.0]


def passes(filters: list[dict[str, Any]], identifier: int, extended: bool) -> bool:
    return any(f["extended"] == extended and identifier & f["can_mask"] == f["can_id"] & f["can_mask"] for f in filters)


@given(st.data())
def test_filters_pass_exactly_what_is_filed(data: st.DataObject) -> None:
    a = admission(LEFT, ("GroundSpeed", "Speed"), ("Exact", "Value"))
    near = [256, 257, SPEED, 0x0CFE4900, 0x18FF2210, 0x18FF2211, 0x1FFE4997]
    bit = st.sampled_from([0, *(1 << i for i in range(29))])
    identifier = data.draw(st.sampled_from(near)) ^ data.draw(bit)
    extended = identifier > 0x7FF or data.draw(st.booleans())
    a.feed(0.0, identifier, extended, bytes(8))
    assert passes(a.can_filters(), identifier, extended) == (a.counts.unknown == 0)


def test_multiplexed_signals_have_samples_only_where_they_are() -> None:
    a = admission(("Muxed", "A"), ("Muxed", "B"))
    for t, page in enumerate([0, 1, 2, 0]):
        a.feed(float(t), 258, False, bytes([page, t, 0]))
    out = a.take()
    assert (values(out, "A"), values(out, "B"), out.refused) == ([(0.0, 0.0), (3.0, 3.0)], [(1.0, 1.0)], {})


def test_two_messages_of_one_identifier_cannot_be_told_apart() -> None:
    twins = Database(strict=False)
    for name in ("One", "Two"):
        twins.add_dbc_string(f'BO_ 256 {name}: 2 X\n SG_ V : 0|16@1+ (1,0) [0|1] "" X\n')
    channels = [Channel(quantity=m, wheel="", message=m, signal="V", **COMMON) for m in ("One", "Two")]
    with pytest.raises(ValueError, match="0x100"):
        Admission(channels, twins)
