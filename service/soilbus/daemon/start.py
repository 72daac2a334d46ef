"""Configuration -> a service that is ready to run."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

from soilbus.can.bus import BusError, LiveBus, open_bus
from soilbus.can.dbc_files import load_databases, output_database
from soilbus.can.publish import Publisher
from soilbus.config import Config
from soilbus.daemon.notify import Notifier
from soilbus.daemon.outputs import check_cycle_times
from soilbus.daemon.pipeline import Pipeline, WindowResult
from soilbus.daemon.service import Service

SWITCH_INTERVAL = 0.0005


def start_service(config: Config, wait: bool, on_window: Callable[[WindowResult], None] | None = None) -> Service:
    """The service with its bus open; with `wait` an interface that is not there yet may come later.

    Raises ConfigError for a configuration that cannot work, BusError for a bus that
    cannot be opened.
    """
    pipeline = Pipeline(config, load_databases(config))
    output = output_database(config)
    check_cycle_times(config, output)
    publisher = Publisher(output)
    settings = config.bus.model_dump()
    filters = pipeline.admission.can_filters()
    bus = LiveBus(lambda: open_bus(settings, filters), time.monotonic, time.sleep)
    try:
        bus.open()
    except BusError as error:
        if not (wait and error.may_come):
            raise
    # The loop must get its turn between the estimator's steps, or the socket overflows.
    sys.setswitchinterval(SWITCH_INTERVAL)
    workers = ThreadPoolExecutor(max_workers=1, thread_name_prefix="estimate")
    return Service(config, pipeline, bus, publisher, Notifier.from_environment(), workers, on_window=on_window)
