"""Rotations, planes, homographies and alignments against scipy and known answers."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from locatk.core import geometry as g
from locatk.core.errors import DegenerateError

VECTORS = arrays(np.float64, 3, elements=st.floats(-10, 10))


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(1)


def rotation_vector(matrix: np.ndarray) -> np.ndarray:
    return g.rotation_vector_from_quaternion(g.quaternion_from_matrix(matrix))


def test_rotations_agree_with_scipy(rng: np.random.Generator) -> None:
    theirs = Rotation.random(200, random_state=rng)
    matrix, quaternion = theirs.as_matrix(), theirs.as_quat(canonical=True)
    np.testing.assert_allclose(g.matrix_from_quaternion(quaternion), matrix, atol=1e-14)
    np.testing.assert_allclose(g.quaternion_from_matrix(matrix), quaternion, atol=1e-14)
    np.testing.assert_allclose(rotation_vector(matrix), theirs.as_rotvec(), atol=1e-12)
    np.testing.assert_allclose(g.rotation_exp(theirs.as_rotvec()), matrix, atol=1e-14)
    both = g.quaternion_multiply(quaternion[:100], quaternion[100:])
    expected = (theirs[:100] * theirs[100:]).as_matrix()
    np.testing.assert_allclose(g.matrix_from_quaternion(both), expected, atol=1e-14)
    back = g.quaternion_multiply(quaternion, g.quaternion_inverse(quaternion))
    np.testing.assert_allclose(back, np.tile([0, 0, 0, 1.0], (200, 1)), atol=1e-14)


def test_quaternion_functions_agree_with_scipy_and_broadcast(rng: np.random.Generator) -> None:
    first, second = (Rotation.random(60, random_state=rng) for _ in range(2))
    a, b, vectors = first.as_quat(), second.as_quat(), rng.normal(size=(60, 3))
    np.testing.assert_allclose(g.quaternion_rotate(a, vectors), first.apply(vectors), atol=1e-14)
    np.testing.assert_allclose(g.quaternion_angle(a), first.magnitude(), atol=1e-14)
    rotvec = g.rotation_vector_from_quaternion(a)
    np.testing.assert_allclose(rotvec, first.as_rotvec(), atol=1e-14)
    np.testing.assert_allclose(g.rotation_vector_from_quaternion(-a), rotvec, atol=1e-14)
    product = g.quaternion_multiply(a, b)
    # One of the two, or both, may be single, and there may be further leading dimensions.
    grid = (3, 4, 5)
    np.testing.assert_array_equal(
        g.quaternion_multiply(a.reshape(*grid, 4), b.reshape(*grid, 4)), product.reshape(*grid, 4)
    )
    every = g.quaternion_multiply(a[:, None], b)
    assert every.shape == (60, 60, 4)
    np.testing.assert_array_equal(every[7], g.quaternion_multiply(a[7], b))
    np.testing.assert_array_equal(every[:, 7], g.quaternion_multiply(a, b[7]))
    np.testing.assert_array_equal(every[7, 9], g.quaternion_multiply(a[7], b[9]))
    rotated = g.quaternion_rotate(a[:, None], vectors)
    np.testing.assert_array_equal(rotated[7], g.quaternion_rotate(a[7], vectors))
    np.testing.assert_array_equal(rotated[7, 9], g.quaternion_rotate(a[7], vectors[9]))
    assert g.quaternion_angle(a[0]).shape == ()
    assert g.rotation_vector_from_quaternion(a.reshape(*grid, 4)).shape == (*grid, 3)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-6, 1.0, 3.0])
def test_slerp_is_uniform_and_takes_the_shorter_arc(angle: float) -> None:
    fraction = np.linspace(0, 1, 11)
    first, second = g.quaternion_from_heading([-0.3, angle - 0.3])
    expected = -0.3 + fraction * angle
    for end in (second, -second):
        between = g.slerp(first, end, fraction)
        np.testing.assert_allclose(g.heading_from_quaternion(between), expected, atol=1e-14)
        np.testing.assert_allclose(np.linalg.norm(between, axis=-1), 1.0, atol=1e-15)


def test_covariances_transform_with_their_frame(rng: np.random.Generator) -> None:
    """Compare with transformed square roots; further unknowns do not change."""
    rotation = Rotation.random(random_state=rng).as_matrix()
    root = rng.normal(size=(2, 7, 7))
    covariance = root @ root.transpose(0, 2, 1)
    jacobian = np.zeros((7, 7))
    jacobian[:3, :3], jacobian[3:6, 3:6], jacobian[6, 6] = 2.5 * rotation, rotation, 1.0
    moved = jacobian @ root
    np.testing.assert_allclose(
        g.transform_covariance(covariance, 2.5, rotation), moved @ moved.transpose(0, 2, 1)
    )


@given(VECTORS)
def test_exp_is_a_rotation_as_scipy_has_it(vector: np.ndarray) -> None:
    ours = g.rotation_exp(vector)
    np.testing.assert_allclose(ours, Rotation.from_rotvec(vector).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(ours @ ours.T, np.eye(3), atol=1e-12)


@given(VECTORS)
def test_log_inverts_exp(vector: np.ndarray) -> None:
    matrix = g.rotation_exp(vector)
    np.testing.assert_allclose(g.rotation_exp(rotation_vector(matrix)), matrix, atol=1e-7)
    if np.linalg.norm(vector) < 3.1:
        np.testing.assert_allclose(rotation_vector(matrix), vector, atol=1e-10)


@pytest.mark.parametrize("angle", [0.0, 1e-300, 1e-14, 1e-9, 1e-4, np.pi - 1e-9, np.pi])
def test_log_and_exp_at_the_edges(angle: float) -> None:
    for axis in np.vstack([np.eye(3), -np.eye(3), np.ones((1, 3)) / np.sqrt(3)]):
        back = rotation_vector(g.rotation_exp(axis * angle))
        assert np.linalg.norm(back) == pytest.approx(angle, rel=1e-9, abs=1e-15)
        # At half a turn both ends of the axis are right.
        assert abs(back @ axis) == pytest.approx(angle, rel=1e-9, abs=1e-15)


def test_heading_and_its_quaternion() -> None:
    heading = np.linspace(-3.14, 3.14, 50)
    quaternion = g.quaternion_from_heading(heading)
    np.testing.assert_allclose(g.heading_from_quaternion(quaternion), heading, atol=1e-12)
    ahead = g.matrix_from_quaternion(quaternion)[:, :2, 0]
    np.testing.assert_allclose(ahead, np.stack([np.cos(heading), np.sin(heading)], 1), atol=1e-12)
    # Roll does not change where the x axis points.
    rolled = g.quaternion_multiply(quaternion, [np.sin(0.4), 0, 0, np.cos(0.4)])
    np.testing.assert_allclose(g.heading_from_quaternion(rolled), heading, atol=1e-12)


def test_skew_is_the_cross_product(rng: np.random.Generator) -> None:
    a, b = rng.normal(size=(2, 20, 3))
    np.testing.assert_allclose((g.skew(a) @ b[..., None])[..., 0], np.cross(a, b))


def test_rigid_motions(rng: np.random.Generator) -> None:
    plane = np.array([[0.0, -1.0, 1.0], [1.0, 0.0, 3.0], [0.0, 0.0, 1.0]])
    np.testing.assert_allclose(g.transform_points(plane, [[1.0, 0.0]]), [[1.0, 4.0]], atol=1e-15)
    np.testing.assert_allclose(g.rigid_inverse(plane) @ plane, np.eye(3), atol=1e-15)
    space = g.se3(Rotation.random(5, random_state=rng).as_matrix(), rng.normal(size=(5, 3)))
    np.testing.assert_allclose(g.rigid_inverse(space), np.linalg.inv(space), atol=1e-14)


def test_plane_through_noisy_points(rng: np.random.Generator) -> None:
    normal = np.array([0.1, -0.2, 0.97])
    normal /= np.linalg.norm(normal)
    points = rng.uniform(-1, 1, (500, 3))
    points -= ((points - [0, 0, 0.5]) @ normal)[:, None] * normal
    points += rng.normal(0, 1e-3, (500, 1)) * normal
    centre, found = g.fit_plane(points)
    assert found @ normal > 1 - 1e-7
    assert abs((centre - [0, 0, 0.5]) @ normal) < 2e-4
    weights = np.r_[np.ones(500), 0.0]
    np.testing.assert_allclose(g.fit_plane(np.vstack([points, [0, 0, 9.0]]), weights)[1], found)
    with pytest.raises(DegenerateError, match="line"):
        g.fit_plane(np.outer(np.arange(5.0), [1, 2, 3]))


def test_homography_is_recovered_and_degeneracy_refused(rng: np.random.Generator) -> None:
    true = np.array([[1.1, 0.2, 300], [-0.1, 0.9, -500], [1e-4, 2e-4, 1.0]])
    source = rng.uniform(0, 4000, (50, 2))
    target = g.apply_homography(true, source)
    for n in (4, 50):
        found = g.fit_homography(source[:n], target[:n])
        np.testing.assert_allclose(found / found[2, 2], true, rtol=1e-8)
    line = np.outer(np.arange(4.0), [1.0, 2.0])
    with pytest.raises(DegenerateError, match="line"):
        g.fit_homography(line, target[:4])
    with pytest.raises(DegenerateError, match="four"):
        g.fit_homography(source[:3], target[:3])


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("with_scale", [False, True])
def test_umeyama_finds_known_transforms(
    rng: np.random.Generator, dimension: int, with_scale: bool
) -> None:
    source = rng.normal(size=(100, dimension))
    rotation = Rotation.random(random_state=rng).as_matrix()
    if dimension == 2:
        rotation = g.rotation_exp([0, 0, 2.5])[:2, :2]
    true = g.Similarity(0.3 if with_scale else 1.0, rotation, rng.normal(size=dimension))
    found = g.umeyama(source, true.apply(source), with_scale=with_scale)
    np.testing.assert_allclose(found.matrix, true.matrix, atol=1e-12)
    # Points of weight zero do not count, whatever they are.
    target = np.vstack([true.apply(source), np.full((1, dimension), 99.0)])
    weights = np.r_[rng.uniform(0.5, 2, 100), 0.0]
    found = g.umeyama(
        np.vstack([source, np.ones((1, dimension))]), target, weights, with_scale=with_scale
    )
    np.testing.assert_allclose(found.matrix, true.matrix, atol=1e-12)


def test_umeyama_with_noise_and_weights_agrees_with_scipy(rng: np.random.Generator) -> None:
    source = rng.normal(size=(40, 3))
    weights = rng.uniform(0.1, 3, 40)
    rotation = Rotation.random(random_state=rng)
    target = rotation.apply(source) + np.array([1, 2, 3]) + rng.normal(0, 0.1, (40, 3))
    found = g.umeyama(source, target, weights, with_scale=False)
    means = [np.average(p, axis=0, weights=weights) for p in (source, target)]
    theirs, _ = Rotation.align_vectors(target - means[1], source - means[0], weights=weights)
    np.testing.assert_allclose(found.rotation, theirs.as_matrix(), atol=1e-12)


def test_umeyama_is_the_minimum(rng: np.random.Generator) -> None:
    source = rng.normal(size=(30, 3))
    target = rng.normal(size=(30, 3))
    best = g.umeyama(source, target)

    def cost(s: g.Similarity) -> float:
        return float(np.sum((s.apply(source) - target) ** 2))

    for _ in range(200):
        change = rng.normal(0, 0.02, 7)
        other = g.Similarity(
            best.scale * np.exp(change[0]),
            g.rotation_exp(change[1:4]) @ best.rotation,
            best.translation + change[4:],
        )
        assert cost(other) >= cost(best)


def test_umeyama_never_reflects(rng: np.random.Generator) -> None:
    source = rng.normal(size=(30, 3))
    assert np.linalg.det(g.umeyama(source, source * [1, 1, -1]).rotation) > 0
    flat = source[:, :2]
    assert np.linalg.det(g.umeyama(flat, flat * [1, -1]).rotation) > 0
    # In space, a mirrored plane is matched by a rotation of half a turn, as documented.
    plane = source * [1, 1, 0]
    found = g.umeyama(plane, plane * [1, -1, 1])
    np.testing.assert_allclose(found.apply(plane), plane * [1, -1, 1], atol=1e-12)


def test_umeyama_refuses_degenerate_points() -> None:
    line = np.outer(np.arange(5.0), [1, 2, 3])
    with pytest.raises(DegenerateError, match="line"):
        g.umeyama(line, line)
    with pytest.raises(DegenerateError, match="coincide"):
        g.umeyama(np.ones((5, 2)), np.ones((5, 2)))
    with pytest.raises(DegenerateError, match="no points"):
        g.umeyama(np.zeros((0, 3)), np.zeros((0, 3)))
