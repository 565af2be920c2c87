"""Foxglove messages: what Foxglove, Lichtblick and Rerun draw without being told how."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from foxglove_schemas_protobuf.ArrowPrimitive_pb2 import ArrowPrimitive
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.CubePrimitive_pb2 import CubePrimitive
from foxglove_schemas_protobuf.CylinderPrimitive_pb2 import CylinderPrimitive
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.KeyValuePair_pb2 import KeyValuePair
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.Point3_pb2 import Point3
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.SpherePrimitive_pb2 import SpherePrimitive
from foxglove_schemas_protobuf.TextPrimitive_pb2 import TextPrimitive
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.message import Message
from numpy.typing import NDArray

from locatk.core.dots.sheet import Manifest
from locatk.core.geometry import quaternion_from_heading, quaternion_from_matrix
from locatk.core.landmarks.landmark import name
from locatk.core.landmarks.map.floor import Cell, FloorMap
from locatk.core.lighthouse.scene import Marker, Scene, Station
from locatk.core.polaris import codec
from locatk.core.polaris.tag import PlanarPose, Tags, as_built_magnets, cell_positions, vertices
from locatk.core.trajectory import Trajectory
from locatk.formats.plots.floor_bars import MIN_BAR_STRENGTH, bars_on_floor, cells_near
from locatk.formats.sessions.messages import timestamp
from locatk.formats.sessions.reader import Session

LONGEST_PATH = 5000
"""Most points of a path that is drawn as one line; longer ones are thinned evenly."""

STATION_COLOR = Color(r=0.15, g=0.35, b=0.75, a=1.0)
MARKER_COLOR = Color(r=0.85, g=0.25, b=0.2, a=1.0)
PAPER_COLOR = Color(r=0.35, g=0.35, b=0.35, a=1.0)
PATTERN_COLOR = Color(r=0.6, g=0.6, b=0.6, a=1.0)
MAGNET_COLOR = Color(r=0.75, g=0.15, b=0.15, a=1.0)
BAR_COLORS = {1: Color(r=0.75, g=0.15, b=0.15, a=1.0), -1: Color(r=0.15, g=0.35, b=0.75, a=1.0)}
"""Of a bar that is N, and of one that is S."""
WEAK_COLOR = Color(r=0.6, g=0.6, b=0.6, a=0.4)
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
"""Okabe and Ito's colours, told apart by the colour-blind too."""

Timed = tuple[int, str, Message]


def poses(topic: str, trajectory: Trajectory) -> Iterator[Timed]:
    """One ``PoseInFrame`` a pose."""
    for time_ns, pose in _stamped(trajectory):
        message = PoseInFrame(timestamp=timestamp(time_ns), frame_id=trajectory.frame, pose=pose)
        yield time_ns, topic, message


def transforms(topic: str, trajectory: Trajectory) -> Iterator[Timed]:
    """One ``FrameTransform`` a pose: the device's frame in the trajectory's."""
    for time_ns, pose in _stamped(trajectory):
        message = FrameTransform(
            timestamp=timestamp(time_ns),
            parent_frame_id=trajectory.frame,
            child_frame_id=child_frame(trajectory),
            translation=_vector(pose.position.x, pose.position.y, pose.position.z),
            rotation=pose.orientation,
        )
        yield time_ns, topic, message


def child_frame(trajectory: Trajectory) -> str:
    """Name of the device's own frame: the device's, unless the poses' frame has that name."""
    return trajectory.device + ("_body" if trajectory.device == trajectory.frame else "")


def path(trajectory: Trajectory, time_ns: int) -> PosesInFrame:
    """The whole path in one message, at most :data:`LONGEST_PATH` poses of it."""
    keep = thinned(len(trajectory))
    return PosesInFrame(
        timestamp=timestamp(time_ns),
        frame_id=trajectory.frame,
        poses=[
            _pose(p, q)
            for p, q in zip(
                trajectory.position[keep].tolist(),
                trajectory.quaternion[keep].tolist(),
                strict=True,
            )
        ],
    )


def log(message: str, time_ns: int, *, warning: bool = False) -> Log:
    """A line for the log panel."""
    level = Log.WARNING if warning else Log.INFO
    return Log(timestamp=timestamp(time_ns), level=level, message=message, name="locatk")


def scene_update(artifact: object, trajectories: Sequence[Trajectory], time_ns: int) -> SceneUpdate:
    """Stations and markers, sheets of paper, tags, or landmarks, and paths as things to look at.

    Sizes are in the units of the scene, which has 0.1 m stations where its scale is
    metric; sheets, tags and landmarks are in metres. An artifact of another kind is not drawn.
    """
    entities = []
    if isinstance(artifact, Scene):
        entities += [_station(station, artifact, time_ns) for station in artifact.stations]
        entities += [_marker(marker, artifact, time_ns) for marker in artifact.markers]
    elif isinstance(artifact, Manifest):
        sheets = range(len(artifact.sheets))
        entities += [_sheet(artifact, number, time_ns) for number in sheets]
    elif isinstance(artifact, Tags):
        found = tags_in_frames(artifact, trajectories)
        entities += [_tag(artifact, *where, time_ns) for where in found]
    elif isinstance(artifact, FloorMap):
        near = cells_near(artifact, [t.position for t in trajectories])
        entities += [_landmark(artifact, cell, time_ns) for cell in near]
    for number, trajectory in enumerate(trajectories):
        if len(trajectory) > 0:
            color = PATH_COLORS[number % len(PATH_COLORS)]
            entities.append(_line(trajectory, color, time_ns))
    return SceneUpdate(entities=entities)


