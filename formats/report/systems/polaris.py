"""Signals of magnetometer arrays: the field across the bar, and the detected tags."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.polaris.array import SensorArray
from locatk.core.polaris.results import TagDetection
from locatk.core.solution import Solution
from locatk.formats.report.diagram_grid import DiagramGrid
from locatk.formats.report.field_map import add_field_map, add_magnets, magnet_times_s
from locatk.formats.report.panels import (
    Panel,
    as_float,
    escape,
    format_value,
    join_sentences,
    reason_text,
)
from locatk.formats.report.signal_diagrams import Event, Signals, add_recording, detail_panels
from locatk.formats.report.signals import DeviceRecording, field_panels
from locatk.formats.report.theme import SENSOR_SHADES
from locatk.formats.sessions.field_samples import MAGNETOMETERS, DeviceSamples
from locatk.formats.sessions.reader import Session

Array = NDArray[np.float64]
Samples = DeviceSamples[SensorArray | None]

MAX_DETAILED_PASSES = 3
"""Number of passes that are drawn sample by sample."""

DETAIL_MARGIN_FRACTION = 0.5
"""Drawn time before and after a pass, in units of its duration."""

MIN_PASS_S = 0.1
"""Least duration of a pass in this calculation."""

FIELD_RANGE_M = 0.02
"""Distance around a magnet in which its field is measurable: about twice the height of the bar."""

NOTE = (
    "Magnitude of the field at each sensor, minus the sensor's median. Above: identified tags with "
    "their margin in steps of orientation, and other passes with the reason. Circles are detected "
    "magnets, drawn according to the mean speed of the pass."
)

DETAIL_NOTE = (
    "Components of the field, minus their medians. The names of sensors contain their position "
    "across the bar, positive to the left."
)


def signal_panels(session: Session, solution: Solution) -> list[Panel]:
    """Return the field of each array with the detected tags, and details of some passes."""
    return field_panels(session, solution, MAGNETOMETERS, "Magnetic field along", NOTE, _draw)


def _draw(recording: DeviceRecording[Samples]) -> list[Panel]:
    detections, start_ns = recording.detections, recording.start_ns
    is_located = recording.samples.geometry is not None
    ordinate, names = _locate_sensors(recording.samples)
    signals = _signals(recording, ordinate, names)
    events = [_event(detection, start_ns) for detection in detections]
    grid = DiagramGrid(3, shared_xaxes=True, row_heights=[0.1, 0.45, 0.45], vertical_spacing=0.03)
    magnitude = np.sqrt(np.sum(signals.value**2, axis=2))
    add_field_map(grid, 2, signals.time_s, magnitude, ordinate)
    if is_located:
        add_magnets(grid, 2, detections, start_ns)
    lines = replace(signals, value=magnitude[:, :, None])
    add_recording(grid, lines, events, ("identified", "not identified"))
    grid.figure.update_yaxes(rangemode="tozero", row=3, col=1)
    row_titles = ["across the bar [mm]" if is_located else "sensor", "field [µT]"]
    figure = grid.finish(620, row_titles, legend_traceorder="reversed", legend_y=0.44)
    note = join_sentences(
        recording.note,
        "" if detections else "No magnet was detected.",
        "" if is_located else "The positions of the sensors are unknown: they are numbered.",
        grid.thinning_note,
    )
    details = detail_panels(
        recording.device,
        "passes",
        DETAIL_NOTE,
        signals,
        events,
        limit=MAX_DETAILED_PASSES,
        legend_traceorder="reversed",
    )
    return [Panel(recording.title, note, figure), *details]


def _locate_sensors(samples: Samples) -> tuple[Array, list[str]]:
    """Return the ordinates of the sensors (across the bar in mm, or their numbers), and names."""
    numbers = range(1, samples.field_t.shape[1] + 1)
    if samples.geometry is None:
        return np.array(numbers, float), [f"sensor {number}" for number in numbers]
    ordinate = 1e3 * samples.geometry.position_m[:, 1]
    offsets = [f"{value:+.0f}" if round(value) else "0" for value in ordinate]
    return ordinate, [f"{k} ({offset} mm)" for k, offset in zip(numbers, offsets, strict=True)]


def _signals(recording: DeviceRecording[Samples], ordinate: Array, names: list[str]) -> Signals:
    """Return the field of each sensor and axis, minus its median, in colors by position."""
    field = recording.samples.field_t
    median = np.zeros(field.shape[1:], np.float32)
    is_alive = np.isfinite(field).any(axis=0)
    median[is_alive] = np.nanmedian(field[:, is_alive], axis=0)
    last = len(SENSOR_SHADES) - 1
    shades = [SENSOR_SHADES[round(last * k / max(len(names) - 1, 1))] for k in range(len(names))]
    rank = np.argsort(np.argsort(ordinate, kind="stable"))
    return Signals(
        recording.seconds(recording.samples.time_ns),
        1e6 * (field - median),
        names,
        [shades[k] for k in rank],
        ("x, forward [µT]", "y, left [µT]", "z, up [µT]"),
        "%{x:.2f} s, %{y:.1f} µT",
    )


def _event(detection: TagDetection, start_ns: int) -> Event:
    speed = as_float(detection.speed_mps)
    times = [detection.time_s - start_ns * 1e-9, *magnet_times_s(detection, start_ns)]
    margin_s = FIELD_RANGE_M / speed if speed > 0 else 0.0
    start_s, stop_s = min(times) - margin_s, max(times) + margin_s
    detail_s = DETAIL_MARGIN_FRACTION * max(stop_s - start_s, MIN_PASS_S)
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
    return Event(
        start_s,
        stop_s,
        label=f"{detection.tag_id} ({margin})" if is_identified else refused,
        description=description,
        refused=refused,
        certainty=as_float(detection.margin),
        detail_s=(start_s - detail_s, stop_s + detail_s),
    )
