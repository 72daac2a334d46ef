"""The service on the faulty wire, hour after hour."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from typing import NamedTuple

from cantools.database import Database

from fakes import Bench, FakeClock
from soilbus.can.dbc_files import load_databases, output_database
from soilbus.daemon.service import Service
from soilbus.daemon.warm_up import warm_up
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
GROWTH = 1e6
"""Of resident memory [bytes] after the first hour that is allowed."""
WORSE = 1.3
"""Errors of the last quarter of the hours over those of the first that are chance: an hour's scatter by a tenth."""
FARTHEST = 5.0
"""Standard deviations that no valid window may be off, of some thousands an hour."""
LEAST_HOURS = 2
"""Fewer do not show what grows or drifts."""
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
    estimator = config.estimator
    estimates = Estimates(soil_named(SOIL).bearing_pressure(estimator.z_ref, estimator.b_ref))
    bench = Bench(config=config, clock=clock, take=estimates.add)
    bench.wire = wire = Wire(clock, traffic_beside(config, seed), seed)
    service = bench.service
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


class Demand(NamedTuple):
    """What was asked, what was found, and whether that will do; None where the run was too short."""

    asked: str
    found: str
    met: bool | None


def demands(shown: Soak) -> list[Demand]:
    """All of them, with what a run showed."""
    hours = [hour for hour in shown.hours if hour.valid]
    long_enough = len(shown.hours) >= LEAST_HOURS and len(hours) >= LEAST_HOURS
    growth = max(hour.memory for hour in shown.hours) - shown.hours[0].memory
    part = max(len(hours) // 4, 1)
    first, last = (sum(hour.error for hour in some) / part for some in (hours[:part], hours[-part:]))
    farthest = max((hour.worst_z for hour in hours), default=float("inf"))
    return [
        Demand(
            "every frame accounted for", f"lost {shown.lost or 'none'} of {shown.received}",
            not shown.lost and shown.received == shown.admitted + shown.refused.total(),
        ),
        Demand("no deadline missed", f"{shown.deadline_misses} missed", shown.deadline_misses == 0),
        Demand("every frame on its beat", f"{shown.off_beat} of {shown.sent} off it", shown.off_beat == 0 < shown.sent),
        Demand(
            "the beat drifts with the windows' ends only", f"{shown.drift:+.3f} s in {shown.epochs} beginnings",
            abs(shown.drift) <= CYCLE / 2 * shown.epochs + SLACK,
        ),
        Demand(
            f"memory grows by at most {GROWTH / 1e6:g} MB after the first hour", f"{growth / 1e6:+.2f} MB",
            growth <= GROWTH if long_enough else None,
        ),
        Demand(
            "estimates as good at the end as at the start", f"error {first:.2%} at first, {last:.2%} at last",
            last <= WORSE * first if long_enough else None,
        ),
        Demand(f"no valid window {FARTHEST:g} sd off", f"the farthest {farthest:.1f} sd", farthest < FARTHEST),
    ]  # fmt: skip
