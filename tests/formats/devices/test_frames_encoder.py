"""Recordings as frames, and back."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from locatk.core.errors import InputError
from locatk.core.geometry import quaternion_from_heading
from locatk.core.landmarks.halls import HallSamples, HallSensors
from locatk.core.lighthouse.recording import Sweeps
from locatk.core.polaris.array import Samples, SensorArray, bar
from locatk.core.trajectory import Trajectory
from locatk.formats.devices import find_device
from locatk.formats.devices.interface import Options, Recording
from locatk.formats.devices.locatk_frames.decoder import FrameDecoder

START_NS = 1_700_000_000_123_456_789


def times(n: int, hz: float, late_ns: int = 0) -> Any:
    return START_NS + late_ns + np.rint(np.arange(n) * 1e9 / hz).astype(np.int64)


def magnetometers(name: str, n: int, sensors: int = 3, hz: float = 75, seed: int = 0) -> Samples:
    field = np.random.default_rng(seed).normal(0, 5e-5, (n, sensors, 3)).astype(np.float32)
    field[n // 2, 0] = np.nan
    return Samples(name, SensorArray(bar(sensors, 0.02)), times(n, hz), field.astype(float))


def sweeps(**changes: Any) -> Sweeps:
    random = np.random.default_rng(1)
    n = 200
    columns = {
        "devices": ("unused", "bar", "other"),
        "time_ns": START_NS + random.integers(0, 2_000_000_000, n),
        "device": random.integers(1, 3, n),
        "sensor": random.integers(0, 4, n),
        "channel": random.integers(1, 17, n),
        "polynomial": random.integers(-1, 32, n),
        "sweep": random.integers(-1, 2, n),
        "count": random.integers(0, 120_000 * 256, n) / 256,
        **changes,
    }
    return Sweeps(**columns)


def everything() -> Recording:
    hall = np.random.default_rng(2).normal(0, 1e-3, (300, 4)).astype(np.float32).astype(float)
    heading = np.linspace(-3, 3, 40)
    track = Trajectory.from_positions(
        "other",
        "odom",
        times(40, 20, 5_000_000),
        np.column_stack([heading, heading / 2, 0 * heading]),
    )
    track.quaternion[:] = quaternion_from_heading(heading)
    return Recording(
        samples=[magnetometers("bar", 150), magnetometers("second bar", 150, 9, 1000, 3)],
        halls=[HallSamples("bar", HallSensors(), times(300, 200, 1_000_000), hall)],
        sweeps=sweeps(),
        odometry=[track],
    )


def decoded(recording: Recording) -> tuple[dict[tuple[str, str], Any], FrameDecoder]:
    """Columns, ticks with them, by kind and node."""
    decoder = FrameDecoder(Options())
    found: dict[tuple[str, str], Any] = {}
    for batch in decoder.feed(
        b"".join(frame for _, frame in find_device("locatk").encode(recording))
    ):
        columns = found.setdefault((batch.stream.kind, batch.stream.node), {})
        for name, column in {**batch.columns, "tick": batch.tick}.items():
            columns.setdefault(name, []).append(column)
    decoder.finish()
    joined = {
        key: {name: np.concatenate(column) for name, column in columns.items()}
        for key, columns in found.items()
    }
    return joined, decoder


def test_everything_comes_back() -> None:
    recording = everything()
    found, decoder = decoded(recording)
    counts = decoder.counts
    assert (counts.bad, counts.lost, counts.skipped, counts.unknown) == (0, 0, 0, 0)
    assert decoder.remarks == []

    def same_times(key: tuple[str, str], time_ns: Any) -> None:
        assert np.abs(found[key]["tick"] - (time_ns - START_NS) // 1000).max() <= 1

    for samples, node in zip(recording.samples, ("", "1"), strict=True):
        field = found["magnetometers", node]["b_tesla"].reshape(samples.field_t.shape)
        np.testing.assert_allclose(field, samples.field_t, rtol=2e-7)
        same_times(("magnetometers", node), samples.time_ns)
    halls = recording.halls[0]
    np.testing.assert_allclose(found["halls", ""]["b_tesla"], halls.field_t, rtol=2e-7)
    same_times(("halls", ""), halls.time_ns)
    track = recording.odometry[0]
    np.testing.assert_allclose(found["odometry", "2"]["x_m"], track.position[:, 0], rtol=1e-7)
    np.testing.assert_allclose(
        found["odometry", "2"]["heading_rad"], np.linspace(-3, 3, 40), rtol=1e-6
    )
    same_times(("odometry", "2"), track.time_ns)
    assert recording.sweeps is not None
    for number, node in ((1, ""), (2, "2")):
        mine = recording.sweeps.device == number
        order = np.argsort(recording.sweeps.time_ns[mine], kind="stable")
        for name in ("sensor", "channel", "polynomial", "sweep", "count"):
            np.testing.assert_array_equal(
                found["lighthouse", node][name], getattr(recording.sweeps, name)[mine][order]
            )
        same_times(("lighthouse", node), recording.sweeps.time_ns[mine][order])


def test_frames_come_in_the_order_of_time() -> None:
    frames = list(find_device("locatk").encode(everything()))
    stamps = [time_ns for time_ns, _ in frames]
    assert stamps == sorted(stamps)
    assert stamps[0] == START_NS
    decoder = FrameDecoder(Options())
    hellos = []
    for time_ns, frame in frames:
        # A frame can be sent when its last sample was measured, and holds no older ones
        # than a receiver can wait for.
        for batch in decoder.feed(frame):
            if batch.stream.kind == "log":
                hellos.append((time_ns, batch.stream.node, batch.columns["text"][0]))
                continue
            assert batch.tick is not None
            assert abs(int(batch.tick.max()) - (time_ns - START_NS) // 1000) <= 1
            assert batch.tick.max() - batch.tick.min() <= 20_000
    assert hellos == [
        (START_NS, "", "hello from bar, 1000000 ticks/s"),
        (START_NS, "1", "hello from second bar, 1000000 ticks/s"),
        (START_NS, "2", "hello from other, 1000000 ticks/s"),
    ]
    assert sum(frame[1] == 1 for _, frame in frames) == 6  # each second, of each node


def test_samples_that_come_unevenly() -> None:
    gaps = np.array([1000, 1_000_000, 1_000_000, 7_000_000, 900, 60_000_000_000, 5_000_000] * 5)
    time_ns = START_NS + np.append(0, np.cumsum(gaps))
    field = np.ones((len(time_ns), 2, 3))
    recording = Recording([Samples("bar", SensorArray(bar(2, 0.02)), time_ns, field)])
    found, decoder = decoded(recording)
    ticks = (time_ns - START_NS) // 1000
    assert np.abs(found["magnetometers", ""]["tick"] - ticks).max() <= 1
    assert (decoder.counts.bad, decoder.counts.lost) == (0, 0)


def test_ticks_of_a_long_recording_start_again() -> None:
    time_ns = START_NS + np.arange(10) * 500_000_000_000
    field = np.ones((10, 2, 3))
    found, _ = decoded(Recording([Samples("bar", SensorArray(bar(2, 0.02)), time_ns, field)]))
    assert found["magnetometers", ""]["tick"].tolist() == [
        n * 500_000_000 % 2**32 for n in range(10)
    ]


def test_as_many_sensors_as_a_frame_tells() -> None:
    recording = Recording([magnetometers("bar", 20, 255, 1000)])
    found, decoder = decoded(recording)
    assert found["magnetometers", ""]["b_tesla"].shape == (20, 765)
    assert decoder.counts.bad == 0


INFINITE = HallSamples("it", HallSensors(), times(2, 10), np.full((2, 4), np.inf))


@pytest.mark.parametrize(
    ("recording", "message"),
    [
        (Recording(), "recording contains nothing"),
        (Recording(sweeps=sweeps(channel=np.full(200, 17))), "channel 17 of sweep 0"),
        (Recording(sweeps=sweeps(count=np.full(200, np.nan))), "count nan of sweep 0"),
        (Recording(sweeps=sweeps(sensor=np.full(200, 256))), "sensor 256 of sweep 0"),
        (Recording([magnetometers("bar", 3, 256)]), "256 sensors of bar"),
        (Recording([magnetometers(f"bar {n}", 2) for n in range(257)]), "257 devices"),
        (Recording(halls=[INFINITE]), "infinite value of it"),
    ],
)
def test_what_no_frame_tells(recording: Recording, message: str) -> None:
    with pytest.raises(InputError, match=message):
        find_device("locatk").encode(recording)
