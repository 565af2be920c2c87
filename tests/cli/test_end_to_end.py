"""Simulate, solve, evaluate, bench: the real thing, from the command line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from click.testing import CliRunner

    from locatk.cli.app import app

    path = tmp_path_factory.mktemp("simulated") / "run.mcap"
    args = ["simulate", "lighthouse", "-o", str(path), "--robots", "2", "--duration", "20"]
    result = CliRunner().invoke(app, [*args, "--seed", "3"])
    assert result.exit_code == 0, result.stderr
    return path


def test_simulated_poses_agree_with_the_truth(locatk, simulated: Path, tmp_path: Path) -> None:
    out, scene = tmp_path / "solved.mcap", tmp_path / "scene.toml"
    result = locatk("solve", simulated, "-o", out, "--save-scene", scene, "--json")
    assert result.exit_code == 0, result.stderr
    [entry] = json.loads(result.stdout)["sessions"]
    assert entry["system"] == "lighthouse"
    assert entry["poses"] > 100
    assert {detection["channel"] for detection in entry["detections"]} == {1, 2}
    score = json.loads(locatk("eval", out, "--truth", simulated, "--json").stdout)
    assert score["mae_m"] < 0.005
    # The saved scene serves another time, without solving it again.
    again = tmp_path / "again.mcap"
    result = locatk("solve", simulated, "-o", again, "--artifact", scene, "--json")
    assert result.exit_code == 0, result.stderr
    score = json.loads(locatk("eval", again, "--truth", simulated, "--json").stdout)
    assert score["mae_m"] < 0.005


@pytest.mark.slow
def test_a_scene_of_another_site_gives_status_3(locatk, simulated: Path, tmp_path: Path) -> None:
    other, scene = tmp_path / "other.mcap", tmp_path / "scene.toml"
    args = ("--seed", 8, "--duration", 10)
    assert locatk("simulate", "lighthouse", "-o", other, *args).exit_code == 0
    assert locatk("calibrate", "scene", other, "-o", scene).exit_code == 0
    out = tmp_path / "out.mcap"
    result = locatk("solve", simulated, "-o", out, "--artifact", scene)
    assert result.exit_code == 3, result.stderr
    assert "of the epochs contradict the scene: a station was moved since" in result.stderr


@pytest.mark.slow
def test_frames_blurred_by_motion_are_status_3(locatk, tmp_path: Path) -> None:
    frames, out = tmp_path / "frames.mcap", tmp_path / "out.mcap"
    args = ("--frames", 4, "--motion", 13)
    assert locatk("simulate", "dots", "-o", frames, *args).exit_code == 0
    result = locatk("solve", frames, "-o", out)
    assert result.exit_code == 3, result.stderr
    assert "no pose for camera" in result.stderr


def test_same_seed_same_bytes(locatk, tmp_path: Path) -> None:
    files = [tmp_path / f"{n}.mcap" for n in range(3)]
    for path, seed in zip(files, (5, 5, 6), strict=True):
        args = ("--duration", 2, "--seed", seed)
        assert locatk("simulate", "lighthouse", "-o", path, *args).exit_code == 0
    assert files[0].read_bytes() == files[1].read_bytes() != files[2].read_bytes()


def test_the_session_does_not_give_the_answer_away(locatk, simulated: Path) -> None:
    """Stations are for the solver to find: only their channels are seen in the sweeps."""
    answer = json.loads(locatk("info", simulated, "--json").stdout)
    assert answer["markers"] > 0
    assert [station["position_m"] for station in answer["stations"]] == [None, None]


@pytest.mark.slow
def test_published_grid_is_solved(locatk, data: Path, tmp_path: Path) -> None:
    grid, out = tmp_path / "grid.mcap", tmp_path / "solved.mcap"
    source = data / "lighthouse" / "twoLH-3D_scene" / "dataset" / "data_all.csv"
    assert locatk("import", "dotbot-lh2", source, "-o", grid).exit_code == 0
    result = locatk("solve", grid, "-o", out, "--json")
    assert result.exit_code == 0, result.stderr
    assert json.loads(result.stdout)["sessions"][0]["poses"] > 4500
    score = json.loads(locatk("eval", out, "--truth", grid, "--align", "sim3", "--json").stdout)
    assert score["mae_m"] < 0.002
