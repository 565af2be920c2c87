"""The README: what .ci/run takes from it, and that it promises nothing that is not there."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import click
import pytest

from locatk.cli.app import app


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


@pytest.mark.parametrize("page", ["README.md", "docs/index.md"])
def test_links_lead_somewhere(root: Path, page: str) -> None:
    path = root / page
    for target in re.findall(r"\]\(([^)#]+)[^)]*\)", path.read_text(encoding="utf-8")):
        if not target.startswith("http"):
            assert (path.parent / target).exists(), target


def test_commands_are_valid_usage(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Path, "exists", lambda self, **_: True)
    text = (root / "README.md").read_text(encoding="utf-8")
    found = re.findall(r"^locatk .*$|(?<=`)locatk [^`]+(?=`)", text, re.M)
    assert len(found) > 5
    for line in found:
        args = line.split()[1:]
        command: click.Command = app
        while isinstance(command, click.Group):
            child = command.get_command(click.Context(app), args.pop(0))
            assert child is not None, line
            command = child
        if args:  # a bare name is a mention, not a use
            command.make_context("example", args)


def test_python_example_runs(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = (root / "README.md").read_text(encoding="utf-8")
    [code] = re.findall(r"^```python\n(.*?)^```$", text, re.M | re.S)
    exec(code, {})
    assert len(capsys.readouterr().out.splitlines()) == 3
