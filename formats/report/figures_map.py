"""The path over the artifact: from above, and from the side where there is a third dimension."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from plotly.graph_objects import Figure, Scatter

from locatk.core.geometry import heading_from_quaternion
from locatk.core.solution import Solution
from locatk.core.trajectory import Trajectory
from locatk.formats.plots.ground import (
    IN_LEGEND,
    SCENE_COLOR,
    TRUTH_COLOR,
    Ground,
    Pointer,
    View,
    broken,
    framed,
    short,
)
from locatk.formats.plots.units import digits, thousands
from locatk.formats.report.artifact_marks import artifact_marks, landmark_names
from locatk.formats.report.figures import (
    FIRST,
    Array,
    axis,
    colours,
    drawn,
    faint,
    label,
    sentences,
    share_of_points,
    thin,
)
from locatk.formats.report.panel import Panel

WIDEST = 1.75
"""A map is at most so many times as wide as high."""

MOST_ELLIPSES = 40

ELLIPSE_95 = float(np.sqrt(-2 * np.log(0.05)))
"""Semi-axis in sigmas of the ellipse that holds 95 % of a normal distribution in the plane."""

STEEP = 0.05
"""A path is also seen from the side where it rises by more than this share of its width."""


def map_panels(
    solution: Solution, ground: Ground, start_ns: int, title: str = "Path"
) -> list[Panel]:
    """The map, and the side where the path leaves the plane."""
    panels = [_panel(solution, ground, start_ns, title, (0, 1))]
    places = [p[np.isfinite(p).all(axis=1)] for p in ground.paths.values()]
    every = np.concatenate(places) if places else np.zeros((0, 3))
    if len(every) > 1:
        low, high = np.percentile(every, (1, 99), axis=0)
        wide, rise = float(np.max((high - low)[:2])), float(high[2] - low[2])
        if rise > STEEP * wide:
            panels.append(_panel(solution, ground, start_ns, f"{title} from the side", (0, 2)))
    return panels


def _panel(
    solution: Solution, ground: Ground, start_ns: int, title: str, plane: tuple[int, int]
) -> Panel:
    ground, view, pointers = framed(ground, widest=WIDEST, plane=plane)
    figure = Figure()
    names = list(ground.paths)
    colors = colours(names)
    above = plane == (0, 1)
    if above:
        for trace in artifact_marks(ground):
            figure.add_trace(trace)
    counts = [len(t) for t in ground.truth]
    for k, (t, most) in enumerate(zip(ground.truth, share_of_points(counts), strict=True)):
        figure.add_trace(_truth(t, most, plane, first=k == 0))
    factor = _add_ellipses(figure, solution, ground, view, plane, colors)
    each = dict(zip(names, share_of_points([len(p) for p in ground.paths.values()]), strict=True))
    shown = 0
    for k, t in enumerate(solution.trajectories):
        keep = thin(len(t), each[t.device], _jumps(ground.paths[t.device]))
        shown += len(keep)
        named = len(names) <= IN_LEGEND or k < IN_LEGEND - 1
        for trace in _path(t, ground, keep, start_ns, plane, colors[t.device], named):
            figure.add_trace(trace)
    if ground.scene.markers:
        figure.add_trace(_markers(ground, plane))
    figure.update_layout(**_layout(view, plane, ground.unit))
    _add_stations(figure, ground, pointers, plane)
    if above and ground.floor is not None:
        for words in landmark_names(ground.floor, view):
            figure.add_annotation(words)
    out = sum(view.outside(path[:, list(plane)]) for path in ground.paths.values())
    note = sentences(
        f"Ellipses hold 95 % by the solver's covariance; they are drawn {factor} times as large."
        if factor > 1
        else "Ellipses hold 95 % by the solver's covariance."
        if factor
        else "",
        f"{_poses(out)} outside this view: double-click to see all." if out else "",
        f"The legend names {IN_LEGEND - 1} of {len(names)} devices."
        if len(names) > IN_LEGEND
        else "",
        drawn(shown, solution.poses),
    )
    return Panel(title, note, figure)


def _poses(count: int) -> str:
    return "1 pose lies" if count == 1 else f"{thousands(count)} poses lie"


def _jumps(path: Array) -> Array:
    """How far each place is from the middle of its neighbours."""
    far = np.zeros(len(path))
    if len(path) > 2:
        far[1:-1] = np.linalg.norm(path[1:-1] - (path[:-2] + path[2:]) / 2, axis=1)
    return far


def _truth(t: Trajectory, most: int, plane: tuple[int, int], *, first: bool) -> Scatter:
    keep = thin(len(t), most, _jumps(t.position))
    x, y = broken(t.position[keep][:, list(plane)], t.time_ns, keep).T
    return Scatter(
        x=x,
        y=y,
        mode="lines",
        name="truth",
        legendgroup="truth",
        showlegend=first,
        line={"color": TRUTH_COLOR, "width": 4},
        hoverinfo="skip",
    )


def _path(
    t: Trajectory,
    ground: Ground,
    keep: NDArray[np.int64],
    start: int,
    plane: tuple[int, int],
    color: str,
    named: bool,
) -> list[Scatter]:
    """The path of a device, and its first pose."""
    if not len(t):
        return []
    position = ground.paths[t.device][keep]
    said, template = _hover(t, ground, keep, start)
    both = broken(np.column_stack([position[:, list(plane)], said]), t.time_ns, keep)
    name = label(short(t.device))
    look: dict[str, Any] = {"legendgroup": t.device, "hovertemplate": template, "name": name}
    look["legendrank"] = FIRST
    line = Scatter(
        x=both[:, 0],
        y=both[:, 1],
        customdata=both[:, 2:],
        mode="lines+markers",
        showlegend=named,
        line={"color": color, "width": 1.2},
        marker={"color": color, "size": 4},
        **look,
    )
    first = Scatter(
        x=both[:1, 0],
        y=both[:1, 1],
        customdata=both[:1, 2:],
        mode="markers",
        showlegend=False,
        marker={"color": "#ffffff", "size": 10, "line": {"color": color, "width": 2.5}},
        **look,
    )
    return [line, first]


def _hover(t: Trajectory, ground: Ground, keep: NDArray[np.int64], start: int) -> tuple[Array, str]:
    """What a pose says when pointed at: columns (n, k) and the template that shows them."""
    position = ground.paths[t.device][keep]
    sigma = t.sigma[keep] * ([ground.to.scale] * 3 + [1.0] * 3)
    columns = [(t.time_ns[keep] - start) * 1e-9]
    lines = ["%{customdata[0]:.3f} s"]
    places = {"m": ".4f", "mm": ".3f", "unit": ".4f"}[ground.unit]

    def say(words: str, values: Array, form: str, after: str) -> None:
        lines.append(f"{words} %{{customdata[{len(columns)}]:{form}}} {after}")
        columns.append(values)

    for k, name in enumerate("xyz"):
        spread = sigma[:, k]
        say(name, position[:, k], places, ground.unit)
        if np.isfinite(spread).any():
            lines[-1] += f" \u00b1 %{{customdata[{len(columns)}]:.3g}} {ground.unit}"
            columns.append(spread)
    if np.isfinite(sigma[:, 5]).any():
        say("heading", np.degrees(heading_from_quaternion(t.quaternion[keep])), ".2f", "\u00b0")
        lines[-1] += f" \u00b1 %{{customdata[{len(columns)}]:.3g}} \u00b0"
        columns.append(np.degrees(sigma[:, 5]))
    return np.column_stack(columns), "<br>".join(lines)


def _add_ellipses(
    figure: Figure,
    solution: Solution,
    ground: Ground,
    view: View,
    plane: tuple[int, int],
    colors: dict[str, str],
) -> int:
    """Draw some 95 % ellipses; says how many times too large, 0 where there are none."""
    axes = np.array(plane)
    turn = ground.to.scale * ground.to.rotation
    places, shapes, owners = [], [], []
    each = max(1, MOST_ELLIPSES // max(1, len(solution.trajectories)))
    for t in solution.trajectories[:MOST_ELLIPSES]:
        keep = thin(len(t), each)
        known = t.covariance[keep][:, axes[:, None], axes]
        keep = keep[np.isfinite(known).all(axis=(1, 2))]
        shape = np.nan_to_num(t.covariance[keep, :3, :3])
        shape = (turn @ shape @ turn.T)[:, axes[:, None], axes]
        places.append(ground.paths[t.device][keep][:, axes])
        shapes.append(shape)
        owners += [t.device] * len(keep)
    if not owners:
        return 0
    place, shape = np.concatenate(places), np.concatenate(shapes)
    values, vectors = np.linalg.eigh(shape)
    semi = ELLIPSE_95 * np.sqrt(np.maximum(values, 0))
    factor = _magnified(float(np.median(semi[:, 1])), float(view.half.min()))
    turns = np.linspace(0, 2 * np.pi, 25)
    circle = np.stack([np.cos(turns), np.sin(turns)])
    rims = place[:, None] + np.einsum("nij,nj,jk->nki", vectors, factor * semi, circle)
    for k, name in enumerate(dict.fromkeys(owners)):
        mine = [i for i, owner in enumerate(owners) if owner == name]
        gap = np.full((len(mine), 1, 2), np.nan)
        x, y = np.concatenate([rims[mine], gap], axis=1).reshape(-1, 2).T
        words = "95 % ellipse" + (f", \u00d7 {factor}" if factor > 1 else "")
        figure.add_trace(
            Scatter(
                x=x,
                y=y,
                mode="lines",
                name=words,
                legendgroup="ellipses",
                showlegend=k == 0,
                fill="toself",
                fillcolor=faint(colors[name], 0.13),
                line={"color": faint(colors[name], 0.65), "width": 1},
                hoverinfo="skip",
            )
        )
    return factor


def _magnified(semi: float, half: float) -> int:
    """How many times larger an ellipse is drawn so that it can be seen: 1, 2, 5, 10, ..."""
    wanted = 0.035 * half / semi if semi > 0 else 1.0
    if wanted < 2:
        return 1
    power = 10 ** int(np.floor(np.log10(wanted)))
    return int(power * max(step for step in (1, 2, 5) if step * power <= wanted))


def _markers(ground: Ground, plane: tuple[int, int]) -> Scatter:
    at = np.array([m.position[list(plane)] for m in ground.scene.markers])
    return Scatter(
        x=at[:, 0],
        y=at[:, 1],
        mode="markers",
        name="marker",
        text=[label(m.name) for m in ground.scene.markers],
        hovertemplate=f"%{{text}}<br>%{{x:.3f}}, %{{y:.3f}} {ground.unit}",
        marker={
            "symbol": "square-open",
            "size": 11,
            "color": SCENE_COLOR,
            "line": {"width": 1.8},
        },
    )


def _add_stations(
    figure: Figure, ground: Ground, pointers: tuple[Pointer, ...], plane: tuple[int, int]
) -> None:
    """Stations where they stand with an arrow the way they look, or at the margin."""
    inside = [(p, s) for p, s in zip(pointers, ground.scene.stations, strict=True) if p.inside]
    if inside:
        figure.add_trace(
            Scatter(
                x=[p.at[0] for p, _ in inside],
                y=[p.at[1] for p, _ in inside],
                mode="markers",
                name="station",
                text=[
                    f"station, channel {s.channel}<br>"
                    + ", ".join(digits(float(v)) for v in s.position)
                    + f" {ground.unit}<br>calibration: {label(s.calibration.source)}"
                    for _, s in inside
                ],
                hovertemplate="%{text}",
                marker={"size": 11, "color": SCENE_COLOR},
            )
        )
    for p in pointers:
        figure.add_annotation(
            x=p.tip[0],
            y=p.tip[1],
            ax=p.at[0],
            ay=p.at[1],
            axref="x",
            ayref="y",
            text="",
            showarrow=True,
            arrowhead=2,
            arrowwidth=1.8,
            arrowcolor=SCENE_COLOR,
        )
        below = p.inside and p.tip[1] > p.at[1]
        figure.add_annotation(
            x=p.label_at[0],
            y=p.label_at[1],
            text=label(p.label).replace("\n", "<br>"),
            showarrow=False,
            yshift=(-18 if below else 18) if p.inside else 0,
            font={"size": 12.5},
            bgcolor="rgba(255,255,255,0.7)",
        )


def _layout(view: View, plane: tuple[int, int], unit: str) -> dict[str, Any]:
    """Equal axes over the view."""
    names = [f"{'xyz'[k]} [{unit}]" for k in plane]
    (left, right), (low, high) = view.limits
    shape = float(view.half[0] / view.half[1])
    return {
        "height": round(min(640, max(430, 960 / shape + 90))),
        "xaxis": axis(names[0], range=[left, right], constrain="domain"),
        "yaxis": axis(
            names[1], range=[low, high], scaleanchor="x", scaleratio=1, constrain="domain"
        ),
    }
