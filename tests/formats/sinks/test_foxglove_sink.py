"""The Foxglove WebSocket protocol, decoded with nothing but what the server advertises."""

from __future__ import annotations

import base64
import contextlib
import json
import struct
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass

from locatk.core.lighthouse.calibration import IDEAL_CALIBRATION
from locatk.core.lighthouse.results import StationDetection
from locatk.core.lighthouse.scene import Marker, Scene, Station
from locatk.core.polaris.tag import PlanarPose, Tags
from locatk.core.solution import SolverWarning
from locatk.core.streaming.events import (
    ArtifactUpdate,
    Correction,
    DetectionEvent,
    StateChange,
    TrackingState,
    WarningEvent,
)
from locatk.formats.sinks.foxglove import SUBPROTOCOLS, create
from locatk.formats.sinks.interface import SinkContext

SCENE = Scene(
    stations=(Station(2, np.array([-2.0, 0.0, 2.0]), np.eye(3), IDEAL_CALIBRATION, 0xABC),),
    markers=(Marker("left", np.array([0.5, 0.5, 0.0])),),
    scale="markers",
)


class Viewer:
    """Client that knows the protocol, and no schema."""

    def __init__(self, sink: Any, subprotocol: str = SUBPROTOCOLS[1]) -> None:
        connect = pytest.importorskip("websockets.sync.client").connect
        self._stack = contextlib.ExitStack()
        self.socket = self._stack.enter_context(connect(sink.url, subprotocols=[subprotocol]))
        self.info = json.loads(self.socket.recv(timeout=10))
        self.channels: dict[int, dict[str, Any]] = {}
        self.messages: list[tuple[str, int, Any]] = []
        self.read()

    def __enter__(self) -> Viewer:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def subscribe(self, *topics: str) -> None:
        """Subscribe to topics; the id of a subscription is 100 more than that of its channel."""
        wanted = [
            {"id": 100 + number, "channelId": number}
            for number, channel in self.channels.items()
            if channel["topic"] in topics
        ]
        assert len(wanted) == len(topics)
        self.socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))

    def unsubscribe(self, number: int) -> None:
        self.socket.send(json.dumps({"op": "unsubscribe", "subscriptionIds": [100 + number]}))

    def read(self) -> None:
        """Read one frame."""
        frame = self.socket.recv(timeout=10)
        if isinstance(frame, str):
            message = json.loads(frame)
            assert message["op"] == "advertise"
            for channel in message["channels"]:
                assert channel["id"] not in self.channels
                self.channels[channel["id"]] = channel
            return
        opcode, subscription, time_ns = struct.unpack_from("<BIQ", frame)
        assert opcode == 1
        channel = self.channels[subscription - 100]
        self.messages.append((channel["topic"], time_ns, decode(channel, frame[13:])))

    def read_messages(self, count: int) -> list[tuple[str, int, Any]]:
        """Read until there are so many messages; return them."""
        while len(self.messages) < count:
            self.read()
        result, self.messages = self.messages, []
        return result


def decode(channel: dict[str, Any], payload: bytes) -> Any:
    """Decode a message by the schema of its channel."""
    if channel["encoding"] == "json":
        assert json.loads(channel["schema"])["type"] == "object"
        return json.loads(payload)
    assert channel["encoding"] == channel["schemaEncoding"] == "protobuf"
    pool = DescriptorPool()
    for file in FileDescriptorSet.FromString(base64.b64decode(channel["schema"])).file:
        pool.Add(file)  # Fails if a dependency is missing.
    return GetMessageClass(pool.FindMessageTypeByName(channel["schemaName"])).FromString(payload)


@pytest.mark.parametrize("subprotocol", SUBPROTOCOLS)
def test_poses_arrive_on_their_channels(servers: ModuleType, subprotocol: str) -> None:
    context = SinkContext("lighthouse", devices=("a", "floor"))
    with (
        servers.running(create, "foxglove://:0", context) as sink,
        Viewer(sink, subprotocol) as viewer,
    ):
        assert viewer.socket.subprotocol == subprotocol
        assert viewer.info["op"] == "serverInfo"
        assert viewer.info["capabilities"] == []
        topics = {channel["topic"] for channel in viewer.channels.values()}
        assert topics == {"/tf", "/scene", "/log", "/detections"} | {
            f"/{kind}/{device}" for kind in ("pose", "odometry") for device in ("a", "floor")
        }
        viewer.subscribe("/pose/a", "/odometry/a", "/tf")
        servers.wait_until(lambda: len(sink.clients[0].subscriptions) == 3)
        covariance = np.arange(36.0).reshape(6, 6)
        covariance[5] = np.nan
        pose = servers.pose(
            k=3,
            covariance=covariance,
            state=TrackingState.DEAD_RECKONING,
            reason="no light",
        )
        servers.offer(sink, pose)
        servers.offer(sink, servers.pose("floor"))  # The frame has this name, too.
        messages = {topic: (t, message) for topic, t, message in viewer.read_messages(3)}
        assert set(messages) == {"/pose/a", "/odometry/a", "/tf"}
        for time_ns, message in messages.values():
            assert time_ns == pose.time_ns == message.timestamp.ToNanoseconds()
        in_frame = messages["/pose/a"][1]
        assert in_frame.frame_id == "floor"
        position, rotation = in_frame.pose.position, in_frame.pose.orientation
        assert (position.x, position.y, position.z) == pytest.approx((0.03, 0.5, 0.0))
        assert (rotation.x, rotation.y, rotation.z, rotation.w) == (0.0, 0.0, 0.6, 0.8)
        odometry = messages["/odometry/a"][1]
        assert str(odometry.pose) == str(in_frame.pose)
        assert (odometry.frame_id, odometry.body_frame_id) == ("floor", "a")
        np.testing.assert_array_equal(odometry.pose_covariance, covariance.ravel())
        facts = {pair.key: pair.value for pair in odometry.metadata}
        assert facts == {"state": "dead reckoning", "reason": "no light"}
        transform = messages["/tf"][1]
        assert (transform.parent_frame_id, transform.child_frame_id) == ("floor", "a")
        assert transform.rotation.w == 0.8
        (_, _, other) = viewer.read_messages(1)[0]
        assert other.child_frame_id == "floor_body"
        servers.wait_until(lambda: sink.status().sent == 4)


