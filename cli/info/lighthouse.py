"""What `locatk info` and `locatk import` say of Lighthouse: sweeps, stations, receivers."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeVar

from locatk.core.errors import LocatkError

if TYPE_CHECKING:
    from locatk.core.lighthouse.receiver import Receiver
    from locatk.core.lighthouse.recording import StationReport
    from locatk.core.lighthouse.scene import Scene
    from locatk.formats.sessions.reader import Session

T = TypeVar("T")

Table = tuple[tuple[str, ...], list[tuple[Any, ...]]]
"""A header and its rows."""

TOPIC = "/lighthouse/"

SHOWN = {"id", "period_ticks", "sweeps", "missed", "calibration", "frames", "damaged"}
"""Entries of the records ``station-<channel>`` that stand in :func:`station_table`."""


def shown(name: str, key: str) -> bool:
    """Whether an entry of the metadata is in the table of stations."""
    return name.startswith("station-") and key in SHOWN


def recording(session: Session) -> dict[str, Any]:
    """Sweeps, stations and receivers of a session or a solution; what is damaged is left out
    and said."""
    from locatk.core.lighthouse.scene import Scene as Nothing
    from locatk.formats.sessions import description as describe
    from locatk.formats.sessions import observations

    wrong: dict[str, Any] = {}

    def tried(read: Callable[[Session], T]) -> T | None:
        try:
            return read(session)
        except LocatkError as error:
            wrong.update(wrong or describe.damage(session, error))  # the first of all
            return None

    known = tried(observations.read_scene) or Nothing()
    heard = tried(observations.read_station_reports) or ()
    receivers = tried(observations.read_receivers) or {}
    detections = tried(_detections) or []
    counts, sweeps = tried(_sweeps) or (None, {})
    return {
        **sweeps,
        "receivers": [receiver(found, device) for device, found in receivers.items()],
        **wrong,
        **scene(known, counts, heard, detections),
    }


def _sweeps(session: Session) -> tuple[dict[int, int] | None, dict[str, Any]]:
    """Sweeps of each channel, None where they are too many to be read, and what there is."""
    import numpy as np

    from locatk.formats.sessions import capture_record as captured
    from locatk.formats.sessions import observations

    topics = session.topics(TOPIC)
    if not topics:
        return None, {}
    if not captured.is_small(session, topics):
        known = [captured.samples(session, topic) for topic in topics]
        return None, {
            "devices": [topic.removeprefix(TOPIC) for topic in topics],
            "sweeps": None if None in known else sum(each or 0 for each in known),
            "unread_bytes": captured.held_bytes(session, topics),
        }
    found = observations.read_sweeps(session)
    channels, numbers = np.unique(found.channel, return_counts=True)
    counts = dict(zip(channels.tolist(), numbers.tolist(), strict=True))
    return counts, {"devices": list(found.devices), "sweeps": len(found)}


def _detections(session: Session) -> list[dict[str, Any]]:
    """What a solution says of each station; nothing where it is none, or says it otherwise."""
    import json

    from locatk.formats.sessions.solutions import SOLUTION_FILE

    data = session.attachment(SOLUTION_FILE)
    try:
        found = [] if data is None else json.loads(data)["detections"]
        return [each for each in found if each["channel"] in range(1, 17)]
    except (ValueError, KeyError, TypeError, RecursionError):
        return []


def scene(
    known: Scene,
    counts: Mapping[int, int] | None = None,
    heard: Iterable[StationReport] = (),
    detections: Sequence[Mapping[str, Any]] = (),
) -> dict[str, Any]:
    """Stations that are in the scene, were heard, solved or only seen in sweeps (``counts``,
    channel to count), and the rest of the scene."""
    from locatk.formats.sessions.station_reports import describe_unknown_stations

    measured = {each.channel: each for each in heard}
    solved = {each["channel"]: each for each in detections}
    channels = {station.channel for station in known.stations} or set(solved)
    channels |= known.calibrations.keys() | known.ids.keys()
    channels |= measured.keys() | (counts or {}).keys()
    stations = []
    for channel in sorted(channels):
        station = known.station(channel)
        entry = told(measured.get(channel), channel)
        calibration = known.calibrations.get(channel) if station is None else station.calibration
        if calibration is not None:
            entry["calibration"] = calibration.source
        number = known.ids.get(channel) if station is None else station.id
        if number is not None:
            entry["id"] = number
        detection = solved.get(channel)
        if counts is not None:
            entry["sweeps"] = counts.get(channel, 0)
        elif detection is not None:
            entry["sweeps"] = detection.get("sweeps")
        for key in ("rejected", "verification_rad", "verification_m"):
            entry[key] = None if detection is None else detection.get(key)
        entry["position_m"] = None if station is None else station.position
        stations.append(entry)
    return {
        "stations": stations,
        "markers": len(known.markers),
        "scale": known.scale if known.stations else None,
        "planar": known.planar,
        "frame": known.frame,
        "notes": [*known.notes, *describe_unknown_stations(known, list(measured.values()))],
    }


def told(station: StationReport | None, channel: int) -> dict[str, Any]:
    """What a recording tells of a station; its nominal period where it was not measured."""
    from locatk.core.lighthouse.channels import period_ticks

    nominal = int(period_ticks(channel))
    period = None if station is None else station.period_ticks
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
    if station is not None:
        entry |= {key: getattr(station, key) for key in ("id", "sweeps", "missed", "decode_rate")}
        entry |= {key: getattr(station, key) for key in ("frames", "damaged")}
        if station.calibration is not None:
            entry["calibration"] = station.calibration.source
    return entry


def receiver(found: Receiver, device: str | None = None) -> dict[str, Any]:
    """Where the photodiodes of a device sit; ``size_mm`` is how far they are apart in x, y, z."""
    position = 1e3 * found.position_m
    return {
        **({} if device is None else {"device": device}),
        "name": found.name or None,
        "sensors": len(found),
        "size_mm": position.max(axis=0) - position.min(axis=0),
        "position_mm": position,
        "normal": found.normal,
    }


def _verified(station: Mapping[str, Any]) -> str:
    off = station.get("verification_rad")
    return "-" if off is None else f"{1e3 * off:.2f}"


def station_table(stations: Sequence[Mapping[str, Any]], scale: str | None = None) -> Table:
    """Stations for people, in a scene of this scale; columns of which nothing is known are left
    out."""
    unit = "units" if scale == "unit" else "m"

    columns: list[tuple[str, bool, Callable[[Mapping[str, Any]], object]]] = [
        ("channel", True, lambda s: s["channel"]),
        ("id", True, lambda s: hexadecimal(s["id"]) or "-"),
        ("period", True, _period),
        ("ppm", _any(stations, "ppm"), lambda s: _or_dash(s["ppm"], "+.2f")),
        ("sweeps", True, lambda s: _or_dash(s["sweeps"])),
        ("rejected", _any(stations, "rejected"), lambda s: _or_dash(s["rejected"])),
        ("decoded", _any(stations, "decode_rate"), lambda s: _percent(s["decode_rate"])),
        ("calibration", True, lambda s: s["calibration"] or "-"),
        ("off others [mrad]", _any(stations, "verification_rad"), _verified),
        ("OOTX frames", _any(stations, "frames"), lambda s: _or_dash(s["frames"])),
        ("damaged", any(s["damaged"] for s in stations), lambda s: _or_dash(s["damaged"])),
        (f"position [{unit}]", _any(stations, "position_m"), lambda s: _place(s["position_m"])),
    ]
    shown = [(name, cell) for name, wanted, cell in columns if wanted]
    rows = [tuple(cell(station) for _, cell in shown) for station in stations]
    return tuple(name for name, _ in shown), rows


def _any(stations: Sequence[Mapping[str, Any]], key: str) -> bool:
    return any(station.get(key) is not None for station in stations)


def _or_dash(value: Any, form: str = "") -> str:
    return "-" if value is None else f"{value:{form}}"


def _place(position: Sequence[float] | None) -> str:
    return "-" if position is None else ", ".join(f"{x:.3f}" for x in position)


def hexadecimal(number: int | None) -> str | None:
    """A serial number as it is printed on the station."""
    return None if number is None else f"{number:08x}"


def _period(station: Mapping[str, Any]) -> str:
    """In ticks; what was measured has decimals."""
    ticks = station["period_ticks"]
    return f"{ticks}" if station["ppm"] is None else f"{ticks:.2f}"


def _percent(share: float | None) -> str:
    """Rounded down: 100 % is all of them."""
    return "-" if share is None else f"{math.floor(1000 * share + 1e-9) / 10:.1f} %"


def receiver_table(receivers: Sequence[Mapping[str, Any]]) -> Table:
    """Receivers for people."""
    header = ("receiver", "kind", "sensors", "size [mm]", "directions")
    rows = [
        (
            each.get("device", "-"),
            each["name"] or "-",
            each["sensors"],
            " x ".join(f"{size:.4g}" for size in each["size_mm"]),
            "-" if each["normal"] is None else "known",
        )
        for each in receivers
    ]
    return header, rows
