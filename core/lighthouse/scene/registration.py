"""Further stations, one by one: on places that are located, or by way of a neighbour.

A station that saw places which the known ones locate is resected on them. One that shares
places with single known stations only is put where the arrangements of these pairs agree:
the turn and the direction come from a pair; the distance from places that a third station
locates, or from a second neighbour, where the two directions cross.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError
from locatk.core.lighthouse.calibration import Calibration
from locatk.core.lighthouse.localization.positions import PositionEstimates, estimate_positions
from locatk.core.lighthouse.scene import two_view as twoview
from locatk.core.lighthouse.scene.bundle_adjustment import BundleState, adjust_bundle
from locatk.core.lighthouse.scene.pairs import START_POINTS, StationPair
from locatk.core.lighthouse.scene.resection import Pose, resect_in_space, resect_on_plane
from locatk.core.lighthouse.scene.selection import spread_evenly

Array = NDArray[np.float64]
Neighbours = Callable[[int, int], StationPair | None]
"""The arrangement of two stations, by their columns, or None where they have none."""

LEAST_COMMON = 3
"""Places that tell how far a neighbour is, at least, so that one wrong sweep does not."""

SAME_RATIO = 0.1
"""Those places agree on a distance to this share, or they tell none."""

LOOSE = 0.1
"""Standard deviation of a station's place, as a share of its distance, from which on a few
places in a corner of its view do not fix it."""

LEAST_CROSSING = np.deg2rad(5.0)
"""Angle at which the directions from two neighbours cross, at least."""

SAME_TURN = np.deg2rad(5.0)
"""Two neighbours agree on how a station is turned to within this."""

REFINE_STEPS = 10


class StationRegistration:
    """Stations of known place, to which others are added.

    Parameters
    ----------
    angles : (m, s, 2) ndarray
        Observed rotor angles in radians, ``nan`` where not seen.
    rays : (m, s, 3) ndarray
        The directions (1, y, z) that they mean.
    calibrations : tuple of Calibration
        One a station.
    start : StationPair
        The two stations to begin with.
    sigma : float
        Standard deviation of an angle, in radians.
    """

    def __init__(
        self,
        angles: Array,
        rays: Array,
        calibrations: tuple[Calibration, ...],
        start: StationPair,
        sigma: float,
    ) -> None:
        self.angles, self.rays, self.sigma = angles, rays, sigma
        self.planar = start.planar
        self.seen = np.isfinite(rays[..., 0])
        count = len(calibrations)
        self.positions = np.full((count, 3), np.nan)
        self.rotations = np.tile(np.eye(3), (count, 1, 1))
        self.calibrations = list(calibrations)
        self.known: list[int] = []
        self._take(sorted(start.columns), _ordered(start))

    def fixes(self, stations: Sequence[int] | None = None) -> PositionEstimates:
        """All places as the known stations (or some of them) locate them."""
        chosen = list(self.known if stations is None else stations)
        return estimate_positions(
            self.angles[:, chosen],
            self.positions[chosen],
            self.rotations[chosen],
            tuple(self.calibrations[k] for k in chosen),
            floor_z=0.0 if self.planar else None,
        )

    def add_all(self, neighbours: Neighbours) -> dict[int, str]:
        """Add every station that can be; the others' columns, with the reason.

        The station that shares the most located places comes first: the more there are
        known, the firmer the next one stands.
        """
        apart: dict[int, str] = {}
        while len(self.known) + len(apart) < len(self.positions):
            fixes = self.fixes()
            good = np.isfinite(fixes.position[:, 0]) & (fixes.worst < twoview.GATE)
            shared = {
                k: np.flatnonzero(good & self.seen[:, k])
                for k in range(len(self.positions))
                if k not in self.known and k not in apart
            }
            index = max(shared, key=lambda k: len(shared[k]))
            pose = self._resected(index, shared[index], fixes)
            if pose is None:
                # The most places were not enough: any that a neighbour can place is next.
                ways = ((k, self._by_neighbours(k, shared[k], fixes, neighbours)) for k in shared)
                index, pose = next(((k, p) for k, p in ways if p is not None), (index, None))
            if pose is None:
                apart[index] = self._why_not(index, neighbours)
                continue
            self._take([index], pose)
            # What stood too loose for it may be placed on the one that was added.
            apart.clear()
            self._refine()
        return apart

    def _take(self, columns: Sequence[int], rig: BundleState) -> None:
        for k, index in enumerate(columns):
            self.positions[index], self.rotations[index] = rig.positions[k], rig.rotations[k]
            self.calibrations[index] = rig.calibrations[k]
        self.known = sorted({*self.known, *columns})

    def _resected(
        self, index: int, rows: NDArray[np.int64], fixes: PositionEstimates
    ) -> BundleState | None:
        """The station (alone in a rig) on the places that the known ones locate."""
        points, rays = fixes.position[rows], self.rays[rows, index]
        try:
            poses: list[Pose] = (
                [resect_on_plane(points[:, :2], rays)]
                if self.planar
                else resect_in_space(points, rays)
            )
        except DegenerateError:
            return None
        tries = [
            adjust_bundle(
                self.angles[rows][:, [index]],
                BundleState(position[None], rotation[None], (self.calibrations[index],), points),
                sigma=self.sigma,
                fixed_points=True,
            )
            for position, rotation in poses
        ]
        best = min(tries, key=lambda t: t.cost)
        away = np.median(np.linalg.norm(points - best.rig.positions[0], axis=1))
        spread = np.sqrt(max(float(np.trace(best.station_covariance[0, :3, :3])), 0.0))
        agrees = np.nanmedian(np.abs(best.residuals)) < twoview.GATE
        return best.rig if agrees and spread < LOOSE * away else None

    def _by_neighbours(
        self, index: int, rows: NDArray[np.int64], fixes: PositionEstimates, neighbours: Neighbours
    ) -> BundleState | None:
        """The station (alone in a rig) by the pairs that it makes with known ones.

        On a floor nothing is gained: there one station locates places alone.
        """
        if self.planar:
            return None
        pairs = [p for k in self.known if (p := neighbours(k, index)) is not None]
        pairs = [p for p in pairs if p.looseness < LOOSE]
        pairs.sort(key=lambda p: p.looseness)
        ways = [(p, *self._direction(p, index)) for p in pairs]
        for pair, here, rotation, direction in ways:
            reach = self._distance(pair, here, rows, fixes)
            if reach is not None:
                return self._alone(index, self.positions[here] + reach * direction, rotation, pair)
        for n, (pair, here, rotation, direction) in enumerate(ways):
            for _, there, other_rotation, other in ways[n + 1 :]:
                if _turn(rotation, other_rotation) > SAME_TURN:
                    continue
                where = _crossing(self.positions[[here, there]], np.stack([direction, other]))
                if where is not None:
                    return self._alone(index, where, rotation, pair)
        return None

    def _direction(self, pair: StationPair, index: int) -> tuple[int, Array, Array]:
        """The known station of a pair, and from there the new one's rotation and direction."""
        new = pair.columns.index(index)
        here = pair.columns[1 - new]
        rig = pair.rig
        to = self.rotations[here] @ rig.rotations[1 - new].T
        step = to @ (rig.positions[new] - rig.positions[1 - new])
        return here, to @ rig.rotations[new], step / np.linalg.norm(step)

    def _distance(
        self, pair: StationPair, here: int, rows: NDArray[np.int64], fixes: PositionEstimates
    ) -> float | None:
        """Distance of the stations of a pair, from common places that others locate."""
        rows = rows[self.seen[rows, here] & (fixes.freedom[rows] > 0)]
        if len(rows) < LEAST_COMMON:
            return None
        rig = pair.rig
        local = estimate_positions(
            self.angles[rows][:, list(pair.columns)],
            rig.positions,
            rig.rotations,
            rig.calibrations,
        ).position
        from_here = local - rig.positions[pair.columns.index(here)]
        away = np.linalg.norm(fixes.position[rows] - self.positions[here], axis=1)
        ratio = away / np.linalg.norm(from_here, axis=1)
        ratio = ratio[np.isfinite(ratio)]
        if len(ratio) < LEAST_COMMON:
            return None
        middle = float(np.median(ratio))
        if np.median(np.abs(ratio - middle)) > SAME_RATIO * middle:
            return None
        return middle * float(np.linalg.norm(rig.positions[1] - rig.positions[0]))

    def _alone(
        self, index: int, position: Array, rotation: Array, pair: StationPair
    ) -> BundleState:
        calibration = pair.rig.calibrations[pair.columns.index(index)]
        return BundleState(position[None], rotation[None], (calibration,), np.zeros((0, 3)))

    def _refine(self) -> None:
        """Adjust the known stations together, so that errors do not add up along a chain."""
        fixes = self.fixes()
        good = np.isfinite(fixes.position[:, 0]) & (fixes.freedom > 0)
        good &= fixes.worst < 3 * twoview.GATE
        rows = spread_evenly(self.seen[:, self.known], np.flatnonzero(good), START_POINTS)
        if len(rows) < 4:
            return
        done = adjust_bundle(
            self.angles[rows][:, self.known],
            BundleState(
                self.positions[self.known],
                self.rotations[self.known],
                tuple(self.calibrations[k] for k in self.known),
                fixes.position[rows],
            ),
            sigma=self.sigma,
            planar=self.planar,
            iterations=REFINE_STEPS,
        )
        self._take(self.known, done.rig)

    def _why_not(self, index: int, neighbours: Neighbours) -> str:
        """Why a station cannot be placed, for a note."""
        if not self.planar and any(neighbours(k, index) for k in self.known):
            return (
                "shares places with one other only, and none that two others locate, so that "
                "its distance is unknown"
            )
        if not np.any(self.seen[:, self.known].any(axis=1) & self.seen[:, index]):
            return "shares no place with the others"
        return "shares too few places with the others"


def _ordered(pair: StationPair) -> BundleState:
    """The rig of a pair, its stations in ascending order of their columns."""
    rig, order = pair.rig, np.argsort(pair.columns)
    return BundleState(
        rig.positions[order],
        rig.rotations[order],
        tuple(rig.calibrations[k] for k in order),
        rig.points,
    )


def _turn(first: Array, second: Array) -> float:
    """Angle in radians between two rotations."""
    cosine = (np.trace(first.T @ second) - 1.0) / 2.0
    return float(np.arccos(np.clip(cosine, -1.0, 1.0)))


def _crossing(places: Array, directions: Array) -> Array | None:
    """Where two lines (2, 3) come closest, or None behind either start or at a flat angle."""
    angle = np.arccos(np.clip(abs(directions[0] @ directions[1]), 0.0, 1.0))
    if angle < LEAST_CROSSING:
        return None
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    where = np.linalg.solve(across.sum(axis=0), np.einsum("nij,nj->i", across, places))
    if np.any(np.sum((where - places) * directions, axis=1) <= 0):
        return None
    return np.asarray(where, float)
