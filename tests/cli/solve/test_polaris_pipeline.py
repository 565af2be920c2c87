"""Magnetic tags from the recording to the calibrated tag: the real thing, command by command."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from locatk.core.polaris.codec import layout_of
from locatk.core.polaris.tag import Tags, cell_positions
from locatk.formats.artifacts import tags
from locatk.formats.sessions import solutions

DEFAULT_ID = 262_143

HAND_PLACED = np.array([4.3, -2.2, 13.0, 0.0, -2.8])
"""Degrees by which the magnets of the published default tag are off, fitted by others with
a model of their own (facts 1)."""


@pytest.fixture(scope="module")
def published(data: Path, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Sessions of nine of the default runs."""
    from click.testing import CliRunner

    from locatk.cli.app import app

    source = data / "polaris" / "default"
    if not source.is_dir():
        pytest.skip(f"no {source}")
    folder, sessions = tmp_path_factory.mktemp("published"), []
    for number in range(1, 10):
        sessions.append(folder / f"run{number}.mcap")
        args = ["import", "polaris-csv", str(source / f"RawData_{number}.csv")]
        args += ["--rate", "40", "--spacing", "20", "-o", str(sessions[-1])]
        assert CliRunner().invoke(app, args).exit_code == 0
    return sessions


def margins(locatk, sessions: list[Path], folder: Path, *args: object) -> list[float]:
    """Margins of the one tag in each session, which must be the default one."""
    result = locatk("solve", *sessions, "-o", folder, "--json", *args)
    assert result.exit_code == 0, result.stderr
    answers = [json.loads(line)["sessions"] for line in result.stdout.splitlines()]
    found = [entry["detections"] for (entry,) in answers]
    assert [[seen["tag_id"] for seen in one] for one in found] == [[DEFAULT_ID]] * len(sessions)
    return [one[0]["margin"] for one in found]


@pytest.mark.slow
def test_published_runs_teach_how_their_tag_was_built(
    locatk, published: list[Path], tmp_path: Path
) -> None:
    known, held_out = published[:6], published[6:9]
    out = tmp_path / "built.toml"
    result = locatk("calibrate", "tag", *known, "-o", out, "--json")
    assert result.exit_code == 0, result.stderr
    (tag,) = json.loads(result.stdout)["tags"]
    assert (tag["id"], len(tag["used"])) == (DEFAULT_ID, 6)
    found = np.degrees([magnet["angle_rad"] for magnet in tag["magnets"]])
    # They measured angles against the array, here the grid of the magnets is the measure.
    apart = found - HAND_PLACED
    assert np.ptp(apart) < 2.0
    assert max(magnet["scatter_m"] for magnet in tag["magnets"]) < 0.5e-3
    assert max(math.degrees(magnet["scatter_rad"]) for magnet in tag["magnets"]) < 1.5
    # Runs that it has not seen are read with more certainty.
    before = margins(locatk, held_out, tmp_path / "before")
    after = margins(locatk, held_out, tmp_path / "after", "--artifact", out)
    assert np.median(after) > np.median(before) + 0.2


@pytest.mark.slow
def test_a_simulated_tag_is_measured_as_it_was_built(locatk, tmp_path: Path) -> None:
    """From four sides; the simulation knows finite magnets, and where it put them."""
    config = tmp_path / "sim.toml"
    config.write_text(
        'format = "locatk-simulation-polaris"\nformat_version = 1\n'
        "[build]\nangle_deg = 5\nposition_mm = 0.3\nseed = 3\n"
    )
    sessions = [tmp_path / f"side{k}.mcap" for k in range(4)]
    for k, session in enumerate(sessions):
        result = locatk(
            "simulate", "polaris", "-o", session, "--id", 77, "--heading", 90 * k + 10,
            "--config", config, "--seed", k,
        )  # fmt: skip
        assert result.exit_code == 0, result.stderr
    out = tmp_path / "built.toml"
    result = locatk("calibrate", "tag", *sessions, "-o", out, "--speed", 0.1)
    assert result.exit_code == 0, result.stderr
    built = tags.read_tags(out).built[77]
    assert built.passes == 4

    facts = json.loads(locatk("info", sessions[0], "--json").stdout)["metadata"]["facts"]
    lying = json.loads(facts["simulated_magnets"])
    place = np.array([[magnet["x_m"], magnet["y_m"]] for magnet in lying])
    angle = np.array([magnet["angle_rad"] for magnet in lying])
    layout = layout_of(Tags(), 77)
    nominal = cell_positions(Tags(), layout.cells)
    u, _, vt = np.linalg.svd((place - place.mean(0)).T @ (nominal - nominal.mean(0)))
    turn = u @ vt
    moved = (place - place.mean(0)) @ turn + nominal.mean(0)
    np.testing.assert_allclose(built.offset_m, moved - nominal, atol=0.15e-3)
    expected = (
        angle + math.atan2(turn[0, 1], turn[0, 0]) + Tags().step_rad * np.array(layout.symbols)
    )
    off = np.degrees((built.angle_rad - expected + math.pi) % math.tau - math.pi)
    assert np.abs(off).max() < 0.5
    assert np.ptp(np.degrees(built.angle_rad)) > 3  # there was something to find


@pytest.mark.slow
def test_a_simulated_tour_is_solved_on_its_site(locatk, tmp_path: Path) -> None:
    from locatk.core.polaris.tag import PlanarPose

    site = {5: PlanarPose(0.0, 0.0, 0.0), 9: PlanarPose(0.5, 0.05, 2.0)}
    artifact, tour, out = (tmp_path / name for name in ("tag.toml", "tour.mcap", "solved.mcap"))
    tags.write_tags(artifact, replace(Tags(), site=site, meanings={9: "stop"}))
    args = ("--id", 5, "--id", 9, "--odometry", "--seed", 2)
    assert locatk("simulate", "polaris", artifact, "-o", tour, *args).exit_code == 0
    result = locatk("solve", tour, "-o", out, "--json")
    assert result.exit_code == 0, result.stderr
    (entry,) = json.loads(result.stdout)["sessions"]
    assert [seen["tag_id"] for seen in entry["detections"]] == [5, 9]
    assert [seen.get("meaning") for seen in entry["detections"]] == [None, "stop"]
    (correction,) = entry["facts"]["heading_corrections"]
    assert (correction["from"], correction["to"]) == (5, 9)
    solution = solutions.read_solution(out)
    assert solution.artifact.site == site
    assert [track.frame for track in solution.trajectories] == ["site"]
    score = json.loads(locatk("eval", out, "--truth", tour, "--json").stdout)
    assert score["mae_m"] < 1e-3
    # Tables for other programs: SI, and a sigma for each pose.
    table = tmp_path / "poses.csv"
    assert locatk("export", out, "--format", "csv", "-o", table).exit_code == 0
    assert len(table.read_text().splitlines()) == entry["poses"] + 1
