"""Detections of each system: the tables that the command line prints, and the panel of a report."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime

import numpy as np
from plotly.graph_objects import Figure

from locatk.core.dots.results import FrameOutcome
from locatk.core.landmarks.results import LandmarkDetection
from locatk.core.polaris.results import TagDetection
from locatk.core.solution import Solution
from locatk.formats.plots.units import format_count
from locatk.formats.report.diagram_grid import REFUSED, USED, DiagramGrid
from locatk.formats.report.panels import Panel, Table, as_float, format_value, reason_text

TITLE = "Detections"

MAX_LISTED = 20
"""Number of detections in the table of a report; ``locatk solve --json`` lists all."""

HISTOGRAM_BINS = 40
"""Number of bins of a histogram; up to two share the width of a page."""

DEGREES_PER_RADIAN = math.degrees(1)


# ---- tables


OPTIONAL_COLUMNS = ("other magnets", "design", "meaning", "refused")
"""Columns that are omitted if they are empty."""


def tag_table(
    detections: Sequence[TagDetection], limit: int | None = None, *, compact: bool = False
) -> Table:
    """Return the table of detected tags in the frame of the array.

    Parameters
    ----------
    detections : sequence of TagDetection
    limit : int, optional
        Number of rows; by default all.
    compact : bool
        Write standard deviations after the values instead of in columns of their own.
    """

    def cells(detection: TagDetection) -> dict[str, str]:
        return {
            "array": detection.device,
            "tag": "-" if detection.tag_id is None else str(detection.tag_id),
            "margin [steps]": format_value(detection.margin, 1, ".2f"),
            "magnets": str(len(detection.magnets)),
            "other magnets": str(len(detection.other_magnets) or ""),
            **_pose_cells(detection, compact),
            "design": detection.design or "",
            "meaning": detection.meaning or "",
            "refused": reason_text(detection.refused),
        }

    return _table([cells(each) for each in detections], limit, device_column="array")


def landmark_table(
    detections: Sequence[LandmarkDetection], limit: int | None = None, *, compact: bool = False
) -> Table:
    """Return the table of detected landmarks with the robot's pose in the frame of each.

    The parameters are those of :func:`tag_table`.
    """

    def cells(detection: LandmarkDetection) -> dict[str, str]:
        return {
            "time (UTC)": format_clock(detection.time_s),
            "robot": detection.device,
            "cell": format_cell(detection.cell) or "-",
            "pattern": detection.pattern or "-",
            "probability [%]": format_probability(detection.probability),
            **_pose_cells(detection, compact),
            "refused": reason_text(detection.refused),
        }

    return _table([cells(each) for each in detections], limit, device_column="robot")


def _table(
    rows: Sequence[Mapping[str, str]], limit: int | None = None, device_column: str = ""
) -> Table:
    """Return the first rows, without the column of devices if there is only one device, and
    without :data:`OPTIONAL_COLUMNS` that are empty."""
    shown = rows[:limit]
    omitted_columns = set()
    if len({row.get(device_column) for row in rows}) < 2:
        omitted_columns.add(device_column)
    omitted_columns |= {
        name for name in OPTIONAL_COLUMNS if not any(row.get(name) for row in shown)
    }
    header = tuple(name for name in rows[0] if name not in omitted_columns) if rows else ()
    cells = [tuple(row[name] for name in header) for row in shown]
    return Table(header, cells, len(rows) - len(shown))


def _pose_cells(detection: TagDetection | LandmarkDetection, compact: bool) -> dict[str, str]:
    """Return the cells of position and heading with their standard deviations."""
    columns = (
        ("x", "x_m", 1e3, "mm"),
        ("y", "y_m", 1e3, "mm"),
        ("heading", "heading_rad", DEGREES_PER_RADIAN, "deg"),
    )
    values, sigmas = {}, {}
    for name, field, scale, unit in columns:
        value = format_value(getattr(detection, field), scale, ".2f")
        sigma = format_value(getattr(detection, f"sigma_{field}"), scale, ".2g")
        if compact and "-" not in (value, sigma):
            value = f"{value} \u00b1 {sigma}"
        values[f"{name} [{unit}]"] = value
        sigmas[f"sigma {name} [{unit}]"] = sigma
    return values if compact else values | sigmas


def format_cell(cell: Sequence[int] | None) -> str:
    """Format row and column of a landmark; empty if they are unknown."""
    return "" if cell is None else ",".join(map(str, cell))


def format_probability(probability: float | None) -> str:
    """Format a probability in percent; less than 1 is never rounded to 100."""
    if probability is None or not math.isfinite(probability):
        return "-"
    percent = 100 * probability
    return f"{percent:.1f}" if percent < 99.95 else "100" if percent >= 99.9995 else ">99.9"


def format_clock(time_s: float) -> str:
    """Format the time of day to the millisecond."""
    try:
        return datetime.fromtimestamp(time_s, UTC).strftime("%H:%M:%S.%f")[:-3]
    except (OverflowError, ValueError, OSError):
        return f"{time_s:g} s"


# ---- panels


def detection_panel(solution: Solution) -> Panel:
    """Return what the solver detected: stations, frames, tags or landmarks."""
    make = PANELS.get(solution.system)
    if make is None:
        return Panel(TITLE, f"{len(solution.detections)} detections of {solution.system}.")
    if not solution.detections and solution.system != "dots":
        return Panel(TITLE, "There are none.")
    return make(solution)


def _station_panel(solution: Solution) -> Panel:
    rows = [
        {
            "channel": str(detection.channel),
            "id": detection.id or "-",
            "period [ticks]": str(detection.period_ticks),
            "calibration": detection.calibration,
            "sweeps": str(detection.sweeps),
            "rejected": str(detection.rejected),
            "residual [mrad]": format_value(detection.residual_rad, 1e3, ".3f"),
        }
        for detection in solution.detections
    ]
    return Panel(
        TITLE,
        "Base stations of the recording, with the number of sweeps that are part of a pose and of "
        "sweeps from rejected moments. The residual is the angle by which light planes miss their "
        "common point, if there are redundant ones.",
        table=_table(rows),
    )


def _tag_panel(solution: Solution) -> Panel:
    detections = solution.detections
    margins = [as_float(each.margin) for each in detections if not each.refused]
    note = (
        f"{len(margins)} of {format_count(len(detections), 'passes')} over magnets "
        f"{'was' if len(margins) == 1 else 'were'} identified as a tag. Poses of tags are in the "
        "frame of the bar, with standard deviations. The margin is the difference between the "
        "distances of the second nearest and the nearest id, in steps of orientation."
    )
    table = tag_table(detections, MAX_LISTED, compact=True)
    return _list_panel(note, table, "margin [steps]", margins, "passes")


def _landmark_panel(solution: Solution) -> Panel:
    detections = solution.detections
    refused = sum(bool(each.refused) for each in detections)
    note = (
        f"{format_count(len(detections), 'visits')} to landmarks, {refused} refused. Poses of the "
        "robot are in the frame of the landmark, with standard deviations."
    )
    table = landmark_table(detections, MAX_LISTED, compact=True)
    residuals = [each.residual_sigma for each in detections]
    return _list_panel(note, table, "residual [sigma]", residuals, "visits")


def _list_panel(
    note: str, table: Table, quantity: str, values: Sequence[float], noun: str
) -> Panel:
    """Return a table of detections; if there are many, also a histogram of a quantity."""
    if table.omitted:
        note += (
            f" The first {len(table.rows)} are listed; `locatk solve --json` prints all of them."
        )
    figure = None
    if len(values) > MAX_LISTED:
        figure = _draw_histograms({quantity: {"": np.array(values, float)}}, noun)
    return Panel(TITLE, note, figure, table)


def _frame_panel(solution: Solution) -> Panel:
    frames: tuple[FrameOutcome, ...] = () if solution.facts is None else solution.facts.frames
    if not frames:
        return Panel(TITLE, f"{len(solution.detections)} frames with a position.")
    groups = {
        "decoded": [frame for frame in frames if not frame.rejected],
        "rejected": [frame for frame in frames if frame.rejected],
    }
    rows = [
        {
            "frames": name,
            "count": str(len(group)),
            "fraction [%]": f"{100 * len(group) / len(frames):.1f}",
            "dots": _format_median(group, "dots", 1, ".0f"),
            "bits corrected": _format_median(group, "corrected_bits", 1, ".0f"),
            "confidence [%]": _format_median(group, "confidence", 100, ".2f"),
        }
        for name, group in groups.items()
        if group
    ]
    values = {
        quantity: {
            f"{name} ({len(group)})": np.array([scale * getattr(each, field) for each in group])
            for name, group in groups.items()
        }
        for quantity, field, scale in (
            ("confidence [%]", "confidence", 100.0),
            ("bits corrected", "corrected_bits", 1.0),
        )
    }
    return Panel(
        TITLE,
        f"{format_count(len(frames), 'frames')} of the camera. Dots, corrected bits and confidence "
        "are medians.",
        _draw_histograms(values, "frames"),
        _table(rows),
    )


def _format_median(group: Sequence[FrameOutcome], field: str, scale: float, spec: str) -> str:
    values = np.array([getattr(frame, field) for frame in group], float)
    is_known = np.isfinite(values)
    return format_value(float(np.median(values[is_known])), scale, spec) if is_known.any() else "-"


def _draw_histograms(quantities: Mapping[str, Mapping[str, np.ndarray]], noun: str) -> Figure:
    """Draw histograms of several quantities next to each other.

    The values of a quantity are in named groups, of used and of refused detections.
    """
    grid = DiagramGrid(1, len(quantities), shared_yaxes=True, horizontal_spacing=0.06)
    for column, (quantity, groups) in enumerate(quantities.items(), 1):
        every = np.concatenate([values[np.isfinite(values)] for values in groups.values()])
        low, high = 0.0, 100.0
        if len(every) and not quantity.endswith("[%]"):
            low, high = float(every.min()), float(every.max())
            if low == high:
                low, high = low - 0.5, high + 0.5
        edges = np.linspace(low, high, HISTOGRAM_BINS + 1)
        colored = dict(
            zip(groups, zip(groups.values(), (USED, REFUSED), strict=False), strict=True)
        )
        grid.add_histogram(column, edges, colored, "%{x:.4g}: %{y}")
    has_legend = any(len(groups) > 1 for groups in quantities.values())
    return grid.finish(
        300,
        [noun],
        column_titles=list(quantities),
        barmode="stack",
        bargap=0,
        showlegend=has_legend,
    )


PANELS: dict[str, Callable[[Solution], Panel]] = {
    "lighthouse": _station_panel,
    "dots": _frame_panel,
    "polaris": _tag_panel,
    "landmarks": _landmark_panel,
}
"""Panel of detections by system."""
