"""Samples of magnetometers and hall sensors in sessions: exact round trips, precise errors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from google.protobuf.message import Message
from hypothesis import given, settings
from hypothesis import strategies as st

from locatk.core.errors import ArtifactError, FormatError, InputError
from locatk.core.landmarks.halls import HallSamples, HallSensors, circle
from locatk.core.landmarks.map.floor import FloorMap
from locatk.core.polaris.array import Samples, SensorArray, bar
from locatk.core.polaris.tag import Tags
from locatk.core.trajectory import Trajectory
from locatk.formats.artifacts import maps, tags
from locatk.formats.schemas.magnetics_pb2 import HallArray, MagnetometerArray
from locatk.formats.sessions import observations
from locatk.formats.sessions.field_samples import (
    read_halls,
    read_magnetometers,
    write_halls,
    write_magnetometers,
)
from locatk.formats.sessions.messages import timestamp
from locatk.formats.sessions.reader import Session
from locatk.formats.sessions.writer import SessionWriter

START_NS = 1_700_000_000_000_000_000

FLOOR = FloorMap(np.array([[7, 1, -1], [3, 15, 0]]), origin_m=(1.0, -2.0), name="lab")
TAGS = Tags(ids=(3, 5), min_distance=2)


def array_samples(n: int = 50, sensors: int = 4, device: str = "bar", seed: int = 1) -> Samples:
    rng = np.random.default_rng(seed)
    time_ns = START_NS + np.cumsum(rng.integers(1, 20_000_000, n))
    field = rng.normal(size=(n, sensors, 3)) * 5e-5
    return Samples(device, SensorArray(bar(sensors, 0.02)), time_ns, field)


def hall_samples(n: int = 50, sensors: int = 4, device: str = "bar", seed: int = 1) -> HallSamples:
    rng = np.random.default_rng(seed)
    time_ns = START_NS + np.cumsum(rng.integers(1, 20_000_000, n))
    names = tuple(f"hall{k}" for k in range(sensors))
    position = circle(0.025)[np.arange(sensors) % 4] * (1 + np.arange(sensors)[:, None] // 4)
    field = rng.normal(size=(n, sensors)) * 5e-3
    return HallSamples(device, HallSensors(names, position), time_ns, field)


@dataclass(frozen=True)
class SensorCase:
    """Everything in which the sessions of the two kinds of sensors differ."""

    samples: Callable[..., Any]
    write: Callable[..., None]
    read: Callable[[Session], list[Any]]
    message: type[Message]
    topic: str
    geometry_file: str
    geometry_text: str
    geometry: str
    axes: int
    extras: dict[str, Any]
    artifact_file: str

    def geometry_of(self, samples: Any) -> Any:
        return samples.array if self.geometry == "array" else samples.sensors


CASES = {
    "magnetometers": SensorCase(
        array_samples,
        write_magnetometers,
        read_magnetometers,
        MagnetometerArray,
        "/magnetometers/bar",
        "array",
        tags.dumps_array(SensorArray(bar(4, 0.02))),
        "array",
        3,
        {"tags": TAGS},
        "tag.toml",
    ),
    "halls": SensorCase(
        hall_samples,
        write_halls,
        read_halls,
        HallArray,
        "/halls/bar",
        "halls",
        maps.dumps_halls(HallSensors()),
        "robot",
        1,
        {"floor": FLOOR},
        "map.toml",
    ),
}


@pytest.fixture(params=CASES)
def case(request: pytest.FixtureRequest) -> SensorCase:
    return CASES[request.param]


# ---- what is written is read


@pytest.mark.slow
@settings(max_examples=25, deadline=None)
@given(
    kind=st.sampled_from(sorted(CASES)),
    n=st.integers(1, 2500),
    sensors=st.integers(1, 12),
    seed=st.integers(0, 99),
)
def test_samples_of_any_number_are_restored(
    tmp_path_factory: pytest.TempPathFactory, kind: str, n: int, sensors: int, seed: int
) -> None:
    case = CASES[kind]
    path = tmp_path_factory.mktemp("samples") / "run.mcap"
    written = case.samples(n, sensors, seed=seed)
    written.field_t[seed % n, seed % sensors] = np.nan
    case.write(path, [written])
    (read,) = case.read(Session.open(path))
    assert read.device == "bar"
    np.testing.assert_array_equal(read.time_ns, written.time_ns)
    np.testing.assert_array_equal(np.isnan(read.field_t), np.isnan(written.field_t))
    np.testing.assert_allclose(read.field_t, written.field_t, rtol=6e-8)
    geometry, expected = case.geometry_of(read), case.geometry_of(written)
    np.testing.assert_array_equal(geometry.position_m, expected.position_m)
    assert getattr(geometry, "names", None) == getattr(expected, "names", None)


def test_a_session_contains_reference_data_and_artifacts(case: SensorCase, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    written = case.samples(150)
    truth = Trajectory.from_positions(
        "bar", "site", written.time_ns, np.arange(3.0 * len(written)).reshape(-1, 3)
    )
    odometry = Trajectory.from_positions("bar", "odom", written.time_ns, truth.position * [1, 1, 0])
    case.write(
        path,
        [written],
        truth=[truth],
        odometry=[odometry],
        facts={"seed": 3, "rate_hz": 40.0},
        warnings=["one row is lost"],
        **case.extras,
    )
    session = Session.open(path)
    assert session.facts["system"] == ("polaris" if case.axes == 3 else "landmarks")
    assert session.metadata()["facts"] == {"seed": "3", "rate_hz": "40.0"}
    np.testing.assert_array_equal(observations.read_truth(session)[0].position, truth.position)
    (read,) = observations.read_odometry(session)
    np.testing.assert_array_equal(read.position, odometry.position)
    assert len(session.topics("/log")) == 1
    files = [item.name for item in session.attachments()]
    assert files == [case.artifact_file, f"{case.geometry_file}.toml"]
    (read,) = case.read(session)
    np.testing.assert_allclose(read.field_t, written.field_t, rtol=6e-8)
    # A message names its device, and none covers more than half a second.
    messages: list[Any] = [message for _, message in session.decoded(case.topic, case.message)]
    assert {(m.device, m.sensors) for m in messages} == {("bar", 4)}
    assert len(messages) > 1
    assert all(m.time_ns[-1] - m.time_ns[0] <= 500_000_000 for m in messages)


def test_artifacts_are_restored(tmp_path: Path) -> None:
    write_magnetometers(tmp_path / "a.mcap", [array_samples()], tags=TAGS)
    assert observations.read_tags(Session.open(tmp_path / "a.mcap")) == TAGS
    write_halls(tmp_path / "b.mcap", [hall_samples()], floor=FLOOR)
    attached = observations.read_map(Session.open(tmp_path / "b.mcap"))
    assert attached is not None
    assert maps.dumps_map(attached) == maps.dumps_map(FLOOR)


def test_equal_samples_give_equal_bytes(case: SensorCase, tmp_path: Path) -> None:
    first, second = tmp_path / "first.mcap", tmp_path / "second.mcap"
    for _ in range(2):
        case.write(first, [case.samples()], overwrite=True, **case.extras)
    case.write(second, [case.samples()], **case.extras)
    assert first.read_bytes() == second.read_bytes()


def test_devices_share_a_geometry_or_have_their_own(case: SensorCase, tmp_path: Path) -> None:
    front, rear = case.samples(device="front"), case.samples(device="rear", seed=2)
    other = case.samples(sensors=3, device="other")
    name = case.geometry_file
    for path, devices, files in (
        (tmp_path / "same.mcap", [rear, front], [f"{name}.toml"]),
        (tmp_path / "other.mcap", [rear, other], [f"{name}-rear.toml", f"{name}-other.toml"]),
    ):
        case.write(path, devices)
        session = Session.open(path)
        assert [item.name for item in session.attachments()] == files
        read = case.read(session)
        assert [each.device for each in read] == sorted(each.device for each in devices)
        by_name = {each.device: each for each in devices}
        for each in read:
            expected = by_name[each.device]
            positions = case.geometry_of(each).position_m, case.geometry_of(expected).position_m
            np.testing.assert_array_equal(*positions)
            np.testing.assert_allclose(each.field_t, expected.field_t, rtol=6e-8)


def check_saturation(path: Path, range_mt: float) -> None:
    full = 1e-3 * range_mt
    written = hall_samples(6)
    written = replace(written, sensors=replace(written.sensors, range_t=full))
    written.field_t[:] = np.clip(written.field_t, -0.9 * full, 0.9 * full)
    written.field_t[1], written.field_t[2, 3], written.field_t[3, 0] = full, -full, 1.5 * full
    write_halls(path, [written])
    (read,) = read_halls(Session.open(path))
    is_saturated = np.abs(written.field_t) >= full
    np.testing.assert_array_equal(np.abs(read.field_t) >= read.sensors.range_t, is_saturated)
    np.testing.assert_array_equal(np.sign(read.field_t), np.sign(written.field_t))


def test_saturated_fields_stay_saturated(tmp_path: Path) -> None:
    """Rounding to float32 must not bring a value below the range of its sensor."""
    check_saturation(tmp_path / "run.mcap", 20.1)


@pytest.mark.slow
@settings(max_examples=15, deadline=None)
@given(range_mt=st.floats(1, 200))
def test_saturated_fields_of_any_range_stay_saturated(
    tmp_path_factory: pytest.TempPathFactory, range_mt: float
) -> None:
    check_saturation(tmp_path_factory.mktemp("halls") / "run.mcap", range_mt)


# ---- what is refused


def set_older_time(samples: Any) -> None:
    samples.time_ns[7] = samples.time_ns[5]


def set_equal_time(samples: Any) -> None:
    samples.time_ns[7] = samples.time_ns[6]


def set_infinite_field(samples: Any) -> None:
    samples.field_t[3, 2, ...] = np.inf


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (set_older_time, "sample 7 of bar is older than the one before"),
        (set_equal_time, "sample 7 of bar has the time of the one before"),
        (set_infinite_field, "sample 3 of bar is infinite at sensor 2"),
    ],
)
def test_invalid_samples_are_not_written(
    case: SensorCase, tmp_path: Path, change: Callable[[Any], None], words: str
) -> None:
    samples = case.samples()
    change(samples)
    with pytest.raises(InputError, match=words):
        case.write(tmp_path / "run.mcap", [samples])
    assert not list(tmp_path.iterdir())


def test_no_samples_and_equal_names_are_not_written(case: SensorCase, tmp_path: Path) -> None:
    for nothing in ([], [case.samples(0)]):
        with pytest.raises(InputError, match="no sample at all"):
            case.write(tmp_path / "run.mcap", nothing)
    with pytest.raises(InputError, match=f"two {case.geometry}s have the name 'bar'"):
        case.write(tmp_path / "run.mcap", [case.samples(), case.samples()])
    assert not list(tmp_path.iterdir())


def record(
    case: SensorCase, path: Path, *messages: Message, geometry: str | None = None
) -> Session:
    """Write a session as another program would do it."""
    text = case.geometry_text if geometry is None else geometry
    with SessionWriter(path, system="polaris") as writer:
        if text:
            name = f"{case.geometry_file}.toml"
            writer.attach(name, text.encode(), "application/toml")
        for message in messages:
            writer.write(case.topic, message, START_NS)
    return Session.open(path)


def make_message(
    case: SensorCase,
    times: list[int],
    sensors: int = 4,
    missing: int = 0,
    value: float = 1e-5,
) -> Message:
    count = case.axes * sensors * len(times) - missing
    temperature = {"temperature_celsius": [20.0] * len(times)} if case.axes == 3 else {}
    return case.message(
        timestamp=timestamp(START_NS),
        device="bar",
        sensors=sensors,
        time_ns=times,
        device_ticks=[7] * len(times),
        sequence=list(range(len(times))),
        b_tesla=[value] * count,
        **temperature,
    )


def test_messages_of_other_programs_are_read(case: SensorCase, tmp_path: Path) -> None:
    """They may have the device's clock, a counter and temperatures, which locatk ignores."""
    messages = make_message(case, [1, 2]), make_message(case, [5])
    (read,) = case.read(record(case, tmp_path / "run.mcap", *messages))
    assert read.time_ns.tolist() == [1, 2, 5]
    assert read.field_t.shape == ((3, 4, 3) if case.axes == 3 else (3, 4))


