"""Signals of hall sensors: the field under the robot, and the detected landmarks."""

from __future__ import annotations

from functools import partial

from locatk.core.errors import LocatkError
from locatk.core.landmarks.results import LandmarkDetection
from locatk.core.solution import Solution
from locatk.formats.plots.series import origin_ns
from locatk.formats.report.detections import format_cell, format_probability
from locatk.formats.report.diagrams import (
    LINES_THINNED,
    MAX_EVENT_LABELS,
    NEUTRAL_COLORS,
    SIGNAL_COLUMNS,
    Diagrams,
    Event,
    Signals,
    detail_panels,
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
from locatk.formats.sessions.field_samples import HALLS
from locatk.formats.sessions.reader import Session

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
        details = detail_panels(
            f"Visits of {device} in detail",
            "The dotted line is the time of the detection.",
            signals,
            events,
            [as_float(detection.probability) for detection in detections],
            [(DETAIL_BEFORE_S, DETAIL_AFTER_S)] * len(events),
            noun="visits",
            limit=MAX_DETAILED_VISITS,
            row_height_px=230,
            mark_time=True,
        )
        return [_draw_recording(title, signals, events, note), *details]

    decode = partial(decode_field_samples, HALLS)
    source = SignalSource("Hall sensors of", HALLS.topic, HALLS.schema, decode, draw, NOTE)
    return device_panels(session, solution, source)


def _sensor_names(session: Session, device: str, count: int) -> list[str]:
    """Return the names of the sensors, numbers if they are unknown."""
    try:
        sensors = HALLS.attached(session, device)
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
    diagrams.add_signals(2, signals)
    diagrams.add_strip(events, ("used", "refused"), shaded_rows=(2,))
    diagrams.limit_time(signals.time_s)
    return Panel(
        title,
        join_sentences(
            note,
            "" if events else "No landmark was detected.",
            "Hovering over a mark shows its landmark." if len(events) > MAX_EVENT_LABELS else "",
            LINES_THINNED if len(signals.time_s) > 2 * SIGNAL_COLUMNS else "",
        ),
        diagrams.finish(420, ["vertical field [mT]"]),
    )
