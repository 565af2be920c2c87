"""Trajectories from topics of decoded messages, of ROS and of Foxglove.

Definitions: geometry_msgs and nav_msgs of https://github.com/ros2/common_interfaces, tf2_msgs of
https://github.com/ros2/geometry2, and https://docs.foxglove.dev/docs/sdk/schemas.
"""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import FormatError, InputError
from locatk.core.trajectory import Trajectory
from locatk.core.transform_chain import compose
from locatk.formats.importers.poses.trajectory_csv import (
    MAX_NORM_ERROR,
    MIN_NORM_ERROR,
    unknown_covariance,
)

UNKNOWN_VARIANCE = 1e6
"""Variance in m^2 or rad^2 from which on a quantity is unobserved: ROS has no value for "unknown",
and drivers and :mod:`locatk.formats.exporters.ros2` write this one or a larger one."""

MAX_LISTED_TOPICS = 12
"""Number of topics that an error lists."""

DEVICE_PREFIX = "/pose/"
"""Beginning of the topics that ``locatk export`` writes; the rest is the name of the device."""


class Topic(NamedTuple):
    """Topic of a file.

    Attributes
    ----------
    name, type : str
        As in ``"/odom"`` and ``"nav_msgs/msg/Odometry"``.
    encoding : str
        Of its messages: ``"cdr"``, ``"ros1"``, ``"protobuf"`` or ``"json"``.
    """

    name: str
    type: str
    encoding: str


MessageSource = Callable[[Collection[Topic]], Iterator[tuple[Topic, int, bytes]]]
"""Function that yields (topic, log time in ns, payload) of the messages of topics."""

Decoder = Callable[[Topic], Callable[[bytes], Any]]
"""Function that returns the decoder of the messages of a topic, which raises ValueError."""


class PoseSample(NamedTuple):
    """Pose in a message: position in m, quaternion as x, y, z, w, covariance (36,) if it has one.

    ``child`` is the frame whose pose it is, in transforms.
    """

    stamp_ns: int
    frame: str
    numbers: tuple[float, ...]
    child: str = ""
    covariance: Sequence[float] = ()


# ---- messages


def _ros_time_ns(header: Any) -> int:
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)


def _numbers(position: Any, orientation: Any) -> tuple[float, ...]:
    p, q = position, orientation
    return (p.x, p.y, p.z, q.x, q.y, q.z, q.w)


def _pose_stamped(message: Any) -> Iterator[PoseSample]:
    header, pose = message.header, message.pose
    numbers = _numbers(pose.position, pose.orientation)
    yield PoseSample(_ros_time_ns(header), header.frame_id, numbers)


def _pose_with_covariance(message: Any) -> Iterator[PoseSample]:
    header, pose = message.header, message.pose.pose
    numbers = _numbers(pose.position, pose.orientation)
    covariance = message.pose.covariance.tolist()
    yield PoseSample(_ros_time_ns(header), header.frame_id, numbers, "", covariance)


def _point_stamped(message: Any) -> Iterator[PoseSample]:
    header, p = message.header, message.point
    yield PoseSample(_ros_time_ns(header), header.frame_id, (p.x, p.y, p.z, 0.0, 0.0, 0.0, 1.0))


def _transform_stamped(message: Any) -> Iterator[PoseSample]:
    header, transform = message.header, message.transform
    numbers = _numbers(transform.translation, transform.rotation)
    yield PoseSample(_ros_time_ns(header), header.frame_id, numbers, message.child_frame_id)


def _tf_message(message: Any) -> Iterator[PoseSample]:
    for transform in message.transforms:
        yield from _transform_stamped(transform)


def _path(message: Any) -> Iterator[PoseSample]:
    for pose in message.poses:
        for sample in _pose_stamped(pose):
            yield sample._replace(frame=sample.frame or message.header.frame_id)


def _foxglove_time_ns(timestamp: Any) -> int:
    """Return the time of a protobuf (seconds, nanos) or of JSON (sec, nsec)."""
    if hasattr(timestamp, "nsec"):
        return int(timestamp.sec) * 1_000_000_000 + int(timestamp.nsec)
    return int(timestamp.seconds) * 1_000_000_000 + int(timestamp.nanos)


def _pose_in_frame(message: Any) -> Iterator[PoseSample]:
    numbers = _numbers(message.pose.position, message.pose.orientation)
    yield PoseSample(_foxglove_time_ns(message.timestamp), message.frame_id, numbers)


