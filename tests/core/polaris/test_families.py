"""Families keep their distance, and never change."""

from __future__ import annotations

import hashlib
import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from locatk.core.errors import InputError
from locatk.core.polaris import codec
from locatk.core.polaris.codec import families
from locatk.core.polaris.tag import Tags

LARGE = Tags(order=5, magnets=13, orientations=20)
DESIGNS = [
    Tags(),
    Tags(magnets=4, orientations=16),
    Tags(order=4, magnets=8, orientations=7),
    Tags(order=2, magnets=3, orientations=2),
    LARGE,
    Tags(magnets=8, codec="redundant"),
    Tags(codec="polaris-released"),
]


def slow_distance(tags: Tags, one: int, other: int) -> int:
    """The definition, magnet by magnet."""
    layouts = [codec.layout_of(tags, tag_id) for tag_id in (one, other)]
    first, second = (dict(zip(a.cells, a.symbols, strict=True)) for a in layouts)
    total = 0
    for cell, symbol in first.items():
        if cell in second:
            rotation = (symbol - second[cell]) % tags.orientations
            total += min(rotation, tags.orientations - rotation)
        else:
            total += tags.orientations // 2
    return total


@st.composite
def designs_and_ids(draw, count: int) -> tuple[Tags, list[int]]:
    tags = draw(st.sampled_from(DESIGNS))
    some = st.integers(0, codec.capacity(tags) - 1)
    return tags, [draw(some) for _ in range(count)]


