"""Samples of inertial measurement units: exact round trips, and a reader of another project."""

from __future__ import annotations

from pathlib import Path

import mcap.reader
import numpy as np
import pytest
from mcap_protobuf.decoder import DecoderFactory

from locatk.core.errors import FormatError, InputError
from locatk.core.inertial import InertialSamples
from locatk.core.lighthouse.recording import Sweeps
from locatk.formats.sessions import observations
from locatk.formats.sessions.messages import IMU
from locatk.formats.sessions.reader import Session
from locatk.formats.sessions.writer import SessionWriter

START = 1_690_000_000_000_000_000
NO_SWEEPS = Sweeps(
    ("cf",),
    np.array([START]),
    *(np.array([value], np.int32) for value in (0, 0, 1, -1, 0)),
    np.array([40_000.0]),
)


def make_samples(n: int, device: str = "cf", seed: int = 0) -> InertialSamples:
    rng = np.random.default_rng(seed)
    time_ns = START + np.cumsum(rng.integers(1, 20_000_000, n))
    return InertialSamples(device, time_ns, rng.normal(size=(n, 3)), rng.normal(size=(n, 3)))


def write(path: Path, *imu: InertialSamples) -> Session:
    observations.write_session(path, system="lighthouse", sweeps=NO_SWEEPS, imu=imu)
    return Session.open(path)


def test_samples_survive(tmp_path: Path) -> None:
    written = [make_samples(3000, "a"), make_samples(50, "b", 1)]
    written[1].acceleration[7] = np.nan
    read = observations.read_imu(write(tmp_path / "s.mcap", *written))
    for before, after in zip(written, read, strict=True):
        assert before.device == after.device
        for name in ("time_ns", "acceleration", "angular_rate"):
            np.testing.assert_array_equal(getattr(before, name), getattr(after, name), strict=True)


def test_a_sensor_that_is_missing_is_not_stored(tmp_path: Path) -> None:
    samples = make_samples(20)
    samples.angular_rate[:] = np.nan
    write(tmp_path / "s.mcap", samples)
    with (tmp_path / "s.mcap").open("rb") as stream:
        reader = mcap.reader.make_reader(stream, decoder_factories=[DecoderFactory()])
        messages = [
            m for _, channel, _, m in reader.iter_decoded_messages() if "imu" in channel.topic
        ]
    assert {len(message.angular_rate_rad_s) for message in messages} == {0}
    values = np.concatenate([message.acceleration_m_s2 for message in messages])
    np.testing.assert_array_equal(values.reshape(-1, 3), samples.acceleration)
    [read] = observations.read_imu(Session.open(tmp_path / "s.mcap"))
    assert np.isnan(read.angular_rate).all()


def test_a_session_without_imu_has_none(tmp_path: Path) -> None:
    assert observations.read_imu(write(tmp_path / "s.mcap")) == []


def test_impossible_samples_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "s.mcap"
    late = make_samples(5)
    late.time_ns[3] = late.time_ns[2]
    infinite = make_samples(5)
    infinite.angular_rate[4, 1] = np.inf
    old = make_samples(5)
    old.time_ns[0] = -1
    for samples, text in (
        (late, "sample 3 is not later"),
        (infinite, "sample 4 has an infinite angular_rate"),
        (old, "sample 0 is older than 1970"),
    ):
        with pytest.raises(InputError, match=text):
            write(path, samples)
    with pytest.raises(InputError, match="two IMUs of device 'cf'"):
        write(path, make_samples(5), make_samples(5))
    assert not path.exists()


def test_impossible_samples_of_other_writers_are_refused(tmp_path: Path) -> None:
    samples = make_samples(5)
    columns = {
        "time_ns": samples.time_ns[::-1],
        "acceleration_m_s2": samples.acceleration,
        "angular_rate_rad_s": samples.angular_rate,
    }
    with SessionWriter(tmp_path / "s.mcap", system="lighthouse") as writer:
        writer.write("/imu/cf", IMU.pack({"device": "cf"}, columns), START)
    with pytest.raises(FormatError, match="sample 1 is not later") as error:
        observations.read_imu(Session.open(tmp_path / "s.mcap"))
    assert error.value.where == "/imu/cf"
