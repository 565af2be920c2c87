"""DotLattices, found in points whose places are known; no images here."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.dots.detection import lattice as grid
from locatk.core.dots.detection.lattice import DotLattices, fit_lattices

Array = NDArray[np.float64]

SIZE = (188, 120)
HALF_DIAGONAL = math.hypot(*SIZE) / 2
CORNER_SQUARE = 93.5**2 + 59.5**2

DIRECTIONS = np.array([[0, -1], [-1, 0], [1, 0], [0, 1]]) / 6


@dataclass(frozen=True)
class Cloud:
    """Points (n, 2) px from the middle of a frame, and the place (n, 2) of each; nan for dust."""

    points: Array
    place: Array


def cloud(
    rng: np.random.Generator,
    *,
    pitch: float = 11.04,
    heading: float = 0.3,
    tilt: float = 0.0,
    towards: float = 0.0,
    lens: float = 0.0,
    missing: float = 0.0,
    dust: float = 0.0,
    scatter: float = 0.0,
    stray: float = 0.01,
    size: tuple[int, int] = SIZE,
) -> Cloud:
    """Dots of random symbols as seen from 348.7 px above.

    ``lens`` is by which share the corners are drawn in, ``scatter`` the standard deviation of
    all dots in pitches, ``stray`` the share of dots that lie up to half a pitch aside.
    """
    reach = math.ceil(math.hypot(*size) / 2 / pitch * 1.5) + 2
    x, y = np.meshgrid(np.arange(-reach, reach + 1), np.arange(-reach, reach + 1))
    place = np.stack([x, y], axis=-1).reshape(-1, 2).astype(float)
    at = place + DIRECTIONS[rng.integers(0, 4, len(place))]
    at += rng.normal(0, scatter, at.shape) if scatter else 0
    away = rng.random(len(at)) < stray
    at[away] = place[away] + rng.uniform(-0.5, 0.5, (away.sum(), 2))
    at += rng.uniform(-0.5, 0.5, 2)
    c, s = math.cos(heading), math.sin(heading)
    right, down = (at @ np.array([[c, s], [-s, c]]) * pitch).T
    # A pinhole that leans by `tilt` over the point in the middle.
    along = math.cos(towards) * right + math.sin(towards) * down
    beside = -math.sin(towards) * right + math.cos(towards) * down
    depth = 1 + along * math.sin(tilt) / 348.7
    along, beside = along * math.cos(tilt) / depth, beside / depth
    observed = np.stack(
        [
            math.cos(towards) * along - math.sin(towards) * beside,
            math.sin(towards) * along + math.cos(towards) * beside,
        ],
        axis=1,
    )
    observed /= 1 + lens * (observed**2).sum(axis=1, keepdims=True) / CORNER_SQUARE
    inside = (np.abs(observed) < np.array(size) / 2 - 2).all(axis=1) & (depth > 0.3)
    kept = inside & (rng.random(len(observed)) >= missing)
    observed, place = observed[kept], place[kept]
    specks = rng.binomial(len(observed), dust) if dust else 0
    observed = np.concatenate([observed, rng.uniform(-0.5, 0.5, (specks, 2)) * size])
    place = np.concatenate([place, np.full((specks, 2), np.nan)])
    order = rng.permutation(len(observed))
    return Cloud(observed[order], place[order])


def fit(clouds: list[Cloud], *, lens: bool = True, half: float = HALF_DIAGONAL) -> DotLattices:
    most = max(len(c.points) for c in clouds)
    points = np.zeros((len(clouds), most, 2), np.float32)
    valid = np.zeros((len(clouds), most), bool)
    for k, c in enumerate(clouds):
        points[k, : len(c.points)] = c.points / half
        valid[k, : len(c.points)] = True
    return fit_lattices(points, valid, lens=lens)


def agreement(lattices: DotLattices, clouds: list[Cloud]) -> Array:
    """Share of each frame's dots whose places differ from the true ones as the others' do."""
    shares = []
    for k, c in enumerate(clouds):
        known = np.flatnonzero(np.isfinite(c.place[:, 0]))
        place = lattices.nodes[k, known].astype(float)
        best = 0.0
        for quarter in range(4):
            a, b = [(1, 0), (0, 1), (-1, 0), (0, -1)][quarter]
            rotated = c.place[known] @ np.array([[a, b], [-b, a]], float)
            _, counts = np.unique(place - rotated, axis=0, return_counts=True)
            best = max(best, counts.max() / len(known))
        shares.append(best)
    return np.array(shares)


def assert_found(clouds: list[Cloud], share: float = 0.99, **how: Any) -> DotLattices:
    lattices = fit(clouds, **how)
    assert lattices.fitted.all()
    assert agreement(lattices, clouds).min() >= share
    return lattices


@pytest.mark.parametrize("pitch", [8, 9, 10, 11.04, 12, 14, 16])
def test_every_heading_and_pitch(pitch: float) -> None:
    rng = np.random.default_rng(1)
    rotations = np.radians(np.arange(0, 360, 7.5))
    clouds = [cloud(rng, pitch=pitch, heading=rotation) for rotation in rotations]
    lattices = assert_found(clouds)
    assert np.median(lattices.sigma) < 0.015
    # A step along u is a pitch, to the right of the image or within 45 degrees of it.
    slope = grid.slope_at_centre(lattices.parameters) / HALF_DIAGONAL * pitch
    lengths = np.linalg.norm(slope, axis=2)
    np.testing.assert_allclose(lengths, 1, atol=0.01)
    assert (slope[:, 0, 0] > math.cos(math.radians(46))).all()
    assert (slope[:, 1, 1] > math.cos(math.radians(46))).all()
    # Its origin is at the middle, but for a fraction.
    assert np.abs(lattices.parameters[:, [grid.C_U, grid.C_V]]).max() <= 0.5 + 1e-9


@pytest.mark.slow
@pytest.mark.parametrize(
    ("how", "share"),
    [
        ({"tilt": math.radians(5)}, 0.99),
        ({"tilt": math.radians(10)}, 0.99),
        ({"tilt": math.radians(15)}, 0.99),
        ({"lens": 0.045}, 0.99),
        ({"lens": 0.12}, 0.9),
        ({"lens": -0.1}, 0.97),
        ({"tilt": math.radians(10), "lens": 0.045, "missing": 0.05}, 0.99),
        ({"missing": 0.2}, 0.99),
        ({"dust": 0.05}, 0.98),
        ({"dust": 0.05, "missing": 0.1, "tilt": math.radians(8)}, 0.98),
        ({"scatter": 0.03}, 0.99),
        ({"scatter": 0.05}, 0.97),
    ],
)
def test_spoilt_lattices(how: dict[str, float], share: float) -> None:
    rng = np.random.default_rng(2)
    clouds = [
        cloud(rng, heading=rng.uniform(0, math.tau), towards=rng.uniform(0, math.tau), **how)
        for _ in range(40)
    ]
    assert_found(clouds, share)


def test_positions_have_fractions() -> None:
    # Each dot lies beside its place by the sixth of a pitch that its symbol says.
    rng = np.random.default_rng(3)
    clouds = [
        cloud(rng, heading=rng.uniform(-0.7, 0.7), tilt=0.15, towards=k, lens=0.045, stray=0.0)
        for k in range(20)
    ]
    lattices = assert_found(clouds, 1.0)
    rest = (lattices.uv - lattices.nodes)[lattices.valid]
    longer, shorter = np.abs(rest).max(axis=1), np.abs(rest).min(axis=1)
    np.testing.assert_allclose(longer, 1 / 6, atol=0.02)
    assert shorter.max() < 0.02
    assert lattices.sigma.max() < 0.005


@pytest.mark.parametrize(
    ("size", "pitch"), [((320, 240), 20), ((640, 480), 11), ((640, 480), 40), ((1280, 960), 20)]
)
def test_large_frames(size: tuple[int, int], pitch: float) -> None:
    rng = np.random.default_rng(4)
    clouds = [cloud(rng, pitch=pitch, heading=a, size=size, stray=0) for a in (0.1, 0.8, 2.0, 4.4)]
    assert_found(clouds, half=math.hypot(*size) / 2)


def test_a_known_lens_is_not_fitted() -> None:
    rng = np.random.default_rng(5)
    clouds = [cloud(rng, heading=a, lens=0.045) for a in np.linspace(0, 6, 10)]
    free, flat = fit(clouds, lens=True), fit(clouds, lens=False)
    np.testing.assert_allclose(flat.parameters[:, grid.LENS], 0, atol=1e-9)
    assert (free.parameters[:, grid.LENS] < -0.02).all()  # the corners are drawn in
    assert np.median(free.sigma) < 0.5 * np.median(flat.sigma)


def test_random_points_are_no_lattice() -> None:
    # Whatever is fitted to them, dots do not lie where symbols stand.
    rng = np.random.default_rng(6)
    heaps = [
        Cloud(rng.uniform(-0.5, 0.5, (n, 2)) * SIZE, np.full((n, 2), np.nan))
        for n in rng.integers(30, 400, 60)
    ]
    lattices = fit(heaps)
    pattern = fit([cloud(rng, scatter=0.02, heading=a) for a in np.linspace(0, 6, 20)])
    near = [
        (
            ((np.abs(rest - grid.nearest_symbol_offset(rest)).max(axis=2) < 0.06) & one.valid).sum(
                axis=1
            )
            / one.valid.sum(axis=1)
        )
        for one in (lattices, pattern)
        for rest in [one.uv - one.nodes]
    ]
    assert near[0].max() < 0.6
    assert near[1].min() > 0.9


def test_too_few_points_and_odd_ones() -> None:
    rng = np.random.default_rng(7)
    few = cloud(rng, missing=0.95)
    assert len(few.points) < grid.MIN_LATTICE_DOTS
    assert not fit([few]).fitted.any()
    empty = fit_lattices(np.zeros((2, 1, 2), np.float32), np.zeros((2, 1), bool), lens=True)
    assert not empty.fitted.any()
    line = np.stack([np.linspace(-90, 90, 60), np.zeros(60)], axis=1)
    for points in (np.zeros((50, 2)), np.repeat(rng.uniform(-50, 50, (2, 2)), 40, axis=0), line):
        lattices = fit([Cloud(points, points)])
        assert np.isfinite(lattices.sigma[0]) or not lattices.fitted[0]


def test_frames_do_not_depend_on_their_company() -> None:
    rng = np.random.default_rng(8)
    clouds = [cloud(rng, heading=k, missing=m) for k, m in enumerate((0.0, 0.3, 0.1, 0.6))]
    clouds.append(Cloud(rng.uniform(-50, 50, (500, 2)), np.full((500, 2), np.nan)))
    together = fit(clouds)
    for k, one in enumerate(clouds[:4]):
        alone = fit([one])
        n = len(one.points)
        np.testing.assert_allclose(together.uv[k, :n], alone.uv[0], atol=1e-4)
        np.testing.assert_allclose(together.parameters[k], alone.parameters[0], atol=1e-5)
        assert together.fitted[k] == alone.fitted[0]


def test_nearest_symbol() -> None:
    rest = np.array([[0.1, 0.02], [-0.2, 0.1], [0.05, 0.3], [-0.1, -0.12], [0.16, 0.0]], np.float32)
    np.testing.assert_allclose(
        grid.nearest_symbol_offset(rest),
        np.array([[1, 0], [-1, 0], [0, 1], [0, -1], [1, 0]]) / 6,
        atol=1e-6,
    )
