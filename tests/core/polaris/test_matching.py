"""Laying the grid over magnets that were seen, built here without the tag's own geometry."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike, NDArray

from locatk.core.polaris.identification.matching import apply_scale, match_tags, refit_match
from locatk.core.polaris.magnets import DetectedMagnets
from locatk.core.polaris.tag import Tags

Array = NDArray[np.float64]

TAGS = Tags()
CELLS = ((0, 0), (1, 1), (0, 2), (1, 2), (2, 2))


def magnet_positions(
    cells: tuple[tuple[int, int], ...],
    pose: tuple[float, float, float] = (0.0, 0.0, 0.0),
    *,
    order: int = 3,
    spacing: float = 0.04,
) -> Array:
    """Places of a tag's magnets, in complex numbers: columns to the right, rows ahead."""
    x, y, heading = pose
    half = (order - 1) / 2
    ahead = np.exp(1j * heading)
    z = [x + 1j * y + ahead * spacing * ((r - half) - 1j * (c - half)) for c, r in cells]
    return np.column_stack([np.real(z), np.imag(z)])


def detected_magnets(
    positions: ArrayLike, *, free: bool = False, sigma: float = 2e-5
) -> DetectedMagnets:
    position = np.asarray(positions, float)
    m = len(position)
    return DetectedMagnets(
        time_ns=0,
        first=0,
        stop=101,
        path_m=np.linspace(-0.1, 0.1, 101),
        position_m=position,
        angle_rad=np.zeros(m),
        moment_am2=np.full(m, 1.8e-3),
        covariance=sigma**2 * np.eye(3 * m),
        path_sigma_m=np.full(101, sigma),
        is_path_estimated=free,
        residual_sigma=1.0,
    )


coordinate = st.floats(-0.2, 0.2)


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(
    coordinate, coordinate, st.floats(-3.1, 3.1), st.permutations(range(5)), st.integers(0, 1000)
)
def test_any_pose_in_any_order(
    x: float, y: float, heading: float, order: list[int], seed: int
) -> None:
    rng = np.random.default_rng(seed)
    positions = magnet_positions(CELLS, (x, y, heading))[order] + 2e-4 * rng.standard_normal((5, 2))
    best = match_tags(detected_magnets(positions), TAGS)[0]
    assert best.cells == CELLS
    assert [order[k] for k in best.magnets] == [0, 1, 2, 3, 4]
    assert abs(best.x_m - x) < 8e-4
    assert abs(best.y_m - y) < 8e-4
    assert abs(np.angle(np.exp(1j * (best.heading_rad - heading)))) < 0.02
    assert best.misfit_m < 6e-4


def test_every_assignment_is_enumerated() -> None:
    """Four magnets in a small square lie on the grid in many ways, three of the corners
    of the tag in one."""
    assert len(match_tags(detected_magnets(magnet_positions(((0, 0), (0, 2), (2, 2)))), TAGS)) == 1
    square = match_tags(detected_magnets(magnet_positions(((0, 0), (0, 1), (1, 0), (1, 1)))), TAGS)
    assert len({match.cells + match.magnets for match in square}) == len(square) > 4


def test_the_position_pattern_comes_first() -> None:
    """Turned by a quarter the same magnets would put one on the corner that stays empty."""
    for quarter in range(4):
        result = match_tags(
            detected_magnets(magnet_positions(CELLS, (0, 0, quarter * np.pi / 2))), TAGS
        )
        assert {match.cells for match in result} == {CELLS}
        rotated = result[0].heading_rad - quarter * np.pi / 2
        assert abs(np.angle(np.exp(1j * rotated))) < 1e-9


@pytest.mark.slow
def test_covariance_is_that_of_many_draws() -> None:
    """Of a tag whose magnets were set by hand, 0.4 mm each way, and measured well."""
    rng = np.random.default_rng(0)
    result = []
    for _ in range(150):
        positions = magnet_positions(CELLS, (0.01, -0.02, 0.5)) + 4e-4 * rng.standard_normal((5, 2))
        best = match_tags(detected_magnets(positions), TAGS)[0]
        result.append([best.x_m, best.y_m, best.heading_rad])
    ratio = np.std(result, axis=0) / np.sqrt(np.diag(best.covariance))
    assert np.all(ratio > 0.75)
    assert np.all(ratio < 1.25)


def test_worse_magnets_give_a_worse_pose() -> None:
    sure = match_tags(detected_magnets(magnet_positions(CELLS), sigma=1e-5), TAGS)[0]
    unsure = match_tags(detected_magnets(magnet_positions(CELLS), sigma=2e-3), TAGS)[0]
    off = match_tags(
        detected_magnets(
            magnet_positions(CELLS) + [[2e-3, 0], [0, -2e-3], [0, 0], [0, 2e-3], [-2e-3, 0]]
        ),
        TAGS,
    )[0]
    for other in (unsure, off):
        assert np.all(np.diag(other.covariance) > 2 * np.diag(sure.covariance))


def test_the_tag_scales_an_unknown_path() -> None:
    positions = magnet_positions(CELLS, (0.0, 0.01, 0.3))
    short = positions * [0.97, 1.0]
    best = match_tags(detected_magnets(short, free=True), TAGS)[0]
    assert best.scale == pytest.approx(1 / 0.97, abs=0.006)
    assert abs(best.heading_rad - 0.3) < 0.01
    assert match_tags(detected_magnets(positions), TAGS)[0].scale == pytest.approx(1.0, abs=1e-6)
    measured = apply_scale(detected_magnets(short, free=True), best)
    np.testing.assert_allclose(measured.position_m, positions, atol=4e-4)
    np.testing.assert_allclose(np.ptp(measured.path_m), 0.2 * best.scale)
    assert not measured.is_path_estimated


