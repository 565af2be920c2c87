"""Landmark maps from layouts in VDMA's Layout Interchange Format (LIF) 1.0.0 and 2.0.0.

A node is a landmark, whose name (in LIF 2, its descriptor) is the letters of its bars. Neighbours
without an edge in either direction are separated by a wall. The format and the conventions of its
nodes and edges are described in :mod:`locatk.formats.exporters.map_lif`, which writes such layouts.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from locatk.core.errors import FormatError, error_context
from locatk.core.landmarks.landmark import code_of
from locatk.core.landmarks.map.floor import Cell, FloorMap, neighbour
from locatk.core.landmarks.map.grid_fit import MAX_OFFSET_M, floor_from_poses

MAX_COORDINATE_M = 1e4
"""10 km, larger than any floor: larger numbers are in another unit."""

LETTERS_KEY = {"1": "nodeName", "2": "nodeDescriptor"}
"""Key of the letters of a node by the major version of LIF."""


def loads_lif(
    text: str,
    *,
    file: str | os.PathLike[str],
    pitch_m: float | None = None,
    tolerance_m: float = MAX_OFFSET_M,
) -> FloorMap:
    """Parse a layout; pitch and cells are estimated from the positions of the nodes.

    An edge in one direction only is not a wall: a map that is unique with this passage is unique
    without it, too.

    Parameters
    ----------
    text : str
    file : path
        Name in errors.
    pitch_m, tolerance_m
        See :func:`locatk.core.landmarks.map.grid_fit.fit_grid`.

    Raises
    ------
    FormatError
        It is not LIF, or the name of a node is not a landmark; the error names the node or the key.
    InputError
        The positions are not on a grid; the error names a deviating node.
    """
    reader = _LayoutReader(file)
    layout, major = reader.layout(text)
    codes, poses, names = [], [], []
    index: dict[str, int] = {}
    for number, node in enumerate(reader.objects(layout, "nodes")):
        where = f"nodes[{number}]"
        node_id = reader.text(node, "nodeId", where)
        if node_id in index:
            raise reader.error(f"node {node_id!r} occurs twice", where)
        index[node_id] = number
        codes.append(reader.code(node, LETTERS_KEY[major], where, node_id))
        poses.append((*reader.position(node, where), 0.0))
        names.append(f"node {node_id!r}")
    if not codes:
        raise reader.error("a layout without nodes", "nodes")
    with error_context(file):
        floor = floor_from_poses(codes, poses, names, pitch_m=pitch_m, tolerance_m=tolerance_m)
    edges = set()
    for number, edge in enumerate(reader.objects(layout, "edges")):
        ends = [reader.text(edge, key, f"edges[{number}]") for key in ("startNodeId", "endNodeId")]
        if all(end in index for end in ends):  # an end may be in another layout
            edges.add(frozenset(index[end] for end in ends))
    by_cell = dict(zip(_cells(floor, poses), range(len(poses)), strict=True))
    walls = {
        (cell, other)
        for cell, other in iter_passages(floor)
        if cell < other and frozenset((by_cell[cell], by_cell[other])) not in edges
    }
    title = layout.get("layoutName")
    return replace(floor, walls=frozenset(walls), name=title if isinstance(title, str) else "")


def iter_passages(floor: FloorMap) -> Iterator[tuple[Cell, Cell]]:
    """Yield the pairs of cells between which a robot can drive, in both directions."""
    for cell in floor.cells():
        for heading in range(4):
            if floor.is_passable(cell, heading):
                yield cell, neighbour(cell, heading)


class _LayoutReader:
    """Checked access to the JSON; errors name ``file``."""

    def __init__(self, file: str | os.PathLike[str]) -> None:
        self._file = file

    def error(self, message: str, where: str, hint: str | None = None) -> FormatError:
        return FormatError(message, file=self._file, where=where, hint=hint)

    def layout(self, text: str) -> tuple[dict[str, Any], str]:
        """Return the only layout of the text, and the major version of its format."""
        try:
            data = json.loads(text.removeprefix("\ufeff"))
        except json.JSONDecodeError as error:
            raise FormatError(
                f"not JSON ({error.msg})", file=self._file, where=error.lineno
            ) from None
        except (ValueError, RecursionError) as error:
            raise FormatError(f"not JSON ({error})", file=self._file) from None
        if not isinstance(data, dict):
            raise FormatError("not LIF: expected an object", file=self._file)
        major = self._major_version(data)
        root = "layouts" if major == "1" else "origins"
        if root not in data:
            raise FormatError(f"not LIF {major}: expected the key {root!r}", file=self._file)
        parents = [data] if major == "1" else self.objects(data, "origins")
        layouts = [layout for parent in parents for layout in self.objects(parent, "layouts")]
        if len(layouts) != 1:
            raise self.error(
                f"{len(layouts)} layouts, expected one",
                "layouts",
                "A landmark map is one floor: keep one layout in the file",
            )
        return layouts[0], major

    def _major_version(self, data: dict[str, Any]) -> str:
        """Return the stated major version; a file without one is recognized by its keys."""
        head = data.get("metaInformation")
        version = head.get("lifVersion") if isinstance(head, dict) else None
        if version is None:
            return "2" if "origins" in data else "1"
        major = version.split(".")[0] if isinstance(version, str) else ""
        if major not in LETTERS_KEY:
            raise self.error(
                f"version {version!r} of LIF is not supported",
                "metaInformation.lifVersion",
                "Export the layout as LIF 1.0.0 or 2.0.0",
            )
        return major

    def objects(self, data: dict[str, Any], key: str) -> list[dict[str, Any]]:
        """Return a list of objects."""
        value = data.get(key)
        if not isinstance(value, list) or not all(isinstance(item, dict) for item in value):
            raise self.error("expected a list of objects", key)
        return value

    def text(self, data: dict[str, Any], key: str, where: str) -> str:
        """Return a string that is not empty; ``where`` is the path of ``data``."""
        value = data.get(key)
        if not isinstance(value, str) or not value:
            raise self.error("expected a string", f"{where}.{key}")
        return value

    def code(self, node: dict[str, Any], key: str, where: str, node_id: str) -> int:
        """Return the code of the landmark whose letters a node has under ``key``."""
        letters = node.get(key)
        try:
            return code_of(letters if isinstance(letters, str) else "")
        except ValueError:
            raise self.error(
                f"the {key} of node {node_id!r} is not a landmark",
                f"{where}.{key}",
                f"Give the letters of its bars as {key}, as in NNSN: counter-clockwise from +x",
            ) from None

    def position(self, node: dict[str, Any], where: str) -> tuple[float, float]:
        """Return the position of a node in metres."""
        position = node.get("nodePosition")
        coordinates = []
        for axis in ("x", "y"):
            value = position.get(axis) if isinstance(position, dict) else None
            is_number = isinstance(value, int | float) and not isinstance(value, bool)
            if value is None or not is_number or not abs(value) <= MAX_COORDINATE_M:
                raise self.error(
                    f"expected x and y in metres, up to {MAX_COORDINATE_M:g}",
                    f"{where}.nodePosition",
                )
            coordinates.append(float(value))
        return coordinates[0], coordinates[1]


def _cells(floor: FloorMap, poses: list[tuple[float, float, float]]) -> list[Cell]:
    """Return the cell of each pose."""
    x, y = floor.origin_m
    return [
        (round((pose[1] - y) / floor.pitch_m), round((pose[0] - x) / floor.pitch_m))
        for pose in poses
    ]
