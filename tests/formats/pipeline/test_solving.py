"""One session and many: reports, failures, outputs."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from locatk.core.errors import DegenerateError, LocatkError, MissingDataError, OutputExistsError
from locatk.core.solution import Solution
from locatk.core.trajectory import Trajectory
from locatk.formats.pipeline import (
    OutputConflictError,
    SolvedSession,
    SolveFailure,
    SolveReport,
    SolveRequest,
    check_outputs,
    plan_jobs,
    plan_outputs,
    solve_batch,
    solve_file,
    systems,
)
from locatk.formats.pipeline.outcome import find_losses, portable_error, summarize
from locatk.formats.sessions.reader import Session
from locatk.formats.sessions.solutions import read_solution
from locatk.formats.sessions.writer import SessionWriter


class PluginError(DegenerateError):
    """Error of another package, with a constructor of its own."""

    def __init__(self, sensor: int, path: str) -> None:
        super().__init__(f"sensor {sensor} stood still", file=path)


def track(device: str, poses: int) -> Trajectory:
    times = 1_700_000_000_000_000_000 + np.arange(poses)
    covariance = np.broadcast_to(np.diag([4e-6, 9e-6, np.nan]), (poses, 3, 3))
    return Trajectory.from_positions(device, "floor", times, np.ones((poses, 3)), covariance)


@pytest.fixture
def record(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], Path]:
    """``record(name)`` writes an empty session, whose solution has the poses of two robots.

    The session `still` is refused.
    """

    def solve(session: Session, request: SolveRequest) -> SolvedSession:
        if Path(session.path).stem == "still":
            raise PluginError(3, str(session.path))
        tracks = (track("red", 3), track("blue", 0))
        return SolvedSession(Solution("lighthouse", request.method or "bundle", tracks), 0.25)

    monkeypatch.setitem(systems.SYSTEMS, "lighthouse", solve)

    def write(name: str) -> Path:
        path = tmp_path / f"{name}.mcap"
        with SessionWriter(path, system="lighthouse"):
            pass
        return path

    return write


def test_a_session_is_solved_into_a_report(record: Callable[[str], Path], tmp_path: Path) -> None:
    session = record("run")
    report = solve_file(session, request=SolveRequest(method="paper"))
    output = tmp_path / "run-solved.mcap"
    assert (report.session, report.output) == (str(session), str(output))
    assert (report.system, report.method, report.poses, report.solve_s) == (
        "lighthouse", "paper", 3, 0.25,
    )  # fmt: skip
    red, blue = report.devices
    assert red.median_sigma == pytest.approx((2e-3, 3e-3, np.nan, np.nan), nan_ok=True)
    assert np.isnan(blue.median_sigma).all()
    assert [(loss.code, loss.message) for loss in report.losses] == [
        ("no_pose", "no pose for blue")
    ]
    assert not report.is_resumed
    assert read_solution(output).poses == 3
    for request in (None, SolveRequest(method="paper")):
        with pytest.raises(OutputExistsError):
            solve_file(session, request=request)
    again = solve_file(session, request=SolveRequest(method="paper"), resume=True)
    assert (again.is_resumed, again.poses, again.losses) == (True, 3, report.losses)
    assert solve_file(session, overwrite=True).method == "bundle"


def test_a_file_that_appears_meanwhile_is_neither_replaced_nor_taken_for_the_result(
    record: Callable[[str], Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    output = tmp_path / "solved.mcap"
    known = systems.SYSTEMS["lighthouse"]

    def solve(session: Session, request: SolveRequest) -> SolvedSession:
        output.write_text("precious")
        return known(session, request)

    session = record("run")
    monkeypatch.setitem(systems.SYSTEMS, "lighthouse", solve)
    with pytest.raises(OutputExistsError):
        solve_file(session, output)
    assert output.read_text() == "precious"


def test_a_failure_is_an_error_of_the_library(record: Callable[[str], Path]) -> None:
    session = record("still")
    with pytest.raises(DegenerateError, match="sensor 3 stood still") as failed:
        solve_file(session)
    assert failed.value.file == str(session)
    (note,) = failed.value.__notes__
    assert "PluginError" in note
    assert not session.with_name("still-solved.mcap").exists()


def test_an_internal_error_names_no_option(
    record: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(session: Session, request: SolveRequest) -> SolvedSession:
        raise ZeroDivisionError("by zero")

    session = record("run")
    monkeypatch.setitem(systems.SYSTEMS, "lighthouse", fail)
    with pytest.raises(LocatkError, match="internal error, ZeroDivisionError: by zero") as failed:
        solve_file(session)
    assert "-v" not in (failed.value.hint or "")
    assert "by zero" in failed.value.__notes__[0]


@pytest.mark.parametrize("system", ["dots", "lighthouse", "polaris", "landmarks"])
def test_reports_contain_detections_and_facts_if_used(system: str) -> None:
    """Tables of tags and landmarks are printed in any case, and the facts of tags."""
    detection = SimpleNamespace(tag_id=1, refused="")
    facts = SimpleNamespace(robots={})
    solution = Solution(system, "bundle", (track("red", 3),), detections=(detection,), facts=facts)
    full = summarize("in", "out", solution)
    small = summarize("in", "out", solution, with_detections=False)
    assert full.detections == (detection,)
    assert full.facts is (facts if system in ("polaris", "landmarks") else None)
    assert small.detections == ((detection,) if system in ("polaris", "landmarks") else ())
    assert small.facts is (facts if system == "polaris" else None)
    assert small.losses == full.losses


def test_a_missing_file_of_the_request_is_reported(tmp_path: Path) -> None:
    request = SolveRequest(artifact=tmp_path / "none.toml")
    with pytest.raises(MissingDataError, match="no such file"):
        plan_jobs(["a.mcap"], ["b.mcap"], request, is_remote=True)


def test_a_batch_has_an_outcome_for_each_session(record: Callable[[str], Path]) -> None:
    sessions = [str(record(name)) for name in ("one", "still", "two")]
    jobs = plan_jobs(sessions, plan_outputs(sessions, None), SolveRequest())
    steps = list(solve_batch(jobs))
    assert [count for count, _ in steps] == [1, 2, 3]
    first, failure, last = (outcome for _, ready in steps for outcome in ready)
    assert isinstance(first, SolveReport)
    assert isinstance(last, SolveReport)
    assert isinstance(failure, SolveFailure)
    assert failure.session == sessions[1]
    assert "PluginError" in failure.traceback


def test_errors_travel_between_processes() -> None:
    """An exception with other parameters cannot be unpickled, which would break the pool."""
    error = portable_error(
        PluginError(3, "/tmp/x/run.mcap"), {"/tmp/x/run.mcap": "s3://b/run.mcap"}
    )
    copy = pickle.loads(pickle.dumps(error))
    assert type(copy) is DegenerateError
    assert str(copy) == "s3://b/run.mcap: sensor 3 stood still"
    plain = portable_error(LocatkError("no", hint="see /tmp/a.mcap"), {"/tmp/a.mcap": "a.mcap"})
    assert plain.hint == "see a.mcap"


def test_outputs_of_several_sessions(tmp_path: Path) -> None:
    sessions = ["day/a.mcap", "day/b.mcap"]
    assert plan_outputs(sessions, None) == ["day/a-solved.mcap", "day/b-solved.mcap"]
    folder = tmp_path / "out"
    assert plan_outputs(sessions, str(folder)) == [str(folder / "a.mcap"), str(folder / "b.mcap")]
    assert not folder.exists()
    assert plan_outputs(sessions[:1], "x") == ["x"]
    assert plan_outputs(sessions[:1], str(folder), is_folder=True) == [str(folder / "a.mcap")]
    assert plan_outputs(sessions, "s3://b/out/") == ["s3://b/out/a.mcap", "s3://b/out/b.mcap"]
    for conflict in (["a.mcap", "b/a.mcap"], ["a.mcap", "a.mcap"]):
        with pytest.raises(OutputConflictError, match="same output"):
            plan_outputs(conflict, str(folder))
    with pytest.raises(OutputConflictError, match="need a folder"):
        plan_outputs(sessions, "one.mcap")
    (tmp_path / "file").write_text("x")
    with pytest.raises(OutputExistsError):
        plan_outputs(sessions, str(tmp_path / "file"))


def test_the_folder_of_outputs_is_created_after_the_checks(tmp_path: Path) -> None:
    folder = tmp_path / "day" / "out"
    outputs = [str(folder / "a.mcap"), str(folder / "b.mcap")]
    options = {"overwrite": False, "resume": False}
    with pytest.raises(OutputConflictError):
        check_outputs([outputs[0]] * 2, [], **options, folder=str(folder))
    with pytest.raises(MissingDataError, match="no such folder"):
        check_outputs(outputs, [], **options)
    assert list(tmp_path.iterdir()) == []
    check_outputs(outputs, [], **options, folder=str(folder))
    assert folder.is_dir()
    (folder / "b.mcap").touch()
    with pytest.raises(OutputExistsError):
        check_outputs(outputs, [], **options, folder=str(folder))


def test_an_input_is_never_an_output(tmp_path: Path) -> None:
    path, link = tmp_path / "a.mcap", tmp_path / "b.mcap"
    path.write_text("x")
    link.hardlink_to(path)
    for output in (path, link):
        with pytest.raises(OutputExistsError, match="one of the inputs"):
            check_outputs([str(output)], [str(path)], overwrite=True, resume=False)
    with pytest.raises(OutputConflictError):
        check_outputs([str(path), str(link)], [], overwrite=True, resume=False)


@pytest.mark.parametrize(
    ("system", "rejected", "words"),
    [
        ("dots", {"motion_blur": 3}, None),
        ("dots", {"motion_blur": 3, "glare": 1}, "4 of 7 frames gave no pose (most: motion blur)"),
        ("lighthouse", {"moment_few": 4}, "4 of 7 epochs gave no pose (most: few)"),
        ("lighthouse", {"jump": 99}, None),
    ],
)
def test_few_poses_are_a_loss(system: str, rejected: dict[str, int], words: str | None) -> None:
    losses = find_losses(Solution(system, "test", (track("red", 3),), rejected=rejected))
    assert [loss.message for loss in losses] == ([] if words is None else [words])


def test_a_solution_without_devices_is_a_loss() -> None:
    report = summarize("run.mcap", "out.mcap", Solution("dots", "lattice", ()))
    assert [loss.message for loss in report.losses] == ["no pose at all"]
    assert report.poses == 0
