"""Artifacts that people edit: the lighthouse scene, ``scene.toml``.

Its keys are described in docs/formats.md. Lengths are in mm, exactly: a scene that is
written and read again is the same to the last bit.
"""

from __future__ import annotations

import math
import re
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np

from locatk.core.lighthouse.calibration import MODELS, PARAMETERS, Calibration
from locatk.core.lighthouse.scene import Distance, Marker, MarkerVisit, Scene, Station
from locatk.formats.artifacts import toml
from locatk.formats.artifacts.base import Artifact, head
from locatk.formats.artifacts.checks import above
from locatk.formats.artifacts.toml import Inline, Shifted, Table

SCENE_FILE = "scene.toml"
"""Name of the attachment that holds the scene of a session or a solution."""

SCENE_FORMAT = "locatk-lighthouse-scene"
SCENE_VERSION = 1

SCALES = ("markers", "distance", "odometry", "device", "unit")
SOURCES = ("factory", "generic", "estimated", "none")

ANGLES = ("phase", "tilt", "gibphase", "ogeephase")
"""Calibration parameters that are angles; their keys end in ``_rad``."""

_TIME = re.compile(
    r"(\d{4}-\d\d-\d\d)[Tt ](\d\d:\d\d:\d\d)(?:\.(\d{1,9}))?([Zz]|[+-]\d\d:\d\d)", re.ASCII
)
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_MM = 3
_METRES = -3


def dumps_scene(scene: Scene) -> str:
    """TOML text of a scene; the same scene gives the same text."""
    in_units = bool(scene.stations) and scene.scale == "unit"
    table: dict[str, Any] = {
        **head(SCENE_FORMAT, SCENE_VERSION),
        "frame": scene.frame,
        "scale": scene.scale,
        "planar": scene.planar,
    }
    if in_units:
        table["floor_z_units"] = float(scene.floor_z)
    else:
        table["floor_z_mm"] = Shifted(scene.floor_z, _MM)
    table["notes"] = list(scene.notes) or None
    table["stations"] = [_station_table(station, in_units) for station in scene.stations]
    table["markers"] = [
        {
            "name": marker.name,
            "position_mm": Shifted(marker.position, _MM),
            "sightings": [_sighting_table(sighting) for sighting in marker.visits] or None,
        }
        for marker in scene.markers
    ]
    table["distances"] = [
        {
            "distance_mm": Shifted(distance.distance, _MM),
            "first": _sighting_table(distance.first),
            "second": _sighting_table(distance.second),
        }
        for distance in scene.distances
    ]
    table["calibrations"] = [
        {
            "channel": int(channel),
            "id": _hexadecimal(scene.ids.get(channel)),
            **_calibration_table(scene.calibrations.get(channel)),
        }
        for channel in sorted(scene.calibrations.keys() | scene.ids.keys())
    ]
    return toml.dumps({key: value for key, value in table.items() if value != []})


def _station_table(station: Station, in_units: bool) -> dict[str, Any]:
    x, y, z = station.rotation[:, 0].tolist()
    yaw, pitch = math.degrees(math.atan2(y, x)), math.degrees(math.asin(max(-1.0, min(1.0, z))))
    position = (
        {"position_units": np.asarray(station.position)}
        if in_units
        else {"position_mm": Shifted(station.position, _MM)}
    )
    covariance = "covariance_units_rad" if in_units else "covariance_m_rad"
    return {
        "#": f"looks to yaw {yaw:.1f} deg, {abs(pitch):.1f} deg {'up' if pitch > 0 else 'down'}",
        "channel": int(station.channel),
        "id": _hexadecimal(station.id),
        **position,
        "rotation": station.rotation,
        covariance: station.covariance,
        "floor_map_m": station.floor_map,
        "calibration": _calibration_table(station.calibration),
    }


def _hexadecimal(number: int | None) -> str | None:
    return None if number is None else f"{number:08x}"


