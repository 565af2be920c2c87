"""Sink ``zenoh://host``: topics of ROS 2 for nodes that use rmw_zenoh, without ROS on this side.

Keys, liveliness tokens and attachments are those of
https://github.com/ros2/rmw_zenoh/blob/rolling/docs/design.md.
"""

from __future__ import annotations

import json
import secrets
import struct
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from locatk.core.streaming.events import PoseEstimate
from locatk.formats.extras import requires_extra
from locatk.formats.sinks import cdr
from locatk.formats.sinks.addresses import SinkAddress
from locatk.formats.sinks.interface import LiveMessage
from locatk.formats.sinks.queued import QueuedSink
from locatk.formats.sinks.ros_topics import OPTIONS, QOS_DEPTH, TF_TOPIC, RosTopics

if TYPE_CHECKING:
    from zenoh import Publisher, Session

DEFAULT_PORT = 7447
"""Port of the router ``rmw_zenohd``."""

QOS = f"1:2:1,{QOS_DEPTH}:,:,:,,"
"""Reliable, volatile, keep last 10, in the form of liveliness tokens."""

NO_TYPE_HASH = "TypeHashNotSupported"
"""In the place of a hash in Humble."""

ATTACHMENT = struct.Struct("<qqB16s")
"""Sequence number, time of sending [ns], length of the identifier, identifier of the publisher."""

CHECK_PERIOD_S = 0.5
"""Time between two looks for a router or peer."""

NODE = "locatk"


def create(address: SinkAddress) -> ZenohSink:
    """Return the sink of ``zenoh://host:7447?domain=0&...``, or ``zenoh:?...`` for any peer."""
    return ZenohSink(address)


@dataclass
class _Topic:
    """Publisher with its sequence number, identifier and liveliness token."""

    publisher: Publisher
    token: Any
    identifier: bytes
    sequence: int = 0


class ZenohSink(QueuedSink):
    """Publishes poses with covariance, and transforms of poses with orientation.

    Messages to a subscriber that is too slow are dropped by zenoh, which does not count them.
    """

    def __init__(self, address: SinkAddress) -> None:
        address = address.with_path_options()
        address.reject_unknown_options("domain", "distro", *OPTIONS)
        self._endpoint = ""
        if address.host is not None:
            port = address.port or DEFAULT_PORT
            self._endpoint = "tcp/" + SinkAddress("", "", address.host, port).host_and_port
        self._domain = address.integer("domain", 0, 0, 232)
        self._has_hashes = address.choice("distro", "iron", "jazzy", "kilted", "humble") != "humble"
        self._names = RosTopics(address)
        super().__init__(address, self._endpoint or "zenoh peers")
        self._session: Session | None = None
        self._node_token: Any = None
        self._next_check_s = 0.0
        self._topics: dict[str, _Topic] = {}

    def prepare(self) -> None:
        """Import zenoh."""
        with requires_extra("zenoh", "zenoh", file=self.address):
            import zenoh  # noqa: F401

    def start(self) -> None:
        """Open the session and announce the node."""
        import zenoh

        config = zenoh.Config()
        if self._endpoint:
            # A client sends everything through the router. A peer listens on a port, and a router
            # does not forward its messages to all peers.
            config.insert_json5("mode", '"client"')
            config.insert_json5("connect/endpoints", json.dumps([self._endpoint]))
            config.insert_json5("scouting/multicast/enabled", "false")
        try:
            self._session = zenoh.open(config)
        except zenoh.ZError:
            raise ConnectionError(self._absence()) from None
        prefix = f"@ros2_lv/{self._domain}/{self._session.info.zid()}"
        for device in self.context.devices:  # Subscribers know the topics before the first pose.
            self._topic(self._names.pose_topic(device), cdr.POSE_TYPE)
        self._node_token = self._session.liveliness().declare_token(f"{prefix}/0/0/NN/%/%/{NODE}")

    def send(self, message: LiveMessage) -> int:
        """Publish a pose; other events have no message in ROS."""
        pose = message.event
        if not isinstance(pose, PoseEstimate):
            return 0
        frame = self._names.frame(pose)
        topic = self._topic(self._names.pose_topic(pose.device), cdr.POSE_TYPE)
        is_received = self._put(topic, cdr.pose_with_covariance(pose, frame))
        if self._names.has_transforms and pose.has_orientation:
            topic = self._topic(TF_TOPIC, cdr.TRANSFORM_TYPE)
            content = cdr.transform(pose, frame, self._names.child_frame(pose))
            is_received |= self._put(topic, content)
        if not is_received:
            self.count(dropped=1)
        return int(is_received)

    def tick(self) -> float | None:
        """Look for a router or peer."""
        pause_s = self._next_check_s - time.monotonic()
        if pause_s > 0:
            return pause_s
        self._next_check_s = time.monotonic() + CHECK_PERIOD_S
        assert self._session is not None
        info = self._session.info
        self.clients = len(list(info.routers_zid())) + len(list(info.peers_zid()))
        self.report_error("" if self.clients else self._absence())
        return CHECK_PERIOD_S

    def stop(self) -> None:
        """Close the session, with its publishers and tokens."""
        if self._session is not None:
            self._session.close()

    def _absence(self) -> str:
        return f"no router at {self._endpoint}" if self._endpoint else "no peer"

    def _topic(self, name: str, message_type: str) -> _Topic:
        """Return the publisher of a topic, declared at the first call."""
        import zenoh

        if name in self._topics:
            return self._topics[name]
        assert self._session is not None
        key, token = self.keys(name, message_type, str(self._session.info.zid()))
        publisher = self._session.declare_publisher(
            key,
            congestion_control=zenoh.CongestionControl.DROP,
            reliability=zenoh.Reliability.RELIABLE,
        )
        self._topics[name] = topic = _Topic(
            publisher, self._session.liveliness().declare_token(token), secrets.token_bytes(16)
        )
        return topic

    def keys(self, topic: str, message_type: str, session: str) -> tuple[str, str]:
        """Return the key of the messages of a topic, and that of its liveliness token."""
        package, _, name = message_type.split("/")
        dds_type = f"{package}::msg::dds_::{name}_"
        type_hash = cdr.TYPE_HASHES[message_type] if self._has_hashes else NO_TYPE_HASH
        key = f"{self._domain}/{topic.strip('/')}/{dds_type}/{type_hash}"
        entity = len(self._topics) + 1  # The node has the number 0.
        token = (
            f"@ros2_lv/{self._domain}/{session}/0/{entity}/MP/%/%/{NODE}/"
            f"{topic.replace('/', '%')}/{dds_type}/{type_hash}/{QOS}"
        )
        return key, token

    @staticmethod
    def _put(topic: _Topic, content: bytes) -> bool:
        """Publish a message; return whether somebody subscribes."""
        topic.sequence += 1
        attachment = ATTACHMENT.pack(topic.sequence, time.time_ns(), 16, topic.identifier)
        topic.publisher.put(content, attachment=attachment)
        status: Any = topic.publisher.matching_status
        return bool(status.matching)
