"""Landmark maps as a layout in VDMA's Layout Interchange Format, for master controls.

LIF 1.0.0 (VDMA, "LIF - Layout Interchange Format", March 2024; the JSON of
github.com/Intralogistics-2X-LIF/Layout-Interchange-Format) in metres:

- a landmark is a node ``r<row>c<column>`` at its position, as built if that is known; its
  ``nodeName`` is the letters of its bars, as in ``NNSN``, counter-clockwise from +x;
- a passage from a landmark to a neighbour is an edge; neighbours without an edge in either
  direction are separated by a wall;
- there are no stations, and there is one type of vehicle, :data:`VEHICLE`.

The layout does not contain the alphabet, the window, the bars and the headings as built.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

from locatk.core.errors import FormatError, error_context
from locatk.core.landmarks.landmark import code_of, name
from locatk.core.landmarks.map.floor import Cell, FloorMap, as_built_poses, neighbour
from locatk.core.landmarks.map.grid_fit import MAX_OFFSET_M, floor_from_poses
from locatk.formats.output import tool_version

LIF_VERSION = "1.0.0"

VEHICLE = "locatk.landmarks"

POSITION_DECIMALS = 9
"""Decimals of a position in metres."""

MAX_COORDINATE_M = 1e4
"""10 km, larger than any floor: larger numbers are in another unit."""


def dumps_lif(floor: FloorMap, stamp: datetime) -> str:
    """Return the layout of a map; the same map and stamp give the same text.

    Parameters
    ----------
    floor : FloorMap
    stamp : datetime
        Time of the layout, with its time zone.
    """
    title = floor.name or "landmarks"
    rows, columns = floor.shape
    nodes = [
        {
            "nodeId": _node_id(cell),
            "nodeName": name(int(floor.codes[cell])),
            "nodeDescription": f"landmark of code {floor.codes[cell]} in row {cell[0]}, "
            f"column {cell[1]}",
            "mapId": title,
            "nodePosition": {"x": round(x, POSITION_DECIMALS), "y": round(y, POSITION_DECIMALS)},
            "vehicleTypeNodeProperties": [{"vehicleTypeId": VEHICLE}],
        }
        for cell, (x, y, _) in zip(floor.cells(), as_built_poses(floor).tolist(), strict=True)
    ]
    edges = [
        {
            "edgeId": f"{_node_id(cell)}-{_node_id(other)}",
            "startNodeId": _node_id(cell),
            "endNodeId": _node_id(other),
            "vehicleTypeEdgeProperties": [
                {
                    "vehicleTypeId": VEHICLE,
                    "vehicleOrientation": 0.0,
                    "orientationType": "TANGENTIAL",
                    "rotationAllowed": False,
                }
            ],
        }
        for cell, other in _passages(floor)
    ]
    layout = {
        "layoutId": title,
        **({"layoutName": floor.name} if floor.name else {}),
        "layoutVersion": "1",
        "layoutLevelId": "0",
        "layoutDescription": f"{len(nodes)} magnetic landmarks in {rows} rows and {columns} "
        f"columns of {1e3 * floor.pitch_m:g} mm",
        "nodes": nodes,
        "edges": edges,
        "stations": [],
    }
    utc = stamp.astimezone(UTC)
    head = {
        "projectIdentification": title,
        "creator": f"locatk {tool_version()}",
        "exportTimestamp": f"{utc:%Y-%m-%dT%H:%M:%S}.{utc.microsecond // 10_000:02}Z",
        "lifVersion": LIF_VERSION,
    }
    text = json.dumps({"metaInformation": head, "layouts": [layout]}, indent=1, ensure_ascii=False)
    return text + "\n"


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
    layout = reader.layout(text)
    codes, poses, names = [], [], []
    index: dict[str, int] = {}
    for number, node in enumerate(reader.objects(layout, "nodes")):
        where = f"nodes[{number}]"
        node_id = reader.text(node, "nodeId", where)
        if node_id in index:
            raise reader.error(f"node {node_id!r} occurs twice", where)
        index[node_id] = number
        codes.append(reader.code(node, where, node_id))
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
        for cell, other in _passages(floor)
        if cell < other and frozenset((by_cell[cell], by_cell[other])) not in edges
    }
    title = layout.get("layoutName")
    return replace(floor, walls=frozenset(walls), name=title if isinstance(title, str) else "")


class _LayoutReader:
    """Checked access to the JSON; errors name ``file``."""

    def __init__(self, file: str | os.PathLike[str]) -> None:
        self._file = file

    def error(self, message: str, where: str, hint: str | None = None) -> FormatError:
        return FormatError(message, file=self._file, where=where, hint=hint)

    def layout(self, text: str) -> dict[str, Any]:
        """Return the only layout of the text."""
        try:
            data = json.loads(text.removeprefix("\ufeff"))
        except json.JSONDecodeError as error:
            raise FormatError(
                f"not JSON ({error.msg})", file=self._file, where=error.lineno
            ) from None
        except (ValueError, RecursionError) as error:
            raise FormatError(f"not JSON ({error})", file=self._file) from None
        if not isinstance(data, dict) or "layouts" not in data:
            raise FormatError("not LIF: expected the key 'layouts'", file=self._file)
        layouts = self.objects(data, "layouts")
        if len(layouts) != 1:
            raise self.error(
                f"{len(layouts)} layouts, expected one",
                "layouts",
                "A landmark map is one floor: keep one layout in the file",
            )
        return layouts[0]

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

    def code(self, node: dict[str, Any], where: str, node_id: str) -> int:
        """Return the code of the landmark that is the name of a node."""
        letters = node.get("nodeName")
        try:
            return code_of(letters if isinstance(letters, str) else "")
        except ValueError:
            raise self.error(
                f"the name of node {node_id!r} is not a landmark",
                f"{where}.nodeName",
                "Give the letters of its bars as the name, as in NNSN: counter-clockwise from +x",
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


def _node_id(cell: Cell) -> str:
    return f"r{cell[0]}c{cell[1]}"


def _passages(floor: FloorMap) -> Iterator[tuple[Cell, Cell]]:
    """Yield the pairs of cells between which a robot can drive, in both directions."""
    for cell in floor.cells():
        for heading in range(4):
            if floor.is_passable(cell, heading):
                yield cell, neighbour(cell, heading)


def _cells(floor: FloorMap, poses: list[tuple[float, float, float]]) -> list[Cell]:
    """Return the cell of each pose."""
    x, y = floor.origin_m
    return [
        (round((pose[1] - y) / floor.pitch_m), round((pose[0] - x) / floor.pitch_m))
        for pose in poses
    ]
