"""Properties of the codecs that decoding depends on."""

from __future__ import annotations

import json
from itertools import combinations, pairwise, product
from math import gcd
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from locatk.core.dots.codec import (
    MAIN_SEQUENCE_LENGTH,
    SECTION_LENGTH,
    SYMBOL_LETTERS,
    Codec,
    check_window,
    codec,
    sequences,
)
from locatk.core.errors import InputError

NAMES = ("anoto", "libdots", "microdots")

FOURTH = {
    "anoto": sequences.FOURTH_ANOTO,
    "libdots": sequences.FOURTH_LIBDOTS,
    "microdots": sequences.FOURTH_MICRODOTS,
}

names = st.sampled_from(NAMES)
positions = st.integers(0, SECTION_LENGTH - 100)
sections = st.tuples(st.integers(0, 62), st.integers(0, 62))


def cyclic(sequence: str, order: int) -> list[str]:
    """All strings of this length, one from each place of the sequence."""
    round_and_on = sequence * 2
    return [round_and_on[i : i + order] for i in range(len(sequence))]


def missing(sequence: str, order: int) -> set[str]:
    """Strings over the sequence's digits that are not in it."""
    every = {"".join(s) for s in product(sorted(set(sequence)), repeat=order)}
    return every - set(cyclic(sequence, order))


def flipped(bits: str) -> str:
    return bits.translate(str.maketrans("01", "10"))


def one_flip(bits: str) -> list[str]:
    return [bits[:i] + flipped(bits[i]) + bits[i + 1 :] for i in range(len(bits))]


# --- the definition of the pattern in plain Python, one position after the other


def shift(name: str, position: int) -> int:
    texts = (sequences.FIRST_DIGITS, sequences.SECOND_DIGITS, sequences.THIRD_DIGITS, FOURTH[name])
    a1, a2, a3, a4 = (int(text[position % len(text)]) for text in texts)
    return 5 + a1 + 3 * a2 + 9 * a3 + 18 * a4


def shifts_before(name: str, position: int) -> int:
    """Sum of all shifts before a place: whole rounds of each sequence, then what is left."""
    total = 5 * position
    texts = (sequences.FIRST_DIGITS, sequences.SECOND_DIGITS, sequences.THIRD_DIGITS, FOURTH[name])
    for weight, text in zip((1, 3, 9, 18), texts, strict=True):
        digits = [int(c) for c in text]
        total += weight * (
            position // len(text) * sum(digits) + sum(digits[: position % len(text)])
        )
    return total


def slow_letters(
    name: str, origin: tuple[int, int], size: tuple[int, int], section: tuple[int, int]
) -> list[str]:
    """Rows of u, d, l, r: no numpy, and no table but the digit strings."""
    (x, y), (columns, rows) = origin, size
    glyphs = {(0, 0): "u", (1, 0): "l", (0, 1): "r", (1, 1): "d"}  # (column bit, row bit)
    ox = [section[0] + shifts_before(name, x)]
    for i in range(columns - 1):
        ox.append(ox[-1] + shift(name, x + i))
    oy = [section[1] + shifts_before(name, y)]
    for j in range(rows - 1):
        oy.append(oy[-1] + shift(name, y + j))
    return [
        "".join(
            glyphs[
                int(sequences.MAIN_DIGITS[(ox[i] + y + j) % 63]),
                int(sequences.MAIN_DIGITS[(oy[j] + x + i) % 63]),
            ]
            for i in range(columns)
        )
        for j in range(rows)
    ]


def letters(symbols: np.ndarray[Any, Any]) -> list[str]:
    return ["".join(SYMBOL_LETTERS[s] for s in row) for row in symbols]


# --- sequences


def test_main_sequence_is_quasi_de_bruijn() -> None:
    assert len(sequences.MAIN_DIGITS) == MAIN_SEQUENCE_LENGTH == 63
    assert len(set(cyclic(sequences.MAIN_DIGITS, 6))) == 63
    assert missing(sequences.MAIN_DIGITS, 6) == {"111111"}


