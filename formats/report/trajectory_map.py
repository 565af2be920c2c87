"""Map of the trajectories over the artifact (plotly), from above and from the side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from plotly.graph_objects import Figure

from locatk.core.evaluation import Evaluation
from locatk.core.geometry import heading_from_quaternion
from locatk.core.solution import Solution
from locatk.core.trajectory import Trajectory
from locatk.formats.plots.ground import POSITION_FORMATS, Ground, View, build_ground, fit_view
from locatk.formats.plots.series import interrupt_at_gaps
from locatk.formats.plots.shapes import (
    COLORS,
    TRUTH,
    Label,
    Shape,
    Style,
    device_colors,
    is_in_legend,
)
from locatk.formats.plots.units import abbreviate, format_count
from locatk.formats.report.panels import Panel, escape, join_sentences
from locatk.formats.report.style import DEVICE_LEGEND_RANK, faded
from locatk.formats.report.theme import CARD, TRANSPARENT
from locatk.formats.report.thinning import Indices, allot_points, thin, thinning_note

Array = NDArray[np.float64]

MAX_ASPECT = 1.75
"""Ratio of width to height up to which a map fills a page without scrolling."""

MIN_HEIGHT_PX, MAX_HEIGHT_PX, WIDTH_PX = 430, 640, 960
"""Height of a map, and its width on a wide page."""

MAX_ELLIPSES = 40
"""Number of covariance ellipses on a map; more would cover the trajectories."""

ELLIPSE_POINTS = 25
"""Number of points of the outline of an ellipse, the first and the last of which are equal."""

ELLIPSE_95_SIGMAS = float(np.sqrt(-2 * np.log(0.05)))
"""Semi-axes in sigmas of the ellipse that contains 95 % of a normal distribution in the plane."""

MIN_ELLIPSE_FRACTION = 0.035
"""Fraction of the view's half height to which the median ellipse is magnified."""

MIN_RISE_FRACTION = 0.05
"""Height of a trajectory, relative to its width, from which it is also drawn from the side."""

PLOTLY_SYMBOLS = {"circle": "circle", "square": "square", "cross": "x-thin"}


def split_frames(
    solution: Solution, truth: Sequence[Trajectory], evaluation: Evaluation | None
) -> list[tuple[str, Solution, Ground]]:
    """Return each frame with poses, its part of the solution, and the contents of its map."""
    frames = list(dict.fromkeys(t.frame for t in solution.trajectories))
    parts = []
    for frame in frames or [""]:
        trajectories = tuple(t for t in solution.trajectories if t.frame == frame)
        devices = {t.device for t in trajectories}
        of_frame = [t for t in truth if len(frames) < 2 or t.device in devices]
        part = replace(solution, trajectories=trajectories)
        parts.append((frame, part, build_ground(part, of_frame, evaluation)))
    return parts


def map_panels(solution: Solution, ground: Ground, start_ns: int, title: str) -> list[Panel]:
    """Return the map from above and, if the trajectories are not flat, from the side."""
    panels = [_map_panel(solution, ground, start_ns, title, (0, 1))]
    every = np.concatenate([np.zeros((0, 3)), *ground.paths.values()])
    every = every[np.isfinite(every).all(axis=1)]
    if len(every) > 1:
        low, high = np.percentile(every, (1, 99), axis=0)
        width, rise = float(np.max((high - low)[:2])), float(high[2] - low[2])
        if rise > MIN_RISE_FRACTION * width:
            side = f"{title} from the side"
            panels.append(_map_panel(solution, ground, start_ns, side, (0, 2)))
    return panels


