"""Signals of magnetometer arrays: the field across the bar, and the detected tags."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from plotly.colors import sample_colorscale

from locatk.core.errors import LocatkError
from locatk.core.polaris.results import TagDetection
from locatk.core.solution import Solution
from locatk.formats.plots.series import origin_ns
from locatk.formats.report.diagrams import (
    GAP_INTERVALS,
    LINES_THINNED,
    REFUSED,
    SIGNAL_COLUMNS,
    USED,
    Diagrams,
    Event,
    Signals,
    detail_panels,
    single_precision,
)
from locatk.formats.report.panels import (
    Panel,
    as_float,
    escape,
    format_value,
    join_sentences,
    reason_text,
)
from locatk.formats.report.signals import (
    FieldSamples,
    SignalSource,
    decode_field_samples,
    device_panels,
    seconds_since,
)
from locatk.formats.sessions.field_samples import MAGNETOMETERS
from locatk.formats.sessions.reader import Session

Array = NDArray[np.float64]

MAX_DETAILED_PASSES = 3
"""Number of passes that are drawn sample by sample."""

DETAIL_MARGIN_FRACTION = 0.5
"""Drawn time before and after a pass, in units of its duration."""

MIN_PASS_S = 0.1
"""Least duration of a pass in this calculation."""

MAX_LARGE_MARKS = 300
"""Number of magnets up to which their marks are large."""

FIELD_RANGE_M = 0.02
"""Distance around a magnet in which its field is measurable: about twice the height of the bar."""

MAX_COLOR = 0.88
"""End of the color scale of sensors; the yellow beyond it is invisible on white."""

NOTE = (
    "Magnitude of the field at each sensor, minus the sensor's median. Above: identified tags with "
    "their margin in steps of orientation, and other passes with the reason. Circles are detected "
    "magnets, drawn according to the mean speed of the pass."
)


def signal_panels(session: Session, solution: Solution) -> list[Panel]:
    """Return the field of each array with the detected tags, and details of some passes."""
    start_ns = origin_ns(session, solution)

    def draw(device: str, title: str, samples: FieldSamples, note: str) -> list[Panel]:
        sensor_count = samples.field_t.shape[1] // 3
        lateral_mm = _lateral_positions_mm(session, device, sensor_count)
        signals = _signals(samples, lateral_mm, start_ns)
        detections = [each for each in solution.detections if each.device == device]
        events = [_event(detection, start_ns) for detection in detections]
        recording = _draw_recording(title, signals, lateral_mm, detections, events, start_ns, note)
        duration_s = [max(event.stop_s - event.start_s, MIN_PASS_S) for event in events]
        details = detail_panels(
            f"Passes of {device} in detail",
            "Components of the field, minus their medians. The names of sensors contain their "
            "position across the bar, positive to the left.",
            signals,
            events,
            [as_float(detection.margin) for detection in detections],
            [(DETAIL_MARGIN_FRACTION * each, DETAIL_MARGIN_FRACTION * each) for each in duration_s],
            noun="passes",
            limit=MAX_DETAILED_PASSES,
            row_height_px=157,
            legend_traceorder="reversed",
        )
        return [recording, *details]

    decode = partial(decode_field_samples, MAGNETOMETERS)
    topic, schema = MAGNETOMETERS.topic, MAGNETOMETERS.schema
    source = SignalSource("Magnetic field along", topic, schema, decode, draw, NOTE)
    return device_panels(session, solution, source)


def _lateral_positions_mm(session: Session, device: str, count: int) -> Array | None:
    """Return the positions of the sensors across the bar, positive to the left, if known."""
    try:
        array = MAGNETOMETERS.attached(session, device)
    except LocatkError:
        return None
    return None if array is None or len(array) != count else 1e3 * array.position_m[:, 1]


def _signals(samples: FieldSamples, lateral_mm: Array | None, start_ns: int) -> Signals:
    """Return the field [uT] of each sensor and axis, minus its median."""
    field = samples.field_t.reshape(len(samples.time_ns), -1, 3)
    median = np.zeros(field.shape[1:], np.float32)
    is_alive = np.isfinite(field).any(axis=0)
    median[is_alive] = np.nanmedian(field[:, is_alive], axis=0)
    count = field.shape[1]
    if lateral_mm is None:
        names = [f"sensor {k + 1}" for k in range(count)]
    else:
        offsets = [f"{value:+.0f}" if round(value) else "0" for value in lateral_mm]
        names = [f"{k + 1} ({offset} mm)" for k, offset in enumerate(offsets)]
    shades = sample_colorscale("Viridis", np.linspace(0, MAX_COLOR, max(count, 2)))
    rank = np.argsort(np.argsort(_ordinates(lateral_mm, count), kind="stable"))
    return Signals(
        seconds_since(samples.time_ns, start_ns),
        1e6 * (field - median),
        names,
        [shades[k] for k in rank],
        ("x, forward [µT]", "y, left [µT]", "z, up [µT]"),
        "%{x:.2f} s, %{y:.1f} µT",
    )


def _ordinates(lateral_mm: Array | None, count: int) -> Array:
    """Return the positions of the sensors across the bar, their numbers if they are unknown."""
    return np.arange(1.0, count + 1) if lateral_mm is None else lateral_mm


def _magnet_times_s(detection: TagDetection, start_ns: int) -> list[float]:
    """Return when the bar passed each magnet, at the mean speed of the pass."""
    speed = as_float(detection.speed_mps)
    if not speed > 0:
        return []
    time_s = detection.time_s - start_ns * 1e-9
    return [time_s + magnet.x_m / speed for magnet in detection.magnets]


def _event(detection: TagDetection, start_ns: int) -> Event:
    speed = as_float(detection.speed_mps)
    times = [detection.time_s - start_ns * 1e-9, *_magnet_times_s(detection, start_ns)]
    margin_s = FIELD_RANGE_M / speed if speed > 0 else 0.0
    refused = escape(reason_text(detection.refused))
    margin = format_value(detection.margin, 1, ".2f")
    is_identified = detection.tag_id is not None
    description = (
        f"tag {detection.tag_id}" if is_identified else f"not identified: {refused}",
        f"margin {margin} steps",
        f"{len(detection.magnets)} magnets",
        f"residual {format_value(detection.residual_sigma, 1, '.2g')} sigma",
        f"speed {format_value(detection.speed_mps, 1e3, '.0f')} mm/s",
    )
    label = f"{detection.tag_id} ({margin})" if is_identified else refused
    return Event(min(times) - margin_s, max(times) + margin_s, label, description, refused)


def _draw_recording(
    title: str,
    signals: Signals,
    lateral_mm: Array | None,
    detections: Sequence[TagDetection],
    events: Sequence[Event],
    start_ns: int,
    note: str,
) -> Panel:
    """Draw the whole recording of one array: detections, a map of the field, and lines."""
    diagrams = Diagrams(3, shared_xaxes=True, row_heights=[0.1, 0.45, 0.45], vertical_spacing=0.03)
    magnitude = np.sqrt(np.sum(signals.value**2, axis=2))
    _add_field_map(diagrams, signals.time_s, magnitude, lateral_mm)
    if lateral_mm is not None:
        _add_magnets(diagrams, detections, start_ns)
    diagrams.add_signals(3, replace(signals, value=magnitude[:, :, None]))
    diagrams.add_strip(events, ("identified", "not identified"), shaded_rows=(3,))
    diagrams.limit_time(signals.time_s)
    diagrams.figure.update_yaxes(rangemode="tozero", row=3, col=1)
    return Panel(
        title,
        join_sentences(
            note,
            "" if detections else "No magnet was detected.",
            "The positions of the sensors are unknown: they are numbered."
            if lateral_mm is None
            else "",
            LINES_THINNED if len(signals.time_s) > SIGNAL_COLUMNS else "",
        ),
        diagrams.finish(
            620,
            ["sensor" if lateral_mm is None else "across the bar [mm]", "field [µT]"],
            legend_traceorder="reversed",
            legend_y=0.44,
        ),
    )


def _add_field_map(
    diagrams: Diagrams, time_s: Array, magnitude: NDArray[Any], lateral_mm: Array | None
) -> None:
    """Add the magnitude (n, sensors) over time and sensors, the largest value of each column."""
    ordinate = _ordinates(lateral_mm, magnitude.shape[1])
    order = np.argsort(ordinate, kind="stable")
    starts = np.arange(0, len(time_s), math.ceil(len(time_s) / SIGNAL_COLUMNS))
    largest = np.fmax.reduceat(magnitude, starts, axis=0)[:, order]
    x, largest = _insert_gaps(time_s[starts], largest)
    is_known = np.isfinite(largest).any()
    diagrams.figure.add_heatmap(
        x=single_precision(x),
        y=single_precision(ordinate[order]),
        z=single_precision(largest.T),
        zmin=0,
        zmax=float(np.nanpercentile(largest, 99.5)) if is_known else 1.0,
        colorscale="Greys",
        colorbar={"title": {"text": "µT"}, "len": 0.4, "y": 0.69, "x": 1.01, "thickness": 12},
        hovertemplate="%{x:.2f} s, %{y:.0f} mm: %{z:.1f} µT<extra></extra>",
        row=2,
        col=1,
    )


def _insert_gaps(time_s: Array, columns: NDArray[Any]) -> tuple[Array, NDArray[Any]]:
    """Insert empty columns where samples are missing, which a heatmap would fill."""
    if len(time_s) < 3:
        return time_s, columns
    step = float(np.median(np.diff(time_s)))
    gaps = np.flatnonzero(np.diff(time_s) > GAP_INTERVALS * step) + 1
    edges = np.column_stack([time_s[gaps - 1] + step, time_s[gaps] - step]).ravel()
    index = np.repeat(gaps, 2)
    return np.insert(time_s, index, edges), np.insert(columns, index, np.nan, axis=0)


def _add_magnets(diagrams: Diagrams, detections: Sequence[TagDetection], start_ns: int) -> None:
    """Mark the detected magnets of identified and other tags on the map of the field."""
    for is_identified, color, name in (
        (True, USED, "magnets of tags"),
        (False, REFUSED, "magnets, not identified"),
    ):
        marks = [
            (time_s, 1e3 * magnet.y_m)
            for detection in detections
            if (detection.tag_id is not None) == is_identified
            for time_s, magnet in zip(
                _magnet_times_s(detection, start_ns), detection.magnets, strict=False
            )
        ]
        points = np.array(marks or np.zeros((0, 2)))
        points = points[np.isfinite(points).all(axis=1)]
        if not len(points):
            continue
        is_large = len(points) <= MAX_LARGE_MARKS
        line = {"width": 2 if is_large else 1}
        look = {"symbol": "circle-open", "color": color, "size": 9 if is_large else 4}
        diagrams.add_marks(2, *points.T, marker={**look, "line": line}, name=name, hoverinfo="skip")
