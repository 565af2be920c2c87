"""Shapes on the ground under a trajectory: sheets of dots, magnetic tags, landmarks, markers.

Each artifact is described once, as polylines, polygons, markers and arrows with a style and a name.
:mod:`locatk.formats.plots.picture` draws these shapes with matplotlib,
:mod:`locatk.formats.report.trajectory_map` with plotly.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from locatk.core.dots.sheet import Manifest
from locatk.core.geometry import Similarity
from locatk.core.landmarks.drawing.floor_bars import MIN_DRAWN_STRENGTH, bars_on_floor, cells_near
from locatk.core.landmarks.map.floor import Cell, FloorMap
from locatk.core.lighthouse.scene import Scene
from locatk.core.polaris import codec
from locatk.core.polaris.results import TagDetection
from locatk.core.polaris.tag import PlanarPose, Tags, as_built_magnets
from locatk.core.solution import Solution
from locatk.core.trajectory import Trajectory
from locatk.formats.sessions.foxglove import tags_in_frames

Array = NDArray[np.float64]

COLORS = (
    "#0072B2", "#D55E00", "#009E73", "#CA77A5", "#3A9BCE", "#785203", "#7F3C8D",
    "#012C44", "#8D59FF", "#610200", "#3F20CE", "#39017D", "#015449", "#4A7366",
    "#4D3164", "#650798", "#7E87FC", "#C227BB", "#89012B", "#9D658D", "#653DE9",
)  # fmt: skip
"""Colors of devices on a white background, with a contrast of at least 3 to 1.

