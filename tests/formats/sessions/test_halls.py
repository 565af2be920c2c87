"""Samples of hall sensors in sessions: what is written comes back; what is wrong is named.

What they share with magnetometers is tested in test_arrays.py.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from locatk.core.errors import ArtifactError, FormatError, InputError
from locatk.core.landmarks.halls import HallSamples, HallSensors, circle
from locatk.core.landmarks.map.floor import FloorMap
from locatk.core.trajectory import Trajectory
from locatk.formats.artifacts import maps
from locatk.formats.schemas.magnetics_pb2 import HallArray, MagnetometerArray
from locatk.formats.sessions import halls, observations
from locatk.formats.sessions.messages import timestamp
from locatk.formats.sessions.reader import Session
from locatk.formats.sessions.writer import SessionWriter

START_NS = 1_700_000_000_000_000_000

FLOOR = FloorMap(np.array([[7, 1, -1], [3, 15, 0]]), origin_m=(1.0, -2.0), name="lab")


def samples(n: int = 50, sensors: int = 4, device: str = "robot", seed: int = 1) -> HallSamples:
    rng = np.random.default_rng(seed)
    time_ns = START_NS + np.cumsum(rng.integers(1, 20_000_000, n))
    names = tuple(f"hall{k}" for k in range(sensors))
    place = rng.normal(size=(sensors, 2)) * 0.025
    field = rng.normal(size=(n, sensors)) * 5e-3
    return HallSamples(device, HallSensors(names, place), time_ns, field)


@settings(max_examples=30, deadline=None)
@given(n=st.integers(1, 2500), sensors=st.integers(1, 8), seed=st.integers(0, 99))
def test_all_samples_come_back(
    tmp_path_factory: pytest.TempPathFactory, n: int, sensors: int, seed: int
) -> None:
    path = tmp_path_factory.mktemp("halls") / "run.mcap"
    first = samples(n, sensors, seed=seed)
    first.field_t[seed % n, seed % sensors] = np.nan
    halls.write_session(path, [first], floor=None)
    (read,) = halls.read_samples(Session.open(path))
    assert read.device == "robot"
    assert read.sensors.names == first.sensors.names
    np.testing.assert_array_equal(read.sensors.position_m, first.sensors.position_m)
    np.testing.assert_array_equal(read.time_ns, first.time_ns)
    np.testing.assert_array_equal(np.isnan(read.field_t), np.isnan(first.field_t))
    np.testing.assert_allclose(read.field_t, first.field_t, rtol=6e-8)


@settings(max_examples=30, deadline=None)
@given(range_mt=st.floats(1, 200))
def test_what_was_saturated_stays_so(
    tmp_path_factory: pytest.TempPathFactory, range_mt: float
) -> None:
    """Rounding to float32 must not bring a value below the range that its sensor can tell."""
    path = tmp_path_factory.mktemp("halls") / "run.mcap"
    full = 1e-3 * range_mt
    first = samples(6)
    first = replace(first, sensors=replace(first.sensors, range_t=full))
    first.field_t[:] = np.clip(first.field_t, -0.9 * full, 0.9 * full)
    first.field_t[1], first.field_t[2, 3], first.field_t[3, 0] = full, -full, 1.5 * full
    halls.write_session(path, [first], floor=None)
    (read,) = halls.read_samples(Session.open(path))
    beyond = np.abs(first.field_t) >= full
    np.testing.assert_array_equal(np.abs(read.field_t) >= read.sensors.range_t, beyond)
    np.testing.assert_array_equal(np.sign(read.field_t), np.sign(first.field_t))


def test_a_session_holds_all_that_is_known(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    first = samples()
    truth = Trajectory.from_positions(
        "robot", "map", first.time_ns, np.arange(3.0 * len(first)).reshape(-1, 3)
    )
    odometry = Trajectory.from_positions(
        "robot", "odometry", first.time_ns, truth.position * [1, 1, 0]
    )
    halls.write_session(
        path,
        [first],
        floor=FLOOR,
        truth=[truth],
        odometry=[odometry],
        facts={"seed": 3},
        warnings=["one row is lost"],
    )
    session = Session.open(path)
    assert session.facts["system"] == "landmarks"
    assert session.metadata()["facts"] == {"seed": "3"}
    attached = maps.attached_map(session)
    assert attached is not None
    assert maps.dumps_map(attached) == maps.dumps_map(FLOOR)
    (found,) = observations.read_truth(session)
    np.testing.assert_array_equal(found.position, truth.position)
    (found,) = observations.read_odometry(session)
    np.testing.assert_array_equal(found.position, odometry.position)
    assert len(session.topics("/log")) == 1
    assert [item.name for item in session.attachments()] == ["map.toml", "halls.toml"]
    # A message tells a viewer what it is, and none covers more than half a second.
    messages = [m for _, m in session.decoded("/halls/robot", HallArray)]
    assert {(m.device, m.sensors) for m in messages} == {("robot", 4)}
    assert all(m.time_ns[-1] - m.time_ns[0] <= 500_000_000 for m in messages)
    again = tmp_path / "again.mcap"
    for _ in range(2):
        halls.write_session(again, [first], floor=FLOOR, overwrite=True)
    halls.write_session(tmp_path / "twin.mcap", [first], floor=FLOOR)
    assert again.read_bytes() == (tmp_path / "twin.mcap").read_bytes()


def test_several_robots_share_their_sensors_or_have_their_own(tmp_path: Path) -> None:
    one, other = samples(device="b"), samples(device="a", seed=2)
    alike = replace(other, sensors=one.sensors)
    for path, robots, names in (
        (tmp_path / "same.mcap", [one, alike], ["halls.toml"]),
        (tmp_path / "other.mcap", [one, other], ["halls-b.toml", "halls-a.toml"]),
    ):
        halls.write_session(path, robots, floor=None)
        session = Session.open(path)
        assert [item.name for item in session.attachments()] == names
        read = halls.read_samples(session)
        assert [each.device for each in read] == ["a", "b"]
        by_name = {each.device: each for each in robots}
        for each in read:
            first = by_name[each.device]
            np.testing.assert_array_equal(each.sensors.position_m, first.sensors.position_m)
            np.testing.assert_allclose(each.field_t, first.field_t, rtol=6e-8)


def test_bad_samples_are_not_written(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    for nothing in ([], [samples(0)]):
        with pytest.raises(InputError, match="no sample at all"):
            halls.write_session(path, nothing, floor=None)
    with pytest.raises(InputError, match="two robots have the name 'robot'"):
        halls.write_session(path, [samples(), samples()], floor=None)
    wrong = samples()
    wrong.field_t[3, 2] = np.inf
    with pytest.raises(InputError, match="sample 3 of robot is infinite at sensor 2"):
        halls.write_session(path, [wrong], floor=None)
    wrong = samples()
    wrong.time_ns[7] = wrong.time_ns[6]
    with pytest.raises(InputError, match="sample 7 of robot has the time of the one before"):
        halls.write_session(path, [wrong], floor=None)
    assert not list(tmp_path.iterdir())


def record(path: Path, *messages: HallArray, geometry: str | None = None) -> Session:
    """A session as another program would write it."""
    text = maps.dumps_halls(HallSensors()) if geometry is None else geometry
    with SessionWriter(path, system="landmarks") as writer:
        if text:
            writer.attach("halls.toml", text.encode(), "application/toml")
        for message in messages:
            writer.write("/halls/robot", message, START_NS)
    return Session.open(path)


def message(times: list[int], sensors: int = 4, values: int | None = None) -> HallArray:
    return HallArray(
        timestamp=timestamp(START_NS),
        device="robot",
        sensors=sensors,
        time_ns=times,
        device_ticks=[7] * len(times),
        sequence=list(range(len(times))),
        b_tesla=[1e-3] * (sensors * len(times) if values is None else values),
    )


def test_messages_of_other_programs_are_read(tmp_path: Path) -> None:
    """With the device's own clock and counter, which locatk does not need."""
    (read,) = halls.read_samples(record(tmp_path / "run.mcap", message([1, 2]), message([5])))
    assert read.time_ns.tolist() == [1, 2, 5]
    assert read.field_t.shape == (3, 4)
    np.testing.assert_array_equal(read.sensors.position_m, circle())


