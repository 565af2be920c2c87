"""Placement of texts in a drawing, so that no line and no other text touches them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from locatk.core.drawing.marks import (
    CAPITAL_HEIGHT_EM,
    MM_PER_POINT,
    Box,
    Circle,
    Line,
    Mark,
    Point,
    Text,
    text_width,
)

DESCENDER_EM = 0.22
"""Depth of descenders of Helvetica below the baseline, as a fraction of the font size."""

DESCENDING_LETTERS = frozenset("gjpqyQ,;()[]{}|_/@$")
"""Characters that extend below the baseline."""

CAPITAL_WIDTH_EM = 0.78
"""Width of the capitals of bold Helvetica, except M and W, as a fraction of the font size."""

TEXT_CLEARANCE_MM = 0.3
"""Smallest distance of a text from a line or from another text."""

MAX_CHORD_ERROR_MM = 0.05
"""Largest distance of a circle from the chords that approximate it."""

MIN_CIRCLE_CHORDS = 24
"""Least number of chords of a circle."""


def text_box(text: Text) -> Box:
    """Return the box around a text whose angle is a multiple of 90 degrees."""
    em = text.points * MM_PER_POINT
    # Single capitals can be wider than the mean letter of a text.
    width = max(text_width(text.text, text.points), min(2, len(text.text)) * CAPITAL_WIDTH_EM * em)
    depth = DESCENDER_EM * em if DESCENDING_LETTERS & set(text.text) else 0.0
    start = -{"start": 0.0, "middle": 0.5, "end": 1.0}[text.anchor] * width
    c, s = (round(f(math.radians(text.angle_deg))) for f in (math.cos, math.sin))
    corners = [
        (text.position[0] + c * along - s * up, text.position[1] + s * along + c * up)
        for along in (start, start + width)
        for up in (-depth, CAPITAL_HEIGHT_EM * em)
    ]
    (left, right), (bottom, top) = ((min(axis), max(axis)) for axis in zip(*corners, strict=True))
    return left, bottom, right, top


class Obstacles:
    """Lines and texts of a drawing that a further text must not touch.

    Filled polygons count with their outlines. Texts must be within ``bounds``, if these are given.
    """

    def __init__(self, marks: Iterable[Mark] = (), bounds: Box | None = None) -> None:
        self._bounds = bounds
        self._strokes = np.zeros((0, 5))
        self._boxes: list[Box] = []
        self.add(marks)

    def add(self, marks: Iterable[Mark]) -> None:
        """Add marks to the drawing."""
        strokes: list[tuple[float, ...]] = []
        for mark in marks:
            if isinstance(mark, Text):
                self._boxes.append(text_box(mark))
            else:
                strokes += _strokes(mark)
        self._strokes = np.concatenate([self._strokes, np.array(strokes).reshape(-1, 5)])

    def is_free(self, text: Text, clearance_mm: float = TEXT_CLEARANCE_MM) -> bool:
        """Return True if the text keeps its distance from all lines and texts."""
        left, bottom, right, top = text_box(text)
        if self._bounds is not None:
            low_x, low_y, high_x, high_y = self._bounds
            if left < low_x or bottom < low_y or right > high_x or top > high_y:
                return False
        box = (left - clearance_mm, bottom - clearance_mm, right + clearance_mm, top + clearance_mm)
        return not any(boxes_overlap(box, other) for other in self._boxes) and not bool(
            _enters(self._strokes, box).any()
        )

    def are_touched_by(self, mark: Mark) -> bool:
        """Return True if a line is too near to a text of the drawing."""
        strokes = np.array(_strokes(mark)).reshape(-1, 5)
        strokes[:, 4] += TEXT_CLEARANCE_MM
        return any(bool(_enters(strokes, box).any()) for box in self._boxes)

    def interrupt(self, circle: Circle) -> list[Circle | Line]:
        """Return a circle; if texts touch it, the chords of it that leave them free."""
        if not self.are_touched_by(circle):
            return [circle]
        chords = [Line(stroke[:2], stroke[2:4], circle.width_mm) for stroke in _strokes(circle)]
        return [chord for chord in chords if not self.are_touched_by(chord)]

    def place(self, candidates: Iterable[Text]) -> list[Text]:
        """Add the first of the candidates that is free; return it in a list, or an empty list."""
        text = next(filter(self.is_free, candidates), None)
        if text is None:
            return []
        self.add([text])
        return [text]


def interrupt(line: Line, texts: Sequence[Text]) -> list[Line]:
    """Return the parts of a line along an edge of the page that leave texts free."""
    axis = 0 if line.start[1] == line.end[1] else 1
    low, high = sorted((line.start[axis], line.end[axis]))
    across = line.start[1 - axis]
    margin = TEXT_CLEARANCE_MM + line.width_mm / 2
    gaps = []
    for box in map(text_box, texts):
        if box[1 - axis] - margin < across < box[3 - axis] + margin:
            gaps.append((box[axis] - margin, box[axis + 2] + margin))
    parts = []
    for gap_start, gap_end in (*sorted(gaps), (high, high)):
        if gap_start > low:
            parts.append((low, min(gap_start, high)))
        low = max(low, gap_end)

    def point(along: float) -> Point:
        return (along, across) if axis == 0 else (across, along)

    return [Line(point(a), point(b), line.width_mm, line.dash_mm) for a, b in parts]


def boxes_overlap(first: Box, second: Box) -> bool:
    """Return True if two boxes have a common area."""
    return all(
        max(first[axis], second[axis]) < min(first[axis + 2], second[axis + 2]) for axis in (0, 1)
    )


def _strokes(mark: Mark) -> list[tuple[float, float, float, float, float]]:
    """Return the straight strokes of a mark as (x0, y0, x1, y1, half width)."""
    if isinstance(mark, Text):
        return []
    half = mark.width_mm / 2
    if isinstance(mark, Line):
        return [(*mark.start, *mark.end, half)]
    if isinstance(mark, Circle):
        relative = min(1.0, MAX_CHORD_ERROR_MM / max(mark.radius_mm, MAX_CHORD_ERROR_MM))
        chords = max(MIN_CIRCLE_CHORDS, math.ceil(math.pi / math.acos(1 - relative)))
        angles = np.linspace(0, 2 * np.pi, chords, endpoint=False)
        corners = [
            (mark.centre[0] + mark.radius_mm * c, mark.centre[1] + mark.radius_mm * s)
            for c, s in zip(np.cos(angles).tolist(), np.sin(angles).tolist(), strict=True)
        ]
    else:
        corners = list(mark.corners)
    return [(*a, *b, half) for a, b in itertools.pairwise([*corners, corners[0]])]


def _enters(strokes: NDArray[np.float64], box: Box) -> NDArray[np.bool_]:
    """Return which strokes enter a box, by the clipping of Liang and Barsky.

    Reference: Y.-D. Liang and B. A. Barsky, A new concept and method for line clipping, ACM
    Transactions on Graphics 3(1), 1984.
    """
    half = strokes[:, 4:]
    start, step = strokes[:, :2], strokes[:, 2:4] - strokes[:, :2]
    low, high = np.array(box[:2]) - half, np.array(box[2:]) + half
    with np.errstate(divide="ignore", invalid="ignore"):
        first, last = (low - start) / step, (high - start) / step
    is_still = np.abs(step) < 1e-12
    is_within = (start > low) & (start < high)
    enter = np.where(is_still, np.where(is_within, 0.0, 2.0), np.minimum(first, last))
    leave = np.where(is_still, 1.0, np.maximum(first, last))
    return np.maximum(enter.max(axis=1), 0.0) < np.minimum(leave.min(axis=1), 1.0)
