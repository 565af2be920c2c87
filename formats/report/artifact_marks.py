"""What lies on the ground, as traces of a map: sheets, tags of magnets, landmarks of bars."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from plotly.graph_objects import Scatter

from locatk.formats.plots.floor import (
    MOST_NAMED,
    NORTH_COLOR,
    REFUSED_COLOR,
    SEEN_COLOR,
    SOUTH_COLOR,
    WALL_COLOR,
    WEAK_COLOR,
    Floor,
)
from locatk.formats.plots.ground import FOUND_COLOR, PAPER_COLOR, SCENE_COLOR, Ground, Paper, View
from locatk.formats.plots.tags import Arrows, Tag
from locatk.formats.report.figures import Array, label


def artifact_marks(ground: Ground) -> list[Scatter]:
    """Everything on the ground that devices can find, beneath their paths."""
    traces: list[Scatter] = []
    for k, paper in enumerate(ground.papers):
        traces += _paper(paper, first=k == 0)
    if ground.floor is not None:
        traces += _floor(ground.floor)
    for k, tag in enumerate(ground.tags):
        traces += _tag(tag, first=k == 0)
    return traces


def _paper(paper: Paper, *, first: bool) -> Iterator[Scatter]:
    yield _rings(
        paper.paper[None],
        name="paper",
        fillcolor="rgba(255,252,240,1)",
        line={"color": PAPER_COLOR, "width": 1.4},
        legendgroup="paper",
        showlegend=first,
    )
    yield _rings(
        paper.pattern[None],
        name="its dots",
        fillcolor="rgba(120,130,140,0.10)",
        line={"color": PAPER_COLOR, "width": 1, "dash": "dot"},
        legendgroup="dots",
        showlegend=first,
    )


def _floor(floor: Floor) -> Iterator[Scatter]:
    if len(floor.walls):
        yield _strokes(floor.walls, name="wall", line={"color": WALL_COLOR, "width": 3})
    for rings, name, fill, rim in (
        (floor.south, "south pole", SOUTH_COLOR, SOUTH_COLOR),
        (floor.north, "north pole", NORTH_COLOR, NORTH_COLOR),
        (floor.weak, "weak or missing", "rgba(0,0,0,0)", WEAK_COLOR),
    ):
        if len(rings):
            yield _rings(rings, name=name, fillcolor=fill, line={"color": rim, "width": 0.8})
    for points, name, look in (
        (floor.seen, "landmark seen", {"symbol": "circle-open", "color": SEEN_COLOR}),
        (floor.refused, "refused", {"symbol": "x-thin-open", "color": REFUSED_COLOR}),
    ):
        if len(points):
            marker = {"size": 13, "line": {"width": 2}, **look}
            yield Scatter(
                x=points[:, 0],
                y=points[:, 1],
                mode="markers",
                name=name,
                marker=marker,
                hovertemplate=f"{name} from here<extra></extra>",
            )


def _tag(tag: Tag, *, first: bool) -> Iterator[Scatter]:
    # What was found is drawn finer, so that what should be there is seen beneath.
    yield from _arrows(tag.known, f"magnet of {tag.name}", "magnet", SCENE_COLOR, 3.0, first)
    for k, found in enumerate(tag.found):
        named = first and k == 0
        yield from _arrows(found, f"{tag.name}, as found", "as found", FOUND_COLOR, 1.5, named)


def _arrows(
    arrows: Arrows, words: str, kind: str, color: str, width: float, named: bool
) -> Iterator[Scatter]:
    """Magnets as rings with an arrow the way they are magnetised."""
    gap = np.full_like(arrows.tail, np.nan)
    points = np.stack([arrows.tail, arrows.tip, gap], axis=1).reshape(-1, 3)
    yield Scatter(
        x=points[:, 0],
        y=points[:, 1],
        mode="lines+markers",
        legendgroup=kind,
        showlegend=False,
        line={"color": color, "width": width},
        marker={
            "symbol": "arrow",
            "size": [0, 7 + 3 * width, 0] * len(arrows.tail),
            "angleref": "previous",
            "color": color,
        },
        hoverinfo="skip",
    )
    yield Scatter(
        x=arrows.tail[:, 0],
        y=arrows.tail[:, 1],
        mode="markers",
        name=kind,
        legendgroup=kind,
        showlegend=named,
        marker={
            "size": 8 + 3 * width,
            "color": "#ffffff",
            "line": {"color": color, "width": width},
        },
        hovertemplate=f"{label(words)}<br>%{{x:.2f}}, %{{y:.2f}}<extra></extra>",
    )


def _rings(rings: Array, **look: Any) -> Scatter:
    """Polygons (m, k, 3) as one trace."""
    closed = np.concatenate([rings, rings[:, :1]], axis=1)[:, :, :2]
    return _strokes(closed, fill="toself", **look)


def _strokes(lines: Array, **look: Any) -> Scatter:
    """Lines (m, k, 2 or more) as one trace that cannot be pointed at."""
    gap = np.full((len(lines), 1, 2), np.nan)
    x, y = np.concatenate([lines[:, :, :2], gap], axis=1).reshape(-1, 2).T
    return Scatter(x=x, y=y, mode="lines", hoverinfo="skip", **look)


def landmark_names(floor: Floor, view: View) -> list[dict[str, Any]]:
    """Row and column beside each landmark in the view, where there is room for all."""
    inside = np.all(np.abs(floor.centres[:, :2] - view.middle) < view.half, axis=1)
    if np.count_nonzero(inside) > MOST_NAMED:
        return []
    return [
        {
            "x": floor.centres[k, 0] + floor.reach_m,
            "y": floor.centres[k, 1] + floor.reach_m,
            "text": label(floor.names[k]),
            "showarrow": False,
            "xanchor": "left",
            "yanchor": "bottom",
            "font": {"size": 11, "color": WALL_COLOR},
        }
        for k in np.flatnonzero(inside)
    ]
