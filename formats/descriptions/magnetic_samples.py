"""Description of the samples of magnetometers or hall sensors, with the artifact of the session."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from locatk.core.errors import FormatError, LocatkError
from locatk.core.landmarks.halls import HallSamples
from locatk.core.polaris.array import Samples
from locatk.formats.sessions import capture_record
from locatk.formats.sessions.field_samples import MissingGeometryError, SensorKind
from locatk.formats.sessions.reader import Session


def describe_samples(
    session: Session,
    read_artifact: Callable[[Session], Any],
    describe_artifact: Callable[[Any], dict[str, Any]],
    key: str,
    kind: SensorKind[Any],
    read_samples: Callable[[], list[tuple[Samples | HallSamples, dict[str, Any]]]],
    describe_sensors: Callable[[Any], dict[str, Any]],
) -> dict[str, Any]:
    """Describe the artifact and the samples of a session.

    Samples are read only if they are few and every device has some; ``read_samples`` returns
    them with the description of their sensors. Their descriptions get the name ``key``.
    """
    described: dict[str, Any] = {}
    try:
        artifact = read_artifact(session)
        if artifact is not None:
            described |= describe_artifact(artifact)
        topics = kind.topics(session)
        is_small = capture_record.is_small(session, topics)
        if topics and is_small and all(capture_record.messages(session, topic) for topic in topics):
            recordings = read_samples()
            described[key] = [{**_recorded(each), **sensors} for each, sensors in recordings]
            described["samples"] = sum(len(each) for each, _ in recordings)
        elif topics:
            entries = [_unread(session, kind, topic) for topic in topics]
            described[key] = [{**entry, **describe_sensors(known)} for entry, known in entries]
            counts = [entry["samples"] for entry, _ in entries]
            described["samples"] = None if None in counts else sum(counts)
            described["unread_bytes"] = (
                None if is_small else capture_record.held_bytes(session, topics)
            )
        if topics:
            described["devices"] = [each["device"] for each in described[key]]
    except MissingGeometryError as error:
        described["notes"] = [f"{error.message}. {error.hint}"]
    except LocatkError as error:
        described |= capture_record.describe_damage(session, error)
    return described


def _unread(session: Session, kind: SensorKind[Any], topic: str) -> tuple[dict[str, Any], Any]:
    """Describe the samples of a device without reading them; return also its geometry."""
    device = topic.removeprefix(kind.topic)
    geometry = kind.attached(session, device)
    if geometry is None:
        raise FormatError(f"no geometry of the {kind.geometry} {device!r}")
    count = capture_record.samples(session, topic) if capture_record.messages(session, topic) else 0
    entry = {
        "device": device,
        "samples": count,
        "rate_hz": capture_record.rate_hz(session, count),
        "left_out": None,
    }
    return entry, geometry


def _recorded(samples: Samples | HallSamples) -> dict[str, Any]:
    span = float(samples.time_ns[-1] - samples.time_ns[0]) * 1e-9
    return {
        "device": samples.device,
        "samples": len(samples),
        "rate_hz": (len(samples) - 1) / span if span > 0 else None,
        "left_out": int(np.count_nonzero(np.isnan(samples.field_t))),
    }
