"""What no map can do."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from locatk.core.errors import InputError
from locatk.core.landmarks.design.bounds import (
    max_distinct_readings,
    max_square_side,
    require_enough_words,
)
from locatk.core.landmarks.design.proof import prove_map
from locatk.core.landmarks.map.floor import FloorMap
from locatk.core.landmarks.map.windows import ALPHABET_CODES


@pytest.mark.slow
@pytest.mark.parametrize(
    ("alphabet", "window", "shape"),
    [("6", "I3", (1, 3)), ("16", "I2", (1, 2)), ("6", "2x2", (2, 2))],
)
def test_useful_words_are_those_of_floors_of_one_window(
    alphabet: str, window: str, shape: tuple[int, int]
) -> None:
    """Each such floor holds as many words as it has headings; none is of two floors."""
    codes = product(ALPHABET_CODES[alphabet], repeat=shape[0] * shape[1])
    floors = [FloorMap(np.reshape(c, shape), window=window, alphabet=alphabet) for c in codes]
    proofs = [prove_map(floor, steps=False) for floor in floors]
    assert max_distinct_readings(alphabet, window) == sum(proof.is_unique for proof in proofs)


def test_bounds_of_the_facts() -> None:
    """Facts 4; the words of I2 and 2x2 that turn into themselves fall out in addition."""
    assert max_distinct_readings("6", "L") == 216
    assert max_distinct_readings("6", "I3") == 180
    assert max_distinct_readings("16", "L") == 4096
    assert max_distinct_readings("16", "I2") == 240
    assert max_distinct_readings("6", "2x2") == 1296 - 36
    assert max_distinct_readings("16", "2x2") == 65536 - 256
    assert max_distinct_readings("compass", "2x2") == 4 * 81
    assert max_square_side("16", "L") == 33
    assert max_square_side("6", "L") == 8
    assert [max_square_side("16", w, 1) for w in ("L", "2x2")] == [9, 33]
    assert [max_square_side("6", w, 1) for w in ("L", "2x2")] == [4, 8]
    assert max_square_side("compass", "2x2") == 10


@pytest.mark.parametrize(
    ("rows", "columns", "alphabet", "window", "detect", "bound"),
    [
        (34, 33, "16", "L", 0, 4096),
        (8, 9, "16", "I2", 0, 240),
        (8, 8, "6", "I3", 0, 180),
        (19, 19, "6", "2x2", 0, 1260),
        (9, 10, "16", "L", 1, 256),
        (11, 10, "compass", "2x2", 0, 81),
        (1, 3, "compass", "I2", 1, 0),
    ],
)
def test_too_large_floors_are_refused_with_the_bound(
    rows: int, columns: int, alphabet: str, window: str, detect: int, bound: int
) -> None:
    if bound:
        with pytest.raises(InputError, match=f"only {bound} ") as error:
            require_enough_words(rows, columns, alphabet=alphabet, window=window, detect=detect)
        side = max_square_side(alphabet, window, detect)
        assert f"{side} x {side}" in str(error.value.hint)
    require_enough_words(
        rows - 1 or 1, columns - 1, alphabet=alphabet, window=window, detect=detect
    )


def test_holes_and_walls_reduce_the_readings() -> None:
    with pytest.raises(InputError, match="256 readings"):
        require_enough_words(9, 9, alphabet="6", window="L")
    middle = {(r, c) for r in range(3, 6) for c in range(3, 6)}
    require_enough_words(9, 9, alphabet="6", window="L", forbidden=middle)
    fence = {((r, c), (r, c + 1)) for r in range(9) for c in (2, 5)}
    require_enough_words(9, 9, alphabet="6", window="L", walls=fence)


def test_a_one_way_square_may_equal_its_rotation() -> None:
    """One wall leaves one of the four ways around a square, and no word is useless then."""
    codes = np.zeros((2, 2), int)
    walls = frozenset({((0, 0), (0, 1))})
    assert prove_map(FloorMap(codes, alphabet="6", window="2x2", walls=walls)).is_unique
    require_enough_words(2, 2, alphabet="6", window="2x2", walls=walls)


def test_one_way_squares_do_not_count_as_reversible() -> None:
    """19 x 20 cells with 14 walls have 1284 readings, of which 28 are read in one direction only.

    The other 1256 are no more than the 1260 words that differ from their rotated reverse.
    """
    corners = [(row, column) for row in range(1, 17, 3) for column in (1, 4, 7)][:14]
    walls = frozenset(((row, column), (row, column + 1)) for row, column in corners)
    require_enough_words(19, 20, alphabet="6", window="2x2", walls=walls)
    with pytest.raises(InputError, match="1264 readings"):
        require_enough_words(19, 20, alphabet="6", window="2x2", walls=frozenset(sorted(walls)[1:]))
