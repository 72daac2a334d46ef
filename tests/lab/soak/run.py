"""The service on the faulty wire, hour after hour."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from typing import NamedTuple

from cantools.database import Database

from fakes import FakeClock, InlineExecutor
from soilbus.can.bus import LiveBus
from soilbus.can.dbc_files import load_databases, output_database
from soilbus.can.publish import Publisher
from soilbus.daemon.notify import Notifier
from soilbus.daemon.service import Service
from soilbus.daemon.warm_up import warm_up
from soilbus.pipeline.pipeline import Pipeline
from soilbus.simulator.reference import reference_configuration
from soilbus.terra.soils import soil_named
from tests.lab.soak.figures import Beat, Estimates, Hour, resident_memory, unaccounted
from tests.lab.soak.traffic import SOIL, traffic_beside
from tests.lab.soak.wire import Wire

HOUR = 3600.0
CYCLE, JITTER = 0.1, 0.006
"""Cycle [s] of the frames that others act on, and by how much one may be longer or shorter: 6 %."""
SLACK = 0.03
"""How much later than its beat [s] a frame may go: the loop waits up to 20 ms for a frame."""
LOOK = 150.0
"""How long before an hour's end [s] its memory is looked at: the least of what is resident is what is kept, as free
memory goes back once a minute and what one window needs comes and goes."""


class Soak(NamedTuple):
    """What a run showed: hours (the last may be short), frames received, admitted, refused by reason, unknown,
    lost (by message), faults by kind, deadline misses, ten-hertz frames sent and how many left their beat,
    how far [s] that shifted altogether, and how often the numbering of windows restarted, which the beat follows."""

    hours: list[Hour]
    received: int
    admitted: int
    refused: Counter[str]
    unknown: int
    lost: dict[str, int]
    faults: Counter[str]
    deadline_misses: int
    sent: int
    off_beat: int
    drift: float
    epochs: int


def soak(duration: float, seed: int, each_hour: Callable[[Hour], None] = lambda hour: None, hour: float = HOUR) -> Soak:
    """Run the service for `duration` [s] of its clock; `hour` [s] is how often it is looked at."""
    config = reference_configuration()
    clock = FakeClock()
    database, out = load_databases(config), output_database(config)
    warm_up(config, database, out)  # as start_service does
    wire = Wire(clock, traffic_beside(config, seed), seed)
    pipeline = Pipeline(config, database)
    estimator = config.estimator
    estimates = Estimates(soil_named(SOIL).bearing_pressure(estimator.z_ref, estimator.b_ref))
    service = Service(
        config, pipeline, LiveBus(lambda: wire, clock, clock.sleep), Publisher(out), Notifier(), InlineExecutor(),
        clock, estimates.add,
    )  # fmt: skip
    verdict = out.get_message_by_name("Traversability").frame_id
    beat = Beat(CYCLE, SLACK, JITTER)
    wire.on_send = lambda t, message: beat.add(t) if message.arbitration_id == verdict else None
    hours: list[Hour] = []
    end = clock.now + duration
    while clock.now < end:
        until = min(clock.now + hour, end)
        kept = math.inf
        while clock.now < until:
            service.step()
            if clock.now >= until - LOOK:
                kept = min(kept, resident_memory())
        hours.append(estimates.hour(int(kept)))
        each_hour(hours[-1])
    service.intake.ingest()
    return _shown(service, wire, database, hours, beat)


def _shown(service: Service, wire: Wire, database: Database, hours: list[Hour], beat: Beat) -> Soak:
    counts = service.intake.admission.counts
    names = {m.frame_id: m.name for m in database.messages}
    delivered: Counter[str] = Counter()
    for identifier, n in wire.delivered.items():
        delivered[names.get(identifier, "")] += n
    strangers = delivered.pop("", 0)
    lost = unaccounted(counts.received, counts.admitted, counts.refused, delivered)
    if strangers != counts.unknown:
        lost["unknown"] = strangers - counts.unknown
    if wire.error_frames != service.bus.counts.error_frames:
        lost["error frames"] = wire.error_frames - service.bus.counts.error_frames
    refused: Counter[str] = Counter()
    for (_, reason), n in counts.refused.items():
        refused[str(reason)] += n
    return Soak(
        hours,
        sum(counts.received.values()),
        sum(counts.admitted.values()),
        refused,
        counts.unknown,
        lost,
        wire.gone,
        service.deadline_misses,
        beat.sent,
        beat.off,
        beat.drift,
        service.intake.epoch,
    )
