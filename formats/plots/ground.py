"""Trajectories and the artifact under them in one frame and unit, and the view that shows them.

Nothing is drawn here: :mod:`locatk.formats.plots.picture` (matplotlib) and
:mod:`locatk.formats.report.trajectory_map` (plotly) draw the same :class:`Ground`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.evaluation import Evaluation, evaluate
from locatk.core.geometry import Similarity
from locatk.core.lighthouse.scene import Scene, Station
from locatk.core.solution import Solution
from locatk.core.trajectory import Trajectory
from locatk.formats.plots.shapes import (
    STATION,
    Drawing,
    Label,
    Shape,
    draw_artifact,
    draw_markers,
)

Array = NDArray[np.float64]

MAX_STATION_DISTANCE_WIDTHS = 1.0
"""Distance from the trajectories, in widths of the view, up to which the view contains a station.
Farther stations are indicated by an arrow at the margin."""

MARGIN_FACTOR, LABEL_MARGIN_FACTOR = 1.12, 1.45
"""Ratio of the view to its contents, without and with labels of far stations at the margin."""

MIN_VIEW_WIDTH_M = 0.01
"""Least width of a view; a single pose has no extent."""

MAX_LABELS = 40
"""Number of labels in the view up to which they are written; more would overlap."""

POSITION_FORMATS = {"m": ".4f", "mm": ".3f", "unit": ".4f"}
"""Format of a coordinate in each unit."""


@dataclass(frozen=True)
class Ground:
    """All that a map shows, in one frame and one unit.

    Attributes
    ----------
    paths : dict of str to (n, 3) ndarray
        Positions of each device.
    times : dict of str to (n,) int64 ndarray
        Their stamps in ns.
    truth : tuple of Trajectory
    stations : tuple of Station
        Lighthouse base stations; empty for other systems.
    markers, artifact : Drawing
        Markers of a Lighthouse scene; sheets, tags or landmarks.
    unit : {"m", "mm", "unit"}
        Of all lengths; ``"unit"`` if the scene has no scale.
    transform : Similarity
        From the solution's frame into this one.
    """

    paths: dict[str, Array]
    times: dict[str, NDArray[np.int64]]
    truth: tuple[Trajectory, ...]
    stations: tuple[Station, ...]
    markers: Drawing
    artifact: Drawing
    unit: str
    transform: Similarity

    def scaled(self, factor: float, unit: str) -> Ground:
        """Return the same in another unit."""
        scaling = Similarity(factor, np.eye(3), np.zeros(3))
        to = self.transform
        return replace(
            self._transformed(scaling),
            truth=tuple(replace(t, position=factor * t.position) for t in self.truth),
            unit=unit,
            transform=Similarity(factor * to.scale, to.rotation, factor * to.translation),
        )

    def _transformed(self, to: Similarity) -> Ground:
        """Return everything but the truth in another frame."""
        stations = (
            replace(s, position=to.apply(s.position), rotation=to.rotation @ s.rotation)
            for s in self.stations
        )
        return replace(
            self,
            paths={name: to.apply(path) for name, path in self.paths.items()},
            stations=tuple(stations),
            markers=self.markers.transformed(to),
            artifact=self.artifact.transformed(to),
            transform=to,
        )


def with_finite_positions(trajectory: Trajectory) -> Trajectory:
    """Return the poses with a finite position, which alone can be compared with the truth."""
    is_finite = np.asarray(np.isfinite(trajectory.position).all(axis=1))
    return trajectory if is_finite.all() else trajectory.select(is_finite)


def evaluate_unaligned(solution: Solution, truth: Sequence[Trajectory]) -> Evaluation | None:
    """Evaluate the solution without alignment; None if no pose has truth."""
    truth_of = {t.device: with_finite_positions(t) for t in truth}
    solved = [with_finite_positions(t) for t in solution.trajectories]
    pairs = [(t, truth_of[t.device]) for t in solved if t.device in truth_of and len(t)]
    try:
        return evaluate(pairs) if pairs else None
    except InputError:
        return None


def is_unscaled(solution: Solution) -> bool:
    """Return whether lengths are in units of the scene instead of metres."""
    scene = solution.artifact
    return isinstance(scene, Scene) and solution.system == "lighthouse" and scene.scale == "unit"


def is_shown_unscaled(solution: Solution, evaluation: Evaluation | None) -> bool:
    """Return whether lengths are still unscaled after the alignment of the evaluation."""
    return is_unscaled(solution) and not (evaluation and evaluation.align.startswith("sim"))


def build_ground(
    solution: Solution, truth: Sequence[Trajectory] = (), evaluation: Evaluation | None = None
) -> Ground:
    """Return the contents of a map, in the frame of the truth if there is an evaluation.

    The truth is omitted if the solution has no scale and the evaluation estimated none.
    """
    scene = solution.artifact if isinstance(solution.artifact, Scene) else Scene()
    unscaled = is_shown_unscaled(solution, evaluation)
    ground = Ground(
        paths={t.device: t.position for t in solution.trajectories},
        times={t.device: t.time_ns for t in solution.trajectories},
        truth=() if unscaled else tuple(truth),
        stations=tuple(scene.stations),
        markers=draw_markers(scene),
        artifact=draw_artifact(solution),
        unit="unit" if unscaled else "m",
        transform=Similarity.identity(),
    )
    return ground if evaluation is None else ground._transformed(evaluation.alignment)


# ---- the view


@dataclass(frozen=True)
class View:
    """Rectangle of the map, in the plane of two of its axes.

    Attributes
    ----------
    plane : tuple of int
        Axes to the right and upwards: (0, 1) from above, (0, 2) from the side.
    centre, half_size : (2,) ndarray
    """

    plane: tuple[int, int]
    centre: Array
    half_size: Array

    @property
    def limits(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Limits of both axes."""
        low, high = self.centre - self.half_size, self.centre + self.half_size
        return (float(low[0]), float(high[0])), (float(low[1]), float(high[1]))

    def project(self, points: Array) -> Array:
        """Return the two coordinates (..., 2) of points (..., 3) in this plane."""
        return points[..., list(self.plane)]

    def count_outside(self, points: Array) -> int:
        """Return how many of the points (n, 3) the view does not contain."""
        offset = np.abs(self.project(points) - self.centre)
        return int(np.count_nonzero(np.any(offset > self.half_size, axis=1)))

    def select_labels(self, labels: Sequence[Label]) -> list[Label]:
        """Return the labels in the view, none if there are more than :data:`MAX_LABELS`."""
        inside = [label for label in labels if not self.count_outside(label.position[None])]
        return inside if len(inside) <= MAX_LABELS else []


