"""Samples of magnetometer arrays in sessions: written in batches, read as arrays."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence

from locatk.core.polaris.array import Samples, SensorArray
from locatk.core.polaris.tag import Tags
from locatk.core.trajectory import Trajectory
from locatk.formats import samples as recordings
from locatk.formats import tags as artifacts
from locatk.formats.messages import magnetometers
from locatk.formats.samples import Kind, Recorded
from locatk.formats.session import Session

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
    truth: Sequence[Trajectory] = (),
    odometry: Sequence[Trajectory] = (),
    facts: Mapping[str, object] | None = None,
    warnings: Sequence[str] = (),
    overwrite: bool = False,
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
    truth, odometry : sequence of Trajectory
        As in :func:`locatk.formats.observations.write_session`.
    facts : mapping, optional
        Written as texts to the metadata record ``facts``.
    warnings : sequence of str
        Written to ``/log``.
    overwrite : bool
        Replace an existing file.

    Raises
    ------
    OutputExistsError, MissingDataError
        See :func:`locatk.formats.output.atomic_write`.
    InputError
        There is no sample, times do not ascend or are before 1970, a field is infinite, or
        two arrays or trajectories have the same name.
    """
    recordings.write(
        path,
        KIND,
        [Recorded(each.device, each.array, each.time_ns, each.field_t) for each in samples],
        artifact=None if tags is None else (artifacts.TAG_FILE, artifacts.dumps_tags(tags)),
        truth=truth,
        odometry=odometry,
        facts=facts,
        warnings=warnings,
        overwrite=overwrite,
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
