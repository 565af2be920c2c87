"""Drawing of named shapes on a floor at true size, independent of the file format.

Landmarks (:mod:`.map_drawing`) and tags (:mod:`.site_drawing`) are drawn with it, and written by
:mod:`.drawing_dxf` and :mod:`.drawing_svg`. Lengths are in mm, angles in radians,
counter-clockwise.
"""

from __future__ import annotations

from dataclasses import dataclass

from locatk.core.drawing import Box, Circle, Line, Point, Polygon


@dataclass(frozen=True)
class Layer:
    """Layer of a CAD drawing; ``colour`` is from AutoCAD's colour index."""

    name: str
    colour: int


@dataclass(frozen=True)
class Letter:
    """Letter that remains upright in SVG; ``centre`` is in the frame of its shape."""

    text: str
    centre: Point


@dataclass(frozen=True)
class Shape:
    """Object that can be placed several times, in a frame of its own: a block in CAD.

    Attributes
    ----------
    name : str
        Name of the block.
    group : str
        Layer of its placements in SVG.
    parts : tuple of (Layer, tuple of Line, Circle or Polygon)
        The layer of the first part is that of the placements.
    letters : tuple of Letter
        In the layer of the last part.
    letter_height_mm : float
        Height of capitals.
    """

    name: str
    group: str
    parts: tuple[tuple[Layer, tuple[Line | Circle | Polygon, ...]], ...]
    letters: tuple[Letter, ...] = ()
    letter_height_mm: float = 1.0


@dataclass(frozen=True)
class Placement:
    """Shape at its pose on the floor.

    Attributes
    ----------
    name : str
        Identifier that no other placement of the drawing has.
    shape : Shape
    position_mm : (x, y)
    heading_rad : float
    label : str
        Text below the shape.
    attributes : tuple of (str, str)
        Attributes of the block in CAD, by their upper case names.
    """

    name: str
    shape: Shape
    position_mm: Point
    heading_rad: float
    label: str
    attributes: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class FloorDrawing:
    """Shapes on a floor.

    Attributes
    ----------
    title : str
    box_mm : (left, bottom, right, top)
        Part of the floor that is drawn.
    groups : tuple of str
        Layers of the shapes in SVG.
    placements : tuple of Placement
    walls : tuple of Line
    label_height_mm : float
        Height of capitals of the labels.
    label_distance_mm : float
        Distance of the top of a label below the centre of its shape.
    """

    title: str
    box_mm: Box
    groups: tuple[str, ...]
    placements: tuple[Placement, ...]
    walls: tuple[Line, ...]
    label_height_mm: float
    label_distance_mm: float
