"""System configurations of the Crazyflie: geometry and calibration of base stations (YAML).

The file is what cfclient saves and cflib's ``LighthouseConfigFileManager`` reads and writes;
ids in it are channels less one. Frames are ours: ``origin`` in
metres, ``rotation`` from the station (x forward, y left, z up) to the room.

Calibrations are the factory's numbers, as the stations send them. Crazyflie firmware leaves
curve and ogee out of its model and takes the gib wave elsewhere; that is a choice of the
firmware, not of the numbers, so that they are read for the full model
(:mod:`locatk.core.lighthouse.calibration`). A geometry is another matter: it was estimated
with the firmware's model, and is as good as that was. A scene that was read says so, unless
the key ``solver`` tells that it is ours.

Only factory calibrations are written. A Crazyflie that hears a station replaces others by
the factory's within half a minute, and a reader could not tell an estimate from it.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from decimal import Decimal, DecimalException
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from locatk.core.errors import ArtifactError, InputError
from locatk.core.lighthouse.calibration import GENERIC_CALIBRATION, PARAMETERS, Calibration
from locatk.core.lighthouse.channels import CHANNELS
from locatk.core.lighthouse.scene import Scene, Station
from locatk.formats.artifacts.toml import Table
from locatk.formats.files import read_bytes
from locatk.formats.output import atomic_write

TYPE = "lighthouse_system_configuration"
VERSION = "1"
SYSTEM_V2 = 2

FRAME = "room"
"""What the frame of a scene is called that comes from a Crazyflie."""

LARGEST_FILE = 1_000_000
"""Bytes. Sixteen stations take 12,000."""

DEEPEST = 8
"""Lists and mappings within each other; the format has five."""

FARTHEST_M = 1000.0
LARGEST_PARAMETER = 10.0
"""Of a calibration, where the angles are at most a turn and the rest less than 1."""

ROTATION_TOLERANCE = 1e-3
"""How far rotation matrices may be off, as those that people typed with four digits."""

MODEL_NOTE = (
    "stations are taken as the Crazyflie estimates them, whose calibration model leaves curve and "
    "ogee out: solve again for millimetres"
)

SOLVER, OURS = "solver", "locatk"
"""A key that cfclient and cflib pass over: of stations that were solved with the full model."""

HINT = "give a configuration that cfclient or cflib has saved"

_SAFE_LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_NUMBER = re.compile(r"[-+]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][-+]?[0-9]+)?")
_NO_NUMBER = re.compile(r"[-+]?\.(?:inf|nan)", re.IGNORECASE)
_ID = re.compile("[0-9]|1[0-5]")
_STANDARD_TAG = re.compile("!|tag:yaml.org,2002:(?:str|int|float|map|seq)")


def read_config(path: str | os.PathLike[str]) -> Scene:
    """Read a system configuration as a scene.

    Where geometry and calibration are known, the scene has the station; where only the
    calibration is, the calibration and the serial number. A geometry alone gets the generic
    calibration, and a note.

    Raises
    ------
    MissingDataError
        There is no such file.
    InputError
        It cannot be read.
    ArtifactError
        It is no system configuration of Lighthouse V2, or has a wrong value; the error names
        the key.
    """
    return loads_config(read_bytes(path, LARGEST_FILE + 1), file=path)


def loads_config(text: str | bytes, *, file: str | os.PathLike[str] = "<config>") -> Scene:
    """The scene of a system configuration's text; ``file`` is what errors call it.

    Raises
    ------
    ArtifactError
        As :func:`read_config`.
    """
    table = Table(_mapping(text, file), file, "")
    if table.raw("type", None) != TYPE:
        raise table.error("type", f"expected {TYPE!r}", HINT)
    if str(table.raw("version", None)) != VERSION:
        raise table.error("version", f"expected {VERSION!r}, the one version that is known")
    if table.raw("systemType", SYSTEM_V2) != SYSTEM_V2:
        raise table.error(
            "systemType", "not of Lighthouse V2 (2)", "stations of Lighthouse V1 are not supported"
        )
    notes: list[str] = []
    unread: list[str] = []
    geometries = {
        channel: _geometry(below, channel, notes, unread)
        for channel, below in _by_channel(table, "geos")
    }
    calibrations: dict[int, Calibration] = {}
    ids: dict[int, int] = {}
    for channel, below in _by_channel(table, "calibs"):
        calibration, uid = _calibration(below, unread)
        if np.any(calibration.sweeps):
            calibrations[channel] = calibration
        if uid:
            ids[channel] = uid
    unread += _unread(table, ("type", "version", "systemType", SOLVER, "geos", "calibs"))
    if unread:
        names = ", ".join(map(repr, unread[:5])) + (", ..." if len(unread) > 5 else "")
        notes.append(f"unknown keys of the Crazyflie's configuration were passed over: {names}")
    if geometries and table.raw(SOLVER, None) != OURS:
        notes.append(MODEL_NOTE)
    unknown = sorted(set(geometries) - set(calibrations))
    if unknown:
        notes.append(
            f"generic calibration of {_channels(unknown)}: the file tells their geometry only"
        )
    return Scene(
        stations=tuple(
            Station(
                channel,
                *geometries[channel],
                calibrations.get(channel, GENERIC_CALIBRATION),
                ids.get(channel),
            )
            for channel in sorted(geometries)
        ),
        scale="distance" if geometries else "unit",
        frame=FRAME,
        notes=tuple(notes),
        calibrations={c: v for c, v in sorted(calibrations.items()) if c not in geometries},
        ids={c: v for c, v in sorted(ids.items()) if c not in geometries},
    )


def dumps_config(scene: Scene) -> str:
    """YAML text of a scene for cfclient, cflib and the Crazyflie; the same scene gives the
    same text. What cannot be told in it stands in a comment.

    Raises
    ------
    InputError
        The scene has no stations, no scale, or numbers that are not finite.
    """
    if not scene.stations:
        raise InputError(
            "the scene has no stations to export", hint="solve a session first (locatk solve)"
        )
    if scene.scale == "unit":
        raise InputError(
            "the scene has no scale: a Crazyflie needs metres",
            hint="give markers or a distance to locatk solve",
        )
    geos, calibs, left_out = {}, {}, []
    calibrations = dict(scene.calibrations) | {s.channel: s.calibration for s in scene.stations}
    ids = dict(scene.ids) | {s.channel: s.id for s in scene.stations}
    for station in scene.stations:
        if not (np.all(np.isfinite(station.position)) and np.all(np.isfinite(station.rotation))):
            raise InputError(f"the pose of the station on channel {station.channel} is not finite")
        geos[station.channel - 1] = {
            "origin": np.asarray(station.position, float).tolist(),
            "rotation": np.asarray(station.rotation, float).tolist(),
        }
    for channel, calibration in sorted(calibrations.items()):
        if calibration.source != "factory":
            left_out.append(channel)
            continue
        calibs[channel - 1] = {
            "sweeps": [
                dict(zip(PARAMETERS, row, strict=True)) for row in calibration.sweeps.tolist()
            ],
            "uid": int(ids.get(channel) or 0),
        }
    head = [f"# Positions in the frame {scene.frame!r}; ids are channels less one."]
    if left_out:
        head.append(
            f"# No factory calibration of {_channels(left_out)}: "
            "the Crazyflie takes it from the light."
        )
    content = {
        "type": TYPE,
        "version": VERSION,
        "systemType": SYSTEM_V2,
        **({} if MODEL_NOTE in scene.notes else {SOLVER: OURS}),
        "geos": dict(sorted(geos.items())),
        "calibs": calibs,
    }
    return "\n".join(head) + "\n" + yaml.safe_dump(content, sort_keys=False, width=100)


def write_config(path: str | os.PathLike[str], scene: Scene, *, overwrite: bool = False) -> None:
    """Write a scene as a system configuration.

    Raises
    ------
    InputError
        As :func:`dumps_config`.
    OutputExistsError, MissingDataError
        See :func:`locatk.formats.output.atomic_write`.
    """
    text = dumps_config(scene)
    with atomic_write(path, overwrite=overwrite) as stream:
        stream.write(text.encode())


def _channels(channels: list[int]) -> str:
    return f"channel{'s' if len(channels) > 1 else ''} " + ", ".join(map(str, channels))


def _by_channel(table: Table, key: str) -> Iterator[tuple[int, Table]]:
    """What stands under each id, with the channel that it means."""
    group = table.table(key, None)
    for name in group or ():
        if not _ID.fullmatch(name):
            raise group.error(name, "expected the id of a base station, 0 to 15")
        yield int(name) + CHANNELS[0], group.table(name)


def _geometry(
    table: Table, channel: int, notes: list[str], unread: list[str]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    origin = table.array("origin", (3,))
    if np.abs(origin).max() > FARTHEST_M:
        raise table.error("origin", f"expected metres, at most {FARTHEST_M:.0f} from the origin")
    rotation = table.array("rotation", (3, 3))
    u, sizes, v = np.linalg.svd(np.clip(rotation, -2.0, 2.0))
    if np.abs(sizes - 1).max() > ROTATION_TOLERANCE or np.linalg.det(rotation) < 0:
        raise table.error("rotation", "expected the rows of a rotation matrix")
    if np.abs(sizes - 1).max() > 1e-6:
        notes.append(f"the rotation of channel {channel} was rounded: the nearest one is taken")
    if np.abs(sizes - 1).max() > 1e-9:  # rounded to 32 bits, as in the Crazyflie's memory
        rotation = u @ v
    unread += _unread(table, ("origin", "rotation"))
    return origin, rotation


def _calibration(table: Table, unread: list[str]) -> tuple[Calibration, int]:
    uid = table.integer("uid", 0, 0xFFFFFFFF)
    rows = table.raw("sweeps")
    if not isinstance(rows, list) or len(rows) != 2 or not all(isinstance(r, dict) for r in rows):
        raise table.error("sweeps", f"expected two mappings with {', '.join(PARAMETERS)}")
    sweeps = np.zeros((2, len(PARAMETERS)))
    for number, sweep in enumerate(table.tables("sweeps")):
        sweeps[number] = [sweep.number(name) for name in PARAMETERS]
        large = np.flatnonzero(np.abs(sweeps[number]) > LARGEST_PARAMETER)
        if len(large):
            raise sweep.error(
                PARAMETERS[large[0]],
                f"no calibration parameter is beyond {LARGEST_PARAMETER:.0f}",
                "let the Crazyflie receive the calibration again: it has stored a damaged one",
            )
        unread += _unread(sweep, PARAMETERS)
    unread += _unread(table, ("sweeps", "uid"))
    return Calibration(sweeps, "factory"), uid


def _unread(table: Table, known: tuple[str, ...]) -> list[str]:
    return [str(table.error(key[:40], "").where) for key in table if key not in known]


def _mapping(text: str | bytes, file: str | os.PathLike[str]) -> dict[str, Any]:
    """The mapping that the text is, with numbers as int and Decimal, the rest as strings."""
    if len(text) > LARGEST_FILE:
        raise ArtifactError(
            f"larger than {LARGEST_FILE // 1000} kB: no Crazyflie configuration",
            file=file,
            hint=HINT,
        )
    try:
        decoded = text.decode("utf-8-sig") if isinstance(text, bytes) else text
    except UnicodeDecodeError:
        raise ArtifactError("not UTF-8 text", file=file, hint=HINT) from None
    try:
        root = _tree(decoded, file)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        problem = getattr(error, "problem", None) or "damaged text"
        raise ArtifactError(
            f"not valid YAML ({problem})",
            file=file,
            where=mark.line + 1 if mark else None,
            hint=HINT,
        ) from None
    if not isinstance(root, dict):
        raise ArtifactError(
            "no Crazyflie configuration: expected a YAML mapping", file=file, hint=HINT
        )
    return root


def _tree(text: str, file: str | os.PathLike[str]) -> Any:
    """What the text's one document holds, without anchors, tags and repeated keys.

    Built from PyYAML's events: its loaders take the last of two equal keys, follow anchors
    to exponential size, and recurse as deep as the text does.
    """
    events = yaml.parse(text, Loader=_SAFE_LOADER)
    root = None
    for event in events:
        if isinstance(event, yaml.NodeEvent):
            if root is not None:
                raise _at(event, file, "more than one YAML document")
            root = _node(event, events, file, 0)
    return root


def _node(
    event: yaml.Event, events: Iterator[yaml.Event], file: str | os.PathLike[str], depth: int
) -> Any:
    """The value that begins with an event, taking the events to its end."""
    if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None) is not None:
        raise _at(event, file, "YAML anchors and aliases are not read")
    tag = getattr(event, "tag", None)
    if tag is not None and not _STANDARD_TAG.fullmatch(tag):
        raise _at(event, file, f"YAML tag {tag[:60]!r} is not read")
    if isinstance(event, yaml.ScalarEvent):
        return _scalar(event)
    if depth == DEEPEST:
        raise _at(event, file, "lists and mappings are nested too deep")
    if isinstance(event, yaml.SequenceStartEvent):
        items = []
        while not isinstance(event := next(events), yaml.SequenceEndEvent):
            items.append(_node(event, events, file, depth + 1))
        return items
    values: dict[str, Any] = {}
    while not isinstance(event := next(events), yaml.MappingEndEvent):
        if not isinstance(event, yaml.ScalarEvent):
            raise _at(event, file, "a key that is no name or number")
        key = event.value
        if key in values:
            raise _at(event, file, f"key {key[:60]!r} is there twice")
        values[key] = _node(next(events), events, file, depth + 1)
    return values


def _at(event: yaml.Event, file: str | os.PathLike[str], message: str) -> ArtifactError:
    line = event.start_mark.line + 1 if event.start_mark else None
    return ArtifactError(message, file=file, where=line, hint=HINT)


def _scalar(event: yaml.ScalarEvent) -> Any:
    text = event.value
    if event.style or not (_NUMBER.fullmatch(text) or _NO_NUMBER.fullmatch(text)):
        return text
    if text.isdigit() and len(text) < 20:
        return int(text)
    try:
        return Decimal(text)
    except DecimalException:  # .inf, .nan, an exponent of twenty digits
        return Decimal("nan")
