"""MAVLink sink, received by pymavlink."""

from __future__ import annotations

import math
import os
import random
import socket
import time
from collections.abc import Iterator
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from locatk.core.errors import InputError
from locatk.core.streaming.events import TrackingState
from locatk.formats.sinks import mavlink_messages
from locatk.formats.sinks.interface import SinkContext
from locatk.formats.sinks.registry import create_sink


@pytest.fixture(scope="module")
def dialect() -> Any:
    return pytest.importorskip("pymavlink.dialects.v20.common", reason="pymavlink is not installed")


def parse(dialect: Any, data: bytes) -> list[Any]:
    """Return the messages in bytes; pymavlink raises on a wrong checksum."""
    return dialect.MAVLink(None).parse_buffer(data) or []


class Autopilot:
    """Receiver of datagrams, which decodes them with pymavlink."""

    def __init__(self, dialect: Any) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.settimeout(0.05)
        self.port = self.socket.getsockname()[1]
        self.messages: list[Any] = []
        self.sender: Any = None
        self._decoder = dialect.MAVLink(None)

    def of(self, name: str) -> list[Any]:
        """Receive what has come, and return all messages of a type so far."""
        while True:
            try:
                data, self.sender = self.socket.recvfrom(4096)
            except TimeoutError:
                return [each for each in self.messages if each.get_type() == name]
            self.messages += self._decoder.parse_buffer(data)


@pytest.fixture
def autopilot(dialect: Any) -> Iterator[Autopilot]:
    receiver = Autopilot(dialect)
    yield receiver
    receiver.socket.close()


@pytest.fixture
def opened() -> Iterator[Any]:
    sinks: list[Any] = []

    def create(text: str, *devices: str) -> Any:
        sink = create_sink(text)
        sinks.append(sink)
        sink.open(SinkContext("dots", devices=devices))
        return sink

    yield create
    for sink in sinks:
        sink.close(5)


def random_pose(live: ModuleType, seed: int) -> Any:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(6, 6))
    quaternion = Rotation.random(random_state=seed).as_quat()
    position = rng.normal(size=3)
    return live.pose(position=position, quaternion=quaternion, covariance=root @ root.T)


TO_FRD = np.diag([1.0, -1.0, -1.0])
TO_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(("is_ned", "axes", "frame"), [(False, TO_FRD, 20), (True, TO_NED, 1)])
def test_odometry_equals_the_rotated_pose(
    dialect: Any, live: ModuleType, seed: int, is_ned: bool, axes: Any, frame: int
) -> None:
    pose = random_pose(live, seed)
    data = mavlink_messages.Encoder(7).odometry(pose, is_ned)
    (message,) = parse(dialect, data)
    assert message.get_type() == "ODOMETRY"
    assert message.get_srcSystem() == 7
    assert message.get_srcComponent() == dialect.MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY
    assert message.time_usec == live.EPOCH_NS // 1000
    position = [message.x, message.y, message.z]
    np.testing.assert_allclose(position, axes @ pose.position, rtol=1e-6)
    w, x, y, z = message.q
    expected = axes @ Rotation.from_quat(pose.quaternion).as_matrix() @ TO_FRD
    np.testing.assert_allclose(Rotation.from_quat([x, y, z, w]).as_matrix(), expected, atol=1e-6)
    both = np.kron(np.eye(2), axes)
    covariance = np.zeros((6, 6))
    covariance[np.triu_indices(6)] = message.pose_covariance
    expected = np.triu(both @ pose.covariance @ both.T)
    np.testing.assert_allclose(covariance, expected, rtol=1e-5)
    assert (message.frame_id, message.child_frame_id) == (frame, dialect.MAV_FRAME_BODY_FRD)
    assert message.estimator_type == dialect.MAV_ESTIMATOR_TYPE_VISION
    velocities = [message.vx, message.vy, message.vz, message.rollspeed, message.yawspeed]
    assert all(math.isnan(each) for each in velocities)
    assert math.isnan(message.velocity_covariance[0])