def _calibration_table(calibration: Calibration | None) -> dict[str, Any]:
    if calibration is None:
        return {}
    return {
        "source": calibration.source,
        "model": calibration.model,
        **{
            name: Inline(
                {_calibration_key(p): float(v) for p, v in zip(PARAMETERS, row, strict=True)}
            )
            for name, row in zip(("first", "second"), calibration.sweeps, strict=True)
        },
    }


def _calibration_key(parameter: str) -> str:
    return f"{parameter}_rad" if parameter in ANGLES else parameter


def _sighting_table(sighting: MarkerVisit) -> dict[str, Any]:
    if sighting.counts:
        counts = {str(c): [float(n) for n in pair] for c, pair in sighting.counts.items()}
        return {"counts": Inline(counts)}
    return {
        "device": sighting.device,
        "start": None if sighting.start_ns is None else format_time(sighting.start_ns),
        "end": None if sighting.end_ns is None else format_time(sighting.end_ns),
    }


def _parse(table: Table) -> Scene:
    toml.check_format(table, SCENE_FORMAT, SCENE_VERSION)
    scale = table.text("scale", "unit", SCALES)
    stations = table.tables("stations")
    in_units = bool(stations) and scale == "unit"
    floor_z = (
        table.number("floor_z_units", 0.0)
        if in_units
        else table.number("floor_z_mm", 0.0, shift=_METRES)
    )
    calibrations, ids = _calibrations(table)
    scene = Scene(
        stations=tuple(_station(station, in_units) for station in stations),
        markers=tuple(_marker(marker) for marker in table.tables("markers")),
        distances=tuple(_distance(distance) for distance in table.tables("distances")),
        planar=table.flag("planar", None),
        floor_z=floor_z,
        scale=scale,
        frame=table.text("frame", "floor"),
        notes=table.texts("notes", ()),
        calibrations=calibrations,
        ids=ids,
    )
    table.end()
    _refuse_repeated(table, "stations", "channel", [s.channel for s in scene.stations])
    _refuse_repeated(table, "markers", "name", [m.name for m in scene.markers])
    return scene


def _refuse_repeated(table: Table, key: str, name: str, values: list[Any]) -> None:
    for number, value in enumerate(values):
        if value in values[:number]:
            raise table.error(f"{key}[{number}].{name}", f"{value!r} is there twice")


def _station(table: Table, in_units: bool) -> Station:
    channel = table.integer("channel", 1, 16)
    number = _id(table)
    if in_units:
        position = table.array("position_units", (3,))
    else:
        position = table.array("position_mm", (3,), shift=_METRES)
    rotation = table.array("rotation", (3, 3))
    with np.errstate(over="ignore", invalid="ignore"):
        turns = np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)
        turns = turns and np.linalg.det(rotation) > 0
    if not turns:
        raise table.error("rotation", "expected the rows of a rotation matrix")
    key = "covariance_units_rad" if in_units else "covariance_m_rad"
    covariance = table.array(key, (6, 6), nan=True) if key in table else None
    floor_map = table.array("floor_map_m", (3, 3)) if "floor_map_m" in table else None
    for name in (key, "floor_map_m"):
        table.raw(name, None)  # known also where it is missing
    calibration = _calibration(table.table("calibration"))
    table.end()
    return Station(channel, position, rotation, calibration, number, covariance, floor_map)


def _id(table: Table) -> int | None:
    """A station's serial number."""
    text = table.text("id", None)
    if text is None:
        return None
    if not re.fullmatch("[0-9a-fA-F]{1,16}", text):
        raise table.error("id", 'expected a hexadecimal number in quotes, as in "4cc60647"')
    return int(text, 16)


def _calibrations(table: Table) -> tuple[dict[int, Calibration], dict[int, int]]:
    """What is known of stations that are yet to be solved: calibrations and serial numbers, by
    channel."""
    entries = table.tables("calibrations")
    channels = [entry.integer("channel", 1, 16) for entry in entries]
    _refuse_repeated(table, "calibrations", "channel", channels)
    known: dict[int, Calibration] = {}
    ids: dict[int, int] = {}
    for channel, entry in zip(channels, entries, strict=True):
        number = _id(entry)
        if number is not None:
            ids[channel] = number
        if number is not None and set(entry) <= {"channel", "id"}:
            entry.end()  # its serial number is all that is known of it
        else:
            known[channel] = _calibration(entry)
    return known, ids


