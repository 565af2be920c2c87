"""Two views, with OpenCV as the judge.

OpenCV's image is x right, y down, z ahead; a station's rays are (1, y left, z up).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError
from locatk.core.lighthouse.calibration import GENERIC_CALIBRATION, MODEL_SIGMA_RAD, ideal_angles
from locatk.core.lighthouse.light_planes import rays as rays_of
from locatk.core.lighthouse.scene import two_view
from locatk.core.lighthouse.scene.bundle_adjustment import BundleAdjustment, BundleState

Array = NDArray[np.float64]

TO_CV = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""Station axes to OpenCV's."""


class Views:
    """Two stations over places, as rays without error, and the motion between them."""

    def __init__(self, world: Any, flat: bool, n: int = 60, channels: Any = (1, 2)) -> None:
        first, second = world.lamps(*channels)
        self.points = world.curve(n, flat=flat)
        a, b = ((self.points - s.position) @ s.rotation for s in (first, second))
        self.depths = a[:, 0], b[:, 0]
        self.a, self.b = a / a[:, :1], b / b[:, :1]
        self.rotation = second.rotation.T @ first.rotation
        self.translation = second.rotation.T @ (first.position - second.position)
        self.up = first.rotation.T @ [0.0, 0.0, 1.0]
        self.height = first.position[2]

    @property
    def image(self) -> tuple[Array, Array]:
        return (self.a @ TO_CV.T)[:, :2], (self.b @ TO_CV.T)[:, :2]


@pytest.fixture(params=[(1, 2), (2, 5), (5, 16)])
def flat(world: Any, request: pytest.FixtureRequest) -> Views:
    return Views(world, True, channels=request.param)


@pytest.fixture(params=[(1, 2), (2, 5), (5, 16)])
def space(world: Any, request: pytest.FixtureRequest) -> Views:
    return Views(world, False, channels=request.param)


def unit(h: Array) -> Array:
    h = h / np.linalg.norm(h)
    return h * np.sign(h.ravel()[np.argmax(np.abs(h))])


def test_homography_is_opencvs(flat: Views) -> None:
    noisy = flat.b + np.random.default_rng(0).normal(0, 1e-4, flat.b.shape) * [0, 1, 1]
    ours = TO_CV @ two_view.fit_homography(flat.a, noisy) @ TO_CV.T
    image_a, _ = flat.image
    theirs, _ = cv2.findHomography(image_a, (noisy @ TO_CV.T)[:, :2], 0)
    # OpenCV refines its direct transform: the two agree to the noise of the points.
    np.testing.assert_allclose(unit(ours), unit(theirs), atol=5e-4)
    exact = TO_CV @ two_view.fit_homography(flat.a, flat.b) @ TO_CV.T
    np.testing.assert_allclose(unit(exact), unit(cv2.findHomography(*flat.image, 0)[0]), atol=1e-8)


def test_homography_residual_is_a_distance_in_the_image(flat: Views) -> None:
    h = two_view.fit_homography(flat.a, flat.b)
    off = flat.b + [0.0, 3e-3, 4e-3]
    np.testing.assert_allclose(two_view.homography_residuals(h, flat.a, flat.b), 0, atol=1e-9)
    np.testing.assert_allclose(two_view.homography_residuals(h, flat.a, off), 5e-3, atol=1e-9)
    np.testing.assert_allclose(
        two_view.homography_residuals(-2.5 * h, 3 * flat.a, 0.1 * off), 5e-3, atol=1e-9
    )


def test_motions_behind_a_homography_are_opencvs(flat: Views) -> None:
    h = two_view.fit_homography(flat.a, flat.b)
    ours = two_view.decompose_homography(-3.7 * h)  # neither scale nor sign matters
    _, turns, moves, normals = cv2.decomposeHomographyMat(TO_CV @ h @ TO_CV.T, np.eye(3))
    assert len(ours) == len(turns) == 4
    for turn, move, normal in zip(turns, moves, normals, strict=True):
        back = TO_CV.T @ turn @ TO_CV, TO_CV.T @ move[:, 0], TO_CV.T @ normal[:, 0]
        # OpenCV's normal has unit length and its translation is that over the height; ours
        # puts the plane at normal . a = 1. The product is the same.
        assert any(
            np.allclose(r, back[0], atol=1e-6)
            and np.allclose(np.outer(t, n), np.outer(back[1], back[2]), atol=1e-6)
            for r, t, n in ours
        )