@pytest.mark.parametrize("seed", range(3))
def test_vision_position_estimate(dialect: Any, live: ModuleType, seed: int) -> None:
    pose = random_pose(live, seed)
    (message,) = parse(dialect, mavlink_messages.Encoder(1).vision_position(pose, False))
    assert message.get_type() == "VISION_POSITION_ESTIMATE"
    angles = [message.roll, message.pitch, message.yaw]
    rotation = TO_FRD @ Rotation.from_quat(pose.quaternion).as_matrix() @ TO_FRD
    np.testing.assert_allclose(Rotation.from_euler("xyz", angles).as_matrix(), rotation, atol=1e-6)
    np.testing.assert_allclose([message.x, message.y, message.z], TO_FRD @ pose.position, rtol=1e-6)
    assert message.covariance[0] == pytest.approx(pose.covariance[0, 0])


def test_resets_and_quality(dialect: Any, live: ModuleType) -> None:
    encoder = mavlink_messages.Encoder(1)
    changes = [
        {"reset_counter": 255},
        {"state": TrackingState.PROVISIONAL},
        {"covariance": np.diag([25.0] * 6)},
        {"covariance": np.full((6, 6), math.nan)},
        {"probability": 0.5},
    ]
    messages = [
        each
        for change in changes
        for each in parse(dialect, encoder.odometry(live.pose(**change), False))
    ]
    assert [each.reset_counter for each in messages] == [255, 0, 0, 0, 0]
    # Radius sqrt(5.99) x 10 mm: exp(-0.0245) = 0.976.
    assert [each.quality for each in messages] == [98, 50, 1, 1, 49]
    assert [each.get_seq() for each in messages] == [0, 1, 2, 3, 4]
    unknown = messages[3].pose_covariance
    assert [unknown[k] for k in (0, 6, 11, 15, 18, 20)] == [1e6] * 6


def test_sequence_numbers_wrap_around(dialect: Any) -> None:
    encoder = mavlink_messages.Encoder(1)
    frames = [encoder.heartbeat() for _ in range(257)]
    (last,) = parse(dialect, frames[-1])
    assert last.get_seq() == 0
    assert (last.type, last.autopilot) == (18, 8)


@pytest.mark.slow
def test_newest_pose_wins_at_50_hz(live: ModuleType, autopilot: Any, opened: Any) -> None:
    sink = opened(f"mavlink:udpout:127.0.0.1:{autopilot.port}?sysid=3")
    live.wait_for(lambda: autopilot.of("HEARTBEAT"))
    begin = time.monotonic()
    for k in range(120):
        live.offer(sink, live.pose(k))
        time.sleep(0.001)
    live.wait_for(lambda: autopilot.of("ODOMETRY") and autopilot.of("ODOMETRY")[-1].x == 119)
    duration = time.monotonic() - begin
    received = [each.x for each in autopilot.of("ODOMETRY")]
    assert received == sorted(set(received))
    assert 2 < len(received) <= duration * 50 + 2
    assert sink.status().sent == len(received)
    assert sink.status().dropped == 0
    assert sink.status().address == f"udpout:127.0.0.1:{autopilot.port}"


def test_slow_poses_all_arrive(live: ModuleType, autopilot: Any, opened: Any) -> None:
    sink = opened(f"mavlink:udpout:127.0.0.1:{autopilot.port}?message=vision&frame=ned")
    for k in range(5):
        live.offer(sink, live.pose(k))
        live.wait_for(lambda k=k: len(autopilot.of("VISION_POSITION_ESTIMATE")) == k + 1)
        time.sleep(0.025)
    live.wait_for(lambda: len(autopilot.of("VISION_POSITION_ESTIMATE")) == 5)
    assert [each.y for each in autopilot.of("VISION_POSITION_ESTIMATE")] == [0, 1, 2, 3, 4]


