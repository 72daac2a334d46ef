"""Counters since the start, by name: the part of the state file that only ever grows."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict

from soilbus.can.admission import Counts
from soilbus.can.bus import BusCounts


def totals(
    windows: int, deadline_misses: int, failures: Mapping[str, int], bus: BusCounts, frames: Counts
) -> dict[str, int]:
    """Return the counters by name; deadline misses are windows dropped and ticks late."""
    refused: Counter[str] = Counter()
    for (_, reason), n in frames.refused.items():
        refused[f"refused.{reason}"] += n
    return {
        "windows": windows,
        "deadline_misses": deadline_misses,
        **{f"failed.{kind}": n for kind, n in failures.items()},
        **{f"bus.{name}": n for name, n in asdict(bus).items() if isinstance(n, int)},
        "frames": sum(frames.received.values()),
        **refused,
    }
