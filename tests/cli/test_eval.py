"""``locatk eval`` as a user runs it."""

from __future__ import annotations

import csv
import json
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from locatk.core.geometry import quaternion_from_heading
from locatk.core.solution import Solution
from locatk.core.trajectory import Trajectory
from locatk.formats.exporters.kitti import write_kitti
from locatk.formats.exporters.trajectory_csv import write_csv
from locatk.formats.exporters.tum import write_tum
from locatk.formats.sessions.solutions import write_solution
from locatk.formats.sessions.trajectories import truth_messages, write_streams
from locatk.formats.sessions.writer import SessionWriter

START_NS = 1_700_000_000_000_000_000
N = 600


def drive(device: str = "red") -> Trajectory:
    """A robot in the plane that turns on its way; its pose is known to 1 mm and 10 mrad."""
    time = np.arange(N) * 0.05
    heading = 0.4 * time + np.sin(0.9 * time)
    step = 0.2 * 0.05
    position = np.column_stack(
        [np.cumsum(step * np.cos(heading)), np.cumsum(step * np.sin(heading)), 0 * time]
    )
    covariance = np.full((N, 6, 6), np.nan)
    plane = np.array([0, 1, 5])
    covariance[:, plane[:, None], plane] = np.diag([1e-6, 1e-6, 1e-4])
    return Trajectory(
        device,
        "floor",
        START_NS + np.round(time * 1e9).astype(np.int64),
        position,
        quaternion_from_heading(heading),
        covariance,
    )


def solved(device: str = "red", factor: float = 1.0, late_ns: int = 0) -> Trajectory:
    """With errors ``factor`` times as large as it says."""
    true = drive(device)
    rng = np.random.default_rng(7)
    error = factor * rng.normal(0, [1e-3, 1e-3, 1e-2], (N, 3))
    heading = 2 * np.arctan2(true.quaternion[:, 2], true.quaternion[:, 3]) + error[:, 2]
    return replace(
        true,
        time_ns=true.time_ns + late_ns,
        position=true.position + error[:, [0, 1, 2]] * [1, 1, 0],
        quaternion=quaternion_from_heading(heading),
    )


def unknown(of: Trajectory) -> Trajectory:
    return replace(of, covariance=np.full((len(of), 6, 6), np.nan))


def session(path: Path, *truth: Trajectory) -> Path:
    with SessionWriter(path, system="dots") as writer:
        write_streams(writer, truth_messages(truth or [unknown(drive())]))
    return path


def solution(path: Path, *found: Trajectory) -> Path:
    write_solution(path, Solution("dots", "lattice", found or (solved(),)), source="run.mcap")
    return path


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return session(tmp_path / "run.mcap")


@pytest.fixture
def found(tmp_path: Path) -> Path:
    return solution(tmp_path / "solved.mcap")


def answer(locatk, *words: object) -> dict:
    result = locatk("eval", *words, "--json")
    assert result.exit_code == 0, result.stderr
    assert result.stdout.count("\n") == 1
    return dict(json.loads(result.stdout))


def test_json_is_complete(locatk, run: Path, found: Path) -> None:
    said = answer(locatk, found, "--truth", run)
    assert said["version"] == 1
    assert (said["n"], said["match"], said["align"]) == (N, "interpolate", "none")
    assert said["ape"]["translation_m"]["rmse"] == said["rmse_m"] == pytest.approx(1.4e-3, rel=0.1)
    assert said["ape"]["rotation_deg"]["rmse"] == pytest.approx(np.rad2deg(1e-2), rel=0.1)
    assert said["rpe"]["delta"] == "1f"
    assert said["rpe"]["translation_m"]["n"] == N - 1
    assert said["rpe"]["rotation_deg"]["rmse"] == pytest.approx(np.rad2deg(1.4e-2), rel=0.1)
    assert said["coverage"] == {"share": 1.0, "solved_s": 29.95, "truth_s": 29.95}
    assert said["path_m"] == pytest.approx(0.01 * (N - 1), rel=1e-3)
    assert said["path_estimate_m"] > said["path_m"]
    assert 0 < said["drift"]["translation_percent"] < 1
    assert said["nees"]["mean"] == pytest.approx(1, abs=0.12)
    assert said["nees"]["dof"] == 3
    assert set(said["devices"]) == {"red"}
    assert said["devices"]["red"]["ape"] == said["ape"]


