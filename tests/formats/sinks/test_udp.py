"""UDP sink against sockets."""

from __future__ import annotations

import json
import math
import socket
import struct
from collections.abc import Iterator
from types import ModuleType
from typing import Any

import pytest

from locatk.core.errors import InputError
from locatk.core.streaming.events import StateChange, TrackingState
from locatk.formats.sinks.interface import SinkContext
from locatk.formats.sinks.registry import create_sink
from locatk.formats.sinks.udp import pack


@pytest.fixture
def receive() -> Iterator[Any]:
    """Return a function (family, address) that returns a bound socket."""
    sockets: list[socket.socket] = []

    def bind(family: int = socket.AF_INET, host: str = "127.0.0.1") -> socket.socket:
        receiver = socket.socket(family, socket.SOCK_DGRAM)
        sockets.append(receiver)
        receiver.settimeout(10)
        try:
            receiver.bind((host, 0))
        except OSError as error:
            pytest.skip(f"cannot receive at {host}: {error}")
        return receiver

    yield bind
    for each in sockets:
        each.close()


@pytest.fixture
def opened() -> Iterator[Any]:
    sinks: list[Any] = []

    def create(text: str) -> Any:
        sink = create_sink(text)
        sinks.append(sink)
        sink.open(SinkContext("dots"))
        return sink

    yield create
    for sink in sinks:
        sink.close(5)


def test_json_datagrams_in_order(live: ModuleType, receive: Any, opened: Any) -> None:
    receiver = receive()
    sink = opened(f"udp://localhost:{receiver.getsockname()[1]}")
    received = []
    for k in range(300):
        live.offer(sink, live.pose(k))
        received.append(json.loads(receiver.recv(65536)))
    assert [each["x_m"] for each in received] == list(range(300))
    assert received[0]["type"] == "pose"
    assert received[0]["sigma_x_m"] == 0.01
    assert 0 <= received[0]["latency_s"] < 10
    live.offer(sink, live.lost(), live.warning())
    assert [json.loads(receiver.recv(65536))["type"] for _ in range(2)] == ["state", "warning"]
    live.wait_for(lambda: sink.status().sent == 302)
    assert sink.status().dropped == 0


def test_packed_datagrams(live: ModuleType, receive: Any, opened: Any) -> None:
    receiver = receive()
    sink = opened(f"udp://127.0.0.1:{receiver.getsockname()[1]}?format=packed")
    provisional = live.pose(7, state=TrackingState.PROVISIONAL, reset_counter=9)
    recovered = StateChange("robot", live.EPOCH_NS, TrackingState.TRACKING)
    live.offer(sink, provisional, live.correction(), recovered, live.lost())
    # Offsets as documented, without the Struct of the sink.
    data = receiver.recv(200)
    assert len(data) == 84
    assert data[:2] == b"LK"
    assert list(data[2:6]) == [1, 1, 9, 0]
    assert struct.unpack_from("<H", data, 6) == (0,)
    assert struct.unpack_from("<q", data, 8) == (provisional.time_ns,)
    assert data[16:32] == b"robot".ljust(16, b"\0")
    assert struct.unpack_from("<3f", data, 32) == (7, 0.5, 0.25)
    quaternion = struct.unpack_from("<4f", data, 44)
    assert quaternion == pytest.approx(provisional.quaternion.tolist())
    sigma = struct.unpack_from("<6f", data, 60)
    assert sigma == pytest.approx([0.01] * 3 + [0.02] * 3)
    data = receiver.recv(200)
    assert (data[3], data[6]) == (0, 1)  # lost, the next number: the others have no datagram
    assert all(math.isnan(each) for each in struct.unpack_from("<13f", data, 32))
    live.wait_for(lambda: sink.status().sent == 2)
    assert sink.status().dropped == 0


def test_packed_unknown_orientation_and_long_names(live: ModuleType) -> None:
    packed = pack(live.position_only(1, "ein zu länger Name"), 5)
    assert packed is not None
    assert packed[16:32] == "ein zu länger ".encode().ljust(16, b"\0")
    cut = pack(live.pose(1, "abcdefghijklmnä"), 5)  # the last letter would be cut in the middle
    assert cut is not None
    assert cut[16:32] == b"abcdefghijklmn\0\0"
    assert math.isnan(struct.unpack_from("<f", packed, 44)[0])
    assert math.isnan(struct.unpack_from("<f", packed, 80)[0])


def test_ipv6(live: ModuleType, receive: Any, opened: Any) -> None:
    receiver = receive(socket.AF_INET6, "::1")
    sink = opened(f"udp://[::1]:{receiver.getsockname()[1]}")
    live.offer(sink, live.pose(3))
    assert json.loads(receiver.recv(65536))["x_m"] == 3
    assert sink.status().address.startswith("udp://[::1]:")


def test_ipv4_comes_first(
    live: ModuleType, receive: Any, opened: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    receiver = receive()
    port = receiver.getsockname()[1]
    answers = [
        (socket.AF_INET6, socket.SOCK_DGRAM, 17, "", ("::1", port, 0, 0)),
        (socket.AF_INET, socket.SOCK_DGRAM, 17, "", ("127.0.0.1", port)),
    ]
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_args, **_options: list(answers))
    live.offer(opened(f"udp://localhost:{port}"), live.pose(3))
    assert json.loads(receiver.recv(65536))["x_m"] == 3


def test_multicast(live: ModuleType, receive: Any, opened: Any) -> None:
    receiver = receive(host="0.0.0.0")
    group = socket.inet_aton("239.255.77.7") + socket.inet_aton("0.0.0.0")
    try:
        receiver.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, group)
    except OSError as error:
        pytest.skip(f"no multicast here: {error}")
    sink = opened(f"udp://239.255.77.7:{receiver.getsockname()[1]}")
    live.offer(sink, live.pose(3))
    assert json.loads(receiver.recv(65536))["x_m"] == 3


def test_broadcast(live: ModuleType, receive: Any, opened: Any) -> None:
    receiver = receive(host="0.0.0.0")
    sink = opened(f"udp://127.255.255.255:{receiver.getsockname()[1]}")
    live.offer(sink, live.pose(3))
    assert json.loads(receiver.recv(65536))["x_m"] == 3


def test_message_that_is_no_datagram_is_dropped(
    live: ModuleType, receive: Any, opened: Any
) -> None:
    receiver = receive()
    sink = opened(f"udp://127.0.0.1:{receiver.getsockname()[1]}")
    live.offer(sink, live.lost(reason="x" * 70_000), live.pose(3))
    assert json.loads(receiver.recv(65536))["x_m"] == 3
    assert sink.status().dropped == 1
    assert "no datagram" in sink.status().error


def test_unknown_host_is_an_error_of_the_status(live: ModuleType, opened: Any) -> None:
    sink = opened("udp://no-such-host.invalid:9000")
    live.offer(sink, live.pose(3))
    live.wait_for(lambda: sink.status().error)
    assert sink.status().sent == 0


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("udp://:9000", "no host"),
        ("udp:host:9000", "no host"),
        ("udp://host", "no port"),
        ("udp://host:0x50", "invalid port"),
        ("udp://[::1:9000", "invalid host"),
        ("udp://host:9000?format=xml", "format=xml"),
        ("udp://host:9000?rate=5", "unknown option"),
    ],
)
def test_bad_addresses_are_refused(text: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        create_sink(text)
