"""Foxglove WebSocket: ``foxglove://[host]:port`` for Foxglove and Lichtblick.

The protocol is that of https://github.com/foxglove/ws-protocol (``foxglove.websocket.v1``); newer
programs offer it as ``foxglove.sdk.v1``. The topics are those of a solved session, so that the same
layout shows both:

============================ ============================ =======================================
topic                        schema                       content
============================ ============================ =======================================
``/pose/<device>``           foxglove.PoseInFrame         pose
``/odometry/<device>``       foxglove.Odometry            pose with covariance, state and reason
``/tf``                      foxglove.FrameTransform      pose, from its frame to the device
``/scene``                   foxglove.SceneUpdate         artifact, to each new subscriber
``/log``                     foxglove.Log                 states, corrections, warnings
``/detections``              JSON                         detections (:mod:`.json_messages`)
============================ ============================ =======================================
"""

from __future__ import annotations

import base64
import functools
import json
import math
import struct
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.KeyValuePair_pb2 import KeyValuePair
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.Odometry_pb2 import Odometry
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.message import Message
from mcap_protobuf.schema import build_file_descriptor_set

from locatk.core.streaming.events import (
    ArtifactUpdate,
    Correction,
    DetectionEvent,
    LiveEvent,
    PoseEstimate,
    StateChange,
    TrackingState,
    WarningEvent,
)
from locatk.core.trajectory import Trajectory
from locatk.formats.sessions import foxglove
from locatk.formats.sessions.messages import timestamp
from locatk.formats.sinks.addresses import SinkAddress
from locatk.formats.sinks.interface import SinkContext
from locatk.formats.sinks.json_messages import event_to_json
from locatk.formats.sinks.server import Client, QueuedMessage, ServerSink, is_loopback, to_json_text
from locatk.formats.sinks.shapes import artifact_frames, find_artifact

DEFAULT_PORT = 8765
"""Port that Foxglove and Lichtblick propose."""

SUBPROTOCOLS = ("foxglove.sdk.v1", "foxglove.websocket.v1")

FOXGLOVE_ORIGINS = ("https://app.foxglove.dev", "file://")
"""Origins that need no token on the loopback interface: Foxglove in a browser, and the desktop
programs, whose pages are files. Pages of this machine (Lichtblick in a container) are others."""

MAX_WAITING = 256
"""Number of messages that wait for a client before older poses are dropped."""

MESSAGE_DATA = struct.Struct("<BIQ")
"""Header of a message: opcode 1, id of the subscription, time in ns."""

DETECTION_SCHEMA = {
    "type": "object",
    "properties": {
        "type": {"type": "string"},
        "time_s": {"type": "number"},
        "device": {"type": "string"},
        "detection": {"type": "object"},
    },
}
"""JSON schema of a detection; the attributes of its detection depend on the system."""


@dataclass(frozen=True)
class _Channel:
    """Topic that clients can subscribe to.

    Attributes
    ----------
    topic : str
    message : type or None
        Class of its messages; None if they are JSON.
    """

    topic: str
    message: type[Message] | None

    def advertisement(self, number: int) -> dict[str, Any]:
        """Return its description for clients."""
        head = {"id": number, "topic": self.topic}
        if self.message is None:
            return head | {
                "encoding": "json",
                "schemaName": "locatk.Detection",
                "schemaEncoding": "jsonschema",
                "schema": json.dumps(DETECTION_SCHEMA),
            }
        return head | {
            "encoding": "protobuf",
            "schemaName": self.message.DESCRIPTOR.full_name,
            "schemaEncoding": "protobuf",
            "schema": _schema(self.message),  # type: ignore[arg-type]
        }


TF, SCENE, LOG, DETECTIONS = range(1, 5)
"""Numbers of the channels that there are from the beginning; those of devices follow."""

FIRST_CHANNELS = {
    TF: _Channel("/tf", FrameTransform),
    SCENE: _Channel("/scene", SceneUpdate),
    LOG: _Channel("/log", Log),
    DETECTIONS: _Channel("/detections", None),
}


@functools.cache
def _schema(message: type[Message]) -> str:
    """Return the descriptor of a message and of all that it contains, in base64."""
    return base64.b64encode(build_file_descriptor_set(message).SerializeToString()).decode()


def create(address: SinkAddress) -> FoxgloveSink:
    """Create the sink of an address such as ``foxglove://:8765``."""
    return FoxgloveSink(address)


