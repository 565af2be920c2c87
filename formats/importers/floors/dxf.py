"""Named objects on layers of a DXF drawing: block inserts, closed outlines and points with text.

Landmark maps (:mod:`.map_dxf`) and sites of tags (:mod:`.site_dxf`) are read from them. Only the
objects of the model space count, not those within blocks. Conventions:

- the position of an insert is the base point of its block, its rotation is that of the insert
  (counter-clockwise from x), and the size of its scale is ignored;
- the position of a closed outline (polyline, circle, ellipse) is the centroid of its area; outlines
  and points have no rotation;
- the scale of an insert may be negative along both axes, which is a rotation by 180 degrees;
- a text belongs to the object that is nearest to its insertion point, if it is nearer than half the
  distance of that object to the next one, or than :data:`MAX_TEXT_DISTANCE_M` to a single object.

Z is ignored. Read with ezdxf (extra ``dxf``): DXF R12 to R2018, as text or binary, also slightly
damaged files.
"""

from __future__ import annotations

import io
import logging
import math
import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import FormatError
from locatk.core.printable import escape_controls
from locatk.formats.extras import requires_extra
from locatk.formats.files import read_bytes

Array = NDArray[np.float64]

MAX_DXF_BYTES = 64 << 20
"""Largest drawing [bytes]; ezdxf takes about twenty times as much memory."""

MAX_COORDINATE_M = 1e4
"""10 km, larger than any floor: larger numbers are in another unit or of a map of the country."""

MAX_TEXT_DISTANCE_M = 2.0
"""Largest distance of a text from the only object: 20 mm on paper in a drawing of 1 : 100."""

UNIT_M = {"mm": 1e-3, "cm": 1e-2, "dm": 0.1, "m": 1.0, "in": 0.0254, "ft": 0.3048}
"""Length of the units in metres."""

INSUNITS = {1: "in", 2: "ft", 4: "mm", 5: "cm", 6: "m", 14: "dm"}
"""Units by the header variable ``$INSUNITS`` (Autodesk, DXF Reference, HEADER section)."""

OUTLINE_KINDS = ("LWPOLYLINE", "POLYLINE", "CIRCLE", "ELLIPSE")

FLATTENING = 1e-3
"""Largest distance of an arc from the chords that replace it, relative to the outline's size."""

MAX_REASON_CHARACTERS = 80
"""Length of the reason of ezdxf in a message."""

MAX_NAMED_LAYERS = 8
"""Number of layers that a message lists."""


@dataclass(frozen=True)
class DxfText:
    """Text of one line."""

    handle: str
    text: str


@dataclass(frozen=True)
class DxfObject:
    """Object on a layer, with its texts.

    Attributes
    ----------
    handle : str
    x_m, y_m : float
    rotation_rad : float or None
        None for outlines and points.
    block : str
        Name of the block of an insert, otherwise empty.
    attributes : dict of str to str
        Attributes of an insert, by their names in upper case.
    block_texts, nearby_texts : tuple of DxfText
        Texts of the block of an insert, and texts next to the object.
    """

    handle: str
    x_m: float
    y_m: float
    rotation_rad: float | None = None
    block: str = ""
    attributes: dict[str, str] = field(default_factory=dict)
    block_texts: tuple[DxfText, ...] = ()
    nearby_texts: tuple[DxfText, ...] = ()

    @property
    def name(self) -> str:
        """Description for messages."""
        return f"handle {self.handle}"


@dataclass(frozen=True)
class DxfLayers:
    """Content of some layers of a drawing.

    Attributes
    ----------
    objects : tuple of DxfObject
    distant_texts : tuple of DxfText
        Texts that belong to no object.
    unit : str
        Unit of the drawing, one of :data:`UNIT_M`.
    ignored : dict of str to int
        Number of other entities, by their kinds in the terms of DXF.
    """

    objects: tuple[DxfObject, ...]
    distant_texts: tuple[DxfText, ...]
    unit: str
    ignored: dict[str, int]


