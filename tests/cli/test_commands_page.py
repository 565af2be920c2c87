"""docs/commands.md is what the commands themselves say."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

import pytest


def test_page_is_up_to_date(
    root: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    script = str(root / ".ci" / "commands.py")
    monkeypatch.setattr(sys, "argv", [script, "--check"])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(script, run_name="__main__")
    assert ended.value.code == 0, capsys.readouterr().err
