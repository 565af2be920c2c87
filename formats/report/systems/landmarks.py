"""Signals of hall sensors: the field under the robot, and the detected landmarks."""

from __future__ import annotations

from locatk.core.landmarks.halls import HallSensors
from locatk.core.landmarks.results import LandmarkDetection
from locatk.core.solution import Solution
from locatk.formats.plots.shapes import COLORS
from locatk.formats.report import signal_diagrams
from locatk.formats.report.detections import format_cell, format_probability
from locatk.formats.report.diagram_grid import REFUSED, USED, DiagramGrid
from locatk.formats.report.panels import (
    Panel,
    as_float,
    escape,
    format_value,
    join_sentences,
    reason_text,
)
from locatk.formats.report.signal_diagrams import Event, Signals
from locatk.formats.report.signals import DeviceRecording, field_panels
from locatk.formats.sessions.field_samples import HALLS, DeviceSamples
from locatk.formats.sessions.reader import Session

SENSOR_COLORS = tuple(color for color in COLORS if color not in (USED, REFUSED))

MAX_DETAILED_VISITS = 6
"""Number of visits that are drawn sample by sample, three in a row."""

DETAIL_BEFORE_S, DETAIL_AFTER_S = 2.75, 1.25
"""Drawn time before and after the mark of a detection, which is near the end of its visit."""

MARK_HALF_WIDTH_S = 0.25
"""Half the width of the mark of a detection, of which only one time is known."""

NOTE = (
    "Above: detected landmarks with row and column on the map and pattern, refused ones with the "
    "reason."
)


def signal_panels(session: Session, solution: Solution) -> list[Panel]:
    """Return the channels of each robot with its detections, and details of some visits."""
    return field_panels(session, solution, HALLS, "Hall sensors of", NOTE, _draw)


def _draw(recording: DeviceRecording[DeviceSamples[HallSensors | None]]) -> list[Panel]:
    samples = recording.samples
    count = samples.field_t.shape[1]
    names = [f"sensor {k + 1}" for k in range(count)]
    if samples.geometry is not None:
        names = [escape(name) for name in samples.geometry.names]
    signals = Signals(
        recording.seconds(samples.time_ns),
        1e3 * samples.field_t,
        names,
        [SENSOR_COLORS[k % len(SENSOR_COLORS)] for k in range(count)],
        ("field [mT]",),
        "%{x:.2f} s, %{y:.2f} mT",
    )
    events = [_event(detection, recording.start_ns) for detection in recording.detections]
    grid = DiagramGrid(2, shared_xaxes=True, row_heights=[0.22, 0.78], vertical_spacing=0.02)
    signal_diagrams.add_recording(grid, signals, events, ("used", "refused"))
    is_labelled = len(events) <= signal_diagrams.MAX_EVENT_LABELS
    note = join_sentences(
        recording.note,
        "" if events else "No landmark was detected.",
        "" if is_labelled else "Hovering over a mark shows its landmark.",
        grid.thinning_note,
    )
    details = signal_diagrams.detail_panels(
        recording.device,
        "visits",
        "The dotted line is the time of the detection.",
        signals,
        events,
        limit=MAX_DETAILED_VISITS,
        mark_time=True,
    )
    return [Panel(recording.title, note, grid.finish(420, ["vertical field [mT]"])), *details]


def _event(detection: LandmarkDetection, start_ns: int) -> Event:
    time_s = detection.time_s - start_ns * 1e-9
    start_s, stop_s = time_s - MARK_HALF_WIDTH_S, time_s + MARK_HALF_WIDTH_S
    refused = escape(reason_text(detection.refused))
    cell, pattern = format_cell(detection.cell), escape(detection.pattern or "")
    name = " ".join(filter(None, (cell, pattern)))
    description = (
        f"landmark {name}" if name else "not identified",
        f"probability {format_probability(detection.probability)} %",
        f"residual {format_value(detection.residual_sigma, 1, '.2g')} sigma",
        *([f"refused: {refused}"] if refused else []),
    )
    return Event(
        start_s,
        stop_s,
        label="<br>".join(filter(None, (refused, cell, pattern))),
        description=description,
        refused=refused,
        certainty=as_float(detection.probability),
        detail_s=(start_s - DETAIL_BEFORE_S, stop_s + DETAIL_AFTER_S),
    )