class DxfReader:
    """Access to the objects of a drawing; errors name the file and the handle of an entity."""

    def __init__(self, path: Path) -> None:
        """Read a drawing.

        Raises
        ------
        FormatError
            It is not DXF, or larger than :data:`MAX_DXF_BYTES`.
        """
        self._path = path
        self._document = _load(path, read_bytes(path, MAX_DXF_BYTES))

    def read(self, layers: Sequence[str], unit: str | None = None) -> DxfLayers:
        """Return the objects on layers, in the order of the file.

        Parameters
        ----------
        layers : sequence of str
            Names; case is ignored, as in CAD.
        unit : str, optional
            Unit of the drawing, one of :data:`UNIT_M`, which takes precedence over ``$INSUNITS``.

        Raises
        ------
        FormatError
            A layer is missing or there are no objects on the layers, the unit is unknown, an insert
            is mirrored, tilted or an array of blocks, or a position is not within
            :data:`MAX_COORDINATE_M`.
        """
        self._check_layers(layers)
        unit = unit or self._unit()
        wanted = {layer.casefold() for layer in layers}
        objects: list[DxfObject] = []
        texts: list[tuple[DxfText, tuple[float, float]]] = []
        ignored: Counter[str] = Counter()
        for entity in self._document.modelspace():
            if _layer(entity).casefold() not in wanted:
                continue
            kind = entity.dxftype()
            if kind in ("TEXT", "MTEXT"):
                position = self._object(entity, _text_position(entity), unit)
                texts.append((_text(entity), (position.x_m, position.y_m)))
                continue
            found = self._convert(entity, unit)
            if found is None:
                ignored[kind] += 1
            else:
                objects.append(found)
        if not objects:
            raise self._no_objects(layers, ignored)
        return _assign_texts(objects, texts, unit, dict(ignored))

    def unit_m(self, unit: str | None = None) -> float:
        """Return the length of the drawing's unit in metres; ``unit`` takes precedence.

        Raises
        ------
        FormatError
            The unit is unknown.
        """
        return UNIT_M[unit or self._unit()]

    def closed_outlines(
        self, layers: Sequence[str] | None = None
    ) -> tuple[list[tuple[str, Array]], list[str]]:
        """Return the polygons of closed polylines in the unit of the drawing, by their handles.

        Parameters
        ----------
        layers : sequence of str, optional
            Names; by default all layers.

        Returns
        -------
        outlines : list of (str, (n, 2) ndarray)
            Arcs are replaced by chords; the first corner is not repeated.
        open_handles : list of str
            Handles of polylines that are not closed.

        Raises
        ------
        FormatError
            A layer is missing, or an entity is damaged.
        """
        from ezdxf import DXFError

        if layers is not None:
            self._check_layers(layers)
        wanted = None if layers is None else {layer.casefold() for layer in layers}
        outlines: list[tuple[str, Array]] = []
        open_handles: list[str] = []
        for entity in self._document.modelspace():
            if entity.dxftype() not in OUTLINE_KINDS:
                continue
            if wanted is not None and _layer(entity).casefold() not in wanted:
                continue
            try:
                with np.errstate(over="ignore", invalid="ignore"):  # damaged coordinates
                    corners = _outline_corners(entity)
            except DXFError as error:
                reason = escape_controls(str(error))[:MAX_REASON_CHARACTERS]
                raise self.error(f"a damaged entity ({reason})", entity.dxf.handle) from error
            if corners is None:
                continue
            if len(corners) > 3 and _is_closed(corners):
                outlines.append((entity.dxf.handle, corners[:-1]))
            else:
                open_handles.append(entity.dxf.handle)
        return outlines, open_handles

    def error(
        self, message: str, handle: str | None = None, hint: str | None = None
    ) -> FormatError:
        """Return an error about the drawing, or about the entity with a handle."""
        where = None if handle is None else f"handle {handle}"
        return FormatError(message, file=self._path, where=where, hint=hint)

    def _check_layers(self, layers: Sequence[str]) -> None:
        used = {_layer(entity) for entity in self._document.modelspace()} - {""}
        known = {layer.casefold() for layer in used}
        missing = [layer for layer in layers if layer.casefold() not in known]
        if missing:
            names = sorted(used, key=str.casefold)
            more = ", ..." if len(names) > MAX_NAMED_LAYERS else ""
            listed = ", ".join(names[:MAX_NAMED_LAYERS]) + more
            raise self.error(
                f"nothing is on layer {missing[0]!r}",
                hint=f"Name a layer of the drawing with --layer: {listed}" if names else None,
            )

    def _unit(self) -> str:
        code = self._document.header.get("$INSUNITS", 0)
        if code not in INSUNITS:
            reason = "the drawing has no unit" if not code else f"unit {code} is not supported"
            raise self.error(
                f"{reason} ($INSUNITS)", hint=f"Give it as in --units mm: {', '.join(UNIT_M)}"
            )
        return INSUNITS[code]

    def _no_objects(self, layers: Sequence[str], ignored: Counter[str]) -> FormatError:
        kinds = ", ".join(f"{count} {kind}" for kind, count in sorted(ignored.items()))
        return self.error(
            f"no block insert, closed outline or point on layer {', '.join(layers)}"
            + (f", but {kinds}" if kinds else ""),
            hint="Draw each as a block, a closed polyline, a circle or a point, or name another "
            "--layer",
        )

    def _convert(self, entity: Any, unit: str) -> DxfObject | None:
        """Return the object that an entity is; None for entities of other kinds."""
        from ezdxf import DXFError

        try:
            if entity.dxftype() == "INSERT":
                return self._insert(entity, unit)
            if entity.dxftype() == "POINT":
                return self._object(entity, entity.dxf.location, unit)
            if entity.dxftype() not in OUTLINE_KINDS:
                return None
            with np.errstate(over="ignore", invalid="ignore"):  # damaged coordinates
                centre = _outline_centre(entity)
        except DXFError as error:
            reason = escape_controls(str(error))[:MAX_REASON_CHARACTERS]
            hint = "Draw it again"
            raise self.error(f"a damaged entity ({reason})", entity.dxf.handle, hint) from error
        return None if centre is None else self._object(entity, centre, unit)

    def _insert(self, insert: Any, unit: str) -> DxfObject:
        handle, dxf = insert.dxf.handle, insert.dxf
        if insert.mcount > 1:
            hint = "Explode the array, so that each block is an insert of its own"
            raise self.error(f"an array of {insert.mcount} blocks", handle, hint)
        normal_x, normal_y, normal_z = dxf.get("extrusion", (0.0, 0.0, 1.0))
        if not math.hypot(normal_x, normal_y) <= 1e-6 * abs(normal_z):  # nan too
            hint = "Insert the block again, in the plane of the floor"
            raise self.error("a tilted block, whose rotation is not that of a tag", handle, hint)
        scale_x, scale_y = dxf.get("xscale", 1.0), dxf.get("yscale", 1.0)
        if normal_z < 0 or not scale_x * scale_y > 0:
            hint = "Insert the block again, rotated instead of mirrored"
            raise self.error("a mirrored block, whose rotation is not that of a tag", handle, hint)
        rotation_deg = dxf.get("rotation", 0.0)
        if not math.isfinite(rotation_deg):
            raise self.error(f"a rotation of {rotation_deg} degrees", handle)
        block = self._document.blocks.get(dxf.name)
        entities = [] if block is None else list(block)
        attributes = {
            entity.dxf.tag.upper(): entity.dxf.text.strip()
            for entity in [
                *(item for item in entities if item.dxftype() == "ATTDEF" and item.is_const),
                *(item for item in insert.attribs if item.is_alive),  # not damaged ones
            ]
        }
        return replace(
            self._object(insert, dxf.insert, unit),
            rotation_rad=math.radians(rotation_deg) + (math.pi if scale_x < 0 else 0.0),
            block=dxf.name,
            attributes=attributes,
            block_texts=tuple(
                _text(item) for item in entities if item.dxftype() in ("TEXT", "MTEXT")
            ),
        )

    def _object(self, entity: Any, position: Any, unit: str) -> DxfObject:
        x_m, y_m = (UNIT_M[unit] * float(value) for value in (position[0], position[1]))
        if not (abs(x_m) <= MAX_COORDINATE_M and abs(y_m) <= MAX_COORDINATE_M):  # nan too
            raise self.error(
                f"at {x_m:.6g}, {y_m:.6g} m from the origin of the drawing, more than "
                f"{MAX_COORDINATE_M:g} m",
                entity.dxf.handle,
                "Check the unit (--units), or move the drawing to an origin on the floor",
            )
        return DxfObject(entity.dxf.handle, x_m, y_m)


