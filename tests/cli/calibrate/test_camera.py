"""`locatk calibrate camera` as a user runs it."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from locatk.core.dots.camera import Camera
from locatk.core.dots.simulation import session as simulate
from locatk.core.dots.simulation.session import SimulationOptions
from locatk.core.simulation import SESSION_START_NS
from locatk.formats.artifacts import sheets
from locatk.formats.sessions import frames as files

CAMERA = Camera((188, 120), 360.0, (96.2, 57.1), -0.45)
MANIFEST = simulate.sheet()


def seen(count: int, *, tilt_deg: float = 0.0, **more: object) -> simulate.SimulatedSession:
    options = SimulationOptions(
        frames=count, path="random", camera=CAMERA, tilt_rad=math.radians(tilt_deg), **more
    )  # type: ignore[arg-type]
    return simulate.simulate(MANIFEST, options)


def write(path: Path, *sessions: simulate.SimulatedSession, camera: Camera | None = None) -> Path:
    cameras = [
        replace(session.frames, device=f"camera{n or ''}") for n, session in enumerate(sessions)
    ]
    files.write_session(path, cameras, MANIFEST, camera=camera)
    return path


@pytest.fixture(scope="module")
def tilted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("tilted") / "run.mcap", seen(15, tilt_deg=10.0))


@pytest.fixture(scope="module")
def upright(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("upright") / "run.mcap", seen(12, seed=1))


def test_a_session_in_a_camera_out(locatk, tilted: Path, tmp_path: Path) -> None:
    out = tmp_path / "camera.toml"
    result = locatk("calibrate", "camera", tilted, "-o", out)
    assert result.exit_code == 0, result.stderr
    camera = sheets.read_camera(out)
    assert camera.size == CAMERA.size
    assert camera.focal_px == pytest.approx(360.0, rel=0.02)
    assert camera.centre_px == pytest.approx(CAMERA.centre_px, abs=0.2)
    assert camera.radial_px == pytest.approx(CAMERA.radial_px, rel=0.02)
    lines = result.stdout.splitlines()
    assert lines[0].startswith(f"{tilted} -> {out}: 15 of 15 frames, ")
    table = {line.split("  ")[0]: line.split() for line in lines[2:6]}
    assert list(table) == ["focal length", "centre x", "centre y", "radial"]
    assert [row[-1] for row in table.values()] == ["frames"] * 4
    assert float(table["centre x"][2]) == pytest.approx(camera.centre_px[0], abs=1e-3)
    assert lines[6].startswith("residual of the dots: ")
    assert lines[7] == "distortion of the corners: 4.3 %"
    assert lines[-1] == "skipped: nothing"
    assert result.stderr == ""


@pytest.mark.slow
def test_the_camera_makes_poses_better(locatk, upright: Path, tmp_path: Path) -> None:
    """Whoever takes the middle of the frame for the camera's is off by 0.17 mm."""
    camera, run = tmp_path / "camera.toml", tmp_path / "drive.mcap"
    locatk("calibrate", "camera", upright, "-o", camera, "--focal-px", 350)
    session = seen(10, seed=7)
    files.write_session(run, [session.frames], MANIFEST, truth=[session.truth])

    def rms_mm(*more: object) -> float:
        solved = tmp_path / "solved.mcap"
        assert locatk("solve", run, "-o", solved, "--overwrite", *more).exit_code == 0
        result = locatk("eval", solved, "--truth", run, "--align", "none", "--json")
        assert result.exit_code == 0, result.stderr
        return 1e3 * json.loads(result.stdout)["rmse_m"]

    assert rms_mm() == pytest.approx(0.046 * math.hypot(2.7, 2.4), rel=0.1)
    assert rms_mm("--camera", camera) < 0.005


