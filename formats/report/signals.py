"""Panels of the recorded signals: which messages are read, and which system draws them.

The modules of :mod:`locatk.formats.report.systems` draw the signals of one device each.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from typing import Any, Generic, TypeVar

import numpy as np
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from locatk.core.errors import FormatError, LocatkError
from locatk.core.solution import Solution
from locatk.formats.plots.series import origin_ns
from locatk.formats.report.panels import Panel, join_names, join_sentences
from locatk.formats.sessions import capture_record
from locatk.formats.sessions.field_samples import DeviceSamples, Geometry, SensorKind
from locatk.formats.sessions.mcap_file import DamageError, Segment, read_messages
from locatk.formats.sessions.messages import BatchError
from locatk.formats.sessions.reader import Session, open_mcap

SIGNALS_TITLE = "Signals"

MODULES = {
    system: f"locatk.formats.report.systems.{system}"
    for system in ("lighthouse", "dots", "polaris", "landmarks")
}
"""Modules with a function ``signal_panels(session, solution)``. They are imported when needed,
because OpenCV (dots) takes 0.1 s."""

MAX_READ_BYTES = 8 << 20
"""Size of a recording up to which it is read completely; of a larger one, parts are read that are
spread over its duration."""

MAX_DEVICES = 4
"""Number of devices that are drawn; the others are listed."""

T = TypeVar("T")


def signal_panels(session: Session, solution: Solution) -> list[Panel]:
    """Return at least one panel of the signals of a recording with the detections of a solution.

    The recording may be damaged, empty, or of another system; the panel describes the problem.
    Figures have no WebGL traces: browsers limit their number.
    """
    module = MODULES.get(solution.system)
    if module is None:
        return [Panel(SIGNALS_TITLE, f"Signals of the system {solution.system!r} cannot be drawn.")]
    draw: Callable[[Session, Solution], list[Panel]] = import_module(module).signal_panels
    try:
        panels = draw(session, solution)
    except LocatkError as error:
        # The report is on the solution, which is complete.
        hint = f"{error.hint}." if error.hint else ""
        note = join_sentences(f"The recording cannot be drawn: {error.message}.", hint)
        return [Panel(SIGNALS_TITLE, note)]
    if panels:
        return panels
    system = session.facts.get("system")
    problem = f"it is of {system}" if system not in (None, solution.system) else "it has none"
    return [Panel(SIGNALS_TITLE, f"No signals of {solution.system} in the recording: {problem}.")]


@dataclass(frozen=True)
class DeviceRecording(Generic[T]):
    """Samples of one device, to be drawn with a solution.

    Attributes
    ----------
    device : str
    title, note : str
        Of the first panel of the device.
    samples : T
    solution : Solution
    start_ns : int
        Origin of the time axis.
    """

    device: str
    title: str
    note: str
    samples: T
    solution: Solution
    start_ns: int

    @property
    def detections(self) -> list[Any]:
        """Detections of the device."""
        return [each for each in self.solution.detections if each.device == self.device]

    def seconds(self, time_ns: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return times on the time axis."""
        return np.asarray((time_ns - self.start_ns) * 1e-9, np.float64)


def device_panels(
    session: Session,
    solution: Solution,
    *,
    title: str,
    note: str,
    topic: str,
    schema: str,
    decode: Callable[[Session, str, list[bytes]], T],
    draw: Callable[[DeviceRecording[T]], list[Panel]],
) -> list[Panel]:
    """Return the panels of up to :data:`MAX_DEVICES` devices.

    Notes on the whole recording are in the first panel. A device without readable samples has a
    panel that describes the problem.

    Parameters
    ----------
    session : Session
    solution : Solution
    title : str
        Of a panel, before the name of the device.
    note : str
        Explanation for the first device.
    topic, schema : str
        Prefix of the topics before the name of the device, and schema of the messages.
    decode : callable
        Return the samples of a session's topic from its messages; raises FormatError.
    draw : callable
        Return the panels of a device.
    """
    topics = session.topics(topic, schema)
    payloads_by_topic, problems = read_excerpt(session, topics[:MAX_DEVICES])
    devices = [name.removeprefix(topic) for name in topics]
    notes = [note, *problems, missing_devices_note(solution, devices)]
    if len(devices) > MAX_DEVICES:
        notes.append(f"Not drawn: {join_names(devices[MAX_DEVICES:])}.")
    note = join_sentences(*notes)
    start_ns = origin_ns(session, solution)
    panels: list[Panel] = []
    for name, payloads in payloads_by_topic.items():
        device = name.removeprefix(topic)
        heading = f"{title} {device}"
        try:
            samples = decode(session, name, payloads)
        except FormatError as error:
            panels.append(Panel(heading, join_sentences(f"Not drawn: {error.message}.", note)))
            note = ""
        else:
            recording = DeviceRecording(device, heading, note, samples, solution, start_ns)
            panels += draw(recording)
            note = "Drawn as above."
    return panels


