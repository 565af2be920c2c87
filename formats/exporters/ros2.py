"""Export of poses as a ROS 2 bag: an MCAP file of CDR messages.

evo, rosbags, RViz and ``ros2 bag`` read it.

The messages of a device differ only in stamp and numbers, hence numpy encodes all of them at once.
For 100,000 poses and their transforms this module needs 1.0 s (11.1 MB) and rosbags 0.11
(``rosbag2.Writer`` with ``StoragePlugin.MCAP``, zstd, ``serialize_cdr``) 1.9 s (10.6 MB); its
writer alone, with messages encoded here, 0.7 s. It is not used, because it writes a folder with
``metadata.yaml`` instead of one file that appears atomically, writes no checksums, and has no
metadata record for the origin of the poses. The writer of ``mcap-ros2-support`` encodes 25 times
slower and cannot give channels the metadata that the profile requires.

Sources: CDR is OMG's DDSI-RTPS 2.5, section 10, as rmw uses it (little-endian, alignment relative
to the end of the four-byte header). Definitions are those of ROS 2's common_interfaces. Names:
https://design.ros2.org/articles/topic_and_service_names.html. Profile:
https://mcap.dev/spec/registry#ros2. Fields that a player reads:
rosbag2_storage_mcap/src/mcap_storage.cpp of https://github.com/ros2/rosbag2.
"""

from __future__ import annotations

import os
import re
import struct
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.trajectory import Trajectory
from locatk.formats.output import atomic_write, tool_version
from locatk.formats.sessions.foxglove import child_frame

UNKNOWN_VARIANCE = 1e6
"""Variance of unobserved quantities, in m^2 or rad^2.

ROS has no value for "unknown". Filters interpret a large variance as no information and zero as
certainty, and fail on NaN. An unknown orientation is the identity with this variance: tf and RViz
refuse quaternions that are not of unit length.
"""

OFFERED_QOS = "[]"
"""Value of ``offered_qos_profiles``, which the profile requires.

No publisher is known, and players use their default (reliable, volatile). Distributions before
Jazzy write policies as numbers, later ones as names; the empty list is valid for all.
"""

RECORD = "locatk_export"
"""Name of the metadata record with the origin of the poses."""

END_OF_TIME_NS = 2**31 * 1_000_000_000
"""First time that ``builtin_interfaces/Time`` cannot represent: 2038-01-19."""

_DEFINITIONS = {
    "geometry_msgs/msg/PoseStamped": "std_msgs/Header header\ngeometry_msgs/Pose pose\n",
    "geometry_msgs/msg/PoseWithCovarianceStamped": (
        "std_msgs/Header header\ngeometry_msgs/PoseWithCovariance pose\n"
    ),
    "tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms\n",
}
"""Definitions of the messages that are written."""

_PARTS = {
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id\n",
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec\n",
    "geometry_msgs/TransformStamped": (
        "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform\n"
    ),
    "geometry_msgs/Transform": (
        "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n"
    ),
    "geometry_msgs/PoseWithCovariance": "geometry_msgs/Pose pose\nfloat64[36] covariance\n",
    "geometry_msgs/Pose": ("geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n"),
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w\n",
}
"""Definitions of their parts."""

Stream = tuple[int, NDArray[np.int64], list[bytes]]
"""Channel, times (n,) in ns, and n messages."""


