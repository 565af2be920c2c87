"""Sink ``mqtt://host``: JSON topics, or the topics of VDA 5050, on an MQTT broker."""

from __future__ import annotations

import os
import re
import secrets
import socket
import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote, urlsplit

from locatk.core.errors import InputError, MissingDataError
from locatk.core.streaming.events import (
    ArtifactUpdate,
    LiveEvent,
    PoseEstimate,
    StateChange,
    TrackingState,
)
from locatk.formats.extras import requires_extra
from locatk.formats.sinks.addresses import SinkAddress
from locatk.formats.sinks.interface import LiveMessage
from locatk.formats.sinks.json_messages import dump, event_to_json
from locatk.formats.sinks.queued import MAX_EVENTS, Busy, QueuedSink
from locatk.formats.sinks.vda5050 import VERSIONS, Interface, Vehicle

if TYPE_CHECKING:
    from paho.mqtt.client import Client, MQTTMessageInfo

PORTS = {"mqtt": 1883, "mqtts": 8883}

MAX_OUTSTANDING = 256
"""Messages at a broker, unfinished, beyond which ours wait. paho queues those of QoS 0 without
bound while a broker accepts nothing."""

SEND_BUFFER_BYTES = 65_536
"""Buffer of the socket. The default grows to megabytes, which a broker that hung gets late."""

KEEPALIVE_S = 10
"""A broker that does not answer for 1.5 times as long is given up."""

RECONNECT_S = (1, 10)
"""First and longest pause before a new connection."""

FAREWELL_S = 1.0
"""Longest wait for the last messages to be acknowledged."""

STATE_PERIOD_S = 30.0
"""Longest time between two messages ``state`` of VDA 5050."""


@dataclass(frozen=True)
class Publication:
    """Message for a broker."""

    topic: str
    content: dict[str, Any]
    qos: int = 1
    retain: bool = False


def create(address: SinkAddress) -> MqttSink:
    """Return the sink of ``mqtt://[user:password@]host:1883/prefix?...`` or ``mqtts://...``."""
    return MqttSink(address)


class MqttSink(QueuedSink):
    """Publishes poses with QoS 0 and everything else with QoS 1.

    Poses are not published late: without a connection they are dropped. The states of devices are
    retained. Other events wait for a connection.
    """

    def __init__(self, address: SinkAddress) -> None:
        address.reject_unknown_options("ca", "vda5050", "version", "manufacturer", "map")
        self._broker = Broker.from_address(address)
        self._topics: JsonTopics | Vda5050Topics
        if "vda5050" in address.options:
            interface = Interface(
                address.choice("version", *VERSIONS),
                address.options.get("manufacturer", "locatk"),
                address.options.get("map", ""),
                address.path,
            )
            with_state = address.choice("vda5050", "visualization", "state") == "state"
            self._topics = Vda5050Topics(interface, self._connect, with_state)
        else:
            for option in ("version", "manufacturer", "map"):
                if option in address.options:
                    raise InputError(
                        f"option {option!r} without vda5050 in {address.public_text}",
                        hint="Add vda5050=visualization",
                    )
            self._topics = JsonTopics(address.path or "locatk", self._connect)
        target = f"{address.scheme}://{self._broker.name}"
        super().__init__(address, f"{target}/{address.path}" if address.path else target)
        self._connections: list[Connection] = []

    def prepare(self) -> None:
        """Import paho."""
        with requires_extra("mqtt", "MQTT", file=self.address):
            import paho.mqtt.client  # noqa: F401

    def start(self) -> None:
        """Start to connect."""
        self._topics.start(self.context.devices)

    def send(self, message: LiveMessage) -> int:
        """Publish an event, or keep it for the next connection."""
        self.tick()
        self._topics.publish(message)
        return 0  # Counted by tick(), when it has left.

    def tick(self) -> float | None:
        """Count what has left, and publish what is due."""
        sent = dropped = 0
        for connection in self._connections:
            connection.collect()
            sent += connection.sent
            dropped += connection.dropped
            connection.sent = connection.dropped = 0
        if sent or dropped:
            self.count(sent=sent, dropped=dropped)
        pause_s = self._topics.tick()
        return 0.05 if any(each.is_unfinished for each in self._connections) else pause_s

    def stop(self) -> None:
        """Say that the session ended, and disconnect."""
        until_s = time.monotonic() + FAREWELL_S
        self._topics.stop()
        for connection in self._connections:
            connection.close(until_s)
        self.tick()

    def _connect(self, will: Publication, greeting: Callable[[], list[Publication]]) -> Connection:
        connection = Connection(self._broker, will, greeting, self)
        self._connections.append(connection)
        return connection