The first are of the palette of Okabe and Ito (Color Universal Design, 2002) without yellow and
black, darkened as far as the contrast needs it, and a violet. Each of the others is the color with
the largest distance from all before it: in OKLab (Ottosson, 2020), for normal vision and, by the
model of Machado et al. (IEEE TVCG 15 (2009) 1291), for people who lack one type of cones.
"""

MAX_LEGEND_DEVICES = 8
"""Number of devices up to which a legend names all of them."""

MAX_DETECTION_DELAY_NS = 1_000_000_000
"""Time between a detection and the nearest pose up to which the detection is drawn on the path."""

SHEET_CORNERS = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
"""Corners of a sheet in units of its width and height."""


@dataclass(frozen=True)
class Style:
    """Look of a shape on a screen.

    Attributes
    ----------
    color : str
        Of lines and outlines, ``"#rrggbb"``.
    width_px : float
        Width of lines and outlines.
    fill : str
        Of polygons and markers; empty if they are not filled.
    fill_opacity : float
    dotted : bool
        Dotted instead of solid lines.
    symbol : {"circle", "square", "cross"}
        Of markers.
    size_px : float
        Size of markers.
    """

    color: str
    width_px: float = 1.0
    fill: str = ""
    fill_opacity: float = 1.0
    dotted: bool = False
    symbol: Literal["circle", "square", "cross"] = "circle"
    size_px: float = 0.0


TRUTH = Style("#8C8C8C", 4)
PAPER = Style("#8C8C8C", 1.4, fill="#FFFCF0")
DOT_PATTERN = Style("#8C8C8C", 1, fill="#78828C", fill_opacity=0.1, dotted=True)
MAGNET = Style("#333333", 2, fill="#FFFFFF", size_px=11)
DETECTED_MAGNET = Style("#D55E00", 1.5, fill="#FFFFFF", size_px=6)
NORTH_POLE = Style("#C0392B", 0.8, fill="#C0392B")
SOUTH_POLE = Style("#6384AE", 0.8, fill="#6384AE")
WEAK_BAR = Style("#8C8C8C", 0.8)
WALL = Style("#595959", 3)
DETECTION = Style("#009E73", 2, size_px=13)
REFUSED_DETECTION = Style("#7F3C8D", 2, symbol="cross", size_px=13)
MARKER = Style("#333333", 1.8, symbol="square", size_px=11)
STATION = Style("#333333", 1.8, fill="#333333", size_px=11)


@dataclass(frozen=True)
class Shape:
    """Several lines, polygons, markers or arrows of one style and meaning.

    Attributes
    ----------
    kind : {"line", "polygon", "marker", "arrow"}
    points : (m, k, 3) ndarray
        The m elements: k vertices of a line or polygon, one position of a marker, tail and tip of
        an arrow. Lines are interrupted at ``nan``.
    style : Style
    name : str
        Entry of the legend; empty if it has none. Shapes of one name share an entry.
    descriptions : tuple of str
        Of each marker, shown when it is pointed at; empty if there are none.
    """

    kind: Literal["line", "polygon", "marker", "arrow"]
    points: Array
    style: Style
    name: str = ""
    descriptions: tuple[str, ...] = ()


@dataclass(frozen=True)
class Label:
    """Text on the map.

    Attributes
    ----------
    text : str
    position : (3,) ndarray
    clearance : float
        Distance to the right of and above the position at which the text begins; 0 if the text is
        centred on the position.
    shift_px : float
        Upward shift on the screen.
    """

    text: str
    position: Array
    clearance: float = 0.0
    shift_px: float = 0.0


@dataclass(frozen=True)
class Drawing:
    """Shapes and labels in one frame and one unit.

    Attributes
    ----------
    shapes : tuple of Shape
        In the order in which they are drawn.
    labels : tuple of Label
    extent : (n, 3) ndarray
        Points that a view of the drawing must contain.
    """

    shapes: tuple[Shape, ...] = ()
    labels: tuple[Label, ...] = ()
    extent: Array = field(default_factory=lambda: np.zeros((0, 3)))

    def transformed(self, transform: Similarity) -> Drawing:
        """Return the drawing in another frame."""
        return Drawing(
            tuple(replace(shape, points=transform.apply(shape.points)) for shape in self.shapes),
            tuple(
                replace(
                    label,
                    position=transform.apply(label.position),
                    clearance=transform.scale * label.clearance,
                )
                for label in self.labels
            ),
            transform.apply(self.extent),
        )


def device_colors(names: Sequence[str]) -> dict[str, str]:
    """Return the color of each device, the same in all figures of a solution."""
    return {name: COLORS[k % len(COLORS)] for k, name in enumerate(names)}


def is_in_legend(index: int, devices: int, most: int = MAX_LEGEND_DEVICES) -> bool:
    """Return whether a legend of ``most`` entries names the device with this index."""
    return devices <= most or index < most - 1


def draw_artifact(solution: Solution) -> Drawing:
    """Return the sheets, tags or landmarks of a solution, in metres in the frame of the poses.

    The stations and markers of a Lighthouse scene are drawn by :func:`draw_markers` and
    :func:`locatk.formats.plots.ground.fit_view`, because they are visible from the side, too.
    """
    artifact = solution.artifact
    if isinstance(artifact, Manifest):
        return _draw_sheets(artifact, solution)
    if isinstance(artifact, Tags):
        return _draw_tags(artifact, solution)
    if isinstance(artifact, FloorMap):
        return _draw_floor(artifact, solution)
    return Drawing()


def draw_markers(scene: Scene) -> Drawing:
    """Return the markers of a Lighthouse scene."""
    if not scene.markers:
        return Drawing()
    position = np.array([marker.position for marker in scene.markers], float)
    names = tuple(marker.name for marker in scene.markers)
    shape = Shape("marker", position[:, None], MARKER, "marker", names)
    return Drawing((shape,), (), position)


def _on_ground(points: Any) -> Array:
    """Return points (..., 2) as (..., 3) at height 0."""
    points = np.asarray(points, float)
    return np.concatenate([points, np.zeros((*points.shape[:-1], 1))], axis=-1)


# ---- sheets of dots


def _draw_sheets(manifest: Manifest, solution: Solution) -> Drawing:
    """Draw the sheets in whose frames there are poses; all tiles of a floor share one frame."""
    frames = {t.frame for t in solution.trajectories}
    papers, patterns = [], []
    for index, sheet in enumerate(manifest.sheets):
        if manifest.frame(index) in frames:
            first_dot = np.array(sheet.origin, float)
            page = (SHEET_CORNERS * sheet.page_mm - sheet.first_mm) / manifest.pitch_mm
            dots = SHEET_CORNERS * (np.array(sheet.size) - 1)
            papers.append(manifest.to_metres(index, first_dot + page))
            patterns.append(manifest.to_metres(index, first_dot + dots))
    if not papers:
        return Drawing()
    paper = _on_ground(papers)
    shapes = (
        Shape("polygon", paper, PAPER, "paper"),
        Shape("polygon", _on_ground(patterns), DOT_PATTERN, "dot pattern"),
    )
    return Drawing(shapes, (), paper.reshape(-1, 3))


# ---- magnetic tags


def _draw_tags(tags: Tags, solution: Solution) -> Drawing:
    """Draw the magnets of the tags with known pose, as built and as detected."""
    arrow_m = tags.spacing_m / 3
    nominal, detected, labels = [], [], []
    nominal_names: list[str] = []
    detected_names: list[str] = []
    for number, _, pose in tags_in_frames(tags, solution.trajectories):
        name = f"tag {number}"
        position, angle = as_built_magnets(tags, number, codec.layout_of(tags, number))
        arrows = _arrows(position, angle, arrow_m, pose)
        nominal.append(arrows)
        nominal_names += [f"magnet of {name}"] * len(arrows)
        for detection in solution.detections:
            if detection.tag_id == number:
                detected.append(_detected_arrows(detection, arrow_m, pose))
                detected_names += [f"detected magnet of {name}"] * len(detected[-1])
        below = np.array([arrows[:, 0, 0].mean(), arrows[:, 0, 1].min(), 0.0])
        labels.append(Label(name, below, shift_px=-18))
    # Detected magnets are smaller and drawn later, so that the nominal ones remain visible.
    shapes = (
        *_magnet_shapes(nominal, MAGNET, "magnet", nominal_names),
        *_magnet_shapes(detected, DETECTED_MAGNET, "detected magnet", detected_names),
    )
    extent = np.concatenate(nominal).reshape(-1, 3) if nominal else np.zeros((0, 3))
    return Drawing(shapes, tuple(labels), extent)


def _arrows(position: Array, angle: Array, length_m: float, pose: PlanarPose) -> Array:
    """Return tails and tips (m, 2, 3) of magnets given in a frame that has this pose."""
    c, s = np.cos(pose.heading_rad), np.sin(pose.heading_rad)
    tail = position @ np.array([[c, s], [-s, c]]) + [pose.x_m, pose.y_m]
    heading = angle + pose.heading_rad
    tip = tail + length_m * np.column_stack([np.cos(heading), np.sin(heading)])
    return _on_ground(np.stack([tail, tip], axis=1))


def _detected_arrows(detection: TagDetection, length_m: float, pose: PlanarPose) -> Array:
    """Return the arrows of detected magnets, which are given in the frame of the array."""
    array = detection.array_pose
    assert array is not None  # An identified tag has a pose.
    position = np.array([[magnet.x_m, magnet.y_m] for magnet in detection.magnets])
    angle = np.array([magnet.angle_rad for magnet in detection.magnets])
    array_pose = PlanarPose(array.x_m, array.y_m, array.heading_rad)
    in_tag = _arrows(position, angle, length_m, array_pose)
    return _arrows(in_tag[:, 0, :2], angle + array.heading_rad, length_m, pose)


def _magnet_shapes(
    arrows: Sequence[Array], style: Style, name: str, descriptions: Sequence[str]
) -> tuple[Shape, ...]:
    if not arrows:
        return ()
    points = np.concatenate(arrows)
    circles = Shape("marker", points[:, :1], style, name, tuple(descriptions))
    return Shape("arrow", points, style), circles


# ---- floors of landmarks


def _draw_floor(floor: FloorMap, solution: Solution) -> Drawing:
    """Draw the bars of landmarks, walls, and the robots' positions at detections."""
    cells = cells_near(floor, [t.position for t in solution.trajectories])
    radius_m = floor.geometry.radius_m + floor.geometry.bar_width_m / 2
    centres = _on_ground(np.array([floor.position(cell) for cell in cells]).reshape(-1, 2))
    detected = {detection.cell for detection in solution.detections}
    is_detected = np.array([cell in detected for cell in cells], bool)
    # The view contains the detected landmarks; without any, all of them.
    shown = centres[is_detected] if is_detected.any() else centres
    offsets = radius_m * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
    return Drawing(
        (*_wall_shapes(floor), *_bar_shapes(floor, cells), *_detection_shapes(floor, solution)),
        tuple(
            Label(f"{row},{column}", centre, radius_m)
            for (row, column), centre in zip(cells, centres, strict=True)
        ),
        (shown[:, None] + offsets).reshape(-1, 3),
    )


