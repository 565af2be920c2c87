"""Samples of inertial measurement units in sessions."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import FormatError, InputError
from locatk.core.inertial import InertialSamples
from locatk.formats.sessions.messages import IMU, MessageBatch, batch_edges
from locatk.formats.sessions.reader import Session
from locatk.formats.sessions.trajectories import read_batches

IMU_TOPIC_PREFIX = "/imu/"
"""Topic of the samples of a device, without its name."""


def imu_messages(samples: InertialSamples) -> Iterator[MessageBatch]:
    """Yield batches of the samples of one device.

    Raises
    ------
    InputError
        Times do not ascend or are before 1970, or a value is infinite.
    """
    if problem := _find_problem(samples):
        raise InputError(f"sample {problem} (IMU of {samples.device})")
    return _batches(samples)


def _batches(samples: InertialSamples) -> Iterator[MessageBatch]:
    columns: dict[str, NDArray[Any]] = {"time_ns": samples.time_ns}
    for name, values in _columns(samples).items():
        if not np.isnan(values).all():
            columns[name] = values
    edges = batch_edges(samples.time_ns, np.zeros(len(samples), np.int64))
    topic = IMU_TOPIC_PREFIX + samples.device
    return IMU.batches(topic, {"device": samples.device}, columns, edges)


def imu_streams(imu: Sequence[InertialSamples]) -> list[Iterator[MessageBatch]]:
    """Return the streams of the samples of several devices.

    Raises
    ------
    InputError
        Two have the same device; see also :func:`imu_messages`.
    """
    names = [samples.device for samples in imu]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"two IMUs of device {name!r}")
    return [imu_messages(samples) for samples in imu]


def read_imu(session: Session) -> list[InertialSamples]:
    """Read the samples of all IMUs of a session, sorted by device; empty without any.

    Raises
    ------
    FormatError
        A message is damaged, times do not ascend, or a value is infinite.
    """
    recordings = []
    for topic in session.topics(IMU_TOPIC_PREFIX, IMU.message.DESCRIPTOR.full_name):
        columns = read_batches(session, [topic], IMU).columns
        samples = InertialSamples(
            topic.removeprefix(IMU_TOPIC_PREFIX),
            columns["time_ns"],
            columns["acceleration_m_s2"],
            columns["angular_rate_rad_s"],
        )
        if problem := _find_problem(samples):
            raise FormatError(f"sample {problem}", file=session.path, where=topic)
        recordings.append(samples)
    return recordings


def _columns(samples: InertialSamples) -> dict[str, NDArray[np.float64]]:
    return {
        "acceleration_m_s2": samples.acceleration,
        "angular_rate_rad_s": samples.angular_rate,
    }


def _find_problem(samples: InertialSamples) -> str | None:
    """Describe the first sample that is impossible; None if there is none."""
    time_ns = samples.time_ns
    if len(time_ns) and time_ns[0] < 0:
        return "0 is older than 1970"
    unordered = np.diff(time_ns) <= 0
    if unordered.any():
        return f"{int(np.argmax(unordered)) + 1} is not later than the one before it"
    for name, values in _columns(samples).items():
        is_infinite = np.isinf(values).any(axis=1)
        if is_infinite.any():
            return f"{int(np.argmax(is_infinite))} has an infinite {name}"
    return None
