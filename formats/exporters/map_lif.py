"""Landmark maps as a layout in VDMA's Layout Interchange Format, for master controls.

LIF 1.0.0 (VDMA, "LIF - Layout Interchange Format", March 2024; the JSON of
github.com/Intralogistics-2X-LIF/Layout-Interchange-Format) in metres. What it holds here:

- each landmark is a node, ``r<row>c<column>``, at its place as built where that is known;
  its ``nodeName`` are the letters of its bars, as in ``NNSN``, counter-clockwise from +x;
- each way from a landmark to a neighbour is an edge: between two neighbours without an edge
  in either direction is a wall;
- there are no stations, and one type of vehicle, :data:`VEHICLE`.

The alphabet, the window, the bars and the headings as built are not in it.
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

DECIMALS = 9
"""Of metres."""

FARTHEST_M = 1e4
"""No floor is larger: what is above is in another unit."""


def dumps_lif(floor: FloorMap, stamp: datetime) -> str:
    """The layout of a map; the same map and stamp give the same text.

    Parameters
    ----------
    floor : FloorMap
    stamp : datetime
        The layout's state is of then; with its time zone.
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
            "nodePosition": {"x": round(x, DECIMALS), "y": round(y, DECIMALS)},
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
        for cell, other in _ways(floor)
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
    """The map of a layout; pitch and cells are found from the places of the nodes.

    A way that leads in one direction only is no wall: a map that is unique with it is unique
    without it, too.

    Parameters
    ----------
    text : str
    file : path
        Named in errors.
    pitch_m, tolerance_m
        See :func:`locatk.core.landmarks.map.grid_fit.fit_grid`.

    Raises
    ------
    FormatError
        It is no LIF, or a node names no landmark; the node or the key is named.
    InputError
        The places lie on no grid, or one is off it: its node is named.
    """
    read = _Reader(file)
    layout = read.layout(text)
    codes, poses, names = [], [], []
    index: dict[str, int] = {}
    for number, node in enumerate(read.objects(layout, "nodes")):
        where = f"nodes[{number}]"
        node_id = read.text(node, "nodeId", where)
        if node_id in index:
            raise read.error(f"node {node_id!r} is there twice", where)
        index[node_id] = number
        codes.append(read.code(node, where, node_id))
        poses.append((*read.place(node, where), 0.0))
        names.append(f"node {node_id!r}")
    if not codes:
        raise read.error("a layout without nodes", "nodes")
    with error_context(file):
        floor = floor_from_poses(codes, poses, names, pitch_m=pitch_m, tolerance_m=tolerance_m)
    ways = set()
    for number, edge in enumerate(read.objects(layout, "edges")):
        ends = [read.text(edge, key, f"edges[{number}]") for key in ("startNodeId", "endNodeId")]
        if all(end in index for end in ends):  # an end may be in another layout
            ways.add(frozenset(index[end] for end in ends))
    by_cell = dict(zip(_cells(floor, poses), range(len(poses)), strict=True))
    walls = {
        (cell, other)
        for cell, other in _ways(floor)
        if cell < other and frozenset((by_cell[cell], by_cell[other])) not in ways
    }
    title = layout.get("layoutName")
    return replace(floor, walls=frozenset(walls), name=title if isinstance(title, str) else "")


class _Reader:
    """What of the JSON is read, each checked; ``file`` is named in errors."""

    def __init__(self, file: str | os.PathLike[str]) -> None:
        self._file = file

    def error(self, message: str, where: str, hint: str | None = None) -> FormatError:
        return FormatError(message, file=self._file, where=where, hint=hint)

    def layout(self, text: str) -> dict[str, Any]:
        """The only layout."""
        try:
            data = json.loads(text.removeprefix("\ufeff"))
        except json.JSONDecodeError as error:
            raise FormatError(
                f"not JSON ({error.msg})", file=self._file, where=error.lineno
            ) from None
        except (ValueError, RecursionError) as error:
            raise FormatError(f"not JSON ({error})", file=self._file) from None
        if not isinstance(data, dict) or "layouts" not in data:
            raise FormatError("no LIF: expected the key 'layouts'", file=self._file)
        layouts = self.objects(data, "layouts")
        if len(layouts) != 1:
            raise self.error(
                f"{len(layouts)} layouts, expected one",
                "layouts",
                "A landmark map is one floor: leave one layout in the file",
            )
        return layouts[0]

    def objects(self, data: dict[str, Any], key: str) -> list[dict[str, Any]]:
        value = data.get(key)
        if not isinstance(value, list) or not all(isinstance(item, dict) for item in value):
            raise self.error("expected a list of objects", key)
        return value

    def text(self, data: dict[str, Any], key: str, where: str) -> str:
        value = data.get(key)
        if not isinstance(value, str) or not value:
            raise self.error("expected a string", f"{where}.{key}")
        return value

    def code(self, node: dict[str, Any], where: str, node_id: str) -> int:
        letters = node.get("nodeName")
        try:
            return code_of(letters if isinstance(letters, str) else "")
        except ValueError:
            raise self.error(
                f"node {node_id!r} names no landmark",
                f"{where}.nodeName",
                "Name it by the letters of its bars, as in NNSN: counter-clockwise from +x",
            ) from None

    def place(self, node: dict[str, Any], where: str) -> tuple[float, float]:
        position = node.get("nodePosition")
        found = []
        for axis in ("x", "y"):
            value = position.get(axis) if isinstance(position, dict) else None
            number = isinstance(value, int | float) and not isinstance(value, bool)
            if value is None or not number or not abs(value) <= FARTHEST_M:
                raise self.error(
                    f"expected x and y in metres, up to {FARTHEST_M:g}", f"{where}.nodePosition"
                )
            found.append(float(value))
        return found[0], found[1]


def _node_id(cell: Cell) -> str:
    return f"r{cell[0]}c{cell[1]}"


def _ways(floor: FloorMap) -> Iterator[tuple[Cell, Cell]]:
    """Cells between which a robot can go, in both directions."""
    for cell in floor.cells():
        for heading in range(4):
            if floor.is_passable(cell, heading):
                yield cell, neighbour(cell, heading)


def _cells(floor: FloorMap, poses: list[tuple[float, float, float]]) -> list[Cell]:
    """The cell of each place."""
    x, y = floor.origin_m
    return [
        (round((at[1] - y) / floor.pitch_m), round((at[0] - x) / floor.pitch_m)) for at in poses
    ]
