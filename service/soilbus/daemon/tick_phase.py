"""The beat of the ten-hertz frames, which is brought into step with the windows."""

from __future__ import annotations

import math

from soilbus.pipeline.outputs import TICK

LEAD_BEFORE_WINDOW_END = 0.01
"""A tick falls this long [s] before a window's end: it decodes what the window would else have to, and the next one
does not halt the worker, with which the loop shares one interpreter, while that has the window."""
MAX_PERIOD_CHANGE = 0.05 * TICK
"""By so much [s] a period may differ from TICK until it is so."""


def next_tick(tick: float, end: float) -> float:
    """When the tick after that of `tick` is due, where a window ends at `end`; nan and inf: not known; all [s]."""
    if not math.isfinite(end):
        return tick + TICK
    off = math.remainder(end - LEAD_BEFORE_WINDOW_END - tick, TICK)
    return tick + TICK + min(max(off, -MAX_PERIOD_CHANGE), MAX_PERIOD_CHANGE)