def test_text_summarizes_the_errors(locatk, run: Path, found: Path, tmp_path: Path) -> None:
    text = locatk("eval", found, "--truth", run, "--delta", "0.5m", "--full").stdout
    for line in (
        "RPE: between poses at a distance of 0.5m",
        "alignment: none\n",
        "association: interpolate",
        "time offset: 0.0000 s (none)",
        "not scored: nothing",
        "coverage: 100.0 % (29.9 of 29.9 s)",
        "path: 5.9",
        "drift: 0.",
        "consistency: covariances fit: NEES ",
    ):
        assert line in text, line
    assert "APE [mm]" in text
    bold = solution(tmp_path / "bold.mcap", solved(factor=3.0))
    said = locatk("eval", bold, "--truth", run, "--full").stdout
    assert re.search(r"sigmas are (2\.9|3|3\.1) times too small: NEES", said)


def test_the_default_text_is_short(locatk, run: Path, found: Path) -> None:
    """Verdict, APE, RPE and coverage; assumptions only if they are not the default ones."""
    lines = locatk("eval", found, "--truth", run).stdout.splitlines()
    assert lines[0].startswith("Half of 600 poses are within ")
    assert lines[1].split() == ["device", "error", "n", "rmse", "mean", "median", "p95", "max"]
    assert [line.split()[1] for line in lines[2:6]] == ["APE", "APE", "RPE", "RPE"]
    assert lines[6:] == ["coverage: 100.0 % (29.9 of 29.9 s)", "alignment: none"]
    aligned = locatk("eval", found, "--truth", run, "--align", "sim2", "--offset", "0.1").stdout
    assert "alignment: sim2, fitted on the scored poses (scale " in aligned
    assert "time offset: 0.1000 s" in aligned
    assert "not scored: " in aligned


def test_points_have_no_rotation(locatk, tmp_path: Path) -> None:
    poses = drive()
    point = Trajectory.from_positions(
        "red", "floor", poses.time_ns, poses.position, np.full((N, 3, 3), 0.0) + np.eye(3) * 1e-6
    )
    run, found = session(tmp_path / "a.mcap", point), solution(tmp_path / "b.mcap", point)
    assert answer(locatk, found, "--truth", run)["ape"]["rotation_deg"] is None
    full = locatk("eval", found, "--truth", run, "--full").stdout
    assert "sigmas are more than 100 times too large: NEES 0" in full
    assert "[deg]" not in full + locatk("eval", found, "--truth", run).stdout


def test_a_single_device_with_another_name_is_reported(
    locatk, run: Path, found: Path, tmp_path: Path
) -> None:
    assert "compared" not in locatk("eval", found, "--truth", run).stderr
    other = solution(tmp_path / "other.mcap", replace(solved(), device="robot"))
    done = locatk("eval", other, "--truth", run)
    assert done.exit_code == 0
    assert "robot is compared with red, the only other device" in done.stderr
    assert "compared" not in locatk("eval", other, "--truth", run, "--pair", "robot=red").stderr


def test_frames_of_other_names_are_reported(locatk, run: Path, tmp_path: Path) -> None:
    other = solution(tmp_path / "other.mcap", replace(solved(), frame="tag-0"))
    words = "the poses of red are in the frame 'tag-0', its truth in 'floor'"
    assert words in locatk("eval", other, "--truth", run).stderr
    assert words not in locatk("eval", other, "--truth", run, "--align", "se2").stderr
    write_tum(tmp_path / "red.tum", solved())  # A file without a name of the frame.
    assert "frame" not in locatk("eval", tmp_path / "red.tum", "--truth", run).stderr


def test_devices_of_other_names(locatk, tmp_path: Path) -> None:
    red, blue = drive(), replace(drive(), device="blue")
    blue = replace(blue, position=blue.position + [1.0, 0.0, 0.0])
    run = session(tmp_path / "a.mcap", red, blue)
    gateway = [replace(red, device="785b"), replace(blue, device="dffa")]
    found = solution(tmp_path / "b.mcap", *gateway)
    refused = locatk("eval", found, "--truth", run)
    assert refused.exit_code == 1
    assert "--pair NAME=NAME: one of 785b, dffa, and one of blue, red" in refused.stderr
    said = answer(locatk, found, "--truth", run, "--pair", "785b=red", "--pair", "dffa=blue")
    assert said["max_m"] < 1e-9
    assert set(said["devices"]) == {"785b", "dffa"}
    wrong = answer(locatk, found, "--truth", run, "--pair", "785b=blue", "--pair", "dffa=red")
    assert wrong["rmse_m"] == pytest.approx(1.0)
    for pair, status in (("785b", 2), ("=red", 2), ("785b=green", 1), ("none=red", 1)):
        done = locatk("eval", found, "--truth", run, "--pair", pair)
        assert done.exit_code == status, pair
        assert len(done.stderr.splitlines()) == 1


