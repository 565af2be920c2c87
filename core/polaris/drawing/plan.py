"""Plan of a site for the installer: the floor to scale, and a table of the tags.

Each tag has its square, an arrow along its x axis, its id, heading and meaning. Ordinates at the
left and lower edge of the plan are the coordinates of the tags from the datum. If the labels do not
fit on one page, the plan is divided over several pages of a larger scale, after an overview.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from locatk.core.drawing import (
    Box,
    Circle,
    Group,
    Line,
    Mark,
    Page,
    Point,
    Polygon,
    Text,
    arrow,
    capital_height,
    cross,
    line_height,
    rectangle,
    text_width,
    wrap,
)
from locatk.core.drawing.pages import (
    TEXT_POINTS,
    TITLE_POINTS,
    PageFrame,
    TableColumn,
    UnnumberedPage,
    check_margin,
    number_pages,
    printable,
    table_pages,
    text_paper,
)
from locatk.core.drawing.placement import Obstacles
from locatk.core.drawing.scale import axes, round_scale, scale_bar
from locatk.core.drawing.tiles import tile_name
from locatk.core.errors import InputError
from locatk.core.polaris.drawing.outline import tag_side
from locatk.core.polaris.tag import PlanarPose, Tags
from locatk.core.units import mm_text

Array = NDArray[np.float64]

MIN_SYMBOL_MM = 2.0
"""Smallest side of the square of a tag on the paper; smaller tags are drawn larger."""

HEADING_ARROW_MM = 4.0
"""Length of the arrow of a heading beyond the square."""

EDGE_SPACE_MM = 20.0
"""Largest space between the outer tags of a plan on one page and its edge, for labels."""

FOOT_MM = 16.0
"""Height of the strip below the ordinates, with axes and scale bar."""

OVERVIEW_EDGE_MM = 4.0
"""Space at the sides of the overview, for the symbol of the datum."""

JOG_MM = 6.0
"""Length of the lines between the edge of the plan and the ordinates."""

MEANING_WIDTH_MM = 32.0
"""Width to which meanings are wrapped on the plan."""

LABEL_MARGIN_MM = 0.4
"""Distance of lines from the box of a label."""

LABEL_DISTANCES_MM = (0.8, 4.0, 8.0, 13.0, 19.0)
"""Distances of a label from its tag that are tried; the label has a line to its tag beyond the
first one."""

ZOOMS = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0)
"""Ratios of the scale to that of one page that are tried until all labels fit."""

MAX_TAGS_PER_PAGE = 150
"""Number of tags on a page above which the plan is divided without trying to place their labels."""

PARTS_PER_TAG = 3
"""Number of labels and ordinates of a tag: its label, and one ordinate along each axis."""

OUTSIDE_WEIGHT_MM = 1e3
"""Area [mm^2] of overlap that is as bad as each mm of a label beyond the edge of the plan."""

MAX_DATUM_RATIO = 2.0
"""Ratio by which the plan may become larger to contain the datum."""

MAX_PAGES = 300
"""Largest number of pages of a plan with its table."""

SAME_ORDINATE_MM = 0.05
"""Difference of two coordinates that are one ordinate: half of the last decimal."""


DATUM_ON_PAGE = "is the crossed circle"
"""Words for a datum on the same page, the longest ones for its place."""


@dataclass(frozen=True)
class SitePlan:
    """Pages of the plan of a site.

    Attributes
    ----------
    pages : tuple of Page
    plan_pages : int
        Number of pages before the table.
    scale : float
        The n of 1 : n of the plan.
    page_of : dict of int to int
        Page of each tag on the plan, counted from 0, by its id.
    """

    pages: tuple[Page, ...]
    plan_pages: int
    scale: float
    page_of: dict[int, int]


def draw_site_plan(
    tags: Tags,
    title: str,
    paper_mm: Point,
    *,
    margin_mm: float = 10.0,
    datum_m: Point = (0.0, 0.0),
) -> SitePlan:
    """Draw the plan of a site and the table of its tags.

    Parameters
    ----------
    tags : Tags
        With a site.
    title : str
    paper_mm : (width, height)
        The paper of the plan is rotated if that gives fewer pages or a larger scale.
    margin_mm : float
    datum_m : (x, y)
        Point of the frame of the site from which positions are measured.

    Raises
    ------
    InputError
        There is no site, the paper is too small, or there are more than :data:`MAX_PAGES` pages.
    """
    if not tags.site:
        raise InputError(
            "no tag has a position", hint="Add them with [[site]], or by `locatk site import`"
        )
    check_margin(paper_mm, margin_mm, min_content_mm=100.0)
    floor = _Floor(tags, printable(title), datum_m)
    plans = [_divide(floor, size, margin_mm) for size in (paper_mm, paper_mm[::-1])]
    plan = min(plans, key=lambda item: (item.cost, item.scale))
    pages, page_of = _plan_pages(floor, plan)
    table = _table(floor, text_paper(paper_mm), margin_mm, page_of if len(pages) > 1 else {})
    if len(pages) + len(table) > MAX_PAGES:
        raise InputError(
            f"the plan takes {len(pages) + len(table)} pages; at most {MAX_PAGES} are possible",
            hint="Use a larger paper",
        )
    return SitePlan(number_pages([*pages, *table]), len(pages), plan.scale, page_of)


class _Floor:
    """Tags in mm from the datum, in the order of their ids."""

    def __init__(self, tags: Tags, title: str, datum_m: Point) -> None:
        self.title = title
        self.side_mm = tag_side(tags)
        x, y = (mm_text(value) for value in datum_m)
        self.datum_name = f"the datum ({x}, {y} mm in the frame of the site)"
        self.ids = sorted(tags.site)
        self.poses = [tags.site[tag_id] for tag_id in self.ids]
        self.meanings = [printable(tags.meanings.get(tag_id, "")) for tag_id in self.ids]
        position_m = np.array([[pose.x_m, pose.y_m] for pose in self.poses])
        self.position_mm: Array = 1e3 * (position_m - datum_m)
        low, high = self.position_mm.min(axis=0), self.position_mm.max(axis=0)
        with_datum = np.minimum(low, 0.0), np.maximum(high, 0.0)
        size = np.maximum(high - low, 4 * self.side_mm)
        self.has_datum = bool((with_datum[1] - with_datum[0] <= MAX_DATUM_RATIO * size).all())
        if self.has_datum:
            low, high = with_datum
        # A single tag, or a row of tags, has some floor around it.
        padding_mm = np.maximum(0.0, 2 * self.side_mm - (high - low)) / 2 + self.side_mm
        self.low_mm, self.high_mm = low - padding_mm, high + padding_mm

    def ordinates(self, index: Sequence[int], axis: int) -> Array:
        """Return the different coordinates of tags along x (0) or y (1), ascending."""
        values = np.unique(np.round(self.position_mm[list(index), axis], 1))
        return np.asarray(values, float)


@dataclass(frozen=True)
class _Block:
    """Rectangle of the floor on one page, in mm from the datum, with the indices of its tags."""

    low: Point
    high: Point
    members: tuple[int, ...]

    def has_datum(self, floor: _Floor) -> bool:
        """Return whether the page of this block draws the datum."""
        return floor.has_datum and all(
            low - SAME_ORDINATE_MM <= 0 <= high + SAME_ORDINATE_MM
            for low, high in zip(self.low, self.high, strict=True)
        )


@dataclass(frozen=True)
class _Division:
    """Division of the floor over pages.

    ``unplaced`` is the number of labels and ordinates without space; None if a block has more than
    :data:`MAX_TAGS_PER_PAGE` tags.
    """

    frame: PageFrame
    blocks: tuple[_Block, ...]
    across: int
    scale: float
    unplaced: int | None

    @property
    def cost(self) -> int:
        """Number of pages and of unplaced labels and ordinates: a page more is worth a label.

        With unknown labels, it is the number of all labels and ordinates at any number of pages, so
        that the largest scale is the best one.
        """
        sizes = [len(block.members) for block in self.blocks if block.members]
        if self.unplaced is None:
            return PARTS_PER_TAG * sum(sizes)
        return self.unplaced + len(sizes) + (len(sizes) > 1)  # and the overview


def _frame(floor: _Floor, size_mm: Point, margin_mm: float, name: str, notes: str) -> PageFrame:
    title = f"{floor.title}: {name}"
    return PageFrame(size_mm, margin_mm, title, (notes,), has_rulers=False)


def _datum_state(floor: _Floor, block: _Block, is_divided: bool) -> str:
    """Return where the datum is, in the words of the note of the page of a block."""
    if block.has_datum(floor):
        return DATUM_ON_PAGE
    return "is in the overview" if floor.has_datum and is_divided else "is off the plan"


def _notes(floor: _Floor, scale: float, datum_state: str) -> str:
    symbols = (
        "Squares are to scale"
        if floor.side_mm / scale >= MIN_SYMBOL_MM
        else "Squares are larger than the tags"
    )
    return (
        f"{len(floor.ids)} tags, 1 : {scale:g}. {symbols}; arrows are the tags' x axes (forward). "
        "At a tag: id, heading counter-clockwise from +x, meaning. Numbers at the edges are mm to "
        f"the middles of the tags from {floor.datum_name}, which {datum_state}."
    )


def _ordinate_space(floor: _Floor) -> float:
    """Return the space in mm for ordinates at the left of and below the plan."""
    low, high = floor.position_mm.min(axis=0), floor.position_mm.max(axis=0)
    texts = [mm_text(value / 1e3) for value in (*low, *high)]
    texts += [mm_text(value / 1e3) for value in floor.position_mm.ravel().tolist()]
    return JOG_MM + 1.5 + max(text_width(text, TEXT_POINTS) for text in texts)


def _plan_box(floor: _Floor, frame: PageFrame) -> Box:
    left, bottom, right, top = frame.content_box
    space = _ordinate_space(floor)
    return left + space, bottom + FOOT_MM + space, right, top


def _divide(floor: _Floor, size_mm: Point, margin_mm: float) -> _Division:
    """Divide the plan over as few pages of this size as its labels need.

    If they do not fit at any scale, most of them do at that of the result. Of equal divisions, the
    one of the largest scale is returned.
    """
    divisions: list[_Division] = []
    extent = floor.high_mm - floor.low_mm
    # The height of the notes hardly depends on the scale; those with the datum are the longest.
    notes = _notes(floor, 1000.0, DATUM_ON_PAGE)
    frame = _frame(floor, size_mm, margin_mm, "plan of the tags", notes)
    left, bottom, right, top = _plan_box(floor, frame)
    space = np.array([right - left, top - bottom])
    if not (space > 20).all():
        raise InputError("the paper is too small for a plan of the tags", hint="Use a larger paper")
    fit = float((extent / space).max())
    for zoom in ZOOMS:
        scale = round_scale(max(1.0, fit / zoom))
        count = np.ceil(extent / (space * scale) - 1e-9).astype(int)
        notes = _notes(floor, scale, DATUM_ON_PAGE)
        frame = _frame(floor, size_mm, margin_mm, "plan of the tags", notes)
        blocks = _blocks(floor, count, scale * space, scale * EDGE_SPACE_MM)
        unplaced = None
        if max(len(block.members) for block in blocks) <= MAX_TAGS_PER_PAGE:
            box = _plan_box(floor, frame)
            sheets = [_Sheet(floor, block, scale, box) for block in blocks if block.members]
            unplaced = sum(sheet.unplaced for sheet in sheets)
        divisions.append(_Division(frame, blocks, int(count[0]), scale, unplaced))
        if unplaced == 0:
            break
    return min(divisions, key=lambda item: (item.cost, item.scale))


def _blocks(
    floor: _Floor, count: NDArray[np.int64], page_mm: Array, edge_mm: float
) -> tuple[_Block, ...]:
    """Return equal blocks, row by row from the upper left one, with the floor in their middle.

    ``page_mm`` is the size of the floor on a page, and ``edge_mm`` the space for labels around the
    tags of a plan on one page.
    """
    extent = floor.high_mm - floor.low_mm
    step = np.where(count == 1, np.minimum(page_mm, extent + 2 * edge_mm), page_mm)
    origin = (floor.low_mm + floor.high_mm - count * step) / 2
    cell = np.floor((floor.position_mm - origin) / step).astype(int)
    cell = np.clip(cell, 0, count - 1)
    blocks = []
    for row in range(int(count[1]) - 1, -1, -1):
        for column in range(int(count[0])):
            low = origin + step * [column, row]
            members = np.flatnonzero((cell == [column, row]).all(axis=1)).tolist()
            high = low + step
            corners = [(float(corner[0]), float(corner[1])) for corner in (low, high)]
            blocks.append(_Block(corners[0], corners[1], tuple(members)))
    return tuple(blocks)


def _plan_pages(floor: _Floor, plan: _Division) -> tuple[list[UnnumberedPage], dict[int, int]]:
    """Draw the plan; with several blocks, the overview comes first, and empty blocks are left out.

    Returns
    -------
    pages : list of UnnumberedPage
    page_of : dict of int to int
        Page of each tag by its id, counted from 0.
    """
    names = [tile_name(number, plan.across) for number in range(len(plan.blocks))]
    drawn = [(name, block) for name, block in zip(names, plan.blocks, strict=True) if block.members]
    is_divided = len(drawn) > 1
    pages = [_overview(floor, plan, drawn)] if is_divided else []
    page_of: dict[int, int] = {}
    for name, block in drawn:
        for index in block.members:
            page_of[floor.ids[index]] = len(pages)
        title = f"plan of the tags, {name}" if is_divided else "plan of the tags"
        notes = _notes(floor, plan.scale, _datum_state(floor, block, is_divided))
        frame = _frame(floor, plan.frame.size_mm, plan.frame.margin_mm, title, notes)
        sheet = _Sheet(floor, block, plan.scale, _plan_box(floor, frame))
        foot = _foot(frame, plan.scale)
        pages.append(
            UnnumberedPage(frame, (Group("plan", tuple(sheet.marks())), Group("foot", foot)))
        )
    return pages, page_of


def _foot(frame: PageFrame, scale: float) -> tuple[Mark, ...]:
    """Draw the axes and the scale bar in the lower left corner of a page."""
    left, bottom, _, _ = frame.content_box
    return (
        *axes((left + 1.0, bottom + 1.0), 9.0, "+x", "+y"),
        *scale_bar((left + 28.0, bottom + 2.0), scale, 60.0),
        Text(f"1 : {scale:g}", (left + 28.0, bottom + 5.0), TEXT_POINTS, bold=True),
    )


def _overview(
    floor: _Floor, plan: _Division, drawn: Sequence[tuple[str, _Block]]
) -> UnnumberedPage:
    """Draw all tags as points, with the names of the parts of the plan."""
    frame = _frame(
        floor,
        plan.frame.size_mm,
        plan.frame.margin_mm,
        "overview",
        f"{len(floor.ids)} tags. Each rectangle is a page of the plan, 1 : {plan.scale:g}.",
    )
    left, bottom, right, top = frame.content_box
    low = np.min([block.low for _, block in drawn] + [tuple(floor.low_mm)], axis=0)
    high = np.max([block.high for _, block in drawn] + [tuple(floor.high_mm)], axis=0)
    space = [right - left - 2 * OVERVIEW_EDGE_MM, top - bottom - FOOT_MM - OVERVIEW_EDGE_MM]
    scale = round_scale(float(((high - low) / space).max()))
    corner = (left + OVERVIEW_EDGE_MM, top - float(high[1] - low[1]) / scale)

    def on_page(point: Point) -> Point:
        return (
            corner[0] + (point[0] - float(low[0])) / scale,
            corner[1] + (point[1] - float(low[1])) / scale,
        )

    marks: list[Mark] = []
    for name, block in drawn:
        lower, upper = on_page(block.low), on_page(block.high)
        marks.append(rectangle((*lower, *upper), 0.25))
        position = (lower[0] + 1.0, upper[1] - 1.0 - capital_height(TITLE_POINTS))
        marks.append(Text(name, position, TITLE_POINTS, bold=True))
        for index in block.members:
            x, y = floor.position_mm[index].tolist()
            marks.append(Circle(on_page((x, y)), 0.4, 0.4))
    if floor.has_datum:
        marks += _datum(on_page((0.0, 0.0)))
    groups = (Group("overview", tuple(marks)), Group("foot", _foot(frame, scale)))
    return UnnumberedPage(frame, groups)


def _datum(centre: Point) -> list[Mark]:
    return [Circle(centre, 1.8, 0.3), *cross(centre, 3.0, 0.3)]


@dataclass(frozen=True)
class _Label:
    """Lines of text at a tag, in a box on the page; ``leader`` is a line to the tag.

    ``anchor`` is the side of the box at which the text is, next to the tag.
    """

    lines: tuple[str, ...]
    box: Box
    anchor: Literal["start", "middle", "end"]
    leader: Line | None


class _Sheet:
    """One page of the plan: positions on the page, labels and ordinates.

    Without space, labels lose their meanings, then overlap; and ordinates are left out.
    ``unplaced`` counts them. ``datum`` is the position of the datum, None if it is not on the page.
    """

    def __init__(self, floor: _Floor, block: _Block, scale: float, box: Box) -> None:
        self.floor, self.block, self.scale, self.box = floor, block, scale, box
        size = ((block.high[0] - block.low[0]) / scale, (block.high[1] - block.low[1]) / scale)
        self.corner = (box[0], box[3] - size[1])
        self.high = (box[0] + size[0], box[3])
        half = max(floor.side_mm / scale, MIN_SYMBOL_MM) / 2
        self.half_mm = half
        self.unplaced = 0
        self.datum = self._on_page(0.0, 0.0) if block.has_datum(floor) else None
        self.points = [self._on_page(*floor.position_mm[k].tolist()) for k in block.members]
        self.tips = [
            self._rotated(point, k, half + HEADING_ARROW_MM, 0.0)
            for point, k in zip(self.points, block.members, strict=True)
        ]
        self.labels = self._place_labels()
        self.x_ordinates = self._spread_ordinates(0)
        self.y_ordinates = self._spread_ordinates(1)

    def _on_page(self, x: float, y: float) -> Point:
        return (
            self.corner[0] + (x - self.block.low[0]) / self.scale,
            self.corner[1] + (y - self.block.low[1]) / self.scale,
        )

    def _rotated(self, centre: Point, index: int, x: float, y: float) -> Point:
        """Return a point of the frame of a tag on the page, in mm on the paper."""
        heading = self.floor.poses[index].heading_rad
        c, s = math.cos(heading), math.sin(heading)
        return centre[0] + c * x - s * y, centre[1] + s * x + c * y

    # ---- labels

    def _place_labels(self) -> list[_Label]:
        """Place the labels one after the other, each where it overlaps nothing."""
        reach = self.half_mm * math.sqrt(2)
        occupied = [(x - reach, y - reach, x + reach, y + reach) for x, y in self.points]
        for point, tip in zip(self.points, self.tips, strict=True):
            low = (min(point[0], tip[0]) - 0.8, min(point[1], tip[1]) - 0.8)
            occupied.append((*low, max(point[0], tip[0]) + 0.8, max(point[1], tip[1]) + 0.8))
        if self.datum is not None:
            x, y = self.datum
            occupied.append((x - 2, y - 2, x + 2, y + 2))
        obstacles = Obstacles(
            mark
            for index, point, tip in zip(self.block.members, self.points, self.tips, strict=True)
            for mark in self._draw_tag(index, point, tip)
        )
        labels = []
        for index, point in zip(self.block.members, self.points, strict=True):
            label = self._place_label(index, point, reach, np.array(occupied), obstacles)
            labels.append(label)
            occupied.append(label.box)
            obstacles.add(_draw_label(label))
        return labels

    def _place_label(
        self, index: int, point: Point, reach: float, occupied: Array, obstacles: Obstacles
    ) -> _Label:
        """Return the first label that touches nothing, otherwise the one that overlaps least.

        ``occupied`` (n, 4) are boxes, and ``obstacles`` the tags, labels and leaders in them.
        """
        refused: list[tuple[float, _Label]] = []
        texts = self._label_texts(index)
        for lines in texts:
            for label in _candidates(lines, point, reach):
                penalty = _overlap_penalty(label.box, occupied, (*self.corner, *self.high))
                if penalty == 0 and _is_clear(label, obstacles):
                    # A label without its meaning is complete only if there is none.
                    self.unplaced += lines != texts[0]
                    return label
                refused.append((penalty, label))
        self.unplaced += 1
        return min(refused, key=lambda item: item[0])[1]

    def _label_texts(self, index: int) -> list[tuple[str, ...]]:
        """Return the lines of a label with the meaning, and without it."""
        head = f"id {self.floor.ids[index]}, {_heading_text(self.floor.poses[index])}\u00b0"
        heads = tuple(wrap(head, TEXT_POINTS, MEANING_WIDTH_MM))
        meaning = wrap(self.floor.meanings[index], TEXT_POINTS, MEANING_WIDTH_MM)
        return [(*heads, *meaning), heads] if meaning else [heads]

    # ---- ordinates

    def _spread_ordinates(self, axis: int) -> list[tuple[float, float, float]]:
        """Return value, position on the page and position of the text of the ordinates."""
        values = self.floor.ordinates(self.block.members, axis)
        datum_position = self._on_page(0.0, 0.0)[axis]
        positions = datum_position + values / self.scale
        gap = line_height(TEXT_POINTS, 1.1)
        low, high = self.box[axis] + gap / 2, self.box[axis + 2] - gap / 2
        if (len(values) - 1) * gap > high - low:
            kept = np.linspace(0, len(values) - 1, max(2, int((high - low) / gap))).astype(int)
            self.unplaced += len(values) - len(kept)
            values, positions = values[kept], positions[kept]
        spread = _spread(positions, gap, low, high)
        return list(zip(values.tolist(), positions.tolist(), spread.tolist(), strict=True))

    # ---- drawing

    def marks(self) -> Iterator[Mark]:
        """Yield all marks of the plan."""
        yield rectangle((*self.corner, *self.high), 0.2)
        yield from self._draw_ordinates()
        if self.datum is not None:
            yield from _datum(self.datum)
        for index, point, tip, label in zip(
            self.block.members, self.points, self.tips, self.labels, strict=True
        ):
            yield from self._draw_tag(index, point, tip)
            yield from _draw_label(label)

    def _draw_tag(self, index: int, point: Point, tip: Point) -> list[Mark]:
        half = self.half_mm
        signs = ((-1, -1), (1, -1), (1, 1), (-1, 1))
        corners = tuple(self._rotated(point, index, half * a, half * b) for a, b in signs)
        front = self._rotated(point, index, half, 0.0)
        return [
            Polygon(corners, width_mm=0.25),
            *cross(point, min(0.8, 0.6 * half), 0.1),
            *arrow(front, tip, 1.8, 0.25),
        ]

    def _draw_ordinates(self) -> Iterator[Mark]:
        """Yield ordinates, with lines across the plan to the farthest tag of each."""
        left, bottom = self.corner
        capital = capital_height(TEXT_POINTS)
        for value, y, text_y in self.y_ordinates:
            for start, end in self._gaps(1, y, left, self._farthest(1, value)):
                yield Line((start, y), (end, y), 0.05, dash_mm=1.0)
            yield from _jog((left, y), (left - JOG_MM, text_y), 1)
            position = (left - JOG_MM - 0.8, text_y - capital / 2)
            yield Text(mm_text(value / 1e3), position, TEXT_POINTS, "end")
        for value, x, text_x in self.x_ordinates:
            for start, end in self._gaps(0, x, bottom, self._farthest(0, value)):
                yield Line((x, start), (x, end), 0.05, dash_mm=1.0)
            yield from _jog((x, bottom), (text_x, bottom - JOG_MM), 0)
            position = (text_x + capital / 2, bottom - JOG_MM - 0.8)
            yield Text(mm_text(value / 1e3), position, TEXT_POINTS, "end", angle_deg=90)

    def _gaps(
        self, axis: int, position: float, start: float, end: float
    ) -> Iterator[tuple[float, float]]:
        """Yield the parts of the line of an ordinate that are not under a label."""
        along = 1 - axis
        covered = sorted(
            (label.box[along] - LABEL_MARGIN_MM, label.box[along + 2] + LABEL_MARGIN_MM)
            for label in self.labels
            if label.box[axis] - LABEL_MARGIN_MM < position < label.box[axis + 2] + LABEL_MARGIN_MM
        )
        for low, high in (*covered, (end, end)):
            if low > start:
                yield start, min(low, end)
            start = max(start, high)
            if start >= end:
                return

    def _farthest(self, axis: int, value: float) -> float:
        """Return the page coordinate, across an axis, of the farthest tag of an ordinate."""
        along = self.floor.position_mm[list(self.block.members)]
        is_same = np.abs(along[:, axis] - value) <= SAME_ORDINATE_MM * (1 + 1e-9)
        other = float(along[is_same, 1 - axis].max())
        return self._on_page(other, other)[1 - axis]


def _jog(edge: Point, text: Point, axis: int) -> list[Mark]:
    """Draw a tick at the edge of the plan, and a line from it to the text of an ordinate."""
    (x1, y1), (x2, y2) = edge, text
    below = ((x1, y1 - 1.5), (x2, y2 + 1.0))
    knees = below if axis == 0 else ((x1 - 1.5, y1), (x2 + 1.0, y2))
    points = (edge, *knees, text)
    return [Line(a, b, 0.1) for a, b in itertools.pairwise(points)]


_ANCHORS: dict[int, Literal["start", "middle", "end"]] = {1: "start", 0: "middle", -1: "end"}


def _candidates(lines: tuple[str, ...], point: Point, reach: float) -> Iterator[_Label]:
    """Yield labels of a tag at several sides and distances, in the order of preference."""
    width = max(text_width(line, TEXT_POINTS) for line in lines)
    height = len(lines) * line_height(TEXT_POINTS)
    x, y = point
    for distance in LABEL_DISTANCES_MM:
        gap = reach + distance
        # At the corners, ordinate lines pass the label by.
        for side in ((1, 1), (1, -1), (-1, 1), (-1, -1), (1, 0), (-1, 0), (0, -1), (0, 1)):
            # Labels at a corner are nearer along each axis.
            along = gap if 0 in side else gap / math.sqrt(2)
            centre_x = x + side[0] * (along + width / 2)
            centre_y = y + side[1] * (along + height / 2)
            box = (
                centre_x - width / 2,
                centre_y - height / 2,
                centre_x + width / 2,
                centre_y + height / 2,
            )
            leader = None
            if distance > LABEL_DISTANCES_MM[0]:
                near = (
                    min(max(x, box[0] - LABEL_MARGIN_MM), box[2] + LABEL_MARGIN_MM),
                    min(max(y, box[1] - LABEL_MARGIN_MM), box[3] + LABEL_MARGIN_MM),
                )
                length = math.dist(point, near)
                start = tuple(
                    a + (b - a) * reach / length for a, b in zip(point, near, strict=True)
                )
                leader = Line((start[0], start[1]), near, 0.1)
            yield _Label(lines, box, _ANCHORS[side[0]], leader)


def _overlap_penalty(box: Box, occupied: Array, area: Box) -> float:
    """Return the area in mm^2 that a box shares with others, plus a weight of its excess.

    The excess is how far the box extends beyond ``area``; its weight is
    :data:`OUTSIDE_WEIGHT_MM`.
    """
    width = np.minimum(box[2], occupied[:, 2]) - np.maximum(box[0], occupied[:, 0])
    height = np.minimum(box[3], occupied[:, 3]) - np.maximum(box[1], occupied[:, 1])
    shared = float((np.maximum(width, 0) * np.maximum(height, 0)).sum())
    excess = (area[0] - box[0], area[1] - box[1], box[2] - area[2], box[3] - area[3])
    return shared + OUTSIDE_WEIGHT_MM * sum(max(0.0, value) for value in excess)


def _is_clear(label: _Label, obstacles: Obstacles) -> bool:
    """Return whether the texts of a label and its leader touch nothing."""
    return not any(
        obstacles.are_touched_by(mark) if isinstance(mark, Line) else not obstacles.is_free(mark)
        for mark in _draw_label(label)
    )


def _draw_label(label: _Label) -> list[Line | Text]:
    marks: list[Line | Text] = [] if label.leader is None else [label.leader]
    left, _, right, top = label.box
    x = {"start": left, "middle": (left + right) / 2, "end": right}[label.anchor]
    step = line_height(TEXT_POINTS)
    for number, line in enumerate(label.lines, 1):
        position = (x, top - number * step + 0.25 * step)
        marks.append(Text(line, position, TEXT_POINTS, label.anchor, bold=number == 1))
    return marks


def _spread(positions: Array, gap: float, low: float, high: float) -> Array:
    """Move ascending positions apart to distances of at least ``gap``, each as little as possible.

    Overlapping neighbours are pooled around their common middle. All remain within ``low`` and
    ``high`` if there is space for them.
    """
    pools: list[list[float]] = []  # first position without gaps, number of members
    for number, position in enumerate(positions.tolist()):
        pools.append([position - number * gap, 1])
        while len(pools) > 1 and pools[-2][0] >= pools[-1][0]:
            value, count = pools.pop()
            total = pools[-1][1] + count
            pools[-1] = [(pools[-1][0] * pools[-1][1] + value * count) / total, total]
    bare = np.concatenate([np.full(int(count), value) for value, count in pools])
    bare = np.minimum(np.maximum(bare, low), max(low, high - (len(positions) - 1) * gap))
    return np.asarray(bare + gap * np.arange(len(positions)), float)


def _heading_text(pose: PlanarPose) -> str:
    """Format a heading in degrees, above -180 and up to 180."""
    degrees = round(math.degrees(math.remainder(pose.heading_rad, math.tau)), 2)
    return f"{180.0 if degrees == -180 else degrees + 0.0:g}"


def _table(
    floor: _Floor, paper_mm: Point, margin_mm: float, page_of: dict[int, int]
) -> list[UnnumberedPage]:
    """List position, heading and meaning of each tag, with a box to tick."""
    rows = []
    for tag_id, pose, meaning, position in zip(
        floor.ids, floor.poses, floor.meanings, floor.position_mm.tolist(), strict=True
    ):
        x, y = (mm_text(value / 1e3) for value in position)
        page = [str(page_of[tag_id] + 1)] if page_of else []
        rows.append(["[  ]", str(tag_id), x, y, _heading_text(pose), *page, "", meaning])
    heads = ["done", "id", "x mm", "y mm", "heading", *(["page"] if page_of else []), "", "meaning"]
    widths = [
        max(text_width(text, TEXT_POINTS) for text in (head, *column)) + 2.5
        for head, column in zip(heads, zip(*rows, strict=True), strict=True)
    ]
    columns = [
        TableColumn(head, width, is_right_aligned=head not in ("done", "meaning"))
        for head, width in zip(heads, widths, strict=True)
    ]
    notes = (
        f"Measure x and y from {floor.datum_name} to the middle of the tag, along the axes of the "
        "plan. "
        "Heading: from +x to the tag's x axis (forward, the arrow of its template), in degrees "
        "counter-clockwise."
    )
    frame = _frame(floor, paper_mm, margin_mm, "positions of the tags", notes)
    left, _, right, _ = frame.content_box
    if sum(widths) > right - left:
        raise InputError("the paper is too narrow for the table", hint="Use a larger paper")
    return table_pages(rows, columns, frame)
