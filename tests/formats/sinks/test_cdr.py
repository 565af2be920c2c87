"""CDR of single messages, against rosbags."""

from __future__ import annotations

import struct
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from locatk.core.streaming.events import PoseEstimate
from locatk.formats.exporters.ros2 import UNKNOWN_VARIANCE
from locatk.formats.sinks import cdr

FRAMES = ["map", "a", "floor", "hall 3/östlich", "odom_combined"]


@pytest.fixture(scope="module", params=["ROS2_HUMBLE", "ROS2_JAZZY"])
def store(request: Any) -> Any:
    typesys = pytest.importorskip("rosbags.typesys", reason="rosbags is not installed")
    return typesys.get_typestore(getattr(typesys.Stores, request.param))


def header(store: Any, pose: PoseEstimate, frame: str) -> Any:
    types = store.types
    stamp = types["builtin_interfaces/msg/Time"](*divmod(pose.time_ns, 10**9))
    return types["std_msgs/msg/Header"](stamp, frame)


@pytest.mark.parametrize("frame", FRAMES)
def test_pose_equals_that_of_rosbags(store: Any, live: ModuleType, frame: str) -> None:
    types = store.types
    rng = np.random.default_rng(3)
    root = rng.normal(size=(6, 6))
    pose = live.pose(7, covariance=root @ root.T)
    quaternion = types["geometry_msgs/msg/Quaternion"](*pose.quaternion)
    point = types["geometry_msgs/msg/Point"](*pose.position)
    message = types[cdr.POSE_TYPE](
        header(store, pose, frame),
        types["geometry_msgs/msg/PoseWithCovariance"](
            types["geometry_msgs/msg/Pose"](point, quaternion), pose.covariance.ravel()
        ),
    )
    assert cdr.pose_with_covariance(pose, frame) == bytes(
        store.serialize_cdr(message, cdr.POSE_TYPE)
    )


@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize("child", FRAMES)
def test_transform_equals_that_of_rosbags(
    store: Any, live: ModuleType, frame: str, child: str
) -> None:
    types = store.types
    pose = live.pose(7)
    rotation = types["geometry_msgs/msg/Quaternion"](*pose.quaternion)
    translation = types["geometry_msgs/msg/Vector3"](*pose.position)
    transform = types["geometry_msgs/msg/Transform"](translation, rotation)
    message = types[cdr.TRANSFORM_TYPE](
        [types["geometry_msgs/msg/TransformStamped"](header(store, pose, frame), child, transform)]
    )
    assert cdr.transform(pose, frame, child) == bytes(
        store.serialize_cdr(message, cdr.TRANSFORM_TYPE)
    )


def test_unobserved_components_have_a_large_variance(store: Any, live: ModuleType) -> None:
    pose = live.position_only()
    message = store.deserialize_cdr(cdr.pose_with_covariance(pose, "map"), cdr.POSE_TYPE)
    covariance = message.pose.covariance.reshape(6, 6)
    assert np.diagonal(covariance).tolist() == [1e-4] * 3 + [UNKNOWN_VARIANCE] * 3
    assert np.count_nonzero(covariance) == 6
    orientation = message.pose.pose.orientation
    assert (orientation.x, orientation.y, orientation.z, orientation.w) == (0, 0, 0, 1)


def test_type_hashes(store: Any) -> None:
    for name, type_hash in cdr.TYPE_HASHES.items():
        assert store.hash_rihs01(name) == type_hash


def test_time_that_ros_cannot_express(live: ModuleType) -> None:
    with pytest.raises(struct.error):
        cdr.pose_with_covariance(live.pose(time_ns=2**31 * 10**9), "map")
