"""Observations and solutions: exact round trips, and files that other tools read."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import mcap.reader
import mcap.writer
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from mcap_protobuf.decoder import DecoderFactory

from locatk.core.errors import FormatError, InputError, OutputExistsError
from locatk.core.lighthouse.calibration import Calibration
from locatk.core.lighthouse.recording import Sweeps
from locatk.core.lighthouse.results import LighthouseFacts, StationDetection
from locatk.core.lighthouse.scene import Marker, Scene, Station
from locatk.core.solution import Solution, SolverWarning
from locatk.core.trajectory import Trajectory
from locatk.formats.schemas.lighthouse_pb2 import LighthouseSweep
from locatk.formats.sessions import observations
from locatk.formats.sessions.messages import SWEEPS, BatchError
from locatk.formats.sessions.reader import Session
from locatk.formats.sessions.writer import SessionWriter

FIELDS = ("time_ns", "sensor", "channel", "polynomial", "sweep", "count")
START = 1_690_000_000_000_000_000


def make_sweeps(n: int, seed: int = 0, devices: tuple[str, ...] = ("R", "G")) -> Sweeps:
    rng = np.random.default_rng(seed)

    def draw(low: int, high: int) -> np.ndarray:
        return rng.integers(low, high, n, endpoint=True).astype(np.int32)

    return Sweeps(
        devices=devices,
        time_ns=START + rng.integers(0, n * 5_000_000, n),
        device=draw(0, len(devices) - 1),
        sensor=draw(0, 3),
        channel=draw(1, 16),
        polynomial=draw(-1, 31),
        sweep=draw(-1, 1),
        count=rng.uniform(0, 1e5, n),
    )


def rows(sweeps: Sweeps) -> list[tuple[object, ...]]:
    """Sweeps as a sorted list: their order in a file is free."""
    names = [sweeps.devices[number] for number in sweeps.device]
    columns = (getattr(sweeps, name).tolist() for name in FIELDS)
    return sorted(zip(names, *columns, strict=True))


def make_trajectory(n: int, device: str = "R", seed: int = 0) -> Trajectory:
    rng = np.random.default_rng(seed)
    quaternion = rng.normal(size=(n, 4))
    half = rng.normal(size=(n, 6, 6))
    covariance = half + half.transpose(0, 2, 1)
    covariance[: n // 2, 3:] = np.nan
    covariance[: n // 2, :, 3:] = np.nan
    return Trajectory(
        device,
        "floor",
        START + np.cumsum(rng.integers(1, 10**8, n)),
        rng.normal(size=(n, 3)),
        quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True),
        covariance,
    )


def same(a: Trajectory, b: Trajectory, *, covariance: bool = True) -> None:
    assert (a.device, a.frame) == (b.device, b.frame)
    for name in ("time_ns", "position", "quaternion") + (("covariance",) if covariance else ()):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), strict=True)


SCENE = Scene(
    stations=(
        Station(
            1,
            np.array([0.1, 0.2, 2.3]),
            np.eye(3),
            Calibration(np.ones((2, 7)), "factory"),
            0x4CC60647,
            np.eye(6) * 1e-6,
        ),
        Station(
            16,
            np.array([1.0, 0.0, 1.0]),
            np.eye(3)[[1, 2, 0]],
            Calibration(np.zeros((2, 7)), "generic"),
        ),
    ),
    markers=(Marker("tl", np.array([0.4, 0.6, 0.0])),),
    planar=True,
    scale="markers",
)


# ---- sweeps


@pytest.mark.slow
@pytest.mark.parametrize("n", [0, 1, 5000])
@pytest.mark.parametrize("batch_ns", [1, 20_000_000, 10**15])
def test_sweeps_round_trip(tmp_path: Path, n: int, batch_ns: int) -> None:
    sweeps = make_sweeps(n)
    path = tmp_path / "run.mcap"
    with SessionWriter(path, system="lighthouse") as writer:
        observations.write_sweeps(writer, sweeps, batch_ns=batch_ns)
    session = Session.open(path)
    if n == 0:
        assert session.channels == ()
        return
    back = observations.read_sweeps(session)
    assert rows(back) == rows(sweeps)
    for name, dtype in (("time_ns", np.int64), ("channel", np.int32), ("count", np.float64)):
        assert getattr(back, name).dtype == dtype
    times = [time_ns for _, time_ns, _ in session.messages()]
    assert times == sorted(times)


def test_batches_are_bounded_in_time_and_number() -> None:
    sweeps = make_sweeps(5000)
    for batch_ns, most in ((20_000_000, 1024), (10**15, 1024)):
        for time_ns, topic, message in sweep_messages(sweeps, batch_ns):
            assert topic == f"/lighthouse/{message.device}"
            assert 1 <= len(message.time_ns) <= most
            assert list(message.time_ns) == sorted(message.time_ns)
            assert message.time_ns[0] == time_ns
            assert message.time_ns[-1] - time_ns < batch_ns
            assert message.timestamp.ToNanoseconds() == time_ns
    assert len(sweep_messages(sweeps, batch_ns=10**15)) < 10


def sweep_messages(sweeps: Sweeps, batch_ns: int) -> list[tuple[int, str, LighthouseSweep]]:
    return [
        (time_ns, batch.topic, LighthouseSweep.FromString(payload))
        for stream in observations.sweep_messages(sweeps, batch_ns=batch_ns)
        for batch in stream
        for time_ns, payload in zip(batch.time_ns.tolist(), batch.payloads, strict=True)
    ]


@pytest.mark.slow
@settings(max_examples=20, deadline=None)
@given(data=st.data(), n=st.integers(1, 60), batch_ns=st.integers(1, 10**10))
def test_sweeps_of_any_values_are_restored(data: st.DataObject, n: int, batch_ns: int) -> None:
    def draw(dtype: type, elements: st.SearchStrategy[int | float]) -> np.ndarray:
        return data.draw(hnp.arrays(dtype, n, elements=elements))

    names = st.lists(st.text(min_size=1, max_size=5), min_size=1, max_size=3, unique=True)
    devices = tuple(data.draw(names))
    sweeps = Sweeps(
        devices=devices,
        time_ns=draw(np.int64, st.integers(0, 2**63 - 1)),
        device=draw(np.int32, st.integers(0, len(devices) - 1)),
        sensor=draw(np.int32, st.integers(0, 2**31 - 1)),
        channel=draw(np.int32, st.integers(1, 16)),
        polynomial=draw(np.int32, st.integers(-1, 31)),
        sweep=draw(np.int32, st.integers(-1, 1)),
        count=draw(np.float64, st.floats(allow_nan=False)),
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "run.mcap")
        with SessionWriter(path, system="lighthouse") as writer:
            observations.write_sweeps(writer, sweeps, batch_ns=batch_ns)
        assert rows(observations.read_sweeps(Session.open(path))) == rows(sweeps)


@settings(max_examples=12, deadline=None)
@given(
    st.integers(0, 5).flatmap(
        lambda n: st.tuples(
            *(st.lists(st.integers(0, 2**31 - 1), min_size=n, max_size=n) for _ in range(3))
        )
    )
)
def test_every_encoding_of_protobuf_is_read(values: tuple[list[int], ...]) -> None:
    """Unpacked, in pieces, in another order, with fields of a later version."""
    times, sensors, channels = values
    n = len(times)
    plain = LighthouseSweep(
        device="R",
        time_ns=times,
        sensor=sensors,
        channel=channels,
        polynomial=[-1] * n,
        sweep=[0] * n,
        count=[0.5] * n,
    ).SerializeToString()
    unpacked = b"".join(b"\x19" + value.to_bytes(8, "little") for value in times)
    rest = LighthouseSweep(
        device="R",
        sensor=sensors,
        channel=channels,
        polynomial=[-1] * n,
        sweep=[0] * n,
        count=[0.5] * n,
    ).SerializeToString()
    later = b"\x7a\x03abc" + b"\x80\x01\x05"
    pieces = b"".join(LighthouseSweep(time_ns=[value]).SerializeToString() for value in times)
    forms = [
        plain,
        pieces + rest,
        rest + pieces,
        unpacked + rest,
        rest + unpacked,
        later + plain,
        plain + later,
    ]
    batches = SWEEPS.unpack(forms)
    assert batches.counts.tolist() == [n] * len(forms)
    assert batches.texts["device"] == ["R"] * len(forms)
    assert batches.columns["time_ns"].tolist() == times * len(forms)
    assert batches.columns["sensor"].tolist() == sensors * len(forms)
    assert batches.columns["polynomial"].tolist() == [-1] * n * len(forms)
    assert batches.columns["count"].tolist() == [0.5] * n * len(forms)


@settings(max_examples=20, deadline=None)
@given(st.binary(max_size=200))
def test_garbage_is_a_batch_or_an_error(payload: bytes) -> None:
    try:
        batches = SWEEPS.unpack([payload])
    except BatchError:
        return
    lengths = {len(column) for column in batches.columns.values()}
    assert lengths == {int(batches.counts[0])}


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10**6), st.integers(0, 7))
def test_a_flipped_bit_of_a_batch_is_a_batch_or_an_error(place: int, bit: int) -> None:
    payload = bytearray(next(observations.sweep_messages(make_sweeps(50))[0]).payloads[0])
    payload[place % len(payload)] ^= 1 << bit
    test_garbage_is_a_batch_or_an_error.hypothesis.inner_test(bytes(payload))


def test_fields_of_different_length_are_refused(tmp_path: Path) -> None:
    message = LighthouseSweep(device="R", time_ns=[1, 2], sensor=[0, 0], channel=[1])
    path = tmp_path / "run.mcap"
    with SessionWriter(path, system="lighthouse") as writer:
        writer.write("/lighthouse/R", message, 1)
    with pytest.raises(FormatError, match="channel") as caught:
        observations.read_sweeps(Session.open(path))
    assert caught.value.where == "/lighthouse/R"


@pytest.mark.parametrize(
    ("name", "value"),
    [("channel", 0), ("channel", 17), ("polynomial", 32), ("sweep", 2), ("sensor", 2**31)],
)
def test_values_out_of_range_are_refused(tmp_path: Path, name: str, value: int) -> None:
    fields = {"time_ns": 1, "sensor": 0, "channel": 1, "polynomial": 0, "sweep": 0, "count": 1.0}
    fields[name] = value
    message = LighthouseSweep(device="R", **{key: [item] for key, item in fields.items()})
    path = tmp_path / "run.mcap"
    with SessionWriter(path, system="lighthouse") as writer:
        writer.write("/lighthouse/R", message, 1)
    with pytest.raises(FormatError, match=name):
        observations.read_sweeps(Session.open(path))


def test_the_error_of_a_file_without_sweeps_lists_its_topics(tmp_path: Path) -> None:
    other = tmp_path / "other.mcap"
    with open(other, "wb") as stream:
        writer = mcap.writer.Writer(stream)
        writer.start()
        channel = writer.register_channel("/imu", "json", 0)
        writer.add_message(channel, 1, b"{}", 1)
        writer.finish()
    with pytest.raises(FormatError, match="not a session of locatk") as caught:
        observations.read_sweeps(Session.open(other))
    assert "/imu" in (caught.value.hint or "")

    ours = tmp_path / "ours.mcap"
    with SessionWriter(ours, system="dots"):
        pass
    with pytest.raises(FormatError, match="no lighthouse sweeps"):
        observations.read_sweeps(Session.open(ours))


# ---- sessions


def test_session_round_trip(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    sweeps = make_sweeps(2000)
    truth = [make_trajectory(1100), make_trajectory(1, "G", 1)]
    heading = np.linspace(-3, 3, 50)
    flat = Trajectory(
        "R",
        "odom",
        START + np.arange(50) * 10**7,
        np.column_stack([heading, heading**2, np.zeros(50)]),
        np.column_stack([np.zeros((50, 2)), np.sin(heading / 2), np.cos(heading / 2)]),
        np.full((50, 6, 6), np.nan),
    )
    contents: dict[str, Any] = {
        "system": "lighthouse",
        "sweeps": sweeps,
        "truth": truth,
        "odometry": [flat],
        "scene": SCENE,
        "facts": {"source": "test", "rows": 3},
    }
    observations.write_session(path, **contents)
    session = Session.open(path)
    assert session.facts["kind"] == "session"
    assert session.metadata()["facts"] == {"source": "test", "rows": "3"}
    assert rows(observations.read_sweeps(session)) == rows(sweeps)
    for a, b in zip(observations.read_truth(session), truth[::-1], strict=True):
        same(a, b)
    (odometry,) = observations.read_odometry(session)
    assert odometry.frame == "odom"
    np.testing.assert_allclose(odometry.position, flat.position, atol=1e-15)
    np.testing.assert_allclose(odometry.quaternion, flat.quaternion, atol=1e-12)
    scene = observations.read_scene(session)
    assert scene is not None
    assert [station.channel for station in scene.stations] == [1, 16]
    times = [time_ns for _, time_ns, _ in session.messages()]
    assert times == sorted(times)
    assert observations.read_trajectories(path)[0].device == "G"

    again = tmp_path / "again.mcap"
    observations.write_session(again, **contents)
    assert again.read_bytes() == path.read_bytes()
    with pytest.raises(OutputExistsError):
        observations.write_session(path, system="lighthouse", sweeps=sweeps)
    assert again.read_bytes() == path.read_bytes()


def test_a_session_without_reference_data(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    observations.write_session(path, system="lighthouse", sweeps=make_sweeps(10))
    session = Session.open(path)
    assert observations.read_scene(session) is None
    assert observations.read_truth(session) == []
    assert observations.read_odometry(session) == []
    with pytest.raises(FormatError, match="no poses"):
        observations.read_trajectories(path)


def test_invalid_sessions_leave_no_file(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    twice = [make_trajectory(3), make_trajectory(3)]
    with pytest.raises(InputError, match="two truth"):
        observations.write_session(path, system="lighthouse", sweeps=make_sweeps(3), truth=twice)
    early = make_sweeps(3)
    early.time_ns[1] = -5
    with pytest.raises(InputError, match="time_ns"):
        observations.write_session(path, system="lighthouse", sweeps=early)
    assert list(tmp_path.iterdir()) == []


# ---- solutions


def solution() -> Solution:
    return Solution(
        system="lighthouse",
        method="bundle",
        trajectories=(
            make_trajectory(6000, "R"),
            make_trajectory(3, "B", 1),
            Trajectory.from_positions("none", "floor", np.zeros(0, np.int64), np.zeros((0, 3))),
        ),
        rejected={"jump of 2 degrees": 3, "unknown channel": 0},
        detections=(
            StationDetection(1, 2, None, 959000, "factory", sweeps=np.int64(7), rejected=0),
        ),
        artifact=SCENE,
        warnings=(SolverWarning("generic_calibration", "generic calibration of station 16"),),
        facts=LighthouseFacts(angle_sigma_rad=np.float64(1e-4), plane_median_rad=float("nan")),
    )


@pytest.mark.slow
def test_solution_round_trip(tmp_path: Path) -> None:
    path = tmp_path / "solved.mcap"
    wanted = solution()
    observations.write_solution(path, wanted, source=tmp_path / "run.mcap")
    found = observations.read_solution(path)
    for a, b in zip(found.trajectories, wanted.trajectories, strict=True):
        same(a, b)
    assert (found.system, found.method, found.poses) == ("lighthouse", "bundle", 6003)
    assert found.rejected == wanted.rejected
    assert found.warnings == wanted.warnings
    assert found.detections == wanted.detections
    assert found.facts == LighthouseFacts(angle_sigma_rad=1e-4)
    np.testing.assert_array_equal(found.artifact.stations[0].position, SCENE.stations[0].position)
    facts = Session.open(path).facts
    assert (facts["kind"], facts["source"]) == ("solution", "run.mcap")
    assert [t.device for t in observations.read_trajectories(path)] == ["B", "R"]
    with pytest.raises(FormatError, match="no reference poses"):
        observations.read_trajectories(path, "truth")


@pytest.mark.slow
def test_the_library_reads_solutions(tmp_path: Path) -> None:
    """With the stock reader and decoder: every topic of docs/formats.md."""
    path = tmp_path / "solved.mcap"
    wanted = solution()
    observations.write_solution(path, wanted, source="run.mcap")
    seen: dict[str, list[object]] = {}
    schemas: dict[str, str] = {}
    with open(path, "rb") as stream:
        reader = mcap.reader.make_reader(stream, decoder_factories=[DecoderFactory()])
        for schema, channel, _, message in reader.iter_decoded_messages():
            assert schema is not None
            schemas[channel.topic] = schema.name
            seen.setdefault(channel.topic, []).append(message)
    assert schemas == {
        "/solution/R": "locatk.PoseTrack",
        "/solution/B": "locatk.PoseTrack",
        "/pose/R": "foxglove.PoseInFrame",
        "/pose/B": "foxglove.PoseInFrame",
        "/path/R": "foxglove.PosesInFrame",
        "/path/B": "foxglove.PosesInFrame",
        "/path_points/R": "foxglove.PointCloud",
        "/path_points/B": "foxglove.PointCloud",
        "/artifact_points/floor": "foxglove.PointCloud",
        "/tf": "foxglove.FrameTransform",
        "/scene": "foxglove.SceneUpdate",
        "/log": "foxglove.Log",
    }
    track = wanted.trajectories[0]
    poses = seen["/pose/R"]
    assert len(poses) == 6000
    assert poses[7].timestamp.ToNanoseconds() == track.time_ns[7]
    assert poses[7].frame_id == "floor"
    p, q = poses[7].pose.position, poses[7].pose.orientation
    assert [p.x, p.y, p.z] == track.position[7].tolist()
    assert [q.x, q.y, q.z, q.w] == track.quaternion[7].tolist()
    assert len(seen["/tf"]) == 6003
    assert {transform.child_frame_id for transform in seen["/tf"]} == {"R", "B"}
    assert len(seen["/path/R"][0].poses) == 5000
    assert seen["/path/R"][0].poses[-1].position.x == track.position[-1, 0]
    entities = {entity.id: entity for entity in seen["/scene"][0].entities}
    assert set(entities) == {"station/1", "station/16", "marker/tl", "path/R", "path/B"}
    facts = {pair.key: pair.value for pair in entities["station/1"].metadata}
    assert facts == {"channel": "1", "calibration": "factory", "id": "4cc60647"}
    assert [m.message for m in seen["/log"]] == [
        "generic calibration of station 16",
        "rejected 3: jump of 2 degrees",
    ]
    with open(path, "rb") as stream:
        names = [entry.name for entry in mcap.reader.make_reader(stream).iter_attachments()]
    assert names == ["scene.toml", "solution.json"]


def test_a_solution_without_poses(tmp_path: Path) -> None:
    path = tmp_path / "solved.mcap"
    nothing = Solution("lighthouse", "bundle", ())
    observations.write_solution(path, nothing, source="run.mcap")
    assert observations.read_solution(path) == nothing


def test_a_session_is_not_a_solution(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    observations.write_session(path, system="lighthouse", sweeps=make_sweeps(10))
    with pytest.raises(FormatError, match="no solution") as caught:
        observations.read_solution(path)
    assert caught.value.hint


@pytest.mark.parametrize(
    "text", [b"", b"[]", b"{}", b'{"version": 1}', b'{"version": "x"}', b'{"version": 99}', b"\xff"]
)
def test_a_damaged_solution_record(tmp_path: Path, text: bytes) -> None:
    path = tmp_path / "solved.mcap"
    with SessionWriter(path, kind="solution", system="lighthouse") as writer:
        writer.attach("solution.json", text, "application/json")
    with pytest.raises(FormatError):
        observations.read_solution(path)


def test_poses_of_another_tool(tmp_path: Path) -> None:
    """PoseInFrame of anybody serves as truth and as estimate."""
    from locatk.formats.sessions import foxglove

    track = make_trajectory(20)
    path = tmp_path / "other.mcap"
    with SessionWriter(path, system="lighthouse") as writer:
        (batch,) = foxglove.poses("/truth/R", track)
        for time_ns, payload in zip(
            batch.time_ns[::-1].tolist(), batch.payloads[::-1], strict=True
        ):
            writer.write(batch.topic, batch.message.FromString(payload), time_ns)
            writer.write("/pose/R", batch.message.FromString(payload), time_ns)
    (truth,) = observations.read_truth(Session.open(path))
    same(truth, track, covariance=False)
    assert np.isnan(truth.covariance).all()
    (estimate,) = observations.read_trajectories(path, "solution")
    same(estimate, track, covariance=False)
