"""Stories: what happens to a service from second to second, drawn from a seed."""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from typing import Any, NamedTuple

from tests.lab.stories.onlooker import WEAK, Drive

LAST = 0.4
"""Seconds of good frames at the end of a story."""
HEAL = 7.0
"""Seconds of good frames, beside a window's length, after which go is due again after any fault."""
STEPS = (-3600.0, -5.0, -1.5, -0.6, 0.4, 2.0, 70.0, 3600.0)
"""Seconds by which the clock that stamps frames is set."""
TO_SOME = ("deaf", "noisy", "spoilt", "repeated")
"""What happens to some of the messages: they do not come, or others in their place; are damaged; do not count on."""
TO_ALL = ("lost", "off", "halted", "forged", "clock", "restart", "killed", "hangs", "late")
TO_GROUND = ("blind", "soft", "raises", "weak", "unsaid")
"""What only a tracker that is given the truth knows of."""


class Event(NamedTuple):
    """Faults with their arguments, and how long they last [s]; no fault: all is well."""

    faults: dict[str, Any]
    seconds: float


def drawn(seed: int, messages: Sequence[str], kinds: Sequence[str] = (*TO_SOME, *TO_ALL, *TO_GROUND)) -> list[Event]:
    """One to three events, of which each has none, one or two faults at a time; some hit a part of the messages."""
    rng = random.Random(seed)
    return [_event(rng, messages, kinds) for _ in range(rng.randint(1, 3))]


def _event(rng: random.Random, messages: Sequence[str], kinds: Sequence[str]) -> Event:
    chosen = rng.sample(kinds, rng.choice((0, 1, 1, 1, 2, 2)))
    seconds = rng.choice((rng.uniform(0.1, 1.0), rng.uniform(1.0, 2.0), rng.uniform(2.0, 3.5)))
    return Event({kind: _argument(rng, kind, messages) for kind in chosen}, seconds)


def _argument(rng: random.Random, kind: str, messages: Sequence[str]) -> Any:
    if kind in TO_SOME:
        return frozenset(rng.sample(messages, rng.choice((1, 1, 2, len(messages)))))
    return {"clock": rng.choice(STEPS), "late": rng.uniform(0.2, 2.6)}.get(kind, True)


def played(drive: Drive, story: Sequence[Event], healed: bool = False) -> Drive:
    """The drive after a good start and the events; healed: until go is due again, which else is a fault."""
    window, firm = drive.config.estimator.window, not drive.wire.soft
    drive.run(window + 0.4)
    if drive.tracked is not None and not drive.go:
        drive.faults.append("no go where all is well")
    for event in story:
        begin(drive, event.faults)
        drive.run(event.seconds)
        end(drive, firm)
    drive.run(LAST)
    if healed:
        drive.run(window + HEAL - LAST)
        if str(drive.last["State"]) != "go":
            drive.faults.append(f"{drive.last['State']} after {window + HEAL} s in which all was well")
    return drive


def begin(drive: Drive, faults: dict[str, Any]) -> None:
    """The faults come."""
    for kind, what in faults.items():
        match kind:
            case "noisy":
                drive.wire.deaf, drive.wire.noisy = what, True
            case "weak" | "unsaid":
                drive.wire.power = WEAK
                if kind == "unsaid":  # some samples of the limit come, then none any more
                    drive.wire.mute_from = drive.clock.now + 4.0 * drive.wire.cycle
            case "hangs":
                drive.worker.hangs = True
            case "late":
                drive.worker.takes = what
            case "clock":
                drive.step_clock(what)
            case "restart":
                drive.stop()
                drive.start()
            case "killed":
                drive.start()
            case _:
                setattr(drive.wire, kind, what)


def end(drive: Drive, firm: bool = True) -> None:
    """All is well again; on firm ground or not."""
    wire = drive.wire
    wire.deaf = wire.spoilt = wire.repeated = frozenset()
    wire.noisy = wire.lost = wire.off = wire.halted = wire.forged = wire.blind = wire.raises = False
    wire.soft, wire.power, wire.mute_from = not firm, 1.0, math.inf
    drive.worker.wake()
