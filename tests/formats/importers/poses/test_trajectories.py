"""Whatever holds poses is read by what it holds; whatever does not is refused in one line."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from locatk.core.errors import FormatError, InputError, LocatkError
from locatk.core.solution import Solution
from locatk.core.trajectory import Trajectory
from locatk.formats.exporters.kitti import write_kitti
from locatk.formats.exporters.trajectory_csv import write_csv
from locatk.formats.exporters.tum import write_tum
from locatk.formats.importers.poses import trajectories as files
from locatk.formats.importers.poses.trajectory_csv import read_csv
from locatk.formats.sessions.solutions import write_solution
from locatk.formats.sessions.trajectories import truth_messages, write_streams
from locatk.formats.sessions.writer import SessionWriter


def sample(shift_m: float = 0.0, device: str = "red") -> Trajectory:
    time = 10**18 + 100_000_000 * np.arange(5)
    position = np.outer(np.arange(5.0), [1, 2, 0]) + shift_m
    return Trajectory.from_positions(device, "floor", time, position, np.full((5, 3, 3), 1e-6))


@pytest.fixture
def solution(tmp_path: Path) -> Path:
    path = tmp_path / "solved.mcap"
    write_solution(path, Solution("lighthouse", "bundle", (sample(0.5),)), source="run.mcap")
    return path


@pytest.fixture
def session(tmp_path: Path) -> Path:
    path = tmp_path / "run.mcap"
    with SessionWriter(path, system="lighthouse") as writer:
        write_streams(writer, truth_messages([sample()]))
    return path


@pytest.mark.parametrize("role", ["estimate", "truth"])
def test_sessions_and_solutions_both_ways(session: Path, solution: Path, role) -> None:
    recorded = files.open_file(session, role=role)
    assert (recorded.kind, recorded.solved) == ("session", False)
    np.testing.assert_array_equal(recorded.trajectories[0].position, sample().position)
    solved = files.open_file(solution, role=role)
    assert (solved.kind, solved.solved) == ("solution", True)
    np.testing.assert_array_equal(files.read(solution, role=role)[0].position, sample(0.5).position)


@pytest.mark.parametrize("name", ["poses.tum", "poses.txt", "poses", "poses.kitti", "a.csv"])
def test_texts_are_known_by_their_rows(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    write_tum(path, sample())
    assert files.open_file(path).kind == "tum"
    path.write_text("# stamps x y z q\n\n" + path.read_text())
    assert files.open_file(path).kind == "tum"
    write_kitti(path, sample(), overwrite=True)
    found = files.open_file(path)
    assert found.kind == "kitti"
    assert found.trajectories[0].time_ns.tolist() == [k * 10**9 for k in range(5)]
    write_csv(path, [sample()], overwrite=True)
    assert files.open_file(path).kind == "csv"
    assert files.read(path)[0].device == "red"


def test_kitti_only_with_kitti_of_as_many_rows(tmp_path: Path) -> None:
    write_kitti(tmp_path / "a.txt", sample())
    write_tum(tmp_path / "b.txt", sample())
    kitti, tum = (files.open_file(tmp_path / name) for name in ("a.txt", "b.txt"))
    files.check_kinds(kitti, kitti)
    files.check_kinds(tum, tum)
    for pair in ((kitti, tum), (tum, kitti)):
        with pytest.raises(InputError, match="KITTI has no times") as caught:
            files.check_kinds(*pair)
        assert caught.value.file == str(tmp_path / "a.txt")
    lines = (tmp_path / "a.txt").read_text().splitlines(keepends=True)
    (tmp_path / "c.txt").write_text("".join(lines[:3]))
    with pytest.raises(InputError, match=r"3 rows, but a\.txt has 5"):
        files.check_kinds(files.open_file(tmp_path / "c.txt"), kitti)


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("", "empty"),
        ("# nothing\n\n", "no poses"),
        ("1 2 3\n", "3 words"),
        ("hello\n", "1 word"),
        ("t,x,y\n1,2,3\n", "time_s"),
        ("1 2 3 4 5 6 7 8\n1 2\n", "2 words"),
        ("1 0 0 0 0 1 0 0 0 0 1\n", "11 words"),
        ("2 0 0 0 0 1 0 0 0 0 1 0\n", "not a rotation"),
        ("1 0 0 0 0 1 0 0 0 0 -1 0\n", "not a rotation"),
        ("1 0 0 0 0 1 0 0 0 0 1 x\n", "'x'"),
        ("1 0 0 nan 0 1 0 0 0 0 1 0\n", "finite"),
        ("1e200 0 0 0 0 1 0 0 0 0 1 0\n", r"1e\+09 or less"),
    ],
)
def test_what_holds_no_poses(tmp_path: Path, text: str, what: str) -> None:
    path = tmp_path / "a.txt"
    path.write_text(text)
    with pytest.raises(InputError, match=what) as caught:
        files.read(path)
    assert caught.value.file == str(path)
    assert caught.value.hint
    assert "\n" not in str(caught.value) + caught.value.hint


@given(st.binary(max_size=300))
def test_any_bytes_are_refused_in_one_line(
    tmp_path_factory: pytest.TempPathFactory, content: bytes
) -> None:
    path = tmp_path_factory.mktemp("junk") / "junk"
    path.write_bytes(content)
    with pytest.raises(LocatkError):
        files.read(path)


def test_places_that_are_no_files(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        files.read(tmp_path / "none")
    with pytest.raises(InputError, match="folder"):
        files.read(tmp_path)
    (tmp_path / "cut.mcap").write_bytes(b"\x89MCAP0\r\n")
    with pytest.raises(LocatkError):
        files.read(tmp_path / "cut.mcap")


def test_compressed_files_are_named(tmp_path: Path) -> None:
    path = tmp_path / "truth.tum.gz"
    path.write_bytes(gzip.compress(b"0 0 0 0 0 0 0 1\n"))
    with pytest.raises(FormatError, match="compressed"):
        files.read(path)


def test_quoted_names_are_of_one_device(tmp_path: Path) -> None:
    """A name that begins like a formula is quoted for spreadsheets, or not."""
    path = tmp_path / "poses.csv"
    path.write_text("time_s,device,x_m,y_m,z_m\n1,=a,0,0,0\n2,'=a,0,0,0\n")
    assert [(each.device, len(each)) for each in read_csv(path)] == [("=a", 2)]
    path.write_text("time_s,device,x_m,y_m,z_m\n2,=a,0,0,0\n1,'=a,0,0,0\n")
    with pytest.raises(InputError, match="does not ascend"):
        read_csv(path)