def _bar_shapes(floor: FloorMap, cells: Sequence[Cell]) -> Iterator[Shape]:
    """Yield the south and north halves of bars, and the outlines of weak ones."""
    if not cells:
        return
    bars = [bars_on_floor(floor, cell) for cell in cells]
    centre, heading, strength = (np.concatenate(each) for each in zip(*bars, strict=True))
    is_weak = ~(np.abs(strength) >= MIN_DRAWN_STRENGTH)  # An unknown strength is nan.
    direction = np.column_stack([np.cos(heading), np.sin(heading)])
    along = direction * floor.geometry.bar_length_m / 2
    across = direction[:, ::-1] * [-1, 1] * floor.geometry.bar_width_m / 2
    for start, stop, selected, style, name in (
        (centre - along, centre, ~is_weak, SOUTH_POLE, "south pole"),
        (centre, centre + along, ~is_weak, NORTH_POLE, "north pole"),
        (centre - along, centre + along, is_weak, WEAK_BAR, "weak or missing"),
    ):
        if selected.any():
            corners = [start - across, stop - across, stop + across, start + across]
            yield Shape("polygon", _on_ground(np.stack(corners, axis=1)[selected]), style, name)


def _wall_shapes(floor: FloorMap) -> Iterator[Shape]:
    """Yield the walls, each perpendicular to the line between the two cells that it separates."""
    ends = []
    for first, second in sorted(floor.walls):
        a, b = np.array(floor.position(first)), np.array(floor.position(second))
        across = (b - a)[::-1] * [-1, 1] / 2
        ends.append([(a + b) / 2 - across, (a + b) / 2 + across])
    if ends:
        yield Shape("line", _on_ground(ends), WALL, "wall")


