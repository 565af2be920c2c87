"""Foxglove messages, which Foxglove, Lichtblick and Rerun draw without configuration.

Rerun does not know ``foxglove.SceneUpdate``, and opens no 3D view for poses and transforms alone
(0.41; https://rerun.io/docs/howto/logging-and-ingestion/mcap). It opens one for a point cloud,
hence paths and artifacts are written as point clouds too.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.ArrowPrimitive_pb2 import ArrowPrimitive
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.CubePrimitive_pb2 import CubePrimitive
from foxglove_schemas_protobuf.CylinderPrimitive_pb2 import CylinderPrimitive
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.KeyValuePair_pb2 import KeyValuePair
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.Point3_pb2 import Point3
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.SpherePrimitive_pb2 import SpherePrimitive
from foxglove_schemas_protobuf.TextPrimitive_pb2 import TextPrimitive
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from numpy.typing import ArrayLike, NDArray

from locatk.core.dots.sheet import Manifest
from locatk.core.geometry import quaternion_from_heading, quaternion_from_matrix
from locatk.core.landmarks.drawing.floor_bars import (
    MIN_DRAWN_STRENGTH,
    bars_on_floor,
    cells_near,
)
from locatk.core.landmarks.landmark import name
from locatk.core.landmarks.map.floor import Cell, FloorMap
from locatk.core.lighthouse.scene import Marker, Scene, Station
from locatk.core.polaris import codec
from locatk.core.polaris.tag import PlanarPose, Tags, as_built_magnets, cell_positions, vertices
from locatk.core.trajectory import Trajectory
from locatk.formats.sessions.mcap_file import MAX_TIME_NS
from locatk.formats.sessions.messages import MessageBatch, timestamp
from locatk.formats.sessions.protobuf_rows import (
    Rows,
    double_fields,
    encode_message,
    message_field,
    text_field,
    timestamp_field,
)
from locatk.formats.sessions.reader import Session, time_error

MAX_PATH_POINTS = 5000
"""Number of points of a path that is drawn as one line; longer paths are thinned evenly."""

POSES_PER_BLOCK = 2048
"""Number of poses that are encoded at once: few enough for the cache of a processor."""

POINTS_PER_LINE = 400
"""Number of points of an outline in a point cloud."""

STATION_COLOR = Color(r=0.15, g=0.35, b=0.75, a=1.0)
MARKER_COLOR = Color(r=0.85, g=0.25, b=0.2, a=1.0)
PAPER_COLOR = Color(r=0.35, g=0.35, b=0.35, a=1.0)
PATTERN_COLOR = Color(r=0.6, g=0.6, b=0.6, a=1.0)
MAGNET_COLOR = Color(r=0.75, g=0.15, b=0.15, a=1.0)
BAR_COLORS = {1: Color(r=0.75, g=0.15, b=0.15, a=1.0), -1: Color(r=0.15, g=0.35, b=0.75, a=1.0)}
"""Colours of bars with the north pole (1) or the south pole (-1) outside."""
MISSING_COLOR = Color(r=0.6, g=0.6, b=0.6, a=0.4)
TEXT_COLOR = Color(r=0.5, g=0.5, b=0.5, a=1.0)
PATH_COLORS = tuple(
    Color(r=r, g=g, b=b, a=1.0)
    for r, g, b in (
        (0.0, 0.45, 0.7),
        (0.9, 0.6, 0.0),
        (0.0, 0.6, 0.5),
        (0.8, 0.4, 0.0),
        (0.8, 0.6, 0.7),
        (0.35, 0.7, 0.9),
    )
)
"""Okabe and Ito's colours, which colour-blind people can distinguish
(https://jfly.uni-koeln.de/color/)."""

_PATH_PREFIX = "path/"
"""Prefix of the ids of the entities that are no artifact."""

_POINT = np.dtype([("xyz", "<f4", (3,)), ("rgba", "u1", (4,))])
_POINT_FIELDS = [
    *(
        PackedElementField(name=name, offset=4 * i, type=PackedElementField.FLOAT32)
        for i, name in enumerate("xyz")
    ),
    *(
        PackedElementField(name=name, offset=12 + i, type=PackedElementField.UINT8)
        for i, name in enumerate(("red", "green", "blue", "alpha"))
    ),
]

# ---- poses


def poses(topic: str, trajectory: Trajectory) -> Iterator[MessageBatch]:
    """Yield one ``PoseInFrame`` per pose."""
    for time_ns, position, quaternion in _blocks(trajectory):
        rows = encode_message(
            [
                timestamp_field(1, time_ns),
                text_field(2, trajectory.frame, len(time_ns)),
                message_field(3, _pose_fields(position, quaternion)),
            ]
        )
        yield MessageBatch(topic, PoseInFrame, time_ns, rows.split())


def transforms(topic: str, trajectory: Trajectory) -> Iterator[MessageBatch]:
    """Yield one ``FrameTransform`` per pose, from the trajectory's frame to the device's."""
    for time_ns, position, quaternion in _blocks(trajectory):
        rows = encode_message(
            [
                timestamp_field(1, time_ns),
                text_field(2, trajectory.frame, len(time_ns)),
                text_field(3, child_frame(trajectory.device, trajectory.frame), len(time_ns)),
                message_field(4, [double_fields(1, position)]),
                message_field(5, [double_fields(1, quaternion)]),
            ]
        )
        yield MessageBatch(topic, FrameTransform, time_ns, rows.split())


def _blocks(
    trajectory: Trajectory,
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]]:
    """Yield times, positions and quaternions of the poses that are encoded at once."""
    for start in range(0, len(trajectory), POSES_PER_BLOCK):
        part = slice(start, start + POSES_PER_BLOCK)
        yield trajectory.time_ns[part], trajectory.position[part], trajectory.quaternion[part]


