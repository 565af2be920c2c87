"""Ids and layouts are the same thing, at any size, and in the order that the docs promise."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from locatk.core.errors import InputError
from locatk.core.polaris import codec
from locatk.core.polaris.codec import mosk
from locatk.core.polaris.tag import CODECS, TagLayout, Tags

RELEASED = Tags(codec="polaris-released")

# Offline decoder of github.com/wjk5117/Polaris: occupied positions and their three bits
TABLE = {
    (1, 4, 5, 6, 8): "111",
    (1, 2, 3, 6, 8): "000",
    (1, 2, 4, 6, 8): "001",
    (1, 2, 5, 6, 8): "010",
    (1, 2, 6, 7, 8): "011",
    (1, 3, 4, 6, 8): "100",
    (1, 3, 5, 6, 8): "101",
    (1, 3, 6, 7, 8): "110",
}
BITS = ["111", "110", "010", "011", "001", "000", "100", "101"]
NUMBERED = {1: (0, 0), 2: (1, 0), 3: (0, 1), 4: (1, 1), 5: (2, 1), 6: (0, 2), 7: (1, 2), 8: (2, 2)}


@st.composite
def designs(draw) -> Tags:
    order = draw(st.integers(2, 7))
    magnets = draw(st.integers(3, order**2 - 1))
    return Tags(order=order, magnets=magnets, orientations=draw(st.integers(2, 40)))


@st.composite
def tags_and_ids(draw) -> tuple[Tags, int]:
    tags = draw(designs())
    return tags, draw(st.integers(0, codec.capacity(tags) - 1))


def hamming_distance_of(one: int, other: int) -> int:
    return (one ^ other).bit_count()


@pytest.mark.parametrize(
    ("order", "magnets", "orientations", "expected"),
    [(3, 4, 8, 20_480), (3, 5, 8, 327_680), (2, 3, 8, 512), (3, 8, 8, 2**24)],
)
def test_capacity_is_the_papers(order, magnets, orientations, expected) -> None:
    tags = Tags(order=order, magnets=magnets, orientations=orientations)
    assert codec.capacity(tags) == expected


def test_capacity_of_the_papers_large_tag() -> None:
    tags = Tags(order=4, magnets=8, orientations=16)
    assert math.log2(codec.capacity(tags)) == pytest.approx(41.6, abs=0.05)


@settings(deadline=None)
@given(tags_and_ids())
def test_every_id_has_a_layout_and_comes_back(case: tuple[Tags, int]) -> None:
    tags, tag_id = case
    layout = codec.layout_of(tags, tag_id)
    assert len(layout.cells) == len(layout.symbols) == tags.magnets
    assert codec.id_of(tags, layout) == tag_id


@pytest.mark.slow
@settings(deadline=None)
@given(designs(), st.data())
def test_every_layout_has_an_id_and_comes_back(tags: Tags, data) -> None:
    last = tags.order - 1
    free = {(c, r) for c in range(tags.order) for r in range(tags.order)}
    free -= {(0, 0), (0, last), (last, last), (last, 0)}
    mixed = data.draw(st.permutations(sorted(free)))
    cells = [(0, 0), (0, last), (last, last), *mixed[: tags.magnets - 3]]
    cells.sort(key=lambda cell: (cell[1], cell[0]))
    size = tags.magnets
    symbols = data.draw(
        st.lists(st.integers(0, tags.orientations - 1), min_size=size, max_size=size)
    )
    layout = TagLayout(tuple(cells), tuple(symbols))
    tag_id = codec.id_of(tags, layout)
    assert 0 <= tag_id < codec.capacity(tags)
    assert codec.layout_of(tags, tag_id) == layout


@pytest.mark.parametrize(("order", "magnets", "base"), [(3, 5, 4), (3, 4, 6), (3, 7, 2), (4, 5, 3)])
def test_ids_count_as_documented(order: int, magnets: int, base: int) -> None:
    """Every layout once, placements in lexicographic order, then the first magnet's digit."""
    tags = Tags(order=order, magnets=magnets, orientations=base)
    digit = {symbol: d for d, symbol in enumerate(by_word(base))}
    last = order - 1
    rows = [(c, r) for r in range(order) for c in range(order)]
    corners = [(0, 0), (0, last), (last, last)]
    free = [cell for cell in rows if cell not in [*corners, (last, 0)]]
    expected = 0
    for taken in itertools.combinations(free, magnets - 3):
        cells = tuple(cell for cell in rows if cell in corners or cell in taken)
        for digits in itertools.product(range(base), repeat=magnets):
            layout = codec.layout_of(tags, expected)
            assert layout.cells == cells
            assert tuple(digit[symbol] for symbol in layout.symbols) == digits
            expected += 1
    assert expected == codec.capacity(tags)


def by_word(base: int) -> list[int]:
    """Symbols in the order of their Gray words, from the rule as the docs have it."""
    length = 1
    while 2**length < base + base % 2:
        length += 1
    reflected = ["0", "1"]
    for _ in range(length - 1):
        reflected = ["0" + w for w in reflected] + ["1" + w for w in reversed(reflected)]
    half = (base + base % 2) // 2
    words = (reflected[:half] + reflected[-half:])[:base]
    return sorted(range(base), key=words.__getitem__)