def test_json_is_all_that_is_on_stdout(locatk, tilted: Path, tmp_path: Path) -> None:
    out = tmp_path / "camera.toml"
    result = locatk("calibrate", "camera", tilted, "-o", out, "--json")
    assert result.exit_code == 0
    answer = json.loads(result.stdout)
    camera = sheets.read_camera(out)
    assert answer["version"] == 1
    assert (answer["session"], answer["output"], answer["device"]) == (
        str(tilted), str(out), "camera",
    )  # fmt: skip
    assert answer["frames"] == {"seen": 15, "located": 15, "used": 15, "skipped": {}}
    assert answer["camera"] == {
        "size_px": [188, 120],
        "focal_px": camera.focal_px,
        "centre_px": list(camera.centre_px),
        "radial": camera.radial,
        "radial_per_px2": camera.radial_px,
    }
    assert 0 < answer["sigma"]["focal_px"] < 5
    assert all(0 < sigma < 0.1 for sigma in answer["sigma"]["centre_px"])
    assert (answer["focal_from"], answer["centre_from"]) == ("frames", "frames")
    assert answer["rms_px"] < 0.05 < answer["rms_before_px"]
    assert math.radians(5) < answer["largest_tilt_rad"] < math.radians(10.5)
    assert answer["notes"] == []


@pytest.mark.slow
def test_untilted_frames_leave_the_focal_length_open(locatk, upright: Path, tmp_path: Path) -> None:
    out = tmp_path / "camera.toml"
    result = locatk("calibrate", "camera", upright, "-o", out, "--json")
    assert result.exit_code == 3
    assert "Incomplete: the focal length cannot be estimated" in result.stderr
    assert "--focal-px" in result.stderr
    assert "do not tell the focal length: they are not tilted enough" in result.stderr
    answer = json.loads(result.stdout)
    assert answer["focal_from"] == "usual"
    assert answer["sigma"]["focal_px"] is None
    camera = sheets.read_camera(out)  # what poses need is there
    assert camera.centre_px == pytest.approx(CAMERA.centre_px, abs=0.2)
    assert camera.radial_px == pytest.approx(CAMERA.radial_px, rel=0.02)

    result = locatk("calibrate", "camera", upright, "-o", out, "--focal-px", 400, "--overwrite")
    assert result.exit_code == 0
    assert "--focal-px" in result.stdout
    camera = sheets.read_camera(out)
    assert camera.focal_px == 400.0
    assert camera.radial_px == pytest.approx(CAMERA.radial_px, rel=0.02)


def test_the_focal_length_of_the_sessions_camera_is_kept(locatk, tmp_path: Path) -> None:
    earlier = Camera((188, 120), 333.0, (93.5, 59.5))
    run = write(tmp_path / "run.mcap", seen(10), camera=earlier)
    out = tmp_path / "camera.toml"
    result = locatk("calibrate", "camera", run, "-o", out)
    assert result.exit_code == 0
    assert sheets.read_camera(out).focal_px == 333.0
    assert "the session's camera" in result.stdout
    assert "is kept" in result.stderr


def test_one_of_several_cameras(locatk, tmp_path: Path) -> None:
    run = write(tmp_path / "run.mcap", seen(3), seen(8, seed=2))
    out = tmp_path / "camera.toml"
    result = locatk("calibrate", "camera", run, "-o", out)
    assert result.exit_code == 1
    assert f"Error: {run}: several cameras: camera, camera1. Hint" in result.stderr
    assert "--device" in result.stderr
    result = locatk("calibrate", "camera", run, "-o", out, "--device", "left")
    assert result.exit_code == 1
    assert "no camera 'left'" in result.stderr
    result = locatk("calibrate", "camera", run, "-o", out, "--device", "camera")
    assert result.exit_code == 1
    assert "3 of 3 frames show the pattern, where 5 are needed" in result.stderr
    assert str(run) in result.stderr
    assert not out.exists()
    result = locatk("calibrate", "camera", run, "-o", out, "--device", "camera1")
    assert result.exit_code == 3
    assert "8 of 8 frames" in result.stdout