def _detection_shapes(floor: FloorMap, solution: Solution) -> Iterator[Shape]:
    """Yield the robots' positions at their detections of landmarks, used and refused ones."""
    paths = {t.device: t for t in solution.trajectories if len(t)}
    used: list[Array] = []
    refused: list[Array] = []
    for detection in solution.detections:
        position = _position_at(paths.get(detection.device), detection.time_s)
        if position is None and detection.cell is not None and detection.x_m is not None:
            position = np.array(floor.position(detection.cell)) + [detection.x_m, detection.y_m]
        if position is not None:
            (refused if detection.refused else used).append(position)
    for positions, style, name in (
        (used, DETECTION, "landmark detected"),
        (refused, REFUSED_DETECTION, "detection refused"),
    ):
        if positions:
            points = _on_ground(np.array(positions))[:, None]
            yield Shape("marker", points, style, name, (name,) * len(points))


def _position_at(path: Trajectory | None, time_s: float) -> Array | None:
    """Return the position (2,) of the nearest pose, None if none is near in time."""
    if path is None or not math.isfinite(time_s):
        return None
    delay_ns = np.abs(path.time_ns - round(1e9 * time_s))
    nearest = int(np.argmin(delay_ns))
    return path.position[nearest, :2] if delay_ns[nearest] <= MAX_DETECTION_DELAY_NS else None