def missing_devices_note(solution: Solution, recorded: Iterable[str]) -> str:
    """Return a sentence on devices with poses that are not in the recording, empty without any."""
    # The trajectory of a photodiode is named DEVICE/SENSOR, that over one sheet DEVICE-SHEET.
    names = tuple(recorded)
    prefixes = tuple(f"{name}{separator}" for name in names for separator in "/-")
    missing = [
        t.device
        for t in solution.trajectories
        if t.device not in names and not t.device.startswith(prefixes)
    ]
    if not missing:
        return ""
    return f"The recording has no signals of {join_names(missing)}, although there are poses."


# ---- reading


def read_excerpt(
    session: Session, topics: Collection[str]
) -> tuple[dict[str, list[bytes]], list[str]]:
    """Read messages of ``topics`` from about :data:`MAX_READ_BYTES` of a file.

    Returns
    -------
    payloads : dict of str to list of bytes
        By topic, in the order of the file.
    notes : list of str
        Sentences on parts that were left out or are damaged.
    """
    names = {
        entry.id: entry.topic for entry in session.index.channels.values() if entry.topic in topics
    }
    segments = session.index.segments_with(names)
    chosen = _select_segments(segments, MAX_READ_BYTES)
    payloads: dict[str, list[bytes]] = {topic: [] for topic in sorted(topics)}
    damaged = 0
    with open_mcap(session.path) as stream:
        for segment in chosen:
            try:
                for channel, _, payload in read_messages(stream, segment, names):
                    payloads[names[channel]].append(payload)
            except DamageError:
                damaged += 1
    notes = []
    if len(chosen) < len(segments):
        size_mb = capture_record.held_bytes(session, topics) / 1e6
        notes.append(
            f"The recording is large ({size_mb:.0f} MB): {len(chosen)} of {len(segments)} parts "
            "are drawn, spread over its duration."
        )
    if damaged:
        notes.append(f"{damaged} of {len(chosen)} parts of the recording are damaged and missing.")
    return payloads, notes


def _select_segments(segments: list[Segment], limit_bytes: int) -> list[Segment]:
    """Return segments of about this size, evenly spread over the file, at least one."""
    total = sum(segment.length for segment in segments)
    if total <= limit_bytes:
        return segments
    count = max(1, len(segments) * limit_bytes // total)
    chosen = np.linspace(0, len(segments) - 1, count).round().astype(int)
    return [segments[k] for k in np.unique(chosen)]


# ---- samples of magnetic sensors


def field_panels(
    session: Session,
    solution: Solution,
    kind: SensorKind[Geometry],
    title: str,
    note: str,
    draw: Callable[[DeviceRecording[DeviceSamples[Geometry | None]]], list[Panel]],
) -> list[Panel]:
    """Return the panels of magnetic sensors; the parameters are those of :func:`device_panels`."""
    decode = partial(_decode_field_samples, kind)
    source = {"title": title, "note": note, "topic": kind.topic, "schema": kind.schema}
    return device_panels(session, solution, **source, decode=decode, draw=draw)


def _decode_field_samples(
    kind: SensorKind[Geometry], session: Session, topic: str, payloads: list[bytes]
) -> DeviceSamples[Geometry | None]:
    """Decode the samples of one device; the geometry is None if it is unknown or does not fit.

    Raises
    ------
    FormatError
        There are no samples, or a message is damaged.
    """
    try:
        first: Any = kind.layout(1).message.FromString(payloads[0]) if payloads else None
        if first is None or not first.sensors:
            raise FormatError("no samples", file=session.path, where=topic)
        sensors = int(first.sensors)
        columns = kind.layout(sensors).unpack(payloads).columns
    except (DecodeError, BatchError):
        raise FormatError("a message is damaged", file=session.path, where=topic) from None
    time_ns = columns["time_ns"]
    if not len(time_ns):
        raise FormatError("no samples", file=session.path, where=topic)
    order = np.argsort(time_ns, kind="stable")
    field_t = columns["b_tesla"].reshape(len(time_ns), sensors, -1)
    device = topic.removeprefix(kind.topic)
    geometry: Any = None
    with suppress(LocatkError):  # The field can be drawn without the positions of the sensors.
        geometry = kind.attached(session, device)
    if geometry is not None and len(geometry) != sensors:
        geometry = None
    return DeviceSamples(device, geometry, time_ns[order], field_t[order])
