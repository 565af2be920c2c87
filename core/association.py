"""Which truth belongs to which pose: matching devices, and matching in time.

A time offset is in seconds and is *added to the stamps of the estimate*: an estimate
stamped t is compared with the truth at t + offset. (Shifting a camera's clock by
+0.318 s, as the authors of the DotBot data do, is an offset of -0.318 s here.)
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.orientation import slerp
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]
Rows = NDArray[np.int64]

Pairs = Sequence[tuple[Trajectory, Trajectory]]
"""Estimate and truth, one pair a device."""

MATCHES = ("interpolate", "nearest")
"""How truth is found for a pose: ``interpolate`` takes it between its two neighbours in time.
``nearest`` is what evo does by default: each pose of the shorter of the two with the nearest
of the longer."""

MAX_GAP_S = 0.5
"""Default for the longest gap in the truth that is bridged by interpolation."""

MAX_DIFF_S = 0.01
"""Default for the largest difference in time of ``nearest``, as evo's."""


@dataclass(frozen=True)
class Association:
    """Poses of one estimate for which there is truth.

    Attributes
    ----------
    index : (n,) int ndarray
        Rows of the estimate; ascending, and with ``nearest`` perhaps repeated.
    before, after : (n,) int ndarray
        Rows of the truth between which each pose lies.
    share : (n,) ndarray
        How far it is on the way from the one to the other, 0 to 1.
    time_ns : (n,) int64 ndarray
        The stamps of the poses, as in the estimate.
    estimate, truth : (n, 3) ndarray
        Positions in metres, each in its own frame.
    estimate_turn, truth_turn : (n, 4) ndarray
        Orientations as (x, y, z, w).
    """

    index: Rows
    before: Rows
    after: Rows
    share: Array
    time_ns: NDArray[np.int64]
    estimate: Array
    truth: Array
    estimate_turn: Array
    truth_turn: Array

    def __len__(self) -> int:
        return len(self.index)

    def take(self, keep: NDArray[np.bool_]) -> Association:
        """Only the poses where ``keep`` (n,) is true."""
        if keep.all():
            return self
        return Association(*(getattr(self, field.name)[keep] for field in fields(self)))

    def interpolated(self, of_truth: Array) -> Array:
        """What the truth tells at its stamps (m, ...), linearly at those of the poses (n, ...)."""
        share = self.share.reshape(-1, *(1,) * (of_truth.ndim - 1))
        return np.asarray((1 - share) * of_truth[self.before] + share * of_truth[self.after])


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
        One of :data:`MATCHES`. ``interpolate``: positions linearly, orientations along the
        great circle; never extrapolated, and gaps longer than ``max_gap_s`` are not
        bridged. ``nearest``: pairs not more than ``max_diff_s`` apart, in float64 seconds,
        so that ties fall as in evo 1.38 (``evo.core.sync``); of several poses with the same
        truth all are kept.

    Raises
    ------
    InputError
        The stamps of the truth do not ascend; an unknown ``match``.
    """
    if match not in MATCHES:
        raise InputError(f"unknown match {match!r}", hint=f"use one of {', '.join(MATCHES)}")
    ascending(truth, "truth")
    if len(truth) == 0 or len(estimate) == 0:
        nothing = np.zeros(0, np.int64)
        index, before, after, share = nothing, nothing, nothing, np.zeros(0)
    elif match == "nearest":
        ascending(estimate, "estimate")
        index, before = nearest(estimate.time_ns, truth.time_ns, offset_s, max_diff_s)
        after, share = before, np.zeros(len(index))
    else:
        time = estimate.time_ns + round(offset_s * 1e9)
        index, before, after, share = between(time, truth.time_ns, max_gap_s)
    positions, turns = truth.position[before], truth.quaternion[before]
    if share.any():
        column = share[:, None]
        positions = (1 - column) * positions + column * truth.position[after]
        turns = slerp(turns, truth.quaternion[after], share)
    return Association(
        index,
        before,
        after,
        share,
        estimate.time_ns[index],
        estimate.position[index],
        positions,
        estimate.quaternion[index],
        turns,
    )


def ascending(trajectory: Trajectory, what: str) -> None:
    """Raise :class:`InputError` where stamps do not ascend."""
    if np.any(trajectory.time_ns[1:] <= trajectory.time_ns[:-1]):
        raise InputError(
            f"the stamps of the {what} of device {trajectory.device!r} do not ascend",
            hint="sort it and drop repeated stamps",
        )


def between(
    time: NDArray[np.int64], known: NDArray[np.int64], max_gap_s: float
) -> tuple[Rows, Rows, Rows, Array]:
    """Neighbours of stamps ``time`` (n,) among ascending stamps ``known`` (m,), m > 0.

    Returns
    -------
    index : (k,) int ndarray
        Rows of ``time`` that have neighbours, not more than ``max_gap_s`` apart.
    before, after : (k,) int ndarray
        Rows of ``known``; both the same where the stamp is met exactly.
    share : (k,) ndarray
        Of the way from ``before`` to ``after``.
    """
    after = np.searchsorted(known, time)  # first known stamp at or after each
    after_safe = np.minimum(after, len(known) - 1)
    before = np.maximum(after - 1, 0)
    exact = known[after_safe] == time
    # Differences of int64 nanoseconds: no digit of the epoch is lost.
    gap = known[after_safe] - known[before]
    inside = (after > 0) & (after < len(known)) & (gap <= round(max_gap_s * 1e9))
    index = np.flatnonzero(inside | exact)
    after = after_safe[index]
    before = np.where(exact[index], after, before[index])
    gap = np.maximum(known[after] - known[before], 1)
    return index, before, after, (time[index] - known[before]) / gap


def nearest(
    estimate: NDArray[np.int64], truth: NDArray[np.int64], offset_s: float, max_diff_s: float
) -> tuple[Rows, Rows]:
    """Rows of estimate and truth whose stamps are nearest; see :func:`associate`."""
    mine, true = _seconds(estimate), _seconds(truth)
    if len(mine) > len(true):
        rows_true, rows_mine = _nearest_of(true, mine + offset_s, max_diff_s)
        return rows_mine, rows_true
    return _nearest_of(mine, true - offset_s, max_diff_s)


def _nearest_of(short: Array, long: Array, limit: float) -> tuple[Rows, Rows]:
    """Rows of ``short`` and of the stamps of ``long`` nearest to them; the earlier of two."""
    after = np.minimum(np.searchsorted(long, short, side="right"), len(long) - 1)
    ahead = long[after] - short
    behind = np.where(after > 0, short - long[after - 1], np.inf)
    best = np.where(ahead < behind, after, after - 1)
    within = np.minimum(ahead, behind) <= limit
    within &= (short >= long[0] - limit) & (short <= long[-1] + limit)
    rows = np.flatnonzero(within)
    return rows, best[rows]


def _seconds(time_ns: NDArray[np.int64]) -> Array:
    """Epoch seconds, rounded once as by ``float("1690218696.0748")``."""
    # Below 2^53 ns the quotient is rounded once. Beyond, no nine decimals lie so near the middle
    # of two floats that the rounding of the fraction could decide.
    seconds, rest = np.divmod(time_ns, 1_000_000_000)
    small = np.abs(time_ns) < 2**53
    return np.where(small, time_ns / 1e9, seconds + rest / 1e9)


def take(trajectory: Trajectory, keep: NDArray[np.bool_]) -> Trajectory:
    """Only the poses where ``keep`` (n,) is true."""
    time_ns, covariance = trajectory.time_ns[keep], trajectory.covariance
    if len(covariance) and covariance.strides[0] == 0:  # one unknown for all: stays one in memory
        covariance = np.broadcast_to(covariance[0], (len(time_ns), 6, 6))
    else:
        covariance = covariance[keep]
    return Trajectory(
        trajectory.device,
        trajectory.frame,
        time_ns,
        trajectory.position[keep],
        trajectory.quaternion[keep],
        covariance,
    )


def pair_devices(
    estimates: Sequence[Trajectory],
    truths: Sequence[Trajectory],
    names: Mapping[str, str] | None = None,
) -> tuple[list[tuple[Trajectory, Trajectory]], list[str]]:
    """Estimate and truth of each device, and the devices that have no truth.

    By name; where there is just one of each, their names need not agree. ``names`` tells what
    devices of the estimate are called in the truth; others then have their own name.

    Raises
    ------
    InputError
        ``names`` has a device that is not there.
    """
    known = {trajectory.device: trajectory for trajectory in truths}
    names = names or {}
    for what, wanted, there in (
        ("estimate", names.keys(), {mine.device for mine in estimates}),
        ("truth", names.values(), known.keys()),
    ):
        for name in wanted:
            if name not in there:
                has = ", ".join(sorted(there))
                raise InputError(f"no device {name!r} in the {what}", hint=f"It has {has}")
    if len(estimates) == len(truths) == 1:
        return [(estimates[0], truths[0])], []
    called = [(mine, names.get(mine.device, mine.device)) for mine in estimates]
    pairs = [(mine, known[name]) for mine, name in called if name in known]
    return pairs, [mine.device for mine, name in called if name not in known]
