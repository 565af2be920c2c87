"""The paper's method, on the planes the paper believes in: exactly 30 degrees, no more."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError
from locatk.core.geometry import umeyama
from locatk.core.lighthouse.light_planes import paper_image_points
from locatk.core.lighthouse.published import scene as paper
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


def off(found: Array, true: Array) -> float:
    """Largest error after the best similarity."""
    return float(np.max(np.linalg.norm(umeyama(found, true).apply(found) - true, axis=1)))


def same_poses(scene: paper.PaperScene, lamps: Any, found: Array, points: Array) -> None:
    """The stations stand where the points say they stand."""
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
    assert off(found, points) < 1e-3
    same_poses(scene, lamps, found, points)


@pytest.mark.parametrize("channels", PAIRS)
def test_two_stations_in_space(world: Any, channels: tuple[int, int]) -> None:
    lamps = ideal(world, *channels)
    points = world.curve(60, flat=False)
    image = image_of(lamps, points)
    scene = paper.two_3d(image)
    found = scene.locate(image)
    assert off(found, points) < 1e-3
    same_poses(scene, lamps, found, points)


def test_equation_6_to_10_are_a_decomposition(world: Any) -> None:
    # The rotation that the paper's equations give is one of OpenCV's four.
    lamps = ideal(world, 2, 16)
    image = image_of(lamps, world.curve(60, flat=True))
    scene = paper.two_planar(image)
    h, _ = cv2.findHomography(image[:, 0], image[:, 1])
    _, turns, _, _ = cv2.decomposeHomographyMat(h, np.eye(3))
    ours = paper.TO_STATION.T @ scene.stations[1][1].T @ paper.TO_STATION
    assert min(np.abs(ours - turn).max() for turn in turns) < 1e-4


def test_unseen_places_stay_unseen(world: Any) -> None:
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
def test_too_few_places_are_refused(world: Any, kind: str, drive: str) -> None:
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


def test_a_distance_nobody_saw_is_refused(world: Any) -> None:
    lamps = ideal(world, 2, 16)
    recording = world.drive(lamps, world.curve(60, flat=True))
    seen = MarkerVisit("robot", int(recording.time_ns[0]), int(recording.time_ns[3]))
    scene = Scene(distances=(Distance(seen, MarkerVisit("robot", 0, 1), 1.0),))
    with pytest.raises(DegenerateError, match="distance") as refused:
        solve(recording.sweeps, scene, SolveOptions(method="paper", scene="two-planar"))
    assert refused.value.hint


def test_the_paper_must_be_told_of_the_plane(world: Any) -> None:
    lamps = ideal(world, 2, 16)
    recording = world.drive(lamps, world.curve(100, flat=True))
    solution = solve(recording.sweeps, None, SolveOptions(method="paper"))
    assert any("planar" in each.message for each in solution.warnings)
    assert any("unit scale" in each.message for each in solution.warnings)
    first, second = (s.position for s in solution.artifact.stations)
    assert np.linalg.norm(second - first) == pytest.approx(1, abs=1e-3)


def test_real_planes_cost_the_paper_centimetres(world: Any) -> None:
    # Why the default method exists: planes of real units lean by 27 degrees.
    lamps = world.lamps(2, 16)
    recording = world.drive(lamps, world.curve(100, flat=False))
    errors = {}
    for method in ("paper", "bundle"):
        options = SolveOptions(method=method, scene="two-3d")
        (track,) = solve(recording.sweeps, None, options).trajectories
        errors[method] = off(track.position, recording.points)
    assert errors["paper"] > 0.02
    assert errors["bundle"] < 0.5 * errors["paper"]
