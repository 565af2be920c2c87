"""Estimation of a scene from the epochs of a recording.

One station is resected on its markers, over a floor or in space. Two or more stations are estimated
from the angles alone, up to scale: a two-view initialization of the best pair, registration of the
other stations one at a time, and a bundle adjustment of all. One of five keyframes is held out, so
that the scene can be verified on it. Markers, a distance or odometry then fix frame and scale.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError
from locatk.core.geometry import rotation_angle
from locatk.core.lighthouse.calibration import (
    GENERIC_CALIBRATION,
    MODEL_SIGMA_RAD,
    Calibration,
    ideal_angles,
)
from locatk.core.lighthouse.devices.pnp import candidate_poses
from locatk.core.lighthouse.epochs import Epochs, rotor_angles
from locatk.core.lighthouse.light_planes import rays as rays_of
from locatk.core.lighthouse.receiver import Receiver
from locatk.core.lighthouse.results import LighthouseFacts
from locatk.core.lighthouse.scene import Scene, Station
from locatk.core.lighthouse.scene.bundle_adjustment import (
    BundleAdjustment,
    BundleState,
    adjust_bundle,
)
from locatk.core.lighthouse.scene.frame import (
    MAX_MARKER_MISFIT_M,
    FramedState,
    fix_gauge,
    marker_angles,
    marker_misfit,
    marker_misfit_warning,
    unused_visits_warnings,
)
from locatk.core.lighthouse.scene.keyframes import (
    average_standstills,
    split_held_out,
    spread_evenly,
)
from locatk.core.lighthouse.scene.registration import (
    MAX_RELATIVE_SIGMA,
    StationRegistration,
    fit_floor_homography,
    resect_on_plane,
)
from locatk.core.lighthouse.scene.two_view import (
    INLIER_GATE_TAN,
    MIN_KEYFRAMES_IN_SPACE,
    MIN_KEYFRAMES_ON_PLANE,
    MarkerMisfit,
    StationPair,
    estimate_homography,
    estimate_station_pair,
    homography_residuals,
    is_plane_like,
)
from locatk.core.solution import SolverWarning
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]

SCENE_KINDS = ("auto", "one-planar", "two-planar", "two-3d")
"""Kinds of scenes; ``two-`` means two or more stations, ``"auto"`` is decided from the stations and
the data."""

MAX_BUNDLE_KEYFRAMES = 1500
"""Largest number of keyframes in the bundle adjustment. More cost time and do not make the scene
more accurate, because its error is that of the calibrations."""

MAX_KEYFRAMES = 2 * MAX_BUNDLE_KEYFRAMES
"""Largest number of keyframes from which a scene is estimated. A fifth of them is held out, and a
third may be wrong, before the bundle adjustment has fewer than its largest number."""

MAX_START_PAIRS = 3
"""Number of pairs of stations to start from. Further ones are tried if the first registers no more
than half of the group of linked stations."""

MIN_START_KEYFRAMES_RATIO = 0.25
"""Smallest number of common keyframes of a pair to start from, relative to the best pair."""

MAX_PLANE_TEST_PAIRS = 12
MIN_PLANE_TEST_KEYFRAMES = 20
"""Number of pairs on which a plane is tested, and their fewest common keyframes."""

MIN_SPATIAL_PAIR_FRACTION = 0.25
"""The scene is spatial if at least this fraction of the tested pairs fits no plane. The common
keyframes of a single pair may be of a flat part of the drive only."""

MIN_SHARED_KEYFRAMES = 4
"""Fewest common keyframes that link two stations to one group."""

MIN_PLANE_FRACTION = 0.95
"""Smallest fraction of positions on the plane of a planar scene without a warning."""

MIN_FLOOR_MARKERS = 4
"""Fewest markers that determine the pose of a single station."""

MAX_FLOOR_SLOPE = 0.05
"""Largest difference of the heights of markers on one floor, relative to their distance."""

MIN_POSE_LOG_ODDS = float(np.log(1000.0))
"""Smallest logarithm of the odds of the best pose of a station against any other."""

MIN_POSE_DIFFERENCE_RAD = 0.05
"""Smallest angle between two poses of a station that are not the same; seen from the markers, for
their positions."""


@dataclass(frozen=True)
class SceneEstimate:
    """Scene with the recording reduced to its stations.

    Attributes
    ----------
    scene : Scene
        With stations.
    epochs : Epochs
        Epochs with the sweeps of these stations only.
    facts : LighthouseFacts
    warnings : tuple of SolverWarning
    rejected : dict of str to int
        Number of sweeps of other stations, by reason.
    verification_angles : (n, s, 2) ndarray or None
        Rotor angles to verify the scene on; None if all epochs are suitable.
    held_out : bool
        True if these took no part in the estimation.
    """

    scene: Scene
    epochs: Epochs
    facts: LighthouseFacts = field(default_factory=LighthouseFacts)
    warnings: tuple[SolverWarning, ...] = ()
    rejected: dict[str, int] = field(default_factory=dict)
    verification_angles: Array | None = None
    held_out: bool = True


def use_given_scene(epochs: Epochs, scene: Scene) -> SceneEstimate:
    """Use a scene with stations as it is, and reduce the recording to its stations.

    Raises
    ------
    DegenerateError
        The scene has none of the stations of the recording.
    """
    columns = [i for i, c in enumerate(epochs.channels) if scene.station(int(c))]
    if not columns:
        raise DegenerateError(
            "the scene has none of the stations of the recording",
            hint="its channels are "
            + ", ".join(str(s.channel) for s in scene.stations)
            + "; the recording has "
            + ", ".join(str(c) for c in epochs.channels),
        )
    epochs, rejected = select_stations(epochs, columns, "station_not_in_scene")
    warnings = [SolverWarning("scene_assumption", note) for note in scene.notes]
    if len(columns) == 1 and not scene.planar:
        warnings.append(direction_only_warning(int(epochs.channels[0])))
    return SceneEstimate(scene, epochs, warnings=tuple(warnings), rejected=rejected)


def estimate_scene(
    epochs: Epochs,
    prior: Scene,
    *,
    kind: str = "auto",
    odometry: Sequence[Trajectory] = (),
    seed: int = 0,
) -> SceneEstimate:
    """Estimate the stations of a recording, in metres if the scale is known.

    Parameters
    ----------
    epochs : Epochs
        At least one.
    prior : Scene
        Without stations; its markers, distances, calibrations and serial numbers are used.
    kind : str
        One of :data:`SCENE_KINDS`.
    odometry : sequence of Trajectory
        Determines the scale if the prior has neither markers nor distances.
    seed : int
        Seed of the random samples: equal inputs and seeds give equal results.

    Raises
    ------
    DegenerateError
        The recording does not determine the scene. The message states what is missing.
    """
    decides_by_data = kind == "auto"
    kind = resolve_scene_kind(kind, prior, epochs)
    if kind == "one-planar":
        return _estimate_one_station(epochs, prior, may_be_in_space=decides_by_data)
    require_two_stations(kind, epochs)
    return _estimate_several_stations(epochs, prior, kind, odometry, seed)


def resolve_scene_kind(kind: str, prior: Scene, epochs: Epochs) -> str:
    """Replace ``"auto"`` by the kind of scene that the stations and the prior determine.

    ``"two-auto"`` if neither determines whether two or more stations are over a plane.
    """
    if kind != "auto":
        return kind
    if len(epochs.channels) == 1:
        return "one-planar"
    return {True: "two-planar", False: "two-3d", None: "two-auto"}[prior.planar]


def require_two_stations(kind: str, epochs: Epochs) -> None:
    """Raise an error if a recording has a single station."""
    if len(epochs.channels) < 2:
        raise DegenerateError(
            f"a {kind} scene needs two stations and the recording has one",
            hint="use --scene one-planar with markers",
        )


def select_stations(
    epochs: Epochs, columns: Sequence[int], reason: str
) -> tuple[Epochs, dict[str, int]]:
    """Keep the sweeps of some stations, and count those of the others under ``reason``."""
    if len(columns) == len(epochs.channels):
        return epochs, {}
    removed_columns = [i for i in range(len(epochs.channels)) if i not in columns]
    removed = int(np.count_nonzero(np.isfinite(epochs.counts[:, removed_columns])))
    kept = replace(
        epochs,
        channels=epochs.channels[list(columns)],
        counts=epochs.counts[:, list(columns)],
    )
    return kept, {reason: removed} if removed else {}


# ---- one station


def _estimate_one_station(epochs: Epochs, prior: Scene, *, may_be_in_space: bool) -> SceneEstimate:
    """Resect the station with the most markers, on a floor or in space."""
    marker_points, observed = marker_angles(prior.markers, epochs, rotor_angles(epochs))
    is_complete = np.all(np.isfinite(observed), axis=2)
    column = int(np.argmax(np.count_nonzero(is_complete, axis=0)))
    epochs, rejected = select_stations(epochs, [column], "other_station")
    marker_points = marker_points[is_complete[:, column]]
    observed = observed[is_complete[:, column]][:, [column]]
    if len(marker_points) < MIN_FLOOR_MARKERS:
        raise DegenerateError(
            f"one station needs {MIN_FLOOR_MARKERS} visited markers on the floor and has "
            f"{len(marker_points)}",
            hint="add [[markers]] with sightings to a scene.toml and give it by --artifact, "
            "or record with two stations",
        )
    if may_be_in_space and (prior.planar is False or not is_on_floor(marker_points)):
        return _resect_in_space(epochs, prior, marker_points, observed, rejected)
    floor_z = float(np.mean(marker_points[:, 2]))
    on_floor = marker_points - np.array([0.0, 0.0, floor_z])
    calibration = prior.calibrations.get(int(epochs.channels[0]), GENERIC_CALIBRATION)
    rays = rays_of(ideal_angles(observed[:, 0], calibration), calibration.tilts)
    position, rotation = resect_on_plane(on_floor[:, :2], rays)
    adjustment = adjust_bundle(
        observed,
        BundleState(position[None], rotation[None], (calibration,), on_floor),
        sigma_rad=MODEL_SIGMA_RAD,
        planar=True,
        fixed_points=True,
        calibrate=False,
    )
    state = adjustment.state
    raised = replace(state, positions=state.positions + np.array([0.0, 0.0, floor_z]))
    framed = FramedState(
        raised, adjustment.station_covariance, floor_z, "markers", prior.frame, "markers"
    )
    warnings = (
        *generic_calibration_warnings(epochs.channels.tolist(), state.calibrations),
        *unused_visits_warnings(prior.markers, len(marker_points)),
    )
    scene = _build_scene(framed, True, epochs, prior, warnings)
    station = replace(scene.stations[0], floor_map=fit_floor_homography(on_floor[:, :2], rays))
    facts = LighthouseFacts(
        planar=True, marker_residual_rad=float(np.sqrt(np.nanmean(adjustment.residuals**2)))
    )
    return SceneEstimate(replace(scene, stations=(station,)), epochs, facts, warnings, rejected)


def is_on_floor(points: Array) -> bool:
    """Return whether points (n, 3) have the same height, up to :data:`MAX_FLOOR_SLOPE`."""
    extent, relief = np.ptp(points[:, :2], axis=0).max(), np.ptp(points[:, 2])
    return bool(relief <= MAX_FLOOR_SLOPE * extent)


def _resect_in_space(
    epochs: Epochs, prior: Scene, marker_points: Array, observed: Array, rejected: dict[str, int]
) -> SceneEstimate:
    """Resect a station on markers (n, 3) in space.

    The markers are like the photodiodes of a rigid device, whose candidate poses are those of the
    station. They are refined on all markers. Photodiodes are on a floor only if the prior states
    it; otherwise the station gives their directions, and no positions.
    """
    channel = int(epochs.channels[0])
    calibration = prior.calibrations.get(channel, GENERIC_CALIBRATION)
    adjustments = [
        adjust_bundle(
            observed,
            BundleState(
                (-rotation.T @ position)[None], rotation.T[None], (calibration,), marker_points
            ),
            sigma_rad=MODEL_SIGMA_RAD,
            fixed_points=True,
        )
        for position, rotation in candidate_poses(
            observed[:, 0], Receiver(marker_points), calibration
        )
    ]
    hint = f"visit {MIN_FLOOR_MARKERS} or more markers at different heights, wide apart"
    if not adjustments:
        raise DegenerateError("the markers do not determine the pose of the station", hint=hint)
    best = min(adjustments, key=lambda adjustment: adjustment.cost)
    distance = float(np.median(np.linalg.norm(marker_points - best.state.positions[0], axis=1)))
    agrees = np.all(np.abs(best.residuals[:, 0]) < INLIER_GATE_TAN, axis=1)
    if np.count_nonzero(agrees) < MIN_FLOOR_MARKERS:
        raise DegenerateError(
            "fewer than four markers agree with each other",
            hint="check the measured positions and the times of the visits",
        )
    is_rival = [
        other.cost < best.cost + MIN_POSE_LOG_ODDS
        and max(
            float(rotation_angle(other.state.rotations[0], best.state.rotations[0])),
            float(np.linalg.norm(other.state.positions - best.state.positions)) / distance,
        )
        > MIN_POSE_DIFFERENCE_RAD
        for other in adjustments
    ]
    if any(is_rival):
        raise DegenerateError(
            "two poses of the station explain the markers equally well", hint=hint
        )
    sigma = float(np.sqrt(np.trace(best.station_covariance[0, :3, :3])))
    if not sigma < MAX_RELATIVE_SIGMA * distance:
        raise DegenerateError(
            f"the markers determine the position of the station to {sigma:.2f} m only", hint=hint
        )
    residual_rad = float(np.sqrt(np.nanmean(best.residuals**2)))
    warnings = [
        *generic_calibration_warnings([channel], best.state.calibrations),
        *unused_visits_warnings(prior.markers, len(marker_points)),
    ]
    if residual_rad * distance > MAX_MARKER_MISFIT_M:
        warnings.append(marker_misfit_warning(residual_rad * distance))
    planar = prior.planar is True
    framed = FramedState(
        best.state, best.station_covariance, prior.floor_z, "markers", prior.frame, "markers"
    )
    scene = _build_scene(framed, planar, epochs, prior, warnings)
    if not planar:
        warnings.append(direction_only_warning(channel))
    facts = LighthouseFacts(planar=planar, marker_residual_rad=residual_rad)
    return SceneEstimate(scene, epochs, facts, tuple(warnings), rejected)


def direction_only_warning(channel: int) -> SolverWarning:
    """Return the warning for photodiodes in space under a single station."""
    return SolverWarning(
        "direction_only",
        f"one station (channel {channel}) gives the direction of a photodiode in space, and no "
        "position: state the floor in the scene (planar = true, floor_z_mm), add a station, or use "
        "a device with four photodiodes",
    )


# ---- two stations or more


def _estimate_several_stations(
    epochs: Epochs, prior: Scene, kind: str, odometry: Sequence[Trajectory], seed: int
) -> SceneEstimate:
    """Estimate two or more stations of a recording and fix their gauge."""
    planar = {"two-planar": True, "two-3d": False}.get(kind)
    angles = rotor_angles(epochs)
    keyframes, _ = average_standstills(angles, epochs.device)
    is_observed = np.asarray(np.isfinite(keyframes).all(axis=2))
    keyframes = keyframes[spread_evenly(is_observed, np.arange(len(keyframes)), MAX_KEYFRAMES)]

    def misfit_of_markers(state: BundleState, columns: tuple[int, int]) -> float:
        marker_points, observed = marker_angles(prior.markers, epochs, angles)
        return marker_misfit(state, True, marker_points, observed[:, columns])

    estimate = estimate_stations(
        keyframes,
        tuple(prior.calibrations.get(int(c), GENERIC_CALIBRATION) for c in epochs.channels),
        sigma=MODEL_SIGMA_RAD,
        planar=planar,
        marker_misfit=misfit_of_markers if prior.markers else None,
        ups=np.array([prior.ups.get(int(c), np.full(3, np.nan)) for c in epochs.channels]),
        seed=seed,
    )
    stations = list(estimate.stations)
    kept, rejected = select_stations(epochs, stations, "station_not_solved")
    framed = fix_gauge(
        estimate.adjustment.state,
        estimate.adjustment.station_covariance,
        estimate.planar,
        prior,
        kept,
        angles[:, stations],
        odometry,
    )
    warnings = (
        *_left_out_warnings(estimate, epochs),
        *_assumption_warnings(estimate, decided_by_data=planar is None),
        *framed.warnings,
        *generic_calibration_warnings(kept.channels.tolist(), framed.state.calibrations),
    )
    has_held_out = len(estimate.held_out) > 0
    rows = estimate.held_out if has_held_out else estimate.chosen
    return SceneEstimate(
        _build_scene(framed, estimate.planar, kept, prior, warnings),
        kept,
        replace(estimate.facts, planar=estimate.planar, marker_misfit_m=framed.marker_misfit_m),
        warnings,
        rejected,
        keyframes[rows][:, stations],
        has_held_out,
    )


def _left_out_warnings(estimate: StationsEstimate, epochs: Epochs) -> list[SolverWarning]:
    """Return a warning for each reason why stations were left out."""
    warnings = []
    for reason in dict.fromkeys(estimate.left_out.values()):
        channels = [
            str(epochs.channels[k])
            for k, station_reason in sorted(estimate.left_out.items())
            if station_reason == reason
        ]
        warnings.append(
            SolverWarning(
                "stations_left_out",
                f"station on channel {', '.join(channels)} {reason}: left out",
            )
        )
    return warnings


def _assumption_warnings(
    estimate: StationsEstimate, *, decided_by_data: bool
) -> list[SolverWarning]:
    """Return the assumptions about a plane, and evidence against them."""
    warnings = []
    facts = estimate.facts
    if decided_by_data:
        text = "the positions are on one plane" if estimate.planar else "the positions fill space"
        warnings.append(SolverWarning("plane_from_data", text))
    fraction = facts.plane_fraction
    if estimate.planar and fraction is not None and fraction < MIN_PLANE_FRACTION:
        warnings.append(
            SolverWarning(
                "plane_contradicted",
                f"{1.0 - fraction:.0%} of the positions contradict the plane (carried robots, "
                "swapped sweeps, reflections)",
            )
        )
    fitting = [c for c in facts.candidates or () if c.fits]
    if len(fitting) > 1 and facts.candidate_decided_by is None:
        warnings.append(
            SolverWarning(
                "two_candidates",
                "two arrangements of the stations explain the angles equally well; the one with "
                "less roll was chosen",
            )
        )
    return warnings


def generic_calibration_warnings(
    channels: Sequence[int], calibrations: Sequence[Calibration]
) -> tuple[SolverWarning, ...]:
    """Return a warning that names the channels without factory calibration, if there are any."""
    generic = [
        str(channel)
        for channel, calibration in zip(channels, calibrations, strict=True)
        if calibration.is_generic
    ]
    if not generic:
        return ()
    return (
        SolverWarning(
            "generic_calibration",
            f"no factory calibration is known of channel {', '.join(generic)}: using an average "
            "factory calibration (generic), refined from this recording if possible",
        ),
    )


def _build_scene(
    framed: FramedState,
    planar: bool,
    epochs: Epochs,
    prior: Scene,
    warnings: Sequence[SolverWarning],
) -> Scene:
    """Build a scene from stations in their final frame, with its assumptions as notes."""
    state = framed.state
    stations = tuple(
        Station(
            int(channel),
            state.positions[i],
            state.rotations[i],
            state.calibrations[i],
            prior.ids.get(int(channel)),
            covariance=framed.station_covariance[i, :6, :6],
        )
        for i, channel in enumerate(epochs.channels)
    )
    return Scene(
        stations,
        prior.markers,
        prior.distances,
        planar,
        framed.floor_z,
        framed.scale,
        framed.frame,
        tuple(warning.message for warning in warnings),
        frame_source=framed.frame_source,
    )


# ---- stations from angles alone


@dataclass(frozen=True)
class StationsEstimate:
    """Stations up to scale, in an arbitrary frame.

    Attributes
    ----------
    adjustment : BundleAdjustment
        Bundle adjustment of the keyframes ``chosen``. In a planar scene z = 0 is the plane of the
        photodiodes and z is up.
    stations : tuple of int
        Columns of the estimated stations, ascending.
    chosen : (k,) int ndarray
        Indices of the keyframes in the bundle adjustment.
    planar : bool
    facts : LighthouseFacts
        Decisions, with the figures on which they rest.
    held_out : (n,) int ndarray
        Indices of keyframes that agree as well and took no part; empty if all were needed.
    left_out : dict of int to str
        Columns of the other stations, with the reason.
    """

    adjustment: BundleAdjustment
    stations: tuple[int, ...]
    chosen: NDArray[np.int64]
    planar: bool
    facts: LighthouseFacts
    held_out: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    left_out: dict[int, str] = field(default_factory=dict)


def estimate_stations(
    angles: Array,
    calibrations: tuple[Calibration, ...],
    *,
    sigma: float,
    planar: bool | None = None,
    marker_misfit: MarkerMisfit | None = None,
    ups: Array | None = None,
    seed: int = 0,
) -> StationsEstimate:
    """Estimate two or more stations from angles alone.

    Parameters
    ----------
    angles : (m, s, 2) ndarray
        Observed rotor angles of keyframes in radians, ``nan`` without a sweep; s >= 2.
    calibrations : tuple of Calibration
        One per station; generic ones are refined.
    sigma : float
        Standard deviation of an angle including the errors of its calibration, in radians.
    planar : bool, optional
        True if all photodiodes are on one plane; decided from the data if None.
    marker_misfit : callable, optional
        Misfit of the markers in the state of two stations, given with their columns. It decides
        between the two decompositions of a homography.
    ups : (s, 3) ndarray, optional
        Direction against gravity in the axes of each station, ``nan`` if unknown. They decide if
        the markers do not.
    seed : int
        Seed of the random samples: equal inputs and seeds give equal results.

    Raises
    ------
    DegenerateError
        The keyframes do not determine the stations: too few positions, all on a line, all on a
        plane (for ``planar=False``), or stations without common keyframes.
    """
    rays = np.stack(
        [rays_of(ideal_angles(angles[:, i], c), c.tilts) for i, c in enumerate(calibrations)],
        axis=1,
    )
    shared = _count_shared(np.isfinite(rays[..., 0]))
    pairs: dict[tuple[int, int, bool | None], StationPair | DegenerateError] = {}

    def pair_of(i: int, j: int, planar: bool | None) -> StationPair | DegenerateError:
        columns = (min(i, j), max(i, j))
        key = (*columns, planar)
        if key not in pairs:
            try:
                pairs[key] = estimate_station_pair(
                    angles,
                    rays,
                    calibrations,
                    columns,
                    sigma=sigma,
                    planar=planar,
                    marker_misfit=marker_misfit,
                    ups=ups,
                    seed=seed,
                )
            except DegenerateError as error:
                pairs[key] = error
        return pairs[key]

    group = largest_group(shared)
    decided_by = "data" if planar is None else "option"
    if planar is None and len(group) > 2 and _fills_space(rays, shared, group, seed):
        planar = False
    starts = _start_pairs(shared, group, lambda i, j: pair_of(i, j, planar))

    def neighbour_pair(i: int, j: int) -> StationPair | None:
        pair = pair_of(i, j, starts[0].planar)
        return pair if isinstance(pair, StationPair) else None

    attempts: list[tuple[StationRegistration, StationPair, dict[int, str]]] = []
    for start in starts:
        if any({*start.columns} <= {*attempt.registered} for attempt, _, _ in attempts):
            continue
        registration = StationRegistration(angles, rays, calibrations, start, sigma)
        attempts.append((registration, start, registration.register_all(neighbour_pair)))
        if 2 * len(registration.registered) > len(group):
            break
    registration, start, left_out = max(attempts, key=lambda attempt: len(attempt[0].registered))
    for k in left_out:
        if k not in group and np.any(shared[k] >= MIN_SHARED_KEYFRAMES):
            left_out[k] = "is of a group that shares no position with the larger one"
    return _adjust_all(registration, calibrations, start, left_out, decided_by)


def _adjust_all(
    registration: StationRegistration,
    calibrations: tuple[Calibration, ...],
    start: StationPair,
    left_out: dict[int, str],
    planar_decided_by: str,
) -> StationsEstimate:
    """Adjust all registered stations together, on all keyframes that agree with them."""
    planar, registered = registration.planar, registration.registered
    estimates = registration.estimate_keyframes()
    is_inlier = np.isfinite(estimates.position[:, 0]) & (estimates.redundancy > 0)
    is_inlier &= estimates.max_residual < INLIER_GATE_TAN
    if len(registered) == 2:
        # Outliers of the two-view consensus stay out: light planes can intersect by chance.
        is_consensus = np.zeros(len(is_inlier), bool)
        is_consensus[start.inliers] = True
        is_inlier &= is_consensus
    usable = np.flatnonzero(is_inlier)
    if len(usable) < (MIN_KEYFRAMES_ON_PLANE if planar else MIN_KEYFRAMES_IN_SPACE):
        raise DegenerateError(
            f"{len(usable)} positions agree with one arrangement of the stations",
            hint="the recording has almost only wrong sweeps; `locatk info` shows its channels",
        )
    is_observed = registration.is_observed[:, registered]
    used, held_out = split_held_out(is_observed, usable)
    chosen = spread_evenly(is_observed, used, MAX_BUNDLE_KEYFRAMES)
    # Start from the given calibrations and not from those that the registration refined, because
    # a bundle adjustment keeps the parameters that its prior fixes at their initial values.
    adjustment = adjust_bundle(
        registration.angles[chosen][:, registered],
        BundleState(
            registration.positions[registered],
            registration.rotations[registered],
            tuple(calibrations[k] for k in registered),
            estimates.position[chosen],
        ),
        sigma_rad=registration.sigma,
        planar=planar,
    )
    facts = LighthouseFacts(
        plane_fraction=start.facts.plane_fraction,
        plane_median_rad=start.facts.plane_median_rad,
        planar_decided_by=planar_decided_by,
        candidate_decided_by=start.facts.candidate_decided_by,
        candidates=start.facts.candidates,
        bundle_points=len(chosen),
        bundle_iterations=adjustment.iterations,
    )
    return StationsEstimate(
        adjustment, tuple(registered), chosen, planar, facts, held_out, left_out
    )


def _count_shared(is_observed: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the (s, s) numbers of common keyframes of two stations; 0 on the diagonal."""
    observed = is_observed.astype(np.int64)
    shared = observed.T @ observed
    np.fill_diagonal(shared, 0)
    return shared


