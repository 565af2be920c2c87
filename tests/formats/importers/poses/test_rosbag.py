"""Poses in bags that rosbags wrote."""

from __future__ import annotations

import sqlite3
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from locatk.core.errors import FormatError, InputError, LocatkError
from locatk.core.geometry import quaternion_from_matrix, rotation_exp
from locatk.core.trajectory import Trajectory
from locatk.formats.exporters.ros2 import write_ros2
from locatk.formats.importers.poses import trajectories as files

START_NS = 1_700_000_000_123_456_789
STORAGES = ("sqlite3", "mcap", "ros1")


def track(device: str = "robot", frame: str = "map", n: int = 20, seed: int = 3) -> Trajectory:
    random = np.random.default_rng(seed)
    factor = random.normal(size=(n, 6, 6)) * 1e-2
    return Trajectory(
        device,
        frame,
        START_NS + np.cumsum(random.integers(1_000_000, 90_000_000, n)),
        random.normal(size=(n, 3)),
        quaternion_from_matrix(rotation_exp(random.normal(size=(n, 3)))),
        factor @ factor.transpose(0, 2, 1),
    )


def poses(make: Any, track: Trajectory, topic: str = "/pose") -> list[tuple[str, int, Any]]:
    rows = zip(track.time_ns.tolist(), track.position, track.quaternion, strict=True)
    # Messages are recorded 7 ms after their stamps.
    return [
        (topic, time + 7_000_000, make.pose_stamped(time, track.frame, position, quaternion))
        for time, position, quaternion in rows
    ]


def transforms(
    make: Any, track: Trajectory, child: str, topic: str = "/tf"
) -> list[tuple[str, int, Any]]:
    rows = zip(track.time_ns.tolist(), track.position, track.quaternion, strict=True)
    return [
        (topic, time, make.tf(make.transform(time, track.frame, child, *pose)))
        for time, *pose in rows
    ]


def assert_same(actual: Trajectory, expected: Trajectory) -> None:
    assert actual.frame == expected.frame
    np.testing.assert_array_equal(actual.time_ns, expected.time_ns)
    np.testing.assert_array_equal(actual.position, expected.position)
    np.testing.assert_allclose(actual.quaternion, expected.quaternion, atol=1e-15)


@pytest.mark.slow
@pytest.mark.parametrize("storage", STORAGES)
def test_all_types_have_the_same_poses(tmp_path: Path, ros_bags: ModuleType, storage: str) -> None:
    make, robot = ros_bags.Messages(storage), track()
    messages = poses(make, robot)
    stamped = []
    for k, time in enumerate(robot.time_ns.tolist()):
        pose = "map", robot.position[k], robot.quaternion[k]
        stamped.append(make.pose_stamped(time, *pose))
        wide = make.with_covariance(time, *pose, robot.covariance[k])
        odometry = make.odometry(time, *pose, robot.covariance[k])
        transform = make.transform(time, "map", "base", *pose[1:])
        point = make.point(time, *pose[:2])
        single = {"/wide": wide, "/odom": odometry, "/vicon": transform, "/point": point}
        single |= {"/path": make.path(time, "map", list(stamped)), "/tf": make.tf(transform)}
        messages += [(topic, time, message) for topic, message in single.items()]
    messages.append(("/chatter", START_NS, make.text("hello")))
    path = ros_bags.write_bag(tmp_path / "drive", storage, sorted(messages, key=lambda m: m[1]))
    found = files.open_file(path)
    assert (found.kind, found.solved) == ("bag", True)
    tracks = {each.device: each for each in found.trajectories}
    assert list(tracks) == ["/odom", "/path", "/point", "/pose", "/tf:map.base", "/vicon", "/wide"]
    for name, each in tracks.items():
        if name == "/point":
            np.testing.assert_array_equal(each.position, robot.position)
            assert (each.quaternion == [0, 0, 0, 1]).all()
        else:
            assert_same(each, robot)
        if name in ("/odom", "/wide"):
            np.testing.assert_allclose(each.covariance, robot.covariance, rtol=1e-12)
        else:
            assert np.isnan(each.covariance).all()
    assert found.notes == ()


