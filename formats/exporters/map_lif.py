"""Landmark maps as a layout in VDMA's Layout Interchange Format, for master controls.

Both versions of the format are in metres and have the same content:

- a landmark is a node ``r<row>c<column>`` at its position, as built if that is known; its
  ``nodeName`` (in LIF 2 its ``nodeDescriptor``) is the letters of its bars, as in ``NNSN``,
  counter-clockwise from +x;
- a passage from a landmark to a neighbour is an edge; neighbours without an edge in either
  direction are separated by a wall;
- there are no stations, and there is one type of vehicle, :data:`VEHICLE`.

LIF 1.0.0 is VDMA, "LIF - Layout Interchange Format", March 2024. LIF 2.0.0 (September 2026) is not
compatible with it. Its source is the repository of the working group,
github.com/Intralogistics-2X-LIF/Layout-Interchange-Format: ``LIF.md``, ``json_schemas/LIF.schema``,
and ``changenotes/1.0.0 -> 2.0.0.md``. Layouts belong to an origin, the file has a ``lifId``, nodes
have no name, and a vehicle is a mobile robot with manufacturer and series.

The layout does not contain the alphabet, the window, the bars and the headings as built.
"""

from __future__ import annotations

import json
from datetime import UTC, datetime
from typing import Any

from locatk.core.landmarks.landmark import name
from locatk.core.landmarks.map.floor import Cell, FloorMap, as_built_poses
from locatk.formats.importers.map_lif import iter_passages
from locatk.formats.output import tool_version

LIF_VERSIONS = ("1.0.0", "2.0.0")

VEHICLE = "locatk.landmarks"

MOBILE_ROBOT_TYPE = dict(zip(("manufacturer", "seriesName"), VEHICLE.split("."), strict=True))

POSITION_DECIMALS = 9
"""Decimals of a position in metres."""


def dumps_lif(floor: FloorMap, stamp: datetime, version: str = LIF_VERSIONS[0]) -> str:
    """Return the layout of a map; the same map, stamp and version give the same text.

    Parameters
    ----------
    floor : FloorMap
    stamp : datetime
        Time of the layout, with its time zone.
    version : str
        One of :data:`LIF_VERSIONS`.
    """
    title = floor.name or "landmarks"
    rows, columns = floor.shape
    description = (
        f"{len(floor.cells())} magnetic landmarks in {rows} rows and {columns} columns of "
        f"{1e3 * floor.pitch_m:g} mm"
    )
    layout: dict[str, Any] = {
        "layoutId": title,
        **({"layoutName": floor.name} if floor.name else {}),
        "layoutVersion": "1",
    }
    utc = stamp.astimezone(UTC)
    seconds = f"{utc:%Y-%m-%dT%H:%M:%S}"
    creator = f"locatk {tool_version()}"
    data: dict[str, Any]
    if version == "1.0.0":
        head = {
            "projectIdentification": title,
            "creator": creator,
            "exportTimestamp": f"{seconds}.{utc.microsecond // 10_000:02}Z",
            "lifVersion": version,
        }
        layout |= {"layoutLevelId": "0", "layoutDescription": description}
        layout |= _graph_1(floor, title) | {"stations": []}
        data = {"metaInformation": head, "layouts": [layout]}
    else:
        head = {
            "lifId": title,
            "creator": creator,
            # Milliseconds, as in the examples of the repository.
            "exportTimestamp": f"{seconds}.{utc.microsecond // 1000:03}Z",
            "lifVersion": version,
        }
        layout |= {"layoutDescriptor": description} | _graph_2(floor, title)
        origin = {"originId": title, "layouts": [layout]}
        data = {"metaInformation": head, "origins": [origin]}
    return json.dumps(data, indent=1, ensure_ascii=False) + "\n"


def _graph_1(floor: FloorMap, title: str) -> dict[str, Any]:
    """Return nodes and edges of LIF 1."""
    nodes = [
        {
            "nodeId": _node_id(cell),
            "nodeName": name(int(floor.codes[cell])),
            "nodeDescription": f"landmark of code {floor.codes[cell]} in row {cell[0]}, "
            f"column {cell[1]}",
            "mapId": title,
            "nodePosition": position,
            "vehicleTypeNodeProperties": [{"vehicleTypeId": VEHICLE}],
        }
        for cell, position in _positions(floor)
    ]
    edges = [
        {
            **_edge(cell, other),
            "vehicleTypeEdgeProperties": [
                {
                    "vehicleTypeId": VEHICLE,
                    "vehicleOrientation": 0.0,
                    "orientationType": "TANGENTIAL",
                    "rotationAllowed": False,
                }
            ],
        }
        for cell, other in iter_passages(floor)
    ]
    return {"nodes": nodes, "edges": edges}


def _graph_2(floor: FloorMap, title: str) -> dict[str, Any]:
    """Return nodes and edges of LIF 2."""
    nodes = [
        {
            "nodeId": _node_id(cell),
            "nodeDescriptor": name(int(floor.codes[cell])),
            "mapId": title,
            "nodePosition": position,
            "mobileRobotTypeNodeProperties": [{"mobileRobotTypes": [MOBILE_ROBOT_TYPE]}],
        }
        for cell, position in _positions(floor)
    ]
    edges = [
        {
            **_edge(cell, other),
            "mobileRobotTypeEdgeProperties": [
                {
                    "mobileRobotTypes": [MOBILE_ROBOT_TYPE],
                    "orientationType": "TANGENTIAL",
                    "mobileRobotOrientations": [0.0],
                    "reachOrientationBeforeEntering": True,
                }
            ],
        }
        for cell, other in iter_passages(floor)
    ]
    return {"nodes": nodes, "edges": edges}


def _positions(floor: FloorMap) -> list[tuple[Cell, dict[str, float]]]:
    poses = as_built_poses(floor).tolist()
    return [
        (cell, {"x": round(x, POSITION_DECIMALS), "y": round(y, POSITION_DECIMALS)})
        for cell, (x, y, _) in zip(floor.cells(), poses, strict=True)
    ]


def _edge(cell: Cell, other: Cell) -> dict[str, str]:
    start, end = _node_id(cell), _node_id(other)
    return {"edgeId": f"{start}-{end}", "startNodeId": start, "endNodeId": end}


def _node_id(cell: Cell) -> str:
    return f"r{cell[0]}c{cell[1]}"
