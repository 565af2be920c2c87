"""Records become messages: the right topic, every value, times that ascend."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foxglove_schemas_protobuf.Log_pb2 import Log
from hypothesis import given, settings
from hypothesis import strategies as st

from locatk.core.polaris.array import SensorArray, bar
from locatk.formats.artifacts import tags
from locatk.formats.capture.clocks import ArrivalTimes
from locatk.formats.capture.ingestion import MessageEncoder, StampedMessage
from locatk.formats.devices.interface import KINDS, Batch, Stream, Ticks
from locatk.formats.sessions import field_samples, messages, observations
from locatk.formats.sessions import trajectories as tracks
from locatk.formats.sessions.messages import MAX_BATCH_SAMPLES, Layout
from locatk.formats.sessions.reader import Session
from locatk.formats.sessions.writer import SessionWriter

START_NS = 1_700_000_000_000_000_000
MS = 1_000_000


def arrivals_of(ends: Sequence[int], step_ns: int = 20 * MS) -> ArrivalTimes:
    arrivals = ArrivalTimes()
    for number, end in enumerate(ends):
        arrivals.add(int(end), START_NS + number * step_ns)
    return arrivals


def values(kind: str, n: int, seed: int = 0) -> dict[str, Any]:
    """Columns of ``n`` records of any kind but the log."""
    rng = np.random.default_rng(seed)
    whole = {"sensor": (0, 4), "channel": (1, 17), "polynomial": (-1, 32), "sweep": (-1, 2)}
    numbers = {key: rng.integers(*span, n) for key, span in whole.items()}
    if kind == "magnetometers":
        return {
            "b_tesla": rng.normal(size=(n, 9)).astype(np.float32),
            "temperature_celsius": rng.normal(20, 1, n).astype(np.float32),
        }
    if kind == "halls":
        return {"b_tesla": rng.normal(size=(n, 4)).astype(np.float32)}
    if kind == "lighthouse":
        return {**numbers, "count": rng.uniform(0, 2e5, n)}
    if kind == "captures":
        numbers.pop("channel"), numbers.pop("sweep")
        bits = rng.integers(0, 2**64, n, dtype=np.uint64)
        return {**numbers, "bits": bits, "bit_offset": rng.integers(0, 9, n)}
    if kind == "odometry":
        return {name: rng.normal(size=n) for name in ("x_m", "y_m", "heading_rad")}
    if kind == "imu":
        names = ("acceleration_m_s2", "angular_rate_rad_s")
        return {name: rng.normal(size=(n, 3)) for name in names}
    if kind == "poses":
        quaternion = rng.normal(size=(n, 4))
        quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
        return {"position_m": rng.normal(size=(n, 3)), "quaternion_xyzw": quaternion}
    return {"value": rng.normal(size=(n, 2))}


STREAMS = {
    "magnetometers": (Stream("magnetometers", sensors=3), messages.magnetometers(3)),
    "halls": (Stream("halls", sensors=4), messages.halls(4)),
    "lighthouse": (Stream("lighthouse"), messages.SWEEPS),
    "captures": (Stream("captures"), messages.CAPTURES),
    "odometry": (Stream("odometry"), messages.ODOMETRY),
    "imu": (Stream("imu"), messages.IMU),
    "poses": (Stream("poses"), messages.POSES),
    "readings": (Stream("readings", names=("a", "b")), messages.readings(2)),
}


def unpacked(made: Sequence[StampedMessage], layout: Layout) -> messages.Batches:
    return layout.unpack([each.message.SerializeToString() for each in made])


def test_all_kinds_are_tried_here() -> None:
    assert {*STREAMS, "log"} == set(KINDS)


@pytest.mark.parametrize("kind", STREAMS)
@pytest.mark.parametrize("node", ["", "b7"])
def test_every_value_comes_through(kind: str, node: str) -> None:
    stream, layout = STREAMS[kind]
    stream = Stream(stream.kind, node=node, sensors=stream.sensors, names=stream.names)
    ends = np.arange(1, 8) * 10
    columns = values(kind, 7)
    tick, sequence = np.arange(7) * 1000 + 5, np.arange(7) + 65_530
    made = list(
        MessageEncoder("red").messages(
            [Batch(stream, ends, columns, tick=tick, sequence=sequence)],
            arrivals_of(ends),
            START_NS + 999 * MS,
        )
    )
    device = f"red-{node}" if node else "red"
    (stamped,) = made
    topic = {"poses": "onboard_track"}.get(kind, kind)
    assert stamped.topic == f"/{topic}/{device}"
    assert stamped.time_ns == START_NS + 999 * MS
    assert stamped.publish_ns == START_NS  # no clock is told, so the ticks are only kept
    batches = unpacked(made, layout)
    assert batches.texts["device"] == [device]
    np.testing.assert_array_equal(batches.columns["time_ns"], START_NS + np.arange(7) * 20 * MS)
    if kind != "poses":
        np.testing.assert_array_equal(batches.columns["device_ticks"], tick)
    for name, column in columns.items():
        np.testing.assert_array_equal(batches.columns[name], column)
    if "sequence" in batches.columns:
        np.testing.assert_array_equal(batches.columns["sequence"], sequence)
    message: Any = stamped.message
    if kind == "readings":
        assert list(message.names) == ["a", "b"]
    if kind in ("magnetometers", "halls"):
        assert message.sensors == stream.sensors
        assert message.frame_id == device
    assert message.timestamp.ToNanoseconds() == START_NS


def test_long_batches_are_several_messages() -> None:
    n = 2 * MAX_BATCH_SAMPLES + 1
    ends = np.arange(1, n + 1)
    stream, layout = STREAMS["halls"]
    columns = values("halls", n)
    streams = MessageEncoder("red")
    made = list(streams.messages([Batch(stream, ends, columns)], arrivals_of(ends), START_NS))
    batches = unpacked(made, layout)
    assert batches.counts.tolist() == [MAX_BATCH_SAMPLES, MAX_BATCH_SAMPLES, 1]
    np.testing.assert_array_equal(batches.columns["b_tesla"], columns["b_tesla"])
    assert [each.publish_ns for each in made] == [
        START_NS + k * MAX_BATCH_SAMPLES * 20 * MS for k in range(3)
    ]
    assert streams.samples == {"/halls/red": n}


def test_empty_batches_are_nothing() -> None:
    stream, _ = STREAMS["halls"]
    batch = Batch(stream, np.zeros(0, np.int64), values("halls", 0))
    streams = MessageEncoder("red")
    assert list(streams.messages([batch], arrivals_of([1]), START_NS)) == []
    assert not streams.samples


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(
    steps=st.lists(
        st.lists(st.integers(0, 2).map(lambda k: k * 5), min_size=1, max_size=6),
        min_size=1,
        max_size=6,
    )
)
def test_times_of_a_topic_ascend_strictly(steps: list[list[int]]) -> None:
    """Readers refuse two samples of one time, and many records may end in one read."""
    arrivals, streams = ArrivalTimes(), MessageEncoder("red")
    stream, layout = STREAMS["halls"]
    end, time_ns, made, truth = 0, START_NS, [], []
    for lengths in steps:
        ends = end + 1 + np.cumsum(lengths)
        end = int(ends[-1]) + 1
        time_ns += 1000
        arrivals.add(end, time_ns)
        batch = Batch(stream, ends.astype(np.int64), values("halls", len(ends)))
        made += list(streams.messages([batch], arrivals, time_ns))
        truth += [time_ns] * len(ends)
    times = unpacked(made, layout).columns["time_ns"]
    assert (np.diff(times) > 0).all()
    assert (times >= truth).all()
    assert (times <= np.array(truth) + 100).all()  # nudged, not moved


def test_topics_do_not_push_each_other() -> None:
    streams, arrivals = MessageEncoder("red"), arrivals_of([10])
    for kind in ("halls", "odometry"):
        stream, layout = STREAMS[kind]
        batch = Batch(stream, np.array([10]), values(kind, 1))
        made = list(streams.messages([batch], arrivals, START_NS))
        assert unpacked(made, layout).columns["time_ns"].tolist() == [START_NS]


# ---- the device's clock


def ticked(
    streams: MessageEncoder,
    arrivals: ArrivalTimes,
    ends: Any,
    tick: Any,
    ticks: Ticks,
    node: str = "",
) -> Any:
    stream = Stream("halls", node=node, sensors=4, ticks=ticks)
    batch = Batch(stream, ends, values("halls", len(ends)), tick=tick)
    made = list(streams.messages([batch], arrivals, START_NS))
    return unpacked(made, messages.halls(4)).columns


def test_samples_have_the_times_of_the_device() -> None:
    """Samples every 10 ms, read in bursts of 100 ms: their ticks tell them apart."""
    n = 300
    ends = np.arange(1, n + 1)
    arrivals = ArrivalTimes()
    for burst in range(n // 10):
        arrivals.add(10 * (burst + 1), START_NS + (burst + 1) * 100 * MS)
    streams = MessageEncoder("red")
    tick = (np.arange(n) + 1) * 10_000 + 123_456
    times = ticked(streams, arrivals, ends, tick, Ticks(1e6))["time_ns"]
    np.testing.assert_allclose(np.diff(times)[20:] / MS, 10, atol=0.2)
    (clock,) = streams.clocks().values()
    assert clock.tick_count == n
    assert clock.offset_ns == pytest.approx(START_NS - 123_456_000, abs=MS)


def test_each_device_has_its_clock() -> None:
    streams = MessageEncoder("red")
    ends = np.arange(1, 6)
    for node in ("a", "b"):
        ticked(streams, arrivals_of(ends), ends, ends * 1000, Ticks(1e6, 32), node)
    assert sorted(streams.clocks()) == ["red-a", "red-b"]


def test_streams_of_one_device_share_its_clock() -> None:
    streams = MessageEncoder("red")
    ends = np.arange(1, 6)
    ticked(streams, arrivals_of(ends), ends, ends * 1000, Ticks(1e6, 32))
    first = streams.clocks()["red"]
    stream = Stream("odometry", ticks=Ticks(1e6, 32))
    batch = Batch(stream, ends, values("odometry", 5), tick=ends * 1000)
    list(streams.messages([batch], arrivals_of(ends), START_NS))
    assert streams.clocks()["red"] is first
    assert first.tick_count == 10


def test_a_device_may_have_two_clocks() -> None:
    """The Crazyflie's own, and that of its deck, which wraps every 0.7 s and runs otherwise."""
    n = 400
    ends = np.arange(1, n + 1)
    arrivals, streams = arrivals_of(ends), MessageEncoder("red")
    deck = Stream("lighthouse", sensors=4, ticks=Ticks(24e6, 24, "deck"))
    imu = Stream("imu", ticks=Ticks(1e3, 32))
    tick = {deck: ends * 480_096 & 0xFFFFFF, imu: 500_000 + ends * 20}
    times: dict[Stream, list[int]] = {deck: [], imu: []}
    for part in range(0, n, 10):
        rows = slice(part, part + 10)
        for stream in (deck, imu):
            columns = {key: column[rows] for key, column in values(stream.kind, n).items()}
            batch = Batch(stream, ends[rows], columns, tick=tick[stream][rows])
            for each in streams.messages([batch], arrivals, START_NS):
                message: Any = each.message
                times[stream] += message.time_ns
    for stream in (deck, imu):
        delay_ns = np.array(times[stream]) - START_NS - (ends - 1) * 20 * MS
        assert np.abs(delay_ns[n // 2 :]).max() < 0.1 * MS
    clocks = streams.clocks()
    assert sorted(clocks) == ["red", "red-deck"]
    assert clocks["red-deck"].drift_ppm == pytest.approx(200, abs=1)
    assert clocks["red"].drift_ppm == pytest.approx(0, abs=1)


def test_after_a_restart_the_ticks_may_be_others() -> None:
    """Unplugged for a second, the device counts from 0 again: no time is bent for it."""
    streams = MessageEncoder("red")
    ends = np.arange(1, 101)
    arrivals = arrivals_of(ends)
    ticked(streams, arrivals, ends, ends * 20_000 + 9_000_000, Ticks(1e6))
    streams.restart()
    more = ends + 100
    for number, end in enumerate(more.tolist()):
        arrivals.add(end, START_NS + (150 + number) * 20 * MS)
    times = ticked(streams, arrivals, more, ends * 20_000, Ticks(1e6))["time_ns"]
    np.testing.assert_allclose((times - START_NS) / MS, 20 * (150 + np.arange(100)), atol=1.0)


# ---- lines of the device


def test_messages_of_the_device_are_logged() -> None:
    batch = Batch(
        Stream("log", node="3"),
        np.array([10, 20]),
        {"level": np.array([2, 4]), "text": np.array(["started", "hot"], object)},
    )
    made = list(MessageEncoder("red").messages([batch], arrivals_of([10, 20]), START_NS + 50 * MS))
    lines: list[Any] = [each.message for each in made]
    assert [each.topic for each in made] == ["/log", "/log"]
    assert [line.message for line in lines] == ["started", "hot"]
    assert [line.level for line in lines] == [Log.INFO, Log.ERROR]
    assert {line.name for line in lines} == {"red-3"}
    assert [each.time_ns for each in made] == [START_NS + 50 * MS] * 2
    assert [line.timestamp.ToNanoseconds() for line in lines] == [START_NS, START_NS + 20 * MS]


def test_an_unknown_kind() -> None:
    batch = Batch(Stream("smell"), np.array([1]), {})
    with pytest.raises(ValueError, match="smell"):
        list(MessageEncoder("red").messages([batch], arrivals_of([1]), START_NS))


# ---- solvers can read them


def test_recorded_streams_equal_written_ones(tmp_path: Path) -> None:
    ends = np.arange(1, 51) * 10
    arrivals, streams = arrivals_of(ends), MessageEncoder("red")
    columns = {kind: values(kind, 50) for kind in STREAMS}
    columns["magnetometers"].pop("temperature_celsius")
    with SessionWriter(tmp_path / "run.mcap", system="polaris") as writer:
        writer.attach_toml(tags.ARRAY_FILE, tags.dumps_array(SensorArray(bar(3, 0.02))))
        for part in range(0, 50, 7):
            span = slice(part, part + 7)
            batches = [
                Batch(stream, ends[span], {key: c[span] for key, c in columns[kind].items()})
                for kind, (stream, _) in STREAMS.items()
            ]
            for each in streams.messages(batches, arrivals, START_NS):
                writer.write(each.topic, each.message, each.time_ns, each.publish_ns)
    session = Session.open(tmp_path / "run.mcap")
    (samples,) = field_samples.read_magnetometers(session)
    assert samples.device == "red"
    np.testing.assert_array_equal(
        samples.field_t.reshape(50, -1), columns["magnetometers"]["b_tesla"]
    )
    sweeps = observations.read_sweeps(session)
    np.testing.assert_array_equal(sweeps.count, columns["lighthouse"]["count"])
    np.testing.assert_array_equal(sweeps.time_ns, samples.time_ns)
    (imu,) = observations.read_imu(session)
    assert imu.device == "red"
    np.testing.assert_array_equal(imu.acceleration, columns["imu"]["acceleration_m_s2"])
    np.testing.assert_array_equal(imu.angular_rate, columns["imu"]["angular_rate_rad_s"])
    (track,) = tracks.read_onboard(session)
    assert track.device == "red"
    np.testing.assert_array_equal(track.quaternion, columns["poses"]["quaternion_xyzw"])
    (odometry,) = tracks.read_odometry(session)
    np.testing.assert_array_equal(odometry.position[:, 0], columns["odometry"]["x_m"])
