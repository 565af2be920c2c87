"""Plans of sites: positions to scale, ordinates from the datum, labels that can be read."""

from __future__ import annotations

import itertools
import math
import random
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from locatk.core.drawing import Circle, Group, Line, Mark, Page, Polygon, Text, text_width
from locatk.core.drawing.pages import PageFrame
from locatk.core.errors import InputError
from locatk.core.polaris.drawing.plan import (
    MIN_SYMBOL_MM,
    SitePlan,
    _Block,
    _Division,
    _spread,
    draw_site_plan,
)
from locatk.core.polaris.tag import PlanarPose, Tags

A4, LETTER = (210.0, 297.0), (215.9, 279.4)

MIN_POINTS = 7.0

FOUR = Tags(
    site={
        0: PlanarPose(0.0, 0.0, 0.0),
        202517: PlanarPose(1.5005, 0.2, math.pi / 2),
        77354: PlanarPose(2.5, 1.8, math.radians(-135)),
        279871: PlanarPose(0.8, 2.6, math.radians(197.25)),
    },
    meanings={0: "dock", 202517: "stop, wait", 279871: "turn left at the end of aisle 7 \u4e2d"},
)


def random_site(count: int, seed: int, width_m: float = 24.0, height_m: float = 15.0) -> Tags:
    draw = random.Random(seed)
    ids = draw.sample(range(262144), count)
    poses = (
        PlanarPose(
            round(draw.uniform(0, width_m), 4), round(draw.uniform(0, height_m), 4), draw.random()
        )
        for _ in ids
    )
    site = dict(zip(ids, poses, strict=True))
    return Tags(site=site, meanings=dict.fromkeys(ids[::3], "charging station"))


def marks(page: Page, group: str = "plan") -> tuple[Mark, ...]:
    return next(each.marks for each in page.groups if each.name == group)


def texts(page: Page) -> list[Text]:
    return [mark for each in page.groups for mark in each.marks if isinstance(mark, Text)]


def words(page: Page) -> str:
    return " ".join(text.text for text in texts(page))


def squares(page: Page) -> np.ndarray:
    """Middles of the squares of the tags; the first outline is the edge of the plan."""
    outlines = [m for m in marks(page) if isinstance(m, Polygon) and not m.filled][1:]
    return np.array([np.mean(outline.corners, axis=0) for outline in outlines])


def datum(page: Page) -> np.ndarray:
    (circle,) = (mark for mark in marks(page) if isinstance(mark, Circle))
    return np.array(circle.centre)


def box_of(text: Text) -> tuple[float, float, float, float]:
    """Box of a text by the width that hardly any font exceeds, which is too large for most."""
    width = 0.85 * text_width(text.text, text.points)
    height = 0.72 * text.points * 25.4 / 72
    left = {"start": 0.0, "middle": -width / 2, "end": -width}[text.anchor]
    corners = np.array([(left, 0), (left + width, height)])
    if text.angle_deg == 90:
        corners = np.array([(-height, left), (0, left + width)])
    low, high = corners + text.position
    return low[0], low[1], high[0], high[1]


def overlaps(one: tuple[float, ...], other: tuple[float, ...]) -> bool:
    return (
        min(one[2], other[2]) > max(one[0], other[0]) + 1e-6
        and min(one[3], other[3]) > max(one[1], other[1]) + 1e-6
    )


def plan_pages(plan: SitePlan) -> list[Page]:
    first = 1 if plan.plan_pages > 1 else 0
    return list(plan.pages[first : plan.plan_pages])


@pytest.mark.parametrize("paper", [A4, LETTER])
@pytest.mark.parametrize("datum_m", [(0.0, 0.0), (-0.5, 0.25)])
def test_tags_are_to_scale_from_the_datum(
    paper: tuple[float, float], datum_m: tuple[float, float]
) -> None:
    plan = draw_site_plan(FOUR, "hall", paper, datum_m=datum_m)
    assert (len(plan.pages), plan.plan_pages) == (2, 1)
    assert plan.page_of == dict.fromkeys(FOUR.site, 0)
    page = plan.pages[0]
    ids = sorted(FOUR.site)
    position_m = np.array([[FOUR.site[k].x_m, FOUR.site[k].y_m] for k in ids]) - datum_m
    expected = datum(page) + 1e3 * position_m / plan.scale
    np.testing.assert_allclose(squares(page), expected, atol=1e-9)
    outline = next(m for m in marks(page)[1:] if isinstance(m, Polygon) and not m.filled)
    side = math.dist(*outline.corners[:2])
    assert side == pytest.approx(120 / plan.scale)
    assert side > MIN_SYMBOL_MM
    for text in ("id 0, 0\u00b0", "id 202517, 90\u00b0", "id 279871, -162.75\u00b0"):
        assert text in words(page)
    assert f"({1e3 * datum_m[0]:g}, {1e3 * datum_m[1]:g} mm in" in words(page)
    # A character that the fonts of PDF lack.
    assert "turn left at the end" in words(page)
    assert "7 ?" in words(page)


