"""`locatk info`, `eval` and `export` on what `solve` and `import` write."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest

from locatk.cli.eval.command import ALIGNMENTS
from locatk.core import evaluation
from locatk.formats.artifacts import scene as artifacts

POSES = 20


@pytest.fixture
def solved(locatk, requests, session: Path, tmp_path: Path) -> Path:
    out = tmp_path / "solved.mcap"
    assert locatk("solve", session, "-o", out).exit_code == 0
    return out


def test_info_of_a_session(locatk, session: Path) -> None:
    answer = json.loads(locatk("info", session, "--json").stdout)
    assert answer["version"] == 1
    assert (answer["kind"], answer["system"]) == ("session", "lighthouse")
    assert answer["damage"] is None
    assert answer["devices"] == ["red"]
    assert answer["sweeps"] == 2 * POSES
    assert answer["metadata"]["facts"]["note"] == "made by a test"
    assert answer["attachments"][0]["name"] == "scene.toml"
    [station] = answer["stations"]
    assert (station["channel"], station["period_ticks"], station["sweeps"]) == (1, 959000, 40)
    truth = next(item for item in answer["streams"] if item["topic"] == "/truth/red")
    assert (truth["schema"], truth["messages"]) == ("foxglove.PoseInFrame", POSES)
    assert truth["rate_hz"] == pytest.approx((POSES - 1) / answer["duration_s"])
    text = locatk("info", session).stdout
    for words in ("session, lighthouse", "/lighthouse/red", "959000", "made by a test"):
        assert words in text


def test_info_of_a_solution(locatk, solved: Path) -> None:
    answer = json.loads(locatk("info", solved, "--json").stdout)
    assert answer["kind"] == "solution"
    [station] = answer["stations"]
    assert station["calibration"] == "generic"
    assert station["position_m"] == [0.0, 1.0, 2.0]
    assert "4cc60647" in locatk("info", solved).stdout


def test_info_of_a_scene(locatk, scene, tmp_path: Path) -> None:
    path = tmp_path / "scene.toml"
    artifacts.write_scene(path, scene)
    answer = json.loads(locatk("info", path, "--json").stdout)
    assert (answer["kind"], answer["scale"], answer["markers"]) == ("scene", "markers", 1)
    assert answer["stations"][0]["channel"] == 3
    path.write_text("channel = [")
    result = locatk("info", path)
    assert result.exit_code == 1
    assert result.stderr.startswith("Error: ")


@pytest.mark.parametrize("share", [0.3, 0.6, 0.9, 0.99])
def test_info_reports_a_truncated_session(locatk, session: Path, share: float) -> None:
    whole = session.read_bytes()
    session.write_bytes(whole[: int(share * len(whole))])
    result = locatk("info", session, "--json")
    assert result.exit_code == 3
    assert json.loads(result.stdout)["damage"]
    assert result.stderr.startswith("Incomplete: ")
    assert result.stderr.count("\n") == 1


def test_info_of_flipped_bytes_never_crashes(locatk, session: Path) -> None:
    whole = session.read_bytes()
    for at in range(0, len(whole), max(1, len(whole) // 60)):
        session.write_bytes(whole[:at] + bytes([whole[at] ^ 0xFF]) + whole[at + 1 :])
        result = locatk("info", session)
        assert result.exit_code in (0, 1, 3), at
        assert "internal error" not in result.stderr, at


def test_eval_compares_with_the_sessions_truth(locatk, solved: Path, session: Path) -> None:
    result = locatk("eval", solved, "--truth", session, "--json")
    assert result.exit_code == 0, result.stderr
    answer = json.loads(result.stdout)
    assert answer["version"] == 1
    assert answer["n"] == POSES
    assert answer["mae_m"] == pytest.approx(1e-3)
    assert answer["align"] == "none"
    assert answer["devices"]["red"]["rmse_m"] == pytest.approx(1e-3)
    aligned = json.loads(
        locatk("eval", solved, "--truth", session, "--align", "se3", "--json").stdout
    )
    assert aligned["mae_m"] == pytest.approx(0, abs=1e-9)
    text = locatk("eval", solved, "--truth", session).stdout
    assert "1.000" in text
    assert "alignment: none" in text


def test_eval_reads_what_export_writes(locatk, solved: Path, session: Path, tmp_path: Path) -> None:
    for kind in ("csv", "tum"):
        poses = tmp_path / f"poses.{kind}"
        assert locatk("export", solved, "--format", kind, "-o", poses).exit_code == 0
        result = locatk("eval", poses, "--truth", session, "--json")
        assert json.loads(result.stdout)["mae_m"] == pytest.approx(1e-3), kind
    backward = locatk("eval", solved, "--truth", tmp_path / "poses.tum", "--json")
    assert json.loads(backward.stdout)["mae_m"] == pytest.approx(0, abs=1e-12)
    assert json.loads(locatk("eval", solved, "--truth", solved, "--json").stdout)["max_m"] == 0


def test_eval_offset(locatk, solved: Path, session: Path) -> None:
    answer = json.loads(
        locatk("eval", solved, "--truth", session, "--offset", "0.05", "--json").stdout
    )
    assert answer["offset_s"] == 0.05
    assert answer["mae_m"] > 0.005
    for bad in ("soon", "nan", "inf"):
        assert locatk("eval", solved, "--truth", session, "--offset", bad).exit_code == 2


def test_eval_refuses_incomparable_files(
    locatk, record, solved: Path, session: Path, tmp_path
) -> None:
    two = record(tmp_path / "two.mcap", ("green", "blue"))
    result = locatk("eval", solved, "--truth", two)
    assert result.exit_code == 1
    assert f"Error: {solved}: none of its devices is in {two}. Hint: Name" in result.stderr
    assert locatk("eval", session, "--truth", session).exit_code == 1  # not solved
    assert locatk("eval", solved).exit_code == 2


def test_alignments_are_those_of_the_core() -> None:
    assert ALIGNMENTS == evaluation.ALIGNMENTS


def test_export_csv_is_the_contract(locatk, solved: Path, tmp_path: Path) -> None:
    out = tmp_path / "poses.csv"
    assert locatk("export", solved, "--format", "csv", "-o", out).exit_code == 0
    with out.open(newline="") as stream:
        rows = list(csv.reader(stream))
    assert ",".join(rows[0]) == (
        "time_s,device,x_m,y_m,z_m,qx,qy,qz,qw,"
        "sigma_x_m,sigma_y_m,sigma_z_m,sigma_heading_rad,probability"
    )
    assert len(rows) == POSES + 1
    assert rows[1][:2] == ["1700000000.000000000", "red"]
    assert float(rows[1][9]) == pytest.approx(2e-3)
    assert rows[1][12] == ""  # no heading from one photodiode
    before = out.read_bytes()
    assert locatk("export", solved, "--format", "csv", "-o", out).exit_code == 1
    assert out.read_bytes() == before


def test_export_tum_makes_a_file_a_device(locatk, record, requests, tmp_path: Path) -> None:
    session = record(tmp_path / "two.mcap", ("red", "lab/blue"))
    solved = tmp_path / "solved.mcap"
    assert locatk("solve", session, "-o", solved).exit_code == 0
    result = locatk("export", solved, "--format", "tum", "-o", tmp_path / "out")
    assert result.exit_code == 0, result.stderr
    files = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert files == ["lab_blue.tum", "red.tum"]
    assert len((tmp_path / "out" / "red.tum").read_text().splitlines()) == POSES
    assert locatk("export", solved, "--format", "tum", "-o", tmp_path / "out").exit_code == 1