def _poses_in_frame(message: Any) -> Iterator[PoseSample]:
    time_ns = _foxglove_time_ns(message.timestamp)
    for pose in message.poses:
        yield PoseSample(time_ns, message.frame_id, _numbers(pose.position, pose.orientation))


def _frame_transform(message: Any) -> Iterator[PoseSample]:
    numbers = _numbers(message.translation, message.rotation)
    time_ns = _foxglove_time_ns(message.timestamp)
    yield PoseSample(time_ns, message.parent_frame_id, numbers, message.child_frame_id)


def _frame_transforms(message: Any) -> Iterator[PoseSample]:
    for transform in message.transforms:
        yield from _frame_transform(transform)


SAMPLES_OF: dict[str, Callable[[Any], Iterator[PoseSample]]] = {
    "geometry_msgs/msg/PoseStamped": _pose_stamped,
    "geometry_msgs/msg/PoseWithCovarianceStamped": _pose_with_covariance,
    "geometry_msgs/msg/PointStamped": _point_stamped,
    "geometry_msgs/msg/TransformStamped": _transform_stamped,
    "nav_msgs/msg/Odometry": _pose_with_covariance,
    "nav_msgs/msg/Path": _path,
    "tf2_msgs/msg/TFMessage": _tf_message,
    "tf/msg/tfMessage": _tf_message,
    "foxglove.PoseInFrame": _pose_in_frame,
    "foxglove.PosesInFrame": _poses_in_frame,
    "foxglove.FrameTransform": _frame_transform,
    "foxglove.FrameTransforms": _frame_transforms,
}
"""Types of messages with poses, and the function that yields the poses of one."""

TREE_TYPES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage", "foxglove.FrameTransforms")
"""Types of messages with transforms of several frames."""

PATH_TYPE = "nav_msgs/msg/Path"
"""Type of messages with a whole trajectory; each replaces the one before."""

SAME_TIME_TYPE = "foxglove.PosesInFrame"
"""Type of messages with several poses of a single time."""


# ---- reading


def read_topics(
    path: Path, topics: Sequence[Topic], source: MessageSource, decoder: Decoder, selected: str = ""
) -> tuple[list[Trajectory], tuple[str, ...]]:
    """Read the trajectories of topics, and notes on poses that were left out.

    A trajectory has the name of its topic without :data:`DEVICE_PREFIX`; a transform of a tree is
    named as in evo, ``/tf:map.base_link``. Constant transforms (``tf_static``) are no trajectories.

    Parameters
    ----------
    path : Path
        The file, for errors.
    topics : sequence of Topic
        All topics of the file.
    source, decoder : callable
        Access to the messages.
    selected : str
        Topic or trajectory to read. A transform ``/tf:map.base_link`` that no message holds is
        composed of those from ``map`` to ``odom`` and so on. All trajectories by default.

    Raises
    ------
    FormatError
        No topic has poses, all poses are unusable, or a message is damaged.
    InputError
        There is no trajectory of the name ``selected``.
    """
    candidates = [topic for topic in topics if topic.type in SAMPLES_OF]
    if not candidates:
        raise FormatError("no topic with poses", file=path, hint=_listed_topics(topics))
    wanted = [topic for topic in candidates if not selected or _is_named(topic, selected)]
    frames = ""
    if selected and not wanted:
        name, _, frames = selected.partition(":")
        wanted = [topic for topic in candidates if frames and _is_named(topic, name)]
        static = {f"{topic.name}_static" for topic in wanted}
        wanted += [topic for topic in candidates if topic.name in static]
    if not wanted:
        names = ", ".join(topic.name for topic in candidates[:MAX_LISTED_TOPICS])
        raise InputError(f"no topic {selected!r} with poses", file=path, hint=f"It has {names}")
    trajectories: list[tuple[_Series, Trajectory]] = []
    notes: list[str] = []
    for series in _collect(path, wanted, source, decoder):
        trajectory = series.trajectory(notes)
        if trajectory is not None:
            trajectories.append((series, trajectory))
    if frames:
        chosen = _select_transform(path, trajectories, selected, frames, notes)
    else:
        chosen = [trajectory for series, trajectory in trajectories if not series.is_static]
    if not chosen:
        hint = "; ".join(notes) or "Its topics have no messages, or constant transforms only"
        raise FormatError("no usable poses", file=path, hint=hint)
    return sorted(chosen, key=lambda trajectory: trajectory.device), tuple(notes)