def _map_panel(
    solution: Solution, ground: Ground, start_ns: int, title: str, plane: tuple[int, int]
) -> Panel:
    ground, view, stations = fit_view(ground, max_aspect=MAX_ASPECT, plane=plane)
    is_from_above = plane == (0, 1)
    names = list(ground.paths)
    colors = device_colors(names)
    traces: list[dict[str, Any]] = []
    if is_from_above:
        traces += _shape_traces(ground.artifact.shapes, ground, view)
    counts = allot_points([len(t) for t in ground.truth])
    for t, count in zip(ground.truth, counts, strict=True):
        kept = thin(len(t), count, curvature(t.position))
        line = interrupt_at_gaps(t.position[kept], t.time_ns, kept)
        shape = Shape("line", line[None], TRUTH, "truth")
        traces += _shape_traces([shape], ground, view, first=t is ground.truth[0])
    ellipses, magnification = _ellipse_traces(solution, ground, view, colors)
    traces += ellipses
    counts = allot_points([len(path) for path in ground.paths.values()])
    shown = 0
    for k, (t, count) in enumerate(zip(solution.trajectories, counts, strict=True)):
        kept = thin(len(t), count, curvature(ground.paths[t.device]))
        shown += len(kept)
        in_legend = is_in_legend(k, len(names), len(COLORS))
        traces += _path_traces(t, ground, view, kept, start_ns, colors[t.device], in_legend)
    traces += _shape_traces((*ground.markers.shapes, *stations.shapes), ground, view)
    figure = Figure(traces, _layout(view, ground.unit))
    for label in (
        *(view.select_labels(ground.artifact.labels) if is_from_above else ()),
        *stations.labels,
    ):
        figure.add_annotation(_annotation(label, view))
    outside = sum(view.count_outside(path) for path in ground.paths.values())
    note = join_sentences(
        _ellipse_note(magnification),
        f"{format_count(outside, 'poses')} outside this view: double-click to show everything."
        if outside
        else "",
        f"The legend names {len(COLORS) - 1} of {len(names)} devices."
        if len(names) > len(COLORS)
        else "",
        thinning_note(shown, solution.poses),
    )
    return Panel(title, note, figure)


def curvature(path: Array) -> Array:
    """Return the distance (n,) of each position from the middle of its neighbours."""
    distance = np.zeros(len(path))
    if len(path) > 2:
        distance[1:-1] = np.linalg.norm(path[1:-1] - (path[:-2] + path[2:]) / 2, axis=1)
    return distance


def _layout(view: View, unit: str) -> dict[str, Any]:
    """Return equal axes over the view."""
    x, y = (f"{'xyz'[axis]} [{unit}]" for axis in view.plane)
    x_limits, y_limits = view.limits
    height = WIDTH_PX * float(view.half_size[1] / view.half_size[0]) + 90
    return {
        "height": round(min(MAX_HEIGHT_PX, max(MIN_HEIGHT_PX, height))),
        "xaxis": {"title": {"text": x}, "range": list(x_limits), "constrain": "domain"},
        "yaxis": {
            "title": {"text": y},
            "range": list(y_limits),
            "scaleanchor": "x",
            "scaleratio": 1,
            "constrain": "domain",
        },
    }


# ---- shapes


def _shape_traces(
    shapes: Any, ground: Ground, view: View, *, first: bool = True
) -> list[dict[str, Any]]:
    """Return the traces of shapes; only the ``first`` of a name are in the legend."""
    return [_shape_trace(shape, ground, view, first) for shape in shapes]


