"""Conversion of received records to the observations of the streams, with their artifacts."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import groupby
from typing import Any

import numpy as np

from locatk.core.dots.frames import Frames
from locatk.core.errors import InputError, LocatkError
from locatk.core.geometry import quaternion_from_heading
from locatk.core.inertial import InertialSamples
from locatk.core.landmarks.halls import HallSamples
from locatk.core.lighthouse.recording import Sweeps
from locatk.core.polaris.array import Samples
from locatk.core.trajectory import Trajectory
from locatk.formats import images
from locatk.formats.artifacts.maps import HALLS
from locatk.formats.artifacts.schema import Artifact
from locatk.formats.artifacts.tags import ARRAY
from locatk.formats.capture.camera import Frame
from locatk.formats.capture.ingestion import SYSTEMS, TimedBatch
from locatk.formats.sessions.field_samples import restore_saturation

Observations = Sweeps | Samples | HallSamples | Frames | Trajectory | InertialSamples
"""What a stream takes; see :class:`locatk.core.streaming.events.Stream`."""


class AttachedArtifacts:
    """Artifacts of an input that belong to its devices.

    Parameters
    ----------
    texts : mapping of str to str
        Attachments of a session: name to TOML.

    Attributes
    ----------
    texts : dict of str to str
    """

    def __init__(self, texts: Mapping[str, str]) -> None:
        self.path = None
        self.texts = dict(texts)

    def add(self, texts: Mapping[str, str]) -> None:
        """Add attachments, such as those that follow from the device."""
        self.texts = {**texts, **self.texts}

    def attachment(self, name: str) -> bytes | None:
        """Return the content of an attachment, or None."""
        text = self.texts.get(name)
        return None if text is None else text.encode()

    def of_device(self, artifact: Artifact[Any], device: str) -> Any:
        """Return the artifact of a device, or None."""
        return artifact.attached_for(self, device)


class RecordConverter:
    """Converts the records of one input.

    Parameters
    ----------
    artifacts : AttachedArtifacts

    Attributes
    ----------
    ignored : set of str
        Kinds of records that no stream uses.
    """

    def __init__(self, artifacts: AttachedArtifacts) -> None:
        self._artifacts = artifacts
        self._geometry: dict[str, Any] = {}
        self.ignored: set[str] = set()

    def observations(self, records: Iterable[TimedBatch]) -> Iterator[Observations]:
        """Yield the observations of records, in their order.

        Raises
        ------
        InputError
            The geometry of a sensor is unknown or of another number of sensors.
        """
        for kind, group in groupby(records, key=lambda batch: batch.stream.kind):
            if kind == "lighthouse":
                yield _sweeps(list(group))
                continue
            convert = _CONVERSIONS.get(kind)
            if convert is None:
                self.ignored.add(kind)
                continue
            for batch in group:
                yield convert(self, batch)

    def _magnetometers(self, batch: TimedBatch) -> Samples:
        array = self._sensors(ARRAY, batch, "array")
        # Recordings have float32: with the same values, live and recorded poses are the same.
        field_t = batch.columns["b_tesla"].astype(np.float32).astype(np.float64)
        return Samples(
            batch.device, array, batch.time_ns, field_t.reshape(len(batch.time_ns), -1, 3)
        )

    def _halls(self, batch: TimedBatch) -> HallSamples:
        sensors = self._sensors(HALLS, batch, "robot")
        field_t = batch.columns["b_tesla"].astype(np.float32).astype(np.float64)
        return HallSamples(
            batch.device, sensors, batch.time_ns, restore_saturation(field_t, sensors.range_t)
        )

    def _sensors(self, artifact: Artifact[Any], batch: TimedBatch, name: str) -> Any:
        """Return the geometry of the sensors of a device."""
        geometry = self._geometry.get(batch.device)
        if geometry is None:
            geometry = self._artifacts.of_device(artifact, batch.device)
            if geometry is None:
                raise InputError(
                    f"no geometry of the {name} {batch.device!r}",
                    hint=f"Give it as --artifact {artifact.file}",
                )
            if len(geometry) != batch.stream.sensors:
                raise InputError(
                    f"samples of {batch.stream.sensors} sensors, but the {name} of "
                    f"{batch.device} has {len(geometry)}",
                    hint=f"Give another --artifact {artifact.file}",
                )
            self._geometry[batch.device] = geometry
        return geometry

    def _odometry(self, batch: TimedBatch) -> Trajectory:
        columns, n = batch.columns, len(batch.time_ns)
        return Trajectory(
            batch.device,
            "odometry",
            batch.time_ns,
            np.column_stack([columns["x_m"], columns["y_m"], np.zeros(n)]),
            quaternion_from_heading(np.asarray(columns["heading_rad"], float)),
            np.full((n, 6, 6), np.nan),
        )

    def _inertial(self, batch: TimedBatch) -> InertialSamples:
        columns, n = batch.columns, len(batch.time_ns)
        unknown = np.full((n, 3), np.nan)
        return InertialSamples(
            batch.device,
            batch.time_ns,
            np.asarray(columns.get("acceleration_m_s2", unknown), float),
            np.asarray(columns.get("angular_rate_rad_s", unknown), float),
        )


_CONVERSIONS: dict[str, Any] = {
    "magnetometers": RecordConverter._magnetometers,
    "halls": RecordConverter._halls,
    "odometry": RecordConverter._odometry,
    "imu": RecordConverter._inertial,
}
"""Conversion of each kind of records that streams use, besides sweeps."""


def _sweeps(batches: Sequence[TimedBatch]) -> Sweeps:
    """Return the sweeps of several devices, which the stream solves at once."""
    devices = tuple(dict.fromkeys(batch.device for batch in batches))
    counts = [len(batch.time_ns) for batch in batches]
    numbers = np.array([devices.index(batch.device) for batch in batches], np.int32)
    columns = {
        name: np.concatenate([batch.columns[name] for batch in batches])
        for name in ("sensor", "channel", "polynomial", "sweep", "count")
    }
    return Sweeps(
        devices=devices,
        time_ns=np.concatenate([batch.time_ns for batch in batches]),
        device=np.repeat(numbers, counts),
        **columns,
    )


def system_of(observations: Observations) -> str:
    """Return the system that solves observations; ``""`` for odometry and IMU."""
    if isinstance(observations, Sweeps):
        return SYSTEMS["lighthouse"]
    if isinstance(observations, Samples):
        return SYSTEMS["magnetometers"]
    if isinstance(observations, HallSamples):
        return SYSTEMS["halls"]
    return "dots" if isinstance(observations, Frames) else ""


def frame_observations(device: str, frames: Iterable[Frame], first_number: int) -> Iterator[Frames]:
    """Yield received frames of a camera one by one; damaged ones are left out."""
    for number, frame in enumerate(frames, first_number):
        try:
            picture = images.grey(images.decode(frame.image).pixels)
        except LocatkError:
            continue
        yield Frames(device, np.array([frame.time_ns], np.int64), (str(number),), [picture])
