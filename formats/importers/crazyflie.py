"""System configurations of the Crazyflie: geometry and calibration of base stations (YAML).

cfclient saves the file, and cflib's ``LighthouseConfigFileManager`` reads and writes it. Ids in it
are channels less one. The frames agree with those of a scene: ``origin`` is in metres, ``rotation``
is from the station (x forward, y left, z up) to the room.

Calibrations are the parameters of the factory, as the stations send them. Crazyflie firmware omits
curve and ogee in its model and applies the gib wave to another angle, but that concerns the
firmware, not the parameters: they are read for the full model
(:mod:`locatk.core.lighthouse.calibration`). A geometry was estimated with the firmware's model and
is as accurate as that; a scene that was read has a note about it, unless the key ``solver`` states
that locatk estimated it.

Scenes are written as such files by :mod:`locatk.formats.exporters.crazyflie`.
"""

from __future__ import annotations

import os
import re
from typing import Any

import numpy as np

from locatk.core.errors import ArtifactError
from locatk.core.lighthouse.calibration import GENERIC_CALIBRATION, PARAMETERS, Calibration
from locatk.core.lighthouse.channels import CHANNELS
from locatk.core.lighthouse.scene import Scene, Station
from locatk.formats.artifacts.kinds import (
    Integer,
    InvalidValueError,
    ListOf,
    Number,
    parse_key,
    type_name,
)
from locatk.formats.artifacts.schema import Array, Key, Table, Values, unknown_keys
from locatk.formats.extras import requires_extra
from locatk.formats.files import read_head

TYPE = "lighthouse_system_configuration"
VERSION = "1"
SYSTEM_V2 = 2

FRAME = "room"
"""Frame of a scene that was read from a configuration."""

MAX_FILE_BYTES = 1_000_000
"""Sixteen stations take 12,000 bytes."""

MAX_DISTANCE_M = 1000.0
MAX_PARAMETER = 10.0
"""Largest parameter of a calibration: angles are at most 2 pi, other parameters below 1."""

ROTATION_TOLERANCE = 1e-3
"""Largest error of a singular value of a rotation, for matrices typed with four digits."""

FLOAT32_TOLERANCE = 1e-6
"""Error of a rotation that was stored with 32 bits, as in the Crazyflie's memory."""

FLOAT64_TOLERANCE = 1e-9
"""Error up to which a rotation is used unchanged."""

MAX_NAMED_KEYS = 5
MAX_KEY_CHARACTERS = 40
"""Limits of the note about ignored keys."""

MODEL_NOTE = (
    "the geometry of the stations was estimated by the Crazyflie, whose calibration model omits "
    "curve and ogee: solve again for millimetre accuracy"
)

SOLVER, OWN_SOLVER = "solver", "locatk"
"""Key that cfclient and cflib ignore, and its value for stations solved with the full model."""

HINT = "Give a configuration that cfclient or cflib has saved"

_ID = re.compile("[0-9]|1[0-5]")


def read_config(path: str | os.PathLike[str]) -> Scene:
    """Read a system configuration as a scene.

    The scene has a station for each geometry; without a calibration in the file, its calibration is
    generic, and there is a note. Calibrations without a geometry are in ``calibrations`` and
    ``ids``.

    Raises
    ------
    MissingDataError
        There is no such file.
    InputError
        It cannot be read.
    ArtifactError
        It is not a system configuration of Lighthouse V2, or has a wrong value; the error names
        the key.
    LocatkError
        PyYAML is not installed.
    """
    return loads_config(read_head(path, MAX_FILE_BYTES + 1), file=path)


def loads_config(text: str | bytes, *, file: str | os.PathLike[str] = "<config>") -> Scene:
    """Parse the text of a system configuration; errors name ``file``.

    Raises
    ------
    ArtifactError, LocatkError
        See :func:`read_config`.
    """
    data = _parse_mapping(text, file)
    try:
        return _scene_of(data)
    except InvalidValueError as error:
        raise ArtifactError(
            error.message, file=file, where=error.key or None, hint=error.hint
        ) from None


def _scene_of(data: dict[str, Any]) -> Scene:
    _check_system(data)
    notes: list[str] = []
    geometries: dict[int, dict[str, Any]] = _by_channel(data, "geos", _GEOMETRY)
    calibrations: dict[int, Calibration] = {}
    ids: dict[int, int] = {}
    for channel, entry in _by_channel(data, "calibs", _CALIBRATION).items():
        sweeps = np.array([[sweep[name] for name in PARAMETERS] for sweep in entry["sweeps"]])
        if np.any(sweeps):
            calibrations[channel] = Calibration(sweeps, "factory")
        if entry["uid"]:
            ids[channel] = entry["uid"]
    for channel, geometry in geometries.items():
        if geometry.pop("is_rounded"):
            notes.append(
                f"the rotation of channel {channel} is rounded: the nearest rotation is used"
            )
    if ignored := _ignored_keys(data):
        names = ", ".join(map(repr, ignored[:MAX_NAMED_KEYS]))
        more = ", ..." if len(ignored) > MAX_NAMED_KEYS else ""
        notes.append(f"unknown keys of the Crazyflie's configuration are ignored: {names}{more}")
    if geometries and data.get(SOLVER) != OWN_SOLVER:
        notes.append(MODEL_NOTE)
    generic = sorted(set(geometries) - set(calibrations))
    if generic:
        notes.append(
            f"generic calibration of {list_channels(generic)}: the file has their geometry only"
        )
    return Scene(
        stations=tuple(
            Station(
                channel,
                **geometries[channel],
                calibration=calibrations.get(channel, GENERIC_CALIBRATION),
                id=ids.get(channel),
            )
            for channel in sorted(geometries)
        ),
        scale="distance" if geometries else "unit",
        frame=FRAME,
        notes=tuple(notes),
        calibrations={c: v for c, v in sorted(calibrations.items()) if c not in geometries},
        ids={c: v for c, v in sorted(ids.items()) if c not in geometries},
    )


