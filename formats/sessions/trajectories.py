"""Trajectories in sessions: exact batches for programs, one message per pose for viewers."""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import FormatError, InputError
from locatk.core.geometry import heading_from_quaternion, quaternion_from_heading
from locatk.core.trajectory import MAX_ODOMETRY, Trajectory
from locatk.formats.sessions import foxglove
from locatk.formats.sessions.mcap_file import MAX_TIME_NS
from locatk.formats.sessions.messages import (
    MAX_BATCH_SAMPLES,
    ODOMETRY,
    POSES,
    BatchError,
    Batches,
    Layout,
    MessageBatch,
    symmetric,
    triangle,
)
from locatk.formats.sessions.reader import Session
from locatk.formats.sessions.writer import SessionWriter

MAX_BUFFERED_BYTES = 8 << 20
"""Size of the messages that are taken from streams before they are sorted and written: large
compared with the overhead of sorting, small compared with the memory of a computer."""

LIVE_TRACK = "/live_track/"
"""Topic of the poses of ``locatk live``, without the name of the device."""

# ---- writing


def track_messages(topic: str, trajectory: Trajectory) -> Iterator[MessageBatch]:
    """Yield exact batches of the poses of one device."""
    columns: dict[str, NDArray[Any]] = {
        "time_ns": trajectory.time_ns,
        "position_m": trajectory.position,
        "quaternion_xyzw": trajectory.quaternion,
    }
    if not np.isnan(trajectory.covariance).all():
        columns["covariance_m_rad"] = triangle(trajectory.covariance)
    if trajectory.probability is not None:
        columns["probability"] = trajectory.probability
    return _batches(POSES, topic, trajectory, columns)


def odometry_messages(topic: str, trajectory: Trajectory) -> Iterator[MessageBatch]:
    """Yield batches of the planar part of a trajectory: x, y and heading."""
    columns = {
        "time_ns": trajectory.time_ns,
        "x_m": trajectory.position[:, 0],
        "y_m": trajectory.position[:, 1],
        "heading_rad": heading_from_quaternion(trajectory.quaternion),
    }
    return _batches(ODOMETRY, topic, trajectory, columns)


def _batches(
    layout: Layout, topic: str, trajectory: Trajectory, columns: Mapping[str, NDArray[Any]]
) -> Iterator[MessageBatch]:
    texts = {"device": trajectory.device, "frame_id": trajectory.frame}
    edges = np.append(np.arange(0, len(trajectory), MAX_BATCH_SAMPLES), len(trajectory))
    return layout.batches(topic, texts, columns, edges)


def truth_messages(truth: Iterable[Trajectory]) -> list[Iterator[MessageBatch]]:
    """Return streams of reference poses: exact batches, and one message per pose for viewers."""
    return _pose_streams("truth", truth)


def onboard_messages(onboard: Sequence[Trajectory]) -> list[Iterator[MessageBatch]]:
    """Return streams of the poses that devices estimated themselves, as :func:`truth_messages`.

    Raises
    ------
    InputError
        Two trajectories have the same device.
    """
    check_devices(onboard, "on-board")
    return _pose_streams("onboard", onboard)


def _pose_streams(kind: str, trajectories: Iterable[Trajectory]) -> list[Iterator[MessageBatch]]:
    streams = []
    for trajectory in trajectories:
        streams.append(track_messages(f"/{kind}_track/{trajectory.device}", trajectory))
        streams.append(foxglove.poses(f"/{kind}/{trajectory.device}", trajectory))
    return streams


def reference_streams(
    truth: Sequence[Trajectory], odometry: Sequence[Trajectory]
) -> list[Iterator[MessageBatch]]:
    """Return the streams of reference poses and odometry.

    Raises
    ------
    InputError
        Two trajectories of the same kind have the same device.
    """
    check_devices(truth, "truth")
    check_devices(odometry, "odometry")
    return [
        *truth_messages(truth),
        *(odometry_messages(f"/odometry/{each.device}", each) for each in odometry),
    ]


def write_warnings(writer: SessionWriter, warnings: Iterable[str], end_ns: int) -> None:
    """Write warnings to ``/log``, at the end of a session."""
    for line in warnings:
        writer.write("/log", foxglove.log(line, end_ns, warning=True), end_ns)


