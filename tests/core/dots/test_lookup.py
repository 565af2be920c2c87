"""Windows that are whole are read right, and what is not whole is not read."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from locatk.core.dots.codec.lookup import ExactWindows, decode_exact, digits_of, rotate_symbols
from locatk.core.dots.codec.pattern import DOWN, LEFT, RIGHT, SECTION_LENGTH, UP, codec
from locatk.core.errors import InputError

Symbols = NDArray[np.uint8]

NAMES = ("anoto", "libdots", "microdots")


def draw(
    name: str, count: int, size: tuple[int, int], seed: int
) -> tuple[Symbols, NDArray[np.int64], NDArray[np.int64]]:
    """Windows (n, rows, columns) anywhere; where they lie (n, 2) and their sections (n, 2)."""
    rng = np.random.default_rng(seed)
    at = rng.integers(0, SECTION_LENGTH - np.array(size) + 1, (count, 2))
    sections = rng.integers(0, 63, (count, 2))
    one = codec(name)
    windows = [
        one.symbols((int(x), int(y)), size, (int(u), int(v)))
        for (x, y), (u, v) in zip(at, sections, strict=True)
    ]
    return np.stack(windows), at, sections


def repeated(at: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return whether positions are those of the six windows that libdots' A4 sequence has twice."""
    twice = [82, 238, 170, 236, 177, 237, 195, 217, 198, 218, 199, 219]
    result: NDArray[np.bool_] = np.isin(at % 241, twice)
    return result


def agrees(
    actual: ExactWindows,
    rows: Any,
    at: NDArray[np.int64],
    sections: NDArray[np.int64],
    rotation: int,
) -> None:
    assert actual.ok[rows].all()
    np.testing.assert_array_equal(actual.x[rows], at[rows, 0])
    np.testing.assert_array_equal(actual.y[rows], at[rows, 1])
    np.testing.assert_array_equal(actual.section[rows], sections[rows])
    np.testing.assert_array_equal(actual.rotation[rows], rotation)


def nothing(actual: ExactWindows) -> None:
    """Rows that are not ok say nothing else either."""
    bad = ~actual.ok
    for values in (actual.x, actual.y, actual.section, actual.rotation):
        assert (values[bad] == -1).all()


def test_a_rotation_by_90_degrees_is_counter_clockwise() -> None:
    page = np.array([[UP, UP, RIGHT], [DOWN, LEFT, LEFT]], np.uint8)
    rotated = np.array([[UP, DOWN], [LEFT, DOWN], [LEFT, RIGHT]], np.uint8)
    np.testing.assert_array_equal(rotate_symbols(page, 1), rotated)
    np.testing.assert_array_equal(rotate_symbols(rotated, -1), page)
    np.testing.assert_array_equal(rotate_symbols(page, 2), rotate_symbols(rotated, 1))
    np.testing.assert_array_equal(rotate_symbols(page, 7), rotate_symbols(page, -1))


@pytest.mark.slow
@pytest.mark.parametrize("rotation", range(4))
@pytest.mark.parametrize("name", NAMES)
def test_8x8_windows_at_any_position_section_and_rotation(name: str, rotation: int) -> None:
    windows, at, sections = draw(name, 400, (8, 8), 10 + rotation)
    actual = decode_exact(rotate_symbols(windows, rotation), codec(name))
    agrees(actual, slice(None), at, sections, rotation)


@given(
    st.sampled_from(NAMES),
    st.tuples(st.integers(8, 80), st.integers(8, 80)),
    st.integers(0, 2**32),
    st.integers(0, 3),
)
@settings(max_examples=40, deadline=None)
def test_any_larger_window(name: str, size: tuple[int, int], seed: int, rotation: int) -> None:
    windows, at, sections = draw(name, 3, size, seed)
    agrees(
        decode_exact(rotate_symbols(windows, rotation), codec(name)),
        slice(None),
        at,
        sections,
        rotation,
    )