@pytest.mark.parametrize("compression", ["FILE", "MESSAGE"])
@pytest.mark.parametrize("storage", ["sqlite3", "mcap"])
def test_compressed_bags(
    tmp_path: Path, ros_bags: ModuleType, storage: str, compression: str
) -> None:
    messages = poses(ros_bags.Messages(), track())
    path = ros_bags.write_bag(tmp_path / "drive", storage, messages, compression)
    assert_same(files.read(path)[0], track())


@pytest.mark.parametrize(("storage", "kind"), [("sqlite3", "bag"), ("mcap", "mcap")])
def test_single_files_of_a_bag(
    tmp_path: Path, ros_bags: ModuleType, storage: str, kind: str
) -> None:
    folder = ros_bags.write_bag(tmp_path / "drive", storage, poses(ros_bags.Messages(), track()))
    [file] = [each for each in folder.iterdir() if each.suffix in (".db3", ".mcap")]
    found = files.open_file(file)
    assert found.kind == kind
    assert_same(found.trajectories[0], track())


def test_bags_without_definitions_of_messages(tmp_path: Path, ros_bags: ModuleType) -> None:
    """Bags before ROS 2 Iron have none."""
    folder = ros_bags.write_bag(tmp_path / "a", "sqlite3", poses(ros_bags.Messages(), track()))
    with sqlite3.connect(folder / "a.db3") as database:
        database.execute("DELETE FROM message_definitions")
    database.close()
    assert_same(files.read(folder)[0], track())


def test_our_export_is_read_back(tmp_path: Path, ros_bags: ModuleType) -> None:
    robot = track("kiwi", "floor")
    robot.covariance[3:, 2, :] = robot.covariance[3:, :, 2] = np.nan  # an unobserved height
    write_ros2(tmp_path / "a.mcap", [robot], covariance=True)
    tracks = {each.device: each for each in files.read(tmp_path / "a.mcap")}
    assert list(tracks) == ["/pose_with_covariance/kiwi", "/tf:floor.kiwi", "kiwi"]
    for each in tracks.values():
        assert_same(each, robot)
    wide = tracks["/pose_with_covariance/kiwi"]
    np.testing.assert_allclose(wide.covariance, robot.covariance, rtol=1e-12)


def test_variances_that_mean_unknown(tmp_path: Path, ros_bags: ModuleType) -> None:
    make = ros_bags.Messages()
    covariance = np.diag([0.04, 0.09, 0.0, -1.0, 1e6, 0.01])
    covariance[0, 1] = covariance[1, 0] = 0.02
    pose = "map", (1, 2, 3), (0, 0, 0, 1)
    messages = [
        ("/a", START_NS, make.with_covariance(START_NS, *pose, covariance)),
        ("/b", START_NS, make.with_covariance(START_NS, *pose, np.zeros((6, 6)))),
    ]
    some, none = files.read(ros_bags.write_bag(tmp_path / "a", "mcap", messages))
    expected = np.full((6, 6), np.nan)
    known = np.ix_([0, 1, 5], [0, 1, 5])
    expected[known] = covariance[known]
    np.testing.assert_array_equal(some.covariance[0], expected)
    assert np.isnan(none.covariance).all()


def test_unusable_poses_are_counted(tmp_path: Path, ros_bags: ModuleType) -> None:
    make, robot = ros_bags.Messages(), track(n=10)
    robot.quaternion[1] *= 1.005  # rounding, which is corrected
    robot.quaternion[2] = 0
    robot.quaternion[3] *= 2
    robot.position[4, 1] = np.nan
    messages = poses(make, robot)
    messages[5][2].header.frame_id = "other"
    messages[6][2].header.stamp.sec = messages[6][2].header.stamp.nanosec = 0
    messages.append(messages[7])
    found = files.open_file(ros_bags.write_bag(tmp_path / "a", "sqlite3", messages))
    [left] = found.trajectories
    np.testing.assert_array_equal(left.time_ns, robot.time_ns[[0, 1, 7, 8, 9]])
    np.testing.assert_allclose(np.linalg.norm(left.quaternion, axis=1), 1.0, atol=1e-15)
    assert sorted(found.notes) == [
        "/pose: 1 of 11 poses left out (not finite)",
        "/pose: 1 of 11 poses left out (not in the frame 'map' of the first one)",
        "/pose: 1 of 11 poses left out (stamp of another pose)",
        "/pose: 1 of 11 poses left out (without a stamp)",
        "/pose: 2 of 11 poses left out (quaternion not of unit length)",
    ]
    messages = [each for k, each in enumerate(messages) if k in (2, 3)]
    with pytest.raises(FormatError, match="no usable poses") as caught:
        files.open_file(ros_bags.write_bag(tmp_path / "b", "sqlite3", messages))
    assert caught.value.hint == "/pose: 2 of 2 poses left out (quaternion not of unit length)"