class FoxgloveSink(ServerSink):
    """Server of the Foxglove WebSocket protocol."""

    default_port = DEFAULT_PORT
    purpose = "the connection to Foxglove"
    subprotocols = SUBPROTOCOLS
    max_waiting = MAX_WAITING

    def __init__(self, address: SinkAddress) -> None:
        super().__init__(address)
        self._channels = dict(FIRST_CHANNELS)
        self._pose_channels: dict[str, tuple[int, int]] = {}
        self._artifact: Any = None
        self._poses: dict[str, PoseEstimate] = {}
        self._frames: dict[str, None] = {}
        self._session_id = str(time.time_ns())

    @property
    def url(self) -> str:
        """Address for Foxglove, with the token."""
        return f"ws://{self.location}/" + ("" if self.token is None else f"?token={self.token}")

    def open(self, context: SinkContext) -> None:
        """Start the server; see :meth:`.server.ServerSink.open`."""
        self._artifact = find_artifact(context.artifacts)
        self._frames = dict.fromkeys(artifact_frames(self._artifact))
        for device in context.devices:
            self._add_device(device)
        super().open(context)

    def accepts_origin(self, origin: str, has_token: bool) -> bool:
        """Return whether a page is Foxglove or Lichtblick, is of this machine, or has the token."""
        if self.token is not None:
            return has_token
        scheme, _, host = origin.partition("://")
        name = host.rpartition(":")[0] if not host.endswith("]") and ":" in host else host
        is_local = scheme in ("http", "https") and is_loopback(name.strip("[]"))
        return is_local or origin in FOXGLOVE_ORIGINS

    def greet(self, client: Client) -> Iterable[str]:
        """Yield the description of the server and its channels."""
        yield to_json_text(
            {
                "op": "serverInfo",
                "name": f"locatk live: {self.context.system}",
                "capabilities": [],
                "sessionId": self._session_id,
            }
        )
        yield from self._advertise(client)

    def _advertise(self, client: Client) -> Iterator[str]:
        """Yield the channels that a client does not know."""
        new = [number for number in self._channels if number > client.known]
        if new:
            client.known = max(new)
            channels = [self._channels[number].advertisement(number) for number in new]
            yield to_json_text({"op": "advertise", "channels": channels})

    def receive(self, client: Client, text: str) -> None:
        """Take a subscription or its end; other requests are not offered, and are ignored."""
        message = json.loads(text)
        if message["op"] == "subscribe":
            for each in message["subscriptions"]:
                channel, subscription = int(each["channelId"]), int(each["id"])
                if channel not in self._channels or not 0 <= subscription < 2**32:
                    raise ValueError(f"no channel {channel}")
                client.subscriptions[channel] = subscription
                if channel == SCENE:
                    client.request("scene")
        elif message["op"] == "unsubscribe":
            ended = set(message["subscriptionIds"])
            for channel, subscription in list(client.subscriptions.items()):
                if subscription in ended:
                    del client.subscriptions[channel]

    def observe(self, items: Sequence[QueuedMessage]) -> None:
        """Add the channels of new devices, and keep what the scene needs."""
        devices, frames, artifact = len(self._pose_channels), len(self._frames), self._artifact
        for item in items:
            event = item.message.event
            if isinstance(event, PoseEstimate):
                if event.device not in self._pose_channels:
                    self._add_device(event.device)
                self._poses[event.device] = event
                self._frames.setdefault(event.frame)
            elif isinstance(event, ArtifactUpdate):
                self._artifact = event.artifact
        has_scene = len(self._frames) != frames or self._artifact is not artifact
        for client in self.clients:
            if len(self._pose_channels) != devices:
                client.request("channels")
            if has_scene:
                client.request("scene")

    def _add_device(self, device: str) -> None:
        number = len(self._channels) + 1
        self._channels[number] = _Channel(f"/pose/{device}", PoseInFrame)
        self._channels[number + 1] = _Channel(f"/odometry/{device}", Odometry)
        self._pose_channels[device] = (number, number + 1)

    def encode(
        self, client: Client, items: list[QueuedMessage], requests: set[str]
    ) -> Iterator[str | bytes]:
        """Yield new channels, the scene if it changed, and messages of subscribed channels."""
        if "channels" in requests:
            yield from self._advertise(client)
        if "scene" in requests and SCENE in client.subscriptions:
            time_ns = self._scene_time_ns()
            payload = self._scene(time_ns).SerializeToString()
            yield MESSAGE_DATA.pack(1, client.subscriptions[SCENE], time_ns) + payload
        for item in items:
            event = item.message.event
            for channel in self._channels_of(event):
                subscription = client.subscriptions.get(channel)
                if subscription is None:
                    continue
                data = item.encoded.get(channel)
                if data is None:
                    data = item.encoded[channel] = self._payload(channel, item)
                yield MESSAGE_DATA.pack(1, subscription, max(0, event.time_ns)) + data
                client.sent += 1

    def _channels_of(self, event: LiveEvent) -> tuple[int, ...]:
        """Return the channels in which an event is sent."""
        if isinstance(event, PoseEstimate):
            return (TF, *self._pose_channels[event.device])
        return (DETECTIONS,) if isinstance(event, DetectionEvent) else (LOG,)

    def _payload(self, channel: int, item: QueuedMessage) -> bytes:
        event = item.message.event
        if isinstance(event, PoseEstimate):
            return _pose_message(self._channels[channel].message, event).SerializeToString()
        if isinstance(event, DetectionEvent):
            return to_json_text(event_to_json(event, item.message.latency_s())).encode()
        return _log_message(event).SerializeToString()

    def _scene_time_ns(self) -> int:
        """Return the time of the newest pose, or the present one."""
        return max((pose.time_ns for pose in self._poses.values()), default=time.time_ns())

    def _scene(self, time_ns: int) -> SceneUpdate:
        """Return the artifact in place of all that was drawn before."""
        here = [_trajectory(pose) for pose in self._poses.values()]
        empty = [
            Trajectory.from_positions("", frame, np.zeros(0, np.int64), np.zeros((0, 3)))
            for frame in self._frames
        ]
        update = foxglove.scene_update(self._artifact, [*here, *empty], time_ns)
        kept = [each for each in update.entities if not foxglove.is_path(each)]
        deletion = SceneEntityDeletion(timestamp=timestamp(time_ns), type=SceneEntityDeletion.ALL)
        return SceneUpdate(deletions=[deletion], entities=kept)


