"""The map of a picture: paths, stations, markers, magnets and landmarks, seen from above."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from locatk.core.geometry import Similarity
from locatk.core.lighthouse.scene import Scene, Station
from locatk.core.polaris import codec
from locatk.core.polaris.tag import Placed, Tags, built_magnets
from locatk.core.solution import Solution
from locatk.core.trajectory import Trajectory
from locatk.formats import plot_floor
from locatk.formats.plot_floor import Floor
from locatk.formats.viewers import tags_in_frames

Array = NDArray[np.float64]

TRUTH_COLOR, SCENE_COLOR, FOUND_COLOR = "0.75", "0.2", "#D55E00"

IN_LEGEND = 8
"""Devices that the legend names, at most."""

NEAR = 1.0
"""A station is drawn in its place up to this far outside the paths, in widths of these;
beyond, at the margin."""

BREAK_NS = 500_000_000
"""A path is not drawn across a longer silence."""


@dataclass(frozen=True)
class Arrows:
    """Magnets on the map: tail and tip of each, (M, 3) in metres."""

    tail: Array
    tip: Array

    @classmethod
    def of(cls, place: Array, angle: Array, length: float, on: Placed) -> Arrows:
        """``place`` (M, 2) and ``angle`` (M,) in the frame that lies at ``on``."""
        c, s = np.cos(on.heading_rad), np.sin(on.heading_rad)
        tail = np.zeros((len(place), 3))
        tail[:, :2] = place @ np.array([[c, s], [-s, c]]) + [on.x_m, on.y_m]
        turn = angle + on.heading_rad
        way = np.column_stack([np.cos(turn), np.sin(turn), 0 * turn])
        return cls(tail, tail + length * way)

    def moved(self, to: Similarity) -> Arrows:
        """The same in another frame."""
        return Arrows(to.apply(self.tail), to.apply(self.tip))


@dataclass(frozen=True)
class Tag:
    """A tag on the map: its magnets as they should lie, and as they were found."""

    name: str
    known: Arrows
    found: tuple[Arrows, ...]

    def moved(self, to: Similarity) -> Tag:
        """The same in another frame."""
        found = tuple(arrows.moved(to) for arrows in self.found)
        return replace(self, known=self.known.moved(to), found=found)


def tags_of(solution: Solution) -> tuple[Tag, ...]:
    """The tags whose place in the frame of the poses is known."""
    tags = solution.artifact
    if not isinstance(tags, Tags):
        return ()
    length = tags.spacing_m / 3
    drawn = []
    for number, _, on in tags_in_frames(tags, solution.trajectories):
        place, angle = built_magnets(tags, number, codec.layout_of(tags, number))
        found = tuple(
            _found(seen, length, on) for seen in solution.detections if seen["tag_id"] == number
        )
        drawn.append(Tag(f"tag {number}", Arrows.of(place, angle, length, on), found))
    return tuple(drawn)


def _found(seen: dict[str, Any], length: float, on: Placed) -> Arrows:
    """Magnets of one detection, which are in the array's frame."""
    array, magnets = seen["array"], seen["magnets"]
    place = np.array([[m["x_m"], m["y_m"]] for m in magnets])
    angle = np.array([m["angle_rad"] for m in magnets])
    at = Placed(array["x_m"], array["y_m"], array["heading_rad"])
    in_tag = Arrows.of(place, angle, length, at)
    heading = np.arctan2(*(in_tag.tip - in_tag.tail).T[1::-1])
    return Arrows.of(in_tag.tail[:, :2], heading, length, on)


def draw_map(
    axes: Axes,
    paths: dict[str, Array],
    times: dict[str, NDArray[np.int64]],
    truth: Sequence[Trajectory],
    scene: Scene,
    tags: Sequence[Tag],
    floor: Floor | None,
    colors: dict[str, str],
    unit: str,
) -> None:
    """Draw all that lies on the ground, and fit the view to it.

    ``paths`` are (n, 3) positions by device, ``times`` (n,) theirs in ns; ``truth``, ``scene``,
    ``tags`` and ``floor`` are in the same frame; ``unit`` is what lengths are in.
    """
    for t in truth:
        axes.plot(*_broken(t.position, t.time_ns), color=TRUTH_COLOR, lw=2.5, zorder=1)
    for name, position in paths.items():
        line = _broken(position, times[name])
        axes.plot(*line, color=colors[name], lw=0.8, marker=".", ms=2.5, zorder=2)
    for marker in scene.markers:
        axes.plot(*marker.position[:2], "s", color=SCENE_COLOR, mfc="none", ms=7, zorder=3)

    for tag in tags:
        _draw_tag(axes, tag)
    if floor is not None:
        plot_floor.draw_floor(axes, floor)

    solid = [t.position for t in truth] + [m.position[None] for m in scene.markers]
    solid += [ends for tag in tags for ends in (tag.known.tail, tag.known.tip)]
    solid += [] if floor is None else plot_floor.solid(floor)
    middle, half = _view(list(paths.values()), solid)
    places = np.array([s.position[:2] for s in scene.stations]).reshape(-1, 2)
    near = np.max(np.abs(places - middle), axis=1, initial=0.0) <= half * (1 + 2 * NEAR)
    if np.any(near):
        both = np.vstack([middle - half, middle + half, places[near]])
        middle = (both.min(axis=0) + both.max(axis=0)) / 2
        half = float(np.max(both.max(axis=0) - both.min(axis=0))) / 2
    half *= 1.12 if np.all(near) else 1.45  # room for the labels at the margin
    for station, inside in zip(scene.stations, near, strict=True):
        _draw_station(axes, station, bool(inside), middle, half, unit)
    axes.set_xlim(middle[0] - half, middle[0] + half)
    axes.set_ylim(middle[1] - half, middle[1] + half)
    axes.set_aspect("equal")
    if floor is not None:
        plot_floor.name_landmarks(axes, floor)
    axes.grid(color="0.92")
    axes.set_axisbelow(True)
    axes.set_xlabel(f"x [{unit}]")
    axes.set_ylabel(f"y [{unit}]")
    out = sum(
        int(np.count_nonzero(np.any(np.abs(p[:, :2] - middle) > half, axis=1)))
        for p in paths.values()
    )
    if out:
        axes.set_title(f"{out} poses lie outside this view", loc="left", fontsize=9)