def test_as_built_places_are_used() -> None:
    nominal = magnet_positions(CELLS)
    real = nominal + 1e-3 * np.array([[1, 0], [0, 1], [-1, 0], [0.5, 1], [1, -1]])
    rotation, shift = np.array([[0.8, -0.6], [0.6, 0.8]]), np.array([0.03, 0.01])
    sighting = detected_magnets(real @ rotation.T + shift)
    best = match_tags(sighting, TAGS)[0]
    again = refit_match(sighting, TAGS, best, real)
    assert again.misfit_m < 1e-9 < best.misfit_m
    assert [again.x_m, again.y_m] == pytest.approx(shift, abs=1e-9)
    assert again.heading_rad == pytest.approx(np.arctan2(0.6, 0.8))


@pytest.mark.parametrize("spacing", [0.028, 0.055])
def test_another_grid_does_not_fit(spacing: float) -> None:
    for match in match_tags(detected_magnets(magnet_positions(CELLS, spacing=spacing)), TAGS):
        assert len(match.magnets) < 5 or match.misfit_m > 3e-3


@pytest.mark.parametrize("count", [0, 1])
def test_too_few_magnets_match_no_grid(count: int) -> None:
    assert match_tags(detected_magnets(magnet_positions(CELLS)[:count].reshape(-1, 2)), TAGS) == []


def test_larger_grids() -> None:
    tags = replace(TAGS, order=5, magnets=9, spacing_m=0.02)
    cells = ((0, 0), (2, 0), (1, 1), (4, 1), (0, 2), (3, 3), (0, 4), (2, 4), (4, 4))
    positions = magnet_positions(cells, (0.02, 0.0, 2.6), order=5, spacing=0.02)
    best = match_tags(detected_magnets(positions), tags)[0]
    assert best.cells == cells
    assert best.heading_rad == pytest.approx(2.6)


def test_apply_scale_rescales_the_covariance() -> None:
    """Across the track and of angles it stays; along the track it has the scale of the match."""
    magnets = detected_magnets(magnet_positions(CELLS, (0.05, 0.01, 0.3)) * [0.97, 1.0], free=True)
    match = match_tags(magnets, TAGS)[0]
    scaled = apply_scale(magnets, match)
    # Expected from the transform x' = s x and a prior-free scale of known variance.
    x = scaled.position_m[:, 0]
    own = np.diag(magnets.covariance)[0::3] * match.scale**2
    old_scale_variance = 1 / np.sum(x**2 / own)
    expected = np.diag(own) + (match.scale_sigma**2 - old_scale_variance) * np.outer(x, x)
    np.testing.assert_allclose(scaled.covariance[0::3, 0::3], expected, rtol=1e-9)
    for unchanged in (1, 2):
        np.testing.assert_array_equal(
            scaled.covariance[unchanged::3, unchanged::3],
            magnets.covariance[unchanged::3, unchanged::3],
        )
    known = replace(magnets, is_path_estimated=False)
    assert apply_scale(known, match) is known


def test_covariance_of_a_match_grows_with_its_misfit() -> None:
    """Beyond the prior of hand-built tags, the squares of the residuals scale it."""
    offset = np.array([[2.0, 0], [0, -2.0], [0, 0], [0, 2.0], [-2.0, 0]])
    sigma = []
    for size_m in (1e-6, 1e-3, 1.5e-3):
        match = match_tags(detected_magnets(magnet_positions(CELLS) + size_m * offset), TAGS)[0]
        sigma.append(np.sqrt(np.diag(match.covariance)))
    ratio = sigma[2] / sigma[1]
    np.testing.assert_allclose(ratio, 1.5, rtol=0.05)
    assert np.all(sigma[1] > 2 * sigma[0])


def test_a_known_path_has_no_scale() -> None:
    match = match_tags(detected_magnets(magnet_positions(CELLS) * [0.98, 1.0]), TAGS)[0]
    assert match.scale == pytest.approx(1.0, abs=1e-6)
    assert match.scale_sigma < 2e-6 * 10


def test_magnets_of_other_tags_are_not_used() -> None:
    positions = np.vstack([magnet_positions(CELLS), magnet_positions(CELLS, (0.2, 0.0, 1.0))])
    match = match_tags(detected_magnets(positions), TAGS, used=frozenset(range(5)))[0]
    assert set(match.magnets) == set(range(5, 10))


def test_equivalent_placements_keep_their_order() -> None:
    """Rounding does not decide: two magnets fit many pairs of cells equally well."""
    positions = magnet_positions(((0, 0), (1, 1)), (0.01, 0.0, 0.2))
    first = match_tags(detected_magnets(positions), TAGS)
    again = match_tags(detected_magnets(positions * (1 + 1e-15)), TAGS)
    assert [m.cells for m in first] == [m.cells for m in again]


def test_a_magnet_on_the_empty_corner_is_not_assigned() -> None:
    for match in match_tags(detected_magnets(magnet_positions((*CELLS, (2, 0)))), TAGS):
        assert (2, 0) not in match.cells
