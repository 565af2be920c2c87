"""Stations and points from nothing but angles: up to scale, in a frame of its own.

The pair of stations that stands firmest starts; the others are added one by one; a bundle
adjustment over all ends it. Every fifth place takes no part, so that the scene can be
verified on it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError
from locatk.core.lighthouse.calibration import Calibration, ideal_angles
from locatk.core.lighthouse.light_planes import rays as rays_of
from locatk.core.lighthouse.scene import two_view as twoview
from locatk.core.lighthouse.scene.bundle_adjustment import (
    BundleAdjustment,
    BundleState,
    adjust_bundle,
)
from locatk.core.lighthouse.scene.pairs import Misfit, StationPair, looks_flat, solve_pair
from locatk.core.lighthouse.scene.registration import StationRegistration
from locatk.core.lighthouse.scene.selection import split_held_out, spread_evenly

Array = NDArray[np.float64]

BUNDLE_POINTS = 1500
"""Moments in the bundle adjustment, at most: more do not sharpen a scene whose error is
its calibration, and cost time."""

STARTS = 3
"""Pairs with which to start, at most: the firmest, and the others where that leads to less
than half of the stations."""

LOOKS, LEAST_LOOK = 12, 20
"""Pairs whose places are looked at to tell a floor from space, at most, and how many places
a pair must share to have a say."""

LEAST_JOINT = 4
"""Places that two stations share, at least, to be of one group."""


@dataclass(frozen=True)
class Assembly:
    """Stations up to scale.

    Attributes
    ----------
    adjustment : BundleAdjustment
        The bundle adjustment over ``chosen``; in a planar scene z = 0 is the plane of the
        photodiodes and z is up.
    stations : tuple of int
        Columns of the stations that were solved, ascending.
    chosen : (k,) int ndarray
        Indices of the places that took part.
    planar : bool
    facts : dict
        What was decided, with the figures it was decided on.
    held_out : (n,) int ndarray
        Indices of places that agree as well and took no part; empty where all were needed.
    left_out : dict of int to str
        Columns of the other stations, with the reason.
    """

    adjustment: BundleAdjustment
    stations: tuple[int, ...]
    chosen: NDArray[np.int64]
    planar: bool
    facts: dict[str, object]
    held_out: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    left_out: dict[int, str] = field(default_factory=dict)


def estimate_stations(
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
    joint = _joint(seen)
    found: dict[tuple[int, int, bool | None], StationPair | DegenerateError] = {}

    def pair_of(i: int, j: int, planar: bool | None) -> StationPair | DegenerateError:
        columns = (min(i, j), max(i, j))
        key = (*columns, planar)
        if key not in found:
            try:
                found[key] = solve_pair(
                    angles,
                    rays,
                    calibrations,
                    columns,
                    sigma=sigma,
                    planar=planar,
                    misfit=misfit,
                    seed=seed,
                )
            except DegenerateError as error:
                found[key] = error
        return found[key]

    group = _largest_group(joint)
    told = planar is not None
    if not told and len(group) > 2 and _fills_space(rays, joint, group, seed):
        planar = False
    starts = _starts(joint, group, lambda i, j: pair_of(i, j, planar))

    def neighbours(i: int, j: int) -> StationPair | None:
        pair = pair_of(i, j, starts[0].planar)
        return pair if isinstance(pair, StationPair) else None

    grown: list[tuple[StationRegistration, StationPair, dict[int, str]]] = []
    for start in starts:
        if any({*start.columns} <= {*growth.known} for growth, _, _ in grown):
            continue
        growth = StationRegistration(angles, rays, calibrations, start, sigma)
        grown.append((growth, start, growth.add_all(neighbours)))
        if 2 * len(growth.known) > len(group):
            break
    growth, start, left_out = max(grown, key=lambda g: len(g[0].known))
    facts = {**start.facts, "planar_decided_by": "option" if told else "data"}
    for k in left_out:
        if k not in group and np.any(joint[k] >= LEAST_JOINT):
            left_out[k] = "is of a group that shares no place with the larger one"
    return _adjusted(growth, calibrations, start, left_out, facts)


def _adjusted(
    growth: StationRegistration,
    calibrations: tuple[Calibration, ...],
    start: StationPair,
    left_out: dict[int, str],
    facts: dict[str, object],
) -> Assembly:
    """All known stations adjusted together, on all places that agree with them."""
    planar, known = growth.planar, growth.known
    fixes = growth.fixes()
    good = np.isfinite(fixes.position[:, 0]) & (fixes.freedom > 0) & (fixes.worst < twoview.GATE)
    if len(known) == 2:
        # What the two-view consensus refused stays out: two planes can meet by chance.
        member = np.zeros(len(good), bool)
        member[start.inside] = True
        good &= member
    usable = np.flatnonzero(good)
    if len(usable) < (4 if planar else 8):
        raise DegenerateError(
            f"{len(usable)} places agree with one arrangement of the stations",
            hint="the recording holds little but wrong sweeps; `locatk info` shows its channels",
        )
    seen = growth.seen[:, known]
    taken, held_out = split_held_out(seen, usable)
    chosen = spread_evenly(seen, taken, BUNDLE_POINTS)
    # From the calibrations that came in: the prior holds whatever an adjustment starts from.
    final = adjust_bundle(
        growth.angles[chosen][:, known],
        BundleState(
            growth.positions[known],
            growth.rotations[known],
            tuple(calibrations[k] for k in known),
            fixes.position[chosen],
        ),
        sigma=growth.sigma,
        planar=planar,
    )
    facts["bundle_points"] = len(chosen)
    facts["bundle_iterations"] = final.iterations
    return Assembly(final, tuple(known), chosen, planar, facts, held_out, left_out)


def _joint(seen: NDArray[np.bool_]) -> NDArray[np.int64]:
    """(s, s) number of places that two stations share; 0 on the diagonal."""
    as_number = seen.astype(np.int64)
    joint = as_number.T @ as_number
    np.fill_diagonal(joint, 0)
    return joint


def _largest_group(joint: NDArray[np.int64]) -> tuple[int, ...]:
    """Columns of the stations that common sight links: of several such groups the one with
    the most stations, then with the most common places."""
    if not np.any(joint):
        raise DegenerateError(
            "no moment was seen by two stations at once",
            hint="put the stations so that their views overlap",
        )
    linked = joint >= min(LEAST_JOINT, int(joint.max()))
    groups: list[tuple[int, ...]] = []
    left = set(range(len(joint)))
    while left:
        group, frontier = set[int](), {min(left)}
        while frontier:
            group |= frontier
            frontier = {int(k) for i in frontier for k in np.flatnonzero(linked[i])} - group
        left -= group
        groups.append(tuple(sorted(group)))
    return max(groups, key=lambda g: (len(g), int(joint[np.ix_(g, g)].sum())))


def _fills_space(rays: Array, joint: NDArray[np.int64], group: tuple[int, ...], seed: int) -> bool:
    """Whether a quarter of the pairs of a group saw places that are on no plane.

    One pair alone may see a stretch of the drive that happens to be flat.
    """
    ranked = sorted(combinations(group, 2), key=lambda p: -int(joint[p]))
    views = []
    for i, j in ranked[:LOOKS]:
        if joint[i, j] < LEAST_LOOK:
            break
        both = np.isfinite(rays[:, [i, j], 0]).all(axis=1)
        a, b = rays[both, i], rays[both, j]
        flat, _ = twoview.agree_on_plane(a, b, seed)
        median = float(np.median(twoview.homography_residuals(flat, a, b)))
        views.append(looks_flat(a, b, median))
    return bool(views) and 4 * views.count(False) >= len(views)


def _starts(
    joint: NDArray[np.int64],
    group: tuple[int, ...],
    pair_of: Callable[[int, int], StationPair | DegenerateError],
) -> list[StationPair]:
    """The pairs of a group with the most common places, the one that stands firmest first."""
    ranked = sorted(combinations(group, 2), key=lambda p: -int(joint[p]))
    pairs: list[StationPair] = []
    refused: DegenerateError | None = None
    for i, j in ranked:
        weak = joint[i, j] < LEAST_JOINT or 4 * joint[i, j] < joint[ranked[0]]
        if pairs and (weak or len(pairs) == STARTS):
            break
        pair = pair_of(i, j)
        if isinstance(pair, StationPair):
            pairs.append(pair)
        else:
            refused = refused or pair
    if not pairs:
        assert refused is not None  # every pair was either solved or refused
        raise refused
    # A floor is a floor for all: of pairs that differ the kind of the first is right.
    alike = [p for p in pairs if p.planar == pairs[0].planar]
    return sorted(alike, key=lambda p: p.looseness)
