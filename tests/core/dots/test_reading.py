"""Windows that say too little, lie at a rim, or are of another codec: told, never guessed."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.dots.codec import RANGE, Codec, codec
from locatk.core.dots.decode import THRESHOLD, Decoded, decode
from locatk.core.dots.exact import turn

ANOTO = codec("anoto")
Truth = NDArray[np.int64]


def soft(symbols: NDArray[np.uint8]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    column = np.where(symbols & 1, 4, -4).astype(np.float32)
    return column, np.where(symbols & 2, 4, -4).astype(np.float32)


def windows(
    code: Codec, columns: int, rows: int, n: int, seed: int, low: int = 0, high: int = RANGE - 99
) -> tuple[NDArray[np.uint8], Truth]:
    """(n, rows, columns) windows as seen, and x, y, u, v and quarter turns of each."""
    rng = np.random.default_rng(seed)
    truth = np.column_stack(
        [rng.integers(low, high, (n, 2)), rng.integers(0, 63, (n, 2)), rng.integers(0, 4, n)]
    )
    seen = []
    for x, y, u, v, turns in truth.tolist():
        size = (rows, columns) if turns % 2 else (columns, rows)
        seen.append(turn(code.symbols((x, y), size, (u, v)), turns))
    return np.array(seen), truth


def right(found: Decoded, truth: Truth) -> NDArray[np.bool_]:
    answer = np.column_stack([found.x, found.y, found.section, found.rotation])
    result: NDArray[np.bool_] = (answer == truth).all(axis=1)
    return result


@pytest.mark.parametrize("size", [(8, 8), (12, 9), (9, 12), (7, 20), (23, 23), (40, 11)])
def test_windows_of_any_shape_and_turn(size: tuple[int, int]) -> None:
    symbols, truth = windows(ANOTO, *size, n=60, seed=1)
    found = decode(*soft(symbols), ANOTO)
    assert right(found, truth).all()
    assert (found.confidence >= THRESHOLD).all()
    assert found.dots.tolist() == [size[0] * size[1]] * 60
    assert not found.corrected.any()


@pytest.mark.parametrize("size", [(10, 5), (17, 5), (30, 5), (17, 4), (5, 30), (3, 40)])
def test_a_few_lines_fit_many_places_and_are_not_accepted(size: tuple[int, int]) -> None:
    symbols, _ = windows(ANOTO, *size, n=80, seed=2)
    assert (decode(*soft(symbols), ANOTO).confidence < 0.9).all()


@pytest.mark.parametrize("rows", [6, 7, 8])
def test_repeated_digits_of_libdots_are_never_accepted_wrong(rows: int) -> None:
    code = codec("libdots")
    symbols, truth = windows(code, 10, rows, n=1500, seed=3)
    found = decode(*soft(symbols), code)
    assert not ((found.confidence >= THRESHOLD) & ~right(found, truth)).any()


def test_two_strips_with_a_gap_between_them() -> None:
    symbols, truth = windows(ANOTO, 11, 11, n=400, seed=4)
    column, row = soft(symbols)
    for bits in (column, row):
        bits[:, 4:7] = 0
    found = decode(column, row, ANOTO)
    accepted = found.confidence >= THRESHOLD
    assert accepted.mean() > 0.5
    assert (accepted & ~right(found, truth)).sum() <= 1


@pytest.mark.parametrize("origin", [(0, 0), (1, 2), (0, 300)])
def test_looking_past_the_rim_of_the_first_sheet(origin: tuple[int, int]) -> None:
    symbols = ANOTO.symbols(origin, (20, 20), (5, 7))
    seen = np.zeros((2, 24, 24), np.float32)
    seen[:, 4:, 4:] = np.stack(soft(symbols))
    found = decode(seen[:1], seen[1:], ANOTO)
    assert (found.x[0], found.y[0]) == (origin[0] - 4, origin[1] - 4)
    assert found.section.tolist() == [[5, 7]]
    assert found.confidence[0] >= THRESHOLD


def test_the_last_places_of_the_range() -> None:
    symbols = ANOTO.symbols((RANGE - 12, RANGE - 12), (12, 12), (62, 0))
    found = decode(*soft(symbols[None]), ANOTO)
    assert (found.x[0], found.y[0]) == (RANGE - 12, RANGE - 12)
    assert found.section.tolist() == [[62, 0]]
    assert not found.border[0]


@pytest.mark.parametrize("beyond", [3, 6, 9])
@pytest.mark.parametrize("width", [12, 18])
def test_windows_across_a_section_border_are_not_accepted(beyond: int, width: int) -> None:
    rng = np.random.default_rng(beyond)
    seen = []
    for _ in range(40):
        y = int(rng.integers(0, RANGE - width))
        u, v, other = (int(k) for k in rng.integers(0, 63, 3))
        left = ANOTO.symbols((RANGE - width + beyond, y), (width - beyond, width), (u, v))
        seen.append(np.hstack([left, ANOTO.symbols((0, y), (beyond, width), (other, v))]))
    found = decode(*soft(np.array(seen)), ANOTO)
    accepted = found.confidence >= THRESHOLD
    assert accepted.mean() < 0.05  # a place of either side, if the other reads as dirt
    x = found.x[accepted]
    assert ((x >= RANGE - 2 * width) | (x < width)).all()


def test_a_sheet_of_another_codec_is_no_place() -> None:
    symbols, _ = windows(ANOTO, 16, 11, n=200, seed=5)
    assert (decode(*soft(symbols), codec("microdots")).confidence < THRESHOLD).all()


@pytest.mark.parametrize("side", [8, 12, 18])
def test_random_bits_and_mirrored_windows_are_not_accepted(side: int) -> None:
    rng = np.random.default_rng(6)
    noise = rng.integers(0, 4, (700, side, side)).astype(np.uint8)
    symbols, _ = windows(ANOTO, side, side, n=60, seed=7)
    # Through the paper: columns in reverse, left and right exchanged.
    mirrored = np.array([0, 2, 1, 3], np.uint8)[symbols[:, :, ::-1]]
    for wrong in (noise, mirrored):
        assert (decode(*soft(wrong), ANOTO).confidence < THRESHOLD).all()


def test_wrong_bits_are_corrected_and_counted() -> None:
    symbols, truth = windows(ANOTO, 14, 14, n=150, seed=8)
    bits = np.stack(soft(symbols), axis=1)
    rng = np.random.default_rng(9)
    flipped = rng.random((150, 2 * 14 * 14)).argsort(axis=1) < 12
    bits[flipped.reshape(bits.shape)] *= -1
    found = decode(bits[:, 0], bits[:, 1], ANOTO)
    assert right(found, truth).all()
    assert (found.confidence >= THRESHOLD).mean() > 0.98
    assert found.corrected.tolist() == [12] * 150


@pytest.mark.parametrize("wrong", [1, 2])
def test_small_windows_with_wrong_bits_are_rather_rejected_than_wrong(wrong: int) -> None:
    symbols, truth = windows(ANOTO, 8, 8, n=700, seed=10)
    bits = np.stack(soft(symbols), axis=1)
    rng = np.random.default_rng(11)
    flipped = rng.random((700, 128)).argsort(axis=1) < wrong
    bits[flipped.reshape(bits.shape)] *= -1
    found = decode(bits[:, 0], bits[:, 1], ANOTO)
    accepted = found.confidence >= THRESHOLD
    assert accepted.mean() > 0.5
    assert (accepted & ~right(found, truth)).sum() <= 1
