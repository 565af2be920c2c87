"""What lies on the ground under a solution's paths, and the view that holds it: no drawing yet.

Shared by the pictures (:mod:`locatk.formats.plots.solution`) and the pages
(:mod:`locatk.formats.report`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.dots.sheet import Manifest
from locatk.core.errors import InputError
from locatk.core.evaluation import Evaluation, evaluate
from locatk.core.geometry import Similarity
from locatk.core.lighthouse.scene import Scene
from locatk.core.solution import Solution
from locatk.core.trajectory import Trajectory
from locatk.formats.plots import floor as plot_floor
from locatk.formats.plots.floor import Floor, floor_of
from locatk.formats.plots.tags import Tag, tags_of

Array = NDArray[np.float64]

COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#7F3C8D")
"""Okabe and Ito's, which the colour-blind can tell apart, without yellow."""

IN_LEGEND = 8
"""Devices that a legend names, at most."""

NEAR = 1.0
"""A station is drawn in its place up to this far outside the paths, in widths of these;
beyond, at the margin."""

TRUTH_COLOR, SCENE_COLOR, FOUND_COLOR, PAPER_COLOR = "#BFBFBF", "#333333", "#D55E00", "#8C8C8C"

BREAK_NS = 500_000_000
"""A path is not drawn across a longer silence."""


@dataclass(frozen=True)
class Paper:
    """A sheet of dots: corners of the paper and of its pattern, (4, 3) each."""

    name: str
    frame: str
    paper: Array
    pattern: Array


@dataclass(frozen=True)
class Ground:
    """All that a map shows, in one frame and one unit.

    Attributes
    ----------
    paths : dict of str to (n, 3) ndarray
        By device.
    times : dict of str to (n,) int64 ndarray
        Their stamps in ns.
    truth : tuple of Trajectory
    scene : Scene
        Stations and markers; empty for other systems.
    tags, floor, papers
        What else the devices can find.
    unit : str
        Of all lengths: ``"m"``, or ``"unit"`` where the scene has no scale.
    to : Similarity
        From the solution's frame into this one.
    """

    paths: dict[str, Array]
    times: dict[str, NDArray[np.int64]]
    truth: tuple[Trajectory, ...]
    scene: Scene
    tags: tuple[Tag, ...]
    floor: Floor | None
    papers: tuple[Paper, ...]
    unit: str
    to: Similarity

    def scaled(self, factor: float, unit: str) -> Ground:
        """The same in another unit."""
        by = Similarity(factor, np.eye(3), np.zeros(3))
        to = Similarity(factor * self.to.scale, self.to.rotation, factor * self.to.translation)
        truth = tuple(replace(t, position=factor * t.position) for t in self.truth)
        moved = _moved(self, by)
        paths = {name: factor * path for name, path in self.paths.items()}
        return replace(moved, paths=paths, truth=truth, unit=unit, to=to)

    def outlines(self) -> list[Array]:
        """Points (n, 3) that the view must hold, apart from the paths."""
        points = [t.position for t in self.truth]
        points += [m.position[None] for m in self.scene.markers]
        points += [ends for tag in self.tags for ends in (tag.known.tail, tag.known.tip)]
        points += [paper.paper for paper in self.papers]
        return points + ([] if self.floor is None else plot_floor.solid(self.floor))


def known(t: Trajectory) -> Trajectory:
    """The poses of a trajectory whose positions are numbers: the others cannot be judged."""
    whole = np.isfinite(t.position).all(axis=1)
    if whole.all():
        return t
    return replace(
        t,
        time_ns=t.time_ns[whole],
        position=t.position[whole],
        quaternion=t.quaternion[whole],
        covariance=t.covariance[whole],
    )


def compare(solution: Solution, truth: Sequence[Trajectory]) -> Evaluation | None:
    """The solution against the truth as it is; None where no pose has truth."""
    true = {t.device: known(t) for t in truth}
    solved = [known(t) for t in solution.trajectories]
    pairs = [(t, true[t.device]) for t in solved if t.device in true and len(t)]
    try:
        return evaluate(pairs) if pairs else None
    except InputError:
        return None


