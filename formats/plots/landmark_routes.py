"""Picture of routes over a floor of landmarks, colored by the predicted accuracy (matplotlib)."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray

from locatk.core.landmarks.design.routes import RouteCheck
from locatk.core.landmarks.drawing.floor_bars import bars_on_floor, cells_near
from locatk.core.landmarks.map.floor import FloorMap
from locatk.formats.plots.figure_files import write_figure

Array = NDArray[np.float64]

WIDTH_INCHES, MIN_HEIGHT_INCHES, MAX_HEIGHT_INCHES = 10.0, 4.0, 12.0
"""Size of the picture; its height follows that of the floor."""

COLOR_MAP = "viridis_r"
"""Light for accurate, dark for inaccurate parts, also in grey."""

POLE_COLORS = ("#D9A9A0", "#A9C4D9")
"""Colors of the north and south halves of bars, pale below the routes."""

MAX_LABELLED_CELLS = 40
"""Rows or columns up to which each has its number."""


def write_routes_picture(
    path: str | os.PathLike[str],
    floor: FloorMap,
    checks: Sequence[RouteCheck],
    *,
    overwrite: bool = False,
) -> None:
    """Draw a floor from above and its routes, colored by the standard deviation of the position.

    Parameters
    ----------
    path : path
        The output (.png, .svg or .pdf). The same arguments result in the same bytes.
    floor : FloorMap
    checks : sequence of RouteCheck
    overwrite : bool
        Replace an existing file.

    Raises
    ------
    InputError, OutputExistsError, MissingDataError
        See :func:`~.figure_files.write_figure`.
    """
    write_figure(path, lambda: draw_routes(floor, checks), overwrite=overwrite)


def draw_routes(floor: FloorMap, checks: Sequence[RouteCheck]) -> Figure:
    """Return the figure of :func:`write_routes_picture`."""
    cells = cells_near(floor, [check.accuracy.position_m for check in checks])
    points = [np.array([floor.position(cell) for cell in cells]).reshape(-1, 2)]
    points += [check.route.waypoint_m for check in checks]
    low, high = np.concatenate(points).min(axis=0), np.concatenate(points).max(axis=0)
    low, high = low - 0.5 * floor.pitch_m, high + 0.5 * floor.pitch_m
    aspect = (high[1] - low[1]) / (high[0] - low[0])
    height = float(
        np.clip(0.85 * WIDTH_INCHES * aspect + 1.4, MIN_HEIGHT_INCHES, MAX_HEIGHT_INCHES)
    )
    figure = Figure(figsize=(WIDTH_INCHES, height), layout="constrained")
    axes = figure.subplots()
    _draw_bars(axes, floor, cells)
    _draw_sigmas(figure, axes, checks)
    _draw_visits(axes, floor, checks)
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_aspect("equal")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    _label_cells(axes, floor)
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=5, frameon=False)
    return figure


def _draw_bars(axes: Axes, floor: FloorMap, cells: Sequence[tuple[int, int]]) -> None:
    """Draw the two halves of each bar; missing bars are left out."""
    if not cells:
        return
    bars = [bars_on_floor(floor, cell) for cell in cells]
    centre, heading, strength = (np.concatenate(each) for each in zip(*bars, strict=True))
    kept = np.abs(np.nan_to_num(strength)) > 0
    centre, heading = centre[kept], heading[kept]
    direction = np.column_stack([np.cos(heading), np.sin(heading)])
    along = direction * floor.geometry.bar_length_m / 2
    across = direction[:, ::-1] * [-1, 1] * floor.geometry.bar_width_m / 2
    for end, color in zip((along, -along), POLE_COLORS, strict=True):
        corners = [centre - across, centre + end - across, centre + end + across, centre + across]
        axes.add_collection(
            PolyCollection(list(np.stack(corners, axis=1)), facecolor=color, edgecolor="none")
        )


def _draw_sigmas(figure: Figure, axes: Axes, checks: Sequence[RouteCheck]) -> None:
    """Draw the routes, colored where the robot knows its pose, with the scale of the colors."""
    sigmas = [1e3 * check.accuracy.position_rms_m for check in checks if check.is_localizable]
    known = np.concatenate(sigmas) if sigmas else np.zeros(0)
    known = known[np.isfinite(known)]
    norm = Normalize(0.0, float(known.max()) if len(known) else 1.0)
    for number, check in enumerate(checks):
        label = "not localised" if number == 0 else None
        line = check.route.waypoint_m
        axes.plot(*line.T, color="0.55", lw=1.5, ls=(0, (3, 2)), label=label, zorder=2)
        if not check.is_localizable:
            continue
        position, sigma = check.accuracy.position_m, 1e3 * check.accuracy.position_rms_m
        mean = (sigma[:-1] + sigma[1:]) / 2
        is_known = np.isfinite(mean)
        lines = LineCollection(
            list(np.stack([position[:-1], position[1:]], axis=1)[is_known]),
            cmap=COLOR_MAP,
            norm=norm,
            linewidths=4.0,
            capstyle="round",
            zorder=3,
        )
        lines.set_array(mean[is_known])
        axes.add_collection(lines)
    if len(known):
        scale = mpl.cm.ScalarMappable(norm, COLOR_MAP)
        bar = figure.colorbar(scale, ax=axes, shrink=0.9, pad=0.02)
        bar.set_label("standard deviation of the position [mm]")


def _draw_visits(axes: Axes, floor: FloorMap, checks: Sequence[RouteCheck]) -> None:
    """Draw where landmarks are read, where each robot starts and where it is localised."""
    visits = [visit for check in checks for visit in check.visits]
    for is_read, face, label in ((True, "black", "landmark read"), (False, "white", "only grazed")):
        centres = [floor.position(visit.cell) for visit in visits if visit.is_read == is_read]
        if centres:
            axes.plot(*np.array(centres).T, "o", ms=4, mfc=face, mec="black", label=label, zorder=5)
    starts = np.array([check.route.waypoint_m[0] for check in checks])
    axes.plot(*starts.T, "s", ms=7, color="#0072B2", label="start", zorder=4)
    for check, start in zip(checks, starts, strict=True):
        axes.annotate(
            check.route.name.replace("$", r"\$"),
            start,
            xytext=(6, 6),
            textcoords="offset points",
            color="#0072B2",
            zorder=6,
            bbox={"fc": "white", "ec": "none", "alpha": 0.7, "pad": 1},
        )
    at_m = [(check, check.localized_m) for check in checks if check.localized_m is not None]
    if at_m:
        places = np.array([check.route.at(np.array([m]))[0][0] for check, m in at_m])
        axes.plot(
            *places.T, "*", ms=14, mfc="#D55E00", mec="white", label="localised here", zorder=6
        )


def _label_cells(axes: Axes, floor: FloorMap) -> None:
    """Number columns at the top and rows at the right, if there are not too many."""
    rows, columns = floor.shape
    top, right = axes.secondary_xaxis("top"), axes.secondary_yaxis("right")
    for count, origin, set_ticks in (
        (columns, floor.origin_m[0], top.set_xticks),
        (rows, floor.origin_m[1], right.set_yticks),
    ):
        ticks = range(0, count, math.ceil(count / MAX_LABELLED_CELLS))
        set_ticks([origin + floor.pitch_m * tick for tick in ticks], list(map(str, ticks)))
    top.set_xlabel("column")
    right.set_ylabel("row")