def test_one_motion_behind_a_homography_is_the_true_one(flat: Views) -> None:
    motions = two_view.decompose_homography(two_view.fit_homography(flat.a, flat.b))
    normal = -flat.up / flat.height
    assert any(
        np.allclose(r, flat.rotation, atol=1e-7)
        and np.allclose(np.outer(t, n), np.outer(flat.translation, normal), atol=1e-6)
        for r, t, n in motions
    )
    for rotation, _, _ in motions:
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
        assert np.linalg.det(rotation) == pytest.approx(1)


def test_every_motion_explains_the_homography(flat: Views) -> None:
    h = two_view.fit_homography(flat.a, flat.b)
    for r, t, n in two_view.decompose_homography(h):
        again = r + np.outer(t, n)
        np.testing.assert_allclose(unit(again), unit(h), atol=1e-9)


def test_stations_at_one_place_have_no_motion() -> None:
    turn = cv2.Rodrigues(np.array([0.1, -0.4, 0.2]))[0]
    assert two_view.decompose_homography(turn) == []


def test_essential_matrix_is_opencvs(space: Views) -> None:
    e = TO_CV @ two_view.fit_epipolar(space.a, space.b) @ TO_CV.T
    theirs, _ = cv2.findFundamentalMat(*space.image, cv2.FM_8POINT)
    np.testing.assert_allclose(unit(e), unit(theirs), atol=1e-6)
    true = np.cross(np.eye(3), space.translation) @ space.rotation
    np.testing.assert_allclose(unit(two_view.fit_epipolar(space.a, space.b)), unit(true), atol=1e-8)


def test_sampson_distance_is_that_of_opencv(space: Views) -> None:
    e = two_view.fit_epipolar(space.a, space.b)
    off = space.b + np.random.default_rng(0).normal(0, 3e-3, space.b.shape) * [0, 1, 1]
    ours = two_view.epipolar_residuals(e, space.a, off)
    e_cv = TO_CV @ e @ TO_CV.T
    theirs = [
        cv2.sampsonDistance(TO_CV @ a, TO_CV @ b, e_cv) for a, b in zip(space.a, off, strict=True)
    ]
    np.testing.assert_allclose(ours**2, theirs, rtol=1e-6)


def test_motions_behind_an_essential_matrix_are_opencvs(space: Views) -> None:
    e = two_view.fit_epipolar(space.a, space.b)
    ours = two_view.decompose_essential(e)
    assert len(ours) == 4
    turn_1, turn_2, move = cv2.decomposeEssentialMat(TO_CV @ e @ TO_CV.T)
    for turn in (turn_1, turn_2):
        for sign in (1, -1):
            r, t = TO_CV.T @ turn @ TO_CV, sign * TO_CV.T @ move[:, 0]
            assert any(
                np.allclose(p, r, atol=1e-6) and np.allclose(q, t, atol=1e-6) for p, q in ours
            )
    direction = space.translation / np.linalg.norm(space.translation)
    assert any(
        np.allclose(p, space.rotation, atol=1e-6) and np.allclose(q, direction, atol=1e-6)
        for p, q in ours
    )


def test_the_motion_with_points_in_front_agrees_with_opencv(space: Views) -> None:
    e = two_view.fit_epipolar(space.a, space.b)
    ahead = []
    for r, t in two_view.decompose_essential(e):
        depth, other = two_view.triangulate(space.a, space.b, r, t)
        if np.all(depth > 0) and np.all(other > 0):
            ahead.append((r, t))
    _, turn, move, _ = cv2.recoverPose(TO_CV @ e @ TO_CV.T, *space.image, np.eye(3))
    assert len(ahead) == 1
    np.testing.assert_allclose(ahead[0][0], TO_CV.T @ turn @ TO_CV, atol=1e-6)
    np.testing.assert_allclose(ahead[0][1], TO_CV.T @ move[:, 0], atol=1e-6)


def test_triangulation_finds_the_depths(space: Views) -> None:
    depth, other = two_view.triangulate(space.a, space.b, space.rotation, space.translation)
    np.testing.assert_allclose(depth, space.depths[0], rtol=1e-9)
    np.testing.assert_allclose(other, space.depths[1], rtol=1e-9)