def _pose_fields(position: NDArray[np.float64], quaternion: NDArray[np.float64]) -> list[Rows]:
    """Return the fields of a ``Pose``."""
    return [
        message_field(1, [double_fields(1, position)]),
        message_field(2, [double_fields(1, quaternion)]),
    ]


def child_frame(device: str, frame: str) -> str:
    """Return the name of the device's own frame: its name, unless the poses' frame has it."""
    return device + ("_body" if device == frame else "")


def path(trajectory: Trajectory, time_ns: int) -> PosesInFrame:
    """Return the path in one message, thinned to :data:`MAX_PATH_POINTS` poses."""
    keep = _thinned_indices(len(trajectory))
    fields = _pose_fields(trajectory.position[keep], trajectory.quaternion[keep])
    message = PosesInFrame.FromString(message_field(3, fields).joined())
    message.timestamp.CopyFrom(timestamp(time_ns))
    message.frame_id = trajectory.frame
    return message


def log(message: str, time_ns: int, *, warning: bool = False) -> Log:
    """Return a line for the log panel."""
    level = Log.WARNING if warning else Log.INFO
    return Log(timestamp=timestamp(time_ns), level=level, message=message, name="locatk")


# ---- scenes


def scene_update(artifact: object, trajectories: Sequence[Trajectory], time_ns: int) -> SceneUpdate:
    """Return the artifact of a solution and its paths as a 3D scene.

    Artifacts are the stations and markers of a :class:`Scene`, sheets of paper, tags, or
    landmarks; other kinds are not drawn. Sizes are in the units of the scene, whose stations
    measure 0.1 m if its scale is metric; sheets, tags and landmarks are in metres.
    """
    entities = []
    if isinstance(artifact, Scene):
        entities += [_station(station, artifact, time_ns) for station in artifact.stations]
        entities += [_marker(marker, artifact, time_ns) for marker in artifact.markers]
    elif isinstance(artifact, Manifest):
        sheets = range(len(artifact.sheets))
        entities += [_sheet(artifact, number, time_ns) for number in sheets]
    elif isinstance(artifact, Tags):
        visible_tags = tags_in_frames(artifact, trajectories)
        entities += [_tag(artifact, *tag, time_ns) for tag in visible_tags]
    elif isinstance(artifact, FloorMap):
        cells = cells_near(artifact, [t.position for t in trajectories])
        entities += [_landmark(artifact, cell, time_ns) for cell in cells]
    for number, trajectory in enumerate(trajectories):
        if len(trajectory) > 0:
            color = PATH_COLORS[number % len(PATH_COLORS)]
            entities.append(_line(trajectory, color, time_ns))
    return SceneUpdate(entities=entities)


def is_path(entity: SceneEntity) -> bool:
    """Return whether an entity of a scene is a path, and not a part of the artifact."""
    return bool(entity.id.startswith(_PATH_PREFIX))