def list_channels(channels: list[int]) -> str:
    """Return ``channel 1`` or ``channels 1, 3`` for a note."""
    return f"channel{'s' if len(channels) > 1 else ''} " + ", ".join(map(str, channels))


def _check_system(data: dict[str, Any]) -> None:
    """Refuse files that are not of Lighthouse V2."""
    if data.get("type") != TYPE:
        raise InvalidValueError(f"expected {TYPE!r}", "type", HINT)
    if str(data.get("version")) != VERSION:
        raise InvalidValueError(f"expected {VERSION!r}, the only known version", "version")
    if data.get("systemType", SYSTEM_V2) != SYSTEM_V2:
        raise InvalidValueError(
            "not of Lighthouse V2 (2)",
            "systemType",
            "Stations of Lighthouse V1 are not supported",
        )


def _by_channel(data: dict[str, Any], key: str, table: Table) -> dict[int, Any]:
    """Parse the tables of stations below ``key``, by channel."""
    group = data.get(key, {})
    if not isinstance(group, dict):
        raise InvalidValueError(f"expected a table, not {type_name(group)}", key)
    for station_id in group:
        if not _ID.fullmatch(station_id):
            raise InvalidValueError(
                "expected the id of a base station, 0 to 15", f"{key}.{station_id}"
            )
    return {
        int(station_id) + CHANNELS[0]: parse_key(f"{key}.{station_id}", table, entry)
        for station_id, entry in group.items()
    }


def _geometry_of(values: Values) -> dict[str, Any]:
    """Return position and rotation of a station, and whether the rotation is rounded."""
    rotation = values["rotation"]
    u, sizes, v = np.linalg.svd(np.clip(rotation, -2.0, 2.0))
    error = np.abs(sizes - 1).max()
    if error > ROTATION_TOLERANCE or np.linalg.det(rotation) < 0:
        raise InvalidValueError("expected the rows of a rotation matrix", "rotation")
    return {
        "position": values["origin"],
        "rotation": u @ v if error > FLOAT64_TOLERANCE else rotation,
        "is_rounded": error > FLOAT32_TOLERANCE,
    }


_GEOMETRY = Table(
    (
        Key(
            "origin",
            Array((3,), Number(-MAX_DISTANCE_M, MAX_DISTANCE_M, hint="Positions are in metres")),
        ),
        Key("rotation", Array((3, 3))),
    ),
    _geometry_of,
    is_open=True,
)
_PARAMETER = Number(
    -MAX_PARAMETER,
    MAX_PARAMETER,
    hint="Let the Crazyflie receive the calibration again: the stored one is damaged",
)
_SWEEP = Table(tuple(Key(name, _PARAMETER) for name in PARAMETERS), is_open=True)
_CALIBRATION = Table(
    (Key("uid", Integer(0, 0xFFFFFFFF)), Key("sweeps", ListOf(_SWEEP, 2, 2))), is_open=True
)
_SYSTEM_KEYS = ("type", "version", "systemType", SOLVER, "geos", "calibs")


def _ignored_keys(data: dict[str, Any]) -> list[str]:
    """Return the paths of keys that are not read."""
    paths: list[str] = []
    for key, table in (("geos", _GEOMETRY), ("calibs", _CALIBRATION)):
        for station_id, entry in data.get(key, {}).items():
            path = f"{key}.{station_id}"
            for number, sweep in enumerate(entry.get("sweeps", ())[:2] if key == "calibs" else ()):
                paths += unknown_keys(_SWEEP, sweep, f"{path}.sweeps[{number}]")
            paths += unknown_keys(table, entry, path)
    return [*paths, *(name[:MAX_KEY_CHARACTERS] for name in data if name not in _SYSTEM_KEYS)]


def _parse_mapping(text: str | bytes, file: str | os.PathLike[str]) -> dict[str, Any]:
    """Parse a YAML mapping, with numbers as int and Decimal and other scalars as strings."""
    if len(text) > MAX_FILE_BYTES:
        raise ArtifactError(
            f"larger than {MAX_FILE_BYTES // 1000} kB: not a Crazyflie configuration",
            file=file,
            hint=HINT,
        )
    try:
        decoded = text.decode("utf-8-sig") if isinstance(text, bytes) else text
    except UnicodeDecodeError:
        raise ArtifactError("not UTF-8 text", file=file, hint=HINT) from None
    with requires_extra("yaml", "a Crazyflie configuration", file=file):
        from locatk.formats.importers.yaml_tree import parse_yaml
    root = parse_yaml(decoded, file=file, hint=HINT)
    if not isinstance(root, dict):
        raise ArtifactError(
            "not a Crazyflie configuration: expected a YAML mapping", file=file, hint=HINT
        )
    return root
