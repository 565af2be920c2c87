"""Landmarks as line drawings in mm, for the installation pack and for CAD.

The map's x is to the right on the paper and its y up; landmarks lie with their axes along
the map's, and are drawn as designed, not as built.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from locatk.core.drawing import Line, Mark, Point, Polygon
from locatk.core.landmarks.landmark import Geometry, name

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


def arrow(start: Point, tip: Point, head_mm: float, width_mm: float = 0.2) -> list[Mark]:
    """A line with a filled head of this length."""
    length = math.dist(start, tip)
    u, v = (tip[0] - start[0]) / length, (tip[1] - start[1]) / length
    back = (tip[0] - head_mm * u, tip[1] - head_mm * v)
    wing = 0.35 * head_mm
    left = (back[0] - wing * v, back[1] + wing * u)
    right = (back[0] + wing * v, back[1] - wing * u)
    return [Line(start, back, width_mm), Polygon((tip, left, right), filled=True)]