def tags_in_frames(
    tags: Tags, trajectories: Sequence[Trajectory]
) -> list[tuple[int, str, PlanarPose]]:
    """Return id, frame and pose in this frame of each tag whose pose is known.

    These are the tags of the site; without a site, the tags whose frames contain poses.
    """
    if tags.site:
        return [(number, "site", pose) for number, pose in sorted(tags.site.items())]
    frames = sorted({t.frame for t in trajectories})
    numbers = [(frame.removeprefix("tag-"), frame) for frame in frames if frame[:4] == "tag-"]
    return [(int(n), frame, PlanarPose(0.0, 0.0, 0.0)) for n, frame in numbers if n.isdecimal()]


def read_trajectory(session: Session, topic: str, device: str) -> Trajectory:
    """Read the poses of a ``PoseInFrame`` topic of any tool, in the order of their timestamps.

    The covariance is unknown. The log time replaces the timestamp of messages without one.
    """
    times: list[int] = []
    rows: list[tuple[float, ...]] = []
    frame = ""
    for log_ns, message in session.decoded(topic, PoseInFrame):
        stamp, p, q = message.timestamp, message.pose.position, message.pose.orientation
        stamp_ns = stamp.seconds * 1_000_000_000 + stamp.nanos
        times.append(stamp_ns if message.HasField("timestamp") else log_ns)
        rows.append((p.x, p.y, p.z, q.x, q.y, q.z, q.w))
        frame = frame or message.frame_id
    table = np.array(rows, np.float64).reshape(-1, 7)
    last_ns = max(map(abs, times), default=0)
    if last_ns > MAX_TIME_NS:
        raise time_error(session.path, topic, last_ns)
    time_ns = np.array(times, np.int64)
    order = np.argsort(time_ns, kind="stable")
    return Trajectory(
        device,
        frame,
        time_ns[order],
        table[order, :3],
        table[order, 3:],
        np.full((len(times), 6, 6), np.nan),
    )


def _pose(position: Sequence[float], quaternion: Sequence[float]) -> Pose:
    x, y, z, w = quaternion
    return Pose(position=_vector(*position), orientation=Quaternion(x=x, y=y, z=z, w=w))


def _vector(x: float, y: float, z: float) -> Vector3:
    return Vector3(x=x, y=y, z=z)


def _thinned_indices(n: int) -> NDArray[np.int64]:
    """Return the indices of the poses that are drawn, of n poses."""
    return np.unique(np.linspace(0, n - 1, min(n, MAX_PATH_POINTS)).round().astype(np.int64))


def _station(station: Station, scene: Scene, time_ns: int) -> SceneEntity:
    position = station.position.tolist()
    pose = _pose(position, quaternion_from_matrix(station.rotation).tolist())
    label = f"station {station.channel}"
    facts = {"channel": str(station.channel), "calibration": station.calibration.source}
    if station.id is not None:
        facts["id"] = f"{station.id:08x}"
        label += f" ({station.id:08x})"
    return SceneEntity(
        timestamp=timestamp(time_ns),
        frame_id=scene.frame,
        id=f"station/{station.channel}",
        metadata=_pairs(facts),
        cubes=[CubePrimitive(pose=pose, size=_vector(0.07, 0.1, 0.1), color=STATION_COLOR)],
        arrows=[
            ArrowPrimitive(
                pose=pose,
                shaft_length=0.25,
                shaft_diameter=0.02,
                head_length=0.08,
                head_diameter=0.05,
                color=STATION_COLOR,
            )
        ],
        texts=[_text(label, position, 0.12)],
    )


def _marker(marker: Marker, scene: Scene, time_ns: int) -> SceneEntity:
    position = marker.position.tolist()
    pose = _pose(position, (0.0, 0.0, 0.0, 1.0))
    size = 0.02
    return SceneEntity(
        timestamp=timestamp(time_ns),
        frame_id=scene.frame,
        id=f"marker/{marker.name}",
        spheres=[SpherePrimitive(pose=pose, size=_vector(size, size, size), color=MARKER_COLOR)],
        texts=[_text(marker.name, position, 0.04)],
    )


