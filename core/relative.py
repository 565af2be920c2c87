"""Errors of motions: from pose to pose (RPE), and over parts of the way (drift).

The relative error of two poses i and j is how the motion from i to j, as seen from i, differs
between estimate and truth: E = (Q_i^-1 Q_j)^-1 (P_i^-1 P_j) (Sturm et al., A benchmark for
the evaluation of RGB-D SLAM systems, IROS 2012, eq. 2). Its translation is told in metres,
its rotation by its angle. Where estimate or truth tells no orientation, motions are compared in
the frame of the truth instead, and there is no rotation.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, cast

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.orientation import angle, inverse, multiply, rotate

Array = NDArray[np.float64]
Rows = NDArray[np.int64]
Unit = Literal["f", "m", "deg", "s"]

TOLERANCE = 0.1
"""With all pairs, how far one may be from the delta, as a part of it; as evo's default."""

PARTS = (0.1, 0.2, 0.3, 0.4, 0.5)
"""Lengths of the sub-trajectories of drift, as parts of the way; those of Zhang and
Scaramuzza's toolbox."""

MOST_STARTS = 2000
"""Sub-trajectories of one length, at most; they then start evenly over the poses."""

DELTA = re.compile(r"([0-9.eE+-]+)\s*(f|m|deg|s)", re.ASCII)


@dataclass(frozen=True)
class Delta:
    """How far apart the two poses of a pair are.

    Attributes
    ----------
    value : float
    unit : str
        ``"f"`` poses, ``"m"`` metres of way, ``"deg"`` degrees turned, ``"s"`` seconds.
    """

    value: float
    unit: Unit

    @classmethod
    def parse(cls, text: str) -> Delta:
        """Of ``"1f"``, ``"0.5m"``, ``"10deg"``, ``"1s"``.

        Raises
        ------
        InputError
            It is none of them.
        """
        match = DELTA.fullmatch(text.strip())
        try:
            value = float(match[1]) if match else np.nan
        except ValueError:
            value = np.nan
        unit = match[2] if match else "f"
        whole = unit != "f" or value == np.floor(value)
        if not (0 < value < np.inf) or not whole or (unit == "deg" and value > 180):
            raise InputError(
                f"{text!r} is no distance between poses",
                hint="write it as 1f (poses, a whole number), 0.5m, 10deg (up to 180) or 1s",
            )
        return cls(value, cast(Unit, unit))

    def __str__(self) -> str:
        return f"{self.value:g}{self.unit}"


@dataclass(frozen=True)
class Poses:
    """Matched poses of one device: the aligned estimate and its truth.

    Attributes
    ----------
    time_ns : (n,) int64 ndarray
    estimate, truth : (n, 3) ndarray
    estimate_turn, truth_turn : (n, 4) ndarray or None
        None where one of them tells no orientation.
    """

    time_ns: NDArray[np.int64]
    estimate: Array
    truth: Array
    estimate_turn: Array | None
    truth_turn: Array | None

    def __len__(self) -> int:
        return len(self.time_ns)


@dataclass(frozen=True)
class Relative:
    """Errors of m motions.

    Attributes
    ----------
    first, last : (m,) int ndarray
        Rows of the poses between which.
    translation : (m,) ndarray
        In metres.
    rotation_deg : (m,) ndarray or None
        ``nan`` of devices that tell no orientation, None where none does.
    """

    first: Rows
    last: Rows
    translation: Array
    rotation_deg: Array | None

    @classmethod
    def joined(cls, parts: Sequence[Relative]) -> Relative:
        """Those of several devices."""
        return cls(
            np.concatenate([part.first for part in parts]),
            np.concatenate([part.last for part in parts]),
            np.concatenate([part.translation for part in parts]),
            _joined([part.rotation_deg for part in parts], [len(part.first) for part in parts]),
        )


def _joined(parts: Sequence[Array | None], sizes: Sequence[int]) -> Array | None:
    """One after the other, ``nan`` for those that are not known; None where none is."""
    if all(part is None for part in parts):
        return None
    filled = [np.full(n, np.nan) if p is None else p for p, n in zip(parts, sizes, strict=True)]
    return np.concatenate(filled)


def relative_errors(poses: Poses, first: Rows, last: Rows) -> Relative:
    """Errors of the motions from rows ``first`` (m,) to rows ``last`` (m,)."""
    moved = poses.estimate[last] - poses.estimate[first]
    truly = poses.truth[last] - poses.truth[first]
    if poses.estimate_turn is None or poses.truth_turn is None:
        return Relative(first, last, np.linalg.norm(moved - truly, axis=1), None)
    # From each pose back to its frame once, and pair by pair after that.
    back, truly_back = inverse(poses.estimate_turn), inverse(poses.truth_turn)
    difference = rotate(back[first], moved) - rotate(truly_back[first], truly)
    turn = multiply(back[first], poses.estimate_turn[last])
    true_turn = multiply(truly_back[first], poses.truth_turn[last])
    return Relative(
        first,
        last,
        np.linalg.norm(difference, axis=1),
        np.rad2deg(angle(multiply(inverse(true_turn), turn))),
    )


