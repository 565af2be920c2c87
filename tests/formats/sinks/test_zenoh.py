"""zenoh sink against a router and a subscriber in processes of their own, decoded by rosbags."""

from __future__ import annotations

import functools
import json
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from types import ModuleType
from typing import Any

import pytest

from locatk.core.errors import InputError, LocatkError
from locatk.formats.sinks import cdr
from locatk.formats.sinks.addresses import parse_address
from locatk.formats.sinks.interface import SinkContext
from locatk.formats.sinks.registry import create_sink

PEER = """
import json, sys, threading, time, zenoh
lock = threading.Lock()
port, mode, key = sys.argv[1:]
config = zenoh.Config()
config.insert_json5("mode", json.dumps(mode))
where = "listen" if mode == "router" else "connect"
config.insert_json5(where + "/endpoints", json.dumps(["tcp/127.0.0.1:" + port]))
if mode == "peer":
    config.insert_json5("listen/endpoints", '["tcp/127.0.0.1:0"]')
config.insert_json5("scouting/multicast/enabled", "false")
session = zenoh.open(config)
def show(kind, sample):
    attachment = sample.attachment.to_bytes().hex() if sample.attachment else ""
    content = sample.payload.to_bytes().hex()
    line = json.dumps([kind, str(sample.kind), str(sample.key_expr), content, attachment])
    with lock:
        print(line, flush=True)
if key:
    tokens = session.liveliness().declare_subscriber(
        "@ros2_lv/**", lambda sample: show("token", sample), history=True)
    messages = session.declare_subscriber(key, lambda sample: show("message", sample))
with lock:
    print('["ready"]', flush=True)
time.sleep(100)
"""


class Peer:
    """Router or subscriber in another process."""

    def __init__(self, port: int, mode: str, key: str = "") -> None:
        self.lines: list[Any] = []
        command = [sys.executable, "-c", PEER, str(port), mode, key]
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE)
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()
        until = time.monotonic() + 20
        while ["ready"] not in self.lines:
            assert time.monotonic() < until
            time.sleep(0.005)

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self.lines.append(json.loads(line))

    def messages(self, text: str) -> list[tuple[bytes, bytes]]:
        """Return content and attachment of the messages whose key contains a text."""
        return [
            (bytes.fromhex(content), bytes.fromhex(attachment))
            for kind, _, key, content, attachment in (x for x in list(self.lines) if len(x) > 1)
            if kind == "message" and text in key
        ]

    def tokens(self, kind: str) -> list[str]:
        return [x[2] for x in list(self.lines) if len(x) > 1 and x[0] == "token" and kind in x[1]]

    def stop(self) -> None:
        self._process.kill()
        self._process.wait()


@pytest.fixture
def peers(live: ModuleType) -> Iterator[Any]:
    pytest.importorskip("zenoh", reason="eclipse-zenoh is not installed")
    started: list[Peer] = []
    port = live.free_port()

    def start(mode: str, key: str = "") -> Peer:
        started.append(Peer(port, mode, key))
        return started[-1]

    start.port = port  # type: ignore[attr-defined]
    yield start
    for each in started:
        each.stop()


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


@functools.cache
def typestore() -> Any:
    typesys = pytest.importorskip("rosbags.typesys", reason="rosbags is not installed")
    return typesys.get_typestore(typesys.Stores.ROS2_JAZZY)


def decode(content: bytes, name: str) -> Any:
    return typestore().deserialize_cdr(content, name)


