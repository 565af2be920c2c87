"""What is sent of a session: recorded bytes, or those that a device makes of its streams."""

from __future__ import annotations

import sys
import types
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from locatk.core.errors import FormatError, InputError
from locatk.core.landmarks.halls import HallSamples, HallSensors
from locatk.core.lighthouse.recording import Sweeps
from locatk.core.polaris.array import Samples, SensorArray, bar
from locatk.core.trajectory import Trajectory
from locatk.formats import devices as wire
from locatk.formats.devices.interface import Recording
from locatk.formats.emulation.sources import (
    SYSTEMS,
    replayed_source,
    select_source,
    write_simulated_session,
)
from locatk.formats.schemas.serial_pb2 import SerialChunk
from locatk.formats.sessions import field_samples, observations
from locatk.formats.sessions.reader import Session
from locatk.formats.sessions.writer import SessionWriter

START_NS = 1_700_000_000_000_000_000
TIMES = START_NS + 10_000_000 * np.arange(5)


@pytest.fixture
def recordings(monkeypatch: pytest.MonkeyPatch) -> list[Recording]:
    """A device ``fake`` that sends how many samples there are; what it was given."""
    given: list[Recording] = []

    def encode(recording: Recording) -> Iterator[tuple[int, bytes]]:
        given.append(recording)
        if not recording.samples:
            raise InputError("no samples of magnetometers", hint="Record some")
        for samples in recording.samples:
            yield int(samples.time_ns[0]), bytes([len(samples)])

    module = types.ModuleType("a_fake_device")
    module.encode = encode  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "a_fake_device", module)
    fake = wire.Device("fake", "", 9600, "", "a_fake_device:encode")
    monkeypatch.setitem(wire.DEVICES, "fake", fake)
    return given


def odometry(device: str) -> Trajectory:
    return Trajectory.from_positions(device, "odometry", TIMES, np.zeros((5, 3)))


def of_samples(path: Path) -> Session:
    samples = Samples("bar", SensorArray(bar(9, 0.02)), TIMES, np.zeros((5, 9, 3)))
    field_samples.write_magnetometers(path, [samples], odometry=[odometry("bar")])
    return Session.open(path)


def of_halls(path: Path) -> Session:
    samples = HallSamples("robot", HallSensors(), TIMES, np.zeros((5, 4)))
    field_samples.write_halls(path, [samples], odometry=[odometry("robot")])
    return Session.open(path)


def of_sweeps(path: Path) -> Session:
    zero = np.zeros(5, np.int32)
    sweeps = Sweeps(("robot",), TIMES, zero, zero, zero + 1, zero, zero, zero + 1000.0)
    observations.write_session(path, system="lighthouse", sweeps=sweeps)
    return Session.open(path)


def of_bytes(
    path: Path, device: str | None = "locatk", topics: tuple[str, ...] = ("/serial/bar",)
) -> Session:
    with SessionWriter(path, system="polaris") as writer:
        if device is not None:
            writer.metadata("capture", {"device": device})
        for k in range(10):
            for topic in topics:
                chunk = SerialChunk(port="p", byte_offset=3 * k, data=bytes([k, 0, 255]))
                writer.write(topic, chunk, START_NS + 1000 * k)
    return Session.open(path)


def test_recorded_bytes_are_sent_as_they_are(tmp_path: Path) -> None:
    source = select_source(of_bytes(tmp_path / "run.mcap"))
    assert (source.device, source.recorded) == ("locatk", True)
    expected = [(START_NS + 1000 * k, bytes([k, 0, 255])) for k in range(10)]
    assert list(source.packets()) == expected
    assert list(source.packets()) == expected, "and again"


@pytest.mark.parametrize(
    ("by", "name", "device"),
    [
        ("lines", None, "lines"),
        ("lines", "lines", "lines"),
        ("lines", "raw", "raw"),
        (None, None, "raw"),
        (None, "locatk", "locatk"),
    ],
)
def test_whose_bytes_they_are(
    tmp_path: Path, by: str | None, name: str | None, device: str
) -> None:
    source = select_source(of_bytes(tmp_path / "run.mcap", by), name)
    assert (source.device, source.recorded) == (device, True)
    assert len(list(source.packets())) == 10


def test_bytes_of_another_device_are_not_sent(tmp_path: Path, recordings: list[Recording]) -> None:
    with pytest.raises(InputError, match="no data that a serial device sends"):
        select_source(of_bytes(tmp_path / "run.mcap", "locatk"), "fake")


