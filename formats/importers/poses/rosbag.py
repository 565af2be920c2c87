"""Trajectories from bags of ROS 2 and ROS 1, read with rosbags (extra ``ros``).

rosbags reads the storage and the messages. The types of :data:`.pose_topics.SAMPLES_OF` are the
same in all distributions, hence the definitions in a bag, which older ones lack, are not needed.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from locatk.core.errors import FormatError, LocatkError
from locatk.core.trajectory import Trajectory
from locatk.formats.extras import requires_extra
from locatk.formats.importers.poses.pose_topics import Topic, read_topics

METADATA_FILE = "metadata.yaml"
"""File in the folder of a bag of ROS 2."""

SQLITE_MAGIC = b"SQLite format 3\0"

TF_DEFINITION = "geometry_msgs/TransformStamped[] transforms"
"""Definition of tf2_msgs/TFMessage and of tf/tfMessage, its predecessor in ROS 1."""

ROS1_MAGIC = b"#ROSBAG V"

MESSAGES = "a message of ROS"
"""What needs rosbags, for errors."""


def is_bag_folder(path: Path) -> bool:
    """Return whether a path is the folder of a bag of ROS 2."""
    return (path / METADATA_FILE).is_file()


def ros_decoder(topic: Topic) -> Callable[[bytes], Any]:
    """Return the decoder of the messages of a topic, which raises ValueError.

    Raises
    ------
    LocatkError
        rosbags is not installed.
    """
    with requires_extra("ros", MESSAGES):
        from rosbags import typesys

    is_ros1 = topic.encoding == "ros1"
    store = typesys.get_typestore(
        typesys.Stores.ROS1_NOETIC if is_ros1 else typesys.Stores.ROS2_HUMBLE
    )
    if is_ros1 and topic.type not in store.types:  # It lacks the packages of tf.
        store.register(typesys.get_types_from_msg(TF_DEFINITION, topic.type))
    deserialize = store.deserialize_ros1 if is_ros1 else store.deserialize_cdr

    def decode(data: bytes) -> Any:
        try:
            return deserialize(data, topic.type)
        except Exception as error:  # Damaged messages raise errors of many kinds.
            raise ValueError(str(error)) from None

    return decode


def read_bag(path: Path, selected: str = "") -> tuple[list[Trajectory], tuple[str, ...]]:
    """Read the trajectories of a bag; see :func:`.pose_topics.read_topics`.

    Parameters
    ----------
    path : Path
        The folder of a bag of ROS 2, its SQLite file (.db3), or a bag of ROS 1 (.bag).
    selected : str
        Topic or trajectory to read; all by default.

    Raises
    ------
    FormatError
        The bag is damaged, or has no poses.
    InputError
        It has no trajectory of this name.
    LocatkError
        rosbags is not installed.
    """
    with requires_extra("ros", MESSAGES, file=path):
        from rosbags import rosbag1, rosbag2

    with _errors_of_locatk(path):
        reader = rosbag1.Reader(path) if path.suffix == ".bag" else rosbag2.Reader(path)
        with reader:
            encoding = "ros1" if isinstance(reader, rosbag1.Reader) else "cdr"
            connections = {
                Topic(each.topic, each.msgtype, encoding): each for each in reader.connections
            }

            def messages(topics: Collection[Topic]) -> Iterator[tuple[Topic, int, bytes]]:
                chosen: list[Any] = [
                    each
                    for each in reader.connections
                    if Topic(each.topic, each.msgtype, encoding) in topics
                ]
                for connection, log_ns, data in reader.messages(chosen):
                    yield Topic(connection.topic, connection.msgtype, encoding), log_ns, data

            return read_topics(path, list(connections), messages, ros_decoder, selected)


@contextmanager
def _errors_of_locatk(path: Path) -> Iterator[None]:
    """Convert errors of rosbags to a FormatError with the file."""
    try:
        yield
    except LocatkError:
        raise
    except Exception as error:  # Damaged bags raise errors of many kinds, also of the codecs.
        reason = " ".join(str(error).split()) or type(error).__name__
        raise FormatError(
            f"not a bag that can be read ({reason})",
            file=path,
            hint="Repair it with `ros2 bag reindex` or `rosbag reindex`, or record it again",
        ) from None
