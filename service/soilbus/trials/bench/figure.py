"""One figure of the bench, and the timing of code on a machine with other load.

time = least of several runs: other load only adds
"""

from __future__ import annotations

import time
import timeit
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Figure:
    """Value with its target, the least or (at_most) the greatest that will do; None: no target.

    peer and what are a few words for the table, more are lines below it, all the numbers behind it.
    """

    value: float
    target: float | None
    peer: str
    what: str
    at_most: bool = False
    digits: int = 1
    more: tuple[str, ...] = ()

    @property
    def met(self) -> bool | None:
        """Whether the value is as good as the target asks; None without a target."""
        if self.target is None:
            return None
        return self.value <= self.target if self.at_most else self.value >= self.target

    @property
    def aim(self) -> str:
        """The target as the table has it."""
        if self.target is None:
            return ""
        return f"{'<=' if self.at_most else '>='} {self.target:g}{'' if self.met else ' missed'}"


def wall_time(work: Callable[[], Any], repeats: int) -> float:
    """Return the shortest wall time of several runs [s]: what else the machine does only adds."""
    return min(timeit.repeat(work, number=1, repeat=repeats))


def in_turn(works: Sequence[Callable[[], Any]], rounds: int) -> NDArray[np.float64]:
    """Return the least processor time [s] of each work (len(works),), all run once in each round.

    So a busy machine slows all of them alike.
    """
    times = [[timeit.timeit(work, timer=time.process_time, number=1) for work in works] for _ in range(rounds)]
    return np.asarray(np.min(times, axis=0))
