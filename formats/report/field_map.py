"""Map of the magnetic field across a bar of magnetometers over time, with the detected magnets."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from locatk.core.polaris.results import TagDetection
from locatk.formats.report.diagram_grid import (
    LINES_THINNED,
    REFUSED,
    USED,
    DiagramGrid,
    single_precision,
)
from locatk.formats.report.panels import as_float
from locatk.formats.report.theme import FIELD_SCALE
from locatk.formats.report.thinning import SIGNAL_COLUMNS, column_maxima

Array = NDArray[np.float64]

MAX_LARGE_MARKS = 300
"""Number of magnets up to which their marks are large."""


def add_field_map(
    grid: DiagramGrid, row: int, time_s: Array, magnitude_ut: NDArray[Any], ordinate: Array
) -> None:
    """Add the magnitude (n, sensors) over time and the ordinates (sensors,) of the sensors."""
    if len(time_s) > SIGNAL_COLUMNS:
        grid.thinning_note = LINES_THINNED
    order = np.argsort(ordinate, kind="stable")
    x, largest = column_maxima(time_s, magnitude_ut[:, order])
    is_known = np.isfinite(largest).any()
    grid.figure.add_heatmap(
        x=single_precision(x),
        y=single_precision(ordinate[order]),
        z=single_precision(largest.T),
        zmin=0,
        zmax=float(np.nanpercentile(largest, 99.5)) if is_known else 1.0,
        colorscale=FIELD_SCALE,
        colorbar={
            **{"title": {"text": "µT"}, "len": 0.4, "y": 0.69, "x": 1.01, "thickness": 12},
            "outlinewidth": 0,
        },
        hovertemplate="%{x:.2f} s, %{y:.0f} mm: %{z:.1f} µT<extra></extra>",
        row=row,
        col=1,
    )


def add_magnets(
    grid: DiagramGrid, row: int, detections: Sequence[TagDetection], start_ns: int
) -> None:
    """Mark the detected magnets of identified and other tags on a map in millimetres."""
    for is_identified, color, name in (
        (True, USED, "magnets of tags"),
        (False, REFUSED, "magnets, not identified"),
    ):
        marks = [
            (time_s, 1e3 * magnet.y_m)
            for detection in detections
            if (detection.tag_id is not None) == is_identified
            for time_s, magnet in zip(
                magnet_times_s(detection, start_ns), detection.magnets, strict=False
            )
        ]
        x, y = np.array(marks or np.zeros((0, 2))).T
        is_finite = np.isfinite(x) & np.isfinite(y)
        size_px, width_px = (9, 2) if np.count_nonzero(is_finite) <= MAX_LARGE_MARKS else (4, 1)
        marker = {"color": color, "size": size_px, "symbol": "circle-open"}
        marker["line"] = {"width": width_px}
        look = {"name": name, "hoverinfo": "skip"}
        grid.add_marks(row, x[is_finite], y[is_finite], marker, **look)


def magnet_times_s(detection: TagDetection, start_ns: int) -> list[float]:
    """Return when the bar passed each magnet, at the mean speed of the pass; [] if it is unknown.

    ``start_ns`` is the origin of the time axis.
    """
    speed = as_float(detection.speed_mps)
    if not speed > 0:
        return []
    time_s = detection.time_s - start_ns * 1e-9
    return [time_s + magnet.x_m / speed for magnet in detection.magnets]