def test_clients_get_what_they_subscribed_to(servers: ModuleType) -> None:
    with servers.running(create, "foxglove://:0") as sink, Viewer(sink) as viewer:
        servers.offer(sink, servers.pose("new"))
        viewer.read()  # The channels of a device that was not known before.
        assert {"/pose/new", "/odometry/new"} < {c["topic"] for c in viewer.channels.values()}
        viewer.subscribe("/pose/new")
        servers.wait_until(lambda: sink.clients[0].subscriptions)
        for k in range(200):
            servers.offer(sink, servers.pose("new", k))
        messages = viewer.read_messages(200)
        assert {topic for topic, _, _ in messages} == {"/pose/new"}
        assert [t for _, t, _ in messages] == [servers.pose(k=k).time_ns for k in range(200)]
        viewer.unsubscribe(next(iter(sink.clients[0].subscriptions)))
        servers.wait_until(lambda: not sink.clients[0].subscriptions)
        servers.offer(sink, servers.pose("new"))
        viewer.subscribe("/scene")
        assert viewer.read_messages(1)[0][0] == "/scene"
        assert sink.status().dropped == 0


def test_each_new_subscriber_gets_the_scene(servers: ModuleType) -> None:
    context = SinkContext("lighthouse", {"scene.toml": SCENE})
    with servers.running(create, "foxglove://:0", context) as sink:
        for _ in range(2):
            with Viewer(sink) as viewer:
                viewer.subscribe("/scene")
                ((topic, _, update),) = viewer.read_messages(1)
                assert topic == "/scene"
                assert {entity.id for entity in update.entities} == {"station/2", "marker/left"}
                assert {entity.frame_id for entity in update.entities} == {"floor"}
        with Viewer(sink) as viewer:
            viewer.subscribe("/scene", "/log")
            viewer.read_messages(1)
            servers.offer(sink, ArtifactUpdate(7, 2, Scene(markers=SCENE.markers), "station moved"))
            messages = {topic: message for topic, _, message in viewer.read_messages(2)}
            assert [entity.id for entity in messages["/scene"].entities] == ["marker/left"]
            # All that was drawn before is deleted.
            assert [each.type for each in messages["/scene"].deletions] == [1]
            assert messages["/log"].message == "version 2: station moved"


def test_a_tag_without_a_site_is_drawn_when_it_was_read(servers: ModuleType) -> None:
    for tags, frame, before in (
        (Tags(), "tag-77", []),
        (Tags(site={5: PlanarPose(1.0, 2.0, 0.0)}), "site", ["tag/5"]),
    ):
        context = SinkContext("polaris", {"tag.toml": tags})
        with servers.running(create, "foxglove://:0", context) as sink, Viewer(sink) as viewer:
            viewer.subscribe("/scene")
            ((_, _, update),) = viewer.read_messages(1)
            assert [entity.id for entity in update.entities] == before
            servers.offer(sink, servers.pose(frame=frame))
            if not before:
                ((_, _, update),) = viewer.read_messages(1)
                assert [entity.id for entity in update.entities] == ["tag/77"]


def test_states_warnings_and_detections_are_sent(servers: ModuleType) -> None:
    with servers.running(create, "foxglove://:0") as sink, Viewer(sink) as viewer:
        viewer.subscribe("/log", "/detections")
        servers.wait_until(lambda: len(sink.clients[0].subscriptions) == 2)
        servers.offer(sink, StateChange("a", 1, TrackingState.LOST, "no light for 1 s"))
        servers.offer(sink, StateChange("a", 2, TrackingState.TRACKING))
        moved = np.array([0.03, 0.04, np.nan])
        servers.offer(sink, Correction("a", 3, moved, 0.1, "tag 77"))
        servers.offer(sink, WarningEvent("", 4, SolverWarning("unit_scale", "no scale")))
        station = StationDetection(0, 4, "0abc", 960_000, "factory", 10, 0)
        servers.offer(sink, DetectionEvent("a", 5, station))
        messages = viewer.read_messages(5)
        assert [t for _, t, _ in messages] == [1, 2, 3, 4, 5]
        logs = [(message.message, message.level) for topic, _, message in messages[:4]]
        assert logs == [
            ("a: lost (no light for 1 s)", 3),
            ("a: tracking", 2),
            ("a: corrected by 0.050 m (tag 77)", 2),
            ("no scale", 3),
        ]
        topic, _, detection = messages[4]
        assert topic == "/detections"
        assert detection["device"] == "a"
        assert detection["detection"]["channel"] == 4
        assert detection["latency_s"] >= 0
