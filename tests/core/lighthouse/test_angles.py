"""Counts, angles, planes and rays: against a plane that is turned step by step."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from locatk.core.lighthouse import light_planes as angles
from locatk.core.lighthouse.channels import CHANNELS, period_counts
from locatk.core.lighthouse.published.scene import paper_image_points

Array = NDArray[np.float64]

POINTS = np.array(
    [
        (1.0, 0.0, 0.0), (2.0, 0.7, 0.3), (2.0, -0.7, 0.3), (1.5, 0.9, -0.8), (3.0, -2.4, -0.1),
        (0.4, 0.3, 0.35), (5.0, 0.0, -2.0),
    ]
)  # fmt: skip


def turn_until_it_meets(point: Array, lean: float) -> float:
    """Rotor angle at which a light plane meets a point, by trying.

    The plane contains the direction in which the rotor looks; ``lean`` is how far its
    upper edge leans to the left of the vertical.
    """

    def side(angle: Array) -> Array:
        zero = np.zeros_like(angle)
        ahead = np.stack([np.cos(angle), np.sin(angle), zero], axis=-1)
        left = np.stack([-np.sin(angle), np.cos(angle), zero], axis=-1)
        edge = math.cos(lean) * np.array([0.0, 0.0, 1.0]) + math.sin(lean) * left
        return np.asarray(np.cross(ahead, edge) @ point)

    low, high = -math.pi / 2, math.pi / 2
    for _ in range(6):
        trial = np.linspace(low, high, 1001)
        at = side(trial)
        cross = np.flatnonzero((at[:-1] > 0) != (at[1:] > 0))
        assert len(cross) == 1
        low, high = trial[cross[0]], trial[cross[0] + 1]
    return (low + high) / 2


@pytest.mark.parametrize("point", POINTS)
@pytest.mark.parametrize("tilts", [(30.0, -30.0), (27.2, -27.4), (31.0, -28.0)])
def test_planes_meet_the_point_that_a_turning_plane_meets(
    point: Array, tilts: tuple[float, float]
) -> None:
    lean = np.radians(tilts)
    met = np.array([turn_until_it_meets(point, t) for t in lean])

    normals = angles.plane_normals(met, lean)
    np.testing.assert_allclose(normals @ point, 0, atol=1e-12)
    ray = angles.rays(met, lean)
    np.testing.assert_allclose(ray, point / point[0], atol=1e-11)


def test_nominal_planes_lean_by_thirty_degrees_the_first_to_the_left() -> None:
    point = POINTS[1]
    met = np.array([turn_until_it_meets(point, math.radians(t)) for t in (30, -30)])
    np.testing.assert_allclose(angles.rays(met), point / point[0], atol=1e-11)


def test_normals_measure_horizontal_distance() -> None:
    normal = angles.plane_normals(np.zeros(2))[0]
    # The first plane looks ahead: at its own height a point 5 mm to the left is 5 mm off.
    assert normal @ [2.0, 0.005, 0.0] == pytest.approx(0.005)
    assert normal @ [2.0, 0.005 + math.tan(math.pi / 6) * 0.4, 0.4] == pytest.approx(0.005)


def test_counts_follow_the_documented_formula() -> None:
    # Crazyflie: alpha_1 = 2 pi n_1 / T - pi + pi/3, alpha_2 = 2 pi n_2 / T - pi - pi/3.
    for channel in CHANNELS:
        n1, n2, period = 41_000.0, 79_000.0, float(period_counts(channel))
        found = angles.counts_to_angles(np.array([n1, n2]), channel)
        assert found[0] == pytest.approx(2 * math.pi * n1 / period - math.pi + math.pi / 3)
        assert found[1] == pytest.approx(2 * math.pi * n2 / period - math.pi - math.pi / 3)


def test_one_count_is_52_microradians() -> None:
    one, next_one = angles.counts_to_angles(np.array([[40_000.0, 80_000], [40_001, 80_001]]), 1)
    np.testing.assert_allclose(next_one - one, 52.4e-6, atol=0.05e-6)


@given(
    st.lists(st.tuples(st.floats(0, 110_000), st.floats(0, 110_000)), min_size=1, max_size=5),
    st.integers(1, 16),
)
def test_angles_and_counts_are_inverse(pairs: list[tuple[float, float]], channel: int) -> None:
    counts = np.array(pairs)
    back = angles.angles_to_counts(angles.counts_to_angles(counts, channel), channel)
    np.testing.assert_allclose(back, counts, atol=1e-9)


def test_channels_may_differ_row_by_row() -> None:
    counts = np.array([[40_000.0, 80_000], [40_000, 80_000], [np.nan, 80_000]])
    both = angles.counts_to_angles(counts, np.array([1, 16, 16], np.int32))
    for row, channel in enumerate((1, 16, 16)):
        np.testing.assert_array_equal(both[row], angles.counts_to_angles(counts[row], channel))
    assert np.isnan(both[2, 0])
    assert np.isfinite(both[2, 1])
    np.testing.assert_allclose(
        angles.angles_to_counts(both, np.array([1, 16, 16], np.int32)), counts
    )


def test_rays_are_those_of_crazyflie() -> None:
    # lighthouse_calibration.c, idealToDistortedV2: y and z at x = 1 of ideal angles.
    rng = np.random.default_rng(0)
    pairs = rng.uniform(-0.8, 0.8, (50, 1)) + rng.uniform(-0.4, 0.4, (50, 2))
    a1, a2 = pairs.T
    y = np.tan((a2 + a1) / 2)
    z = np.sin(a2 - a1) / (math.tan(math.pi / 6) * (np.cos(a2) + np.cos(a1)))
    np.testing.assert_allclose(angles.rays(pairs), np.c_[np.ones(50), y, z], rtol=1e-9)


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
    # Theirs has no 1/cos(theta), theta being half a turn where the planes look ahead.
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
