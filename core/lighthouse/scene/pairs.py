"""Two stations from what both saw: up to scale, in a frame of their own.

Planar and spatial explanations compete; candidates are refined and compared.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError
from locatk.core.lighthouse.calibration import Calibration
from locatk.core.lighthouse.scene import two_view as twoview
from locatk.core.lighthouse.scene import two_view_candidates as candidates
from locatk.core.lighthouse.scene.bundle_adjustment import (
    BundleAdjustment,
    BundleState,
    adjust_bundle,
)
from locatk.core.lighthouse.scene.keyframes import SAME_PLACE, require_distinct_positions

Array = NDArray[np.float64]
Misfit = Callable[[BundleState, tuple[int, int]], float]

START_POINTS = 300
"""Moments with which candidate rigs are compared."""

START_STEPS = 60
"""Steps in which a right start converges."""

MANY = 60
CERTAIN = 1.5e-4
"""With so many places, and a residual (rms, in radians) at the noise of a standing
receiver, a start is taken without trying the others."""

LEAST_BASELINE = 0.02
"""Distance of two stations, as a share of their distance from the plane of the robots."""

FLAT = 3e-3
"""Median miss of a homography, as a tangent, up to which a scene counts as planar."""

CERTAIN_SHARE = 0.9
"""Of the places on one plane: it is a floor, and the others are errors."""

PLANE_SHARE = 0.7
"""A floor has so many of the places that agree at all. Simulated and published floors have 0.83
and more with a tenth of wrong sweeps, space 0.63 and less."""

FLAT_SHARE = 0.03
"""The same as a share of the spread of the rays: in a narrow field anything looks flat. The
published floor has 0.007, its grid in space 0.3, photodiodes on a body of 8 cm 0.05."""


@dataclass(frozen=True)
class StationPair:
    """Two stations that saw the same places.

    Attributes
    ----------
    columns : (int, int)
        Of the stations.
    adjustment : BundleAdjustment
        Of both, over some of the places; in a planar scene z = 0 is the plane of the
        photodiodes and z is up.
    inside : (k,) int ndarray
        Indices of the places that agree with one arrangement.
    planar : bool
    facts : dict
        What was decided, with the figures it was decided on.
    """

    columns: tuple[int, int]
    adjustment: BundleAdjustment
    inside: NDArray[np.int64]
    planar: bool
    facts: dict[str, object]

    @property
    def rig(self) -> BundleState:
        """Both stations, in the order of ``columns``."""
        return self.adjustment.rig

    @property
    def looseness(self) -> float:
        """Standard deviation of the stations' places, as a share of their distance."""
        spread = np.trace(self.adjustment.station_covariance[:, :3, :3], axis1=1, axis2=2)
        baseline = np.linalg.norm(self.rig.positions[1] - self.rig.positions[0])
        return float(np.sqrt(max(float(np.sum(spread)), 0.0)) / max(float(baseline), 1e-12))


def solve_pair(
    angles: Array,
    rays: Array,
    calibrations: tuple[Calibration, ...],
    columns: tuple[int, int],
    *,
    sigma: float,
    planar: bool | None = None,
    misfit: Misfit | None = None,
    seed: int = 0,
) -> StationPair:
    """Solve for two stations.

    Parameters
    ----------
    angles : (m, s, 2) ndarray
        Observed rotor angles of all stations in radians, ``nan`` where not seen.
    rays : (m, s, 3) ndarray
        The directions (1, y, z) that they mean.
    calibrations : tuple of Calibration
        One a station.
    columns : (int, int)
        The two stations.
    sigma, planar, misfit, seed
        As for :func:`~locatk.core.lighthouse.scene.assembly.estimate_stations`.

    Raises
    ------
    DegenerateError
        Their common places do not determine them.
    """
    i, j = columns
    joint = np.flatnonzero(np.isfinite(rays[:, i, 0]) & np.isfinite(rays[:, j, 0]))
    a, b = rays[joint, i], rays[joint, j]
    require_distinct_positions(a, b, 5 if planar is None else 4 if planar else 8)

    facts: dict[str, object] = {}
    flat, on_plane = twoview.agree_on_plane(a, b, seed)
    planar, agreed = _decide(a, b, flat, on_plane, planar, seed, facts)
    require_distinct_positions(a[agreed], b[agreed], 4 if planar else 8)
    if not planar:
        miss = twoview.homography_residuals(
            twoview.fit_homography(a[agreed], b[agreed]), a[agreed], b[agreed]
        )
        if np.sqrt(np.median(miss**2)) < SAME_PLACE / 2:
            raise DegenerateError(
                "all places lie on one plane, which does not determine a scene in space",
                hint="move the photodiode up and down as well, or use --scene two-planar",
            )
    _require_baseline(a[agreed], b[agreed])
    pair = (calibrations[i], calibrations[j])
    starts = (
        candidates.on_plane(a[agreed], b[agreed], pair)
        if planar
        else candidates.in_space(a[agreed], b[agreed], pair)
    )
    if not starts:
        raise DegenerateError(
            "no arrangement of two stations explains the angles",
            hint="check that the channels of the stations are those of the recording",
        )
    inside = joint[agreed]
    best = _choose(angles[inside][:, [i, j]], starts, planar, sigma, misfit, (i, j), facts)
    return StationPair((i, j), best, inside, planar, facts)


