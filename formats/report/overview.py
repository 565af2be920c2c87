"""Beginning of a page on several solutions: a table of all, and a small map of each.

The maps are SVG in the page. They need no script, and two or three kilobytes each.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from locatk.formats.plots.ground import Ground, fit_view, is_shown_unscaled
from locatk.formats.plots.series import interrupt_at_gaps, pose_span_ns
from locatk.formats.plots.shapes import COLORS, Shape
from locatk.formats.plots.units import format_count, format_length
from locatk.formats.report import page
from locatk.formats.report.panels import Table, join_names, join_sentences
from locatk.formats.report.subject import Subject
from locatk.formats.report.thinning import allot_points, thin
from locatk.formats.report.trajectory_map import curvature, split_frames

Array = NDArray[np.float64]

MAP_WIDTH_PX, MAP_HEIGHT_PX = 200, 140
"""Size of a small map, in units of its SVG."""

FOOT_HEIGHT_PX = 16
"""Height of the scale bar below a small map."""

MAX_POINTS = 200
"""Number of points of all trajectories together on a small map."""

MIN_OUTLINE_PX = 4.0
"""Size of a shape from which its outline is drawn; a smaller one is a dot."""

MAX_DOTS = 400
"""Number of dots that stand for small shapes; they are thinned evenly."""

MAX_SCALE_RATIO = 3.0
"""Ratio of the largest to the smallest map of a system up to which all have the same scale."""

MAX_SCALE_BAR_PX = 60
"""Largest length of a scale bar."""


def overview(subjects: Sequence[Subject]) -> str:
    """Return a table of all subjects, which the reader can sort, and their maps.

    The names in the table and the maps are links to the parts of the page with ``id`` s1, s2, ...
    """
    links = [f"#s{k}" for k in range(1, len(subjects) + 1)]
    table = page.table(_table(subjects), links)
    nav = f'<nav class="sortable">{table}</nav>'
    return f'<div id="overview">{nav}\n{_maps(subjects, links)}</div>'


# ---- the table


def _table(subjects: Sequence[Subject]) -> Table:
    header = (
        "solution", "system", "method", "devices", "duration", "poses", "coverage",
        "APE median", "p95", "max", "NEES", "rejected", "warnings",
    )  # fmt: skip
    rows = []
    for subject in subjects:
        solution, evaluation = subject.solution, subject.evaluation
        unscaled = is_shown_unscaled(solution, evaluation)
        errors, coverage, nees = ["-"] * 3, "-", "-"
        if evaluation is not None:
            lengths = (evaluation.median, evaluation.p95, float(np.max(evaluation.errors)))
            errors = [format_length(value, unscaled=unscaled) for value in lengths]
            if evaluation.coverage.fraction is not None:
                coverage = f"{100 * evaluation.coverage.fraction:.1f} %"
            known = np.isfinite(evaluation.nees)
            if known.any() and evaluation.nees_dof[known].sum():
                ratio = np.sum(evaluation.nees[known]) / np.sum(evaluation.nees_dof[known])
                nees = f"{ratio:.3g}"
        trajectories = [each for each in solution.trajectories if len(each)]
        span_ns = pose_span_ns(solution)
        rows.append(
            (
                subject.name,
                solution.system,
                solution.method,
                format_count(len(trajectories)),
                f"{1e-9 * (span_ns[1] - span_ns[0]):.1f} s" if span_ns else "-",
                format_count(solution.poses),
                coverage,
                *errors,
                nees,
                format_count(sum(solution.rejected.values())),
                format_count(len(solution.warnings)),
            )
        )
    return Table(header, rows)


# ---- the maps


@dataclass(frozen=True)
class _SmallMap:
    """Contents of a small map and the view that holds them.

    Attributes
    ----------
    ground : Ground
    stations : tuple of Shape
        Of a Lighthouse scene.
    centre : (2,) ndarray
        Middle of the view, in the unit of the ground.
    scale : float
        Pixels per unit of the ground at which the view fills the map.
    unit_m : float
        Unit of the ground in metres; 1 if the scene has no scale.
    group : (str, bool)
        System, and whether lengths have no scale: only such maps can share a scale.
    """

    ground: Ground
    stations: tuple[Shape, ...]
    centre: Array
    scale: float
    unit_m: float
    group: tuple[str, bool]

    @property
    def pixels_per_m(self) -> float:
        """Scale in pixels per metre."""
        return self.scale / self.unit_m


def _maps(subjects: Sequence[Subject], links: Sequence[str]) -> str:
    maps = [_fit_map(subject) for subject in subjects]
    shared = _shared_scales(maps)
    items = [
        f'<a href="{link}">{_draw(small, shared.get(small.group, small.pixels_per_m))}'
        f"<b>{page.text(subject.name)}</b><span>{page.text(_caption(subject))}</span></a>"
        for subject, small, link in zip(subjects, maps, links, strict=True)
    ]
    systems = [
        f"{system} without scale" if is_unscaled else system for system, is_unscaled in shared
    ]
    note = join_sentences(
        "Trajectories over the artifacts, each with a scale bar.",
        f"All maps of a system have the same scale: {join_names(systems)}." if systems else "",
    )
    return f'{page.paragraph(note, "sub")}<nav class="maps">{"".join(items)}</nav>'


def _caption(subject: Subject) -> str:
    """Return the median error of a subject, without truth its number of poses."""
    frames = len({t.frame for t in subject.solution.trajectories})
    more = f", 1 of {frames} frames" if frames > 1 else ""
    evaluation = subject.evaluation
    if evaluation is None:
        return format_count(subject.solution.poses, "poses") + more
    unscaled = is_shown_unscaled(subject.solution, evaluation)
    return f"APE median {format_length(evaluation.median, unscaled=unscaled)}{more}"


def _fit_map(subject: Subject) -> _SmallMap:
    """Return the map of the frame with most poses."""
    frames = split_frames(subject.solution, subject.truth, subject.evaluation)
    _, solution, ground = max(frames, key=lambda each: each[1].poses)
    ground, view, stations = fit_view(ground, max_aspect=MAP_WIDTH_PX / MAP_HEIGHT_PX)
    scale = min(MAP_WIDTH_PX / view.half_size[0], MAP_HEIGHT_PX / view.half_size[1]) / 2
    markers = tuple(shape for shape in stations.shapes if shape.kind == "marker")
    unit_m = 1e-3 if ground.unit == "mm" else 1.0
    group = (solution.system, ground.unit == "unit")
    return _SmallMap(ground, markers, view.centre, float(scale), unit_m, group)


def _shared_scales(maps: Sequence[_SmallMap]) -> dict[tuple[str, bool], float]:
    """Return the scale [px/m] of the groups whose maps are of similar size."""
    scales: dict[tuple[str, bool], list[float]] = {}
    for small in maps:
        scales.setdefault(small.group, []).append(small.pixels_per_m)
    return {
        group: min(each)
        for group, each in scales.items()
        if len(each) > 1 and max(each) <= MAX_SCALE_RATIO * min(each)
    }


def _draw(small: _SmallMap, pixels_per_m: float) -> str:
    """Return a map as SVG."""
    scale = pixels_per_m * small.unit_m
    middle = np.array([MAP_WIDTH_PX, MAP_HEIGHT_PX]) / 2

    def project(points: Array) -> Array:
        """Return pixels (..., 2), downwards, of points (..., 3)."""
        return middle + scale * (points[..., :2] - small.centre) * [1, -1]

    ground = small.ground
    parts = [
        f'<svg viewBox="0 0 {MAP_WIDTH_PX} {MAP_HEIGHT_PX + FOOT_HEIGHT_PX}" aria-hidden="true">',
        # The view may cut trajectories, which must not run over the scale bar.
        f'<svg width="{MAP_WIDTH_PX}" height="{MAP_HEIGHT_PX}">',
        *_draw_shapes([*ground.artifact.shapes, *ground.markers.shapes], project),
    ]
    counts = allot_points([len(path) for path in ground.paths.values()], MAX_POINTS)
    for k, ((name, path), count) in enumerate(zip(ground.paths.items(), counts, strict=True)):
        kept = thin(len(path), count, curvature(path))
        line = interrupt_at_gaps(project(path[kept]), ground.times[name], kept)
        if len(line):
            color = f"var(--device-{k % len(COLORS)})"
            parts.append(f'<path class="path" style="stroke:{color}" d="{_path(line)}"/>')
    for shape in small.stations:
        parts.append(f'<path class="station" d="{_dots(project(shape.points[:, 0]))}"/>')
    length, name = _scale_bar(pixels_per_m, is_unscaled=small.group[1])
    y = MAP_HEIGHT_PX + FOOT_HEIGHT_PX - 4
    bar = f'<path class="bar" d="M1 {y - 4}v4h{length:.1f}v-4"/>'
    text = f'<text x="{length + 7:.1f}" y="{y}">{name}</text>'
    return "".join([*parts, "</svg>", bar, text, "</svg>"])


def _draw_shapes(shapes: Sequence[Shape], project: Any) -> Iterator[str]:
    """Yield the outlines of large shapes, and dots for small ones."""
    dots = [np.zeros((0, 2))]
    outlines = []
    for shape in shapes:
        if shape.kind == "arrow" or not len(shape.points):
            continue
        points = project(shape.points)
        if shape.kind == "marker":
            dots.append(points[:, 0])
            continue
        size = np.nanmax(points, axis=1) - np.nanmin(points, axis=1)
        is_large = size.max(axis=1) >= MIN_OUTLINE_PX
        dots.append(points[~is_large].mean(axis=1))
        end = "" if shape.kind == "line" else "z"
        outlines += [_path(each) + end for each in points[is_large] if _is_visible(each).any()]
    if outlines:
        yield f'<path class="artifact" d="{"".join(outlines)}"/>'
    every = np.concatenate(dots)
    every = np.unique(np.round(every[_is_visible(every)]), axis=0)
    if len(every):
        yield f'<path class="dots" d="{_dots(every[thin(len(every), MAX_DOTS)])}"/>'


def _is_visible(points: Array) -> NDArray[np.bool_]:
    """Return which pixels (n, 2) are on the map."""
    return np.all((points >= 0) & (points <= [MAP_WIDTH_PX, MAP_HEIGHT_PX]), axis=-1)


def _path(points: Array) -> str:
    """Return a path of SVG through pixels (n, 2), interrupted at ``nan``."""
    words, letter = [], "M"
    for x, y in points.tolist():
        if math.isfinite(x) and math.isfinite(y):
            words.append(f"{letter}{x:.1f} {y:.1f}")
            letter = "L"
        else:
            letter = "M"
    return "".join(words)


def _dots(points: Array) -> str:
    """Return a path of SVG that a round line cap turns into dots."""
    return "".join(f"M{x:.4g} {y:.4g}h0" for x, y in points.tolist())


def _scale_bar(pixels_per_m: float, *, is_unscaled: bool) -> tuple[float, str]:
    """Return the length [px] of a scale bar and its name: the longest 1, 2 or 5 times 10^k."""
    longest_m = MAX_SCALE_BAR_PX / pixels_per_m
    power = 10.0 ** math.floor(math.log10(longest_m))
    length_m = power * max(step for step in (1, 2, 5) if step * power <= longest_m * (1 + 1e-9))
    if is_unscaled:
        return length_m * pixels_per_m, f"{length_m:g} unit"
    units = ((1.0, "m"), (1e-2, "cm"), (1e-3, "mm"))
    unit_m, unit = next((each for each in units if length_m > 0.999 * each[0]), units[-1])
    return length_m * pixels_per_m, f"{length_m / unit_m:g} {unit}"
