"""Samples of magnetometers in sessions: what is written comes back; what is wrong is named."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from locatk.core.errors import ArtifactError, FormatError, InputError
from locatk.core.polaris.array import Samples, SensorArray, bar
from locatk.core.polaris.tag import Tags
from locatk.core.trajectory import Trajectory
from locatk.formats.artifacts import tags
from locatk.formats.schemas.magnetics_pb2 import MagnetometerArray
from locatk.formats.sessions import magnetometers as arrays
from locatk.formats.sessions import observations
from locatk.formats.sessions.messages import timestamp
from locatk.formats.sessions.reader import Session
from locatk.formats.sessions.writer import SessionWriter

START_NS = 1_700_000_000_000_000_000


def samples(n: int = 50, sensors: int = 9, device: str = "bar", seed: int = 1) -> Samples:
    rng = np.random.default_rng(seed)
    time_ns = START_NS + np.cumsum(rng.integers(1, 20_000_000, n))
    field = rng.normal(size=(n, sensors, 3)) * 5e-5
    return Samples(device, SensorArray(bar(sensors, 0.02)), time_ns, field)


@settings(max_examples=40, deadline=None)
@given(n=st.integers(1, 2500), sensors=st.integers(1, 12), seed=st.integers(0, 99))
def test_all_samples_come_back(
    tmp_path_factory: pytest.TempPathFactory, n: int, sensors: int, seed: int
) -> None:
    path = tmp_path_factory.mktemp("arrays") / "run.mcap"
    first = samples(n, sensors, seed=seed)
    first.field_t[seed % n, seed % sensors] = np.nan
    arrays.write_session(path, [first])
    (read,) = arrays.read_samples(Session.open(path))
    np.testing.assert_array_equal(read.time_ns, first.time_ns)
    np.testing.assert_array_equal(np.isnan(read.field_t), np.isnan(first.field_t))
    np.testing.assert_allclose(read.field_t, first.field_t, rtol=6e-8)
    np.testing.assert_array_equal(read.array.position_m, first.array.position_m)


def test_a_session_holds_all_that_is_known(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    first = samples()
    truth = Trajectory.from_positions(
        "bar", "site", first.time_ns, np.arange(3.0 * len(first)).reshape(-1, 3)
    )
    odometry = Trajectory.from_positions("bar", "odom", first.time_ns, truth.position * [1, 1, 0])
    known = Tags(ids=(3, 5), min_distance=2)
    arrays.write_session(
        path,
        [first],
        tags=known,
        truth=[truth],
        odometry=[odometry],
        facts={"rate_hz": 40.0},
        warnings=["one row is lost"],
    )
    session = Session.open(path)
    assert session.facts["system"] == "polaris"
    assert session.metadata()["facts"] == {"rate_hz": "40.0"}
    assert observations.read_tags(session) == known
    (found,) = observations.read_truth(session)
    np.testing.assert_array_equal(found.position, truth.position)
    (found,) = observations.read_odometry(session)
    np.testing.assert_array_equal(found.position, odometry.position)
    assert len(session.topics("/log")) == 1
    assert [item.name for item in session.attachments()] == ["tag.toml", "array.toml"]
    # A message tells a viewer what it is, and none covers more than half a second.
    messages = [m for _, m in session.decoded("/magnetometers/bar", MagnetometerArray)]
    assert {(m.device, m.sensors) for m in messages} == {("bar", 9)}
    assert all(m.time_ns[-1] - m.time_ns[0] <= 500_000_000 for m in messages)
    assert arrays.write_session(path, [first], overwrite=True) is None


def test_same_samples_same_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        arrays.write_session(tmp_path / name, [samples()], tags=Tags())
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_several_arrays_share_a_geometry_or_have_their_own(tmp_path: Path) -> None:
    front, rear = samples(device="front"), samples(device="rear", seed=2)
    mini = samples(sensors=3, device="mini")
    for path, all_of_them, names in (
        (tmp_path / "same.mcap", [rear, front], ["array.toml"]),
        (tmp_path / "other.mcap", [rear, mini], ["array-rear.toml", "array-mini.toml"]),
    ):
        arrays.write_session(path, all_of_them)
        session = Session.open(path)
        assert [item.name for item in session.attachments()] == names
        read = arrays.read_samples(session)
        assert [each.device for each in read] == sorted(each.device for each in all_of_them)
        by_name = {each.device: each for each in all_of_them}
        for each in read:
            assert len(each.array) == len(by_name[each.device].array)
            np.testing.assert_allclose(each.field_t, by_name[each.device].field_t, rtol=6e-8)


# ---- what is wrong


def late(wrong: Samples) -> None:
    wrong.time_ns[7] = wrong.time_ns[5]


def same(wrong: Samples) -> None:
    wrong.time_ns[7] = wrong.time_ns[6]


def infinite(wrong: Samples) -> None:
    wrong.field_t[3, 4, 1] = np.inf


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (late, "sample 7 of bar is older than the one before"),
        (same, "sample 7 of bar has the time of the one before"),
        (infinite, "sample 3 of bar is infinite at sensor 4"),
    ],
)
def test_bad_samples_are_not_written(
    tmp_path: Path, spoil: Callable[[Samples], None], words: str
) -> None:
    wrong = samples()
    spoil(wrong)
    with pytest.raises(InputError, match=words):
        arrays.write_session(tmp_path / "run.mcap", [wrong])
    assert not list(tmp_path.iterdir())


def test_nothing_and_twins_are_not_written(tmp_path: Path) -> None:
    for nothing in ([], [samples(0)]):
        with pytest.raises(InputError, match="no sample at all"):
            arrays.write_session(tmp_path / "run.mcap", nothing)
    with pytest.raises(InputError, match="two arrays have the name 'bar'"):
        arrays.write_session(tmp_path / "run.mcap", [samples(), samples()])
    assert not list(tmp_path.iterdir())


def record(path: Path, *messages: MagnetometerArray, geometry: str | None = None) -> Session:
    """A session as another program would write it."""
    text = tags.dumps_array(SensorArray(bar(2, 0.02))) if geometry is None else geometry
    with SessionWriter(path, system="polaris") as writer:
        if text:
            writer.attach("array.toml", text.encode(), "application/toml")
        for message in messages:
            writer.write("/magnetometers/bar", message, START_NS)
    return Session.open(path)


def message(
    times: list[int], sensors: int = 2, values: int | None = None, fill: float = 1e-5
) -> MagnetometerArray:
    count = 3 * sensors * len(times) if values is None else values
    return MagnetometerArray(
        timestamp=timestamp(START_NS),
        device="bar",
        sensors=sensors,
        time_ns=times,
        device_ticks=[7] * len(times),
        sequence=list(range(len(times))),
        temperature_celsius=[20.0] * len(times),
        b_tesla=[fill] * count,
    )


def test_messages_of_other_programs_are_read(tmp_path: Path) -> None:
    """With the device's own clock, counter and temperature, which locatk does not need."""
    session = record(tmp_path / "run.mcap", message([1, 2]), message([5]))
    (read,) = arrays.read_samples(session)
    assert read.time_ns.tolist() == [1, 2, 5]
    assert read.field_t.shape == (3, 2, 3)