def test_log_times_replace_missing_stamps(tmp_path: Path, ros_bags: ModuleType) -> None:
    make = ros_bags.Messages()
    messages = [
        ("/pose", START_NS + k, make.pose_stamped(0, "map", (k, 0, 0), (0, 0, 0, 1)))
        for k in range(3)
    ]
    found = files.open_file(ros_bags.write_bag(tmp_path / "a", "mcap", messages))
    assert found.trajectories[0].time_ns.tolist() == [START_NS, START_NS + 1, START_NS + 2]
    assert found.notes == ("/pose: its headers have no stamps; log times are used instead",)


def test_stamps_out_of_order_are_sorted(tmp_path: Path, ros_bags: ModuleType) -> None:
    messages = poses(ros_bags.Messages(), track())
    messages = [
        (topic, START_NS + k, message) for k, (topic, _, message) in enumerate(messages[::-1])
    ]
    assert_same(files.read(ros_bags.write_bag(tmp_path / "a", "mcap", messages))[0], track())


def test_a_path_without_stamps_has_no_times(tmp_path: Path, ros_bags: ModuleType) -> None:
    make = ros_bags.Messages()
    planned = [make.pose_stamped(0, "map", (k, 0, 0), (0, 0, 0, 1)) for k in range(3)]
    messages = [("/plan", START_NS, make.path(START_NS, "map", planned))]
    with pytest.raises(FormatError, match="no usable poses") as caught:
        files.open_file(ros_bags.write_bag(tmp_path / "a", "mcap", messages))
    assert caught.value.hint == "/plan: 3 of 3 poses left out (without a stamp)"


def test_poses_of_a_path_without_frame_have_that_of_the_path(
    tmp_path: Path, ros_bags: ModuleType
) -> None:
    make = ros_bags.Messages()
    points = [make.pose_stamped(START_NS + k, "", (k, 0, 0), (0, 0, 0, 1)) for k in range(3)]
    messages = [("/path", START_NS, make.path(START_NS, "map", points))]
    [path] = files.read(ros_bags.write_bag(tmp_path / "a", "mcap", messages))
    assert (path.frame, len(path)) == ("map", 3)


def test_transforms_of_several_bodies_on_one_topic(tmp_path: Path, ros_bags: ModuleType) -> None:
    make = ros_bags.Messages()
    messages = [
        ("/vicon", START_NS + k, make.transform(START_NS + k, "map", body, (x, 0, 0), (0, 0, 0, 1)))
        for k in range(3)
        for x, body in enumerate(("red", "blue"))
    ]
    path = ros_bags.write_bag(tmp_path / "a", "mcap", messages)
    blue, red = files.read(path)
    assert (blue.device, red.device) == ("/vicon:map.blue", "/vicon:map.red")
    assert (blue.position[:, 0].tolist(), red.position[:, 0].tolist()) == ([1] * 3, [0] * 3)
    assert names(path, "/vicon:map.red") == ["/vicon:map.red"]


# ---- selection


