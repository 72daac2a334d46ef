"""A listener beside the daemon: when each window's result came, and how many frames the daemon received.

latency = time of the frame SoilStrength - time of the window's last mapped frame    (kernel time stamps)
"""

from __future__ import annotations

import threading
import time
from typing import Any

import numpy as np

from soilbus.arrays import Array
from soilbus.can.bus import RECEIVE_BUFFER, open_bus
from soilbus.can.dbc_files import filters_of, load_databases, output_database
from soilbus.can.wire import wire_of
from soilbus.daemon.bus_health import RECEIVED_MODULUS
from soilbus.pipeline.intake import EDGE_LEAD, Intake
from soilbus.pipeline.outputs import WINDOW_MODULUS
from soilbus.simulator.reference import reference_configuration

MAX_PAUSE_SMALL_BUFFER = 0.05
"""Longest time [s] between two looks where the kernel's buffer does not hold seconds of frames."""


class Ear:
    """Receives the mapped messages and the daemon's on a channel, with the kernel's time stamps.

    It must be made while the channel is quiet: a socket receives all frames until its filters are set, and a foreign
    one would pass for the first mapped one.
    """

    def __init__(self, channel: str) -> None:
        self._config = reference_configuration()
        self._ours = output_database(self._config)
        mapped = Intake(self._config, load_databases(self._config)).admission.can_filters()
        filters = mapped + filters_of(self._ours)
        self._wire = wire_of(open_bus({"interface": "socketcan", "channel": channel}, filters))
        self._mapped: list[float] = []
        self._said: dict[int, list[tuple[float, bytes]]] = {m.frame_id: [] for m in self._ours.messages}
        self._on = True
        self._thread = threading.Thread(target=self._listen, daemon=True)

    def start(self) -> None:
        """Begin to listen; the first mapped frame to come must be the first that the daemon gets."""
        self._thread.start()

    def stop(self) -> None:
        """Stop listening."""
        self._on = False
        self._thread.join()
        self._wire.shutdown()

    def _listen(self) -> None:
        while self._on:
            frame = self._wire.recv(0.0)
            if frame is None:
                time.sleep(self._pause())
                continue
            if frame.arbitration_id in self._said:
                self._said[frame.arbitration_id].append((frame.timestamp, bytes(frame.data)))
            else:
                self._mapped.append(frame.timestamp)

    def _pause(self) -> float:
        """Time [s] for which frames may gather: the kernel stamps them, and listening takes the daemon time."""
        if not self._mapped:
            return MAX_PAUSE_SMALL_BUFFER
        pause = until_middle(time.time(), self._mapped[0], self._config.estimator.window, self._config.estimator.hop)
        return pause if self._wire.room >= RECEIVE_BUFFER else min(pause, MAX_PAUSE_SMALL_BUFFER)

    def latencies(self) -> Array:
        """Time [s] from the last mapped frame of each window so far to its frame SoilStrength."""
        said = self._of("SoilStrength", "Window")
        settings = self._config.estimator
        return latencies(np.array(self._mapped), np.array(said), settings.window, settings.hop)

    def longest_pause(self) -> float:
        """The longest time [s] in which no mapped frame came."""
        return float(np.diff(self._mapped).max(initial=0.0))

    def books(self) -> tuple[int, int]:
        """Frames that the daemon says it received, and that were dropped before it (up to 250)."""
        received = np.array([0.0] + [n for _, n in self._of("BusHealth", "Received")])
        dropped = [n for _, n in self._of("BusHealth", "Overruns")]
        return int((np.diff(received) % RECEIVED_MODULUS).sum()), int(max(dropped, default=0))

    def _of(self, message: str, signal: str) -> list[tuple[float, float]]:
        layout = self._ours.get_message_by_name(message)
        decoded: list[tuple[float, Any]] = [
            (t, layout.decode(data, decode_choices=False)) for t, data in self._said[layout.frame_id]
        ]
        return [(t, float(values[signal])) for t, values in decoded]


def latencies(mapped: Array, results: Array, window: float, hop: float) -> Array:
    """From the last mapped frame of a window to its result, (windows,) [s]; inf for one that never came.

    mapped (N,) are the times of mapped frames, ascending [s]; results (M, 2) time and number of the windows
    whose results came, numbers modulo WINDOW_MODULUS from 0.
    """
    if not len(results):
        return np.empty(0)
    number = np.unwrap(results[:, 1], period=WINDOW_MODULUS).astype(int)
    late = np.full(number[-1] + 1, np.inf)
    end = mapped[0] - EDGE_LEAD + window + hop * number
    late[number] = results[:, 0] - mapped[np.searchsorted(mapped, end) - 1]
    return late


def until_middle(now: float, first: float, window: float, hop: float) -> float:
    """Time [s] from `now` to the next middle between two windows' ends, where `first` is the first mapped frame's."""
    return (first - EDGE_LEAD + window + hop / 2.0 - now) % hop
