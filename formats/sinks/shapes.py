"""Artifacts as simple shapes in JSON, for maps that a browser draws.

The shapes are those of reports (:mod:`locatk.formats.plots.shapes`). Their colors are names:
the colors depend on the scheme of the browser.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from locatk.core.dots.sheet import Manifest
from locatk.core.geometry import rotation_matrix_2d
from locatk.core.landmarks.landmark import name
from locatk.core.landmarks.map.floor import FloorMap
from locatk.core.lighthouse.scene import Scene
from locatk.core.polaris.tag import Tags, cell_positions, vertices
from locatk.core.solution import Solution
from locatk.core.trajectory import Trajectory
from locatk.formats.plots import shapes
from locatk.formats.plots.shapes import Drawing, Label, Shape, draw_artifact, draw_markers

STYLE_NAMES = {
    shapes.PAPER: "paper",
    shapes.DOT_PATTERN: "pattern",
    shapes.MAGNET: "magnet",
    shapes.NORTH_POLE: "north",
    shapes.SOUTH_POLE: "south",
    shapes.WEAK_BAR: "weak",
    shapes.WALL: "wall",
    shapes.MARKER: "marker",
    shapes.STATION: "station",
}
"""Names of the styles, which are variables of the page's CSS."""

DECIMALS = 5
"""Decimals of coordinates [m]: 10 micrometres."""


def find_artifact(artifacts: Mapping[str, Any]) -> Any:
    """Return the scene, sheets, tags or floor among the artifacts of a session, None without."""
    kinds = (Scene, Manifest, Tags, FloorMap)
    return next((each for each in artifacts.values() if isinstance(each, kinds)), None)


def artifact_frames(artifact: Any, used: Iterable[str] = ()) -> list[str]:
    """Return the frames in which there are drawings.

    Parameters
    ----------
    artifact : Scene, Manifest, Tags, FloorMap or None
    used : iterable of str
        Frames in which there are poses. Loose sheets and tags that are not on a site have a frame
        each; they are drawn as soon as a pose refers to them.
    """
    if isinstance(artifact, Scene):
        own = [artifact.frame]
    elif isinstance(artifact, FloorMap):
        own = ["map"]
    elif isinstance(artifact, Tags):
        own = ["site"] if artifact.site else []
    elif isinstance(artifact, Manifest):
        own = [artifact.frame(0)] if artifact.sheets else []
    else:
        own = []
    return list(dict.fromkeys([*own, *used]))


def artifact_to_json(artifact: Any, used_frames: Iterable[str] = ()) -> dict[str, Any]:
    """Return the drawing of an artifact as a dict for JSON.

    Returns
    -------
    dict
        ``unit`` is ``"m"``, or ``"unit"`` if the scene has no scale. ``frames`` has for each frame
        ``shapes`` and ``labels``. A shape has ``kind`` (``"line"``, ``"polygon"``, ``"marker"``,
        ``"arrow"`` or ``"station"``, whose two points are the position and the viewing direction),
        ``style`` (a value of :data:`STYLE_NAMES`, or ``"tag"``) and ``points`` (m elements of k
        points, (x, y) on the ground or (x, y, z)). A label has ``text`` and ``at``.
    """
    is_unscaled = isinstance(artifact, Scene) and artifact.scale == "unit"
    frames = {}
    for frame in artifact_frames(artifact, used_frames):
        drawing = _draw(artifact, frame)
        frames[frame] = {
            "shapes": [_shape_to_json(shape) for shape in drawing.shapes if shape.points.size],
            "labels": [
                {"text": label.text, "at": label.position.round(DECIMALS).tolist()}
                for label in drawing.labels
            ],
        }
        if isinstance(artifact, Tags) and frame == "site" and artifact.site:
            # Below the magnets.
            frames[frame]["shapes"][:0] = _tag_outlines(artifact)
        if isinstance(artifact, Scene) and frame == artifact.frame:
            frames[frame]["shapes"] += _stations(artifact)
            frames[frame]["labels"] += [
                {"text": _station_name(each), "at": each.position.round(DECIMALS).tolist()}
                for each in artifact.stations
            ]
    return {"unit": "unit" if is_unscaled else "m", "frames": frames}


