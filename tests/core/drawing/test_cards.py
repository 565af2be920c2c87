"""Arrangement of equal cards on pages."""

from __future__ import annotations

import pytest

from locatk.core.drawing.cards import CardGrid, CardSlot, cards_along

AREA = (10.0, 20.0, 110.0, 120.0)


@pytest.mark.parametrize(
    ("space", "side", "gap", "count"),
    [(100, 30, 5, 3), (100, 30, 5.1, 2), (100, 100, 5, 1), (100, 101, 5, 0), (-5, 30, 5, 0)],
)
def test_cards_and_gaps_fit_the_length(space, side, gap, count) -> None:
    assert cards_along(space, side, gap) == count


def test_cards_that_fit_exactly_are_not_lost_to_rounding() -> None:
    assert cards_along(3 * 0.1, 0.1, 0.0) == 3
    assert cards_along(0.7, 0.1, 0.0) == 7


def test_cards_fill_pages_from_the_upper_left() -> None:
    grid = CardGrid.densest(AREA, (40.0, 30.0), 5.0)
    assert (grid.columns, grid.rows, grid.cards_per_page) == (2, 3, 6)
    assert [grid.page_count(cards) for cards in (1, 6, 7)] == [1, 1, 2]
    slots = list(grid.slots(7))
    # 2 x 40 + 5 mm in the centre of 100 mm.
    assert slots[:3] == [
        CardSlot(0, (17.5, 120.0)),
        CardSlot(0, (62.5, 120.0)),
        CardSlot(0, (17.5, 85.0)),
    ]
    assert slots[6] == CardSlot(1, (17.5, 120.0))


def test_few_cards_are_centred_if_asked() -> None:
    grid = CardGrid.densest(AREA, (40.0, 30.0), 5.0)
    assert next(grid.slots(1, centred=True)) == CardSlot(0, (40.0, 120.0))
    assert list(grid.slots(7, centred=True))[6] == CardSlot(1, (40.0, 120.0))
    # A last row below full rows continues their columns.
    assert list(grid.slots(3, centred=True))[2] == CardSlot(0, (17.5, 85.0))


def test_a_card_larger_than_the_area_has_no_slot() -> None:
    assert CardGrid.densest(AREA, (101.0, 10.0), 5.0).cards_per_page == 0