def largest_group(shared: NDArray[np.int64]) -> tuple[int, ...]:
    """Return the columns of the largest group of stations that common keyframes link.

    Parameters
    ----------
    shared : (s, s) int ndarray
        Number of common keyframes, 0 on the diagonal.

    Returns
    -------
    tuple of int
        The group with the most stations, and of several the one with the most common keyframes.

    Raises
    ------
    DegenerateError
        No two stations have a common keyframe.
    """
    if not np.any(shared):
        raise DegenerateError(
            "no position was observed by two stations at once",
            hint="put the stations so that their views overlap",
        )
    is_linked = shared >= min(MIN_SHARED_KEYFRAMES, int(shared.max()))
    groups: list[tuple[int, ...]] = []
    remaining = set(range(len(shared)))
    while remaining:
        group, frontier = set[int](), {min(remaining)}
        while frontier:
            group |= frontier
            frontier = {int(k) for i in frontier for k in np.flatnonzero(is_linked[i])} - group
        remaining -= group
        groups.append(tuple(sorted(group)))
    return max(groups, key=lambda g: (len(g), int(shared[np.ix_(g, g)].sum())))


def _fills_space(rays: Array, shared: NDArray[np.int64], group: tuple[int, ...], seed: int) -> bool:
    """Return whether enough pairs of a group have common keyframes that are on no plane."""
    is_flat_pair = []
    for i, j in _ranked_pairs(shared, group)[:MAX_PLANE_TEST_PAIRS]:
        if shared[i, j] < MIN_PLANE_TEST_KEYFRAMES:
            break
        is_common = np.isfinite(rays[:, [i, j], 0]).all(axis=1)
        a, b = rays[is_common, i], rays[is_common, j]
        homography, _ = estimate_homography(a, b, seed)
        median = float(np.median(homography_residuals(homography, a, b)))
        is_flat_pair.append(is_plane_like(a, b, median))
    spatial_pairs = is_flat_pair.count(False)
    return bool(is_flat_pair) and spatial_pairs >= MIN_SPATIAL_PAIR_FRACTION * len(is_flat_pair)