def fit_view(
    ground: Ground, *, max_aspect: float = 1.0, plane: tuple[int, int] = (0, 1)
) -> tuple[Ground, View, Drawing]:
    """Fit a view to a map, and convert a map below a metre to millimetres.

    The view contains the artifact, the truth and all solved poses but the outermost percent, which
    may be outliers. It is at most ``max_aspect`` times as wide as high, and never higher than wide.

    Returns
    -------
    ground : Ground
        In the unit that suits the size of the view.
    view : View
    stations : Drawing
        Stations in the view with an arrow in their viewing direction; other stations as an arrow
        at the margin that points to them, with their distance.
    """
    view, is_near = _fit_rectangle(ground, max_aspect, plane, MIN_VIEW_WIDTH_M)
    if ground.unit == "m" and 2 * view.half_size.max() < 1:
        ground = ground.scaled(1e3, "mm")
        view, is_near = _fit_rectangle(ground, max_aspect, plane, 1e3 * MIN_VIEW_WIDTH_M)
    return ground, view, _draw_stations(ground, view, is_near)


def _fit_rectangle(
    ground: Ground, max_aspect: float, plane: tuple[int, int], min_width: float
) -> tuple[View, list[bool]]:
    """Return the view, and for each station whether it is in the view."""
    view = View(plane, np.zeros(2), np.zeros(2))
    contents = [t.position for t in ground.truth]
    contents += [ground.markers.extent, ground.artifact.extent]
    corners = _corners([view.project(each) for each in contents])
    solved = [view.project(path) for path in ground.paths.values()]
    position = np.concatenate(solved) if solved else np.zeros((0, 2))
    position = position[np.isfinite(position).all(axis=1)]
    if len(position):
        corners.extend(np.percentile(position, (1, 99), axis=0))
    box = np.array(corners) if corners else np.array([[-1.0, -1.0], [1.0, 1.0]])

    stations = np.array([view.project(s.position) for s in ground.stations]).reshape(-1, 2)
    centre, half = _rectangle(box, 1.0, min_width)
    distance = np.max(np.abs(stations - centre), axis=1, initial=0.0)
    is_near = distance <= half.max() * (1 + 2 * MAX_STATION_DISTANCE_WIDTHS)
    centre, half = _rectangle(np.vstack([box, stations[is_near]]), max_aspect, min_width)
    factor = MARGIN_FACTOR if np.all(is_near) else LABEL_MARGIN_FACTOR
    return replace(view, centre=centre, half_size=factor * half), is_near.tolist()


