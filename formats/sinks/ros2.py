"""Sink ``ros2:``: topics of ROS 2 through rclpy, in the Python of a sourced distribution."""

from __future__ import annotations

from typing import Any

from locatk.core.errors import LocatkError
from locatk.core.streaming.events import PoseEstimate
from locatk.formats.exporters.ros2 import known_covariance
from locatk.formats.sinks import cdr
from locatk.formats.sinks.addresses import SinkAddress
from locatk.formats.sinks.interface import LiveMessage
from locatk.formats.sinks.queued import QueuedSink
from locatk.formats.sinks.ros_topics import OPTIONS, QOS_DEPTH, TF_TOPIC, RosTopics


def create(address: SinkAddress) -> Ros2Sink:
    """Return the sink of ``ros2:`` or ``ros2:?namespace=...&topic=...``."""
    return Ros2Sink(address)


class Ros2Sink(QueuedSink):
    """Publishes what the sink ``zenoh:`` does, with the middleware of the ROS environment."""

    def __init__(self, address: SinkAddress) -> None:
        address = address.with_path_options()
        address.reject_unknown_options(*OPTIONS)
        self._names = RosTopics(address)
        super().__init__(address, "ROS 2")
        self._ros: Any = None
        self._context: Any = None
        self._node: Any = None
        self._publishers: dict[str, Any] = {}

    def prepare(self) -> None:
        """Import rclpy.

        Raises
        ------
        LocatkError
            No environment of ROS 2 is sourced, or it is one of another version of Python.
        """
        try:
            self._ros = _Ros()
        except ImportError as error:
            raise LocatkError(
                f"ros2: needs rclpy, which cannot be imported ({error})",
                hint="Source ROS 2 with the Python of its distribution, or use zenoh://localhost",
            ) from None

    def start(self) -> None:
        """Create the node, in a context of its own: signals stay with locatk."""
        self._context = self._ros.rclpy.Context()
        self._ros.rclpy.init(context=self._context, signal_handler_options=self._ros.no_signals)
        self._node = self._ros.rclpy.create_node("locatk", context=self._context)
        for device in self.context.devices:
            self._publisher(self._names.pose_topic(device), self._ros.pose_type)

    def send(self, message: LiveMessage) -> int:
        """Publish a pose; other events have no message in ROS."""
        pose = message.event
        if not isinstance(pose, PoseEstimate):
            return 0
        topic = self._names.pose_topic(pose.device)
        content = self._pose(pose)
        self._publisher(topic, self._ros.pose_type).publish(content)
        if self._names.has_transforms and pose.has_orientation:
            transforms = self._ros.transforms_type(transforms=[self._transform(pose)])
            self._publisher(TF_TOPIC, self._ros.transforms_type).publish(transforms)
        return 1

    def stop(self) -> None:
        """Destroy the node and its context."""
        if self._node is not None:
            self._node.destroy_node()
        if self._context is not None:
            self._ros.rclpy.shutdown(context=self._context)

    def _publisher(self, topic: str, message_type: Any) -> Any:
        if topic not in self._publishers:
            self._publishers[topic] = self._node.create_publisher(message_type, topic, QOS_DEPTH)
        return self._publishers[topic]

    def _pose(self, pose: PoseEstimate) -> Any:
        message = self._ros.pose_type()
        self._fill_header(message.header, pose)
        target = message.pose.pose
        target.position.x, target.position.y, target.position.z = pose.position.tolist()
        _fill_quaternion(target.orientation, pose)
        message.pose.covariance = known_covariance(pose.covariance[None]).ravel().tolist()
        return message

    def _transform(self, pose: PoseEstimate) -> Any:
        message = self._ros.transform_type()
        self._fill_header(message.header, pose)
        message.child_frame_id = self._names.child_frame(pose)
        target = message.transform
        x, y, z = pose.position.tolist()
        target.translation.x, target.translation.y, target.translation.z = x, y, z
        _fill_quaternion(target.rotation, pose)
        return message

    def _fill_header(self, header: Any, pose: PoseEstimate) -> None:
        header.stamp.sec, header.stamp.nanosec = divmod(pose.time_ns, 1_000_000_000)
        header.frame_id = self._names.frame(pose)


class _Ros:
    """What is used of the packages of ROS, imported."""

    def __init__(self) -> None:
        import rclpy
        from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
        from rclpy.signals import SignalHandlerOptions
        from tf2_msgs.msg import TFMessage

        self.rclpy = rclpy
        self.no_signals = SignalHandlerOptions.NO
        self.pose_type = PoseWithCovarianceStamped
        self.transform_type = TransformStamped
        self.transforms_type = TFMessage


def _fill_quaternion(target: Any, pose: PoseEstimate) -> None:
    target.x, target.y, target.z, target.w = cdr.quaternion(pose)
