"""The redundant code keeps its promise: against brute force over all of its words."""

from __future__ import annotations

import itertools
from functools import cache

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from locatk.core.errors import InputError
from locatk.core.polaris import codec
from locatk.core.polaris.codec import redundant
from locatk.core.polaris.tag import TagLayout, Tags

DESIGNS = [
    *(Tags(order=4, magnets=m, orientations=8, codec="redundant") for m in range(5, 10)),
    *(Tags(order=4, magnets=m, orientations=16, codec="redundant") for m in (5, 8, 15)),
    Tags(order=5, magnets=17, orientations=16, codec="redundant"),
    Tags(order=5, magnets=20, orientations=20, codec="redundant"),
    Tags(order=3, magnets=6, orientations=6, codec="redundant"),
    Tags(order=3, magnets=8, orientations=12, codec="redundant"),
]
BUDGET = 3


def design(magnets: int, orientations: int) -> Tags:
    return Tags(order=4, magnets=magnets, orientations=orientations, codec="redundant")


@cache
def words(magnets: int, orientations: int) -> tuple[tuple[int, ...], ...]:
    tags = design(magnets, orientations)
    return tuple(codec.layout_of(tags, i).symbols for i in range(codec.capacity(tags)))


def errors(word: tuple[int, ...], observed: tuple[int | None, ...]) -> int:
    return sum(s is not None and s != w for w, s in zip(word, observed, strict=True))


@pytest.mark.parametrize(
    ("orientations", "size"),
    [(4, 4), (5, 5), (6, 5), (8, 8), (10, 8), (12, 11), (16, 16), (20, 19)],
)
def test_the_field_is_the_largest_that_fits(orientations: int, size: int) -> None:
    assert redundant.field_size(orientations) == size


@pytest.mark.parametrize("size", [3, 4, 5, 7, 8, 11, 13, 16, 19])
def test_the_field_is_a_field(size: int) -> None:
    field = redundant.finite_field(size)
    everything = range(size)
    for a in everything:
        assert field.multiply(a, 1) == a
        assert field.subtract(a, 0) == a
        assert sorted(field.subtract(a, b) for b in everything) == list(everything)
        if a:
            assert sorted(field.multiply(a, b) for b in everything) == list(everything)
            assert all(field.multiply(field.divide(b, a), a) == b for b in everything)
    for a, b, c in itertools.product(everything, repeat=3):
        left = field.multiply(a, field.subtract(b, c))
        assert left == field.subtract(field.multiply(a, b), field.multiply(a, c))
        assert field.multiply(a, field.multiply(b, c)) == field.multiply(field.multiply(a, b), c)


@pytest.mark.parametrize(
    ("magnets", "orientations"), [(5, 4), (5, 5), (6, 5), (5, 8), (6, 8), (7, 8), (7, 7)]
)
def test_words_differ_in_five_places(magnets: int, orientations: int) -> None:
    pairs = itertools.combinations(words(magnets, orientations), 2)
    assert min(errors(one, other) for one, other in pairs) == 5


@pytest.mark.slow
@pytest.mark.parametrize(("magnets", "orientations", "step"), [(5, 4, 1), (5, 5, 4), (6, 5, 17)])
def test_decoding_is_optimal_for_any_observation(
    magnets: int, orientations: int, step: int
) -> None:
    """Of every ``step``-th observation, exactly what brute force over the words would accept."""
    tags = design(magnets, orientations)
    known = words(magnets, orientations)
    alphabet = [None, *range(orientations)]
    every = itertools.product(alphabet, repeat=magnets)
    for observed in itertools.islice(every, 0, None, step):
        missing = observed.count(None)
        near = [word for word in known if 2 * errors(word, observed) + missing <= BUDGET]
        assert len(near) <= 1
        assert redundant.decode_word(tags, observed) == (near[0] if near else None)


def test_every_missing_magnet_with_every_misread_is_corrected() -> None:
    tags = design(5, 8)
    for word in words(5, 8):
        for missing, wrong in itertools.permutations(range(5), 2):
            for symbol in range(8):
                observed: list[int | None] = list(word)
                observed[missing], observed[wrong] = None, symbol
                assert redundant.decode_word(tags, observed) == word