@pytest.mark.slow
def test_poses_reach_a_subscriber_in_order(live: ModuleType, peers: Any, opened: Any) -> None:
    peers("router")
    subscriber = peers("peer", "5/**")
    sink = opened(f"zenoh://127.0.0.1:{peers.port}?domain=5&namespace=lab", "robot 1")
    live.wait_for(lambda: subscriber.tokens("PUT"))
    live.wait_for(lambda: sink.status().clients)
    time.sleep(0.1)  # The subscription reaches the sink.
    for k in range(500):
        live.offer(sink, live.pose(k, "robot 1"))
        time.sleep(0.0005)
    live.offer(sink, live.lost(), live.position_only(501, "robot 1"))
    key = "5/lab/pose_with_covariance/robot_1/geometry_msgs::msg::dds_::PoseWithCovariance"
    live.wait_for(lambda: len(subscriber.messages(key)) == 501)
    received = subscriber.messages(key)
    poses = [decode(content, cdr.POSE_TYPE) for content, _ in received]
    assert [each.pose.pose.position.x for each in poses] == [*range(500), 501]
    first = poses[0].header
    assert first.stamp.sec * 10**9 + first.stamp.nanosec == live.EPOCH_NS
    assert first.frame_id == "floor"
    for index, (_, attachment) in enumerate(received, 1):
        sequence, sent_ns, size, identifier = struct.unpack("<qqB16s", attachment)
        assert (sequence, size) == (index, 16)
        assert abs(sent_ns - time.time_ns()) < 600e9
        assert identifier == received[0][1][-16:]
    # No transform without an orientation.
    transforms = subscriber.messages("5/tf/tf2_msgs::msg::dds_::TFMessage_/RIHS01_e369")
    assert len(transforms) == 500
    (transform,) = decode(transforms[7][0], cdr.TRANSFORM_TYPE).transforms
    assert (transform.header.frame_id, transform.child_frame_id) == ("floor", "robot 1")
    assert transform.transform.translation.x == 7
    assert sink.status().sent == 501
    assert sink.status().dropped == 0

    session = subscriber.tokens("PUT")[0].split("/")[2]
    tokens = {
        f"@ros2_lv/5/{session}/0/0/NN/%/%/locatk",
        f"@ros2_lv/5/{session}/0/1/MP/%/%/locatk/%lab%pose_with_covariance%robot_1/"
        f"geometry_msgs::msg::dds_::PoseWithCovarianceStamped_/{cdr.TYPE_HASHES[cdr.POSE_TYPE]}"
        "/1:2:1,10:,:,:,,",
        f"@ros2_lv/5/{session}/0/2/MP/%/%/locatk/%tf/tf2_msgs::msg::dds_::TFMessage_/"
        f"{cdr.TYPE_HASHES[cdr.TRANSFORM_TYPE]}/1:2:1,10:,:,:,,",
    }
    assert set(subscriber.tokens("PUT")) == tokens
    sink.close(5)
    live.wait_for(lambda: set(subscriber.tokens("DELETE")) == tokens)


@pytest.mark.slow
def test_router_that_comes_later_and_restarts(live: ModuleType, peers: Any, opened: Any) -> None:
    sink = opened(f"zenoh://127.0.0.1:{peers.port}?tf=no&topic=pose&frame=map")
    live.wait_for(lambda: sink.status().error == f"no router at tcp/127.0.0.1:{peers.port}")
    live.offer(sink, live.pose(0))
    router = peers("router")
    subscriber = peers("peer", "0/**")

    def arrives(index: int) -> None:
        def attempt() -> bool:
            live.offer(sink, live.pose(index))
            time.sleep(0.01)
            return any(
                decode(content, cdr.POSE_TYPE).pose.pose.position.x == index
                for content, _ in subscriber.messages("0/pose/")
            )

        live.wait_for(attempt, 20)

    arrives(1)
    live.wait_for(lambda: sink.status().error == "")
    assert decode(subscriber.messages("0/pose/")[-1][0], cdr.POSE_TYPE).header.frame_id == "map"
    router.stop()
    live.wait_for(lambda: sink.status().error.startswith("no router"))
    dropped = sink.status().dropped
    live.offer(sink, *(live.pose(k) for k in range(10, 20)))
    live.wait_for(lambda: sink.status().dropped == dropped + 10)
    peers("router")
    arrives(30)
    live.wait_for(lambda: sink.status().error == "")
    assert not subscriber.messages("/tf/")


def test_humble_has_no_hashes() -> None:
    sink: Any = create_sink("zenoh://host?distro=humble")
    key, token = sink.keys("/tf", cdr.TRANSFORM_TYPE, "abc")
    assert key == "0/tf/tf2_msgs::msg::dds_::TFMessage_/TypeHashNotSupported"
    assert "/TypeHashNotSupported/" in token


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("zenoh://host?domain=300", "domain=300"),
        ("zenoh:?distro=foxy", "distro=foxy"),
        ("zenoh:?topic=a b", "no topic of ROS"),
        ("zenoh:?namespace=7up", "no topic of ROS"),
        ("zenoh:?qos=1", "unknown option"),
        ("zenoh:?tf=maybe", "tf=maybe"),
    ],
)
def test_bad_addresses_are_refused(text: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        create_sink(text)


def test_missing_package_is_named(without_extras: Any) -> None:
    sink = create_sink("zenoh://host")
    without_extras("zenoh")
    with pytest.raises(LocatkError, match="eclipse-zenoh"):
        sink.open(SinkContext("dots"))


def test_devices_with_equal_names_in_ros_are_refused(live: ModuleType) -> None:
    from locatk.formats.sinks.ros_topics import RosTopics

    names = RosTopics(parse_address("zenoh://host"))
    assert names.pose_topic("robot 1") == "/pose_with_covariance/robot_1"
    assert names.pose_topic("robot 1") == "/pose_with_covariance/robot_1"
    with pytest.raises(InputError, match="same topic"):
        names.pose_topic("robot/1")
    assert names.child_frame(live.pose(device="floor")) == "floor_body"