def test_any_file_on_either_side(locatk, run: Path, found: Path, tmp_path: Path) -> None:
    write_tum(tmp_path / "solved.txt", solved())
    write_csv(tmp_path / "solved.csv", [solved()])
    write_tum(tmp_path / "truth.txt", drive())
    expected = answer(locatk, found, "--truth", run)["rmse_m"]
    for mine in ("solved.mcap", "solved.csv", "solved.txt"):
        for true in ("run.mcap", "truth.txt"):
            said = answer(locatk, tmp_path / mine, "--truth", tmp_path / true)
            assert said["rmse_m"] == pytest.approx(expected, rel=1e-12), (mine, true)
            assert said["match"] == ("nearest" if {mine[-3:], true[-3:]} == {"txt"} else
                                     "interpolate")  # fmt: skip
    backward = locatk("eval", run, "--truth", found, "--json")
    assert json.loads(backward.stdout)["rmse_m"] == pytest.approx(expected)
    assert "has no solved poses" in backward.stderr


def test_kitti_is_compared_row_by_row(locatk, tmp_path: Path) -> None:
    write_kitti(tmp_path / "a.txt", solved())
    write_kitti(tmp_path / "b.txt", drive())
    said = answer(locatk, tmp_path / "a.txt", "--truth", tmp_path / "b.txt")
    assert (said["n"], said["match"], said["coverage"]["share"]) == (N, "nearest", 1.0)
    assert said["rmse_m"] == pytest.approx(1.4e-3, rel=0.1)


def test_several_devices_have_rows_of_their_own(locatk, tmp_path: Path) -> None:
    """In natural order of their names."""
    names = ("robot-10", "robot-2")
    run = session(tmp_path / "run.mcap", *(unknown(drive(name)) for name in names))
    found = solution(tmp_path / "solved.mcap", *map(solved, (*names, "green")))
    result = locatk("eval", found, "--truth", run)
    assert "no truth for green" in result.stderr
    assert [line.split()[0] for line in result.stdout.splitlines()[2:14]] == (
        ["all"] * 4 + ["robot-2"] * 4 + ["robot-10"] * 4
    )
    said = answer(locatk, found, "--truth", run)
    assert said["n"] == 2 * said["devices"]["robot-2"]["n"] == 2 * N


def test_clocks_months_apart(locatk, run: Path, tmp_path: Path) -> None:
    later = 100 * 86_400 * 10**9 + 123_456_789
    of = solved(late_ns=later)
    keep = of.time_ns >= of.time_ns[0] + 10**9
    cut = Trajectory(
        "robot", "floor", of.time_ns[keep], of.position[keep], of.quaternion[keep],
        of.covariance[keep],
    )  # fmt: skip
    found = solution(tmp_path / "later.mcap", cut)
    lost = locatk("eval", found, "--truth", run)
    assert lost.exit_code == 1
    assert "--offset auto" in lost.stderr
    said = answer(locatk, found, "--truth", run, "--offset", "auto")
    assert said["offset_s"] == pytest.approx(-later / 1e9, abs=2e-3)
    assert said["rmse_m"] < 2e-3
    assert said["unscored"]["held out"] == pytest.approx(said["n"] / 3, rel=0.02)


@pytest.mark.parametrize(
    ("words", "what"),
    [
        (("--align", "best"), "best"),
        (("--offset", "soon"), "soon"),
        (("--offset", "nan"), "nan"),
        (("--match", "any"), "any"),
        (("--max-diff", "0"), "max-diff"),
    ],
)
def test_wrong_usage(locatk, run: Path, found: Path, words: tuple[str, ...], what: str) -> None:
    result = locatk("eval", found, "--truth", run, *words)
    assert result.exit_code == 2
    assert what in result.stderr


TUM = "1 0 0 0 0 0 0 1\n2 1 0 0 0 0 0 1\n3 1 1 0 0 0 0 1\n"