def _corners(point_sets: Sequence[Array]) -> list[Array]:
    """Return the lower and upper corners (2,) of the bounding boxes of points (n, 2)."""
    return [f(points, axis=0) for points in point_sets if len(points) for f in (np.min, np.max)]


def _rectangle(points: Array, max_aspect: float, min_width: float) -> tuple[Array, Array]:
    """Return centre and half sizes of the rectangle around points (m, 2)."""
    low, high = points.min(axis=0), points.max(axis=0)
    width, height = (high - low).tolist()
    width = max(width, height, min_width)
    height = max(height, width / max_aspect)
    return (low + high) / 2, np.array([width, height]) / 2


def _draw_stations(ground: Ground, view: View, is_near: Sequence[bool]) -> Drawing:
    """Draw stations at their positions, and far ones as arrows at the margin."""
    inside, arrows, labels, descriptions = [], [], [], []
    for station, near in zip(ground.stations, is_near, strict=True):
        name = f"ch {station.channel}"
        position = view.project(station.position)
        if near:
            # The arrow becomes shorter as the station faces the viewer.
            direction = view.project(station.rotation[:, 0])
            tip = position + 0.22 * float(view.half_size.min()) * direction
            arrows.append((position, tip))
            inside.append(station.position)
            source = station.calibration.source
            descriptions.append(f"station on channel {station.channel}, calibration: {source}")
            shift_px = -18 if tip[1] > position[1] else 18
            labels.append(Label(name, station.position, shift_px=shift_px))
            continue
        offset = position - view.centre
        distance = float(np.linalg.norm(offset))
        to_margin = float(np.min(view.half_size / np.maximum(np.abs(offset), 1e-300)))
        tip = view.centre + 0.98 * to_margin * offset
        tail = tip - 0.09 * float(view.half_size.min()) * offset / distance
        arrows.append((tail, tip))
        at = _lift((view.centre + 0.82 * (tip - view.centre))[None], view.plane)[0]
        labels.append(Label(f"{name}\n{_format_distance(distance, ground.unit)}", at))
    shapes = []
    if arrows:
        shapes.append(Shape("arrow", _lift(np.array(arrows), view.plane), STATION))
    if inside:
        points = np.array(inside)[:, None]
        shapes.append(Shape("marker", points, STATION, "station", tuple(descriptions)))
    return Drawing(tuple(shapes), tuple(labels))


def _lift(points: Array, plane: tuple[int, int]) -> Array:
    """Return points (..., 2) of a view as (..., 3), 0 along the axis that is not visible."""
    lifted = np.zeros((*points.shape[:-1], 3))
    lifted[..., list(plane)] = points
    return lifted


def _format_distance(distance: float, unit: str) -> str:
    """Format a distance to two digits; a station may be metres from a map in millimetres."""
    if unit == "mm" and distance >= 1e3:
        distance, unit = distance / 1e3, "m"
    return f"{distance:.0f} {unit}" if distance >= 10 else f"{distance:.2g} {unit}"
