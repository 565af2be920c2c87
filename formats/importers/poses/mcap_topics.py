"""Trajectories from MCAP files of other programs: messages of ROS and of Foxglove."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from google.protobuf.message import DecodeError

from locatk.core.trajectory import Trajectory
from locatk.formats.importers.poses.pose_topics import Topic, read_topics
from locatk.formats.importers.poses.rosbag import ros_decoder
from locatk.formats.sessions.reader import Session

PROTOBUF_CLASSES: dict[str, Any] = {
    each.DESCRIPTOR.full_name: each
    for each in (PoseInFrame, PosesInFrame, FrameTransform, FrameTransforms)
}


def read_mcap_topics(
    session: Session, selected: str = ""
) -> tuple[list[Trajectory], tuple[str, ...]]:
    """Read the trajectories of an MCAP file; see :func:`.pose_topics.read_topics`.

    Raises
    ------
    FormatError
        The file is damaged, or has no poses.
    InputError
        It has no trajectory of the name ``selected``.
    LocatkError
        A topic has messages of ROS, and rosbags is not installed.
    """
    topics = {
        channel.topic: Topic(channel.topic, _message_type(channel.schema), channel.encoding)
        for channel in session.channels
    }

    def messages(wanted: Collection[Topic]) -> Iterator[tuple[Topic, int, bytes]]:
        for name, log_ns, data in session.messages([topic.name for topic in wanted]):
            yield topics[name], log_ns, data

    return read_topics(Path(session.path), list(topics.values()), messages, _decoder, selected)


def _message_type(schema: str) -> str:
    """Return the name of a type as ROS 2 writes it; MCAP files of ROS 1 leave out ``msg``."""
    package, separator, name = schema.partition("/")
    return f"{package}/msg/{name}" if separator and "/" not in name else schema


def _decoder(topic: Topic) -> Callable[[bytes], Any]:
    if topic.encoding == "protobuf":
        message_class = PROTOBUF_CLASSES.get(topic.type)
        return _refuse if message_class is None else _protobuf_decoder(message_class)
    if topic.encoding == "json":
        return _decode_json
    return ros_decoder(topic) if topic.encoding in ("cdr", "ros1") else _refuse


def _protobuf_decoder(message_class: Any) -> Callable[[bytes], Any]:
    def decode(data: bytes) -> Any:
        try:
            return message_class.FromString(data)
        except DecodeError as error:
            raise ValueError(str(error)) from None

    return decode


def _decode_json(data: bytes) -> Any:
    return json.loads(data, object_hook=lambda fields: SimpleNamespace(**fields))


def _refuse(data: bytes) -> Any:
    raise ValueError("another encoding than its type has")
