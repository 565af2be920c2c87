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
from locatk.core.geometry import heading_from_quaternion
from locatk.formats.schemas.serial_pb2 import SerialChunk
from locatk.formats.sessions.frames import read_frames
from locatk.formats.sessions.mcap_file import CAPTURE_RECORD
from locatk.formats.sessions.observations import read_halls
from locatk.formats.sessions.reader import Session
from locatk.formats.sessions.trajectories import read_live, read_odometry, read_truth
from locatk.formats.sessions.writer import SessionWriter

pytestmark = pytest.mark.slow

SESSIONS = ("landmarks", "polaris", "lighthouse", "deck", "dots")

FIELDS = {
    *("type", "time_s", "device", "frame", "x_m", "y_m", "z_m", "qx", "qy", "qz", "qw"),
    *("sigma_x_m", "sigma_y_m", "sigma_z_m", "sigma_heading_rad", "probability"),
    *("state", "reason", "reset_counter", "latency_s"),
}
"""Fields of a pose, as docs/live.md lists them."""

MAX_DIFFERENCE_MM = {"landmarks": 5.0, "polaris": 0.5, "lighthouse": 1.0, "deck": 1.5, "dots": 1e-6}
"""95 % of the live poses differ less from those of `locatk solve`: the sigma of landmarks and tags
at this speed; dots solves each frame alone."""

MIN_POSES = {"landmarks": 50, "polaris": 50, "lighthouse": 100, "deck": 60, "dots": 12}


@dataclass
class Replayed:
    """A replay as fast as possible, with a recording."""

    system: str
    source: Path
    recording: Path
    messages: list[dict[str, Any]]


@pytest.fixture(scope="module", params=SESSIONS)
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
    if replayed.system == "deck":  # A rigid device; its receiver is that of the capture device.
        assert compared["ape"]["rotation_deg"]["p95"] < 1.0


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


# ---- two inputs


def write_lines(path: Path, header: str, time_ns: Any, rows: Any) -> Path:
    """Write a recording of a device that sends lines."""
    with SessionWriter(path, system="") as writer:
        writer.metadata(CAPTURE_RECORD, {"device": "lines"})
        total = 0
        lines = [header, *(",".join(f"{value:.9g}" for value in row) for row in rows)]
        for k, line in enumerate(lines):
            data = line.encode() + b"\n"
            chunk = SerialChunk(port="p", byte_offset=total, data=data, opened=not k)
            writer.write("/serial/robot", chunk, int(time_ns[max(k - 1, 0)]))
            total += len(data)
    return path


@pytest.mark.parametrize("speed", [0, 5])
def test_odometry_and_hall_sensors_of_two_inputs(
    live_sessions: Any, tmp_path: Path, locatk: Any, speed: float
) -> None:
    """They are merged by time whatever the speed, and recorded in two files."""
    session = Session.open(live_sessions.decoded("landmarks"))
    (halls,), (odometry,) = read_halls(session), read_odometry(session)
    names = [f"hall_{side}_mt" for side in ("front", "left", "rear", "right")]
    first = write_lines(
        tmp_path / "halls.mcap", ",".join(names), halls.time_ns, 1e3 * halls.field_t
    )
    heading = heading_from_quaternion(odometry.quaternion)
    second = write_lines(
        tmp_path / "odometry.mcap", "x_m,y_m,heading_rad", odometry.time_ns,
        np.column_stack([odometry.position[:, :2], heading]),
    )  # fmt: skip
    recording = tmp_path / "run.mcap"
    result = locatk(
        "live", f"replay:{second}", "--speed", speed, "--record", recording,
        "--input", f"replay:{first} device=lines speed={speed} name=robot",
        "--artifact", live_sessions.decoded("landmarks"),
    )  # fmt: skip
    assert result.exit_code == 0, result.stderr
    poses = [each for each in messages_of(result) if each["type"] == "pose"]
    assert len(poses) > 80
    assert {pose["device"] for pose in poses} == {"robot"}
    (truth,) = read_truth(session)
    for pose in poses:
        nearest = np.argmin(np.abs(truth.time_ns - 1e9 * pose["time_s"]))
        # The map fits at another place as well: the pose is provisional, its start is right.
        assert abs(pose["x_m"] - truth.position[nearest, 0]) < 0.3
    first_file, second_file = (tmp_path / f"run-{k}.mcap" for k in (1, 2))
    assert Session.open(first_file).topics("/odometry/")
    assert Session.open(second_file).topics("/halls/")
    assert len(read_live(Session.open(first_file))[0]) == len(poses)


# ---- errors in the middle


def test_an_error_of_the_program_leaves_a_finished_recording(
    live_sessions: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, locatk: Any, raw_bytes: Any
) -> None:
    from locatk.core.landmarks.stream import LandmarksStream

    push, calls = LandmarksStream.push, iter(range(10_000))

    def fail(stream: Any, observations: Any) -> Any:
        if next(calls) > 50:
            raise ZeroDivisionError("in the filter")
        return push(stream, observations)

    monkeypatch.setattr(LandmarksStream, "push", fail)
    path = tmp_path / "run.mcap"
    given = f"replay:{live_sessions.raw('landmarks')}"
    result = locatk("live", given, "--speed", 0, "--record", path)
    assert "ZeroDivisionError" in repr(result.exception) or result.exit_code == 1
    assert Session.open(path).damage is None
    kept, sent = raw_bytes(path), raw_bytes(live_sessions.raw("landmarks"))
    assert sent.startswith(kept)
    assert kept


def test_a_recording_that_fails_is_status_3(
    live_sessions: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, locatk: Any
) -> None:
    from locatk.formats.live.recorded_events import RecordedEvents

    def broken(self: Any) -> Any:
        raise ValueError("odd")

    monkeypatch.setattr(RecordedEvents, "take", broken)
    given = f"replay:{live_sessions.raw('landmarks')}"
    result = locatk("live", given, "--speed", 0, "--record", tmp_path / "run.mcap")
    assert result.exit_code == 3
    assert "ValueError: odd" in result.stderr.splitlines()[-1]
    assert len(messages_of(result)) > 100