def _broken(position: Array, time_ns: NDArray[np.int64]) -> tuple[Array, Array]:
    """x and y of a path, with nan where it is silent for long."""
    gaps = np.flatnonzero(np.diff(time_ns) > BREAK_NS) + 1
    x, y = np.insert(position[:, :2], gaps, np.nan, axis=0).T
    return x, y


def _view(paths: Sequence[Array], solid: Sequence[Array]) -> tuple[Array, float]:
    """Middle (2,) and half the width of the square that holds the paths.

    All of what is ``solid``; of the solved poses all but the outermost, which may be wild.
    """
    corners = [f(p[:, :2], axis=0) for p in solid if len(p) for f in (np.min, np.max)]
    solved = np.concatenate([p[:, :2] for p in paths]) if paths else np.zeros((0, 2))
    solved = solved[np.isfinite(solved).all(axis=1)]
    if len(solved):
        corners.extend(np.percentile(solved, (1, 99), axis=0))
    box = np.array(corners) if corners else np.array([[-1.0, -1.0], [1.0, 1.0]])
    low, high = box.min(axis=0), box.max(axis=0)
    return (low + high) / 2, max(float(np.max(high - low)) / 2, 0.05)


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


def _draw_station(
    axes: Axes, station: Station, inside: bool, middle: Array, half: float, unit: str
) -> None:
    """A station with the direction it looks in, or at the margin the way to it."""
    place, label = station.position[:2], f"ch {station.channel}"
    if inside:
        # A flat arrow shrinks as the station looks down.
        tip = place + station.rotation[:2, 0] * 0.22 * half
        axes.plot(*place, "o", color=SCENE_COLOR, ms=6, zorder=4)
        label_at, shift = place, 13 if tip[1] < place[1] else -13
    else:
        away = place - middle
        label += f"\n{float(np.linalg.norm(away)):.2g} {unit}"
        tip = middle + away * 0.98 * half / np.max(np.abs(away))
        place = tip - 0.09 * half * away / np.linalg.norm(away)
        label_at, shift = middle + (tip - middle) * 0.82, 0
    look = {"arrowstyle": "-|>", "color": SCENE_COLOR, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", xy=(tip[0], tip[1]), xytext=(place[0], place[1]), arrowprops=look)
    axes.annotate(
        label,
        (label_at[0], label_at[1]),
        xytext=(0, shift),
        textcoords="offset points",
        ha="center",
        va="center",
        fontsize=8,
    )


def legend(
    colors: dict[str, str],
    scene: Scene,
    tags: Sequence[Tag],
    floor: Floor | None,
    with_truth: bool,
) -> list[Line2D]:
    """What the signs of the map mean."""

    def sign(label: str, **look: Any) -> Line2D:
        return Line2D([], [], **{"color": SCENE_COLOR, "label": label, "ls": "", **look})

    named = list(colors)
    if len(named) > IN_LEGEND:
        named = named[: IN_LEGEND - 1]
    handles = [sign(_short(name), color=colors[name], ls="-", marker=".") for name in named]
    if len(named) < len(colors):
        handles.append(sign(f"and {len(colors) - len(named)} more"))
    if with_truth:
        handles.append(sign("truth", color=TRUTH_COLOR, ls="-", lw=2.5))
    if scene.markers:
        handles.append(sign("marker", marker="s", mfc="none", ms=7))
    if scene.stations:
        handles.append(sign("station", marker="o", ms=6))
    if tags:
        handles.append(sign("magnet", marker="o", mfc="none", ms=6))
    if any(tag.found for tag in tags):
        handles.append(sign("as found", color=FOUND_COLOR, marker="o", mfc="none", ms=3))
    if floor is not None:
        handles += [sign(**look) for look in plot_floor.signs(floor)]
    return handles


def _short(name: str) -> str:
    # A leading underscore would hide it from the legend.
    return plain((name if len(name) <= 18 else f"{name[:7]}...{name[-8:]}").lstrip("_") or "_ ")


def plain(text: str) -> str:
    """Text in which a dollar is a dollar, not the start of a formula."""
    return text.replace("$", r"\$")