def _calibration(table: Table) -> Calibration:
    source = table.text("source", choices=SOURCES)
    model = table.text("model", "libsurvive", choices=MODELS)
    sweeps = np.zeros((2, len(PARAMETERS)))
    for number, name in enumerate(("first", "second")):
        # Without calibration there is nothing to say: all zero.
        sweep = table.table(name, None) if source == "none" else table.table(name)
        if sweep is not None:
            sweeps[number] = [sweep.number(_calibration_key(p)) for p in PARAMETERS]
            sweep.end()
    table.end()
    return Calibration(sweeps, source, model)


def _marker(table: Table) -> Marker:
    marker = Marker(
        name=table.text("name"),
        position=table.array("position_mm", (3,), shift=_METRES),
        visits=tuple(_sighting(sighting) for sighting in table.tables("sightings")),
    )
    table.end()
    return marker


def _distance(table: Table) -> Distance:
    distance = above(table, "distance_mm", shift=_METRES)
    first, second = (_sighting(table.table(name)) for name in ("first", "second"))
    table.end()
    return Distance(first, second, distance)


def _sighting(table: Table) -> MarkerVisit:
    if "counts" in table:
        counts = table.table("counts")
        found = {_channel(counts, key): _pair(counts, key) for key in counts}
        table.end()
        return MarkerVisit(counts=found)
    device = table.text("device")
    start, end = (_time(table, key) for key in ("start", "end"))
    if end < start:
        raise table.error("end", "is before start")
    table.raw("counts", None)
    table.end()
    return MarkerVisit(device, start, end)


def _channel(table: Table, key: str) -> int:
    if not re.fullmatch("[1-9][0-9]?", key) or int(key) > 16:
        raise table.error(key, "expected a channel from 1 to 16 as key")
    return int(key)


def _pair(table: Table, key: str) -> tuple[float, float]:
    first, second = table.array(key, (2,)).tolist()
    if min(first, second) < 0:
        raise table.error(key, "a count is below 0")
    return first, second


def _time(table: Table, key: str) -> int:
    value = table.raw(key)
    # TOML's own date and time without quotes is welcome; it holds microseconds.
    text = value.isoformat() if isinstance(value, datetime) else value
    time_ns = parse_time(text) if isinstance(text, str) else None
    if time_ns is None:
        raise table.error(key, 'expected a time with its zone, as in "2023-07-27T15:34:22.700963Z"')
    return time_ns


SCENE = Artifact(SCENE_FILE, dumps_scene, _parse)
"""The scene as a file; these are its methods."""

write_scene, read_scene = SCENE.write, SCENE.read
loads_scene, attached_scene = SCENE.loads, SCENE.attached


def parse_time(text: str) -> int | None:
    """Nanoseconds since the epoch of an RFC 3339 time; None where it is none."""
    found = _TIME.fullmatch(text)
    if found is None:
        return None
    day, clock, fraction, zone = found.groups()
    try:
        whole = datetime.fromisoformat(f"{day}T{clock}{zone.upper().replace('Z', '+00:00')}")
        seconds = (whole - _EPOCH) // timedelta(seconds=1)
    except (ValueError, OverflowError):
        return None
    time_ns = seconds * 1_000_000_000 + int((fraction or "").ljust(9, "0"))
    return time_ns if abs(time_ns) < 1 << 63 else None


def format_time(time_ns: int) -> str:
    """RFC 3339 text of nanoseconds since the epoch, in UTC, with all nine digits."""
    seconds, nanos = divmod(int(time_ns), 1_000_000_000)
    whole = _EPOCH + timedelta(seconds=seconds)
    return f"{whole:%Y-%m-%dT%H:%M:%S}.{nanos:09d}Z"
