"""The paper's method, on the planes that the paper assumes: undistorted, at 30 degrees."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import combinations
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError
from locatk.core.geometry import umeyama
from locatk.core.lighthouse.channels import period_counts
from locatk.core.lighthouse.published import scene as paper
from locatk.core.lighthouse.published.scene import paper_image_points
from locatk.core.lighthouse.scene import Distance, MarkerVisit, Scene
from locatk.core.lighthouse.solver import SolveOptions, solve

Array = NDArray[np.float64]

PAIRS = list(combinations((1, 2, 5, 16), 2))


def ideal(world: Any, *channels: int) -> Any:
    planes = (world.Plane(), world.Plane())
    return tuple(replace(lamp, planes=planes) for lamp in world.lamps(*channels))


def image_of(lamps: Any, points: Array) -> Array:
    return np.stack(
        [paper_image_points(s.counts(s.angles(points)), s.channel) for s in lamps], axis=1
    )


def largest_error(found: Array, true: Array) -> float:
    """Return the largest position error after alignment by a similarity."""
    return float(np.max(np.linalg.norm(umeyama(found, true).apply(found) - true, axis=1)))


def assert_poses(scene: paper.PaperScene, lamps: Any, found: Array, points: Array) -> None:
    """Check the poses of the stations in the frame of the true points."""
    to = umeyama(found, points)
    for lamp, (position, rotation) in zip(lamps, scene.stations, strict=True):
        np.testing.assert_allclose(to.apply(position), lamp.position, atol=5e-3)
        np.testing.assert_allclose(to.rotation @ rotation, lamp.rotation, atol=5e-3)


def test_one_station_is_a_homography(world: Any) -> None:
    lamps = ideal(world, 1)
    points = world.curve(40, flat=True)
    scene = paper.one_planar(world.square[:, :2], image_of(lamps, world.square)[:, 0])
    np.testing.assert_allclose(scene.locate(image_of(lamps, points)), points, atol=1e-5)
    assert scene.stations == ()


@pytest.mark.parametrize("channels", PAIRS)
def test_two_stations_over_a_plane(world: Any, channels: tuple[int, int]) -> None:
    lamps = ideal(world, *channels)
    points = world.curve(60, flat=True)
    image = image_of(lamps, points)
    scene = paper.two_planar(image)
    found = scene.locate(image)
    assert largest_error(found, points) < 1e-3
    assert_poses(scene, lamps, found, points)


@pytest.mark.parametrize("channels", PAIRS)
def test_two_stations_in_space(world: Any, channels: tuple[int, int]) -> None:
    lamps = ideal(world, *channels)
    points = world.curve(60, flat=False)
    image = image_of(lamps, points)
    scene = paper.two_3d(image)
    found = scene.locate(image)
    assert largest_error(found, points) < 1e-3
    assert_poses(scene, lamps, found, points)


def test_equations_6_to_10_decompose_the_homography(world: Any) -> None:
    # The rotation that the paper's equations give is one of OpenCV's four.
    lamps = ideal(world, 2, 16)
    image = image_of(lamps, world.curve(60, flat=True))
    scene = paper.two_planar(image)
    h, _ = cv2.findHomography(image[:, 0], image[:, 1])
    _, turns, _, _ = cv2.decomposeHomographyMat(h, np.eye(3))
    ours = paper.TO_STATION.T @ scene.stations[1][1].T @ paper.TO_STATION
    assert min(np.abs(ours - turn).max() for turn in turns) < 1e-4


def test_a_plane_behind_the_second_camera_is_not_selected() -> None:
    image = np.tile([[[0.0, -0.5]]], (5, 2, 1))
    # Both planes are below the cameras, the first one more so, but behind the second camera.
    behind = (np.array([0.0, -1.0, 0.0]), np.eye(3), np.array([0.0, 0.0, 5.0]))
    ahead = (np.array([0.0, -0.8, 0.6]), np.eye(3), np.zeros(3))
    for candidates in ([behind, ahead], [ahead, behind]):
        normal, _, _ = paper._select_candidate(candidates, image, 1.0)
        np.testing.assert_array_equal(normal, ahead[0])


def test_missing_points_have_no_position(world: Any) -> None:
    lamps = ideal(world, 1, 5)
    image = image_of(lamps, world.curve(30, flat=False))
    scene = paper.two_3d(image)
    image[3, 1] = np.nan
    found = scene.locate(image)
    assert np.isnan(found[3]).all()
    assert np.isfinite(np.delete(found, 3, axis=0)).all()


def test_three_markers_are_refused(world: Any) -> None:
    image = image_of(ideal(world, 1), world.square)[:, 0]
    with pytest.raises(DegenerateError) as refused:
        paper.one_planar(world.square[:3, :2], image[:3])
    assert refused.value.hint
    with pytest.raises(DegenerateError):
        paper.one_planar(np.zeros((4, 2)), np.tile(image[:1], (4, 1)))


@pytest.mark.parametrize("kind", ["two-planar", "two-3d"])
@pytest.mark.parametrize("drive", ["still", "three places"])
def test_too_few_positions_are_refused(world: Any, kind: str, drive: str) -> None:
    places = world.curve(3 if drive == "three places" else 1, flat=True)
    recording = world.drive(world.lamps(1, 2), np.repeat(places, 30, axis=0))
    with pytest.raises(DegenerateError) as refused:
        solve(recording.sweeps, None, SolveOptions(method="paper", scene=kind))
    assert refused.value.hint


@pytest.mark.parametrize("flat", [True, False])
def test_a_session_is_solved_as_the_paper_does(world: Any, flat: bool) -> None:
    lamps = ideal(world, 2, 16)
    recording = world.drive(lamps, world.curve(100, flat=flat), noise_rad=1e-5)
    markers = world.markers_of(lamps, world.square)
    kind = "two-planar" if flat else "two-3d"
    solution = solve(
        recording.sweeps, Scene(markers=markers), SolveOptions(method="paper", scene=kind)
    )
    (track,) = solution.trajectories
    assert solution.method == "paper"
    assert len(track) == 100
    np.testing.assert_allclose(track.position, recording.points, atol=5e-3)
    assert np.isnan(track.covariance).all()  # the paper knows no uncertainty
    for lamp, station in zip(lamps, solution.artifact.stations, strict=True):
        assert station.calibration.source == "none"
        np.testing.assert_allclose(station.position, lamp.position, atol=0.02)


def test_an_unobserved_distance_is_refused(world: Any) -> None:
    lamps = ideal(world, 2, 16)
    recording = world.drive(lamps, world.curve(60, flat=True))
    seen = MarkerVisit("robot", int(recording.time_ns[0]), int(recording.time_ns[3]))
    scene = Scene(distances=(Distance(seen, MarkerVisit("robot", 0, 1), 1.0),))
    with pytest.raises(DegenerateError, match="distance") as refused:
        solve(recording.sweeps, scene, SolveOptions(method="paper", scene="two-planar"))
    assert refused.value.hint


def test_an_unknown_kind_of_scene_is_assumed_planar(world: Any) -> None:
    lamps = ideal(world, 2, 16)
    recording = world.drive(lamps, world.curve(100, flat=True))
    solution = solve(recording.sweeps, None, SolveOptions(method="paper"))
    assert "plane_assumed" in {w.code for w in solution.warnings}
    assert "unit_scale" in {w.code for w in solution.warnings}
    first, second = (s.position for s in solution.artifact.stations)
    assert np.linalg.norm(second - first) == pytest.approx(1, abs=1e-3)


def test_real_planes_cost_the_paper_centimetres(world: Any) -> None:
    # The reason for the default method: planes of real units are tilted by 27 degrees.
    lamps = world.lamps(2, 16)
    recording = world.drive(lamps, world.curve(100, flat=False))
    errors = {}
    for method in ("paper", "bundle"):
        options = SolveOptions(method=method, scene="two-3d")
        (track,) = solve(recording.sweeps, None, options).trajectories
        errors[method] = largest_error(track.position, recording.points)
    assert errors["paper"] > 0.02
    assert errors["bundle"] < 0.5 * errors["paper"]


# ---- image points

POINTS = np.array(
    [
        (1.0, 0.0, 0.0), (2.0, 0.7, 0.3), (2.0, -0.7, 0.3), (1.5, 0.9, -0.8), (3.0, -2.4, -0.1),
        (0.4, 0.3, 0.35), (5.0, 0.0, -2.0),
    ]
)  # fmt: skip


@pytest.mark.parametrize(
    ("channel", "expected"),
    [
        # PyDotBot, calculate_camera_point(49341, 85887, poly 1)
        (1, (-0.4255775370509014, 0.15468717476270966)),
        # dotbot-lh2-calibration, calculate_camera_point(49341, 85887, index 1), from 0
        (2, (-0.43435315273542, 0.1512338330873567)),
    ],
)
def test_paper_image_is_dotbots_but_for_the_cosine(
    channel: int, expected: tuple[float, float]
) -> None:
    counts = np.array([49341.0, 85887.0])
    x, y = paper_image_points(counts, channel)
    assert x == pytest.approx(expected[0], abs=1e-12)
    # Theirs has no 1/cos(theta); theta is half a revolution straight ahead.
    theta = 2 * np.pi * counts.mean() / period_counts(channel)
    assert y * math.cos(theta) == pytest.approx(expected[1], abs=1e-12)


def test_paper_image_is_the_ray_of_ideal_planes(world: Any) -> None:
    # x right, y up; one factor 1/cos: a point above the axis keeps its height at the side.
    ideal = (world.Plane(), world.Plane())
    for channel in (1, 16):
        lamp = world.Lamp(channel, np.zeros(3), np.eye(3), ideal)
        counts = lamp.counts(lamp.angles(POINTS))
        image = paper_image_points(counts, channel)
        expected = np.c_[-POINTS[:, 1], POINTS[:, 2]] / POINTS[:, :1]
        np.testing.assert_allclose(image, expected, atol=1e-9)
