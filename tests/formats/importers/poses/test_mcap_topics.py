"""Poses in MCAP files that other programs wrote."""

from __future__ import annotations

import contextlib
import json
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.timestamp_pb2 import Timestamp
from mcap.writer import Writer
from mcap_protobuf.writer import Writer as ProtobufWriter

from locatk.core.errors import FormatError, InputError, LocatkError
from locatk.core.trajectory import Trajectory
from locatk.formats.importers.poses import trajectories as files
from locatk.formats.sessions.writer import SessionWriter

START_NS = 1_700_000_000_123_456_789
TIME_NS = START_NS + 10_000_000 * np.arange(5)
POSITION = np.random.default_rng(2).normal(size=(5, 3))
QUATERNION = np.array([0.1, 0.5, -0.7, 0.5])


def stamp(time_ns: int) -> Timestamp:
    return Timestamp(seconds=time_ns // 10**9, nanos=time_ns % 10**9)


def pose(position: Any) -> Pose:
    x, y, z = position
    i, j, k, w = QUATERNION
    return Pose(position=Vector3(x=x, y=y, z=z), orientation=Quaternion(x=i, y=j, z=k, w=w))


def protobuf_messages() -> dict[str, list[Any]]:
    """Messages of each type, by topic, with the same poses."""
    messages: dict[str, list[Any]] = {"/a": [], "/b": [], "/c": [], "/tf": []}
    for time_ns, position in zip(TIME_NS.tolist(), POSITION.tolist(), strict=True):
        placed = pose(position)
        frame = {"timestamp": stamp(time_ns), "frame_id": "map"}
        transform = FrameTransform(
            timestamp=stamp(time_ns),
            parent_frame_id="map",
            child_frame_id="base",
            translation=placed.position,
            rotation=placed.orientation,
        )
        messages["/a"].append(PoseInFrame(pose=placed, **frame))
        messages["/b"].append(PosesInFrame(poses=[placed], **frame))
        messages["/c"].append(transform)
        messages["/tf"].append(FrameTransforms(transforms=[transform]))
    return messages


def write_protobuf(path: Path, messages: dict[str, list[Any]]) -> Path:
    with path.open("wb") as stream, ProtobufWriter(stream) as writer:
        for topic, each in messages.items():
            for message in each:
                writer.write_message(topic, message, START_NS + 10**9)
    return path


def write_json(path: Path, messages: dict[str, list[tuple[str, Any]]]) -> Path:
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        for topic, each in messages.items():
            schema = writer.register_schema(each[0][0], "jsonschema", b"{}")
            channel = writer.register_channel(topic, "json", schema)
            for _, message in each:
                data = json.dumps(message).encode()
                writer.add_message(channel, START_NS + 10**9, data, START_NS + 10**9)
        writer.finish()
    return path


def as_json(message: Any) -> tuple[str, Any]:
    """Type and fields of a message in the JSON of Foxglove, whose times are objects."""

    def fields(value: Any) -> Any:
        if isinstance(value, Timestamp):
            return {"sec": value.seconds, "nsec": value.nanos}
        if isinstance(value, Vector3 | Quaternion):
            return {name: getattr(value, name) for name in value.DESCRIPTOR.fields_by_name}
        if hasattr(value, "DESCRIPTOR"):
            return {name: fields(getattr(value, name)) for name in value.DESCRIPTOR.fields_by_name}
        return value if isinstance(value, str) else [fields(each) for each in value]

    return message.DESCRIPTOR.full_name, fields(message)


def assert_same(track: Trajectory) -> None:
    assert track.frame == "map"
    np.testing.assert_array_equal(track.time_ns, TIME_NS)
    np.testing.assert_array_equal(track.position, POSITION)
    np.testing.assert_array_equal(track.quaternion, np.tile(QUATERNION, (5, 1)))


@pytest.mark.parametrize("encoding", ["protobuf", "json"])
def test_messages_of_foxglove(tmp_path: Path, encoding: str) -> None:
    messages = protobuf_messages()
    if encoding == "json":
        texts = {topic: [as_json(each) for each in some] for topic, some in messages.items()}
        path = write_json(tmp_path / "a.mcap", texts)
    else:
        path = write_protobuf(tmp_path / "a.mcap", messages)
    found = files.open_file(path)
    assert (found.kind, found.solved, found.notes) == ("mcap", True, ())
    assert [each.device for each in found.trajectories] == ["/a", "/b", "/c", "/tf:map.base"]
    for each in found.trajectories:
        assert_same(each)


def test_foxglove_needs_no_rosbags(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rosbags", None)
    assert len(files.read(write_protobuf(tmp_path / "a.mcap", protobuf_messages()))) == 4


def test_several_poses_of_one_time_are_no_trajectory(tmp_path: Path) -> None:
    poses = [pose(position) for position in POSITION.tolist()]
    messages = {"/path": [PosesInFrame(timestamp=stamp(START_NS), frame_id="map", poses=poses)]}
    with pytest.raises(FormatError, match="no usable poses") as caught:
        files.read(write_protobuf(tmp_path / "a.mcap", messages))
    assert caught.value.hint == "/path: 5 of 5 poses left out (several poses of one time)"


def test_topics_with_names_of_locatk_are_read_as_before(tmp_path: Path) -> None:
    """Their poses are those of a device, and there can be truth beside them."""
    a = protobuf_messages()["/a"]
    path = write_protobuf(tmp_path / "a.mcap", {"/pose/red": a, "/truth/red": a[:3], "/odom": a})
    estimate, truth = files.open_file(path), files.open_file(path, role="truth")
    assert [each.device for each in estimate.trajectories] == ["red"]
    assert (len(estimate.trajectories[0]), len(truth.trajectories[0])) == (5, 3)
    [odom] = files.read(Path(f"{path}#/odom"))
    assert_same(odom)


def test_poses_of_another_solver_are_truth(tmp_path: Path) -> None:
    path = write_protobuf(tmp_path / "a.mcap", {"/pose/red": protobuf_messages()["/a"]})
    [truth] = files.read(path, role="truth")
    assert truth.device == "red"
    assert_same(truth)


@pytest.mark.parametrize("data", [b"{", b"[1]", b'{"timestamp": 3}', b'{"a":' * 9999, b"\xff"])
def test_damaged_json_names_its_topic(tmp_path: Path, data: bytes) -> None:
    with (tmp_path / "a.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema("foxglove.PoseInFrame", "jsonschema", b"{}")
        channel = writer.register_channel("/a", "json", schema)
        writer.add_message(channel, START_NS, data, START_NS)
        writer.finish()
    with pytest.raises(FormatError, match=r"/a: a message is no valid foxglove\.PoseInFrame"):
        files.read(tmp_path / "a.mcap")


@pytest.mark.parametrize("number", ['"x"', "null", "1e999", "[]", "1e18"])
def test_json_with_other_values(tmp_path: Path, number: str) -> None:
    name, message = as_json(protobuf_messages()["/a"][0])
    for part, key in ((message["timestamp"], "sec"), (message["pose"]["position"], "x")):
        before, part[key] = part[key], json.loads(number)
        with (
            pytest.raises(FormatError)
            if key == "sec" or number != "1e18"
            else contextlib.nullcontext()
        ):
            files.read(write_json(tmp_path / "a.mcap", {"/a": [(name, message)]}))
        part[key] = before


def test_damaged_protobuf_names_its_topic(tmp_path: Path) -> None:
    with (tmp_path / "a.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema("foxglove.PoseInFrame", "protobuf", b"")
        channel = writer.register_channel("/a", "protobuf", schema)
        writer.add_message(channel, START_NS, b"\xff\xff", START_NS)
        writer.finish()
    with pytest.raises(FormatError, match=r"/a: a message is no valid foxglove\.PoseInFrame"):
        files.read(tmp_path / "a.mcap")


def test_messages_of_ros_and_foxglove_in_one_file(tmp_path: Path, ros_bags: ModuleType) -> None:
    """As Foxglove's own recorder writes it: no profile."""
    make, store = ros_bags.Messages(), ros_bags.ROS2
    with (tmp_path / "a.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        for topic, encoding, kind in (
            ("/ros", "cdr", "geometry_msgs/msg/PoseStamped"),
            ("/foxglove", "protobuf", "foxglove.PoseInFrame"),
        ):
            channel = writer.register_channel(
                topic, encoding, writer.register_schema(kind, "", b"")
            )
            for k, message in enumerate(protobuf_messages()["/a"]):
                data = message.SerializeToString()
                if encoding == "cdr":
                    ros = make.pose_stamped(TIME_NS[k], "map", POSITION[k], QUATERNION)
                    data = bytes(store.serialize_cdr(ros, kind))
                writer.add_message(channel, START_NS, data, START_NS)
        writer.finish()
    for track in files.read(tmp_path / "a.mcap"):
        assert_same(track)


def test_messages_of_ros1_in_mcap(tmp_path: Path, ros_bags: ModuleType) -> None:
    """As `mcap convert` writes them."""
    make, store = ros_bags.Messages("ros1"), ros_bags.ROS1
    with (tmp_path / "a.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros1")
        schema = writer.register_schema("geometry_msgs/PoseStamped", "ros1msg", b"")
        channel = writer.register_channel("/a", "ros1", schema)
        for time_ns, position in zip(TIME_NS.tolist(), POSITION, strict=True):
            message = make.pose_stamped(time_ns, "map", position, QUATERNION)
            data = bytes(store.serialize_ros1(message, message.__msgtype__))
            writer.add_message(channel, START_NS, data, START_NS)
        writer.finish()
    assert_same(files.read(tmp_path / "a.mcap")[0])


def test_files_without_poses_list_their_topics(tmp_path: Path) -> None:
    path = write_json(tmp_path / "a.mcap", {"/log": [("foxglove.Log", {})]})
    with pytest.raises(FormatError, match="no topic with poses") as caught:
        files.read(path)
    assert caught.value.hint == "It has /log (foxglove.Log)"
    with pytest.raises(FormatError, match="no topic with poses"):
        files.read(path, role="truth")
    with pytest.raises(FormatError, match="no on-board poses"):
        files.read(path, role="onboard")


def test_sessions_of_locatk_without_truth_have_their_own_error(tmp_path: Path) -> None:
    with SessionWriter(tmp_path / "run.mcap", system="lighthouse"):
        pass
    with pytest.raises(FormatError, match="no reference poses"):
        files.read(tmp_path / "run.mcap", role="truth")
    with pytest.raises(FormatError, match="no reference poses"):
        files.read(tmp_path / "run.mcap")


def test_cut_files_can_be_recovered(tmp_path: Path, locatk: Any) -> None:
    path = write_protobuf(tmp_path / "a.mcap", protobuf_messages())
    content = path.read_bytes()
    path.write_bytes(content[: len(content) - 100])
    with pytest.raises(FormatError, match="cut short") as caught:
        files.read(path)
    assert "locatk recover" in str(caught.value.hint)
    whole = tmp_path / "whole.mcap"
    assert locatk("recover", path, "-o", whole).exit_code in (0, 3)
    assert len(files.read(whole)) == 4


def test_unknown_topics_are_errors(tmp_path: Path) -> None:
    path = write_protobuf(tmp_path / "a.mcap", protobuf_messages())
    with pytest.raises(InputError, match="no topic '/d' with poses") as caught:
        files.read(Path(f"{path}#/d"))
    assert caught.value.hint == "It has /a, /b, /c, /tf"
    assert isinstance(caught.value, LocatkError)
