"""Poses without orientation: empty where a format allows it, otherwise a named identity."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from locatk.core.errors import InputError
from locatk.core.geometry import quaternion_from_heading
from locatk.core.solution import Solution
from locatk.core.trajectory import Trajectory, has_orientation
from locatk.formats.exporters.trajectory_csv import write_csv
from locatk.formats.importers.poses.trajectory_csv import read_csv
from locatk.formats.sessions.solutions import write_solution

TIME_NS = 1_700_000_000_000_000_000 + 100_000_000 * np.arange(4)


@pytest.fixture
def tracks() -> tuple[Trajectory, Trajectory]:
    position = np.arange(12.0).reshape(4, 3)
    photodiode = Trajectory.from_positions(
        "dot", "floor", TIME_NS, position, np.tile(1e-6 * np.eye(3), (4, 1, 1))
    )
    heading = quaternion_from_heading(np.linspace(0.0, 1.0, 4))
    covariance = np.tile(1e-6 * np.eye(6), (4, 1, 1))
    return photodiode, Trajectory("robot", "floor", TIME_NS, position, heading, covariance)


def test_csv_has_empty_cells_and_reads_back(tracks: tuple[Trajectory, ...], tmp_path: Path) -> None:
    path = tmp_path / "poses.csv"
    write_csv(path, tracks)
    rows = [line.split(",") for line in path.read_text().splitlines()[1:]]
    assert [row[5:9] for row in rows[:4]] == [["", "", "", ""]] * 4
    assert rows[4][5:9] == ["0.0", "0.0", "0.0", "1.0"]
    photodiode, robot = read_csv(path)
    assert not has_orientation(photodiode).any()
    assert has_orientation(robot).all()
    assert np.array_equal(robot.quaternion, tracks[1].quaternion)


def test_an_unknown_heading_is_no_orientation(tracks: tuple[Trajectory, ...]) -> None:
    # Roll and pitch of a robot on a floor are known; its heading is not.
    covariance = tracks[1].covariance.copy()
    covariance[:, 5, :] = covariance[:, :, 5] = np.nan
    assert not has_orientation(replace(tracks[1], covariance=covariance)).any()


def test_an_incomplete_quaternion_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "poses.csv"
    path.write_text("time_s,device,x_m,y_m,z_m,qx,qy,qz,qw\n1,a,0,0,0,0,0,,1\n")
    with pytest.raises(InputError, match="an incomplete quaternion"):
        read_csv(path)


@pytest.mark.parametrize("form", ["csv", "parquet", "tum", "kitti", "ros2"])
def test_formats_without_empty_values_warn(
    locatk, tracks: tuple[Trajectory, ...], tmp_path: Path, form: str
) -> None:
    if form == "parquet":
        pytest.importorskip("pyarrow", reason="pyarrow is not installed")
    solved = tmp_path / "solved.mcap"
    write_solution(solved, Solution("lighthouse", "bundle", tracks), source="run.mcap")
    ending = {"kitti": "", "tum": "", "ros2": ".mcap"}.get(form, f".{form}")
    result = locatk("export", solved, "--format", form, "-o", tmp_path / f"poses{ending}")
    assert result.exit_code == 0, result.stderr
    is_named = "the orientation of dot is unknown" in result.stderr
    assert is_named == (form in ("tum", "kitti", "ros2"))
    only = locatk(
        "export", solved, "--format", form, "--device", "robot", "-o", tmp_path / f"one{ending}"
    )
    assert "is unknown" not in only.stderr