def test_last_pose_is_sent_at_the_end(live: ModuleType, autopilot: Any, opened: Any) -> None:
    sink = opened(f"mavlink:udpout:127.0.0.1:{autopilot.port}")
    live.offer(sink, live.pose(1), live.pose(2))
    sink.close(2)
    assert autopilot.of("ODOMETRY")[-1].x == 2


@pytest.mark.slow
def test_heartbeat_and_timesync(
    live: ModuleType, autopilot: Any, opened: Any, dialect: Any
) -> None:
    opened(f"mavlink:udpout:127.0.0.1:{autopilot.port}")
    live.wait_for(lambda: autopilot.of("HEARTBEAT"))
    sender = dialect.MAVLink(None, srcSystem=1)
    request = sender.timesync_encode(0, 123_456_789_012).pack(sender)
    answer_of_other = sender.timesync_encode(5, 6).pack(sender)
    autopilot.socket.sendto(answer_of_other + request, autopilot.sender)
    (answer,) = live.wait_for(lambda: autopilot.of("TIMESYNC"))
    assert answer.ts1 == 123_456_789_012
    assert abs(answer.tc1 - time.time_ns()) < 60e9
    live.wait_for(lambda: len(autopilot.of("HEARTBEAT")) == 3)
    sequence = [each.get_seq() for each in autopilot.messages]
    assert sequence == list(range(len(sequence)))


