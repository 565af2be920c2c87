"""Wrong usage is reported as such, also if the output exists."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (("simulate", "lighthouse", "-o", "RUN", "--robots", "0"), "'--robots'"),
        (("simulate", "dots", "-o", "RUN", "--bogus"), "--bogus"),
        (("tag", "design", "-o", "ART", "--count", "-3"), "'--count'"),
        (("map", "design", "0x4", "-o", "ART"), "'0x4'"),
        (("print", "pattern", "--size", "A99", "-o", "RUN"), "RUN"),
        (("import", "polaris-csv", "RUN", "-o", "RUN", "--rate", "40"), "needs --spacing"),
        (("import", "polaris-csv", "RUN", "-o", "ART", "--rate", "40"), "needs --spacing"),
        (("decode", "RUN", "-o", "RUN", "--device", "foo"), "no device 'foo'"),
        (("capture", "loop://", "-o", "RUN", "--device", "foo"), "no device 'foo'"),
        (("solve", "RUN", "-o", "RUN", "--method", "foo"), "'--method'"),
        (("export", "RUN", "-o", "CSV", "--covariance"), "--covariance"),
        (("eval", "RUN", "--truth", "RUN", "--table", "RUN"), "RUN"),
        (("calibrate", "scene", "RUN", "-o", "ART", "--bogus"), "--bogus"),
    ],
)
def test_usage_comes_before_existing_outputs(
    locatk: Callable[..., Any], tmp_path: Path, words: tuple[str, ...], problem: str
) -> None:
    files = {"RUN": "run.mcap", "ART": "scene.toml", "CSV": "poses.csv"}
    for name in files.values():
        (tmp_path / name).write_text("before")
    given = [str(tmp_path / files[word]) if word in files else word for word in words]
    result = locatk(*given)
    assert result.exit_code in (1, 2)
    assert files.get(problem, problem) in result.stderr
    assert "output exists" not in result.stderr
    assert {(tmp_path / name).read_text() for name in files.values()} == {"before"}
