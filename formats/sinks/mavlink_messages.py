"""Messages of MAVLink 2 that the sink ``mavlink:`` sends and understands, encoded by hand.

https://mavlink.io/en/guide/serialization.html and https://mavlink.io/en/messages/common.html
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from locatk.core.geometry import quaternion_multiply
from locatk.core.streaming.events import PoseEstimate
from locatk.formats.exporters.ros2 import known_covariance
from locatk.formats.sinks.confidence import localization_score

START_V1, START_V2 = 0xFE, 0xFD

HEARTBEAT, VISION_POSITION_ESTIMATE, TIMESYNC, ODOMETRY = 0, 102, 111, 331

CRC_EXTRA = {HEARTBEAT: 50, VISION_POSITION_ESTIMATE: 158, TIMESYNC: 34, ODOMETRY: 91}
"""Byte that completes the checksum of a message: a hash of its definition."""

COMPONENT_ID = 197
"""MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY."""

MAV_FRAME_LOCAL_NED, MAV_FRAME_LOCAL_FRD, MAV_FRAME_BODY_FRD = 1, 20, 12

MAV_ESTIMATOR_TYPE_VISION = 2
"""PX4 ignores the covariance of type NAIVE, and does not fuse MOCAP."""

_HEARTBEAT = struct.Struct("<IBBBBB")
_ODOMETRY = struct.Struct("<Q3f4f3f3f21f21f4Bb")
_VISION = struct.Struct("<Q3f3f21fB")
_TIMESYNC = struct.Struct("<qq")
_TRIANGLE = np.triu_indices(6)
_FRD_SIGNS = np.array([1.0, -1.0, -1.0, 1.0, -1.0, -1.0])
_NED_ORDER = np.array([1, 0, 2, 4, 3, 5])
_NED_SIGNS = np.array([1.0, 1.0, -1.0, 1.0, 1.0, -1.0])
_ENU_TO_NED = np.array([math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0])
_FRD_TO_FLU = np.array([1.0, 0.0, 0.0, 0.0])
_UNKNOWN_TRIANGLE = [math.nan] + [0.0] * 20


class Encoder:
    """Frames of one sender, with sequence numbers."""

    def __init__(self, system_id: int) -> None:
        self._system_id = system_id
        self._sequence = 0

    def frame(self, message_id: int, payload: bytes) -> bytes:
        """Return the frame of a payload, without the zeros at its end."""
        payload = payload.rstrip(b"\0") or payload[:1]
        head = struct.pack(
            "<BBBBBB3s",
            len(payload),
            0,
            0,
            self._sequence,
            self._system_id,
            COMPONENT_ID,
            message_id.to_bytes(3, "little"),
        )
        self._sequence = (self._sequence + 1) & 0xFF
        checksum = x25_crc(head + payload + bytes([CRC_EXTRA[message_id]]))
        return bytes([START_V2]) + head + payload + checksum.to_bytes(2, "little")

    def heartbeat(self) -> bytes:
        """Return a HEARTBEAT of a companion computer: MAV_TYPE 18, no autopilot, active."""
        return self.frame(HEARTBEAT, _HEARTBEAT.pack(0, 18, 8, 0, 4, 3))

    def timesync(self, own_ns: int, request_ns: int) -> bytes:
        """Return the answer to a TIMESYNC."""
        return self.frame(TIMESYNC, _TIMESYNC.pack(own_ns, request_ns))

    def odometry(self, pose: PoseEstimate, is_ned: bool) -> bytes:
        """Return an ODOMETRY without velocities."""
        local = LocalPose.from_pose(pose, is_ned)
        x, y, z, w = local.quaternion
        payload = _ODOMETRY.pack(
            pose.time_ns // 1000,
            *local.position,
            *(w, x, y, z),
            *[math.nan] * 6,
            *local.covariance,
            *_UNKNOWN_TRIANGLE,
            MAV_FRAME_LOCAL_NED if is_ned else MAV_FRAME_LOCAL_FRD,
            MAV_FRAME_BODY_FRD,
            pose.reset_counter,
            MAV_ESTIMATOR_TYPE_VISION,
            quality(pose),
        )
        return self.frame(ODOMETRY, payload)

    def vision_position(self, pose: PoseEstimate, is_ned: bool) -> bytes:
        """Return a VISION_POSITION_ESTIMATE, for firmware without ODOMETRY."""
        local = LocalPose.from_pose(pose, is_ned)
        payload = _VISION.pack(
            pose.time_ns // 1000,
            *local.position,
            *euler_angles(local.quaternion),
            *local.covariance,
            pose.reset_counter,
        )
        return self.frame(VISION_POSITION_ESTIMATE, payload)


@dataclass(frozen=True)
class LocalPose:
    """Pose of the body frame FRD (forward, right, down) in a frame whose z axis points down.

    Attributes
    ----------
    position : list of 3 float
    quaternion : list of 4 float
        (x, y, z, w), from body to frame.
    covariance : list of 21 float
        Upper triangle, row by row.
    """

    position: list[float]
    quaternion: list[float]
    covariance: list[float]

    @classmethod
    def from_pose(cls, pose: PoseEstimate, is_ned: bool) -> LocalPose:
        """Convert a pose of a body FLU in a frame with z upwards.

        Without ``is_ned`` the new frame is FRD: the old one rotated by 180 degrees about x. With
        it, the old frame is ENU (x east, y north), and the new one NED.
        """
        covariance = known_covariance(pose.covariance[None])[0]
        if is_ned:
            x, y, z = pose.position.tolist()
            position = [y, x, -z]
            rotated = quaternion_multiply(_ENU_TO_NED, pose.quaternion)
            quaternion = quaternion_multiply(rotated, _FRD_TO_FLU)
            if quaternion[3] < 0:
                quaternion = -quaternion
            covariance = covariance[_NED_ORDER][:, _NED_ORDER] * np.outer(_NED_SIGNS, _NED_SIGNS)
        else:
            position = (pose.position * _FRD_SIGNS[:3]).tolist()
            quaternion = pose.quaternion * np.array([1.0, -1.0, -1.0, 1.0])
            covariance = covariance * np.outer(_FRD_SIGNS, _FRD_SIGNS)
        return cls(position, quaternion.tolist(), covariance[_TRIANGLE].tolist())


def quality(pose: PoseEstimate) -> int:
    """Return the quality of a pose from 1 to 100, at most 50 while it is provisional."""
    return max(1, round(100 * localization_score(pose)))


def euler_angles(quaternion: list[float]) -> tuple[float, float, float]:
    """Return roll, pitch and yaw [rad] of a rotation Rz(yaw) Ry(pitch) Rx(roll)."""
    x, y, z, w = quaternion
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = math.asin(min(max(2 * (w * y - z * x), -1.0), 1.0))
    yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return roll, pitch, yaw


def x25_crc(data: bytes) -> int:
    """Return the checksum CRC-16/MCRF4XX of MAVLink."""
    crc = 0xFFFF
    for byte in data:
        crc = (crc >> 8) ^ _CRC_TABLE[(crc ^ byte) & 0xFF]
    return crc


def _crc_table() -> list[int]:
    table = []
    for value in range(256):
        for _ in range(8):
            value = (value >> 1) ^ (0x8408 if value & 1 else 0)
        table.append(value)
    return table


_CRC_TABLE = _crc_table()


def timesync_requests(buffer: bytearray) -> Iterator[int]:
    """Yield ``ts1`` of the requests TIMESYNC in received bytes, and remove complete frames.

    Other messages, bytes between frames and frames with a wrong checksum are skipped.
    """
    while True:
        starts = [at for at in (buffer.find(START_V1), buffer.find(START_V2)) if at >= 0]
        if not starts:
            buffer.clear()
            return
        del buffer[: min(starts)]
        if len(buffer) < 3:
            return
        is_v2 = buffer[0] == START_V2
        head = 10 if is_v2 else 6
        signature = 13 if is_v2 and buffer[2] & 1 else 0
        end = head + buffer[1] + 2
        if len(buffer) < end + signature:
            return
        message_id = int.from_bytes(buffer[7:10], "little") if is_v2 else buffer[5]
        if message_id != TIMESYNC:
            # Its checksum is unknown here: skip it as a whole.
            del buffer[: end + signature]
            continue
        expected = x25_crc(bytes(buffer[1 : end - 2]) + bytes([CRC_EXTRA[TIMESYNC]]))
        if int.from_bytes(buffer[end - 2 : end], "little") != expected:
            del buffer[:1]
            continue
        payload = bytes(buffer[head : end - 2]).ljust(_TIMESYNC.size, b"\0")
        del buffer[: end + signature]
        own_ns, request_ns = _TIMESYNC.unpack_from(payload)
        if own_ns == 0:
            yield request_ns
