"""State persistence: the state file is written at the start, once a minute and at the end.

A thread of its own writes, so no disk halts the loop. The file holds the newest posterior of soil and sensor gains,
the number of starts and the counters since the first start (totals = stored totals + counts of this run). A state that
cannot be read is one warning and the estimate begins without it; a folder that cannot be written is one warning until
it can be written again.
"""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable, Mapping
from concurrent.futures import Executor, Future, wait
from pathlib import Path
from typing import NamedTuple

from soilbus.daemon.state_store import (
    OtherOwner,
    Owner,
    State,
    StateError,
    dumped,
    gaussian_of,
    read,
    stored_gaussian,
    write_whole,
)
from soilbus.estimation.gaussian import Gaussian
from soilbus.estimation.options import ESTIMATOR
from soilbus.words import one_line

log = logging.getLogger(__name__)

STORE_PERIOD = 60.0
"""Time [s] between two writes: the most that a power cut loses."""
MAX_LAST_WRITE_TIME = 3.0
"""Time [s] that the end waits for the last write."""
FILE = "state.json"


class StoredPrior(NamedTuple):
    """Posterior of the last run, and its age [s]."""

    gaussian: Gaussian
    elapsed: float


class StatePersistence:
    """Keeper of one vehicle's state in a folder, which a thread of its own writes with the time of day [s, Unix]."""

    def __init__(self, folder: Path, owner: Owner, writer: Executor, wall: Callable[[], float] = time.time) -> None:
        self._path, self._owner, self._writer, self._wall = folder / FILE, owner, writer, wall
        self._is_of_other = False
        self._previous = self._read()
        self._stored = None if self._previous is None else self._previous.gaussian
        self._seen: Gaussian | None = None
        self._writing: Future[None] | None = None
        self._fails = False
        self._next = float("-inf")

    @property
    def stored_prior(self) -> StoredPrior | None:
        """Posterior of the last run and its age: gain_correlation_time if the clock was set back; None without one."""
        if self._previous is None or self._previous.gaussian is None:
            return None
        elapsed = self._wall() - self._previous.gaussian.at
        return StoredPrior(
            gaussian_of(self._previous.gaussian, self._owner),
            elapsed if elapsed >= 0.0 else ESTIMATOR.tracker.gain_correlation_time,
        )

    def tick(self, now: float, gaussian: Gaussian | None, counts: Callable[[], Mapping[str, int]]) -> None:
        """Begin to write the state of this run if that is due; return at once."""
        if now < self._next:
            return
        self._next = now + STORE_PERIOD
        if self._writing is None or self._writing.done():
            self._write(gaussian, counts())

    def close(self, gaussian: Gaussian | None, counts: Mapping[str, int]) -> None:
        """Write the last state; wait for it, but not long."""
        self._write(gaussian, counts)
        if self._writing is not None:
            wait([self._writing], MAX_LAST_WRITE_TIME)
        self._writer.shutdown(wait=False)

    def _read(self) -> State | None:
        try:
            return read(self._path, self._owner)
        except StateError as error:
            self._is_of_other = isinstance(error, OtherOwner)
            log.warning("stored state %s is not used, the estimate begins afresh: %s", self._path, error)
            return None

    def _write(self, gaussian: Gaussian | None, counts: Mapping[str, int]) -> None:
        """`gaussian` is None as long as this run has none: then the last run's stays."""
        is_new, self._seen = gaussian is not None and gaussian is not self._seen, gaussian
        self._writing = self._writer.submit(self._store, gaussian if is_new else None, dict(counts))

    def _store(self, gaussian: Gaussian | None, counts: Mapping[str, int]) -> None:
        """In the writer's thread."""
        at = max(self._wall(), 0.0)
        if gaussian is not None:
            try:
                self._stored = stored_gaussian(gaussian, at, self._owner)
            except StateError as error:
                log.info("the present posterior is not stored: %s", error)
        previous = self._previous
        if self._is_of_other and self._stored is None:
            return  # it stays until there is a posterior to store: the configuration may be given by mistake
        totals = Counter(counts) + Counter({} if previous is None else previous.totals)
        starts = 1 if previous is None else previous.starts + 1
        try:
            content = dumped(State(at=at, starts=starts, gaussian=self._stored, totals=dict(totals)), self._owner)
            write_whole(self._path, content)
        except Exception as error:  # an error of this thread would reach nobody
            if not self._fails:
                why = getattr(error, "strerror", None) or one_line(error)
                log.warning("state cannot be stored in %s: %s", self._path.parent, why)
            self._fails = True
            return
        self._fails = False