@settings(deadline=None)
@given(st.integers(1, 200).map(lambda half: 2 * half))
def test_neighbouring_orientations_differ_in_one_bit(base: int) -> None:
    words = mosk.gray_words(base)
    assert len(set(words)) == base
    if base > 2:
        assert all(hamming_distance_of(words[s], words[s - 1]) == 1 for s in range(base))
    assert max(words).bit_length() == (base - 1).bit_length()


@settings(deadline=None)
@given(st.integers(1, 100).map(lambda half: 2 * half + 1))
def test_odd_orientations_differ_in_one_bit_but_at_the_wrap(base: int) -> None:
    words = mosk.gray_words(base)
    assert len(set(words)) == base
    assert all(hamming_distance_of(words[s], words[s - 1]) == 1 for s in range(1, base))
    assert hamming_distance_of(words[-1], words[0]) == 2


@settings(deadline=None)
@given(st.integers(2, 400))
def test_digits_are_a_permutation(base: int) -> None:
    digits = mosk.gray_digits(base)
    assert sorted(digits) == list(range(base))
    assert [digits[s] for s in mosk.gray_symbols(base)] == list(range(base))
    if base & (base - 1) == 0:
        assert digits == tuple(s ^ s >> 1 for s in range(base))


@settings(deadline=None)
@given(st.data())
def test_a_step_changes_one_bit_of_the_id(data) -> None:
    tags = Tags(orientations=data.draw(st.sampled_from([4, 8, 16])))
    tag_id = data.draw(st.integers(0, codec.capacity(tags) - 1))
    layout = codec.layout_of(tags, tag_id)
    symbols = list(layout.symbols)
    symbols[data.draw(st.integers(0, 4))] += data.draw(st.sampled_from([1, -1]))
    rotated = tuple(s % tags.orientations for s in symbols)
    assert hamming_distance_of(codec.id_of(tags, TagLayout(layout.cells, rotated)), tag_id) == 1


def test_released_ids_are_the_published_ones() -> None:
    cells = ((0, 0), (1, 1), (2, 1), (0, 2), (2, 2))
    assert codec.id_of(RELEASED, TagLayout(cells, (0, 0, 0, 0, 0))) == 262143
    assert codec.id_of(RELEASED, TagLayout(cells, (0, 1, 2, 3, 4))) == 255183


@settings(deadline=None)
@given(st.sampled_from(sorted(TABLE)), st.lists(st.integers(0, 7), min_size=5, max_size=5))
def test_released_ids_follow_the_table(numbers: tuple[int, ...], symbols: list[int]) -> None:
    layout = TagLayout(tuple(NUMBERED[n] for n in numbers), tuple(symbols))
    expected = int("".join(BITS[s] for s in symbols) + TABLE[numbers], 2)
    assert codec.id_of(RELEASED, layout) == expected
    assert codec.layout_of(RELEASED, expected) == layout


@pytest.mark.parametrize("numbers", [(1, 4, 6, 7, 8), (1, 5, 6, 7, 8)])
def test_two_placements_are_not_in_the_released_table(numbers: tuple[int, ...]) -> None:
    layout = TagLayout(tuple(NUMBERED[n] for n in numbers), (0,) * 5)
    with pytest.raises(InputError, match="no id"):
        codec.id_of(RELEASED, layout)


@pytest.mark.parametrize(
    "wrong",
    [
        {"order": 1, "magnets": 3},
        {"order": 3, "magnets": 2},
        {"order": 3, "magnets": 9},
        {"orientations": 1},
        {"codec": "aruco"},
        {"codec": "polaris-released", "magnets": 4},
        {"codec": "polaris-released", "orientations": 16},
        {"codec": "redundant", "magnets": 4},
        {"codec": "redundant", "order": 4, "magnets": 10},
        {"codec": "redundant", "orientations": 3},
    ],
)
def test_designs_that_cannot_be_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(InputError):
        codec.capacity(replace(Tags(), **wrong))


@pytest.mark.parametrize("name", CODECS)
def test_ids_beyond_the_capacity_are_refused(name: str) -> None:
    tags = Tags(codec=name)
    codec.layout_of(tags, codec.capacity(tags) - 1)
    for tag_id in (-1, codec.capacity(tags)):
        with pytest.raises(InputError, match="is not in 0"):
            codec.layout_of(tags, tag_id)


@pytest.mark.parametrize(
    ("cells", "symbols"),
    [
        (((0, 0), (1, 1), (0, 2), (2, 2)), (0,) * 4),  # one magnet short
        (((0, 0), (2, 1), (1, 1), (0, 2), (2, 2)), (0,) * 5),  # not in order
        (((0, 0), (1, 1), (1, 1), (0, 2), (2, 2)), (0,) * 5),  # twice
        (((0, 0), (1, 1), (3, 1), (0, 2), (2, 2)), (0,) * 5),  # beside the grid
        (((0, 0), (1, 1), (2, 1), (0, 2), (1, 2)), (0,) * 5),  # without v3
        (((0, 0), (2, 0), (1, 1), (0, 2), (2, 2)), (0,) * 5),  # on v4
        (((0, 0), (1, 1), (2, 1), (0, 2), (2, 2)), (0, 0, 0, 0, 8)),
        (((0, 0), (1, 1), (2, 1), (0, 2), (2, 2)), (0, 0, 0, 0)),
    ],
)
@pytest.mark.parametrize("name", CODECS)
def test_layouts_that_are_no_tag_are_refused(name: str, cells, symbols) -> None:
    with pytest.raises(InputError):
        codec.id_of(Tags(codec=name), TagLayout(cells, symbols))
