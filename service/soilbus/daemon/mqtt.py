"""Windows to an MQTT broker, from a thread of its own: the loop appends to a queue and never waits.

    loop:    put(result) -> queue of QUEUE_LENGTH, the oldest dropped and counted
    worker:  queue -> JSON -> publish, one message in flight until the broker has acknowledged it (QoS 1)

TOPIC/window holds the JSON object of `replay --json`; TOPIC/status is "online", or "offline" when the broker has lost
us (last will).  A broker that is down or hangs changes nothing but the count in the status line.
"""

from __future__ import annotations

import logging
import math
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from soilbus.config.model import Config, ConfigError, Mqtt
from soilbus.pipeline.outputs import json_line
from soilbus.pipeline.result import WindowResult

if TYPE_CHECKING:
    from paho.mqtt.client import Client

log = logging.getLogger(__name__)

QUEUE_LENGTH = 60
"""Messages kept for a broker that is away: a minute at one a second, 0.2 MB."""
CONNECT_TIMEOUT = 5.0
"""Time [s] for which the worker waits for a connection."""
LONGEST_RETRY = 30
"""Time [s] from one attempt to connect to the next, at most."""
POLL = 0.5
"""Time [s] after which a worker that waits for the broker looks whether it is to stop."""


class MqttOutlet:
    """Publishes windows.

    Parameters
    ----------
    settings
        The section [mqtt].
    config
        The whole configuration, for the JSON.
    environ
        Environment: SOILBUS_MQTT_USERNAME and SOILBUS_MQTT_PASSWORD, or CREDENTIALS_DIRECTORY of systemd with files
        `mqtt-username` and `mqtt-password`.
    clock
        Monotonic time [s].

    Raises
    ------
    ConfigError
        The extra is not installed, or a file of credentials or certificates cannot be read.
    """

    def __init__(
        self,
        settings: Mqtt,
        config: Config,
        environ: Mapping[str, str] = os.environ,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._config, self._settings, self._clock = config, settings, clock
        self._queue: deque[WindowResult] = deque()
        self._waiting, self._connected, self._stopping = threading.Event(), threading.Event(), threading.Event()
        self._next, self._refusal = -math.inf, ""
        self.dropped = 0
        """Windows that the broker was too slow, or not there, to take."""
        self._client = self._new_client(environ)
        self._worker = threading.Thread(target=self._run, name="mqtt", daemon=True)
        self._worker.start()

    def put(self, result: WindowResult) -> None:
        """Take a window, unless none is due; never waits.

        They are 1/rate [s] apart on average; one may come a quarter of that early, for at a rate of one a hop none is
        to be left out because the one before it came late.
        """
        now, period = self._clock(), 1.0 / self._settings.rate
        if now < self._next - 0.25 * period:
            return
        self._next = max(self._next, now) + period
        if len(self._queue) >= QUEUE_LENGTH:
            self._queue.popleft()
            self.dropped += 1
        self._queue.append(result)
        self._waiting.set()

    def status(self) -> str:
        """What is not well, for the status line; empty where all is."""
        parts = [] if self._connected.is_set() else ["not connected"]
        parts += [f"{self.dropped} dropped"] if self.dropped else []
        return f"mqtt: {', '.join(parts)}" if parts else ""

    def close(self) -> None:
        """Say "offline" and end, without waiting for a broker that is away."""
        self._stopping.set()
        self._waiting.set()
        if self._connected.is_set():
            self._client.publish(f"{self._settings.topic}/status", "offline", qos=1, retain=True)
            self._client.disconnect()
        self._worker.join(2.0 * POLL)

    def _new_client(self, environ: Mapping[str, str]) -> Client:
        if find_spec("paho") is None:
            raise ConfigError(["mqtt: needs the extra soilbus[mqtt]"])
        from paho.mqtt.client import Client
        from paho.mqtt.enums import CallbackAPIVersion

        settings = self._settings
        client = Client(CallbackAPIVersion.VERSION2)
        client.connect_timeout = CONNECT_TIMEOUT
        client.reconnect_delay_set(1, LONGEST_RETRY)
        client.will_set(f"{settings.topic}/status", "offline", qos=1, retain=True)
        username = _credential("username", environ)
        if username is not None:
            client.username_pw_set(username, _credential("password", environ))
        if settings.tls:
            try:
                client.tls_set(ca_certs=None if settings.ca is None else str(self._config.folder / settings.ca))
            except OSError as error:
                raise ConfigError([f"mqtt.ca: {settings.ca}: {error.strerror or error}"]) from None

        def on_connect(client: Client, _data: object, _flags: object, reason: object, _properties: object) -> None:
            if getattr(reason, "is_failure", False):
                if str(reason) != self._refusal:
                    log.warning("mqtt: the broker refuses us: %s", reason)
                self._refusal = str(reason)
                return
            client.publish(f"{settings.topic}/status", "online", qos=1, retain=True)
            self._connected.set()

        def on_disconnect(*_: object) -> None:
            self._connected.clear()

        client.on_connect, client.on_disconnect = on_connect, on_disconnect
        return client

    def _run(self) -> None:
        """The worker: publish what is queued, one after the other, while the broker is there."""
        self._client.connect_async(self._settings.host, self._settings.port or (8883 if self._settings.tls else 1883))
        self._client.loop_start()
        while not self._stopping.is_set():
            if not self._connected.wait(POLL):
                continue
            try:
                result = self._queue.popleft()
            except IndexError:
                self._waiting.wait(POLL)
                self._waiting.clear()
                continue
            sent = self._client.publish(f"{self._settings.topic}/window", json_line(result, self._config), qos=1)
            # where the connection went in between, rc is not 0, and the client sends it when there is one again
            while sent.rc == 0 and not sent.is_published() and not self._stopping.is_set():
                sent.wait_for_publish(POLL)


def _credential(name: str, environ: Mapping[str, str]) -> str | None:
    """The broker's username or password, of the environment or of systemd's credentials; None without."""
    if (given := environ.get(f"SOILBUS_MQTT_{name.upper()}")) is not None:
        return given
    file = Path(environ.get("CREDENTIALS_DIRECTORY", "")) / f"mqtt-{name}"
    if not environ.get("CREDENTIALS_DIRECTORY") or not file.exists():
        return None
    try:
        return file.read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError([f"mqtt: {file}: {getattr(error, 'strerror', None) or 'no text'}"]) from None
