"""Frames across the seam of two tiles, by a camera that shares nothing with the solver."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.dots.calibration.seam_measurements import (
    SeamMeasurement,
    add_systematic_errors,
    crop_overlaps,
    measure_seam,
    refuse_contained_tiles,
    without_ambiguous_dots,
)
from locatk.core.dots.camera import Camera
from locatk.core.dots.codec import codec
from locatk.core.dots.frames import Frames
from locatk.core.dots.localization import seams, separation
from locatk.core.dots.localization.frames import (
    LOW_CONFIDENCE,
    NO_GRID,
    dot_correspondences,
    localize_frames,
)
from locatk.core.dots.localization.seams import localize_view
from locatk.core.dots.localization.separation import SheetView, separate_sheets, view_of_sheet
from locatk.core.dots.sheet import Manifest, Sheet
from locatk.core.dots.solver import SolveOptions, solve
from locatk.core.errors import InputError

PITCH_MM = 0.508
ANOTO = codec("anoto")
CAMERA = Camera((188, 120), 348.7, (93.5, 59.5))
SIZE, PAGE, FIRST = (370, 540), (210.0, 297.0), (10.0, 12.0)
STEP_MM = 360 * PITCH_MM
CUT_MM = FIRST[0] + 364.5 * PITCH_MM
TILES = Manifest(
    (
        Sheet("left", (1000, 2000), SIZE, (0, 0), PAGE, FIRST, (0.0, 0.0)),
        Sheet("right", (1360, 2000), SIZE, (0, 0), PAGE, FIRST, (STEP_MM, 0.0)),
    )
)
"""Two tiles that share ten columns; they are cut in the middle of these."""

Frame = tuple[NDArray[np.uint8], complex, float]


@pytest.fixture(scope="module")
def lay(laid_sheet: Callable[..., Any]) -> Callable[..., tuple[Any, Any]]:
    """``lay(dx, dy, turn)``: both tiles, the right one displaced in mm and degrees."""

    def lay(dx: float, dy: float, turn: float) -> tuple[Any, Any]:
        visible = (0.0, 0.0, CUT_MM, PAGE[1])
        left = laid_sheet((1000, 2000), SIZE, PAGE, FIRST, visible=visible)
        visible = (CUT_MM - STEP_MM, 0.0, PAGE[0], PAGE[1])
        right = laid_sheet((1360, 2000), SIZE, PAGE, FIRST, STEP_MM + dx, dy, turn, visible=visible)
        return left, right

    return lay


@pytest.fixture(scope="module")
def cross(shoot_floor: Callable[..., Any]) -> Callable[..., Iterator[Frame]]:
    """``cross(sheets, count, seed)``: frames at random places of the seam, tilted up to 4 deg."""

    def cross(
        sheets: tuple[Any, Any], count: int, seed: int, width_mm: float = 1.5, **how: Any
    ) -> Iterator[Frame]:
        rng = np.random.default_rng(seed)
        for k in range(count):
            spot = complex(CUT_MM + rng.uniform(-width_mm, width_mm), rng.uniform(40, 260))
            heading = rng.uniform(-math.pi, math.pi)
            tilt, towards = rng.uniform(0, 0.07), rng.uniform(-math.pi, math.pi)
            image = shoot_floor(
                sheets, spot.real, spot.imag, heading=heading, seed=k, tilt=tilt, towards=towards,
                **how,
            )  # fmt: skip
            yield image, spot, heading

    return cross


def grid_of(sheet: Any, spot: complex) -> NDArray[np.float64]:
    """Grid coordinates of a place on the floor, by the renderer's arithmetic."""
    paper = sheet.on_paper(spot)
    x, y = paper.real - sheet.first[0], sheet.page[1] - sheet.first[1] - paper.imag
    return np.array([x, y]) / PITCH_MM + sheet.origin


def error_of(seam: SeamMeasurement, sheets: tuple[Any, Any]) -> NDArray[np.float64]:
    """Error (3,) of the pose of the second sheet of a measurement, in mm and rad."""
    first, other = (sheets[number] for number in seam.numbers)
    x, y, heading = seam.poses[0]
    true = first.on_paper(other.on_floor(complex(*seam.points_mm[0])))
    turn = heading - math.radians(other.turn - first.turn)
    return np.array([x - true.real, y - true.imag, turn])


