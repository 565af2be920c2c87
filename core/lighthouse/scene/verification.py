"""How well a scene predicts what took no part in solving it, station by station.

Each station is compared with where the others see a photodiode, as far as these suffice;
and each is left out in turn, to see by how far positions jump when it is hidden. A station
without which the rest agree, and with which they do not, was moved or is seen by reflection.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.lighthouse.calibration import Calibration, predict_angles
from locatk.core.lighthouse.localization.positions import PositionEstimates, estimate_positions
from locatk.core.robust import robust_sigma

Array = NDArray[np.float64]

MOST = 500
"""Moments that are verified, at most: a median needs no more."""

WRONG_RAD = 1.5e-3
"""Residual from which on a station can be wrong, in radians: above what a generic calibration
leaves unmodelled."""

WRONG_SHARE = 1 / 3
"""The others agree by so much better without a wrong station than without any other."""


@dataclass(frozen=True)
class StationCheck:
    """One station against the others.

    Attributes
    ----------
    channel : int
    against : str
        ``"others"``: its angles against positions from all other stations; ``"joint"``:
        against positions in which it took part, where the others do not suffice.
    moments : int
        That told.
    residual_rad : float
        Robust standard deviation of its angles from those predicted; None where none told.
    residual_m : float
        The same at the distance of each photodiode, across the ray, in metres.
    jump_median_m, jump_95_m : float or None
        How far positions move when it is left out: median and 95 % of the moments.
    without_rad : float or None
        What the other stations' angles disagree by among themselves when it is left out.
    """

    channel: int
    against: str
    moments: int
    residual_rad: float | None
    residual_m: float | None
    jump_median_m: float | None
    jump_95_m: float | None
    without_rad: float | None

    def as_facts(self) -> dict[str, object]:
        """For :attr:`~locatk.core.solution.Solution.facts`."""
        return dict(vars(self))


def verify(
    angles: Array,
    channels: Sequence[int],
    positions: Array,
    rotations: Array,
    calibrations: tuple[Calibration, ...],
    *,
    floor_z: float | None = None,
) -> tuple[StationCheck, ...]:
    """Check each station of a scene.

    Parameters
    ----------
    angles : (m, s, 2) ndarray
        Rotor angles in radians, ``nan`` where not seen, of moments that took no part in
        solving the scene.
    channels : sequence of int
    positions, rotations, calibrations
        Of the stations, as for :func:`~locatk.core.lighthouse.localization.positions.estimate_positions`.
    floor_z : float, optional
        Height of all photodiodes, where they move on a plane.

    Returns
    -------
    tuple of StationCheck
        In the order of ``channels``.
    """

    def where(seen: Array) -> PositionEstimates:
        return estimate_positions(seen, positions, rotations, calibrations, floor_z=floor_z)

    joint = where(angles)
    checks = []
    for i, channel in enumerate(channels):
        mine = np.isfinite(angles[:, i]).any(axis=1)
        rest = angles[mine]
        rest[:, i] = np.nan
        without = where(rest)
        told = np.isfinite(without.position[:, 0])
        against = "others" if np.any(told) else "joint"
        position = without.position if np.any(told) else joint.position[mine]
        local = (position - positions[i]) @ rotations[i]
        with np.errstate(invalid="ignore"):
            residual = predict_angles(local, calibrations[i]) - angles[mine, i]
        away = np.linalg.norm(local, axis=1)[:, None]
        number = int(np.count_nonzero(np.isfinite(residual).any(axis=1)))
        jump = np.linalg.norm(without.position - joint.position[mine], axis=1)
        jump = jump[np.isfinite(jump)]
        checked = without.freedom > 0
        agreed = np.abs(without.residual[checked & told])
        checks.append(
            StationCheck(
                int(channel),
                against,
                number,
                robust_sigma(residual) if number else None,
                robust_sigma(residual * away) if number else None,
                float(np.median(jump)) if len(jump) else None,
                float(np.percentile(jump, 95)) if len(jump) else None,
                robust_sigma(agreed) if len(agreed) else None,
            )
        )
    return tuple(checks)


def wrong_station(checks: Sequence[StationCheck]) -> StationCheck | None:
    """The station that contradicts all others, which agree without it; None where there is
    none, or where fewer than three are there to tell."""
    told = sorted(
        (c.without_rad, k)
        for k, c in enumerate(checks)
        if c.without_rad is not None and c.against == "others"
    )
    if len(told) < 3:
        return None
    (best, k), (second, _) = told[:2]
    residual = checks[k].residual_rad
    stands_out = best < WRONG_SHARE * second and residual is not None and residual > WRONG_RAD
    return checks[k] if stands_out else None
