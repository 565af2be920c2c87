"""``locatk calibrate scene``: frames from standstills."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from locatk.core.geometry import Similarity, quaternion_inverse, quaternion_rotate
from locatk.core.inertial import STANDARD_GRAVITY_M_S2, InertialSamples
from locatk.core.lighthouse.receiver import DECK
from locatk.core.lighthouse.recording import StationReport
from locatk.core.lighthouse.scene.floor_frame import ASSUMED_BASELINE_M, PLACEMENT_SIGMA_M
from locatk.core.lighthouse.simulation.session import (
    FLOOR_MARKERS_M,
    SimulatedSession,
    SimulationOptions,
    simulate,
)
from locatk.formats.artifacts.scene import read_scene, write_scene
from locatk.formats.sessions.observations import write_session


@pytest.fixture(scope="module")
def simulated() -> SimulatedSession:
    """A robot that is set on four corners of a square of a metre, and drives then."""
    return simulate(SimulationOptions(duration_s=40.0, seed=11))


@pytest.fixture(scope="module")
def session(simulated: SimulatedSession, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its session, without the markers, as a user records it."""
    path = tmp_path_factory.mktemp("scene") / "run.mcap"
    scene = replace(simulated.scene, markers=(), scale="unit")
    write_session(path, system="lighthouse", sweeps=simulated.sweeps, scene=scene)
    return path


MARKERS = [
    text
    for k, (x, y, _) in enumerate(1e3 * FLOOR_MARKERS_M)
    for text in ("--marker", f"m{k}={x:g},{y:g}")
]


def test_markers_in_the_order_of_standstills(
    locatk: Callable[..., Any], simulated: SimulatedSession, session: Path, tmp_path: Path
) -> None:
    out = tmp_path / "scene.toml"
    result = locatk("calibrate", "scene", session, "-o", out, *MARKERS, "--json")
    assert result.exit_code == 0, result.stderr
    (entry,) = json.loads(result.stdout)["sessions"]
    frame = entry["frame"]
    assert frame["source"] == "markers"
    assert [rest["role"] for rest in frame["standstills"]][:4] == ["m0", "m1", "m2", "m3"]
    for rest, position in zip(frame["standstills"], FLOOR_MARKERS_M, strict=False):
        assert rest["position_m"] == pytest.approx(position, abs=0.005)
        assert 1.2e9 < rest["end_ns"] - rest["start_ns"] < 2.1e9
    assert frame["level_sigma_rad"] > 0
    scene = read_scene(out)
    assert (scene.frame_source, scene.scale) == ("markers", "markers")
    for station in simulated.true_scene.stations:
        solved = scene.station(station.channel)
        assert solved is not None
        assert solved.position == pytest.approx(station.position, abs=0.03)


def test_a_floor_with_a_known_axis(
    locatk: Callable[..., Any], session: Path, tmp_path: Path
) -> None:
    out = tmp_path / "scene.toml"
    args = ("--floor", "--x-distance", 1000, "--height", 25)
    result = locatk("calibrate", "scene", session, "-o", out, *args)
    assert result.exit_code == 0, result.stderr
    lines = [line.split() for line in result.stdout.splitlines() if "robot-1" in line]
    rests = [line for line in lines if line[1] == "robot-1"]
    assert rests[0][4:] == ["0", "0", "25", "origin"]
    assert rests[1][-5:] == ["1000", "0", "25", "x", "axis"]
    assert rests[2][-1] == "floor"
    assert "frame: from floor" in result.stdout
    scene = read_scene(out)
    assert (scene.frame_source, scene.scale, scene.floor_z) == ("floor", "distance", 0.025)
    # The robot drives around the square counterclockwise: the second corner is at the right.
    swapped = tmp_path / "swapped.toml"
    args = ("--origin", 2, "--x-axis", 3, "--x-distance", 1000)
    assert locatk("calibrate", "scene", session, "-o", swapped, *args).exit_code == 0
    first, other = scene.stations[0].position, read_scene(swapped).stations[0].position
    assert other[:2] == pytest.approx([first[1], 1 - first[0]], abs=0.02)