@pytest.mark.parametrize(
    ("sequence", "length", "absent"),
    [
        (sequences.FIRST_DIGITS, 236, 7),
        (sequences.SECOND_DIGITS, 233, 10),
        (sequences.THIRD_DIGITS, 31, 1),
        (sequences.FOURTH_ANOTO, 241, 2),
        (sequences.FOURTH_MICRODOTS, 241, 2),
    ],
)
def test_secondary_sequences_are_quasi_de_bruijn(sequence: str, length: int, absent: int) -> None:
    assert len(sequence) == length
    assert len(set(cyclic(sequence, 5))) == length
    assert len(missing(sequence, 5)) == absent


def test_libdots_repeats_six_strings() -> None:
    def repeated(order: int) -> dict[str, list[int]]:
        at: dict[str, list[int]] = {}
        for position, string in enumerate(cyclic(sequences.FOURTH_LIBDOTS, order)):
            at.setdefault(string, []).append(position)
        return {string: where for string, where in at.items() if len(where) > 1}

    assert repeated(5) == {
        "11100": [82, 238],
        "22111": [170, 236],
        "21110": [177, 237],
        "11212": [195, 217],
        "12122": [198, 218],
        "21222": [199, 219],
    }
    assert len(repeated(6)) == 1
    assert not repeated(7)


def test_anoto_is_the_only_insertion_that_works() -> None:
    published = sequences.FOURTH_LIBDOTS[:-1]
    assert len(published) == 240
    candidates = {published[:at] + digit + published[at:] for at in range(241) for digit in "012"}
    working = {text for text in candidates if len(set(cyclic(text, 5))) == 241}
    assert working == {sequences.FOURTH_ANOTO}
    assert published[:220] + "1" + published[220:] == sequences.FOURTH_ANOTO
    assert missing(sequences.FOURTH_ANOTO, 5) == {"11111", "22222"}


def test_lengths_are_coprime_and_make_the_range() -> None:
    for name in NAMES:
        lengths = [len(digits) for digits in codec(name).digits]
        assert all(gcd(a, b) == 1 for a, b in combinations(lengths, 2))
        assert int(np.prod(lengths)) == SECTION_LENGTH == 410_815_348


def test_every_shift_has_its_own_digits() -> None:
    digits = product(range(3), range(3), range(2), range(3))
    shifts = [
        sequences.MIN_SHIFT + sum(w * a for w, a in zip(sequences.DIGIT_WEIGHTS, d, strict=True))
        for d in digits
    ]
    assert sorted(shifts) == list(range(5, 59))


@pytest.mark.parametrize(("order", "both"), [(6, 62), (7, 0), (8, 0), (12, 0)])
def test_seven_bits_of_the_main_sequence_give_its_direction(order: int, both: int) -> None:
    strings = cyclic(sequences.MAIN_DIGITS, order)
    assert sum(flipped(s[::-1]) in strings for s in strings) == both


@pytest.mark.parametrize(("order", "unseen"), [(6, 372), (7, 92), (8, 0), (9, 0)])
def test_main_sequence_shows_a_flipped_bit_from_eight_bits_on(order: int, unseen: int) -> None:
    strings = set(cyclic(sequences.MAIN_DIGITS, order))
    assert sum(wrong in strings for s in strings for wrong in one_flip(s)) == unseen


@pytest.mark.parametrize(
    ("order", "least"), [(6, 1), (7, 1), (8, 2), (9, 2), (10, 2), (11, 2), (12, 2), (16, 4)]
)
def test_distance_of_strings_of_the_main_sequence(order: int, least: int) -> None:
    pairs = combinations(cyclic(sequences.MAIN_DIGITS, order), 2)
    assert min(sum(a != b for a, b in zip(*pair, strict=True)) for pair in pairs) == least


