"""From frames to poses in metres: sheets, tiles, scales, and what is counted as rejected."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.dots.frames import Frames
from locatk.core.dots.sheet import Manifest, Sheet
from locatk.core.dots.solver import SolveOptions, solve
from locatk.core.errors import InputError

Image = NDArray[np.uint8]
Shoot = Callable[..., Image]

A4 = Sheet("A4-0001", (1000, 2000), (370, 540), (0, 0), (210.0, 297.0), (10.0, 12.0))


def recorded_frames(images: list[Image], device: str = "robot") -> Frames:
    n = len(images)
    names = tuple(f"{k:03d}.png" for k in range(n))
    return Frames(device, np.arange(n) * 20_000_000 + 10**18, names, images)


def test_a_pose_is_in_metres_on_the_paper(shoot: Shoot) -> None:
    at, heading = (1100.25, 2200.5), 0.6
    solution = solve([recorded_frames([shoot(at=at, heading=heading)])], Manifest((A4,)))
    (track,) = solution.trajectories
    assert (track.device, track.frame) == ("robot", "A4-0001")
    x, y = 10 + 100.25 * 0.508, 297 - 12 - 200.5 * 0.508
    np.testing.assert_allclose(track.position[0] * 1e3, [x, y, 0], atol=2e-3)
    assert 2 * math.atan2(track.quaternion[0, 2], track.quaternion[0, 3]) == pytest.approx(
        heading, abs=1e-3
    )
    sigma = track.sigma[0]
    assert np.isfinite(sigma[[0, 1, 5]]).all()
    assert np.isnan(sigma[[2, 3, 4]]).all()
    (detection,) = solution.detections
    assert detection.grid_x == pytest.approx(at[0], abs=3e-3)
    assert (detection.sheet, detection.frame) == ("A4-0001", "000.png")
    assert solution.rejected == {}


def test_the_measured_scale_of_the_print_counts(shoot: Shoot) -> None:
    frames = [recorded_frames([shoot(at=(1100.0, 2200.0), heading=0.5)])]
    nominal = solve(frames, Manifest((A4,))).trajectories[0]
    measured = solve(frames, Manifest((A4,), scale=(1.01, 0.98))).trajectories[0]
    np.testing.assert_allclose(measured.position[0], nominal.position[0] * [1.01, 0.98, 1])


def test_tiles_are_one_floor(shoot: Shoot) -> None:
    left = Sheet("c1r1", (1000, 2000), (300, 300), (0, 0), (210, 297), (10, 10), (0.0, 0.0))
    rotated = Sheet(
        "c2r1", (1290, 2000), (300, 300), (0, 0), (210, 297), (10, 10), (500.0, 40.0), 90.0
    )
    images = [shoot(at=(1050.0, 2100.0)), shoot(at=(1400.0, 2100.0), heading=0.25)]
    solution = solve([recorded_frames(images)], Manifest((left, rotated)))
    (track,) = solution.trajectories
    assert (track.device, track.frame, len(track)) == ("robot", "floor", 2)
    on_paper = (10 + 110 * 0.508, 297 - 10 - 100 * 0.508)
    np.testing.assert_allclose(
        track.position[1, :2] * 1e3, [500 - on_paper[1], 40 + on_paper[0]], atol=2e-3
    )
    heading = 2 * math.atan2(track.quaternion[1, 2], track.quaternion[1, 3])
    assert heading == pytest.approx(math.pi / 2 + 0.25, abs=1e-3)
    # The spread along the paper's x lies along the floor's y.
    alone = solve([recorded_frames(images[1:])], Manifest((Sheet(*_without_position(rotated)),)))
    assert track.sigma[1, 1] == pytest.approx(alone.trajectories[0].sigma[0, 0], rel=1e-6)


def _without_position(sheet: Sheet) -> tuple[object, ...]:
    return (sheet.id, sheet.origin, sheet.size, sheet.section, sheet.page_mm, sheet.first_mm)


def test_a_camera_that_sees_two_sheets_has_a_trajectory_on_each(shoot: Shoot) -> None:
    other = Sheet("A4-0002", (5000, 2000), (370, 540), (0, 0), (210.0, 297.0), (10.0, 12.0))
    images = [shoot(at=(x, 2100.0)) for x in (1100.0, 5100.0, 1110.0)]
    solution = solve([recorded_frames(images)], Manifest((A4, other)))
    frames = {track.frame: (track.device, len(track)) for track in solution.trajectories}
    assert frames == {"A4-0001": ("robot-A4-0001", 2), "A4-0002": ("robot-A4-0002", 1)}


def test_adjacent_sheets_contain_their_own_dots() -> None:
    first, second = (Sheet(f"s{x}", (x, 0), (100, 100), (0, 0), (60, 60), (5, 5)) for x in (0, 100))
    manifest = Manifest((first, second))
    positions = [
        [99.0, 50.0],
        [100.0, 50.0],
        [105.0, 50.0],
        [-8.0, 50.0],
        [208.0, 50.0],
        [230.0, 50.0],
    ]
    result = manifest.find(positions, np.zeros((6, 2), int), slack=12.0)
    assert result.tolist() == [0, 1, 1, 0, 1, -1]


def test_sizes_may_differ_without_a_camera(shoot: Shoot) -> None:
    small = shoot(at=(1100.0, 2200.0))
    large = shoot(at=(1120.0, 2200.0), size=(320, 240), pitch=20.0)
    solution = solve([recorded_frames([small, large, small])], Manifest((A4,)))
    x = solution.trajectories[0].position[:, 0]
    np.testing.assert_allclose(np.diff(x) / 0.508e-3, [20, -20], atol=0.01)
    assert [each.code for each in solution.warnings] == ["no_camera_model"]


def test_nothing_to_solve() -> None:
    solution = solve([recorded_frames([])], Manifest((A4,)))
    assert solution.poses == 0
    assert solution.trajectories[0].frame == "A4-0001"
    assert solve([], Manifest((A4,))).trajectories == ()


def test_unknown_methods_and_codecs_are_refused() -> None:
    with pytest.raises(InputError, match="no method 'bundle'"):
        solve([], Manifest((A4,)), SolveOptions("bundle"))
    with pytest.raises(InputError, match="no codec 'braille'"):
        solve([], Manifest((A4,), codec="braille"))
