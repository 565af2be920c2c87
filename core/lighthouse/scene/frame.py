"""Scale and frame of a solved scene: from markers, a distance, odometry, or neither.

A rig solved from angles has a unit of its own. Markers (several, not one: the peers' user
errors of 58 to 132 mm come from a single origin sample, facts/lighthouse.md 5) turn it
into metres and into the user's frame; a distance or odometry give the metres only.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError, InputError
from locatk.core.geometry import Similarity, umeyama
from locatk.core.lighthouse.epochs import Epochs
from locatk.core.lighthouse.light_planes import counts_to_angles
from locatk.core.lighthouse.localization.positions import PositionEstimates, estimate_positions
from locatk.core.lighthouse.scene import Distance, Marker, MarkerVisit
from locatk.core.lighthouse.scene.bundle_adjustment import BundleState
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]


def sighted_angles(sighting: MarkerVisit, epochs: Epochs, angles: Array) -> Array:
    """Rotor angles (s, 2) seen at a sighting: the median over its time, or its counts.

    ``nan`` where a station was not seen.
    """
    if sighting.counts:
        seen = np.full((len(epochs.channels), 2), np.nan)
        for i, channel in enumerate(epochs.channels):
            if int(channel) in sighting.counts:
                pair = np.sort(np.array(sighting.counts[int(channel)], float))
                seen[i] = counts_to_angles(pair, int(channel))
        return seen
    if sighting.device not in epochs.devices:
        raise InputError(
            f"a sighting names the device {sighting.device!r}, which is not in the recording",
            hint=f"devices are {', '.join(epochs.devices)}",
        )
    inside = (
        (epochs.device == epochs.devices.index(sighting.device))
        & (epochs.time_ns >= (sighting.start_ns or 0))
        & (epochs.time_ns <= (sighting.end_ns or 0))
    )
    if not np.any(inside):
        return np.full(angles.shape[1:], np.nan)
    chosen = angles[inside]
    seen = np.full(angles.shape[1:], np.nan)
    for index in np.ndindex(seen.shape):
        column = chosen[(slice(None), *index)]
        if np.any(np.isfinite(column)):
            seen[index] = np.nanmedian(column)
    return seen


def sighted_markers(
    markers: Sequence[Marker], epochs: Epochs, angles: Array
) -> tuple[Array, Array]:
    """Positions (k, 3) in metres and angles (k, s, 2) of all sightings of markers."""
    rows = [
        (marker.position, seen)
        for marker in markers
        for sighting in marker.sightings
        if np.any(np.isfinite(seen := sighted_angles(sighting, epochs, angles)))
    ]
    if not rows:
        return np.zeros((0, 3)), np.zeros((0, *angles.shape[1:]))
    return np.stack([r[0] for r in rows]), np.stack([r[1] for r in rows])


def sight(rig: BundleState, planar: bool, angles: Array) -> PositionEstimates:
    """Where a rig sees photodiodes (m, s, 2), in its own unit; on z = 0 where ``planar``."""
    return estimate_positions(
        angles, rig.positions, rig.rotations, rig.calibrations, floor_z=0.0 if planar else None
    )


def marker_misfit(rig: BundleState, planar: bool, known: Array, seen: Array) -> float:
    """Rms distance in metres of markers from where the rig sees them, after the best
    similarity; infinite for fewer than four, which fit too easily to tell.

    Parameters as for :func:`place_on_markers`.
    """
    position = sight(rig, planar, seen).position
    good = np.isfinite(position[:, 0])
    to = place_on_markers(rig, planar, known, seen) if np.count_nonzero(good) >= 4 else None
    if to is None:
        return float("inf")
    return float(np.sqrt(np.mean(np.sum((to.apply(position[good]) - known[good]) ** 2, axis=1))))


def place_on_markers(
    rig: BundleState, planar: bool, known: Array, seen: Array
) -> Similarity | None:
    """Similarity that brings the rig into the frame of its markers, or None where fewer
    than three are seen well enough.

    Parameters
    ----------
    rig : BundleState
    planar : bool
        The rig's photodiodes have z = 0.
    known : (k, 3) ndarray
        Markers in metres.
    seen : (k, s, 2) ndarray
        Their rotor angles.

    Raises
    ------
    DegenerateError
        The markers lie on a line.
    """
    fixes = sight(rig, planar, seen)
    good = np.isfinite(fixes.position[:, 0])
    if np.count_nonzero(good) < 3:
        return None
    try:
        return umeyama(fixes.position[good], known[good])
    except DegenerateError:
        raise DegenerateError(
            "the sighted markers lie on one line and do not fix a frame",
            hint="add a marker off that line, or leave the markers out",
        ) from None


def scale_of_distances(
    where: Callable[[Array], Array],
    distances: Sequence[Distance],
    epochs: Epochs,
    angles: Array,
) -> float:
    """Metres a unit of a rig, from known distances (least squares over all).

    Parameters
    ----------
    where : callable
        Positions (n, 3) in the rig's unit of photodiodes that saw angles (n, s, 2).
    distances : sequence of Distance
    epochs, angles : Epochs, (m, s, 2) ndarray
        The recording in which their ends were sighted.

    Raises
    ------
    DegenerateError
        No distance was seen at both its ends.
    """
    ends = [
        where(np.stack([sighted_angles(s, epochs, angles) for s in (d.first, d.second)]))
        for d in distances
    ]
    lengths = np.array([np.linalg.norm(second - first) for first, second in ends])
    known = np.array([d.distance for d in distances])
    seen = np.isfinite(lengths) & (lengths > 0)
    if not np.any(seen):
        raise DegenerateError(
            "no known distance was seen at both its ends by enough stations",
            hint="check the times of its sightings",
        )
    lengths, known = lengths[seen], known[seen]
    return float(lengths @ known / (lengths @ lengths))


def scale_of_odometry(
    position: Array,
    time_ns: NDArray[np.int64],
    device: NDArray[np.int64],
    devices: Sequence[str],
    odometry: Sequence[Trajectory],
) -> float | None:
    """Metres a unit of the rig, from odometry; None where it does not say.

    The distance covered in about a second is compared with what odometry says of the same
    second: drift of odometry over minutes does not enter. Median over all seconds in which
    the robot moved.
    """
    ratios = []
    for track in odometry:
        if track.device not in devices or len(track) < 2:
            continue
        mine = (device == devices.index(track.device)) & np.isfinite(position[:, 0])
        mine &= (time_ns >= track.time_ns[0]) & (time_ns <= track.time_ns[-1])
        when, where = time_ns[mine], position[mine]
        if len(when) < 2:
            continue
        later = np.searchsorted(when, when + 1_000_000_000)
        pairs = np.flatnonzero(later < len(when))
        later = later[pairs]
        near = when[later] - when[pairs] < 1_500_000_000
        pairs, later = pairs[near], later[near]
        base = track.time_ns[0]
        path = np.stack(
            [np.interp(when - base, track.time_ns - base, track.position[:, k]) for k in range(3)],
            axis=1,
        )
        covered = np.linalg.norm(path[later] - path[pairs], axis=1)
        seen = np.linalg.norm(where[later] - where[pairs], axis=1)
        moving = covered > 0.2 * np.max(covered, initial=0.0)
        ratios.append((covered / np.maximum(seen, 1e-12))[moving & (seen > 0)])
    found = np.concatenate(ratios) if ratios else np.zeros(0)
    return float(np.median(found)) if len(found) >= 5 else None


def transform_state(rig: BundleState, to: Similarity) -> BundleState:
    """The rig in another frame and unit."""
    return BundleState(
        to.apply(rig.positions),
        to.rotation @ rig.rotations,
        rig.calibrations,
        to.apply(rig.points),
    )


def at_first_station(rig: BundleState, planar: bool, scale: float) -> Similarity:
    """Frame of a rig that nothing ties to the world.

    In space the axes are the first station's. On a floor z stays up and the origin lies
    below the first station, which looks along x.
    """
    rotation = rig.rotations[0].T
    origin = rig.positions[0]
    if planar:
        forward = rig.rotations[0][:2, 0] / np.linalg.norm(rig.rotations[0][:2, 0])
        rotation = np.array(
            [[forward[0], forward[1], 0.0], [-forward[1], forward[0], 0.0], [0.0, 0.0, 1.0]]
        )
        origin = origin * np.array([1.0, 1.0, 0.0])
    return Similarity(scale, rotation, -scale * rotation @ origin)


def transform_covariance(covariance: Array, scale: float, rotation: Array) -> Array:
    """Covariances (..., k, k) of stations after a similarity of their frame; their first six
    unknowns are position and rotation vector."""
    change = np.eye(covariance.shape[-1])
    change[0:3, 0:3] = scale * rotation
    change[3:6, 3:6] = rotation
    return change @ covariance @ change.T