def test_parallel_rays_have_no_depth() -> None:
    ray = np.array([[1.0, 0.1, 0.2]])
    depth, _ = two_view.triangulate(ray, ray, np.eye(3), np.array([0.0, 1.0, 0.0]))
    assert not np.isfinite(depth[0]) or abs(depth[0]) > 1e6


@pytest.mark.parametrize("n", [40, 400])
def test_consensus_selects_the_inliers(world: Any, n: int) -> None:
    rng = np.random.default_rng(n)
    wrong = rng.random(n) < 0.25
    for is_flat, agree in (
        (True, two_view.estimate_homography),
        (False, two_view.estimate_epipolar),
    ):
        views = Views(world, is_flat, n)
        b = views.b + rng.normal(0, 3e-4, views.b.shape) * [0, 1, 1]
        b[wrong, 1:] += rng.uniform(0.1, 0.4, (np.count_nonzero(wrong), 2)) * rng.choice([-1, 1])
        _, agreed = agree(views.a, b)
        assert agreed[~wrong].all()
        # A ray that slips along its own epipolar line shows nothing.
        assert np.count_nonzero(agreed[wrong]) <= (0 if is_flat else 0.25 * wrong.sum())


def test_upright_motions_are_near_the_true_one(world: Any) -> None:
    first, second = world.lamps(1, 2)
    points = world.curve(9, flat=False)
    level = [
        world.look(s.position, s.position + s.rotation[:, 0] * [1, 1, 0]) for s in (first, second)
    ]
    a, b = ((points - s.position) @ r for s, r in zip((first, second), level, strict=True))
    rotation = level[1].T @ level[0]
    direction = level[1].T @ (first.position - second.position)
    direction /= np.linalg.norm(direction)
    found = two_view.upright_motions(a / a[:, :1], b / b[:, :1], headings=720)
    best = min(
        np.degrees(np.arccos(np.clip((np.trace(r.T @ rotation) - 1) / 2, -1, 1)))
        + np.degrees(np.arccos(np.clip(t @ direction, -1, 1)))
        for r, t in found
    )
    assert best < 3


# ---- decisions


def estimated_kind(world: Any, floor_fraction: float) -> bool:
    """Whether a scene with this fraction of its keyframes on a floor is taken as planar."""
    lamps = world.lamps(1, 2)
    points = world.curve(200, flat=False)
    points[: int(200 * floor_fraction), 2] = 0.0
    angles = np.stack([lamp.angles(points) for lamp in lamps], axis=1)
    angles += np.random.default_rng(0).normal(0, 1e-4, angles.shape)
    generic = (GENERIC_CALIBRATION,) * 2
    rays = np.stack(
        [rays_of(ideal_angles(angles[:, k], c), c.tilts) for k, c in enumerate(generic)], axis=1
    )
    pair = two_view.estimate_station_pair(angles, rays, generic, (0, 1), sigma=MODEL_SIGMA_RAD)
    assert pair.facts.plane_fraction == pytest.approx(floor_fraction, abs=0.12)
    return pair.planar


@pytest.mark.parametrize(("floor_fraction", "planar"), [(0.6, False), (0.97, True)])
def test_a_floor_has_most_keyframes_that_agree_in_space(
    world: Any, floor_fraction: float, planar: bool
) -> None:
    # With 60 % on one plane the median residual of the homography is that of a floor.
    assert estimated_kind(world, floor_fraction) is planar


def test_narrow_views_must_fit_a_plane_better() -> None:
    rng = np.random.default_rng(0)
    wide = np.c_[np.ones(50), rng.normal(0, 0.3, (50, 2))]
    narrow = np.c_[np.ones(50), rng.normal(0, 0.02, (50, 2))]
    assert two_view.is_plane_like(wide, wide, 2.9e-3)
    assert not two_view.is_plane_like(wide, wide, 3.1e-3)
    assert two_view.is_plane_like(narrow, narrow, 4e-4)
    assert not two_view.is_plane_like(narrow, narrow, 9e-4)
    # The narrower of two views decides.
    assert not two_view.is_plane_like(wide, narrow, 9e-4)


