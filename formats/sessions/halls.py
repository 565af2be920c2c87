"""Samples of hall sensors in sessions: written in batches, read as arrays."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Unpack

import numpy as np
from numpy.typing import NDArray

from locatk.core.landmarks.halls import HallSamples, HallSensors
from locatk.core.landmarks.map.floor import FloorMap
from locatk.formats.artifacts import maps as artifacts
from locatk.formats.sessions import field_samples as recordings
from locatk.formats.sessions.field_samples import Beside, Kind, Recorded
from locatk.formats.sessions.messages import halls
from locatk.formats.sessions.reader import Session

KIND: Kind[HallSensors] = Kind(
    system="landmarks",
    topic="/halls/",
    layout=halls,
    file=artifacts.HALLS_FILE,
    device_file=artifacts.halls_file,
    dumps=artifacts.dumps_halls,
    attached=artifacts.attached_halls,
    sensors="hall sensors",
    geometry="robot",
    makers="`locatk import landmark-csv` or `locatk simulate landmarks`",
)

TOPIC, SCHEMA = KIND.topic, KIND.schema


def write_session(
    path: str | os.PathLike[str],
    samples: Sequence[HallSamples],
    *,
    floor: FloorMap | None = None,
    **beside: Unpack[Beside],
) -> None:
    """Write samples, the map of the floor on which they were taken and what is known beside
    them.

    Parameters
    ----------
    path : path
        The output.
    samples : sequence of HallSamples
        One a robot, on ``/halls/<device>``; its sensors are attached as ``halls.toml``, or
        where the robots' differ as ``halls-<device>.toml`` each. Fields are kept as
        float32, which is finer than any sensor.
    floor : FloorMap, optional
        Attached as ``map.toml``.
    **beside
        Truth, odometry, facts, warnings and ``overwrite``, as :func:`.samples.write`
        takes them.

    Raises
    ------
    OutputExistsError, MissingDataError, InputError
        See :func:`.samples.write`.
    """
    recordings.write(
        path,
        KIND,
        [Recorded(each.device, each.sensors, each.time_ns, each.field_t) for each in samples],
        artifact=None if floor is None else (artifacts.MAP_FILE, artifacts.dumps_map(floor)),
        **beside,
    )


def read_samples(session: Session) -> list[HallSamples]:
    """Samples of all robots of a session, one ``HallSamples`` a robot, sorted by device.

    Raises
    ------
    FormatError
        There are none, a message is damaged, times do not ascend, or the sensors are not
        told or are another number.
    ArtifactError
        The sensors are no valid ones.
    """
    return [
        HallSamples(
            each.device,
            each.geometry,
            each.time_ns,
            _still_saturated(each.field_t[:, :, 0], each.geometry.range_t),
        )
        for each in recordings.read(session, KIND)
    ]


def _still_saturated(field_t: NDArray[np.float64], range_t: float) -> NDArray[np.float64]:
    """Fields that were at the range before they were rounded to float32 are so again."""
    full = np.abs(field_t) >= np.float32(range_t)
    return np.where(full, np.copysign(np.maximum(np.abs(field_t), range_t), field_t), field_t)
