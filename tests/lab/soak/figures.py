"""What a soak run is judged by: the service's own counters against the wire's, estimates, memory, deadlines."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from soilbus.can.channels import Reason
from soilbus.decision.traversability import Status
from soilbus.pipeline.result import WindowResult

PAGE = 4096


class Hour(NamedTuple):
    """One hour of a run: windows and valid ones, relative error (rms) and error over std (rms, worst) of the
    bearing pressure of the valid ones, resident memory [bytes] kept near its end."""

    windows: int
    valid: int
    error: float
    rms_z: float
    worst_z: float
    memory: int


@dataclass
class Estimates:
    """Valid windows' bearing pressures since the last look."""

    truth: float
    windows: int = 0
    errors: list[tuple[float, float]] = field(default_factory=list)

    def add(self, result: WindowResult) -> None:
        """Take note of one window."""
        self.windows += 1
        if result.status is Status.VALID and result.bearing is not None:
            off = result.bearing.value - self.truth
            self.errors.append((off / self.truth, off / result.bearing.std))

    def hour(self, memory: int) -> Hour:
        """What was noted, which is forgotten, with the memory kept [bytes]."""
        relative, z = np.array(self.errors or [(math.nan, math.nan)]).T
        done = Hour(
            self.windows, len(self.errors), _rms(relative), _rms(z), float(np.abs(z).max()), memory,
        )  # fmt: skip
        self.windows, self.errors = 0, []
        return done


@dataclass
class Beat:
    """When one frame went out: counts those that left the grid of its period [s].

    The grid may follow by `slew` [s] from one frame to the next; `drift` is how far it went altogether.
    """

    period: float
    slack: float
    slew: float
    due: float | None = None
    sent: int = 0
    off: int = 0
    late: float = 0.0
    drift: float = 0.0

    def add(self, t: float) -> None:
        """Take note of one sending at t [s]."""
        due = t if self.due is None else self.due
        self.late = (t - due + self.period / 2) % self.period - self.period / 2
        followed = min(max(self.late, -self.slew), self.slew)
        self.due = t - self.late + followed
        self.drift += followed
        self.sent += 1
        self.off += abs(self.late) > self.slack


def unaccounted(
    received: Counter[str], admitted: Counter[str], refused: Counter[tuple[str, Reason]], delivered: Counter[str]
) -> dict[str, int]:
    """Frames by message name that were handed over and are neither admitted nor refused for a reason."""
    names = set(received) | set(delivered)
    by_name: Counter[str] = Counter()
    for (name, _), n in refused.items():
        by_name[name] += n
    lost = {name: delivered[name] - admitted[name] - by_name[name] for name in sorted(names)}
    lost |= {f"{name} (counted)": delivered[name] - received[name] for name in sorted(names)}
    return {name: n for name, n in lost.items() if n}


def resident_memory() -> int:
    """Of this process [bytes]; looked at thousands of times, so without a Path, whose parts stay behind."""
    with open("/proc/self/statm") as statm:
        return int(statm.read().split()[1]) * PAGE


def _rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(x))))