def _load(path: str | os.PathLike[str], data: bytes) -> Any:
    """Parse a drawing with ezdxf."""
    with requires_extra("dxf", "DXF", file=path):
        from ezdxf import recover
    if data.startswith(b"AC10"):
        raise FormatError("a drawing in DWG", file=path, hint="Save it as DXF in the CAD program")
    # ezdxf reports each damage that it repairs.
    logger = logging.getLogger("ezdxf")
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        document, _ = recover.read(io.BytesIO(data))
    except Exception as error:  # ezdxf raises errors of many classes for damaged files.
        reason = escape_controls(str(error))[:MAX_REASON_CHARACTERS] or type(error).__name__
        raise FormatError(
            f"not DXF, or damaged ({reason})",
            file=path,
            hint="Save the drawing again as DXF, R12 or later",
        ) from error
    finally:
        logger.setLevel(level)
    return document


def _layer(entity: Any) -> str:
    """Return the layer of an entity, empty if it has none."""
    return str(entity.dxf.layer) if entity.dxf.is_supported("layer") else ""


def _outline_centre(entity: Any) -> tuple[float, float] | None:
    """Return the centroid of the area of a closed outline; None for other lines."""
    corners = _outline_corners(entity)
    return None if corners is None or not _is_closed(corners) else _centroid(corners)


