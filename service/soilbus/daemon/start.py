"""Configuration -> a service that is ready to run."""

from __future__ import annotations

import time
from collections.abc import Callable

from soilbus.can.bus import BusError, LiveBus, open_bus
from soilbus.can.dbc_files import load_databases, output_database
from soilbus.can.publish import Publisher
from soilbus.config import Config
from soilbus.daemon.notify import Notifier
from soilbus.daemon.pipeline import Pipeline, WindowResult
from soilbus.daemon.service import Service


def start_service(config: Config, wait: bool, on_window: Callable[[WindowResult], None] | None = None) -> Service:
    """The service with its bus open; with `wait` an interface that is not there yet may come later.

    Raises ConfigError for a configuration that cannot work, BusError for a bus that
    cannot be opened.
    """
    pipeline = Pipeline(config, load_databases(config))
    publisher = Publisher(output_database(config))
    settings = config.bus.model_dump()
    filters = pipeline.admission.can_filters()
    bus = LiveBus(lambda: open_bus(settings, filters), time.monotonic, time.sleep)
    try:
        bus.open()
    except BusError as error:
        if not (wait and error.may_come):
            raise
    return Service(config, pipeline, bus, publisher, Notifier.from_environment(), on_window=on_window)