def pairs_apart(poses: Poses, delta: Delta, *, all_pairs: bool = False) -> tuple[Rows, Rows]:
    """Rows of the poses that are ``delta`` apart, measured on the aligned estimate.

    One pair begins where the last ended, at the first pose that is at least ``delta`` away;
    ``all_pairs`` begins one at each pose and takes the later pose whose distance is nearest
    to ``delta``, not more than :data:`TOLERANCE` of it off. Both as evo 1.38 does
    (``evo.core.filters``).

    Raises
    ------
    InputError
        ``all_pairs`` with degrees.
    """
    n = len(poses)
    if delta.unit == "f":
        step = int(min(delta.value, n))
        first = np.arange(0, max(n - step, 0), 1 if all_pairs else max(step, 1))
        return first, first + step
    if delta.unit == "deg" and all_pairs:
        raise InputError(
            "all pairs that are some degrees apart would be too many to find",
            hint="leave out --all-pairs, or give the distance in poses, metres or seconds",
        )
    if n < 2:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    steps = _steps(poses, delta.unit)
    if all_pairs:
        return _all_apart(np.concatenate([[0.0], np.cumsum(steps)]), delta.value)
    # Summed from pair to pair in float64, as evo does, so that ties fall alike.
    limit = np.deg2rad(delta.value) if delta.unit == "deg" else delta.value
    ends, way = [0], 0.0
    for row, step in enumerate(steps.tolist(), start=1):
        way += step
        if way >= limit:
            ends.append(row)
            way = 0.0
    return np.array(ends[:-1], np.int64), np.array(ends[1:], np.int64)


def _steps(poses: Poses, unit: Unit) -> Array:
    """From each pose to the next (n - 1,), in metres, seconds or radians."""
    if unit == "m":
        return np.asarray(np.linalg.norm(np.diff(poses.estimate, axis=0), axis=1))
    if unit == "s":
        return np.diff(poses.time_ns) / 1e9
    if poses.estimate_turn is None:
        raise InputError(
            "the poses tell no orientation, so that none are some degrees apart",
            hint="give the distance in poses, metres or seconds",
        )
    turn = poses.estimate_turn
    return angle(multiply(inverse(turn[:-1]), turn[1:]))


def _all_apart(way: Array, delta: float) -> tuple[Rows, Rows]:
    first = np.arange(len(way) - 1)
    after = np.minimum(np.searchsorted(way, way[:-1] + delta), len(way) - 1)
    before = np.maximum(after - 1, first + 1)
    nearer = np.abs(way[before] - way[:-1] - delta) <= np.abs(way[after] - way[:-1] - delta)
    last = np.maximum(np.where(nearer, before, after), first + 1)
    good = np.abs(way[last] - way[:-1] - delta) <= TOLERANCE * delta
    return first[good], last[good]


def path_length(positions: Array) -> float:
    """Length of the way through positions (n, 3)."""
    return float(np.sum(np.linalg.norm(np.diff(positions, axis=0), axis=1)))


@dataclass(frozen=True)
class Drift:
    """How fast the error grows with the way.

    Attributes
    ----------
    translation : (m,) ndarray
        Errors of the sub-trajectories, in metres of error a metre of way.
    rotation : (m,) ndarray or None
        In degrees a metre; ``nan`` of devices that tell no orientation.
    """

    translation: Array
    rotation: Array | None

    @classmethod
    def joined(cls, parts: Sequence[Drift]) -> Drift:
        """That of several devices."""
        return cls(
            np.concatenate([part.translation for part in parts]),
            _joined([part.rotation for part in parts], [len(part.translation) for part in parts]),
        )


def drift(poses: Poses) -> Drift:
    """Relative errors over parts of 10 to 50 % of the way, by their length.

    From each pose (of at most :data:`MOST_STARTS`) to the first one that is that much further
    on the way of the truth. Zhang and Scaramuzza, A tutorial on quantitative trajectory
    evaluation for visual(-inertial) odometry, IROS 2018, section V-B. No sub-trajectories
    where the truth stands still.
    """
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(poses.truth, axis=0), axis=1))])[
        : len(poses)
    ]
    starts = np.unique(np.linspace(0, max(len(way) - 1, 0), MOST_STARTS).astype(np.int64))
    firsts, lasts = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    lengths = [np.zeros(0)]
    for part in PARTS:
        length = part * way[-1] if len(way) else 0.0
        if not length > 0:
            continue
        end = np.searchsorted(way, way[starts] + length)
        first = starts[end < len(way)]
        firsts.append(first)
        lasts.append(end[end < len(way)])
        lengths.append(np.full(len(first), length))
    errors = relative_errors(poses, np.concatenate(firsts), np.concatenate(lasts))
    length = np.concatenate(lengths)
    turned = None if errors.rotation_deg is None else errors.rotation_deg / length
    return Drift(errors.translation / length, turned)
