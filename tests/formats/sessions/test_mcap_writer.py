"""Writer of many messages at a time: the bytes of the mcap library, and the order of streams."""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.message import Message
from mcap.writer import CompressionType, Writer

from locatk.core.errors import InputError
from locatk.core.trajectory import Trajectory
from locatk.formats.schemas.poses_pb2 import PoseTrack
from locatk.formats.sessions import foxglove, trajectories
from locatk.formats.sessions.mcap_writer import MAX_CHUNK_BYTES, McapWriter
from locatk.formats.sessions.messages import MessageBatch, timestamp
from locatk.formats.sessions.reader import Session
from locatk.formats.sessions.trajectories import track_messages, write_streams
from locatk.formats.sessions.writer import SessionWriter


class FailingStream(io.BytesIO):
    """File on a disk that has no space for one of the writes."""

    is_full = False

    def write(self, data: bytes) -> int:  # type: ignore[override]
        if self.is_full:
            raise OSError(28, "No space left on device")
        return super().write(data)


@pytest.mark.parametrize("at_once", [1, 7, 10_000])
@pytest.mark.parametrize("sizes", [(0, 4000), (993, 994)])
def test_bytes_are_those_of_the_library(at_once: int, sizes: tuple[int, int]) -> None:
    """Chunks end at the same messages, however many are given at a time.

    Messages of 993 bytes fill a chunk exactly.
    """
    rng = np.random.default_rng(0)
    ours, theirs = io.BytesIO(), io.BytesIO()
    library = Writer(theirs, compression=CompressionType.ZSTD)
    library.start(profile="p", library="l")
    writer = McapWriter(ours, profile="p", library="l")
    for each in (library, writer):
        each.register_schema("s", "protobuf", b"schema")
        for topic in ("/a", "/b", "/c"):
            each.register_channel(topic, "protobuf", 1)
    library.add_metadata("m", {"k": "v"})
    writer.add_metadata("m", {"k": "v"})
    count = 4000
    channel = rng.integers(1, 4, count)
    time_ns = np.sort(rng.integers(0, 10**18, count))
    payloads = [rng.bytes(size) for size in rng.integers(*sizes, count).tolist()]
    assert sum(map(len, payloads)) > 3 * MAX_CHUNK_BYTES
    sequence = {1: 0, 2: 0, 3: 0}
    for number, time, payload in zip(channel.tolist(), time_ns.tolist(), payloads, strict=True):
        library.add_message(number, time, payload, time, sequence[number])
        sequence[number] += 1
    for start in range(0, count, at_once):
        part = slice(start, start + at_once)
        writer.add_messages(channel[part], time_ns[part], payloads[part])
    library.add_message(2, 10**18, b"last", 5, sequence[2])
    writer.add_message(2, 10**18, b"last", 5)
    library.add_attachment(3, 3, "a.txt", "text/plain", b"content")
    writer.add_attachment(3, "a.txt", "text/plain", b"content")
    library.finish()
    writer.finish()
    assert ours.getvalue() == theirs.getvalue()


def test_a_file_without_messages_is_that_of_the_library() -> None:
    ours, theirs = io.BytesIO(), io.BytesIO()
    library = Writer(theirs)
    library.start(profile="", library="l")
    library.finish()
    McapWriter(ours, profile="", library="l").finish()
    assert ours.getvalue() == theirs.getvalue()


def test_a_chunk_that_the_disk_refused_is_not_counted(tmp_path: Path) -> None:
    stream = FailingStream()
    writer = McapWriter(stream, profile="locatk", library="l")
    schema = writer.register_schema("s", "protobuf", b"")
    channel = writer.register_channel("/a", "protobuf", schema)
    writer.add_message(channel, 1, b"kept", 1)
    writer.flush()
    writer.add_message(channel, 2, b"lost", 2)
    stream.is_full = True
    with pytest.raises(OSError, match="No space"):
        writer.flush()
    stream.is_full = False
    writer.add_message(channel, 3, b"kept too", 3)
    writer.finish()
    path = tmp_path / "run.mcap"
    path.write_bytes(stream.getvalue())
    assert [data for _, _, data in Session.open(path).messages()] == [b"kept", b"kept too"]


# ---- encoding


def varied_trajectory(frame: str = "floor") -> Trajectory:
    """Poses with all lengths of numbers: left out, short and long."""
    rng = np.random.default_rng(1)
    time_ns = np.sort(
        np.concatenate(
            [
                [0, 1, 127, 128, 10**9 - 1, 10**9, 2**31 * 10**9, 2**62],
                rng.integers(0, 2 ** rng.integers(1, 62, 3000)),
            ]
        )
    )
    n = len(time_ns)
    values = rng.choice([0.0, -0.0, 1.0, np.nan, -np.inf, 1e-300], (n, 7))
    values[rng.random(values.shape) < 0.5] = rng.normal()
    return Trajectory("R", frame, time_ns, values[:, :3], values[:, 3:], np.full((n, 6, 6), np.nan))


