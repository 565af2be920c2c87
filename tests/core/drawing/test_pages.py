"""Frames, flowing text and tables of printed pages."""

from __future__ import annotations

import math

import pytest

from locatk.core.drawing import Line, Mark, Polygon, Text, line_height
from locatk.core.drawing.pages import (
    FLOW_TEXT_POINTS,
    FRAME_CLEARANCE_MM,
    TEXT_POINTS,
    PageFrame,
    TableColumn,
    TextFlow,
    UnnumberedPage,
    check_margin,
    larger_paper_text,
    number_pages,
    printable,
    size_text,
    table_pages,
)
from locatk.core.drawing.placement import text_box
from locatk.core.errors import InputError

A4 = (210.0, 297.0)
FRAME = PageFrame(A4, 10.0, "A title", ("a note",))


def texts(marks: tuple[Mark, ...]) -> list[Text]:
    return [mark for mark in marks if isinstance(mark, Text)]


def test_pages_are_numbered_from_one() -> None:
    pages = number_pages([UnnumberedPage(FRAME, ()), UnnumberedPage(FRAME, ())])
    for number, page in enumerate(pages, 1):
        (frame,) = page.groups
        assert frame.name == "page"
        assert f"page {number} of 2" in [text.text for text in texts(frame.marks)]
    assert pages[0].size_mm == A4


def test_the_content_is_clear_of_title_notes_and_rulers() -> None:
    left, bottom, right, top = FRAME.content_box
    header = [text for text in texts(FRAME.draw(1, 1).marks) if text.position[1] > 200]
    assert {text.text for text in header} == {"A title", "a note", "page 1 of 1"}
    lowest = min(text.position[1] for text in header)
    # Descenders are at most a quarter of the font size.
    descender = 0.25 * TEXT_POINTS * 25.4 / 72
    assert lowest - 5 < top < lowest - descender - FRAME_CLEARANCE_MM
    ruler_ends = [
        end
        for mark in FRAME.draw(1, 1).marks
        if isinstance(mark, Line)
        for end in (mark.start, mark.end)
    ]
    assert all(x < left or y < bottom for x, y in ruler_ends)
    assert right == 200.0
    for x, y in ruler_ends:
        assert x >= 10
        assert y >= 10


def test_a_long_title_is_wrapped_in_bold_and_takes_space() -> None:
    long = PageFrame(A4, 10.0, "word " * 30, ("a note",))
    bold = [text for text in texts(long.draw(1, 1).marks) if text.bold]
    assert len(bold) == 2
    assert " ".join(text.text for text in bold) == ("word " * 30).strip()
    note = next(text for text in texts(long.draw(1, 1).marks) if text.text == "a note")
    assert note.position[1] < bold[1].position[1]
    assert FRAME.content_box[3] - long.content_box[3] == pytest.approx(line_height(10.0))


@pytest.mark.parametrize("margin", [-1.0, 95.0, math.nan])
def test_margins_that_leave_nothing_are_rejected(margin: float) -> None:
    check_margin(A4, 94.9)
    with pytest.raises(InputError, match="margin"):
        check_margin(A4, margin)
    check_margin(A4, 104.9, min_content_mm=0.0)
    with pytest.raises(InputError, match="margin of 105 mm leaves too little of a paper of 210 x"):
        check_margin(A4, 105.0, min_content_mm=0.0)


def test_an_extended_paper_grows_only_at_short_sides() -> None:
    assert larger_paper_text((100.0, 200.0), (90.0, 50.5), (80.0, 150.0)) == "110x200mm"
    assert larger_paper_text((100.0, 200.0), (90.0, 50.5), (80.0, 50.0)) == "110x201mm"
    assert size_text((215.9, 279.4)) == "215.9 x 279.4 mm"
    assert size_text((215.9, 279.4), 0) == "216 x 279 mm"


def test_letters_that_pdf_fonts_lack_are_replaced() -> None:
    assert printable("Halle \u00e4 \u20ac \u0416") == "Halle \u00e4 \u20ac ?"


