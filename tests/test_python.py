"""What `import locatk` offers, on sessions of all systems."""

from __future__ import annotations

import doctest
import inspect
import subprocess
import sys
from pathlib import Path
from typing import Any

import matplotlib.image
import numpy as np
import pytest

import locatk
from locatk.core.errors import FormatError, InputError, LocatkError, OutputExistsError
from locatk.core.trajectory import Trajectory
from locatk.formats.api import functions, session, solution

PAGE = Path(__file__).parent.parent / "docs" / "python.md"

MAX_REPR = 120
"""Longest representation in characters: one line of a terminal."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("python")


@pytest.fixture(scope="module")
def recorded(folder: Path) -> session.Session:
    settings = {"robots": {"count": 11, "duration_s": 20.0}}
    return functions.simulate("lighthouse", folder / "run.mcap", settings, seed=2)


@pytest.fixture(scope="module")
def solved(recorded: session.Session) -> solution.Solution:
    return functions.solve(recorded)


@pytest.mark.slow
def test_the_examples_of_the_page_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pandas")
    monkeypatch.chdir(tmp_path)
    text = "\n".join(
        "" if line.startswith("```") else line
        for line in PAGE.read_text(encoding="utf-8").splitlines()
    )
    examples = doctest.DocTestParser().get_doctest(text, {}, PAGE.name, str(PAGE), 0)
    assert len(examples.examples) > 15
    runner = doctest.DocTestRunner()
    runner.run(examples)
    assert runner.failures == 0


def test_all_names_are_on_the_page_and_exist() -> None:
    text = PAGE.read_text(encoding="utf-8")
    for name in locatk.__all__:
        assert getattr(locatk, name) is not None
        assert f"locatk.{name}" in text or f"`{name}" in text, name
    for kind in (session.Session, solution.Solution):
        members = {name for name in vars(kind) if not name.startswith("_")} - {"read"}
        missing = [n for n in members if f"`{n}`" not in text and f"`{n}(" not in text]
        assert missing == []
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        locatk.nothing  # noqa: B018


def test_signatures_are_those_of_the_page() -> None:
    text = PAGE.read_text(encoding="utf-8")
    for name in ("open", "solve", "evaluate", "simulate"):
        parameters = inspect.signature(getattr(locatk, name)).parameters.values()
        plain = [str(p.replace(annotation=p.empty)).replace("'", '"') for p in parameters]
        keyword = [p.kind is p.KEYWORD_ONLY for p in parameters]
        if True in keyword:
            plain.insert(keyword.index(True), "*")
        assert f"`locatk.{name}({', '.join(plain)})`".replace(" = ", "=") in text


def test_importing_is_lazy() -> None:
    """The command line imports the package first; numpy alone takes longer than all of it."""
    code = "import sys, locatk; print([m for m in ('numpy', 'click', 'mcap') if m in sys.modules])"
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert result.stdout.strip() == "[]"


def test_open_tells_sessions_from_solutions(
    folder: Path, recorded: session.Session, solved: solution.Solution
) -> None:
    path = solved.save(folder / "saved.mcap")
    opened = locatk.open(path)
    assert isinstance(opened, solution.Solution)
    assert isinstance(locatk.open(recorded.path), session.Session)
    assert opened.facts["source"] == "run.mcap"
    assert list(opened.poses) == [f"robot-{k:02}" for k in range(1, 12)]
    for device, trajectory in solved.poses.items():
        np.testing.assert_array_equal(opened.poses[device].position, trajectory.position)
    with pytest.raises(OutputExistsError):
        solved.save(path)
    with pytest.raises(FormatError, match="a solution, not a session"):
        locatk.solve(path)
    (folder / "text.mcap").write_text("no MCAP file")
    with pytest.raises(LocatkError):
        locatk.open(folder / "text.mcap")


def test_a_saved_solution_is_that_of_the_command(
    folder: Path, recorded: session.Session, solved: solution.Solution
) -> None:
    from locatk.formats.pipeline.solving import solve_file

    solve_file(recorded.path, folder / "by-command.mcap")
    by_command = locatk.open(folder / "by-command.mcap")
    assert isinstance(by_command, solution.Solution)
    assert by_command.facts["source_sha256"] == solved.facts["source_sha256"]
    for device, trajectory in solved.poses.items():
        np.testing.assert_array_equal(by_command.poses[device].position, trajectory.position)


def test_errors_by_any_kind_of_truth(
    folder: Path, recorded: session.Session, solved: solution.Solution
) -> None:
    expected = locatk.evaluate(solved)
    assert expected.ape_translation.median < 0.002
    path = solved.save(folder / "evaluated.mcap")
    truths = (recorded, recorded.path, recorded.truth, list(recorded.truth.values()))
    for estimate in (solved, path, solved.poses):
        for truth in truths:
            found = locatk.evaluate(estimate, truth)
            np.testing.assert_array_equal(found.errors, expected.errors)
    np.testing.assert_array_equal(locatk.evaluate(path).errors, expected.errors)
    one = locatk.evaluate(solved.poses["robot-03"], recorded.truth["robot-03"], align="se2")
    assert (one.devices, one.align) == (("robot-03",), "se2")
    with pytest.raises(InputError, match="no truth is given"):
        locatk.evaluate(solved.poses["robot-03"])
    named = Trajectory.from_positions("tag", "floor", np.zeros(1, np.int64), np.zeros((1, 3)))
    with pytest.raises(InputError, match="no device has truth"):
        locatk.evaluate([named, named], list(recorded.truth.values())[:3])


def test_the_table_has_the_numbers_of_the_poses(solved: solution.Solution) -> None:
    pandas = pytest.importorskip("pandas")
    table = solved.to_dataframe()
    assert len(table) == solved.result.poses
    rows = table[table.device == "robot-10"]
    track = solved.poses["robot-10"]
    np.testing.assert_array_equal(rows[["x_m", "y_m", "z_m"]], track.position)
    np.testing.assert_array_equal(rows.sigma_x_m, track.sigma[:, 0])
    assert rows.time.iloc[0] == pandas.Timestamp(int(track.time_ns[0]), unit="ns", tz="UTC")
    # A single photodiode has no orientation.
    assert rows[["qx", "qy", "qz", "qw", "sigma_heading_rad", "probability"]].isna().all(axis=None)


@pytest.mark.slow
def test_plot_and_report(folder: Path, solved: solution.Solution) -> None:
    solved.plot(align="se2").savefig(folder / "plot.png")
    picture = matplotlib.image.imread(folder / "plot.png")
    assert picture.std() > 0.05
    page = solved.report(folder / "report.html", align="se2").read_text(encoding="utf-8")
    assert "robot-11" in page
    assert "APE" in page or "rmse" in page.lower()
    with pytest.raises(OutputExistsError):
        solved.report(folder / "report.html")


def test_representations_are_short(recorded: session.Session, solved: solution.Solution) -> None:
    values = (
        recorded, recorded.sweeps, solved, solved.result, solved.poses["robot-01"],
        locatk.evaluate(solved),
    )  # fmt: skip
    for value in values:
        assert repr(value).startswith("<")
        assert len(repr(value)) < MAX_REPR
        assert "\n" not in repr(value)
    for shown in (recorded._repr_html_(), solved._repr_html_()):
        assert shown.count("<table>") == shown.count("</table>") > 0
    assert "<script" not in solution.Solution(solved.result, "<script>", {})._repr_html_()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"foo": 1}, "no option 'foo'"),
        ({"speed": 1.0}, "is not an option of lighthouse"),
        ({"method": "magic"}, "no method 'magic'"),
    ],
)
def test_wrong_options(recorded: session.Session, options: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        locatk.solve(recorded, **options)


@pytest.mark.parametrize(
    ("system", "settings", "message"),
    [
        ("sonar", {}, "no system 'sonar'"),
        ("lighthouse", {"robots": {"cout": 2}}, "unknown key 'cout'"),
        ("lighthouse", {"robot": {"count": 2}}, "unknown key 'robot'"),
        ("lighthouse", {"robots": {"count": -2}}, "at least 1"),
        ("lighthouse", {"robots": {"flying": True, "planar": True}}, "not both"),
        ("landmarks", {}, "landmarks are simulated on a map"),
    ],
)
def test_wrong_settings(
    tmp_path: Path, system: str, settings: dict[str, dict[str, object]], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        locatk.simulate(system, tmp_path / "run.mcap", settings)
    assert not list(tmp_path.iterdir())


def test_settings_are_those_of_the_file(tmp_path: Path, recorded: session.Session) -> None:
    file = tmp_path / "simulation.toml"
    file.write_text(
        'format = "locatk-simulation-lighthouse"\nformat_version = 1\n'
        "[robots]\ncount = 11\nduration_s = 20.0\n[random]\nseed = 9\n"
    )
    by_file = functions.simulate("lighthouse", tmp_path / "run.mcap", file, seed=2)
    np.testing.assert_array_equal(by_file.sweeps.count, recorded.sweeps.count)


@pytest.mark.parametrize(
    ("system", "observations"),
    [("dots", "frames"), ("polaris", "magnetometers"), ("landmarks", "halls")],
)
@pytest.mark.slow
def test_other_systems(tmp_path: Path, locatk: Any, system: str, observations: str) -> None:
    artifact = None
    if system == "landmarks":
        artifact = tmp_path / "map.toml"
        locatk("map", "design", "5x6", "-o", artifact)
    recording = functions.simulate(system, tmp_path / "run.mcap", artifact=artifact, seed=1)
    assert recording.system == system
    observed = getattr(recording, observations)
    assert len(observed) == 1
    assert len(repr(observed[0])) < MAX_REPR
    result = functions.solve(recording)
    assert result.system == system
    assert result.detections
    assert "<table>" in result._repr_html_()


def test_an_artifact_that_is_not_used_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="dots is simulated without an artifact"):
        functions.simulate("dots", tmp_path / "run.mcap", artifact=tmp_path / "map.toml")


def test_devices_without_truth_are_named(
    recorded: session.Session, solved: solution.Solution
) -> None:
    true = [track for device, track in recorded.truth.items() if device != "robot-02"]
    with pytest.warns(UserWarning, match="no truth for robot-02$"):
        errors = functions.evaluate(solved, true)
    assert "robot-02" not in errors.devices