def has_no_scale(solution: Solution) -> bool:
    """Whether lengths are in units of the scene, not in metres."""
    scene = solution.artifact
    return isinstance(scene, Scene) and solution.system == "lighthouse" and scene.scale == "unit"


def ground_of(
    solution: Solution, truth: Sequence[Trajectory] = (), evaluation: Evaluation | None = None
) -> Ground:
    """What a map of the solution shows, with an evaluation in the frame of its truth.

    The truth is left out where the solution has no scale and was not given one.
    """
    scene = solution.artifact if isinstance(solution.artifact, Scene) else Scene()
    unscaled = has_no_scale(solution) and not (evaluation and evaluation.align.startswith("sim"))
    ground = Ground(
        paths={t.device: t.position for t in solution.trajectories},
        times={t.device: t.time_ns for t in solution.trajectories},
        truth=() if unscaled else tuple(truth),
        scene=scene,
        tags=tags_of(solution),
        floor=floor_of(solution),
        papers=_papers(solution),
        unit="unit" if unscaled else "m",
        to=Similarity.identity(),
    )
    if evaluation is None:
        return ground
    to = evaluation.alignment
    paths = {name: to.apply(path) for name, path in ground.paths.items()}
    return replace(_moved(ground, to), paths=paths, to=to)


def _moved(ground: Ground, to: Similarity) -> Ground:
    """All but the paths and the truth in another frame."""
    scene = replace(
        ground.scene,
        stations=tuple(
            replace(s, position=to.apply(s.position), rotation=to.rotation @ s.rotation)
            for s in ground.scene.stations
        ),
        markers=tuple(replace(m, position=to.apply(m.position)) for m in ground.scene.markers),
    )
    return replace(
        ground,
        scene=scene,
        tags=tuple(tag.moved(to) for tag in ground.tags),
        floor=None if ground.floor is None else ground.floor.moved(to),
        papers=tuple(
            replace(p, paper=to.apply(p.paper), pattern=to.apply(p.pattern)) for p in ground.papers
        ),
    )


def _papers(solution: Solution) -> tuple[Paper, ...]:
    """The sheets in whose frames there are poses; of tiles on a floor, all."""
    manifest = solution.artifact
    if not isinstance(manifest, Manifest):
        return ()
    frames = {t.frame for t in solution.trajectories}
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    found = []
    for number, sheet in enumerate(manifest.sheets):
        if manifest.frame(number) not in frames:
            continue
        origin = np.array(sheet.origin, float)
        paper = origin + (square * sheet.page_mm - sheet.first_mm) / manifest.pitch_mm
        pattern = origin + square * (np.array(sheet.size) - 1)
        corners = (manifest.to_metres(number, at) for at in (paper, pattern))
        flat = [np.column_stack([at, np.zeros(4)]) for at in corners]
        found.append(Paper(sheet.id, manifest.frame(number), flat[0], flat[1]))
    return tuple(found)


# ---- the view


