"""The compiled loops and their twins in numpy: the same answers, on frames and on codes."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core import kernels
from locatk.core.dots.codec import SECTION_LENGTH, codec
from locatk.core.dots.codec.lookup import rotate_symbols
from locatk.core.dots.detection import blobs
from locatk.core.dots.detection import lattice as grid
from locatk.core.dots.identification import decoding as decode
from locatk.core.dots.identification import phase_voting as reading
from locatk.core.dots.identification import soft_bits as softbits
from locatk.core.dots.localization import frames as locate
from locatk.core.dots.localization import pose

needs_kernels = pytest.mark.skipif(
    kernels.kernels is None, reason="the compiled kernels were not built (no C compiler)"
)

ANOTO = codec("anoto")

Search = Callable[..., tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]]


def drawn(seed: int, n: int = 6) -> NDArray[np.uint8]:
    """Frames of random dots near a turned and tilted grid, uneven light, noise and dust."""
    rng = np.random.default_rng(seed)
    height, width = 120, 188
    y, x = np.mgrid[:height, :width]
    frames = []
    for _ in range(n):
        angle, pitch = rng.uniform(0, np.pi / 2), rng.uniform(9, 13)
        light = 190 + 30 * np.sin(x / 90 + rng.uniform(0, 6)) - 0.2 * y
        image = light.copy()
        positions = np.stack(np.meshgrid(np.arange(-14, 15), np.arange(-14, 15)), -1).reshape(-1, 2)
        symbols = ANOTO.symbols((int(rng.integers(SECTION_LENGTH - 29)), 7), (29, 29)).reshape(-1)
        offsets = np.array([[0, -1], [-1, 0], [1, 0], [0, 1]])[symbols] / 6
        rotated = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        dots = (positions + offsets + rng.uniform(-0.5, 0.5, 2)) @ rotated.T * pitch
        dots = dots / (1 + dots @ rng.uniform(-3e-4, 3e-4, 2))[:, None] + [93.5, 59.5]
        dust = rng.uniform([0, 0], [width, height], (4, 2))
        for at in np.concatenate([dots[rng.random(len(dots)) > 0.05], dust]):
            if -5 < at[0] < width + 5 and -5 < at[1] < height + 5:
                square = (x - at[0]) ** 2 + (y - at[1]) ** 2
                image -= 0.6 * light * np.exp(-square / (2 * 1.3**2))
        frames.append(np.clip(image + rng.normal(0, 3, image.shape), 0, 255))
    return np.array(frames).astype(np.uint8)


def as_points(dots: blobs.DetectedDots) -> NDArray[np.float32]:
    return ((dots.xy - [93.5, 59.5]) / np.hypot(188, 120) * 2).astype(np.float32)


@pytest.mark.slow
@needs_kernels
@pytest.mark.parametrize("seed", [1, 2])
def test_dots_are_the_same(seed: int) -> None:
    images = drawn(seed)
    mine, twin = blobs.detect_dots(images), blobs.detect_dots_numpy(images)
    assert np.array_equal(mine.valid, twin.valid)
    assert mine.counts.min() > 100
    np.testing.assert_allclose(mine.xy, twin.xy, atol=2e-3)


@pytest.mark.slow
@needs_kernels
def test_dots_in_the_middle_are_kept() -> None:
    images = drawn(3)
    for result in (blobs.detect_dots(images, 50), blobs.detect_dots_numpy(images, 50)):
        assert result.counts.tolist() == [50] * len(images)
    few = blobs.detect_dots(images, 50).xy, blobs.detect_dots_numpy(images, 50).xy
    order = [np.lexsort(np.round(xy, 1).transpose(2, 0, 1), axis=1) for xy in few]
    rows = np.arange(len(images))[:, None]
    same = np.abs(few[0][rows, order[0]] - few[1][rows, order[1]]).max(axis=2) < 0.2
    assert same.mean() > 0.95


@needs_kernels
@pytest.mark.parametrize("shape", [(1, 5, 5), (2, 9, 40), (1, 48, 7), (1, 61, 200)])
def test_dots_of_odd_sizes(shape: tuple[int, int, int]) -> None:
    images = np.random.default_rng(4).integers(0, 256, shape).astype(np.uint8)
    mine, twin = blobs.detect_dots(images), blobs.detect_dots_numpy(images)
    assert np.array_equal(mine.counts, twin.counts)
    np.testing.assert_allclose(mine.xy, twin.xy, atol=5e-3)


@pytest.mark.parametrize("shape", [(2, 3, 50), (1, 4, 4), (3, 60, 1), (0, 60, 60)])
def test_images_too_small_for_a_dot_have_none(shape: tuple[int, int, int]) -> None:
    assert blobs.detect_dots(np.zeros(shape, np.uint8)).counts.tolist() == [0] * shape[0]


@pytest.mark.slow
@needs_kernels
@pytest.mark.parametrize("is_thorough", [True, False])
@pytest.mark.parametrize("lens", [True, False])
def test_lattices_are_the_same(lens: bool, is_thorough: bool) -> None:
    dots = blobs.detect_dots_numpy(drawn(5))
    points = as_points(dots)
    mine = grid.fit_lattices(points, dots.valid, lens=lens, is_thorough=is_thorough)
    twin = grid.fit_lattices_numpy(points, dots.valid, lens=lens, is_thorough=is_thorough)
    assert mine.fitted.all()
    assert np.array_equal(mine.fitted, twin.fitted)
    np.testing.assert_allclose(mine.parameters, twin.parameters, atol=1e-4)
    np.testing.assert_allclose(mine.sigma, twin.sigma, rtol=1e-3)
    np.testing.assert_allclose(mine.uv[dots.valid], twin.uv[dots.valid], atol=1e-3)
    assert np.array_equal(mine.nodes[dots.valid], twin.nodes[dots.valid])


@needs_kernels
def test_too_few_dots_have_no_lattice_in_either() -> None:
    points = np.random.default_rng(6).normal(size=(2, 15, 2)).astype(np.float32)
    valid = np.ones((2, 15), bool)
    for is_thorough in (False, True):
        for fit in (grid.fit_lattices, grid.fit_lattices_numpy):
            assert not fit(points, valid, lens=False, is_thorough=is_thorough).fitted.any()


@needs_kernels
def test_random_dots_have_no_lattice_in_either() -> None:
    points = np.random.default_rng(8).uniform(-1, 1, (20, 150, 2)).astype(np.float32)
    valid = np.ones((20, 150), bool)
    for is_thorough in (False, True):
        for fit in (grid.fit_lattices, grid.fit_lattices_numpy):
            fitted = fit(points, valid, lens=False, is_thorough=is_thorough).fitted
            assert fitted.sum() <= 2


@pytest.mark.slow
@needs_kernels
def test_soft_bits_are_the_same() -> None:
    dots = blobs.detect_dots_numpy(drawn(7))
    lattices = grid.fit_lattices_numpy(as_points(dots), dots.valid, lens=True)
    half = softbits.window_half_width(lattices)
    mine = softbits.soft_bits(lattices, half)
    scatter = np.clip(
        1.5 * lattices.sigma, softbits.MIN_BIT_SIGMA_PITCHES, 2 * softbits.MIN_BIT_SIGMA_PITCHES
    )
    twin = softbits.soft_bits_numpy(lattices, half, scatter)
    assert np.count_nonzero(mine[0]) > 600
    for a, b in zip(mine, twin, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-4)


def test_of_two_dots_at_a_node_the_likelier_one_counts_without_kernels_too() -> None:
    for order in ([0, 1, 2], [2, 1, 0], [1, 0, 2]):
        offset = np.array([[1 / 6, 0.01], [-0.25, 0.1], [0.3, 0.3]], np.float32)[order]
        lattices = grid.DotLattices(
            parameters=np.zeros((1, 9)),
            points=np.zeros((1, 3, 2), np.float32),
            valid=np.ones((1, 3), bool),
            uv=np.array([1, 0], np.float32) + offset[None],
            nodes=np.tile(np.array([1, 0], np.float32), (1, 3, 1)),
            sigma=np.array([0.02]),
            fitted=np.ones(1, bool),
            lens=True,
        )
        columns, rows = softbits.soft_bits_numpy(lattices, 5, np.array([0.03]))
        assert np.count_nonzero(columns) == np.count_nonzero(rows) == 1
        assert columns[0, 5, 6] < -3 < 3 < rows[0, 5, 6]  # right: column bit 0, row bit 1


@needs_kernels
@pytest.mark.parametrize("name", ["anoto", "libdots", "microdots"])
@pytest.mark.parametrize(
    ("side", "missing", "wrong"), [(8, 0, 0), (11, 0.1, 0.03), (24, 0.6, 0.05)]
)
def test_readings_are_the_same(name: str, side: int, missing: float, wrong: float) -> None:
    rng = np.random.default_rng(side)
    code = codec(name)
    windows = []
    for _ in range(60):
        x, y = (int(v) for v in rng.integers(0, SECTION_LENGTH - side, 2))
        u, v = (int(v) for v in rng.integers(0, 63, 2))
        windows.append(
            rotate_symbols(code.symbols((x, y), (side, side), (u, v)), int(rng.integers(4)))
        )
    symbols = np.array(windows)
    bits = []
    for bit in (1, 2):
        sure = rng.uniform(0.5, 4, symbols.shape).astype(np.float32)
        table = np.where(symbols & bit, sure, -sure)
        table[rng.random(table.shape) < wrong] *= -1
        bits.append(table)
    gone = rng.random(symbols.shape) < missing
    for table in bits:
        table[gone] = 0
    mine, twin = reading.estimate_windows(*bits, code), reading.estimate_windows_numpy(*bits, code)
    for field in ("rotation", "position", "shift", "wrong", "first", "last"):
        same = getattr(mine, field) == getattr(twin, field)
        assert same.mean() > 0.99, field  # the sums are rounded differently; ties may fall apart
    agree = (mine.position == twin.position).all(axis=1)
    np.testing.assert_allclose(mine.log_odds[agree], twin.log_odds[agree], atol=1e-3)


def across_sections(x: int, side: int, name: str) -> NDArray[np.uint8]:
    """Symbols from column ``x`` on, continued at the first column."""
    first = min(side, SECTION_LENGTH - x)
    parts = [codec(name).symbols((x, 7), (first, side))]
    if first < side:
        parts.append(codec(name).symbols((0, 7), (side - first, side)))
    return np.concatenate(parts, axis=1)


def column_scores(
    seed: int, n: int, side: int, missing: float, wrong: float, name: str = "anoto"
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Scores of the columns of windows with wrong bits, and the positions of their first ones."""
    rng = np.random.default_rng(seed)
    position = rng.integers(0, SECTION_LENGTH - side, n)
    position[::2] = SECTION_LENGTH - rng.integers(1, side, n // 2)  # on into the next section
    windows = [across_sections(int(x), side, name) for x in position]
    bits = np.where(np.array(windows) & 1, 1, -1) * rng.uniform(2, 8, (n, side, side))
    bits[rng.random(bits.shape) < wrong] *= -1
    bits[rng.random(bits.shape) < missing] = 0
    lines = bits.transpose(0, 2, 1).astype(np.float32)
    return reading.phase_scores(lines), position


@needs_kernels
@pytest.mark.parametrize("try_misread_columns", [True, False])
@pytest.mark.parametrize(
    ("name", "side", "missing", "wrong"),
    [("anoto", 12, 0, 0.03), ("libdots", 20, 0.7, 0.05), ("microdots", 34, 0.8, 0.1)],
)
def test_searches_are_the_same(
    name: str, side: int, missing: float, wrong: float, try_misread_columns: bool
) -> None:
    scores, position = column_scores(side, 40, side, missing, wrong, name)
    scores[:, side - 2] = 0
    mine, twin = (
        search(scores, codec(name), try_misread_columns=try_misread_columns)
        for search in (decode.search_position, decode.search_position_numpy)
    )
    assert (mine[0] == position).mean() > 0.3
    agree = mine[0] == twin[0]
    assert agree.mean() > 0.95  # at the edge of the beam, sums are rounded differently
    assert np.array_equal(mine[1][agree], twin[1][agree])
    np.testing.assert_allclose(mine[2][agree], twin[2][agree], rtol=1e-3, atol=1e-6)


@needs_kernels
@pytest.mark.parametrize("search", [decode.search_position, decode.search_position_numpy])
def test_misread_columns_are_found_between_columns_without_dots(search: Search) -> None:
    scores, position = column_scores(3, 60, 10, 0, 0.03)
    padded = np.zeros((60, 20, 63), np.float32)
    padded[:, 5:15] = scores
    alone, among = (
        search(s, ANOTO, try_misread_columns=True, beam_width=1) for s in (scores, padded)
    )
    assert (alone[0] == position).mean() > 0.8
    assert (alone[0] == (among[0] + 5) % SECTION_LENGTH).mean() > 0.95


@needs_kernels
def test_a_search_without_evidence_is_no_error() -> None:
    for scores in (np.zeros((2, 8, 63), np.float32), np.full((2, 8, 63), np.nan, np.float32)):
        _, _, rivals = decode.search_position(scores, ANOTO, try_misread_columns=True)
        assert (rivals > 1).all()


@pytest.mark.slow
@needs_kernels
def test_poses_are_the_same() -> None:
    dots = blobs.detect_dots_numpy(drawn(8))
    lattices = grid.fit_lattices_numpy(as_points(dots), dots.valid, lens=True)
    half = softbits.window_half_width(lattices)
    decoded = decode.identify_windows(*softbits.soft_bits(lattices, half), ANOTO)
    assert (decoded.confidence > 0.999).all()
    mine = pose.localize_windows(lattices, half, decoded, ANOTO)
    twin = pose.localize_windows_numpy(lattices, half, decoded, ANOTO)
    np.testing.assert_allclose(mine.grid, twin.grid, atol=1e-5)
    np.testing.assert_allclose(mine.heading, twin.heading, atol=1e-6)
    np.testing.assert_allclose(mine.covariance, twin.covariance, rtol=1e-2, atol=1e-12)


@pytest.mark.slow
def test_frames_without_the_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    images = drawn(9)
    mine = locate.localize_frames(images, ANOTO)
    for module in (blobs, grid, softbits, reading, pose):
        monkeypatch.setattr(module, "kernels", None)
    twin = locate.localize_frames(images, ANOTO)
    assert mine.accepted.all()
    assert twin.accepted.all()
    assert np.array_equal(mine.section, twin.section)
    np.testing.assert_allclose(mine.grid, twin.grid, atol=1e-3)
    np.testing.assert_allclose(mine.heading, twin.heading, atol=1e-4)


def test_the_kernels_can_be_left_out() -> None:
    code = "from locatk.core import kernels; print(kernels.kernels)"
    environment = {**os.environ, "LOCATK_NUMPY": "1"}
    answer = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    assert answer.stdout.strip() == "None"


def test_dots_far_from_their_symbols_are_not_assigned() -> None:
    dots = blobs.detect_dots_numpy(drawn(8, 1))
    lattices = grid.fit_lattices_numpy(as_points(dots), dots.valid, lens=True)
    half = softbits.window_half_width(lattices)
    windows = decode.identify_windows(*softbits.soft_bits(lattices, half), ANOTO)
    used = pose.assign_dots(lattices, half, windows, ANOTO).used[0]
    first, second = np.flatnonzero(used)[:2]
    lattices.uv[0, first, 0] += 1.2 * grid.SYMBOL_GATE_PITCHES
    lattices.uv[0, second, 0] += 1e-3
    after = pose.assign_dots(lattices, half, windows, ANOTO).used[0]
    assert not after[first]
    assert after[second]
    assert (after | (np.arange(len(after)) == first))[used].all()