@pytest.mark.slow
@pytest.mark.parametrize(
    "displacement",
    [(1.3, -0.8, 0.5), (0.9, 1.0, -0.3), (0.1, 0.05, 0.1)],
    ids=["1.5 mm", "1.3 mm", "0.4 pitches"],
)
def test_the_pose_of_a_tile_follows_from_each_frame(
    lay: Callable[..., Any], cross: Callable[..., Any], displacement: tuple[float, float, float]
) -> None:
    """A step of some tenths of a pitch is the worst: one lattice bends over both tiles."""
    sheets = lay(*displacement)
    errors, normalized, count = [], [], 10
    for image, _, _ in cross(sheets, count, 7):
        views = separate_sheets(image, TILES, ANOTO, CAMERA)
        seam = measure_seam(views, TILES, CAMERA)
        if seam is not None:
            error = error_of(seam, sheets)
            errors.append(np.hypot(*error[:2]))
            (seam,) = add_systematic_errors([seam], PITCH_MM)
            normalized.append(error @ np.linalg.solve(seam.covariance, error) / 3)
    assert len(errors) >= count / 2
    assert max(errors) < 3e-3
    assert 0.1 < np.mean(normalized) < 2


def test_every_dot_belongs_to_its_tile(lay: Callable[..., Any], cross: Callable[..., Any]) -> None:
    sheets = lay(1.3, -0.8, 0.5)
    ((image, spot, _),) = cross(sheets, 1, 1, width_mm=0.2)
    views = separate_sheets(image, TILES, ANOTO, CAMERA)
    assert {view.number for view in views} == {0, 1}
    assert sum(len(view.pixels) for view in views) > 140
    for view in views:
        # Left of the cut all dots are the left tile's, except for a few chance agreements.
        column = view.grid[:, 0] - sheets[view.number].origin[0]
        side = column * PITCH_MM + FIRST[0] + view.number * STEP_MM < CUT_MM
        assert np.mean(side == (view.number == 0)) > 0.95
        middle = grid_of(sheets[view.number], spot)
        assert np.abs(view.grid - middle).max() < 11


def test_a_tile_alone_is_alone(lay: Callable[..., Any], shoot_floor: Callable[..., Any]) -> None:
    image = shoot_floor(lay(1.3, -0.8, 0.5), 60.0, 150.0, heading=0.4)
    (view,) = separate_sheets(image, TILES, ANOTO, CAMERA)
    assert view.number == 0
    assert len(view.pixels) > 160
    assert measure_seam([view], TILES, CAMERA) is None


def test_a_blank_frame_has_no_sheet() -> None:
    blank = np.full((120, 188), 200, np.uint8)
    assert separate_sheets(blank, TILES, ANOTO, CAMERA) == []


@pytest.mark.slow
def test_a_sheet_without_position_is_decoded_alone(
    lay: Callable[..., Any], cross: Callable[..., Any]
) -> None:
    """Where each half of the frame has enough dots; the other code is that of no neighbour."""
    unplaced = Manifest(
        tuple(Sheet(s.id, s.origin, s.size, s.section, s.page_mm, s.first_mm) for s in TILES.sheets)
    )
    large = {"size": (320, 240), "centre": (159.5, 119.5)}
    camera = Camera((320, 240), 348.7, (159.5, 119.5))
    sheets = lay(1.3, -0.8, 0.5)
    for image, _, _ in cross(sheets, 2, 5, width_mm=0.5, **large):
        views = separate_sheets(image, unplaced, ANOTO, camera)
        assert {view.number for view in views} == {0, 1}
        seam = measure_seam(views, unplaced, camera)
        assert seam is not None
        assert np.hypot(*error_of(seam, sheets)[:2]) < 2e-3


@pytest.mark.slow
def test_almost_aligned_tiles_do_not_pull_each_other(
    lay: Callable[..., Any], cross: Callable[..., Any]
) -> None:
    """A dot in the overlap agrees with both tiles, 0.06 pitches apart, but is printed on one."""
    sheets = lay(0.02, 0.03, 0.0)
    camera = Camera((320, 240), 348.7, (159.5, 119.5))
    for image, _, _ in cross(sheets, 3, 5, 0.5, size=(320, 240), centre=(159.5, 119.5)):
        seam = measure_seam(separate_sheets(image, TILES, ANOTO, camera), TILES, camera)
        assert seam is not None
        assert np.hypot(*error_of(seam, sheets)[:2]) < 2e-3


