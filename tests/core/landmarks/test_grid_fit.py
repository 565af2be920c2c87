"""Grids that are found from places: the pitch, the cells, and what is off."""

from __future__ import annotations

import numpy as np
import pytest

from locatk.core.errors import InputError
from locatk.core.landmarks.landmark import signs
from locatk.core.landmarks.map.floor import HOLE_CODE, AsBuiltLandmark, FloorMap, as_built_poses
from locatk.core.landmarks.map.grid_fit import fit_grid, floor_from_poses


def names(count: int) -> list[str]:
    return [f"p{k}" for k in range(count)]


def positions(cells: list[tuple[int, int]], pitch: float, x: float = 0.0, y: float = 0.0):
    return np.array([(x + pitch * column, y + pitch * row) for row, column in cells])


@pytest.mark.parametrize(
    "cells",
    [
        [(0, 0), (0, 1)],
        [(0, 0), (1, 0), (5, 0)],
        [(0, 0), (1, 1), (2, 0), (1, 3)],  # no two side by side
        [(0, 0), (0, 2), (0, 5)],  # no gap of one cell
        [(2, 0), (0, 3), (5, 7), (9, 1)],
    ],
)
def test_pitch_and_cells_are_found(cells: list[tuple[int, int]]) -> None:
    grid = fit_grid(positions(cells, 0.18, -3.21, 7.5), names(len(cells)))
    assert grid.pitch_m == 0.18
    np.testing.assert_array_equal(grid.cells, cells)
    assert grid.origin_m == pytest.approx((-3.21, 7.5), abs=0)
    np.testing.assert_allclose(grid.offset_m, 0, atol=1e-12)


def test_a_large_floor_with_scatter_has_a_round_pitch() -> None:
    rng = np.random.default_rng(3)
    cells = [(int(r), int(c)) for r, c in np.argwhere(rng.random((60, 80)) < 0.7)]
    at = positions(cells, 0.2, 1.0, 2.0) + rng.uniform(-0.004, 0.004, (len(cells), 2))
    grid = fit_grid(at, names(len(cells)))
    least = np.min(cells, axis=0)
    np.testing.assert_array_equal(grid.cells, np.array(cells) - least)
    assert grid.pitch_m == 0.2
    assert grid.origin_m == pytest.approx((1 + 0.2 * least[1], 2 + 0.2 * least[0]), abs=3e-4)
    assert np.abs(grid.offset_m).max() < 0.0045


def test_the_pitch_can_be_given() -> None:
    assert fit_grid([(1.0, 2.0)], ["a"], pitch_m=0.2).origin_m == (1.0, 2.0)
    # 0.4 m apart: neighbours, unless they are known to be two cells apart.
    pair = positions([(0, 0), (0, 2)], 0.2)
    assert fit_grid(pair, names(2)).cells[1, 1] == 1
    assert fit_grid(pair, names(2), pitch_m=0.2).cells[1, 1] == 2


def test_deviating_landmarks_are_named() -> None:
    at = positions([(0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (1, 2)], 0.2)
    at[4, 1] += 0.03
    at[2, 0] += 0.016
    with pytest.raises(InputError, match=r"p4 is .* mm off the grid of 200 mm"):
        fit_grid(at, names(6), pitch_m=0.2)
    with pytest.raises(InputError, match="no grid"):
        fit_grid(at, names(6))
    result = fit_grid(at, names(6), tolerance_m=0.04)
    assert result.cells[4].tolist() == [1, 1]
    for wrong, words in (
        ({"tolerance_m": 0.06, "pitch_m": 0.2}, "tolerance of 60 mm is too large"),
        ({"pitch_m": 5e-5, "tolerance_m": 1e-6}, "more than 2000 per side"),
    ):
        with pytest.raises(InputError, match=words):
            fit_grid(at, names(6), **wrong)
    with pytest.raises(InputError, match="no landmarks"):
        fit_grid([], [])


def test_a_rotated_survey_has_no_grid() -> None:
    at = positions([(r, c) for r in range(10) for c in range(10)], 0.2)
    rotation = np.deg2rad(3)
    rotated = at @ np.array(
        [[np.cos(rotation), np.sin(rotation)], [-np.sin(rotation), np.cos(rotation)]]
    )
    with pytest.raises(InputError):
        fit_grid(rotated, names(len(at)))


def test_poses_are_as_built() -> None:
    floor = FloorMap(
        np.array([[5, HOLE_CODE], [7, 1]]),
        origin_m=(1.0, 2.0),
        built={(1, 0): AsBuiltLandmark(0.003, -0.002, 0.1, signs(7), np.full(7, np.nan))},
    )
    expected = [(1, 2, 0), (1.003, 2.198, 0.1), (1.2, 2.2, 0)]
    np.testing.assert_allclose(as_built_poses(floor), expected, atol=1e-15)
    back = floor_from_poses([5, 7, 1], as_built_poses(floor), names(3), pitch_m=0.2)
    np.testing.assert_array_equal(back.codes, floor.codes)
    np.testing.assert_allclose(as_built_poses(back), expected, atol=1e-12)