def test_the_published_method_has_its_floor_at_zero(
    locatk: Callable[..., Any], session: Path, tmp_path: Path
) -> None:
    """Its planar scene was in the axes of the first station, 545 mm (rms) off the floor."""
    out = tmp_path / "scene.toml"
    args = ("--floor", "--x-distance", 1000, "--method", "paper", "--json")
    result = locatk("calibrate", "scene", session, "-o", out, *args)
    assert result.exit_code == 0, result.stderr
    frame = json.loads(result.stdout)["sessions"][0]["frame"]
    positions = np.array([rest["position_m"] for rest in frame["standstills"]])
    assert positions[:, 2] == pytest.approx(0.0, abs=1e-6)
    # The stations are not ideal, which the published method assumes.
    corners = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]
    assert positions[:4, :2] == pytest.approx(np.array(corners), abs=0.08)
    assert positions[1] == pytest.approx([1.0, 0.0, 0.0], abs=1e-6)
    scene = read_scene(out)
    assert scene.planar
    assert scene.floor_z == pytest.approx(0.0, abs=1e-6)
    assert all(1.5 < station.position[2] < 2.2 for station in scene.stations)


def test_an_axis_without_scale_is_not_in_metres(
    locatk: Callable[..., Any], session: Path, tmp_path: Path
) -> None:
    """The standard deviation of its direction took the distance of the stations for a metre."""
    out = tmp_path / "scene.toml"
    result = locatk("calibrate", "scene", session, "-o", out, "--floor", "--json")
    assert result.exit_code == 0, result.stderr
    frame = json.loads(result.stdout)["sessions"][0]["frame"]
    length = np.linalg.norm(frame["standstills"][1]["position_m"])
    assert frame["heading_sigma_rad"] == pytest.approx(
        np.sqrt(2) * PLACEMENT_SIGMA_M / (ASSUMED_BASELINE_M * length)
    )
    # The axis has a metre, and the stations are farther apart than assumed.
    true_sigma_rad = np.sqrt(2) * PLACEMENT_SIGMA_M
    assert true_sigma_rad < frame["heading_sigma_rad"] < 2 * true_sigma_rad
    assert "misfit_m" not in frame


@pytest.mark.slow
def test_accelerometers_level_a_recording(locatk: Callable[..., Any], tmp_path: Path) -> None:
    """Stations send bytes; those of the reports come back from the session."""
    run = simulate(
        SimulationOptions(planar=False, receiver=DECK, duration_s=15.0, report_hz=30, seed=3)
    )
    reports = []
    for station in run.true_scene.stations:
        forward, left, up = station.rotation[2]
        sent = np.array([-left, up, -forward])
        sent = np.rint(127 * sent / np.max(np.abs(sent))).astype(int)
        reports.append(StationReport(station.channel, acceleration=tuple(sent.tolist())))
    path, out = tmp_path / "run.mcap", tmp_path / "scene.toml"
    write_session(
        path,
        system="lighthouse",
        sweeps=run.sweeps,
        stations=reports,
        receivers={"robot-1": DECK},
    )
    result = locatk("calibrate", "scene", path, "-o", out, "--json")
    assert result.exit_code == 0, result.stderr
    frame = json.loads(result.stdout)["sessions"][0]["frame"]
    assert frame["source"] == "gravity"
    assert np.degrees(frame["level_sigma_rad"]) == pytest.approx(2 / np.sqrt(2))
    scene = read_scene(out)
    for station in run.true_scene.stations:
        solved = scene.station(station.channel)
        assert solved is not None
        assert solved.up == pytest.approx(station.rotation[2], abs=0.01)
        assert solved.rotation[2] == pytest.approx(station.rotation[2], abs=0.05)
    assert scene.frame == "station-1-level"
    assert "z is up by gravity from channel 1 and channel 2" in result.stderr


@pytest.mark.parametrize(("shift_m", "is_reported"), [(0.0, False), (0.05, True)])
def test_markers_of_a_session_validate_a_given_scene(
    locatk: Callable[..., Any],
    simulated: SimulatedSession,
    tmp_path: Path,
    shift_m: float,
    is_reported: bool,
) -> None:
    path, artifact = tmp_path / "run.mcap", tmp_path / "site.toml"
    write_session(path, system="lighthouse", sweeps=simulated.sweeps, scene=simulated.scene)
    away = Similarity(1.0, np.eye(3), np.array([shift_m, 0.0, 0.0]))
    write_scene(artifact, replace(simulated.true_scene.transformed(away), markers=()))
    result = locatk("solve", path, "-o", tmp_path / "solved.mcap", "--artifact", artifact)
    assert result.exit_code == 0, result.stderr
    assert ("on the markers of the session are 50 mm (rms)" in result.stderr) == is_reported


