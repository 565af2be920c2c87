"""Pages of words of an installation pack: materials, checklist, marking list."""

from __future__ import annotations

import math
from collections.abc import Sequence

from locatk.core.drawing import TRUE_SIZE, Group, Line, Mark, Polygon, Text, text_width, wrap
from locatk.core.landmarks.design.materials import patterns
from locatk.core.landmarks.drawing.landmark import digit
from locatk.core.landmarks.drawing.page import (
    TEXT,
    TITLE,
    Column,
    Frame,
    Leaf,
    line_mm,
    table,
)
from locatk.core.landmarks.landmark import PATTERN_OF, name
from locatk.core.landmarks.map.floor import FloorMap
from locatk.core.materials import Item
from locatk.core.units import mm_text

_POINTS = 9.0


class Flow:
    """Lines of text from the top of a page down, and on to the next."""

    def __init__(self, frame: Frame) -> None:
        self.frame = frame
        self._pages: list[list[Mark]] = [[]]
        self._y = frame.box[3]

    def space(self, mm: float) -> None:
        """Leave some room."""
        self._y -= mm

    def add(
        self, text: str, *, points: float = _POINTS, bold: bool = False, boxed: bool = False
    ) -> None:
        """A paragraph; ``boxed`` has a box to tick at its left."""
        left, bottom, right, _ = self.frame.box
        indent = 8.0 if boxed else 0.0
        lines = wrap(text, points, right - left - indent)
        step = line_mm(points)
        if self._y - len(lines) * step < bottom:
            self._pages.append([])
            self._y = self.frame.box[3]
        marks = self._pages[-1]
        if boxed:
            low, side = self._y - step, 0.75 * step
            corners = ((left, low), (left + side, low), (left + side, low + side))
            marks.append(Polygon((*corners, (left, low + side)), width_mm=0.2))
        for line in lines:
            self._y -= step
            marks.append(Text(line, (left + indent, self._y), points, bold=bold))

    def row(self, cells: Sequence[str], widths: Sequence[float], *, bold: bool = False) -> None:
        """A row of a table with columns of these widths; the last one's text is wrapped, and
        takes what is left of the page's width."""
        left, bottom, right, _ = self.frame.box
        step = line_mm(_POINTS)
        lines = wrap(cells[-1], _POINTS, right - left - sum(widths))
        if self._y - len(lines) * step < bottom:
            self._pages.append([])
            self._y = self.frame.box[3]
        marks = self._pages[-1]
        x = left
        for text, width in zip(cells[:-1], widths, strict=True):
            marks.append(Text(text, (x, self._y - step), _POINTS, bold=bold))
            x += width
        for line in lines:
            self._y -= step
            marks.append(Text(line, (x, self._y), _POINTS, bold=bold))
        self._y -= 0.3 * step
        marks.append(Line((left, self._y), (right, self._y), 0.2 if bold else 0.05))
        self._y -= 0.1 * step

    def leaves(self) -> list[Leaf]:
        """The pages."""
        return [Leaf(self.frame, (Group("words", tuple(marks)),)) for marks in self._pages]


def bill_leaves(
    floor: FloorMap, items: Sequence[Item], title: str, paper_mm: tuple[float, float], margin: float
) -> list[Leaf]:
    """The bill of materials, and the landmarks by pattern."""
    flow = Flow(Frame(paper_mm, margin, f"{title}: bill of materials"))
    flow.space(4.0)
    flow.row(("Part", "Count", "What to buy"), (42.0, 18.0), bold=True)
    for item in items:
        flow.row((item.part, str(item.count), item.detail), (42.0, 18.0))
    flow.space(8.0)
    flow.add("Landmarks by pattern", points=TITLE, bold=True)
    flow.space(2.0)
    flow.row(("Pattern", "Bars", "Count", "Templates: code x count"), (20.0, 22.0, 18.0), bold=True)
    for found in patterns(floor):
        codes = ", ".join(f"{digit(code)} ({name(code)}) x {count}" for code, count in found.codes)
        cells = (str(found.number), found.letters, str(found.landmarks), codes)
        flow.row(cells, (20.0, 22.0, 18.0))
    flow.space(3.0)
    flow.add("All bars are alike: a pattern is only how they are laid.", points=TEXT)
    return flow.leaves()