def write_streams(writer: SessionWriter, streams: Iterable[Iterator[MessageBatch]]) -> int:
    """Write messages of several ascending streams in the order of their times.

    At most :data:`MAX_BUFFERED_BYTES` and a batch of each stream are in memory.

    Returns the time of the last one, 0 without messages.
    """
    sources = list(streams)
    waiting: list[list[MessageBatch]] = [[] for _ in sources]
    # The streams that have not ended, by the time of the last message that was taken from them.
    last_times = [(-1, number) for number in range(len(sources))]
    end_ns = 0
    while last_times or any(waiting):
        taken_bytes = 0
        while last_times and taken_bytes < MAX_BUFFERED_BYTES:
            _, number = heapq.heappop(last_times)
            batch = next(sources[number], None)
            if batch is not None:
                waiting[number].append(batch)
                heapq.heappush(last_times, (int(batch.time_ns[-1]), number))
                taken_bytes += sum(map(len, batch.payloads))
        # Later batches of the streams have no earlier messages.
        boundary_ns = last_times[0][0] if last_times else MAX_TIME_NS
        ready = [part for batches in waiting for part in _take_until(batches, boundary_ns)]
        if ready:
            writer.write_batches(ready)
            end_ns = max(int(batch.time_ns[-1]) for batch in ready)
    return end_ns


def _take_until(batches: list[MessageBatch], time_ns: int) -> list[MessageBatch]:
    """Remove the messages up to ``time_ns`` from ascending batches and return them."""
    taken = []
    while batches and batches[0].time_ns[0] <= time_ns:
        count = int(np.searchsorted(batches[0].time_ns, time_ns, side="right"))
        if count < len(batches[0].time_ns):
            part, batches[0] = batches[0].split(count)
            taken.append(part)
            break
        taken.append(batches.pop(0))
    return taken


def check_devices(trajectories: Sequence[Trajectory], kind: str) -> None:
    """Raise InputError if two trajectories have the same device: they would share a topic."""
    names = [trajectory.device for trajectory in trajectories]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"two {kind} trajectories of device {name!r}")


# ---- reading


def read_truth(session: Session) -> list[Trajectory]:
    """Read the reference poses of a session, one trajectory per device; may be empty.

    They are taken from ``/truth_track/<device>``. For devices without such a topic (files of
    other tools) they are the ``foxglove.PoseInFrame`` messages on ``/truth/<device>``.
    """
    exact = read_tracks(session, "/truth_track/")
    exact_topics = {f"/truth/{trajectory.device}" for trajectory in exact}
    return exact + read_poses(session, "/truth/", exact_topics)


def read_onboard(session: Session) -> list[Trajectory]:
    """Read the poses that the devices of a session estimated themselves; may be empty."""
    return read_tracks(session, "/onboard_track/")


def read_live(session: Session) -> list[Trajectory]:
    """Read the poses that ``locatk live`` published while it recorded; may be empty."""
    return read_tracks(session, LIVE_TRACK)


def read_odometry(session: Session) -> list[Trajectory]:
    """Read the odometry of a session as planar trajectories of unknown covariance."""
    trajectories = []
    for topic in session.topics("/odometry/", "locatk.Odometry"):
        batches = read_batches(session, [topic], ODOMETRY)
        columns = batches.columns
        n = len(columns["time_ns"])
        for name in ("x_m", "y_m", "heading_rad"):
            if np.any(np.abs(columns[name]) > MAX_ODOMETRY):
                raise FormatError(
                    f"a pose of odometry beyond {MAX_ODOMETRY:g} m or rad",
                    file=session.path,
                    where=topic,
                )
        position = np.column_stack([columns["x_m"], columns["y_m"], np.zeros(n)])
        quaternion = quaternion_from_heading(columns["heading_rad"])
        covariance = np.full((n, 6, 6), np.nan)
        trajectories.append(_trajectory(batches, topic, position, quaternion, covariance))
    return trajectories


def read_tracks(session: Session, prefix: str) -> list[Trajectory]:
    """Read the trajectories of the ``locatk.PoseTrack`` topics that start with ``prefix``."""
    trajectories = []
    for topic in session.topics(prefix, "locatk.PoseTrack"):
        batches = read_batches(session, [topic], POSES)
        columns = batches.columns
        position, quaternion = columns["position_m"], columns["quaternion_xyzw"]
        covariance = symmetric(columns["covariance_m_rad"])
        track = _trajectory(batches, topic, position, quaternion, covariance)
        probability = columns["probability"]
        if not np.isnan(probability).all():
            track = replace(track, probability=probability)
        trajectories.append(track)
    return trajectories


def read_poses(session: Session, prefix: str, skip: Iterable[str] = ()) -> list[Trajectory]:
    """Read the trajectories of the ``foxglove.PoseInFrame`` topics that start with ``prefix``.

    The covariance is unknown. Topics in ``skip`` are left out.
    """
    topics = set(session.topics(prefix, "foxglove.PoseInFrame")) - set(skip)
    return [
        foxglove.read_trajectory(session, topic, topic.removeprefix(prefix))
        for topic in sorted(topics)
    ]


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
    """Read all batches of ``topics``, in file order.

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
