"""Phase of the 10 Hz ticks, locked to the ends of the windows.

    phase error = (window end - 10 ms - tick) mod 0.1 s, between -50 and +50 ms
    period      = 0.1 s + clip(phase error, -5 ms, +5 ms)

A tick decodes frames, and with a tick just before a window's end little is left to decode when it ends; the next tick
is then a full period away and does not halt the worker, with which the loop shares one interpreter.
"""

from __future__ import annotations

import math

from soilbus.pipeline.outputs import TICK

LEAD_BEFORE_WINDOW_END = 0.01
"""Time [s] by which a tick comes before a window's end."""
MAX_PERIOD_CHANGE = 0.05 * TICK
"""Greatest change [s] of one period while the phase is brought into place."""


def next_tick(tick: float, end: float) -> float:
    """Return when [s] the next tick is due after the last one, by the end of a window (nan or inf: not known)."""
    if not math.isfinite(end):
        return tick + TICK
    off = math.remainder(end - LEAD_BEFORE_WINDOW_END - tick, TICK)
    return tick + TICK + min(max(off, -MAX_PERIOD_CHANGE), MAX_PERIOD_CHANGE)