def _sheet(manifest: Manifest, number: int, time_ns: int) -> SceneEntity:
    """Return the outlines of the paper and of the pattern on it."""
    sheet = manifest.sheets[number]
    origin, first = np.array(sheet.origin, float), np.array(sheet.first_mm)
    unit = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    paper = origin + (unit * sheet.page_mm - first) / manifest.pitch_mm
    pattern = origin + unit * (np.array(sheet.size) - 1)
    corners = manifest.to_metres(number, paper)
    return SceneEntity(
        timestamp=timestamp(time_ns),
        frame_id=manifest.frame(number),
        id=f"sheet/{sheet.id}",
        metadata=_pairs({"id": sheet.id, "codec": manifest.codec}),
        lines=[
            _loop(corners, PAPER_COLOR, 2.0),
            _loop(manifest.to_metres(number, pattern), PATTERN_COLOR, 1.0),
        ],
        texts=[_text(sheet.id, (*corners[0].tolist(), 0.0), 0.0)],
    )


def _tag(tags: Tags, tag_id: int, frame: str, tag_pose: PlanarPose, time_ns: int) -> SceneEntity:
    """Return the magnets, each with an arrow in its direction, and the outline of the grid."""
    positions, angles = as_built_magnets(tags, tag_id, codec.layout_of(tags, tag_id))
    c, s = np.cos(tag_pose.heading_rad), np.sin(tag_pose.heading_rad)
    rotation, origin = np.array([[c, -s], [s, c]]), np.array([tag_pose.x_m, tag_pose.y_m])
    corners = cell_positions(tags, vertices(tags.order)) @ rotation.T + origin
    positions = positions @ rotation.T + origin
    quaternions = quaternion_from_heading(angles + tag_pose.heading_rad)
    magnet, length = tags.magnet, tags.spacing_m / 3
    poses = [
        _pose((x, y, 0.0), quaternion)
        for (x, y), quaternion in zip(positions.tolist(), quaternions.tolist(), strict=True)
    ]
    size = _vector(magnet.diameter_m, magnet.diameter_m, magnet.height_m)
    return SceneEntity(
        timestamp=timestamp(time_ns),
        frame_id=frame,
        id=f"tag/{tag_id}",
        metadata=_pairs({"id": str(tag_id), "codec": tags.codec}),
        cylinders=[
            CylinderPrimitive(
                pose=pose, size=size, bottom_scale=1.0, top_scale=1.0, color=MAGNET_COLOR
            )
            for pose in poses
        ],
        arrows=[
            ArrowPrimitive(
                pose=pose,
                shaft_length=0.7 * length,
                shaft_diameter=0.08 * length,
                head_length=0.3 * length,
                head_diameter=0.2 * length,
                color=MAGNET_COLOR,
            )
            for pose in poses
        ],
        lines=[_loop(corners, PATTERN_COLOR, 1.0)],
        texts=[_text(f"tag {tag_id}", (*corners[0].tolist(), 0.0), 0.0)],
    )


def _landmark(floor: FloorMap, cell: Cell, time_ns: int) -> SceneEntity:
    """Return the bars, each with an arrow to its north pole, and the cell's row and column."""
    geometry = floor.geometry
    centres, headings, strengths = bars_on_floor(floor, cell)
    length, width, height = geometry.bar_length_m, geometry.bar_width_m, geometry.bar_height_m
    cubes, arrows = [], []
    for (x, y), quaternion, heading, strength in zip(
        centres.tolist(),
        quaternion_from_heading(headings).tolist(),
        headings.tolist(),
        strengths.tolist(),
        strict=True,
    ):
        is_present = abs(strength) >= MIN_DRAWN_STRENGTH
        color = BAR_COLORS[1 if strength > 0 else -1] if is_present else MISSING_COLOR
        # The plane z = 0 of the map contains the top faces of the bars.
        pose = _pose((x, y, -height / 2), quaternion)
        cubes.append(CubePrimitive(pose=pose, size=_vector(length, width, height), color=color))
        if is_present:
            tail = x - length / 2 * np.cos(heading), y - length / 2 * np.sin(heading), width / 4
            arrows.append(
                ArrowPrimitive(
                    pose=_pose(tail, quaternion),
                    shaft_length=0.6 * length,
                    shaft_diameter=0.2 * width,
                    head_length=0.4 * length,
                    head_diameter=0.6 * width,
                    color=color,
                )
            )
    row, column = cell
    facts = {"cell": f"{row},{column}", "bars": name(int(floor.codes[cell]))}
    built = floor.built.get(cell)
    if built is not None and built.flags:
        facts["flags"] = ", ".join(built.flags)
    return SceneEntity(
        timestamp=timestamp(time_ns),
        frame_id="map",
        id=f"landmark/{row},{column}",
        metadata=_pairs(facts),
        cubes=cubes,
        arrows=arrows,
        texts=[_text(f"{row},{column}", (*floor.position(cell), 0.0), 0.0)],
    )


