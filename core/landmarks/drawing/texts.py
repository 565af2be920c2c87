"""Pages of text of an installation pack: bill of materials, checklist and marking list."""

from __future__ import annotations

import math
from collections.abc import Sequence

from locatk.core.drawing import TRUE_SIZE_INSTRUCTION, Point, text_width
from locatk.core.drawing.pages import (
    TEXT_POINTS,
    TITLE_POINTS,
    PageFrame,
    TableColumn,
    TextFlow,
    UnnumberedPage,
    printable,
    table_pages,
)
from locatk.core.landmarks.design.materials import count_patterns
from locatk.core.landmarks.drawing.landmark import code_digit
from locatk.core.landmarks.landmark import PATTERN_OF, name
from locatk.core.landmarks.map.floor import FloorMap
from locatk.core.materials import BillItem, total_of
from locatk.core.units import mm_text

BILL_COLUMNS_MM = (38.0, 15.0, 17.0, 20.0)
"""Widths of the columns part, count, price of one and of all; the description takes the rest."""

PATTERN_COLUMNS_MM = (20.0, 22.0, 18.0)
"""Widths of the columns pattern, bars and count; the templates take the rest."""


def bill_pages(
    floor: FloorMap, items: Sequence[BillItem], title: str, paper_mm: Point, margin_mm: float
) -> list[UnnumberedPage]:
    """Write the bill of materials and the number of landmarks by pattern."""
    flow = TextFlow(PageFrame(paper_mm, margin_mm, f"{title}: bill of materials"))
    flow.add_space(4.0)
    total = total_of(items)
    head = ("Part", "Count", "Each", f"Sum {total.currency}".strip(), "What to buy")
    flow.add_row(head, BILL_COLUMNS_MM, bold=True)
    for item in items:
        prices, origin = ("-", "-"), ""
        if item.price is not None:
            prices = (f"{item.price.amount:g}", f"{item.amount:.2f}")
            origin = f" (price: {item.price.source}, {item.price.date})"
        cells = (item.part, str(item.count), *prices, printable(item.detail + origin))
        flow.add_row(cells, BILL_COLUMNS_MM)
    flow.add_space(2.0)
    flow.add_paragraph(printable(f"{total.text[0].upper()}{total.text[1:]}."), bold=True)
    flow.add_space(8.0)
    flow.add_paragraph("Landmarks by pattern", points=TITLE_POINTS, bold=True)
    flow.add_space(2.0)
    pattern_head = ("Pattern", "Bars", "Count", "Templates: code x count")
    flow.add_row(pattern_head, PATTERN_COLUMNS_MM, bold=True)
    for pattern in count_patterns(floor):
        codes = ", ".join(
            f"{code_digit(code)} ({name(code)}) x {count}" for code, count in pattern.codes
        )
        row = (str(pattern.number), pattern.letters, str(pattern.landmarks), codes)
        flow.add_row(row, PATTERN_COLUMNS_MM)
    flow.add_space(3.0)
    note = "All bars are identical. Patterns differ only in the directions of the bars."
    flow.add_paragraph(note, points=TEXT_POINTS)
    return flow.pages()


def installation_steps(floor: FloorMap) -> tuple[str, ...]:
    """Return the instructions for the installation of a floor, in order."""
    rows, columns = floor.shape
    low, high = floor.position((0, 0)), floor.position((rows - 1, columns - 1))
    steps = [
        TRUE_SIZE_INSTRUCTION + " A ruler of 100 mm that measures 99 mm is no template.",
        "Prove the map before you drill: locatk map check MAP must report no duplicates.",
        "Keep steel away: no metal on the surface within 100 mm of a bar, no reinforcement within "
        "50 mm below it (what makers of floor transponders ask for). Sweep a compass over the "
        "floor: where the needle turns, there is iron.",
        f"Snap a chalk line for each row and each column, {mm_text(floor.pitch_m)} mm apart, from "
        "one corner, not from line to line, so that errors do not add up.",
    ]
    if rows > 1 and columns > 1:
        diagonal = mm_text(math.dist(low, high))
        steps.append(
            f"Measure both diagonals between the corner cells: {diagonal} mm each, or the lines "
            "are not square."
        )
    steps += [
        "Test the polarity of each bar with a compass, one bar at a time and away from the "
        "others: the end that draws the needle's SOUTH end, and pushes its north end away, is "
        "the bar's north pole. Mark it.",
        "For each cell take the template of its code (marking list). Lay the cross on the cell, "
        "the edge marks on the lines, the arrow along the map's +y. Never turn a template.",
        "Lay each bar with its marked end to the arrow's tip, flat and within 0.5 mm; the "
        "landmark within 0.5 degrees. Let the adhesive set: neighbouring bars pull at each other.",
        f"Keep the top faces of all bars in one plane. The sensors must pass "
        f"{mm_text(floor.geometry.sensor_height_m)} mm above it, the floor's cover included.",
        "Walk over the floor with the compass again, and tick each landmark on the marking list "
        "whose four arrows are as on the plan.",
        "Strong magnets: keep them from pacemakers, cards and each other; wear eye protection.",
        "Drive over every landmark, record, and run locatk calibrate map SESSION: it finds "
        "flipped, weak, missing and displaced bars, and writes the map as built. Use that map from "
        "then on.",
    ]
    return tuple(steps)


def checklist_pages(
    floor: FloorMap, title: str, paper_mm: Point, margin_mm: float
) -> list[UnnumberedPage]:
    """Write the instructions with boxes to tick, and a line to sign."""
    flow = TextFlow(PageFrame(paper_mm, margin_mm, f"{title}: checklist"))
    flow.add_space(4.0)
    for text in installation_steps(floor):
        flow.add_paragraph(text, has_tick_box=True)
        flow.add_space(3.0)
    flow.add_space(6.0)
    flow.add_paragraph(
        "Printed scale measured (mm of 100): ____________    Done by, on: ____________________"
    )
    return flow.pages()


def marking_list_pages(
    floor: FloorMap, title: str, paper_mm: Point, margin_mm: float
) -> list[UnnumberedPage]:
    """List cell, position, code and bars of each landmark, with a box to tick."""
    rows = []
    for cell in floor.cells():
        code = int(floor.codes[cell])
        x, y = (mm_text(value) for value in floor.position(cell))
        bars = (code_digit(code), name(code), str(PATTERN_OF[code]))
        rows.append((str(cell[0]), str(cell[1]), x, y, *bars, "[  ]"))
    longest = max(len(value) for row in rows for value in row[2:4])
    position_mm = max(12.0, text_width("0" * longest, TEXT_POINTS) + 3.0)
    columns = (
        TableColumn("row", 8.5, is_right_aligned=True),
        TableColumn("col", 8.5, is_right_aligned=True),
        TableColumn("x mm", position_mm, is_right_aligned=True),
        TableColumn("y mm", position_mm, is_right_aligned=True),
        TableColumn("code", 8.5, is_right_aligned=True),
        TableColumn("bars", 11.0, is_right_aligned=True),
        TableColumn("pat.", 8.0, is_right_aligned=True),
        TableColumn("done", 8.0, is_right_aligned=True),
    )
    notes = (
        "Bars: the letters of bar 0 (at +x), 1 (+y), 2 (-x) and 3 (-y); N: magnetised "
        "counter-clockwise around the landmark, S: clockwise. Code: the template to take.",
    )
    return table_pages(
        rows, columns, PageFrame(paper_mm, margin_mm, f"{title}: marking list", notes)
    )
