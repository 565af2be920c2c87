"""Log variables of a Crazyflie: samples of its IMU, and the poses that it estimated itself.

Names and units are those of crazyflie-firmware (``stabilizer.c``). Its body axes are x forward,
y left, z up. The logged pitch has the opposite sign of a rotation about y, for historical reasons;
the quaternion has not.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.geometry import quaternion_from_matrix
from locatk.core.inertial import STANDARD_GRAVITY_M_S2, InertialSamples
from locatk.core.printable import escape_controls
from locatk.core.trajectory import Trajectory
from locatk.formats.importers.crazyflie import FRAME

Array = NDArray[np.float64]

ACCELERATION = ("acc.x", "acc.y", "acc.z")
ANGULAR_RATE = ("gyro.x", "gyro.y", "gyro.z")
POSITION = ("stateestimate.x", "stateestimate.y", "stateestimate.z")
QUATERNION = ("stateestimate.qx", "stateestimate.qy", "stateestimate.qz", "stateestimate.qw")
EULER_ANGLES = ("stateestimate.roll", "stateestimate.pitch", "stateestimate.yaw")
COMPRESSED_POSITION = ("stateestimatez.x", "stateestimatez.y", "stateestimatez.z")
COMPRESSED_QUATERNION = ("stateestimatez.quat",)
"""Names of variables, in lower case."""

USED_VARIABLES = frozenset(
    (
        *ACCELERATION, *ANGULAR_RATE, *POSITION, *QUATERNION, *EULER_ANGLES, *COMPRESSED_POSITION,
        *COMPRESSED_QUATERNION,
    )
)  # fmt: skip

MAX_JOIN_GAP_NS = 200_000_000
"""Longest time between two samples of a variable that are interpolated to the times of another."""

MAX_USUAL_LOSS = 0.02
"""Fraction of the positions without an orientation up to which there is no warning: blocks do not
begin and end at the same time."""


@dataclass(frozen=True)
class LogBlock:
    """Variables that were sampled together.

    Attributes
    ----------
    time_ns : (n,) int64 ndarray
        Strictly ascending.
    columns : dict of str to (n,) float64 ndarray
        By the names of the variables in lower case; ``nan`` if a value is missing.
    """

    time_ns: NDArray[np.int64]
    columns: dict[str, Array]

    @classmethod
    def ascending(
        cls, time_ns: NDArray[np.int64], columns: dict[str, Array]
    ) -> tuple[LogBlock, int]:
        """Return a block of samples in order of time, and the number of samples left out.

        Values of one time may be in several samples; of several values, the first is kept.
        """
        unique, row = np.unique(time_ns, return_inverse=True)
        merged = {}
        repeated = 0
        for name, values in columns.items():
            has_value = np.flatnonzero(~np.isnan(values))
            rows, first = np.unique(row[has_value], return_index=True)
            merged[name] = np.full(len(unique), np.nan)
            merged[name][rows] = values[has_value[first]]
            repeated = max(repeated, len(has_value) - len(rows))
        return cls(unique, merged), repeated


@dataclass(frozen=True)
class DeviceData:
    """IMU and on-board poses of a log.

    Attributes
    ----------
    blocks : list of LogBlock
        The variables in order of time.
    imu : tuple of InertialSamples
        One, or none if neither accelerometer nor gyroscope was logged.
    onboard : tuple of Trajectory
        The poses that the Crazyflie estimated, or none if they were not logged.
    warnings : list of str
        Losses, one line each.
    """

    blocks: list[LogBlock]
    imu: tuple[InertialSamples, ...]
    onboard: tuple[Trajectory, ...]
    warnings: list[str]


def read_device_data(
    samples: Iterable[tuple[NDArray[np.int64], dict[str, Array]]], device: str
) -> DeviceData:
    """Return IMU and on-board poses, given the times and the variables of each block."""
    blocks: list[LogBlock] = []
    repeated = 0
    for time_ns, columns in samples:
        block, count = LogBlock.ascending(time_ns, columns)
        blocks.append(block)
        repeated += count
    warnings = []
    if repeated:
        warnings.append(f"{repeated} samples repeat the time of another one and are left out")
    imu = read_imu(blocks, device)
    track, without_orientation = read_onboard_track(blocks, device)
    if track is not None and without_orientation > MAX_USUAL_LOSS * len(track):
        warnings.append(
            f"{without_orientation} on-board positions are left out: no orientation was logged "
            f"within {MAX_JOIN_GAP_NS // 1_000_000} ms"
        )
    return DeviceData(
        blocks,
        () if imu is None else (imu,),
        () if track is None else (track,),
        warnings,
    )


def read_imu(blocks: Sequence[LogBlock], device: str) -> InertialSamples | None:
    """Return the samples of accelerometer and gyroscope; None if neither was logged."""
    sources = [_find(blocks, names) for names in (ACCELERATION, ANGULAR_RATE)]
    times = [source[0] for source in sources if source is not None]
    if not times:
        return None
    time_ns = np.unique(np.concatenate(times))
    samples = []
    for source, unit in zip(sources, (STANDARD_GRAVITY_M_S2, np.pi / 180), strict=True):
        values = np.full((len(time_ns), 3), np.nan)
        if source is not None:
            values[np.searchsorted(time_ns, source[0])] = unit * source[1]
        samples.append(values)
    return InertialSamples(device, time_ns, *samples)


def read_onboard_track(blocks: Sequence[LogBlock], device: str) -> tuple[Trajectory | None, int]:
    """Return the poses that the Crazyflie estimated, and the number of positions left out.

    They are None if no position was logged. The orientation is the quaternion if it was logged,
    else roll, pitch and yaw; positions of an unknown one are left out, unless it is unknown of all.
    The estimates have no covariance.
    """
    for position_names, unit in ((POSITION, 1.0), (COMPRESSED_POSITION, 1e-3)):
        source = _find(blocks, position_names)
        if source is None:
            continue
        time_ns, position = source[0], unit * source[1]
        quaternion = _orientations(blocks, time_ns)
        is_known = ~np.isnan(quaternion).any(axis=1)
        count = int(is_known.sum())
        if not count:
            return Trajectory.from_positions(device, FRAME, time_ns, position), 0
        covariance = np.full((count, 6, 6), np.nan)
        poses = time_ns[is_known], position[is_known], quaternion[is_known]
        return Trajectory(device, FRAME, *poses, covariance), len(time_ns) - count
    return None, 0


def _find(
    blocks: Sequence[LogBlock], names: tuple[str, ...], *, period: float | None = None
) -> tuple[NDArray[np.int64], Array] | None:
    """Return times (n,) and finite values (n, k) of variables; None if one was not logged.

    Variables of different blocks are interpolated to the times of the first. ``period`` is that of
    variables that wrap.
    """
    complete = [block for block in blocks if all(name in block.columns for name in names)]
    if complete:
        block = max(complete, key=lambda block: len(block.time_ns))
        time_ns = block.time_ns
        values = np.column_stack([block.columns[name] for name in names])
    else:
        owners = [next((b for b in blocks if name in b.columns), None) for name in names]
        found = [owner for owner in owners if owner is not None]
        if len(found) < len(names):
            return None
        time_ns = found[0].time_ns
        values = np.column_stack(
            [
                _interpolate_variable(owner, name, time_ns, period)
                for owner, name in zip(found, names, strict=True)
            ]
        )
    is_finite = np.isfinite(values).all(axis=1)
    return (time_ns[is_finite], values[is_finite]) if is_finite.any() else None


def _interpolate_variable(
    block: LogBlock, name: str, time_ns: NDArray[np.int64], period: float | None
) -> Array:
    """Interpolate one variable to other times (m,)."""
    is_known = np.isfinite(block.columns[name])
    values = block.columns[name][is_known]
    if not len(values):
        return np.full(len(time_ns), np.nan)
    if period is not None:
        values = np.unwrap(values, period=period)
    return interpolate(block.time_ns[is_known], values[:, None], time_ns)[:, 0]


def _orientations(blocks: Sequence[LogBlock], time_ns: NDArray[np.int64]) -> Array:
    """Return quaternions (n, 4) at the times; ``nan`` if unknown."""
    if (source := _find(blocks, QUATERNION)) is not None:
        quaternion = source[1]
    elif (source := _find(blocks, COMPRESSED_QUATERNION)) is not None:
        packed = source[1][:, 0]
        is_valid = (packed >= 0) & (packed < 2**32)
        quaternion = decompress_quaternions(np.where(is_valid, packed, 0).astype(np.uint32))
        quaternion[~is_valid] = np.nan
    elif (source := _find(blocks, EULER_ANGLES, period=360.0)) is not None:
        quaternion = quaternions_from_euler(np.deg2rad(source[1]))
    else:
        return np.full((len(time_ns), 4), np.nan)
    # Opposite quaternions are the same rotation; neighbours must not be opposite.
    flips = np.sum(quaternion[1:] * quaternion[:-1], axis=1) < 0
    quaternion = quaternion * np.where(np.cumsum(np.append(False, flips)) % 2, -1.0, 1.0)[:, None]
    quaternion = interpolate(source[0], quaternion, time_ns)
    length = np.linalg.norm(quaternion, axis=1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(length > 0.5, quaternion / length, np.nan)


def interpolate(known_ns: NDArray[np.int64], values: Array, time_ns: NDArray[np.int64]) -> Array:
    """Interpolate ``values`` (n, k) to other times (m,); ``nan`` in long gaps and outside."""
    if np.array_equal(known_ns, time_ns):
        return values
    after = np.clip(np.searchsorted(known_ns, time_ns), 0, len(known_ns) - 1)
    is_exact = known_ns[after] == time_ns
    before = np.where(is_exact, after, after - 1)
    gap_ns = known_ns[after] - known_ns[before]
    is_inside = (before >= 0) & (time_ns <= known_ns[after]) & (gap_ns <= MAX_JOIN_GAP_NS)
    weight = (time_ns - known_ns[before]) / np.maximum(gap_ns, 1)
    result = values[before] + weight[:, None] * (values[after] - values[before])
    return np.where(is_inside[:, None], result, np.nan)


def quaternions_from_euler(angles_rad: Array) -> Array:
    """Convert logged roll, pitch and yaw (n, 3) to quaternions (n, 4), x y z w.

    The pitch is positive when the nose is up, which is a negative rotation about y.
    """
    roll, pitch, yaw = np.moveaxis(angles_rad * [1.0, -1.0, 1.0], -1, 0)
    (cr, sr), (cp, sp), (cy, sy) = ((np.cos(a), np.sin(a)) for a in (roll, pitch, yaw))
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return quaternion_from_matrix(np.moveaxis(np.array(rows), -1, 0))


def decompress_quaternions(packed: NDArray[np.uint32]) -> Array:
    """Return quaternions (n, 4), x y z w, of the firmware's 32 bits each (``quatcompress.h``).

    The highest two bits are the index of the largest component, which is positive and omitted. The
    others follow in order, the last one in the lowest bits: a sign bit, and nine bits that are the
    magnitude in units of sqrt(1/2) / 511.
    """
    largest = (packed >> 30).astype(np.int64)
    quaternion = np.zeros((len(packed), 4))
    rest = packed.astype(np.int64)
    for component in (3, 2, 1, 0):
        is_stored = largest != component
        magnitude = (rest & 0x1FF) * (np.sqrt(0.5) / 0x1FF)
        value = np.where(rest & 0x200, -magnitude, magnitude)
        quaternion[is_stored, component] = value[is_stored]
        rest = np.where(is_stored, rest >> 10, rest)
    omitted = np.sqrt(np.clip(1 - np.sum(quaternion**2, axis=1), 0, 1))
    quaternion[np.arange(len(packed)), largest] = omitted
    return quaternion


def list_names(names: Iterable[str], limit: int = 12) -> str:
    """Return names in order, at most ``limit`` of them, for a message."""
    ordered = sorted(map(escape_controls, names))
    more = [f"and {len(ordered) - limit} more"] if len(ordered) > limit else []
    return ", ".join([*ordered[:limit], *more]) or "none"