def test_many_frames_do_not_average_systematic_errors() -> None:
    seams = [measured(0, range(1340, 1341))] * 400
    seams = [replace(seam, covariance=np.eye(3) * 1e-8) for seam in seams]
    result = add_systematic_errors(seams, PITCH_MM)
    information = sum(np.linalg.inv(seam.covariance) for seam in result)
    sigma = np.sqrt(np.diag(np.linalg.inv(information)))
    assert sigma[:2] == pytest.approx(math.hypot(2e-3 * PITCH_MM, 1e-4 / 20), rel=1e-6)
    assert sigma[2] == pytest.approx(1e-4 / 20)


def test_dots_of_both_sheets_are_of_neither() -> None:
    pixels = np.arange(20.0).reshape(10, 2)
    views = [SheetView(0, pixels[:7], pixels[:7]), SheetView(1, pixels[5:], pixels[5:])]
    first, second = without_ambiguous_dots(views)
    assert first.pixels.tolist() == pixels[:5].tolist()
    assert second.pixels.tolist() == pixels[7:].tolist()


@pytest.mark.slow
@pytest.mark.parametrize("camera", [CAMERA, None], ids=["camera", "no camera"])
def test_a_pose_at_a_seam_is_that_of_one_tile(
    lay: Callable[..., Any], cross: Callable[..., Any], camera: Camera | None
) -> None:
    """The dots of the other tile used to pull such poses by up to 0.1 mm, 30 sigma."""
    sheets = lay(0.1, 0.05, 0.1)
    frames = list(cross(sheets, 14, 11, width_mm=4.0))
    times = np.arange(len(frames)) * 20_000_000 + 10**18
    images = [image for image, _, _ in frames]
    recording = Frames("robot", times, tuple(map(str, times)), images)
    right = sheets[1]
    built = Manifest(
        (
            TILES.sheets[0],
            Sheet(*list(vars(TILES.sheets[1]).values())[:6], (right.x, right.y), right.turn),
        )
    )
    solution = solve([recording], built, SolveOptions(camera=camera))
    (track,) = solution.trajectories
    rows = np.searchsorted(times, track.time_ns)
    true = np.array([[frames[k][1].real, frames[k][1].imag] for k in rows])
    error = track.position[:, :2] * 1e3 - true
    assert len(track) >= 10
    # A tilted frame without a camera model has its pose in the middle of the frame all the same.
    assert np.hypot(*error.T).max() < 5e-3
    spread = track.covariance[:, :2, :2] * 1e6
    nees = np.einsum("ni,ni->n", error, np.linalg.solve(spread, error[..., None])[..., 0]) / 2
    assert nees.mean() < 3


def measured(number: int, columns: range) -> SeamMeasurement:
    nodes = np.array([[x, y] for x in columns for y in range(2000, 2010)])
    none = np.zeros((0, 2), np.int64)
    return SeamMeasurement(
        0, 0, (number, 1 - number), np.zeros((1, 2)), np.zeros((1, 3)), np.eye(3), (nodes, none)
    )


def test_tiles_end_where_the_other_covers_them() -> None:
    seams = [measured(0, range(1340, 1363)), measured(1, range(1363, 1390))]
    left, right = crop_overlaps(TILES, seams).sheets
    assert (left.origin, left.size) == ((1000, 2000), (363, 540))
    assert (right.origin, right.size) == ((1363, 2000), (367, 540))
    # Dots stay where they are on their paper.
    before = TILES.to_metres(1, [1500, 2100])
    np.testing.assert_allclose(crop_overlaps(TILES, seams).to_metres(1, [1500, 2100]), before)


def test_without_frames_the_cut_is_in_the_middle() -> None:
    left, right = crop_overlaps(TILES, []).sheets
    assert left.origin[0] + left.size[0] == right.origin[0] == 1365


def test_tiles_below_each_other_are_cut_along_their_rows() -> None:
    below = Sheet("below", (1000, 2530), SIZE, (0, 0), PAGE, FIRST, (0.0, -530 * PITCH_MM))
    corner = Sheet("corner", (1360, 2530), SIZE, (0, 0), PAGE, FIRST, (STEP_MM, -530 * PITCH_MM))
    cut = crop_overlaps(Manifest((*TILES.sheets, below, corner)), []).sheets
    assert [sheet.size for sheet in cut] == [(365, 535)] * 4
    assert cut[3].origin == (1365, 2535)


