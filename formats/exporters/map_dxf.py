"""Landmark maps as DXF for CAD: positions in mm, a block for each code.

Layers: BARS (outlines of the bars), POLES (an arrow from south to north in each bar), CENTRES (a
point each), LABELS (row, column and letters), WALLS. A landmark is an insert of the block
``LANDMARK_<letters>``, so that CAD counts them for the bill of materials. The frame of the drawing
is that of the map. Positions are as built if that is known; the bars are those of the design.
Written with ezdxf (extra ``dxf``) as DXF R2010.
"""

from __future__ import annotations

import io
import math
from typing import Any

from locatk.core.drawing import Line, Polygon
from locatk.core.landmarks.drawing.landmark import bar_outlines, pole_arrow, pole_letters
from locatk.core.landmarks.landmark import name
from locatk.core.landmarks.map.floor import FloorMap, as_built_poses
from locatk.formats.extras import requires_extra

LAYERS = {"BARS": 7, "POLES": 1, "CENTRES": 5, "LABELS": 8, "WALLS": 6}
"""Layers and their colours in AutoCAD's colour index."""

MAX_LABEL_HEIGHT_MM = 8.0


def dumps_dxf(floor: FloorMap) -> str:
    """Return the DXF text of a map; the same map and ezdxf give the same text.

    Raises
    ------
    LocatkError
        ezdxf is not installed.
    """
    with requires_extra("dxf", "DXF"):
        import ezdxf
        from ezdxf import units

    # Otherwise each file contains the time and two random ids.
    before = ezdxf.options.write_fixed_meta_data_for_testing
    ezdxf.options.write_fixed_meta_data_for_testing = True
    try:
        document = ezdxf.new("R2010", units=units.MM)
        _draw(document, floor)
        # ezdxf would list the kinds of entities in the order of their hashes.
        for kind in sorted(document.entitydb.dxf_types_in_use()):
            document.classes.add_class(kind)
        stream = io.StringIO()
        document.write(stream)
    finally:
        ezdxf.options.write_fixed_meta_data_for_testing = before
    return stream.getvalue()


def _draw(document: Any, floor: FloorMap) -> None:
    from ezdxf.enums import TextEntityAlignment

    for layer, colour in LAYERS.items():
        document.layers.add(layer, color=colour)
    for code in sorted({int(floor.codes[cell]) for cell in floor.cells()}):
        _block(document, floor, code)
    space = document.modelspace()
    pitch = 1e3 * floor.pitch_m
    height = min(MAX_LABEL_HEIGHT_MM, pitch / 12)
    below = 1e3 * (floor.geometry.radius_m + floor.geometry.bar_width_m / 2) + 0.3 * height
    for cell, (x, y, heading) in zip(floor.cells(), as_built_poses(floor).tolist(), strict=True):
        letters = name(int(floor.codes[cell]))
        position = (1e3 * x, 1e3 * y)
        rotation = {"rotation": math.degrees(heading)} if heading else {}
        space.add_blockref(
            f"LANDMARK_{letters}", position, dxfattribs={"layer": "BARS", **rotation}
        )
        space.add_point(position, dxfattribs={"layer": "CENTRES"})
        space.add_text(
            f"{cell[0]},{cell[1]} {letters}",
            height=height,
            dxfattribs={"layer": "LABELS"},
        ).set_placement(
            (position[0], position[1] - min(below, pitch / 2 - height)),
            align=TextEntityAlignment.TOP_CENTER,
        )
    for (row, column), (other_row, _) in sorted(floor.walls):
        x, y = floor.position((row, column))
        right, top = 1e3 * x + pitch / 2, 1e3 * y + pitch / 2
        start = (right - pitch, top) if other_row > row else (right, top - pitch)
        space.add_line(start, (right, top), dxfattribs={"layer": "WALLS"})
    _set_extents(document, floor)


def _block(document: Any, floor: FloorMap, code: int) -> None:
    """Add the block of a code, with the centre of the landmark as its origin."""
    from ezdxf.enums import TextEntityAlignment

    block = document.blocks.new(f"LANDMARK_{name(code)}")
    width = 1e3 * floor.geometry.bar_width_m
    for bar in bar_outlines(floor.geometry, code):
        block.add_lwpolyline(bar.corners.tolist(), close=True, dxfattribs={"layer": "BARS"})
        for mark in pole_arrow(floor.geometry, bar):
            if isinstance(mark, Line):
                block.add_line(mark.start, mark.end, dxfattribs={"layer": "POLES"})
            elif isinstance(mark, Polygon):
                block.add_solid(mark.corners, dxfattribs={"layer": "POLES"})
        for letter, position in pole_letters(bar):
            block.add_text(letter, height=0.4 * width, dxfattribs={"layer": "POLES"}).set_placement(
                position, align=TextEntityAlignment.MIDDLE_CENTER
            )


def _set_extents(document: Any, floor: FloorMap) -> None:
    """Set the initial view."""
    rows, columns = floor.shape
    half = floor.pitch_m / 2
    x, y = floor.origin_m
    high_x, high_y = floor.position((rows - 1, columns - 1))
    low, high = (1e3 * (x - half), 1e3 * (y - half)), (1e3 * (high_x + half), 1e3 * (high_y + half))
    document.header["$EXTMIN"], document.header["$EXTMAX"] = (*low, 0.0), (*high, 0.0)
    middle = ((low[0] + high[0]) / 2, (low[1] + high[1]) / 2)
    document.set_modelspace_vport(max(high[1] - low[1], high[0] - low[0]), middle)
