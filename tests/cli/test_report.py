"""``locatk report`` as people use it."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import Result

from locatk.cli.eval.command import ALIGNMENTS
from locatk.cli.report import plan_outputs
from locatk.core.evaluation import ALIGNMENTS as CORE
from locatk.formats.pipeline import systems

Locatk = Callable[..., Result]
Record = Callable[..., Path]


@pytest.fixture
def solution(session: Path, requests: list[systems.SolveRequest], locatk: Locatk) -> Path:
    """`run.mcap`, solved into `solved.mcap` beside it."""
    path = session.with_name("solved.mcap")
    assert locatk("solve", session, "-o", path).exit_code == 0
    return path


def test_a_page_is_written(solution: Path, locatk: Locatk) -> None:
    page = solution.with_name("report.html")
    done = locatk("report", solution, "-o", page)
    assert done.exit_code == 0, done.stderr
    assert done.stdout == f"Wrote {page}\n"
    text = page.read_text(encoding="utf-8")
    assert "Half of the poses are within 1.00 mm" in text
    assert "3.00" not in done.stderr
    assert "jump" in text
    assert page.stat().st_size < 12e6


@pytest.mark.slow
def test_pictures_are_written_next_to_the_page(
    solution: Path, locatk: Locatk, tmp_path: Path
) -> None:
    done = locatk("report", solution, "-o", tmp_path / "r.html", "--png", "--svg", "--json")
    assert done.exit_code == 0, done.stderr
    files = [str(tmp_path / name) for name in ("r.html", "r.png", "r.svg")]
    assert json.loads(done.stdout) == {"version": 1, "files": files}
    assert all(Path(path).stat().st_size > 1000 for path in files)


@pytest.mark.slow
def test_a_page_opens_in_a_browser(
    solution: Path, locatk: Locatk, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[str] = []
    for answer in (True, False):
        monkeypatch.setattr("webbrowser.open", lambda url, a=answer: opened.append(url) or a)
        page = tmp_path / f"{answer}.html"
        result = locatk("report", solution, "-o", page, "--open")
        assert result.exit_code == 0
        assert opened[-1] == page.as_uri()
        assert ("no browser was found" in result.stderr) != answer
    assert locatk("report", solution, "-o", tmp_path / "closed.html").exit_code == 0
    assert len(opened) == 2


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".pdf", ".SVG"])
def test_just_a_picture(solution: Path, locatk: Locatk, tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"figure{suffix}"
    done = locatk("report", solution, "-o", path)
    assert done.stdout == f"Wrote {path}\n"
    assert not list(tmp_path.glob("*.html"))


@pytest.mark.slow
def test_several_solutions_share_a_page(solution: Path, locatk: Locatk, tmp_path: Path) -> None:
    other = tmp_path / "other.mcap"
    shutil.copy(solution, other)
    done = locatk("report", solution, other, "-o", tmp_path / "r.html", "--png")
    assert done.exit_code == 0, done.stderr
    assert {p.name for p in tmp_path.glob("r*.*")} == {
        "run.mcap", "r.html", "r-solved.png", "r-other.png",
    }  # fmt: skip
    assert "2 solutions" in (tmp_path / "r.html").read_text(encoding="utf-8")


def test_a_folder_stands_for_its_solutions(solution: Path, locatk: Locatk, tmp_path: Path) -> None:
    """Each finds its truth in a folder by the name of its session."""
    solved, recorded = tmp_path / "solved", tmp_path / "recorded"
    for folder in (solved, recorded):
        folder.mkdir()
    for name in ("a-solved.mcap", "b-solved.mcap"):
        shutil.copy(solution, solved / name)
    shutil.copy(solution.with_name("run.mcap"), recorded / "run.mcap")
    shutil.copy(solution.with_name("run.mcap"), solved / "run.mcap")
    done = locatk("report", solved, "-o", tmp_path / "r.html", "--truth", recorded)
    assert done.exit_code == 0, done.stderr
    text = (tmp_path / "r.html").read_text(encoding="utf-8")
    assert "2 solutions" in text
    assert text.count("Half of the poses are within 1.00 mm") == 2
    (recorded / "run.mcap").unlink()
    done = locatk("report", solved, "-o", tmp_path / "s.html", "--truth", recorded)
    assert done.exit_code == 1
    assert "no truth of this name" in done.stderr


def test_solutions_of_one_name_have_their_paths_as_titles(
    solution: Path, locatk: Locatk, tmp_path: Path
) -> None:
    (tmp_path / "again").mkdir()
    other = tmp_path / "again" / solution.name
    shutil.copy(solution, other)
    assert locatk("report", solution, other, "-o", tmp_path / "r.html").exit_code == 0
    page = (tmp_path / "r.html").read_text(encoding="utf-8")
    assert f"<h2>{solution}</h2>" in page
    assert f"<h2>{other}</h2>" in page


def test_names_of_outputs() -> None:
    one, two = Path("a.mcap"), Path("b/a.mcap")
    assert plan_outputs((one,), Path("r.html"), []) == (Path("r.html"), [[]])
    assert plan_outputs((one,), Path("r.PNG"), [".png"]) == (None, [[Path("r.PNG")]])
    assert plan_outputs((one,), Path("r.png"), [".pdf"]) == (None, [[Path("r.png"), Path("r.pdf")]])
    assert plan_outputs((one, two), Path("x/r.svg"), []) == (
        None,
        [[Path("x/r-a.svg")], [Path("x/r-a-2.svg")]],
    )
    _, pictures = plan_outputs((one, two, Path("a-2.mcap")), Path("r.svg"), [])
    assert pictures == [[Path("r-a.svg")], [Path("r-a-2.svg")], [Path("r-a-2-2.svg")]]


def test_each_solution_has_its_own_picture() -> None:
    """Also if their names differ only in characters that no file name may have, or in case."""
    long = 160 * "x"
    stems = ("a:b", "a_b", "A_B", f"{long}1", f"{long}2")
    _, pictures = plan_outputs(tuple(Path(f"{stem}.mcap") for stem in stems), Path("r.png"), [])
    names = [path.name for [path] in pictures]
    assert names[:3] == ["r-a_b.png", "r-a_b-2.png", "r-A_B-3.png"]
    assert len({name.casefold() for name in names}) == len(stems)


@pytest.mark.slow
def test_nothing_is_replaced_without_overwrite(
    solution: Path, locatk: Locatk, tmp_path: Path
) -> None:
    """Not even the page is begun where a picture is in the way."""
    (tmp_path / "r.png").write_text("mine")
    done = locatk("report", solution, "-o", tmp_path / "r.html", "--png")
    assert done.exit_code == 1
    assert "--overwrite" in done.stderr
    assert not (tmp_path / "r.html").exists()
    assert (tmp_path / "r.png").read_text() == "mine"
    assert locatk("report", solution, "-o", tmp_path / "r.png", "--overwrite").exit_code == 0
    assert (tmp_path / "r.png").read_bytes().startswith(b"\x89PNG")
    assert not (tmp_path / "r.html").exists()
    done = locatk("report", solution, "-o", solution, "--overwrite")
    assert done.exit_code == 2


def test_the_inputs_are_safe(solution: Path, locatk: Locatk, tmp_path: Path) -> None:
    truth = tmp_path / "truth.html"
    truth.write_text("0 0 0 0 0 0 0 1\n")
    done = locatk("report", solution, "-o", truth, "--truth", truth, "--overwrite")
    assert done.exit_code == 1
    assert "one of the inputs" in done.stderr


@pytest.mark.parametrize("name", ["report.txt", "report", "report.html.gz"])
def test_other_kinds_of_files_are_refused(
    solution: Path, locatk: Locatk, tmp_path: Path, name: str
) -> None:
    done = locatk("report", solution, "-o", tmp_path / name)
    assert done.exit_code == 2
    assert ".html, .png, .pdf, .svg" in done.stderr


def test_files_other_than_solutions_are_one_line(
    session: Path, locatk: Locatk, tmp_path: Path
) -> None:
    for wrong in (session, tmp_path / "nowhere.mcap"):
        done = locatk("report", wrong, "-o", tmp_path / "r.html")
        assert done.exit_code == 1
        assert done.stderr.startswith("Error: ")
        assert done.stderr.count("\n") == 1
        assert "Hint: " in done.stderr
    assert "locatk solve" in locatk("report", session, "-o", tmp_path / "r.html").stderr
    text = tmp_path / "text.mcap"
    text.write_text("no mcap")
    done = locatk("report", text, "-o", tmp_path / "r.html")
    assert done.exit_code == 1
    assert done.stderr.count("\n") == 1


def test_the_session_can_be_in_another_folder(
    solution: Path, session: Path, locatk: Locatk, tmp_path: Path
) -> None:
    (tmp_path / "far").mkdir()
    far = session.rename(tmp_path / "far" / "run.mcap")
    page = tmp_path / "r.html"
    assert locatk("report", solution, "-o", page).exit_code == 0
    assert "--session FILE adds them" in page.read_text(encoding="utf-8")
    assert locatk("report", solution, "-o", page, "--session", far, "--overwrite").exit_code == 0
    assert "Half of the poses" in page.read_text(encoding="utf-8")


@pytest.mark.slow
def test_sessions_are_assigned_to_solutions_by_name(
    solution: Path, session: Path, record: Record, locatk: Locatk, tmp_path: Path
) -> None:
    (tmp_path / "far").mkdir()
    other = record(tmp_path / "far" / "second.mcap")
    solved = tmp_path / "second-solved.mcap"
    assert locatk("solve", other, "-o", solved).exit_code == 0
    both = ("report", solution, solved, "-o", tmp_path / "r.html")
    done = locatk(*both, "--session", other)
    assert done.exit_code == 0, done.stderr
    text = (tmp_path / "r.html").read_text(encoding="utf-8")
    assert text.count("Half of the poses") == 2
    done = locatk(*both, "--session", solution, "--overwrite")
    assert done.exit_code == 2
    assert "No solution is from the session" in done.stderr


@pytest.mark.slow
def test_truth_of_another_time_is_reported(solution: Path, locatk: Locatk, tmp_path: Path) -> None:
    (tmp_path / "old.tum").write_text("1 0 0 0 0 0 0 1\n2 1 0 0 0 0 0 1\n")
    done = locatk("report", solution, "-o", tmp_path / "r.html", "--truth", tmp_path / "old.tum")
    assert done.exit_code == 0
    reason = "no pose of the estimate has truth at its time. There are no errors."
    assert reason in done.stderr
    assert reason in (tmp_path / "r.html").read_text(encoding="utf-8")


@pytest.mark.slow
def test_a_session_cut_short_does_not_stop_the_report(
    solution: Path, session: Path, locatk: Locatk, tmp_path: Path
) -> None:
    data = session.read_bytes()
    for n, length in enumerate((0, 20, len(data) // 3, len(data) // 2, len(data) - 9)):
        session.write_bytes(data[:length])
        done = locatk("report", solution, "-o", tmp_path / f"r{n}.html")
        assert done.exit_code == 0, done.stderr


def test_alignments_are_those_of_eval() -> None:
    assert tuple(ALIGNMENTS) == tuple(CORE)
