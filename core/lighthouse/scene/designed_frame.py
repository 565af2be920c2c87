"""Frame of a designed room: placement of an estimated scene near the designed stations.

A design states where stations shall be mounted. By hand, they are mounted near to these poses,
within a tolerance that each station's covariance states. The designed poses are therefore no poses
to locate devices with. The stations are estimated from the recording as without a design, and the
result is moved to where the stations are nearest to their designed poses. The frame is then that of
the room up to the mounting tolerance, divided over the stations; distances within it are as
accurate as in any other estimated scene.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from locatk.core.errors import DegenerateError
from locatk.core.geometry import (
    Similarity,
    quaternion_from_matrix,
    rotation_exp,
    rotation_vector_from_quaternion,
    transform_covariance,
)
from locatk.core.least_squares import DenseEquations, minimize
from locatk.core.lighthouse.calibration import Calibration
from locatk.core.lighthouse.devices.alignment import MARKER_SIGMA_M
from locatk.core.lighthouse.motion.frames import common_motions
from locatk.core.lighthouse.results import FrameFacts, LighthouseFacts
from locatk.core.lighthouse.room import hand_mounting_covariance
from locatk.core.lighthouse.scene.model import Scene, Station
from locatk.core.lighthouse.scene.reframing import transform_solution
from locatk.core.solution import Solution, SolverWarning
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]

DEVICE_SCALE_SIGMA = 0.015
"""Relative standard deviation of a scale from the size of devices: 1 to 2 % for a Lighthouse deck
(:data:`~locatk.core.lighthouse.motion.parameters.PHOTODIODE_SIGMA_M`)."""

ODOMETRY_SCALE_SIGMA = 0.01
"""Relative standard deviation of a scale from odometry, that of the diameter of wheels. An
assumption: half a millimetre in a wheel of 50 mm."""

MAX_STATION_SIGMAS = 5.0
"""Distance of a station from its designed pose, in standard deviations of its position or of its
rotation, from which it was not mounted as designed."""

IMPLAUSIBLE_PROBABILITY = 1e-4
"""Probability of a larger sum of weighted squares, below which the stations do not fit the
design."""

NO_PRIOR = np.inf


@dataclass(frozen=True)
class StationDeviation:
    """Distance of a station from its designed pose.

    Attributes
    ----------
    channel : int
    offset_m, rotation_rad : float
    sigmas : float
        The larger one of both in standard deviations of tolerance and frame.
    """

    channel: int
    offset_m: float
    rotation_rad: float
    sigmas: float


@dataclass(frozen=True)
class DesignedFrame:
    """Transform of an estimated scene to the frame of a design.

    Attributes
    ----------
    to_design : Similarity
    centre : (3,) ndarray
        Mean of the stations in the frame of the design.
    covariance : (7, 7) ndarray
        Of translation (m), rotation (rad) about the centre and relative scale. It is zero for
        directions that the floor of a planar scene determines.
    deviations : tuple of StationDeviation
        Of all stations of both scenes.
    used : tuple of int
        Channels of the stations that determined the frame.
    swaps : tuple of (int, int)
        Pairs of channels, if the stations fit the design only after the exchange of one of these.
        The frame is that of the first. There are several in symmetric rooms.
    misfit_ratio : float
        Distance of the stations used from their designed poses, relative to the mounting tolerance;
        1 if it is plausible.
    scale_sigma_of_design : float
        Relative standard deviation of the scale by the designed poses alone; infinite if these do
        not determine it.
    """

    to_design: Similarity
    centre: Array
    covariance: Array
    deviations: tuple[StationDeviation, ...]
    used: tuple[int, ...]
    swaps: tuple[tuple[int, int], ...]
    misfit_ratio: float
    scale_sigma_of_design: float

    def pose_covariance(self, position: Array) -> Array:
        """Return the covariances (n, 6, 6) of poses at positions (n, 3) by the frame."""
        motions = np.zeros((len(position), 6, 7))
        motions[:, :3] = common_motions(position - self.centre)
        motions[:, range(3, 6), range(3, 6)] = 1.0
        return np.asarray(motions @ self.covariance @ motions.mT)

    def add_uncertainty(self, trajectory: Trajectory) -> Trajectory:
        """Add the uncertainty of the frame to the covariance of poses in it."""
        added = self.pose_covariance(trajectory.position)
        return replace(trajectory, covariance=trajectory.covariance + added)

    @property
    def origin_sigma_m(self) -> float:
        """Largest standard deviation of the origin along an axis [m]."""
        motion = common_motions(-self.centre[None])[0]
        covariance = motion @ self.covariance @ motion.T
        return float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))

    @property
    def level_sigma_rad(self) -> float:
        """Standard deviation of the inclination, about the least certain horizontal axis [rad]."""
        return float(np.sqrt(max(np.linalg.eigvalsh(self.covariance[3:5, 3:5])[-1], 0.0)))

    @property
    def heading_sigma_rad(self) -> float:
        """Standard deviation of the rotation about the vertical [rad]."""
        return float(np.sqrt(self.covariance[5, 5]))

    @property
    def scale_sigma(self) -> float:
        """Relative standard deviation of the scale."""
        return float(np.sqrt(self.covariance[6, 6]))


def is_design(scene: Scene) -> bool:
    """Return True if the stations of a scene are designed poses."""
    return scene.frame_source == "design" and bool(scene.stations)


def design_prior(design: Scene) -> Scene:
    """Return what a design tells of a scene that has yet to be estimated.

    These are points, factory calibrations, serial numbers, and the direction of gravity in each
    station: that of its accelerometer, or else the designed one, which decides between mirrored
    arrangements.
    """
    factory: dict[int, Calibration] = {
        s.channel: s.calibration for s in design.stations if s.calibration.source == "factory"
    }
    designed_ups = {s.channel: s.rotation[2] for s in design.stations}
    measured_ups = {s.channel: s.up for s in design.stations if s.up is not None}
    return replace(
        design,
        stations=(),
        scale="unit",
        notes=(),
        calibrations={**factory, **design.calibrations},
        ids={**{s.channel: s.id for s in design.stations if s.id is not None}, **design.ids},
        ups={**designed_ups, **measured_ups, **design.ups},
        frame_source=None,
        level_sigma_rad=None,
        covariance=None,
    )


def with_mounting_tolerance(design: Scene) -> Scene:
    """Return a design whose stations all have a covariance, by default that of hand mounting."""
    stations = tuple(replace(s, covariance=_mounting_covariance(s)) for s in design.stations)
    return replace(design, stations=stations)


# ---- solutions


def place_in_design(solution: Solution, design: Scene) -> Solution:
    """Transform a solution with an estimated scene to the frame of a design.

    A scene in the frame of markers is not moved, but its stations are compared with the design.

    Raises
    ------
    DegenerateError
        The stations that both have do not determine the frame.
    """
    scene: Scene = solution.artifact
    if scene.frame_source == "markers":
        frame = compare_with_design(scene, design)
        scene = replace(scene, room=design.room)
        return replace(
            solution,
            artifact=scene,
            warnings=(*solution.warnings, *_deviation_warnings(frame)),
        )
    frame = fit_designed_frame(scene, design)
    scale = scene.scale if scene.scale != "unit" else "design"
    if frame.scale_sigma_of_design < scale_sigma(scene):
        scale = "design"
    added = (_frame_warning(frame, scale), *_deviation_warnings(frame))
    removed = {w.message for w in solution.warnings if w.code in ("unit_scale", "device_scale")}
    warnings = [w for w in solution.warnings if w.message not in removed]
    if scale == "device":
        warnings, removed = list(solution.warnings), set()
    is_planar = bool(scene.planar)
    placed = replace(
        scene.transformed(frame.to_design),
        frame=design.frame,
        frame_source="floor",
        scale=scale,
        level_sigma_rad=None if is_planar else frame.level_sigma_rad,
        room=design.room,
        notes=(
            *(note for note in scene.notes if note not in removed),
            *(warning.message for warning in added),
        ),
    )
    moved = transform_solution(solution, frame.to_design, placed)
    facts = FrameFacts(
        "design",
        placed.level_sigma_rad,
        origin_sigma_m=frame.origin_sigma_m,
        heading_sigma_rad=frame.heading_sigma_rad,
        scale_sigma=frame.scale_sigma,
    )
    return replace(
        moved,
        trajectories=tuple(frame.add_uncertainty(t) for t in moved.trajectories),
        facts=replace(solution.facts or LighthouseFacts(), frame=facts),
        warnings=(*warnings, *added),
    )


def scale_sigma(scene: Scene) -> float:
    """Return the relative standard deviation of the scale of a scene, apart from any design."""
    if scene.scale == "distance":
        squares = sum(distance.distance**2 for distance in scene.distances)
        return float(np.sqrt(2.0 / squares)) * MARKER_SIGMA_M if squares else NO_PRIOR
    return {"device": DEVICE_SCALE_SIGMA, "odometry": ODOMETRY_SCALE_SIGMA}.get(
        scene.scale, NO_PRIOR
    )


# ---- frames


def fit_designed_frame(scene: Scene, design: Scene) -> DesignedFrame:
    """Fit the similarity that moves an estimated scene to the designed stations.

    Stations count by the covariance of their mounting and of their estimate. Stations that
    contradict the others are left out. If the scene is planar, its floor is that of the design:
    only the position on it, the heading and the scale are fitted.

    Parameters
    ----------
    scene : Scene
        Estimated, in any frame; if its scale is known, this counts with its standard deviation.
    design : Scene
        With stations on some of its channels.

    Raises
    ------
    DegenerateError
        No station is in both, or a single one and the scale is unknown.
    """
    channels = [s.channel for s in scene.stations if design.station(s.channel) is not None]
    sigma = scale_sigma(scene)
    if not channels or (len(channels) == 1 and not np.isfinite(sigma)):
        raise DegenerateError(
            "the recording determines too few of the designed stations",
            hint="its channels are "
            + ", ".join(str(s.channel) for s in scene.stations)
            + "; those of the design are "
            + ", ".join(str(s.channel) for s in design.stations),
        )
    to_channel = {c: c for c in channels}
    matching = _Matching.of(scene, design, to_channel, sigma)
    fit, used = matching.fit(channels), list(channels)
    swaps: tuple[tuple[int, int], ...] = ()
    if not fit.is_plausible:
        fits_of_swaps = _plausible_swaps(scene, design, channels, sigma)
        swaps = tuple(sorted(fits_of_swaps, key=lambda pair: fits_of_swaps[pair].cost))
        if swaps:
            fit = fits_of_swaps[swaps[0]]
    while not fit.is_plausible and len(used) > 2:
        # Of the stations, the one without which the others fit best is where it should not be.
        fits = {c: matching.fit([other for other in used if other != c]) for c in used}
        worst = min(fits, key=lambda c: fits[c].cost)
        (deviation,) = (d for d in matching.deviations(fits[worst]) if d.channel == worst)
        if deviation.sigmas <= MAX_STATION_SIGMAS:
            break  # All were mounted less carefully than the tolerance says.
        used.remove(worst)
        fit = fits[worst]
    return DesignedFrame(
        fit.to_design,
        fit.centre,
        fit.covariance,
        matching.deviations(fit),
        tuple(used),
        swaps,
        fit.misfit_ratio,
        fit.scale_sigma_of_design,
    )


def compare_with_design(scene: Scene, design: Scene) -> DesignedFrame:
    """Return the deviations of stations in a frame that is not that of the design but should be."""
    channels = [s.channel for s in scene.stations if design.station(s.channel) is not None]
    identity = _Fit(Similarity.identity(), np.zeros(3), np.zeros((7, 7)), 0.0, 1.0, NO_PRIOR)
    deviations: tuple[StationDeviation, ...] = ()
    if channels:
        matching = _Matching.of(scene, design, {c: c for c in channels}, NO_PRIOR)
        deviations = matching.deviations(identity)
    return DesignedFrame(
        identity.to_design, np.zeros(3), identity.covariance, deviations, (), (), 1.0, NO_PRIOR
    )


@dataclass(frozen=True)
class _Fit:
    to_design: Similarity
    centre: Array
    covariance: Array
    cost: float
    misfit_ratio: float
    scale_sigma_of_design: float

    @property
    def is_plausible(self) -> bool:
        return self.misfit_ratio == 1.0


@dataclass(frozen=True)
class _Matching:
    """Estimated stations and the designed poses that they are matched with, by channel."""

    channels: tuple[int, ...]
    position: Array
    rotation: Array
    covariance: Array
    designed_position: Array
    designed_rotation: Array
    tolerance: Array
    scale_sigma: float
    floor_m: tuple[float, float] | None

    @classmethod
    def of(
        cls, scene: Scene, design: Scene, to_channel: Mapping[int, int], sigma: float
    ) -> _Matching:
        """Match each channel of the scene with a channel of the design."""
        own = [_station(scene, c) for c in to_channel]
        designed = [_station(design, c) for c in to_channel.values()]
        return cls(
            tuple(to_channel),
            np.stack([s.position for s in own]),
            np.stack([s.rotation for s in own]),
            np.stack([np.zeros((6, 6)) if s.covariance is None else s.covariance for s in own]),
            np.stack([s.position for s in designed]),
            np.stack([s.rotation for s in designed]),
            np.stack([_mounting_covariance(s) for s in designed]),
            sigma,
            (scene.floor_z, design.floor_z) if scene.planar else None,
        )

    def fit(self, channels: Sequence[int]) -> _Fit:
        """Fit the similarity by some stations: the best of the fits from the pose of each one."""
        rows = [self.channels.index(c) for c in channels]
        return min((self._refine(rows, k) for k in rows), key=lambda fit: fit.cost)

    def _refine(self, rows: list[int], start: int) -> _Fit:
        """Fit from the rotation that the pose of one station gives."""
        source, target = self.position[rows], self.designed_position[rows]
        rotation = self.designed_rotation[start] @ self.rotation[start].T
        if self.floor_m is not None:
            heading = float(
                np.arctan2(rotation[1, 0] - rotation[0, 1], rotation[0, 0] + rotation[1, 1])
            )
            rotation = rotation_exp([0.0, 0.0, heading])
        scale = 1.0
        if np.isinf(self.scale_sigma):
            extent = np.linalg.norm(source - source.mean(axis=0))
            scale = float(np.linalg.norm(target - target.mean(axis=0)) / extent)
        centre = target.mean(axis=0)
        translation = centre - scale * rotation @ source.mean(axis=0)
        free = np.arange(7)
        if self.floor_m is not None:
            # The floor of a planar scene is known; a change of scale about a point on it keeps it.
            free = np.array([0, 1, 5, 6])
            translation[2] = self.floor_m[1] - scale * self.floor_m[0]
            centre[2] = self.floor_m[1]
        problem = _Placement(self, rows, free, centre)
        minimum = minimize(
            problem, Similarity(scale, rotation, translation), damping=1e-6, min_gain=1e-12
        )
        own = np.asarray(minimum.equations.hessian[0])
        cost = 2.0 * float(minimum.equations.cost[0])
        freedom = 6 * len(rows) - len(free) + bool(np.isfinite(self.scale_sigma))
        # With a misfit beyond the tolerance, the mounting was less careful than it says.
        inflation = max(1.0, cost / freedom)
        covariance = np.zeros((7, 7))
        covariance[np.ix_(free, free)] = inflation * np.linalg.inv(own)
        scale_sigma_of_design = NO_PRIOR
        if len(rows) > 1:
            own[-1, -1] -= self.scale_sigma**-2.0
            scale_sigma_of_design = float(np.sqrt(np.linalg.inv(own)[-1, -1]))
        is_plausible = cost < float(chdtri(freedom, IMPLAUSIBLE_PROBABILITY))
        misfit_ratio = 1.0 if is_plausible else float(np.sqrt(cost / freedom))
        return _Fit(minimum.state, centre, covariance, cost, misfit_ratio, scale_sigma_of_design)

    def residuals(self, to: Similarity, rows: Sequence[int]) -> tuple[Array, Array]:
        """Return position and rotation beside the designed ones (n, 6), and weights (n, 6, 6)."""
        offset = to.apply(self.position[rows]) - self.designed_position[rows]
        turn = to.rotation @ self.rotation[rows] @ self.designed_rotation[rows].mT
        angle = rotation_vector_from_quaternion(quaternion_from_matrix(turn))
        own = transform_covariance(self.covariance[rows], to.scale, to.rotation)
        weight = np.asarray(np.linalg.inv(self.tolerance[rows] + own), np.float64)
        return np.concatenate([offset, angle], axis=1), weight

    def jacobian(self, to: Similarity, rows: Sequence[int], centre: Array) -> Array:
        """Return the change of the residuals by a motion about a centre (n, 6, 7)."""
        jacobian = np.zeros((len(rows), 6, 7))
        jacobian[:, :3] = common_motions(to.apply(self.position[rows]) - centre)
        jacobian[:, range(3, 6), range(3, 6)] = 1.0
        return jacobian

    def deviations(self, fit: _Fit) -> tuple[StationDeviation, ...]:
        """Return how far each station is from its designed pose in the frame of a fit."""
        rows = list(range(len(self.channels)))
        residual, weight = self.residuals(fit.to_design, rows)
        jacobian = self.jacobian(fit.to_design, rows, fit.centre)
        covariance = np.linalg.inv(weight) + jacobian @ fit.covariance @ jacobian.mT
        result = []
        for channel, offset, own in zip(self.channels, residual, covariance, strict=True):
            squares = [offset[k] @ np.linalg.solve(own[k, k], offset[k]) for k in _PARTS]
            result.append(
                StationDeviation(
                    channel,
                    float(np.linalg.norm(offset[:3])),
                    float(np.linalg.norm(offset[3:])),
                    float(np.sqrt(max(squares))),
                )
            )
        return tuple(result)


@dataclass(frozen=True)
class _Placement:
    """Similarity of some stations to their designed poses, for :func:`minimize`."""

    matching: _Matching
    rows: list[int]
    free: NDArray[np.int64]
    centre: Array

    def linearize(self, state: Similarity, problems: NDArray[np.int64]) -> DenseEquations:
        """Return the equations of the free ones of translation, rotation and log scale."""
        residual, weight = self.matching.residuals(state, self.rows)
        jacobian = self.matching.jacobian(state, self.rows, self.centre)[..., self.free]
        equations = DenseEquations(
            0.5 * np.einsum("nk,nkl,nl->", residual, weight, residual)[None],
            np.einsum("nki,nkl,nl->i", jacobian, weight, residual)[None],
            np.einsum("nki,nkl,nlj->ij", jacobian, weight, jacobian)[None],
            residual.reshape(1, -1),
        )
        if np.isfinite(self.matching.scale_sigma):
            scale = slice(len(self.free) - 1, None)
            deviation = np.array([[np.log(state.scale)]])
            equations.add_prior(scale, deviation, np.array([self.matching.scale_sigma]))
        return equations

    def retract(self, state: Similarity, step: Array) -> Similarity:
        """Return a similarity after a step (1, k) about the centre."""
        full = np.zeros(7)
        full[self.free] = step[0]
        turn, growth = rotation_exp(full[3:6]), float(np.exp(np.clip(full[6], -1.0, 1.0)))
        return Similarity(
            growth * state.scale,
            turn @ state.rotation,
            self.centre + full[:3] + growth * turn @ (state.translation - self.centre),
        )


_PARTS = (slice(0, 3), slice(3, 6))


def _station(scene: Scene, channel: int) -> Station:
    station = scene.station(channel)
    assert station is not None
    return station


def _mounting_covariance(station: Station) -> Array:
    """Return the covariance (6, 6) of a designed station; by default, that of mounting by hand."""
    return hand_mounting_covariance() if station.covariance is None else station.covariance


def _plausible_swaps(
    scene: Scene, design: Scene, channels: Sequence[int], sigma: float
) -> dict[tuple[int, int], _Fit]:
    """Return the pairs of channels after whose exchange all stations fit, with the fits."""
    result = {}
    for first, second in combinations(channels, 2):
        to_channel = {c: c for c in channels} | {first: second, second: first}
        fit = _Matching.of(scene, design, to_channel, sigma).fit(channels)
        if fit.is_plausible:
            result[first, second] = fit
    return result


# ---- messages


def designed_poses_warning(error: DegenerateError) -> SolverWarning:
    """Return the warning for poses in a scene of designed stations."""
    hint = f" ({error.hint})" if error.hint else ""
    return SolverWarning(
        "designed_poses_used",
        f"{error.message}{hint}: the designed poses of the stations are used, and their mounting "
        "tolerance is in the covariances of the poses",
    )


def _frame_warning(frame: DesignedFrame, scale: str) -> SolverWarning:
    channels = ", ".join(str(c) for c in frame.used)
    by_design = f", scale within {100 * frame.scale_sigma:.2g} %" if scale == "design" else ""
    level = f"level within {np.degrees(frame.level_sigma_rad):.2g} deg, "
    return SolverWarning(
        "frame_of_design",
        f"the frame is that of the design, by the mounting of the stations on channel {channels}: "
        f"origin within {1e3 * frame.origin_sigma_m:.0f} mm, "
        f"{level if frame.level_sigma_rad > 0 else ''}"
        f"heading within {np.degrees(frame.heading_sigma_rad):.2g} deg{by_design} (one sigma). "
        "Visit markers to fix it better",
    )


def _deviation_warnings(frame: DesignedFrame) -> list[SolverWarning]:
    """Return the stations that are not where the design has them."""
    if frame.swaps:
        used, *others = (f"{first} and {second}" for first, second in frame.swaps)
        alternatives = ""
        if others:
            alternatives = (
                f" (or {', or '.join(others)}, which fits as well and gives another frame: visit "
                "markers to decide)"
            )
        return [
            SolverWarning(
                "designed_channels_swapped",
                f"the stations fit the design only if those on channels {used} are exchanged"
                f"{alternatives}: the frame is that of this arrangement. Set the channels as "
                "designed, or exchange them in the design",
            )
        ]
    is_misplaced = [
        d.sigmas > MAX_STATION_SIGMAS or (bool(frame.used) and d.channel not in frame.used)
        for d in frame.deviations
    ]
    warnings = [
        SolverWarning(
            "station_not_as_designed",
            f"the station on channel {d.channel} is {1e3 * d.offset_m:.0f} mm and "
            f"{np.degrees(d.rotation_rad):.1f} deg from its designed pose ({d.sigmas:.0f} sigma of "
            "the mounting): it was mounted elsewhere, or the scene is wrong",
        )
        for d, is_far in zip(frame.deviations, is_misplaced, strict=True)
        if is_far
    ]
    if frame.misfit_ratio > 1.0 and not warnings:
        warnings.append(
            SolverWarning(
                "station_not_as_designed",
                f"the stations are {frame.misfit_ratio:.1f} times as far from their designed poses "
                "as the mounting tolerance: one was mounted elsewhere, or the tolerance is larger",
            )
        )
    return warnings
