"""`locatk import` as a user runs it: good tables, bad tables, published ones."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from locatk.formats import observations
from locatk.formats.session import Session

HEADER = "timestamp,source,LHA_count_1,LHA_count_2,LHB_count_1,LHB_count_2"
ROW = "2023-07-27T15:34:{:02d}.700963Z,R,48333,88779,48979,94628"
ROWS = [ROW.format(second) for second in range(20)]


def table(path: Path, *rows: str, header: str = HEADER) -> Path:
    path.write_text("\n".join([header, *rows]) + "\n")
    return path


def test_a_table_becomes_a_session(locatk, tmp_path: Path) -> None:
    out = tmp_path / "run.mcap"
    source = table(tmp_path / "data.csv", *ROWS)
    result = locatk("import", "dotbot-lh2", source, "-o", out, "--json")
    assert result.exit_code == 0, result.stderr
    answer = json.loads(result.stdout)
    assert answer["version"] == 1
    assert (answer["sweeps"], answer["devices"], answer["truth_poses"]) == (80, ["R"], 0)
    sweeps = observations.read_sweeps(Session.open(out))
    assert sorted(set(sweeps.count)) == [48333, 48979, 88779, 94628]
    again = locatk("import", "dotbot-lh2", source, "-o", out)
    assert again.exit_code == 1
    assert "--overwrite" in again.stderr
    assert locatk("import", "dotbot-lh2", source, "-o", out, "--overwrite").exit_code == 0


@pytest.mark.parametrize(
    "rows",
    [
        [*ROWS, "2023-07-27T15:35:00Z,R,many,88779,48979,94628"],
        [*ROWS, "yesterday,R,48333,88779,48979,94628"],
        [*ROWS, "2023-07-27T15:35:00Z,R,48333"],
        [],
    ],
    ids=["text", "time", "short", "empty"],
)
def test_a_bad_table_is_one_line(locatk, tmp_path: Path, rows: list[str]) -> None:
    source = table(tmp_path / "data.csv", *rows)
    out = tmp_path / "run.mcap"
    result = locatk("import", "dotbot-lh2", source, "-o", out)
    assert result.exit_code == 1
    assert result.stderr.startswith("Error: ")
    assert str(source) in result.stderr
    assert result.stderr.count("\n") == 1
    assert sorted(tmp_path.iterdir()) == [source]


def test_a_missing_column_is_named(locatk, tmp_path: Path) -> None:
    source = table(tmp_path / "data.csv", *ROWS, header=HEADER.replace("LHB_count_2", "other"))
    result = locatk("import", "dotbot-lh2", source, "-o", tmp_path / "run.mcap")
    assert result.exit_code == 1
    assert "lhb_count_2" in result.stderr.lower()


def test_the_input_is_never_the_output(locatk, tmp_path: Path) -> None:
    source = table(tmp_path / "data.csv", *ROWS)
    result = locatk("import", "dotbot-lh2", source, "-o", source, "--overwrite")
    assert result.exit_code == 1
    assert source.read_text().startswith(HEADER)


def test_published_grid(locatk, data: Path, tmp_path: Path) -> None:
    grid = data / "lighthouse" / "twoLH-3D_scene" / "dataset" / "data_all.csv"
    out = tmp_path / "grid.mcap"
    # Naming the grid columns' file as truth is welcome; they are read anyway.
    for more in ((), ("--truth", grid)):
        result = locatk("import", "dotbot-lh2", grid, *more, "-o", out, "--overwrite", "--json")
        assert result.exit_code == 0, result.stderr
        answer = json.loads(result.stdout)
        assert answer["sweeps"] == 4 * 4759
        assert answer["truth_poses"] == 4759


def test_published_tracks(locatk, data: Path, tmp_path: Path) -> None:
    scene = data / "lighthouse" / "twoLH-2D_scene" / "dataset"
    truth = scene / "ground_truth" / "1_blender.csv"
    out = tmp_path / "run.mcap"
    source = scene / "lighthouse" / "data.csv"
    result = locatk("import", "dotbot-lh2", source, "--truth", truth, "-o", out, "--json")
    assert result.exit_code == 0, result.stderr
    assert json.loads(result.stdout)["truth_poses"] == 1691
