"""Session for Python: what a recording contains, read when it is first used."""

from __future__ import annotations

import os
from functools import cached_property
from pathlib import Path

from locatk.core.dots.frames import Frames
from locatk.core.inertial import InertialSamples
from locatk.core.landmarks.halls import HallSamples
from locatk.core.lighthouse.recording import Sweeps
from locatk.core.lighthouse.scene import Scene
from locatk.core.polaris.array import Samples
from locatk.core.trajectory import Trajectory
from locatk.formats.api import tables
from locatk.formats.sessions import capture_record, field_samples, frames, inertial, observations
from locatk.formats.sessions import trajectories as stored
from locatk.formats.sessions.reader import Session as StoredSession


class Session:
    """Recording of one system, opened by :func:`locatk.open`.

    Nothing but the index of the file is read before a property is used; no file stays open.

    Parameters
    ----------
    path : path
        An MCAP file.

    Attributes
    ----------
    stored : locatk.formats.sessions.reader.Session
        Topics, metadata and attachments of the file.

    Raises
    ------
    MissingDataError, FormatError
        There is no such file, or it is not a session.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.stored = StoredSession.open(path)

    @property
    def path(self) -> Path:
        """The file."""
        return Path(self.stored.path)

    @property
    def system(self) -> str:
        """``"lighthouse"``, ``"polaris"``, ``"dots"`` or ``"landmarks"``; empty if unknown."""
        return self.stored.facts.get("system", "")

    @property
    def duration_s(self) -> float:
        """Time from the first message to the last."""
        return capture_record.duration_s(self.stored) or 0.0

    @cached_property
    def sweeps(self) -> Sweeps:
        """Lighthouse: sweeps of all devices; empty without any."""
        return observations.read_sweeps(self.stored)

    @cached_property
    def scene(self) -> Scene | None:
        """Lighthouse: markers and stations that are known before the session is solved."""
        return observations.read_scene(self.stored)

    @cached_property
    def frames(self) -> list[Frames]:
        """Dots: images or detected dots by device."""
        return frames.read_frames(self.stored)

    @cached_property
    def magnetometers(self) -> list[Samples]:
        """Polaris: samples of the magnetometer arrays."""
        return field_samples.read_magnetometers(self.stored)

    @cached_property
    def halls(self) -> list[HallSamples]:
        """Landmarks: samples of the hall sensors."""
        return field_samples.read_halls(self.stored)

    @cached_property
    def imu(self) -> list[InertialSamples]:
        """Samples of the inertial measurement units by device."""
        return inertial.read_imu(self.stored)

    @cached_property
    def odometry(self) -> dict[str, Trajectory]:
        """Odometry by device."""
        return tables.by_device(stored.read_odometry(self.stored))

    @cached_property
    def truth(self) -> dict[str, Trajectory]:
        """Reference poses by device; empty without any."""
        return tables.by_device(stored.read_truth(self.stored))

    @cached_property
    def onboard(self) -> dict[str, Trajectory]:
        """Poses that the devices estimated themselves."""
        return tables.by_device(stored.read_onboard(self.stored))

    def __repr__(self) -> str:
        return f"<Session {self.path.name}: {self.system or 'no system'}, {self.duration_s:.1f} s>"

    def _repr_html_(self) -> str:
        rows = [
            (channel.topic, channel.schema, str(channel.count)) for channel in self.stored.channels
        ]
        return tables.to_html(repr(self), ("topic", "schema", "messages"), rows)
