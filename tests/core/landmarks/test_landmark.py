"""Codes of landmarks: sixteen ways to lay four bars, six patterns."""

from __future__ import annotations

import numpy as np
import pytest

from locatk.core.landmarks.field import landmark_field
from locatk.core.landmarks.landmark import (
    CODE_COUNT,
    PATTERN_OF,
    PATTERNS,
    Geometry,
    code_of,
    name,
    pattern,
    rotated,
    signs,
)


def test_names_and_codes_are_inverse() -> None:
    assert [code_of(name(code)) for code in range(CODE_COUNT)] == list(range(CODE_COUNT))
    assert len({name(code) for code in range(CODE_COUNT)}) == CODE_COUNT
    # Letters run counter-clockwise from the right-hand bar, which is bit 0.
    assert name(0b0001) == "NSSS"
    assert code_of("SNSS") == 0b0010
    assert code_of("NNNS") == 0b0111


@pytest.mark.parametrize("letters", ["", "NNN", "NNNNN", "NNNX", "nnns", "N NS"])
def test_other_letters_are_refused(letters: str) -> None:
    with pytest.raises(ValueError, match="four letters"):
        code_of(letters)


def test_a_rotation_moves_each_bar_to_the_next_side() -> None:
    """By strings, which know nothing of bits."""
    for code in range(CODE_COUNT):
        letters = name(code)
        for quarters in range(-5, 6):
            moved = "".join(letters[(k - quarters) % 4] for k in range(4))
            assert name(int(rotated(code, quarters))) == moved


def test_rotations_broadcast_and_invert() -> None:
    codes = np.arange(CODE_COUNT)
    table = rotated(codes[:, None], np.arange(-4, 5))
    assert table.shape == (CODE_COUNT, 9)
    np.testing.assert_array_equal(table[:, 0], codes)
    np.testing.assert_array_equal(rotated(rotated(codes, 3), -3), codes)
    np.testing.assert_array_equal(rotated(rotated(codes, 1), 2), rotated(codes, 3))
    assert ((table >= 0) & (table < CODE_COUNT)).all()


def test_signs_are_the_letters() -> None:
    for code in range(CODE_COUNT):
        expected = [1.0 if letter == "N" else -1.0 for letter in name(code)]
        np.testing.assert_array_equal(signs(code), expected)
    assert signs(np.zeros((3, 2), int)).shape == (3, 2, 4)


def test_sixteen_orientations_of_six_patterns() -> None:
    """1 + 1 + 2 + 4 + 4 + 4 = 16, and no orientation is of two patterns."""
    orientations = [
        {int(code) for code in rotated(code_of(letters), np.arange(4))} for letters in PATTERNS
    ]
    assert [len(result) for result in orientations] == [2, 4, 4, 4, 1, 1]
    assert set().union(*orientations) == set(range(CODE_COUNT))
    for number, result in enumerate(orientations, 1):
        assert {int(PATTERN_OF[code]) for code in result} == {number}
        assert {pattern(code) for code in result} == {PATTERNS[number - 1]}


def test_a_rotated_code_has_a_rotated_field() -> None:
    """The robot's reading: a landmark seen under q quarter turns is turned back by q."""
    points = np.random.default_rng(0).uniform(-0.06, 0.06, (50, 2))
    quarter = np.array([[0.0, -1.0], [1.0, 0.0]])
    for code in range(CODE_COUNT):
        installed = landmark_field(Geometry(), code, points)
        for q in range(4):
            observed = points @ np.linalg.matrix_power(quarter, q)  # rows: turned back by q
            read = landmark_field(Geometry(), int(rotated(code, -q)), observed)
            np.testing.assert_allclose(read, installed, atol=1e-15)
