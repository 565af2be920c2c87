"""Errors between matched poses: absolute (APE), relative (RPE) and drift, with their statistics.

The relative error of two poses i and j is the difference between the estimated and the true motion
from i to j, in the frame of pose i: E = (Q_i^-1 Q_j)^-1 (P_i^-1 P_j) (Sturm et al., A benchmark for
the evaluation of RGB-D SLAM systems, IROS 2012, eq. 2). Its translation is given in metres, its
rotation as an angle. If estimate or truth has no orientations, motions are compared in the frame of
the truth instead, and there is no rotation error.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Literal, cast

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.geometry import (
    quaternion_angle,
    quaternion_inverse,
    quaternion_multiply,
    quaternion_rotate,
)

Array = NDArray[np.float64]
Rows = NDArray[np.int64]
Unit = Literal["f", "m", "deg", "s"]

DELTA_TOLERANCE_FRACTION = 0.1
"""Largest relative deviation of a pair's distance from the delta with all pairs; evo's default."""

DRIFT_PATH_FRACTIONS = (0.1, 0.2, 0.3, 0.4, 0.5)
"""Lengths of the sub-trajectories of drift, as fractions of the path; those of the toolbox of Zhang
and Scaramuzza."""

MAX_SUB_TRAJECTORIES = 2000
"""Largest number of sub-trajectories of one length, which start evenly over the poses. It
bounds the time for long recordings."""

DELTA_PATTERN = re.compile(r"([0-9.eE+-]+)\s*(f|m|deg|s)", re.ASCII)


@dataclass(frozen=True)
class Statistics:
    """Statistics of n errors, in their unit; the names are those of evo.

    Attributes
    ----------
    n : int
    rmse, mean, median, std, min, max : float
        ``std`` is computed with n, not n - 1, so that rmse^2 = mean^2 + std^2.
    p95 : float
        95th percentile, interpolated linearly.
    sse : float
        Sum of squares.
    """

    n: int
    rmse: float
    mean: float
    median: float
    std: float
    min: float
    max: float
    p95: float
    sse: float

    @classmethod
    def from_errors(cls, errors: Array) -> Statistics:
        """Compute the statistics of errors (n,), all finite, n > 0."""
        squares = errors * errors
        median, p95 = np.percentile(errors, (50, 95))
        return cls(
            n=len(errors),
            rmse=float(np.sqrt(np.mean(squares))),
            mean=float(np.mean(errors)),
            median=float(median),
            std=float(np.std(errors)),
            min=float(np.min(errors)),
            max=float(np.max(errors)),
            p95=float(p95),
            sse=float(np.sum(squares)),
        )

    @classmethod
    def from_finite(cls, errors: Array | None) -> Statistics | None:
        """Compute the statistics of the finite errors among (n,); None if there are none."""
        if errors is None:
            return None
        is_finite = np.isfinite(errors)
        return cls.from_errors(errors[is_finite]) if is_finite.any() else None

    def as_dict(self) -> dict[str, float]:
        """Return the JSON form."""
        return asdict(self)


@dataclass(frozen=True)
class Delta:
    """Distance between the two poses of a relative error.

    Attributes
    ----------
    value : float
    unit : str
        ``"f"`` for poses, ``"m"`` for metres of path, ``"deg"`` for degrees of rotation, ``"s"``
        for seconds.
    """

    value: float
    unit: Unit

    @classmethod
    def parse(cls, text: str) -> Delta:
        """Parse a distance as ``"1f"``, ``"0.5m"``, ``"10deg"`` or ``"1s"``.

        Raises
        ------
        InputError
            The text has another form, or its value is not positive, finite and possible.
        """
        match = DELTA_PATTERN.fullmatch(text.strip())
        try:
            value = float(match[1]) if match else np.nan
        except ValueError:
            value = np.nan
        unit = match[2] if match else "f"
        is_countable = unit != "f" or value == np.floor(value)
        if not (0 < value < np.inf) or not is_countable or (unit == "deg" and value > 180):
            raise InputError(
                f"{text!r} is no distance between poses",
                hint="write it as 1f (poses, a whole number), 0.5m, 10deg (up to 180) or 1s",
            )
        return cls(value, cast(Unit, unit))

    def __str__(self) -> str:
        return f"{self.value:g}{self.unit}"


@dataclass(frozen=True)
class MatchedPoses:
    """Matched poses of one device: the aligned estimate and its truth.

    Attributes
    ----------
    time_ns : (n,) int64 ndarray
    estimate, truth : (n, 3) ndarray
        Positions in metres, in the frame of the truth.
    estimate_quaternion, truth_quaternion : (n, 4) ndarray or None
        Orientations; None if one of the two has none.
    """

    time_ns: NDArray[np.int64]
    estimate: Array
    truth: Array
    estimate_quaternion: Array | None
    truth_quaternion: Array | None

    def __len__(self) -> int:
        return len(self.time_ns)


@dataclass(frozen=True)
class RelativeErrors:
    """Errors of m motions between poses.

    Attributes
    ----------
    first, last : (m,) int ndarray
        Rows of the poses at the start and end of each motion.
    translation : (m,) ndarray
        In metres.
    rotation_deg : (m,) ndarray or None
        ``nan`` for devices without orientations; None if no device has any.
    """

    first: Rows
    last: Rows
    translation: Array
    rotation_deg: Array | None

    @classmethod
    def concatenate(cls, parts: Sequence[RelativeErrors]) -> RelativeErrors:
        """Concatenate the errors of several devices."""
        return cls(
            np.concatenate([part.first for part in parts]),
            np.concatenate([part.last for part in parts]),
            np.concatenate([part.translation for part in parts]),
            _concatenate_known(
                [part.rotation_deg for part in parts], [len(part.first) for part in parts]
            ),
        )


@dataclass(frozen=True)
class Drift:
    """Errors of sub-trajectories per metre of path.

    Attributes
    ----------
    translation : (m,) ndarray
        In metres per metre.
    rotation : (m,) ndarray or None
        In degrees per metre; ``nan`` for devices without orientations, None if no device has any.
    """

    translation: Array
    rotation: Array | None

    @classmethod
    def concatenate(cls, parts: Sequence[Drift]) -> Drift:
        """Concatenate the drift of several devices."""
        return cls(
            np.concatenate([part.translation for part in parts]),
            _concatenate_known(
                [part.rotation for part in parts], [len(part.translation) for part in parts]
            ),
        )


def _concatenate_known(parts: Sequence[Array | None], sizes: Sequence[int]) -> Array | None:
    """Concatenate arrays with ``nan`` for unknown ones; None if all are unknown."""
    if all(part is None for part in parts):
        return None
    filled = [np.full(n, np.nan) if p is None else p for p, n in zip(parts, sizes, strict=True)]
    return np.concatenate(filled)


def relative_errors(poses: MatchedPoses, first: Rows, last: Rows) -> RelativeErrors:
    """Compute the errors of the motions from rows ``first`` (m,) to rows ``last`` (m,)."""
    motion = poses.estimate[last] - poses.estimate[first]
    true_motion = poses.truth[last] - poses.truth[first]
    if poses.estimate_quaternion is None or poses.truth_quaternion is None:
        return RelativeErrors(first, last, np.linalg.norm(motion - true_motion, axis=1), None)
    # The inverse orientations are computed once per pose, not once per pair.
    inverse = quaternion_inverse(poses.estimate_quaternion)
    true_inverse = quaternion_inverse(poses.truth_quaternion)
    difference = quaternion_rotate(inverse[first], motion) - quaternion_rotate(
        true_inverse[first], true_motion
    )
    rotation = quaternion_multiply(inverse[first], poses.estimate_quaternion[last])
    true_rotation = quaternion_multiply(true_inverse[first], poses.truth_quaternion[last])
    rotation_error = quaternion_multiply(quaternion_inverse(true_rotation), rotation)
    return RelativeErrors(
        first,
        last,
        np.linalg.norm(difference, axis=1),
        np.rad2deg(quaternion_angle(rotation_error)),
    )


def select_pairs(
    poses: MatchedPoses, delta: Delta, *, all_pairs: bool = False
) -> tuple[Rows, Rows]:
    """Select pairs of poses that are ``delta`` apart, measured on the aligned estimate.

    A pair begins at the end of the previous one and ends at the first pose that is at least
    ``delta`` away. With ``all_pairs``, a pair begins at each pose and ends at the later pose whose
    distance is nearest to ``delta``, with a deviation of at most :data:`DELTA_TOLERANCE_FRACTION`.
    Both are as in evo 1.38 (``evo.core.filters``).

    Returns
    -------
    first, last : (m,) int ndarray
        Rows of the two poses of each pair.

    Raises
    ------
    InputError
        ``all_pairs`` with degrees, or degrees without orientations.
    """
    n = len(poses)
    if delta.unit == "f":
        step = int(min(delta.value, n))
        first = np.arange(0, max(n - step, 0), 1 if all_pairs else max(step, 1))
        return first, first + step
    if delta.unit == "deg" and all_pairs:
        raise InputError(
            "all pairs at a distance in degrees would be too many to find",
            hint="leave out --all-pairs, or give the distance in poses, metres or seconds",
        )
    if n < 2:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    steps = _step_lengths(poses, delta.unit)
    if all_pairs:
        return _select_all_pairs(np.concatenate([[0.0], np.cumsum(steps)]), delta.value)
    # Distances are summed from pair to pair in float64, so that ties are resolved as in evo.
    limit = np.deg2rad(delta.value) if delta.unit == "deg" else delta.value
    ends, distance = [0], 0.0
    for row, step in enumerate(steps.tolist(), start=1):
        distance += step
        if distance >= limit:
            ends.append(row)
            distance = 0.0
    return np.array(ends[:-1], np.int64), np.array(ends[1:], np.int64)


def _step_lengths(poses: MatchedPoses, unit: Unit) -> Array:
    """Distances from each pose to the next (n - 1,), in metres, seconds or radians."""
    if unit == "m":
        return np.asarray(np.linalg.norm(np.diff(poses.estimate, axis=0), axis=1))
    if unit == "s":
        return np.diff(poses.time_ns) / 1e9
    if poses.estimate_quaternion is None:
        raise InputError(
            "the poses have no orientations, so that distances in degrees are unknown",
            hint="give the distance in poses, metres or seconds",
        )
    quaternion = poses.estimate_quaternion
    return quaternion_angle(
        quaternion_multiply(quaternion_inverse(quaternion[:-1]), quaternion[1:])
    )


def _select_all_pairs(path: Array, delta: float) -> tuple[Rows, Rows]:
    """Pair each pose with the later one whose distance along ``path`` (n,) is nearest to delta."""
    first = np.arange(len(path) - 1)
    after = np.minimum(np.searchsorted(path, path[:-1] + delta), len(path) - 1)
    before = np.maximum(after - 1, first + 1)
    before_deviation = np.abs(path[before] - path[:-1] - delta)
    after_deviation = np.abs(path[after] - path[:-1] - delta)
    last = np.maximum(np.where(before_deviation <= after_deviation, before, after), first + 1)
    is_accepted = np.abs(path[last] - path[:-1] - delta) <= DELTA_TOLERANCE_FRACTION * delta
    return first[is_accepted], last[is_accepted]


def path_length(positions: Array) -> float:
    """Return the length of the path through positions (n, 3)."""
    return float(np.sum(np.linalg.norm(np.diff(positions, axis=0), axis=1)))


def compute_drift(poses: MatchedPoses) -> Drift:
    """Compute the relative errors of sub-trajectories of 10 to 50 % of the path, by their length.

    Each leads from a pose (at most :data:`MAX_SUB_TRAJECTORIES`) to the first one that is that much
    further along the path of the truth. Zhang and Scaramuzza, A tutorial on quantitative trajectory
    evaluation for visual(-inertial) odometry, IROS 2018, section V-B. A truth at rest has no
    sub-trajectories.
    """
    steps = np.linalg.norm(np.diff(poses.truth, axis=0), axis=1)
    path = np.concatenate([[0.0], np.cumsum(steps)])[: len(poses)]
    starts = np.linspace(0, max(len(path) - 1, 0), MAX_SUB_TRAJECTORIES)
    starts = np.unique(starts.astype(np.int64))
    firsts, lasts = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    lengths = [np.zeros(0)]
    for fraction in DRIFT_PATH_FRACTIONS:
        length = fraction * path[-1] if len(path) else 0.0
        if not length > 0:
            continue
        end = np.searchsorted(path, path[starts] + length)
        first = starts[end < len(path)]
        firsts.append(first)
        lasts.append(end[end < len(path)])
        lengths.append(np.full(len(first), length))
    errors = relative_errors(poses, np.concatenate(firsts), np.concatenate(lasts))
    length = np.concatenate(lengths)
    rotation = None if errors.rotation_deg is None else errors.rotation_deg / length
    return Drift(errors.translation / length, rotation)
