"""One station over a floor: the homography from rays to the floor."""

from __future__ import annotations

import warnings
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError
from locatk.core.lighthouse.calibration import GENERIC_CALIBRATION, ideal_angles, predict_angles
from locatk.core.lighthouse.light_planes import rays as rays_of
from locatk.core.lighthouse.localization.positions import estimate_floor_positions
from locatk.core.lighthouse.scene.registration import fit_floor_homography

Array = NDArray[np.float64]


@pytest.fixture
def lamp(world: Any) -> Any:
    return world.lamps(1)[0]


def seen(lamp: Any, points: Array) -> Array:
    return rays_of(
        ideal_angles(lamp.angles(points), GENERIC_CALIBRATION), GENERIC_CALIBRATION.tilts
    )


def mapped(floor_map: Array, rays: Array) -> Array:
    moved = rays @ floor_map.T
    return np.asarray(moved[:, 1:] / moved[:, :1])


def test_four_markers_are_met_exactly(world: Any, lamp: Any) -> None:
    rays = seen(lamp, world.square)
    floor_map = fit_floor_homography(world.square[:, :2], rays)
    np.testing.assert_allclose(mapped(floor_map, rays), world.square[:, :2], atol=1e-9)
    theirs, _ = cv2.findHomography(rays[:, 1:], world.square[:, :2])
    other = world.curve(30, flat=True)
    image = np.c_[seen(lamp, other)[:, 1:], np.ones(30)] @ theirs.T
    np.testing.assert_allclose(
        mapped(floor_map, seen(lamp, other)), image[:, :2] / image[:, 2:], atol=1e-7
    )


def test_it_takes_up_what_calibration_leaves(world: Any, lamp: Any) -> None:
    # The station is another unit than the mean; the floor within the markers is right
    # to a millimetre all the same.
    floor_map = fit_floor_homography(world.square[:, :2], seen(lamp, world.square))
    inside = world.curve(60, flat=True, size=0.45)
    error = np.linalg.norm(mapped(floor_map, seen(lamp, inside)) - inside[:, :2], axis=1)
    assert error.mean() < 1e-3
    assert error.max() < 2.5e-3


def test_more_markers_outvote_a_wrong_one(world: Any, lamp: Any) -> None:
    places = np.array([[x, y, 0.0] for x in (-0.6, 0, 0.6) for y in (-0.6, 0, 0.6)])
    rays = seen(lamp, places)
    known = places[:, :2].copy()
    known[4] += [0.2, -0.1]  # measured badly
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        floor_map = fit_floor_homography(known, rays)
    good = np.delete(np.arange(9), 4)
    np.testing.assert_allclose(mapped(floor_map, rays)[good], places[good, :2], atol=2e-3)
    np.testing.assert_allclose(mapped(floor_map, rays)[4], places[4, :2], atol=2e-3)


def test_the_answer_does_not_hang_on_the_origin(world: Any, lamp: Any) -> None:
    # Last entry of the homography zero: the scale must not be put there.
    places = np.array([[x, y, 0.0] for x in (-0.6, 0, 0.6) for y in (-0.6, 0, 0.6)])
    rays = seen(lamp, places)
    for shift in ([0.0, 0.0], [40.0, -30.0], [-2.6, -1.1]):
        floor_map = fit_floor_homography(places[:, :2] + shift, rays)
        np.testing.assert_allclose(mapped(floor_map, rays) - shift, places[:, :2], atol=2e-3)


@pytest.mark.parametrize("kind", ["same", "line", "three on a line"])
def test_markers_that_fix_nothing_are_refused(kind: str, world: Any, lamp: Any) -> None:
    places = {
        "same": np.zeros((5, 3)),
        "line": np.linspace([-0.5, -0.3, 0], [0.5, 0.4, 0], 5),
        "three on a line": np.array([[0.0, 0, 0], [0.4, 0, 0], [0.8, 0, 0], [0.2, 0.6, 0]]),
    }[kind]
    with pytest.raises(DegenerateError) as refused:
        fit_floor_homography(places[:, :2], seen(lamp, places))
    assert refused.value.hint


def test_positions_and_their_covariance(world: Any, lamp: Any) -> None:
    floor_map = fit_floor_homography(world.square[:, :2], seen(lamp, world.square))
    places = world.curve(6, flat=True, size=0.4)
    rng = np.random.default_rng(0)
    sigma = 2e-4
    angles = lamp.angles(places)
    draws = angles[:, None] + rng.normal(0, sigma, (6, 3000, 2))
    estimates = estimate_floor_positions(
        draws.reshape(-1, 1, 2), GENERIC_CALIBRATION, floor_map, 0.03
    )
    position = estimates.position.reshape(6, 3000, 3)
    np.testing.assert_array_equal(position[..., 2], 0.03)
    stated = estimates.covariance(sigma, True).reshape(6, 3000, 3, 3)[:, 0]
    for k in range(6):
        spread = np.cov(position[k, :, :2].T)
        np.testing.assert_allclose(stated[k, :2, :2], spread, rtol=0.15, atol=0.05 * spread.max())
        assert stated[k, 2, 2] == 0
    assert np.all(estimates.redundancy == 0)
    assert np.all(estimates.residual == 0)


def test_an_unseen_plane_gives_no_place(world: Any, lamp: Any) -> None:
    floor_map = fit_floor_homography(world.square[:, :2], seen(lamp, world.square))
    angles = lamp.angles(world.square)[:, None]
    angles[0, 0, 1] = np.nan
    angles[1] = np.nan
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        estimates = estimate_floor_positions(angles, GENERIC_CALIBRATION, floor_map, 0.0)
        estimates.covariance(1e-4, True)
    assert np.isnan(estimates.position[:2]).all()
    assert np.isfinite(estimates.position[2:]).all()
    assert estimates.redundancy.tolist() == [-1, -2, 0, 0]


def test_generic_planes_are_what_the_map_was_fitted_to(lamp: Any) -> None:
    # The map goes with the calibration it was fitted with: predicted and corrected agree.
    ray = np.array([[1.0, 0.2, -0.4]])
    corrected = ideal_angles(predict_angles(ray, GENERIC_CALIBRATION), GENERIC_CALIBRATION)
    np.testing.assert_allclose(rays_of(corrected, GENERIC_CALIBRATION.tilts), ray, atol=1e-7)
