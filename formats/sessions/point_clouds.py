"""Paths and artifacts as point clouds: what Rerun draws unasked.

Rerun knows no ``foxglove.SceneUpdate``, and opens no 3D view for poses and transforms alone
(0.41; https://rerun.io/docs/howto/logging-and-ingestion/mcap). Of a point cloud it makes one.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from numpy.typing import ArrayLike, NDArray

from locatk.core.trajectory import Trajectory
from locatk.formats.sessions.foxglove import PATH_COLORS, thinned
from locatk.formats.sessions.messages import timestamp

POINTS_A_LINE = 400
"""Points of an outline."""

PATHS = "path/"
"""How the ids of the entities begin that are no artifact."""

_POINT = np.dtype([("xyz", "<f4", (3,)), ("rgba", "u1", (4,))])
_FIELDS = [
    *(
        PackedElementField(name=name, offset=4 * i, type=PackedElementField.FLOAT32)
        for i, name in enumerate("xyz")
    ),
    *(
        PackedElementField(name=name, offset=12 + i, type=PackedElementField.UINT8)
        for i, name in enumerate(("red", "green", "blue", "alpha"))
    ),
]


def path_points(trajectory: Trajectory, number: int, time_ns: int) -> PointCloud:
    """Positions of a path, thinned as its line is and in its colour."""
    color = PATH_COLORS[number % len(PATH_COLORS)]
    places = trajectory.position[thinned(len(trajectory))]
    return _cloud([(places, color)], trajectory.frame, time_ns)


def artifact_points(scene: SceneUpdate, time_ns: int) -> dict[str, PointCloud]:
    """Outlines and middles of what is in a scene but paths, one cloud a frame."""
    parts: dict[str, list[tuple[ArrayLike, Color]]] = {}
    for entity in scene.entities:
        if not entity.id.startswith(PATHS):
            parts.setdefault(entity.frame_id, []).extend(_parts(entity))
    return {frame: _cloud(found, frame, time_ns) for frame, found in parts.items() if found}


def _parts(entity: SceneEntity) -> Iterator[tuple[ArrayLike, Color]]:
    """Points (n, 3) in the entity's frame, and their colour; lines stand in it unturned."""
    solids: list[Any] = [*entity.cubes, *entity.spheres, *entity.cylinders]
    for solid in solids:
        place = solid.pose.position
        yield [(place.x, place.y, place.z)], solid.color
    for line in entity.lines:
        corners = np.array([(point.x, point.y, point.z) for point in line.points])
        if line.type == LinePrimitive.LINE_LOOP:
            corners = np.vstack([corners, corners[:1]])
        yield _along(corners), line.color


def _along(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points evenly along a line through ``corners``."""
    way = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1)))
    at = np.linspace(0.0, way[-1], POINTS_A_LINE)
    return np.column_stack([np.interp(at, way, values) for values in corners.T])


def _cloud(parts: list[tuple[ArrayLike, Color]], frame: str, time_ns: int) -> PointCloud:
    counts = [len(np.asarray(places)) for places, _ in parts]
    points = np.empty(sum(counts), _POINT)
    points["xyz"] = np.concatenate([np.asarray(places) for places, _ in parts])
    colors = np.array([(c.r, c.g, c.b, c.a) for _, c in parts])
    points["rgba"] = np.repeat(np.rint(255 * colors).astype(np.uint8), counts, axis=0)
    return PointCloud(
        timestamp=timestamp(time_ns),
        frame_id=frame,
        pose=Pose(position=Vector3(), orientation=Quaternion(w=1.0)),
        point_stride=_POINT.itemsize,
        fields=_FIELDS,
        data=points.tobytes(),
    )
