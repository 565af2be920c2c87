"""Messages of ROS 2 in CDR (plain, little-endian), one at a time.

OMG DDS-XTypes 1.3, section 7.4.1: each number is aligned to its size, counted from the end of the
header of four bytes. ``locatk export`` encodes whole trajectories (:mod:`..exporters.ros2`).
"""

from __future__ import annotations

import functools
import struct

from locatk.core.streaming.events import PoseEstimate
from locatk.formats.exporters.ros2 import known_covariance

POSE_TYPE = "geometry_msgs/msg/PoseWithCovarianceStamped"
TRANSFORM_TYPE = "tf2_msgs/msg/TFMessage"

TYPE_HASHES = {
    POSE_TYPE: "RIHS01_26432f9803e43727d3c8f668d1fdb3c630f548af631e2f4e31382371bfea3b6e",
    TRANSFORM_TYPE: "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
}
"""Hash of the definition of each message (REP 2016), the same in Iron and later."""

_HEADER = b"\x00\x01\x00\x00"
_STAMP = struct.Struct("<iI")
_POSE = struct.Struct("<7d")
_COVARIANCE = struct.Struct("<36d")


def pose_with_covariance(pose: PoseEstimate, frame: str) -> bytes:
    """Encode ``geometry_msgs/msg/PoseWithCovarianceStamped``.

    Unobserved components get a large variance, see
    :data:`locatk.formats.exporters.ros2.UNKNOWN_VARIANCE`; an unknown orientation is the identity.
    """
    flat = known_covariance(pose.covariance[None])[0].ravel().tolist()
    return b"".join(
        (_HEADER, _stamp(pose.time_ns), _strings(8, frame), _pose(pose), _COVARIANCE.pack(*flat))
    )


def transform(pose: PoseEstimate, frame: str, child_frame: str) -> bytes:
    """Encode ``tf2_msgs/msg/TFMessage`` with the transform from the device to the frame."""
    names = _strings(12, frame, child_frame)
    return b"".join((_HEADER, b"\1\0\0\0", _stamp(pose.time_ns), names, _pose(pose)))


def quaternion(pose: PoseEstimate) -> tuple[float, float, float, float]:
    """Return the orientation (x, y, z, w), the identity if it is unknown."""
    if not pose.has_orientation:
        return (0.0, 0.0, 0.0, 1.0)
    x, y, z, w = pose.quaternion.tolist()
    return (x, y, z, w)


def _stamp(time_ns: int) -> bytes:
    return _STAMP.pack(*divmod(time_ns, 1_000_000_000))


def _pose(pose: PoseEstimate) -> bytes:
    return _POSE.pack(*pose.position.tolist(), *quaternion(pose))


@functools.lru_cache(maxsize=1000)
def _strings(offset: int, *texts: str) -> bytes:
    """Encode strings that begin at an offset, and the padding before a double."""
    content = b""
    for text in texts:
        data = text.encode() + b"\0"
        content += bytes(-(offset + len(content)) % 4) + struct.pack("<I", len(data)) + data
    return content + bytes(-(offset + len(content)) % 8)