@pytest.mark.parametrize("name", NAMES)
def test_corners_of_the_range(name: str) -> None:
    one = codec(name)
    at = np.array([(x, y) for x in (0, SECTION_LENGTH - 8) for y in (0, SECTION_LENGTH - 8)])
    windows = np.stack([one.symbols((x, y), (8, 8), (62, 1)) for x, y in at.tolist()])
    agrees(decode_exact(windows, one), slice(None), at, np.full((4, 2), (62, 1)), 0)


@pytest.mark.parametrize("name", ["anoto", "microdots"])
def test_6x6_windows_are_read_unrotated(name: str) -> None:
    windows, at, sections = draw(name, 600, (6, 6), 3)
    agrees(decode_exact(windows, codec(name)), slice(None), at, sections, 0)


@pytest.mark.slow
def test_libdots_6x6_with_two_positions_is_not_read() -> None:
    windows, at, sections = draw("libdots", 3000, (6, 6), 4)
    actual = decode_exact(windows, codec("libdots"))
    twice = repeated(at).any(axis=1)
    assert 0.05 < twice.mean() < 0.15
    assert not actual.ok[twice].any()
    agrees(actual, ~twice, at, sections, 0)
    nothing(actual)


@pytest.mark.slow
def test_libdots_7x7_knows_all_but_one_string() -> None:
    windows, at, sections = draw("libdots", 3000, (7, 7), 5)
    actual = decode_exact(windows, codec("libdots"))
    # 121222 at 198 and 218 is the one string of six digits that occurs twice.
    twice = np.isin(at % 241, [198, 218]).any(axis=1)
    assert twice.any()
    np.testing.assert_array_equal(actual.ok, ~twice)
    agrees(actual, ~twice, at, sections, 0)


@pytest.mark.slow
@pytest.mark.parametrize("rotation", range(4))
@pytest.mark.parametrize("size", [(6, 6), (6, 9), (7, 6)])
def test_small_windows_of_unknown_rotation_are_right_or_rejected(
    size: tuple[int, int], rotation: int
) -> None:
    windows, at, sections = draw("anoto", 1500, size, 6)
    actual = decode_exact(rotate_symbols(windows, rotation), codec("anoto"), (0, 1, 2, 3))
    assert actual.ok.mean() > 0.3
    agrees(actual, actual.ok, at, sections, rotation)
    nothing(actual)


def test_only_requested_rotations() -> None:
    windows, at, sections = draw("anoto", 200, (8, 8), 7)
    half = rotate_symbols(windows, 2)
    agrees(decode_exact(half, codec("anoto"), (0, 2)), slice(None), at, sections, 2)
    assert not decode_exact(half, codec("anoto"), (0, 1, 3)).ok.any()


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_one_wrong_bit_of_8x8_is_always_detected(name: str) -> None:
    windows, _, _ = draw(name, 6, (8, 8), 8)
    rows, columns, bits = np.indices((8, 8, 2)).reshape(3, -1)
    for window in windows:
        wrong = np.repeat(window[None], 128, axis=0)
        wrong[np.arange(128), rows, columns] ^= (1 + bits).astype(np.uint8)
        for rotation in range(4):
            actual = decode_exact(rotate_symbols(wrong, rotation), codec(name))
            assert not actual.ok.any()
            nothing(actual)


def test_one_wrong_bit_of_6x6_may_go_unseen() -> None:
    windows, at, _ = draw("anoto", 2000, (6, 6), 9)
    windows[:, 3, 3] ^= 1
    actual = decode_exact(windows, codec("anoto"))
    wrong = actual.ok & (actual.x != at[:, 0])
    assert 0.1 < wrong.mean() < 0.9  # it is so, and the docstring says it
    nothing(actual)


