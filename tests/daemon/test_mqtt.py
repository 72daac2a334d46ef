"""Windows to an MQTT broker: a real one in this process, one that hangs, and none."""

from __future__ import annotations

import asyncio
import json
import queue
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from amqtt.broker import Broker
from paho.mqtt.client import Client
from paho.mqtt.enums import CallbackAPIVersion

from soilbus.config.file import parse_config
from soilbus.config.model import ConfigError, Mqtt
from soilbus.daemon.mqtt import MqttOutlet
from soilbus.decision.traversability import Status, Traversability
from soilbus.pipeline.outputs import json_line
from soilbus.pipeline.result import WindowResult
from soilbus.simulator.reference import reference_configuration
from tests.lab.fakes import Bench, FakeClock, drive_messages

CONFIG = reference_configuration()
PATIENCE = 10.0
"""Time [s] after which a test gives up waiting."""


def window(index: int) -> WindowResult:
    return WindowResult(
        10.0 + index, index, Status.INVALID, "standstill", None, None, {}, {}, Traversability(), None, 0, {}
    )


class Loopback:
    """amqtt's broker on a free port, in a thread."""

    def __init__(self) -> None:
        self.port, self.ready, self.loop = 0, threading.Event(), asyncio.new_event_loop()
        self.thread = threading.Thread(target=lambda: self.loop.run_until_complete(self.serve()))
        self.thread.start()
        assert self.ready.wait(PATIENCE)

    async def serve(self) -> None:
        self.over = asyncio.Event()
        listener = {"type": "tcp", "bind": f"127.0.0.1:{self.port}"}
        anonymous = {"amqtt.plugins.authentication.AnonymousAuthPlugin": {"allow_anonymous": True}}
        broker = Broker({"listeners": {"default": listener}, "plugins": anonymous})
        await broker.start()
        self.port = broker._servers["default"].instance.sockets[0].getsockname()[1]
        self.ready.set()
        await self.over.wait()
        await broker.shutdown()

    def open(self, port: int) -> None:
        """Hear on another port too."""

        async def pump(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            while data := await reader.read(4096):
                writer.write(data)
            writer.close()

        async def relay(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            answers, requests = await asyncio.open_connection("127.0.0.1", self.port)
            await asyncio.gather(pump(reader, requests), pump(answers, writer))

        server = asyncio.start_server(relay, "127.0.0.1", port)
        asyncio.run_coroutine_threadsafe(server, self.loop).result(PATIENCE)

    def stop(self) -> None:
        self.loop.call_soon_threadsafe(self.over.set)
        self.thread.join(PATIENCE)


@pytest.fixture
def broker() -> Iterator[Loopback]:
    loopback = Loopback()
    yield loopback
    loopback.stop()


@contextmanager
def subscriber(port: int) -> Iterator[queue.Queue]:
    """Topic and text of all that a subscriber hears."""
    messages: queue.Queue = queue.Queue()
    subscribed = threading.Event()
    client = Client(CallbackAPIVersion.VERSION2)
    client.on_message = lambda _client, _data, message: messages.put((message.topic, message.payload.decode()))
    client.on_subscribe = lambda *_: subscribed.set()
    client.connect("127.0.0.1", port)
    client.loop_start()
    client.subscribe("field/#", qos=1)
    assert subscribed.wait(PATIENCE)
    yield messages
    client.disconnect()
    client.loop_stop()


@pytest.fixture
def heard(broker) -> Iterator[queue.Queue]:
    with subscriber(broker.port) as messages:
        yield messages


@pytest.fixture
def hung() -> Iterator[int]:
    """Port of a broker that takes connections and says nothing."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield server.getsockname()[1]


def test_a_broker_hears_each_window_as_the_json_line_and_when_we_come_and_go(broker, heard):
    clock = FakeClock()
    outlet = MqttOutlet(Mqtt(host="127.0.0.1", port=broker.port, topic="field/one"), CONFIG, {}, clock)
    assert heard.get(timeout=PATIENCE) == ("field/one/status", "online")
    for index in range(3):
        outlet.put(window(index))
        clock.sleep(1.0)
        topic, text = heard.get(timeout=PATIENCE)
        assert (topic, text) == ("field/one/window", json_line(window(index), CONFIG))
    assert outlet.status() == ""
    outlet.close()
    assert heard.get(timeout=PATIENCE) == ("field/one/status", "offline")


def test_windows_faster_than_the_rate_are_left_out_and_not_counted_as_dropped(broker, heard):
    clock = FakeClock()
    outlet = MqttOutlet(Mqtt(host="127.0.0.1", port=broker.port, topic="field", rate=0.5), CONFIG, {}, clock)
    heard.get(timeout=PATIENCE)
    for index in range(5):
        outlet.put(window(index))
        clock.sleep(1.0)
    assert [json.loads(heard.get(timeout=PATIENCE)[1])["window"] for _ in range(3)] == [0, 2, 4]
    assert outlet.dropped == 0
    outlet.close()


def test_windows_at_the_rate_are_all_sent_though_some_come_early(broker, heard):
    clock = FakeClock()
    outlet = MqttOutlet(Mqtt(host="127.0.0.1", port=broker.port, topic="field", rate=1.0), CONFIG, {}, clock)
    heard.get(timeout=PATIENCE)
    for index, gap in enumerate((0.9, 1.1, 0.95, 1.05, 0.9)):
        outlet.put(window(index))
        clock.sleep(gap)
    assert [json.loads(heard.get(timeout=PATIENCE)[1])["window"] for _ in range(5)] == [0, 1, 2, 3, 4]
    outlet.close()


def test_a_broker_that_comes_late_gets_what_is_kept(broker, heard):
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    outlet = MqttOutlet(Mqtt(host="127.0.0.1", port=port, topic="field"), CONFIG, {}, FakeClock())
    outlet.put(window(7))
    assert outlet.status() == "mqtt: not connected"
    broker.open(port)
    assert heard.get(timeout=PATIENCE) == ("field/status", "online")
    assert json.loads(heard.get(timeout=PATIENCE)[1])["window"] == 7
    assert outlet.status() == ""
    outlet.close()


def test_a_broker_that_hangs_delays_nothing_and_the_oldest_are_dropped_and_counted(hung):
    clock = FakeClock()
    outlet = MqttOutlet(Mqtt(host="127.0.0.1", port=hung), CONFIG, {}, clock)
    began = time.perf_counter()
    for index in range(1000):
        outlet.put(window(index))
        clock.sleep(1.0)
    assert time.perf_counter() - began < 0.5
    assert 900 < outlet.dropped < 1000
    assert outlet.status() == f"mqtt: not connected, {outlet.dropped} dropped"
    began = time.perf_counter()
    outlet.close()
    assert time.perf_counter() - began < 2.0


def test_the_loop_sends_the_same_frames_beside_a_broker_that_hangs(hung):
    class Status:
        watchdog_interval = None
        said = ""

        def status(self, text: str) -> None:
            self.said = text

    recording, notifier = drive_messages(CONFIG, 11.5), Status()
    outlet = MqttOutlet(Mqtt(host="127.0.0.1", port=hung), CONFIG, {})
    alone, beside = Bench(recording), Bench(recording, notifier=notifier, outlet=outlet)
    for bench in (alone, beside):
        bench.run(11.0)
    assert beside.results
    assert [(t, m.arbitration_id, m.data) for t, m in beside.wire.sent] == [
        (t, m.arbitration_id, m.data) for t, m in alone.wire.sent
    ]
    assert notifier.said.endswith(", mqtt: not connected")
    outlet.close()


@pytest.mark.parametrize("source", ["environment", "systemd"])
def test_username_and_password_come_from_the_environment_or_from_systemds_credentials(source, tmp_path, monkeypatch):
    if source == "environment":
        environ = {"SOILBUS_MQTT_USERNAME": "tractor", "SOILBUS_MQTT_PASSWORD": "mud"}
    else:
        (tmp_path / "mqtt-username").write_text("tractor\n")
        (tmp_path / "mqtt-password").write_text("mud\n")
        environ = {"CREDENTIALS_DIRECTORY": str(tmp_path)}
    given = []
    monkeypatch.setattr(Client, "username_pw_set", lambda _, *pair: given.append(pair))
    outlet = MqttOutlet(Mqtt(host="127.0.0.1", port=9), CONFIG, environ)
    outlet.close()
    assert given == [("tractor", "mud")]


def test_without_the_section_nothing_of_mqtt_is_loaded():
    assert CONFIG.mqtt is None
    program = "import sys, soilbus.daemon.start; print([m for m in sys.modules if 'mqtt' in m])"
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert run.stdout == "[]\n"


def test_without_the_extra_the_configuration_is_refused(monkeypatch):
    monkeypatch.setattr("soilbus.daemon.mqtt.find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"mqtt: needs the extra soilbus\[mqtt\]"):
        MqttOutlet(Mqtt(host="broker"), CONFIG, {})


@pytest.mark.parametrize(
    ("section", "fault"),
    [
        ({}, "mqtt.host"),
        ({"host": "b", "rate": 0.0}, "mqtt.rate"),
        ({"host": "b", "topic": "a/#"}, "mqtt.topic"),
        ({"host": "b", "ca": "ca.pem"}, "without tls"),
        ({"host": "b", "password": "mud"}, "password"),
    ],
)
def test_a_fault_of_the_section_is_named(section, fault):
    with pytest.raises(ConfigError, match=fault):
        parse_config({"mqtt": section})