def _shape_trace(shape: Shape, ground: Ground, view: View, in_legend: bool) -> dict[str, Any]:
    style, points = shape.style, view.project(shape.points)
    trace: dict[str, Any] = {
        "type": "scatter",
        "name": shape.name,
        "legendgroup": shape.name,
        "showlegend": bool(shape.name) and in_legend,
        "hoverinfo": "skip",
    }
    if shape.kind == "marker":
        trace |= {"x": points[:, 0, 0], "y": points[:, 0, 1], "mode": "markers"}
        trace["marker"] = {
            "symbol": PLOTLY_SYMBOLS[style.symbol],
            "size": style.size_px,
            "color": _fill(style),
            "line": {"color": style.color, "width": style.width_px},
        }
        if shape.descriptions:
            trace["text"] = [
                f"{escape(text)}<br>{_position_text(position, ground.unit)}"
                for text, position in zip(shape.descriptions, shape.points[:, 0], strict=True)
            ]
            trace |= {"hoverinfo": "text", "hovertemplate": "%{text}<extra></extra>"}
        return trace
    if shape.kind == "polygon":
        points = np.concatenate([points, points[:, :1]], axis=1)
        if style.fill:
            trace |= {"fill": "toself", "fillcolor": _fill(style)}
    gap = np.full((len(points), 1, 2), np.nan)
    x, y = np.concatenate([points, gap], axis=1).reshape(-1, 2).T
    dash = "dot" if style.dotted else "solid"
    trace |= {"x": x, "y": y, "mode": "lines"}
    trace["line"] = {"color": style.color, "width": style.width_px, "dash": dash}
    if shape.kind == "arrow":
        sizes = [0, 7 + 3 * style.width_px, 0] * len(points)
        trace["mode"] = "lines+markers"
        trace["marker"] = {
            "symbol": "arrow",
            "size": sizes,
            "angleref": "previous",
            "color": style.color,
            "opacity": 1,
        }
    return trace


def _fill(style: Style) -> str:
    return faded(style.fill, style.fill_opacity) if style.fill else TRANSPARENT


def _position_text(position: Array, unit: str) -> str:
    """Format a position, without its height if that is zero."""
    shown = position if position[2] else position[:2]
    return ", ".join(format(value, POSITION_FORMATS[unit]) for value in shown.tolist()) + f" {unit}"


def _annotation(label: Label, view: View) -> dict[str, Any]:
    x, y = view.project(label.position) + label.clearance
    is_centred = label.clearance == 0
    return {
        "x": x,
        "y": y,
        "text": escape(label.text).replace("\n", "<br>"),
        "showarrow": False,
        "xanchor": "center" if is_centred else "left",
        "yanchor": "middle" if is_centred else "bottom",
        "yshift": label.shift_px,
        "font": {"size": 12.5 if is_centred else 11},
        "bgcolor": faded(CARD, 0.7) if is_centred else TRANSPARENT,
    }


# ---- trajectories


def _path_traces(
    t: Trajectory,
    ground: Ground,
    view: View,
    kept: Indices,
    start_ns: int,
    color: str,
    in_legend: bool,
) -> list[dict[str, Any]]:
    """Return the trajectory of a device, and its first pose as a circle."""
    if not len(t):
        return []
    data, template = _pose_data(t, ground, kept, start_ns)
    position = view.project(ground.paths[t.device][kept])
    rows = interrupt_at_gaps(np.column_stack([position, data]), t.time_ns, kept)
    look = {
        "type": "scatter",
        "name": escape(abbreviate(t.device)),
        "legendgroup": t.device,
        "legendrank": DEVICE_LEGEND_RANK,
        "hovertemplate": template,
    }
    line = {
        **look,
        "x": rows[:, 0],
        "y": rows[:, 1],
        "customdata": rows[:, 2:],
        "mode": "lines+markers",
        "showlegend": in_legend,
        "line": {"color": color, "width": 1.2},
        "marker": {"color": color, "size": 4},
    }
    first = {
        **look,
        "x": rows[:1, 0],
        "y": rows[:1, 1],
        "customdata": rows[:1, 2:],
        "mode": "markers",
        "showlegend": False,
        "marker": {"color": CARD, "size": 10, "line": {"color": color, "width": 2.5}},
    }
    return [line, first]


