"""`locatk solve` and `calibrate`: what they write and say, whatever the solver does."""

from __future__ import annotations

import json
from math import inf
from pathlib import Path
from typing import Any

import pytest
from click.testing import Result

from locatk.core.solution import Solution
from locatk.formats.artifacts import scene as artifacts
from locatk.formats.pipeline import systems
from locatk.formats.sessions.observations import read_truth
from locatk.formats.sessions.reader import Session
from locatk.formats.sessions.solutions import read_solution

POSES = 20

pytestmark = pytest.mark.usefixtures("requests")


def lines(result: Result) -> list[dict[str, Any]]:
    """The sessions of `--json`, one a line."""
    answers = [json.loads(line) for line in result.stdout.splitlines()]
    assert all(set(answer) == {"version", "sessions"} for answer in answers)
    assert [answer["version"] for answer in answers] == [1] * len(answers)
    return [entry for answer in answers for [entry] in [answer["sessions"]]]


def test_json_is_the_contract(locatk, session: Path, tmp_path: Path) -> None:
    out = tmp_path / "solved.mcap"
    result = locatk("solve", session, "-o", out, "--json")
    assert result.exit_code == 0, result.stderr
    answer = json.loads(result.stdout)
    assert answer["version"] == 1
    [entry] = answer["sessions"]
    expected = {
        "session": str(session),
        "system": "lighthouse",
        "method": "bundle",
        "output": str(out),
        "poses": POSES,
        "rejected": {"jump": 3},
        "solve_s": 0.25,
    }
    assert {key: entry[key] for key in expected} == expected
    assert set(entry) == {*expected, "detections"}
    [detection] = entry["detections"]
    assert set(detection) == {
        "station",
        "channel",
        "id",
        "period_ticks",
        "calibration",
        "sweeps",
        "rejected",
    }
    assert read_solution(out).poses == POSES


def test_text_lists_poses_rejections_and_notes(locatk, session: Path, tmp_path: Path) -> None:
    result = locatk("solve", session, "-o", tmp_path / "solved.mcap")
    assert result.exit_code == 0
    assert "20 poses, lighthouse by bundle, 0.25 s" in result.stdout
    assert "3 jump" in result.stdout
    assert "2.00" in result.stdout  # sigma in mm
    assert result.stderr == "run.mcap: generic calibration\n"
    quiet = locatk("solve", session, "-o", tmp_path / "again.mcap", "-q")
    assert quiet.stderr == ""


def test_options_reach_the_solver(locatk, requests, session: Path, tmp_path: Path) -> None:
    scene = tmp_path / "scene.toml"
    args = ("--method", "paper", "--scene", "two-3d", "--save-scene", scene)
    assert locatk("solve", session, "-o", tmp_path / "a.mcap", *args).exit_code == 0
    assert artifacts.read_scene(scene).station(3) is not None
    again = locatk("solve", session, "-o", tmp_path / "b.mcap", "--artifact", scene)
    assert again.exit_code == 0
    assert requests == [
        systems.SolveRequest(method="paper", scene="two-3d"),
        systems.SolveRequest(artifact=scene),
    ]


@pytest.mark.parametrize(("text", "rate_hz"), [("100", 100.0), ("0.5", 0.5), ("sweeps", inf)])
def test_a_rate_reaches_the_solver(
    locatk, requests, session: Path, tmp_path: Path, text: str, rate_hz: float
) -> None:
    out = tmp_path / "solved.mcap"
    assert locatk("solve", session, "-o", out, "--rate", text).exit_code == 0
    assert [request.rate for request in requests] == [rate_hz]


@pytest.mark.parametrize("text", ["0", "-1", "nan", "inf", "1e9", "often"])
def test_a_wrong_rate_is_refused(locatk, requests, session: Path, text: str) -> None:
    result = locatk("solve", session, "--rate", text)
    assert result.exit_code == 2
    assert len(result.stderr.strip().splitlines()) == 1
    assert "the word sweeps" in result.stderr
    assert requests == []


