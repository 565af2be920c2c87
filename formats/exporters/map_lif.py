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
from datetime import UTC, datetime

from locatk.core.landmarks.landmark import name
from locatk.core.landmarks.map.floor import Cell, FloorMap, as_built_poses
from locatk.formats.importers.map_lif import iter_passages
from locatk.formats.output import tool_version

LIF_VERSION = "1.0.0"

VEHICLE = "locatk.landmarks"

POSITION_DECIMALS = 9
"""Decimals of a position in metres."""


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
        for cell, other in iter_passages(floor)
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


def _node_id(cell: Cell) -> str:
    return f"r{cell[0]}c{cell[1]}"
