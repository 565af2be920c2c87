"""The array's way over the floor, from tags that were read and from odometry."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.polaris import codec
from locatk.core.polaris.array import Samples
from locatk.core.polaris.detection.magnets import detect_magnets
from locatk.core.polaris.identification.tags import TagObservation, identify_pass
from locatk.core.polaris.localization import distance_along, localize
from locatk.core.polaris.preprocessing import find_passes, preprocess
from locatk.core.polaris.solver import solve
from locatk.core.polaris.tag import PlanarPose, TagLayout, Tags
from locatk.core.solution import Solution
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]

TAGS = Tags()
CELLS = ((0, 0), (1, 1), (0, 2), (1, 2), (2, 2))
SYMBOLS = ((0, 3, 5, 2, 6), (1, 7, 4, 4, 3), (2, 2, 0, 6, 1))
IDS = tuple(codec.id_of(TAGS, TagLayout(CELLS, symbols)) for symbols in SYMBOLS)
PLACES = ((0.0, 0.008, 0.4), (0.5, -0.012, 2.0), (1.0, 0.005, -1.3))
SITE = {i: PlanarPose(*position) for i, position in zip(IDS, PLACES, strict=True)}


def quaternions(heading: Array) -> Array:
    zero = np.zeros_like(heading)
    return np.column_stack([zero, zero, np.sin(heading / 2), np.cos(heading / 2)])


def headings(trajectory: Trajectory) -> Array:
    return 2 * np.arctan2(trajectory.quaternion[:, 2], trajectory.quaternion[:, 3])


def odometry(
    world: Any, course: Any, *, scale: float = 1.0, turn: float = 0.0, drift: float = 0.0
) -> Trajectory:
    """What wheels say: in a frame of their own, of another scale, drifting in heading."""
    t = np.arange(course.t[0], course.t[-1], 0.02)
    x, y, heading = course.at(t)
    own = heading + turn + drift * t
    step = scale * np.diff(x + 1j * y) * np.exp(1j * (turn + drift * t[:-1]))
    z = np.append(0, np.cumsum(step))
    return Trajectory(
        "bar",
        "odom",
        world.start_ns + np.rint(t * 1e9).astype(np.int64),
        np.column_stack([z.real, z.imag, 0 * t]),
        quaternions(own),
        np.full((len(t), 6, 6), np.nan),
    )


@pytest.fixture(scope="module")
def tour(world: Any) -> tuple[Any, Samples]:
    """A straight drive over three tags, turned by 0.02 rad against the floor's x."""
    tags = [
        world.Tag(CELLS, symbols, *position)
        for symbols, position in zip(SYMBOLS, PLACES, strict=True)
    ]
    course = world.line(length=1.3, past=(0.5, 0.0), direction=0.02)
    return course, world.record(tags, course, seed=11)


def truth(world: Any, course: Any, poses: Trajectory) -> Array:
    x, y, _ = course.at((poses.time_ns - world.start_ns) * 1e-9)
    return np.column_stack([x, y])


def only(solution: Solution) -> Trajectory:
    (poses,) = solution.trajectories
    return poses


def test_poses_on_the_site(world: Any, tour: tuple[Any, Samples]) -> None:
    course, recording = tour
    poses = only(solve([recording], replace(TAGS, site=SITE)))
    assert poses.frame == "site"
    assert poses.device == "bar"
    assert np.all(np.diff(poses.time_ns) > 0)
    error = poses.position[:, :2] - truth(world, course, poses)
    assert np.sqrt(np.mean(error**2)) < 2e-4
    assert np.abs(headings(poses) - 0.02).max() < 2e-3
    np.testing.assert_allclose(poses.position[:, 2], 0.01, atol=1e-4)
    z = error / poses.sigma[:, :2]
    assert np.abs(z).max() < 4
    # Over the tags, not between them.
    x = truth(world, course, poses)[:, 0]
    assert np.min(np.abs(x[:, None] - [0, 0.5, 1.0]), axis=1).max() < 0.11
    assert len(poses) > 300


@pytest.mark.slow
def test_an_unsure_heading_makes_places_away_from_the_tag_unsure(
    world: Any, tour: tuple[Any, Samples]
) -> None:
    """Variance across the track grows by that of the heading with the distance squared."""
    course, recording = tour
    poses = only(solve([recording], replace(TAGS, site={IDS[1]: SITE[IDS[1]]})))
    ahead = truth(world, course, poses)[:, 0] - SITE[IDS[1]].x_m
    assert np.ptp(ahead) > 0.1
    growth = np.polyfit(ahead, poses.covariance[:, 1, 1], 2)[0]
    assert growth == pytest.approx(np.median(poses.covariance[:, 5, 5]), rel=0.1)


