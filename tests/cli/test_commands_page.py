"""docs/commands.md is what the commands themselves say."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path


def test_page_is_up_to_date(root: Path) -> None:
    script = root / ".ci" / "commands.py"
    done = subprocess.run([sys.executable, script, "--check"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
