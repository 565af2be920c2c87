"""Tags on pages: each on a card with its labels, to be cut out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from locatk.core.drawing import (
    CUT_MARK_MM,
    MIN_TEXT_POINTS,
    MM_PER_POINT,
    TRUE_SIZE_INSTRUCTION,
    Box,
    Group,
    Mark,
    Page,
    Point,
    Text,
    cut_marks,
    paragraph,
    shifted,
    wrap,
)
from locatk.core.drawing.cards import CardGrid
from locatk.core.drawing.pages import (
    FRAME_CLEARANCE_MM,
    TEXT_POINTS,
    PageFrame,
    UnnumberedPage,
    check_margin,
    larger_paper_text,
    number_pages,
    printable,
    size_text,
)
from locatk.core.errors import InputError
from locatk.core.materials import size_mm_text
from locatk.core.polaris.drawing.tag import (
    AXIS_ARROW_MM,
    AXIS_TICK_MM,
    angle_text,
    draw_tag,
    has_all_angles,
    tag_half_side,
)
from locatk.core.polaris.tag import TagLayout, Tags

MAX_PAGES = 200
"""Largest number of pages of one drawing."""

CARD_GAP_MM = 5.0
"""Distance between two cards."""

CUT_MARK_CLEARANCE_MM = 1.0
"""Distance of the cut marks from the rulers and from the text above the cards."""

TEXT_INDENT_MM = 1.0
"""Distance of the text of a card from its left edge."""

ID_POINTS = 8.0
"""Font size of the id of a tag."""

DETAIL_POINTS = MIN_TEXT_POINTS
"""Font size of the design of a tag."""

SPACING_EM = 1.25
"""Line height as a fraction of the font size."""

TEXT_BLOCK_GAP_EM = 0.3
"""Distance of a block of text from the tag, as a fraction of the font size."""

_LEGEND = (
    "Circle: magnet. Arrow: its north, in degrees clockwise from x, seen from above. "
    "+: empty cell. Diamond: origin."
)


@dataclass(frozen=True)
class PlacedTag:
    """Position of a tag on the pages.

    ``page`` is counted from 0; ``origin_mm`` is the origin of the tag from the lower left corner of
    the page.
    """

    tag_id: int
    page: int
    origin_mm: Point


@dataclass(frozen=True)
class TagPages:
    """Pages with tags, and the position of each tag in the order of the request."""

    pages: tuple[Page, ...]
    tags: tuple[PlacedTag, ...]


def draw_tag_cards(
    tags: Tags,
    requested: Sequence[tuple[int, TagLayout]],
    paper_mm: Point,
    *,
    margin_mm: float = 10.0,
    mirror: bool = False,
) -> TagPages:
    """Draw tags on cards, on as many pages as needed, each row by row from the upper left.

    Parameters
    ----------
    tags : Tags
        Design of the tags. They are drawn as designed, not as built.
    requested : sequence of (id, TagLayout)
        Tags in the order of the pages.
    paper_mm : (width, height)
        The paper is rotated if that takes fewer pages.
    margin_mm : float
    mirror : bool
        Draw the tags as seen from below, for magnets that are inserted from the underside.

    Raises
    ------
    InputError
        A tag is larger than the paper, there is nothing to draw, or there are more than
        :data:`MAX_PAGES` pages.
    """
    if not requested:
        raise InputError("no tag to draw")
    check_margin(paper_mm, margin_mm, min_content_mm=0.0)
    drawings = {
        tag_id: _TagDrawing.of(tags, tag_id, layout, mirror) for tag_id, layout in requested
    }
    card = _TagCard.for_drawings(tags, list(drawings.values()), mirror)
    frames = [
        PageFrame(size_mm, margin_mm, TRUE_SIZE_INSTRUCTION, (_LEGEND,), TEXT_POINTS, SPACING_EM)
        for size_mm in (paper_mm, paper_mm[::-1])
    ]
    grids = [CardGrid.densest(_card_area(frame), card.size_mm, CARD_GAP_MM) for frame in frames]
    choices = [pair for pair in zip(grids, frames, strict=True) if pair[0].cards_per_page]
    if not choices:
        raise _too_small(frames[0], card)
    grid, frame = min(choices, key=lambda pair: pair[0].page_count(len(requested)))
    page_count = grid.page_count(len(requested))
    if page_count > MAX_PAGES:
        raise InputError(
            f"{len(requested)} tags take {page_count} pages; at most {MAX_PAGES} are possible",
            hint="Name some of them with --id, or use a larger paper",
        )
    groups: list[list[Group]] = [[] for _ in range(page_count)]
    placed: list[PlacedTag] = []
    slots = grid.slots(len(requested), centred=True)
    for (tag_id, _), slot in zip(requested, slots, strict=True):
        copy = sum(item.tag_id == tag_id for item in placed)
        name = f"tag-{tag_id}" + (f"-copy-{copy}" if copy else "")
        origin = card.origin(slot.corner_mm)
        groups[slot.page].append(Group(name, card.marks(drawings[tag_id], origin)))
        placed.append(PlacedTag(tag_id, slot.page, origin))
    pages = number_pages([UnnumberedPage(frame, tuple(page)) for page in groups])
    return TagPages(pages, tuple(placed))


def _card_area(frame: PageFrame) -> Box:
    """Return the area for cards, whose cut marks extend beyond it."""
    left, bottom, right, top = frame.content_box
    inset = CUT_MARK_MM + CUT_MARK_CLEARANCE_MM - FRAME_CLEARANCE_MM
    return left + inset, bottom + inset, right - CUT_MARK_MM, top - inset


def _too_small(frame: PageFrame, card: _TagCard) -> InputError:
    left, bottom, right, top = _card_area(frame)
    available = (right - left, top - bottom)
    paper = larger_paper_text(frame.size_mm, card.size_mm, available)
    return InputError(
        f"a tag with its labels takes {size_text(card.size_mm, 0)}; a paper of "
        f"{size_text(frame.size_mm, 0)} has {size_text(available, 0)} for it, so the tag is larger "
        "than the paper",
        hint=f"Use a larger paper, as in --size {paper}",
    )


@dataclass(frozen=True)
class _TagDrawing:
    """Drawing of a tag around (0, 0), with the texts above and below it."""

    marks: tuple[Mark, ...]
    id_text: str
    meaning: str
    details: str

    @classmethod
    def of(cls, tags: Tags, tag_id: int, layout: TagLayout, mirror: bool) -> _TagDrawing:
        """Draw a tag; angles that have no space between its magnets are listed below it."""
        marks = draw_tag(tags, layout, mirror=mirror)
        details = _design_text(tags)
        if not has_all_angles(tags, marks):
            details += f". {_angle_list(tags, layout, mirror)}"
        id_text = f"id {tag_id}" + (", MIRRORED: seen from below" if mirror else "")
        return cls(marks, id_text, printable(tags.meanings.get(tag_id, "")), details)


def _design_text(tags: Tags) -> str:
    disc = tags.magnet
    return (
        f"{tags.codec}, K={tags.order}, M={tags.magnets}, P={tags.orientations}, "
        f"d={size_mm_text(tags.spacing_m)}, "
        f"magnets D{size_mm_text(disc.diameter_m, disc.height_m)} "
        f"{disc.grade or f'{disc.remanence_t:g} T'}, "
        f"clearance {size_mm_text(tags.clearance_m)}"
    )


def _angle_list(tags: Tags, layout: TagLayout, mirror: bool) -> str:
    """List the angles of the magnets as they are on the page, row by row from the top."""
    angles = {
        cell: angle_text(tags, symbol)
        for cell, symbol in zip(layout.cells, layout.symbols, strict=True)
    }
    columns = range(tags.order)
    rows = (
        " ".join(
            angles.get((column, row), "-") for column in (columns[::-1] if mirror else columns)
        )
        for row in reversed(columns)
    )
    return f"Angles, row by row from the top: {'; '.join(rows)}"


@dataclass(frozen=True)
class _TagCard:
    """Area that is cut out: a tag with axes above and at the left, and labels above and below.

    The edges are in mm from the origin of the tag; ``tag_bottom`` is that of its drawing.
    """

    left: float
    bottom: float
    right: float
    top: float
    tag_bottom: float

    @classmethod
    def for_drawings(cls, tags: Tags, drawings: Sequence[_TagDrawing], mirror: bool) -> _TagCard:
        """Return the card that fits all of these drawings with their texts."""
        half = tag_half_side(tags)
        left, right = -half - AXIS_ARROW_MM, half + AXIS_TICK_MM
        if mirror:
            left, right = -right, -left
        bottom, top = -half - AXIS_TICK_MM, half + AXIS_ARROW_MM
        bare = cls(left, bottom, right, top, bottom)
        id_lines = max(len(bare._id_lines(drawing)) for drawing in drawings)
        detail_lines = max(len(bare._detail_lines(drawing)) for drawing in drawings)
        top += _block_height(id_lines, ID_POINTS)
        return replace(bare, top=top, bottom=bottom - _block_height(detail_lines, DETAIL_POINTS))

    @property
    def size_mm(self) -> Point:
        return self.right - self.left, self.top - self.bottom

    def origin(self, corner: Point) -> Point:
        """Return the origin of the tag on the page from the upper left corner of the card."""
        return round(corner[0] - self.left, 3), round(corner[1] - self.top, 3)

    def marks(self, drawing: _TagDrawing, origin: Point) -> tuple[Mark, ...]:
        """Draw the card of a tag with the origin of the tag at ``origin``."""
        corner = (self.left + TEXT_INDENT_MM, self.top)
        below = (corner[0], self.tag_bottom)
        marks = (
            *drawing.marks,
            *_paragraph(self._id_lines(drawing), corner, ID_POINTS, bold=True),
            *_paragraph(self._detail_lines(drawing), below, DETAIL_POINTS),
            *cut_marks(self.left, self.bottom, self.right, self.top),
        )
        return tuple(shifted(mark, *origin) for mark in marks)

    def _id_lines(self, drawing: _TagDrawing) -> list[str]:
        """Return the id of the tag and its meaning, which are written above it."""
        texts = (drawing.id_text, drawing.meaning)
        return [line for text in texts for line in self._wrap(text, ID_POINTS)]

    def _detail_lines(self, drawing: _TagDrawing) -> list[str]:
        """Return the design of the tag, which is written below it."""
        return self._wrap(drawing.details, DETAIL_POINTS)

    def _wrap(self, text: str, points: float) -> list[str]:
        return wrap(text, points, self.size_mm[0] - TEXT_INDENT_MM)


def _paragraph(lines: list[str], corner: Point, points: float, *, bold: bool = False) -> list[Text]:
    return paragraph(lines, corner, points, spacing_em=SPACING_EM, bold=bold)


def _block_height(lines: int, points: float) -> float:
    return (lines * SPACING_EM + TEXT_BLOCK_GAP_EM) * points * MM_PER_POINT