def write_ros2(
    path: str | os.PathLike[str],
    trajectories: Sequence[Trajectory],
    *,
    facts: Mapping[str, str] | None = None,
    covariance: bool = False,
    overwrite: bool = False,
) -> None:
    """Write poses as a ROS 2 bag of one file.

    ``geometry_msgs/msg/PoseStamped`` are written on ``/pose/<device>`` and
    ``tf2_msgs/msg/TFMessage`` on ``/tf``, from the frame of the poses to the device's frame. Log
    time and stamp are the pose's time.

    Parameters
    ----------
    path : path
        The output; ``ros2 bag`` recognizes it by the ending ``.mcap``.
    trajectories : sequence of Trajectory
        One per device.
    facts : mapping of str to str, optional
        Origin of the poses, for the metadata record :data:`RECORD`.
    covariance : bool
        Also ``geometry_msgs/msg/PoseWithCovarianceStamped`` on
        ``/pose_with_covariance/<device>``; see :func:`known_covariance`.
    overwrite : bool
        Replace an existing file.

    Raises
    ------
    InputError
        Two devices have the same name in ROS, a pose is not finite, a time is before 1970
        or after 2038, a frame has no name.
    OutputExistsError, MissingDataError
        See :func:`locatk.formats.output.atomic_write`.
    """
    names = ros_names([trajectory.device for trajectory in trajectories])
    for trajectory in trajectories:
        _check(trajectory)
    with atomic_write(path, overwrite=overwrite) as output:
        writer = Writer(output, compression=CompressionType.ZSTD)
        writer.start(profile="ros2", library=f"locatk {tool_version()}")
        writer.add_metadata(RECORD, {**(facts or {}), "exported_by": f"locatk {tool_version()}"})
        channel = _channels(writer)
        streams: list[Stream] = []
        for name, each in zip(names, trajectories, strict=True):
            pose = channel(f"/pose/{name}", "geometry_msgs/msg/PoseStamped")
            streams.append((pose, each.time_ns, pose_stamped(each)))
            if covariance:
                wide = "geometry_msgs/msg/PoseWithCovarianceStamped"
                topic = channel(f"/pose_with_covariance/{name}", wide)
                streams.append((topic, each.time_ns, pose_with_covariance(each)))
            tf = channel("/tf", "tf2_msgs/msg/TFMessage")
            streams.append((tf, each.time_ns, transforms(each)))
        _write(writer, streams)
        writer.finish()


def ros_names(devices: Sequence[str]) -> list[str]:
    """Convert names of devices to parts of ROS 2 topics: letters, digits, single underscores.

    Other characters become an underscore. A name that would begin with a digit or an underscore
    (a hidden topic) gets the prefix ``device_``.

    Raises
    ------
    InputError
        Two of them become equal.

    Examples
    --------
    >>> ros_names(["kiwi", "lab/blue robot", "17"])
    ['kiwi', 'lab_blue_robot', 'device_17']
    """
    device_of: dict[str, str] = {}
    for device in devices:
        name = re.sub(r"[^0-9A-Za-z]+", "_", device).rstrip("_")
        if not re.match("[A-Za-z]", name):
            name = f"device_{name.lstrip('_')}".rstrip("_")
        if name in device_of:
            raise InputError(
                f"devices {device_of[name]!r} and {device!r} have the same name in ROS, {name!r}",
                hint="Export as csv or parquet, which keep the names",
            )
        device_of[name] = device
    return list(device_of)


def pose_stamped(trajectory: Trajectory) -> list[bytes]:
    """Encode one ``geometry_msgs/msg/PoseStamped`` per pose in CDR."""
    return _messages(trajectory, bytes(8) + _string(trajectory.frame), 0, _poses(trajectory))


def pose_with_covariance(trajectory: Trajectory) -> list[bytes]:
    """Encode one ``geometry_msgs/msg/PoseWithCovarianceStamped`` per pose in CDR."""
    flat = known_covariance(trajectory.covariance).reshape(-1, 36)
    numbers = np.hstack([_poses(trajectory), flat])
    return _messages(trajectory, bytes(8) + _string(trajectory.frame), 0, numbers)


def transforms(trajectory: Trajectory) -> list[bytes]:
    """Encode one ``tf2_msgs/msg/TFMessage`` with one transform per pose in CDR."""
    head = struct.pack("<I", 1) + bytes(8) + _string(trajectory.frame)
    return _messages(
        trajectory,
        head + _string(child_frame(trajectory.device, trajectory.frame)),
        4,
        _poses(trajectory),
    )


