"""The one public camera frame of the pattern, of cellulo-localization: a libdots sheet, 320 x 241.

Its place was recovered from its dots by two other decoders; nobody measured it.
"""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.dots.codec import codec
from locatk.core.dots.frames import Frames
from locatk.core.dots.localization.frames import localize_frames
from locatk.core.dots.sheet import Manifest, Sheet
from locatk.core.dots.solver import SolveOptions, solve

PLACE = (129.168, 3224.506)
HEADING_DEG = 1.603
SECTION = (24, 32)


@pytest.fixture(scope="module")
def frame(data: Path) -> NDArray[np.uint8]:
    path = data / "dots" / "frame.bmp"
    if not path.is_file():
        pytest.skip(f"no {path}")
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    assert image.shape == (241, 320)
    return np.asarray(image, np.uint8)


def rotation_error_deg(result: float, true_deg: float) -> float:
    return abs(math.remainder(math.degrees(result) - true_deg, 360))


@pytest.mark.parametrize("quarters", range(4))
def test_position_and_heading(frame: NDArray[np.uint8], quarters: int) -> None:
    # numpy turns the picture counter-clockwise, as if the camera had been turned clockwise.
    image = np.ascontiguousarray(np.rot90(frame, quarters))
    result = localize_frames(image[None], codec("libdots"))
    assert result.rejected[0] == ""
    np.testing.assert_allclose(result.grid[0], PLACE, atol=0.05)
    # A heading is that of the image's right. The picture is sheared: its down is 0.15 degrees
    # off the square, by whatever centroids, so that its quarter turns cannot be within 0.2 too.
    assert rotation_error_deg(result.heading[0], HEADING_DEG - 90 * quarters) < (
        0.35 if quarters % 2 else 0.2
    )
    assert tuple(result.section[0]) == SECTION
    assert result.dots[0] >= 175
    assert result.corrected[0] <= 6  # 2 of 384 in its full window, more at the blurred rim
    sigma = np.sqrt(np.diag(result.covariance[0]))
    assert (sigma[:2] < 0.01).all()


def test_rotations_agree_with_each_other(frame: NDArray[np.uint8]) -> None:
    result = [
        localize_frames(np.ascontiguousarray(np.rot90(frame, k))[None], codec("libdots"))
        for k in range(4)
    ]
    assert np.ptp([one.grid[0] for one in result], axis=0).max() < 0.01


def test_at_half_and_twice_its_size(frame: NDArray[np.uint8]) -> None:
    half = cv2.resize(frame[:240], (160, 120), interpolation=cv2.INTER_AREA)
    twice = cv2.resize(frame, (640, 482), interpolation=cv2.INTER_CUBIC)
    for image, middle in ((half, 119.5), (twice, 120.0)):
        result = localize_frames(np.asarray(image, np.uint8)[None], codec("libdots"))
        assert result.rejected[0] == ""
        # The middle of the first 240 rows is half a pixel, a 40th of a pitch, above.
        np.testing.assert_allclose(
            result.grid[0], np.array(PLACE) + [0, (middle - 120) / 20.2], atol=0.05
        )


def test_a_microdots_reader_finds_nothing(frame: NDArray[np.uint8]) -> None:
    result = localize_frames(frame[None], codec("microdots"))
    assert not result.accepted[0]


@pytest.mark.parametrize("method", ["lattice", "paper"])
def test_metres_on_its_sheet(frame: NDArray[np.uint8], method: str) -> None:
    # generatePattern's sheet at 0, 3000 with dots on 190 x 270 mm of an A4 page.
    sheet = Sheet("libdots", (0, 3000), (374, 531), SECTION, (210.0, 297.0), (10.0, 13.5))
    frames = Frames("camera", np.array([5 * 10**9]), ("frame.bmp",), [frame])
    solution = solve([frames], Manifest((sheet,), codec="libdots"), SolveOptions(method))
    (pose,) = solution.detections
    assert pose.x_m * 1e3 == pytest.approx(10 + 129.168 * 0.508, abs=0.04)
    assert pose.y_m * 1e3 == pytest.approx(297 - 13.5 - 224.506 * 0.508, abs=0.04)
    assert rotation_error_deg(pose.heading_rad, HEADING_DEG) < 0.5
    assert (pose.sheet, pose.frame, pose.time_s) == ("libdots", "frame.bmp", 5.0)
    assert solution.rejected == {}
