"""Poses from decoded windows: robust against displaced dots, and with a covariance that holds."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.dots.codec import codec
from locatk.core.dots.detection.blobs import detect_dots
from locatk.core.dots.detection.lattice import DotLattices, fit_lattices, slope_at_centre
from locatk.core.dots.identification.decoding import DecodedWindows, identify_windows
from locatk.core.dots.identification.soft_bits import soft_bits, window_half_width
from locatk.core.dots.localization import pose
from locatk.core.dots.localization.frames import localize_frames
from locatk.core.dots.localization.pose import GridPoses, localize_windows

ANOTO = codec("anoto")
SIZE = np.array([188, 120])
AT = (150_000_000.25, 90_000_000.75)

Decoded = tuple[DotLattices, int, DecodedWindows]


@pytest.fixture(scope="module")
def decoded(shoot: Callable[..., NDArray[np.uint8]]) -> Decoded:
    """One frame up to its decoded window."""
    dots = detect_dots(shoot(at=AT, heading=0.4, noise=4.0)[None])
    points = (dots.xy - (SIZE - 1) / 2) / np.hypot(*SIZE) * 2
    lattices = fit_lattices(points.astype(np.float32), dots.valid, lens=True)
    half = window_half_width(lattices)
    bits = soft_bits(lattices, half)
    return lattices, half, identify_windows(*bits, ANOTO, other_codec_odds=0)


def with_displaced(
    decoded: Decoded, displaced: NDArray[np.bool_], by: NDArray[np.float64]
) -> GridPoses:
    """Return poses if some dots are displaced in the image, in pitches."""
    lattices, half, windows = decoded
    pitch = 2 / np.linalg.norm(slope_at_centre(lattices.parameters)[0])
    moved = np.where(displaced[..., None], by * np.sqrt(0.5) * pitch, 0)
    points = (lattices.points + moved).astype(np.float32)
    refitted = fit_lattices(points, lattices.valid, lens=True)
    return localize_windows(refitted, half, windows, ANOTO)


@pytest.fixture(params=["compiled", "numpy"])
def implementation(request: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    if request.param == "numpy":
        monkeypatch.setattr(pose, "kernels", None)


@pytest.mark.usefixtures("implementation")
def test_displaced_dots_at_one_side_hardly_move_the_pose(decoded: Decoded) -> None:
    right = decoded[0].points[..., 0] > 0.55  # a seventh of the frame
    moved = with_displaced(decoded, right, np.array([0.06, 0.0]))
    error = moved.grid[0] - AT
    assert np.abs(error).max() < 1.5e-3
    sigma = np.sqrt(np.einsum("nii->ni", moved.covariance)[0, :2])
    assert (np.abs(error) < 3 * sigma).all()
    assert sigma.max() < 4e-3


@pytest.mark.usefixtures("implementation")
def test_outliers_widen_the_covariance_more_if_they_agree(decoded: Decoded) -> None:
    def sigma(displaced: NDArray[np.bool_], by: NDArray[np.float64]) -> float:
        covariance = with_displaced(decoded, displaced, by).covariance[0]
        return float(np.sqrt(np.trace(covariance[:2, :2])))

    n, m = decoded[0].valid.shape
    for seed in range(6):
        rng = np.random.default_rng(seed)
        some = rng.random((n, m)) < 0.12
        angle = rng.uniform(0, 2 * np.pi, (n, m))
        apart = 0.08 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        clean = sigma(some & False, apart)
        # A tenth of the dots at three sigma, in any direction, alone adds half of the variance.
        assert sigma(some, apart) > 1.4 * clean
        assert sigma(some, np.array([0.08, 0.0])) > 1.3 * sigma(some, apart)


def standardized_errors(
    shoot: Callable[..., NDArray[np.uint8]], n: int, **options: float
) -> NDArray[np.float64]:
    """Errors (n, 2) of rendered frames over their standard deviations."""
    rng = np.random.default_rng(7)
    at = rng.uniform(1e6, 4e8, (n, 2))
    images = [
        shoot(at=tuple(position), heading=angle, towards=angle * 2, seed=k, **options)
        for k, (position, angle) in enumerate(zip(at, rng.uniform(-3, 3, n), strict=True))
    ]
    located = localize_frames(np.stack(images), ANOTO, other_codec_odds=0)
    assert located.accepted.all()
    sigma = np.sqrt(np.einsum("nii->ni", located.covariance)[:, :2])
    result: NDArray[np.float64] = (located.grid - at) / sigma
    return result


@pytest.mark.slow
def test_tilted_discs_are_corrected_for_their_eccentricity(shoot: Any) -> None:
    # The image of a disc's middle is not the middle of its image.
    errors = standardized_errors(shoot, 24, tilt=0.45, focal=200.0, dot=0.3)
    assert 0.2 < np.mean(errors**2) < 2


@pytest.mark.slow
def test_light_from_one_side_moves_no_pose(shoot: Any) -> None:
    errors = standardized_errors(shoot, 24, gradient=0.85, paper=130.0, ink=35.0, noise=1.0)
    assert 0.2 < np.mean(errors**2) < 2


@pytest.mark.slow
@pytest.mark.usefixtures("implementation")
def test_a_lens_of_another_model_is_followed(shoot: Any) -> None:
    # The renderer's lens is the division model, to which a term of the fourth power is added.
    dots = detect_dots(shoot(at=AT, heading=0.4, noise=1.0)[None])
    points = (dots.xy - (SIZE - 1) / 2) / np.hypot(*SIZE) * 2
    squared = (points * points).sum(axis=2, keepdims=True)
    sigmas = []
    for bend in (0.0, 0.12):
        bent = (points * (1 + bend * squared**2)).astype(np.float32)
        lattices = fit_lattices(bent, dots.valid, lens=True)
        half = window_half_width(lattices)
        windows = identify_windows(*soft_bits(lattices, half), ANOTO, other_codec_odds=0)
        poses = localize_windows(lattices, half, windows, ANOTO)
        assert np.abs(poses.grid[0] - AT).max() < 1e-3
        sigmas.append(np.sqrt(np.trace(poses.covariance[0, :2, :2])))
    # 13 times with one coefficient.
    assert sigmas[1] < 4 * sigmas[0]


@pytest.mark.usefixtures("implementation")
def test_displacements_that_neighbours_share_widen_the_covariance(decoded: Decoded) -> None:
    """The same displacements, in any order, leave the scatter of the frame as it is."""
    points, valid = decoded[0].points[0].astype(np.float64), decoded[0].valid
    for seed in range(4):
        rng = np.random.default_rng(seed)
        waves, phases = rng.normal(0, 8, (3, 2, 2)), rng.uniform(0, 6.3, (3, 2))
        smooth = 0.006 * np.sin(np.einsum("mi,kci->mkc", points, waves) + phases).sum(axis=1)
        sigmas = []
        for order in (np.arange(len(points)), rng.permutation(len(points))):
            moved = with_displaced(decoded, valid, smooth[order][None])
            sigmas.append(np.sqrt(np.trace(moved.covariance[0, :2, :2])))
        assert sigmas[0] > 1.2 * sigmas[1]


@pytest.mark.usefixtures("implementation")
def test_a_lens_beyond_the_model_hardly_widens_the_covariance(decoded: Decoded) -> None:
    lattices, half, windows = decoded
    points = lattices.points
    squared = (points**2).sum(axis=2, keepdims=True)
    # A term of the tenth power moves the corners by 15 %; a seventh of the dots is displaced.
    strong_bend = points * (0.15 * squared**2 - 0.3 * squared**5)
    rng = np.random.default_rng(5)
    displaced = (rng.random(points.shape[:2]) < 0.15)[..., None]
    displacement = displaced * rng.normal(0, 0.006, points.shape)
    sigmas = []
    for moved in (points * 0.15 * squared**2, strong_bend, strong_bend + displacement):
        refitted = fit_lattices((points + moved).astype(np.float32), lattices.valid, lens=True)
        poses = localize_windows(refitted, half, windows, ANOTO)
        assert np.abs(poses.grid[0] - AT).max() < 2e-3
        sigmas.append(np.sqrt(np.trace(poses.covariance[0, :2, :2])))
    assert sigmas[1] < 1.5 * sigmas[0]
    assert sigmas[2] > 1.3 * sigmas[1]


@pytest.mark.skipif(pose.kernels is None, reason="no compiled kernels")
@pytest.mark.parametrize("bend", [0.2, 0.3])
def test_compiled_poses_of_a_strong_lens_are_those_of_numpy(decoded: Decoded, bend: float) -> None:
    lattices, half, windows = decoded
    squared = (lattices.points**2).sum(axis=2, keepdims=True)
    bent = lattices.points * (1 + 0.15 * squared**2 - bend * squared**5)
    refitted = fit_lattices(bent.astype(np.float32), lattices.valid, lens=True)
    compiled = localize_windows(refitted, half, windows, ANOTO)
    expected = pose.localize_windows_numpy(refitted, half, windows, ANOTO)
    np.testing.assert_allclose(compiled.grid - AT, expected.grid - AT, atol=2e-5)
    np.testing.assert_allclose(compiled.covariance, expected.covariance, rtol=0.02, atol=1e-10)
