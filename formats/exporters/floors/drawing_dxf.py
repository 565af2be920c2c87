"""Drawings of a floor as DXF for CAD: positions in mm, a block for each shape.

Each placement is an insert of the block of its shape, so that CAD counts them for the bill of
materials, with the attributes of the placement. Besides the layers of the shapes there are CENTRES
(a point each), LABELS, and WALLS if there are walls. The frame of the drawing is that of the floor.
Written with ezdxf (extra ``dxf``) as DXF R2010.
"""

from __future__ import annotations

import io
import math
from typing import Any

from locatk.core.drawing import Circle, Line
from locatk.formats.exporters.floors.floor_drawing import FloorDrawing, Layer, Placement, Shape
from locatk.formats.extras import requires_extra

CENTRES, LABELS, WALLS = Layer("CENTRES", 5), Layer("LABELS", 8), Layer("WALLS", 6)


def dumps_dxf(drawing: FloorDrawing) -> str:
    """Return the DXF text of a drawing; the same drawing and ezdxf give the same text.

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
        _draw(document, drawing)
        # ezdxf would list the kinds of entities in the order of their hashes.
        for kind in sorted(document.entitydb.dxf_types_in_use()):
            document.classes.add_class(kind)
        stream = io.StringIO()
        document.write(stream)
    finally:
        ezdxf.options.write_fixed_meta_data_for_testing = before
    return stream.getvalue()


def _draw(document: Any, drawing: FloorDrawing) -> None:
    from ezdxf.enums import TextEntityAlignment

    shapes = {placement.shape.name: placement.shape for placement in drawing.placements}
    layers = [layer for shape in shapes.values() for layer, _ in shape.parts]
    for layer in dict.fromkeys([*layers, CENTRES, LABELS, *([WALLS] if drawing.walls else [])]):
        document.layers.add(layer.name, color=layer.colour)
    tags = {item.shape.name: [tag for tag, _ in item.attributes] for item in drawing.placements}
    for shape_name in sorted(shapes):
        _block(document, shapes[shape_name], tags[shape_name])
    space = document.modelspace()
    for placement in drawing.placements:
        _insert(space, placement)
        x, y = placement.position_mm
        space.add_point((x, y), dxfattribs={"layer": CENTRES.name})
        space.add_text(
            placement.label, height=drawing.label_height_mm, dxfattribs={"layer": LABELS.name}
        ).set_placement((x, y - drawing.label_distance_mm), align=TextEntityAlignment.TOP_CENTER)
    for wall in drawing.walls:
        space.add_line(wall.start, wall.end, dxfattribs={"layer": WALLS.name})
    _set_extents(document, drawing)


def _insert(space: Any, placement: Placement) -> None:
    degrees = math.degrees(placement.heading_rad)
    rotation = {"rotation": degrees} if degrees else {}
    layer = placement.shape.parts[0][0].name
    insert = space.add_blockref(
        placement.shape.name, placement.position_mm, dxfattribs={"layer": layer, **rotation}
    )
    if placement.attributes:
        insert.add_auto_attribs(dict(placement.attributes))


def _block(document: Any, shape: Shape, attributes: list[str]) -> None:
    """Add the block of a shape, with the origin of the shape as its base point."""
    from ezdxf.enums import TextEntityAlignment

    block = document.blocks.new(shape.name)
    for layer, marks in shape.parts:
        style = {"layer": layer.name}
        for mark in marks:
            if isinstance(mark, Line):
                block.add_line(mark.start, mark.end, dxfattribs=style)
            elif isinstance(mark, Circle):
                block.add_circle(mark.centre, mark.radius_mm, dxfattribs=style)
            elif mark.filled:
                block.add_solid(mark.corners, dxfattribs=style)
            else:
                block.add_lwpolyline(mark.corners, close=True, dxfattribs=style)
    style = {"layer": shape.parts[-1][0].name}
    for letter in shape.letters:
        block.add_text(letter.text, height=shape.letter_height_mm, dxfattribs=style).set_placement(
            letter.centre, align=TextEntityAlignment.MIDDLE_CENTER
        )
    for name in attributes:
        # Invisible: the label is the text for people.
        block.add_attdef(
            name,
            (0, 0),
            height=shape.letter_height_mm,
            dxfattribs={"layer": shape.parts[0][0].name, "flags": 1},
        )


def _set_extents(document: Any, drawing: FloorDrawing) -> None:
    """Set the initial view."""
    left, bottom, right, top = drawing.box_mm
    document.header["$EXTMIN"] = (left, bottom, 0.0)
    document.header["$EXTMAX"] = (right, top, 0.0)
    middle = ((left + right) / 2, (bottom + top) / 2)
    document.set_modelspace_vport(max(top - bottom, right - left), middle)