@dataclass(frozen=True)
class View:
    """A rectangle of the map: its middle (2,) and half its width and height (2,)."""

    middle: Array
    half: Array

    @property
    def limits(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Of x and of y."""
        low, high = self.middle - self.half, self.middle + self.half
        return (float(low[0]), float(high[0])), (float(low[1]), float(high[1]))

    def outside(self, points: Array) -> int:
        """How many of the points (n, 2) it does not show."""
        return int(np.count_nonzero(np.any(np.abs(points - self.middle) > self.half, axis=1)))


@dataclass(frozen=True)
class Pointer:
    """An arrow for a station: from itself the way it looks, or at the margin the way to it."""

    label: str
    inside: bool
    at: Array
    tip: Array
    label_at: Array


def framed(
    ground: Ground, *, widest: float = 1.0, plane: tuple[int, int] = (0, 1)
) -> tuple[Ground, View, tuple[Pointer, ...]]:
    """A map in the unit that suits its size (mm below a metre), with what :func:`view_of` says."""
    view, pointers = view_of(ground, widest=widest, plane=plane)
    if ground.unit != "m" or 2 * view.half.max() >= 1:
        return ground, view, pointers
    ground = ground.scaled(1e3, "mm")
    return ground, *view_of(ground, widest=widest, plane=plane, least=10.0)


def view_of(
    ground: Ground,
    *,
    widest: float = 1.0,
    plane: tuple[int, int] = (0, 1),
    least: float = 0.01,
) -> tuple[View, tuple[Pointer, ...]]:
    """The rectangle that shows a map, at most ``widest`` times as wide as high, and never higher
    than wide; and the stations in it or at its margin.

    It holds what is known, and of the solved poses all but the outermost, which may be wild.
    ``plane`` are the columns that go right and up; ``least`` is the least width.
    """
    axes = list(plane)
    box = _box(list(ground.paths.values()), ground.outlines(), axes)
    places = np.array([s.position[axes] for s in ground.scene.stations]).reshape(-1, 2)
    middle, half = _rectangle(box, 1.0, least)
    near = np.max(np.abs(places - middle), axis=1, initial=0.0) <= half.max() * (1 + 2 * NEAR)
    middle, half = _rectangle(np.vstack([box, places[near]]), widest, least)
    half = half * (1.12 if np.all(near) else 1.45)  # room for the labels at the margin
    view = View(middle, half)
    pointers = []
    for station, inside in zip(ground.scene.stations, near.tolist(), strict=True):
        label = f"ch {station.channel}"
        at = station.position[axes]
        if inside:
            # A flat arrow shrinks as the station looks down.
            tip = at + station.rotation[axes, 0] * 0.22 * float(half.min())
            pointers.append(Pointer(label, True, at, tip, at))
            continue
        away = at - middle
        far = float(np.linalg.norm(away))
        tip = middle + away * 0.98 * float(np.min(half / np.maximum(np.abs(away), 1e-300)))
        tail = tip - 0.09 * float(half.min()) * away / far
        label_at = middle + (tip - middle) * 0.82
        pointers.append(
            Pointer(f"{label}\n{_distance(far, ground.unit)}", False, tail, tip, label_at)
        )
    return view, tuple(pointers)


def _distance(far: float, unit: str) -> str:
    """To two digits; a station may be metres away, however small the map."""
    if unit == "mm" and far >= 1e3:
        far, unit = far / 1e3, "m"
    return f"{far:.0f} {unit}" if far >= 10 else f"{far:.2g} {unit}"


def _box(paths: Sequence[Array], solid: Sequence[Array], axes: list[int]) -> Array:
    """Corners (m, 2) of what the view must hold."""
    corners = [f(p[:, axes], axis=0) for p in solid if len(p) for f in (np.min, np.max)]
    solved = np.concatenate([p[:, axes] for p in paths]) if paths else np.zeros((0, 2))
    solved = solved[np.isfinite(solved).all(axis=1)]
    if len(solved):
        corners.extend(np.percentile(solved, (1, 99), axis=0))
    return np.array(corners) if corners else np.array([[-1.0, -1.0], [1.0, 1.0]])


def _rectangle(box: Array, widest: float, least: float) -> tuple[Array, Array]:
    """Middle and half sizes of the rectangle around points (m, 2)."""
    low, high = box.min(axis=0), box.max(axis=0)
    wide, tall = (high - low).tolist()
    wide = max(wide, tall, least)
    tall = max(tall, wide / widest)
    return (low + high) / 2, np.array([wide, tall]) / 2


def broken(
    position: Array, time_ns: NDArray[np.int64], keep: NDArray[np.int64] | None = None
) -> Array:
    """Rows (n, k) with one of nan wherever the path is silent for longer than :data:`BREAK_NS`,
    and longer than three of its usual intervals.

    Of a thinned path the rows are those of ``keep``, while the times are of all: what is left
    out is no silence.
    """
    interval = np.diff(time_ns)
    silence = max(BREAK_NS, 3 * int(np.median(interval))) if len(interval) else BREAK_NS
    silences = np.concatenate([[0], np.cumsum(interval > silence)])[: len(time_ns)]
    gaps = np.flatnonzero(np.diff(silences if keep is None else silences[keep])) + 1
    return np.insert(position, gaps, np.nan, axis=0)


def short(name: str) -> str:
    """A device's name as a legend has room for it."""
    return name if len(name) <= 18 else f"{name[:7]}...{name[-8:]}"