def test_nothing_is_overwritten_unasked(locatk, requests, session: Path, tmp_path: Path) -> None:
    out, scene = tmp_path / "solved.mcap", tmp_path / "scene.toml"
    out.write_text("precious")
    scene.write_text("precious")
    for args in (["-o", out], ["-o", tmp_path / "new.mcap", "--save-scene", scene]):
        result = locatk("solve", session, *args)
        assert result.exit_code == 1
        assert "--overwrite" in result.stderr
    assert out.read_text() == scene.read_text() == "precious"
    assert not (tmp_path / "new.mcap").exists()
    assert requests == []  # refused before the work
    assert locatk("solve", session, "-o", out, "--overwrite").exit_code == 0
    assert read_solution(out).poses == POSES


def test_the_recording_itself_is_never_the_output(locatk, session: Path) -> None:
    before = session.read_bytes()
    result = locatk("solve", session, "-o", session, "--overwrite")
    assert result.exit_code == 1
    assert "one of the inputs" in result.stderr
    assert session.read_bytes() == before


def test_a_folder_takes_several_sessions(locatk, record, tmp_path: Path) -> None:
    sessions = [record(tmp_path / f"{name}.mcap") for name in ("one", "two")]
    result = locatk("solve", *sessions, "-o", tmp_path / "out", "--json")
    assert result.exit_code == 0, result.stderr
    outputs = [entry["output"] for entry in lines(result)]
    assert outputs == [str(tmp_path / "out" / f"{name}.mcap") for name in ("one", "two")]
    assert all(Path(output).exists() for output in outputs)


def test_one_bad_session_does_not_stop_the_others(locatk, record, tmp_path: Path) -> None:
    sessions = [record(tmp_path / f"{name}.mcap") for name in ("one", "still", "two")]
    result = locatk("solve", *sessions, "-o", tmp_path / "out", "--json")
    assert result.exit_code == 3
    entries = lines(result)
    assert [entry.get("error") for entry in entries] == [None, "one robot standing still", None]
    assert "\nIncomplete: 1 of 3 sessions could not be solved.\n" in result.stderr
    assert f"Error: {sessions[1]}: one robot standing still. Hint: Drive" in result.stderr


def test_quiet_batches_name_failed_sessions(locatk, record, tmp_path: Path) -> None:
    sessions = [record(tmp_path / f"{name}.mcap") for name in ("one", "still")]
    result = locatk("solve", *sessions, "-o", tmp_path / "out", "-q")
    assert f"Error: {sessions[1]}: one robot standing still." in result.stderr


def test_all_bad_sessions_are_a_failure(locatk, record, tmp_path: Path) -> None:
    sessions = [record(tmp_path / f"still{n}.mcap") for n in range(2)]
    result = locatk("solve", *sessions, "-o", tmp_path / "out")
    assert result.exit_code == 1
    assert result.stderr.endswith("Error: none of the 2 sessions could be solved.\n")
    for session in sessions:
        assert result.stderr.count(f"Error: {session}: one robot standing still.") == 1
    one = locatk("solve", sessions[0], "-o", tmp_path / "one.mcap")
    assert one.exit_code == 1
    assert one.stderr == (
        f"Error: {sessions[0]}: one robot standing still. Hint: Drive it around.\n"
    )
    assert not (tmp_path / "one.mcap").exists()


def test_an_unseen_device_is_status_3(locatk, record, tmp_path: Path) -> None:
    out = tmp_path / "solved.mcap"
    result = locatk("solve", record(tmp_path / "blind.mcap"), "-o", out)
    assert result.exit_code == 3
    assert "no pose for red" in result.stderr
    assert read_solution(out).poses == 0


@pytest.mark.parametrize(
    ("system", "rejected", "words"),
    [
        ("dots", {"motion_blur": POSES}, None),
        ("lighthouse", {"moment_inconsistent": POSES + 1}, "21 of 41 epochs gave no pose (most: "),
    ],
)
def test_more_without_a_pose_than_with_one_is_status_3(
    locatk,
    monkeypatch,
    session: Path,
    tmp_path: Path,
    system: str,
    rejected: Any,
    words: str | None,
) -> None:
    def solve(*_: Any) -> systems.SolvedSession:
        poses = read_truth(Session.open(session))
        return systems.SolvedSession(Solution(system, "test", tuple(poses), rejected=rejected), 0.1)

    monkeypatch.setitem(systems.SYSTEMS, "lighthouse", solve)
    result = locatk("solve", session, "-o", tmp_path / "solved.mcap")
    assert result.exit_code == (0 if words is None else 3), result.stderr
    assert (words or "") in result.stderr
    assert read_solution(tmp_path / "solved.mcap").poses == POSES


