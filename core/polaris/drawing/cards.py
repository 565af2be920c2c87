"""Tags on pages: each on a card of its own, with its labels, to be cut out."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from locatk.core.drawing import (
    CAPITAL_HEIGHT_EM,
    CUT_MARK_MM,
    MM_PER_POINT,
    RULER_DEPTH_MM,
    TRUE_SIZE,
    Group,
    Mark,
    Page,
    Point,
    Text,
    cut_marks,
    page_rulers,
    wrap,
)
from locatk.core.errors import InputError
from locatk.core.polaris.drawing.tag import AXIS_MM, TICK_MM, draw_tag, field_mm
from locatk.core.polaris.tag import TagLayout, Tags

MOST_PAGES = 200

_GAP_MM = 5.0
"""Between two cards."""

_INDENT_MM = 1.0
"""From a card's left edge to its words."""

_HEADER, _TITLE, _DETAIL = 7.0, 8.0, 5.0
"""Sizes of text in points."""

_LEADING = 1.25
"""From line to line in sizes of the font."""

_PAGE_MM = 30.0
"""Room for the number of a page."""

_LEGEND = (
    "Circle: magnet. Arrow: its north, in degrees clockwise from x, seen from above. "
    "+: empty cell. Diamond: origin."
)


@dataclass(frozen=True)
class PlacedTag:
    """Which tag lies where: on which page, counted from 0, and its origin there in mm from
    the lower left corner."""

    tag_id: int
    page: int
    origin_mm: Point


@dataclass(frozen=True)
class Template:
    """Pages of tags to draw, and where each tag is on them, in the order asked for."""

    pages: tuple[Page, ...]
    tags: tuple[PlacedTag, ...]


def draw(
    tags: Tags,
    wanted: Sequence[tuple[int, TagLayout]],
    paper_mm: Point,
    *,
    landscape: bool | None = None,
    margin_mm: float = 10.0,
    mirror: bool = False,
) -> Template:
    """Lay tags out on as many pages as they need.

    Parameters
    ----------
    tags : Tags
        What the tags have in common. They are drawn as designed, not as built.
    wanted : sequence of (id, Layout)
        In the order of the pages, each row by row from the upper left.
    paper_mm : (width, height)
    landscape : bool, optional
        Turn the paper so that its width is the longer (True) or the shorter (False) side.
        None takes it as it is, unless fewer pages are needed the other way.
    margin_mm : float
        Left empty on all sides.
    mirror : bool
        As seen from below, for magnets that are put in from the underside.

    Raises
    ------
    InputError
        A tag is larger than the paper, there is nothing to draw, or there are more than
        :data:`MOST_PAGES` pages.
    """
    if not wanted:
        raise InputError("no tag to draw")
    if not 0 <= margin_mm < min(paper_mm) / 2:
        raise InputError(f"a margin of {margin_mm:g} mm on {_size(paper_mm)}")
    card = _Card.of(tags, [tag_id for tag_id, _ in wanted], mirror)
    sheets = [_Sheet(size, margin_mm) for size in _ways(paper_mm, landscape)]
    roomy = [sheet for sheet in sheets if sheet.room_for(card)]
    if not roomy:
        raise InputError(
            f"a tag of {_size(card.size)}, its labels with it, is larger than the paper of "
            f"{_size(sheets[0].size)} leaves room for, {_size(sheets[0].area)}",
            hint=f"Use a larger paper, as in --size {sheets[0].enough(card)}",
        )
    # The first of those that need the fewest pages: as the paper is, where that is one.
    sheet = min(roomy, key=lambda item: math.ceil(len(wanted) / item.room_for(card)))
    each = sheet.room_for(card)
    count = math.ceil(len(wanted) / each)
    if count > MOST_PAGES:
        raise InputError(
            f"{len(wanted)} tags would take {count} pages, and {MOST_PAGES} are the most",
            hint="Name some of them with --id, or use a larger paper",
        )
    pages: list[Page] = []
    placed: list[PlacedTag] = []
    for number in range(count):
        groups = [sheet.furniture(number, count)]
        some = wanted[number * each : (number + 1) * each]
        for origin, (tag_id, layout) in zip(sheet.origins(card, len(some)), some, strict=True):
            copy = sum(item.tag_id == tag_id for item in placed)
            name = f"tag-{tag_id}" + (f"-copy-{copy}" if copy else "")
            groups.append(Group(name, card.marks(tag_id, layout, origin)))
            placed.append(PlacedTag(tag_id, number, origin))
        pages.append(Page(sheet.size, tuple(groups)))
    return Template(tuple(pages), tuple(placed))


def _ways(paper_mm: Point, landscape: bool | None) -> list[Point]:
    width, height = paper_mm
    ways = [(width, height), (height, width)]
    if landscape is None:
        return ways
    return [max(ways) if landscape else min(ways)]


def _size(size_mm: Point) -> str:
    return f"{size_mm[0]:.0f} x {size_mm[1]:.0f} mm"


