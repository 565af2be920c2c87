"""Line drawings of landmarks in mm, for the installation pack and for CAD.

The x axis of the map points to the right on the paper and its y axis up. Landmarks are drawn as
designed, with their axes parallel to those of the map, not as built.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from locatk.core.drawing import (
    CAPITAL_HEIGHT_EM,
    MIN_TEXT_POINTS,
    MM_PER_POINT,
    Circle,
    Line,
    Mark,
    Point,
    Polygon,
    Text,
    arrow,
    capital_height,
    cross,
    line_height,
    text_width,
)
from locatk.core.errors import InputError
from locatk.core.landmarks.landmark import Geometry, name
from locatk.core.landmarks.map.floor import FloorMap

Array = NDArray[np.float64]

BAR_LABEL_GAP_MM = 3.0
"""Distance of the label of a bar from the bars."""

BAR_LABEL_POINTS = 7.0
"""Font size of the labels of the bars."""

MAX_NOTE_POINTS = 10.0
"""Largest font size of the notes within a landmark."""

NOTE_SPACING_EM = 1.25
"""Line height of the notes within a landmark, as a fraction of the font size."""


@dataclass(frozen=True)
class BarOutline:
    """Outline of a bar seen from above, in the frame of its landmark, in mm.

    Attributes
    ----------
    corners : (4, 2) ndarray
        Counter-clockwise.
    south, north : (x, y)
        Centres of the pole faces; the magnetization points from south to north.
    letter : str
        "N" if the magnetization is counter-clockwise around the landmark, "S" if clockwise.
    """

    corners: Array
    south: Point
    north: Point
    letter: str


def bar_outlines(geometry: Geometry, code: int) -> list[BarOutline]:
    """Return the outlines of bars 0 to 3 of a landmark.

    Examples
    --------
    >>> bar = bar_outlines(Geometry(), 0b0001)[0]
    >>> bar.south, bar.north, bar.letter
    ((25.0, -15.0), (25.0, 15.0), 'N')
    """
    length, width = 1e3 * geometry.bar_length_m, 1e3 * geometry.bar_width_m
    radius = 1e3 * geometry.radius_m
    across = radius + width / 2 * np.array([-1.0, 1.0, 1.0, -1.0])
    along = length / 2 * np.array([-1.0, -1.0, 1.0, 1.0])
    bars = []
    for number, letter in enumerate(name(code)):
        ends = [(radius, -length / 2), (radius, length / 2)]
        poles = ends if letter == "N" else ends[::-1]
        south, north = (_rotate(end, number) for end in poles)
        corners = [_rotate(corner, number) for corner in zip(across, along, strict=True)]
        bars.append(BarOutline(np.array(corners), south, north, letter))
    return bars


def _rotate(point: Point, quarters: int) -> Point:
    """Rotate a point counter-clockwise about the origin by quarter turns, without rounding."""
    x, y = (round(float(value), 9) + 0.0 for value in point)
    for _ in range(quarters % 4):
        x, y = 0.0 - y, x
    return x, y


def bars_half_side(geometry: Geometry) -> float:
    """Return half of the side of the square around the bars of a landmark, in mm."""
    radius, half = geometry.radius_m + geometry.bar_width_m / 2, geometry.bar_length_m / 2
    return 1e3 * max(radius, half)


def drawing_half_side(geometry: Geometry) -> float:
    """Return half of the side of the square around a drawing of :func:`draw_landmark`, in mm."""
    label_width = text_width(_bar_label(0, "S"), BAR_LABEL_POINTS)
    return bars_half_side(geometry) + BAR_LABEL_GAP_MM + label_width


def check_buildable(floor: FloorMap) -> None:
    """Check that the bars of a floor do not overlap.

    Raises
    ------
    InputError
        Bars of one landmark or of neighbouring landmarks overlap, or no cell has a landmark.
    """
    geometry = floor.geometry
    inner = geometry.radius_m - geometry.bar_width_m / 2
    if inner < geometry.bar_length_m / 2 - 1e-9:
        raise InputError(
            f"bars of {1e3 * geometry.bar_length_m:g} x {1e3 * geometry.bar_width_m:g} mm on a "
            f"radius of {1e3 * geometry.radius_m:g} mm overlap at the landmark's corners",
            hint="Use shorter bars or a larger radius",
        )
    if 1e3 * floor.pitch_m < 2 * bars_half_side(geometry) - 1e-6:
        raise InputError(
            f"landmarks of {2 * bars_half_side(geometry):g} mm overlap at a pitch of "
            f"{1e3 * floor.pitch_m:g} mm",
            hint="Use a larger pitch",
        )
    if not floor.cells():
        raise InputError("the map has no landmark to lay")


def draw_landmark(
    geometry: Geometry,
    code: int,
    centre: Point,
    notes: tuple[str, ...] = (),
    max_half_side_mm: float = math.inf,
) -> list[Mark]:
    """Draw a landmark at true size, for placing its bars.

    Each bar has its outline, an arrow to its north pole, the letters of its poles, and lines along
    and across its centre that extend beyond it, for drilling and for aligning a bar that covers its
    outline.

    Parameters
    ----------
    geometry : Geometry
    code : int
    centre : (x, y)
        Position on the page. The drawing ends :func:`drawing_half_side` from it on all sides.
    notes : tuple of str
        Lines of text in the upper left part of the square between the bars.
    max_half_side_mm : float
        Distance from the centre within which the labels of the bars must end; longer ones are
        shortened or left out.
    """
    marks: list[Mark] = []
    label_distance = bars_half_side(geometry) + BAR_LABEL_GAP_MM
    bars = bar_outlines(geometry, code)
    label = _longest_bar_label(max_half_side_mm - label_distance)
    for number, bar in enumerate(bars):
        marks += _draw_bar(geometry, bar, centre)
        if label is not None:
            text = label(number, bar.letter)
            marks.append(_draw_bar_label(number, text, centre, label_distance))
    inner = 1e3 * (geometry.radius_m - geometry.bar_width_m / 2)
    arm = min(6.0, 0.5 * inner)
    marks += [*cross(centre, arm, 0.2), Circle(centre, arm / 3, 0.2)]
    return [*marks, *_draw_notes(notes, centre, inner)]


def _draw_bar(geometry: Geometry, bar: BarOutline, centre: Point) -> list[Mark]:
    """Draw the outline of a bar, its centre lines, its arrow and the letters of its poles."""
    length, width = 1e3 * geometry.bar_length_m, 1e3 * geometry.bar_width_m
    (south_x, south_y), (north_x, north_y) = bar.south, bar.north
    x, y = centre[0] + (south_x + north_x) / 2, centre[1] + (south_y + north_y) / 2
    u, v = (north_x - south_x) / length, (north_y - south_y) / length
    corners = tuple((centre[0] + a, centre[1] + b) for a, b in bar.corners.tolist())
    marks: list[Mark] = [Polygon(corners, width_mm=0.2)]
    # The line along the bar is drawn outside only, because the arrow fills the inside.
    for inner_end, outer_end, (p, q) in (
        (length / 2, length / 2 + 2, (u, v)),
        (0.0, width / 2 + 2, (-v, u)),
    ):
        for side in (-1.0, 1.0):
            start, end = side * inner_end, side * outer_end
            marks.append(Line((x + start * p, y + start * q), (x + end * p, y + end * q), 0.1))
    letter_mm = min(4.0, 0.5 * width, 0.13 * length)
    half_arrow = length / 2 - 1.7 * letter_mm
    tail, tip = ((x + side * half_arrow * u, y + side * half_arrow * v) for side in (-1, 1))
    marks += arrow(tail, tip, min(0.45 * width, 0.6 * half_arrow), 0.06 * min(width, 10.0))
    points = letter_mm / (CAPITAL_HEIGHT_EM * MM_PER_POINT)
    if points < MIN_TEXT_POINTS:
        # The arrow shows the poles, too.
        return marks
    for pole, side in (("S", -1), ("N", 1)):
        offset = side * (length / 2 - 0.9 * letter_mm)
        position = (x + offset * u, y + offset * v - letter_mm / 2)
        marks.append(Text(pole, position, points, "middle", bold=True))
    return marks


def _bar_label(number: int, letter: str) -> str:
    return f"bar {number}: {letter} ({'ccw' if letter == 'N' else 'cw'})"


def _short_bar_label(number: int, letter: str) -> str:
    return f"{number}: {letter}"


def _longest_bar_label(width_mm: float) -> Callable[[int, str], str] | None:
    """Return the format of the labels of bars that fits a width, or None if none does."""
    for label in (_bar_label, _short_bar_label):
        if text_width(label(0, "S"), BAR_LABEL_POINTS) <= width_mm:
            return label
    return None


def _draw_bar_label(number: int, text: str, centre: Point, distance: float) -> Text:
    """Draw the label of a bar outside of it, next to the line to the neighbouring cell."""
    gap = 1.2
    x, y = (
        (distance, gap),
        (gap, distance),
        (-distance, gap),
        (gap, -distance - capital_height(BAR_LABEL_POINTS)),
    )[number]
    anchor: Literal["start", "end"] = "end" if number == 2 else "start"
    position = (centre[0] + x, centre[1] + y)
    return Text(text, position, BAR_LABEL_POINTS, anchor)


def _draw_notes(notes: tuple[str, ...], centre: Point, inner_mm: float) -> list[Mark]:
    """Draw right-aligned lines of text in the upper left part of the square between the bars.

    They are left out if the square is too small for legible text.
    """
    longest = max((len(text) for text in notes), default=1)
    points = min(MAX_NOTE_POINTS, 0.85 * inner_mm / text_width("x" * longest, 1.0))
    if points < MIN_TEXT_POINTS:
        return []
    top = centre[1] + inner_mm - 2.6
    step = line_height(points, NOTE_SPACING_EM)
    return [
        Text(text, (centre[0] - 1.5, top - number * step), points, "end", bold=number == 1)
        for number, text in enumerate(notes, 1)
    ]


def pole_arrow(geometry: Geometry, bar: BarOutline) -> list[Line | Polygon]:
    """Draw a short arrow in the middle of a bar to its north pole, with space for the letters."""
    start, tip = (_along_bar(bar, fraction) for fraction in (0.28, 0.72))
    head = min(0.5e3 * geometry.bar_width_m, 0.2 * math.dist(bar.south, bar.north))
    return arrow(start, tip, head)


def pole_letters(bar: BarOutline) -> list[tuple[str, Point]]:
    """Return the letters of the poles of a bar with their positions, for :func:`pole_arrow`."""
    return [("S", _along_bar(bar, 0.13)), ("N", _along_bar(bar, 0.87))]


def _along_bar(bar: BarOutline, fraction: float) -> Point:
    """Return the point of a bar at a fraction of the way from its south to its north pole."""
    x, y = np.add(bar.south, fraction * np.subtract(bar.north, bar.south)).tolist()
    return x, y


def draw_symbol(code: int, centre: Point, cell_mm: float) -> list[Mark]:
    """Draw a landmark as a symbol on a plan, not to scale, in a cell with sides of ``cell_mm``.

    Bars point to their north poles and bars of letter N are filled. The code, as the digit of the
    map's file, is in the centre.
    """
    x, y = centre
    marks: list[Mark] = []
    for bar, letter in enumerate(name(code)):
        sign = 1.0 if letter == "N" else -1.0
        outline = [(0.215, -0.15), (0.295, -0.15), (0.295, 0.07), (0.255, 0.15), (0.215, 0.07)]
        corners = [_rotate((cell_mm * a, cell_mm * sign * b), bar) for a, b in outline]
        positions = tuple((x + a, y + b) for a, b in corners)
        marks.append(Polygon(positions, letter == "N", min(0.2, 0.012 * cell_mm)))
    points = max(MIN_TEXT_POINTS, 0.2 * cell_mm / (CAPITAL_HEIGHT_EM * MM_PER_POINT))
    baseline = y - capital_height(points) / 2
    marks.append(Text(code_digit(code), (x, baseline), points, "middle", bold=True))
    return marks


def draw_hole(centre: Point, half_mm: float, width_mm: float) -> list[Mark]:
    """Draw the diagonal cross of a cell without landmark."""
    x, y = centre
    return [
        Line((x - half_mm, y - half_mm), (x + half_mm, y + half_mm), width_mm),
        Line((x - half_mm, y + half_mm), (x + half_mm, y - half_mm), width_mm),
    ]


def code_digit(code: int) -> str:
    """Return the hexadecimal digit of a code, as in the files of maps."""
    return f"{code:x}"


def north_mark(start: Point, height_mm: float, text: str = "map +y") -> list[Mark]:
    """Draw an arrow up the page from ``start``, with a text at its right."""
    x, y = start
    points = min(9.0, max(MIN_TEXT_POINTS, 1.1 * height_mm))
    return [
        *arrow(start, (x, y + height_mm), 0.45 * height_mm, 0.06 * height_mm),
        Text(text, (x + 0.2 * height_mm + 0.5, y + 0.3 * height_mm), points, bold=True),
    ]