@pytest.mark.parametrize(
    ("messages", "words"),
    [
        ([], "no samples of"),
        ([{"times": []}], "messages without any sample"),
        ([{"times": [1, 2]}, {"times": [2, 3]}], "sample 2 of bar has the time of the one before"),
        ([{"times": [5]}, {"times": [3]}], "sample 1 of bar is older"),
        ([{"times": [1 << 63]}], "older than 1970"),
        ([{"times": [1], "value": float("inf")}], "infinite"),
        ([{"times": [1], "sensors": 0}], "no sensor"),
        ([{"times": [1], "sensors": 3}], r"samples of 3 sensors, but the \w+ has 4"),
        ([{"times": [1]}, {"times": [2], "sensors": 3}], "another number of b_tesla"),
        ([{"times": [1, 2], "missing": 1}], "another number of b_tesla"),
    ],
)
def test_damaged_messages_are_refused_with_their_topic(
    case: SensorCase, tmp_path: Path, messages: list[dict[str, Any]], words: str
) -> None:
    made = [make_message(case, **fields) for fields in messages]
    session = record(case, tmp_path / "run.mcap", *made)
    with pytest.raises(FormatError, match=words) as caught:
        case.read(session)
    assert caught.value.file == session.path
    assert caught.value.where == (case.topic if messages else None)


def test_messages_of_another_schema_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with SessionWriter(path, system="polaris") as writer:
        writer.write("/halls/robot", MagnetometerArray(device="robot", sensors=4), START_NS)
    with pytest.raises(FormatError, match="no samples of hall sensors"):
        read_halls(Session.open(path))


def test_unknown_and_invalid_geometries_are_refused(case: SensorCase, tmp_path: Path) -> None:
    name = case.geometry_file
    session = record(case, tmp_path / "run.mcap", make_message(case, [1]), geometry="")
    with pytest.raises(FormatError, match=rf"run\.mcap:{name}\.toml: no geometry of the \w+ 'bar'"):
        case.read(session)
    session = record(case, tmp_path / "bad.mcap", make_message(case, [1]), geometry="format = 3")
    with pytest.raises(ArtifactError, match=rf"bad\.mcap:{name}\.toml:format"):
        case.read(session)
