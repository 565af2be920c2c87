"""A robot with a Lighthouse deck, from the simulator to full poses, as a user does it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from click.testing import Result

from locatk.core.lighthouse.receiver import DECK
from locatk.core.lighthouse.simulation import SimulationOptions, simulate

Run = Callable[..., Result]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("deck")


@pytest.fixture(scope="module")
def session(folder: Path) -> Path:
    from click.testing import CliRunner

    from locatk.cli.app import app

    path = folder / "deck.mcap"
    words = ["simulate", "lighthouse", "-o", str(path), "--3d", "--receiver", "deck"]
    done = CliRunner().invoke(app, [*words, "--duration", "14", "--noise-udeg", "6600"])
    assert done.exit_code == 0, done.output
    return path


@pytest.mark.slow
def test_poses_are_full_and_in_the_frame_of_the_markers(
    locatk: Run, session: Path, folder: Path
) -> None:
    solved = folder / "solved.mcap"
    answer = json.loads(locatk("solve", session, "-o", solved, "--json").stdout)["sessions"][0]
    assert answer["poses"] > 250
    for row in answer["detections"]:
        assert row["verification_m"] < 0.01
    shown = locatk("info", solved).stdout
    assert "vs. others" in " ".join(shown.split())
    first = answer["detections"][0]
    assert f"{1e3 * first['verification_rad']:.2f}" in shown
    score = json.loads(locatk("eval", solved, "--truth", session, "--json").stdout)
    assert score["ape"]["translation_m"]["median"] < 2e-3
    assert score["ape"]["rotation_deg"]["median"] < 2.0


def test_info_shows_the_photodiodes(locatk: Run, session: Path) -> None:
    facts = json.loads(locatk("info", session, "--json").stdout)
    assert facts["receivers"][0]["name"] == "lighthouse-deck"
    assert facts["receivers"][0]["sensors"] == 4
    assert "30 x 15 x 0" in locatk("info", session).stdout


def test_a_file_gives_the_positions_of_photodiodes(locatk: Run, folder: Path) -> None:
    receiver = folder / "receiver.toml"
    receiver.write_text(
        'format = "locatk-lighthouse-receiver"\nformat_version = 1\n'
        "position_mm = [[60, 0, 0], [-60, 40, 0], [-60, -40, 10]]\n"
    )
    out = folder / "bar.mcap"
    words = ("simulate", "lighthouse", "-o", out, "--receiver", receiver, "--duration", "5")
    done = locatk(*words)
    assert done.exit_code == 0, done.output
    facts = json.loads(locatk("info", out, "--json").stdout)
    assert facts["receivers"][0]["sensors"] == 3


def test_a_receiver_that_is_not_there(locatk: Run, folder: Path) -> None:
    done = locatk("simulate", "lighthouse", "-o", folder / "x.mcap", "--receiver", "none.toml")
    assert done.exit_code == 1
    assert "none.toml" in done.stderr
    assert not (folder / "x.mcap").exists()


def test_sweeps_follow_the_positions_of_photodiodes() -> None:
    """The sweeps of two photodiodes of a rotation differ as their places do."""
    made = simulate(
        SimulationOptions(receiver=DECK, report_hz=120.0, duration_s=20.0, noise_rad=0.0)
    )
    sweeps, (truth,) = made.sweeps, made.truth
    assert sorted(np.unique(sweeps.sensor).tolist()) == [0, 1, 2, 3]
    station = made.true_scene.stations[0]
    late = sweeps.time_ns > truth.time_ns[-800]
    for sensor in (0, 3):
        mine = np.flatnonzero(late & (sweeps.sensor == sensor) & (sweeps.channel == 1))[:40]
        at = np.searchsorted(truth.time_ns, sweeps.time_ns[mine])
        assert np.all(at < len(truth))
        heading = 2 * np.arctan2(truth.quaternion[at, 2], truth.quaternion[at, 3])
        x, y, _ = DECK.position_m[sensor]
        cos, sin = np.cos(heading), np.sin(heading)
        place = truth.position[at].copy()
        place[:, 0] += cos * x - sin * y
        place[:, 1] += sin * x + cos * y
        local = (place - station.position) @ station.rotation
        azimuth = np.arctan2(local[:, 1], local[:, 0])
        # The mean of both planes' turns is the azimuth, half a turn from the zero; each alone is
        # off by what the elevation and the factory's bending make of it, the same for both.
        turn = 2 * np.pi * sweeps.count[mine] / 119_875
        pairs = np.flatnonzero((np.diff(turn) > 1.5) & (np.diff(turn) < 3.0))
        mean = (turn[pairs] + turn[pairs + 1]) / 2 - np.pi
        assert len(pairs) > 10
        assert np.max(np.abs(mean - azimuth[pairs])) < 0.02
