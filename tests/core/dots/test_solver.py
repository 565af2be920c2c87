"""The solver against pages made by hand, its bookkeeping, and its covariance in metres.

Sheets, tiles and scales on frames of the renderer are in test_sheets_to_poses.py.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.dots.camera import Camera
from locatk.core.dots.codec import codec
from locatk.core.dots.frames import Frames
from locatk.core.dots.localization import recordings
from locatk.core.dots.localization.frames import localize_frames
from locatk.core.dots.sheet import Manifest, Sheet
from locatk.core.dots.solver import SolveOptions, solve
from locatk.core.errors import InputError
from locatk.core.geometry import heading_from_quaternion
from locatk.core.solution import Solution
from locatk.core.trajectory import Trajectory

Image = NDArray[np.uint8]
Shoot = Callable[..., Image]

PX = 12
"""Pixels a pitch of the page that is made by hand, dots of 3 px 2 px beside their places."""

PAGE = Sheet("hand", (4000, 9000), (80, 60), (7, 3), (60.0, 50.0), (8.0, 6.0))


def page() -> Image:
    """The page's dots; place (0, 0) is the middle of the first cell."""
    symbols = codec("anoto").symbols(PAGE.origin, PAGE.size, PAGE.section)
    image = np.full((PAGE.size[1] * PX, PAGE.size[0] * PX), 220, np.uint8)
    for row, column in np.ndindex(symbols.shape):
        right, down = {0: (0, -2), 1: (-2, 0), 2: (2, 0), 3: (0, 2)}[int(symbols[row, column])]
        x, y = column * PX + PX // 2 + right, row * PX + PX // 2 + down
        image[y - 1 : y + 2, x - 1 : x + 2] = 40
    noise = np.random.default_rng(1).normal(0, 2, image.shape)
    return np.clip(np.rint(image + noise), 0, 255).astype(np.uint8)