def checks(floor: FloorMap) -> tuple[str, ...]:
    """What to do and to check when a floor is laid, in order."""
    geometry = floor.geometry
    rows, columns = floor.shape
    low, high = floor.place((0, 0)), floor.place((rows - 1, columns - 1))
    lines = [
        TRUE_SIZE + " A ruler of 100 mm that measures 99 mm is no template.",
        "Prove the map before you drill: locatk map check MAP must report no duplicates.",
        "Keep steel away: no metal on the surface within 100 mm of a bar, no reinforcement within "
        "50 mm below it (what makers of floor transponders ask for). Sweep a compass over the "
        "floor: where the needle turns, there is iron.",
        f"Snap a chalk line for each row and each column, {mm_text(floor.pitch_m)} mm apart, from "
        "one corner, not from line to line, so that errors do not add up.",
    ]
    if rows > 1 and columns > 1:
        cross = mm_text(math.dist(low, high))
        lines.append(
            f"Measure both diagonals between the corner cells: {cross} mm each, or the lines are "
            "not square."
        )
    lines += [
        "Test the polarity of each bar with a compass, one bar at a time and away from the "
        "others: the end that draws the needle's SOUTH end, and pushes its north end away, is "
        "the bar's north pole. Mark it.",
        "For each cell take the template of its code (marking list). Lay the cross on the cell, "
        "the edge marks on the lines, the arrow along the map's +y. Never turn a template.",
        "Lay each bar with its marked end to the arrow's tip, flat and within 0.5 mm; the "
        "landmark within 0.5 degrees. Let the adhesive set: neighbouring bars pull at each other.",
        f"Keep the top faces of all bars in one plane. The sensors must pass "
        f"{mm_text(geometry.sensor_height_m)} mm above it, the floor's cover included.",
        "Walk over the floor with the compass again, and tick each landmark on the marking list "
        "whose four arrows are as on the plan.",
        "Strong magnets: keep them from pacemakers, cards and each other; wear eye protection.",
        "Drive over every landmark, record, and run locatk calibrate map SESSION: it finds "
        "flipped, weak, missing and displaced bars, and writes the map as built, with which to "
        "solve from then on.",
    ]
    return tuple(lines)


def checklist_leaves(
    floor: FloorMap, title: str, paper_mm: tuple[float, float], margin: float
) -> list[Leaf]:
    """Boxes to tick, and lines to sign."""
    flow = Flow(Frame(paper_mm, margin, f"{title}: checklist"))
    flow.space(4.0)
    for text in checks(floor):
        flow.add(text, boxed=True)
        flow.space(3.0)
    flow.space(6.0)
    flow.add(
        "Printed scale measured (mm of 100): ____________    Done by, on: ____________________"
    )
    return flow.leaves()


def list_leaves(
    floor: FloorMap, title: str, paper_mm: tuple[float, float], margin: float
) -> list[Leaf]:
    """Each landmark's cell, place, code and bars, with a box to tick."""
    rows = []
    for cell in floor.cells():
        code = int(floor.codes[cell])
        x, y = (mm_text(value) for value in floor.place(cell))
        bars = (digit(code), name(code), str(PATTERN_OF[code]))
        rows.append((str(cell[0]), str(cell[1]), x, y, *bars, "[  ]"))
    longest = max(len(value) for row in rows for value in row[2:4])
    place = max(12.0, text_width("0" * longest, TEXT) + 3.0)
    columns = (
        Column("row", 8.5, True),
        Column("col", 8.5, True),
        Column("x mm", place, True),
        Column("y mm", place, True),
        Column("code", 8.5, True),
        Column("bars", 11.0, True),
        Column("pat.", 8.0, True),
        Column("done", 8.0, True),
    )
    words = (
        "Bars: the letters of bar 0 (at +x), 1 (+y), 2 (-x) and 3 (-y); N: magnetised "
        "counter-clockwise around the landmark, S: clockwise. Code: the template to take.",
    )
    return table(rows, columns, Frame(paper_mm, margin, f"{title}: marking list", words))
