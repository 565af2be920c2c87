"""docs/commands.md is what the commands themselves say."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.slow
def test_page_is_up_to_date(root: Path) -> None:
    """In a process of its own: click keeps the help option of the first context of a command."""
    script = root / ".ci" / "commands.py"
    checked = subprocess.run(
        [sys.executable, str(script), "--check"], capture_output=True, text=True
    )
    assert checked.returncode == 0, checked.stderr