def known_covariance(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (n, 6, 6) covariances without NaN, as filters need them.

    Unobserved quantities get the variance :data:`UNKNOWN_VARIANCE` and no correlation. The order
    of ROS is that of locatk: x, y, z, and rotations about the fixed axes x, y, z.
    """
    filled = np.nan_to_num(covariance, nan=0.0)
    row, column = np.nonzero(np.isnan(np.einsum("nii->ni", covariance)))
    filled[row, column, :] = filled[row, :, column] = 0.0
    filled[row, column, column] = UNKNOWN_VARIANCE
    return filled


def _poses(trajectory: Trajectory) -> NDArray[np.float64]:
    return np.hstack([trajectory.position, trajectory.quaternion])


def _string(text: str) -> bytes:
    """Encode a string in CDR: length with the final zero, bytes, padding for another length."""
    data = text.encode() + b"\0"
    return struct.pack("<I", len(data)) + data + bytes(-len(data) % 4)


def _messages(
    trajectory: Trajectory, head: bytes, stamp_offset: int, numbers: NDArray[np.float64]
) -> list[bytes]:
    """Encode messages of ``head``, with the stamp at byte ``stamp_offset``, and doubles (n, k)."""
    n, k = numbers.shape
    header = b"\x00\x01\x00\x00"  # plain CDR, little-endian
    blank = header + head + bytes(-len(head) % 8) + bytes(8 * k)
    size, start = len(blank), len(header) + stamp_offset
    layout = np.dtype(
        {
            "names": ["sec", "nanosec", "numbers"],
            "formats": ["<i4", "<u4", ("<f8", (k,))],
            "offsets": [start, start + 4, size - 8 * k],
            "itemsize": size,
        }
    )
    content = bytearray(blank * n)
    table = np.frombuffer(content, layout)
    table["sec"], table["nanosec"] = np.divmod(trajectory.time_ns, 1_000_000_000)
    table["numbers"] = numbers
    return [bytes(content[k : k + size]) for k in range(0, n * size, size)]


def _check(trajectory: Trajectory) -> None:
    name = f"trajectory of device {trajectory.device!r}"
    if not trajectory.frame:
        raise InputError(f"a frame without a name in the {name}", hint="Export it as csv or tum")
    if not np.isfinite(_poses(trajectory)).all():
        raise InputError(f"poses that are not numbers in the {name}", hint="Leave them out")
    if ((trajectory.time_ns < 0) | (trajectory.time_ns >= END_OF_TIME_NS)).any():
        raise InputError(
            f"a time that is not between 1970 and 2038 in the {name}",
            hint="Export it as csv or parquet",
        )


def _channels(writer: Writer) -> Callable[[str, str], int]:
    """Return a function (topic, message) that registers a topic once and returns its channel."""
    schemas: dict[str, int] = {}
    channels: dict[str, int] = {}

    def channel(topic: str, message: str) -> int:
        if message not in schemas:
            text = _definition(message).encode()
            schemas[message] = writer.register_schema(message, "ros2msg", text)
        if topic not in channels:
            metadata = {"offered_qos_profiles": OFFERED_QOS}
            channels[topic] = writer.register_channel(topic, "cdr", schemas[message], metadata)
        return channels[topic]

    return channel


def _definition(message: str) -> str:
    """Return the definition of a message and of its parts in the format ``ros2msg``."""
    text, parts = _DEFINITIONS[message], {}
    pending = [text]
    while pending:
        for line in pending.pop().splitlines():
            part = line.split()[0].removesuffix("[]")
            if part in _PARTS and part not in parts:
                parts[part] = _PARTS[part]
                pending.append(_PARTS[part])
    rule = "=" * 80
    return text + "".join(f"{rule}\nMSG: {part}\n{lines}" for part, lines in parts.items())


def _write(writer: Writer, streams: Sequence[Stream]) -> None:
    """Write all messages in the order of their times."""
    if not streams:
        return
    times = np.concatenate([time_ns for _, time_ns, _ in streams])
    messages = [message for _, _, encoded in streams for message in encoded]
    channels = np.repeat([channel for channel, _, _ in streams], [len(m) for *_, m in streams])
    order = np.argsort(times, kind="stable")
    sequence: dict[int, int] = {}
    for k, channel, time_ns in zip(
        order.tolist(), channels[order].tolist(), times[order].tolist(), strict=True
    ):
        count = sequence[channel] = sequence.get(channel, -1) + 1
        writer.add_message(channel, time_ns, messages[k], time_ns, count)
