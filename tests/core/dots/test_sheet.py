"""Places of the pattern as metres on paper and floor, against numbers worked out by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from locatk.core.dots.sheet import (
    DOT_OFFSET_PITCHES,
    MM_PER_INCH,
    Distortion,
    Manifest,
    Sheet,
    interpolation_weights,
)

PAGE = Sheet("A4-1", (1000, 2000), (394, 565), (3, 5), (210.0, 297.0), (5.08, 4.0))
MANIFEST = Manifest((PAGE,), pitch_mm=0.5)


def test_origin_is_the_papers_lower_left_corner_and_y_points_up() -> None:
    result = MANIFEST.to_metres(0, [[1000, 2000], [1100, 2000], [1000, 2010.5], [989.84, 2586]])
    expected = [[0.00508, 0.293], [0.05508, 0.293], [0.00508, 0.28775], [0.0, 0.0]]
    np.testing.assert_allclose(result, expected, atol=1e-12)
    assert MANIFEST.to_metres(0, (1000, 2000)).shape == (2,)
    assert MANIFEST.to_metres(0, np.zeros((4, 3, 2))).shape == (4, 3, 2)


def test_measured_scale_stretches_the_whole_paper() -> None:
    printed = replace(MANIFEST, scale=(1.002, 0.999))
    np.testing.assert_allclose(
        printed.to_metres(0, [1100, 2010]), [0.05508 * 1.002, 0.288 * 0.999], atol=1e-12
    )


def test_tiles_are_placed_on_the_floor() -> None:
    tile = replace(PAGE, position_mm=(1000.0, -200.0))
    plain = Manifest((tile,), pitch_mm=0.5)
    np.testing.assert_allclose(plain.to_metres(0, [1000, 2000]), [1.00508, 0.093], atol=1e-12)
    # Turned a quarter counter-clockwise: the paper's x points to the floor's y.
    rotated = Manifest((replace(tile, heading_deg=90.0),), pitch_mm=0.5)
    np.testing.assert_allclose(
        rotated.to_metres(0, [[1000, 2000], [1100, 2000]]),
        [[0.707, -0.19492], [0.707, -0.14492]],
        atol=1e-12,
    )
    # The scale is the paper's, and goes before the turn; the tile's place is not scaled.
    both = replace(rotated, scale=(1.01, 1.0))
    np.testing.assert_allclose(
        both.to_metres(0, [1000, 2000]), [0.707, -0.2 + 0.00508 * 1.01], atol=1e-12
    )


def test_frames_poses_are_given_in() -> None:
    tiles = Manifest((PAGE, replace(PAGE, id="A4-2", position_mm=(0.0, 0.0))))
    assert tiles.frame(0) == "A4-1"
    assert tiles.frame(1) == "floor"


@given(
    st.floats(-180, 180),
    st.tuples(st.floats(0.9, 1.1), st.floats(0.9, 1.1)),
    st.tuples(st.floats(900, 1500), st.floats(1900, 2700)),
    st.booleans(),
)
def test_jacobian_is_the_derivative(
    heading: float, scale: tuple[float, float], at: tuple[float, float], tiled: bool
) -> None:
    sheet = replace(PAGE, position_mm=(40.0, 30.0), heading_deg=heading) if tiled else PAGE
    manifest = Manifest((sheet,), scale=scale)
    here = manifest.to_metres(0, at)
    derivative = np.stack(
        [(manifest.to_metres(0, np.add(at, step)) - here) / 8 for step in ((8, 0), (0, 8))], axis=1
    )
    np.testing.assert_allclose(manifest.jacobian(0), derivative, atol=1e-12)
    # A pitch stays a pitch, and the page's y down becomes y up.
    lengths = np.linalg.norm(manifest.jacobian(0), axis=0)
    np.testing.assert_allclose(lengths, np.multiply(scale, 0.508e-3), rtol=1e-9)
    assert np.linalg.det(manifest.jacobian(0)) < 0


def test_find_distinguishes_sheets_and_sections() -> None:
    other = replace(PAGE, id="A4-2", origin=(1394, 2000))
    elsewhere = replace(PAGE, id="A4-3", section=(4, 5))
    manifest = Manifest((PAGE, other, elsewhere))
    grid = [[1000, 2000], [1393, 2564], [1394, 2000], [1200, 2100], [1200, 2100], [1200, 2100]]
    section = [[3, 5], [3, 5], [3, 5], [4, 5], [4, -1], [-1, -1]]
    assert manifest.find(grid, section).tolist() == [0, 0, 1, 2, 2, 0]
    outside = [
        [999.9, 2100],
        [1788, 2100],
        [1200, 1999],
        [1200, 2564.1],
        [1200, 2100],
        [1500, 2100],
    ]
    wrong = [[3, 5], [3, 5], [3, 5], [3, 5], [9, 5], [4, 5]]
    assert manifest.find(outside, wrong).tolist() == [-1] * 6
    assert manifest.find(np.zeros((0, 2)), np.zeros((0, 2), int)).tolist() == []


def test_find_with_slack_takes_the_rim() -> None:
    sections = [[3, 5]] * 4
    grid = [[995.1, 1995.1], [1398, 2569], [994.9, 2100], [1200, 2569.1]]
    assert MANIFEST.find(grid, sections).tolist() == [-1] * 4
    assert MANIFEST.find(grid, sections, slack=5.0).tolist() == [0, 0, -1, -1]


def test_defaults_are_the_papers_print() -> None:
    # 0.508 mm are six printer dots at 300 dpi; a dot is one wide and one from its place.
    plain = Manifest((PAGE,))
    for length, printer_dots in ((plain.pitch_mm, 6), (plain.dot_mm, 1), (plain.offset_mm, 1)):
        assert length / MM_PER_INCH * 300 == pytest.approx(printer_dots)
    assert plain.offset_mm == pytest.approx(plain.pitch_mm * DOT_OFFSET_PITCHES)
    assert plain.scale == (1.0, 1.0)


def with_distortion(seed: int = 0) -> Manifest:
    values = np.random.default_rng(seed).normal(0, 0.1, (2, 5, 4)).tolist()
    x, y = (tuple(tuple(row) for row in rows) for rows in values)
    tile = replace(PAGE, position_mm=(30.0, 40.0), heading_deg=20.0, distortion=Distortion(x, y))
    return Manifest((tile,), pitch_mm=0.5, scale=(1.01, 0.99))


def test_a_distortion_is_that_of_its_nodes() -> None:
    manifest = with_distortion()
    plain = Manifest((replace(manifest.sheets[0], distortion=None),), pitch_mm=0.5,
                     scale=(1.01, 0.99))  # fmt: skip
    # The upper left dot is the first node of the last row.
    distortion = manifest.sheets[0].distortion
    assert distortion is not None
    turn = np.radians(20)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    for grid, node in (([1000, 2000], (4, 0)), ([1393, 2564], (0, 3))):
        moved = (manifest.to_metres(0, grid) - plain.to_metres(0, grid)) * 1e3
        np.testing.assert_allclose(moved, rotation @ distortion.displacement_mm[node], atol=1e-9)


def test_positions_and_directions_of_a_distorted_print_agree() -> None:
    manifest, step = with_distortion(), 1e-4
    grid = np.random.default_rng(1).uniform([950, 1950], [1450, 2650], (60, 2))
    np.testing.assert_allclose(manifest.to_grid(0, manifest.to_metres(0, grid)), grid, atol=1e-5)
    ahead = manifest.to_metres(0, grid + [step, 0]) - manifest.to_metres(0, grid - [step, 0])
    below = manifest.to_metres(0, grid + [0, step]) - manifest.to_metres(0, grid - [0, step])
    numeric = np.stack([ahead, below], axis=2) / (2 * step)
    np.testing.assert_allclose(manifest.jacobian(0, grid), numeric, atol=1e-9)
    heading = np.linspace(-3, 3, 60)
    position, turned, _ = manifest.poses_in_metres(0, grid, heading, np.zeros((60, 3, 3)))
    np.testing.assert_allclose(position, manifest.to_metres(0, grid))
    right = np.stack([np.cos(heading), -np.sin(heading)], axis=1)
    x, y = (manifest.to_metres(0, grid + step * right) - position).T
    np.testing.assert_allclose(np.angle(np.exp(1j * (turned - np.arctan2(y, x)))), 0, atol=1e-5)


@pytest.mark.parametrize("count", [2, 3, 7])
def test_interpolation_reproduces_nodes_and_lines(count: int) -> None:
    nodes = np.linspace(0, 1, count)
    np.testing.assert_allclose(interpolation_weights(nodes, count)[0], np.eye(count), atol=1e-12)
    place = np.linspace(-0.3, 1.3, 50)
    weights, slopes = interpolation_weights(place, count)
    np.testing.assert_allclose(weights @ nodes, place, atol=1e-12)
    np.testing.assert_allclose(slopes @ nodes, 1, atol=1e-12)


@pytest.mark.slow
def test_the_covariance_of_a_floor_is_that_of_its_sheets() -> None:
    """Against the scatter of positions on sheets that are drawn from the covariance."""
    rng = np.random.default_rng(2)
    root = rng.normal(0, 1, (3, 3)) * [[0.05], [0.04], [0.02]]
    covariance = root @ root.T
    tile = replace(
        PAGE,
        position_mm=(300.0, 100.0),
        heading_deg=30.0,
        covariance_mm_deg=tuple(tuple(row) for row in covariance.tolist()),
    )
    manifest = Manifest((tile,), pitch_mm=0.5)
    grid, heading = np.array([[1350.0, 2100.0]]), np.array([0.4])
    drawn = []
    for x, y, turn in rng.multivariate_normal([300, 100, 30], covariance, 4000):
        other = Manifest((replace(tile, position_mm=(x, y), heading_deg=turn),), pitch_mm=0.5)
        position, angle, _ = other.poses_in_metres(0, grid, heading, np.zeros((1, 3, 3)))
        drawn.append([*position[0], angle[0]])
    position, _, (result,) = manifest.poses_in_metres(0, grid, heading, np.zeros((1, 3, 3)))
    np.testing.assert_allclose(result, np.cov(np.transpose(drawn)), rtol=0.1, atol=1e-10)
    rough = Manifest((replace(tile, covariance_mm_deg=None, distortion_sigma_mm=(0.1, 0.3)),))
    c, s = np.cos(np.radians(30)), np.sin(np.radians(30))
    expected = np.array([[c, -s], [s, c]]) @ np.diag([1e-8, 9e-8]) @ np.array([[c, s], [-s, c]])
    np.testing.assert_allclose(rough.covariance(0, position[0])[:2, :2], expected)
    turned = Manifest((replace(PAGE, distortion_sigma_deg=0.1),)).covariance(0, position[0])
    np.testing.assert_allclose(turned, np.diag([0, 0, np.radians(0.1) ** 2]))
    assert not Manifest((PAGE,)).covariance(0, position).any()


def test_the_overlap_of_tiles_is_divided_in_its_middle() -> None:
    left = replace(PAGE, position_mm=(0.0, 0.0))
    right = replace(left, id="A4-2", origin=(1384, 2000), position_mm=(192.0, 0.0))
    manifest = Manifest((left, right))
    positions = [[1380.0, 2100.0], [1386.0, 2100.0], [1391.0, 2100.0], [1400.0, 2100.0]]
    assert manifest.find(positions, np.full((4, 2), -1)).tolist() == [0, 0, 1, 1]
    assert manifest.has_seams
    assert not MANIFEST.has_seams
    shared = manifest.contains(positions, (3, 5)).sum(axis=0)
    assert shared.tolist() == [1, 2, 2, 1]
    assert not manifest.contains(positions, (3, 4)).any()