def _ranked_pairs(shared: NDArray[np.int64], group: tuple[int, ...]) -> list[tuple[int, int]]:
    """Return the pairs of a group, those with the most common keyframes first."""
    return sorted(combinations(group, 2), key=lambda pair: -int(shared[pair]))


def _start_pairs(
    shared: NDArray[np.int64],
    group: tuple[int, ...],
    pair_of: Callable[[int, int], StationPair | DegenerateError],
) -> list[StationPair]:
    """Return the pairs with the most common keyframes, the most accurate one first."""
    ranked = _ranked_pairs(shared, group)
    min_shared = MIN_START_KEYFRAMES_RATIO * shared[ranked[0]]
    pairs: list[StationPair] = []
    first_error: DegenerateError | None = None
    for i, j in ranked:
        has_too_few = shared[i, j] < MIN_SHARED_KEYFRAMES or shared[i, j] < min_shared
        if pairs and (has_too_few or len(pairs) == MAX_START_PAIRS):
            break
        pair = pair_of(i, j)
        if isinstance(pair, StationPair):
            pairs.append(pair)
        else:
            first_error = first_error or pair
    if not pairs:
        assert first_error is not None  # Each pair was either estimated or raised an error.
        raise first_error
    # Either all pairs are over one floor or none is: the pair with the most keyframes decides.
    consistent = [pair for pair in pairs if pair.planar == pairs[0].planar]
    return sorted(consistent, key=lambda pair: pair.relative_sigma)
