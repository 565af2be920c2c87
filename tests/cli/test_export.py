"""`locatk export` as a user runs it, in every format."""

from __future__ import annotations

import csv
import json
import shutil
import subprocess
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from locatk.cli import export
from locatk.core.errors import InputError
from locatk.core.lighthouse.scene import Scene
from locatk.core.trajectory import Trajectory
from locatk.formats.artifacts import scene as artifacts
from locatk.formats.exporters import export as exports
from locatk.formats.importers.poses.trajectory_csv import read_csv
from locatk.formats.importers.poses.tum import read_tum
from locatk.formats.sessions.solutions import read_solution, write_solution
from locatk.formats.sessions.writer import SessionWriter
from locatk.formats.tables.timestamps import parse_decimal_time

POSES = 20


@pytest.fixture
def solved(locatk, requests, session: Path, tmp_path: Path) -> Path:
    out = tmp_path / "solved.mcap"
    assert locatk("solve", session, "-o", out).exit_code == 0
    return out


@pytest.fixture
def two(locatk, requests, record, tmp_path: Path) -> Path:
    """Solved, of the devices `lab/blue` and `red`."""
    out = tmp_path / "two-solved.mcap"
    session = record(tmp_path / "two.mcap", ("red", "lab/blue"))
    assert locatk("solve", session, "-o", out).exit_code == 0
    return out


def test_formats_are_those_of_the_writers() -> None:
    assert export.FORMATS == exports.FORMATS


@pytest.mark.parametrize("kind", ["csv", "parquet", "ros2"])
def test_one_file_holds_all_devices(locatk, two: Path, tmp_path: Path, kind: str) -> None:
    if kind == "parquet":
        pytest.importorskip("pyarrow", reason="pyarrow is not installed")
    out = tmp_path / f"poses.{'mcap' if kind == 'ros2' else kind}"
    result = locatk("export", two, "--format", kind, "-o", out, "--json")
    assert result.exit_code == 0, result.stderr
    assert result.stderr.count("Warning: the orientation of ") == (kind == "ros2")
    answer = json.loads(result.stdout)
    assert answer == {
        "version": 1,
        "input": str(two),
        "format": kind,
        "files": [
            {"path": str(out), "device": device, "poses": POSES, "times": None}
            for device in ("lab/blue", "red")
        ],
    }
    before = out.read_bytes()
    again = locatk("export", two, "--format", kind, "-o", out)
    assert again.exit_code == 1
    assert again.stderr.count("\n") == 1
    assert "--overwrite" in again.stderr
    assert out.read_bytes() == before
    assert locatk("export", two, "--format", kind, "-o", out, "--overwrite").exit_code == 0
    assert out.read_bytes() == before


@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_several_solutions_are_one_table(
    locatk, solved: Path, two: Path, tmp_path: Path, kind: str
) -> None:
    out = tmp_path / f"all.{kind}"
    folder = tmp_path / "solutions"
    folder.mkdir()
    for path in (solved, two):
        path.rename(folder / path.name)
    result = locatk("export", folder, "--format", kind, "-o", out, "--json")
    assert result.exit_code == 0, result.stderr
    answer = json.loads(result.stdout)
    assert answer["files"] == [{"path": str(out), "poses": 3 * POSES}]
    if kind == "csv":
        rows = list(csv.DictReader(out.open(encoding="utf-8")))
    else:
        rows = pytest.importorskip("pyarrow.parquet").read_table(out).to_pylist()
    keys = Counter((row["session"], row["device"]) for row in rows)
    assert keys == {("solved", "red"): POSES, ("two", "red"): POSES, ("two", "lab/blue"): POSES}
    (one,) = read_solution(folder / "solved.mcap").trajectories
    x_m = [float(row["x_m"]) for row in rows if row["session"] == "solved"]
    np.testing.assert_array_equal(x_m, one.position[:, 0])
    # Not to be taken for one session.
    if kind == "csv":
        with pytest.raises(InputError, match="several sessions"):
            read_csv(out)