def test_ordinates_are_coordinates_from_the_datum() -> None:
    page = draw_site_plan(FOUR, "hall", A4, datum_m=(-0.5, 0.0)).pages[0]
    upright = {text.text for text in texts(page) if text.angle_deg == 90}
    assert upright == {"500", "1300", "2000.5", "3000", "+y"}
    level = {text.text for text in texts(page) if text.anchor == "end" and text.angle_deg == 0}
    assert {"0", "200", "1800", "2600"} <= level


def test_the_table_has_all_positions() -> None:
    plan = draw_site_plan(FOUR, "hall", A4, datum_m=(-0.5, 0.0))
    cells = [mark.text for mark in marks(plan.pages[1], "table") if isinstance(mark, Text)]
    assert cells[:7] == ["done", "id", "x mm", "y mm", "heading", "", "meaning"]
    rows = (
        list(itertools.batched(cells, 7))
        if hasattr(itertools, "batched")
        else [tuple(cells[k : k + 7]) for k in range(0, len(cells), 7)]
    )
    assert rows[1:] == [
        ("[  ]", "0", "500", "0", "0", "", "dock"),
        ("[  ]", "77354", "3000", "1800", "-135", "", ""),
        ("[  ]", "202517", "2000.5", "200", "90", "", "stop, wait"),
        ("[  ]", "279871", "1300", "2600", "-162.75", "", "turn left at the end of aisle 7 ?"),
    ]


@pytest.mark.slow
@pytest.mark.parametrize("paper", [A4, LETTER])
@pytest.mark.parametrize("seed", range(4))
def test_labels_of_sixty_tags_can_be_read(paper: tuple[float, float], seed: int) -> None:
    site = random_site(60, seed)
    plan = draw_site_plan(site, "hall", paper)
    assert sorted(plan.page_of) == sorted(site.site)
    found = 0
    for page in plan_pages(plan):
        labels = [text for text in texts(page) if text.text.startswith("id ")]
        found += len(labels)
        own = [mark for mark in marks(page) if isinstance(mark, Text)]
        for one, other in itertools.combinations(map(box_of, own), 2):
            assert not overlaps(one, other)
        dashed = [mark for mark in marks(page) if isinstance(mark, Line) and mark.dash_mm]
        for line in dashed:
            # From the left or the lower edge to a tag, around the labels.
            along = np.subtract(line.end, line.start)
            assert sum(along) > 0
            end = np.add(line.end, np.where(along == 0, 0.1, 0.0))
            covered = (*line.start, *end)
            assert not any(overlaps(covered, box_of(text)) for text in labels)
        half = MIN_SYMBOL_MM / 2
        for x, y in squares(page):
            symbol = (x - half, y - half, x + half, y + half)
            assert not any(overlaps(symbol, box_of(text)) for text in own)
        for left, bottom, right, top in map(box_of, texts(page)):
            assert min(left, bottom) >= 9.9
            assert right <= page.size_mm[0] - 9.9
            assert top <= page.size_mm[1] - 9.9
    assert found == 60
    for page in plan.pages:
        assert min(text.points for text in texts(page)) >= MIN_POINTS


@pytest.mark.slow
def test_a_large_site_is_divided_after_an_overview() -> None:
    site = random_site(150, 1, 80.0, 20.0)
    plan = draw_site_plan(site, "hall", A4)
    assert plan.plan_pages > 2
    overview = plan.pages[0]
    points = [m for m in marks(overview, "overview") if isinstance(m, Circle)]
    assert len(points) == 150 + 1  # and the datum
    names = [text.text for text in texts(overview) if text.text.startswith("c")]
    assert len(names) == plan.plan_pages - 1
    for number, page in enumerate(plan.pages[1 : plan.plan_pages], 1):
        expected = {tag_id for tag_id, each in plan.page_of.items() if each == number}
        shown = {
            int(text.text.split(",")[0][3:]) for text in texts(page) if text.text.startswith("id ")
        }
        assert shown == expected
        assert len(squares(page)) == len(expected)
    assert {str(page + 1) for page in plan.page_of.values()} <= set(words(plan.pages[-1]).split())


