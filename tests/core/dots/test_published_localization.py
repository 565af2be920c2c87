"""The published algorithm, on frames of a renderer of its own and on the published frame."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.dots.camera import Camera
from locatk.core.dots.codec import MAIN_SEQUENCE, SECTION_LENGTH, codec
from locatk.core.dots.codec.lookup import rotate_symbols
from locatk.core.dots.published import grid as paper_grid
from locatk.core.dots.published.localization import (
    PublishedPose,
    best_window,
    correlate,
    localize_published,
    look_up_position,
    vote_orientation,
)
from locatk.core.errors import InputError

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

PITCH_PX = 0.508 / 0.046
FINE = 6
"""Fine pixels a pixel."""


def photograph(
    at: tuple[float, float],
    heading: float,
    *,
    section: tuple[int, int] = (0, 0),
    name: str = "anoto",
    size: tuple[int, int] = (188, 120),
    centre: tuple[float, float] | None = None,
    lens: Callable[[Array], Array] | None = None,
    dot: float = 0.30,
    blur: float = 0.6,
    noise: float = 2.0,
    missing: float = 0.0,
    seed: int = 0,
) -> Image:
    """What a camera with ``at`` (grid coordinates) under ``centre`` sees.

    Discs are drawn on a canvas six times as fine, which is averaged, blurred and spoilt.
    ``dot`` is in pitches, ``blur`` in px, ``lens`` from ideal to distorted px.
    """
    rng = np.random.default_rng(seed)
    width, height = size
    middle = np.array(centre or ((width - 1) / 2, (height - 1) / 2))
    reach = math.ceil(math.hypot(width, height) / PITCH_PX) + 2
    corner = (round(at[0]) - reach, round(at[1]) - reach)
    symbols = codec(name).symbols(corner, (2 * reach, 2 * reach), section)
    rows, columns = np.indices(symbols.shape)
    sideways = np.select([symbols == 1, symbols == 2], [-1 / 6, 1 / 6], 0.0)  # left, right
    downwards = np.select([symbols == 0, symbols == 3], [-1 / 6, 1 / 6], 0.0)  # up, down
    east = columns + corner[0] + sideways - at[0]
    south = rows + corner[1] + downwards - at[1]
    # The image's right looks `heading` counter-clockwise of east: to (cos, -sin) with y down.
    c, s = math.cos(heading), math.sin(heading)
    points = middle + PITCH_PX * np.stack([c * east - s * south, s * east + c * south], axis=-1)
    points = points[rng.random(symbols.shape) >= missing]
    if lens is not None:
        points = lens(points)
    canvas = np.full((height * FINE, width * FINE), 200, np.uint8)
    for x, y in (points + 0.5) * FINE - 0.5:
        if -99 < x < width * FINE + 99 and -99 < y < height * FINE + 99:
            radius = round(dot * PITCH_PX / 2 * FINE * 16)
            cv2.circle(canvas, (round(x * 16), round(y * 16)), radius, 50, -1, cv2.LINE_8, 4)
    frame = cv2.resize(canvas, size, interpolation=cv2.INTER_AREA).astype(float)
    frame = cv2.GaussianBlur(frame, (0, 0), blur) + rng.normal(0, noise, frame.shape)
    return np.clip(np.rint(frame), 0, 255).astype(np.uint8)


def rotation_error_deg(actual: float, true: float) -> float:
    """Difference of two headings, in degrees."""
    return abs(math.degrees(math.remainder(actual - true, math.tau)))


def study(count: int, seed: int, **how: Any) -> tuple[Counter[str], list[float], list[float]]:
    """What becomes of frames at random poses; errors in pitches and degrees of the right ones."""
    rng = np.random.default_rng(seed)
    fate: Counter[str] = Counter()
    off, turn_off = [], []
    for k in range(count):
        x, y = rng.uniform(100, SECTION_LENGTH - 100, 2)
        heading, (u, v) = rng.uniform(-math.pi, math.pi), rng.integers(0, 63, 2).tolist()
        frame = photograph((x, y), heading, section=(u, v), seed=k, **how)
        pose = localize_published(frame, codec("anoto"))
        error = math.hypot(pose.x - x, pose.y - y)
        if pose.rejected is not None:
            fate[pose.rejected] += 1
        elif error > 0.5 or pose.section != (u, v):
            fate["wrong"] += 1
        else:
            fate["right"] += 1
            off.append(error)
            turn_off.append(rotation_error_deg(pose.heading_rad, heading))
    return fate, off, turn_off


# --- whole frames


@pytest.mark.slow
def test_frames_of_the_papers_camera() -> None:
    # All were read of 200 frames like these; the peer in C reads 78 %, without earlier frames.
    fate, off, turn_off = study(80, 1)
    assert fate["right"] >= 79, fate
    assert fate["wrong"] == 0, fate
    assert np.sqrt(np.mean(np.square(off))) < 0.02
    assert max(turn_off) < 0.5


@pytest.mark.slow
def test_dots_of_a_sixth_of_the_pitch_and_missing_dots() -> None:
    fate, _, _ = study(30, 2, dot=1 / 6)
    assert fate["right"] >= 22, fate
    fate, _, _ = study(30, 3, missing=0.05)
    assert fate["right"] >= 20, fate


@pytest.mark.parametrize("quarter", range(4))
def test_heading_is_counter_clockwise_from_the_sheets_x(quarter: int) -> None:
    heading = math.radians(5.0 + 90 * quarter)
    pose = localize_published(photograph((7000.3, 900.8), heading, section=(4, 60)), codec("anoto"))
    assert pose.rejected is None
    assert math.hypot(pose.x - 7000.3, pose.y - 900.8) < 0.15
    assert rotation_error_deg(pose.heading_rad, heading) < 2.5
    assert pose.section == (4, 60)
    assert pose.dots > 150
    assert 0.5 < pose.quality <= 1.0


@pytest.mark.parametrize("name", ["libdots", "microdots"])
def test_other_codecs(name: str) -> None:
    frame = photograph((250_000_000.5, 77.7), 0.1, name=name)
    pose = localize_published(frame, codec(name))
    assert pose.rejected is None
    assert math.hypot(pose.x - 250_000_000.5, pose.y - 77.7) < 0.15


def test_published_frame_and_its_rotations(data: Path) -> None:
    file = data / "dots" / "frame.bmp"
    if not file.exists():
        pytest.skip(f"{file} is not there")
    frame = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
    for quarter in range(4):
        pose = localize_published(np.ascontiguousarray(np.rot90(frame, quarter)), codec("libdots"))
        assert pose.rejected is None
        assert math.hypot(pose.x - 129.168, pose.y - 3224.506) < 0.1
        assert pose.section == (24, 32)
        # What turns the frame counter-clockwise is a camera turned clockwise.
        assert rotation_error_deg(pose.heading_rad, math.radians(1.603 - 90 * quarter)) < 0.4


def test_camera_undistorts_and_gives_the_centre() -> None:
    camera = Camera((188, 120), 219.0, (99.0, 56.5), -0.35)
    right = {True: 0, False: 0}
    for k in range(12):
        at, heading = (5000.25 + 40.3 * k, 700.6 + 31.7 * k), math.radians(3 + 97 * k)
        frame = photograph(at, heading, centre=(99.0, 56.5), lens=camera.distort, seed=k)
        for known in (True, False):
            pose = localize_published(frame, codec("anoto"), camera if known else None)
            right[known] += math.hypot(pose.x - at[0], pose.y - at[1]) < 0.2
    assert right[True] >= 9
    assert right[False] == 0


def test_a_mirrored_frame_is_not_read() -> None:
    frame = photograph((5000.3, 900.8), 0.1)
    assert localize_published(frame, codec("anoto")).rejected is None
    mirrored = localize_published(np.ascontiguousarray(frame[:, ::-1]), codec("anoto"))
    assert mirrored.rejected is not None


def rejected(pose: PublishedPose, *reasons: str) -> bool:
    return pose.rejected in reasons and math.isnan(pose.x) and pose.section == (-1, -1)


def test_frames_without_pattern_are_rejected() -> None:
    one = codec("anoto")
    for shape in ((1, 1), (120, 188)):
        for grey in (0, 128, 255):
            assert rejected(localize_published(np.full(shape, grey, np.uint8), one), "no_dots")
    regular = np.full((120, 188), 200, np.uint8)
    for x in range(6, 188, 11):
        for y in range(6, 120, 11):
            cv2.circle(regular, (x, y), 2, 30, -1)
    assert rejected(localize_published(regular, one), "no_orientation")
    assert rejected(localize_published(regular[:80, :80].copy(), one), "no_window")
    line = np.full((120, 188), 200, np.uint8)
    line[60:63] = np.tile([30, 30, 30, 200, 200, 200, 200, 200], 24)[:188]
    assert rejected(localize_published(line, one), "no_grid")
    rng = np.random.default_rng(5)
    for sigma in (0.5, 1.5, 3.0):
        for _ in range(8):
            cloud = cv2.GaussianBlur(rng.normal(0, 1, (120, 188)), (0, 0), sigma)
            noise = cv2.normalize(cloud, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
            assert rejected(
                localize_published(noise, one), "no_grid", "no_window", "no_orientation"
            )


@pytest.mark.parametrize(
    ("image", "says"),
    [
        (np.zeros((120, 188, 3), np.uint8), "not 8-bit grey"),
        (np.zeros((120, 188), np.uint16), "not 8-bit grey"),
        (np.zeros((0, 188), np.uint8), "not 8-bit grey"),
        (np.zeros((121, 188), np.uint8), "188 x 121 px is not of the camera's 188 x 120"),
    ],
)
def test_invalid_frames_are_refused(image: Any, says: str) -> None:
    camera = Camera((188, 120), 200.0, (93.5, 59.5))
    with pytest.raises(InputError, match=says):
        localize_published(image, codec("anoto"), camera)


# --- step by step


def test_symmetric_edges_of_a_small_cloud() -> None:
    # Five around one: the farthest is not among the middle's four nearest.
    points = np.array([[0, 0], [1, 0], [-1.1, 0], [0, 1.2], [0, -1.3], [0.2, 9]], float)
    edges = {tuple(sorted(e)) for e in paper_grid.symmetric_edges(points).tolist()}
    assert {(0, k) for k in (1, 2, 3, 4)} <= edges
    assert (0, 5) not in edges


@pytest.mark.parametrize("degrees", [0, 20, 44, 45, 70, 90, 133])
def test_clusters_are_found_in_any_direction(degrees: int) -> None:
    rng = np.random.default_rng(degrees)
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    true = 11 * np.array([[c, s], [-s, c]])
    edges = true[rng.integers(0, 2, 300)] * rng.choice([-1, 1], (300, 1))
    actual = paper_grid.cluster_edges(edges + rng.normal(0, 1, edges.shape))
    assert actual is not None
    u, v = actual
    assert u[0] * v[1] - u[1] * v[0] > 0  # v is a quarter turn from u, as y is from x
    for axis in (u, v):
        alike = np.abs(true @ axis) / 121
        assert alike.max() == pytest.approx(1, abs=0.02)
        assert alike.min() == pytest.approx(0, abs=0.04)


def test_intact_neighbourhood_is_the_nearest_whole_one() -> None:
    where = np.stack(np.meshgrid(np.arange(7.0), np.arange(5.0)), axis=-1).reshape(-1, 2)
    where += np.random.default_rng(3).uniform(-0.1, 0.1, where.shape)
    near = np.array([3.0, 2.0])

    def origin(points: Array) -> Array | None:
        return paper_grid.intact_origin(points, paper_grid.symmetric_edges(points), near)

    def middle(column: int, row: int) -> Array:
        around = [(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)]
        result: Array = np.mean([where[(row + b) * 7 + column + a] for a, b in around], axis=0)
        return result

    actual = origin(where)
    assert actual is not None
    np.testing.assert_allclose(actual, middle(3, 2))
    gone = np.delete(where, 1 * 7 + 4, axis=0)  # a corner dot of the 3 x 3 around (3, 2)
    actual = origin(gone)
    assert actual is not None
    assert np.abs(actual - near).max() > 0.5
    assert origin(where[:14]) is None


def test_refinement_moves_the_origin_and_the_lengths() -> None:
    rng = np.random.default_rng(8)
    positions = np.stack(np.meshgrid(np.arange(-8, 9), np.arange(-5, 6)), axis=-1).reshape(-1, 2)
    offsets = np.array([[0, -1], [-1, 0], [1, 0], [0, 1]])[rng.integers(0, 4, len(positions))] / 6
    noise = rng.normal(0, 0.01, positions.shape)
    points = np.array([90.0, 60.0]) + (positions + offsets + noise) * 11.0
    rough = paper_grid.AffineGrid(np.array([91.0, 58.8]), np.array([11.1, 0]), np.array([0, 10.85]))
    refined = paper_grid.refine_grid(rough, points)
    assert refined is not None
    grid, g, delta = refined
    np.testing.assert_allclose(grid.origin, [90, 60], atol=0.4)  # from 1.0 and 1.2 px off
    assert grid.u[0] == pytest.approx(11, abs=0.05)
    assert grid.v[1] == pytest.approx(11, abs=0.05)
    np.testing.assert_array_equal(g, positions)
    np.testing.assert_allclose(delta, offsets, atol=0.1)


def test_refinement_corrects_the_direction() -> None:
    rng = np.random.default_rng(9)
    nodes = np.stack(np.meshgrid(np.arange(-8, 9), np.arange(-5, 6)), axis=-1).reshape(-1, 2)
    offsets = np.array([[0, -1], [-1, 0], [1, 0], [0, 1]])[rng.integers(0, 4, len(nodes))] / 6
    points = np.array([90.0, 60.0]) + (nodes + offsets) * 11.0
    c, s = 11 * math.cos(math.radians(3)), 11 * math.sin(math.radians(3))
    rotated = paper_grid.AffineGrid(np.array([90.0, 60.0]), np.array([c, s]), np.array([-s, c]))
    refined = paper_grid.refine_grid(rotated, points)
    assert refined is not None
    grid, actual, delta = refined
    assert math.degrees(math.atan2(grid.u[1], grid.u[0])) == pytest.approx(0, abs=0.2)
    assert math.degrees(math.atan2(grid.v[0], grid.v[1])) == pytest.approx(0, abs=0.2)
    np.testing.assert_array_equal(actual, nodes)
    np.testing.assert_allclose(delta, offsets, atol=0.1)


def test_refinement_that_degenerates_has_no_grid() -> None:
    grid = paper_grid.AffineGrid(np.zeros(2), np.array([11.0, 0]), np.array([0, 11.0]))
    line = np.array([[11.0 * k, 0.0] for k in range(12)])
    assert paper_grid.refine_grid(grid, line) is None
    # Two rows that are one blob high are no grid.
    rows = np.array([[11.0 * k, y] for k in range(12) for y in (5.4, 5.6)])
    assert paper_grid.refine_grid(grid, rows) is None


@pytest.mark.parametrize(
    ("u", "v", "plausible"),
    [
        ((11, 0), (0, 11), True),
        ((11, 0), (0, -11), False),
        ((1.9, 0), (0, 11), False),
        ((11, 0), (11 * math.cos(0.5), 11 * math.sin(0.5)), False),
        ((11, 0), (11 * math.cos(0.55), 11 * math.sin(0.55)), True),
    ],
)
def test_plausible_grids(u: Any, v: Any, plausible: bool) -> None:
    grid = paper_grid.AffineGrid(np.zeros(2), np.array(u, float), np.array(v, float))
    assert grid.is_plausible is plausible


def test_likelihood_is_equation_9() -> None:
    r0 = 1 / 6
    r = np.array([0, r0, -r0, r0 / 2, 1.74 * r0, -2 * r0])
    np.testing.assert_allclose(
        paper_grid.quasi_probability(r), [0, 1, -1, 0.75 - 1 / 16, 0, 0], atol=1e-12
    )


def test_soft_bits_give_the_symbol_and_keep_the_likelier_dot() -> None:
    g = np.array([[0, 0], [1, 0], [0, 1], [1, 1], [1, 1], [3, 2]])
    offsets = np.array([[0, -1], [-1, 0], [1, 0], [0.0, 1], [-0.5, 0], [0, 0]]) / 6
    columns, rows = paper_grid.soft_bits(g + [5, -3], offsets)
    np.testing.assert_allclose(columns, [[-1, 1, 0, 0], [-1, 1, 0, 0], [0] * 4], atol=1e-12)
    np.testing.assert_allclose(rows, [[-1, -1, 0, 0], [1, 1, 0, 0], [0] * 4], atol=1e-12)


def test_best_window_is_that_of_the_largest_sum() -> None:
    rng = np.random.default_rng(4)
    for shape in ((8, 8), (9, 17), (14, 11)):
        likely = rng.random(shape)
        sums = {
            (column, row): likely[row : row + 8, column : column + 8].sum()
            for row in range(shape[0] - 7)
            for column in range(shape[1] - 7)
        }
        assert tuple(best_window(likely).tolist()) == max(sums, key=lambda at: sums[at])


def soft(symbols: Image) -> Array:
    return np.stack([symbols & 1, symbols >> 1]) * 2.0 - 1.0


def test_orientation_by_vote() -> None:
    rng = np.random.default_rng(6)
    for _ in range(50):
        x, y = rng.integers(0, SECTION_LENGTH - 8, 2).tolist()
        symbols = codec("anoto").symbols((x, y), (8, 8))
        for quarters in range(4):
            window = soft(rotate_symbols(symbols, quarters))
            for _ in range(3):
                window[:, rng.integers(8), rng.integers(8)] *= rng.choice([0, -1])
            assert vote_orientation(window) == quarters
    assert vote_orientation(np.zeros((2, 8, 8))) is None


def test_correlation_after_one_flip() -> None:
    # II-B.7: 36 % of the places stay right (192 of 504 when the first of equals counts);
    # where the flipped bit has no weight, all.
    strings = MAIN_SEQUENCE[np.add.outer(np.arange(63), np.arange(8)) % 63] * 2.0 - 1.0
    right = weighted = 0
    for bit in range(8):
        lines, weights = strings.copy(), np.ones((63, 8))
        lines[:, bit] *= -1
        phases, corrected = correlate(lines, weights)
        right += int((phases == np.arange(63)).sum())
        assert corrected >= 63
        weights[:, bit] = 0
        phases, corrected = correlate(lines, weights)
        weighted += int((phases == np.arange(63)).sum())
        assert corrected == 63
    assert right == 192
    assert weighted == 504


@pytest.mark.parametrize("name", ["anoto", "libdots", "microdots"])
def test_place_of_eight_phases(name: str) -> None:
    rng = np.random.default_rng(7)
    one = codec(name)
    for x in [0, SECTION_LENGTH - 8, *rng.integers(0, SECTION_LENGTH - 8, 100).tolist()]:
        phases = one.phases(np.arange(x, x + 8), 17)
        assert look_up_position(phases, one) == x
    across = one.phases(SECTION_LENGTH - 4) + np.cumsum(
        np.r_[0, one.differences((SECTION_LENGTH - 4 + np.arange(7)) % SECTION_LENGTH)]
    )
    assert look_up_position(across % 63, one) is None
    assert look_up_position(np.zeros(8, np.int64), one) is None


def test_an_outer_line_may_be_wrong() -> None:
    one = codec("anoto")
    right = 0
    for x in range(5000, 5100):
        phases = one.phases(np.arange(x, x + 8))
        phases[0] = (phases[0] + 31) % 63
        right += look_up_position(phases, one) == x
    assert right >= 90
