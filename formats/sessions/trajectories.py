"""Trajectories in sessions: exact batches for programs, one message a pose for viewers."""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from google.protobuf.message import Message
from numpy.typing import NDArray

from locatk.core.errors import FormatError, InputError
from locatk.core.geometry import heading_from_quaternion, quaternion_from_heading
from locatk.core.trajectory import Trajectory
from locatk.formats.sessions import foxglove as viewers
from locatk.formats.sessions.messages import (
    ODOMETRY,
    POSES,
    BatchError,
    Batches,
    Layout,
    symmetric,
    triangle,
)
from locatk.formats.sessions.reader import Session
from locatk.formats.sessions.writer import SessionWriter

LARGEST_BATCH = 1024
"""Most samples in one message."""

Timed = tuple[int, str, Message]
"""Time in ns, topic and message."""


def track_messages(topic: str, trajectory: Trajectory) -> Iterator[Timed]:
    """Exact batches of the poses of one device."""
    columns: dict[str, NDArray[Any]] = {
        "time_ns": trajectory.time_ns,
        "position_m": trajectory.position,
        "quaternion_xyzw": trajectory.quaternion,
    }
    if not np.isnan(trajectory.covariance).all():
        columns["covariance_m_rad"] = triangle(trajectory.covariance)
    return _batched(POSES, topic, trajectory, columns)


def odometry_messages(topic: str, trajectory: Trajectory) -> Iterator[Timed]:
    """Batches of the plane part of a trajectory: x, y and heading."""
    columns = {
        "time_ns": trajectory.time_ns,
        "x_m": trajectory.position[:, 0],
        "y_m": trajectory.position[:, 1],
        "heading_rad": heading_from_quaternion(trajectory.quaternion),
    }
    return _batched(ODOMETRY, topic, trajectory, columns)


def _batched(
    layout: Layout, topic: str, trajectory: Trajectory, columns: Mapping[str, NDArray[Any]]
) -> Iterator[Timed]:
    texts = {"device": trajectory.device, "frame_id": trajectory.frame}
    for start in range(0, len(trajectory), LARGEST_BATCH):
        part = {key: column[start : start + LARGEST_BATCH] for key, column in columns.items()}
        yield int(part["time_ns"][0]), topic, layout.pack(texts, part)


def truth_messages(truth: Iterable[Trajectory]) -> list[Iterator[Timed]]:
    """Streams of reference poses: exact ones, and one message a pose for viewers."""
    streams = []
    for trajectory in truth:
        streams.append(track_messages(f"/truth_track/{trajectory.device}", trajectory))
        streams.append(viewers.poses(f"/truth/{trajectory.device}", trajectory))
    return streams


def known_streams(
    truth: Sequence[Trajectory], odometry: Sequence[Trajectory]
) -> list[Iterator[Timed]]:
    """Streams of the trajectories that are known beside what was recorded.

    Raises
    ------
    InputError
        Two of them have the same device.
    """
    for kind, trajectories in (("truth", truth), ("odometry", odometry)):
        check_devices(trajectories, kind)
    driven = [odometry_messages(f"/odometry/{each.device}", each) for each in odometry]
    return [*truth_messages(truth), *driven]


def write_warnings(writer: SessionWriter, warnings: Iterable[str], end_ns: int) -> None:
    """Write warnings to ``/log``, at the end of a session."""
    for line in warnings:
        writer.write("/log", viewers.log(line, end_ns, warning=True), end_ns)


def write_streams(writer: SessionWriter, streams: Iterable[Iterator[Timed]]) -> int:
    """Write messages of several ascending streams in the order of their times.

    Returns the time of the last one, 0 where there is none.
    """
    time_ns = 0
    for time_ns, topic, message in heapq.merge(*streams, key=lambda item: item[0]):
        writer.write(topic, message, time_ns)
    return time_ns


def check_devices(trajectories: Sequence[Trajectory], kind: str) -> None:
    """Refuse two trajectories of one device: they would share a topic."""
    names = [trajectory.device for trajectory in trajectories]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"two {kind} trajectories of device {name!r}")


def read_truth(session: Session) -> list[Trajectory]:
    """Reference poses of a session, one trajectory a device; empty without any.

    Taken from ``/truth_track/<device>``; from the ``foxglove.PoseInFrame`` on
    ``/truth/<device>`` for devices that have no such topic (other tools' files).
    """
    exact = read_tracks(session, "/truth_track/")
    known = {f"/truth/{trajectory.device}" for trajectory in exact}
    return exact + read_poses(session, "/truth/", known)


def read_odometry(session: Session) -> list[Trajectory]:
    """Odometry of a session as trajectories in the plane, covariance unknown."""
    found = []
    for name in session.topics("/odometry/", "locatk.Odometry"):
        batches = read_batches(session, [name], ODOMETRY)
        columns = batches.columns
        n = len(columns["time_ns"])
        position = np.column_stack([columns["x_m"], columns["y_m"], np.zeros(n)])
        quaternion = quaternion_from_heading(columns["heading_rad"])
        covariance = np.full((n, 6, 6), np.nan)
        found.append(_trajectory(batches, name, position, quaternion, covariance))
    return found


def read_tracks(session: Session, prefix: str) -> list[Trajectory]:
    """Trajectories of the ``locatk.PoseTrack`` topics that start with ``prefix``."""
    found = []
    for name in session.topics(prefix, "locatk.PoseTrack"):
        batches = read_batches(session, [name], POSES)
        columns = batches.columns
        covariance = symmetric(columns["covariance_m_rad"])
        found.append(
            _trajectory(
                batches, name, columns["position_m"], columns["quaternion_xyzw"], covariance
            )
        )
    return found


def read_poses(session: Session, prefix: str, skip: Iterable[str] = ()) -> list[Trajectory]:
    """Trajectories of the ``foxglove.PoseInFrame`` topics that start with ``prefix``.

    The covariance is unknown. ``skip`` names topics to leave out.
    """
    topics = set(session.topics(prefix, "foxglove.PoseInFrame")) - set(skip)
    return [viewers.trajectory(session, name, name.removeprefix(prefix)) for name in sorted(topics)]


def _trajectory(
    batches: Batches,
    topic: str,
    position: NDArray[np.float64],
    quaternion: NDArray[np.float64],
    covariance: NDArray[np.float64],
) -> Trajectory:
    device = next(iter(batches.texts["device"]), topic.rpartition("/")[2])
    frame = next(iter(batches.texts["frame_id"]), "")
    return Trajectory(device, frame, batches.columns["time_ns"], position, quaternion, covariance)


def read_batches(session: Session, topics: Iterable[str], layout: Layout) -> Batches:
    """All batches of ``topics``, in the order of the file.

    Raises
    ------
    FormatError
        A message is damaged.
    """
    names = list(topics)
    try:
        return layout.unpack(data for _, _, data in session.messages(names))
    except BatchError as error:
        where = names[0] if len(names) == 1 else None
        raise FormatError(str(error), file=session.path, where=where) from None
