"""Subjects of reports: the session and truth that are used, and refused files."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from locatk.core.errors import FormatError, InputError, MissingDataError
from locatk.core.lighthouse.scene import Scene
from locatk.core.solution import Solution
from locatk.core.trajectory import Trajectory
from locatk.formats.exporters.tum import write_tum
from locatk.formats.report.evaluation import why_not_evaluated
from locatk.formats.report.subject import find_session, load_subject
from locatk.formats.sessions import observations
from locatk.formats.sessions.solutions import write_solution

START_NS = 1_767_225_600_000_000_000


def track(device: str = "red", off_m: float = 0.0, late_s: float = 0.0) -> Trajectory:
    turn = np.linspace(0, 6, 60)
    place = np.column_stack([np.cos(turn) + off_m, np.sin(turn), 0 * turn])
    time_ns = START_NS + round(late_s * 1e9) + 100_000_000 * np.arange(60)
    return Trajectory.from_positions(
        device, "floor", time_ns, place, np.broadcast_to(np.eye(3) * 1e-6, (60, 3, 3))
    )


SOLUTION = Solution(
    "lighthouse", "bundle", (track(off_m=2e-3),), artifact=Scene(scale="markers", planar=True)
)


@pytest.fixture
def session(tmp_path: Path) -> Path:
    """A recording with truth."""
    return record(tmp_path / "run.mcap")


def record(path: Path, late_s: float = 0.0, truth: bool = True) -> Path:
    known = [track(late_s=late_s)] if truth else []
    observations.write_session(
        path, system="lighthouse", scene=Scene(), truth=known, sweeps=_none()
    )
    return path


def _none() -> observations.Sweeps:
    empty = np.zeros(0, np.int32)
    return observations.Sweeps(
        ("red",), np.zeros(0, np.int64), empty, empty, empty, empty, empty, np.zeros(0)
    )


def solved(path: Path, solution: Solution = SOLUTION, source: str = "run.mcap") -> Path:
    write_solution(path, solution, source=source)
    return path


def test_devices_are_in_natural_order(tmp_path: Path) -> None:
    names = ("robot-10", "Robot-2", "robot-1")
    solution = replace(SOLUTION, trajectories=tuple(track(name) for name in names))
    subject = load_subject(solved(tmp_path / "solved.mcap", solution))
    ordered = [t.device for t in subject.solution.trajectories]
    assert ordered == ["robot-1", "Robot-2", "robot-10"]


def test_truth_is_read_from_the_session_in_the_same_folder(session: Path, tmp_path: Path) -> None:
    subject = load_subject(solved(tmp_path / "solved.mcap"))
    assert subject.name == "solved.mcap"
    assert subject.session is not None
    assert Path(subject.session.path) == session
    assert subject.facts["source"] == "run.mcap"
    assert subject.evaluation is not None
    assert subject.evaluation.median == pytest.approx(2e-3)


def test_damaged_truth_is_reported(session: Path, tmp_path: Path) -> None:
    content = bytearray(session.read_bytes())
    with session.open("rb") as stream:
        (*_, chunk) = make_reader(stream).get_summary().chunk_indexes  # type: ignore[union-attr]
    content[chunk.chunk_start_offset + chunk.chunk_length // 2] ^= 1
    session.write_bytes(content)
    subject = load_subject(solved(tmp_path / "solved.mcap"))
    assert (subject.truth, subject.evaluation) == ((), None)
    assert "cannot be read" in why_not_evaluated(subject)


def test_truth_that_cannot_be_used_is_reported(tmp_path: Path) -> None:
    record(tmp_path / "run.mcap")
    late = track()
    late = replace(late, time_ns=late.time_ns + 1_000_000_000_000)
    path = tmp_path / "late.tum"
    write_tum(path, late)
    subject = load_subject(solved(tmp_path / "solved.mcap"), truth=path)
    assert subject.evaluation is None
    assert "The truth cannot be used" in why_not_evaluated(subject)


def test_without_session_there_is_no_truth(tmp_path: Path) -> None:
    subject = load_subject(solved(tmp_path / "solved.mcap"))
    assert (subject.session, subject.truth, subject.evaluation) == (None, (), None)


@pytest.mark.parametrize("source", ["../run.mcap", "/run.mcap", "", "solved.mcap", "."])
def test_other_names_are_not_followed(session: Path, tmp_path: Path, source: str) -> None:
    """Neither out of the folder nor to the solution itself."""
    (tmp_path / "in").mkdir()
    path = solved(tmp_path / "in" / "solved.mcap")
    named = source if source != "/run.mcap" else str(session)
    assert find_session(path, {"source": named}, SOLUTION) is None
    there = solved(tmp_path / "solved.mcap")
    assert find_session(there, {"source": "run.mcap"}, SOLUTION) is not None


def test_a_session_of_another_system_is_refused(session: Path, tmp_path: Path) -> None:
    path = solved(tmp_path / "solved.mcap", replace(SOLUTION, system="dots"))
    with pytest.raises(InputError, match="of lighthouse, but the solution is of dots"):
        load_subject(path, session=session)


def test_a_recording_of_another_time_is_another_recording(tmp_path: Path) -> None:
    record(tmp_path / "run.mcap", late_s=3600.0)
    assert load_subject(solved(tmp_path / "solved.mcap")).session is None


def test_a_session_in_another_folder_can_be_given(tmp_path: Path) -> None:
    (tmp_path / "far").mkdir()
    far = record(tmp_path / "far" / "other.mcap")
    subject = load_subject(solved(tmp_path / "solved.mcap"), session=far)
    assert subject.session is not None
    assert subject.evaluation is not None


def test_a_solution_is_no_session(tmp_path: Path) -> None:
    path = solved(tmp_path / "solved.mcap")
    twin = tmp_path / "twin.mcap"
    shutil.copy(path, twin)
    with pytest.raises(FormatError, match="a solution, not a session"):
        load_subject(path, session=twin)


def test_a_damaged_session_does_not_stop_the_report(session: Path, tmp_path: Path) -> None:
    data = session.read_bytes()
    for broken in (data[: len(data) // 2], b"no mcap at all", b""):
        session.write_bytes(broken)
        path = tmp_path / "solved.mcap"
        path.unlink(missing_ok=True)
        assert load_subject(solved(path)).solution.poses == 60


def test_a_truth_file_replaces_the_truth_of_the_session(session: Path, tmp_path: Path) -> None:
    write_tum(tmp_path / "camera.tum", track(off_m=5e-3))
    subject = load_subject(solved(tmp_path / "solved.mcap"), truth=tmp_path / "camera.tum")
    assert subject.evaluation is not None
    assert subject.evaluation.median == pytest.approx(3e-3)


def test_alignment_and_offset_are_the_requested_ones(session: Path, tmp_path: Path) -> None:
    subject = load_subject(solved(tmp_path / "solved.mcap"), align="se2")
    assert subject.evaluation is not None
    assert subject.evaluation.align == "se2"
    assert subject.evaluation.max < 1e-6
    late = load_subject(solved(tmp_path / "b.mcap"), offset_s=0.1).evaluation
    assert late is not None
    assert late.time_offset.source == "given"
    assert late.median > 0.05


def test_a_scene_without_scale_is_evaluated_only_with_scaling_alignment(
    session: Path, tmp_path: Path
) -> None:
    unit = replace(SOLUTION, artifact=Scene(scale="unit"))
    path = solved(tmp_path / "solved.mcap", unit)
    subject = load_subject(path)
    assert subject.truth
    assert subject.evaluation is None
    assert load_subject(path, align="sim3").evaluation is not None


def test_truth_of_nothing_that_was_solved(session: Path, tmp_path: Path) -> None:
    two = replace(SOLUTION, trajectories=(track("green"), track("blue")))
    assert load_subject(solved(tmp_path / "a.mcap", two)).evaluation is None
    none = replace(SOLUTION, trajectories=())
    assert load_subject(solved(tmp_path / "b.mcap", none)).evaluation is None


def test_a_session_is_no_solution(session: Path, tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="no solution") as caught:
        load_subject(session)
    assert "locatk solve" in str(caught.value.hint)
    with pytest.raises(MissingDataError):
        load_subject(tmp_path / "nowhere.mcap")


def test_a_damaged_solution_is_one_line(tmp_path: Path) -> None:
    path = solved(tmp_path / "solved.mcap")
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(FormatError) as caught:
        load_subject(path)
    assert "\n" not in str(caught.value)


def test_devices_are_in_the_order_of_their_names(tmp_path: Path) -> None:
    names = ("robot-10", "robot-9", "a/2", "robot", "7", "a/11")
    many = replace(SOLUTION, trajectories=tuple(track(name) for name in names))
    found = load_subject(solved(tmp_path / "solved.mcap", many)).solution.trajectories
    assert [t.device for t in found] == ["7", "a/2", "a/11", "robot", "robot-9", "robot-10"]


def test_poses_that_are_not_finite_are_not_evaluated(session: Path, tmp_path: Path) -> None:
    some = replace(SOLUTION, trajectories=(track(off_m=2e-3),))
    some.trajectories[0].position[3] = np.nan
    subject = load_subject(solved(tmp_path / "solved.mcap", some))
    assert subject.evaluation is not None
    assert subject.evaluation.n == 59
    assert subject.solution.poses == 60
    some.trajectories[0].position[:] = np.inf
    assert load_subject(solved(tmp_path / "none.mcap", some)).evaluation is None
