"""Signals of hall sensors: the field under the robot, and the detected landmarks."""

from __future__ import annotations

from functools import partial

from locatk.core.errors import LocatkError
from locatk.core.landmarks.results import LandmarkDetection
from locatk.core.solution import Solution
from locatk.formats.plots.series import origin_ns
from locatk.formats.report.detections import format_cell, format_probability
from locatk.formats.report.diagrams import (
    DETAIL_WIDTH_PX,
    LINES_THINNED,
    MAX_EVENT_LABELS,
    NEUTRAL_COLORS,
    REFUSED,
    SIGNAL_COLUMNS,
    USED,
    Diagrams,
    Event,
    Signals,
    draw_details,
    select_details,
    selection_note,
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
from locatk.formats.sessions.halls import KIND
from locatk.formats.sessions.reader import Session

MAX_DETAILED_VISITS = 6
"""Number of visits that are drawn sample by sample, three in a row."""

DETAIL_BEFORE_S, DETAIL_AFTER_S = 3.0, 1.5
"""Drawn time before and after a detection, which is stamped near the end of its visit."""

MARK_HALF_WIDTH_S = 0.25
"""Half the width of the mark of a detection, of which only one time is known."""

NOTE = (
    "Above: detected landmarks with row and column on the map and pattern, refused ones with the "
    "reason."
)


def signal_panels(session: Session, solution: Solution) -> list[Panel]:
    """Return the channels of each robot with its detections, and details of some visits."""
    start_ns = origin_ns(session, solution)

    def draw(device: str, title: str, samples: FieldSamples, note: str) -> list[Panel]:
        names = _sensor_names(session, device, samples.field_t.shape[1])
        signals = Signals(
            seconds_since(samples.time_ns, start_ns),
            1e3 * samples.field_t[:, :, None],
            names,
            [NEUTRAL_COLORS[k % len(NEUTRAL_COLORS)] for k in range(len(names))],
            ("field [mT]",),
            "%{x:.2f} s, %{y:.2f} mT",
        )
        detections = [each for each in solution.detections if each.device == device]
        events = [_event(detection, start_ns) for detection in detections]
        certainty = [as_float(detection.probability) for detection in detections]
        recording = _draw_recording(title, signals, events, note)
        return [recording, *_draw_visits(device, signals, events, certainty)]

    decode = partial(decode_field_samples, KIND)
    source = SignalSource("Hall sensors of", KIND.topic, KIND.schema, decode, draw, NOTE)
    return device_panels(session, solution, source)


def _sensor_names(session: Session, device: str, count: int) -> list[str]:
    """Return the names of the sensors, numbers if they are unknown."""
    try:
        sensors = KIND.attached(session, device)
    except LocatkError:
        sensors = None
    if sensors is None or len(sensors) != count:
        return [f"sensor {k + 1}" for k in range(count)]
    return [escape(name) for name in sensors.names]


def _event(detection: LandmarkDetection, start_ns: int) -> Event:
    time_s = detection.time_s - start_ns * 1e-9
    refused = escape(reason_text(detection.refused))
    cell, pattern = format_cell(detection.cell), escape(detection.pattern or "")
    name = " ".join(filter(None, (cell, pattern)))
    description = (
        f"landmark {name}" if name else "not identified",
        f"probability {format_probability(detection.probability)} %",
        f"residual {format_value(detection.residual_sigma, 1, '.2g')} sigma",
        *([f"refused: {refused}"] if refused else []),
    )
    label = "<br>".join(filter(None, (refused, cell, pattern)))
    return Event(
        time_s - MARK_HALF_WIDTH_S, time_s + MARK_HALF_WIDTH_S, label, description, refused
    )


def _draw_recording(title: str, signals: Signals, events: list[Event], note: str) -> Panel:
    """Draw the whole recording of one robot."""
    diagrams = Diagrams(2, shared_xaxes=True, row_heights=[0.22, 0.78], vertical_spacing=0.02)
    for k, (name, color) in enumerate(zip(signals.names, signals.colors, strict=True)):
        value = signals.value[:, k, 0]
        diagrams.add_signal(2, signals.time_s, value, color, name=name, hovertemplate=signals.hover)
    diagrams.add_strip(events, ("used", "refused"), shaded_rows=(2,))
    limits = [float(signals.time_s[0]), float(signals.time_s[-1])]
    diagrams.figure.update_xaxes(range=limits)
    return Panel(
        title,
        join_sentences(
            "" if events else "No landmark was detected.",
            "Hovering over a mark shows its landmark." if len(events) > MAX_EVENT_LABELS else "",
            LINES_THINNED if len(signals.time_s) > 2 * SIGNAL_COLUMNS else "",
            note,
        ),
        diagrams.finish(420, ["vertical field [mT]"]),
    )


def _draw_visits(
    device: str, signals: Signals, events: list[Event], certainty: list[float]
) -> list[Panel]:
    """Draw some visits sample by sample; none if no samples of visits were read."""
    windows = [(e.centre_s - DETAIL_BEFORE_S, e.centre_s + DETAIL_AFTER_S) for e in events]
    read = [k for k, window in enumerate(windows) if len(signals.between(*window).time_s) > 1]
    refused = [events[k].refused for k in read]
    selected = select_details(refused, [certainty[k] for k in read], MAX_DETAILED_VISITS)
    if not selected:
        return []
    chosen = [read[k] for k in selected]
    drawn = [events[k] for k in chosen]
    diagrams = draw_details(signals, drawn, [windows[k] for k in chosen])
    for k, event in enumerate(drawn):
        color = REFUSED if event.refused else USED
        row, column = k // diagrams.columns + 1, k % diagrams.columns + 1
        diagrams.add_vertical_line(event.centre_s, row, column, color, "dot")
    height = 90 + 230 * diagrams.rows
    width = DETAIL_WIDTH_PX * diagrams.columns
    figure = diagrams.finish(height, column_titles=(), margin_t=60, width=width)
    note = selection_note(len(drawn), len(read), "visits")
    return [
        Panel(
            f"Visits of {device} in detail",
            f"{note} The dotted line is the time of the detection.",
            figure,
        )
    ]