def test_text_flows_to_the_next_page() -> None:
    flow = TextFlow(FRAME)
    left, bottom, _, top = FRAME.content_box
    for number in range(80):
        flow.add_paragraph(f"line {number}", has_tick_box=number == 0)
    pages = flow.pages()
    assert len(pages) == 2
    marks = [page.groups[0].marks for page in pages]
    assert [text.text for page in marks for text in texts(page)] == [f"line {n}" for n in range(80)]
    for page in marks:
        assert texts(page)[0].position[1] == pytest.approx(top - line_height(FLOW_TEXT_POINTS))
        assert texts(page)[-1].position[1] >= bottom
    (box,) = [mark for mark in marks[0] if isinstance(mark, Polygon)]
    assert box.corners[0][0] == left
    assert texts(marks[0])[0].position[0] - texts(marks[0])[1].position[0] == pytest.approx(8.0)


def test_rows_of_text_wrap_their_last_column() -> None:
    flow = TextFlow(FRAME)
    flow.add_space(10.0)
    flow.add_row(("a", "b", "long " * 40), (30.0, 20.0))
    flow.add_row(("c", "d", "short"), (30.0, 20.0))
    marks = flow.pages()[0].groups[0].marks
    left, _, right, top = FRAME.content_box
    a, b, *wrapped = texts(marks)
    assert a.position[1] == b.position[1] == wrapped[0].position[1]
    assert a.position[1] == pytest.approx(top - 10 - line_height(FLOW_TEXT_POINTS))
    assert (a.position[0], b.position[0], wrapped[0].position[0]) == (left, left + 30, left + 50)
    c = next(text for text in texts(marks) if text.text == "c")
    lines = [mark for mark in marks if isinstance(mark, Line)]
    assert [(line.start[0], line.end[0]) for line in lines] == [(left, right)] * 2
    last_of_first_row = wrapped[wrapped.index(c) - 1]
    assert last_of_first_row.position[1] > lines[0].start[1] > c.position[1]


def test_tables_fill_blocks_and_pages_in_order() -> None:
    columns = (TableColumn("no", 20.0, is_right_aligned=True), TableColumn("name", 30.0))
    rows = [(str(number), f"item {number}") for number in range(500)]
    pages = table_pages(rows, columns, FRAME)
    assert len(pages) == 3
    shown = [
        text.text
        for page in pages
        for text in texts(page.groups[0].marks)
        if text.text.startswith("item")
    ]
    assert shown == [name for _, name in rows]
    left, bottom, right, top = FRAME.content_box
    for page in pages:
        for text in texts(page.groups[0].marks):
            assert left <= text.position[0] <= right
            assert bottom <= text.position[1] <= top
    first = texts(pages[0].groups[0].marks)
    assert [text.text for text in first[:4]] == ["no", "name", "0", "item 0"]
    assert first[0].bold
    assert not first[2].bold
    assert (first[2].position[0], first[2].anchor) == (left + 19.0, "end")
    assert (first[3].position[0], first[3].anchor) == (left + 20.0, "start")
    assert len(table_pages([], columns, FRAME)) == 1


def test_a_row_with_an_empty_last_cell_takes_a_line() -> None:
    flow = TextFlow(FRAME)
    flow.add_row(("a", ""), (30.0,))
    flow.add_row(("b", "c"), (30.0,))
    first, *_, second, _ = texts(flow.pages()[0].groups[0].marks)
    assert first.position[1] - second.position[1] >= line_height(FLOW_TEXT_POINTS)


def test_rules_of_a_table_keep_their_distance_from_its_texts() -> None:
    """Half a millimetre above and below, so that they do not merge on a screen either."""
    rows = [("qj[ ]", "8")] * 23
    columns = (TableColumn("yg", 30.0), TableColumn("(mm)", 30.0, is_right_aligned=True))
    (page,) = table_pages(rows, columns, FRAME)
    marks = page.groups[0].marks
    rules = [mark.start[1] for mark in marks if isinstance(mark, Line)]
    assert len(rules) == 5
    for _, bottom, _, top in map(text_box, texts(marks)):
        assert all(rule < bottom - 0.5 or rule > top + 0.5 for rule in rules)
