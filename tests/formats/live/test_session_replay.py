"""Decoded observations of a session as an input."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from locatk.core.inertial import InertialSamples
from locatk.core.lighthouse.recording import Sweeps
from locatk.core.trajectory import Trajectory
from locatk.formats.capture.links import LinkEnded, SourceError
from locatk.formats.capture.reader_thread import ReceivedData
from locatk.formats.live.observations import AttachedArtifacts, RecordConverter
from locatk.formats.live.session_replay import PIECE_NS, ObservationsIntake, ObservationsPort
from locatk.formats.sessions.observations import write_session
from locatk.formats.sessions.reader import Session
from locatk.formats.sessions.writer import SessionWriter

START_NS = 1_700_000_000_000_000_000


@pytest.fixture
def session(tmp_path: Path) -> Path:
    """Sweeps of two devices, and odometry and IMU of one, over a tenth of a second."""
    rng = np.random.default_rng(3)
    time_ns = START_NS + np.sort(rng.integers(0, 100_000_000, 60))
    sweeps = Sweeps(
        devices=("red", "blue"),
        time_ns=time_ns,
        device=rng.integers(0, 2, 60),
        sensor=np.zeros(60, int),
        channel=rng.integers(1, 3, 60),
        polynomial=np.full(60, -1),
        sweep=np.full(60, -1),
        count=rng.uniform(0, 900_000 / 8, 60),
    )
    steps_ns = START_NS + 5_000_000 * np.arange(20)
    odometry = Trajectory(
        "red",
        "odometry",
        steps_ns,
        np.column_stack([np.arange(20.0), np.zeros((20, 2))]),
        np.tile([0.0, 0.0, 0.0, 1.0], (20, 1)),
        np.full((20, 6, 6), np.nan),
    )
    imu = InertialSamples("red", steps_ns + 1, rng.normal(size=(20, 3)), rng.normal(size=(20, 3)))
    path = tmp_path / "run.mcap"
    write_session(path, system="lighthouse", sweeps=sweeps, odometry=[odometry], imu=[imu])
    return path


def read_all(path: Path) -> list[ReceivedData]:
    link = ObservationsPort("replay:run.mcap", Session.open(path), 0.0).open()
    received = []
    while True:
        try:
            data = link.read(0.0)
        except LinkEnded:
            return received
        assert link.time_ns is not None
        received.append(ReceivedData(link.time_ns, data, sum(item.size for item in data)))


def test_all_observations_pass_by_in_the_order_of_time(session: Path) -> None:
    received = read_all(session)
    times = [each.time_ns for each in received]
    assert times == sorted(times)
    assert len(received) == 10
    intake, converter = ObservationsIntake(), RecordConverter(AttachedArtifacts({}))
    found = [each for data in received for each in converter.observations(intake.decode([data]))]
    sweeps = [each for each in found if isinstance(each, Sweeps)]
    assert sum(map(len, sweeps)) == 60
    assert {name for each in sweeps for name in each.devices} == {"red", "blue"}
    odometry = [each for each in found if isinstance(each, Trajectory)]
    assert np.concatenate([each.position[:, 0] for each in odometry]).tolist() == list(range(20))
    inertial = [each for each in found if isinstance(each, InertialSamples)]
    assert sum(map(len, inertial)) == 20
    for each in received:
        newest = max(int(item.batch.time_ns[-1]) for item in each.data)
        oldest = min(int(item.batch.time_ns[0]) for item in each.data)
        assert each.time_ns == newest
        assert newest - oldest < PIECE_NS


def test_the_system_is_that_of_the_observations(session: Path) -> None:
    intake = ObservationsIntake()
    assert intake.system == ""
    intake.decode(read_all(session))
    assert intake.system == "lighthouse"


def test_a_session_without_observations_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "empty.mcap"
    with SessionWriter(path, system="lighthouse"):
        pass
    with pytest.raises(SourceError, match="no observations"):
        ObservationsPort("replay:empty.mcap", Session.open(path), 0.0).open()


def test_its_devices_are_known_before_data_come(session: Path) -> None:
    port = ObservationsPort("replay:run.mcap", Session.open(session), 0.0)
    assert sorted(port.devices) == ["blue", "red"]