def test_photodiodes_at_unknown_positions_are_located_one_by_one(
    locatk: Callable[..., Any], simulated: SimulatedSession, tmp_path: Path
) -> None:
    path, out = tmp_path / "run.mcap", tmp_path / "scene.toml"
    sweeps = replace(simulated.sweeps, sensor=np.full_like(simulated.sweeps.sensor, 2))
    write_session(path, system="lighthouse", sweeps=sweeps)
    result = locatk("calibrate", "scene", path, "-o", out, *MARKERS)
    assert result.exit_code == 0, result.stderr
    assert read_scene(out).frame_source == "markers"
    assert "1  robot-1/2" in result.stdout
    for name in ("robot-1", "robot-1/2"):
        named = (*MARKERS, "--device", name, "--overwrite")
        assert locatk("calibrate", "scene", path, "-o", out, *named).exit_code == 0


@pytest.mark.slow
def test_an_imu_at_rest_levels_a_recording(locatk: Callable[..., Any], tmp_path: Path) -> None:
    options = SimulationOptions(planar=False, receiver=DECK, duration_s=28.0, report_hz=16, seed=4)
    run = simulate(options)
    (truth,) = run.truth
    up = np.array([0.0, 0.0, STANDARD_GRAVITY_M_S2])
    force = quaternion_rotate(quaternion_inverse(truth.quaternion), up)
    imu = InertialSamples("robot-1", truth.time_ns, force, np.zeros_like(force))
    path, out = tmp_path / "run.mcap", tmp_path / "scene.toml"
    write_session(
        path, system="lighthouse", sweeps=run.sweeps, receivers={"robot-1": DECK}, imu=[imu]
    )
    result = locatk("calibrate", "scene", path, "-o", out)
    assert result.exit_code == 0, result.stderr
    assert "z is up by gravity from the IMU of robot-1" in result.stderr
    scene = read_scene(out)
    assert np.degrees(scene.level_sigma_rad) == pytest.approx(1.0)
    for station in run.true_scene.stations:
        solved = scene.station(station.channel)
        assert solved is not None
        assert solved.rotation[2] == pytest.approx(station.rotation[2], abs=0.04)


def test_factory_calibrations_of_an_artifact_and_standstills(
    locatk: Callable[..., Any], simulated: SimulatedSession, session: Path, tmp_path: Path
) -> None:
    """The artifact is the true scene, with stations elsewhere: they are estimated anew."""
    artifact, out = tmp_path / "site.toml", tmp_path / "scene.toml"
    away = Similarity(1.0, np.eye(3), np.array([5.0, 0.0, 0.0]))
    write_scene(artifact, simulated.true_scene.transformed(away))
    args = (*MARKERS, "--artifact", artifact)
    result = locatk("calibrate", "scene", session, "-o", out, *args)
    assert result.exit_code == 0, result.stderr
    assert "generic" not in result.stderr
    for station in simulated.true_scene.stations:
        solved = read_scene(out).station(station.channel)
        assert solved is not None
        assert solved.calibration.source == "factory"
        assert solved.position == pytest.approx(station.position, abs=0.005)


@pytest.mark.parametrize(
    ("args", "status", "words"),
    [
        (("--marker", "a=0,0"), 2, "three markers or more"),
        (("--marker", "a"), 2, "'a' is not NAME=X,Y or NAME=X,Y,Z in mm"),
        (("--marker", "=1,2"), 2, "is not NAME=X,Y"),
        (("--marker", "a=1,nan"), 2, "is not NAME=X,Y"),
        (("--marker", "a=1,2,3,4"), 2, "is not NAME=X,Y"),
        ((*MARKERS, "--marker", "m0=0,0"), 2, "same name"),
        ((*MARKERS, "--floor"), 2, "Give one of them"),
        (("--height", 5), 2, "--height needs --marker or --floor"),
        (("--ignore", 1), 2, "--ignore needs"),
        (("--floor", "--origin", 2, "--ignore", 2), 2, "Standstill 2 is"),
        (("--floor", "--x-axis", 1, "--ignore", 1), 2, "Standstill 1 is"),
        (("--x-distance", -1), 2, "x>0"),
        (("--floor", "--device", "x"), 1, "device 'x' did not rest"),
        (("--floor", "--origin", 99), 1, "no standstill 99"),
        (("--floor", "--height", 5), 1, "a height needs a known scale"),
        (
            [text for k in range(30) for text in ("--marker", f"m{k}={k},{k * k}")],
            1,
            "30 markers and",
        ),
    ],
)
def test_wrong_usage(
    locatk: Callable[..., Any],
    session: Path,
    tmp_path: Path,
    args: tuple[object, ...],
    status: int,
    words: str,
) -> None:
    out = tmp_path / "scene.toml"
    result = locatk("calibrate", "scene", session, "-o", out, *args)
    assert result.exit_code == status, result.stderr
    assert words in result.stderr
    if status == 1:
        assert result.stderr.startswith(f"Error: {session}: ")
        assert "Hint: " in result.stderr
    assert not out.exists()
