"""Cards of tags: what is cut out holds the whole drawing."""

from __future__ import annotations

import math

import pytest

from locatk.core.drawing import Circle, Line, Mark, Point, Polygon, Text, text_width
from locatk.core.polaris.codec import layout_of
from locatk.core.polaris.drawing.cards import CARD_GAP_MM, draw_tag_cards
from locatk.core.polaris.tag import Tags


def extent(mark: Mark) -> list[Point]:
    if isinstance(mark, Line):
        return [mark.start, mark.end]
    if isinstance(mark, Polygon):
        return list(mark.corners)
    if isinstance(mark, Circle):
        (x, y), radius = mark.centre, mark.radius_mm
        return [(x - radius, y - radius), (x + radius, y + radius)]
    x, y = mark.position
    half = text_width(mark.text, mark.points) / 2 if mark.anchor == "middle" else 0.0
    return [(x - half, y), (x + half, y)]


def is_cut_mark(mark: Mark) -> bool:
    return isinstance(mark, Line) and math.dist(mark.start, mark.end) == pytest.approx(2.0)


@pytest.mark.parametrize("mirror", [False, True])
@pytest.mark.parametrize("tags", [Tags(spacing_m=0.02), Tags(order=4, spacing_m=0.013)])
def test_the_drawing_of_a_tag_is_within_its_cut_marks(tags: Tags, mirror: bool) -> None:
    requested = [(tag_id, layout_of(tags, tag_id)) for tag_id in (5, 77_777)]
    drawn = draw_tag_cards(tags, requested, (297.0, 210.0), mirror=mirror)
    edges = []
    for group in drawn.pages[0].groups[1:]:
        cut_marks = group.marks[-8:]
        assert all(map(is_cut_mark, cut_marks))
        xs = [mark.start[0] for mark in cut_marks if mark.start[0] == mark.end[0]]
        ys = [mark.start[1] for mark in cut_marks if mark.start[1] == mark.end[1]]
        left, right, bottom, top = min(xs), max(xs), min(ys), max(ys)
        for mark in group.marks[:-8]:
            for x, y in extent(mark):
                assert left <= x <= right
                assert bottom <= y <= top
        edges.append((left, right))
    assert edges[1][0] - edges[0][1] == pytest.approx(CARD_GAP_MM, abs=2e-3)


def test_the_meaning_of_an_id_is_below_it() -> None:
    tags = Tags(meanings={5: "charge here"})
    requested = [(tag_id, layout_of(tags, tag_id)) for tag_id in (5, 6)]
    groups = draw_tag_cards(tags, requested, (297.0, 420.0)).pages[0].groups[1:]
    texts = [
        {mark.text: mark for mark in group.marks if isinstance(mark, Text)} for group in groups
    ]
    assert texts[0]["id 5"].position[1] > texts[0]["charge here"].position[1]
    assert texts[0]["id 5"].points == texts[0]["charge here"].points
    assert "id 6" in texts[1]
    assert "charge here" not in texts[1]


def test_the_moment_of_a_magnet_is_clockwise_from_up_and_mirrored_from_below() -> None:
    tags = Tags()
    layout = layout_of(tags, 77_777)
    for mirror, side in ((False, 1.0), (True, -1.0)):
        page = draw_tag_cards(tags, [(77_777, layout)], (210.0, 297.0), mirror=mirror).pages[0]
        discs = [mark for mark in page.groups[1].marks if isinstance(mark, Circle)]
        letters = [mark for mark in page.groups[1].marks if isinstance(mark, Text)]
        letters = [mark for mark in letters if mark.text == "N"]
        for disc, letter, symbol in zip(discs, letters, layout.symbols, strict=True):
            dx, dy = letter.position[0] - disc.centre[0], letter.position[1] - disc.centre[1]
            angle = math.radians(360 * symbol / tags.orientations)
            # The letter is centred on the moment's line, half of a capital above its baseline.
            dy += 0.36 * letter.points * 25.4 / 72
            error = math.remainder(math.atan2(dx, dy) - side * angle, math.tau)
            assert error == pytest.approx(0, abs=1e-6)
    assert len(set(layout.symbols)) > 2