@st.composite
def damaged(draw) -> tuple[Tags, tuple[int, ...], list[int | None], int, int]:
    """A design, a word of it, what is seen, and the numbers of misread and missing."""
    tags = draw(st.sampled_from(DESIGNS))
    size = redundant.field_size(tags.orientations)
    word = codec.layout_of(tags, draw(st.integers(0, codec.capacity(tags) - 1))).symbols
    missing = draw(st.integers(0, 3))
    misread = draw(st.integers(0, (BUDGET - missing) // 2 + 1))
    positions = draw(st.permutations(range(tags.magnets)))
    observed: list[int | None] = list(word)
    for position in positions[:missing]:
        observed[position] = None
    for position in positions[missing : missing + misread]:
        by = draw(st.integers(1, size - 1))
        observed[position] = (word[position] + by) % size
    return tags, word, observed, misread, missing


@pytest.mark.slow
@settings(deadline=None, max_examples=200)
@given(damaged())
def test_the_promise_holds_at_any_size(case) -> None:
    """Within the budget the word comes back; one misread more is noticed."""
    tags, word, observed, misread, missing = case
    expected = word if 2 * misread + missing <= BUDGET else None
    assert redundant.decode_word(tags, observed) == expected


@pytest.mark.slow
@settings(deadline=None)
@given(st.sampled_from([t for t in DESIGNS if t.magnets > 5]), st.data())
def test_three_misreads_of_a_whole_tag_are_noticed(tags: Tags, data) -> None:
    size = redundant.field_size(tags.orientations)
    observed = list(
        codec.layout_of(tags, data.draw(st.integers(0, codec.capacity(tags) - 1))).symbols
    )
    for position in data.draw(st.permutations(range(tags.magnets)))[:3]:
        observed[position] = (observed[position] + data.draw(st.integers(1, size - 1))) % size
    assert redundant.decode_word(tags, observed) is None


@settings(deadline=None)
@given(st.sampled_from(DESIGNS), st.data())
def test_ids_come_back(tags: Tags, data) -> None:
    tag_id = data.draw(st.integers(0, codec.capacity(tags) - 1))
    layout = codec.layout_of(tags, tag_id)
    assert layout.cells == redundant.cells(tags)
    assert codec.id_of(tags, layout) == tag_id


def test_an_orientation_that_no_word_has_counts_as_missing() -> None:
    tags = DESIGNS[-3]
    assert tags.orientations == 20
    word = codec.layout_of(tags, 123456789).symbols
    observed: list[int | None] = list(word)
    observed[3] = observed[7] = 19
    observed[11] = None
    assert redundant.decode_word(tags, observed) == word


def test_words_never_change() -> None:
    """Printed tags outlive releases."""
    assert codec.layout_of(design(8, 8), 1234).symbols == (2, 3, 2, 2, 3, 4, 0, 6)
    assert codec.layout_of(design(9, 8), 1234).symbols == (0, 2, 3, 2, 2, 1, 4, 4, 1)
    assert codec.layout_of(design(6, 12), 77).symbols == (7, 0, 7, 8, 5, 6)
    assert codec.layout_of(design(8, 16), 54321).symbols == (13, 4, 3, 1, 15, 9, 6, 11)


@settings(deadline=None)
@given(st.data())
def test_the_checks_are_the_documented_ones(data) -> None:
    """Where the field is a prime's, plain arithmetic tells."""
    orientations, prime = data.draw(st.sampled_from([(5, 5), (7, 7), (12, 11), (20, 19)]))
    tags = design(data.draw(st.integers(5, min(15, prime + 1))), orientations)
    word = codec.layout_of(tags, data.draw(st.integers(0, codec.capacity(tags) - 1))).symbols
    infinity = word[prime] if len(word) > prime else 0
    for j in range(4):
        total = sum(w * x**j for x, w in enumerate(word[:prime]))
        assert (total + (infinity if j == 3 else 0)) % prime == 0


def test_layouts_that_are_no_word_are_refused() -> None:
    tags = design(7, 8)
    layout = codec.layout_of(tags, 100)
    rotated = (layout.symbols[0] ^ 1, *layout.symbols[1:])
    with pytest.raises(InputError, match="no word"):
        codec.id_of(tags, TagLayout(layout.cells, rotated))
    moved = (*layout.cells[:-3], (1, 2), *layout.cells[-2:])
    with pytest.raises(InputError, match="in the cells"):
        codec.id_of(tags, TagLayout(moved, layout.symbols))