def _draw(artifact: Any, frame: str) -> Drawing:
    """Draw what an artifact has in one frame."""
    if isinstance(artifact, Scene):
        if frame != artifact.frame:
            return Drawing()
        markers = draw_markers(artifact)
        labels = [Label(each.name, np.asarray(each.position, float)) for each in artifact.markers]
        return Drawing(markers.shapes, tuple(labels))
    if isinstance(artifact, FloorMap) and frame == "map":
        return _draw_floor(artifact)
    if isinstance(artifact, Manifest):
        drawing = draw_artifact(_solution_in(artifact, frame))
        return Drawing(drawing.shapes, tuple(_sheet_labels(artifact, frame)))
    if isinstance(artifact, Tags) and (frame == "site" or not artifact.site):
        drawing = draw_artifact(_solution_in(artifact, frame))
        meanings = {f"tag {number}": text for number, text in artifact.meanings.items()}
        labels = [
            Label(f"{each.text}: {meanings[each.text]}", each.position)
            if each.text in meanings
            else each
            for each in drawing.labels
        ]
        return Drawing(drawing.shapes, tuple(labels))
    return Drawing()


def _tag_outlines(tags: Tags) -> list[dict[str, Any]]:
    """Return the grids of the tags of a site, and markers for views in which they are too small."""
    # A little outside the outer cells, so that the outline does not run through the magnets.
    grid = 1.4 * cell_positions(tags, vertices(tags.order))
    centres = np.array([[[each.x_m, each.y_m]] for each in tags.site.values()])
    outlines = [
        grid @ rotation_matrix_2d(each.heading_rad).T + centre
        for each, centre in zip(tags.site.values(), centres, strict=True)
    ]
    polygons = np.array(outlines).round(DECIMALS).tolist()
    return [
        {"kind": "polygon", "style": "pattern", "points": polygons},
        {"kind": "marker", "style": "tag", "points": centres.round(DECIMALS).tolist()},
    ]


def _solution_in(artifact: Any, frame: str) -> Solution:
    """Return a solution without poses in a frame, in which the artifact is to be drawn."""
    no_poses = Trajectory.from_positions("", frame, np.zeros(0, np.int64), np.zeros((0, 3)))
    return Solution("", "", (no_poses,), artifact=artifact)


def _draw_floor(floor: FloorMap) -> Drawing:
    """Draw the landmarks with row, column and bars; large floors as their positions only."""
    drawing = draw_artifact(_solution_in(floor, "map"))
    if not drawing.labels:  # There are too many to draw each bar.
        cells = floor.cells()
        positions = np.array([[*floor.position(cell), 0.0] for cell in cells]).reshape(-1, 1, 3)
        centres = Shape("marker", positions, shapes.WEAK_BAR)
        return Drawing((*drawing.shapes, centres))
    labels = [
        Label(f"{cell[0]},{cell[1]} {name(int(floor.codes[cell]))}", label.position)
        for cell, label in zip(floor.cells(), drawing.labels, strict=True)
    ]
    return Drawing(drawing.shapes, tuple(labels))


def _sheet_labels(manifest: Manifest, frame: str) -> Iterable[Label]:
    """Yield the ids of the sheets of a frame, at the middle of the upper side of their patterns."""
    for number, sheet in enumerate(manifest.sheets):
        if manifest.frame(number) == frame:
            middle = np.array(sheet.origin) + [(sheet.size[0] - 1) / 2, 0]
            x, y = manifest.to_metres(number, middle).tolist()
            yield Label(sheet.id, np.array([x, y, 0.0]))


def _stations(scene: Scene) -> list[dict[str, Any]]:
    if not scene.stations:
        return []
    points = np.array([[each.position, each.rotation[:, 0]] for each in scene.stations])
    return [{"kind": "station", "style": "station", "points": points.round(DECIMALS).tolist()}]


def _station_name(station: Any) -> str:
    return f"station {station.channel}" + ("" if station.id is None else f" ({station.id:08x})")


def _shape_to_json(shape: Shape) -> dict[str, Any]:
    points = shape.points if shape.points[..., 2].any() else shape.points[..., :2]
    return {
        "kind": shape.kind,
        "style": STYLE_NAMES[shape.style],
        "points": points.round(DECIMALS).tolist(),
    }
