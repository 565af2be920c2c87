"""Reports on base stations in the metadata of a session: ``station-<channel>``.

The entries are texts; numbers are restored exactly. The calibration of a station is not among
them: it is in ``scene.toml`` under ``[[calibrations]]``, and the record names only its source.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace

from locatk.core.errors import FormatError, InputError
from locatk.core.lighthouse.calibration import Calibration
from locatk.core.lighthouse.recording import StationReport
from locatk.core.lighthouse.scene import Scene
from locatk.core.lighthouse.scene.gravity import up_from_acceleration
from locatk.formats.artifacts.scene import attached_scene
from locatk.formats.sessions.reader import Session

PREFIX = "station-"
"""Prefix of the names of the records, in front of the channel."""

_COUNTS = ("sweeps", "missed", "frames", "damaged")
_OPTIONAL = ("missed",)


def station_record(station: StationReport) -> dict[str, str]:
    """Return the metadata record of a station; unknown values have no entry."""
    values = {
        "id": None if station.id is None else f"{station.id:08x}",
        "period_ticks": None if station.period_ticks is None else repr(float(station.period_ticks)),
        **{key: getattr(station, key) for key in _COUNTS},
        "calibration": None if station.calibration is None else station.calibration.source,
        "acceleration": None
        if station.acceleration is None
        else " ".join(map(str, station.acceleration)),
    }
    return {key: str(value) for key, value in values.items() if value is not None}


def station_records(stations: Sequence[StationReport]) -> dict[str, dict[str, str]]:
    """Return the metadata records (name to entries) of stations, ascending in channel.

    Raises
    ------
    InputError
        Two stations have the same channel, or a number is out of range.
    """
    records: dict[str, dict[str, str]] = {}
    for station in sorted(stations, key=lambda each: each.channel):
        name = f"{PREFIX}{station.channel}"
        if name in records:
            raise InputError(f"two stations on channel {station.channel}")
        records[name] = station_record(station)
        try:
            _parse_record(name, records[name], {})
        except ValueError as error:
            raise InputError(f"the station on channel {station.channel}: {error}") from None
    return records


def add_station_data(scene: Scene | None, stations: Sequence[StationReport]) -> Scene | None:
    """Add the calibrations, serial numbers and directions that stations sent to ``scene``.

    Those that the scene already has for a channel are kept. Returns ``scene`` itself if there is
    nothing to add.
    """
    calibrations = {each.channel: each.calibration for each in stations if each.calibration}
    ids = {each.channel: each.id for each in stations if each.id is not None}
    ups = {
        each.channel: up
        for each in stations
        if each.acceleration is not None
        and (up := up_from_acceleration(each.acceleration)) is not None
    }
    if not calibrations and not ids and not ups:
        return scene
    scene = scene or Scene()
    return replace(
        scene,
        calibrations={**calibrations, **scene.calibrations},
        ids={**ids, **scene.ids},
        ups={**ups, **scene.ups},
    )


def describe_unknown_stations(scene: Scene, stations: Sequence[StationReport]) -> list[str]:
    """Describe the stations of a recording that differ from that of the scene on their channel."""
    notes = []
    for each in stations:
        station = scene.station(each.channel)
        scene_id = scene.ids.get(each.channel) if station is None else station.id
        if scene_id is None or each.id is None or scene_id == each.id:
            continue
        notes.append(
            f"channel {each.channel}: the scene contains station {scene_id:08x}, the recording "
            f"was made with station {each.id:08x}. Check that the scene is of this site"
        )
    return notes


def read_station_reports(session: Session) -> tuple[StationReport, ...]:
    """Read the reports on the stations of a recording, ascending in channel; may be empty.

    Raises
    ------
    FormatError
        A record is damaged: metadata of MCAP have no checksum.
    ArtifactError
        The scene, which contains the calibrations, is damaged.
    """
    names = [name for name in session.metadata() if name.startswith(PREFIX)]
    if not names:
        return ()
    scene = attached_scene(session) or Scene()
    records = session.metadata()
    reports = []
    for name in names:
        try:
            reports.append(_parse_record(name, records[name], scene.calibrations))
        except ValueError as error:
            where = name if len(name) < 20 and name.isprintable() else ascii(name[:20])
            raise FormatError(str(error), file=session.path, where=where) from None
    return tuple(sorted(reports, key=lambda each: each.channel))


def _parse_record(
    name: str, record: Mapping[str, str], calibrations: Mapping[int, Calibration]
) -> StationReport:
    """Return the report of a record; raises ValueError with a message for people."""
    channel = name.removeprefix(PREFIX)
    if not re.fullmatch("[1-9]|1[0-6]", channel, re.ASCII):
        raise ValueError(f"channel {channel[:20]!r} is not in 1..16")
    number = record.get("id")
    if number is not None and not re.fullmatch("[0-9a-f]{1,16}", number, re.ASCII):
        raise ValueError(f"id {number[:20]!r} is no hexadecimal number")
    period = None
    if "period_ticks" in record:
        try:
            period = float(record["period_ticks"])
        except ValueError:
            period = math.nan
        if not 0 < period < math.inf:
            stated = record["period_ticks"][:20]
            raise ValueError(f"period_ticks {stated!r} is not a number above 0")
    counts: dict[str, int] = {}
    for key in _COUNTS:
        text = record.get(key, None if key in _OPTIONAL else "0")
        if text is not None:
            if not re.fullmatch("[0-9]{1,18}", text, re.ASCII):
                raise ValueError(f"{key} {text[:20]!r} is no count")
            counts[key] = int(text)
    acceleration = None
    if "acceleration" in record:
        # Signed bytes, which the station scales so that the largest is 127.
        stated = record["acceleration"][:20]
        match = re.fullmatch(r"(-?\d{1,3}) (-?\d{1,3}) (-?\d{1,3})", stated, re.ASCII)
        values = [] if match is None else [int(text) for text in match.groups()]
        if not values or max(map(abs, values)) > 128:
            raise ValueError(f"acceleration {stated!r} is not three signed bytes")
        acceleration = (values[0], values[1], values[2])
    return StationReport(
        channel=int(channel),
        id=None if number is None else int(number, 16),
        period_ticks=period,
        sweeps=counts["sweeps"],
        missed=counts.get("missed"),
        calibration=calibrations.get(int(channel)) if "calibration" in record else None,
        frames=counts["frames"],
        damaged=counts["damaged"],
        acceleration=acceleration,
    )