def test_published_digits(data: Path) -> None:
    file = data / "dots" / "sequences.json"
    if not file.exists():
        pytest.skip(f"{file} is not there")
    published = json.loads(file.read_text(encoding="utf-8"))
    ours = {
        "MNS": sequences.MAIN_DIGITS,
        "A1": sequences.FIRST_DIGITS,
        "A2": sequences.SECOND_DIGITS,
        "A3": sequences.THIRD_DIGITS,
        "A4_libdots": sequences.FOURTH_LIBDOTS,
        "A4_recovered": sequences.FOURTH_ANOTO,
        "A4_alt": sequences.FOURTH_MICRODOTS,
    }
    for key, text in ours.items():
        assert published[key]["digits"] == text, key
    basis = published["decomposition"]
    assert basis["d_range"] == [5, 58]
    assert tuple(basis["bases"]) == sequences.DIGIT_BASES
    assert basis["crt_product"] == SECTION_LENGTH
    for word, bits in published["bits"]["glyph_to_(column_bit,row_bit)"].items():
        assert bits[0] + 2 * bits[1] == SYMBOL_LETTERS.index(word[0])
    truth = published["real_image_truth"]
    assert truth["section_(u,v)_if_A4_libdots"] == [24, 32]
    pages = published["anoto_page_truth"]["ronyeh/papertoolkit data/pattern/default/N.pattern"]
    assert pages["top_left"] == ["184022430+1330*N", 7200]
    for page in range(10):  # genuine sheets lie whole in one section
        origin = (184_022_430 + 1330 * page, 7200)
        check_window(origin, tuple(pages["size_cols_rows"]), tuple(pages["section"]))


def test_section_of_a_sheet_that_starts_at_zero_by_itself() -> None:
    # Cellulo's generatePattern.py begins each sheet with shift 0 at its own corner; the
    # published frame was read as of a sheet from (0, 3000) on, in section (24, 32).
    libdots = codec("libdots")
    u, v = -3000 % 63, -shifts_before("libdots", 3000) % 63
    assert (u, v) == (24, 32)
    sheet = libdots.symbols((0, 3000), (30, 30), (u, v))
    assert letters(sheet[:1, :])[0] == "".join(
        SYMBOL_LETTERS[c + 2 * r]
        for i in range(30)
        for c in [int(sequences.MAIN_DIGITS[shifts_before("libdots", i) % 63])]
        for r in [int(sequences.MAIN_DIGITS[i])]
    )


# --- closed form


def test_first_bits_are_those_of_py_microdots() -> None:
    # Its tests (cheind/py-microdots, tests/test_anoto.py) expect these, in u and v alike.
    for section, bits in (((0, 0), "00000010"), ((1, 1), "00000100")):
        window = codec("anoto").symbols((0, 0), (8, 8), section)
        assert "".join(map(str, window[:, 0] & 1)) == bits
        assert "".join(map(str, window[0] >> 1)) == bits


@pytest.mark.slow
@given(names, positions, positions, st.integers(1, 20), st.integers(1, 20), sections)
@example("anoto", 0, 0, 9, 9, (0, 0))
@example("libdots", SECTION_LENGTH - 100, SECTION_LENGTH - 100, 100, 100, (62, 62))
@settings(max_examples=60, deadline=None)
def test_closed_form_equals_the_slow_reference(
    name: str, x: int, y: int, columns: int, rows: int, section: tuple[int, int]
) -> None:
    fast = codec(name).symbols((x, y), (columns, rows), section)
    assert fast.shape == (rows, columns)
    assert fast.dtype == np.uint8
    assert letters(fast) == slow_letters(name, (x, y), (columns, rows), section)


@pytest.mark.parametrize("name", NAMES)
def test_phases_are_sums_one_by_one(name: str) -> None:
    count = 60_000
    total, expected = 7, []
    for position in range(count):
        expected.append(total % 63)
        total += shift(name, position)
    np.testing.assert_array_equal(codec(name).phases(np.arange(count), 7), expected)


