"""CSV files of a Crazyflie's log variables: of cfclient, and of programs with cflib."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from locatk.core.errors import FormatError, InputError, MissingDataError
from locatk.core.geometry import matrix_from_quaternion
from locatk.core.lighthouse.channels import period_counts
from locatk.formats.importers.crazyflie_csv import read_crazyflie_csv
from locatk.formats.sessions import observations
from locatk.formats.sessions.reader import Session

START_NS = 1_000_000_000
"""Time of the first sample in a session without dates."""

POSITION = ("stateEstimate.x", "stateEstimate.y", "stateEstimate.z")
QUATERNION = ("stateEstimate.qx", "stateEstimate.qy", "stateEstimate.qz", "stateEstimate.qw")
IMU = ("acc.x", "acc.y", "acc.z", "gyro.x", "gyro.y", "gyro.z")


def write(path: Path, header: Sequence[str], rows: Any) -> Path:
    lines = [",".join(header), *(",".join(map(str, row)) for row in rows)]
    path.write_text("\n".join(lines) + "\n")
    return path


def values(flight: Any, crazyflie: ModuleType, t: np.ndarray) -> dict[str, np.ndarray]:
    """Log variables of a flight by name."""
    rotation = flight.rotation(t)
    columns = np.hstack(
        [
            flight.acceleration(t) / 9.80665,
            np.rad2deg(flight.angular_rate(t)),
            flight.position(t),
            crazyflie.to_quaternion(rotation),
        ]
    )
    return dict(zip((*IMU, *POSITION, *QUATERNION), columns.T, strict=True))


def check(session: Any, flight: Any, t: np.ndarray, *, tolerance_m: float = 1e-6) -> None:
    """IMU and estimate are those of the flight at times ``t`` after the first sample."""
    [imu], [track] = session.imu, session.onboard
    np.testing.assert_allclose((imu.time_ns - START_NS) * 1e-9, t, atol=1e-9)
    np.testing.assert_allclose(imu.acceleration, flight.acceleration(t), atol=1e-9)
    np.testing.assert_allclose(imu.angular_rate, flight.angular_rate(t), atol=1e-9)
    at = (track.time_ns - START_NS) * 1e-9
    assert len(at) >= len(t) - 2
    np.testing.assert_allclose(track.position, flight.position(at), atol=tolerance_m)
    rotation = matrix_from_quaternion(track.quaternion)
    np.testing.assert_allclose(rotation, flight.rotation(at), atol=max(tolerance_m, 1e-6))


def test_files_of_cfclient_are_joined_over_the_wrap(crazyflie: ModuleType, tmp_path: Path) -> None:
    """The blocks are not sampled at the same times, and the counter of 24 bits wraps."""
    flight, t = crazyflie.Flight(), np.arange(0, 4, 0.01)
    ms = np.rint(1e3 * t).astype(int) + (1 << 24) - 1500
    imu = values(flight, crazyflie, t)
    paths = []
    for number, (names, shift) in enumerate(((IMU, 0), (POSITION, 3), (QUATERNION, 7))):
        column = values(flight, crazyflie, t + shift / 1e3) if shift else imu
        if names == QUATERNION:  # Opposite quaternions are the same rotation.
            sign = np.where(np.arange(len(t)) % 3, 1.0, -1.0)
            column = {name: sign * column[name] for name in QUATERNION}
        rows = zip((ms + shift) % (1 << 24), *(column[name] for name in names), strict=True)
        path = tmp_path / f"Block{number}-20240531T12-03-01.csv"
        paths.append(write(path, ["Timestamp", *names], rows))
    session = read_crazyflie_csv(paths)
    # Between samples of 10 ms, positions are interpolated with an error of a t^2 / 8.
    check(session, flight, t, tolerance_m=1e-4)
    assert session.lost is None
    assert session.facts["files"].count("Block") == 3


def test_a_file_may_begin_after_the_wrap_of_another(crazyflie: ModuleType, tmp_path: Path) -> None:
    flight, t = crazyflie.Flight(), np.arange(0, 2, 0.01)
    column = values(flight, crazyflie, t)
    ms = (np.rint(1e3 * t).astype(int) + (1 << 24) - 500) % (1 << 24)
    first = write(
        tmp_path / "a.csv",
        ["Timestamp", *IMU],
        zip(ms, *(column[name] for name in IMU), strict=True),
    )
    late = slice(60, None)
    second = write(
        tmp_path / "b.csv",
        ["Timestamp", *POSITION],
        zip(ms[late], *(column[name][late] for name in POSITION), strict=True),
    )
    [track] = read_crazyflie_csv([first, second]).onboard
    at = (track.time_ns - START_NS) * 1e-9
    np.testing.assert_allclose(at, t[late], atol=1e-9)
    np.testing.assert_allclose(track.position, flight.position(at), atol=1e-9)


@pytest.mark.parametrize(
    ("header", "unit"),
    [
        ("Timestamp", 1000), ("timestamp_ms", 1000), ("time_s", 1), ("time [s]", 1), ("t", 1),
        ("Time", 1_000_000), ("ms", 1000), ("timestamp (us)", 1_000_000),
    ],
)  # fmt: skip
@pytest.mark.parametrize("spelling", ["stateEstimate.x", "state_estimate_x", "STATEESTIMATE X"])
def test_spellings_and_units_are_recognised(
    crazyflie: ModuleType, tmp_path: Path, header: str, unit: int, spelling: str
) -> None:
    flight, t = crazyflie.Flight(), np.arange(0, 1, 0.02)
    column = values(flight, crazyflie, t)
    names = [header, *(spelling[:-1] + n[-1] for n in POSITION), *QUATERNION, *IMU, "pm.vbat"]
    ordered = [column[name] for name in (*POSITION, *QUATERNION, *IMU)]
    rows = zip(unit * (12.5 + t), *ordered, 3.9 + t, strict=True)
    session = read_crazyflie_csv([write(tmp_path / "log.csv", names, rows)])
    check(session, flight, t)
    assert session.facts["not_used"] == "pm.vbat"


def test_rows_of_single_values_are_collected(crazyflie: ModuleType, tmp_path: Path) -> None:
    flight, t = crazyflie.Flight(), np.arange(0, 1, 0.02)
    column = values(flight, crazyflie, t)
    rows: list[tuple[object, ...]] = []
    for k, time in enumerate(t):
        rows += [(f"{time:.3f}", name, column[name][k]) for name in column]
        rows.append((f"{time:.3f}", "radio.state", "connected"))
    path = write(tmp_path / "log.csv", ["time", "name", "value"], rows)
    check(read_crazyflie_csv([path]), flight, t)


@pytest.mark.parametrize(
    ("unit_s", "start_s"),
    [(1e-3, 12.5), (1e-3, 1_717_156_981.0), (1e-6, 1_717_156_981.0), (1e-6, 2.0), (1.0, 12.5)],
)
def test_units_are_recognised_if_blocks_are_sampled_in_turn(
    tmp_path: Path, unit_s: float, start_s: float
) -> None:
    """Most steps of time are then a tenth of the period of a block."""
    groups = (IMU[:3], IMU[3:], POSITION)
    rows = [
        (round((start_s + 0.01 * k + 0.001 * phase) / unit_s, 4), name, 1.0)
        for k in range(100)
        for phase, names in enumerate(groups)
        for name in names
    ]
    session = read_crazyflie_csv([write(tmp_path / "log.csv", ["time", "name", "value"], rows)])
    [track] = session.onboard
    assert 1e-9 * (track.time_ns[-1] - track.time_ns[0]) == pytest.approx(0.99, abs=1e-6)
    is_dated = start_s > 1e9
    assert 1e-9 * track.time_ns[0] == pytest.approx(start_s + 0.002 if is_dated else 1.002)


def test_rows_may_lack_the_values_of_other_blocks(crazyflie: ModuleType, tmp_path: Path) -> None:
    flight, t = crazyflie.Flight(), np.arange(0, 1, 0.02)
    column = values(flight, crazyflie, t)
    rows = []
    for k, time in enumerate(np.rint(1e3 * t).astype(int)):
        rows.append([time, *(column[n][k] if n in IMU else "" for n in column)])
        rows.append([time, *("" if n in IMU else column[n][k] for n in column)])
    session = read_crazyflie_csv([write(tmp_path / "log.csv", ["Timestamp", *column], rows)])
    check(session, flight, t)
    assert session.warnings == ["no angles of Lighthouse stations: the session cannot be solved"]


def test_angles_of_two_blocks_are_joined_over_180_degrees(tmp_path: Path) -> None:
    ms = 10 * np.arange(100)
    yaw = (150 + ms / 10 + 180) % 360 - 180
    names = ["Timestamp", *POSITION, "stateEstimate.roll", "stateEstimate.pitch"]
    poses = write(tmp_path / "poses.csv", names, [(t, 0, 0, 1, 0, 0) for t in ms])
    angles = write(
        tmp_path / "yaw.csv", ["Timestamp", "stateEstimate.yaw"], zip(ms + 5, yaw, strict=True)
    )
    session = read_crazyflie_csv([poses, angles])
    [track] = session.onboard
    heading = np.unwrap(np.arctan2(*matrix_from_quaternion(track.quaternion)[:, [1, 0], 0].T))
    np.testing.assert_allclose(np.rad2deg(heading), 149.5 + np.arange(1, 100), atol=1e-9)
    assert not [line for line in session.warnings if "on-board" in line]  # The first one only.


@pytest.mark.parametrize(
    ("known_ms", "expected", "lost"),
    [(range(0, 501, 100), 51, ["49"]), ((1, 999), 100, [])],  # Until 0.5 s; never near enough.
)
def test_positions_without_an_orientation_are_not_lost_silently(
    tmp_path: Path, known_ms: Sequence[int], expected: int, lost: list[str]
) -> None:
    ms = np.arange(0, 1000, 10)
    positions = write(
        tmp_path / "a.csv", ["Timestamp", *POSITION], [(t, t / 1000, 0, 1) for t in ms]
    )
    rotations = write(
        tmp_path / "b.csv", ["Timestamp", *QUATERNION], [(t, 0, 0, 0, 1) for t in known_ms]
    )
    session = read_crazyflie_csv([positions, rotations])
    [track] = session.onboard
    assert len(track) == expected
    losses = [line for line in session.warnings if "on-board positions are left out" in line]
    assert [line.split()[0] for line in losses] == lost


def test_a_position_and_a_packed_orientation_belong_together(tmp_path: Path) -> None:
    header = ["Timestamp", *POSITION, "stateEstimateZ.quat"]
    packed = 3 << 30 | 255 << 20  # x is half of sqrt(1/2), and w is the largest.
    rows = [(10 * k, 0, 0, 1, packed if k < 4 else 2**33) for k in range(5)]
    [track] = read_crazyflie_csv([write(tmp_path / "log.csv", header, rows)]).onboard
    assert len(track) == 4  # A number of 33 bits is no orientation.
    np.testing.assert_allclose(track.quaternion[:, 0], np.sqrt(0.5) * 255 / 511)


def test_dates_of_the_computer_are_kept(tmp_path: Path) -> None:
    iso = [f"2024-05-31T12:03:01.{k}00000Z" for k in range(5)]
    rows = [(time, 0.0, 0.0, 1.0) for time in iso]
    path = write(tmp_path / "log.csv", ["time", *IMU[:3]], rows)
    [imu] = read_crazyflie_csv([path]).imu
    assert imu.time_ns[0] == 1_717_156_981_000_000_000
    assert np.isnan(imu.angular_rate).all()
    seconds = [(1_717_156_981 + k / 10, 0.0, 0.0, 1.0) for k in range(5)]
    path = write(tmp_path / "log.csv", ["time", *IMU[:3]], seconds)
    [imu] = read_crazyflie_csv([path]).imu
    assert imu.time_ns[0] == 1_717_156_981_000_000_000


def test_sampled_angles_become_sweeps(tmp_path: Path) -> None:
    names = [f"lighthouse.rawAngle{station}{axis}lh2" for station in (0, 1) for axis in "xy"]
    angles = [(0.0, 0.0, 0.0, 0.0), (0.1, 0.2, -0.3, 0.4), (0.1, 0.21, -0.3, 0.4)]
    rows = [(1000 + 10 * k, *each) for k, each in enumerate(angles)]
    path = write(tmp_path / "log.csv", ["Timestamp", *names], rows)
    session = read_crazyflie_csv([path])
    sweeps = session.sweeps
    order = np.lexsort((sweeps.sweep, sweeps.channel, sweeps.time_ns))
    found = [(int(sweeps.channel[k]), int(sweeps.sweep[k])) for k in order]
    assert found == [(1, 0), (1, 1), (2, 0), (2, 1), (1, 1)]
    assert (sweeps.time_ns[order] - START_NS).tolist() == [10**7] * 4 + [2 * 10**7]
    turns = sweeps.count[order] / period_counts(sweeps.channel[order])
    # Straight ahead is a third of a rotation for the first plane, two thirds for the second.
    expected = np.array([0.1, 0.2, -0.3, 0.4, 0.21]) / (2 * np.pi)
    expected += np.array([1, 2, 1, 2, 2]) / 3
    np.testing.assert_allclose(turns, expected, atol=1e-12)
    assert len(session.receivers["crazyflie"]) == 4
    assert "3 samples repeat one" in session.facts["sweeps"]
    assert session.facts["clock"] == "since the first sample"
    # An angle of two blocks is used once.
    again = write(tmp_path / "again.csv", ["Timestamp", names[1]], [(1005, 0.2), (1015, 0.21)])
    assert len(read_crazyflie_csv([again, path]).sweeps) == len(sweeps)


def test_a_restart_is_reported(tmp_path: Path) -> None:
    times = [50_000, 50_010, 300, 310, 320, 330]
    path = write(tmp_path / "log.csv", ["Timestamp", *IMU[:3]], [(t, 0, 0, 1) for t in times])
    session = read_crazyflie_csv([path])
    assert session.lost is not None
    assert "2 rows are left out" in session.lost
    assert len(session.imu[0]) == 4


def test_unusable_files_are_refused(tmp_path: Path) -> None:
    battery = write(tmp_path / "battery.csv", ["Timestamp", "pm.vbat"], [(10, 3.9), (20, 3.8)])
    timeless = write(tmp_path / "timeless.csv", [*IMU[:3]], [(0, 0, 1), (0, 0, 1)])
    wrong = write(tmp_path / "wrong.csv", ["Timestamp", *IMU[:3]], [(10, 0, 0, 1), (20, 0, "x", 1)])
    early = write(tmp_path / "early.csv", ["Timestamp", *IMU[:3]], [(10, 0, 0, 1), (20, 0, 0, 1)])
    late = write(tmp_path / "late.csv", ["Timestamp", *IMU[3:]], [(90, 0, 0, 1), (95, 0, 0, 1)])
    for paths, kind, text in (
        ([battery], InputError, "no log variable that can be used"),
        ([timeless], FormatError, "a column of times is missing"),
        ([wrong], InputError, "'x' instead of a number"),
        ([early, late], InputError, "no time in common"),
        ([tmp_path / "none.csv"], MissingDataError, "no such file"),
    ):
        with pytest.raises(kind, match=text) as error:
            read_crazyflie_csv(paths)
        assert error.value.hint
    with pytest.raises(InputError) as unused:
        read_crazyflie_csv([battery])
    assert "stateEstimate" in str(unused.value.hint)
    assert "pm.vbat" in str(unused.value.hint)


def test_the_command_writes_a_session(locatk: Any, crazyflie: ModuleType, tmp_path: Path) -> None:
    flight, t = crazyflie.Flight(), np.arange(0, 1, 0.02)
    column = values(flight, crazyflie, t)
    rows = zip(np.rint(1e3 * t).astype(int), *column.values(), strict=True)
    log, out = write(tmp_path / "log.csv", ["Timestamp", *column], rows), tmp_path / "out.mcap"
    result = locatk("import", "crazyflie-csv", log, "-o", out, "--device", "cf7")
    assert result.exit_code == 0, result.stderr
    assert "50 samples of the IMU, 50 on-board poses" in result.stderr
    session = Session.open(out)
    assert observations.read_imu(session)[0].device == "cf7"
    [track] = observations.read_onboard(session)
    assert (track.device, track.frame, len(track)) == ("cf7", "room", 50)
    tum = tmp_path / "poses.tum"
    assert locatk("export", out, "--onboard", "--format", "tum", "-o", tum).exit_code == 0
    np.testing.assert_allclose(np.loadtxt(tum)[:, 1:4], flight.position(t), atol=1e-9)
    solved = locatk("solve", out, "-o", tmp_path / "solved.mcap")
    assert solved.exit_code == 1
    assert "no lighthouse sweeps" in solved.stderr
