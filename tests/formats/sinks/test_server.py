"""Servers of sinks: slow clients, restarts, and who may connect."""

from __future__ import annotations

import json
import socket
import threading
from collections.abc import Callable, Iterator
from types import ModuleType
from typing import Any

import pytest

from locatk.core.errors import InputError, LocatkError
from locatk.core.solution import SolverWarning
from locatk.core.streaming.events import WarningEvent
from locatk.formats.sinks import foxglove
from locatk.formats.sinks.addresses import parse_address
from locatk.formats.sinks.interface import SinkContext
from locatk.formats.sinks.server import (
    MAX_WAITING_EVENTS,
    SEND_BUFFER_BYTES,
    MessageQueue,
    QueuedMessage,
)
from locatk.formats.sinks.web import sink as web

CREATE: list[Callable[..., Any]] = [web.create, foxglove.create]


def warning(k: int, size: int = 0) -> WarningEvent:
    return WarningEvent("a", k, SolverWarning("test", f"{k}" + "x" * size))


@pytest.fixture
def connect() -> Any:
    return pytest.importorskip("websockets.sync.client").connect


def subscribe_all(client: Any) -> dict[str, int]:
    """Subscribe to the channels that a Foxglove client knows; return their topics' numbers."""
    assert json.loads(client.recv())["op"] == "serverInfo"
    channels = json.loads(client.recv())["channels"]
    wanted = [{"id": each["id"], "channelId": each["id"]} for each in channels]
    client.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
    return {each["topic"]: each["id"] for each in channels}


@pytest.fixture
def hung(servers: ModuleType) -> Iterator[Callable[[Any], socket.socket]]:
    """Return a function that connects a client to a Foxglove server, which never reads."""
    opened = []

    def hang(sink: Any) -> socket.socket:
        before = len(sink.clients)
        raw = socket.socket()
        raw.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        raw.connect(("127.0.0.1", servers.port_of(sink)))
        raw.sendall(
            b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            b"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n"
            b"Sec-WebSocket-Protocol: foxglove.websocket.v1\r\n\r\n"
        )
        servers.wait_until(lambda: len(sink.clients) > before)
        wanted = [{"id": number, "channelId": number} for number in (1, 3, 6)]
        text = json.dumps({"op": "subscribe", "subscriptions": wanted}).ljust(200).encode()
        raw.sendall(b"\x81\xfe" + len(text).to_bytes(2, "big") + bytes(4) + text)
        client = sink.clients[-1]
        servers.wait_until(lambda: len(client.subscriptions) == 3)
        opened.append(raw)
        return raw

    yield hang
    for raw in opened:
        raw.close()


class Reader(threading.Thread):
    """Reads the poses of a Foxglove client until it is closed."""

    def __init__(self, client: Any, channel: int) -> None:
        super().__init__(daemon=True)
        self.payloads: list[bytes] = []
        self._client, self._channel = client, channel
        self.start()

    def run(self) -> None:
        from websockets.exceptions import ConnectionClosed

        try:
            for frame in self._client:
                if (
                    isinstance(frame, bytes)
                    and int.from_bytes(frame[1:5], "little") == self._channel
                ):
                    self.payloads.append(frame[13:])
        except ConnectionClosed:
            pass


@pytest.mark.slow
def test_a_hung_client_delays_no_other_and_stays_bounded(
    servers: ModuleType, connect: Any, hung: Any
) -> None:
    context = SinkContext("lighthouse", devices=("a",))
    with (
        servers.running(foxglove.create, "foxglove://:0", context) as sink,
        connect(sink.url, subprotocols=["foxglove.sdk.v1"]) as good,
    ):
        reader = Reader(good, subscribe_all(good)["/odometry/a"])
        servers.wait_until(lambda: len(sink.clients[0].subscriptions) == 6)
        hung(sink)
        slow = sink.clients[1]
        most = 0
        for k in range(3000):
            servers.offer(sink, servers.pose(k=k))
            if k % 50 == 49:
                servers.wait_until(lambda k=k: len(reader.payloads) == k + 1)
                most = max(most, len(slow.queue))
        received = [foxglove.Odometry.FromString(each) for each in reader.payloads]
        assert [round(100 * each.pose.position.x) for each in received] == list(range(3000))
        assert 100 < most <= 1.5 * foxglove.MAX_WAITING + 1
        assert slow.connection.transport.get_write_buffer_size() < 2 * SEND_BUFFER_BYTES
        assert sink.clients[0].queue.replaced == 0
        # What the hung client gets, if ever, ends with the newest pose.
        assert sink.status().dropped == slow.queue.replaced > 1000
        assert slow.queue.take()[-1].message.event.time_ns == servers.pose(k=2999).time_ns