def tags_in_frames(
    tags: Tags, trajectories: Sequence[Trajectory]
) -> list[tuple[int, str, PlanarPose]]:
    """Ids of the tags whose place is known, the frame of that place, and the place.

    Those of the site; where there is none, the tags in whose frames there are poses.
    """
    if tags.site:
        return [(number, "site", placed) for number, placed in sorted(tags.site.items())]
    frames = sorted({t.frame for t in trajectories})
    numbers = [(frame.removeprefix("tag-"), frame) for frame in frames if frame[:4] == "tag-"]
    return [(int(n), frame, PlanarPose(0.0, 0.0, 0.0)) for n, frame in numbers if n.isdecimal()]


def trajectory(session: Session, topic: str, device: str) -> Trajectory:
    """Poses of a ``PoseInFrame`` topic of any tool, in the order of their own times.

    The covariance is unknown. Where a message has no time of its own, its log time
    is taken.
    """
    times: list[int] = []
    rows: list[tuple[float, ...]] = []
    frame = ""
    for log_ns, message in session.decoded(topic, PoseInFrame):
        stamp, p, q = message.timestamp, message.pose.position, message.pose.orientation
        own_ns = stamp.seconds * 1_000_000_000 + stamp.nanos
        times.append(own_ns if message.HasField("timestamp") else log_ns)
        rows.append((p.x, p.y, p.z, q.x, q.y, q.z, q.w))
        frame = frame or message.frame_id
    table = np.array(rows, np.float64).reshape(-1, 7)
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


def _stamped(trajectory: Trajectory) -> Iterator[tuple[int, Pose]]:
    rows = zip(
        trajectory.time_ns.tolist(),
        trajectory.position.tolist(),
        trajectory.quaternion.tolist(),
        strict=True,
    )
    for time_ns, position, quaternion in rows:
        yield time_ns, _pose(position, quaternion)


def _pose(position: Sequence[float], quaternion: Sequence[float]) -> Pose:
    x, y, z, w = quaternion
    return Pose(position=_vector(*position), orientation=Quaternion(x=x, y=y, z=z, w=w))


def _vector(x: float, y: float, z: float) -> Vector3:
    return Vector3(x=x, y=y, z=z)


def thinned(n: int) -> NDArray[np.int64]:
    """Which of n poses are drawn."""
    return np.unique(np.linspace(0, n - 1, min(n, LONGEST_PATH)).round().astype(np.int64))


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
    """Rims of the paper and of the pattern on it."""
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


def _tag(tags: Tags, tag_id: int, frame: str, placed: PlanarPose, time_ns: int) -> SceneEntity:
    """The magnets, each with an arrow in its direction, in the rim of the grid."""
    place, angle = as_built_magnets(tags, tag_id, codec.layout_of(tags, tag_id))
    c, s = np.cos(placed.heading_rad), np.sin(placed.heading_rad)
    turn, origin = np.array([[c, -s], [s, c]]), np.array([placed.x_m, placed.y_m])
    corners = cell_positions(tags, vertices(tags.order)) @ turn.T + origin
    headings = quaternion_from_heading(angle + placed.heading_rad).tolist()
    magnet, length = tags.magnet, tags.spacing_m / 3
    poses = [
        _pose((x, y, 0.0), quaternion)
        for (x, y), quaternion in zip((place @ turn.T + origin).tolist(), headings, strict=True)
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
    """The bars, each with an arrow to its north pole, and the cell's row and column."""
    geometry = floor.geometry
    middles, headings, strengths = bars_on_floor(floor, cell)
    length, width, height = geometry.bar_length_m, geometry.bar_width_m, geometry.bar_height_m
    cubes, arrows = [], []
    for (x, y), quaternion, heading, strength in zip(
        middles.tolist(),
        quaternion_from_heading(headings).tolist(),
        headings.tolist(),
        strengths.tolist(),
        strict=True,
    ):
        there = abs(strength) >= MIN_BAR_STRENGTH
        color = BAR_COLORS[1 if strength > 0 else -1] if there else WEAK_COLOR
        # The map's plane is that of the bars' tops.
        below = _pose((x, y, -height / 2), quaternion)
        cubes.append(CubePrimitive(pose=below, size=_vector(length, width, height), color=color))
        if there:
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
    points = trajectory.position[thinned(len(trajectory))].tolist()
    return SceneEntity(
        timestamp=timestamp(time_ns),
        frame_id=trajectory.frame,
        id=f"path/{trajectory.device}",
        metadata=_pairs({"device": trajectory.device, "poses": str(len(trajectory))}),
        lines=[
            LinePrimitive(
                type=LinePrimitive.LINE_STRIP,
                pose=_pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)),
                thickness=2.0,
                scale_invariant=True,
                points=[Point3(x=x, y=y, z=z) for x, y, z in points],
                color=color,
            )
        ],
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