@pytest.mark.slow
def test_blank_frames_are_counted(locatk, tmp_path: Path) -> None:
    session = seen(8)
    blank = np.full((120, 188), 200, np.uint8)
    images = [*session.frames.images, blank, blank]
    time_ns = SESSION_START_NS + 20_000_000 * np.arange(10)
    frames = replace(
        session.frames, time_ns=time_ns, names=tuple(map(str, range(10))), images=images
    )
    run = tmp_path / "run.mcap"
    files.write_session(run, [frames], MANIFEST)
    result = locatk("calibrate", "camera", run, "-o", tmp_path / "c.toml", "--focal-px", 360)
    assert result.exit_code == 0
    assert "8 of 10 frames" in result.stdout
    assert "skipped: 2 no pattern" in result.stdout


@pytest.mark.slow
def test_the_manifest_may_be_given(locatk, tmp_path: Path) -> None:
    run, out, sheet = (tmp_path / name for name in ("run.mcap", "camera.toml", "sheet.toml"))
    frames = seen(8).frames
    shots = [
        files.Shot(int(t), name, image)
        for t, name, image in zip(frames.time_ns, frames.names, frames.images, strict=True)
    ]
    files.write_shots(run, {"camera": shots})
    result = locatk("calibrate", "camera", run, "-o", out)
    assert result.exit_code == 1
    assert f"{run}: the session has no manifest of the sheet" in result.stderr
    assert "--artifact" in result.stderr
    sheets.write_manifest(sheet, MANIFEST)
    result = locatk("calibrate", "camera", run, "-o", out, "--artifact", sheet, "--focal-px", 360)
    assert result.exit_code == 0
    other = replace(MANIFEST.sheets[0], origin=(0, 0))
    sheets.write_manifest(sheet, replace(MANIFEST, sheets=(other,)), overwrite=True)
    again = tmp_path / "again.toml"
    result = locatk("calibrate", "camera", run, "-o", again, "--artifact", sheet)
    assert result.exit_code == 1
    assert "off all sheets of the manifest" in result.stderr
    assert not again.exists()


def test_nothing_is_overwritten_unasked(locatk, upright: Path, tmp_path: Path) -> None:
    out = tmp_path / "camera.toml"
    out.write_text("mine")
    result = locatk("calibrate", "camera", upright, "-o", out)
    assert result.exit_code == 1
    assert "--overwrite" in result.stderr
    assert out.read_text() == "mine"
    before = upright.read_bytes()
    result = locatk("calibrate", "camera", upright, "-o", upright, "--overwrite")
    assert result.exit_code == 2
    assert "end it in .toml" in result.stderr
    assert upright.read_bytes() == before


@pytest.mark.parametrize("value", ["0", "-3", "nan", "inf", "wide"])
def test_focal_lengths_that_are_none(locatk, upright: Path, tmp_path: Path, value: str) -> None:
    out = tmp_path / "camera.toml"
    result = locatk("calibrate", "camera", upright, "-o", out, "--focal-px", value)
    assert result.exit_code in (1, 2)
    assert result.stderr.startswith("Error: ")
    assert result.stderr.count("\n") == 1
    assert not out.exists()


def test_a_session_of_something_else(locatk, record, tmp_path: Path) -> None:
    run = record(tmp_path / "light.mcap")
    result = locatk("calibrate", "camera", run, "-o", tmp_path / "camera.toml")
    assert result.exit_code == 1
    assert "no camera frames" in result.stderr
    assert result.stderr.count("\n") == 1
    (tmp_path / "text.mcap").write_text("not a session")
    result = locatk("calibrate", "camera", tmp_path / "text.mcap", "-o", tmp_path / "camera.toml")
    assert result.exit_code == 1
    assert result.stderr.count("\n") == 1


def test_help_shows_examples_and_the_group_knows_its_commands(locatk) -> None:
    text = locatk("calibrate", "camera", "--help").stdout
    assert "locatk calibrate camera run.mcap -o camera.toml" in text
    group = locatk("calibrate", "--help").stdout
    for name in ("camera", "printer", "scene"):
        assert f"\n  {name} " in group