@pytest.mark.parametrize(
    ("mine", "true", "words", "what"),
    [
        (TUM, TUM, ("--delta", "1km"), "no distance between poses"),
        (TUM, "PK\x03\x04 zip", (), "first row"),
        ("1 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", TUM, (), "does not ascend"),
        (TUM, "1 0 nan 0 0 0 0 1\n", (), "finite"),
        (TUM, "101 0 0 0 0 0 0 1\n102 1 0 0 0 0 0 1\n", (), "truth at its time"),
        (TUM.splitlines()[0], TUM, ("--align", "se3"), "at least two poses"),
        (TUM.splitlines()[0], TUM, ("--offset", "auto"), "only 0 poses"),
        ("1 0 0 0 0 0 0 1\n2 1 0 0 0 0 0 1\n", TUM, ("--align", "se3"), "collinear"),
        (TUM.replace("1 0 0 0", "0 0 0 0"), TUM, ("--align", "se2", "--offset", "9"), "time"),
        ("1 0 0 0 0 1 0 0 0 0 1 0\n", TUM, (), "KITTI has no times"),
    ],
)
def test_bad_input_is_one_line_and_a_hint(
    locatk, tmp_path: Path, mine: str, true: str, words: tuple[str, ...], what: str
) -> None:
    (tmp_path / "mine.txt").write_text(mine)
    (tmp_path / "true.txt").write_text(true)
    result = locatk("eval", tmp_path / "mine.txt", "--truth", tmp_path / "true.txt", *words)
    assert result.exit_code == 1
    assert what in result.stderr
    assert "Hint: " in result.stderr
    assert result.stderr.count("\n") == 1
    assert result.stdout == ""


