"""`locatk simulate dots` as a user runs it."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from locatk.core.dots.camera import Camera
from locatk.core.dots.simulation import session as simulate
from locatk.formats.artifacts import sheets
from locatk.formats.sessions.frames import read_frames
from locatk.formats.sessions.reader import Session
from locatk.formats.sessions.trajectories import read_truth

SETTINGS = """
format = "locatk-simulation-dots"
format_version = 1

[sheet]
file = "sheet.toml"

[path]
frames = 7

[print]
dot_pitches = 0.25
dust_fraction = 0.05
jitter_um = 8

[camera]
file = "camera.toml"
calibrated = false
pitch_deg = 2
roll_deg = -3
tilt_deg = 5
blur_px = 0.9

[light]
contrast_fraction = 0.5
vignette_fraction = 0.2
gradient_fraction = 0.1
"""
"""Settings that have no option of their own, and some that options override."""


def test_a_session_holds_frames_sheet_camera_and_truth(locatk, tmp_path: Path) -> None:
    out = tmp_path / "run.mcap"
    result = locatk("simulate", "dots", "-o", out, "--frames", 5, "--seed", 3, "--json")
    assert result.exit_code == 0, result.stderr
    assert json.loads(result.stdout) == {
        "version": 1,
        "output": str(out),
        "frames": 5,
        "device": "camera",
        "frame": "simulated",
        "codec": "anoto",
        "calibrated": True,
        "truth_poses": 5,
    }
    session = Session.open(out)
    assert session.facts["system"] == "dots"
    (frames,) = read_frames(session)
    wanted = simulate.simulate(None, simulate.SimulationOptions(frames=5, seed=3))
    assert np.array_equal(list(frames.images), list(wanted.frames.images))
    assert frames.names == wanted.frames.names
    assert np.array_equal(frames.time_ns, wanted.frames.time_ns)
    assert sheets.attached_manifest(session) == wanted.manifest
    assert sheets.attached_camera(session) == wanted.camera
    (truth,) = read_truth(session)
    assert truth.frame == "simulated"
    assert truth.position == pytest.approx(wanted.truth.position)
    assert truth.quaternion == pytest.approx(wanted.truth.quaternion)


def test_each_option_reaches_the_frames(locatk, tmp_path: Path) -> None:
    printed, lens = tmp_path / "sheet.toml", tmp_path / "camera.toml"
    one = simulate.sheet("libdots")
    two = replace(one.sheets[0], id="second", origin=(7_000, 9_000))
    manifest = replace(one, sheets=(*one.sheets, two))
    camera = Camera((160, 100), 300.0, (80.0, 50.0), -0.2)
    sheets.write_manifest(printed, manifest)
    sheets.write_camera(lens, camera)
    out, config = tmp_path / "run.mcap", tmp_path / "sim.toml"
    config.write_text(SETTINGS)
    given = (
        *("--config", config, "--id", "second", "--duration", "0.2"),
        *("--rate", 20, "--path", "random", "--speed", 0.3, "--motion", 2, "--missing", 0.1),
        *("--printer-scale", "1.002,0.999", "--scale-known", "--noise", 4, "--seed", 8),
    )
    result = locatk("simulate", "dots", "-o", out, *given)
    assert result.exit_code == 0, result.stderr
    assert "4 frames of camera over second, 4 truth poses" in result.stdout
    options = simulate.SimulationOptions(
        frames=4,
        rate_hz=20.0,
        path="random",
        speed_mps=0.3,
        motion_px=2.0,
        camera=camera,
        pitch_rad=math.radians(2),
        roll_rad=math.radians(-3),
        tilt_rad=math.radians(5),
        dot=0.25,
        missing=0.1,
        dust=0.05,
        jitter_m=8e-6,
        printer_scale=(1.002, 0.999),
        blur_px=0.9,
        noise=4.0,
        contrast=0.5,
        vignette=0.2,
        gradient=0.1,
        sheet=1,
        seed=8,
    )
    session = Session.open(out)
    (frames,) = read_frames(session)
    wanted = simulate.simulate(manifest, options)
    assert np.array_equal(list(frames.images), list(wanted.frames.images))
    assert sheets.attached_manifest(session) == replace(manifest, scale=(1.002, 0.999))
    assert sheets.attached_camera(session) is None


def test_an_unknown_scale_is_not_in_the_manifest(locatk, tmp_path: Path) -> None:
    out = tmp_path / "run.mcap"
    options = ("--frames", 1, "--printer-scale", "1.002,0.999")
    assert locatk("simulate", "dots", "-o", out, *options).exit_code == 0
    manifest = sheets.attached_manifest(Session.open(out))
    assert manifest is not None
    assert manifest.scale == (1.0, 1.0)


@pytest.mark.parametrize(
    ("options", "status", "said"),
    [
        (("--frames", 3, "--duration", 2), 2, "not both"),
        (("--scale-known",), 2, "--scale-known needs --printer-scale"),
        (("--printer-scale", "1.002"), 2, "X,Y"),
        (("--id", "other"), 2, "simulated"),
        (("--missing", 1.5), 2, "--missing"),
        (("--codec", "libdots"), 2, "codec in [sheet]"),
        (("--askew", "2,3"), 2, "pitch_deg in [camera] and roll_deg in [camera]"),
        (("--rate", 10000), 1, "exposure_s"),
    ],
)
def test_impossible_settings_give_one_line(
    locatk, tmp_path: Path, options: tuple[object, ...], status: int, said: str
) -> None:
    result = locatk("simulate", "dots", "-o", tmp_path / "run.mcap", *options)
    assert result.exit_code == status
    assert said in result.stderr
    assert "Traceback" not in result.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('[sheet]\ncodec = "qr"', "libdots"),
        ("[print]\ndot_pitches = 0.9", "dot 0.9"),
        ("[camera]\ntilt_deg = 60", "camera.tilt_deg"),
    ],
)
def test_a_wrong_setting_is_one_line(locatk, tmp_path: Path, text: str, said: str) -> None:
    config, out = tmp_path / "sim.toml", tmp_path / "run.mcap"
    config.write_text(f'format = "locatk-simulation-dots"\nformat_version = 1\n{text}\n')
    result = locatk("simulate", "dots", "-o", out, "--config", config)
    assert result.exit_code == 1
    assert said in result.stderr
    assert not out.exists()


def test_outputs_are_not_overwritten_without_the_option(locatk, tmp_path: Path) -> None:
    out = tmp_path / "run.mcap"
    out.write_text("mine")
    assert locatk("simulate", "dots", "-o", out, "--frames", 1).exit_code == 1
    assert out.read_text() == "mine"
    assert locatk("simulate", "dots", "-o", out, "--frames", 1, "--overwrite").exit_code == 0
    sheet = tmp_path / "sheet.toml"
    sheets.write_manifest(sheet, simulate.sheet())
    result = locatk("simulate", "dots", "-o", sheet, "--sheet", sheet, "--overwrite")
    assert result.exit_code == 2
    assert sheets.read_manifest(sheet) == simulate.sheet()
