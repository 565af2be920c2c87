"""`cameras.toml`, the table of sensors."""

from __future__ import annotations

import pytest

from locatk.core.dots.design.camera_sensors import SENSORS
from locatk.core.errors import ArtifactError
from locatk.formats.artifacts.cameras import CAMERAS, cameras_template, read_cameras

ROW = """format = "locatk-camera-table"
format_version = 1
[[sensors]]
name = "a"
size_px = [100, 80]
pixel_um = 3.0
frame_rate_hz = 60
shutter = "global"
"""


def test_the_template_holds_the_known_sensors() -> None:
    assert CAMERAS.loads(cameras_template()) == SENSORS
    assert read_cameras(None) == SENSORS


def test_values_are_in_si() -> None:
    (sensor,) = CAMERAS.loads(ROW + "min_exposure_ms = 0.01\ncolour = true\n")
    assert (sensor.pixel_m, sensor.min_exposure_s) == (3e-6, 1e-5)
    assert sensor.is_colour
    assert sensor.size_px == (100, 80)


@pytest.mark.parametrize(
    ("before", "after", "problem"),
    [
        ("pixel_um = 3.0", "pixel_um = 0.003", "pixel_um"),
        ("pixel_um", "pixel_mm", "pixel_um"),
        ('"global"', '"fast"', "shutter"),
        ("[100, 80]", "[100, -80]", "size_px"),
        ("frame_rate_hz = 60", "frame_rate_hz = 0", "frame_rate_hz"),
        ("[[sensors]]", "[sensors]", "sensors"),
    ],
)
def test_errors_name_the_key(before: str, after: str, problem: str) -> None:
    with pytest.raises(ArtifactError, match=problem):
        CAMERAS.loads(ROW.replace(before, after))


def test_names_are_unique() -> None:
    row = ROW.partition("[[sensors]]")[2]
    with pytest.raises(ArtifactError, match="occurs twice"):
        CAMERAS.loads(ROW + "[[sensors]]" + row.replace('"a"', '"A"'))