@pytest.mark.slow
def test_without_a_site_the_first_tag_is_the_frame(world: Any, tour: tuple[Any, Samples]) -> None:
    course, recording = tour
    solution = solve([recording], TAGS)
    poses = only(solution)
    assert poses.frame == f"tag-{IDS[0]}"
    x, y, heading = PLACES[0]
    there = (truth(world, course, poses) @ [1, 1j] - (x + 1j * y)) * np.exp(-1j * heading)
    assert np.abs(poses.position[:, :2] @ [1, 1j] - there).max() < 6e-4
    assert np.abs(headings(poses) - (0.02 - heading)).max() < 2e-3
    for other in IDS[1:]:
        assert any(
            each.code == "tag_not_on_site" and str(other) in each.message
            for each in solution.warnings
        )


@pytest.mark.slow
def test_a_tag_outside_the_site_is_reported(tour: tuple[Any, Samples]) -> None:
    _, recording = tour
    known = {i: SITE[i] for i in IDS[:2]}
    solution = solve([recording], replace(TAGS, site=known))
    (warning,) = [each for each in solution.warnings if each.code == "tag_not_on_site"]
    assert f"tag {IDS[2]} has no position on the site" in warning.message
    assert solution.poses > 0


@pytest.mark.slow
@pytest.mark.parametrize(
    "off", [{}, {"scale": 1.02}, {"turn": 2.0}, {"scale": 0.98, "drift": 0.002}]
)
def test_odometry_joins_the_tags(
    off: dict[str, float], world: Any, tour: tuple[Any, Samples]
) -> None:
    course, recording = tour
    poses = only(
        solve([recording], replace(TAGS, site=SITE), odometry=[odometry(world, course, **off)])
    )
    t = (poses.time_ns - world.start_ns) * 1e-9
    assert np.all(np.diff(poses.time_ns) > 0)
    assert np.diff(t).max() < 0.05  # no gap is left between the tags
    error = poses.position[:, :2] - truth(world, course, poses)
    # 2 % of the 0.35 m between two tags, shared out between both ends.
    assert np.abs(error).max() < 3e-3
    assert np.abs(headings(poses) - 0.02).max() < 0.02
    z = error / poses.sigma[:, :2]
    assert np.sqrt(np.mean(z**2)) < 3


@pytest.mark.slow
def test_odometry_of_another_device_is_not_used(world: Any, tour: tuple[Any, Samples]) -> None:
    course, recording = tour
    other = replace(odometry(world, course, scale=3.0), device="other")
    with_other = only(solve([recording], replace(TAGS, site=SITE), odometry=[other]))
    alone = only(solve([recording], replace(TAGS, site=SITE)))
    np.testing.assert_array_equal(with_other.position, alone.position)


@pytest.mark.slow
def test_corrections_lead_to_the_next_tag(world: Any, tour: tuple[Any, Samples]) -> None:
    """Paper 8.3.7. Checked by driving them: turn, then go straight as far as is said."""
    course, recording = tour
    rotations = solve([recording], replace(TAGS, site=SITE)).facts.heading_corrections
    assert [(turn.from_tag, turn.to_tag) for turn in rotations] == [IDS[:2], IDS[1:]]
    for turn in rotations:
        x, y, heading = (float(v) for v in course.at(np.array(turn.time_s - world.start_ns * 1e-9)))
        reached = x + 1j * y + turn.distance_m * np.exp(1j * (heading + turn.rotation_rad))
        goal = SITE[turn.to_tag]
        assert abs(reached - (goal.x_m + 1j * goal.y_m)) < 4e-3
        assert 0 < turn.sigma_rotation_rad < 0.02


def test_along_counts_backward_as_negative(world: Any) -> None:
    course = world.driven(world.line(length=1.0, direction=1.1), [0, 5, 10], [0, 1, 0.5])
    driven = odometry(world, course, turn=0.7)
    path = distance_along(driven, driven.time_ns)
    assert path[0] == 0
    assert path.max() == pytest.approx(1.0, abs=0.01)
    assert path[-1] == pytest.approx(0.5, abs=0.01)


def test_along_counts_only_what_the_robot_looks_at(world: Any) -> None:
    """Sideways is no way along the array's x."""
    course = world.line(length=1.0, direction=0.3, crab=np.pi / 3)
    driven = odometry(world, course)
    assert distance_along(driven, driven.time_ns)[-1] == pytest.approx(0.5, abs=0.01)


@pytest.mark.slow
def test_the_error_of_odometry_widens_the_covariance_between_tags(
    world: Any, tour: tuple[Any, Samples]
) -> None:
    """2 % of 0.35 m: 7 mm at the next tag, of which up to a half counts midway."""
    course, recording = tour
    driven = odometry(world, course, scale=1.02)
    poses = only(solve([recording], replace(TAGS, site=SITE), odometry=[driven]))
    x = truth(world, course, poses)[:, 0]
    midway = poses.sigma[np.argmin(np.abs(x - 0.25)), 0]
    over_tag = poses.sigma[np.argmin(np.abs(x)), 0]
    assert midway > 1.5e-3 > 3 * over_tag


