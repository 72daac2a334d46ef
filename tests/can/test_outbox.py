"""What waits for room: one frame an identifier, the newest, and not for long."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from soilbus.can.outbox import Outbox
from soilbus.can.publish import Frame

CYCLE = 0.1
"""Seconds after which the next frame of an identifier is made: one that waited longer says nothing."""


def frame(identifier: int, content: int = 0) -> Frame:
    return Frame(identifier, True, bytes((content,)))


def test_a_newer_frame_takes_the_place_and_the_turn_of_the_older():
    box = Outbox()
    for i, (identifier, content) in enumerate([(1, 0), (2, 0), (1, 7)]):
        box.put(frame(identifier, content), 1e-3 * i)
    assert (len(box), box.dropped) == (2, 1)
    assert box.first(0.01) == frame(1, 7)
    box.done(frame(1, 7))
    assert box.first(0.01) == frame(2)


def test_late_frames_are_dropped():
    box = Outbox()
    box.put(frame(1), 0.0)
    box.put(frame(2), 0.05)
    assert box.first(0.02 + CYCLE) == frame(2)
    assert box.first(0.07 + CYCLE) is None
    assert (len(box), box.dropped) == (0, 2)


steps = st.lists(st.one_of(st.integers(0, 5), st.just("send"), st.just("clear")), max_size=60)


@given(steps, st.floats(0.0, 0.05))
def test_every_frame_is_sent_dropped_or_waits_and_none_is_sent_late_or_after_a_newer_one(actions, pause):
    box, put, sent, now = Outbox(), 0, 0, 0.0
    newest: dict[int, int] = {}
    made: dict[int, float] = {}
    for action in actions:
        now += pause
        if action == "send":
            if (out := box.first(now)) is not None:
                assert out.data[0] == newest[out.arbitration_id] % 256
                assert now - made[out.arbitration_id] <= CYCLE
                box.done(out)
                sent += 1
        elif action == "clear":
            box.clear()
            assert len(box) == 0
        else:
            put += 1
            newest[action], made[action] = put, now
            box.put(frame(action, put % 256), now)
    assert put == sent + box.dropped + len(box)
