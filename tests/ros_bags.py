"""Bags written by the rosbags library, which shares no code with locatk."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

TF_TYPE_OF_ROS1 = "tf/msg/tfMessage"
"""Type of ``/tf`` in old bags. rosbags has no definition of it or of its successor for ROS 1."""

ROS1, ROS2 = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_JAZZY)
ROS1.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TF_TYPE_OF_ROS1))

Message = tuple[str, int, Any]
"""Topic, log time in ns, and message."""


class Messages:
    """Messages of one ROS version."""

    def __init__(self, storage: str = "mcap") -> None:
        self.store = ROS1 if storage == "ros1" else ROS2
        self.is_ros1 = storage == "ros1"

    def make(self, name: str, *values: Any) -> Any:
        return self.store.types[name](*values)

    def header(self, time_ns: int, frame: str) -> Any:
        time = self.make("builtin_interfaces/msg/Time", *divmod(int(time_ns), 10**9))
        sequence = (0,) if self.is_ros1 else ()
        return self.make("std_msgs/msg/Header", *sequence, time, frame)

    def vector(self, position: Iterable[float], kind: str = "Point") -> Any:
        return self.make(f"geometry_msgs/msg/{kind}", *map(float, position))

    def pose(self, position: Iterable[float], quaternion: Iterable[float]) -> Any:
        orientation = self.vector(quaternion, "Quaternion")
        return self.make("geometry_msgs/msg/Pose", self.vector(position), orientation)

    def pose_stamped(self, time_ns: int, frame: str, position: Any, quaternion: Any) -> Any:
        header, pose = self.header(time_ns, frame), self.pose(position, quaternion)
        return self.make("geometry_msgs/msg/PoseStamped", header, pose)

    def point(self, time_ns: int, frame: str, position: Any) -> Any:
        header = self.header(time_ns, frame)
        return self.make("geometry_msgs/msg/PointStamped", header, self.vector(position))

    def with_covariance(
        self, time_ns: int, frame: str, position: Any, quaternion: Any, covariance: Any
    ) -> Any:
        flat = np.asarray(covariance, np.float64).ravel()
        pose = self.pose(position, quaternion)
        wide = self.make("geometry_msgs/msg/PoseWithCovariance", pose, flat)
        header = self.header(time_ns, frame)
        return self.make("geometry_msgs/msg/PoseWithCovarianceStamped", header, wide)

    def odometry(
        self, time_ns: int, frame: str, position: Any, quaternion: Any, covariance: Any
    ) -> Any:
        wide = self.with_covariance(time_ns, frame, position, quaternion, covariance)
        still = self.vector((0, 0, 0), "Vector3")
        twist = self.make("geometry_msgs/msg/Twist", still, still)
        zero = self.make("geometry_msgs/msg/TwistWithCovariance", twist, np.zeros(36))
        return self.make("nav_msgs/msg/Odometry", wide.header, "base_link", wide.pose, zero)

    def transform(
        self, time_ns: int, frame: str, child: str, position: Any, quaternion: Any
    ) -> Any:
        rotation = self.vector(quaternion, "Quaternion")
        parts = self.vector(position, "Vector3"), rotation
        transform = self.make("geometry_msgs/msg/Transform", *parts)
        header = self.header(time_ns, frame)
        return self.make("geometry_msgs/msg/TransformStamped", header, child, transform)

    def tf(self, *transforms: Any) -> Any:
        kind = TF_TYPE_OF_ROS1 if self.is_ros1 else "tf2_msgs/msg/TFMessage"
        return self.make(kind, list(transforms))

    def path(self, time_ns: int, frame: str, poses: list[Any]) -> Any:
        return self.make("nav_msgs/msg/Path", self.header(time_ns, frame), poses)

    def text(self, text: str) -> Any:
        return self.make("std_msgs/msg/String", text)


def write_bag(
    path: Path, storage: str, messages: Iterable[Message], compression: str | None = None
) -> Path:
    """Write a bag and return what is given to locatk: a folder, or the file of ROS 1."""
    if storage == "ros1":
        path = path.with_suffix(".bag")
        with rosbag1.Writer(path) as writer:
            _write(writer, messages, ROS1, ROS1.serialize_ros1)
        return path
    plugin = {"sqlite3": rosbag2.StoragePlugin.SQLITE3, "mcap": rosbag2.StoragePlugin.MCAP}
    writer = rosbag2.Writer(path, version=9, storage_plugin=plugin[storage])
    if compression is not None:
        mode = rosbag2.CompressionMode[compression]
        writer.set_compression(mode, rosbag2.CompressionFormat.ZSTD)
    with writer:
        _write(writer, messages, ROS2, ROS2.serialize_cdr)
    return path


def _write(writer: Any, messages: Iterable[Message], store: Any, serialize: Any) -> None:
    connections: dict[str, Any] = {}
    for topic, time_ns, message in messages:
        if topic not in connections:
            kind = message.__msgtype__
            connections[topic] = writer.add_connection(topic, kind, typestore=store)
        writer.write(connections[topic], time_ns, serialize(message, message.__msgtype__))