@dataclass(frozen=True)
class Broker:
    """Address of a broker, with credentials."""

    host: str
    port: int
    user: str | None
    password: str | None
    uses_tls: bool
    ca: str | None

    @classmethod
    def from_address(cls, address: SinkAddress) -> Broker:
        """Return the broker of an address.

        Raises
        ------
        InputError
            The address has no host, or an option that needs TLS without it.
        MissingDataError
            The file of certificates does not exist.
        """
        if re.search(r"[+#]", address.path):
            raise InputError(f"+ or # in the topic of {address.public_text}")
        ca = address.options.get("ca")
        if ca is not None and address.scheme != "mqtts":
            raise InputError(f"option 'ca' in {address.public_text}", hint="Use mqtts://")
        if ca is not None and not os.path.isfile(ca):
            raise MissingDataError("no such file of certificates", file=ca)
        parts = urlsplit(address.text)
        return cls(
            address.require_host(),
            address.port or PORTS[address.scheme],
            unquote(parts.username) if parts.username else None,
            unquote(parts.password) if parts.password else None,
            address.scheme == "mqtts",
            ca,
        )

    @property
    def name(self) -> str:
        """Host and port."""
        return SinkAddress("", "", self.host, self.port).host_and_port


class Connection:
    """Connection to a broker; a thread of paho reconnects.

    All methods are called by the thread of the sink.

    Parameters
    ----------
    broker : Broker
    will : Publication
        Published by the broker if the connection breaks.
    greeting : callable
        Returns what to publish after each connection, retained messages included: a broker that
        was started again has lost them.
    sink : QueuedSink
        Woken after each connection, and told errors.
    """

    def __init__(
        self,
        broker: Broker,
        will: Publication,
        greeting: Callable[[], list[Publication]],
        sink: QueuedSink,
    ) -> None:
        from paho.mqtt.client import Client
        from paho.mqtt.enums import CallbackAPIVersion

        self.sent = self.dropped = 0
        self._greeting = greeting
        self._sink = sink
        self._broker = broker
        self._is_accepted = self._is_fresh = False
        self._unfinished: deque[MQTTMessageInfo] = deque()
        self._waiting: deque[Publication] = deque()
        self._client = client = Client(
            CallbackAPIVersion.VERSION2, client_id=f"locatk-{secrets.token_hex(6)}"
        )
        # An exception in a callback would end the thread of paho.
        client.suppress_exceptions = True
        client.will_set(will.topic, dump(will.content), will.qos, will.retain)
        client.reconnect_delay_set(*RECONNECT_S)
        if broker.user is not None:
            client.username_pw_set(broker.user, broker.password)
        if broker.uses_tls:
            client.tls_set(ca_certs=broker.ca)
        client.on_socket_open = _configure_socket
        client.on_connect = self._on_connect
        client.on_connect_fail = self._on_connect_fail
        client.on_disconnect = self._on_disconnect
        client.connect_async(broker.host, broker.port, KEEPALIVE_S)
        client.loop_start()

    @property
    def is_unfinished(self) -> bool:
        """Return whether messages have not left yet."""
        return bool(self._unfinished)

    def require_room(self) -> None:
        """Raise Busy if the broker takes no messages now."""
        if len(self._unfinished) < MAX_OUTSTANDING:
            return
        self.collect()
        if len(self._unfinished) >= MAX_OUTSTANDING and self._client.is_connected():
            raise Busy

    def publish(self, publications: Iterable[Publication]) -> None:
        """Publish messages. Without a connection drop those of QoS 0 and keep others.

        Retained messages are not kept: they are part of the greeting.
        """
        is_connected = self._client.is_connected()
        for each in publications:
            if is_connected and not self._is_fresh:
                self._hand_over(each)
            elif each.qos == 0:
                self.dropped += 1
            elif not each.retain:
                self._waiting.append(each)
                if len(self._waiting) > MAX_EVENTS:
                    self._waiting.popleft()
                    self.dropped += 1

    def collect(self) -> None:
        """Greet after a new connection, and count the messages that have left."""
        if self._is_fresh and self._client.is_connected():
            self._is_fresh = False
            for each in self._greeting():
                self._hand_over(each)
            while self._waiting:
                self._hand_over(self._waiting.popleft())
        while self._unfinished:
            try:
                if not self._unfinished[0].is_published():
                    break
                self.sent += 1
            except (RuntimeError, ValueError):  # The connection broke before it left.
                self.dropped += 1
            self._unfinished.popleft()

    def close(self, until_s: float) -> None:
        """Wait for messages to leave, at most until a time (``time.monotonic``); disconnect."""
        while time.monotonic() < until_s and self._client.is_connected():
            self.collect()
            if not self._unfinished:
                break
            time.sleep(0.005)
        self.dropped += len(self._unfinished) + len(self._waiting)
        self._unfinished.clear()
        self._waiting.clear()
        self._client.disconnect()
        self._client.loop_stop()

    def _hand_over(self, each: Publication) -> None:
        info = self._client.publish(each.topic, dump(each.content), each.qos, each.retain)
        self._unfinished.append(info)

    # ---- called by the thread of paho

    def _on_connect(
        self, client: Client, data: Any, flags: Any, code: Any, properties: Any
    ) -> None:
        if code.is_failure:
            self._sink.report_error(f"{self._broker.name} refused the connection: {code}")
            return
        self._is_accepted = self._is_fresh = True
        self._sink.report_error("")
        self._sink.wake()

    def _on_connect_fail(self, client: Client, data: Any) -> None:
        self._sink.report_error(f"no connection to {self._broker.name}")

    def _on_disconnect(
        self, client: Client, data: Any, flags: Any, code: Any, properties: Any
    ) -> None:
        if self._is_accepted and code.is_failure:
            self._sink.report_error(f"connection to {self._broker.name} lost: {code}")
        self._is_accepted = False


