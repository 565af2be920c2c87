"""The stories of this folder: what six users do, from the first command to what they wanted.

Each is a script that a reader can follow and run. Here they run with the installed package, or with
that of this checkout; ``.ci/stories`` runs them in a fresh environment with the built wheel.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
STORIES = sorted({*HERE.glob("*.sh"), *HERE.glob("*.py")} - {Path(__file__)})

LIMIT_S = 300.0


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return a PATH on which ``locatk`` and ``python`` are those of these tests."""
    folder = tmp_path_factory.mktemp("bin")
    for name, arguments in {"locatk": "-m locatk.cli", "python": ""}.items():
        program = folder / name
        program.write_text(f'#!/bin/sh\nexec "{sys.executable}" {arguments} "$@"\n')
        program.chmod(0o755)
    return f"{folder}{os.pathsep}{os.environ['PATH']}"


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
@pytest.mark.parametrize("story", STORIES, ids=lambda story: story.stem)
def test_story(story: Path, path: str, tmp_path: Path) -> None:
    program = ["python"] if story.suffix == ".py" else ["bash", "-euo", "pipefail"]
    done = subprocess.run(
        [*program, story],
        cwd=tmp_path,
        env={**os.environ, "PATH": path},
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
    )
    assert done.returncode == 0, f"{done.stdout}\n{done.stderr}"