def test_one_pose_has_an_error_all_the_same(locatk, tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("2 1 0.5 0 0 0 0 1\n")
    (tmp_path / "b.txt").write_text(TUM)
    said = answer(locatk, tmp_path / "a.txt", "--truth", tmp_path / "b.txt")
    assert (said["n"], said["max_m"], said["rpe"]["translation_m"]) == (1, 0.5, None)
    full = locatk("eval", tmp_path / "a.txt", "--truth", tmp_path / "b.txt", "--full").stdout
    assert "drift: -" in full


@pytest.mark.slow
def test_tum_files_need_no_scipy_and_no_session(tmp_path: Path) -> None:
    """They are heavy to import, and evaluating is to be quick."""
    (tmp_path / "a.txt").write_text(TUM)
    code = (
        "import sys; from locatk.cli.app import app\n"
        "try: app(['eval', 'a.txt', '--truth', 'a.txt', '--align', 'se3'])\n"
        "except SystemExit as end: assert not end.code\n"
        "print([m for m in ('scipy', 'mcap', 'google', 'cv2') if m in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path
    )
    assert done.stdout.splitlines()[-1] == "[]", done.stdout + done.stderr


def test_the_longest_gap_is_chosen(locatk, found: Path, tmp_path: Path) -> None:
    """A truth of one pose a second."""
    slow = tmp_path / "slow.csv"
    part = unknown(drive())
    rows = np.arange(0, N, 20)
    write_csv(slow, [part.select(np.isin(np.arange(N), rows))])
    assert answer(locatk, found, "--truth", slow)["n"] == len(rows)
    bridged = answer(locatk, found, "--truth", slow, "--max-gap", 1)
    assert bridged["n"] == rows[-1] + 1
    assert bridged["coverage"]["share"] == 1.0


def test_a_single_pose_and_a_late_start_are_reported(locatk, run: Path, tmp_path: Path) -> None:
    one, late = tmp_path / "one.csv", tmp_path / "late.csv"
    write_csv(one, [solved().select(np.arange(N) == 5)])
    assert "The only pose with truth has an error of" in locatk("eval", one, "--truth", run).stdout
    write_csv(late, [solved(late_ns=-5_000_000_000_000)])
    said = locatk("eval", late, "--truth", run).stderr
    assert "starts 5000.000 s before the truth" in said


# ---- several files


@pytest.fixture
def study(tmp_path: Path) -> Path:
    """Three sessions with truth, solved twice: with errors as stated, and three times as large."""
    for folder in ("recordings", "good", "bad"):
        (tmp_path / folder).mkdir()
    for number in (1, 2, 10):
        name = f"run-{number}"
        session(tmp_path / "recordings" / f"{name}.mcap")
        for folder, factor in (("good", 1.0), ("bad", 3.0)):
            poses = Solution("dots", "lattice", (solved(factor=factor * number),))
            path = tmp_path / folder / f"{name}-solved.mcap"
            write_solution(path, poses, source=f"{name}.mcap")
    return tmp_path


def test_a_folder_is_evaluated_by_the_names_of_sessions(locatk, study: Path) -> None:
    result = locatk("eval", study / "good", "--truth", study / "recordings")
    lines = result.stdout.splitlines()
    rows = [line.split() for line in lines if line.startswith("run-")]
    assert [row[0] for row in rows] == ["run-1", "run-2", "run-10"]
    # The error of each is that of the file alone.
    for row, number in zip(rows, (1, 2, 10), strict=True):
        alone = locatk(
            "eval",
            study / "good" / f"run-{number}-solved.mcap",
            "--truth",
            study / "recordings" / f"run-{number}.mcap",
            "--json",
        )
        assert float(row[3]) == pytest.approx(1e3 * json.loads(alone.stdout)["median_m"], rel=1e-2)
    assert any(line.startswith("all") and "3 sessions" in line for line in lines)


def test_runs_are_compared_by_paired_differences(locatk, study: Path) -> None:
    arguments = ("eval", study / "good", study / "bad", "--truth", study / "recordings")
    facts = json.loads(locatk(*arguments, "--json").stdout)
    good, bad = facts["runs"]
    assert (good["run"].endswith("good"), bad["run"].endswith("bad")) == (True, True)
    assert (good["sessions"], good["shared"], bad["shared"]) == (3, 0, 3)
    medians = {}
    for row in facts["rows"]:
        medians[Path(row["run"]).name, row["session"]] = row["median_m"]
    change = [medians["bad", f"run-{k}"] - medians["good", f"run-{k}"] for k in (1, 2, 10)]
    assert bad["difference_m"] == pytest.approx(sorted(change)[1])
    assert bad["better"] == 0
    # NEES per degree of freedom tells the right covariance.
    nees = {(Path(r["run"]).name, r["session"]): r["nees"] for r in facts["rows"]}
    assert nees["good", "run-1"] == pytest.approx(1.0, abs=0.2)
    assert nees["bad", "run-1"] == pytest.approx(9.0, abs=2.0)
    text = " ".join(locatk(*arguments).stdout.split())
    assert "3 shared sessions" in text
    assert "larger" in text


@pytest.mark.parametrize("ending", [".csv", ".json", ".parquet", ".tex"])
def test_a_table_of_all_devices(locatk, study: Path, ending: str) -> None:
    table = study / f"errors{ending}"
    arguments = ("eval", study / "good", "--truth", study / "recordings", "--table", table)
    locatk(*arguments)
    if ending == ".csv":
        rows = list(csv.DictReader(table.open(encoding="utf-8")))
    elif ending == ".json":
        rows = json.loads(table.read_text(encoding="utf-8"))
    elif ending == ".parquet":
        rows = pytest.importorskip("pyarrow.parquet").read_table(table).to_pylist()
    else:
        lines = table.read_text(encoding="utf-8").splitlines()
        assert lines[0].startswith(r"\begin{tabular}{l")
        assert sum(line.endswith(r"\\") for line in lines) == 4
        assert r"run-10 & red & dots" in lines[6]
        return
    assert [row["session"] for row in rows] == ["run-1", "run-2", "run-10"]
    assert [row["device"] for row in rows] == ["red"] * 3
    assert float(rows[2]["median_m"]) > 3 * float(rows[0]["median_m"]) > 1e-3
    assert locatk(*arguments).exit_code == 1
    assert "output exists" in locatk(*arguments).stderr


def test_files_that_fail_are_named_and_the_others_evaluated(locatk, study: Path) -> None:
    (study / "recordings" / "run-2.mcap").unlink()
    (study / "good" / "run-10-solved.mcap").write_bytes(b"damaged")
    table = study / "errors.csv"
    result = locatk("eval", study / "good", "--truth", study / "recordings", "--table", table)
    assert result.exit_code == 1
    assert "2 of 3 files could not be evaluated" in result.stderr
    assert "no truth of this name" in result.stderr
    assert len(table.read_text().splitlines()) == 2
    assert "run-1 " in result.stdout


def test_several_files_without_any(locatk, study: Path) -> None:
    truth = study / "recordings"
    for name, message in (
        (study / "good" / "*.tum", "no file matches"),
        (truth, "no solution in the folder"),
        (study / "nothing.mcap", "No such file"),
    ):
        result = locatk("eval", name, "--truth", truth)
        assert result.exit_code == 1
        assert message in result.stderr
        assert len(result.stderr.splitlines()) == 1
    result = locatk("eval", study / "good", "--truth", truth, "--table", "errors.txt")
    assert result.exit_code == 2