@dataclass(frozen=True)
class _Sheet:
    """A paper: rulers at its left and lower edge, words above, the cards between."""

    size: Point
    margin: float

    @property
    def area(self) -> Point:
        """Width and height of what cards and the gaps between them may cover."""
        left, bottom, right, top = self._box
        return right - left, top - bottom

    @property
    def _box(self) -> tuple[float, float, float, float]:
        ruler_mm = RULER_DEPTH_MM + 1.0
        return (
            self.margin + ruler_mm + CUT_MARK_MM,
            self.margin + ruler_mm + CUT_MARK_MM,
            self.size[0] - self.margin - CUT_MARK_MM,
            self.size[1] - self.margin - CUT_MARK_MM - self._header_mm,
        )

    @property
    def _header_mm(self) -> float:
        return len(self._words) * _HEADER * _LEADING * MM_PER_POINT + 1.0

    @property
    def _words(self) -> list[str]:
        """Lines at the top of a page: what must not be missed, then what the signs mean."""
        width = self.size[0] - 2 * self.margin
        return [*wrap(TRUE_SIZE, _HEADER, width - _PAGE_MM), *wrap(_LEGEND, _HEADER, width)]

    def _grid(self, card: _Card) -> tuple[int, int]:
        """Columns and rows of cards that fit."""
        columns, rows = (
            int((room + _GAP_MM + 1e-9) // (side + _GAP_MM))
            for room, side in zip(self.area, card.size, strict=True)
        )
        return max(columns, 0), max(rows, 0)

    def room_for(self, card: _Card) -> int:
        columns, rows = self._grid(card)
        return columns * rows

    def enough(self, card: _Card) -> str:
        """A paper on which the card fits, as it is named on the command line."""
        sides = (
            math.ceil(side + max(0.0, needed - room))
            for side, needed, room in zip(self.size, card.size, self.area, strict=True)
        )
        return "x".join(map(str, sides)) + "mm"

    def origins(self, card: _Card, count: int) -> list[Point]:
        """Origins of ``count`` cards, row by row from the upper left, in the middle."""
        left, _, right, top = self._box
        columns = min(self._grid(card)[0], count)
        width, height = card.size
        start = (left + right - columns * width - (columns - 1) * _GAP_MM) / 2
        origins = []
        for index in range(count):
            row, column = divmod(index, columns)
            x = start + column * (width + _GAP_MM) - card.left
            y = top - row * (height + _GAP_MM) - card.top
            origins.append((round(x, 3), round(y, 3)))
        return origins

    def furniture(self, number: int, count: int) -> Group:
        """Rulers and words of one page."""
        width, height = self.size
        marks = page_rulers(self.size, self.margin)
        line = _HEADER * MM_PER_POINT
        top = height - self.margin - CAPITAL_HEIGHT_EM * line
        page = f"page {number + 1} of {count}"
        marks.append(Text(page, (width - self.margin, top), _HEADER, "end"))
        for index, text in enumerate(self._words):
            at = (self.margin, top - index * _LEADING * line)
            marks.append(Text(text, at, _HEADER, bold=index == 0))
        return Group("page", tuple(marks))


@dataclass(frozen=True)
class _Card:
    """What is cut out: one tag with its axes above and at the left, and its labels.

    Edges are in mm from the tag's origin.
    """

    tags: Tags
    mirror: bool
    left: float
    bottom: float
    right: float
    top: float

    @classmethod
    def of(cls, tags: Tags, ids: Sequence[int], mirror: bool) -> _Card:
        """The card that fits all of these tags."""
        field = field_mm(tags)
        left, right = -field - AXIS_MM, field + TICK_MM
        if mirror:
            left, right = -right, -left
        card = cls(tags, mirror, left, -field - TICK_MM, right, field + AXIS_MM)
        lines = max(len(card._title(tag_id)) for tag_id in ids)
        top = card.top + _lines_mm(lines, _TITLE)
        bottom = card.bottom - _lines_mm(len(card._details()), _DETAIL)
        return replace(card, top=top, bottom=bottom)

    @property
    def size(self) -> Point:
        return self.right - self.left, self.top - self.bottom

    def marks(self, tag_id: int, layout: TagLayout, origin: Point) -> tuple[Mark, ...]:
        """The tag whose origin lies there."""
        tag = draw_tag(self.tags, layout, origin, mirror=self.mirror)
        x, y = origin
        edges = (x + self.left, y + self.bottom, x + self.right, y + self.top)
        return (*tag, *self._words(tag_id, origin), *cut_marks(*edges))

    def _words(self, tag_id: int, origin: Point) -> list[Mark]:
        left = origin[0] + self.left + _INDENT_MM
        words: list[Mark] = []
        for lines, points, top in (
            (self._title(tag_id), _TITLE, self.top),
            (self._details(), _DETAIL, -field_mm(self.tags) - TICK_MM),
        ):
            for index, text in enumerate(lines, 1):
                baseline = origin[1] + top - index * _LEADING * points * MM_PER_POINT
                words.append(Text(text, (left, baseline), points, bold=points == _TITLE))
        return words

    def _title(self, tag_id: int) -> list[str]:
        text = f"id {tag_id}" + (", MIRRORED: seen from below" if self.mirror else "")
        return wrap(text, _TITLE, self.size[0] - _INDENT_MM)

    def _details(self) -> list[str]:
        """What the card says below the tag."""
        tags, disc = self.tags, self.tags.magnet
        text = (
            f"{tags.codec}, K={tags.order}, M={tags.magnets}, P={tags.orientations}, "
            f"d={1e3 * tags.spacing_m:g} mm, "
            f"magnets D{1e3 * disc.diameter_m:g} x {1e3 * disc.height_m:g} mm "
            f"{disc.grade or f'{disc.remanence_t:g} T'}, "
            f"clearance {1e3 * tags.clearance_m:g} mm"
        )
        return wrap(text, _DETAIL, self.size[0] - _INDENT_MM)


def _lines_mm(count: int, points: float) -> float:
    return (count * _LEADING + 0.3) * points * MM_PER_POINT