def _pose_data(t: Trajectory, ground: Ground, kept: Indices, start_ns: int) -> tuple[Array, str]:
    """Return columns (n, k) of time, pose and sigmas, and the template that shows them."""
    position = ground.paths[t.device][kept]
    sigma = t.sigma[kept]
    quantities = [
        (name, position[:, axis], ground.transform.scale * sigma[:, axis], ground.unit)
        for axis, name in enumerate("xyz")
    ]
    if np.isfinite(sigma[:, 5]).any():
        heading = np.degrees(heading_from_quaternion(t.quaternion[kept]))
        quantities.append(("heading", heading, np.degrees(sigma[:, 5]), "\u00b0"))
    columns = [(t.time_ns[kept] - start_ns) * 1e-9]
    lines = ["%{customdata[0]:.3f} s"]
    for name, value, spread, unit in quantities:
        spec = POSITION_FORMATS.get(unit, ".2f")
        lines.append(f"{name} %{{customdata[{len(columns)}]:{spec}}} {unit}")
        columns.append(value)
        if np.isfinite(spread).any():
            lines[-1] += f" \u00b1 %{{customdata[{len(columns)}]:.3g}} {unit}"
            columns.append(spread)
    return np.column_stack(columns), "<br>".join(lines)


# ---- covariances


def _ellipse_traces(
    solution: Solution, ground: Ground, view: View, colors: dict[str, str]
) -> tuple[list[dict[str, Any]], int]:
    """Return some 95 % ellipses, and their magnification (0 if there are none)."""
    axes = np.array(view.plane)
    jacobian = ground.transform.scale * ground.transform.rotation
    centres: dict[str, Array] = {}
    covariances: dict[str, Array] = {}
    count = max(1, MAX_ELLIPSES // max(1, len(solution.trajectories)))
    for t in solution.trajectories[:MAX_ELLIPSES]:
        kept = thin(len(t), count)
        is_known = np.isfinite(t.covariance[kept][:, axes[:, None], axes]).all(axis=(1, 2))
        kept = kept[is_known]
        if len(kept):
            covariance = jacobian @ np.nan_to_num(t.covariance[kept, :3, :3]) @ jacobian.T
            covariances[t.device] = covariance[:, axes[:, None], axes]
            centres[t.device] = view.project(ground.paths[t.device][kept])
    if not covariances:
        return [], 0
    values, _ = np.linalg.eigh(np.concatenate(list(covariances.values())))
    largest = ELLIPSE_95_SIGMAS * np.sqrt(np.maximum(values[:, 1], 0))
    magnification = _magnification(float(np.median(largest)), float(view.half_size.min()))
    name = "95 % ellipse" + (f", \u00d7 {magnification}" if magnification > 1 else "")
    angle = np.linspace(0, 2 * np.pi, ELLIPSE_POINTS)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    traces: list[dict[str, Any]] = []
    for device, centre in centres.items():
        values, vectors = np.linalg.eigh(covariances[device])
        semi_axes = magnification * ELLIPSE_95_SIGMAS * np.sqrt(np.maximum(values, 0))
        outline = centre[:, None] + np.einsum("nij,nj,jk->nki", vectors, semi_axes, circle)
        gap = np.full((len(outline), 1, 2), np.nan)
        x, y = np.concatenate([outline, gap], axis=1).reshape(-1, 2).T
        trace = {
            "type": "scatter",
            "x": x,
            "y": y,
            "mode": "lines",
            "name": name,
            "legendgroup": "ellipses",
            "showlegend": not traces,
            "fill": "toself",
            "fillcolor": faded(colors[device], 0.13),
            "line": {"color": colors[device], "width": 0.7},
            "hoverinfo": "skip",
        }
        traces.append(trace)
    return traces, magnification


def _magnification(semi_axis: float, half_height: float) -> int:
    """Return 1, 2, 5, 10, ...: the magnification at which an ellipse is visible."""
    wanted = MIN_ELLIPSE_FRACTION * half_height / semi_axis if semi_axis > 0 else 1.0
    if wanted < 2:
        return 1
    power = 10 ** int(np.floor(np.log10(wanted)))
    return int(power * max(step for step in (1, 2, 5) if step * power <= wanted))


def _ellipse_note(magnification: int) -> str:
    if not magnification:
        return ""
    note = "Ellipses contain 95 % by the solver's covariance"
    return note + (f", drawn {magnification} times as large." if magnification > 1 else ".")
