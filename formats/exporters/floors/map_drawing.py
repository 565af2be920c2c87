"""Landmark maps as drawings of a floor, for CAD (DXF) and plotters (SVG).

Layers in CAD: BARS (outlines of the bars), POLES (an arrow from south to north in each bar and the
letters of the poles), CENTRES (a point each), LABELS (row, column and letters), WALLS. A landmark
is an insert of the block ``LANDMARK_<letters>``. Layers in SVG: the landmarks of each pattern,
their centres, labels, walls. Positions are as built if that is known; the bars are those of the
design.
"""

from __future__ import annotations

from locatk.core.drawing import Line, Polygon
from locatk.core.landmarks.drawing.landmark import bar_outlines, pole_arrow, pole_letters
from locatk.core.landmarks.landmark import PATTERN_OF, PATTERNS, Geometry, name
from locatk.core.landmarks.map.floor import FloorMap, as_built_poses
from locatk.formats.exporters.floors.floor_drawing import (
    FloorDrawing,
    Layer,
    Letter,
    Placement,
    Shape,
)

BARS, POLES = Layer("BARS", 7), Layer("POLES", 1)

MAX_LABEL_HEIGHT_MM = 8.0


def draw_map(floor: FloorMap) -> FloorDrawing:
    """Return the drawing of a map; its lower left corner is half a pitch before cell (0, 0)."""
    pitch = 1e3 * floor.pitch_m
    height = min(MAX_LABEL_HEIGHT_MM, pitch / 12)
    below = 1e3 * (floor.geometry.radius_m + floor.geometry.bar_width_m / 2) + 0.3 * height
    codes = sorted({int(floor.codes[cell]) for cell in floor.cells()})
    shapes = {code: _landmark_shape(floor.geometry, code) for code in codes}
    placements = []
    for cell, (x, y, heading) in zip(floor.cells(), as_built_poses(floor).tolist(), strict=True):
        code = int(floor.codes[cell])
        placements.append(
            Placement(
                f"r{cell[0]}c{cell[1]}",
                shapes[code],
                (1e3 * x, 1e3 * y),
                heading,
                f"{cell[0]},{cell[1]} {name(code)}",
            )
        )
    walls = []
    for (row, column), (other_row, _) in sorted(floor.walls):
        x, y = floor.position((row, column))
        right, top = 1e3 * x + pitch / 2, 1e3 * y + pitch / 2
        start = (right - pitch, top) if other_row > row else (right, top - pitch)
        walls.append(Line(start, (right, top)))
    rows, columns = floor.shape
    (left, bottom), (right, top) = floor.position((0, 0)), floor.position((rows - 1, columns - 1))
    half = floor.pitch_m / 2
    return FloorDrawing(
        f"Landmarks {floor.name}".strip(),
        (1e3 * (left - half), 1e3 * (bottom - half), 1e3 * (right + half), 1e3 * (top + half)),
        PATTERNS,
        tuple(placements),
        tuple(walls),
        height,
        min(below, pitch / 2 - height),
    )


def _landmark_shape(geometry: Geometry, code: int) -> Shape:
    bars = bar_outlines(geometry, code)
    outlines = tuple(Polygon(tuple((x, y) for x, y in bar.corners.tolist())) for bar in bars)
    arrows = tuple(mark for bar in bars for mark in pole_arrow(geometry, bar))
    letters = tuple(Letter(*letter) for bar in bars for letter in pole_letters(bar))
    return Shape(
        f"LANDMARK_{name(code)}",
        PATTERNS[PATTERN_OF[code] - 1],
        ((BARS, outlines), (POLES, arrows)),
        letters,
        0.4e3 * geometry.bar_width_m,
    )
