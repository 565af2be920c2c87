"""`locatk live replay:`: poses of recorded sessions of all systems, and their recording."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from locatk.cli.app import app
from locatk.formats.sessions.frames import read_frames
from locatk.formats.sessions.reader import Session
from locatk.formats.sessions.trajectories import read_live

pytestmark = pytest.mark.slow

SYSTEMS = ("landmarks", "polaris", "lighthouse", "dots")

FIELDS = {
    *("type", "time_s", "device", "frame", "x_m", "y_m", "z_m", "qx", "qy", "qz", "qw"),
    *("sigma_x_m", "sigma_y_m", "sigma_z_m", "sigma_heading_rad", "probability"),
    *("state", "reason", "reset_counter", "latency_s"),
}
"""Fields of a pose, as docs/live.md lists them."""

MAX_DIFFERENCE_MM = {"landmarks": 5.0, "polaris": 0.5, "lighthouse": 1.0, "dots": 1e-6}
"""95 % of the live poses differ less from those of `locatk solve`: the sigma of landmarks and tags
at this speed; dots solves each frame alone."""

MIN_POSES = {"landmarks": 50, "polaris": 50, "lighthouse": 100, "dots": 12}


@dataclass
class Replayed:
    """A replay as fast as possible, with a recording."""

    system: str
    source: Path
    recording: Path
    messages: list[dict[str, Any]]


@pytest.fixture(scope="module", params=SYSTEMS)
def replayed(request: Any, live_sessions: Any, tmp_path_factory: Any) -> Replayed:
    source = live_sessions.raw(request.param)
    recording = tmp_path_factory.mktemp("replayed") / f"{request.param}.mcap"
    result = invoke("live", f"replay:{source}", "--speed", 0, "--record", recording)
    assert result.exit_code == 0, result.stderr
    return Replayed(request.param, source, recording, messages_of(result))


def invoke(*arguments: object) -> Any:
    return CliRunner().invoke(app, [str(each) for each in arguments], prog_name="locatk")


def messages_of(result: Any) -> list[dict[str, Any]]:
    return [json.loads(line) for line in result.stdout.splitlines()]


def test_poses_have_the_documented_fields(replayed: Replayed, root: Path) -> None:
    poses = [each for each in replayed.messages if each["type"] == "pose"]
    assert len(poses) >= MIN_POSES[replayed.system]
    assert all(set(pose) == FIELDS for pose in poses)
    assert all(0 <= pose["latency_s"] < 60 for pose in poses)
    assert all(pose["sigma_x_m"] > 0 for pose in poses)
    times = [pose["time_s"] for pose in poses]
    assert times == sorted(times)
    documented = (root / "docs" / "live_messages.md").read_text()
    assert all(f"`{field}`" in documented for field in FIELDS)


def test_they_agree_with_the_offline_solver(replayed: Replayed, tmp_path: Path) -> None:
    """The recording is solved, and compared with its own live poses."""
    solved = tmp_path / "solved.mcap"
    status = invoke("solve", replayed.recording, "-o", solved).exit_code
    assert status == (3 if replayed.system == "landmarks" else 0)  # Two of its landmarks only.
    result = invoke("eval", replayed.recording, "--live", "--truth", solved, "--json")
    assert result.exit_code == 0, result.stderr
    compared = json.loads(result.stdout)
    assert compared["n"] > 0.2 * MIN_POSES[replayed.system]
    assert 1e3 * compared["p95_m"] < MAX_DIFFERENCE_MM[replayed.system]


def test_the_recording_has_the_live_poses(replayed: Replayed) -> None:
    poses = [each for each in replayed.messages if each["type"] == "pose"]
    (track,) = read_live(Session.open(replayed.recording))
    assert {pose["device"] for pose in poses} == {track.device}
    assert track.position[:, 0].tolist() == [pose["x_m"] for pose in poses]
    assert (1e-9 * track.time_ns).tolist() == [pose["time_s"] for pose in poses]


def test_the_recording_has_the_bytes_of_the_source(replayed: Replayed, raw_bytes: Any) -> None:
    if replayed.system != "dots":
        assert raw_bytes(replayed.recording) == raw_bytes(replayed.source)
        return
    ((given,), (kept,)) = (
        read_frames(Session.open(path)) for path in (replayed.source, replayed.recording)
    )
    assert kept.time_ns.tolist() == given.time_ns.tolist()
    assert all(map(np.array_equal, kept.images, given.images))


def test_results_do_not_depend_on_the_speed(replayed: Replayed) -> None:
    again = messages_of(invoke("live", f"replay:{replayed.source}", "--speed", 7))
    for message in (*again, *replayed.messages):
        message.pop("latency_s", None)
    assert again == replayed.messages
