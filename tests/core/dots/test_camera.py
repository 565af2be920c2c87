"""The lens model and its inverse undo each other."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from locatk.core.dots.camera import Camera

coordinates = st.floats(-600, 800, allow_nan=False)


@st.composite
def cameras(draw: st.DrawFn) -> Camera:
    size = (draw(st.integers(16, 640)), draw(st.integers(16, 480)))
    centre = (draw(st.floats(0, size[0] - 1)), draw(st.floats(0, size[1] - 1)))
    return Camera(size, draw(st.floats(50, 2000)), centre, draw(st.floats(-0.9, 0.9)))


@pytest.mark.slow
@given(cameras(), st.lists(st.tuples(coordinates, coordinates), min_size=1, max_size=8))
@settings(max_examples=60, deadline=None)
def test_distort_undoes_undistort(camera: Camera, where: list[tuple[float, float]]) -> None:
    points = np.array(where)
    offset = points - camera.centre_px
    # One distorted point for each ideal one: as far as |k| r^2 < 1.
    bent = np.abs(camera.radial_px) * (offset**2).sum(axis=1)
    points = points[bent < 0.95]
    np.testing.assert_allclose(
        camera.distort(camera.undistort(points)), points, rtol=1e-7, atol=1e-6
    )


@pytest.mark.slow
@given(cameras(), st.lists(st.tuples(coordinates, coordinates), min_size=1, max_size=8))
@settings(max_examples=60, deadline=None)
def test_undistort_undoes_distort(camera: Camera, where: list[tuple[float, float]]) -> None:
    points = np.array(where)
    offset = points - camera.centre_px
    points = points[4 * camera.radial_px * (offset**2).sum(axis=1) < 0.95]
    np.testing.assert_allclose(
        camera.undistort(camera.distort(points)), points, rtol=1e-6, atol=1e-5
    )


def test_equation_2_in_numbers() -> None:
    camera = Camera((188, 120), 200.0, (93.5, 59.5), -0.4)
    assert camera.radial_px == pytest.approx(-1e-5)
    # 100 px to the right of the centre: 100 / (1 - 1e-5 * 100^2) = 100 / 0.9.
    result = camera.undistort(np.array([[193.5, 59.5], [93.5, 59.5], [93.5, -0.5]]))
    expected = [[93.5 + 100 / 0.9, 59.5], [93.5, 59.5], [93.5, 59.5 - 60 / (1 - 0.036)]]
    np.testing.assert_allclose(result, expected)


def test_barrel_draws_the_corners_in() -> None:
    corner = np.array([187.0, 119.0])
    centre = np.array([93.5, 59.5])
    for radial, nearer in ((-0.3, True), (0.3, False)):
        camera = Camera((188, 120), 219.0, (93.5, 59.5), radial)
        observed = camera.distort(corner)
        assert (np.linalg.norm(observed - centre) < np.linalg.norm(corner - centre)) is np.bool_(
            nearer
        )


def test_no_lens_changes_nothing_whatever_the_shape() -> None:
    camera = Camera((64, 48), 100.0, (30.0, 20.0))
    for shape in ((2,), (0, 2), (5, 2), (3, 4, 2)):
        points = np.random.default_rng(0).uniform(0, 60, shape)
        for moved in (camera.distort(points), camera.undistort(points)):
            assert moved.shape == shape
            np.testing.assert_allclose(moved, points)


def test_points_without_distorted_image_are_nan() -> None:
    camera = Camera((188, 120), 100.0, (0.0, 0.0), 0.25)
    # r / (1 + k r^2) has its largest value, 1 / (2 sqrt(k)) = 1 focal length, at r = 2.
    result = camera.distort(np.array([[99.0, 0.0], [101.0, 0.0]]))
    assert np.isfinite(result[0]).all()
    assert np.isnan(result[1]).any()
