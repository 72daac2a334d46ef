"""Configuration -> a service that is ready to run.

Bus, filters, publisher and intake are made here; the worker thread loads what only it needs (estimator, stored state)
while the loop listens already.  It then solves a few made-up windows, so that the first real one is fast.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from cantools.database.can import Database

from soilbus.allocator import loading
from soilbus.can.bus import BusError, LiveBus, open_bus
from soilbus.can.dbc_files import filters_of, load_databases, output_database
from soilbus.can.j1939 import source_of
from soilbus.can.publish import Publisher
from soilbus.config.model import Config, ConfigError
from soilbus.daemon.notify import Notifier
from soilbus.daemon.service import Service
from soilbus.pipeline.outputs import check_cycle_times
from soilbus.pipeline.pipeline import Pipeline
from soilbus.pipeline.result import WindowResult

if TYPE_CHECKING:
    from soilbus.daemon.address_claim import AddressClaim
    from soilbus.daemon.state_persistence import StatePersistence

SWITCH_INTERVAL = 0.0005
"""Time [s] after which the interpreter switches threads: the loop must run between the estimator's steps, or the
socket's buffer overflows."""


def start_service(
    config: Config,
    wait: bool,
    on_window: Callable[[WindowResult], None] | None = None,
    rehearse: bool = True,
) -> Service:
    """Return the service of a configuration, with its bus open.

    With `wait` an interface that does not exist yet may appear later. With `rehearse` the worker solves made-up windows
    while the first real one fills.

    Raises
    ------
    ConfigError
        The configuration cannot work.
    BusError
        The bus cannot be opened.
    """
    pipeline, ours = Pipeline(config, load_databases(config, mapped_only=True)), output_database(config)
    check_cycle_times(config, ours)
    claim = _claim(config, ours)
    publisher = Publisher(ours)
    settings = config.bus.model_dump()
    filters = pipeline.admission.can_filters() + filters_of(ours) + ([] if claim is None else list(claim.filters))
    own = [(message.frame_id, message.is_extended_frame) for message in ours.messages]
    bus = LiveBus(lambda: open_bus(settings, filters), time.monotonic, time.sleep, own)
    try:
        bus.open()
    except BusError as error:
        if not (wait and error.may_come):
            raise
    # The loop must get its turn between the estimator's steps, or the socket overflows.
    sys.setswitchinterval(SWITCH_INTERVAL)
    workers = ThreadPoolExecutor(max_workers=1, thread_name_prefix="estimate")
    if bus.holds_seconds:
        workers.submit(_load)
    else:
        _load()
    service = Service(
        config, pipeline, bus, publisher, Notifier.from_environment(), workers, on_window=on_window,
        open_persistence=partial(_state_persistence, pipeline, os.environ), claim=claim,
    )  # fmt: skip
    if rehearse:
        workers.submit(_rehearse, config, pipeline.database, ours)  # where it raises, the first window is late, no more
    return service


def _claim(config: Config, ours: Database) -> AddressClaim | None:
    """Return the address claim that [j1939] asks for, with the address of our frames."""
    if not config.j1939.address_claim:
        return None
    from soilbus.daemon.address_claim import AddressClaim

    addresses = {source_of(message.frame_id) for message in ours.messages if message.is_extended_frame}
    if len(addresses) != 1:
        raise ConfigError([f"j1939.address: missing; the frames of {config.output.dbc} have no one address"])
    return AddressClaim(config.j1939, addresses.pop())


def _load() -> None:
    """Import what only the worker needs.

    The service listens already. An import holds the interpreter for so long that on a slow machine the kernel's default
    buffer runs full; then it is done before, in the loop's thread.
    """
    with loading():
        import soilbus.daemon.state_persistence  # noqa: F401


def _rehearse(config: Config, database: Database, ours: Database) -> None:
    """In the worker: solve a few made-up windows."""
    from soilbus.daemon.warm_up import warm_up

    warm_up(config, database, ours)


def _state_persistence(pipeline: Pipeline, environ: Mapping[str, str]) -> StatePersistence | None:
    """In the worker: the state in the folder that systemd names; None where there is no folder."""
    folder = environ.get("STATE_DIRECTORY", "").partition(":")[0]
    if not folder:
        return None
    from soilbus.daemon.state_persistence import StatePersistence
    from soilbus.daemon.state_store import Owner

    writer = ThreadPoolExecutor(max_workers=1, thread_name_prefix="store")
    return StatePersistence(
        Path(folder), Owner.of(pipeline.config, pipeline.intake.channels, pipeline.database), writer
    )