def test_the_uncertainty_of_a_surveyed_tag_is_part_of_its_poses(tour: tuple[Any, Samples]) -> None:
    _, recording = tour
    preprocessed = preprocess(recording)
    part = find_passes(preprocessed.samples, preprocessed.noise_t)[0]
    identified = identify_pass(detect_magnets(preprocessed, part, TAGS), recording, [TAGS])
    assert identified is not None
    sigma = (0.02, 0.01, 0.1)
    exact = replace(TAGS, site=SITE)
    surveyed = replace(exact, site_sigma={IDS[0]: sigma})
    before, after = (
        localize(recording, [replace(identified.observations[0], tags=tags)]).trajectories[0]
        for tags in (exact, surveyed)
    )
    np.testing.assert_array_equal(after.position, before.position)
    added = (after.covariance - before.covariance)[:, :, [0, 1, 5]][:, [0, 1, 5]]
    # A rotation of the tag moves the array about the tag.
    pose = SITE[IDS[0]]
    x, y = (after.position[:, :2] - [pose.x_m, pose.y_m]).T
    by_tag = np.tile(np.eye(3), (len(after), 1, 1))
    by_tag[:, 0, 2], by_tag[:, 1, 2] = -y, x
    expected = by_tag @ np.diag(np.square(sigma)) @ by_tag.swapaxes(1, 2)
    np.testing.assert_allclose(added, expected, atol=1e-12)


def test_the_same_tag_twice_in_a_row_has_no_correction(tour: tuple[Any, Samples]) -> None:
    _, recording = tour
    preprocessed = preprocess(recording)
    part = find_passes(preprocessed.samples, preprocessed.noise_t)[0]
    identified = identify_pass(detect_magnets(preprocessed, part, TAGS), recording, [TAGS])
    assert identified is not None
    observation = replace(identified.observations[0], tags=replace(TAGS, site=SITE))
    result = localize(recording, [observation, observation])
    assert result.heading_corrections == ()
    assert len(result.trajectories) == 1


@pytest.mark.slow
def test_poses_of_a_tag_are_over_its_own_magnets(world: Any) -> None:
    """Two tags in one pass, their middles 0.15 m apart."""
    x_m = (-0.075, 0.075)
    tags = [world.Tag(CELLS, symbols, x=x) for x, symbols in zip(x_m, SYMBOLS[:2], strict=True)]
    course = world.line(length=0.5)
    recording = world.record(tags, course)
    preprocessed = preprocess(recording)
    (part,) = find_passes(preprocessed.samples, preprocessed.noise_t)
    identified = identify_pass(detect_magnets(preprocessed, part, TAGS), recording, [TAGS])
    assert identified is not None
    assert [each.tag_id for each in identified.observations] == list(IDS[:2])
    for observation, x in zip(identified.observations, x_m, strict=True):
        (poses,) = localize(recording, [observation]).trajectories
        driven, _, _ = course.at((poses.time_ns - world.start_ns) * 1e-9)
        assert np.ptp(driven) == pytest.approx(0.14, abs=0.01)
        assert np.mean(driven) == pytest.approx(x, abs=0.01)
        assert poses.position[:, 0] == pytest.approx(driven - x, abs=1e-3)


@pytest.fixture(scope="module")
def first_tag(tour: tuple[Any, Samples]) -> TagObservation:
    _, recording = tour
    preprocessed = preprocess(recording)
    part = find_passes(preprocessed.samples, preprocessed.noise_t)[0]
    identified = identify_pass(detect_magnets(preprocessed, part, TAGS), recording, [TAGS])
    assert identified is not None
    return identified.observations[0]


def with_path(observation: TagObservation, path_m: Array) -> TagObservation:
    sigma_m = np.minimum(observation.magnets.path_sigma_m, 2e-4)
    magnets = replace(observation.magnets, path_m=path_m, path_sigma_m=sigma_m)
    return replace(observation, magnets=magnets)


def localized_times(recording: Samples, observation: TagObservation) -> NDArray[np.int64]:
    (poses,) = localize(recording, [observation]).trajectories
    return poses.time_ns


def test_a_sample_far_off_its_neighbours_has_no_pose(
    tour: tuple[Any, Samples], first_tag: TagObservation
) -> None:
    _, recording = tour
    magnets = first_tag.magnets
    damaged = int(np.argmin(np.abs(magnets.path_m - 0.02)))
    path_m = magnets.path_m.copy()
    path_m[damaged] -= 0.03
    before = localized_times(recording, first_tag)
    after = localized_times(recording, with_path(first_tag, path_m))
    assert set(before) - set(after) == {recording.time_ns[magnets.first + damaged]}


@pytest.mark.parametrize(("beyond_m", "has_poses"), [(0.02, False), (0.005, True), (-0.03, True)])
def test_a_rest_away_from_the_magnets_may_be_a_motion(
    beyond_m: float, has_poses: bool, tour: tuple[Any, Samples], first_tag: TagObservation
) -> None:
    _, recording = tour
    magnets = first_tag.magnets
    last_m = magnets.position_m[:, 0].max()
    path_m = np.minimum(magnets.path_m, last_m + beyond_m)
    rest_ns = recording.time_ns[magnets.first : magnets.stop][path_m == path_m.max()]
    assert len(rest_ns) > 10
    is_localized = np.isin(rest_ns, localized_times(recording, with_path(first_tag, path_m)))
    assert is_localized.tolist() == [has_poses] * len(rest_ns)
