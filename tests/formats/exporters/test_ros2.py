"""Export of poses as a ROS 2 bag, read with rosbags and evo."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import subprocess
from pathlib import Path

import mcap.reader
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from locatk.core.errors import InputError, OutputExistsError
from locatk.core.geometry import quaternion_from_matrix, rotation_exp
from locatk.core.trajectory import Trajectory
from locatk.formats.exporters.ros2 import UNKNOWN_VARIANCE, known_covariance, ros_names, write_ros2
from locatk.formats.exporters.tum import write_tum

START_NS = 1_700_000_000_123_456_789


def track(device: str = "robot", frame: str = "floor", n: int = 50, seed: int = 3) -> Trajectory:
    """A path through space, turned all ways, with a covariance that has correlations."""
    random = np.random.default_rng(seed)
    step_ns = random.integers(1_000_000, 30_000_000, n)
    matrices = rotation_exp(random.normal(size=(n, 3)))
    factor = random.normal(size=(n, 6, 6)) * 1e-3
    return Trajectory(
        device,
        frame,
        START_NS + np.cumsum(step_ns),
        np.cumsum(random.normal(size=(n, 3)), axis=0) * 0.01,
        quaternion_from_matrix(matrices),
        factor @ factor.transpose(0, 2, 1),
    )


def read(path: Path) -> dict[str, list[tuple[int, object]]]:
    """Topic to (log time, message), as rosbags reads them by the definitions in the file."""
    rosbags = pytest.importorskip("rosbags.highlevel", reason="rosbags is not installed")
    found: dict[str, list[tuple[int, object]]] = {}
    with rosbags.AnyReader([path]) as reader:
        for connection, time_ns, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            found.setdefault(connection.topic, []).append((time_ns, message))
    return found


def stamp_ns(header: object) -> int:
    stamp = header.stamp  # type: ignore[attr-defined]
    return stamp.sec * 1_000_000_000 + stamp.nanosec


def numbers(part: object, names: str) -> list[float]:
    return [getattr(part, name) for name in names]


@pytest.mark.slow
def test_rosbags_reads_the_export(tmp_path: Path) -> None:
    path, red, blue = tmp_path / "poses.mcap", track("red"), track("lab/blue", "map", seed=4)
    write_ros2(path, [red, blue], covariance=True)
    found = read(path)
    assert set(found) == {
        "/pose/red",
        "/pose/lab_blue",
        "/pose_with_covariance/red",
        "/pose_with_covariance/lab_blue",
        "/tf",
    }
    for name, each in (("red", red), ("lab_blue", blue)):
        times, messages = zip(*found[f"/pose/{name}"], strict=True)
        assert list(times) == each.time_ns.tolist()
        assert [stamp_ns(m.header) for m in messages] == each.time_ns.tolist()
        assert {m.header.frame_id for m in messages} == {each.frame}
        position = [numbers(m.pose.position, "xyz") for m in messages]
        orientation = [numbers(m.pose.orientation, "xyzw") for m in messages]
        assert np.array_equal(position, each.position)
        assert np.array_equal(orientation, each.quaternion)

        wide = [message for _, message in found[f"/pose_with_covariance/{name}"]]
        assert [stamp_ns(m.header) for m in wide] == each.time_ns.tolist()
        assert [numbers(m.pose.pose.position, "xyz") for m in wide] == position
        covariance = np.array([m.pose.covariance for m in wide]).reshape(-1, 6, 6)
        assert np.array_equal(covariance, each.covariance)

        moves = [m.transforms[0] for _, m in found["/tf"]]
        mine = [t for t in moves if t.child_frame_id == each.device]
        assert [stamp_ns(t.header) for t in mine] == each.time_ns.tolist()
        assert {t.header.frame_id for t in mine} == {each.frame}
        assert [numbers(t.transform.translation, "xyz") for t in mine] == position
        assert [numbers(t.transform.rotation, "xyzw") for t in mine] == orientation
    assert all(len(m.transforms) == 1 for _, m in found["/tf"])


@pytest.mark.slow
@settings(deadline=None, max_examples=40)  # the first call imports rosbags
@given(st.text(min_size=1, max_size=9), st.text(min_size=1, max_size=9))
def test_strings_of_any_length_are_aligned(device: str, frame: str) -> None:
    """The numbers stand at multiples of eight whatever is in front of them."""
    stores = pytest.importorskip("rosbags.typesys", reason="rosbags is not installed")
    from locatk.formats.exporters import ros2

    store = stores.get_typestore(stores.Stores.ROS2_HUMBLE)
    if any(0xD800 <= ord(c) < 0xE000 or c == "\0" for c in device + frame):
        return  # cannot be said in UTF-8, or ends a string
    each = track(device, frame, n=2)
    [_, transform] = [
        store.deserialize_cdr(raw, "tf2_msgs/msg/TFMessage").transforms[0]
        for raw in ros2.transforms(each)
    ]
    assert transform.header.frame_id == frame
    assert transform.child_frame_id == (device if device != frame else f"{device}_body")
    assert numbers(transform.transform.rotation, "xyzw") == each.quaternion[1].tolist()
    raw = ros2.pose_stamped(each)[1]
    assert store.serialize_cdr(
        store.deserialize_cdr(raw, "geometry_msgs/msg/PoseStamped"), "geometry_msgs/msg/PoseStamped"
    ) == memoryview(raw)


def test_the_file_follows_the_profile_of_rosbag2(tmp_path: Path) -> None:
    """Profile, encodings, complete definitions, the key for QoS; the stock reader."""
    path = tmp_path / "poses.mcap"
    write_ros2(path, [track("red"), track("blue")], facts={"system": "dots"}, covariance=True)
    with path.open("rb") as stream:
        reader = mcap.reader.make_reader(stream)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == 300
        for channel in summary.channels.values():
            assert channel.message_encoding == "cdr"
            assert channel.metadata == {"offered_qos_profiles": "[]"}
        for schema in summary.schemas.values():
            assert schema.encoding == "ros2msg"
            assert re.fullmatch(r"\w+/msg/\w+", schema.name)
        [record] = list(reader.iter_metadata())
        assert record.name == "locatk_export"
        assert record.metadata["system"] == "dots"
        log_times = [message.log_time for _, _, message in reader.iter_messages()]
        in_file = [m.log_time for *_, m in reader.iter_messages(log_time_order=False)]
    assert in_file == sorted(log_times)  # a player needs little memory


def test_definitions_are_those_of_ros() -> None:
    """But for comments, as rosbags has them from the distributions."""
    stores = pytest.importorskip("rosbags.typesys", reason="rosbags is not installed")
    from locatk.formats.exporters import ros2

    store = stores.get_typestore(stores.Stores.ROS2_HUMBLE)
    for message in ros2._DEFINITIONS:
        theirs, _ = store.generate_msgdef(message, ros_version=2)
        assert sections(ros2._definition(message)) == sections(theirs)


def sections(definition: str) -> set[str]:
    return {part.strip() for part in definition.split("=" * 80)}


def test_unobserved_quantities_have_a_large_variance() -> None:
    covariance = np.full((2, 6, 6), np.nan)
    covariance[0, :2, :2] = [[4e-6, 1e-6], [1e-6, 9e-6]]
    filled = known_covariance(covariance)
    unknown = np.diag([0.0, 0.0, *[UNKNOWN_VARIANCE] * 4])
    unknown[:2, :2] = covariance[0, :2, :2]
    assert np.array_equal(filled[0], unknown)
    assert np.array_equal(filled[1], np.eye(6) * UNKNOWN_VARIANCE)
    assert (np.linalg.eigvalsh(filled) > 0).all()
    assert np.isnan(covariance[1]).all()  # the caller's stays as it was


@settings(max_examples=50, deadline=None)
@given(st.lists(st.text(max_size=12), max_size=5, unique=True))
def test_names_are_valid_in_ros(devices: list[str]) -> None:
    names: list[str] = []
    with contextlib.suppress(InputError):  # two are the same
        names = ros_names(devices)
    if not names:
        devices = []
    assert len(set(names)) == len(devices)
    for name in names:
        assert re.fullmatch(r"[A-Za-z][0-9A-Za-z]*(_[0-9A-Za-z]+)*", name), name


def test_valid_names_are_kept() -> None:
    assert ros_names(["kiwi", "robot_2", "B7"]) == ["kiwi", "robot_2", "B7"]
    with pytest.raises(InputError, match="'a b' and 'a/b' have the same name in ROS, 'a_b'"):
        ros_names(["a b", "a/b"])


def test_poses_that_ros_cannot_represent_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "poses.mcap"
    good = track()
    for change, words in (
        ({"time_ns": good.time_ns - START_NS - 10**12}, "1970"),
        ({"time_ns": good.time_ns + 2**31 * 10**9}, "2038"),
        ({"frame": ""}, "frame without a name"),
        ({"position": np.where(good.position > 0, np.inf, 0.0)}, "not numbers"),
    ):
        with pytest.raises(InputError, match=words):
            write_ros2(path, [Trajectory(**{**vars(good), **change})])
        assert not path.exists()
    write_ros2(path, [good])
    before = path.read_bytes()
    with pytest.raises(OutputExistsError):
        write_ros2(path, [good])
    assert path.read_bytes() == before
    write_ros2(path, [], overwrite=True)
    assert read(path) == {}


def evo(*arguments: object, cwd: Path) -> str:
    """What a command of evo prints; the test is skipped where there is no evo."""
    name, *rest = map(str, arguments)
    folder = os.environ.get("LOCATK_EVO")
    program = shutil.which(name, path=folder) if folder else shutil.which(name)
    if program is None:
        pytest.skip("evo is not installed (see LOCATK_EVO)")
    home = {**os.environ, "HOME": str(cwd), "MPLBACKEND": "Agg"}
    done = subprocess.run(
        [program, *rest], cwd=cwd, env=home, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_evo_reads_it(tmp_path: Path) -> None:
    """`evo_traj mcap` finds each device once, and its poses are those of the TUM file."""
    red, blue = track("red", n=200), track("blue", n=100, seed=5)
    write_ros2(tmp_path / "poses.mcap", [red, blue])
    said = evo("evo_traj", "mcap", "poses.mcap", "--all_topics", "--save_as_tum", cwd=tmp_path)
    assert re.findall(r"name:\s*(\S+)", said) == ["/pose/blue", "/pose/red"]
    for each in (red, blue):
        [saved] = [path for path in tmp_path.rglob("*.tum") if each.device in path.name]
        rows = np.loadtxt(saved)
        assert np.allclose(rows[:, 0], each.time_ns * 1e-9, rtol=0, atol=1e-6)
        assert np.allclose(rows[:, 1:4], each.position, rtol=0, atol=1e-8)
        assert np.allclose(rows[:, 4:], each.quaternion, rtol=0, atol=1e-8)


def test_evo_compares_it(tmp_path: Path) -> None:
    """`evo_ape mcap` between two topics says the same as `evo_ape tum` on the TUM files."""
    truth = track("truth", n=120)
    shifted = truth.position + np.array([0.003, 0.004, 0.0])
    estimate = Trajectory(**{**vars(truth), "device": "estimate", "position": shifted})
    write_ros2(tmp_path / "poses.mcap", [truth, estimate])
    bag = evo("evo_ape", "mcap", "poses.mcap", "/pose/truth", "/pose/estimate", cwd=tmp_path)
    for each in (truth, estimate):
        write_tum(tmp_path / f"{each.device}.tum", each)
    tum = evo("evo_ape", "tum", "truth.tum", "estimate.tum", cwd=tmp_path)
    [rmse] = re.findall(r"rmse\s+(\S+)", bag)
    assert float(rmse) == pytest.approx(0.005, abs=1e-6)
    assert re.findall(r"(\w+)\t([\d.]+)", bag) == re.findall(r"(\w+)\t([\d.]+)", tum)
