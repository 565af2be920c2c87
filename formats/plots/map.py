"""The map of a picture, drawn: paths and all that lies on the ground, seen from above."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from locatk.formats.plots import floor as plot_floor
from locatk.formats.plots.floor import Floor
from locatk.formats.plots.ground import (
    FOUND_COLOR,
    IN_LEGEND,
    PAPER_COLOR,
    SCENE_COLOR,
    TRUTH_COLOR,
    Ground,
    Paper,
    Pointer,
    broken,
    framed,
    short,
)
from locatk.formats.plots.tags import Tag
from locatk.formats.plots.units import thousands

Array = NDArray[np.float64]


def draw_map(axes: Axes, ground: Ground, colors: dict[str, str]) -> None:
    """Draw all that lies on the ground, and fit a square view to it."""
    ground, view, pointers = framed(ground)
    for t in ground.truth:
        line = broken(t.position[:, :2], t.time_ns).T
        axes.plot(*line, color=TRUTH_COLOR, lw=2.5, zorder=1)
    for name, position in ground.paths.items():
        line = broken(position[:, :2], ground.times[name]).T
        axes.plot(*line, color=colors[name], lw=0.8, marker=".", ms=2.5, zorder=2)
    for marker in ground.scene.markers:
        axes.plot(*marker.position[:2], "s", color=SCENE_COLOR, mfc="none", ms=7, zorder=3)
    for paper in ground.papers:
        _draw_paper(axes, paper)
    for tag in ground.tags:
        _draw_tag(axes, tag)
    if ground.floor is not None:
        _draw_floor(axes, ground.floor)
    for pointer in pointers:
        _draw_station(axes, pointer)
    axes.set_xlim(*view.limits[0])
    axes.set_ylim(*view.limits[1])
    axes.set_aspect("equal")
    if ground.floor is not None:
        _name_landmarks(axes, ground.floor)
    axes.grid(color="0.92")
    axes.set_axisbelow(True)
    axes.set_xlabel(f"x [{ground.unit}]")
    axes.set_ylabel(f"y [{ground.unit}]")
    out = sum(view.outside(path[:, :2]) for path in ground.paths.values())
    if out:
        lie = "1 pose lies" if out == 1 else f"{thousands(out)} poses lie"
        axes.set_title(f"{lie} outside this view", loc="left", fontsize=9)


def _draw_paper(axes: Axes, paper: Paper) -> None:
    """The rims of the paper and of the dots on it."""
    for corners, width, style in ((paper.paper, 1.2, "-"), (paper.pattern, 0.8, ":")):
        rim = corners[[0, 1, 2, 3, 0], :2].T
        axes.plot(*rim, color=PAPER_COLOR, lw=width, ls=style, zorder=0.9)


def _draw_tag(axes: Axes, tag: Tag) -> None:
    """Magnets as discs with arrows in their direction, those that were found above them."""
    for arrows, color, width in (
        (tag.known, SCENE_COLOR, 0.006),
        *((found, FOUND_COLOR, 0.003) for found in tag.found),
    ):
        x, y = arrows.tail[:, :2].T
        u, v = (arrows.tip - arrows.tail)[:, :2].T
        axes.plot(x, y, "o", color=color, mfc="none", ms=1000 * width, zorder=3)
        axes.quiver(
            x, y, u, v, color=color, angles="xy", scale_units="xy", scale=1, width=width, zorder=3
        )
    middle = tag.known.tail.mean(axis=0)
    axes.annotate(
        tag.name,
        (middle[0], tag.known.tail[:, 1].min()),
        xytext=(0, -14),
        textcoords="offset points",
        ha="center",
        fontsize=8,
    )


def _draw_station(axes: Axes, pointer: Pointer) -> None:
    """A station with the direction it looks in, or at the margin the way to it."""
    tip, tail = pointer.tip, pointer.at
    shift = 0
    if pointer.inside:
        axes.plot(*tail, "o", color=SCENE_COLOR, ms=6, zorder=4)
        shift = 13 if tip[1] < tail[1] else -13
    look = {"arrowstyle": "-|>", "color": SCENE_COLOR, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", xy=(tip[0], tip[1]), xytext=(tail[0], tail[1]), arrowprops=look)
    axes.annotate(
        pointer.label,
        (pointer.label_at[0], pointer.label_at[1]),
        xytext=(0, shift),
        textcoords="offset points",
        ha="center",
        va="center",
        fontsize=8,
    )


def _draw_floor(axes: Axes, floor: Floor) -> None:
    """Bars with their north and south halves, walls, and marks where landmarks were seen."""
    for rings, look in (
        (floor.south, {"facecolor": plot_floor.SOUTH_COLOR}),
        (floor.north, {"facecolor": plot_floor.NORTH_COLOR}),
        (floor.weak, {"facecolor": "none", "edgecolor": plot_floor.WEAK_COLOR, "linewidth": 0.6}),
    ):
        if len(rings):
            axes.add_collection(PolyCollection(list(rings[:, :, :2]), zorder=1.5, **look))
    if len(floor.walls):
        ends = list(floor.walls[:, :, :2])
        axes.add_collection(
            LineCollection(ends, colors=plot_floor.WALL_COLOR, linewidths=2, zorder=1.5)
        )
    axes.plot(
        *floor.seen[:, :2].T, "o", color=plot_floor.SEEN_COLOR, mfc="none", ms=7, mew=1.2, zorder=4
    )
    axes.plot(*floor.refused[:, :2].T, "x", color=plot_floor.REFUSED_COLOR, ms=7, mew=1.5, zorder=4)


def _name_landmarks(axes: Axes, floor: Floor) -> None:
    """Row and column beside each landmark in the view, where there is room for all."""
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    x, y = floor.centres[:, 0], floor.centres[:, 1]
    inside = (left < x) & (x < right) & (low < y) & (y < high)
    if np.count_nonzero(inside) > plot_floor.MOST_NAMED:
        return
    for k in np.flatnonzero(inside):
        axes.annotate(
            floor.names[k],
            (x[k] + floor.reach_m, y[k] + floor.reach_m),
            ha="left",
            va="bottom",
            fontsize=7,
            color="0.35",
            zorder=1.6,
            clip_on=True,
        )


def _floor_signs(floor: Floor) -> list[dict[str, Any]]:
    """Label and look of each sign, for the legend."""
    square = {"marker": "s", "ms": 6}
    found = [
        {"label": "north pole", "color": plot_floor.NORTH_COLOR, **square},
        {"label": "south pole", "color": plot_floor.SOUTH_COLOR, **square},
    ]
    if len(floor.weak):
        found.append(
            {"label": "weak or missing", "color": plot_floor.WEAK_COLOR, "mfc": "none", **square}
        )
    if len(floor.walls):
        found.append({"label": "wall", "color": plot_floor.WALL_COLOR, "ls": "-", "lw": 2})
    if len(floor.seen):
        found.append(
            {"label": "landmark seen", "color": plot_floor.SEEN_COLOR, "marker": "o", "mfc": "none"}
        )
    if len(floor.refused):
        found.append({"label": "refused", "color": plot_floor.REFUSED_COLOR, "marker": "x"})
    return found


def legend(ground: Ground, colors: dict[str, str]) -> list[Line2D]:
    """What the signs of the map mean."""

    def sign(label: str, **look: Any) -> Line2D:
        return Line2D([], [], **{"color": SCENE_COLOR, "label": label, "ls": "", **look})

    named = list(colors)
    if len(named) > IN_LEGEND:
        named = named[: IN_LEGEND - 1]
    handles = [sign(_label(name), color=colors[name], ls="-", marker=".") for name in named]
    if len(named) < len(colors):
        handles.append(sign(f"and {len(colors) - len(named)} more"))
    if ground.truth:
        handles.append(sign("truth", color=TRUTH_COLOR, ls="-", lw=2.5))
    if ground.scene.markers:
        handles.append(sign("marker", marker="s", mfc="none", ms=7))
    if ground.scene.stations:
        handles.append(sign("station", marker="o", ms=6))
    if ground.papers:
        handles.append(sign("paper", color=PAPER_COLOR, ls="-", lw=1.2))
        handles.append(sign("its dots", color=PAPER_COLOR, ls=":", lw=0.8))
    if ground.tags:
        handles.append(sign("magnet", marker="o", mfc="none", ms=6))
    if any(tag.found for tag in ground.tags):
        handles.append(sign("as found", color=FOUND_COLOR, marker="o", mfc="none", ms=3))
    if ground.floor is not None:
        handles += [sign(**look) for look in _floor_signs(ground.floor)]
    return handles


def _label(name: str) -> str:
    # A leading underscore would hide it from the legend.
    return plain(short(name).lstrip("_") or "_ ")


def plain(text: str) -> str:
    """Text in which a dollar is a dollar, not the start of a formula."""
    return text.replace("$", r"\$")
