"""When the state is stored: at the start, once a minute and at the end, beside the loop, so that no disk halts it."""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable, Mapping
from concurrent.futures import Executor, Future, wait
from pathlib import Path
from typing import NamedTuple

from soilbus.daemon.state_store import Owner, State, StateError, dumped, gaussian_of, read, stored_gaussian, write_whole
from soilbus.estimation.gaussian import Gaussian
from soilbus.estimation.tracker import GAIN_CORRELATION_TIME
from soilbus.words import one_line

log = logging.getLogger(__name__)

PERIOD = 60.0
"""Seconds between two writings, so what a power cut takes at most."""
LONGEST_LAST = 3.0
"""Seconds that the end waits for the last writing."""
FILE = "state.json"


class Recalled(NamedTuple):
    """What another run knew, and how many seconds ago."""

    gaussian: Gaussian
    elapsed: float


class StatePersistence:
    """Keeps one vehicle's state in a folder; `writer` is a thread of its own, `wall` the time of day [s, Unix].

    A state that cannot be used is one warning, and everything begins afresh.  So is a folder
    that cannot be written: one warning, until it can be again.
    """

    def __init__(self, folder: Path, owner: Owner, writer: Executor, wall: Callable[[], float] = time.time) -> None:
        self._path, self._owner, self._writer, self._wall = folder / FILE, owner, writer, wall
        self._before = self._read()
        self._stored = None if self._before is None else self._before.gaussian
        self._seen: Gaussian | None = None
        self._writing: Future[None] | None = None
        self._fails = False
        self._next = float("-inf")

    @property
    def recalled(self) -> Recalled | None:
        """What the run before knew; of unknown age, and then taken for old, where the clock was set back since."""
        if self._before is None or self._before.gaussian is None:
            return None
        elapsed = self._wall() - self._before.gaussian.at
        return Recalled(
            gaussian_of(self._before.gaussian, self._owner), elapsed if elapsed >= 0.0 else GAIN_CORRELATION_TIME
        )

    def tick(self, now: float, gaussian: Gaussian | None, counts: Callable[[], Mapping[str, int]]) -> None:
        """Have the state written if that is due at the monotonic time `now` [s]; returns at once."""
        if now < self._next:
            return
        self._next = now + PERIOD
        if self._writing is None or self._writing.done():
            self._write(gaussian, counts())

    def close(self, gaussian: Gaussian | None, counts: Mapping[str, int]) -> None:
        """Have the last state written; waits for it, but not long."""
        self._write(gaussian, counts)
        if self._writing is not None:
            wait([self._writing], LONGEST_LAST)
        self._writer.shutdown(wait=False)

    def _read(self) -> State | None:
        try:
            return read(self._path, self._owner)
        except StateError as error:
            log.warning("stored state %s is not used, the estimate begins afresh: %s", self._path, error)
            return None

    def _write(self, gaussian: Gaussian | None, counts: Mapping[str, int]) -> None:
        """`gaussian` is None as long as this run has none: then the one of the run before stays."""
        is_new, self._seen = gaussian is not None and gaussian is not self._seen, gaussian
        self._writing = self._writer.submit(self._store, gaussian if is_new else None, dict(counts))

    def _store(self, gaussian: Gaussian | None, counts: Mapping[str, int]) -> None:
        """In the writer's thread."""
        at = max(self._wall(), 0.0)
        if gaussian is not None:
            try:
                self._stored = stored_gaussian(gaussian, at, self._owner)
            except StateError as error:
                log.info("the present belief is not stored: %s", error)
        before = self._before
        totals = Counter(counts) + Counter({} if before is None else before.totals)
        starts = 1 if before is None else before.starts + 1
        try:
            content = dumped(State(at=at, starts=starts, gaussian=self._stored, totals=dict(totals)), self._owner)
            write_whole(self._path, content)
        except Exception as error:  # whatever it is, a thread's error would reach nobody
            if not self._fails:
                why = getattr(error, "strerror", None) or one_line(error)
                log.warning("state cannot be stored in %s: %s", self._path.parent, why)
            self._fails = True
            return
        self._fails = False