def on_page(x_px: float, y_px: float) -> tuple[float, float]:
    """Millimetres from the paper's lower left corner of a pixel of :func:`page`."""
    column, row = (x_px - PX // 2) / PX, (y_px - PX // 2) / PX
    return 8.0 + column * 0.508, 50.0 - 6.0 - row * 0.508


def frames_of(images: Sequence[Image], device: str = "robot", start_s: int = 100) -> Frames:
    n = len(images)
    time_ns = (start_s + np.arange(n)) * 1_000_000_000
    return Frames(device, time_ns, tuple(f"{device}{k}" for k in range(n)), images)


def only(solution: Solution) -> Trajectory:
    (track,) = solution.trajectories
    return track


def heading(track: Trajectory) -> NDArray[np.float64]:
    result: NDArray[np.float64] = np.degrees(heading_from_quaternion(track.quaternion))
    return result


# --- where a pose is, and which way is up


@pytest.mark.parametrize("method", ["lattice", "paper"])
@pytest.mark.parametrize(
    ("quarters", "degrees"),
    [(0, 0), (1, -90), (2, 180), (3, 90)],  # the page turned left is the camera turned right
)
def test_a_page_cut_by_hand(method: str, quarters: int, degrees: float) -> None:
    left, top = 300, 250
    cut = page()[top : top + 120, left : left + 188]
    frames = frames_of([np.ascontiguousarray(np.rot90(cut, quarters))])
    track = only(solve([frames], Manifest((PAGE,)), SolveOptions(method)))
    expected = on_page(left + 187 / 2, top + 119 / 2)
    # The published method rounds its window's corner from one dot's place: 0.05 pitches.
    tolerance_mm = 0.002 if method == "lattice" else 0.05
    np.testing.assert_allclose(track.position[0, :2] * 1e3, expected, atol=tolerance_mm)
    assert track.position[0, 2] == 0
    assert math.remainder(heading(track)[0] - degrees, 360) == pytest.approx(0, abs=0.3)


def test_a_camera_that_moves_right_and_then_up() -> None:
    whole = page()
    cuts = [whole[t : t + 120, x : x + 188] for x, t in ((240, 240), (264, 240), (264, 204))]
    track = only(solve([frames_of(cuts)], Manifest((PAGE,))))
    steps = np.diff(track.position[:, :2], axis=0) * 1e3
    np.testing.assert_allclose(steps, [[24 / PX * 0.508, 0], [0, 36 / PX * 0.508]], atol=0.002)


def test_which_of_two_neighbouring_sheets(shoot: Shoot) -> None:
    """Their areas touch: a place near the seam is on the sheet that was printed with it."""
    first = Sheet("first", (1000, 2000), (100, 100), (0, 0), (70.0, 70.0), (10.0, 10.0))
    second = replace(first, id="second", origin=(1100, 2000))
    images = [shoot(at=(x, 2050.0)) for x in (1092.0, 1098.0, 1101.0, 1106.0, 1111.0)]
    for sheets in ((first, second), (second, first)):
        solution = solve([frames_of(images)], Manifest(sheets))
        on = [pose.sheet for pose in solution.detections]
        assert on == ["first", "first", "second", "second", "second"]


def test_just_off_the_rim_is_still_on_the_sheet(shot: Callable[..., Any]) -> None:
    one = shot(at=(1000 - 2.5, 2040.25), pitch=8.0)
    symbols = codec("anoto").symbols(one.corner, (2 * one.reach + 1,) * 2)
    symbols[:, : 1000 - one.corner[0]] = 255  # nothing is printed left of the sheet
    image = shot(at=one.at, pitch=8.0, symbols=symbols).take()
    sheet = Sheet("rim", (1000, 2000), (100, 100), (0, 0), (70.0, 70.0), (10.0, 10.0))
    track = only(solve([frames_of([image])], Manifest((sheet,))))
    expected = [10 - 2.5 * 0.508, 60 - 40.25 * 0.508]
    np.testing.assert_allclose(track.position[0, :2] * 1e3, expected, atol=0.003)


# --- what becomes of the frames


class Damaged(Sequence[Image]):
    """Images of which some cannot be read."""

    def __init__(self, images: list[Image | None]) -> None:
        self.images = images

    def __len__(self) -> int:
        return len(self.images)

    def __getitem__(self, index: Any) -> Any:
        image = self.images[index]
        if image is None:
            raise InputError("a truncated image")
        return image


@pytest.mark.parametrize("method", ["lattice", "paper"])
def test_every_frame_has_an_outcome(shoot: Shoot, method: str) -> None:
    sheet = Sheet("s", (1000, 2000), (100, 100), (0, 0), (70.0, 70.0), (10.0, 10.0))
    good = [shoot(at=(1030.0 + 7 * k, 2050.0), seed=k) for k in range(4)]
    blank = np.full((120, 188), 200, np.uint8)
    elsewhere = shoot(at=(9000.0, 2050.0))
    images = Damaged([good[0], None, good[1], blank, None, elsewhere, good[2], good[3], None])
    frames = frames_of(images)
    solution = solve([frames], Manifest((sheet,)), SolveOptions(method))
    outcomes = solution.facts.frames
    assert [one.frame for one in outcomes] == list(frames.names)
    assert [one.time_s for one in outcomes] == (frames.time_ns / 1e9).tolist()
    reasons = [one.rejected for one in outcomes]
    assert [k for k, reason in enumerate(reasons) if reason is None] == [0, 2, 6, 7]
    assert [reasons[k] for k in (1, 4, 8)] == ["unreadable_frame"] * 3
    assert reasons[5] == "off_sheet"
    assert solution.rejected == Counter(reason for reason in reasons if reason)
    track = only(solution)
    assert track.time_ns.tolist() == frames.time_ns[[0, 2, 6, 7]].tolist()
    assert [pose.frame for pose in solution.detections] == [frames.names[k] for k in (0, 2, 6, 7)]
    for pose, one in zip(solution.detections, [outcomes[k] for k in (0, 2, 6, 7)], strict=True):
        for key in ("confidence", "corrected_bits", "dots", "time_s"):
            assert getattr(pose, key) == getattr(one, key)
    np.testing.assert_allclose(
        track.position[:, 0], [pose.x_m for pose in solution.detections], atol=1e-12
    )
    assert solution.poses == 4
    if method == "lattice":
        assert (np.array([one.confidence for one in solution.detections]) > 0.999).all()
        assert np.isfinite(track.covariance[0][np.ix_([0, 1, 5], [0, 1, 5])]).all()
    else:
        assert np.isnan(track.covariance).all()
        assert "no_uncertainty" in [each.code for each in solution.warnings]


def test_the_manifest_of_another_codec(shoot: Shoot) -> None:
    sheet = Sheet("s", (1000, 2000), (200, 200), (0, 0), (120.0, 120.0), (8.0, 8.0))
    images = [shoot(at=(1050.0 + 11 * k, 2100.0 + 3 * k), codec="microdots") for k in range(8)]
    solution = solve([frames_of(images)], Manifest((sheet,), codec="anoto"))
    assert solution.poses == 0
    assert sum(solution.rejected.values()) == 8
    assert set(solution.rejected) <= {"no_code", "low_confidence", "off_sheet"}
    right = solve([frames_of(images)], Manifest((sheet,), codec="microdots"))
    assert right.poses == 8


def test_the_other_codec_is_named_by_frames_off_the_sheet(shoot: Shoot) -> None:
    # The fourth sequences of anoto and libdots are the same up to position 219 of 241.
    start = 241 * 700_000
    sheet = Sheet("s", (start, start), (241, 241), (0, 0), (140.0, 140.0), (8.0, 8.0))
    images = [
        shoot(at=(start + x, start + 100.0), codec="libdots", seed=x)
        for x in (40, 80, 120, 160, 232, 233)
    ]
    confused = solve([frames_of(images)], Manifest((sheet,), codec="anoto"))
    assert (confused.poses, confused.rejected) == (4, {"off_sheet": 2})
    # In the place of another codec, a position off the sheet is no certain one.
    off_sheet = confused.facts.frames[4:]
    assert all(frame.confidence < 0.999 for frame in off_sheet)
    (warning,) = (each for each in confused.warnings if each.code != "no_camera_model")
    assert warning.code == "other_codec"
    assert "were printed with the codec 'libdots'" in warning.message
    right = solve([frames_of(images)], Manifest((sheet,), codec="libdots"))
    assert right.poses == 6
    assert [each.code for each in right.warnings] == ["no_camera_model"]


@pytest.mark.parametrize(("right", "others", "printed"), [(6, 2, False), (1, 4, True)])
def test_a_few_frames_of_another_codec_do_not_rename_the_sheets(
    shoot: Shoot, right: int, others: int, printed: bool
) -> None:
    sheet = Sheet("s", (1000, 2000), (200, 200), (0, 0), (120.0, 120.0), (8.0, 8.0))
    images = [
        shoot(at=(1050.0 + 11 * k, 2100.0), codec="anoto" if k < right else "microdots", seed=k)
        for k in range(right + others)
    ]
    solution = solve([frames_of(images)], Manifest((sheet,), codec="anoto"))
    assert solution.poses == right
    (warning,) = (each for each in solution.warnings if each.code == "other_codec")
    assert "'microdots'" in warning.message
    assert f"{others} of the rejected frames" in warning.message
    assert ("were printed with" in warning.message) == printed
    assert (f"{right} of those with a pose are not" in warning.message) != printed


ALTERED = {
    "mirrored": lambda image: image[:, ::-1],
    "inverted": lambda image: 255 - image,
    "mirrored_and_inverted": lambda image: 255 - image[:, ::-1],
}


@pytest.mark.slow
@pytest.mark.parametrize("reason", ALTERED)
def test_mirrored_and_inverted_frames_are_named(shoot: Shoot, reason: str) -> None:
    """Also if they are few among frames without a pattern, and those with one keep their poses."""
    sheet = Sheet("s", (1000, 2000), (200, 200), (0, 0), (120.0, 120.0), (8.0, 8.0))
    good = [shoot(at=(1050.0 + 11 * k, 2100.0), heading=k, seed=k) for k in range(10)]
    blank = np.full((120, 188), 200, np.uint8)
    images = [*good[:2], *[blank] * 20, *(ALTERED[reason](image) for image in good[2:])]
    solution = solve([frames_of(images)], Manifest((sheet,)))
    assert solution.poses == 2
    assert solution.rejected == {reason: 8, "too_few_dots": 20}
    (warning,) = (each for each in solution.warnings if each.code != "no_camera_model")
    assert warning.code == f"{reason}_frames"
    assert warning.message.startswith("8 frames")


def test_other_causes_are_tried_on_a_sample_only(monkeypatch: pytest.MonkeyPatch) -> None:
    tried = []

    def count(images: Image, *args: Any, **options: Any) -> Any:
        tried.append(len(images))
        return localize_frames(images, *args, **options)

    monkeypatch.setattr(recordings, "localize_frames", count)
    noise = np.random.default_rng(4).integers(0, 256, (40, 60, 60)).astype(np.uint8)
    solution = solve([frames_of(list(noise))], Manifest((PAGE,)))
    assert sum(solution.rejected.values()) == 40
    assert set(solution.rejected) <= {"no_grid", "too_few_dots", "no_code"}
    # Three alterations and two other codecs.
    assert sum(tried) == 40 + 5 * recordings.MAX_TRIED_FRAMES


def test_cameras_by_themselves(shoot: Shoot) -> None:
    sheet = Sheet("s", (1000, 2000), (200, 200), (0, 0), (120.0, 120.0), (8.0, 8.0))
    left = [shoot(at=(1060.0, 2100.0)), shoot(at=(1061.0, 2100.0))]
    right = [shoot(at=(1130.0, 2100.0), size=(320, 240), pitch=20.0)]
    solution = solve(
        [frames_of(left, "left"), frames_of(right, "right", start_s=50)], Manifest((sheet,))
    )
    assert [(t.device, len(t)) for t in solution.trajectories] == [("left", 2), ("right", 1)]
    assert [one.frame for one in solution.facts.frames] == ["left0", "left1", "right0"]
    both = np.concatenate([t.position[:, 0] for t in solution.trajectories]) * 1e3
    np.testing.assert_allclose(both, 8 + np.array([60, 61, 130]) * 0.508, atol=0.003)


# --- covariance


@pytest.mark.slow
def test_covariance_in_metres(shoot: Shoot) -> None:
    """Errors in metres and radians are as the covariance says, on a turned and scaled tile."""
    tile = Sheet(
        "tile", (1000, 2000), (400, 400), (0, 0), (220.0, 220.0), (8.0, 8.0), (300.0, -40.0), 30.0
    )
    manifest = Manifest((tile,), scale=(1.003, 0.995))
    rng = np.random.default_rng(5)
    at = rng.uniform([1050, 2050], [1350, 2350], (60, 2))
    rotation = rng.uniform(-np.pi, np.pi, 60)
    images = [
        shoot(at=tuple(position), heading=angle, noise=12.0, jitter=0.01, seed=k)
        for k, (position, angle) in enumerate(zip(at.tolist(), rotation.tolist(), strict=True))
    ]
    track = only(solve([frames_of(images)], manifest))
    assert (track.frame, len(track)) == ("floor", 60)
    # By hand: paper in mm, scaled, turned by 30 degrees, moved.
    paper = np.stack([8 + (at[:, 0] - 1000) * 0.508, 220 - 8 - (at[:, 1] - 2000) * 0.508], axis=1)
    paper *= [1.003, 0.995]
    c, s = math.cos(math.radians(30)), math.sin(math.radians(30))
    floor = (paper @ np.array([[c, s], [-s, c]]) + [300, -40]) * 1e-3
    right = np.stack([1.003 * np.cos(rotation), 0.995 * np.sin(rotation)], axis=1)
    angle = np.arctan2(right[:, 1], right[:, 0]) + math.radians(30)
    error = np.column_stack(
        [track.position[:, :2] - floor, heading_from_quaternion(track.quaternion) - angle]
    )
    error[:, 2] = np.remainder(error[:, 2] + np.pi, 2 * np.pi) - np.pi
    assert np.abs(error[:, :2]).max() < 10e-6
    covariance = track.covariance[:, [0, 1, 5]][:, :, [0, 1, 5]]
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error) / 3
    assert 0.5 < nees.mean() < 2


def test_frames_of_another_size_than_the_cameras_are_rejected() -> None:
    images = [np.zeros(shape, np.uint8) for shape in ((120, 188), (60, 94))]
    frames = Frames("camera", np.arange(2), ("0", "1"), images)
    sheet = Sheet("s", (0, 0), (100, 100), (0, 0), (60.0, 60.0), (5.0, 5.0))
    camera = Camera((188, 120), 348.7, (93.5, 59.5))
    solution = solve([frames], Manifest((sheet,)), SolveOptions(camera=camera))
    outcomes = [frame.rejected for frame in solution.facts.frames]
    assert outcomes == ["too_few_dots", "not_of_the_cameras_size"]
