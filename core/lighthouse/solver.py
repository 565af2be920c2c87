"""Pipeline of the Lighthouse solver, from sweeps to poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from locatk.core.errors import DegenerateError, InputError
from locatk.core.inertial import InertialSamples
from locatk.core.lighthouse.devices.solver import (
    merge_solutions,
    paths_warnings,
    select_rigid_receivers,
    solve_devices,
)
from locatk.core.lighthouse.doubled_channels import (
    DOUBLED_CHANNEL_HINT,
    doubled_channel_message,
    find_doubled_channels,
    possible_doubled_channel_message,
)
from locatk.core.lighthouse.epochs import Epochs, group_epochs, rotor_angles
from locatk.core.lighthouse.localization.photodiodes import detect_stations, track_photodiodes
from locatk.core.lighthouse.localization.trajectories import refine_photodiodes
from locatk.core.lighthouse.published.scene import solve_published
from locatk.core.lighthouse.receiver import Receiver
from locatk.core.lighthouse.recording import Sweeps
from locatk.core.lighthouse.scene import Scene
from locatk.core.lighthouse.scene.designed_frame import (
    design_prior,
    designed_poses_warning,
    is_design,
    place_in_design,
    with_mounting_tolerance,
)
from locatk.core.lighthouse.scene.estimation import (
    SCENE_KINDS,
    SceneEstimate,
    estimate_scene,
    resolve_scene_kind,
    use_given_scene,
)
from locatk.core.lighthouse.scene.frame import marker_angles
from locatk.core.lighthouse.scene.model import stack_stations
from locatk.core.lighthouse.scene.verification import (
    inconsistent_station_warnings,
    select_verification_epochs,
    verify_scene,
)
from locatk.core.solution import Solution, SolverWarning, add_counts
from locatk.core.trajectory import Trajectory

METHODS = ("bundle", "paper")


_RATE_WARNING = SolverWarning(
    "rate_not_used",
    "the photodiodes have a pose for each report, and none between them: they report too few "
    "sweeps a second for a path",
)


@dataclass(frozen=True)
class SolveOptions:
    """Options of the solver.

    Attributes
    ----------
    method : str
        ``"bundle"`` or ``"paper"`` (the published method).
    scene : str
        One of :data:`~locatk.core.lighthouse.scene.estimation.SCENE_KINDS`; ``"auto"`` decides
        from the stations and the data.
    seed : int
        Seed of the random samples.
    rate_hz : float, optional
        Poses per second of devices that move, infinite for a pose at each sweep; by default, one
        per rotation of the fastest station. Between sweeps, poses are interpolated.
    """

    method: str = "bundle"
    scene: str = "auto"
    seed: int = 0
    rate_hz: float | None = None

    def __post_init__(self) -> None:
        for name, value, choices in (
            ("method", self.method, METHODS),
            ("scene", self.scene, SCENE_KINDS),
        ):
            if value not in choices:
                raise InputError(
                    f"unknown {name} {value!r}", hint=f"choose one of {', '.join(choices)}"
                )
        if self.rate_hz is not None and not self.rate_hz > 0:
            raise InputError(f"{self.rate_hz:g} poses per second is not positive")
        if self.rate_hz is not None and self.method == "paper":
            raise InputError(
                "the published method has no paths between sweeps",
                hint="leave --rate or --method paper out",
            )


def solve(
    sweeps: Sweeps,
    scene: Scene | None = None,
    options: SolveOptions | None = None,
    odometry: Sequence[Trajectory] = (),
    receivers: Mapping[str, Receiver] | None = None,
    imu: Sequence[InertialSamples] = (),
) -> Solution:
    """Estimate the poses of all photodiodes and rigid devices of a recording.

    Parameters
    ----------
    sweeps : Sweeps
    scene : Scene, optional
        With stations: they are used as they are. Without: they are estimated first; markers
        and distances then fix frame and scale. Stations of a design (``frame_source`` is
        ``"design"``) are estimated as well, and the result is moved to them
        (:mod:`~locatk.core.lighthouse.scene.designed_frame`); if the recording does not determine
        them, the designed poses are used, with their covariances.
    options : SolveOptions, optional
    odometry : sequence of Trajectory
        Determines the scale if the scene has neither markers nor distances.
    receivers : mapping of str to Receiver, optional
        By device. Devices with three or more photodiodes of known position get full poses, and
        a scene without stations is estimated from them. The others are located in that scene.
    imu : sequence of InertialSamples
        Of rigid devices; those of others are not used.

    Returns
    -------
    Solution
        Its ``artifact`` is the scene with stations, for later sessions; the given design if no
        stations could be estimated.

    Raises
    ------
    DegenerateError
        The recording does not determine the scene. The message states what is missing, or that
        several stations send on each channel.
    InputError
        The options contradict the scene, or a marker names an unknown device.
    """
    scene = scene or Scene()
    options = options or SolveOptions()
    if not is_design(scene):
        return _solve(sweeps, scene, options, odometry, receivers, imu)
    try:
        solution = _solve(sweeps, design_prior(scene), options, odometry, receivers, imu)
        return place_in_design(solution, scene)
    except DegenerateError as error:
        if options.method == "paper":
            raise
        given = with_mounting_tolerance(scene)
        solution = _solve(sweeps, given, options, odometry, receivers, imu)
        warning = designed_poses_warning(error)
        return replace(solution, artifact=scene, warnings=(warning, *solution.warnings))


def _solve(
    sweeps: Sweeps,
    scene: Scene,
    options: SolveOptions,
    odometry: Sequence[Trajectory],
    receivers: Mapping[str, Receiver] | None,
    imu: Sequence[InertialSamples],
) -> Solution:
    """Solve in a scene whose stations are used as they are, or estimated if it has none."""
    channels = find_doubled_channels(sweeps)
    doubled = channels.proven
    is_doubled = np.isin(sweeps.channel, doubled)
    if doubled and np.all(is_doubled):
        raise DegenerateError(doubled_channel_message(doubled), hint=DOUBLED_CHANNEL_HINT)
    sweeps = sweeps.take(~is_doubled)
    rigid = select_rigid_receivers(sweeps, receivers) if receivers else {}
    if rigid and options.method == "bundle":
        solution = solve_devices(sweeps, rigid, scene, imu=imu, rate_hz=options.rate_hz)
        single = [k for k, name in enumerate(sweeps.devices) if name not in rigid]
        rows = np.flatnonzero(np.isin(sweeps.device, single))
        if len(rows):
            others = sweeps.take(rows)
            try:
                photodiodes = _solve_photodiodes(others, solution.artifact, options)
            except DegenerateError as error:
                solution = _with_unsolved_devices(solution, others, error)
            else:
                solution = merge_solutions(solution, photodiodes)
    else:
        solution = _solve_photodiodes(sweeps, scene, options, odometry)
        if rigid:
            warning = SolverWarning(
                "rigid_devices_ignored",
                "the published method does not support rigid devices: each photodiode is solved "
                "separately",
            )
            solution = replace(solution, warnings=(*solution.warnings, warning))
    if doubled:
        warning = SolverWarning("doubled_channel", doubled_channel_message(doubled))
        number = int(np.count_nonzero(is_doubled))
        solution = replace(
            solution,
            rejected=add_counts(solution.rejected, {"sweep_of_doubled_channel": number}),
            warnings=(warning, *solution.warnings),
        )
    if channels.possible:
        warning = SolverWarning(
            "possible_doubled_channel", possible_doubled_channel_message(channels.possible)
        )
        solution = replace(solution, warnings=(warning, *solution.warnings))
    return replace(solution, warnings=tuple(dict.fromkeys(solution.warnings)))


def _solve_photodiodes(
    sweeps: Sweeps, scene: Scene, options: SolveOptions, odometry: Sequence[Trajectory] = ()
) -> Solution:
    """Estimate the trajectory of each photodiode, in the given scene or an estimated one."""
    epochs = group_epochs(sweeps)
    _require_sweeps(epochs)
    if scene.stations:
        estimate = use_given_scene(epochs, scene)
        if options.method == "paper":
            raise InputError(
                "the published method estimates its own scene and takes none with stations",
                hint="leave --artifact or --method paper out",
            )
    elif options.method == "paper":
        kind = resolve_scene_kind(options.scene, scene, epochs)
        return solve_published(epochs, scene, kind)
    else:
        estimate = estimate_scene(
            epochs, scene, kind=options.scene, odometry=odometry, seed=options.seed
        )
    return _locate_and_verify(
        estimate, sweeps, epochs.rejected, options, is_estimated=not scene.stations
    )


def _with_unsolved_devices(solution: Solution, sweeps: Sweeps, error: DegenerateError) -> Solution:
    """Add devices without poses to the solution of the others; ``sweeps`` are all theirs."""
    names = [sweeps.devices[k] for k in np.unique(sweeps.device).tolist()]
    epochs = group_epochs(sweeps)
    no_time, no_position = np.zeros(0, np.int64), np.zeros((0, 3))
    frame = solution.artifact.frame
    return replace(
        solution,
        trajectories=(
            *solution.trajectories,
            *(Trajectory.from_positions(name, frame, no_time, no_position) for name in names),
        ),
        rejected=add_counts(
            solution.rejected,
            epochs.rejected,
            {"station_not_in_scene": int(np.count_nonzero(np.isfinite(epochs.counts)))},
        ),
        warnings=(
            *solution.warnings,
            SolverWarning("no_device_pose", f"{', '.join(names)}: no pose was found: {error}"),
        ),
    )


def _locate_and_verify(
    estimate: SceneEstimate,
    sweeps: Sweeps,
    rejected_sweeps: Mapping[str, int],
    options: SolveOptions,
    *,
    is_estimated: bool,
) -> Solution:
    """Locate all epochs in a scene, estimate paths where photodiodes move, and verify the scene."""
    scene = estimate.scene
    tracks = track_photodiodes(estimate.epochs, scene)
    channels = tracks.epochs.channels.tolist()
    trajectories, rejected, sigma_rad = tracks.trajectories, tracks.rejected, tracks.angle_sigma_rad
    # Visits of a given scene are those of another recording.
    visited = scene.markers if is_estimated else ()
    markers = marker_angles(visited, tracks.epochs, rotor_angles(tracks.epochs))
    paths, path_warnings = None, []
    try:
        paths = refine_photodiodes(
            sweeps,
            channels,
            trajectories,
            scene,
            markers,
            is_estimated=is_estimated,
            rate_hz=options.rate_hz,
        )
    except DegenerateError as error:
        path_warnings.extend(paths_warnings(error))
    if paths is None and options.rate_hz is not None:
        path_warnings.append(_RATE_WARNING)
    if paths is not None:
        scene, trajectories, sigma_rad = paths.scene, paths.trajectories, paths.sigma_rad
        rejected = add_counts(rejected, paths.rejected)
        path_warnings = paths.warnings
    stations = {c: s for c in channels if (s := scene.station(c)) is not None}
    verification = None
    # A floor homography has no pose to verify.
    if not (len(stations) == 1 and stations[channels[0]].floor_map is not None):
        angles, held_out = estimate.verification_angles, estimate.held_out
        if angles is None:
            angles = rotor_angles(tracks.epochs)
            angles, held_out = angles[select_verification_epochs(angles)], True
        verification = verify_scene(
            angles,
            channels,
            stack_stations(list(stations.values())),
            floor_z=scene.floor_z if scene.planar else None,
            held_out=held_out,
        )
    return Solution(
        "lighthouse",
        options.method,
        trajectories,
        add_counts(rejected_sweeps, estimate.rejected, rejected),
        detect_stations(
            tracks.epochs, stations, tracks.estimates.residual, tracks.is_accepted, verification
        ),
        scene,
        facts=replace(
            estimate.facts,
            restored_swapped_epochs=tracks.restored_epochs or None,
            angle_sigma_rad=sigma_rad,
            calibration_sigma_rad=tracks.calibration_sigma_rad,
            verification=verification,
        ),
        warnings=(
            *estimate.warnings,
            *tracks.warnings,
            *path_warnings,
            *inconsistent_station_warnings(verification),
        ),
    )


def _require_sweeps(epochs: Epochs) -> None:
    """Raise an error if a recording has no usable sweep."""
    if len(epochs) == 0 or len(epochs.channels) == 0:
        raise DegenerateError(
            "the recording has no usable sweep",
            hint="`locatk info` shows its contents; rejected: "
            + (", ".join(f"{n} {r}" for r, n in epochs.rejected.items()) or "nothing"),
        )
