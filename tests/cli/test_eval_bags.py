"""``locatk eval`` and ``locatk report`` with poses in bags of ROS, written by rosbags."""

from __future__ import annotations

import csv
import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from click.testing import Result

from locatk.core.geometry import quaternion_from_heading
from locatk.core.solution import Solution
from locatk.core.trajectory import Trajectory
from locatk.formats.exporters.tum import write_tum
from locatk.formats.sessions.solutions import write_solution

Locatk = Callable[..., Result]

START_NS = 1_700_000_000_000_000_000
N = 200


def drive(frame: str = "floor") -> Trajectory:
    """True poses on a curve in space."""
    time = 0.05 * np.arange(N)
    position = np.column_stack([np.cos(0.5 * time), np.sin(0.7 * time), 0.1 * time])
    time_ns = START_NS + np.round(time * 1e9).astype(np.int64)
    quaternion = quaternion_from_heading(0.3 * time)
    return Trajectory("kiwi", frame, time_ns, position, quaternion, np.full((N, 6, 6), np.nan))


def estimate(frame: str = "floor") -> Trajectory:
    """Poses with errors of 3 mm, as their covariance says."""
    true = drive(frame)
    error = np.random.default_rng(5).normal(0, 3e-3, (N, 3))
    covariance = np.tile(np.diag([9e-6, 9e-6, 9e-6, 1e-4, 1e-4, 1e-4]), (N, 1, 1))
    return replace(true, position=true.position + error, covariance=covariance)


@pytest.fixture
def solved(tmp_path: Path) -> Path:
    path = tmp_path / "solved.mcap"
    write_solution(path, Solution("dots", "lattice", (estimate(),)), source="run.mcap")
    return path


def bag(ros_bags: ModuleType, path: Path, storage: str = "sqlite3") -> Path:
    """A bag with the truth, the estimate and a wrong pose of the same robot."""
    make, true, mine = ros_bags.Messages(storage), drive(), estimate()
    messages = []
    for k, time in enumerate(true.time_ns.tolist()):
        pose = true.position[k], true.quaternion[k]
        own = mine.position[k], mine.quaternion[k], mine.covariance[k]
        half = true.position[k] / 2, (0, 0, 0, 1)
        rest = true.position[k] / 2, true.quaternion[k]
        messages += [
            ("/mocap", time, make.pose_stamped(time, "floor", *pose)),
            ("/slam", time, make.odometry(time, "floor", *own)),
            ("/far", time, make.pose_stamped(time, "floor", pose[0] + 1, pose[1])),
            ("/tf", time, make.tf(make.transform(time, "floor", "odom", *half))),
            ("/tf", time, make.tf(make.transform(time, "odom", "base", *rest))),
        ]
    return Path(ros_bags.write_bag(path, storage, messages))


def result(locatk: Locatk, *words: object) -> dict:
    done = locatk("eval", *words, "--json")
    assert done.exit_code == 0, done.stderr
    return dict(json.loads(done.stdout))


@pytest.mark.slow
@pytest.mark.parametrize("storage", ["sqlite3", "mcap", "ros1"])
def test_a_bag_and_a_text_have_the_same_errors(
    tmp_path: Path, ros_bags: ModuleType, locatk: Locatk, solved: Path, storage: str
) -> None:
    path = bag(ros_bags, tmp_path / "drive", storage)
    write_tum(tmp_path / "truth.tum", drive())
    by_text = result(locatk, solved, "--truth", tmp_path / "truth.tum")
    assert by_text["rmse_m"] == pytest.approx(3e-3 * 3**0.5, rel=0.1)
    for truth in ("/mocap", "mocap", "/tf:floor.base"):
        by_bag = result(locatk, solved, "--truth", f"{path}#{truth}")
        assert by_bag["n"] == N
        for error in ("translation_m", "rotation_deg"):
            for name, value in by_text["ape"][error].items():
                assert by_bag["ape"][error][name] == pytest.approx(value, abs=1e-9), name
    from_bag = result(locatk, f"{path}#/slam", "--truth", tmp_path / "truth.tum")
    assert from_bag["rmse_m"] == pytest.approx(by_text["rmse_m"], abs=1e-9)
    assert from_bag["nees"]["dof"] == 6
    assert from_bag["nees"]["mean"] == pytest.approx(by_text["nees"]["mean"], abs=1e-6)
    paired = result(locatk, solved, "--truth", path, "--pair", "kiwi=/far")
    assert paired["rmse_m"] == pytest.approx(3**0.5, rel=0.01)