def looks_flat(a: Array, b: Array, median: float) -> bool:
    """Whether rays (n, 3) of two stations look like those of a floor, of which a homography
    misses the ``median`` by so much (as a tangent)."""
    spread = min(float(np.std(view[:, 1:], axis=0).max()) for view in (a, b))
    return median < min(FLAT, FLAT_SHARE * spread)


def _off_plane(a: Array, b: Array, share: float, seed: int) -> bool:
    """Whether many of the places that contradict a plane agree in space: four stops and the way
    between them are most of a short recording, and always on some plane."""
    if share > CERTAIN_SHARE or len(a) < 8:
        return False
    _, agreed = twoview.agree_in_space(a, b, seed)
    return share < PLANE_SHARE * float(np.mean(agreed))


def _require_baseline(a: Array, b: Array) -> None:
    """Refuse two stations at one place: their views then differ by a turn alone."""
    h = twoview.fit_homography(a, b)
    if np.median(twoview.homography_residuals(h, a, b)) > FLAT:
        return
    stretch = np.linalg.svd(h, compute_uv=False)
    if stretch[0] - stretch[2] < LEAST_BASELINE * stretch[1]:
        raise DegenerateError(
            "two stations stand at one place, which does not determine a scene",
            hint="move them apart, best by as much as they are away from the robots",
        )


def _decide(
    a: Array,
    b: Array,
    flat: Array,
    on_plane: NDArray[np.bool_],
    planar: bool | None,
    seed: int,
    facts: dict[str, object],
) -> tuple[bool, NDArray[np.bool_]]:
    """Whether the places lie on a plane, and which correspondences agree with that."""
    share = float(np.mean(on_plane))
    median = float(np.median(twoview.homography_residuals(flat, a, b)))
    facts["plane_share"] = share
    facts["plane_median_rad"] = median
    if planar is None:
        planar = looks_flat(a, b, median) and not _off_plane(a, b, share, seed)
        facts["planar_decided_by"] = "data"
    else:
        facts["planar_decided_by"] = "option"
    if planar:
        return True, on_plane
    if len(a) < 8:
        raise DegenerateError(
            f"{len(a)} places off one plane do not determine a scene in space",
            hint="record at least 8 places, better 20",
        )
    _, agreed = twoview.agree_in_space(a, b, seed)
    return False, agreed


def _choose(
    angles: Array,
    starts: list[BundleState],
    planar: bool,
    sigma: float,
    misfit: Misfit | None,
    columns: tuple[int, int],
    facts: dict[str, object],
) -> BundleAdjustment:
    """The start that explains the angles best; of two that do, the one that fits the markers,
    else the upright one.

    A homography has two valid readings. Noise-free they predict the same angles, so that
    only the world decides: what is known of it, or that stations stand or hang upright, with
    little roll (the paper's conditions on the signs of n and t say as much).
    """
    some = np.unique(np.linspace(0, len(angles) - 1, START_POINTS).astype(int))
    tried = []
    for rig in starts:
        small = BundleState(rig.positions, rig.rotations, rig.calibrations, rig.points[some])
        # All residuals count in full: a soft loss would let a bad start stay bad.
        done = adjust_bundle(
            angles[some], small, sigma=sigma, planar=planar, soft=1.0, iterations=START_STEPS
        )
        tried.append((done.cost, _roll(done.rig.rotations) if planar else 0.0, done))
        # In space only one arrangement fits; with many places a perfect fit is no accident.
        perfect = np.sqrt(np.nanmean(done.residuals**2)) < CERTAIN
        perfect &= done.iterations < START_STEPS
        if not planar and len(some) >= MANY and perfect:
            break
    cheapest = min(cost for cost, _, _ in tried)
    fitting = [t for t in tried if t[0] <= 2.0 * cheapest + 1e-9]
    _, _, done = min(fitting, key=lambda t: (t[1], t[0]))
    if planar and misfit is not None and len(fitting) > 1:
        missed = [misfit(t[2].rig, columns) for t in fitting]
        order = np.argsort(missed)
        if missed[order[0]] < 0.5 * missed[order[1]]:
            done = fitting[int(order[0])][2]
            facts["reading_decided_by"] = "markers"
    if planar:
        facts["candidates"] = [
            {
                "cost": float(c),
                "roll_deg": float(np.degrees(r)),
                "fits": bool(c <= 2.0 * cheapest + 1e-9),
                "chosen": candidate is done,
            }
            for c, r, candidate in tried
        ]
    return done


def _roll(rotations: Array) -> float:
    """How far stations lean sideways, in radians: root of the sum of squares."""
    return float(np.sqrt(np.sum(np.arcsin(np.clip(rotations[:, 2, 1], -1, 1)) ** 2)))
