"""Outline of a tag with its heading and its magnets, in the frame of the tag, in mm.

The x axis of the tag (forward) points to the right. Magnets are drawn as designed, not as built.
"""

from __future__ import annotations

import math
from typing import TypeAlias

from locatk.core.drawing import Circle, Line, Point, Polygon, arrow
from locatk.core.polaris.codec import layout_of
from locatk.core.polaris.tag import Tags, cell_positions, symbol_angles

ShapeMark: TypeAlias = Line | Circle | Polygon

HEADING_FRACTION = 0.25
"""Length of the arrow of the heading, as a fraction of the side of the tag."""


def tag_side(tags: Tags) -> float:
    """Return the side of the square of a tag in mm: all its cells, each as wide as the spacing."""
    return 1e3 * tags.order * tags.spacing_m


def tag_outline(tags: Tags) -> list[ShapeMark]:
    """Draw the square of a tag, and an arrow along its x axis from the middle of its front."""
    half = tag_side(tags) / 2
    length = 2 * half * HEADING_FRACTION
    corners: tuple[Point, ...] = ((-half, -half), (half, -half), (half, half), (-half, half))
    return [Polygon(corners), *arrow((half, 0.0), (half + length, 0.0), length / 2)]


def tag_magnets(tags: Tags, tag_id: int) -> list[ShapeMark]:
    """Draw the magnets of an id: their outlines, and an arrow from each centre to its north."""
    layout = layout_of(tags, tag_id)
    positions = (1e3 * cell_positions(tags, layout.cells)).tolist()
    radius = 0.5e3 * tags.magnet.diameter_m
    length = max(2 * radius, 0.3e3 * tags.spacing_m)
    marks: list[ShapeMark] = []
    for (x, y), angle in zip(positions, symbol_angles(tags, layout.symbols).tolist(), strict=True):
        tip = (x + length * math.cos(angle), y + length * math.sin(angle))
        marks += [Circle((x, y), radius), *arrow((x, y), tip, 0.4 * length)]
    return marks