@given(names, st.integers(0, SECTION_LENGTH - 400), st.integers(1, 300), st.integers(0, 62))
@settings(max_examples=60, deadline=None)
def test_phases_grow_by_the_shifts_between(name: str, start: int, count: int, section: int) -> None:
    one = codec(name)
    between = [shift(name, start + i) for i in range(count)]
    assert one.differences(np.arange(start, start + count)).tolist() == between
    first, last = one.phases([start, start + count], section)
    assert (last - first) % 63 == sum(between) % 63


@given(names, st.lists(st.integers(0, SECTION_LENGTH - 1), min_size=1, max_size=5))
@example("anoto", [0, 1, 235, 236, 240, 241, SECTION_LENGTH - 1])
def test_position_of_residues(name: str, chosen: list[int]) -> None:
    one = codec(name)
    residues = [[p % len(digits) for digits in one.digits] for p in chosen]
    assert one.position(residues).tolist() == chosen


@given(names, positions, positions, sections, st.integers(0, 30), st.integers(0, 30))
@settings(max_examples=40, deadline=None)
def test_a_window_is_part_of_every_larger_one(
    name: str, x: int, y: int, section: tuple[int, int], right: int, down: int
) -> None:
    large = codec(name).symbols((x, y), (40, 40), section)
    small = codec(name).symbols((x + right, y + down), (10, 9), section)
    np.testing.assert_array_equal(large[down : down + 9, right : right + 10], small)


def test_sections_shift_columns_and_rows() -> None:
    one = codec("anoto")
    first = one.symbols((5, 9), (70, 70), (0, 0))
    np.testing.assert_array_equal(one.symbols((5, 9), (70, 70), (3, 0))[:67] & 1, first[3:] & 1)
    np.testing.assert_array_equal(
        one.symbols((5, 9), (70, 70), (0, 4))[:, :66] >> 1, first[:, 4:] >> 1
    )
    corners = {one.symbols((5, 9), (8, 8), (u, v)).tobytes() for u in range(63) for v in range(63)}
    assert len(corners) == 63 * 63


@pytest.mark.parametrize("name", NAMES)
def test_columns_hold_the_main_sequence_and_shift_by_5_to_58(name: str) -> None:
    symbols = codec(name).symbols((184_022_430, 7200), (300, 63))
    where = ["".join(map(str, column & 1)) for column in symbols.T]
    strings = cyclic(sequences.MAIN_DIGITS, 63)
    at = [strings.index(w) for w in where]
    assert all(5 <= (b - a) % 63 <= 58 for a, b in pairwise(at))


# --- bad input


@pytest.mark.parametrize(
    ("origin", "size", "section", "says"),
    [
        ((-1, 0), (8, 8), (0, 0), "origin x -1"),
        ((0, SECTION_LENGTH), (8, 8), (0, 0), f"origin y {SECTION_LENGTH}"),
        ((10**12, 0), (8, 8), (0, 0), "origin x"),
        ((SECTION_LENGTH - 7, 0), (8, 8), (0, 0), "border of the section"),
        ((0, SECTION_LENGTH - 1), (8, 2), (0, 0), "border of the section"),
        ((0, 0), (0, 8), (0, 0), "0 x 8 dots"),
        ((0, 0), (8, 8), (63, 0), "section 63,0"),
        ((0, 0), (8, 8), (0, -1), "section 0,-1"),
    ],
)
def test_windows_that_no_section_holds_are_refused(
    origin: tuple[int, int], size: tuple[int, int], section: tuple[int, int], says: str
) -> None:
    with pytest.raises(InputError, match=says):
        check_window(origin, size, section)
    with pytest.raises(InputError, match=says):
        codec("anoto").symbols(origin, size, section)


def test_the_last_window_of_a_section_is_its_last() -> None:
    assert codec("anoto").symbols((SECTION_LENGTH - 8, SECTION_LENGTH - 8), (8, 8)).shape == (8, 8)


def test_codecs_by_name() -> None:
    assert isinstance(codec("anoto"), Codec)
    assert codec("anoto") is codec("anoto")
    with pytest.raises(InputError, match="no codec 'ncode'") as caught:
        codec("ncode")
    assert all(name in str(caught.value.hint) for name in NAMES)
