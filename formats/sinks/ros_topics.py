"""Names in ROS 2 that the sinks ``zenoh:`` and ``ros2:`` share."""

from __future__ import annotations

import re

from locatk.core.errors import InputError
from locatk.core.streaming.events import PoseEstimate
from locatk.formats.exporters.ros2 import ros_names
from locatk.formats.sinks.addresses import SinkAddress

OPTIONS = ("namespace", "topic", "frame", "tf")

TF_TOPIC = "/tf"

DEFAULT_TOPIC = "pose_with_covariance/{device}"
"""As in the bags of ``locatk export``."""

QOS_DEPTH = 10
"""Poses that a publisher keeps for a slow subscriber."""

_TOPIC = re.compile(r"[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")


class RosTopics:
    """Topics and frames of the poses of devices.

    Options of the address: ``namespace``; ``topic``, in which ``{device}`` is the name of the
    device; ``frame``, which replaces the name of the frame of the poses; ``tf=no``.
    """

    def __init__(self, address: SinkAddress) -> None:
        namespace = address.options.get("namespace", "").strip("/")
        topic = address.options.get("topic", DEFAULT_TOPIC).strip("/")
        self._topic = f"{namespace}/{topic}" if namespace else topic
        if not _TOPIC.fullmatch(self._topic.replace("{device}", "device")):
            raise InputError(
                f"no topic of ROS in {address.public_text}: {self._topic!r}",
                hint="Letters, digits and _ between slashes, and {device}",
            )
        self._frame = address.options.get("frame", "")
        self.has_transforms = address.choice("tf", "yes", "no") == "yes"
        self._device_of: dict[str, str] = {}

    def pose_topic(self, device: str) -> str:
        """Return the topic of the poses of a device.

        Raises
        ------
        InputError
            Another device has it.
        """
        topic = "/" + self._topic.replace("{device}", ros_names([device])[0])
        owner = self._device_of.setdefault(topic, device)
        if owner != device:
            raise InputError(f"devices {owner!r} and {device!r} have the same topic {topic}")
        return topic

    def frame(self, pose: PoseEstimate) -> str:
        """Return ``frame_id`` of a pose."""
        return self._frame or pose.frame

    def child_frame(self, pose: PoseEstimate) -> str:
        """Return the frame of the device: its name, unless the frame of the poses has it."""
        return pose.device + ("_body" if pose.device == self.frame(pose) else "")
