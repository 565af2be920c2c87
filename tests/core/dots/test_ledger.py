"""Areas that no two sheets share."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from locatk.core.dots.codec import SECTION_LENGTH
from locatk.core.dots.design.ledger import (
    GAP_POSITIONS,
    Area,
    allocate,
    check_name,
    free_origins,
    plan,
)
from locatk.core.dots.drawing.layout import lay_out, snap
from locatk.core.dots.drawing.tiles import tiling
from locatk.core.errors import InputError

SIDES = st.tuples(st.integers(8, 3000), st.integers(8, 3000))
HALF = SECTION_LENGTH // 2
LONG = st.tuples(st.integers(HALF, SECTION_LENGTH), st.integers(8, 3000))


def area(name: str, x: int, y: int, columns: int, rows: int, u: int = 0, v: int = 0) -> Area:
    return Area(name, "anoto", (u, v), (x, y), (columns, rows))


def apart(first: Area, second: Area, gap: int = 0) -> bool:
    """Whether ``gap`` places are between two areas, in x or in y; written out on purpose."""
    (ax, ay), (bx, by) = first.origin, second.origin
    (aw, ah), (bw, bh) = first.size, second.size
    return ax + aw + gap <= bx or bx + bw + gap <= ax or ay + ah + gap <= by or by + bh + gap <= ay


@pytest.mark.slow
@given(
    held=st.lists(st.tuples(st.integers(0, 9000), st.integers(0, 9000), SIDES), max_size=8),
    wanted=st.lists(SIDES | LONG, min_size=1, max_size=25),
)
def test_new_areas_are_free(
    held: list[tuple[int, int, tuple[int, int]]], wanted: list[tuple[int, int]]
) -> None:
    old = [area(f"old{n}", x, y, *size) for n, (x, y, size) in enumerate(held)]
    new = allocate(old, wanted, prefixes=["A4"] * len(wanted), codec="anoto")
    assert [item.size for item in new] == wanted
    for item in new:
        assert item.origin[0] + item.size[0] <= SECTION_LENGTH
        assert item.origin[1] + item.size[1] <= SECTION_LENGTH
    for first, second in itertools.combinations(new, 2):
        assert apart(first, second, GAP_POSITIONS)
        assert not first.overlaps(second)
    for first, second in itertools.product(old, new):
        assert apart(first, second, GAP_POSITIONS)
    again = allocate(old, wanted, prefixes=["A4"] * len(wanted), codec="anoto")
    assert again == new


@given(
    st.tuples(st.integers(0, 50), st.integers(0, 50), SIDES),
    st.tuples(st.integers(0, 50), st.integers(0, 50), SIDES),
)
def test_overlapping_areas_share_a_position(
    first: tuple[int, int, tuple[int, int]], second: tuple[int, int, tuple[int, int]]
) -> None:
    a, b = (area("a", x, y, *size) for x, y, size in (first, second))
    assert a.overlaps(b) == b.overlaps(a) == (not apart(a, b))


def test_one_by_one_or_all_at_once() -> None:
    sizes = [(374, 545)] * 5 + [(1616, 2301), (374, 545)]
    together = allocate([], sizes, prefixes=["A4"] * 7, codec="anoto")
    single: list[Area] = []
    for size in sizes:
        single += allocate(single, [size], prefixes=["A4"], codec="anoto")
    assert single == together
    assert [item.id for item in together][:2] == ["A4-0001", "A4-0002"]
    assert [item.origin[0] for item in together][:3] == [
        0,
        374 + GAP_POSITIONS,
        2 * (374 + GAP_POSITIONS),
    ]


def test_sections_do_not_overlap() -> None:
    held = [area("a", 0, 0, 500, 500)]
    assert free_origins(held, (500, 500)) == [(500 + GAP_POSITIONS, 0)]
    assert free_origins(held, (500, 500), (0, 1)) == [(0, 0)]
    assert not held[0].overlaps(area("b", 0, 0, 500, 500, v=1))


def test_areas_of_other_codecs_overlap() -> None:
    """They share most digits: sheets of two codecs could be taken for one another."""
    held = [area("a", 0, 0, 500, 500)]
    with pytest.raises(InputError, match="in use"):
        allocate(held, [(100, 100)], prefixes=["x"], codec="libdots", origin=(499, 499))


def test_a_full_section_is_reported() -> None:
    held = [area("a", 0, 0, SECTION_LENGTH, SECTION_LENGTH - 200)]
    assert free_origins(held, (8, 200 - GAP_POSITIONS)) == [
        (0, SECTION_LENGTH - 200 + GAP_POSITIONS)
    ]
    with pytest.raises(InputError, match="no free area"):
        free_origins(held, (8, 200 - GAP_POSITIONS + 1))


def test_areas_by_hand() -> None:
    held = allocate([], [(100, 100)], prefixes=["A4"], codec="anoto", origin=(1000, 2000))
    assert held[0].origin == (1000, 2000)

    def ask(x: int, y: int, force: bool = False) -> list[Area]:
        return allocate(
            held, [(50, 50)], prefixes=["A4"], codec="anoto", origin=(x, y), force=force
        )

    for x, y in ((1000, 2000), (1099, 2099), (951, 1951)):
        with pytest.raises(InputError, match="'A4-0001'") as caught:
            ask(x, y)
        assert "--force" in (caught.value.hint or "")
        assert ask(x, y, force=True)[0].id == "A4-0002"
    assert ask(1100, 2000)[0].origin == (1100, 2000)
    assert ask(950, 2000)[0].origin == (950, 2000)
    several = allocate(
        held, [(50, 50), (70, 50), (50, 50)], prefixes=["A4"] * 3, codec="anoto", origin=(5, 7)
    )
    assert [item.origin for item in several] == [
        (5, 7),
        (55 + GAP_POSITIONS, 7),
        (125 + 2 * GAP_POSITIONS, 7),
    ]
    with pytest.raises(InputError, match="cross the border"):
        ask(SECTION_LENGTH - 49, 0)


def test_names_are_used_once() -> None:
    held = [area("map", 0, 0, 10, 10), area("A4-0007", 100, 0, 10, 10)]

    def ask(name: str | None, count: int = 1, force: bool = False, x: int = 5000) -> list[str]:
        sizes = [(10, 10)] * count
        return [
            item.id
            for item in allocate(
                held, sizes, prefixes=["A4"] * count, codec="anoto", name=name, force=force,
                origin=(x, 0),
            )
        ]  # fmt: skip

    assert ask(None) == ["A4-0008"]
    assert ask(None, 2) == ["A4-0008", "A4-0009"]
    assert ask("hall") == ["hall"]
    assert ask("hall", 2) == ["hall-1", "hall-2"]
    with pytest.raises(InputError, match="in the ledger"):
        ask("map")
    with pytest.raises(InputError, match="in the ledger"):
        ask("map", force=True)  # another area of that name
    assert ask("map", force=True, x=0) == ["map"]  # the same sheet once more


@pytest.mark.parametrize("name", ["", "a b", "floor", "-a", "ä", "a/b", "x" * 41, "a\n"])
def test_odd_names_are_refused(name: str) -> None:
    with pytest.raises(InputError):
        check_name(name)


def test_plan_gives_each_sheet_the_area_in_the_ledger() -> None:
    raster = snap(0.508, None, 300)
    one = lay_out((210, 297), 10, raster)
    wide = lay_out((297, 210), 10, raster)
    floor = tiling(one, (2, 2), 10)
    areas, generated = plan([one, wide, floor], [], codec="libdots", section=(3, 4))
    assert generated.codec == "libdots"
    assert [item.id for item in areas] == ["A4-0001", "A4-0002", "A4-0003"]
    assert [sheet.id for sheet in generated.sheets] == [
        "A4-0001", "A4-0002", "A4-0003-c1r1", "A4-0003-c2r1", "A4-0003-c1r2", "A4-0003-c2r2",
    ]  # fmt: skip
    assert areas[2].size == floor.size
    for sheet in generated.sheets:
        assert sheet.section == (3, 4)
        inside = area("s", *sheet.origin, *sheet.size, u=3, v=4)
        owner = next(item for item in areas if sheet.id.startswith(item.id))
        assert [item.id for item in areas if item.overlaps(inside)] == [owner.id]
        # Nothing of a sheet is outside its area.
        for axis in (0, 1):
            assert sheet.origin[axis] >= owner.origin[axis]
            assert sheet.origin[axis] + sheet.size[axis] <= owner.origin[axis] + owner.size[axis]
