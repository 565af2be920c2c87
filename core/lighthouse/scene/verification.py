"""Verification of a scene: agreement of each station with the others on held-out epochs.

The angles of each station are compared with those predicted at positions from the other stations,
if these determine any. In addition each station is left out, and the change of the positions is
measured. If the others agree much better without a station, and it disagrees with them, it was
moved or is received by reflection.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from locatk.core.lighthouse.calibration import Calibration, predict_angles
from locatk.core.lighthouse.localization.positions import (
    PositionEstimates,
    correct_angles,
    intersect_planes,
)
from locatk.core.lighthouse.results import SceneVerification, StationVerification
from locatk.core.lighthouse.scene.keyframes import spread_evenly
from locatk.core.lighthouse.scene.model import StationArrays
from locatk.core.robust import robust_sigma
from locatk.core.solution import SolverWarning

Array = NDArray[np.float64]

MAX_VERIFICATION_EPOCHS = 500
"""Number of epochs on which a scene is verified; the median of more is not more accurate."""

MAX_CANDIDATE_EPOCHS = 20_000
"""Number of epochs, evenly over the recording, among which those to verify a given scene are
selected. It bounds the time of the selection."""

MIN_INCONSISTENT_RESIDUAL_RAD = 1.5e-3
"""Smallest residual of an inconsistent station: above the errors of a generic calibration."""

INCONSISTENT_RESIDUAL_RATIO = 1 / 3
"""Residual of the others without the inconsistent station, relative to that without any other
station, at most."""


def verify_scene(
    angles: Array,
    channels: Sequence[int],
    stations: StationArrays,
    *,
    floor_z: float | None = None,
    held_out: bool = True,
) -> SceneVerification | None:
    """Verify all stations of a scene on up to :data:`MAX_VERIFICATION_EPOCHS` epochs.

    Parameters
    ----------
    angles : (m, s, 2) ndarray
        Rotor angles in radians, ``nan`` without a sweep.
    channels : sequence of int
    stations : StationArrays
    floor_z : float, optional
        Height of all photodiodes, if they move on a plane.
    held_out : bool
        True if the epochs took no part in the estimation of the scene.

    Returns
    -------
    SceneVerification or None
        None for fewer than two stations or without epochs.
    """
    if angles.shape[1] < 2 or len(angles) == 0:
        return None
    rows = spread_evenly(_is_received(angles), np.arange(len(angles)), MAX_VERIFICATION_EPOCHS)
    checks = verify_stations(angles[rows], channels, *stations, floor_z=floor_z)
    return SceneVerification(held_out, len(rows), checks)


def select_verification_epochs(angles: Array) -> NDArray[np.int64]:
    """Select epochs with two stations or more, to verify a given scene on.

    Rejected epochs are included, because they can be the evidence of an inconsistent station.

    Parameters
    ----------
    angles : (m, s, 2) ndarray

    Returns
    -------
    (n,) int ndarray
        Indices, ascending.
    """
    is_received = _is_received(angles)
    rows = np.flatnonzero(np.count_nonzero(is_received, axis=1) > 1)
    rows = rows[:: 1 + len(rows) // MAX_CANDIDATE_EPOCHS]
    return spread_evenly(is_received, rows, MAX_VERIFICATION_EPOCHS)


def _is_received(angles: Array) -> NDArray[np.bool_]:
    """Return (m, s) whether any sweep of each station was received."""
    return np.asarray(np.isfinite(angles).any(axis=2))


def verify_stations(
    angles: Array,
    channels: Sequence[int],
    positions: Array,
    rotations: Array,
    calibrations: tuple[Calibration, ...],
    *,
    floor_z: float | None = None,
) -> tuple[StationVerification, ...]:
    """Verify each station of a scene against the others.

    Parameters
    ----------
    angles : (m, s, 2) ndarray
        Rotor angles in radians, ``nan`` without a sweep, of epochs that took no part in the
        estimation of the scene.
    channels : sequence of int
    positions, rotations, calibrations
        Of the stations, as for
        :func:`~locatk.core.lighthouse.localization.positions.estimate_positions`.
    floor_z : float, optional
        Height of all photodiodes, if they move on a plane.

    Returns
    -------
    tuple of StationVerification
        In the order of ``channels``.
    """

    ideal = correct_angles(angles, calibrations)

    def locate(observed: Array) -> PositionEstimates:
        return intersect_planes(observed, positions, rotations, calibrations, floor_z=floor_z)

    joint = locate(ideal)
    checks = []
    for i, channel in enumerate(channels):
        rows = np.isfinite(angles[:, i]).any(axis=1)
        without_station = ideal[rows]
        without_station[:, i] = np.nan
        from_others = locate(without_station)
        is_located = np.isfinite(from_others.position[:, 0])
        against = "others" if np.any(is_located) else "joint"
        position = from_others.position if np.any(is_located) else joint.position[rows]
        local = (position - positions[i]) @ rotations[i]
        with np.errstate(invalid="ignore"):
            residual = predict_angles(local, calibrations[i]) - angles[rows, i]
        distance = np.linalg.norm(local, axis=1)[:, None]
        count = int(np.count_nonzero(np.isfinite(residual).any(axis=1)))
        jump = np.linalg.norm(from_others.position - joint.position[rows], axis=1)
        jump = jump[np.isfinite(jump)]
        residual_of_others = np.abs(from_others.residual[(from_others.redundancy > 0) & is_located])
        checks.append(
            StationVerification(
                int(channel),
                against,
                count,
                robust_sigma(residual) if count else None,
                robust_sigma(residual * distance) if count else None,
                float(np.median(jump)) if len(jump) else None,
                float(np.percentile(jump, 95)) if len(jump) else None,
                robust_sigma(residual_of_others) if len(residual_of_others) else None,
            )
        )
    return tuple(checks)


def find_inconsistent_station(
    checks: Sequence[StationVerification],
) -> StationVerification | None:
    """Find the station that disagrees with all others, which agree without it.

    Returns None if there is none, or if fewer than three stations were verified against the
    others.
    """
    ranked = sorted(
        (check.without_rad, k)
        for k, check in enumerate(checks)
        if check.without_rad is not None and check.against == "others"
    )
    if len(ranked) < 3:
        return None
    (best, k), (second, _) = ranked[:2]
    residual = checks[k].residual_rad
    is_inconsistent = (
        best < INCONSISTENT_RESIDUAL_RATIO * second
        and residual is not None
        and residual > MIN_INCONSISTENT_RESIDUAL_RAD
    )
    return checks[k] if is_inconsistent else None


def inconsistent_station_warnings(
    verification: SceneVerification | None,
) -> tuple[SolverWarning, ...]:
    """Return a warning if one station of a scene disagrees with all others."""
    station = find_inconsistent_station(verification.stations) if verification else None
    if station is None or station.residual_rad is None:
        return ()
    return (
        SolverWarning(
            "wrong_station",
            f"the station on channel {station.channel} disagrees with the others by "
            f"{1e3 * station.residual_rad:.1f} mrad, and these agree without it: it was moved "
            "since the scene was estimated, or is received by reflection",
        ),
    )