def test_a_tile_inside_of_another_cuts_nothing() -> None:
    inner = replace(TILES.sheets[0], id="inner", origin=(1100, 2000), size=(100, 540))
    manifest = Manifest((TILES.sheets[0], inner))
    assert crop_overlaps(manifest, []) == manifest
    with pytest.raises(InputError, match="tile inner is inside of that of left"):
        refuse_contained_tiles(manifest)
    refuse_contained_tiles(TILES)


# ---- one estimator of poses


@pytest.mark.parametrize("camera", [CAMERA, None], ids=["camera", "no camera"])
def test_a_view_has_the_pose_of_its_frame(
    lay: Callable[..., Any], shoot_floor: Callable[..., Any], camera: Camera | None
) -> None:
    """One sheet is in view: pose, covariance, dots and confidence are those of any frame."""
    image = shoot_floor(
        lay(1.3, -0.8, 0.5), 60.0, 150.0, heading=2.4, tilt=0.3, towards=1.0, missing=0.1
    )
    expected = localize_frames(image[None], ANOTO, camera, other_codec_odds=0)
    (dots,) = dot_correspondences(image[None], ANOTO, camera, other_codec_odds=0)
    view = view_of_sheet(dots, TILES)
    assert view is not None
    pose = localize_view(view, image.shape, TILES, ANOTO, camera)
    sigma = np.sqrt(np.einsum("ii->i", expected.covariance[0]))
    error = np.append(pose.grid[0] - expected.grid[0], pose.heading[0] - expected.heading[0])
    assert np.abs(error / sigma).max() < 0.1
    scale = np.outer(sigma, sigma)
    np.testing.assert_allclose(pose.covariance[0] / scale, expected.covariance[0] / scale, atol=0.1)
    assert pose.dots[0] == expected.dots[0]
    assert pose.confidence[0] == pytest.approx(expected.confidence[0])
    assert pose.accepted.all()


def test_wrong_bits_and_confidence_are_those_of_the_decoded_dots(shot: Callable[..., Any]) -> None:
    first = shot(at=(1180.0, 2270.0))
    symbols = ANOTO.symbols(first.corner, (2 * first.reach + 1,) * 2, (0, 0))
    middle = first.reach
    symbols[middle - 2, middle + 1] ^= 3
    symbols[middle + 1, middle - 1] ^= 1
    image = replace(first, symbols=symbols).take()
    (view,) = separate_sheets(image, TILES, ANOTO, CAMERA)
    pose = localize_view(view, image.shape, TILES, ANOTO, CAMERA)
    assert pose.corrected[0] == 3
    assert pose.grid[0] == pytest.approx(first.at, abs=0.01)
    assert pose.confidence[0] > 1 - 1e-9
    # Too few dots to decode them: the confidence is that with which they were found.
    few = np.hypot(*(view.grid - first.at).T) < 2.5
    part = SheetView(0, view.pixels[few], view.grid[few], confidence=0.99991)
    assert 12 < few.sum() < 25
    pose = localize_view(part, image.shape, TILES, ANOTO, CAMERA)
    assert pose.confidence[0] == 0.99991
    assert pose.corrected[0] == 0
    part = replace(part, misread_pixels=view.misread_pixels)
    assert localize_view(part, image.shape, TILES, ANOTO, CAMERA).corrected[0] == 3
    # Dots that are decoded to another position refute the one that they were found at.
    shifted = replace(view, grid=view.grid + [7.0, 0.0])
    pose = localize_view(shifted, image.shape, TILES, ANOTO, CAMERA)
    assert pose.rejected[0] == LOW_CONFIDENCE
    assert pose.confidence[0] == 0


