"""``locatk advise``: output, files and refusals."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner

from locatk.cli.advise import command as advise_command
from locatk.cli.app import app
from locatk.core.advice import comparison, dots, polaris

FAST = ["--area", "1x0.5", "--accuracy", "20"]


@pytest.fixture
def fast_systems(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compare the two systems that are designed in less than a second."""
    advisers = {"dots": dots.advise, "polaris": polaris.advise}
    monkeypatch.setattr(comparison, "ADVISERS", advisers)


def run(*arguments: str, **more: object):
    return CliRunner().invoke(app, ["advise", *arguments], **more)  # type: ignore[arg-type]


@pytest.mark.slow
def test_all_four_systems_are_compared(tmp_path: Path) -> None:
    page = tmp_path / "plan.html"
    result = run("--area", "2x2", "--accuracy", "10", "--report", str(page), "--json")
    assert result.exit_code == 0, result.stderr
    entry = json.loads(result.stdout)
    assert entry["version"] == 1
    systems = {system["system"]: system for system in entry["systems"]}
    assert set(systems) == {"lighthouse", "dots", "polaris", "landmarks"}
    assert systems[entry["best"]]["feasible"]
    for system in systems.values():
        assert all(check["source"] and check["certainty"] for check in system["checks"])
        assert all(system[key] for key in ("power", "risks", "paper", "work", "commands"))
    html = page.read_text()
    assert "Map of the expected errors" in html
    for word in ("Risks", "Maintenance", "What the paper says", "task.toml", "locatk room design"):
        assert word in html


@pytest.mark.usefixtures("fast_systems")
def test_text_names_what_is_not_met_and_what_would_have_to_change() -> None:
    result = run(*FAST)
    assert result.exit_code == 0
    lines = result.stdout.splitlines()
    assert lines[0].split()[:1] == ["wanted"]
    assert "polaris does not meet:" in lines
    assert any("--route" in line for line in lines)
    assert "Next:" in lines
    assert max(map(len, lines)) <= 80


@pytest.mark.slow
@pytest.mark.usefixtures("fast_systems")
def test_impossible_tasks_are_answered_with_exit_status_3() -> None:
    result = run("--area", "3x3", "--accuracy", "0.01", "--floor", "none")
    assert result.exit_code == 3
    assert "no system meets all requirements" in result.stderr.lower()
    assert "calibrate sheet" in result.stdout  # what would make dots more accurate


@pytest.mark.slow
@pytest.mark.usefixtures("fast_systems")
def test_task_file_gives_the_same_answer_as_the_options(tmp_path: Path) -> None:
    task = tmp_path / "task.toml"
    printed = run(*FAST, "--robots", "3", "--print-task")
    assert printed.exit_code == 0
    task.write_text(printed.stdout)
    first, second = run(*FAST, "--robots", "3", "--json"), run("--task", str(task), "--json")
    assert json.loads(first.stdout) == json.loads(second.stdout)
    overridden = run("--task", str(task), "--robots", "5", "--json")
    assert json.loads(overridden.stdout)["settings"]["robots.count"] == 5


@pytest.mark.usefixtures("fast_systems")
def test_routes_of_a_file_are_relative_to_it_and_give_the_area(tmp_path: Path) -> None:
    folder = tmp_path / "site"
    folder.mkdir()
    (folder / "aisle.csv").write_text("x_m,y_m\n0,0\n3,0\n")
    task = folder / "task.toml"
    task.write_text(
        'format = "locatk-task"\nformat_version = 1\n[area]\nroutes = ["aisle.csv"]\n'
        "[wanted]\nposition_mm = 20\n"
    )
    result = run("--task", str(task), "--json")
    assert result.exit_code == 0, result.stderr
    entry = json.loads(result.stdout)
    tags = next(system for system in entry["systems"] if system["system"] == "polaris")
    assert tags["feasible"]
    assert "1 route" in tags["design"]
    points = next(s for s in entry["systems"] if s["system"] == "dots")["map"]["points_m"]
    # The area is the route with half a robot's size around it.
    assert max(x for x, _ in points) < 3.2
    assert max(y for _, y in points) < 0.2