@pytest.fixture
def tree(tmp_path: Path, ros_bags: ModuleType) -> Path:
    """A bag with map -> odom -> base.link -> (constant) camera, and two more topics."""
    make = ros_bags.Messages()
    fixed = track(frame="base.link", n=1, seed=9)
    messages = [
        *transforms(make, track(frame="map", seed=1), "odom"),
        *transforms(make, track(frame="odom", seed=1), "base.link"),
        *transforms(make, fixed, "camera", "/tf_static"),
        # Each node that starts late gets it again.
        *transforms(make, replace(fixed, time_ns=fixed.time_ns + 10**9), "camera", "/tf_static"),
        *poses(make, track(), "/pose/kiwi"),
        *poses(make, track(seed=5), "/amcl"),
    ]
    return ros_bags.write_bag(tmp_path / "tree", "sqlite3", messages)


def names(path: Path, selected: str) -> list[str]:
    return [each.device for each in files.read(Path(f"{path}#{selected}"))]


def test_topics_and_transforms_are_selected(tree: Path) -> None:
    transforms = ["/tf:map.odom", "/tf:odom.base.link"]
    assert [each.device for each in files.read(tree)] == ["/amcl", *transforms, "kiwi"]
    assert names(tree, "/amcl") == names(tree, "amcl") == ["/amcl"]
    assert names(tree, "kiwi") == names(tree, "/pose/kiwi") == ["kiwi"]
    assert names(tree, "/tf") == transforms
    assert names(tree, "/tf:map.odom") == ["/tf:map.odom"]
    assert names(tree / "tree.db3", "/tf:odom.base.link") == ["/tf:odom.base.link"]


def test_transforms_are_composed(tree: Path) -> None:
    found = files.open_file(Path(f"{tree}#/tf:map.camera"))
    [camera] = found.trajectories
    np.testing.assert_array_equal(camera.time_ns, track(seed=1).time_ns)
    assert camera.frame == "map"
    first = first_matrix(track(seed=1))
    expected = first @ first @ first_matrix(track(n=1, seed=9))
    np.testing.assert_allclose(first_matrix(camera), expected, atol=1e-14)
    assert found.notes == (
        "/tf:map.camera: composed of /tf:map.odom, /tf:odom.base.link, /tf_static:base.link.camera",
    )


def first_matrix(track: Trajectory) -> np.ndarray:
    """Homogeneous matrix of the first pose, from the definition of a quaternion."""
    x, y, z, w = track.quaternion[0]
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    result = np.eye(4)
    result[:3, :3] += 2 * w * skew + 2 * skew @ skew
    result[:3, 3] = track.position[0]
    return result


@pytest.mark.parametrize(
    ("selected", "problem", "hint"),
    [
        ("/gps", "no topic '/gps' with poses", "It has /tf, /tf_static, /pose/kiwi, /amcl"),
        ("/gps:a.b", "no topic '/gps:a.b' with poses", "It has /tf, "),
        ("/tf:camera.map", "no transforms lead to '/tf:camera.map'", "It has /tf:map.odom, "),
        ("/tf:moon", "no transforms lead to '/tf:moon'", "It has /tf:map.odom, "),
        ("/tf_static", "no usable poses", "constant transforms only"),
    ],
)
def test_unknown_names_are_errors(tree: Path, selected: str, problem: str, hint: str) -> None:
    with pytest.raises(InputError, match=problem) as caught:
        names(tree, selected)
    assert hint in str(caught.value.hint)


def test_devices_of_other_files_are_selected(tmp_path: Path) -> None:
    path = tmp_path / "a#b.csv"
    path.write_text("time_s,x_m,y_m,z_m,device\n1,0,0,0,red\n2,0,0,0,red\n1,0,0,0,blue\n")
    assert names(path, "blue") == ["blue"]
    assert sorted(each.device for each in files.read(path)) == ["blue", "red"]
    with pytest.raises(InputError, match="no poses of 'green'"):
        names(path, "green")


# ---- what cannot be read


def test_a_bag_without_poses_lists_its_topics(tmp_path: Path, ros_bags: ModuleType) -> None:
    make = ros_bags.Messages()
    messages = [(f"/chatter{k}", START_NS, make.text("hello")) for k in range(14)]
    path = ros_bags.write_bag(tmp_path / "a", "sqlite3", messages)
    with pytest.raises(FormatError, match="no topic with poses") as caught:
        files.open_file(path)
    assert str(caught.value.hint).startswith("It has /chatter0 (std_msgs/msg/String), /chatter1 ")
    assert str(caught.value.hint).endswith(", and 2 more")
    with pytest.raises(FormatError, match="no topic with poses"):
        files.open_file(path / "a.db3")
    empty = ros_bags.write_bag(tmp_path / "empty", "sqlite3", [])
    with pytest.raises(FormatError, match="no topic with poses") as caught:
        files.open_file(empty)
    assert caught.value.hint == "It has no topics"


