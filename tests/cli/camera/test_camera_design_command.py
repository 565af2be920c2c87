"""`locatk camera design` as a user runs it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from locatk.core.dots.design import camera_measurement
from locatk.core.dots.design.camera_measurement import CameraMeasurement
from locatk.core.dots.design.camera_setup import CameraSetup
from locatk.core.errors import InputError
from locatk.formats.artifacts.cameras import CAMERAS

PAPER = ("--sensor", "mt9v034-binned", "--focal-length", 5.5, "--distance", 16.0417)


def test_design_without_values(locatk) -> None:
    result = locatk("camera", "design", "--frames", 0)
    assert result.exit_code == 0, result.stderr
    assert "12 x 12" in result.stdout
    assert "rolling shutter" in result.stdout
    assert "No frame was rendered" in result.stderr


def test_the_camera_of_the_paper_predicted_and_rendered(locatk) -> None:
    result = locatk("camera", "design", *PAPER, "--exposure", 130.14, "--frames", 12, "--json")
    assert result.exit_code == 0, result.stderr
    report = json.loads(result.stdout)
    assert report["version"] == 1
    figures, rendered = report["figures"], report["rendered"]
    assert figures["metres_per_px"] == pytest.approx(46e-6, rel=1e-4)
    assert figures["one_pixel_speed_mps"] == pytest.approx(0.353, abs=0.001)
    assert (rendered["frames"], rendered["read_rate"]) == (12, 1.0)
    assert figures["position_sigma_m"] == pytest.approx(rendered["position_rms_m"], rel=0.5)
    assert report["warnings"] == []
    names = {entry["name"]: entry for entry in report["sensors"]}
    assert names["ov9281"]["fits"]
    assert not names["ov2640"]["fits"]
    assert names["ov2640"]["reasons"]


def test_an_impossible_wish_is_answered_with_what_would_have_to_change(locatk) -> None:
    result = locatk(
        "camera", "design", "--sensor", "ov2640", "--speed", 2, "--rate", 100, "--frames", 0
    )
    assert result.exit_code == 3
    assert "choose a sensor with a global shutter" in result.stderr
    assert "accept 15 poses per second" in " ".join(result.stderr.split())


def test_motion_that_cannot_be_rendered_is_predicted(locatk) -> None:
    result = locatk(
        "camera", "design", *PAPER, "--exposure", 20000, "--speed", 3, "--rate", 1, "--json"
    )
    assert result.exit_code == 3
    report = json.loads(result.stdout)
    assert report["rendered"] is None
    assert report["figures"]["read_rate"] < 0.01


def test_few_frames_are_rendered_if_motion_makes_them_slow(
    locatk, monkeypatch: pytest.MonkeyPatch
) -> None:
    rendered = []

    def count(setup: CameraSetup, frames: int, seed: int) -> CameraMeasurement:
        rendered.append(frames)
        raise InputError("not rendered")

    monkeypatch.setattr(camera_measurement, "measure_camera", count)
    for speed in (0.3, 300):
        locatk("camera", "design", *PAPER, "--speed", speed)
    assert rendered == [40, 2]


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("--speed", 1e9, "the speed is 1e+09 m/s. Hint: Give at least 0, below 10000 m/s"),
        ("--focus-error", 1e9, "the error of the distance is 1e+09 mm"),
        ("--turn-rate", 1e9, "the rate of rotation is 1e+09 deg/s"),
    ],
)
def test_limits_are_stated_with_the_units_of_the_options(
    locatk, option: str, value: float, message: str
) -> None:
    result = locatk("camera", "design", option, value)
    assert result.exit_code == 1
    assert message in " ".join(result.stderr.split())


def test_a_paper_needs_a_drawing(locatk) -> None:
    result = locatk("camera", "design", "--size", "A3")
    assert result.exit_code == 2
    assert "give --holder as well" in result.stderr


def test_own_table_of_sensors(locatk, tmp_path: Path) -> None:
    template = locatk("camera", "design", "--print-cameras")
    assert template.exit_code == 0
    text = template.stdout + (
        '\n[[sensors]]\nname = "mine"\nsize_px = [400, 400]\npixel_um = 6\n'
        'frame_rate_hz = 200\nshutter = "global"\n'
    )
    path = tmp_path / "cameras.toml"
    path.write_text(text)
    result = locatk(
        "camera", "design", "--cameras", path, "--sensor", "Mine", "--frames", 0, "--rate", 150
    )
    assert result.exit_code == 0, result.stderr
    assert "mine: 400 x 400 px" in result.stdout


def test_the_first_sensor_that_fits_is_chosen(locatk) -> None:
    result = locatk("camera", "design", "--rate", 110, "--frames", 0, "--json")
    report = json.loads(result.stdout)
    assert result.exit_code == 0, result.stderr
    assert report["setup"]["sensor"]["name"] == "ov9281"


def test_holder(locatk, tmp_path: Path) -> None:
    path = tmp_path / "holder.pdf"
    result = locatk("camera", "design", *PAPER, "--frames", 0, "--holder", path)
    assert result.exit_code == 0, result.stderr
    assert path.read_bytes().startswith(b"%PDF")
    again = locatk("camera", "design", *PAPER, "--frames", 0, "--holder", path)
    assert again.exit_code == 1
    assert "--overwrite" in again.stderr


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        (("--sensor", "ov9282"), "Did you mean ov9281"),
        (("--distance", -3), "-3"),
        (("--distance", 99000), "distance is 99000 mm"),
        (("--focal-length", 16, "--distance", 10), "cannot be focused"),
        (("--tilt", 90), "90"),
        (("--pitch", 508), "pitch is 508 mm"),
    ],
)
def test_values_that_cannot_be_meant(locatk, arguments: tuple[object, ...], problem: str) -> None:
    result = locatk("camera", "design", *arguments, "--frames", 0)
    assert result.exit_code in (1, 2)
    assert problem in result.stderr
    assert result.stderr.count("\n") <= 2
    assert "Traceback" not in result.stderr


def test_a_calibration_is_not_a_table(locatk, tmp_path: Path) -> None:
    path = tmp_path / "camera.toml"
    path.write_text('format = "locatk-camera"\nformat_version = 1\n')
    result = locatk("camera", "design", "--cameras", path)
    assert result.exit_code == 1
    assert "camera.toml" in result.stderr
    assert CAMERAS.format in result.stderr