def test_a_refuted_frame_has_neither_pose_nor_sheet(
    lay: Callable[..., Any], cross: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    ((image, _, _),) = cross(lay(1.3, -0.8, 0.5), 1, 1, width_mm=0.2)
    views = separate_sheets(image, TILES, ANOTO, CAMERA)
    wrong = [replace(view, grid=view.grid + [7.0, 0.0]) for view in views]
    monkeypatch.setattr(seams, "separate_sheets", lambda *_: wrong)
    recording = Frames("robot", np.array([10**18]), ("a",), [image])
    solution = solve([recording], TILES, SolveOptions(camera=CAMERA))
    assert solution.rejected == {LOW_CONFIDENCE: 1}
    assert solution.detections == ()
    assert sum(len(track) for track in solution.trajectories) == 0


def test_collinear_dots_determine_no_pose() -> None:
    grid = np.stack([np.full(30, 1180.0), np.arange(2200.0, 2230.0)], axis=1)
    views = [
        SheetView(0, (grid - grid[0]) * 3 + 20, grid),
        SheetView(1, (grid - grid[0]) * 3 + [26, 20], grid + [300, 0]),
    ]
    pose = localize_view(views[0], (120, 188), TILES, ANOTO, CAMERA)
    assert pose.rejected[0] == NO_GRID
    assert measure_seam(views, TILES, CAMERA) is None


@pytest.mark.slow
def test_poses_at_seams_of_tilted_frames(
    lay: Callable[..., Any], shoot_floor: Callable[..., Any]
) -> None:
    """The images of large dots are displaced; without the correction the mean is 2.7."""
    sheets = lay(0.1, 0.05, 0.1)
    rng = np.random.default_rng(8)
    normalized = []
    for k in range(18):
        spot = complex(CUT_MM + rng.uniform(-3, 3), rng.uniform(40, 260))
        heading, towards = rng.uniform(-math.pi, math.pi, 2)
        image = shoot_floor(
            sheets, spot.real, spot.imag, heading=heading, tilt=0.35, towards=towards, seed=k
        )
        views = separate_sheets(image, TILES, ANOTO, CAMERA)
        if len(views) == 2:
            pose = localize_view(views[0], image.shape, TILES, ANOTO, CAMERA)
            error = pose.grid[0] - grid_of(sheets[views[0].number], spot)
            normalized.append(error @ np.linalg.solve(pose.covariance[0, :2, :2], error) / 2)
    assert len(normalized) >= 12
    assert 0.3 < np.mean(normalized) < 2


# ---- hostile positions


def test_specks_anywhere_do_not_matter(
    lay: Callable[..., Any], cross: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Tilt and lens map a pixel far outside to any position, or to none."""
    ((image, _, _),) = cross(lay(1.3, -0.8, 0.5), 1, 1, width_mm=0.2)
    expected = separate_sheets(image, TILES, ANOTO, CAMERA)
    assert len(expected) == 2
    apply = separation.apply_homography

    def apply_with_specks(homography: Any, points: Any) -> Any:
        result = apply(homography, points)
        result[-3:] = [[1e12, 1e12], [np.nan, 1.0], [-3000.0, 5.0]]
        return result

    monkeypatch.setattr(separation, "apply_homography", apply_with_specks)
    views = separate_sheets(image, TILES, ANOTO, CAMERA)
    assert [view.number for view in views] == [view.number for view in expected]
    for view, other in zip(views, expected, strict=True):
        assert 0 <= len(other.pixels) - len(view.pixels) <= 3


# ---- overlaps of several tiles


@pytest.mark.parametrize("order", ["upper first", "lower first"])
@pytest.mark.parametrize("row", [262, 270], ids=["near the upper end", "in the middle"])
def test_dots_that_two_tiles_have_are_of_neither(
    laid_sheet: Callable[..., Any], shoot_floor: Callable[..., Any], order: str, row: int
) -> None:
    """Next to the left tile is the overlap of two others, of which the lower one is on top."""
    size = (370, 290)
    left = TILES.sheets[0]
    upper = Sheet("upper", (1360, 2000), size, (0, 0), PAGE, FIRST, (STEP_MM, 0.0))
    lower = Sheet("lower", (1360, 2250), size, (0, 0), PAGE, FIRST, (STEP_MM, -250 * PITCH_MM))
    rest = (upper, lower) if order == "upper first" else (lower, upper)
    seam_y = PAGE[1] - FIRST[1] - 254 * PITCH_MM
    x = CUT_MM - STEP_MM
    floor = (
        laid_sheet(left.origin, SIZE, PAGE, FIRST, visible=(0, 0, CUT_MM, PAGE[1])),
        laid_sheet(upper.origin, size, PAGE, FIRST, STEP_MM - 0.5, 0.4, visible=(x, seam_y, *PAGE)),
        laid_sheet(
            *(lower.origin, size, PAGE, FIRST, STEP_MM + 0.6, 0.3 - 250 * PITCH_MM, 0.2),
            visible=(x, 0, PAGE[0], PAGE[1] - FIRST[1] + 3 * PITCH_MM),
        ),
    )
    image = shoot_floor(floor, CUT_MM, PAGE[1] - FIRST[1] - row * PITCH_MM, heading=0.2, seed=1)
    (view,) = separate_sheets(image, Manifest((left, *rest)), ANOTO, CAMERA)
    assert view.number == 0
    assert len(view.pixels) > 60