def _loop(corners: NDArray[np.float64], color: Color, thickness: float) -> LinePrimitive:
    return LinePrimitive(
        type=LinePrimitive.LINE_LOOP,
        pose=_pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)),
        thickness=thickness,
        scale_invariant=True,
        points=[Point3(x=x, y=y, z=0.0) for x, y in corners.tolist()],
        color=color,
    )


def _line(trajectory: Trajectory, color: Color, time_ns: int) -> SceneEntity:
    points = trajectory.position[_thinned_indices(len(trajectory))]
    line = LinePrimitive.FromString(message_field(5, [double_fields(1, points)]).joined())
    line.MergeFrom(
        LinePrimitive(
            type=LinePrimitive.LINE_STRIP,
            pose=_pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)),
            thickness=2.0,
            scale_invariant=True,
            color=color,
        )
    )
    return SceneEntity(
        timestamp=timestamp(time_ns),
        frame_id=trajectory.frame,
        id=f"{_PATH_PREFIX}{trajectory.device}",
        metadata=_pairs({"device": trajectory.device, "poses": str(len(trajectory))}),
        lines=[line],
    )


def _text(text: str, position: Sequence[float], above: float) -> TextPrimitive:
    x, y, z = position
    return TextPrimitive(
        pose=_pose((x, y, z + above), (0.0, 0.0, 0.0, 1.0)),
        billboard=True,
        font_size=14,
        scale_invariant=True,
        color=TEXT_COLOR,
        text=text,
    )


def _pairs(facts: Mapping[str, str]) -> list[KeyValuePair]:
    return [KeyValuePair(key=key, value=value) for key, value in facts.items()]


# ---- point clouds


def path_points(trajectory: Trajectory, number: int, time_ns: int) -> PointCloud:
    """Return the positions of path ``number``, thinned and coloured as its line in the scene."""
    color = PATH_COLORS[number % len(PATH_COLORS)]
    positions = trajectory.position[_thinned_indices(len(trajectory))]
    return _cloud([(positions, color)], trajectory.frame, time_ns)


def artifact_points(scene: SceneUpdate, time_ns: int) -> dict[str, PointCloud]:
    """Return outlines and centres of the entities of a scene except paths, one cloud per frame."""
    parts: dict[str, list[tuple[ArrayLike, Color]]] = {}
    for entity in scene.entities:
        if not is_path(entity):
            parts.setdefault(entity.frame_id, []).extend(_entity_points(entity))
    return {frame: _cloud(clouds, frame, time_ns) for frame, clouds in parts.items() if clouds}


def _entity_points(entity: SceneEntity) -> Iterator[tuple[ArrayLike, Color]]:
    """Yield points (n, 3) in the entity's frame and their colour; lines have an identity pose."""
    solids: list[Any] = [*entity.cubes, *entity.spheres, *entity.cylinders]
    for solid in solids:
        centre = solid.pose.position
        yield [(centre.x, centre.y, centre.z)], solid.color
    for line in entity.lines:
        corners = np.array([(point.x, point.y, point.z) for point in line.points])
        if line.type == LinePrimitive.LINE_LOOP:
            corners = np.vstack([corners, corners[:1]])
        yield _sample_line(corners), line.color


def _sample_line(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return evenly spaced points on the polyline through ``corners``."""
    lengths = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    path_length = np.append(0.0, np.cumsum(lengths))
    sampled = np.linspace(0.0, path_length[-1], POINTS_PER_LINE)
    return np.column_stack([np.interp(sampled, path_length, values) for values in corners.T])


def _cloud(parts: list[tuple[ArrayLike, Color]], frame: str, time_ns: int) -> PointCloud:
    counts = [len(np.asarray(positions)) for positions, _ in parts]
    points = np.empty(sum(counts), _POINT)
    points["xyz"] = np.concatenate([np.asarray(positions) for positions, _ in parts])
    colors = np.array([(c.r, c.g, c.b, c.a) for _, c in parts])
    points["rgba"] = np.repeat(np.rint(255 * colors).astype(np.uint8), counts, axis=0)
    return PointCloud(
        timestamp=timestamp(time_ns),
        frame_id=frame,
        pose=_pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)),
        point_stride=_POINT.itemsize,
        fields=_POINT_FIELDS,
        data=points.tobytes(),
    )