def _listed_topics(topics: Sequence[Topic]) -> str:
    if not topics:
        return "It has no topics"
    listed = [f"{topic.name} ({topic.type})" for topic in topics[:MAX_LISTED_TOPICS]]
    more = len(topics) - len(listed)
    return f"It has {', '.join(listed)}{f', and {more} more' if more else ''}"


def _is_named(topic: Topic, name: str) -> bool:
    return name in (topic.name, topic.name.removeprefix("/"), _device(topic.name))


def _device(topic: str) -> str:
    return topic.removeprefix(DEVICE_PREFIX) or topic


@dataclass
class _Series:
    """Poses of one topic, or of one transform in it, in the order of the file."""

    topic: Topic
    frame: str
    child: str
    stamp_ns: array[int] = field(default_factory=lambda: array("q"))
    log_ns: array[int] = field(default_factory=lambda: array("q"))
    numbers: array[float] = field(default_factory=lambda: array("d"))
    covariance: array[float] = field(default_factory=lambda: array("d"))
    rejected: Counter[str] = field(default_factory=Counter)

    def __post_init__(self) -> None:
        self.name = _device(self.topic.name)

    @property
    def is_static(self) -> bool:
        return self.topic.name.endswith("tf_static")

    def append(self, sample: PoseSample, log_ns: int) -> None:
        """Add a pose; raise OverflowError or TypeError if a number is none."""
        if sample.frame != self.frame:
            self.rejected[f"not in the frame {self.frame!r} of the first one"] += 1
            return
        self.stamp_ns.append(sample.stamp_ns)
        self.log_ns.append(log_ns)
        self.numbers.extend(sample.numbers)
        self.covariance.extend(sample.covariance)

    def trajectory(self, notes: list[str]) -> Trajectory | None:
        """Return the usable poses in the order of their times, None without any."""
        n = len(self.stamp_ns)
        time_ns = np.array(self.stamp_ns, np.int64)
        has_stamp = time_ns != 0
        if n and not has_stamp.any() and self.topic.type != PATH_TYPE:
            notes.append(f"{self.name}: its headers have no stamps; log times are used instead")
            time_ns, has_stamp = np.array(self.log_ns, np.int64), np.ones(n, bool)
        numbers = np.array(self.numbers, np.float64).reshape(n, 7)
        is_finite = np.isfinite(numbers).all(axis=1)
        with np.errstate(over="ignore", invalid="ignore"):
            length = np.linalg.norm(numbers[:, 3:], axis=1)
            is_unit = np.abs(length - 1.0) <= MAX_NORM_ERROR
        rejected = self.rejected.copy()
        rejected["without a stamp"] += int(np.sum(~has_stamp))
        rejected["not finite"] += int(np.sum(has_stamp & ~is_finite))
        rejected["quaternion not of unit length"] += int(np.sum(has_stamp & is_finite & ~is_unit))
        rows = np.flatnonzero(has_stamp & is_finite & is_unit)
        rows = rows[np.argsort(time_ns[rows], kind="stable")]
        is_first = np.diff(time_ns[rows], prepend=time_ns[rows][:1] - 1) > 0
        rejected["stamp of another pose"] += int(np.sum(~is_first))
        rows = rows[is_first]
        total = n + sum(self.rejected.values())
        for reason, count in rejected.items():
            if count:
                notes.append(f"{self.name}: {count} of {total} poses left out ({reason})")
        if len(rows) == 0:
            return None
        if self.is_static:
            rows = rows[-1:]
        quaternion, length = numbers[rows, 3:], length[rows, None]
        is_rounded = np.abs(length - 1) > MIN_NORM_ERROR
        trajectory = Trajectory(
            self.name,
            self.frame,
            time_ns[rows],
            numbers[rows, :3],
            np.where(is_rounded, quaternion / length, quaternion),
            unknown_covariance(len(rows)),
        )
        if len(self.covariance) != 36 * n:
            return trajectory
        covariance = np.array(self.covariance, np.float64).reshape(n, 6, 6)[rows]
        return replace(trajectory, covariance=observed_covariance(covariance))


