"""Errors and consistency of the poses of a simulated flight.

Poses are compared with the truth at their own time stamps. Errors are given after the best rigid
motion and after the best similarity (Umeyama 1991), so that errors of the frame do not hide those
of the poses.

The NEES of an axis is the squared error over the variance that the solver reports; it is 1 on
average if the covariance is honest. It depends on the frame in which errors are taken:

- *raw*: the frame of the given stations, without an alignment;
- *station*: the frame in which the first station is where the solver reports it, for scenes whose
  frame is defined by this station;
- *aligned*: after the alignment. The errors lack what all poses share (the error of the frame);
  the reported variances still contain it, so that this NEES is a lower bound;
- *projected*: after the alignment, without what the alignment absorbs of the covariance. This needs
  the shared part of the errors, which variances of single poses do not contain.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from locatk.core.geometry import Similarity, umeyama
from locatk.core.lighthouse.scene import Scene
from locatk.core.trajectory import Trajectory
from locatk.formats.benchmarks.lighthouse.flights import START_NS, Flight

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

TruePoses = Callable[[NDArray[np.int64]], tuple[Array, Rotation]]
"""From time stamps (n,) to positions (n, 3) and rotations."""

INTERVAL_S = 0.02
"""Length of the intervals of the coverage [s]: a rotation of a station."""

FAR_M, FAR_SIGMAS = 0.05, 5.0
"""Error of a pose that is wrong for a user [m], and one that its covariance excludes."""

MEDIAN_CHI_SQUARE = 0.4549
"""Median of a chi-square distribution with one degree of freedom."""


@dataclass(frozen=True)
class FlightScore:
    """Errors of the poses of one flight, or of several.

    Attributes
    ----------
    is_covered : (k,) bool ndarray
        For each interval of :data:`INTERVAL_S` between take-off and landing, whether it contains a
        pose.
    raw_m, rigid_m, similarity_m : (n,) ndarray
        Distances from the truth, without an alignment and after it.
    raw_nees, station_nees, aligned_nees, projected_nees : (n, 3) ndarray
        NEES of each axis, as in the module; ``nan`` if it is not defined or the covariance is not
        valid. The alignment is a similarity if the scale is unknown, otherwise rigid.
    is_invalid : (n,) bool ndarray
        True for poses whose covariance is not finite or not positive definite.
    turn_rad, turn_nees : (n,) and (n, 3) ndarray
        Angles between estimated and true orientations after the alignment, and the NEES of their
        components; ``nan`` without an orientation.
    """

    is_covered: Mask
    raw_m: Array
    rigid_m: Array
    similarity_m: Array
    raw_nees: Array
    station_nees: Array
    aligned_nees: Array
    projected_nees: Array
    is_invalid: Mask
    turn_rad: Array
    turn_nees: Array

    def __len__(self) -> int:
        return len(self.rigid_m)

    @property
    def is_far(self) -> Mask:
        """Poses (n,) that are wrong for a user after a rigid alignment."""
        return self.rigid_m > FAR_M

    @classmethod
    def concatenate(cls, scores: Sequence[FlightScore]) -> FlightScore:
        """Pool the poses of several flights."""
        names = cls.__dataclass_fields__
        return cls(**{k: np.concatenate([getattr(s, k) for s in scores]) for k in names})


def score_flight(
    flight: Flight,
    trajectory: Trajectory,
    scene: Scene | None = None,
    *,
    with_scale: bool = False,
    shared: Array | None = None,
) -> FlightScore:
    """Compare a trajectory with the truth of an independent flight.

    ``scene`` is the solved one, for the NEES in the frame of the first station; the other
    parameters are those of :func:`score_trajectory`.
    """
    start_s, end_s = flight.motion.flying_s
    flying_ns = (START_NS + round(start_s * 1e9), START_NS + round(end_s * 1e9))
    return score_trajectory(
        trajectory,
        flight.true_poses,
        flying_ns,
        None if scene is None or with_scale else _station_frame(flight, scene),
        with_scale=with_scale,
        shared=shared,
    )


def score_trajectory(
    trajectory: Trajectory,
    true_poses: TruePoses,
    flying_ns: tuple[int, int],
    station_frame: Similarity | None = None,
    *,
    with_scale: bool = False,
    shared: Array | None = None,
) -> FlightScore:
    """Compare a trajectory with the truth.

    Parameters
    ----------
    trajectory : Trajectory
    true_poses : callable
        From time stamps (n,) to positions (n, 3) and rotations.
    flying_ns : (int, int)
        Start and end of the time in which poses are expected.
    station_frame : Similarity, optional
        Rigid motion that moves the first station from its solved to its true pose.
    with_scale : bool
        True if the scale of the trajectory is unknown.
    shared : (n, 3, m) ndarray, optional
        Factor of the covariance that the positions share: the covariance of the positions i and j
        is ``shared[i] @ shared[j].T``, and that of a position contains ``shared[i] @ shared[i].T``.

    Raises
    ------
    DegenerateError
        The trajectory has too few poses for an alignment.
    """
    position, rotation = true_poses(trajectory.time_ns)
    estimate, covariance = trajectory.position, trajectory.covariance[:, :3, :3]
    rigid = umeyama(estimate, position, with_scale=False)
    similarity = umeyama(estimate, position)
    fit = similarity if with_scale else rigid
    is_invalid = ~_is_valid(trajectory.covariance)
    covariance = np.where(is_invalid[:, None, None], np.nan, covariance)
    undefined = np.full_like(position, np.nan)

    def nees(transform: Similarity, covariance: Array) -> Array:
        """Return the NEES along the axes of the trajectory; ``nan`` if a coordinate is known."""
        error = (transform.apply(estimate) - position) @ transform.rotation / transform.scale
        variance = np.einsum("nii->ni", covariance)
        return error**2 / np.where(variance == 0.0, np.nan, variance)

    station_nees, projected_nees = undefined, undefined
    if station_frame is not None:
        station_nees = nees(station_frame, covariance)
    if shared is not None:
        remaining = _project(shared, estimate, with_scale)
        projected_nees = nees(fit, covariance - shared @ shared.mT + remaining @ remaining.mT)
    turn = np.full_like(position, np.nan)
    has_orientation = np.isfinite(trajectory.covariance[:, 5, 5])
    if np.any(has_orientation):
        frame = Rotation.from_matrix(fit.rotation)
        turned = frame * Rotation.from_quat(trajectory.quaternion[has_orientation])
        error = (turned * rotation[has_orientation].inv()).as_rotvec()
        turn[has_orientation] = frame.inv().apply(error)
    turn_variance = np.einsum("nii->ni", trajectory.covariance)[:, 3:]
    turn_variance = np.where(is_invalid[:, None], np.nan, turn_variance)
    return FlightScore(
        _covered(trajectory.time_ns, flying_ns),
        np.linalg.norm(estimate - position, axis=1),
        np.linalg.norm(rigid.apply(estimate) - position, axis=1),
        np.linalg.norm(similarity.apply(estimate) - position, axis=1),
        nees(Similarity.identity(), covariance),
        station_nees,
        nees(fit, covariance),
        projected_nees,
        is_invalid,
        np.linalg.norm(turn, axis=1),
        turn**2 / turn_variance,
    )


def _is_valid(covariance: Array) -> Mask:
    """Return which covariances (n, 6, 6) are finite and positive definite.

    Not considered are coordinates that are known (without variance, as the height over a floor),
    and the orientation if all its variances are ``nan``.
    """
    has_orientation = np.isfinite(covariance[:, range(3, 6), range(3, 6)]).any(axis=1)
    is_estimated = covariance[:, range(6), range(6)] != 0.0
    is_estimated[~has_orientation, 3:] = False
    is_pair = is_estimated[:, :, None] & is_estimated[:, None, :]
    block = np.where(is_pair, covariance, np.eye(6))
    is_finite: Mask = np.asarray(np.isfinite(block).all(axis=(1, 2)))
    block = np.where(is_finite[:, None, None], block, np.eye(6))
    # Scaled to unit variances, so that metres and radians are comparable.
    sigma = np.sqrt(np.abs(np.einsum("nii->ni", block)) + np.finfo(float).tiny)
    scaled = block / sigma[:, :, None] / sigma[:, None, :]
    return np.asarray(is_finite & (np.linalg.eigvalsh(scaled)[:, 0] > 0))


def _station_frame(flight: Flight, scene: Scene) -> Similarity | None:
    """Return the rigid motion that moves the first station from its solved to its true pose."""
    unit = flight.units[0]
    station = scene.station(unit.channel)
    if station is None:
        return None
    rotation = unit.rotation @ station.rotation.T
    return Similarity(1.0, rotation, unit.position - rotation @ station.position)


def _project(shared: Array, position: Array, with_scale: bool) -> Array:
    """Remove from errors (n, 3, m) what a rigid motion or similarity of the positions absorbs."""
    offset = position - position.mean(axis=0)
    motions = np.zeros((len(position), 3, 7 if with_scale else 6))
    motions[:, range(3), range(3)] = 1.0
    motions[:, :, 3:6] = np.cross(np.eye(3)[None], offset[:, None, :]).swapaxes(1, 2)
    if with_scale:
        motions[:, :, 6] = offset
    flat = motions.reshape(-1, motions.shape[2])
    errors = shared.reshape(len(flat), -1)
    absorbed = flat @ np.linalg.lstsq(flat, errors, rcond=None)[0]
    return np.asarray((errors - absorbed).reshape(shared.shape))


def _covered(time_ns: NDArray[np.int64], flying_ns: tuple[int, int]) -> Mask:
    """Return which intervals of :data:`INTERVAL_S` of the flight contain a pose."""
    edges_ns = np.arange(*flying_ns, round(INTERVAL_S * 1e9))
    return np.diff(np.searchsorted(np.sort(time_ns), edges_ns)) > 0


def exceeds_sigmas(nees: Array) -> Mask:
    """Return which poses have an axis beyond :data:`FAR_SIGMAS`, from the NEES (n, 3) of axes."""
    with np.errstate(invalid="ignore"):
        return np.asarray(np.any(nees > FAR_SIGMAS**2, axis=1))


def summarize(score: FlightScore) -> dict[str, float]:
    """Return the figures of a score: lengths in mm, angles in degrees, fractions from 0 to 1.

    Medians of NEES are divided by :data:`MEDIAN_CHI_SQUARE`, so that means and medians are 1 for
    honest covariances. They differ if some poses are worse than reported and most are not.
    """
    figures = {
        "poses": float(len(score)),
        "coverage": float(np.mean(score.is_covered)),
        "raw median": 1e3 * float(np.median(score.raw_m)),
    }
    for name, distance_m in (("rigid", score.rigid_m), ("similarity", score.similarity_m)):
        median, high, largest = 1e3 * np.quantile(distance_m, [0.5, 0.95, 1.0])
        figures |= {f"{name} median": median, f"{name} p95": high, f"{name} max": largest}
    for name in ("raw", "station", "aligned", "projected", "turn"):
        nees = getattr(score, f"{name}_nees")
        nees = nees[np.isfinite(nees)]
        figures[f"{name} NEES"] = float(nees.mean()) if len(nees) else np.nan
        median = float(np.median(nees)) / MEDIAN_CHI_SQUARE if len(nees) else np.nan
        figures[f"{name} NEES median"] = median
    turn_rad = score.turn_rad[np.isfinite(score.turn_rad)]
    return figures | {
        "beyond": float(np.mean(exceeds_sigmas(score.aligned_nees))),
        "far": float(np.mean(score.is_far)),
        "invalid": float(np.mean(score.is_invalid)),
        "orientation": float(np.degrees(np.median(turn_rad))) if len(turn_rad) else np.nan,
    }
