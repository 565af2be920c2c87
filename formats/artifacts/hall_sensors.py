"""Artifact of the landmarks: the robot's hall sensors, ``halls.toml``.

Its keys are described in docs/formats.md. Lengths are in mm, exactly: what is written and
read again is the same to the last bit.
"""

from __future__ import annotations

import math

import numpy as np

from locatk.core.landmarks.halls import HallSensors
from locatk.formats.artifacts import toml
from locatk.formats.artifacts.base import Artifact, head
from locatk.formats.artifacts.checks import above, twin
from locatk.formats.artifacts.toml import Shifted, Table

HALLS_FILE = "halls.toml"
"""Name of the attachment that holds the hall sensors of a session; see
:func:`attached_halls`."""

HALLS_FORMAT = "locatk-hall-sensors"
VERSION = 1

LARGEST_HALLS = 1_000

_MM, _METRES = 3, -3
_MT, _UT = 3, 6


def dumps_halls(sensors: HallSensors) -> str:
    """TOML text of hall sensors; the same sensors give the same text. What is not known of
    them is left out."""
    return toml.dumps(
        {
            **head(HALLS_FORMAT, VERSION),
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
    if (one := twin(position)) is not None:
        raise table.error("position_mm", f"two sensors at the place of {names[one]!r}")
    sensors = HallSensors(
        names=names,
        position_m=position,
        noise_t=above(table, "noise_ut", math.nan, shift=-_UT),
        range_t=above(table, "range_mt", math.inf, shift=-_MT),
        sensor=table.text("sensor", ""),
    )
    table.end()
    return sensors


HALLS = Artifact(HALLS_FILE, dumps_halls, _halls)
"""Hall sensors as a file; these are its methods."""

write_halls, read_halls, loads_halls = HALLS.write, HALLS.read, HALLS.loads
attached_halls, halls_file = HALLS.attached_for, HALLS.file_for
