"""Poses as a ROS 2 bag: an MCAP file of CDR messages for evo, rosbags, RViz and ``ros2 bag``.

The messages of a device differ in their stamp and their numbers only, so that numpy lays out
all of them at once: 25 times as fast as the encoder of ``mcap-ros2-support``, and four times
with the writing of the file (100,000 poses and their transforms). Its writer is not used for a
second reason: it cannot give channels the metadata that the profile asks for.

Sources: CDR is OMG's DDSI-RTPS 2.5, section 10, as rmw uses it (little-endian, alignment from
behind the four bytes of the header); definitions are those of ROS 2's common_interfaces;
rules of names, https://design.ros2.org/articles/topic_and_service_names.html; profile,
https://mcap.dev/spec/registry#ros2; what a player reads, rosbag2_storage_mcap/src/mcap_storage.cpp.
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
"""Variance of what was not observed, in m^2 or rad^2. ROS has no word for it; filters take a
large one for "no information", zero for certainty, and NaN spoils them."""

OFFERED_QOS = "[]"
"""Value of ``offered_qos_profiles``, which the profile requires: no publisher is known, and
players take their default (reliable, volatile). Distributions before Jazzy write its policies as
numbers, later ones as names; the empty list means the same to all."""

RECORD = "locatk_export"
"""Name of the metadata record that tells where the poses come from."""

LAST_NS = 2**31 * 1_000_000_000
"""First time that ``builtin_interfaces/Time`` cannot say: 2038-01-19."""

_DEFINITIONS = {
    "geometry_msgs/msg/PoseStamped": "std_msgs/Header header\ngeometry_msgs/Pose pose\n",
    "geometry_msgs/msg/PoseWithCovarianceStamped": (
        "std_msgs/Header header\ngeometry_msgs/PoseWithCovariance pose\n"
    ),
    "tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms\n",
}
"""The messages that are written, first lines of their schemas."""

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
"""What they are made of."""

Stream = tuple[int, NDArray[np.int64], list[bytes]]
"""Channel, times (n,) in ns, n messages."""


def write_ros2(
    path: str | os.PathLike[str],
    trajectories: Sequence[Trajectory],
    *,
    facts: Mapping[str, str] | None = None,
    covariance: bool = False,
    overwrite: bool = False,
) -> None:
    """Write poses as a ROS 2 bag of one file.

    ``geometry_msgs/msg/PoseStamped`` on ``/pose/<device>`` and ``tf2_msgs/msg/TFMessage`` on
    ``/tf``, the device's frame in that of its poses. Log time and stamp are the pose's time.

    Parameters
    ----------
    path : path
        The output; ``ros2 bag`` knows it by the ending ``.mcap``.
    trajectories : sequence of Trajectory
        One a device.
    facts : mapping of str to str, optional
        Where the poses come from, for the metadata record :data:`RECORD`.
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
    """Names of devices as parts of ROS 2 topics: letters, digits and single underscores.

    Everything else becomes an underscore; a name that would begin with a digit or an
    underscore (a hidden topic) gets ``device_`` in front.

    Raises
    ------
    InputError
        Two of them become the same.

    Examples
    --------
    >>> ros_names(["kiwi", "lab/blue robot", "17"])
    ['kiwi', 'lab_blue_robot', 'device_17']
    """
    found: dict[str, str] = {}
    for device in devices:
        name = re.sub(r"[^0-9A-Za-z]+", "_", device).rstrip("_")
        if not re.match("[A-Za-z]", name):
            name = f"device_{name.lstrip('_')}".rstrip("_")
        if name in found:
            raise InputError(
                f"devices {found[name]!r} and {device!r} have the same name in ROS, {name!r}",
                hint="Export as csv or parquet, which keep names as they are",
            )
        found[name] = device
    return list(found)


def pose_stamped(trajectory: Trajectory) -> list[bytes]:
    """``geometry_msgs/msg/PoseStamped`` in CDR, one a pose."""
    return _messages(trajectory, bytes(8) + _string(trajectory.frame), 0, _poses(trajectory))


