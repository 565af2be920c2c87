"""Sink of rclpy, against a module of this name that records what is published."""

from __future__ import annotations

import sys
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from locatk.core.errors import LocatkError
from locatk.formats.exporters.ros2 import UNKNOWN_VARIANCE
from locatk.formats.sinks.interface import SinkContext
from locatk.formats.sinks.registry import create_sink


class Message:
    """Message whose fields are created when they are used."""

    def __init__(self, **fields: Any) -> None:
        self.__dict__.update(fields)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        self.__dict__[name] = Message()
        return self.__dict__[name]


class PoseWithCovarianceStamped(Message):
    pass


class TransformStamped(Message):
    pass


class TFMessage(Message):
    pass


@pytest.fixture
def ros(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Install modules of ROS, and return what happens in them."""
    calls: Any = SimpleNamespace(published=[], events=[])

    def module(name: str, **content: Any) -> None:
        made = ModuleType(name)
        made.__dict__.update(content)
        monkeypatch.setitem(sys.modules, name, made)

    class Node:
        def create_publisher(self, message_type: type, topic: str, depth: int) -> Any:
            calls.events.append(("publisher", topic, message_type.__name__, depth))
            return SimpleNamespace(publish=lambda each: calls.published.append((topic, each)))

        def destroy_node(self) -> None:
            calls.events.append("destroyed")

    module(
        "rclpy",
        Context=lambda: "context",
        init=lambda **options: calls.events.append(("init", options)),
        create_node=lambda name, context: (calls.events.append((name, context)), Node())[1],
        shutdown=lambda context: calls.events.append(("shutdown", context)),
    )
    module("rclpy.signals", SignalHandlerOptions=SimpleNamespace(NO="no"))
    module("geometry_msgs")
    module(
        "geometry_msgs.msg",
        PoseWithCovarianceStamped=PoseWithCovarianceStamped,
        TransformStamped=TransformStamped,
    )
    module("tf2_msgs")
    module("tf2_msgs.msg", TFMessage=TFMessage)
    return calls


def test_poses_and_transforms(live: ModuleType, ros: Any) -> None:
    sink = create_sink("ros2:?namespace=lab&frame=map")
    sink.open(SinkContext("dots", devices=("kiwi",)))
    live.offer(sink, live.pose(7, "kiwi"), live.lost(), live.position_only(8))
    sink.close(5)
    assert ros.events == [
        ("init", {"context": "context", "signal_handler_options": "no"}),
        ("locatk", "context"),
        ("publisher", "/lab/pose_with_covariance/kiwi", "PoseWithCovarianceStamped", 10),
        ("publisher", "/tf", "TFMessage", 10),
        ("publisher", "/lab/pose_with_covariance/diode", "PoseWithCovarianceStamped", 10),
        "destroyed",
        ("shutdown", "context"),
    ]
    (first, pose), (second, transforms), (third, diode) = ros.published
    assert (first, second) == ("/lab/pose_with_covariance/kiwi", "/tf")
    assert third == "/lab/pose_with_covariance/diode"
    expected = live.pose(7, "kiwi")
    (transform,) = transforms.transforms
    for header in (pose.header, transform.header):
        assert header.frame_id == "map"
        assert header.stamp.sec * 10**9 + header.stamp.nanosec == expected.time_ns
    assert transform.child_frame_id == "kiwi"
    for point in (pose.pose.pose.position, transform.transform.translation):
        assert [point.x, point.y, point.z] == expected.position.tolist()
    for rotation in (pose.pose.pose.orientation, transform.transform.rotation):
        quaternion = [rotation.x, rotation.y, rotation.z, rotation.w]
        assert quaternion == expected.quaternion.tolist()
    assert pose.pose.covariance == expected.covariance.ravel().tolist()
    assert diode.pose.covariance[35] == UNKNOWN_VARIANCE
    assert sink.status().sent == 2
    assert sink.status().dropped == 0


def test_without_ros_the_remedy_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rclpy", None)
    sink = create_sink("ros2:")
    with pytest.raises(LocatkError, match="rclpy") as caught:
        sink.open(SinkContext("dots"))
    assert "zenoh://localhost" in str(caught.value.hint)
    assert "\n" not in str(caught.value)
