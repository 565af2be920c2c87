"""Association of an estimate with its truth: matching devices by name and poses by time.

A time offset is in seconds and is *added to the stamps of the estimate*: a pose stamped t is
compared with the truth at t + offset. (Shifting a camera's clock by +0.318 s, as the authors of
the DotBot data do, is an offset of -0.318 s here.)
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.geometry import slerp
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]
Rows = NDArray[np.int64]

Pairs = Sequence[tuple[Trajectory, Trajectory]]
"""Estimate and truth, one pair per device."""

MATCHES = ("interpolate", "nearest")
"""Methods of matching poses by time: ``interpolate`` interpolates the truth between its two
neighbours in time. ``nearest`` is the default of evo: each pose of the shorter trajectory is
matched with the pose of the longer one that is nearest in time."""

MAX_GAP_S = 0.5
"""Default of the longest gap in the truth that is bridged by interpolation."""

MAX_DIFF_S = 0.01
"""Default of the largest time difference of ``nearest``; that of evo."""


@dataclass(frozen=True)
class Association:
    """Poses of one estimate that have truth, with their truth.

    Attributes
    ----------
    index : (n,) int ndarray
        Rows of the estimate; ascending, with repetitions possible for ``nearest``.
    before, after : (n,) int ndarray
        Rows of the truth that enclose each pose in time.
    fraction : (n,) ndarray
        Position of each pose between them in time, 0 to 1.
    time_ns : (n,) int64 ndarray
        Stamps of the poses, by the clock of the estimate.
    estimate, truth : (n, 3) ndarray
        Positions in metres, each in its own frame.
    estimate_quaternion, truth_quaternion : (n, 4) ndarray
        Orientations as (x, y, z, w).
    """

    index: Rows
    before: Rows
    after: Rows
    fraction: Array
    time_ns: NDArray[np.int64]
    estimate: Array
    truth: Array
    estimate_quaternion: Array
    truth_quaternion: Array

    def __len__(self) -> int:
        return len(self.index)

    def select(self, mask: NDArray[np.bool_]) -> Association:
        """Return only the poses whose ``mask`` (n,) is true."""
        if mask.all():
            return self
        return Association(*(getattr(self, field.name)[mask] for field in fields(self)))

    def interpolate_truth(self, values: Array) -> Array:
        """Interpolate values (m, ...) at the stamps of the truth linearly to the poses (n, ...)."""
        fraction = self.fraction.reshape(-1, *(1,) * (values.ndim - 1))
        return np.asarray((1 - fraction) * values[self.before] + fraction * values[self.after])


def associate(
    estimate: Trajectory,
    truth: Trajectory,
    *,
    offset_s: float = 0.0,
    match: str = "interpolate",
    max_gap_s: float = MAX_GAP_S,
    max_diff_s: float = MAX_DIFF_S,
) -> Association:
    """Match each pose of an estimate with the truth at its time.

    Parameters
    ----------
    estimate, truth : Trajectory
    offset_s : float
        Added to the stamps of the estimate.
    match : str
        One of :data:`MATCHES`. ``interpolate`` interpolates positions linearly and orientations
        along the great circle; it never extrapolates, and does not bridge gaps longer than
        ``max_gap_s``. ``nearest`` matches poses at most ``max_diff_s`` apart in time, compared as
        float64 seconds so that ties are resolved as in evo 1.38 (``evo.core.sync``); poses with
        the same truth are all kept.

    Raises
    ------
    InputError
        The stamps of the truth (for ``nearest`` also of the estimate) do not ascend, or ``match``
        is unknown.
    """
    if match not in MATCHES:
        raise InputError(f"unknown match {match!r}", hint=f"use one of {', '.join(MATCHES)}")
    require_ascending(truth, "truth")
    if len(truth) == 0 or len(estimate) == 0:
        empty = np.zeros(0, np.int64)
        index, before, after, fraction = empty, empty, empty, np.zeros(0)
    elif match == "nearest":
        require_ascending(estimate, "estimate")
        index, before = match_nearest(estimate.time_ns, truth.time_ns, offset_s, max_diff_s)
        after, fraction = before, np.zeros(len(index))
    else:
        time = estimate.time_ns + round(offset_s * 1e9)
        index, before, after, fraction = find_neighbours(time, truth.time_ns, max_gap_s)
    positions, quaternions = truth.position[before], truth.quaternion[before]
    if fraction.any():
        weight = fraction[:, None]
        positions = (1 - weight) * positions + weight * truth.position[after]
        quaternions = slerp(quaternions, truth.quaternion[after], fraction)
    return Association(
        index,
        before,
        after,
        fraction,
        estimate.time_ns[index],
        estimate.position[index],
        positions,
        estimate.quaternion[index],
        quaternions,
    )


def interpolate_positions(
    trajectory: Trajectory, time_ns: NDArray[np.int64], max_gap_s: float
) -> tuple[Rows, Array]:
    """Interpolate the positions of a trajectory at stamps (n,), without orientations.

    Returns
    -------
    index : (k,) int ndarray
        Rows of the stamps at which the trajectory is known; see :func:`associate`.
    positions : (k, 3) ndarray
    """
    if len(trajectory) == 0:
        return np.zeros(0, np.int64), np.zeros((0, 3))
    index, before, after, fraction = find_neighbours(time_ns, trajectory.time_ns, max_gap_s)
    weight = fraction[:, None]
    position = trajectory.position
    return index, (1 - weight) * position[before] + weight * position[after]


def require_ascending(trajectory: Trajectory, role: str) -> None:
    """Raise :class:`InputError` if the stamps of a trajectory do not ascend strictly."""
    if np.any(trajectory.time_ns[1:] <= trajectory.time_ns[:-1]):
        raise InputError(
            f"the stamps of the {role} of device {trajectory.device!r} do not ascend",
            hint="sort it and drop repeated stamps",
        )


def find_neighbours(
    time_ns: NDArray[np.int64], known_ns: NDArray[np.int64], max_gap_s: float
) -> tuple[Rows, Rows, Rows, Array]:
    """Find the neighbours of stamps (n,) among ascending stamps ``known_ns`` (m,), m > 0.

    Returns
    -------
    index : (k,) int ndarray
        Rows of ``time_ns`` whose neighbours are at most ``max_gap_s`` apart.
    before, after : (k,) int ndarray
        Rows of ``known_ns``; equal if the stamps are equal.
    fraction : (k,) ndarray
        Position between ``before`` and ``after``, 0 to 1.
    """
    after = np.searchsorted(known_ns, time_ns)  # first known stamp at or after each
    after_clipped = np.minimum(after, len(known_ns) - 1)
    before = np.maximum(after - 1, 0)
    is_equal = known_ns[after_clipped] == time_ns
    # Differences are taken in int64 nanoseconds, which lose no digit of the epoch.
    gap = known_ns[after_clipped] - known_ns[before]
    is_inside = (after > 0) & (after < len(known_ns)) & (gap <= round(max_gap_s * 1e9))
    index = np.flatnonzero(is_inside | is_equal)
    after = after_clipped[index]
    before = np.where(is_equal[index], after, before[index])
    gap = np.maximum(known_ns[after] - known_ns[before], 1)
    return index, before, after, (time_ns[index] - known_ns[before]) / gap


def match_nearest(
    estimate_ns: NDArray[np.int64],
    truth_ns: NDArray[np.int64],
    offset_s: float,
    max_diff_s: float,
) -> tuple[Rows, Rows]:
    """Return rows of estimate and truth whose stamps are nearest; see :func:`associate`."""
    estimate_s, truth_s = _epoch_seconds(estimate_ns), _epoch_seconds(truth_ns)
    if len(estimate_s) > len(truth_s):
        truth_rows, estimate_rows = _match_to_longer(truth_s, estimate_s + offset_s, max_diff_s)
        return estimate_rows, truth_rows
    return _match_to_longer(estimate_s, truth_s - offset_s, max_diff_s)


def _match_to_longer(shorter: Array, longer: Array, max_diff_s: float) -> tuple[Rows, Rows]:
    """Match each stamp of ``shorter`` with the nearest of ``longer``, the earlier one of a tie."""
    after = np.minimum(np.searchsorted(longer, shorter, side="right"), len(longer) - 1)
    until_after = longer[after] - shorter
    since_before = np.where(after > 0, shorter - longer[after - 1], np.inf)
    nearest = np.where(until_after < since_before, after, after - 1)
    is_match = np.minimum(until_after, since_before) <= max_diff_s
    is_match &= (shorter >= longer[0] - max_diff_s) & (shorter <= longer[-1] + max_diff_s)
    rows = np.flatnonzero(is_match)
    return rows, nearest[rows]


def _epoch_seconds(time_ns: NDArray[np.int64]) -> Array:
    """Convert to epoch seconds, rounded once as by ``float("1690218696.0748")``."""
    # Below 2^53 ns the quotient is rounded once. Beyond, no number of nine decimals is so near the
    # middle of two floats that the rounding of the fraction could decide.
    seconds, remainder_ns = np.divmod(time_ns, 1_000_000_000)
    is_exact = np.abs(time_ns) < 2**53
    return np.where(is_exact, time_ns / 1e9, seconds + remainder_ns / 1e9)


def pair_devices(
    estimates: Sequence[Trajectory],
    truths: Sequence[Trajectory],
    names: Mapping[str, str] | None = None,
) -> tuple[list[tuple[Trajectory, Trajectory]], list[str]]:
    """Pair estimates and truths by device.

    Parameters
    ----------
    estimates, truths : sequence of Trajectory
        A single estimate and a single truth are paired whatever their names.
    names : mapping of str to str, optional
        Names of devices in the estimate to their names in the truth; other devices have the same
        name in both.

    Returns
    -------
    pairs : list of (Trajectory, Trajectory)
    unpaired : list of str
        Devices of the estimate without truth.

    Raises
    ------
    InputError
        ``names`` contains a device that does not exist.
    """
    truth_by_name = {trajectory.device: trajectory for trajectory in truths}
    names = names or {}
    for role, requested, existing in (
        ("estimate", names.keys(), {trajectory.device for trajectory in estimates}),
        ("truth", names.values(), truth_by_name.keys()),
    ):
        for name in requested:
            if name not in existing:
                listed = ", ".join(sorted(existing))
                raise InputError(f"no device {name!r} in the {role}", hint=f"It has {listed}")
    if len(estimates) == len(truths) == 1:
        return [(estimates[0], truths[0])], []
    renamed = [(estimate, names.get(estimate.device, estimate.device)) for estimate in estimates]
    pairs = [(estimate, truth_by_name[name]) for estimate, name in renamed if name in truth_by_name]
    return pairs, [estimate.device for estimate, name in renamed if name not in truth_by_name]
