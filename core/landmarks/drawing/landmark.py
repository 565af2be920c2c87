"""Landmarks as line drawings in mm, for the installation pack and for CAD.

The map's x is to the right on the paper and its y up; landmarks lie with their axes along
the map's, and are drawn as designed, not as built.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from locatk.core.drawing import (
    CAPITAL_HEIGHT_EM,
    MM_PER_POINT,
    Circle,
    Line,
    Mark,
    Point,
    Polygon,
    Text,
    arrow,
    text_width,
)
from locatk.core.errors import InputError
from locatk.core.landmarks.landmark import Geometry, name
from locatk.core.landmarks.map.floor import FloorMap

Array = NDArray[np.float64]


def bar_outlines(geometry: Geometry, code: int) -> list[tuple[Array, Point, Point, str]]:
    """The four bars of a landmark, seen from above, in its frame in mm.

    Returns
    -------
    list of (corners, south, north, letter)
        Of bar 0 to 3. ``corners`` (4, 2) counter-clockwise; ``south`` and ``north`` the
        middles of the bar's two pole faces, so that an arrow from one to the other is the
        direction of magnetisation; ``letter`` N where that is counter-clockwise around the
        landmark, S where clockwise.

    Examples
    --------
    >>> corners, south, north, letter = bar_outlines(Geometry(), 0b0001)[0]
    >>> south, north, letter
    ((25.0, -15.0), (25.0, 15.0), 'N')
    """
    length, width = 1e3 * geometry.bar_length_m, 1e3 * geometry.bar_width_m
    radius = 1e3 * geometry.radius_m
    across = radius + width / 2 * np.array([-1.0, 1.0, 1.0, -1.0])
    along = length / 2 * np.array([-1.0, -1.0, 1.0, 1.0])
    bars = []
    for bar, letter in enumerate(name(code)):
        ends = [(radius, -length / 2), (radius, length / 2)]
        south, north = (_turned(end, bar) for end in (ends if letter == "N" else ends[::-1]))
        corners = [_turned(corner, bar) for corner in zip(across, along, strict=True)]
        bars.append((np.array(corners), south, north, letter))
    return bars


def _turned(point: Point, quarters: int) -> Point:
    """A point counter-clockwise about the origin, without rounding."""
    x, y = (round(float(value), 9) + 0.0 for value in point)
    for _ in range(quarters % 4):
        x, y = 0.0 - y, x
    return x, y


def reach_mm(geometry: Geometry) -> float:
    """From a landmark's centre to the farthest side of its bars along x or y."""
    radius, half = geometry.radius_m + geometry.bar_width_m / 2, geometry.bar_length_m / 2
    return 1e3 * max(radius, half)


def card_mm(geometry: Geometry) -> float:
    """From a landmark's centre to where :func:`draw_landmark` ends, on all four sides."""
    return reach_mm(geometry) + _OUT_MM + text_width(_label(0, "S"), _LABEL)


def check(floor: FloorMap) -> None:
    """Refuse a floor whose bars cannot be laid.

    Raises
    ------
    InputError
        Bars overlap, those of one landmark or of two neighbours, or no cell has a landmark.
    """
    geometry = floor.geometry
    inner = geometry.radius_m - geometry.bar_width_m / 2
    if inner < geometry.bar_length_m / 2 - 1e-9:
        raise InputError(
            f"bars of {1e3 * geometry.bar_length_m:g} x {1e3 * geometry.bar_width_m:g} mm on a "
            f"radius of {1e3 * geometry.radius_m:g} mm overlap at the landmark's corners",
            hint="Use shorter bars or a larger radius",
        )
    if 1e3 * floor.pitch_m < 2 * reach_mm(geometry) - 1e-6:
        raise InputError(
            f"landmarks of {2 * reach_mm(geometry):g} mm overlap at a pitch of "
            f"{1e3 * floor.pitch_m:g} mm",
            hint="Use a larger pitch",
        )
    if not floor.cells():
        raise InputError("the map has no landmark to lay")