@pytest.mark.slow
@pytest.mark.parametrize("storage", STORAGES)
def test_damaged_bags_are_refused(tmp_path: Path, ros_bags: ModuleType, storage: str) -> None:
    """Cut anywhere and with any byte changed, a bag has poses or is refused in one line."""
    make = ros_bags.Messages(storage)
    path = ros_bags.write_bag(tmp_path / "drive", storage, poses(make, track(n=4)))
    [file] = [path] if path.is_file() else [each for each in path.iterdir() if "drive" in each.name]
    whole, random = file.read_bytes(), np.random.default_rng(1)
    for k in range(40):
        content = bytearray(whole)
        if k % 2:
            content[random.integers(len(content))] ^= 1 << random.integers(8)
        else:
            del content[random.integers(len(content)) :]
        file.write_bytes(content)
        for each in {path, file}:
            refused = None
            try:
                assert len(files.read(each)) == 1
            except LocatkError as error:
                refused = error
            assert refused is None or (refused.hint and "\n" not in str(refused))


@pytest.mark.parametrize(
    "text",
    ["", "rosbag2_bagfile_information: 3", "{", "rosbag2_bagfile_information: {version: 99}"],
)
def test_damaged_metadata_is_refused(tmp_path: Path, ros_bags: ModuleType, text: str) -> None:
    path = ros_bags.write_bag(tmp_path / "a", "sqlite3", poses(ros_bags.Messages(), track(n=2)))
    (path / "metadata.yaml").write_text(text)
    with pytest.raises(FormatError, match="not a bag that can be read"):
        files.read(path)


def test_damaged_messages_name_their_topic(tmp_path: Path, ros_bags: ModuleType) -> None:
    folder = ros_bags.write_bag(tmp_path / "a", "sqlite3", poses(ros_bags.Messages(), track(n=2)))
    with sqlite3.connect(folder / "a.db3") as database:
        database.execute("UPDATE messages SET data = x'0001000007' WHERE id = 2")
    database.close()
    with pytest.raises(FormatError, match="a message is no valid geometry_msgs/msg/PoseStamped"):
        files.read(folder)


def test_other_databases_and_compressed_files(tmp_path: Path) -> None:
    with sqlite3.connect(tmp_path / "a.db3") as database:
        database.execute("CREATE TABLE birds (name TEXT)")
    database.close()
    with pytest.raises(FormatError, match="not a bag that can be read"):
        files.read(tmp_path / "a.db3")
    (tmp_path / "b.db3.zstd").write_bytes(b"\x28\xb5\x2f\xfd rest")
    with pytest.raises(FormatError, match="a compressed file") as caught:
        files.read(tmp_path / "b.db3.zstd")
    assert caught.value.hint == "Unpack it: `unzstd`"


@pytest.mark.parametrize("storage", STORAGES)
def test_the_missing_extra_is_named(
    tmp_path: Path, ros_bags: ModuleType, storage: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    make = ros_bags.Messages(storage)
    path = ros_bags.write_bag(tmp_path / "a", storage, poses(make, track(n=2)))
    monkeypatch.setitem(sys.modules, "rosbags", None)
    for each in [path] if path.is_file() else [path, *path.glob("a.*")]:
        with pytest.raises(LocatkError, match="rosbags, which is not installed") as caught:
            files.read(each)
        assert caught.value.hint == 'Install it: pip install "locatk[ros]"'


def test_bags_have_no_onboard_poses(tmp_path: Path, ros_bags: ModuleType) -> None:
    path = ros_bags.write_bag(tmp_path / "a", "sqlite3", poses(ros_bags.Messages(), track(n=2)))
    with pytest.raises(InputError, match="only sessions have on-board poses"):
        files.read(path, role="onboard")
