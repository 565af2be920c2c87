"""A tag is read as brute force over all ids would, or refused with the reason."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from locatk.core.polaris import codec
from locatk.core.polaris.codec import families, redundant
from locatk.core.polaris.identification.decoding import (
    MAX_TIE_STEPS,
    DecodedTag,
    coincidence_probability,
    decode_tag,
)
from locatk.core.polaris.tag import AsBuiltTag, Cell, PlanarPose, Tags

SMALL = Tags(order=2, magnets=3, orientations=5)
DEFAULT = Tags()
RELEASED = Tags(codec="polaris-released")
WIDE = Tags(order=4, magnets=13, orientations=20)
REDUNDANT = Tags(magnets=6, codec="redundant")


@cache
def family(count: int, distance: int) -> Tags:
    ids = families.generate_family(DEFAULT, count, distance)
    return replace(DEFAULT, ids=ids, min_distance=distance)


def magnets(tags: Tags, tag_id: int) -> tuple[list[Cell], np.ndarray]:
    layout = codec.layout_of(tags, tag_id)
    return list(layout.cells), np.array(layout.symbols, float)


def with_rotated_magnets(tags: Tags, *steps: float) -> AsBuiltTag:
    """Return a tag whose magnets are rotated by steps clockwise from their designed angles."""
    return AsBuiltTag(np.zeros((len(steps), 2)), -np.array(steps) * tags.step_rad, 1)


def apart(tags: Tags, one: float, other: float) -> float:
    rotation = (one - other) % tags.orientations
    return min(rotation, tags.orientations - rotation)


def soft_distance(
    tags: Tags, tag_id: int, cells: list[Cell], steps: Iterable[float], built: bool = False
) -> float:
    """The definition, magnet by magnet."""
    layout = codec.layout_of(tags, tag_id)
    expected = {c: float(s) for c, s in zip(layout.cells, layout.symbols, strict=True)}
    if built:
        for k, cell in enumerate(layout.cells):
            expected[cell] -= tags.built[tag_id].angle_rad[k] / (math.tau / tags.orientations)
    return sum(
        apart(tags, step, expected[cell]) if cell in expected else tags.orientations // 2
        for cell, step in zip(cells, steps, strict=True)
    )


def brute(tags: Tags, ids, cells: list[Cell], steps: np.ndarray) -> tuple[int, float]:
    """Nearest id, built ones as built, and its margin over rivals in their best form."""
    own, rival = {}, {}
    for tag_id in ids:
        nominal = soft_distance(tags, tag_id, cells, steps)
        as_built = tag_id in tags.built
        own[tag_id] = soft_distance(tags, tag_id, cells, steps, True) if as_built else nominal
        rival[tag_id] = min(own[tag_id], nominal)
    best = min(own, key=own.__getitem__)
    return best, min(d for tag_id, d in rival.items() if tag_id != best) - own[best]


offsets = st.floats(-0.42, 0.42)
designs = st.sampled_from([SMALL, DEFAULT, RELEASED, WIDE])


# --- every id may occur


@pytest.mark.slow
@settings(deadline=None)
@given(designs, st.data())
def test_installed_tags_are_decoded(tags: Tags, data) -> None:
    """In any order of the magnets, at any wrap, off by less than half a step."""
    tag_id = data.draw(st.integers(0, codec.capacity(tags) - 1))
    cells, steps = magnets(tags, tag_id)
    off = np.array([data.draw(offsets) for _ in cells])
    wraps = np.array([data.draw(st.integers(-3, 3)) for _ in cells]) * tags.orientations
    order = data.draw(st.permutations(range(len(cells))))
    reading = decode_tag(tags, [cells[k] for k in order], (steps + off + wraps)[order])
    assert reading.tag_id == tag_id
    assert (reading.refused, reading.corrected, reading.erased) == ("", 0, 0)
    assert reading.symbols == tuple(int(steps[k]) for k in order)
    assert reading.margin == pytest.approx(1 - 2 * np.abs(off).max())


@settings(deadline=None)
@given(st.data())
def test_the_released_ids_are_read(data) -> None:
    cells = [(0, 0), (1, 1), (2, 1), (0, 2), (2, 2)]
    off = np.array([data.draw(st.floats(-0.3, 0.3)) for _ in cells])
    assert decode_tag(RELEASED, cells, off).tag_id == 262143
    assert decode_tag(RELEASED, cells, np.arange(5) + off).tag_id == 255183


@settings(deadline=None)
@given(designs, st.data())
def test_an_orientation_between_two_is_a_tie(tags: Tags, data) -> None:
    cells, steps = magnets(tags, data.draw(st.integers(0, codec.capacity(tags) - 1)))
    k = data.draw(st.integers(0, len(cells) - 1))
    steps[k] += data.draw(st.floats(0.5 - 0.49 * MAX_TIE_STEPS, 0.5 + 0.49 * MAX_TIE_STEPS))
    reading = decode_tag(tags, cells, steps)
    assert (reading.tag_id, reading.refused) == (None, "tie")
    assert 0 <= reading.margin < MAX_TIE_STEPS


@pytest.mark.parametrize(("sigma", "refused"), [(0.01, ""), (0.03, ""), (0.04, "tie")])
def test_near_a_border_it_depends_on_sigma(sigma: float, refused: str) -> None:
    """0.1 steps from the border are three standard deviations of 0.033."""
    cells, steps = magnets(DEFAULT, 4711)
    steps[2] += 0.4
    assert decode_tag(DEFAULT, cells, steps, np.full(5, sigma)).refused == refused
    # Of the other magnets it does not matter: they are far from theirs.
    others = np.full(5, 0.1)
    others[2] = 0.01
    assert decode_tag(DEFAULT, cells, steps, others).refused == ""


def test_a_sigma_that_is_not_known_is_none() -> None:
    cells, steps = magnets(DEFAULT, 4711)
    assert decode_tag(DEFAULT, cells, steps, np.full(5, np.nan)) == decode_tag(
        DEFAULT, cells, steps
    )


def test_refusals_name_their_reason() -> None:
    cells, steps = magnets(DEFAULT, 5 * 8**5 + 1234)
    free = next(k for k, cell in enumerate(cells) if cell not in [(0, 0), (0, 2), (2, 2)])

    def reason(cells: list[Cell], steps: np.ndarray, tags: Tags = DEFAULT) -> str:
        reading = decode_tag(tags, cells, steps)
        assert reading.tag_id is None
        assert len(reading.symbols) == len(cells)
        return reading.refused

    without = [k for k in range(5) if k != free]
    assert reason([cells[k] for k in without], steps[without]) == "magnets_missing"
    assert reason(cells[1:], steps[1:]) == "vertex_missing"
    spare = next(c for c in [(1, 0), (0, 1), (1, 1), (2, 1), (1, 2)] if c not in cells)
    assert reason([*cells, spare], np.append(steps, 1)) == "too_many_magnets"
    assert reason([*cells[1:], spare], steps) == "vertex_missing"
    assert reason([*cells[1:], (2, 0)], steps) == "corner_occupied"
    assert reason([*cells[1:], (3, 0)], steps) == "outside_grid"
    assert reason([*cells[1:], cells[1]], steps) == "cell_twice"
    unknown = steps.copy()
    unknown[free] = np.nan
    assert reason(cells, unknown) == "magnets_missing"
    assert reason([], np.empty(0)) == "magnets_missing"
    # The table of the released code (github.com/wjk5117/Polaris) has 8 of the 10 placements.
    assert reason([(0, 0), (1, 1), (0, 2), (1, 2), (2, 2)], steps, RELEASED) == "no_such_placement"


def test_arguments_that_do_not_fit_are_a_mistake_of_the_caller() -> None:
    cells, steps = magnets(DEFAULT, 4711)
    with pytest.raises(ValueError, match="5 cells"):
        decode_tag(DEFAULT, cells, steps[:4])
    with pytest.raises(ValueError, match="5 cells"):
        decode_tag(DEFAULT, cells, steps, np.zeros(4))


# --- as built


@pytest.mark.slow
@settings(deadline=None)
@given(st.data())
def test_with_tags_as_built_it_is_the_nearest_of_all_ids(data) -> None:
    """Against brute force over all ids of a small design."""
    shifts = st.lists(st.floats(-0.8, 0.8), min_size=3, max_size=3)
    ids = st.integers(0, codec.capacity(SMALL) - 1)
    built = data.draw(st.dictionaries(ids, shifts, max_size=4))
    tags = replace(
        SMALL, built={i: with_rotated_magnets(SMALL, *shift) for i, shift in built.items()}
    )
    some = data.draw(st.sampled_from(sorted(built)) if built and data.draw(st.booleans()) else ids)
    cells, steps = magnets(tags, some)
    steps += [data.draw(st.floats(-1, 1)) for _ in cells]
    best, margin = brute(tags, range(codec.capacity(tags)), cells, steps)
    assume(abs(margin - MAX_TIE_STEPS) > 1e-9)
    reading = decode_tag(tags, cells, steps)
    assert reading.tag_id == (best if margin >= MAX_TIE_STEPS else None)
    if reading.tag_id is not None:
        assert reading.margin == pytest.approx(margin)


def test_a_measured_error_of_13_degrees_is_decoded_at_16_orientations() -> None:
    """The default tag of the published recordings (github.com/wjk5117/Polaris) has one."""
    design = Tags(orientations=16)
    cells, steps = magnets(design, 54321)
    installed = np.array([4.3, -2.2, 13.0, 0.0, -2.8]) / 22.5
    assert decode_tag(design, cells, steps + installed).tag_id != 54321
    known = replace(design, built={54321: with_rotated_magnets(design, *installed)})
    reading = decode_tag(known, cells, steps + installed + 0.02)
    assert reading.tag_id == 54321
    assert reading.corrected == 0
    assert reading.margin > 0.3
    # And the tag that this one was mistaken for is read still where it lies.
    neighbour = decode_tag(design, cells, steps + installed).tag_id
    assert neighbour is not None
    assert decode_tag(known, *magnets(known, neighbour)).tag_id == neighbour


def test_a_tag_that_is_not_as_it_was_built_is_not_another() -> None:
    tags = replace(DEFAULT, built={4711: with_rotated_magnets(DEFAULT, 0, 0.45, 0, 0, 0)})
    cells, steps = magnets(tags, 4711)
    steps[1] -= 0.4
    assert decode_tag(tags, cells, steps).refused == "tie"


# --- families


@pytest.mark.slow
@settings(deadline=None)
@given(st.data())
def test_members_are_read_as_by_brute_force(data) -> None:
    """Whatever is seen: the nearest member within reach, else nothing."""
    tags = family(40, 7)
    member = data.draw(st.sampled_from(tags.ids))
    if data.draw(st.booleans()):
        shift = [data.draw(st.floats(-0.3, 0.3)) for _ in range(5)]
        tags = replace(tags, built={member: with_rotated_magnets(tags, *shift)})
    cells, steps = magnets(tags, member)
    steps += [data.draw(st.floats(-1.6, 1.6)) for _ in cells]
    best, margin = brute(tags, tags.ids, cells, steps)
    assume(abs(margin - MAX_TIE_STEPS) > 1e-9)
    # Whole steps from what is expected of the best, magnet by magnet.
    as_built = best in tags.built
    alone = [
        soft_distance(tags, best, [c], [s], as_built) for c, s in zip(cells, steps, strict=True)
    ]
    assume(all(abs(d % 1 - 0.5) > 1e-9 for d in alone))
    corrected = sum(round(d) for d in alone)
    reading = decode_tag(tags, cells, steps)
    assert reading.margin == pytest.approx(margin)
    assert reading.tag_id == (best if margin >= MAX_TIE_STEPS and corrected <= 3 else None)
    if reading.tag_id is not None:
        assert reading.corrected == corrected


@pytest.mark.slow
@settings(deadline=None)
@given(st.data())
def test_a_family_corrects_half_its_distance(data) -> None:
    """Distance 7: three steps, in one magnet or in three, whoever is misread."""
    tags = family(200, 7)
    member = data.draw(st.sampled_from(tags.ids))
    cells, steps = magnets(tags, member)
    for k in data.draw(st.lists(st.integers(0, 4), max_size=3)):
        steps[k] += data.draw(st.sampled_from([-1, 1]))
    hit = np.rint(steps - magnets(tags, member)[1])
    wrong = int(np.abs(hit).sum())
    reading = decode_tag(tags, cells, steps)
    assert (reading.tag_id, reading.corrected, reading.refused) == (member, wrong, "")
    assert reading.symbols == tuple(int(s) for s in magnets(tags, member)[1])
    assert reading.margin >= 7 - 2 * wrong


@settings(deadline=None)
@given(st.data())
def test_beyond_half_its_distance_nothing_is_read_as_another(data) -> None:
    """Distance 7, four steps: as far as another member may be three, else noticed."""
    tags = family(200, 7)
    member = data.draw(st.sampled_from(tags.ids))
    cells, steps = magnets(tags, member)
    k, other = data.draw(st.permutations(range(5)))[:2]
    steps[k] += 2
    steps[other] -= 2
    reading = decode_tag(tags, cells, steps)
    if reading.tag_id is None:
        assert reading.refused in ("not_in_family", "tie")
    else:
        assert soft_distance(tags, reading.tag_id, cells, steps) <= 3


def test_between_two_members_is_a_tie() -> None:
    cells, steps = magnets(DEFAULT, 0)
    ids = tuple(codec.id_of(DEFAULT, layout) for layout in _rotated_layouts(0, (0, 2)))
    tags = replace(DEFAULT, ids=ids, min_distance=2)
    assert families.smallest_distance(tags, ids) == 2
    steps[1] += 1
    reading = decode_tag(tags, cells, steps)
    assert (reading.tag_id, reading.refused, reading.margin) == (None, "tie", 0)


def _rotated_layouts(tag_id: int, by):
    layout = codec.layout_of(DEFAULT, tag_id)
    for steps in by:
        symbols = list(layout.symbols)
        symbols[1] += steps
        yield replace(layout, symbols=tuple(symbols))


@pytest.mark.slow
def test_a_foreign_tag_is_not_in_the_family() -> None:
    tags = family(100, 6)
    near = {i for i in range(0, 327680, 997) if families.distance(tags, i, tags.ids[0]) > 0}
    for tag_id in sorted(near)[:60]:
        nearest = min(families.distance(tags, tag_id, member) for member in tags.ids)
        reading = decode_tag(tags, *magnets(tags, tag_id))
        assert (reading.tag_id is None) == (nearest > 2)
        if nearest > 3:
            assert reading.refused == "not_in_family"
    exact = replace(tags, min_distance=1)
    assert decode_tag(exact, *magnets(tags, tags.ids[3])).tag_id == tags.ids[3]
    foreign = next(i for i in range(9) if i not in tags.ids)
    assert decode_tag(exact, *magnets(tags, foreign)).refused == "not_in_family"


@pytest.mark.slow
@settings(deadline=None)
@given(st.data())
def test_a_missing_magnet_reduces_the_distance_by_half_a_revolution(data) -> None:
    """Distance 9, P = 8: one missing leaves 5, so that two steps are corrected beside it."""
    tags = family(30, 9)
    member = data.draw(st.sampled_from(tags.ids))
    cells, steps = magnets(tags, member)
    gone, *rotation = data.draw(st.permutations(range(5)))
    steps[rotation[0]] += data.draw(st.sampled_from([-1, 0, 1]))
    steps[rotation[1]] += data.draw(st.sampled_from([-1, 0, 1]))
    wrong = int(np.abs(steps - magnets(tags, member)[1]).sum())
    rest = [k for k in range(5) if k != gone]
    reading = decode_tag(tags, [cells[k] for k in rest], steps[rest])
    assert (reading.tag_id, reading.erased, reading.corrected) == (member, 1, wrong)


def test_with_a_missing_magnet_less_is_corrected() -> None:
    """Distance 9 bears four steps, with one magnet missing two, with two missing none."""
    tags = family(30, 9)
    member = tags.ids[11]
    for missing, borne in ((0, 4), (1, 2), (2, 0)):
        for wrong in range(5):
            cells, steps = magnets(tags, member)
            steps[missing] += min(wrong, 2)
            steps[missing + 1] -= max(wrong - 2, 0)
            reading = decode_tag(tags, cells[missing:], steps[missing:])
            if wrong <= borne:
                assert (reading.tag_id, reading.corrected) == (member, wrong)
                assert reading.erased == missing
            else:
                assert reading.tag_id is None


def test_a_magnet_missing_from_two_members_alike_is_no_guess() -> None:
    cells, steps = magnets(DEFAULT, 0)
    ids = tuple(codec.id_of(DEFAULT, layout) for layout in _rotated_layouts(0, (0, 4)))
    tags = replace(DEFAULT, ids=(*ids, 202517), min_distance=4)
    kept = [0, 2, 3, 4]
    reading = decode_tag(tags, [cells[k] for k in kept], steps[kept])
    assert (reading.tag_id, reading.refused) == (None, "magnets_missing")
    kept = [0, 1, 2, 3]
    reading = decode_tag(tags, [cells[k] for k in kept], steps[kept])
    assert (reading.tag_id, reading.erased) == (ids[0], 1)
    two = decode_tag(tags, cells[:2], steps[:2])
    assert (two.tag_id, two.refused) == (None, "magnets_missing")


def test_a_magnet_in_a_wrong_cell_counts_half_a_revolution() -> None:
    tags = family(30, 9)
    member = tags.ids[7]
    cells, steps = magnets(tags, member)
    k = next(k for k, cell in enumerate(cells) if cell not in [(0, 0), (0, 2), (2, 2)])
    spare = next(c for c in [(1, 0), (0, 1), (1, 1), (2, 1), (1, 2)] if c not in cells)
    moved = [*cells[:k], spare, *cells[k + 1 :]]
    reading = decode_tag(tags, moved, steps)
    assert (reading.tag_id, reading.corrected, reading.erased) == (member, 4, 0)
    assert decode_tag(replace(tags, min_distance=8), moved, steps).refused == "not_in_family"


def test_a_family_of_one_has_the_largest_margin() -> None:
    tags = replace(DEFAULT, ids=(4711,))
    assert decode_tag(tags, *magnets(tags, 4711)) == DecodedTag(
        4711, 20.0, 0, 0, codec.layout_of(tags, 4711).symbols
    )


# --- the redundant code


@cache
def words() -> dict[int, tuple[int, ...]]:
    count = codec.capacity(REDUNDANT)
    return {i: codec.layout_of(REDUNDANT, i).symbols for i in range(count)}


def capped(steps: np.ndarray, word, positions: list[int]) -> float:
    return sum(min(1.0, apart(REDUNDANT, steps[k], word[k])) for k in positions)


@pytest.mark.slow
@settings(deadline=None, max_examples=150)
@given(st.data())
def test_a_missing_and_a_misread_magnet_are_corrected(data) -> None:
    tag_id = data.draw(st.integers(0, 63))
    cells, steps = magnets(REDUNDANT, tag_id)
    steps += [data.draw(offsets) for _ in cells]
    order = data.draw(st.permutations(range(6)))
    missing = data.draw(st.integers(0, 2))
    kept = order[missing:]
    rotation = data.draw(st.integers(0, 7)) if missing < 2 else 0
    steps[kept[0]] += rotation
    reading = decode_tag(REDUNDANT, [cells[k] for k in kept], steps[kept])
    assert (reading.tag_id, reading.refused, reading.erased) == (tag_id, "", missing)
    assert reading.corrected == min(rotation, 8 - rotation)
    assert reading.symbols == tuple(words()[tag_id][k] for k in kept)
    # The margin promises no more than brute force over all words finds.
    own = capped(steps, words()[tag_id], kept)
    others = (capped(steps, word, kept) for i, word in words().items() if i != tag_id)
    assert reading.margin <= min(others) - own + 1e-9


def test_margin_of_a_clean_tag() -> None:
    assert decode_tag(REDUNDANT, *magnets(REDUNDANT, 33)).margin == 5


@pytest.mark.slow
@settings(deadline=None)
@given(st.data())
def test_one_misread_more_is_refused(data) -> None:
    tags = data.draw(st.sampled_from([REDUNDANT, Tags(4, 15, 16, codec="redundant")]))
    tag_id = data.draw(st.integers(0, codec.capacity(tags) - 1))
    cells, steps = magnets(tags, tag_id)
    missing = data.draw(st.integers(0, 2))
    order = data.draw(st.permutations(range(tags.magnets)))
    kept = order[missing:]
    for k in kept[: (3 - missing) // 2 + 1]:
        steps[k] += data.draw(st.integers(1, tags.orientations - 1))
    reading = decode_tag(tags, [cells[k] for k in kept], steps[kept])
    assert (reading.tag_id, reading.refused) == (None, "beyond_code")


def test_three_missing_magnets_of_a_redundant_tag_are_not_filled_in() -> None:
    """One tag in P of another design would agree with the check that remains."""
    tags = Tags(3, 8, 8, codec="redundant")
    cells, steps = magnets(tags, 1234)
    assert decode_tag(tags, cells[2:], steps[2:]).tag_id == 1234
    assert decode_tag(tags, cells[3:], steps[3:]).refused == "magnets_missing"


def test_a_redundant_tag_has_its_magnets_where_it_has_them() -> None:
    cells, steps = magnets(REDUNDANT, 5)
    free = next(c for c in [(1, 0), (0, 1), (1, 1), (2, 1), (1, 2)] if c not in cells)
    assert (
        decode_tag(REDUNDANT, [*cells[:-2], free, cells[-1]], steps).refused == "no_such_placement"
    )
    kept = [0, 5, 3, 4]
    four = decode_tag(REDUNDANT, [cells[k] for k in kept], steps[kept])
    assert (four.tag_id, four.erased) == (5, 2)


def test_a_redundant_family_has_only_its_members() -> None:
    tags = replace(REDUNDANT, ids=(3, 44))
    for tag_id in range(64):
        reading = decode_tag(tags, *magnets(tags, tag_id))
        assert reading.tag_id == (tag_id if tag_id in (3, 44) else None)
        assert reading.refused == ("" if tag_id in (3, 44) else "not_in_family")


def test_a_redundant_tag_as_built() -> None:
    """Four magnets more than half a step off: beyond the code, but measured."""
    installed = (0.6, -0.6, 0.1, 0.7, -0.55, 0.0)
    cells, steps = magnets(REDUNDANT, 21)
    assert decode_tag(REDUNDANT, cells, steps + installed).tag_id is None
    tags = replace(REDUNDANT, built={21: with_rotated_magnets(REDUNDANT, *installed)})
    reading = decode_tag(tags, cells, steps + installed + 0.05)
    assert (reading.tag_id, reading.corrected) == (21, 0)
    kept = [0, 1, 3, 4, 5]
    misread = steps + installed
    misread[3] += 3
    reading = decode_tag(tags, [cells[k] for k in kept], misread[kept])
    assert (reading.tag_id, reading.corrected, reading.erased) == (21, 3, 1)
    # A neighbour that was not measured is read as before.
    for tag_id in (20, 22):
        assert decode_tag(tags, *magnets(tags, tag_id)).tag_id == tag_id


@pytest.mark.slow
def test_every_id_of_every_codec_is_read_as_itself() -> None:
    for tags in (SMALL, REDUNDANT, Tags(magnets=7, codec="redundant"), RELEASED):
        count = codec.capacity(tags)
        for tag_id in itertools.islice(range(count), 0, None, max(1, count // 500)):
            assert decode_tag(tags, *magnets(tags, tag_id)).tag_id == tag_id
    assert redundant.MAX_DECODING_WEIGHT == 3


@pytest.mark.slow
@pytest.mark.parametrize(
    "tags",
    [
        Tags(ids=tuple(range(0, 327_680, 41)), min_distance=1),
        Tags(ids=families.generate_family(Tags(), 900, 4), min_distance=4),
        Tags(site={k: PlanarPose(0.0, 0.0, 0.0) for k in range(0, 327_680, 37)}),
        Tags(codec="redundant", magnets=8),
    ],
)
def test_how_often_arbitrary_orientations_have_an_id_in_use(tags: Tags) -> None:
    """Drawn at random, as many orientations decode with so few corrections as predicted."""
    rng = np.random.default_rng(72)
    trials = 1500 if tags.codec == "mosk" else 8000
    cells = codec.layout_of(tags, 0).cells
    ids = set(tags.site or tags.ids or range(codec.capacity(tags)))
    corrected, predicted = [], {}
    for steps in rng.integers(0, 8, (trials, len(cells))):
        decoded = decode_tag(tags, cells, steps)
        if decoded.tag_id in ids:
            corrected.append(decoded.corrected)
            predicted[decoded.corrected] = coincidence_probability(tags, cells, decoded)
    assert 0 in predicted
    for limit, probability in predicted.items():
        if limit > 1:
            continue  # The redundant code corrects no two magnets.
        count = np.count_nonzero(np.array(corrected) <= limit)
        assert abs(count - trials * probability) < 4 * np.sqrt(trials * probability) + 1