@pytest.mark.parametrize(("baseline", "is_refused"), [(0.01, True), (0.05, False)])
def test_stations_at_the_same_position_are_refused(
    world: Any, baseline: float, is_refused: bool
) -> None:
    """Their distance counts relative to that from the floor (two metres)."""
    (first,) = world.lamps(1)
    position = first.position + [0.0, 2.0 * baseline, 0.0]
    second = replace(
        first, channel=2, position=position, rotation=world.look(position, np.zeros(3), 0.1)
    )
    points = world.curve(80, flat=True)
    angles = np.stack([lamp.angles(points) for lamp in (first, second)], axis=1)
    calibrations = (GENERIC_CALIBRATION,) * 2
    rays = np.stack(
        [rays_of(ideal_angles(angles[:, k], GENERIC_CALIBRATION), GENERIC_CALIBRATION.tilts)
         for k in range(2)], axis=1
    )  # fmt: skip
    options = {"sigma": MODEL_SIGMA_RAD, "planar": True}
    if not is_refused:
        pair = two_view.estimate_station_pair(angles, rays, calibrations, (0, 1), **options)
        assert pair.planar
    else:
        with pytest.raises(DegenerateError, match="same position"):
            two_view.estimate_station_pair(angles, rays, calibrations, (0, 1), **options)


@pytest.mark.parametrize(("ratio", "by_markers"), [(0.4, True), (0.6, False)])
def test_markers_decide_if_they_clearly_prefer_one_candidate(
    world: Any, ratio: float, by_markers: bool
) -> None:
    first, second = world.lamps(1, 2)
    side = np.array([2.5, 0.6, 2.0]), np.array([2.5, 0.9, 2.4])
    lamps = [
        replace(lamp, position=position, rotation=world.look(position, np.zeros(3)))
        for lamp, position in zip((first, second), side, strict=True)
    ]
    points = world.curve(150, flat=True)
    angles = np.stack([lamp.angles(points) for lamp in lamps], axis=1)
    angles += np.random.default_rng(0).normal(0, 1e-4, angles.shape)
    calibrations = (GENERIC_CALIBRATION,) * 2
    rays = np.stack(
        [rays_of(ideal_angles(angles[:, k], GENERIC_CALIBRATION), GENERIC_CALIBRATION.tilts)
         for k in range(2)], axis=1
    )  # fmt: skip

    def misfit(state: Any, columns: tuple[int, int]) -> float:
        """Prefer the leaning candidate, against the roll of the stations."""
        assert columns == (0, 1)
        return ratio if np.abs(state.rotations[:, 2, 1]).max() > 0.2 else 1.0

    pair = two_view.estimate_station_pair(
        angles, rays, calibrations, (0, 1), sigma=MODEL_SIGMA_RAD, planar=True,
        marker_misfit=misfit,
    )  # fmt: skip
    assert (pair.facts.candidate_decided_by == "markers") is by_markers
    assert (np.abs(pair.state.rotations[:, 2, 1]).max() > 0.2) is np.bool_(by_markers)


@pytest.mark.parametrize(("cost", "chosen"), [(1.9, 1), (2.1, 0)])
def test_an_upright_candidate_must_explain_the_angles_about_as_well(
    monkeypatch: pytest.MonkeyPatch, cost: float, chosen: int
) -> None:
    """The second candidate has no roll, but a higher cost than the first."""
    roll = cv2.Rodrigues(np.array([0.3, 0.0, 0.0]))[0]
    refined = [
        BundleAdjustment(
            BundleState(
                np.zeros((2, 3)),
                np.stack([rotation] * 2),
                (GENERIC_CALIBRATION,) * 2,
                np.zeros((4, 3)),
            ),
            np.full((4, 2, 2), 1e-3),
            np.ones((4, 2, 2)),
            np.zeros((2, 10, 10)),
            5,
            each,
        )
        for rotation, each in ((roll, 1.0), (np.eye(3), cost))
    ]
    results = iter(refined)
    monkeypatch.setattr(two_view, "adjust_bundle", lambda *_, **__: next(results))
    candidates = [adjustment.state for adjustment in refined]
    best, figures, _ = two_view._choose_candidate(
        np.zeros((4, 2, 2)), candidates, True, 1e-3, None, (0, 1)
    )
    assert best is refined[chosen]
    assert [f.chosen for f in figures] == [chosen == 0, chosen == 1]
    assert [f.fits for f in figures] == [True, chosen == 1]