def protobuf_poses(trajectory: Trajectory) -> Iterator[tuple[int, Pose]]:
    rows = zip(trajectory.time_ns, trajectory.position, trajectory.quaternion, strict=True)
    for time_ns, (x, y, z), (qx, qy, qz, qw) in rows:
        orientation = Quaternion(x=qx, y=qy, z=qz, w=qw)
        yield int(time_ns), Pose(position=Vector3(x=x, y=y, z=z), orientation=orientation)


@pytest.mark.parametrize("frame", ["floor", "", "frame " * 50, "Boden ü"])
def test_poses_are_encoded_as_by_protobuf(frame: str) -> None:
    each = varied_trajectory(frame)
    poses, transforms = [], []
    for time_ns, pose in protobuf_poses(each):
        stamp = timestamp(time_ns)
        poses.append(PoseInFrame(timestamp=stamp, frame_id=frame, pose=pose))
        transforms.append(
            FrameTransform(
                timestamp=stamp,
                parent_frame_id=frame,
                child_frame_id="R",
                translation=pose.position,
                rotation=pose.orientation,
            )
        )
    for function, expected in ((foxglove.poses, poses), (foxglove.transforms, transforms)):
        batches = list(function("/topic", each))
        assert np.array_equal(np.concatenate([b.time_ns for b in batches]), each.time_ns)
        payloads = [payload for batch in batches for payload in batch.payloads]
        assert payloads == [message.SerializeToString() for message in expected]


def test_a_path_is_encoded_as_by_protobuf() -> None:
    each = varied_trajectory()
    poses = [pose for _, pose in protobuf_poses(each)]
    expected = PosesInFrame(timestamp=timestamp(5), frame_id="floor", poses=poses)
    assert foxglove.path(each, 5).SerializeToString() == expected.SerializeToString()


def test_a_batch_is_encoded_as_by_protobuf() -> None:
    each = varied_trajectory()
    (first, *_) = track_messages("/solution/R", each)
    expected = PoseTrack(
        timestamp=timestamp(int(each.time_ns[0])),
        device="R",
        frame_id="floor",
        time_ns=each.time_ns[:1024].tolist(),
        position_m=each.position[:1024].ravel().tolist(),
        quaternion_xyzw=each.quaternion[:1024].ravel().tolist(),
    )
    assert list(first.payloads) == [expected.SerializeToString()]


# ---- order


def log_stream(topic: str, times: list[list[int]]) -> Iterator[MessageBatch]:
    """Yield a batch of messages for each list of times."""
    for part in times:
        payloads = [Log(message=f"{topic} {time_ns}").SerializeToString() for time_ns in part]
        yield MessageBatch(topic, Log, np.array(part), payloads)


@pytest.mark.parametrize("buffered_bytes", [1, 100, 1 << 20])
def test_streams_are_written_in_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, buffered_bytes: int
) -> None:
    """Nothing is lost, and times ascend, however little is taken from the streams at a time."""
    monkeypatch.setattr(trajectories, "MAX_BUFFERED_BYTES", buffered_bytes)
    rng = np.random.default_rng(2)
    streams = {}
    for name in "abcde":
        times = np.sort(rng.integers(0, 300, 400))
        cuts = np.sort(rng.integers(1, 400, 20))
        streams[f"/{name}"] = [p.tolist() for p in np.split(times, np.unique(cuts))]
    streams["/late"] = [[290, 290], [290, 400]]
    streams["/none"] = []
    path = tmp_path / "run.mcap"
    with SessionWriter(path, system="lighthouse") as writer:
        end_ns = write_streams(writer, [log_stream(t, parts) for t, parts in streams.items()])
    assert end_ns == 400
    session = Session.open(path)
    messages = list(session.messages())
    assert [time_ns for _, time_ns, _ in messages] == sorted(t for _, t, _ in messages)
    for topic, parts in streams.items():
        own = [time_ns for each, time_ns, _ in messages if each == topic]
        assert own == [time_ns for part in parts for time_ns in part]
    assert all(Log.FromString(data).message == f"{t} {time}" for t, time, data in messages)


def test_streams_are_read_as_needed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A long stream is never in memory as a whole."""
    monkeypatch.setattr(trajectories, "MAX_BUFFERED_BYTES", 10_000)
    taken, written = [], []

    def endless(topic: str) -> Iterator[MessageBatch]:
        for time_ns in range(0, 3000, 10):
            taken.append(time_ns)
            assert len(taken) - len(written) / 10 < 150
            yield from log_stream(topic, [list(range(time_ns, time_ns + 10))])

    class Counter(SessionWriter):
        def write_batches(self, batches: list[MessageBatch]) -> None:  # type: ignore[override]
            written.extend(time_ns for batch in batches for time_ns in batch.time_ns)
            super().write_batches(batches)

    with Counter(tmp_path / "run.mcap", system="lighthouse") as writer:
        write_streams(writer, [endless("/a"), endless("/b")])
    assert len(written) == 6000


def test_a_time_before_1970_is_refused(tmp_path: Path) -> None:
    message: Message = Log(message="old")
    batch = MessageBatch.single(-1, "/log", message)
    with (
        pytest.raises(InputError, match="not in the range"),
        SessionWriter(tmp_path / "run.mcap", system="lighthouse") as writer,
    ):
        writer.write_batches([batch])
