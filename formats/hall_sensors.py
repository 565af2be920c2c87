"""Artifact of the landmarks: the robot's hall sensors, ``halls.toml``.

Its keys are described in docs/formats.md. Lengths are in mm, exactly: what is written and
read again is the same to the last bit.
"""

from __future__ import annotations

import math
import os
from typing import TYPE_CHECKING

import numpy as np

from locatk.core.landmarks.halls import HallSensors
from locatk.formats import toml
from locatk.formats.output import atomic_write, tool_version
from locatk.formats.toml import Shifted, Table

if TYPE_CHECKING:
    from locatk.formats.session import Session

HALLS_FILE = "halls.toml"
"""Name of the attachment that holds the hall sensors of a session; see
:func:`attached_halls`."""

HALLS_FORMAT = "locatk-hall-sensors"
VERSION = 1

LARGEST_HALLS = 1_000

_MM, _METRES = 3, -3
_MT, _UT = 3, 6


def write_halls(
    path: str | os.PathLike[str], sensors: HallSensors, *, overwrite: bool = False
) -> None:
    """Write hall sensors as TOML.

    Raises
    ------
    OutputExistsError, MissingDataError
        See :func:`locatk.formats.output.atomic_write`.
    """
    with atomic_write(path, overwrite=overwrite) as stream:
        stream.write(dumps_halls(sensors).encode())


def read_halls(path: str | os.PathLike[str]) -> HallSensors:
    """Read hall sensors that a person or :func:`write_halls` has written.

    Raises
    ------
    MissingDataError
        There is no such file.
    ArtifactError
        They are no valid sensors; the error names the key and what was expected.
    """
    return _halls(toml.read(path))


def loads_halls(text: str | bytes, *, file: str | os.PathLike[str] | None = None) -> HallSensors:
    """Hall sensors of TOML text; ``file`` is named in errors.

    Raises
    ------
    ArtifactError
        A key is missing, unknown or wrong; the error names it and what was expected.
    """
    return _halls(toml.loads(text, file if file is not None else "<halls>"))


def attached_halls(session: Session, device: str | None = None) -> HallSensors | None:
    """The hall sensors that are attached to a session for ``device``, or None.

    They are in ``halls-<device>.toml`` where the devices of a session have different ones,
    in ``halls.toml`` where they share them.

    Raises
    ------
    FormatError, ArtifactError
        The attachment is damaged, or holds no valid sensors.
    """
    for file in [HALLS_FILE] if device is None else [halls_file(device), HALLS_FILE]:
        data = session.attachment(file)
        if data is not None:
            return loads_halls(data, file=f"{session.path}:{file}")
    return None


def halls_file(device: str) -> str:
    """Name of the attachment that holds the hall sensors of one device alone."""
    return f"halls-{device}.toml"


def dumps_halls(sensors: HallSensors) -> str:
    """TOML text of hall sensors; the same sensors give the same text. What is not known of
    them is left out."""
    return toml.dumps(
        {
            "format": HALLS_FORMAT,
            "format_version": VERSION,
            "tool_version": tool_version(),
            "sensor": sensors.sensor or None,
            "noise_ut": None if math.isnan(sensors.noise_t) else Shifted(sensors.noise_t, _UT),
            "range_mt": None if math.isinf(sensors.range_t) else Shifted(sensors.range_t, _MT),
            "names": list(sensors.names),
            "position_mm": Shifted(np.asarray(sensors.position_m, float), _MM),
        }
    )


def _halls(table: Table) -> HallSensors:
    toml.check_format(table, HALLS_FORMAT, VERSION)
    names = table.texts("names")
    if not 1 <= len(names) <= LARGEST_HALLS or not all(names):
        raise table.error("names", "expected a list of names, one a sensor")
    if len(set(names)) < len(names):
        raise table.error("names", "two sensors of one name")
    position = table.array("position_mm", (len(names), 2), shift=_METRES)
    _, first, count = np.unique(position, axis=0, return_index=True, return_counts=True)
    if (count > 1).any():
        raise table.error(
            "position_mm", f"two sensors at the place of {names[first[count > 1][0]]!r}"
        )
    sensors = HallSensors(
        names=names,
        position_m=position,
        noise_t=_above(table, "noise_ut", -_UT, math.nan),
        range_t=_above(table, "range_mt", -_MT, math.inf),
        sensor=table.text("sensor", ""),
    )
    table.end()
    return sensors


def _above(table: Table, key: str, shift: int = 0, default: float | None = None) -> float:
    if default is not None and key not in table:
        table.raw(key, None)  # known also where it is missing
        return default
    value: float = table.number(key, shift=shift)
    if value <= 0:
        raise table.error(key, "expected a number above 0")
    return value