@pytest.mark.parametrize(
    ("messages", "words"),
    [
        ([], "no samples of magnetometers"),
        ([message([])], "messages without any sample"),
        ([message([1, 2]), message([2, 3])], "sample 2 of bar has the time of the one before"),
        ([message([5]), message([3])], "sample 1 of bar is older"),
        ([message([1 << 63])], "older than 1970"),
        ([message([1], fill=float("inf"))], "infinite"),
        ([message([1], sensors=0)], "no sensor"),
        ([message([1], sensors=3)], "samples of 3 sensors, where the array has 2"),
        ([message([1]), message([2], sensors=3)], "another number of b_tesla"),
        ([message([1, 2], values=11)], "another number of b_tesla"),
    ],
)
def test_damaged_samples_are_refused_with_their_place(
    tmp_path: Path, messages: list[MagnetometerArray], words: str
) -> None:
    session = record(tmp_path / "run.mcap", *messages)
    with pytest.raises(FormatError, match=words) as caught:
        arrays.read_samples(session)
    assert caught.value.file == session.path
    assert caught.value.where == ("/magnetometers/bar" if messages else None)


def test_an_array_of_unknown_geometry_is_refused(tmp_path: Path) -> None:
    session = record(tmp_path / "run.mcap", message([1]), geometry="")
    with pytest.raises(FormatError, match=r"no geometry of the array 'bar'.*array\.toml"):
        arrays.read_samples(session)
    session = record(tmp_path / "bad.mcap", message([1]), geometry="format = 3")
    with pytest.raises(ArtifactError, match=r"bad\.mcap:array\.toml:format"):
        arrays.read_samples(session)