def test_reader_survives_errors_of_the_link(
    dialect: Any, live: ModuleType, autopilot: Any, opened: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    sink = create_sink(f"mavlink:udpout:127.0.0.1:{autopilot.port}")
    read, errors = sink._link.read, iter([ValueError("closed"), AttributeError("_overlapped")])

    def failing_read() -> bytes:
        error = next(errors, None)
        if error is not None:
            raise error
        return read()

    monkeypatch.setattr(sink._link, "read", failing_read)
    sink.open(SinkContext("dots"))
    live.wait_for(lambda: autopilot.of("HEARTBEAT"))
    live.wait_for(lambda: next(errors, None) is None)
    request = dialect.MAVLink(None).timesync_encode(0, 77).pack(dialect.MAVLink(None))
    autopilot.socket.sendto(request, autopilot.sender)
    live.wait_for(lambda: autopilot.of("TIMESYNC"))
    sink.close(5)


def test_requests_in_a_stream_with_noise(dialect: Any) -> None:
    rng = random.Random(4)
    new = dialect.MAVLink(None, srcSystem=1)
    old_module = pytest.importorskip("pymavlink.dialects.v10.common")
    old = old_module.MAVLink(None, srcSystem=1)
    stream, expected = b"", []
    for k in range(1, 60):
        which = (new, old)[k % 2]
        stream += which.timesync_encode(0, k).pack(which)
        stream += new.heartbeat_encode(2, 12, 0, 0, 4).pack(new)
        # Frames that are damaged, and bytes between frames without a start.
        broken = bytearray(new.timesync_encode(0, 10_000 + k).pack(new))
        broken[12] ^= 0x40
        # The start of a frame that is none would take in the request after it.
        broken += bytes([0xFD, 16, 0, 0, 0, 1, 1, mavlink_messages.TIMESYNC, 0, 0])
        stream += bytes(broken) + bytes(rng.randrange(0xF0) for _ in range(k % 5))
        expected.append(k)
    buffer, received = bytearray(), []
    while stream:
        size = rng.randint(1, 40)
        buffer += stream[:size]
        stream = stream[size:]
        received += mavlink_messages.timesync_requests(buffer)
        assert len(buffer) < 300
    assert received == expected


def test_one_vehicle_is_one_device(live: ModuleType, autopilot: Any, opened: Any) -> None:
    sink = opened(f"mavlink:udpout:127.0.0.1:{autopilot.port}?device=kiwi", "kiwi", "lime")
    live.offer(sink, live.pose(1, "lime"), live.pose(2, "kiwi"), live.lost("kiwi"))
    live.wait_for(lambda: autopilot.of("ODOMETRY"))
    assert [each.x for each in autopilot.of("ODOMETRY")] == [2]
    assert sink.status().error == ""

    unchosen = opened(f"mavlink:udpout:127.0.0.1:{autopilot.port}")
    live.offer(unchosen, live.pose(3, "kiwi"), live.pose(4, "lime"))
    live.wait_for(lambda: "device=NAME" in unchosen.status().error)
    with pytest.raises(InputError, match="2 devices for one vehicle") as caught:
        opened("mavlink:udpout:127.0.0.1:1", "kiwi", "lime")
    assert "kiwi, lime" in str(caught.value.hint)


def test_pose_without_orientation_is_refused(live: ModuleType, autopilot: Any, opened: Any) -> None:
    sink = opened(f"mavlink:udpout:127.0.0.1:{autopilot.port}")
    live.offer(sink, live.position_only())
    live.wait_for(lambda: sink.status().dropped == 1)
    assert "no orientation" in sink.status().error
    assert not autopilot.of("ODOMETRY")


def test_udpin_answers_the_last_sender(
    live: ModuleType, autopilot: Any, opened: Any, dialect: Any
) -> None:
    port = live.free_port(socket.SOCK_DGRAM)
    sink = opened(f"mavlink:udpin:127.0.0.1:{port}")
    live.wait_for(lambda: "no autopilot" in sink.status().error)
    sender = dialect.MAVLink(None)
    heartbeat = sender.heartbeat_encode(2, 12, 0, 0, 4).pack(sender)

    def arrives() -> bool:
        autopilot.socket.sendto(heartbeat, ("127.0.0.1", port))
        live.offer(sink, live.pose(5))
        return bool(autopilot.of("ODOMETRY"))

    live.wait_for(arrives)
    live.wait_for(lambda: sink.status().error == "")


@pytest.mark.skipif(not hasattr(os, "openpty"), reason="no pseudo-terminals")
def test_serial_port(live: ModuleType, opened: Any, dialect: Any) -> None:
    import tty

    controller, port = os.openpty()
    tty.setraw(port)
    sink = opened(f"mavlink:serial:{os.ttyname(port)}:57600")
    live.offer(sink, live.pose(8))
    decoder = dialect.MAVLink(None)
    decoder.robust_parsing = True
    messages: list[Any] = []

    def received(name: str) -> list[Any]:
        messages.extend(decoder.parse_buffer(os.read(controller, 4096)) or [])
        return [each for each in messages if each.get_type() == name]

    assert live.wait_for(lambda: received("ODOMETRY"))[0].x == 8
    os.write(controller, decoder.timesync_encode(0, 77).pack(decoder))
    assert live.wait_for(lambda: received("TIMESYNC"))[0].ts1 == 77
    sink.close(2)
    os.close(controller)
    os.close(port)


def test_absent_serial_port_is_an_error_of_the_status(live: ModuleType, opened: Any) -> None:
    sink = opened("mavlink:serial:/dev/no-such-port")
    live.wait_for(lambda: "no-such-port" in sink.status().error)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("mavlink:", "no link"),
        ("mavlink:udpout:host", "no link"),
        ("mavlink:udpout:host:99999", "no link"),
        ("mavlink:tcp:host:1", "no link"),
        ("mavlink:serial:", "no link"),
        ("mavlink:udpout:host:1?sysid=0", "sysid=0"),
        ("mavlink:udpout:host:1?frame=enu", "frame=enu"),
        ("mavlink:udpout:host:1?rate=5", "unknown option"),
    ],
)
def test_bad_addresses_are_refused(text: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        create_sink(text)


def test_payload_sizes() -> None:
    # Zeros at the end are left out, except for the first byte.
    encoder = mavlink_messages.Encoder(1)
    assert encoder.timesync(1, 0)[1] == 1
    assert encoder.timesync(0, 0)[1] == 1
    assert mavlink_messages._ODOMETRY.size == 233
    assert mavlink_messages._VISION.size == 117
