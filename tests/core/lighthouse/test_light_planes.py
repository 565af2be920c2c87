"""Geometry of light planes, against a plane that is rotated step by step."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from locatk.core.lighthouse import light_planes
from locatk.core.lighthouse.channels import CHANNELS, period_counts

Array = NDArray[np.float64]

POINTS = np.array(
    [
        (1.0, 0.0, 0.0), (2.0, 0.7, 0.3), (2.0, -0.7, 0.3), (1.5, 0.9, -0.8), (3.0, -2.4, -0.1),
        (0.4, 0.3, 0.35), (5.0, 0.0, -2.0),
    ]
)  # fmt: skip


def search_crossing(point: Array, tilt: float) -> float:
    """Search the rotor angle at which a light plane crosses a point.

    The plane contains the horizontal direction in which the rotor points; its upper edge is
    tilted to the left of the vertical by ``tilt``.
    """

    def side(angle: Array) -> Array:
        zero = np.zeros_like(angle)
        ahead = np.stack([np.cos(angle), np.sin(angle), zero], axis=-1)
        left = np.stack([-np.sin(angle), np.cos(angle), zero], axis=-1)
        edge = math.cos(tilt) * np.array([0.0, 0.0, 1.0]) + math.sin(tilt) * left
        return np.asarray(np.cross(ahead, edge) @ point)

    low, high = -math.pi / 2, math.pi / 2
    for _ in range(6):
        trial = np.linspace(low, high, 1001)
        distance = side(trial)
        cross = np.flatnonzero((distance[:-1] > 0) != (distance[1:] > 0))
        assert len(cross) == 1
        low, high = trial[cross[0]], trial[cross[0] + 1]
    return (low + high) / 2


@pytest.mark.parametrize("point", POINTS)
@pytest.mark.parametrize("tilts", [(30.0, -30.0), (27.2, -27.4), (31.0, -28.0)])
def test_planes_and_rays_contain_the_point_that_a_rotating_plane_crosses(
    point: Array, tilts: tuple[float, float]
) -> None:
    tilts_rad = np.radians(tilts)
    met = np.array([search_crossing(point, t) for t in tilts_rad])

    normals = light_planes.plane_normals(met, tilts_rad)
    np.testing.assert_allclose(normals @ point, 0, atol=1e-12)
    ray = light_planes.rays(met, tilts_rad)
    np.testing.assert_allclose(ray, point / point[0], atol=1e-11)


def test_nominal_planes_are_tilted_by_thirty_degrees_the_first_to_the_left() -> None:
    point = POINTS[1]
    met = np.array([search_crossing(point, math.radians(t)) for t in (30, -30)])
    np.testing.assert_allclose(light_planes.rays(met), point / point[0], atol=1e-11)


def test_normals_measure_horizontal_distance() -> None:
    normal = light_planes.plane_normals(np.zeros(2))[0]
    # The first plane points ahead: a point 5 mm to the left at the height of the station.
    assert normal @ [2.0, 0.005, 0.0] == pytest.approx(0.005)
    assert normal @ [2.0, 0.005 + math.tan(math.pi / 6) * 0.4, 0.4] == pytest.approx(0.005)


def test_counts_follow_the_documented_formula() -> None:
    # Crazyflie: alpha_1 = 2 pi n_1 / T - pi + pi/3, alpha_2 = 2 pi n_2 / T - pi - pi/3.
    for channel in CHANNELS:
        n1, n2, period = 41_000.0, 79_000.0, float(period_counts(channel))
        found = light_planes.counts_to_angles(np.array([n1, n2]), channel)
        assert found[0] == pytest.approx(2 * math.pi * n1 / period - math.pi + math.pi / 3)
        assert found[1] == pytest.approx(2 * math.pi * n2 / period - math.pi - math.pi / 3)


def test_one_count_is_52_microradians() -> None:
    one, next_one = light_planes.counts_to_angles(
        np.array([[40_000.0, 80_000], [40_001, 80_001]]), 1
    )
    np.testing.assert_allclose(next_one - one, 52.4e-6, atol=0.05e-6)


@given(
    st.lists(st.tuples(st.floats(0, 110_000), st.floats(0, 110_000)), min_size=1, max_size=5),
    st.integers(1, 16),
)
def test_angles_and_counts_are_inverse(pairs: list[tuple[float, float]], channel: int) -> None:
    counts = np.array(pairs)
    back = light_planes.angles_to_counts(light_planes.counts_to_angles(counts, channel), channel)
    np.testing.assert_allclose(back, counts, atol=1e-9)


def test_channels_may_differ_row_by_row() -> None:
    counts = np.array([[40_000.0, 80_000], [40_000, 80_000], [np.nan, 80_000]])
    both = light_planes.counts_to_angles(counts, np.array([1, 16, 16], np.int32))
    for row, channel in enumerate((1, 16, 16)):
        np.testing.assert_array_equal(
            both[row], light_planes.counts_to_angles(counts[row], channel)
        )
    assert np.isnan(both[2, 0])
    assert np.isfinite(both[2, 1])
    np.testing.assert_allclose(
        light_planes.angles_to_counts(both, np.array([1, 16, 16], np.int32)), counts
    )


def test_rays_are_those_of_crazyflie() -> None:
    # lighthouse_calibration.c, idealToDistortedV2: y and z at x = 1 of ideal angles.
    rng = np.random.default_rng(0)
    pairs = rng.uniform(-0.8, 0.8, (50, 1)) + rng.uniform(-0.4, 0.4, (50, 2))
    a1, a2 = pairs.T
    y = np.tan((a2 + a1) / 2)
    z = np.sin(a2 - a1) / (math.tan(math.pi / 6) * (np.cos(a2) + np.cos(a1)))
    np.testing.assert_allclose(light_planes.rays(pairs), np.c_[np.ones(50), y, z], rtol=1e-9)