def test_bytes_of_two_ports_are_refused(tmp_path: Path) -> None:
    session = of_bytes(tmp_path / "run.mcap", None, ("/serial/one", "/serial/two"))
    with pytest.raises(InputError, match="raw bytes of 2 ports"):
        select_source(session)


def test_a_damaged_chunk_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    session = of_bytes(tmp_path / "run.mcap")
    source = select_source(session)
    monkeypatch.setattr(session, "messages", lambda topics: [("/serial/bar", 0, b"\xff")])
    with pytest.raises(FormatError, match=r"run\.mcap:/serial/bar: .* damaged"):
        list(source.packets())


def test_streams_are_encoded(tmp_path: Path, recordings: list[Recording]) -> None:
    source = select_source(of_samples(tmp_path / "run.mcap"), "fake")
    assert (source.device, source.recorded) == ("fake", False)
    assert list(source.packets()) == [(START_NS, b"\x05")]
    assert list(source.packets()) == [(START_NS, b"\x05")], "and again"
    (samples,) = recordings[0].samples
    assert samples.field_t.shape == (5, 9, 3)
    (track,) = recordings[0].odometry
    assert track.device == "bar"
    assert recordings[0].sweeps is None
    assert not recordings[0].halls


def test_a_replay_keeps_the_odometry_of_an_array(tmp_path: Path) -> None:
    session = of_samples(tmp_path / "run.mcap")
    assert select_source(session).device == "polaris-array", "it sends no odometry"
    assert replayed_source(session).device == "locatk"
    assert replayed_source(of_sweeps(tmp_path / "sweeps.mcap")).device == "dotbot-gateway"
    assert replayed_source(of_bytes(tmp_path / "bytes.mcap", "lines")).device == "lines"


def test_all_streams_reach_the_device(tmp_path: Path, recordings: list[Recording]) -> None:
    for make, name in ((of_halls, "halls"), (of_sweeps, "sweeps")):
        source = select_source(make(tmp_path / f"{name}.mcap"), "fake")
        with pytest.raises(InputError, match=rf"{name}\.mcap: no samples of magnetometers"):
            list(source.packets())
        assert len(getattr(recordings[-1], name)) in (1, 5)


@pytest.mark.parametrize(
    ("make", "device"),
    [(of_samples, "polaris-array"), (of_halls, "locatk"), (of_sweeps, "dotbot-gateway")],
)
def test_the_usual_device(tmp_path: Path, make, device: str) -> None:
    assert select_source(make(tmp_path / "run.mcap")).device == device


def test_a_device_that_does_not_exist(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no device 'nonsense'"):
        select_source(of_samples(tmp_path / "run.mcap"), "nonsense")


def test_raw_is_what_was_recorded_or_nothing(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no data that the device 'raw' sends"):
        select_source(of_samples(tmp_path / "run.mcap"), "raw")


def test_images_come_over_no_serial_port(tmp_path: Path, recordings: list[Recording]) -> None:
    from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage

    path = tmp_path / "run.mcap"
    with SessionWriter(path, system="dots") as writer:
        writer.write("/camera/image", CompressedImage(format="png", data=b"x"), START_NS)
    with pytest.raises(InputError, match="serial device") as caught:
        select_source(Session.open(path), "fake")
    assert caught.value.hint is not None
    assert "camera:" in caught.value.hint


@pytest.mark.slow
@pytest.mark.parametrize("system", SYSTEMS)
def test_simulated_sessions(system: str, tmp_path: Path) -> None:
    """They hold observations that a device can send, artifacts and truth."""
    path = tmp_path / "run.mcap"
    write_simulated_session(system, path, seed=3)
    session = Session.open(path)
    assert session.facts["system"] == system
    names = {entry.name for entry in session.attachments()}
    artifact = {"polaris": "tag.toml", "landmarks": "map.toml", "lighthouse": "scene.toml"}[system]
    assert artifact in names
    assert observations.read_truth(session)
    assert session.start_ns is not None
    assert session.end_ns is not None
    assert 10e9 < session.end_ns - session.start_ns < 60e9, "worth a look, and no long wait"
    source = select_source(session, "locatk")
    assert sum(len(data) for _, data in source.packets()) > 10_000


def test_a_camera_is_no_serial_device(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no serial port") as caught:
        write_simulated_session("dots", tmp_path / "run.mcap")
    assert caught.value.hint is not None
    assert "camera:VIDEO" in caught.value.hint
