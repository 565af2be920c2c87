"""Stations and points from nothing but angles: up to scale, in a frame of its own.

Two stations with the most common sight start; planar and spatial explanations compete;
the others are resected one by one; a bundle adjustment ends it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError
from locatk.core.lighthouse import candidates, twoview
from locatk.core.lighthouse.angles import rays as rays_of
from locatk.core.lighthouse.bundle import Adjustment, Rig, adjust
from locatk.core.lighthouse.calibration import Calibration, ideal_angles
from locatk.core.lighthouse.locate import Fixes, locate
from locatk.core.lighthouse.places import SAME_PLACE, require_places
from locatk.core.lighthouse.resection import resect_in_space, resect_on_plane

Array = NDArray[np.float64]

BUNDLE_POINTS = 1500
"""Moments in the bundle adjustment, at most: more do not sharpen a scene whose error is
its calibration, and cost time."""

START_POINTS = 300
"""Moments with which candidate rigs are compared."""

MANY = 60
CERTAIN = 1.5e-4
"""With so many places, and a residual (rms, in radians) at the noise of a standing
receiver, a start is taken without trying the others."""

LEAST_BASELINE = 0.02
"""Distance of two stations, as a share of their distance from the plane of the robots."""

FLAT = 3e-3
"""Median miss of a homography, as a tangent, up to which a scene counts as planar."""


Misfit = Callable[[Rig, tuple[int, int]], float]


@dataclass(frozen=True)
class Assembly:
    """Stations up to scale.

    Attributes
    ----------
    adjustment : Adjustment
        The bundle adjustment over ``chosen``; in a planar scene z = 0 is the plane of the
        photodiodes and z is up.
    stations : tuple of int
        Columns of the stations that were solved, ascending; a station that shares too few
        places with the others is left out.
    chosen : (k,) int ndarray
        Indices of the moments that took part.
    planar : bool
    facts : dict
        What was decided, with the figures it was decided on.
    """

    adjustment: Adjustment
    stations: tuple[int, ...]
    chosen: NDArray[np.int64]
    planar: bool
    facts: dict[str, object]


def assemble(
    angles: Array,
    calibrations: tuple[Calibration, ...],
    *,
    sigma: float,
    planar: bool | None = None,
    misfit: Misfit | None = None,
    seed: int = 0,
) -> Assembly:
    """Solve for two or more stations.

    Parameters
    ----------
    angles : (m, s, 2) ndarray
        Observed rotor angles in radians, ``nan`` where not seen; s >= 2.
    calibrations : tuple of Calibration
        One a station; generic ones are refined.
    sigma : float
        Standard deviation of an angle with what calibration leaves unmodelled, in radians.
    planar : bool, optional
        Whether all photodiodes lie on one plane; decided from the data when None.
    misfit : callable, optional
        How badly a rig of two stations, given with their columns, fits what else is known
        of the place (markers): decides between the two readings of a plane.
    seed : int
        For the random samples: same input and seed, same answer.

    Raises
    ------
    DegenerateError
        The moments do not determine the stations: too few places, all on a line, all on a
        plane (for ``planar=False``), or stations without common sight.
    """
    rays = np.stack(
        [rays_of(ideal_angles(angles[:, i], c), c.tilts) for i, c in enumerate(calibrations)],
        axis=1,
    )
    seen = np.isfinite(rays[..., 0])
    i, j = _best_pair(seen)
    joint = np.flatnonzero(seen[:, i] & seen[:, j])
    a, b = rays[joint, i], rays[joint, j]
    require_places(a, b, 5 if planar is None else 4 if planar else 8)

    facts: dict[str, object] = {}
    flat, on_plane = twoview.agree_on_plane(a, b, seed)
    planar, agreed = _decide(a, b, flat, on_plane, planar, seed, facts)
    require_places(a[agreed], b[agreed], 4 if planar else 8)
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
    return _extend(angles, rays, calibrations, best, (i, j), inside, planar, sigma, facts)


def _best_pair(seen: NDArray[np.bool_]) -> tuple[int, int]:
    joint = {
        p: np.count_nonzero(seen[:, p[0]] & seen[:, p[1]])
        for p in combinations(range(seen.shape[1]), 2)
    }
    pair = max(joint, key=lambda p: joint[p])
    if joint[pair] == 0:
        raise DegenerateError(
            "no moment was seen by two stations at once",
            hint="put the stations so that their views overlap",
        )
    return pair


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
        planar = median < FLAT
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
    starts: list[Rig],
    planar: bool,
    sigma: float,
    misfit: Misfit | None,
    columns: tuple[int, int],
    facts: dict[str, object],
) -> Rig:
    """The start that explains the angles best; of two that do, the one that fits the markers,
    else the upright one.

    A homography has two valid readings. Noise-free they predict the same angles, so that
    only the world decides: what is known of it, or that stations stand or hang upright, with
    little roll (the paper's conditions on the signs of n and t say as much).
    """
    some = np.unique(np.linspace(0, len(angles) - 1, START_POINTS).astype(int))
    tried = []
    for rig in starts:
        small = Rig(rig.positions, rig.rotations, rig.calibrations, rig.points[some])
        # All residuals count in full: a soft loss would let a bad start stay bad.
        done = adjust(angles[some], small, sigma=sigma, planar=planar, soft=1.0, iterations=60)
        tried.append((done.cost, _roll(done.rig.rotations) if planar else 0.0, done))
        # In space only one arrangement fits; with many places a perfect fit is no accident.
        perfect = np.sqrt(np.nanmean(done.residuals**2)) < CERTAIN
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
    return done.rig


def _roll(rotations: Array) -> float:
    """How far stations lean sideways, in radians: root of the sum of squares."""
    return float(np.sqrt(np.sum(np.arcsin(np.clip(rotations[:, 2, 1], -1, 1)) ** 2)))


def _extend(
    angles: Array,
    rays: Array,
    calibrations: tuple[Calibration, ...],
    rig: Rig,
    pair: tuple[int, int],
    inside: NDArray[np.int64],
    planar: bool,
    sigma: float,
    facts: dict[str, object],
) -> Assembly:
    """Resect the other stations on located points, then adjust all together."""
    count = len(calibrations)
    positions = np.full((count, 3), np.nan)
    rotations = np.tile(np.eye(3), (count, 1, 1))
    refined = list(calibrations)
    for k, index in enumerate(pair):
        positions[index], rotations[index] = rig.positions[k], rig.rotations[k]
        refined[index] = rig.calibrations[k]
    known = sorted(pair)
    floor = 0.0 if planar else None

    def fixes_of(stations: list[int]) -> Fixes:
        return locate(
            angles[:, stations],
            positions[stations],
            rotations[stations],
            tuple(refined[k] for k in stations),
            floor_z=floor,
        )

    apart: set[int] = set()
    while len(known) + len(apart) < count:
        fixes = fixes_of(known)
        good = np.isfinite(fixes.position[:, 0]) & (fixes.worst < twoview.GATE)
        shared = {
            k: np.flatnonzero(good & np.isfinite(rays[:, k, 0]))
            for k in range(count)
            if k not in known and k not in apart
        }
        index = max(shared, key=lambda k: len(shared[k]))
        rows = shared[index]
        points = fixes.position[rows]
        try:
            poses = (
                [resect_on_plane(points[:, :2], rays[rows, index])]
                if planar
                else resect_in_space(points, rays[rows, index])
            )
        except DegenerateError:
            apart.add(index)
            continue
        tries = [
            adjust(
                angles[rows][:, [index]],
                Rig(position[None], rotation[None], (refined[index],), points),
                sigma=sigma,
                fixed_points=True,
            )
            for position, rotation in poses
        ]
        best = min(tries, key=lambda t: t.cost)
        positions[index], rotations[index] = best.rig.positions[0], best.rig.rotations[0]
        refined[index] = best.rig.calibrations[0]
        known = sorted([*known, index])

    fixes = fixes_of(known)
    good = np.isfinite(fixes.position[:, 0]) & (fixes.freedom > 0) & (fixes.worst < twoview.GATE)
    if len(known) == 2:
        # What the two-view consensus refused stays out: two planes can meet by chance.
        member = np.zeros(len(angles), bool)
        member[inside] = True
        good &= member
    usable = np.flatnonzero(good)
    if len(usable) < (4 if planar else 8):
        raise DegenerateError(
            f"{len(usable)} places agree with one arrangement of the stations",
            hint="the recording holds little but wrong sweeps; `locatk info` shows its channels",
        )
    chosen = usable[np.unique(np.linspace(0, len(usable) - 1, BUNDLE_POINTS).astype(int))]
    # From the calibrations that came in: the prior holds whatever an adjustment starts from.
    final = adjust(
        angles[chosen][:, known],
        Rig(
            positions[known],
            rotations[known],
            tuple(calibrations[k] for k in known),
            fixes.position[chosen],
        ),
        sigma=sigma,
        planar=planar,
    )
    facts["bundle_points"] = len(chosen)
    facts["bundle_iterations"] = final.iterations
    return Assembly(final, tuple(known), chosen, planar, facts)
