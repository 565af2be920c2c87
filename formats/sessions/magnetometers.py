"""Samples of magnetometer arrays in sessions: written in batches, read as arrays."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Unpack

from locatk.core.polaris.array import Samples, SensorArray
from locatk.core.polaris.tag import Tags
from locatk.formats.artifacts import tags as artifacts
from locatk.formats.sessions import field_samples as recordings
from locatk.formats.sessions.field_samples import Beside, Kind, Recorded
from locatk.formats.sessions.messages import magnetometers
from locatk.formats.sessions.reader import Session

KIND: Kind[SensorArray] = Kind(
    system="polaris",
    topic="/magnetometers/",
    layout=magnetometers,
    file=artifacts.ARRAY_FILE,
    device_file=artifacts.array_file,
    dumps=artifacts.dumps_array,
    attached=artifacts.attached_array,
    sensors="magnetometers",
    geometry="array",
    makers="`locatk import polaris-csv` or `locatk simulate polaris`",
)

TOPIC, SCHEMA = KIND.topic, KIND.schema


def write_session(
    path: str | os.PathLike[str],
    samples: Sequence[Samples],
    *,
    tags: Tags | None = None,
    **beside: Unpack[Beside],
) -> None:
    """Write samples, the tags over which they were taken and what is known beside them.

    Parameters
    ----------
    path : path
        The output.
    samples : sequence of Samples
        One an array, on ``/magnetometers/<device>``; the geometry is attached as
        ``array.toml``, or where the arrays differ as ``array-<device>.toml`` each. Fields
        are kept as float32, which is finer than any sensor.
    tags : Tags, optional
        Attached as ``tag.toml``.
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
        [Recorded(each.device, each.array, each.time_ns, each.field_t) for each in samples],
        artifact=None if tags is None else (artifacts.TAG_FILE, artifacts.dumps_tags(tags)),
        **beside,
    )


def read_samples(session: Session) -> list[Samples]:
    """Samples of all arrays of a session, one ``Samples`` an array, sorted by device.

    Raises
    ------
    FormatError
        There are none, a message is damaged, times do not ascend, or the array's geometry
        is missing or of another number of sensors.
    ArtifactError
        The geometry is no valid one.
    """
    return [
        Samples(each.device, each.geometry, each.time_ns, each.field_t)
        for each in recordings.read(session, KIND)
    ]
