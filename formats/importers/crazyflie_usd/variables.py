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


def read_onboard_track(blocks: Sequence[LogBlock], device: str) -> Trajectory | None:
    """Return the poses that the Crazyflie estimated; None if they were not logged.

    The orientation is the quaternion if it was logged, else roll, pitch and yaw. The estimates have
    no covariance.
    """
    for position_names, unit, quaternion_names in (
        (POSITION, 1.0, QUATERNION),
        (COMPRESSED_POSITION, 1e-3, COMPRESSED_QUATERNION),
    ):
        source = _find(blocks, position_names)
        if source is None:
            continue
        time_ns, position = source[0], unit * source[1]
        quaternion = _orientations(blocks, quaternion_names, time_ns)
        if quaternion is None:
            return Trajectory.from_positions(device, FRAME, time_ns, position)
        is_known = ~np.isnan(quaternion).any(axis=1)
        return Trajectory(
            device,
            FRAME,
            time_ns[is_known],
            position[is_known],
            quaternion[is_known],
            np.full((int(is_known.sum()), 6, 6), np.nan),
        )
    return None


def _find(
    blocks: Sequence[LogBlock], names: tuple[str, ...]
) -> tuple[NDArray[np.int64], Array] | None:
    """Return times (n,) and finite values (n, k) of variables; None if one was not logged.

    Variables of different blocks are interpolated to the times of the first.
    """
    complete = [block for block in blocks if all(name in block.columns for name in names)]
    if complete:
        block = max(complete, key=lambda block: len(block.time_ns))
        time_ns = block.time_ns
        values = np.column_stack([block.columns[name] for name in names])
    else:
        owners = [next((b for b in blocks if name in b.columns), None) for name in names]
        if any(owner is None for owner in owners):
            return None
        found = [owner for owner in owners if owner is not None]
        time_ns = found[0].time_ns
        values = np.column_stack(
            [
                interpolate(owner.time_ns, owner.columns[name][:, None], time_ns)[:, 0]
                for owner, name in zip(found, names, strict=True)
            ]
        )
    is_finite = np.isfinite(values).all(axis=1)
    return (time_ns[is_finite], values[is_finite]) if is_finite.any() else None


def _orientations(
    blocks: Sequence[LogBlock], quaternion_names: tuple[str, ...], time_ns: NDArray[np.int64]
) -> Array | None:
    """Return quaternions (n, 4) at the times; ``nan`` if unknown, None if none was logged."""
    source = _find(blocks, quaternion_names)
    if source is not None and len(quaternion_names) == 1:
        quaternion = decompress_quaternions(source[1][:, 0].astype(np.uint32))
    elif source is not None:
        quaternion = source[1]
    else:
        source = _find(blocks, EULER_ANGLES)
        if source is None:
            return None
        quaternion = quaternions_from_euler(np.deg2rad(source[1]))
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