@pytest.mark.slow
def test_sites_that_are_hard_to_draw() -> None:
    """One tag, tags at one position, a row, a datum far away, ids of many digits."""
    single = Tags(site={5: PlanarPose(3.0, 4.0, 0.0)})
    plan = draw_site_plan(single, "one", A4)
    assert "which is off the plan" in words(plan.pages[0])
    assert len(squares(plan.pages[0])) == 1
    stacked = Tags(site={number: PlanarPose(1.0, 1.0, 0.0) for number in range(30)})
    drawn = draw_site_plan(stacked, "stack", A4)
    assert sum(len(squares(page)) for page in plan_pages(drawn)) == 30
    hall = random_site(60, 3)
    # Many tags at one position do not divide the plan into as many pages as possible.
    crowded = replace(hall, site=hall.site | {300_000 + k: PlanarPose(12, 7, 0) for k in range(30)})
    assert len(draw_site_plan(crowded, "crowded", A4).pages) < 20
    row = Tags(site={number: PlanarPose(0.25 * number, 0.0, 0.0) for number in range(60)})
    assert sum(len(squares(page)) for page in plan_pages(draw_site_plan(row, "row", A4))) == 60
    large = Tags(order=9, magnets=40, site={10**30 + k: PlanarPose(k, 0, 0) for k in range(3)})
    assert len(draw_site_plan(large, "long", A4).pages) >= 2


@pytest.mark.slow
def test_a_dense_cluster_takes_the_largest_scale() -> None:
    """No division shows more than 150 tags in 3.5 m; the overview scale would be the worst."""
    draw = random.Random(1)
    site = {k: PlanarPose(draw.uniform(0, 3.5), draw.uniform(0, 3.5), 0.0) for k in range(200)}
    alone = Tags(site=site | {500: PlanarPose(100.0, 0.0, 0.0)})
    plan = draw_site_plan(alone, "hall", A4)
    # 1 : 450 on one page, and eight times larger at most.
    assert plan.scale <= 75
    assert plan.plan_pages == 3
    assert plan.page_of[500] != plan.page_of[0]


def division(sizes: list[int], unplaced: int | None) -> _Division:
    blocks = tuple(_Block((0.0, 0.0), (1.0, 1.0), tuple(range(size))) for size in sizes)
    return _Division(PageFrame(A4, 10.0, "", ("",)), blocks, 1, 100.0, unplaced)


def test_the_cost_counts_the_pages_that_are_drawn() -> None:
    assert division([5], 2).cost == 2 + 1
    assert division([5, 0, 0, 0], 2).cost == 2 + 1
    assert division([5, 0, 4, 0], 2).cost == 2 + 2 + 1  # with the overview
    # A label and two ordinates of each tag.
    assert division([200, 0, 1], None).cost == 3 * 201


@pytest.mark.slow
def test_the_note_of_each_page_says_where_the_datum_is() -> None:
    pairs = [(5.0, 5.0), (5.6, 5.0), (40.0, 40.0)]
    places = [(x + 0.3 * k, y + 0.3 * k) for x, y in pairs for k in range(12)]
    tags = Tags(site={k: PlanarPose(x, y, 0.0) for k, (x, y) in enumerate(places)})
    states = set()
    for datum_m in ((5.0, 5.0), (0.0, 40.0)):
        plan = draw_site_plan(tags, "hall", A4, datum_m=datum_m)
        assert plan.plan_pages > 2
        assert any(
            isinstance(m, Circle) and m.radius_mm > 1 for m in marks(plan.pages[0], "overview")
        )
        for page in plan_pages(plan):
            circles = [mark for mark in marks(page) if isinstance(mark, Circle)]
            state = "is the crossed circle" if circles else "is in the overview"
            assert f"which {state}." in words(page)
            states.add(state)
    assert len(states) == 2


def test_plans_that_are_refused() -> None:
    with pytest.raises(InputError, match="no tag has a position"):
        draw_site_plan(Tags(), "none", A4)
    with pytest.raises(InputError, match="too little of a paper"):
        draw_site_plan(FOUR, "hall", (105.0, 148.0), margin_mm=10.0)
    wide = replace(FOUR, site={10**60: PlanarPose(0, 0, 0)}, order=12, magnets=100, meanings={})
    with pytest.raises(InputError, match="too narrow for the table"):
        draw_site_plan(wide, "hall", (130.0, 297.0))


@given(st.lists(st.floats(0, 100), min_size=1, max_size=30))
def test_spread_ordinates_keep_their_order(values: list[float]) -> None:
    positions = np.sort(values)
    spread = _spread(positions, 3.0, 0.0, 100.0)
    assert (np.diff(spread) >= 3.0 - 1e-9).all()
    if len(values) <= 30:
        assert spread[0] >= -1e-9
        assert spread[-1] <= 100 + 1e-9
    if len(values) == 1 or np.diff(positions).min() >= 3:
        np.testing.assert_allclose(spread, positions, atol=1e-9)


def test_groups_have_different_names() -> None:
    for page in draw_site_plan(FOUR, "hall", A4).pages:
        names = [group.name for group in page.groups if isinstance(group, Group)]
        assert len(set(names)) == len(names)