@pytest.mark.parametrize(
    ("messages", "words"),
    [
        ([], "no samples of hall sensors"),
        ([message([])], "messages without any sample"),
        ([message([5]), message([3])], "sample 1 of robot is older"),
        ([message([1], sensors=0)], "no sensor"),
        ([message([1], sensors=3)], "samples of 3 sensors, where the robot has 4"),
        ([message([1, 2], values=7)], "another number of b_tesla"),
    ],
)
def test_damaged_samples_are_refused_with_their_place(
    tmp_path: Path, messages: list[HallArray], words: str
) -> None:
    session = record(tmp_path / "run.mcap", *messages)
    with pytest.raises(FormatError, match=words) as caught:
        halls.read_samples(session)
    assert caught.value.file == session.path
    assert caught.value.where == ("/halls/robot" if messages else None)


def test_other_sessions_are_not_taken_for_one(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with SessionWriter(path, system="polaris") as writer:
        writer.write("/halls/robot", MagnetometerArray(device="robot", sensors=4), START_NS)
    with pytest.raises(FormatError, match="no samples of hall sensors"):
        halls.read_samples(Session.open(path))


def test_sensors_of_unknown_place_are_refused(tmp_path: Path) -> None:
    session = record(tmp_path / "run.mcap", message([1]), geometry="")
    with pytest.raises(FormatError, match=r"no geometry of the robot 'robot'.*halls\.toml"):
        halls.read_samples(session)
    session = record(tmp_path / "bad.mcap", message([1]), geometry="format = 3")
    with pytest.raises(ArtifactError, match=r"bad\.mcap:halls\.toml:format"):
        halls.read_samples(session)