@settings(deadline=None)
@given(designs_and_ids(3))
def test_distance_is_the_documented_metric(case) -> None:
    tags, (a, b, c) = case
    ab, bc, ac = (families.distance(tags, *pair) for pair in ((a, b), (b, c), (a, c)))
    assert ab == slow_distance(tags, a, b)
    assert ab == families.distance(tags, b, a)
    assert (ab == 0) == (a == b)
    assert ac <= ab + bc
    assert ab <= tags.magnets * (tags.orientations // 2)


def test_placements_count() -> None:
    """Ids 0 and 8^5 differ in one magnet's cell alone."""
    tags = Tags()
    assert codec.layout_of(tags, 0).symbols == codec.layout_of(tags, 8**5).symbols
    assert families.distance(tags, 0, 8**5) == 4


@pytest.mark.slow
@given(st.sampled_from(DESIGNS), st.data())
@settings(max_examples=40, deadline=None)
def test_members_keep_the_distance(tags: Tags, data) -> None:
    distance = data.draw(st.integers(1, 4))
    count = data.draw(st.integers(1, 25 if tags.magnets > 3 else 2))
    if tags.order == 2:
        distance = min(distance, 3)
    ids = families.generate_family(tags, count, distance)
    assert len(set(ids)) == len(ids) == count
    pairs = [(a, b) for k, a in enumerate(ids) for b in ids[:k]]
    smallest = min((slow_distance(tags, a, b) for a, b in pairs), default=None)
    if smallest is not None:
        assert smallest >= distance
        assert families.smallest_distance(tags, ids) == smallest
    families.check_family(replace(tags, ids=ids, min_distance=distance))


@pytest.mark.slow
def test_a_longer_family_begins_with_the_shorter() -> None:
    tags = Tags()
    long = families.generate_family(tags, 2000, 4)
    assert families.generate_family(tags, 700, 4) == long[:700]
    assert families.smallest_distance(tags, long) == 4


def test_the_batch_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    tags = Tags(magnets=4)
    usual = families.generate_family(tags, 300, 4)
    closest = families.closest_pair(tags, usual)
    monkeypatch.setattr(families, "BATCH_IDS", 7)
    assert families.generate_family(tags, 300, 4) == usual
    assert families.closest_pair(tags, usual) == closest


@pytest.mark.parametrize(
    ("tags", "count", "distance", "first", "digest"),
    [
        (Tags(), 500, 3, (0, 202517, 77354, 279871), "14025e3a91eb278f"),
        (
            Tags(order=4, magnets=8, orientations=16),
            300,
            6,
            (0, 2102313129443, 803012160454, 2905325289897),
            "56536f8b04ecfa37",
        ),
        (
            Tags(magnets=8, codec="redundant"),
            100,
            6,
            (0, 2531, 966, 3497),
            "8654f8adf07437f6",
        ),
        (
            LARGE,
            50,
            10,
            (0, 17857779824714376092003, 6821064929428752184006, 24678844754143128276009),
            "09713b05d53db58d",
        ),
        (
            Tags(codec="polaris-released"),
            100,
            4,
            (0, 162013, 61882, 223895),
            "7e1fc9a372a9ebab",
        ),
    ],
)
def test_version_1_never_changes(tags, count, distance, first, digest) -> None:
    """Tags of these families lie on floors: another rule is another version, beside it."""
    assert families.FAMILY_RULE_VERSION == 1
    ids = families.generate_family(tags, count, distance)
    assert ids[:4] == first
    assert hashlib.sha256(" ".join(map(str, ids)).encode()).hexdigest()[:16] == digest


def test_all_ids_are_a_family_of_distance_one() -> None:
    tags = Tags(order=2, magnets=3, orientations=8)
    assert sorted(families.generate_family(tags, 512, 1)) == list(range(512))


def test_ids_beyond_the_codec_are_refused() -> None:
    tags = Tags(order=2, magnets=3, orientations=4)
    with pytest.raises(InputError, match="the codec has 64 ids"):
        families.generate_family(tags, 65, 1)
    with pytest.raises(InputError, match=r"\d+ found among all 64 ids") as caught:
        families.generate_family(tags, 9, 3)
    result = int(str(caught.value).split(": ")[1].split()[0])
    # As many as it says are there indeed.
    assert len(families.generate_family(tags, result, 3)) == result
    with pytest.raises(InputError):
        families.generate_family(tags, result + 1, 3)


def test_the_search_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(families, "MAX_CANDIDATES", 3000)
    with pytest.raises(InputError, match="found among the first 3000 of 327680 ids"):
        families.generate_family(Tags(), 900, 8)


@pytest.mark.parametrize(("count", "distance"), [(0, 1), (-3, 1), (5, 0)])
def test_families_that_are_none_are_not_made(count: int, distance: int) -> None:
    with pytest.raises(InputError):
        families.generate_family(Tags(), count, distance)


def test_the_two_closest_are_named() -> None:
    tags = Tags()
    ids = (0, 202517, 77354, 1, 279871)
    assert families.closest_pair(tags, ids) == (1, (0, 1))
    assert families.smallest_distance(tags, (5,)) == 20


@pytest.mark.parametrize(
    ("ids", "distance", "said"),
    [
        ((), 1, "without ids"),
        ((7, 9, 7), 1, "id 7 occurs twice"),
        ((0, 202517, 1), 3, "ids 0 and 1 have distance 1, not 3"),
        ((0, 327680), 1, "is not in 0"),
        (None, 3, "without ids"),
        ((0, 202517), 0, "minimum distance of 0"),
    ],
)
def test_a_list_that_is_no_family_is_refused(ids, distance: int, said: str) -> None:
    with pytest.raises(InputError, match=said):
        families.check_family(Tags(ids=ids, min_distance=distance))


# ---- large families


@pytest.mark.slow
@pytest.mark.parametrize(
    ("tags", "distance"),
    [
        (Tags(), 2),
        (Tags(), 4),
        (Tags(magnets=4, orientations=7), 3),
        (Tags(order=4, magnets=8, orientations=16), 5),
        (Tags(magnets=8, codec="redundant"), 3),
        (LARGE, 3),
    ],
)
def test_near_tags_are_those_of_a_full_comparison(
    tags: Tags, distance: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Families and closest pairs are the same with and without the table of keys."""
    monkeypatch.setattr(families, "IDS_PER_NEAR_TAG", 0.05)
    monkeypatch.setattr(families, "BATCH_IDS", 64)  # the table is used from the second batch on
    count = 60 if tags.codec == "redundant" else 400
    ids = families.generate_family(tags, count, distance)
    lists = (ids, ids[:50] + tuple(i + 1 for i in ids[:50]), (*ids[:40], ids[7]))
    pairs = [families.closest_pair(tags, each) for each in lists]
    monkeypatch.setattr(families, "IDS_PER_NEAR_TAG", math.inf)
    assert families.generate_family(tags, count, distance) == ids
    assert [families.closest_pair(tags, each) for each in lists] == pairs
    assert pairs[-1] == (0, (ids[7], ids[7]))


def test_equal_keys_of_different_tags_do_no_harm(monkeypatch: pytest.MonkeyPatch) -> None:
    """Numbers of which most are equal make most keys equal."""
    usual = families.generate_family(Tags(magnets=4), 2000, 2)

    class Coarse(families._NearTags):
        def __init__(self, tags: Tags, rows: np.ndarray) -> None:
            super().__init__(tags, rows)
            self.numbers = self.numbers % np.uint64(3)
            keys = self.numbers[np.arange(rows.shape[1]), rows].sum(axis=1, dtype=np.uint64)
            self.order = np.argsort(keys, kind="stable")
            self.keys = keys[self.order]

    monkeypatch.setattr(families, "IDS_PER_NEAR_TAG", 0.05)
    monkeypatch.setattr(families, "_NearTags", Coarse)
    assert families.generate_family(Tags(magnets=4), 2000, 2) == usual


@pytest.mark.parametrize(
    ("magnets", "orientations"), [(3, 2), (3, 4), (3, 5), (3, 6), (4, 3), (4, 4)]
)
def test_no_family_exceeds_the_bound(magnets: int, orientations: int) -> None:
    """Against families by greedy search in several orders; small ones of order 2 and 3."""
    tags = Tags(order=2 if magnets == 3 else 3, magnets=magnets, orientations=orientations)
    capacity = codec.capacity(tags)
    rows = families.symbol_table(tags, tuple(range(capacity)))
    distances = families._distances(tags, rows, rows)
    bounds = []
    for distance in range(1, magnets * (orientations // 2) + 2):
        bounds.append(families.max_family_size(tags, distance))
        for seed in range(4):
            order = np.arange(capacity)
            if seed:
                np.random.default_rng(seed).shuffle(order)
            is_open = np.ones(capacity, bool)
            size = 0
            for tag_id in order:
                if is_open[tag_id]:
                    size += 1
                    is_open &= distances[tag_id] >= distance
            assert size <= bounds[-1], distance
    assert bounds[0] == capacity
    assert bounds[-1] == 1
    assert bounds == sorted(bounds, reverse=True)


@pytest.mark.parametrize(
    ("magnets", "orientations", "distance", "words"),
    [
        (3, 7, 3, 49),  # perfect Lee code of radius 1 (Golomb and Welch, 1970)
        (3, 8, 2, 256),  # even sums
        (3, 4, 2, 32),  # even sums
        (3, 8, 12, 2),  # a word and its opposite
        (3, 2, 3, 2),  # repetition
    ],
)
def test_the_bound_is_reached_by_known_codes(
    magnets: int, orientations: int, distance: int, words: int
) -> None:
    tags = Tags(order=2, magnets=magnets, orientations=orientations)
    assert families.max_family_size(tags, distance) == words


def test_the_impossible_is_refused_before_the_search(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(families, "_near_any", None)
    with pytest.raises(InputError, match="there are at most 29780") as caught:
        families.generate_family(Tags(), 100_000, 3)
    assert caught.value.hint == (
        "Possible at best with a minimum distance of 2 or 6 magnets or 16 orientations"
    )
    with pytest.raises(InputError, match="there are at most 2") as caught:
        families.generate_family(Tags(order=2, magnets=3, orientations=4), 3, 5)
    assert "a minimum distance of 4" in caught.value.hint


def test_progress_is_reported() -> None:
    calls: list[None] = []
    families.generate_family(Tags(), 3000, 2, partial(calls.append, None))
    assert 60 <= len(calls) <= families.PROGRESS_STEPS
    calls.clear()
    tags = Tags(magnets=4, orientations=4)
    count = families.max_family_size(tags, 2)
    with pytest.raises(InputError):
        families.generate_family(tags, count, 2, partial(calls.append, None))
    assert len(calls) == families.PROGRESS_STEPS


@pytest.mark.slow
def test_a_hundred_thousand_tags() -> None:
    """A family of distance 2 with six magnets; all pairs are checked by keys."""
    ids = families.generate_family(Tags(magnets=6), 100_000, 2)
    assert families.closest_pair(Tags(magnets=6), ids)[0] == 2