def _trajectory(pose: PoseEstimate) -> Trajectory:
    time_ns = np.array([pose.time_ns], np.int64)
    return Trajectory.from_positions(pose.device, pose.frame, time_ns, pose.position[None])


def _pose_message(kind: type[Message] | None, pose: PoseEstimate) -> Message:
    """Return a pose as a message of this kind."""
    stamp = timestamp(pose.time_ns)
    x, y, z = pose.position.tolist()
    qx, qy, qz, qw = pose.quaternion.tolist()
    position, rotation = Vector3(x=x, y=y, z=z), Quaternion(x=qx, y=qy, z=qz, w=qw)
    child = foxglove.child_frame(pose.device, pose.frame)
    if kind is FrameTransform:
        return FrameTransform(
            timestamp=stamp,
            parent_frame_id=pose.frame,
            child_frame_id=child,
            translation=position,
            rotation=rotation,
        )
    body = Pose(position=position, orientation=rotation)
    if kind is PoseInFrame:
        return PoseInFrame(timestamp=stamp, frame_id=pose.frame, pose=body)
    return Odometry(
        timestamp=stamp,
        frame_id=pose.frame,
        body_frame_id=child,
        pose=body,
        pose_covariance=pose.covariance.ravel().tolist(),
        metadata=[
            KeyValuePair(key="state", value=str(pose.state)),
            KeyValuePair(key="reason", value=pose.reason),
        ],
    )


def _log_message(event: LiveEvent) -> Log:
    """Return a change of state, a correction, a new artifact or a warning as a line of a log."""
    if isinstance(event, StateChange):
        text = f"{event.device}: {event.state}" + (f" ({event.reason})" if event.reason else "")
        is_warning = event.state is TrackingState.LOST
    elif isinstance(event, Correction):
        distance_m = math.sqrt(float(np.nansum(event.displacement_m**2)))
        text = f"{event.device}: corrected by {distance_m:.3f} m ({event.reason})"
        is_warning = False
    elif isinstance(event, ArtifactUpdate):
        text = f"version {event.version}" + (f": {event.reason}" if event.reason else "")
        is_warning = False
    else:
        assert isinstance(event, WarningEvent)
        text = f"{event.device}: " if event.device else ""
        text += event.warning.message
        is_warning = True
    return foxglove.log(text, event.time_ns, warning=is_warning)
