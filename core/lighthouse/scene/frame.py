"""Gauge of a scene: its frame and scale, from markers, a known distance, odometry, or none.

A bundle adjustment of angles has an arbitrary frame and unit. Three or more markers give metres
and the frame of the user. Several are averaged: with an origin from a single sample, its error
shifts the whole scene. A known distance or odometry give the scale only.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError, InputError
from locatk.core.geometry import Similarity, transform_covariance, umeyama
from locatk.core.lighthouse.epochs import Epochs
from locatk.core.lighthouse.light_planes import counts_to_angles
from locatk.core.lighthouse.localization.positions import PositionEstimates, estimate_positions
from locatk.core.lighthouse.noise import INLIER_GATE_RAD
from locatk.core.lighthouse.recording import NANOSECONDS_PER_S
from locatk.core.lighthouse.scene import Distance, Marker, MarkerVisit, Scene
from locatk.core.lighthouse.scene.bundle_adjustment import BundleState
from locatk.core.lighthouse.scene.reframing import median_position
from locatk.core.solution import SolverWarning
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]

MIN_MARKERS = 3
"""Fewest markers that fix a frame."""

MIN_MARKERS_FOR_MISFIT = 4
"""Fewest markers whose misfit is meaningful: a similarity fits three of them too easily."""

MAX_MARKER_MISFIT_M = 0.02
"""Rms misfit of markers from which a warning is given: ten times the error of a measurement by hand
with a generic calibration."""

ODOMETRY_INTERVAL_S = 1.0
MAX_ODOMETRY_INTERVAL_S = 1.5
"""Time over which the path of odometry is compared with that of the photodiode. Over a second the
drift of odometry is negligible and the path is much longer than the noise of a position."""

MIN_ODOMETRY_MOTION_RATIO = 0.2
"""Intervals with a shorter path, relative to the longest, have too little motion to compare."""

MIN_ODOMETRY_INTERVALS = 5
"""Fewest intervals with motion that determine the scale."""


@dataclass(frozen=True)
class FramedState:
    """Stations in the frame and unit of a scene.

    Attributes
    ----------
    state : BundleState
    station_covariance : (s, k, k) ndarray
        As in :class:`~locatk.core.lighthouse.scene.bundle_adjustment.BundleAdjustment`.
    floor_z : float
        Height of the photodiodes in a planar scene, in metres.
    scale, frame, frame_source : str
        As in :class:`~locatk.core.lighthouse.scene.model.Scene`.
    marker_misfit_m : float or None
        Rms residual of the markers; None for fewer than :data:`MIN_MARKERS_FOR_MISFIT`.
    warnings : tuple of SolverWarning
    """

    state: BundleState
    station_covariance: Array
    floor_z: float
    scale: str
    frame: str
    frame_source: str
    marker_misfit_m: float | None = None
    warnings: tuple[SolverWarning, ...] = ()


def fix_gauge(
    state: BundleState,
    station_covariance: Array,
    planar: bool,
    prior: Scene,
    epochs: Epochs,
    angles: Array,
    odometry: Sequence[Trajectory],
) -> FramedState:
    """Transform a state into the frame and scale of markers, a distance or odometry.

    Parameters
    ----------
    state : BundleState
        Stations of ``epochs``; if ``planar``, photodiodes have z = 0.
    station_covariance : (s, k, k) ndarray
    planar : bool
    prior : Scene
        Its markers and distances are used.
    epochs : Epochs
    angles : (m, s, 2) ndarray
        Rotor angles of the epochs in radians.
    odometry : sequence of Trajectory

    Raises
    ------
    DegenerateError
        The markers are on a line, or no distance was observed at both ends.
    """
    marker_points, observed = marker_angles(prior.markers, epochs, angles)
    to_markers = align_to_markers(state, planar, marker_points, observed)
    if to_markers is not None:
        return _framed_by_markers(
            state, station_covariance, planar, prior, marker_points, observed, to_markers
        )
    warnings = []
    if prior.markers:
        warnings.append(
            SolverWarning(
                "too_few_markers",
                f"fewer than {MIN_MARKERS} markers were visited in view of enough stations: the "
                "frame is not that of the markers",
            )
        )
    scale, source, scale_warnings = _scale(state, planar, prior, epochs, angles, odometry)
    to_station = first_station_frame(state, planar, scale)
    return FramedState(
        transform_state(state, to_station),
        transform_covariance(station_covariance, scale, to_station.rotation),
        0.0,
        source,
        prior.frame if planar else f"station-{epochs.channels[0]}",
        "floor" if planar else "station",
        warnings=(*warnings, *scale_warnings),
    )


def _framed_by_markers(
    state: BundleState,
    station_covariance: Array,
    planar: bool,
    prior: Scene,
    marker_points: Array,
    observed: Array,
    to_markers: Similarity,
) -> FramedState:
    """Transform a state by ``to_markers``, and add warnings about the markers."""
    is_located = np.isfinite(locate_with(state, planar, observed).position[:, 0])
    warnings = unused_visits_warnings(prior.markers, int(np.count_nonzero(is_located)))
    misfit = marker_misfit(state, planar, marker_points, observed)
    if MAX_MARKER_MISFIT_M < misfit < np.inf:
        warnings.append(marker_misfit_warning(misfit))
    framed = transform_state(state, to_markers)
    floor_z = float(np.mean(marker_points[:, 2])) if planar else 0.0
    if planar and np.mean(framed.positions[:, 2]) < floor_z:
        warnings.append(
            SolverWarning(
                "stations_below_floor",
                "the stations are below the floor: x and y of the markers are clockwise seen from "
                "above, so that their z points down",
            )
        )
    return FramedState(
        framed,
        transform_covariance(station_covariance, to_markers.scale, to_markers.rotation),
        floor_z,
        "markers",
        prior.frame,
        "markers",
        misfit if np.isfinite(misfit) else None,
        tuple(warnings),
    )


def unused_visits_warnings(markers: Sequence[Marker], used: int) -> list[SolverWarning]:
    """Return a warning if fewer visits of ``markers`` are used than there are."""
    total = sum(len(marker.visits) for marker in markers)
    if used == total:
        return []
    message = (
        f"{total - used} of {total} visits of markers are not used, because too few stations were "
        "received: are their times those of the recording?"
    )
    return [SolverWarning("visits_not_used", message)]


def marker_misfit_warning(misfit_m: float) -> SolverWarning:
    """Return the warning for markers with an rms residual of ``misfit_m``."""
    return SolverWarning(
        "marker_misfit",
        f"the markers are {1e3 * misfit_m:.0f} mm (rms) from their positions in the scene: a "
        "marker was measured wrong, or the scene is wrong",
    )


def given_scene_warnings(
    markers: Sequence[Marker], trajectories: Sequence[Trajectory]
) -> list[SolverWarning]:
    """Return a warning if devices that rested on markers are elsewhere in a given scene."""
    errors = [
        float(np.linalg.norm(position - marker.position))
        for marker in markers
        for visit in marker.visits
        if (position := median_position(trajectories, visit)) is not None
    ]
    misfit_m = float(np.sqrt(np.mean(np.square(errors)))) if errors else 0.0
    if misfit_m <= MAX_MARKER_MISFIT_M:
        return []
    message = (
        f"devices on the markers of the session are {1e3 * misfit_m:.0f} mm (rms) from them in the "
        "given scene: its frame is another one, a station was moved, or a marker is wrong"
    )
    return [SolverWarning("marker_misfit", message)]


def _scale(
    state: BundleState,
    planar: bool,
    prior: Scene,
    epochs: Epochs,
    angles: Array,
    odometry: Sequence[Trajectory],
) -> tuple[float, str, list[SolverWarning]]:
    """Return metres per unit of a state, their source, and warnings."""
    warnings: list[SolverWarning] = []
    if prior.distances:
        scale, used = scale_from_distances(
            lambda observed: locate_with(state, planar, observed).position,
            prior.distances,
            epochs,
            angles,
        )
        if used < len(prior.distances):
            message = (
                f"{len(prior.distances) - used} of {len(prior.distances)} known distances are not "
                "used, because too few stations were received at an end: are the times of the "
                "visits those of the recording?"
            )
            warnings.append(SolverWarning("visits_not_used", message))
        return scale, "distance", warnings
    if odometry:
        estimates = locate_with(state, planar, angles)
        is_inlier = estimates.max_residual < INLIER_GATE_RAD
        odometry_scale = scale_from_odometry(
            np.where(is_inlier[:, None], estimates.position, np.nan),
            epochs.time_ns,
            epochs.device,
            epochs.devices,
            odometry,
        )
        if odometry_scale is not None:
            return odometry_scale, "odometry", warnings
        warnings.append(
            SolverWarning(
                "odometry_without_motion",
                "odometry does not determine the scale: too little motion",
            )
        )
    warnings.append(
        SolverWarning(
            "unit_scale",
            "unit scale: the scale is unknown, so the distance of the first two stations is 1. "
            "Give markers, a distance or odometry",
        )
    )
    baseline = float(np.linalg.norm(state.positions[1] - state.positions[0]))
    return 1.0 / baseline, "unit", warnings


# ---- markers


def visit_angles(visit: MarkerVisit, epochs: Epochs, angles: Array) -> Array:
    """Return the rotor angles (s, 2) of a visit: the median over its time, or its counts.

    ``nan`` for stations that were not received.

    Raises
    ------
    InputError
        The device of the visit is not in the recording.
    """
    observed = np.full((len(epochs.channels), 2), np.nan)
    if visit.counts:
        for i, channel in enumerate(epochs.channels):
            if int(channel) in visit.counts:
                counts = np.sort(np.array(visit.counts[int(channel)], float))
                observed[i] = counts_to_angles(counts, int(channel))
        return observed
    if visit.device not in epochs.devices:
        raise InputError(
            f"the visit of a marker names device {visit.device!r}, which is not in the recording",
            hint=f"devices are {', '.join(epochs.devices)}",
        )
    is_during_visit = (
        (epochs.device == epochs.devices.index(visit.device))
        & (epochs.time_ns >= (visit.start_ns or 0))
        & (epochs.time_ns <= (visit.end_ns or 0))
    )
    during_visit = angles[is_during_visit]
    for index in np.ndindex(observed.shape):
        column = during_visit[(slice(None), *index)]
        if np.any(np.isfinite(column)):
            observed[index] = np.nanmedian(column)
    return observed


def marker_angles(markers: Sequence[Marker], epochs: Epochs, angles: Array) -> tuple[Array, Array]:
    """Return the positions (k, 3) in metres and angles (k, s, 2) of all visits of markers."""
    rows = [
        (marker.position, observed)
        for marker in markers
        for visit in marker.visits
        if np.any(np.isfinite(observed := visit_angles(visit, epochs, angles)))
    ]
    if not rows:
        return np.zeros((0, 3)), np.zeros((0, *angles.shape[1:]))
    return np.stack([r[0] for r in rows]), np.stack([r[1] for r in rows])


def locate_with(state: BundleState, planar: bool, angles: Array) -> PositionEstimates:
    """Estimate positions for angles (m, s, 2) with the stations of a state, in its unit.

    They are on z = 0 if ``planar``.
    """
    return estimate_positions(
        angles,
        state.positions,
        state.rotations,
        state.calibrations,
        floor_z=0.0 if planar else None,
    )


def marker_misfit(state: BundleState, planar: bool, marker_points: Array, observed: Array) -> float:
    """Return the rms residual of markers in metres, after the best similarity.

    Infinite for fewer than :data:`MIN_MARKERS_FOR_MISFIT` located markers. Parameters as for
    :func:`align_to_markers`.
    """
    position = locate_with(state, planar, observed).position
    is_located = np.isfinite(position[:, 0])
    if np.count_nonzero(is_located) < MIN_MARKERS_FOR_MISFIT:
        return float("inf")
    to_markers = align_to_markers(state, planar, marker_points, observed)
    if to_markers is None:
        return float("inf")
    error = to_markers.apply(position[is_located]) - marker_points[is_located]
    return float(np.sqrt(np.mean(np.sum(error**2, axis=1))))


def align_to_markers(
    state: BundleState, planar: bool, marker_points: Array, observed: Array
) -> Similarity | None:
    """Estimate the similarity from the frame of a state to that of the markers.

    Parameters
    ----------
    state : BundleState
    planar : bool
        The photodiodes of the state have z = 0.
    marker_points : (k, 3) ndarray
        Positions of the markers in metres.
    observed : (k, s, 2) ndarray
        Rotor angles there.

    Returns
    -------
    Similarity or None
        None if fewer than :data:`MIN_MARKERS` markers are located.

    Raises
    ------
    DegenerateError
        The markers are on a line.
    """
    estimates = locate_with(state, planar, observed)
    is_located = np.isfinite(estimates.position[:, 0])
    if np.count_nonzero(is_located) < MIN_MARKERS:
        return None
    try:
        return umeyama(estimates.position[is_located], marker_points[is_located])
    except DegenerateError:
        raise DegenerateError(
            "the visited markers are on one line and do not fix a frame",
            hint="add a marker off that line, or leave the markers out",
        ) from None


# ---- scale


def scale_from_distances(
    locate: Callable[[Array], Array],
    distances: Sequence[Distance],
    epochs: Epochs,
    angles: Array,
) -> tuple[float, int]:
    """Estimate metres per unit of a state from known distances, by least squares.

    Returns the scale and the number of distances that were observed at both ends.

    Parameters
    ----------
    locate : callable
        From angles (n, s, 2) to positions (n, 3) in the unit of the state.
    distances : sequence of Distance
    epochs, angles : Epochs, (m, s, 2) ndarray
        Recording in which their ends were visited.

    Raises
    ------
    DegenerateError
        No distance was observed at both ends.
    """
    ends = [
        locate(np.stack([visit_angles(visit, epochs, angles) for visit in (d.first, d.second)]))
        for d in distances
    ]
    lengths = np.array([np.linalg.norm(second - first) for first, second in ends])
    known_m = np.array([d.distance for d in distances])
    is_observed = np.isfinite(lengths) & (lengths > 0)
    if not np.any(is_observed):
        raise DegenerateError(
            "no known distance was observed at both ends by enough stations",
            hint="check the times of its visits",
        )
    lengths, known_m = lengths[is_observed], known_m[is_observed]
    return float(lengths @ known_m / (lengths @ lengths)), len(lengths)


def scale_from_odometry(
    position: Array,
    time_ns: NDArray[np.int64],
    device: NDArray[np.int64],
    devices: Sequence[str],
    odometry: Sequence[Trajectory],
) -> float | None:
    """Estimate metres per unit of a state from odometry.

    Distances covered in about a second are compared, so that the drift of odometry over minutes
    has no effect. The result is the median over all such intervals with motion.

    Parameters
    ----------
    position : (m, 3) ndarray
        Of photodiodes, in the unit of the state; ``nan`` if unknown.
    time_ns, device : (m,) ndarray
        Ascending in time for each device.
    devices : sequence of str
    odometry : sequence of Trajectory

    Returns
    -------
    float or None
        None if there are fewer than :data:`MIN_ODOMETRY_INTERVALS` intervals with motion.
    """
    ratios = []
    for track in odometry:
        if track.device not in devices or len(track) < 2:
            continue
        is_covered = (device == devices.index(track.device)) & np.isfinite(position[:, 0])
        is_covered &= (time_ns >= track.time_ns[0]) & (time_ns <= track.time_ns[-1])
        time, path = time_ns[is_covered], position[is_covered]
        if len(time) < 2:
            continue
        end = np.searchsorted(time, time + round(ODOMETRY_INTERVAL_S * NANOSECONDS_PER_S))
        start = np.flatnonzero(end < len(time))
        end = end[start]
        is_short = time[end] - time[start] < round(MAX_ODOMETRY_INTERVAL_S * NANOSECONDS_PER_S)
        start, end = start[is_short], end[is_short]
        base = track.time_ns[0]
        odometry_path = np.stack(
            [np.interp(time - base, track.time_ns - base, track.position[:, k]) for k in range(3)],
            axis=1,
        )
        metres = np.linalg.norm(odometry_path[end] - odometry_path[start], axis=1)
        units = np.linalg.norm(path[end] - path[start], axis=1)
        is_moving = metres > MIN_ODOMETRY_MOTION_RATIO * np.max(metres, initial=0.0)
        ratios.append((metres / np.maximum(units, 1e-12))[is_moving & (units > 0)])
    every = np.concatenate(ratios) if ratios else np.zeros(0)
    return float(np.median(every)) if len(every) >= MIN_ODOMETRY_INTERVALS else None


# ---- transformations


def transform_state(state: BundleState, to: Similarity) -> BundleState:
    """Transform a state by a similarity."""
    return BundleState(
        to.apply(state.positions),
        to.rotation @ state.rotations,
        state.calibrations,
        to.apply(state.points),
    )


def first_station_frame(state: BundleState, planar: bool, scale: float) -> Similarity:
    """Return the similarity to the default frame, which the first station defines.

    In space the axes are those of the first station. On a floor z points up, and the origin is
    below the first station, whose view is along x.
    """
    rotation = state.rotations[0].T
    origin = state.positions[0]
    if planar:
        forward = state.rotations[0][:2, 0] / np.linalg.norm(state.rotations[0][:2, 0])
        rotation = np.array(
            [[forward[0], forward[1], 0.0], [-forward[1], forward[0], 0.0], [0.0, 0.0, 1.0]]
        )
        origin = origin * np.array([1.0, 1.0, 0.0])
    return Similarity(scale, rotation, -scale * rotation @ origin)
