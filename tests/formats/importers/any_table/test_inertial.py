"""IMUs in tables of any layout: units, names, rows without samples, and other sensors."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from locatk.core.errors import InputError
from locatk.core.inertial import InertialSamples
from locatk.formats.importers.any_table.columns import guess_columns
from locatk.formats.importers.any_table.inertial import read_imu
from locatk.formats.sessions import field_samples
from locatk.formats.sessions.inertial import read_imu as read_stored
from locatk.formats.sessions.reader import Session
from locatk.formats.tables.dialects import read_any_table

STANDARD_GRAVITY = 9.80665

ACCELERATIONS = {
    "ax [m/s2]": 1.0,
    "accel_x (m/s^2)": 1.0,
    "acc_x_m_s2": 1.0,
    "imu.linear_acceleration.x_mps2": 1.0,
    "Acceleration X [m/s\u00b2]": 1.0,
    "ax_g": STANDARD_GRAVITY,
    "accelerometer_x (mg)": STANDARD_GRAVITY / 1000,
}
RATES = {
    "gx [rad/s]": 1.0,
    "gyro_x_rad_s": 1.0,
    "angular_velocity.x (rad/s)": 1.0,
    "gyr_x [\u00b0/s]": np.pi / 180,
    "Gyro X (dps)": np.pi / 180,
    "gx_deg_s": np.pi / 180,
    "omega_x [deg/s]": np.pi / 180,
}
"""Headers of the axis x, and the factor of the unit."""


def import_text(
    path: Path, text: str, units: tuple[str, ...] = ()
) -> tuple[list[InertialSamples], list[str]]:
    path.write_text(text, encoding="utf-8")
    table = read_any_table(path)
    return read_imu(table, guess_columns(table, {}, units), device="d", units=units)


def axes(header: str) -> list[str]:
    """Return the headers of all axes of the one of x."""
    at = max(header.lower().rfind(f"{before}x") for before in ("_", ".", " ", "a", "g"))
    return [header[: at + 1] + axis + header[at + 2 :] for axis in "xyz"]


@settings(
    max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None
)
@given(
    acceleration=st.sampled_from(sorted(ACCELERATIONS)),
    rate=st.sampled_from(sorted(RATES)),
    values=st.lists(st.lists(st.floats(-100, 100), min_size=6, max_size=6), min_size=1, max_size=6),
    dialect=st.sampled_from([(",", "."), (";", ","), ("\t", ".")]),
    order=st.permutations(range(7)),
)
def test_the_same_samples_in_any_form(
    acceleration: str,
    rate: str,
    values: list[list[float]],
    dialect: tuple[str, str],
    order: list[int],
    tmp_path: Path,
) -> None:
    header = ["t_ms", *axes(acceleration), *axes(rate)]
    lines = [[str(5 * k), *map(repr, row)] for k, row in enumerate(values)]
    rows = [header, *([cell.replace(".", dialect[1]) for cell in line] for line in lines)]
    text = "\n".join(dialect[0].join(row[k] for k in order) for row in rows)
    (samples,), _ = import_text(tmp_path / "imu.csv", text)
    expected = np.array(values)
    assert samples.time_ns.tolist() == [5_000_000 * k for k in range(len(values))]
    np.testing.assert_allclose(
        samples.acceleration, expected[:, :3] * ACCELERATIONS[acceleration], rtol=1e-12
    )
    np.testing.assert_allclose(samples.angular_rate, expected[:, 3:] * RATES[rate], rtol=1e-12)


def test_accelerometer_and_gyroscope_may_be_sampled_at_different_times(tmp_path: Path) -> None:
    text = "t_s,ax_g,ay_g,az_g,gx_dps,gy_dps,gz_dps\n0,0,0,1,,,\n1,,,,180,0,0\n2,,,,,,\n"
    (samples,), warnings = import_text(tmp_path / "imu.csv", text)
    assert samples.time_ns.tolist() == [0, 10**9]
    np.testing.assert_allclose(samples.acceleration[0], [0, 0, STANDARD_GRAVITY])
    assert np.isnan(samples.acceleration[1]).all()
    assert np.isnan(samples.angular_rate[0]).all()
    np.testing.assert_allclose(samples.angular_rate[1], [np.pi, 0, 0])
    assert warnings == []


def test_samples_repeated_by_a_join_are_read_once(tmp_path: Path) -> None:
    """A table of sweeps repeats the last sample of the IMU in each row of the same time."""
    text = "t_us,channel,count,ax_g,ay_g,az_g\n0,1,1,0,0,1\n0,1,2,0,0,1\n9,1,3,0,0,1\n"
    (samples,), _ = import_text(tmp_path / "imu.csv", text)
    assert samples.time_ns.tolist() == [0, 9000]


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("t_s,ax,ay,az\n0,0,0,1\n", "the unit of column 'ax' is missing"),
        ("t_s,ax_g,ay_g,az_g\n0,0,,1\n", r"imu\.csv:2: empty cell in column 'ay_g'"),
        ("t_s,ax_g,ay_g,az_g\n0,0,inf,1\n", r"imu\.csv:2: inf in column 'ay_g'"),
        ("t_s,ax_g,ay_g,az_g\n1,0,0,1\n0,0,0,1\n", r"imu\.csv:3: the time goes backwards"),
        (
            "t_s,channel,count,ax_g,ay_g,az_g\n0,1,1,0,0,1\n0,1,2,0,0,2\n",
            r"imu\.csv:3: another sample of the IMU has the same time",
        ),
    ],
)
def test_what_is_not_clear_is_refused(text: str, problem: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=problem) as error:
        import_text(tmp_path / "imu.csv", text)
    assert error.value.hint


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("t_s,ax_mg,ay_mg,az_mg\n0,0,0,9.8\n", "the median acceleration is 0.0961 m/s2"),
        ("t_s,ax_g,ay_g,az_g\n0,0,0,9.8\n", "the median acceleration is 96.1 m/s2"),
        ("t_s,gx_rad_s,gy_rad_s,gz_rad_s\n0,0,0,60\n", "the median angular rate is 60 rad/s"),
    ],
)
def test_an_unlikely_unit_is_remarked(text: str, words: str, tmp_path: Path) -> None:
    _, (warning,) = import_text(tmp_path / "imu.csv", text)
    assert words in warning


def test_an_axis_alone_is_no_accelerometer(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text("t_s,ax,bx_ut,by_ut,bz_ut\n0,1,20,0,40\n")
    guess = guess_columns(read_any_table(path), {}, ())
    assert not guess.has_imu
    assert guess.ignored == ("ax",)


# ---- on the command line


def test_magnetometers_with_an_imu(locatk: Callable[..., Any], tmp_path: Path) -> None:
    """The session of magnetometers contains the samples of the IMU, at its own rate."""
    log, output = tmp_path / "log.csv", tmp_path / "run.mcap"
    lines = ["ms,mx,my,mz,ax,ay,az,gx,gy,gz"]
    for k in range(20):
        magnetometer = f"20,{k},40" if k % 2 == 0 else ",,"
        lines.append(f"{10 * k},{magnetometer},0,0,{1 + 0.01 * k:.2f},0,{k},0")
    log.write_text("\n".join(lines))
    result = locatk(
        *("import", "table", log, "--columns", "t=ms", "--units", "ms,uT,g,dps"),
        *("-o", output, "--json"),
    )
    assert result.exit_code == 0, result.stderr
    facts = json.loads(result.stdout)
    assert (facts["samples"], facts["imu_samples"]) == (10, 20)
    session = Session.open(output)
    (imu,) = read_stored(session)
    assert imu.device == "bar"
    np.testing.assert_allclose(imu.angular_rate[:, 1], np.deg2rad(np.arange(20)))
    (samples,) = field_samples.read_magnetometers(session)
    assert samples.time_ns.tolist() == [20_000_000 * k for k in range(10)]


def test_an_imu_alone(locatk: Callable[..., Any], tmp_path: Path) -> None:
    log, output = tmp_path / "log.csv", tmp_path / "run.mcap"
    log.write_text("t_s,device,ax_g,ay_g,az_g\n0,a,0,0,1\n0,b,0,0,1\n1,a,0,0,1\n")
    result = locatk("import", "table", log, "-o", output)
    assert result.exit_code == 0, result.stderr
    assert "cannot be solved" in result.stderr
    assert [(each.device, len(each)) for each in read_stored(Session.open(output))] == [
        ("a", 2),
        ("b", 1),
    ]


def test_hall_sensors_with_an_imu(locatk: Callable[..., Any], tmp_path: Path) -> None:
    log, output = tmp_path / "log.csv", tmp_path / "run.mcap"
    lines = ["t_ms,x_m,y_m,heading_deg,front_mt,left_mt,rear_mt,right_mt,gx,gy,gz"]
    lines += [
        f"{20 * k},{0.004 * k:.3f},0,0,{k % 7},{k % 5},{k % 3},{k % 2},0,0,{k}" for k in range(30)
    ]
    log.write_text("\n".join(lines))
    result = locatk(
        *("import", "table", log, "--circle", "25", "--units", "dps"),
        *("--clock", "ms, 32 bit", "-o", output),
    )
    assert result.exit_code == 0, result.stderr
    (imu,) = read_stored(Session.open(output))
    assert (imu.device, len(imu)) == ("robot", 30)
