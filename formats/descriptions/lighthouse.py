"""Description of Lighthouse recordings and scenes as plain values: sweeps, stations, receivers."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np

from locatk.core.errors import LocatkError
from locatk.core.lighthouse.channels import period_ticks
from locatk.core.lighthouse.receiver import Receiver
from locatk.core.lighthouse.recording import StationReport
from locatk.core.lighthouse.scene import Scene
from locatk.formats.sessions import capture_record, observations
from locatk.formats.sessions.reader import Session
from locatk.formats.sessions.solutions import SOLUTION_FILE
from locatk.formats.sessions.station_reports import describe_unknown_stations

T = TypeVar("T")

CHANNELS = range(1, 17)


def describe_recording(session: Session) -> dict[str, Any]:
    """Describe sweeps, stations and receivers of a session or a solution.

    Damaged parts are left out and reported under ``damage``.
    """
    damage: dict[str, Any] = {}

    def read_or_none(read: Callable[[Session], T]) -> T | None:
        try:
            return read(session)
        except LocatkError as error:
            if not damage:  # The first problem is reported.
                damage.update(capture_record.describe_damage(session, error))
            return None

    known = read_or_none(observations.read_scene) or Scene()
    reports = read_or_none(observations.read_station_reports) or ()
    receivers = read_or_none(observations.read_receivers) or {}
    detections = read_or_none(_detections) or []
    counts, sweeps = read_or_none(_sweeps) or (None, {})
    return {
        **sweeps,
        "receivers": [describe_receiver(layout, device) for device, layout in receivers.items()],
        **damage,
        **describe_scene(known, counts, reports, detections),
    }


def _sweeps(session: Session) -> tuple[dict[int, int] | None, dict[str, Any]]:
    """Count the sweeps of each channel, and describe them.

    In a large session only the index is read, and the counts are None.
    """
    topics = session.topics(observations.SWEEP_TOPIC_PREFIX)
    if not topics:
        return None, {}
    if not capture_record.is_small(session, topics):
        known = [capture_record.samples(session, topic) for topic in topics]
        return None, {
            "devices": [topic.removeprefix(observations.SWEEP_TOPIC_PREFIX) for topic in topics],
            "sweeps": None if None in known else sum(number or 0 for number in known),
            "unread_bytes": capture_record.held_bytes(session, topics),
        }
    sweeps = observations.read_sweeps(session)
    channels, numbers = np.unique(sweeps.channel, return_counts=True)
    counts = dict(zip(channels.tolist(), numbers.tolist(), strict=True))
    return counts, {"devices": list(sweeps.devices), "sweeps": len(sweeps)}


def _detections(session: Session) -> list[dict[str, Any]]:
    """Read the stations of a solution; empty if the file is not a solution or has another form."""
    data = session.attachment(SOLUTION_FILE)
    try:
        detections = [] if data is None else json.loads(data)["detections"]
        return [each for each in detections if each["channel"] in CHANNELS]
    except (ValueError, KeyError, TypeError, RecursionError):
        return []


def describe_scene(
    known: Scene,
    counts: Mapping[int, int] | None = None,
    reports: Iterable[StationReport] = (),
    detections: Sequence[Mapping[str, Any]] = (),
) -> dict[str, Any]:
    """Describe a scene and all stations.

    Parameters
    ----------
    known : Scene
        Stations that are solved, or of which calibration or id is known.
    counts : mapping of int to int, optional
        Number of sweeps by channel.
    reports : iterable of StationReport
        Stations as a recording reports them.
    detections : sequence of mapping
        Stations in the solution, in their JSON form.
    """
    reported = {report.channel: report for report in reports}
    solved = {each["channel"]: each for each in detections}
    channels = {each.channel for each in known.stations} or set(solved)
    channels |= known.calibrations.keys() | known.ids.keys()
    channels |= reported.keys() | (counts or {}).keys()
    stations = []
    for channel in sorted(channels):
        in_scene = known.station(channel)
        entry = describe_station(reported.get(channel), channel)
        calibration = known.calibrations.get(channel) if in_scene is None else in_scene.calibration
        if calibration is not None:
            entry["calibration"] = calibration.source
        number = known.ids.get(channel) if in_scene is None else in_scene.id
        if number is not None:
            entry["id"] = number
        detection = solved.get(channel)
        if counts is not None:
            entry["sweeps"] = counts.get(channel, 0)
        elif detection is not None:
            entry["sweeps"] = detection.get("sweeps")
        for key in ("rejected", "verification_rad", "verification_m"):
            entry[key] = None if detection is None else detection.get(key)
        entry["position_m"] = None if in_scene is None else in_scene.position
        stations.append(entry)
    return {
        "stations": stations,
        "markers": len(known.markers),
        "scale": known.scale if known.stations else None,
        "planar": known.planar,
        "frame": known.frame,
        "notes": [*known.notes, *describe_unknown_stations(known, list(reported.values()))],
    }


def describe_station(report: StationReport | None, channel: int) -> dict[str, Any]:
    """Describe a station as a recording reports it; a period that is unknown is the nominal one."""
    nominal = int(period_ticks(channel))
    period = None if report is None else report.period_ticks
    entry: dict[str, Any] = {
        "channel": channel,
        "id": None,
        "period_ticks": nominal if period is None else period,
        "ppm": None if period is None else 1e6 * (period / nominal - 1),
        "sweeps": None,
        "missed": None,
        "decode_rate": None,
        "calibration": None,
        "frames": None,
        "damaged": None,
    }
    if report is not None:
        for key in ("id", "sweeps", "missed", "decode_rate", "frames", "damaged"):
            entry[key] = getattr(report, key)
        if report.calibration is not None:
            entry["calibration"] = report.calibration.source
    return entry


def describe_receiver(layout: Receiver, device: str | None = None) -> dict[str, Any]:
    """Describe the photodiodes of a device; ``size_mm`` is their extent in x, y, z."""
    position = 1e3 * layout.position_m
    return {
        **({} if device is None else {"device": device}),
        "name": layout.name or None,
        "sensors": len(layout),
        "size_mm": position.max(axis=0) - position.min(axis=0),
        "position_mm": position,
        "normal": layout.normal,
    }
