"""Windows that two codecs have at different positions are not decoded with confidence."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.dots.codec import CODEC_NAMES, SECTION_LENGTH, codec
from locatk.core.dots.identification.decoding import (
    MIN_CONFIDENCE,
    DecodedWindows,
    identify_windows,
)

Bits = NDArray[np.float32]

DISTURBANCES = {"clean": (0.0, 0.0), "missing": (0.0, 0.15), "wrong": (0.02, 0.0)}
"""Fractions of wrong bits and of missing dots."""


def windows(
    name: str, n: int, size: tuple[int, int], disturbance: str, seed: int = 0
) -> tuple[Bits, Bits, NDArray[np.int64]]:
    """Soft bits of windows of a codec, and their positions (n, 2)."""
    rng = np.random.default_rng(seed)
    at = rng.integers(0, SECTION_LENGTH - max(size), (n, 2))
    sections = rng.integers(0, 63, (n, 2))
    symbols = np.stack(
        [
            codec(name).symbols((int(x), int(y)), size, (int(u), int(v)))
            for (x, y), (u, v) in zip(at, sections, strict=True)
        ]
    )
    wrong, missing = DISTURBANCES[disturbance]
    has_dot = rng.random(symbols.shape) >= missing
    bits = []
    for bit in (symbols & 1, symbols >> 1):
        sign = np.where(rng.random(bit.shape) < wrong, -1, 1)
        bits.append(((8.0 * bit - 4) * sign * has_dot).astype(np.float32))
    return bits[0], bits[1], at


def is_right(decoded: DecodedWindows, at: NDArray[np.int64]) -> NDArray[np.bool_]:
    result: NDArray[np.bool_] = (decoded.x == at[:, 0]) & (decoded.y == at[:, 1])
    return result


@pytest.mark.slow
@pytest.mark.parametrize("disturbance", DISTURBANCES)
@pytest.mark.parametrize(("printed", "read"), list(itertools.permutations(CODEC_NAMES, 2)))
def test_no_pair_of_codecs_is_confused(printed: str, read: str, disturbance: str) -> None:
    column, row, at = windows(printed, 80, (12, 11), disturbance)
    decoded = identify_windows(column, row, codec(read))
    accepted = decoded.confidence >= MIN_CONFIDENCE
    assert not (accepted & ~is_right(decoded, at)).any()


@pytest.mark.parametrize("name", CODEC_NAMES)
def test_confidence_of_right_windows_is_limited_by_the_prior_only(name: str) -> None:
    column, row, at = windows(name, 400, (8, 8), "clean")
    decoded = identify_windows(column, row, codec(name))
    certain = identify_windows(column, row, codec(name), other_codec_odds=0)
    assert is_right(decoded, at).all()
    assert (certain.confidence >= MIN_CONFIDENCE).all()
    limited = decoded.confidence < MIN_CONFIDENCE
    assert 0.002 < limited.mean() < 0.15
    # One or two of the two other codecs have the same window: prior odds of 0.005 each.
    same = decoded.confidence[limited]
    assert (np.abs(same - 1 / 1.005) < 1e-3).any()
    assert ((same > 1 / 1.011) & (same < 1 / 1.0045)).all()
    assert (identify_windows(column, row, codec(name), other_codec_odds=1).confidence < 0.75)[
        limited
    ].all()


def test_windows_of_both_codecs_at_one_position_are_certain() -> None:
    # Up to position 219 of 241 the fourth sequences of anoto and libdots are the same.
    at = 241 * np.arange(1000, 1100) + 20
    symbols = np.stack([codec("anoto").symbols((int(x), int(x)), (12, 12)) for x in at])
    column, row = ((8.0 * bit - 4).astype(np.float32) for bit in (symbols & 1, symbols >> 1))
    for name in ("anoto", "libdots"):
        decoded = identify_windows(column, row, codec(name))
        assert is_right(decoded, np.column_stack([at, at])).all()
        assert (decoded.confidence >= MIN_CONFIDENCE).all()
