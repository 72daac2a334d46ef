"""Health of the bus: values of the frame BusHealth, and a text for systemd's STATUS line.

The frame carries the controller's state and counts since the start. A count stays at the top of its range;
the count of received frames wraps at RECEIVED_MODULUS, so that a reader can take differences.
"""

from __future__ import annotations

from typing import Any

from soilbus.can.bus import BusCounts, BusState

RECEIVED_MODULUS = 4016
"""The 12-bit count of received frames is 0..4015."""

_WORDS = {
    "overruns": "received frames lost for want of room",
    "dropped": "frames of ours not sent",
    "error_frames": "error frames",
    "garbled": "frames that the driver could not read",
    "foreign": "frames of another sender under our identifiers",
    "reopened": "times reopened",
}


def health_frame(state: BusState, counts: BusCounts) -> tuple[str, dict[str, Any]]:
    """Return message name and values by signal name of the frame BusHealth."""
    return "BusHealth", {
        "BusState": str(state),
        "Reopened": counts.reopened,
        "Overruns": counts.overruns,
        "Dropped": counts.dropped,
        "ForeignFrames": counts.foreign,
        "ErrorFrames": counts.error_frames,
        "Received": counts.received % RECEIVED_MODULUS,
    }


def health_text(state: BusState, counts: BusCounts) -> str:
    """Return what is wrong, such as "3 error frames, controller error_passive"; nothing if all is well."""
    found = [f"{n} {words}" for name, words in _WORDS.items() if (n := getattr(counts, name))]
    if state not in (BusState.UNKNOWN, BusState.ACTIVE):
        found.append(f"controller {state}")
    return ", ".join(found)