@given(st.integers(0, 2**32), st.integers(8, 12))
@settings(max_examples=20, deadline=None)
def test_noise_is_not_read(seed: int, side: int) -> None:
    noise = np.random.default_rng(seed).integers(0, 4, (2000, side, side))
    actual = decode_exact(noise, codec("anoto"))
    assert not actual.ok.any()
    nothing(actual)


def test_decoded_windows_equal_the_pattern() -> None:
    # Of any window that is read, however it came about, all dots are the codec's.
    noise = np.random.default_rng(11).integers(0, 4, (20_000, 6, 6)).astype(np.uint8)
    one = codec("anoto")
    actual = decode_exact(noise, one, (0, 1, 2, 3))
    assert 0.05 < actual.ok.mean() < 0.5
    for k in np.flatnonzero(actual.ok)[:300]:
        u, v = actual.section[k].tolist()
        printed = one.symbols((int(actual.x[k]), int(actual.y[k])), (6, 6), (u, v))
        np.testing.assert_array_equal(rotate_symbols(printed, int(actual.rotation[k])), noise[k])


@pytest.mark.parametrize("axis", [0, 1])
def test_window_across_the_border_is_not_read(axis: int) -> None:
    one = codec("anoto")
    at, size = [1000, 1000], [8, 8]
    at[axis], size[axis] = SECTION_LENGTH - 12, 12
    before = one.symbols((at[0], at[1]), (size[0], size[1]))
    # The section whose first lines go on as those before the border end: all digits begin
    # anew there, so that the windows across it are consistent, and yet no codec holds them.
    on = [SECTION_LENGTH % 63, SECTION_LENGTH % 63]
    on[axis] = int(one.phases(SECTION_LENGTH - 1) + one.differences(SECTION_LENGTH - 1)) % 63
    at[axis] = 0
    after = one.symbols((at[0], at[1]), (size[0], size[1]), (on[0], on[1]))
    both = np.concatenate([before, after], axis=1 - axis)
    windows = [both[:, k : k + 8] if axis == 0 else both[k : k + 8] for k in range(17)]
    actual = decode_exact(np.stack(windows), one)
    assert actual.ok.tolist() == [True] * 5 + [False] * 7 + [True] * 5


def test_anoto_sheet_read_as_another_codec() -> None:
    windows, at, _ = draw("anoto", 1000, (8, 8), 12)
    alt = decode_exact(windows, codec("microdots"))
    assert not (alt.ok & (alt.x == at[:, 0])).any()
    libdots = decode_exact(windows, codec("libdots"))
    right = libdots.ok & (libdots.x == at[:, 0]) & (libdots.y == at[:, 1])
    # 217 of 241 positions per axis
    assert abs(right.mean() - (217 / 241) ** 2) < 0.05


def test_no_windows_at_all() -> None:
    actual = decode_exact(np.zeros((0, 8, 8), np.uint8), codec("anoto"))
    assert actual.ok.shape == actual.x.shape == actual.rotation.shape == (0,)
    assert actual.section.shape == (0, 2)


def test_digits_of_shifts() -> None:
    shifts = np.arange(5, 59)
    a1, a2, a3, a4 = digits_of(shifts)
    np.testing.assert_array_equal(5 + a1 + 3 * a2 + 9 * a3 + 18 * a4, shifts)
    assert [int(a.max()) for a in (a1, a2, a3, a4)] == [2, 2, 1, 2]


@pytest.mark.parametrize(
    ("windows", "says"),
    [
        (np.zeros((3, 5, 8), np.uint8), "at least 6 x 6"),
        (np.zeros((8, 8), np.uint8), "at least 6 x 6"),
        (np.full((1, 8, 8), 4), "0..3"),
        (np.full((1, 8, 8), -1), "0..3"),
        (np.zeros((1, 8, 8)), "0..3"),
    ],
)
def test_invalid_windows_are_refused(windows: Any, says: str) -> None:
    with pytest.raises(InputError, match=says):
        decode_exact(windows, codec("anoto"))
