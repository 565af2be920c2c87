"""What was heard of each base station, in the metadata of a session: ``station-<channel>``.

The entries are texts; numbers come back as they were. A station's calibration is not among
them: it is in ``scene.toml`` under ``[[calibrations]]``, where people and solvers look for
it, and the record names only its source.
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
from locatk.formats.artifacts import scene as artifacts
from locatk.formats.sessions.reader import Session

PREFIX = "station-"
"""Of the records' names, before the channel."""

_COUNTS = ("sweeps", "missed", "frames", "damaged")
_OPTIONAL = ("missed",)


def record_of(station: StationReport) -> dict[str, str]:
    """The metadata record of a station; what is not known has no entry."""
    known = {
        "id": None if station.id is None else f"{station.id:08x}",
        "period_ticks": None if station.period_ticks is None else repr(float(station.period_ticks)),
        **{key: getattr(station, key) for key in _COUNTS},
        "calibration": None if station.calibration is None else station.calibration.source,
    }
    return {key: str(value) for key, value in known.items() if value is not None}


def records_of(stations: Sequence[StationReport]) -> dict[str, dict[str, str]]:
    """Metadata records (name to entries) of the stations of a session, ascending in channel.

    Raises
    ------
    InputError
        Two stations have the same channel, or a number cannot be.
    """
    records: dict[str, dict[str, str]] = {}
    for station in sorted(stations, key=lambda each: each.channel):
        name = f"{PREFIX}{station.channel}"
        if name in records:
            raise InputError(f"two stations were heard on channel {station.channel}")
        records[name] = record_of(station)
        try:
            _station(name, records[name], {})
        except ValueError as error:
            raise InputError(f"the station heard on channel {station.channel}: {error}") from None
    return records


def with_heard(scene: Scene | None, stations: Sequence[StationReport]) -> Scene | None:
    """``scene`` with the calibrations and serial numbers that the stations sent themselves,
    where it has none of its own for their channels."""
    calibrations = {each.channel: each.calibration for each in stations if each.calibration}
    ids = {each.channel: each.id for each in stations if each.id is not None}
    if not calibrations and not ids:
        return scene
    scene = scene or Scene()
    return replace(
        scene,
        calibrations={**calibrations, **scene.calibrations},
        ids={**ids, **scene.ids},
    )


def strangers(scene: Scene, stations: Sequence[StationReport]) -> list[str]:
    """What to say where a station that was heard is not the one of the scene on its channel."""
    notes = []
    for each in stations:
        known = scene.station(each.channel)
        number = scene.ids.get(each.channel) if known is None else known.id
        if number is None or each.id is None or number == each.id:
            continue
        notes.append(
            f"on channel {each.channel} the scene has the station {number:08x}, and the "
            f"recording heard {each.id:08x}: is it the scene of this place?"
        )
    return notes


def read_heard(session: Session) -> tuple[StationReport, ...]:
    """The stations that a recording heard, ascending in channel; none where it does not tell.

    Raises
    ------
    FormatError
        A record is damaged: MCAP does not guard them with a checksum.
    ArtifactError
        The scene is damaged, which holds the calibrations.
    """
    names = [name for name in session.metadata() if name.startswith(PREFIX)]
    if not names:
        return ()
    scene = artifacts.attached_scene(session) or Scene()
    records = session.metadata()
    found = []
    for name in names:
        try:
            found.append(_station(name, records[name], scene.calibrations))
        except ValueError as error:
            place = name if len(name) < 20 and name.isprintable() else ascii(name[:20])
            raise FormatError(str(error), file=session.path, where=place) from None
    return tuple(sorted(found, key=lambda each: each.channel))


def _station(
    name: str, record: Mapping[str, str], calibrations: Mapping[int, Calibration]
) -> StationReport:
    """The station of a record; raises ValueError, which says what is wrong."""
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
            raise ValueError(f"period_ticks {record['period_ticks'][:20]!r} is no number above 0")
    counts: dict[str, int] = {}
    for key in _COUNTS:
        text = record.get(key, None if key in _OPTIONAL else "0")
        if text is not None:
            if not re.fullmatch("[0-9]{1,18}", text, re.ASCII):
                raise ValueError(f"{key} {text[:20]!r} is no count")
            counts[key] = int(text)
    return StationReport(
        channel=int(channel),
        id=None if number is None else int(number, 16),
        period_ticks=period,
        sweeps=counts["sweeps"],
        missed=counts.get("missed"),
        calibration=calibrations.get(int(channel)) if "calibration" in record else None,
        frames=counts["frames"],
        damaged=counts["damaged"],
    )