def draw_landmark(
    geometry: Geometry, code: int, centre: Point, words: tuple[str, ...] = ()
) -> list[Mark]:
    """A landmark at true size, to lay its bars on.

    Each bar has its outline, an arrow within to its north pole with the poles' letters
    beside, and lines along and across its middle that reach out of it, to drill by or to
    align a bar that covers its outline.

    Parameters
    ----------
    geometry : Geometry
    code : int
    centre : (x, y)
        On the page; what is drawn ends :func:`card_mm` from it.
    words : tuple of str
        Lines in the upper left of the square's inside.
    """
    x, y = centre
    marks: list[Mark] = []
    length, width = 1e3 * geometry.bar_length_m, 1e3 * geometry.bar_width_m
    capital = min(4.0, 0.5 * width, 0.13 * length)
    for bar, (corners, south, north, letter) in enumerate(bar_outlines(geometry, code)):
        middle = ((south[0] + north[0]) / 2, (south[1] + north[1]) / 2)
        u, v = ((north[0] - south[0]) / length, (north[1] - south[1]) / length)
        marks.append(Polygon(tuple((x + a, y + b) for a, b in corners.tolist()), width_mm=0.2))
        for half, (p, q) in ((length / 2, (u, v)), (width / 2, (-v, u))):
            for side in (-1.0, 1.0):
                # Along a bar the inside is the arrow's, so only what reaches out.
                start, end = side * (half - (0 if half == length / 2 else half)), side * (half + 2)
                marks.append(
                    Line(
                        (x + middle[0] + start * p, y + middle[1] + start * q),
                        (x + middle[0] + end * p, y + middle[1] + end * q),
                        0.1,
                    )
                )
        room = length / 2 - 1.7 * capital
        tail, tip = (
            (x + middle[0] + side * room * u, y + middle[1] + side * room * v) for side in (-1, 1)
        )
        marks += arrow(tail, tip, min(0.45 * width, 0.6 * room), 0.06 * min(width, 10.0))
        points = capital / (CAPITAL_HEIGHT_EM * MM_PER_POINT)
        for pole, side in (("S", -1), ("N", 1)):
            at = side * (length / 2 - 0.9 * capital)
            place = (x + middle[0] + at * u, y + middle[1] + at * v - capital / 2)
            marks.append(Text(pole, place, points, "middle", bold=True))
        marks.append(_bar_label(bar, letter, centre, reach_mm(geometry) + _OUT_MM))
    inner = 1e3 * (geometry.radius_m - geometry.bar_width_m / 2)
    arm = min(6.0, 0.5 * inner)
    marks += [
        Line((x - arm, y), (x + arm, y), 0.2),
        Line((x, y - arm), (x, y + arm), 0.2),
        Circle(centre, arm / 3, 0.2),
    ]
    longest = max((len(text) for text in words), default=1)
    points = min(10.0, 0.85 * inner / text_width("x" * longest, 1.0))
    for index, text in enumerate(words):
        up = inner - 2.6 - (index + 1) * 1.25 * points * MM_PER_POINT
        marks.append(Text(text, (x - 1.5, y + up), points, "end", bold=index == 0))
    return marks


_OUT_MM, _LABEL = 3.0, 7.0


def _label(bar: int, letter: str) -> str:
    return f"bar {bar}: {letter} ({'ccw' if letter == 'N' else 'cw'})"


def _bar_label(bar: int, letter: str, centre: Point, out: float) -> Text:
    """Outside of a bar, beside the line that the cell's neighbours lie on."""
    up = 1.2
    capital = CAPITAL_HEIGHT_EM * _LABEL * MM_PER_POINT
    x, y = (
        (out, up),
        (up, out),
        (-out, up),
        (up, -out - capital),
    )[bar]
    anchor: Literal["start", "end"] = "end" if bar == 2 else "start"
    return Text(_label(bar, letter), (centre[0] + x, centre[1] + y), _LABEL, anchor)


def draw_symbol(code: int, centre: Point, cell_mm: float) -> list[Mark]:
    """A landmark as a sign on a plan, not to scale, in a cell of this side.

    Bars point to their north poles; those that are N are filled. The code, as the digit of
    the map's file, is in the middle.
    """
    x, y = centre
    marks: list[Mark] = []
    for bar, letter in enumerate(name(code)):
        sign = 1.0 if letter == "N" else -1.0
        outline = [(0.215, -0.15), (0.295, -0.15), (0.295, 0.07), (0.255, 0.15), (0.215, 0.07)]
        corners = [_turned((cell_mm * a, cell_mm * sign * b), bar) for a, b in outline]
        places = tuple((x + a, y + b) for a, b in corners)
        marks.append(Polygon(places, letter == "N", min(0.2, 0.012 * cell_mm)))
    points = 0.2 * cell_mm / (CAPITAL_HEIGHT_EM * MM_PER_POINT)
    marks.append(Text(digit(code), (x, y - 0.1 * cell_mm), points, "middle", bold=True))
    return marks


def digit(code: int) -> str:
    """Of a code, as in the files of maps."""
    return f"{code:x}"


def north_mark(at: Point, height_mm: float, text: str = "map +y") -> list[Mark]:
    """An arrow up the page from ``at``, with its words at the right."""
    x, y = at
    points = min(9.0, 1.1 * height_mm)
    return [
        *arrow(at, (x, y + height_mm), 0.45 * height_mm, 0.06 * height_mm),
        Text(text, (x + 0.2 * height_mm + 0.5, y + 0.3 * height_mm), points, bold=True),
    ]
