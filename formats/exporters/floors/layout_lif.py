"""Layouts in VDMA's Layout Interchange Format (LIF) 1.0.0 and 2.0.0, for master controls.

A layout has nodes, edges in one direction each, no stations, and one type of vehicle. Both versions
of the format are in metres and have the same content here. LIF 1.0.0 is VDMA, "LIF - Layout
Interchange Format", March 2024. LIF 2.0.0 (September 2026) is not compatible with it. Its source is
the repository of the working group, github.com/Intralogistics-2X-LIF/Layout-Interchange-Format:
``LIF.md``, ``json_schemas/LIF.schema``, and ``changenotes/1.0.0 -> 2.0.0.md``. Layouts belong to an
origin, the file has a ``lifId``, nodes have no name, and a vehicle is a mobile robot with
manufacturer and series.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from locatk.formats.output import tool_version

LIF_VERSIONS = ("1.0.0", "2.0.0")

MANUFACTURER = "locatk"

POSITION_DECIMALS = 9
"""Decimals of a position in metres."""


@dataclass(frozen=True)
class LayoutPoint:
    """Node of a layout.

    Attributes
    ----------
    node_id : str
    x_m, y_m : float
    name : str
        ``nodeName``, in LIF 2 ``nodeDescriptor``; none if it is empty.
    description : str
        ``nodeDescription``, which LIF 2 does not have; none if it is empty.
    theta_rad : float or None
        Orientation of a vehicle on the node, from -pi to pi.
    """

    node_id: str
    x_m: float
    y_m: float
    name: str = ""
    description: str = ""
    theta_rad: float | None = None


def dumps_layout(
    title: str,
    name: str,
    description: str,
    series: str,
    points: Sequence[LayoutPoint],
    edges: Sequence[tuple[str, str]],
    stamp: datetime,
    version: str = LIF_VERSIONS[0],
) -> str:
    """Return the text of a layout; the same arguments give the same text.

    Parameters
    ----------
    title : str
        Identifier of layout, origin and file.
    name, description : str
        Of the layout; it has no name if that is empty.
    series : str
        Series of the vehicles of :data:`MANUFACTURER`.
    points : sequence of LayoutPoint
    edges : sequence of (str, str)
        Identifiers of the nodes at the start and the end of each edge.
    stamp : datetime
        Time of the layout, with its time zone.
    version : str
        One of :data:`LIF_VERSIONS`.
    """
    layout: dict[str, Any] = {
        "layoutId": title,
        **({"layoutName": name} if name else {}),
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
        vehicle = f"{MANUFACTURER}.{series}"
        layout |= {"layoutLevelId": "0", "layoutDescription": description}
        layout["nodes"] = [_node_1(point, title, vehicle) for point in points]
        layout["edges"] = [_edge_1(start, end, vehicle) for start, end in edges]
        layout["stations"] = []
        data = {"metaInformation": head, "layouts": [layout]}
    else:
        head = {
            "lifId": title,
            "creator": creator,
            # Milliseconds, as in the examples of the repository.
            "exportTimestamp": f"{seconds}.{utc.microsecond // 1000:03}Z",
            "lifVersion": version,
        }
        robots = [{"manufacturer": MANUFACTURER, "seriesName": series}]
        layout["layoutDescriptor"] = description
        layout["nodes"] = [_node_2(point, title, robots) for point in points]
        layout["edges"] = [_edge_2(start, end, robots) for start, end in edges]
        origin = {"originId": title, "layouts": [layout]}
        data = {"metaInformation": head, "origins": [origin]}
    return json.dumps(data, indent=1, ensure_ascii=False) + "\n"


def _node_1(point: LayoutPoint, title: str, vehicle: str) -> dict[str, Any]:
    return {
        "nodeId": point.node_id,
        **({"nodeName": point.name} if point.name else {}),
        **({"nodeDescription": point.description} if point.description else {}),
        "mapId": title,
        "nodePosition": _position(point),
        "vehicleTypeNodeProperties": [{"vehicleTypeId": vehicle, **_theta(point)}],
    }


def _node_2(point: LayoutPoint, title: str, robots: list[dict[str, str]]) -> dict[str, Any]:
    return {
        "nodeId": point.node_id,
        **({"nodeDescriptor": point.name} if point.name else {}),
        "mapId": title,
        "nodePosition": _position(point),
        "mobileRobotTypeNodeProperties": [{"mobileRobotTypes": robots, **_theta(point)}],
    }


def _edge_1(start: str, end: str, vehicle: str) -> dict[str, Any]:
    return {
        **_edge(start, end),
        "vehicleTypeEdgeProperties": [
            {
                "vehicleTypeId": vehicle,
                "vehicleOrientation": 0.0,
                "orientationType": "TANGENTIAL",
                "rotationAllowed": False,
            }
        ],
    }


def _edge_2(start: str, end: str, robots: list[dict[str, str]]) -> dict[str, Any]:
    return {
        **_edge(start, end),
        "mobileRobotTypeEdgeProperties": [
            {
                "mobileRobotTypes": robots,
                "orientationType": "TANGENTIAL",
                "mobileRobotOrientations": [0.0],
                "reachOrientationBeforeEntering": True,
            }
        ],
    }


def _position(point: LayoutPoint) -> dict[str, float]:
    return {"x": round(point.x_m, POSITION_DECIMALS), "y": round(point.y_m, POSITION_DECIMALS)}


def _theta(point: LayoutPoint) -> dict[str, float]:
    return {} if point.theta_rad is None else {"theta": point.theta_rad}


def _edge(start: str, end: str) -> dict[str, str]:
    return {"edgeId": f"{start}-{end}", "startNodeId": start, "endNodeId": end}


def stamp_of(path: Path) -> datetime:
    """Return the time at which a file was written, so that the same file gives the same layout.

    SOURCE_DATE_EPOCH takes precedence (reproducible-builds.org).
    """
    given = os.environ.get("SOURCE_DATE_EPOCH", "")
    return datetime.fromtimestamp(int(given or path.stat().st_mtime), UTC)