@pytest.mark.slow
def test_a_client_that_lets_too_many_events_wait_is_disconnected(
    servers: ModuleType, connect: Any, hung: Any
) -> None:
    context = SinkContext("lighthouse", devices=("a",))
    count = 3 * MAX_WAITING_EVENTS
    with (
        servers.running(foxglove.create, "foxglove://:0", context) as sink,
        connect(sink.url, subprotocols=["foxglove.sdk.v1"]) as good,
    ):
        reader = Reader(good, subscribe_all(good)["/log"])
        servers.wait_until(lambda: len(sink.clients[0].subscriptions) == 6)
        hung(sink)
        for k in range(count):
            servers.offer(sink, warning(k, 400))
            if k % 100 == 99:
                servers.wait_until(lambda k=k: len(reader.payloads) == k + 1)
        texts = [foxglove.Log.FromString(each).message for each in reader.payloads]
        assert [int(text.strip("ax: ")) for text in texts] == list(range(count))
        servers.wait_until(lambda: len(sink.clients) == 1)
        assert sink.status().dropped >= MAX_WAITING_EVENTS


@pytest.mark.slow
def test_servers_end_with_a_hung_client_and_share_a_thread(servers: ModuleType, hung: Any) -> None:
    def threads() -> int:
        return sum(each.name == "locatk servers" for each in threading.enumerate())

    assert threads() == 0
    first, second = (
        create(parse_address(f"{name}://:0"))
        for create, name in zip(CREATE, ("web", "foxglove"), strict=True)
    )
    first.open(SinkContext("lighthouse"))
    second.open(SinkContext("lighthouse", devices=("a",)))
    assert threads() == 1
    raw = hung(second)
    for k in range(2000):
        servers.offer(second, servers.pose(k=k))
    second.close(0.5)
    assert second.status().clients == 0
    assert threads() == 1
    assert servers.request(first, "/health")[0] in (200, 503)
    first.close(0.5)
    assert threads() == 0
    # The connection has ended: after what was sent, there is an end or a reset.
    raw.settimeout(10)
    try:
        while raw.recv(65536):
            pass
    except ConnectionError:
        pass
    servers.offer(first, servers.pose())  # No error, and nobody waits for it.


def test_a_server_can_start_again_at_its_port(servers: ModuleType, connect: Any) -> None:
    with servers.running(web.create, "web://:0") as sink:
        port = servers.port_of(sink)
        with connect(f"ws://127.0.0.1:{port}/ws") as client:
            assert json.loads(client.recv())["type"] == "hello"
            with pytest.raises(LocatkError, match=f"port {port} is in use") as caught:
                web.create(parse_address(f"web://:{port}")).open(SinkContext(""))
            assert f"web://127.0.0.1:{port + 1}" in str(caught.value.hint)
    with (
        servers.running(web.create, f"web://:{port}"),
        connect(f"ws://127.0.0.1:{port}/ws") as client,
    ):
        assert json.loads(client.recv())["type"] == "hello"


def test_unknown_hosts_and_options_are_errors(servers: ModuleType) -> None:
    with pytest.raises(LocatkError, match="unknown host"):
        web.create(parse_address("web://no.such.host.invalid:0")).open(SinkContext(""))
    with pytest.raises(InputError, match="unknown option 'colour'"):
        web.create(parse_address("web://:8080?colour=red"))
    for text in ("web:8080", "web://:8080/page"):
        with pytest.raises(InputError, match="has a path") as caught:
            web.create(parse_address(text))
        assert "web://:8080" in str(caught.value.hint)