def test_files_of_one_name_keep_their_folders(locatk, solved: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    other.mkdir()
    shutil.copy(solved, other / solved.name)
    out = tmp_path / "all.csv"
    result = locatk("export", solved, other / solved.name, "--format", "csv", "-o", out)
    assert result.exit_code == 0, result.stderr
    rows = list(csv.DictReader(out.open(encoding="utf-8")))
    assert {row["session"] for row in rows} == {str(solved), str(other / solved.name)}


@pytest.mark.parametrize("kind", ["tum", "ros2", "crazyflie-config"])
def test_other_formats_hold_one_solution(locatk, solved: Path, tmp_path: Path, kind: str) -> None:
    result = locatk("export", solved, solved, "--format", kind, "-o", tmp_path / "out")
    assert result.exit_code == 2
    assert "one file by --format csv or parquet" in result.stderr
    assert not (tmp_path / "out").exists()


def test_the_ending_is_the_format(locatk, solved: Path, tmp_path: Path) -> None:
    for name in ("a.csv", "a.tum", "a.mcap"):
        assert locatk("export", solved, "-o", tmp_path / name).exit_code == 0
        assert (tmp_path / name).stat().st_size > 100
    assert (tmp_path / "a.csv").read_text().startswith("time_s,device,")
    for output, problem in (("a.txt", "'a.txt' is not a known format"), ("-", "--format csv")):
        result = locatk("export", solved, "-o", output)
        assert result.exit_code == 2
        assert problem in result.stderr


def test_kitti_writes_times_to_a_second_file(locatk, solved: Path, tmp_path: Path) -> None:
    out = tmp_path / "poses.txt"
    result = locatk("export", solved, "--format", "kitti", "-o", out)
    assert result.exit_code == 0, result.stderr
    assert "poses.times.txt" in result.stderr
    [wanted] = exports_of(solved)
    matrices = np.loadtxt(out).reshape(-1, 3, 4)
    assert np.array_equal(matrices[:, :, 3], wanted.position)
    times = (tmp_path / "poses.times.txt").read_text().splitlines()
    assert [parse_decimal_time(time) for time in times] == wanted.time_ns.tolist()
    # The times are guarded like the poses.
    out.unlink()
    assert locatk("export", solved, "--format", "kitti", "-o", out).exit_code == 1
    assert not out.exists()


def exports_of(path: Path) -> list[Trajectory]:
    from locatk.formats.sessions.solutions import read_trajectories

    return read_trajectories(path)


def test_a_folder_holds_a_file_a_device(locatk, two: Path, tmp_path: Path) -> None:
    out = tmp_path / "poses"
    result = locatk("export", two, "--format", "kitti", "-o", out, "--json")
    assert result.exit_code == 0, result.stderr
    files = json.loads(result.stdout)["files"]
    assert [(each["device"], Path(each["path"]).name) for each in files] == [
        ("lab/blue", "lab_blue.txt"),
        ("red", "red.txt"),
    ]
    assert sorted(path.name for path in out.iterdir()) == [
        "lab_blue.times.txt",
        "lab_blue.txt",
        "red.times.txt",
        "red.txt",
    ]
    (out / "red.txt").unlink()
    again = locatk("export", two, "--format", "kitti", "-o", out)
    assert again.exit_code == 1
    assert "--overwrite" in again.stderr
    assert not (out / "red.txt").exists()


def test_two_devices_never_share_a_file(locatk, requests, record, tmp_path: Path) -> None:
    session, out = record(tmp_path / "s.mcap", ("lab/blue", "lab_blue")), tmp_path / "solved.mcap"
    assert locatk("solve", session, "-o", out).exit_code == 0
    folder = tmp_path / "poses"
    result = locatk("export", out, "--format", "tum", "-o", folder, "--overwrite")
    assert result.exit_code == 1
    assert "lab_blue.tum" in result.stderr
    assert "--device" in result.stderr
    assert not folder.exists()
    one = tmp_path / "one.tum"
    chosen = locatk("export", out, "--format", "tum", "--device", "lab/blue", "-o", one)
    assert chosen.exit_code == 0
    assert len(one.read_text().splitlines()) == POSES
    bag = locatk("export", out, "--format", "ros2", "-o", tmp_path / "poses.mcap")
    assert bag.exit_code == 1
    assert "have the same name in ROS" in bag.stderr


def test_a_session_gives_its_reference_poses(locatk, session: Path, tmp_path: Path) -> None:
    out = tmp_path / "truth.tum"
    assert locatk("export", session, "--format", "tum", "-o", out).exit_code == 0
    [truth] = exports_of(session)
    assert np.array_equal(read_tum(out).position, truth.position)


def test_stdout_gets_the_same_text_as_a_file(locatk, two: Path, tmp_path: Path) -> None:
    out = tmp_path / "poses.csv"
    assert locatk("export", two, "--format", "csv", "-o", out).exit_code == 0
    piped = locatk("export", two, "--format", "csv", "-o", "-")
    assert piped.exit_code == 0
    assert piped.stdout_bytes == out.read_bytes()
    assert piped.stderr == ""
    several = locatk("export", two, "--format", "tum", "-o", "-")
    assert several.exit_code == 1
    assert several.stdout == ""
    assert "2 devices" in several.stderr
    one = locatk("export", two, "--format", "tum", "-o", "-", "--device", "red")
    assert len(one.stdout.splitlines()) == POSES
    for wrong in (["--format", "ros2"], ["--format", "kitti"], ["--format", "csv", "--json"]):
        assert locatk("export", two, *wrong, "-o", "-").exit_code == 2
    assert not Path("-").exists()


def test_the_bag_names_its_source(locatk, solved: Path, tmp_path: Path) -> None:
    from mcap.reader import make_reader

    out = tmp_path / "poses.mcap"
    result = locatk("export", solved, "--format", "ros2", "--covariance", "-o", out)
    assert result.exit_code == 0, result.stderr
    with out.open("rb") as stream:
        reader = make_reader(stream)
        [record] = list(reader.iter_metadata())
        summary = reader.get_summary()
    assert record.metadata["method"] == "bundle"
    assert record.metadata["source"] == "run.mcap"
    assert "kind" not in record.metadata
    assert summary is not None
    topics = {channel.topic for channel in summary.channels.values()}
    assert topics == {"/pose/red", "/pose_with_covariance/red", "/tf"}
    other = locatk("export", solved, "--format", "ros2", "-o", tmp_path / "poses")
    assert other.exit_code == 0
    assert "does not end in .mcap" in other.stderr


def test_refused_exports_are_one_line(locatk, solved: Path, tmp_path: Path) -> None:
    out = tmp_path / "poses.csv"
    unknown = locatk("export", solved, "--format", "csv", "--device", "blue", "-o", out)
    assert unknown.exit_code == 1
    assert unknown.stderr.count("\n") == 1
    assert "The devices are red" in unknown.stderr
    assert locatk("export", solved, "--format", "csv", "--covariance", "-o", out).exit_code == 2
    assert locatk("export", solved, "--format", "csv", "-o", solved, "--overwrite").exit_code == 1
    assert locatk("export", solved, "--format", "xlsx", "-o", out).exit_code == 2
    assert locatk("export", solved, "--format", "csv").exit_code == 2
    nowhere = locatk("export", solved, "--format", "ros2", "-o", tmp_path / "no" / "poses.mcap")
    assert nowhere.exit_code == 1
    assert nowhere.stderr.count("\n") == 1
    assert not out.exists()


def test_parquet_without_pyarrow(
    locatk, solved: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    result = locatk("export", solved, "--format", "parquet", "-o", tmp_path / "poses.parquet")
    assert result.exit_code == 1
    assert 'pip install "locatk[parquet]"' in result.stderr
    assert result.stderr.count("\n") == 1


def test_non_finite_poses_are_omitted_and_reported(locatk, solved: Path) -> None:
    some = solved.with_name("some.mcap")

    def spoil(rows: slice) -> None:
        whole = read_solution(solved)
        (only,) = whole.trajectories
        position = only.position.copy()
        position[rows] = np.nan
        spoilt = replace(whole, trajectories=(replace(only, position=position),))
        write_solution(some, spoilt, source="run.mcap", overwrite=True)

    spoil(slice(3, 5))
    for kind in ("csv", "tum", "kitti", "ros2"):
        out = solved.with_name(f"poses-{kind}{export.ENDINGS[kind][0]}")
        done = locatk("export", some, "--format", kind, "-o", out)
        assert done.exit_code == 3
        assert "left out 2 poses that are not numbers" in done.stderr
        assert f"{POSES - 2} poses" in done.stdout
    done = locatk("export", some, "--format", "csv", "-o", "-")
    assert (done.exit_code, done.stdout.count("\n")) == (3, POSES - 1)
    spoil(slice(None))
    done = locatk("export", some, "--format", "csv", "-o", solved.with_name("none.csv"))
    assert done.exit_code == 1
    assert "none of the 20 poses is a number" in done.stderr
    assert not solved.with_name("none.csv").exists()


@pytest.mark.slow
def test_a_closed_pipe_is_no_error(locatk, solved: Path) -> None:
    # A TUM file of a photodiode has no orientation, of which the warning tells.
    for kind, warnings in (("csv", 0), ("tum", 1)):
        done = subprocess.run(
            ["sh", "-c", '"$0" -m locatk.cli export "$1" --format "$2" -o - | head -1']
            + [sys.executable, str(solved), kind],
            capture_output=True,
            text=True,
            check=True,
        )
        assert done.stderr.count("\n") == done.stderr.count("Warning: the orientation") == warnings
        assert done.stdout.count("\n") == 1


# ---- stations


def test_stations_for_a_crazyflie(
    locatk, solved: Path, session: Path, scene: Scene, tmp_path: Path
) -> None:
    file, first, second = (tmp_path / name for name in ("scene.toml", "a.yaml", "b.yaml"))
    artifacts.write_scene(file, scene)
    result = locatk("export", solved, "--format", "crazyflie-config", "-o", first)
    assert result.exit_code == 0, result.stderr
    assert result.stdout == f"Wrote {first}: 1 station, channel 3\n"
    result = locatk("export", file, "--format", "crazyflie-config", "-o", second, "--json")
    assert json.loads(result.stdout) == {
        "version": 1,
        "input": str(file),
        "format": "crazyflie-config",
        "files": [{"path": str(second), "channels": [3]}],
    }
    assert first.read_bytes() == second.read_bytes()
    again = locatk("export", solved, "--format", "crazyflie-config", "-o", first)
    assert again.exit_code == 1
    assert "--overwrite" in again.stderr
    back = tmp_path / "back.toml"
    assert locatk("import", "crazyflie-config", first, "-o", back).exit_code == 0
    [station] = artifacts.read_scene(back).stations
    assert (station.channel, station.position.tolist()) == (3, [0, 1, 2])


def test_a_tilted_frame_is_not_for_flight(locatk, scene: Scene, tmp_path: Path) -> None:
    file, out = tmp_path / "scene.toml", tmp_path / "a.yaml"
    tilted = replace(scene, scale="distance", planar=False, frame="station-3")
    artifacts.write_scene(file, tilted)
    export = ("export", file, "--format", "crazyflie-config", "-o", out)
    refused = locatk(*export)
    assert refused.exit_code == 1
    assert refused.stderr.count("\n") == 1
    assert f"{file}: the frame 'station-3' is not level" in refused.stderr
    assert "calibrate scene SESSION --floor" in refused.stderr
    assert not out.exists()
    assert locatk(*export, "--frame", "as-is").stderr.startswith("Warning: not for flight: the fra")
    assert "# NOT FOR FLIGHT: the frame 'station-3' is not level" in out.read_text()
    # Poses of a Crazyflie's own configuration are in its room, also after a round trip.
    back, again = tmp_path / "back.toml", tmp_path / "again.yaml"
    assert locatk("import", "crazyflie-config", out, "-o", back).exit_code == 0
    level = locatk("export", back, "--format", "crazyflie-config", "-o", again)
    assert (level.exit_code, level.stderr) == (0, "")
    # A planar scene is level, unless its z points down.
    artifacts.write_scene(file, replace(tilted, planar=True, frame="floor"), overwrite=True)
    assert locatk(*export, "--overwrite").exit_code == 0
    artifacts.write_scene(file, replace(tilted, planar=True, floor_z=9.0), overwrite=True)
    assert "points down" in locatk(*export, "--overwrite").stderr
    artifacts.write_scene(file, replace(tilted, scale="unit"), overwrite=True)
    assert locatk(*export, "--frame", "as-is", "--overwrite").exit_code == 1


def test_a_calibration_for_dotbots(locatk, tmp_path: Path) -> None:
    run, solved, out = (tmp_path / name for name in ("run.mcap", "solved.mcap", "calibration.out"))
    assert locatk("simulate", "lighthouse", "-o", run, "--duration", 5).exit_code == 0
    assert locatk("solve", run, "-o", solved, "--save-scene", tmp_path / "s.toml").exit_code == 0
    result = locatk("export", solved, "--format", "dotbot-calibration", "-o", out)
    assert result.exit_code == 0, result.stderr
    lines = result.stdout.splitlines()
    assert lines[0] == f"Wrote {out}: 2 stations, channels 1, 2"
    assert "mm rms, up to" in lines[1]
    assert len(lines) == 5
    assert out.read_bytes()[0] == 2
    assert len(out.read_bytes()) == 1 + 2 * 36
    scene = ("export", tmp_path / "s.toml", "--format", "dotbot-calibration", "-o", out)
    result = locatk(*scene, "--area", "500,600,-400,-500", "--overwrite", "--json")
    [file] = json.loads(result.stdout)["files"]
    assert file["area_mm"] == [-400, -500, 500, 600]
    assert file["origin_mm"] == [-400, 600]
    assert [sorted(each) for each in file["stations"]] == [
        ["channel", "max_mm", "rms_mm", "visible_fraction"]
    ] * 2
    assert "one homography is not enough" not in result.stderr
    result = locatk(*scene, "--area", "0,0,2000,-1000", "--overwrite")
    assert "reports (x +0, 0 - y) mm" in result.stdout
    result = locatk(*scene, "--area", "-20000,-20000,20000,20000", "--overwrite")
    assert "one homography is not enough for this floor and channel" in result.stderr
    for wrong in ("1,2,3", "0,0,50,50", "a,b,c,d", "nan,0,1000,1000"):
        assert locatk(*scene, "--area", wrong, "--overwrite").exit_code == 2
    assert locatk(*scene, "--frame", "as-is", "--overwrite").exit_code == 2
    assert "--overwrite" in locatk(*scene).stderr
    assert locatk(*scene[:-1], tmp_path / "calibration.bin").exit_code == 2


def test_contents_that_a_crazyflie_cannot_hold(
    locatk, solved: Path, session: Path, scene: Scene, tmp_path: Path
) -> None:
    out, file = tmp_path / "a.yaml", tmp_path / "scene.toml"
    artifacts.write_scene(file, replace(scene, scale="unit"))

    def refused(source: Path, *more: object) -> tuple[int, str]:
        result = locatk("export", source, "--format", "crazyflie-config", "-o", out, *more)
        assert not out.exists()
        return result.exit_code, result.stderr

    status, words = refused(file)
    assert status == 1
    assert "scale" in words
    assert str(file) in words
    status, words = refused(session)  # markers only
    assert status == 1
    assert "stations" in words
    assert refused(solved, "--device", "red")[0] == 2
    assert refused(solved, "--covariance")[0] == 2
    with SessionWriter(tmp_path / "dots.mcap", system="dots"):
        pass
    assert "no lighthouse scene" in refused(tmp_path / "dots.mcap")[1]
