"""Errors in print of the Lighthouse paper, which docs/lighthouse.md lists.

Alvarado-Marin et al., IEEE RA-L 2024 (DOI 10.1109/LRA.2024.3405345). Each equation is evaluated as
printed and compared with the geometry, and with the form that the package uses.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.lighthouse import lfsr
from locatk.core.lighthouse.channels import period_counts
from locatk.core.lighthouse.light_planes import angles_to_counts, rays
from locatk.core.lighthouse.published import scene as paper

Array = NDArray[np.float64]

TO_IMAGE = paper.TO_STATION.T


# ---- Eq. 1 and 3


def test_eq_1_in_eq_3_divides_twice_by_the_cosine() -> None:
    rng = np.random.default_rng(1)
    azimuth = rng.uniform(-0.8, 0.8, 500)
    spread = rng.uniform(-0.4, 0.4, 500)
    angles = np.stack([azimuth - spread, azimuth + spread], axis=-1)
    ray = rays(angles)
    counts = angles_to_counts(angles, 1)

    alpha_1, alpha_2 = (2 * np.pi * counts / period_counts(1)).T
    theta = (alpha_1 + alpha_2) / 2
    phi = np.arctan(
        np.sin((alpha_2 - alpha_1) / 2 - np.pi / 3) / (np.tan(np.pi / 6) * np.cos(theta))
    )
    printed_y = -np.tan(phi) / np.cos(theta)

    np.testing.assert_allclose(paper.paper_image_points(counts, 1)[:, 1], ray[:, 2], atol=1e-12)
    # Theta is half a revolution straight ahead, so that the second factor also exchanges up and
    # down.
    np.testing.assert_allclose(printed_y, -ray[:, 2] / np.cos(azimuth), atol=1e-12)


# ---- Eq. 4 and 8


def two_views(rng: np.random.Generator, separation_rad: float) -> tuple[Array, Array, float]:
    """Return homography, rotation, and ratio of baseline to height, of two stations over a floor.

    Both look at the origin, from directions that are ``separation_rad`` apart.
    """
    first, second = (
        np.array([r * np.cos(a), r * np.sin(a), h])
        for r, a, h in zip(
            rng.uniform(1.5, 2.5, 2), (0.0, separation_rad), rng.uniform(1, 2.5, 2), strict=True
        )
    )
    to_first, to_second = image_axes(first), image_axes(second)
    rotation = to_second @ to_first.T
    translation = to_second @ (first - second)
    normal = to_first @ np.array([0.0, 0.0, -1.0])
    homography = rotation + np.outer(translation, normal) / first[2]
    return homography, rotation, float(np.linalg.norm(translation) / first[2])


def image_axes(position: Array) -> Array:
    """Return the matrix from the world to image axes (x right, y up) of a view to the origin."""
    ahead = -position / np.linalg.norm(position)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return np.array([right, np.cross(right, ahead), ahead])


def eq_7_rotations(homography: Array, *, with_factor: bool) -> list[Array]:
    """Return both rotations of Eq. 6 to 8, with ``d = a b`` or with the factor it needs."""
    u, s, vt = np.linalg.svd(homography)
    s1, s3 = s[0] / s[1], s[2] / s[1]
    a = np.sqrt((1 - s3**2) / (s1**2 - s3**2))
    b = np.sqrt((s1**2 - 1) / (s1**2 - s3**2))
    c, d = 1 + s1 * s3, a * b * ((s1**2 - s3**2) if with_factor else 1.0)
    c, d = np.array([c, d]) / np.hypot(c, d)
    return [
        np.linalg.det(u @ vt) * (u @ np.array([[c, 0, e], [0, 1, 0], [-e, 0, c]]) @ vt)
        for e in (d, -d)
    ]


def smallest_angle_deg(rotations: list[Array], true: Array) -> float:
    return min(
        float(np.degrees(np.arccos(np.clip((np.trace(r.T @ true) - 1) / 2, -1, 1))))
        for r in rotations
    )


@pytest.mark.parametrize(
    ("separation_deg", "printed_deg"), [(30, (3, 7)), (90, (24, 33)), (180, (34, 45))]
)
def test_eq_8_needs_the_difference_of_squares(
    separation_deg: float, printed_deg: tuple[float, float]
) -> None:
    rng = np.random.default_rng(8)
    errors = np.array(
        [
            [
                smallest_angle_deg(eq_7_rotations(homography, with_factor=factor), rotation)
                for factor in (True, False)
            ]
            for homography, rotation, _ in (
                two_views(rng, np.radians(separation_deg)) for _ in range(100)
            )
        ]
    )
    assert errors[:, 0].max() < 1e-4
    low, high = printed_deg
    assert low < np.median(errors[:, 1]) < high


def test_eq_8_as_implemented_is_the_true_rotation(world: Any) -> None:
    ideal_planes = (world.Plane(), world.Plane())
    first, second = (
        world.Lamp(lamp.channel, lamp.position, lamp.rotation, ideal_planes)
        for lamp in world.lamps(2, 16)
    )
    points = world.curve(60, flat=True)
    image = np.stack(
        [paper.paper_image_points(s.counts(s.angles(points)), s.channel) for s in (first, second)],
        axis=1,
    )
    _, solved = paper.two_planar(image).stations
    true = first.rotation.T @ second.rotation
    assert smallest_angle_deg([solved[1]], true) < 0.1
    homography, _ = cv2.findHomography(image[:, 0], image[:, 1], cv2.LMEDS)
    in_image = TO_IMAGE @ true.T @ TO_IMAGE.T
    assert smallest_angle_deg(eq_7_rotations(homography, with_factor=True), in_image) < 0.1
    assert smallest_angle_deg(eq_7_rotations(homography, with_factor=False), in_image) > 10


def test_eq_4_is_the_difference() -> None:
    rng = np.random.default_rng(4)
    for separation_rad in rng.uniform(0.3, np.pi, 50):
        homography, _, baseline_ratio = two_views(rng, separation_rad)
        s1, s2, s3 = np.linalg.svd(homography)[1]
        assert (s1 - s3) / s2 == pytest.approx(baseline_ratio, rel=1e-9)
        assert s1 / s3 > 1.5 * baseline_ratio


# ---- 24 bits


def windows_of_other_polynomials(
    polynomial: NDArray[np.int64], index: NDArray[np.int64], length: int, max_differing: int
) -> NDArray[np.bool_]:
    """Return whether each window occurs in another polynomial's sequence, but for some bits."""
    window = lfsr.bits_at(index, polynomial, length)
    others = np.arange(len(lfsr.TAPS))[:, None]
    flips = [np.uint64(0), *(np.uint64(1 << k) for k in range(length * max_differing))]
    occurs = np.zeros((len(others), len(window)), bool)
    for flip in flips:
        variant = window ^ flip
        state = (variant >> np.uint64(length - lfsr.REGISTER_BITS)).astype(np.int64)
        found = lfsr.indices(state, others)
        occurs |= (state > 0) & (lfsr.bits_at(found, others, length) == variant)
    occurs[polynomial, np.arange(len(window))] = False
    return occurs.any(axis=0)


def test_24_bits_do_not_select_a_polynomial() -> None:
    rng = np.random.default_rng(24)
    polynomial, index = rng.integers(0, 32, 300), rng.integers(0, 119_000, 300)
    # Over all 4.2 million windows: 99.83 % and 21.6 %.
    assert windows_of_other_polynomials(polynomial, index, 24, 1).mean() > 0.99
    assert 0.14 < windows_of_other_polynomials(polynomial, index, 24, 0).mean() < 0.29
    assert windows_of_other_polynomials(polynomial, index, 46, 1).mean() == 0


@pytest.mark.parametrize("pair", [(0, 1), (2, 3), (7, 30)])
def test_34_correct_bits_exclude_every_other_polynomial(pair: tuple[int, int]) -> None:
    # Two different sequences satisfy a common recurrence of degree 34. They agree in 34 bits
    # nowhere, and in 33 bits at one pair of positions.
    index = np.arange(lfsr.SEQUENCE_LENGTH)
    common = [
        np.intersect1d(*(lfsr.bits_at(index, p, length) for p in pair), assume_unique=True)
        for length in (33, 34)
    ]
    assert [len(windows) for windows in common] == [1, 0]
