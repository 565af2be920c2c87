"""README and docs: what .ci/run takes from them, and that they promise what is there."""

from __future__ import annotations

import contextlib
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import click
import pytest

from locatk.cli.app import app

ROOT = Path(__file__).resolve().parent.parent
PAGES = [
    "README.md",
    "CONTRIBUTING.md",
    "SECURITY.md",
    # The page of commands is made from the commands and has a test of its own.
    *(
        path.relative_to(ROOT).as_posix()
        for path in sorted((ROOT / "docs").rglob("*.md"))
        if path.stem != "commands"
    ),
]

REPOSITORY = re.compile(
    r"https://(?:github\.com/locatk/locatk/blob|raw\.githubusercontent\.com/locatk/locatk)/main/"
)
"""Addresses of files of the repository."""

CONTEXT = click.Context(app, **app.context_settings)
"""Of ``locatk``. A command keeps its help option, with the names of the first context it has."""


@pytest.mark.parametrize("heading", ["Run it", "Test it"])
def test_one_line_does_all(root: Path, heading: str) -> None:
    done = subprocess.run(
        [sys.executable, root / ".ci" / "readme.py", heading],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.count("\n") == 1
    assert done.stdout.startswith("python3 -m venv ")


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_somewhere(root: Path, page: str) -> None:
    path = root / page
    for target in re.findall(r"\]\(([^)#]+)[^)]*\)", path.read_text(encoding="utf-8")):
        if REPOSITORY.match(target):
            assert (root / REPOSITORY.sub("", target)).exists(), target
        elif not target.startswith("http"):
            assert (path.parent / target).exists(), target


def test_readme_has_no_relative_link(root: Path) -> None:
    """PyPI shows the README without the files beside it."""
    text = (root / "README.md").read_text(encoding="utf-8")
    assert re.findall(r"\]\((?!https://|#)[^)]*\)", text) == []
    assert re.findall(r"(?:src|href)=[\"'](?!https://|#)", text) == []
    images = re.findall(r"!\[[^\]]*\]\(([^)]*)\)", text)
    assert images
    assert all(image.startswith("https://raw.githubusercontent.com/") for image in images)


def test_version_is_the_one_of_the_changelog_and_the_citation(root: Path) -> None:
    version = tomllib.loads((root / "pyproject.toml").read_text("utf-8"))["project"]["version"]
    newest = re.search(r"^## (\S+)", (root / "CHANGELOG.md").read_text("utf-8"), re.M)
    cited = re.search(r"^version: (\S+)$", (root / "CITATION.cff").read_text("utf-8"), re.M)
    assert newest
    assert cited
    assert newest[1] == cited[1] == version


def command_of(words: list[str]) -> tuple[click.Command, list[str]]:
    """The command that ``locatk words...`` calls, and what is left of the words."""
    command: click.Command = app
    while isinstance(command, click.Group) and words and not words[0].startswith("-"):
        child = command.get_command(CONTEXT, words[0])
        assert child is not None, words
        command, words = child, words[1:]
    return command, words


@pytest.mark.parametrize("page", PAGES)
def test_command_lines_are_valid_usage(
    root: Path, page: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also of what is only shown: tests/test_guides.py runs the ```sh blocks."""
    text = (root / page).read_text(encoding="utf-8").replace("\\\n", " ")
    monkeypatch.setattr(Path, "exists", lambda self, **_: True)
    for block in re.findall(r"^```(?:sh|console)\n(.*?)^```$", text, re.M | re.S):
        for line in re.findall(r"^(?:\$ )?locatk (.*)$", block, re.M):
            words = shlex.split(re.split(r" (?:[|>&]|2>)", line)[0], comments=True)
            command, words = command_of(words)
            with contextlib.suppress(click.exceptions.Exit):  # of --print-prices and the like
                command.make_context("example", words, parent=CONTEXT)


@pytest.mark.parametrize("page", PAGES)
def test_mentioned_commands_and_options_are_there(root: Path, page: str) -> None:
    text = (root / page).read_text(encoding="utf-8")
    for line in re.findall(r"(?<=`)locatk ([^`]+)(?=`)", text):
        command, words = command_of(line.split())
        context = click.Context(command, parent=CONTEXT)
        known = {name for option in command.get_params(context) for name in option.opts}
        known |= {name for option in command.get_params(context) for name in option.secondary_opts}
        assert {word for word in words if word.startswith("-")} <= known, line


def test_python_example_runs(
    root: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    text = (root / "README.md").read_text(encoding="utf-8")
    [code] = re.findall(r"^```python\n(.*?)^```$", text, re.M | re.S)
    exec(code, {})
    assert len(capsys.readouterr().out.splitlines()) == 3
    assert (tmp_path / "two.html").stat().st_size > 10_000
