"""Picture of a room: maps of standard deviation, stations seen and dilution, plan and section."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patches import Patch, Polygon, Rectangle
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.lighthouse.design.report import RoomReport
from locatk.core.lighthouse.room import Room
from locatk.core.lighthouse.scene import Scene
from locatk.formats.plots.figure_files import write_figure

Array = NDArray[np.float64]

WIDTH_INCHES = 13.0
"""Width of a picture."""

VIEW_LENGTH = 0.06
"""Length of the arrow along the direction of view of a station, relative to the room."""

BAND = 0.06
"""Height of the band of a plane in the section, relative to that of the room."""

COLOUR_PERCENTILE = 98.0
"""Percentile of the covered places at which a scale of colours ends."""

UNCOVERED_COLOUR = "0.72"

STATION_COLOUR = "#c1121f"


@dataclass(frozen=True)
class _Quantity:
    """Values of the places, of which a map shows the worst along the line of sight."""

    title: str
    value: Array
    worst: Any
    colours: str
    is_count: bool = False


def write_room_maps(
    path: str | os.PathLike[str], scene: Scene, report: RoomReport, *, overwrite: bool = False
) -> None:
    """Draw maps of a room in plan and section.

    Parameters
    ----------
    path : path
        The output; its suffix is that of a picture (.png, .svg, .pdf). The same arguments result in
        the same bytes.
    scene : Scene
        With a room.
    report : RoomReport
        Its places are on a regular grid.
    overwrite : bool
        Replace an existing file.

    Raises
    ------
    InputError
        The scene has no room.
    InputError, OutputExistsError, MissingDataError
        See :func:`~.figure_files.write_figure`.
    """
    write_figure(path, lambda: draw_room_maps(scene, report), overwrite=overwrite)


def draw_room_maps(scene: Scene, report: RoomReport) -> Figure:
    """Return the figure of :func:`write_room_maps`."""
    room = scene.room
    if room is None:
        raise InputError("the scene has no room to draw", hint="Give it with --room")
    low, high = room.outline_m.min(axis=0), room.outline_m.max(axis=0)
    width, depth = (high - low).tolist()
    # Each column is a third of the picture, of which axes and colour bar take 1.3 inches.
    scale = (WIDTH_INCHES / 3 - 1.3) / width
    plan, section = float(np.clip(depth * scale, 1.6, 9.0)), max(1.0, room.height_m * scale)
    # The labels of the last colour bar need some space.
    layout = ConstrainedLayoutEngine(rect=(0.0, 0.0, 0.985, 1.0))
    figure = Figure(figsize=(WIDTH_INCHES, plan + section + 1.9), layout=layout)
    grid = figure.add_gridspec(2, 3, height_ratios=(plan, section))
    sigma = 1e3 * np.where(report.is_covered, report.sigma_m, np.inf)
    dilution = np.where(report.is_covered, report.dilution, np.inf)
    seen = report.stations_seen.astype(float)
    quantities = (
        _Quantity("standard deviation [mm]", sigma, np.max, "viridis_r"),
        _Quantity("stations seen", seen, np.min, "cividis", is_count=True),
        _Quantity("dilution", dilution, np.max, "magma_r"),
    )
    for column, quantity in enumerate(quantities):
        norm = _norm(quantity, report)
        for row, across in enumerate((1, 2)):
            axes = figure.add_subplot(grid[row, column])
            mesh = _draw_map(axes, room, report, quantity, across, norm)
            _draw_room(axes, room, scene, across)
            if row == 0:
                axes.set_title(quantity.title, fontsize=10)
                bar = figure.colorbar(mesh, ax=axes, shrink=0.9, pad=0.02)
                if quantity.is_count:
                    bar.set_ticks(np.unique(seen).tolist())
    figure.suptitle(_title(report), x=0.01, ha="left", fontsize=10)
    handles = [
        Patch(facecolor=UNCOVERED_COLOUR, label="not covered"),
        Patch(facecolor=STATION_COLOUR, label="station, its channel and direction of view"),
    ]
    if room.obstacles:
        handles.append(Patch(facecolor="white", edgecolor="black", hatch="///", label="obstacle"))
    figure.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False)
    return figure


def _title(report: RoomReport) -> str:
    needed = f"{report.min_seen} or more stations"
    count = f"{len(report.channels)} station" + "s" * (len(report.channels) != 1)
    text = f"{count}: {100 * report.covered_fraction:.1f} % covered by "
    text += needed
    if np.isfinite(report.p95_sigma_m):
        text += f", standard deviation {1e3 * report.p95_sigma_m:.1f} mm at 95 % of the places"
    along = "" if report.is_planar else " In plan: the worst over all heights."
    return f"{text}.\nUpper row: plan.{along} Lower row: section along x, the worst over all y."


def _norm(quantity: _Quantity, report: RoomReport) -> Any:
    finite = quantity.value[np.isfinite(quantity.value)]
    if quantity.is_count:
        values = np.unique(finite)
        edges = np.concatenate([values - 0.5, [values[-1] + 0.5]]) if len(values) else [0, 1]
        return BoundaryNorm(edges, 256)
    if not len(finite):
        return mpl.colors.Normalize(0.0, 1.0)
    top = float(np.percentile(finite, COLOUR_PERCENTILE))
    return mpl.colors.Normalize(float(finite.min()), max(top, 1.01 * float(finite.min())))


def _draw_map(
    axes: Axes, room: Room, report: RoomReport, quantity: _Quantity, across: int, norm: Any
) -> Any:
    """Draw the worst value along the other axis, in x and y (``across`` 1) or x and z (2)."""
    points = np.round(report.points_m, 6)
    x, column = np.unique(points[:, 0], return_inverse=True)
    y, row = np.unique(points[:, across], return_inverse=True)
    order = np.argsort(quantity.value, kind="stable")
    if quantity.worst is np.min:
        order = order[::-1]
    values = np.full((len(y), len(x)), np.nan)
    values[row[order], column[order]] = quantity.value[order]  # the worst one is written last
    y_edges = _edges(y)
    if across == 2 and len(y) == 1:
        band = BAND * room.height_m
        y_edges = np.maximum(y[0] + np.array([-0.5, 0.5]) * band, [0.0, band])
    elif across == 2:
        y_edges = np.clip(y_edges, *room.photodiode_z_m)
    is_uncovered = np.isinf(values)
    shown = np.ma.masked_invalid(values)
    mesh = axes.pcolormesh(
        _edges(x), y_edges, shown, cmap=quantity.colours, norm=norm, rasterized=True, lw=0
    )
    if np.any(is_uncovered):
        grey = np.ma.masked_where(~is_uncovered, np.ones_like(values))
        axes.pcolormesh(
            _edges(x),
            y_edges,
            grey,
            cmap=mpl.colors.ListedColormap([UNCOVERED_COLOUR]),
            rasterized=True,
        )
    return mesh


def _edges(centres: Array) -> Array:
    """Return the borders of cells by their centres."""
    if len(centres) == 1:
        return centres[0] + np.array([-0.5, 0.5])
    middle = 0.5 * (centres[1:] + centres[:-1])
    first, last = 2 * centres[0] - middle[0], 2 * centres[-1] - middle[-1]
    return np.concatenate([[first], middle, [last]])


def _draw_room(axes: Axes, room: Room, scene: Scene, across: int) -> None:
    low, high = room.outline_m.min(axis=0), room.outline_m.max(axis=0)
    size = float(max(*(high - low), room.height_m))
    if across == 1:
        axes.add_patch(Polygon(room.outline_m, fill=False, ec="black", lw=1.2))
        if room.area_m is not None:
            axes.add_patch(Polygon(room.area_m, fill=False, ec="0.3", lw=0.8, ls="--"))
    else:
        axes.add_patch(
            Rectangle(
                (low[0], 0.0), high[0] - low[0], room.height_m, fill=False, ec="black", lw=1.2
            )
        )
    for obstacle in room.obstacles:
        outline = obstacle.outline_m
        if across == 2:
            left, right = outline[:, 0].min(), outline[:, 0].max()
            bottom, top = obstacle.low_m, min(obstacle.high_m, room.height_m)
            outline = np.array([[left, bottom], [right, bottom], [right, top], [left, top]])
        axes.add_patch(Polygon(outline, fc=(1, 1, 1, 0.35), ec="black", lw=0.8, hatch="///"))
    for station in scene.stations:
        x, y = station.position[0], station.position[across]
        view = VIEW_LENGTH * size * station.rotation[[0, across], 0]
        axes.plot([x, x + view[0]], [y, y + view[1]], color=STATION_COLOUR, lw=1.6)
        axes.plot(x, y, "o", color=STATION_COLOUR, ms=4, clip_on=False)
        label = axes.annotate(
            str(station.channel),
            (x, y),
            xytext=(3, 3),
            textcoords="offset points",
            fontsize=8,
            color=STATION_COLOUR,
            fontweight="bold",
        )
        label.set_path_effects([withStroke(linewidth=2.0, foreground="white")])
    margin = 0.03 * size
    axes.set_xlim(low[0] - margin, high[0] + margin)
    axes.set_ylim(
        *((low[1] - margin, high[1] + margin) if across == 1 else (-margin, room.height_m + margin))
    )
    axes.set_aspect("equal")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]" if across == 1 else "z [m]")