@pytest.mark.usefixtures("fast_systems")
def test_questions_are_asked_on_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(advise_command, "_has_terminal", lambda: True)
    answers = ["1x0.5", "", "maybe", "no", "", "", "print", "4", "", "fast", "0.2", "20", ""]
    result = run(input="\n".join(answers) + "\n")
    assert result.exit_code == 0, result.output
    assert "--area 1x0.5 --no-ceiling --floor print --robots 4 --speed 0.2 --accuracy 20" in (
        result.stderr.replace("\n", " ")
    )
    assert "expected yes or no" in result.stderr
    assert "tripod" in result.stdout or "sheets" in result.stdout


@pytest.mark.slow
@pytest.mark.usefixtures("fast_systems")
def test_report_is_not_overwritten_unasked(tmp_path: Path) -> None:
    page = tmp_path / "plan.html"
    page.write_text("mine")
    refused = run(*FAST, "--report", str(page))
    assert refused.exit_code == 1
    assert page.read_text() == "mine"
    assert run(*FAST, "--report", str(page), "--overwrite").exit_code == 0
    first = page.read_bytes()
    assert run(*FAST, "--report", str(page), "--overwrite").exit_code == 0
    assert page.read_bytes() == first


@pytest.mark.parametrize(
    ("arguments", "status", "message"),
    [
        ([], 2, "No task"),
        (["--area", "10"], 2, "10"),
        (["--area", "10x-3"], 2, "10x-3"),
        (["--area", "10000x3"], 1, "at most 1000 m"),
        (["--area", "1000x0.01"], 1, "0.01 m"),
        (["--clearance", "3000"], 1, "3000 mm"),
        (["--currency", "euro"], 1, "ISO 4217"),
        (["--floor", "none", "--floor", "print"], 1, "none alone"),
        (["--accuracy", "0"], 2, "0"),
        (["--accuracy", "90000"], 1, "at most 10000 mm"),
        (["--floor", "carpet"], 2, "carpet"),
        (["--route", "missing.csv"], 1, "missing.csv"),
        (["--task", "missing.toml"], 1, "missing.toml"),
        (["--accurracy", "3"], 2, "--accuracy"),
    ],
)
def test_bad_input_is_one_line_with_a_hint(arguments: list[str], status: int, message: str) -> None:
    result = run(*arguments)
    assert result.exit_code == status
    assert message in result.stderr
    assert "Traceback" not in result.stderr


@pytest.mark.usefixtures("fast_systems")
def test_a_task_of_defaults_is_a_task(tmp_path: Path) -> None:
    task = tmp_path / "task.toml"
    task.write_text(run("--print-task").stdout)
    result = run("--task", str(task), "--json")
    assert result.exit_code == 0, result.stderr
    assert json.loads(result.stdout)["settings"] == {}


@pytest.mark.usefixtures("fast_systems")
def test_a_system_without_a_design_does_not_stop_the_others() -> None:
    result = run(*FAST, "--clearance", "0.2", "--json")
    entry = json.loads(result.stdout)
    assert entry["best"] == "dots"
    tags = next(system for system in entry["systems"] if system["system"] == "polaris")
    check = next(check for check in tags["checks"] if check["name"] == "design")
    assert check["is_met"] is False
    assert "clearance" in check["expected"]


def test_unknown_keys_and_open_outlines_of_a_task_are_named(tmp_path: Path) -> None:
    task = tmp_path / "task.toml"
    head = 'format = "locatk-task"\nformat_version = 1\n'
    task.write_text(head + "[wanted]\npositon_mm = 3\n")
    result = run("--task", str(task))
    assert result.exit_code == 1
    assert "position_mm" in result.stderr
    task.write_text(head + "[area]\noutline_m = [[0, 0], [1, 0]]\n")
    result = run("--task", str(task))
    assert result.exit_code == 1
    assert "corners" in result.stderr
