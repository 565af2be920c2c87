"""The notebooks of the documentation run from top to bottom."""

from __future__ import annotations

import json
from pathlib import Path

import matplotlib as mpl
import pytest

NOTEBOOKS = sorted((Path(__file__).parent.parent / "docs" / "notebooks").glob("*.ipynb"))


def run(notebook: Path) -> dict[str, object]:
    """Execute the code of a notebook; return its variables."""
    cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
    names: dict[str, object] = {}
    for number, cell in enumerate(cells):
        assert not cell.get("outputs"), "notebooks are stored without outputs"
        if cell["cell_type"] == "code":
            code = compile("".join(cell["source"]), f"{notebook.name}[{number}]", "exec")
            exec(code, names)
    return names


@pytest.mark.slow
@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs(notebook: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pandas")
    mpl.use("agg")
    monkeypatch.chdir(tmp_path)
    names = run(notebook)
    if notebook.stem == "study":
        table = names["table"]
        assert len(table) == 100  # type: ignore[arg-type]
        median = table.groupby("wrong").median_mm.median()  # type: ignore[attr-defined]
        assert median.max() < 5.0
    else:
        assert (tmp_path / "first.html").exists()


def test_there_are_two_notebooks() -> None:
    assert [path.stem for path in NOTEBOOKS] == ["first-analysis", "study"]