def _outline_corners(entity: Any) -> Array | None:
    """Return the points (n, 2) of a line, with chords for arcs; None if it has no size."""
    from ezdxf import path

    try:
        outline = path.make_path(entity)
    except TypeError:  # A mesh, which is a POLYLINE as well.
        return None
    vertices = np.array([(point.x, point.y) for point in outline.control_vertices()])
    size = float(np.ptp(vertices, axis=0).max()) if len(vertices) else 0.0
    if not 0 < size < math.inf:
        return None
    flattened = outline.flattening(FLATTENING * size)
    return np.array([(point.x, point.y) for point in flattened])


def _is_closed(corners: Array) -> bool:
    size = float(np.ptp(corners, axis=0).max())
    return bool(np.allclose(corners[0], corners[-1], rtol=0, atol=1e-6 * size))


def _centroid(corners: Array) -> tuple[float, float] | None:
    """Return the centroid of a polygon; None if it has no area."""
    origin = corners[0]
    relative = corners - origin  # Products of large coordinates would lose digits.
    following = np.roll(relative, -1, axis=0)
    cross = relative[:, 0] * following[:, 1] - following[:, 0] * relative[:, 1]
    area = cross.sum() / 2
    if not abs(area) > 0:
        return None
    x, y = origin + ((relative + following) * cross[:, None]).sum(axis=0) / (6 * area)
    return float(x), float(y)


def _text(entity: Any) -> DxfText:
    """Return the text of a TEXT or MTEXT without codes, on one line."""
    return DxfText(entity.dxf.handle, " ".join(entity.plain_text().split()))


def _text_position(entity: Any) -> Any:
    """Return the point at which a text is placed, in world coordinates."""
    if entity.dxftype() == "MTEXT":
        return entity.dxf.insert
    # The axes of a TEXT depend on its extrusion (Autodesk, DXF Reference, Object Coordinate Systems
    # (OCS)).
    return entity.ocs().to_wcs(entity.get_placement()[1])


def _assign_texts(
    objects: list[DxfObject],
    texts: list[tuple[DxfText, tuple[float, float]]],
    unit: str,
    ignored: dict[str, int],
) -> DxfLayers:
    """Assign each text to the object next to it, by the rule of the module."""
    from scipy.spatial import cKDTree

    if not texts:
        return DxfLayers(tuple(objects), (), unit, ignored)
    position_m = np.array([(item.x_m, item.y_m) for item in objects])
    tree = cKDTree(position_m)
    limit_m = np.full(len(objects), MAX_TEXT_DISTANCE_M)
    if len(objects) > 1:
        limit_m = np.asarray(tree.query(position_m, 2)[0])[:, 1] / 2
    found = tree.query(np.array([position for _, position in texts]))
    distance_m, nearest = (np.asarray(each) for each in found)
    nearby: list[list[DxfText]] = [[] for _ in objects]
    distant: list[DxfText] = []
    for (text, _), distance, index in zip(texts, distance_m, nearest.tolist(), strict=True):
        (nearby[index] if distance < limit_m[index] else distant).append(text)
    assigned = (
        replace(item, nearby_texts=tuple(texts_of))
        for item, texts_of in zip(objects, nearby, strict=True)
    )
    return DxfLayers(tuple(assigned), tuple(distant), unit, ignored)