@pytest.mark.slow
def test_topics_have_to_be_paired(
    tmp_path: Path, ros_bags: ModuleType, locatk: Locatk, solved: Path
) -> None:
    path = bag(ros_bags, tmp_path / "drive")
    done = locatk("eval", solved, "--truth", path)
    assert (done.exit_code, done.stderr.count("\n")) == (1, 1)
    assert "--pair NAME=NAME: one of kiwi, and one of /far, /mocap, /slam, /tf:" in done.stderr
    assert "FILE#NAME reads one of them only" in done.stderr
    # Topics of the same name in two bags are.
    assert result(locatk, path, "--truth", path)["max_m"] == 0.0


def test_our_exported_bag_is_the_same_device(
    tmp_path: Path, ros_bags: ModuleType, locatk: Locatk, solved: Path
) -> None:
    path = tmp_path / "exported.mcap"
    assert locatk("export", solved, "--format", "ros2", "-o", path).exit_code == 0
    assert result(locatk, solved, "--truth", path)["max_m"] == 0.0


@pytest.mark.slow
def test_bags_in_a_folder_and_a_table(
    tmp_path: Path, ros_bags: ModuleType, locatk: Locatk, solved: Path
) -> None:
    (tmp_path / "truth").mkdir()
    make, true = ros_bags.Messages(), drive()
    rows = zip(true.time_ns.tolist(), true.position, true.quaternion, strict=True)
    messages = [("/mocap", time, make.pose_stamped(time, "floor", *pose)) for time, *pose in rows]
    ros_bags.write_bag(tmp_path / "truth" / "run", "sqlite3", messages)
    table = tmp_path / "errors.csv"
    done = locatk("eval", solved, "--truth", tmp_path / "truth", "--table", table)
    assert done.exit_code == 0, done.stderr
    [row] = csv.DictReader(table.open())
    assert (row["session"], row["device"], row["poses"]) == ("run", "kiwi", str(N))
    # The bag as an estimate is one file, and named by its folder.
    track = f"{tmp_path / 'truth' / 'run'}#/mocap"
    for name in (track, tmp_path / "truth" / "run"):
        words = ("--truth", solved, "--table", table, "--overwrite")
        assert locatk("eval", name, *words).exit_code == 0
        [row] = csv.DictReader(table.open())
        assert (row["session"], row["device"]) == ("run", "/mocap")


def test_files_with_a_selection_are_not_replaced(locatk: Locatk, tmp_path: Path) -> None:
    text = "time_s,x_m,y_m,z_m,device\n1,0,0,0,red\n2,1,0,0,red\n"
    path = tmp_path / "a.csv"
    path.write_text(text)
    selected = f"{path}#red"
    done = locatk("eval", selected, "--truth", selected, "--table", path, "--overwrite")
    assert done.exit_code == 1
    assert "one of the inputs" in done.stderr
    assert path.read_text() == text


def test_missing_files_and_names(
    tmp_path: Path, ros_bags: ModuleType, locatk: Locatk, solved: Path
) -> None:
    missing = tmp_path / "none.db3#/mocap"
    for words in ((solved, "--truth", missing), (missing, "--truth", solved)):
        done = locatk("eval", *words)
        assert (done.exit_code, done.stderr.count("\n")) == (1, 1)
        assert "no such file" in done.stderr.lower()
    path = bag(ros_bags, tmp_path / "drive")
    done = locatk("eval", solved, "--truth", f"{path}#/gps")
    assert (done.exit_code, done.stderr.count("\n")) == (1, 1)
    assert "no topic '/gps' with poses. Hint: It has /mocap, /slam, /far, /tf" in done.stderr


def test_the_missing_extra_is_one_line(
    tmp_path: Path,
    ros_bags: ModuleType,
    locatk: Locatk,
    solved: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    path = bag(ros_bags, tmp_path / "drive")
    monkeypatch.setitem(sys.modules, "rosbags", None)
    done = locatk("eval", solved, "--truth", path)
    assert done.exit_code == 1
    assert done.stderr == (
        f"Error: {path}: a message of ROS needs rosbags, which is not installed. "
        'Hint: Install it: pip install "locatk[ros]".\n'
    )


@pytest.mark.slow
def test_a_report_with_the_truth_of_a_bag(
    tmp_path: Path, ros_bags: ModuleType, locatk: Locatk, solved: Path
) -> None:
    path = bag(ros_bags, tmp_path / "drive")
    page = tmp_path / "report.html"
    done = locatk("report", solved, "-o", page, "--truth", f"{path}#/mocap")
    assert done.exit_code == 0, done.stderr
    assert "Half of the poses are within" in page.read_text(encoding="utf-8")
