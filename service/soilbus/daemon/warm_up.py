"""The work of a few windows, done once on a simulated drive before anything depends on how long it takes.

What is done for the first time costs several times as much: memory comes page by page from
the kernel, caches are empty.
"""

from __future__ import annotations

from cantools.database.can import Database

from soilbus.allocator import take_small_blocks
from soilbus.can.publish import Publisher
from soilbus.config.model import Config
from soilbus.pipeline.outputs import hop_frames
from soilbus.pipeline.pipeline import Pipeline
from soilbus.pipeline.result import WindowResult
from soilbus.simulator.frames import frames
from soilbus.simulator.recording import simulate
from soilbus.simulator.scenario import excited

WINDOWS = 3
"""The first one searches for the soil, later ones follow it."""


def warm_up(config: Config, database: Database, ours: Database) -> list[WindowResult]:
    """The windows' results, by a pipeline and a publisher of its own, which are then thrown away.

    Raises as `simulate` for a vehicle that cannot drive, or has no sensors to drive with.
    """
    pipeline, publisher = Pipeline(config, database), Publisher(ours)
    settings = config.estimator
    drive = excited(duration=settings.window + (WINDOWS - 0.5) * settings.hop)
    last = 0.0
    for frame in frames(simulate(config, drive, seed=1), config, database):
        last = frame.timestamp
        pipeline.feed(last, frame.arbitration_id, frame.is_extended_id, frame.data)
    results = pipeline.finish(last)
    for result in results:
        for message, values in hop_frames(result):
            publisher.frame(message, values)
    take_small_blocks()
    return results