def test_each_sigma_has_its_unit(locatk, session: Path, tmp_path: Path) -> None:
    result = locatk("solve", session, "-o", tmp_path / "solved.mcap")
    head = result.stdout.splitlines()[1]
    assert all(f"sigma {axis} [mm]" in head for axis in "xyz")
    assert "sigma heading [deg]" in head


def test_twins_and_files_for_folders_are_refused(locatk, record, tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    twins = [record(tmp_path / "run.mcap"), record(tmp_path / "a" / "run.mcap")]
    assert locatk("solve", *twins, "-o", tmp_path / "out").exit_code == 2
    assert not (tmp_path / "out").exists()
    others = [twins[0], record(tmp_path / "other.mcap")]
    (tmp_path / "file").write_text("x")
    assert locatk("solve", *others, "-o", tmp_path / "file").exit_code == 1
    assert locatk("solve", *others, "-o", tmp_path / "file.mcap").exit_code == 2
    refused = locatk("solve", *others, "-o", tmp_path / "poses.CSV")
    assert refused.exit_code == 2
    assert "`locatk export` writes tables" in refused.stderr
    assert not (tmp_path / "poses.CSV").exists()
    (tmp_path / "old.csv").mkdir()
    assert locatk("solve", *others, "-o", tmp_path / "old.csv").exit_code == 0
    scene = ("--save-scene", tmp_path / "scene.toml")
    assert locatk("solve", *others, "-o", tmp_path / "out", *scene).exit_code == 2


def test_files_other_than_sessions_are_refused(
    locatk, record, session: Path, tmp_path: Path
) -> None:
    solved = tmp_path / "solved.mcap"
    assert locatk("solve", session, "-o", solved).exit_code == 0
    unknown = record(tmp_path / "unknown.mcap", system="sonar")
    raw = record(tmp_path / "raw.mcap", system="")
    empty = tmp_path / "empty.mcap"
    empty.touch()
    hollow = tmp_path / "hollow"
    hollow.mkdir()
    text = tmp_path / "text.mcap"
    text.write_text("hello, this is no recording at all")
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(session.read_bytes()[:-100])
    for path, words in (
        (solved, "a solution, not a session"),
        (unknown, "no solver for the system 'sonar'"),
        (raw, "nothing in it can be solved"),
        (empty, "empty"),
        (text, "not an MCAP file"),
        (cut, "cut short"),
        (tmp_path / "missing.mcap", "No such file"),
        (tmp_path / "none*.mcap", "no file matches"),
        (hollow, "no *.mcap in the folder"),
    ):
        out = tmp_path / "out.mcap"
        result = locatk("solve", path, "-o", out)
        assert result.exit_code == 1, path
        assert result.stderr.startswith(f"Error: {path}:"), result.stderr
        assert words in result.stderr
        assert result.stderr.count("\n") == 1
        assert not out.exists()


def test_calibrate_writes_the_scene(locatk, session: Path, tmp_path: Path) -> None:
    out = tmp_path / "scene.toml"
    result = locatk("calibrate", "scene", session, "-o", out, "--json")
    assert result.exit_code == 0, result.stderr
    assert json.loads(result.stdout)["sessions"][0]["output"] == str(out)
    station = artifacts.read_scene(out).station(3)
    assert station is not None
    assert station.id == 0x4CC60647
    assert locatk("calibrate", "scene", session, "-o", out).exit_code == 1


def test_systems_of_plugins_are_listed(
    locatk, record, monkeypatch, session: Path, tmp_path: Path
) -> None:
    """An entry point in the group locatk.systems serves a system we do not know."""
    from importlib import metadata

    solver = systems.SYSTEMS["lighthouse"]

    class Entry:
        def load(self) -> systems.Solver:
            return solver

    def entry_points(*, group: str, name: str) -> list[Entry]:
        assert group == "locatk.systems"
        return [Entry()] if name == "sonar" else []

    monkeypatch.setattr(metadata, "entry_points", entry_points)
    path = record(tmp_path / "sonar.mcap", system="sonar")
    assert locatk("solve", path, "-o", tmp_path / "out.mcap").exit_code == 0
