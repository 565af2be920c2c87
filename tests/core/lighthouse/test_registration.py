"""A station from known points, with OpenCV as the judge."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError
from locatk.core.lighthouse.scene.registration import resect_in_space, resect_on_plane

Array = NDArray[np.float64]

TO_CV = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])


def rays_of(lamp: Any, points: Array) -> Array:
    seen = (points - lamp.position) @ lamp.rotation
    return np.asarray(seen / seen[:, :1])


def opencv_pose(points: Array, rays: Array) -> tuple[Array, Array]:
    """Position and rotation (station to points' frame) by ``cv2.solvePnP``."""
    image = np.ascontiguousarray((rays @ TO_CV.T)[:, None, :2])
    flag = cv2.SOLVEPNP_IPPE if np.ptp(points[:, 2]) == 0 else cv2.SOLVEPNP_EPNP
    _, turn, move = cv2.solvePnP(points, image, np.eye(3), None, flags=flag)
    turn, move = cv2.solvePnPRefineLM(points, image, np.eye(3), None, turn, move)
    to_camera = TO_CV.T @ cv2.Rodrigues(turn)[0]
    return -to_camera.T @ TO_CV.T @ move[:, 0], to_camera.T


def nearest(poses: list[tuple[Array, Array]], position: Array) -> tuple[Array, Array]:
    """The likely pose that is nearest to the known position."""
    return min(poses, key=lambda pose: float(np.linalg.norm(pose[0] - position)))


@pytest.mark.parametrize("channel", [1, 2, 5, 16])
def test_four_floor_points_fix_a_station(world: Any, channel: int) -> None:
    (lamp,) = world.lamps(channel)
    position, rotation = resect_on_plane(world.square[:, :2], rays_of(lamp, world.square))
    np.testing.assert_allclose(position, lamp.position, atol=1e-7)
    np.testing.assert_allclose(rotation, lamp.rotation, atol=1e-7)


@pytest.mark.parametrize("flat", [True, False])
@pytest.mark.parametrize("channel", [1, 16])
def test_noisy_points_give_what_opencv_gives(world: Any, channel: int, flat: bool) -> None:
    (lamp,) = world.lamps(channel)
    points = world.curve(60, flat=flat)
    rays = rays_of(lamp, points)
    rays[:, 1:] += np.random.default_rng(0).normal(0, 3e-4, (60, 2))
    if flat:
        position, rotation = resect_on_plane(points[:, :2], rays)
    else:
        position, rotation = nearest(resect_in_space(points, rays), lamp.position)
    theirs = opencv_pose(points, rays)
    # A linear start against a refined pose: within a centimetre at three metres.
    np.testing.assert_allclose(position, theirs[0], atol=0.015)
    np.testing.assert_allclose(rotation, theirs[1], atol=0.006)
    assert np.linalg.det(rotation) == pytest.approx(1)
    np.testing.assert_allclose(position, lamp.position, atol=0.015)


def test_six_points_in_space_fix_a_station(world: Any) -> None:
    (lamp,) = world.lamps(2)
    points = world.curve(7, flat=False)
    position, rotation = nearest(resect_in_space(points, rays_of(lamp, points)), lamp.position)
    np.testing.assert_allclose(position, lamp.position, atol=1e-4)
    np.testing.assert_allclose(rotation, lamp.rotation, atol=1e-4)


@pytest.mark.parametrize("lift", [0.0, 1e-4, 2e-3])
def test_places_of_a_tilted_plane_fix_a_station_too(world: Any, lift: float) -> None:
    # There the direct linear transform is free to turn; the plane is not.
    (lamp,) = world.lamps(2)
    points = world.curve(40, flat=True) @ world.look(np.zeros(3), np.array([1, 0.2, 0.3])).T
    points[:, 2] += lift * np.sin(np.arange(40) * 2.0) + 0.5
    position, rotation = nearest(resect_in_space(points, rays_of(lamp, points)), lamp.position)
    np.testing.assert_allclose(position, lamp.position, atol=0.02)
    np.testing.assert_allclose(rotation, lamp.rotation, atol=0.02)


@pytest.mark.parametrize("flat", [True, False])
@pytest.mark.parametrize("wrong", [3, 15])
def test_wrong_places_are_outvoted(world: Any, flat: bool, wrong: int) -> None:
    (lamp,) = world.lamps(5)
    points = world.curve(60, flat=flat)
    rays = rays_of(lamp, points)
    mirrored = points[:wrong] * [-1, 1, 1] + [0.3, 0.4, 0.2]
    rays[:wrong] = rays_of(lamp, mirrored)
    if flat:
        position, rotation = resect_on_plane(points[:, :2], rays)
    else:
        position, rotation = nearest(resect_in_space(points, rays), lamp.position)
    np.testing.assert_allclose(position, lamp.position, atol=1e-3)
    np.testing.assert_allclose(rotation, lamp.rotation, atol=1e-3)


def test_the_unit_is_that_of_the_points(world: Any) -> None:
    (lamp,) = world.lamps(5)
    for flat, resect in ((True, resect_on_plane), (False, resect_in_space)):
        points = world.curve(20, flat=flat)
        rays = rays_of(lamp, points)
        known = points[:, :2] if flat else points
        found = resect(1000 * known, rays)
        position = nearest(found if isinstance(found, list) else [found], 1000 * lamp.position)[0]
        np.testing.assert_allclose(position, 1000 * lamp.position, rtol=1e-5)


def test_a_floor_observed_from_below(world: Any) -> None:
    # Markers in a frame whose z points down: the station has negative z.
    (lamp,) = world.lamps(1)
    position, rotation = resect_on_plane(world.square[:, [1, 0]], rays_of(lamp, world.square))
    np.testing.assert_allclose(position, lamp.position[[1, 0, 2]] * [1, 1, -1], atol=1e-7)
    assert np.linalg.det(rotation) == pytest.approx(1)


@pytest.mark.parametrize(
    "points",
    [
        np.zeros((0, 2)),
        np.array([[0.0, 0.0], [1, 0], [1, 1]]),
        np.zeros((5, 2)),
        np.stack([np.linspace(-1, 1, 6), np.linspace(0.2, 0.9, 6)], axis=1),
    ],
    ids=["none", "three", "one place", "line"],
)
def test_too_little_is_refused_on_a_plane(points: Array, world: Any) -> None:
    rays = rays_of(world.lamps(1)[0], np.c_[points, np.zeros(len(points))])
    with pytest.raises(DegenerateError) as refused:
        resect_on_plane(points, rays)
    assert refused.value.hint


def test_three_of_four_on_a_line_are_refused(world: Any) -> None:
    points = np.array([[0.0, 0, 0], [0.5, 0, 0], [1, 0, 0], [0.3, 0.7, 0]])
    with pytest.raises(DegenerateError):
        resect_on_plane(points[:, :2], rays_of(world.lamps(1)[0], points))


@pytest.mark.parametrize("kind", ["five", "one place", "line"])
def test_too_little_is_refused_in_space(kind: str, world: Any) -> None:
    points = {
        "five": world.curve(5, flat=False),
        "one place": np.full((30, 3), 0.3),
        "line": np.linspace([0, 0, 0.1], [1, 0.5, 0.8], 20),
    }[kind]
    with pytest.raises(DegenerateError) as refused:
        resect_in_space(points, rays_of(world.lamps(1)[0], points))
    assert refused.value.hint