def pose_with_covariance(trajectory: Trajectory) -> list[bytes]:
    """``geometry_msgs/msg/PoseWithCovarianceStamped`` in CDR, one a pose."""
    flat = known_covariance(trajectory.covariance).reshape(-1, 36)
    numbers = np.hstack([_poses(trajectory), flat])
    return _messages(trajectory, bytes(8) + _string(trajectory.frame), 0, numbers)


def transforms(trajectory: Trajectory) -> list[bytes]:
    """``tf2_msgs/msg/TFMessage`` of one transform in CDR, one a pose."""
    head = struct.pack("<I", 1) + bytes(8) + _string(trajectory.frame)
    return _messages(trajectory, head + _string(child_frame(trajectory)), 4, _poses(trajectory))


def known_covariance(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n, 6, 6) covariances without NaN, as filters need them.

    What was not observed has the variance :data:`UNKNOWN_VARIANCE` and no correlation. ROS
    orders as we do: x, y, z, and rotations about the fixed axes x, y, z.
    """
    filled = np.nan_to_num(covariance, nan=0.0)
    row, column = np.nonzero(np.isnan(np.einsum("nii->ni", covariance)))
    filled[row, column, :] = filled[row, :, column] = 0.0
    filled[row, column, column] = UNKNOWN_VARIANCE
    return filled


def _poses(trajectory: Trajectory) -> NDArray[np.float64]:
    return np.hstack([trajectory.position, trajectory.quaternion])


def _string(text: str) -> bytes:
    """A string of CDR: length with the final zero, bytes; padded for another length."""
    data = text.encode() + b"\0"
    return struct.pack("<I", len(data)) + data + bytes(-len(data) % 4)


def _messages(
    trajectory: Trajectory, head: bytes, stamp_at: int, numbers: NDArray[np.float64]
) -> list[bytes]:
    """CDR messages of ``head``, in which a stamp stands at ``stamp_at``, and doubles (n, k)."""
    n, k = numbers.shape
    header = b"\x00\x01\x00\x00"  # plain CDR, little-endian
    blank = header + head + bytes(-len(head) % 8) + bytes(8 * k)
    size, start = len(blank), len(header) + stamp_at
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
    return [bytes(content[at : at + size]) for at in range(0, n * size, size)]


def _check(trajectory: Trajectory) -> None:
    name = f"trajectory of device {trajectory.device!r}"
    if not trajectory.frame:
        raise InputError(f"a frame without a name in the {name}", hint="export it as csv or tum")
    if not np.isfinite(_poses(trajectory)).all():
        raise InputError(f"poses that are not numbers in the {name}", hint="leave them out")
    if ((trajectory.time_ns < 0) | (trajectory.time_ns >= LAST_NS)).any():
        raise InputError(
            f"a time that is not between 1970 and 2038 in the {name}",
            hint="export it as csv or parquet",
        )


def _channels(writer: Writer) -> Callable[[str, str], int]:
    """``channel(topic, message)`` gives the id of a topic's channel, made when it is new."""
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
    """A message's definition followed by those of its parts, as ``ros2msg`` wants it."""
    text, parts = _DEFINITIONS[message], {}
    open_texts = [text]
    while open_texts:
        for line in open_texts.pop().splitlines():
            part = line.split()[0].removesuffix("[]")
            if part in _PARTS and part not in parts:
                parts[part] = _PARTS[part]
                open_texts.append(_PARTS[part])
    rule = "=" * 80
    return text + "".join(f"{rule}\nMSG: {part}\n{lines}" for part, lines in parts.items())


def _write(writer: Writer, streams: Sequence[Stream]) -> None:
    """Write all messages in the order of their times."""
    if not streams:
        return
    times = np.concatenate([time_ns for _, time_ns, _ in streams])
    messages = [message for _, _, found in streams for message in found]
    channels = np.repeat([channel for channel, _, _ in streams], [len(m) for *_, m in streams])
    order = np.argsort(times, kind="stable")
    sequence: dict[int, int] = {}
    for k, channel, time_ns in zip(
        order.tolist(), channels[order].tolist(), times[order].tolist(), strict=True
    ):
        count = sequence[channel] = sequence.get(channel, -1) + 1
        writer.add_message(channel, time_ns, messages[k], time_ns, count)
