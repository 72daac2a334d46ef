"""Recorded logs as records for the diagnosis: each log as one window, through the daemon's own admission and bins.

A log is one record, or several where its clock was set or it was silent for long; a part without enough instants is
left out and named.
"""

from __future__ import annotations

import hashlib
import math
import os
import stat
from collections import Counter
from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from cantools.database.can import Database

from soilbus.can.admission import LONGEST_GAP
from soilbus.config.model import Config
from soilbus.diagnosis.records import Record, TooLittle, record_of
from soilbus.estimation.assembly import effects_and_parameters_of, model_of, rig_of
from soilbus.estimation.window import Window
from soilbus.offline.replay import LogError, fed, log_names
from soilbus.pipeline.intake import Intake


@dataclass(frozen=True, slots=True)
class Recordings:
    """Logs of one vehicle: a record for each usable part, and the index of the first one of each log.

    With them stand the samples in them, refused samples by reason, and names of the parts that were too short to use.
    """

    records: tuple[Record, ...]
    first: tuple[int, ...]
    samples: int
    rejected: dict[str, int]
    too_short: tuple[str, ...]


def recordings_of(
    config: Config,
    database: Database,
    logs: Sequence[Path],
    progress: Callable[[int, float], None] | None = None,
    longest: float = math.inf,
    partial: bool = False,
) -> Recordings:
    """Read logs as recordings of one vehicle, no more than `longest` [s] of each.

    With `partial` what lies before the damage of a log counts. `progress` is called with the number of frames read and
    the time in the recording [s].

    LogError where a log cannot be read to its end (with `partial`: at all), is of another bus, or is given twice;
    TooLittle where it has no usable part; ConfigError where configuration and database do not fit together.
    """
    check_different(logs)
    rig, model, settings = rig_of(config), model_of(config), config.estimator
    effects, free = effects_and_parameters_of(config, undelayed=False)
    records: list[Record] = []
    first, too_short, rejected, samples = [], [], Counter[str](), 0
    for path, log in zip(logs, log_names(logs), strict=True):
        intake = Intake(config, database, {})
        first.append(len(records))
        fault: TooLittle | None = None
        for i, window in enumerate(parts(intake, path, progress, longest, partial)):
            samples += window.samples
            name = log if i == 0 else f"{log}, part {i + 1}"
            try:
                record = record_of(name, window, rig, model, settings.min_speed, settings.max_turn)
            except TooLittle as error:
                fault = fault or error
                too_short.append(name)
                continue
            records.append(record.with_effects(effects, free))
        rejected += intake.refusals.total
        if len(records) == first[-1]:
            raise TooLittle(_why(log, intake, fault))
    return Recordings(tuple(records), tuple(first), samples, dict(rejected.most_common()), tuple(too_short))


def check_different(logs: Sequence[Path]) -> None:
    """Refuse a recording that is given twice, as one file or as a copy, with a LogError.

    Files that differ in size are not read.
    """
    known = [(log, log.stat()) for log in logs if os.path.exists(log)]
    sizes = Counter(status.st_size for _, status in known)
    first: dict[Hashable, Path] = {}
    for log, status in known:
        marks: list[Hashable] = [(status.st_dev, status.st_ino)]
        if stat.S_ISREG(status.st_mode) and sizes[status.st_size] > 1:
            try:
                with log.open("rb") as file:
                    marks.append(hashlib.file_digest(file, "sha256").digest())
            except OSError as error:
                raise LogError(f"{log}: {error.strerror}") from None
        for mark in marks:
            if mark in first:
                raise LogError(f"{first[mark]} and {log} are the same recording, which counts once: leave one out")
            first[mark] = log


def parts(
    intake: Intake,
    log: Path,
    progress: Callable[[int, float], None] | None = None,
    longest: float = math.inf,
    partial: bool = False,
) -> Iterator[Window]:
    """Yield the windows of a log, one for each stretch without a set clock or a long silence.

    LogError where the log cannot be read to its end; with `partial` only where nothing of it can.
    """
    whole: list[Window] = []

    def end() -> None:
        intake.ingest()
        if (window := intake.taken_whole()) is not None:
            whole.append(window)

    intake.admission.at_break = end
    length, last = 0.0, math.nan
    try:
        for now in fed(intake, log, progress):
            yield from whole
            whole.clear()
            intake.ingest(now)
            length += 0.0 if math.isnan(last) else min(max(now - last, 0.0), LONGEST_GAP)  # the clock may be set
            last = now
            if length > longest:
                break
    except LogError:
        if not partial or math.isnan(last):
            raise
    end()
    yield from whole


def _why(log: str, intake: Intake, fault: TooLittle | None) -> str:
    """What is wrong with a log without a usable part."""
    admitted = intake.admission.counts.admitted
    unheard = [channel.name for channel in intake.needed if not admitted[channel.message]]
    what = f"{log}: no usable instant in it" if fault is None else str(fault)
    return what + (f"; never heard: {', '.join(unheard)}" if unheard else "")