def observed_covariance(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return covariances (n, 6, 6) of ROS with NaN for quantities that were not observed.

    These have a variance of 0, which messages have if it is not set, a negative one, or one of at
    least :data:`UNKNOWN_VARIANCE`. The order of ROS is that of locatk: x, y, z, and rotations about
    the fixed axes x, y, z (geometry_msgs/msg/PoseWithCovariance).
    """
    observed = (covariance + covariance.transpose(0, 2, 1)) / 2
    variance = np.einsum("nii->ni", observed)
    with np.errstate(invalid="ignore"):
        is_observed = (variance > 0) & (variance < UNKNOWN_VARIANCE)
    observed[~(is_observed[:, :, None] & is_observed[:, None, :])] = np.nan
    if np.isnan(observed).all():
        return unknown_covariance(len(observed))
    return observed


def _collect(
    path: Path, topics: Collection[Topic], source: MessageSource, decoder: Decoder
) -> Iterable[_Series]:
    """Return the poses of topics."""
    decode = {topic: decoder(topic) for topic in topics}
    series: dict[tuple[Topic, str, str], _Series] = {}
    paths: dict[Topic, tuple[int, bytes]] = {}

    def add(topic: Topic, log_ns: int, data: bytes) -> None:
        try:
            samples = list(SAMPLES_OF[topic.type](decode[topic](data)))
            for sample in samples:
                key = (topic, sample.frame, sample.child) if sample.child else (topic, "", "")
                if key not in series:
                    series[key] = _Series(topic, sample.frame, sample.child)
                if topic.type == SAME_TIME_TYPE and len(samples) > 1:
                    series[key].rejected["several poses of one time"] += 1
                else:
                    series[key].append(sample, log_ns)
        except (ValueError, TypeError, AttributeError, OverflowError, RecursionError):
            raise FormatError(
                f"a message is no valid {topic.type}",
                file=path,
                where=topic.name,
                hint="Read another topic by FILE#NAME, or record it again",
            ) from None

    for topic, log_ns, data in source(topics):
        if topic.type == PATH_TYPE:
            paths[topic] = (log_ns, data)
        else:
            add(topic, log_ns, data)
    for topic, (log_ns, data) in paths.items():
        add(topic, log_ns, data)
    count = Counter(topic for topic, _, _ in series)
    for each in series.values():
        if each.topic.type in TREE_TYPES or count[each.topic] > 1:
            each.name = f"{each.topic.name}:{each.frame}.{each.child}"
    return series.values()


def _select_transform(
    path: Path,
    trajectories: Sequence[tuple[_Series, Trajectory]],
    selected: str,
    frames: str,
    notes: list[str],
) -> list[Trajectory]:
    """Return the transform ``parent.child`` as the only element, composed if it is not direct.

    Raises
    ------
    InputError
        No chain of transforms leads from the parent to the child.
    """
    parents: dict[str, list[tuple[str, Trajectory]]] = {}
    for series, trajectory in trajectories:
        parents.setdefault(series.child, []).append((series.frame, trajectory))
    # Names of frames can contain dots.
    for k, letter in enumerate(frames):
        parent, child = frames[:k], frames[k + 1 :]
        chain = _find_chain(parents, parent, child) if letter == "." else []
        if not chain:
            continue
        result = compose(chain, selected)
        left_out = max(map(len, chain)) - len(result)
        if len(chain) > 1:
            notes.append(f"{selected}: composed of {', '.join(each.device for each in chain)}")
        if left_out:
            notes.append(f"{selected}: {left_out} times that a transform does not cover left out")
        return [result] if len(result) else []
    names = ", ".join(sorted(trajectory.device for _, trajectory in trajectories))
    raise InputError(
        f"no transforms lead to {selected!r}", file=path, hint=f"It has {names or 'none'}"
    )


def _find_chain(
    parents: dict[str, list[tuple[str, Trajectory]]], parent: str, child: str
) -> list[Trajectory]:
    """Return the shortest chain of transforms from a frame down to another one, or nothing."""
    pending: list[tuple[str, list[Trajectory]]] = [(child, [])]
    visited = {child}
    while pending:
        frame, below = pending.pop(0)
        for above, transform in parents.get(frame, []):
            chain = [transform, *below]
            if above == parent:
                return chain
            if above not in visited:
                visited.add(above)
                pending.append((above, chain))
    return []
