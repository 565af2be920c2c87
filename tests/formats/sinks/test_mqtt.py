"""MQTT sink against mosquitto."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from locatk.core.errors import InputError, LocatkError
from locatk.formats.sinks import mqtt
from locatk.formats.sinks.interface import SinkContext
from locatk.formats.sinks.registry import create_sink

MOSQUITTO = shutil.which("mosquitto") or shutil.which("mosquitto", path="/usr/sbin:/usr/local/sbin")

needs_broker = pytest.mark.skipif(MOSQUITTO is None, reason="mosquitto is not installed")


class Broker:
    """mosquitto on a port of the loopback interface, which can be stopped and started again."""

    def __init__(self, folder: Path, port: int, extra: str) -> None:
        self.port = port
        self._config = folder / "mosquitto.conf"
        # Started by root it would become another user, who cannot read the files of the test.
        user = "user root\n" if hasattr(os, "getuid") and os.getuid() == 0 else ""
        self._config.write_text(f"{user}listener {port} 127.0.0.1\npersistence false\n{extra}\n")
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        assert MOSQUITTO is not None
        command = [MOSQUITTO, "-c", str(self._config)]
        self._process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
        until = time.monotonic() + 10
        while time.monotonic() < until:
            time.sleep(0.005)
            with contextlib.suppress(ConnectionRefusedError):
                socket.create_connection(("127.0.0.1", self.port)).close()
                return
        raise AssertionError("mosquitto did not start")

    def signal(self, number: int) -> None:
        assert self._process is not None
        self._process.send_signal(number)

    def stop(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None


class Subscriber:
    """Client that stores what it receives: (topic, payload, QoS, retained, time)."""

    def __init__(self, port: int, topic: str = "#", **credentials: str) -> None:
        from paho.mqtt.client import CallbackAPIVersion, Client

        self.messages: list[Any] = []
        self.is_ready = False
        self._client = client = Client(CallbackAPIVersion.VERSION2)
        if credentials:
            client.username_pw_set(**credentials)

        def on_message(_client: Any, _data: Any, each: Any) -> None:
            content = json.loads(each.payload)
            self.messages.append((each.topic, content, each.qos, each.retain, time.monotonic()))

        client.on_connect = lambda *_: client.subscribe(topic, 1)
        client.on_subscribe = lambda *_: setattr(self, "is_ready", True)
        client.on_message = on_message
        client.reconnect_delay_set(1, 1)
        client.connect_async("127.0.0.1", port)
        client.loop_start()

    def of(self, topic: str) -> list[Any]:
        return [content for each, content, *_ in list(self.messages) if each == topic]

    def close(self) -> None:
        self._client.disconnect()
        self._client.loop_stop()


@pytest.fixture
def broker(tmp_path: Path, live: ModuleType, request: Any) -> Iterator[Broker]:
    extra = getattr(request, "param", "allow_anonymous true")
    running = Broker(tmp_path, live.free_port(), extra)
    yield running
    running.stop()


@pytest.fixture
def session(live: ModuleType) -> Iterator[Any]:
    """Return functions that open a sink and a subscriber, which are closed after the test."""
    opened: list[Any] = []

    class Session:
        @staticmethod
        def sink(text: str, *devices: str, wait: bool = True) -> Any:
            sink = create_sink(text)
            opened.append(lambda: sink.close(2))
            sink.open(SinkContext("dots", devices=devices))
            if wait:
                live.wait_for(lambda: any(each._client.is_connected() for each in all_of(sink)))
            return sink

        @staticmethod
        def subscriber(port: int, *args: Any, **kwargs: Any) -> Subscriber:
            subscriber = Subscriber(port, *args, **kwargs)
            opened.append(subscriber.close)
            live.wait_for(lambda: subscriber.is_ready)
            return subscriber

    def all_of(sink: Any) -> Any:
        return list(sink._connections)

    yield Session
    for close in reversed(opened):
        close()


@needs_broker
def test_every_event_has_its_topic(live: ModuleType, broker: Broker, session: Any) -> None:
    broker.start()
    subscriber = session.subscriber(broker.port)
    sink = session.sink(f"mqtt://127.0.0.1:{broker.port}/hall/3")
    live.offer(sink, live.pose(7), live.lost(), live.correction(), live.warning())
    live.offer(sink, live.warning("robot"), live.pose(device="a/b+#"))
    live.wait_for(lambda: subscriber.of("hall/3/a_b__/pose"))
    (content,) = subscriber.of("hall/3/robot/pose")
    assert (content["x_m"], content["device"], content["state"]) == (7.0, "robot", "tracking")
    assert 0 <= content["latency_s"] < 5
    assert subscriber.of("hall/3/robot/state")[0]["reason"] == "no light"
    assert subscriber.of("hall/3/robot/correction")[0]["displacement_m"] == [0, 0.0, 0.0]
    assert subscriber.of("hall/3/warning")[0]["code"] == "clock"
    assert subscriber.of("hall/3/robot/warning")
    qos = {topic.rpartition("/")[2]: qos for topic, _, qos, *_ in subscriber.messages}
    assert qos == {"status": 1, "pose": 0, "state": 1, "correction": 1, "warning": 1}
    live.wait_for(lambda: sink.status().sent == 7)  # with the status
    assert sink.status().dropped == 0
    assert sink.status().address == f"mqtt://127.0.0.1:{broker.port}/hall/3"


@needs_broker
@pytest.mark.slow
def test_no_pose_is_lost_while_the_broker_keeps_up(
    live: ModuleType, broker: Broker, session: Any
) -> None:
    broker.start()
    subscriber = session.subscriber(broker.port, "locatk/robot/pose")
    sink = session.sink(f"mqtt://127.0.0.1:{broker.port}")
    for k in range(2000):
        live.offer(sink, live.pose(k))
        time.sleep(0.0005)
    live.wait_for(lambda: len(subscriber.messages) == 2000)
    assert [each["x_m"] for each in subscriber.of("locatk/robot/pose")] == list(range(2000))
    live.wait_for(lambda: sink.status().sent == 2001)
    assert sink.status().dropped == 0


@needs_broker
def test_late_subscribers_get_the_state(live: ModuleType, broker: Broker, session: Any) -> None:
    broker.start()
    sink = session.sink(f"mqtt://127.0.0.1:{broker.port}")
    live.offer(sink, live.pose(), live.lost())
    live.wait_for(lambda: sink.status().sent == 3)
    subscriber = session.subscriber(broker.port)
    live.wait_for(lambda: len(subscriber.messages) == 2)
    assert subscriber.of("locatk/status") == [{"status": "online"}]
    assert subscriber.of("locatk/robot/state")[0]["state"] == "lost"
    assert [retained for *_, retained, _ in subscriber.messages] == [True, True]
    sink.close(2)
    live.wait_for(lambda: subscriber.of("locatk/status")[-1] == {"status": "offline"})


@needs_broker
@pytest.mark.slow
def test_last_will_after_a_crash(live: ModuleType, broker: Broker, session: Any) -> None:
    broker.start()
    subscriber = session.subscriber(broker.port)
    code = (
        "import time\n"
        "from locatk.formats.sinks.interface import SinkContext\n"
        "from locatk.formats.sinks.registry import create_sink\n"
        f"sink = create_sink('mqtt://127.0.0.1:{broker.port}')\n"
        "sink.open(SinkContext('dots'))\n"
        "time.sleep(60)\n"
    )
    process = subprocess.Popen([sys.executable, "-c", code])
    try:
        live.wait_for(lambda: subscriber.of("locatk/status") == [{"status": "online"}], 20)
    finally:
        process.kill()
        process.wait()
    live.wait_for(lambda: subscriber.of("locatk/status")[-1] == {"status": "broken"})


@needs_broker
@pytest.mark.slow
def test_broker_that_comes_later_and_restarts(
    live: ModuleType, broker: Broker, session: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    sink = session.sink(f"mqtt://127.0.0.1:{broker.port}", wait=False)
    live.wait_for(lambda: "no connection" in sink.status().error)
    live.offer(sink, live.pose(1), live.correction(2), live.lost(reason="first"))
    live.offer(sink, live.lost(reason="second"))
    live.wait_for(lambda: sink.status().dropped == 1)
    broker.start()
    subscriber = session.subscriber(broker.port)
    live.wait_for(lambda: subscriber.of("locatk/robot/correction"))
    assert sink.status().error == ""
    assert [each["reason"] for each in subscriber.of("locatk/robot/state")] == ["second"]
    live.offer(sink, live.pose(3))
    live.wait_for(lambda: subscriber.of("locatk/robot/pose"))
    assert [each["x_m"] for each in subscriber.of("locatk/robot/pose")] == [3]

    broker.stop()
    live.wait_for(lambda: "lost" in sink.status().error or "no conn" in sink.status().error)
    live.offer(sink, *(live.pose(k) for k in range(10, 20)))
    live.wait_for(lambda: sink.status().dropped == 11)
    subscriber.messages.clear()
    broker.start()
    live.wait_for(lambda: sink.status().error == "")
    live.wait_for(lambda: subscriber.of("locatk/robot/state"))  # retained: lost by the broker
    live.offer(sink, live.pose(20))
    live.wait_for(lambda: subscriber.of("locatk/robot/pose"))
    assert [each["x_m"] for each in subscriber.of("locatk/robot/pose")] == [20]  # no stale ones


@needs_broker
@pytest.mark.slow
def test_broker_that_hangs(live: ModuleType, broker: Broker, session: Any) -> None:
    broker.start()
    subscriber = session.subscriber(broker.port, "locatk/#")
    sink = session.sink(f"mqtt://127.0.0.1:{broker.port}")
    live.offer(sink, live.pose(0))
    live.wait_for(lambda: subscriber.of("locatk/robot/pose"))
    broker.signal(signal.SIGSTOP)
    durations = []
    last = 12_000
    for k in range(1, last + 1):
        event = live.message(live.pose(k))
        begin = time.perf_counter()
        sink.offer(event)
        durations.append(time.perf_counter() - begin)
        if k % 250 == 0:  # Give paho the chance to take them.
            until = time.monotonic() + 0.03
            while sink._pending and time.monotonic() < until:
                time.sleep(0.001)
    assert sorted(durations)[len(durations) * 99 // 100] < 0.01
    (connection,) = sink._connections
    live.wait_for(lambda: len(sink._pending) <= 2000)
    # What paho holds is bounded by us.
    assert len(connection._client._out_packet) <= mqtt.MAX_OUTSTANDING + 1
    assert len(connection._unfinished) <= mqtt.MAX_OUTSTANDING
    assert sink.status().dropped > 5000
    broker.signal(signal.SIGCONT)
    live.wait_for(lambda: subscriber.of("locatk/robot/pose")[-1]["x_m"] == last)
    received = [each["x_m"] for each in subscriber.of("locatk/robot/pose")]
    assert received == sorted(received)
    live.wait_for(lambda: sink.status().sent == len(received) + 1)
    assert sink.status().sent + sink.status().dropped == last + 2


def password_file(folder: Path) -> None:
    command = ["mosquitto_passwd", "-c", "-b", str(folder / "passwords"), "robot", "p@ss:w/rd"]
    subprocess.run(command, check=True)


@needs_broker
@pytest.mark.slow
@pytest.mark.skipif(shutil.which("mosquitto_passwd") is None, reason="no mosquitto_passwd")
def test_credentials_stay_secret(live: ModuleType, tmp_path: Path, session: Any) -> None:
    password_file(tmp_path)
    secured = Broker(tmp_path, live.free_port(), f"password_file {tmp_path}/passwords")
    secured.start()
    try:
        good = f"mqtt://robot:p%40ss%3Aw%2Frd@127.0.0.1:{secured.port}"
        sink = session.sink(good)
        subscriber = session.subscriber(secured.port, username="robot", password="p@ss:w/rd")
        live.offer(sink, live.pose())
        live.wait_for(lambda: subscriber.of("locatk/robot/pose"))
        refused = session.sink(good.replace("p%40", "hidden"), wait=False)
        live.wait_for(lambda: "refused" in refused.status().error)
        for each in (sink, refused):
            text = f"{each.address} {each.status()}"
            assert "p%40" not in text
            assert "w%2F" not in text
            assert "hidden" not in text
            assert "robot:***@127.0.0.1" in each.address
    finally:
        secured.stop()


@needs_broker
@pytest.mark.slow
@pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl is not installed")
def test_tls(live: ModuleType, tmp_path: Path, session: Any) -> None:
    options = "-x509 -newkey rsa:2048 -nodes -days 2 -keyout key.pem -out cert.pem"
    names = ["-subj", "/CN=localhost", "-addext", "subjectAltName=DNS:localhost,IP:127.0.0.1"]
    subprocess.run(
        ["openssl", "req", *options.split(), *names],
        cwd=tmp_path,
        check=True,
        capture_output=True,
    )
    extra = f"allow_anonymous true\nkeyfile {tmp_path}/key.pem\ncertfile {tmp_path}/cert.pem"
    secured = Broker(tmp_path, live.free_port(), extra)
    secured.start()
    try:
        trusted = f"mqtts://127.0.0.1:{secured.port}?ca={tmp_path}/cert.pem"
        sink = session.sink(trusted)
        live.offer(sink, live.pose())
        live.wait_for(lambda: sink.status().sent == 2)
        other = session.sink(f"mqtts://127.0.0.1:{secured.port}", wait=False)
        live.wait_for(lambda: "no connection" in other.status().error)
    finally:
        secured.stop()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("mqtt:///prefix", "no host"),
        ("mqtt://u:geheim@host/a/+/b", "+ or #"),
        ("mqtt://u:geheim@host?qos=2", "unknown option 'qos'"),
        ("mqtt://u:geheim@host?vda5050=order", "vda5050=order"),
        ("mqtt://u:geheim@host?map=hall", "without vda5050"),
        ("mqtt://u:geheim@host:99999", "invalid port"),
        ("mqtt://u:geheim@host?ca=x.pem", "'ca'"),
        ("mqtts://u:geheim@host?ca=missing.pem", "certificates"),
        ("mqtt://u:geheim@host?vda5050=state&version=1.1", "version=1.1"),
    ],
)
def test_bad_addresses_are_refused_without_the_password(text: str, words: str) -> None:
    with pytest.raises(LocatkError) as caught:
        create_sink(text)
    assert words in str(caught.value)
    assert "geheim" not in f"{caught.value} {caught.value.hint}"


def test_missing_package_is_named(without_extras: Any) -> None:
    sink = create_sink("mqtt://u:geheim@host")
    without_extras("mqtt")
    with pytest.raises(LocatkError, match="paho-mqtt") as caught:
        sink.open(SinkContext("dots"))
    assert "locatk[mqtt]" in str(caught.value.hint)
    assert "geheim" not in str(caught.value)
    assert not isinstance(caught.value, InputError)
    sink.close(1)


@needs_broker
@pytest.mark.parametrize("options", ["vda5050=visualization", "vda5050=state&version=3.0"])
def test_vda5050_of_two_vehicles(
    live: ModuleType, broker: Broker, session: Any, options: str
) -> None:
    broker.start()
    subscriber = session.subscriber(broker.port)
    sink = session.sink(f"mqtt://127.0.0.1:{broker.port}?{options}&map=hall", "kiwi")
    is_v3 = "3.0" in options
    prefix = "vda5050/v3/locatk" if is_v3 else "uagv/v2/locatk"
    live.wait_for(lambda: subscriber.of(f"{prefix}/kiwi/connection"))
    live.offer(sink, live.pose(1, "kiwi"), live.lost("kiwi"), live.correction(0, "kiwi"))
    live.offer(sink, live.pose(2, "lime"))
    live.wait_for(lambda: subscriber.of(f"{prefix}/lime/connection"))
    live.offer(sink, live.pose(3, "lime"))
    live.wait_for(lambda: subscriber.of(f"{prefix}/lime/visualization"))
    live.wait_for(lambda: len(subscriber.of(f"{prefix}/kiwi/visualization")) == 2)
    key = "mobileRobotPosition" if is_v3 else "agvPosition"
    first, second = subscriber.of(f"{prefix}/kiwi/visualization")
    assert (first["headerId"], first[key]["x"], first[key]["mapId"]) == (1, 1, "hall")
    assert (second["headerId"], second[key]["localizationScore"]) == (2, 0)
    states = subscriber.of(f"{prefix}/kiwi/state")
    assert len(states) == (2 if is_v3 else 0)  # at the connection and at the change
    if is_v3:
        assert states[-1]["errors"][0]["errorType"] == "LOCALIZATION_ERROR"
        assert second["referenceStateHeaderId"] == states[-1]["headerId"]
    sink.close(5)
    live.wait_for(lambda: len(subscriber.of(f"{prefix}/lime/connection")) == 2)
    for device in ("kiwi", "lime"):
        connection = subscriber.of(f"{prefix}/{device}/connection")
        assert [each["connectionState"] for each in connection] == ["ONLINE", "OFFLINE"]
    by_topic = {topic: qos for topic, _, qos, *_ in subscriber.messages}
    assert {topic.rpartition("/")[2]: qos for topic, qos in by_topic.items()} == (
        {"connection": 1, "visualization": 0, "state": 0}
        if is_v3
        else {"connection": 1, "visualization": 0}
    )
    assert not [topic for topic in by_topic if topic.startswith("locatk/")]


@needs_broker
def test_vda5050_state_every_30_s(
    live: ModuleType, broker: Broker, session: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mqtt, "STATE_PERIOD_S", 0.02)
    broker.start()
    subscriber = session.subscriber(broker.port)
    session.sink(f"mqtt://127.0.0.1:{broker.port}?vda5050=state", "kiwi")
    live.wait_for(lambda: len(subscriber.of("uagv/v2/locatk/kiwi/state")) > 3)


@needs_broker
@pytest.mark.slow
def test_vda5050_last_will(live: ModuleType, broker: Broker, session: Any) -> None:
    broker.start()
    subscriber = session.subscriber(broker.port)
    sink = session.sink(f"mqtt://127.0.0.1:{broker.port}?vda5050=visualization", "kiwi", "lime")
    live.wait_for(lambda: len(subscriber.messages) == 2)
    # The connection of one vehicle breaks.
    broken = sink._connections[0]._client
    broken.reconnect_delay_set(30, 30)
    broken.socket().shutdown(socket.SHUT_RDWR)
    topic = "uagv/v2/locatk/kiwi/connection"
    live.wait_for(lambda: len(subscriber.of(topic)) == 2)
    assert subscriber.of(topic)[1]["connectionState"] == "CONNECTIONBROKEN"
    assert len(subscriber.of("uagv/v2/locatk/lime/connection")) == 1