@pytest.mark.parametrize("create", CREATE)
def test_a_missing_package_is_named(create: Any, without_extras: Callable[..., None]) -> None:
    without_extras("live")
    with pytest.raises(LocatkError, match="needs websockets") as caught:
        create(parse_address("x://:0")).open(SinkContext(""))
    assert 'pip install "locatk[live]"' in str(caught.value.hint)


# ---- who may connect


@pytest.mark.parametrize(
    ("host", "status"),
    [
        ("127.0.0.1:9", 200),
        ("localhost", 200),
        ("[::1]:80", 200),
        ("evil.example", 421),
        ("192.168.1.5", 421),
        ("localhost.evil.example:8080", 421),
        ("localhost:8080@evil.example", 421),
        ("", 421),
    ],
)
def test_only_its_own_hosts_are_answered(servers: ModuleType, host: str, status: int) -> None:
    with servers.running(web.create, "web://:0") as sink:
        for path in ("/", "/app.js"):
            assert servers.request(sink, path, {"Host": host})[0] == status
        assert servers.request(sink, "/health", {"Host": host})[0] in (status, 503)


def status_of(connect: Any, url: str, **options: Any) -> int:
    """Return the status with which a WebSocket is refused, or 101."""
    from websockets.exceptions import InvalidStatus

    try:
        with connect(url, **options):
            return 101
    except InvalidStatus as error:
        return int(error.response.status_code)


@pytest.mark.parametrize(
    ("origin", "web_status", "foxglove_status"),
    [
        (None, 101, 101),
        ("SAME", 101, 101),
        ("https://evil.example", 403, 403),
        ("null", 403, 403),
        ("http://localhost:8080", 403, 101),
        ("http://localhost.evil.example:8080", 403, 403),
        ("https://app.foxglove.dev", 403, 101),
        ("https://app.foxglove.dev.evil.example", 403, 403),
        ("file://", 403, 101),
    ],
)
def test_pages_of_other_origins_get_nothing(
    servers: ModuleType, connect: Any, origin: str | None, web_status: int, foxglove_status: int
) -> None:
    with (
        servers.running(web.create, "web://:0") as page,
        servers.running(foxglove.create, "foxglove://:0") as viewer,
    ):
        for sink, path, status, protocols in (
            (page, "/ws", web_status, None),
            (viewer, "/", foxglove_status, ["foxglove.sdk.v1"]),
        ):
            base = f"127.0.0.1:{servers.port_of(sink)}"
            own = f"http://{base}" if origin == "SAME" else origin
            url = f"ws://{base}{path}"
            assert status_of(connect, url, origin=own, subprotocols=protocols) == status


def test_other_addresses_need_a_token(servers: ModuleType, connect: Any) -> None:
    with servers.running(web.create, "web://0.0.0.0:0") as sink:
        port, token = servers.port_of(sink), sink.token
        assert len(token) >= 20
        assert sink.url.endswith(f":{port}/#token={token}")
        assert token not in sink.status().address
        url = f"ws://127.0.0.1:{port}/ws"
        assert status_of(connect, url) == 401
        assert status_of(connect, f"{url}?token=") == 401
        assert status_of(connect, f"{url}?token={token[:-1]}") == 401
        assert status_of(connect, f"{url}?token=%C3%A9") == 401
        assert status_of(connect, f"{url}?token={token}") == 101
        bearer = {"Authorization": f"Bearer {token}"}
        assert status_of(connect, url, additional_headers=bearer) == 101
        # A token does not open the door to the pages of others, nor to other names.
        assert status_of(connect, f"{url}?token={token}", origin="https://evil.example") == 403
        assert servers.request(sink, "/", {"Host": "evil.example"})[0] == 421
        assert servers.request(sink, "/", {"Host": f"192.168.1.5:{port}"})[0] == 200
        assert 'data-token="required"' in servers.request(sink, "/")[2]
        # Programs of this machine may ask for the health without it.
        assert servers.request(sink, "/health")[0] == 503


