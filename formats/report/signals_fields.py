"""Field sensors of a recording, device by device: what magnetometers and hall sensors share."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from locatk.core.errors import FormatError, LocatkError
from locatk.core.solution import Solution
from locatk.formats.report import signals_drawing as drawing
from locatk.formats.report.panel import Panel
from locatk.formats.report.signals_reading import MOST_DEVICES, excerpt
from locatk.formats.sessions.field_samples import SensorKind
from locatk.formats.sessions.messages import BatchError
from locatk.formats.sessions.reader import Session


@dataclass(frozen=True)
class Fields:
    """Samples of field sensors: times (n,) in ns, ascending, and fields (n, N * axes) in T."""

    time_ns: NDArray[np.int64]
    field_t: NDArray[np.float32]


Draw = Callable[[str, str, Fields, Sequence[str]], list[Panel]]
"""Panels of a device, of the title of the first of them, its samples, and notes to tell."""


def each_device(
    session: Session, solution: Solution, kind: SensorKind[Any], title: str, draw: Draw
) -> list[Panel]:
    """Panels of all devices with samples of a kind, :data:`MOST_DEVICES` at most.

    What must be known of the whole recording is told in the first of them; a device of which
    nothing can be read has a panel that says so.
    """
    topics = session.topics(kind.topic, kind.schema)
    read = excerpt(session, topics[:MOST_DEVICES])
    devices = [topic.removeprefix(kind.topic) for topic in topics]
    notes = [*read.notes, *drawing.strangers(solution, devices)]
    if len(devices) > MOST_DEVICES:
        notes.append(f"Not drawn: {drawing.listed(devices[MOST_DEVICES:])}.")
    found: list[Panel] = []
    for topic, payloads in read.payloads.items():
        device = topic.removeprefix(kind.topic)
        name = f"{title} {device}"
        try:
            samples = fields(session, kind, topic, payloads)
        except LocatkError as error:
            found.append(Panel(name, " ".join([f"Not drawn: {error.message}.", *notes])))
        else:
            found += draw(device, name, samples, notes)
        notes = []
    return found


def fields(session: Session, kind: SensorKind[Any], topic: str, payloads: list[bytes]) -> Fields:
    """Samples of one device; where its sensors sit need not be known.

    Raises
    ------
    FormatError
        There are none, or a message is damaged.
    """
    try:
        first: Any = kind.layout(1).message.FromString(payloads[0]) if payloads else None
        if first is None or not first.sensors:
            raise FormatError("no samples", file=session.path, where=topic)
        batches = kind.layout(int(first.sensors)).unpack(payloads)
    except (DecodeError, BatchError):
        raise FormatError("a message is damaged", file=session.path, where=topic) from None
    time_ns = batches.columns["time_ns"]
    if not len(time_ns):
        raise FormatError("no samples", file=session.path, where=topic)
    order = np.argsort(time_ns, kind="stable")
    return Fields(time_ns[order], batches.columns["b_tesla"].reshape(len(time_ns), -1)[order])