def _configure_socket(client: Client, data: Any, opened: Any) -> None:
    opened.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
    # Nagle's algorithm holds a small message back until the one before is acknowledged.
    opened.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)


Connect = Callable[[Publication, Callable[[], list[Publication]]], Connection]


class JsonTopics:
    """Topics ``<prefix>/<device>/<type>`` with the JSON of events, and ``<prefix>/status``."""

    def __init__(self, prefix: str, connect: Connect) -> None:
        self._prefix = prefix
        self._connect = connect
        self._retained: dict[str, Publication] = {}

    def start(self, devices: tuple[str, ...]) -> None:
        """Start to connect."""
        self._connection = self._connect(self._status("broken"), self._greeting)

    def publish(self, message: LiveMessage) -> None:
        """Publish the JSON of an event."""
        self._connection.require_room()
        event = message.event
        content = event_to_json(event, message.latency_s())
        publication = Publication(
            self._topic(event, content["type"]),
            content,
            qos=0 if isinstance(event, PoseEstimate) else 1,
            retain=isinstance(event, StateChange),
        )
        if publication.retain:
            self._retained[publication.topic] = publication
        self._connection.publish([publication])

    def tick(self) -> float | None:
        """Nothing is due."""
        return None

    def stop(self) -> None:
        """Publish that the session ended."""
        self._connection.publish([self._status("offline")])

    def _greeting(self) -> list[Publication]:
        return [self._status("online"), *self._retained.values()]

    def _status(self, text: str) -> Publication:
        return Publication(f"{self._prefix}/status", {"status": text}, retain=True)

    def _topic(self, event: LiveEvent, name: str) -> str:
        device = "" if isinstance(event, ArtifactUpdate) else event.device
        if not device:
            return f"{self._prefix}/{name}"
        return f"{self._prefix}/{topic_level(device)}/{name}"


class Vda5050Topics:
    """Topics of VDA 5050: a connection per vehicle, because each has a last will of its own."""

    def __init__(self, interface: Interface, connect: Connect, with_state: bool) -> None:
        self._interface = interface
        self._connect = connect
        self._with_state = with_state
        self._vehicles: dict[str, tuple[Vehicle, Connection]] = {}
        self._next_state_s = time.monotonic() + STATE_PERIOD_S

    def start(self, devices: tuple[str, ...]) -> None:
        """Start to connect the devices that are known."""
        for device in devices:
            self._vehicle(device)

    def publish(self, message: LiveMessage) -> None:
        """Publish a pose or a state; other events have no message."""
        event = message.event
        if not isinstance(event, PoseEstimate | StateChange):
            return
        vehicle, connection = self._vehicle(event.device)
        connection.require_room()
        vehicle.update(event)
        publications = []
        if isinstance(event, StateChange) and self._with_state:
            content = vehicle.state(event.time_ns)
            publications.append(Publication(vehicle.topic("state"), content, qos=0))
        if isinstance(event, PoseEstimate) or event.state == TrackingState.LOST:
            content = vehicle.visualization(event.time_ns)
            publications.append(Publication(vehicle.topic("visualization"), content, qos=0))
        connection.publish(publications)

    def tick(self) -> float | None:
        """Publish ``state`` every 30 s."""
        if not self._with_state:
            return None
        now_s = time.monotonic()
        if now_s >= self._next_state_s:
            self._next_state_s = now_s + STATE_PERIOD_S
            for vehicle, connection in self._vehicles.values():
                connection.publish([self._state(vehicle)])
        return self._next_state_s - now_s

    def stop(self) -> None:
        """Publish that each vehicle is offline."""
        for vehicle, connection in self._vehicles.values():
            connection.publish([_connection_state(vehicle, "OFFLINE")])

    def _vehicle(self, device: str) -> tuple[Vehicle, Connection]:
        if device not in self._vehicles:
            vehicle = self._interface.vehicle(device)

            def greeting() -> list[Publication]:
                online = _connection_state(vehicle, "ONLINE")
                return [online, self._state(vehicle)] if self._with_state else [online]

            will = _connection_state(vehicle, "CONNECTION_BROKEN")
            self._vehicles[device] = (vehicle, self._connect(will, greeting))
        return self._vehicles[device]

    @staticmethod
    def _state(vehicle: Vehicle) -> Publication:
        return Publication(vehicle.topic("state"), vehicle.state(time.time_ns()), qos=0)


def _connection_state(vehicle: Vehicle, state: str) -> Publication:
    content = vehicle.connection(state, time.time_ns())
    return Publication(vehicle.topic("connection"), content, retain=True)


def topic_level(name: str) -> str:
    """Return a name as one level of a topic: characters with a meaning become ``_``."""
    return re.sub(r"[+#/\x00-\x1f]", "_", name)