def test_the_token_of_the_session_is_needed_on_loopback_too(
    servers: ModuleType, connect: Any
) -> None:
    context = SinkContext("dots", token="secret")
    with servers.running(foxglove.create, "foxglove://:0", context) as sink:
        url = f"ws://127.0.0.1:{servers.port_of(sink)}/"
        options = {"subprotocols": ["foxglove.sdk.v1"]}
        assert sink.url == f"{url}?token=secret"
        assert status_of(connect, url, **options) == 401
        assert status_of(connect, url, origin="https://app.foxglove.dev", **options) == 403
        # Who knows the token may be of any origin: Foxglove has no other way to be let in.
        foreign = {"origin": "https://viewer.example", **options}
        assert status_of(connect, sink.url, **foreign) == 101
        assert status_of(connect, f"{url}?token=wrong", **foreign) == 403


def test_a_reverse_proxy_is_named_and_needs_a_token(servers: ModuleType, connect: Any) -> None:
    with servers.running(web.create, "web://:0?origin=https://Robots.example") as sink:
        assert sink.token is not None
        url = f"ws://127.0.0.1:{servers.port_of(sink)}/ws"
        assert status_of(connect, url, origin="https://robots.example") == 401
        with_token = f"{url}?token={sink.token}"
        assert status_of(connect, with_token, origin="https://robots.example") == 101
        assert status_of(connect, with_token, origin="https://evil.example") == 403
        assert servers.request(sink, "/", {"Host": "robots.example"})[0] == 200
        # What the proxy passes on comes from this machine, but is not of its users.
        assert servers.request(sink, "/health")[0] == 401
        assert servers.request(sink, f"/health?token={sink.token}")[0] == 503


def test_health_has_the_status_of_the_session(servers: ModuleType) -> None:
    state: dict[str, Any] = {"ok": True, "delay_s": float("nan")}
    with servers.running(web.create, "web://:0", SinkContext("", status=lambda: state)) as sink:
        status, headers, body = servers.request(sink, "/health")
        assert (status, json.loads(body)) == (200, {"ok": True, "delay_s": None})
        assert headers["Content-Type"] == "application/json"
        assert headers["Cache-Control"] == "no-store"
        state["ok"] = False
        assert servers.request(sink, "/health")[0] == 503
        assert servers.request(sink, "/other")[0] == 404

    def broken() -> dict[str, Any]:
        raise RuntimeError("no state")

    with servers.running(web.create, "web://:0", SinkContext("", status=broken)) as sink:
        status, _, body = servers.request(sink, "/health")
        assert status == 503
        assert "no state" in json.loads(body)["error"]


def read_all(client: Any) -> None:
    while True:
        client.recv(timeout=10)


@pytest.mark.parametrize("text", ["{", "[]", '{"op": "subscribe"}', '{"op":"subscribe","subscriptions":[{"id":1,"channelId":99}]}', "x" * 5000])  # fmt: skip  # noqa: E501
def test_an_invalid_message_ends_the_connection(
    servers: ModuleType, connect: Any, text: str
) -> None:
    from websockets.exceptions import ConnectionClosed

    with (
        servers.running(foxglove.create, "foxglove://:0") as sink,
        connect(sink.url, subprotocols=["foxglove.sdk.v1"]) as client,
    ):
        client.send(text)
        with pytest.raises(ConnectionClosed) as caught:
            read_all(client)
        assert caught.value.rcvd.code == (1009 if len(text) > 4096 else 1008)
        assert sink.status().error == ""


def test_a_queue_keeps_events_and_the_newest_poses(servers: ModuleType) -> None:
    queue = MessageQueue(10)
    for k in range(100):
        for device in ("a", "b"):
            queue.put(QueuedMessage(k, device))  # type: ignore[arg-type]
        if k % 20 == 0:
            queue.put(QueuedMessage(k, None))  # type: ignore[arg-type]
        assert len(queue) <= 20
    assert queue.events == 5
    items = queue.take()
    assert [item.message for item in items if item.device is None] == [0, 20, 40, 60, 80]
    assert [item.message for item in items if item.device == "a"][-1] == 99
    assert [item.message for item in items if item.device == "b"][-1] == 99
    assert queue.replaced == 200 - len(items) + 5
    assert not queue.take()
