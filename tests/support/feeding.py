"""Frames of python-can into an admission."""

from __future__ import annotations

import can

from soilbus.can.admission import Admission


def feed_message(admission: Admission, message: can.Message) -> None:
    """One data or remote frame."""
    admission.feed(
        message.timestamp, message.arbitration_id, message.is_extended_id, message.data, message.is_remote_frame
    )
