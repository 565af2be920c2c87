"""Table of the systems: observations, artifact and solver of each.

A system of another package is an entry point in the group ``locatk.systems``. It refers to a
function like an entry of :data:`SYSTEMS`: ``(session, request) -> SolvedSession``.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from locatk.core import dots, landmarks, lighthouse, polaris
from locatk.core.errors import FormatError, InputError, LocatkError
from locatk.core.lighthouse.demodulation.sweep_reports import report_stations
from locatk.core.lighthouse.receiver import Receiver
from locatk.core.lighthouse.recording import Sweeps
from locatk.core.lighthouse.scene import Scene
from locatk.core.lighthouse.scene.frame import given_scene_warnings
from locatk.core.lighthouse.scene.levelling import inertial_ups, level_solution
from locatk.core.lighthouse.scene.setup import (
    AssignedStandstill,
    SceneSetup,
    add_to_prior,
    assign_standstills,
    place_on_floor,
    with_standstills,
)
from locatk.core.lighthouse.scene.standstills import Standstill, find_standstills
from locatk.core.polaris.published.templates import TemplateGrid
from locatk.core.polaris.tag import Tags
from locatk.core.solution import Solution, SolverWarning
from locatk.formats.artifacts import maps, scene, sheets, tags
from locatk.formats.artifacts.registry import ARTIFACTS
from locatk.formats.artifacts.schema import read_format
from locatk.formats.pipeline.scene_merging import knowledge_of_stations, merge_scenes
from locatk.formats.sessions import observations, station_reports
from locatk.formats.sessions.reader import Session

ENTRY_POINT_GROUP = "locatk.systems"


@dataclass(frozen=True)
class SolveRequest:
    """Options of a solver; None selects the default of the solver.

    Attributes
    ----------
    method : str, optional
        Algorithm, as in ``"bundle"`` or ``"paper"``.
    scene : str, optional
        Lighthouse: assumed geometry, as in ``"two-3d"``.
    artifact : Path, optional
        Scene, manifest, tags or map to use instead of those in the session.
    camera : Path, optional
        Dots: camera to use instead of the one in the session.
    speed : float, optional
        Polaris: speed of the array over the tags [m/s].
    templates : str, optional
        Polaris, method ``paper``: resolution of the templates, as in ``"36,5,80"``.
    tag : tuple of Path, optional
        Polaris: designs of the tags on a site, instead of the one in the session or ``artifact``.
    odometry_noise : float, optional
        Landmarks: random walk of the heading by odometry [deg/sqrt(m)].
    odometry_lag : float, optional
        Landmarks: time by which odometry is later than the hall sensors [ms].
    rate : float, optional
        Lighthouse: poses per second on paths, infinite for a pose at each sweep.
    setup : SceneSetup, optional
        Lighthouse: points at which a device rested, found by its standstills.
    """

    method: str | None = None
    scene: str | None = None
    artifact: Path | None = None
    camera: Path | None = None
    speed: float | None = None
    templates: str | None = None
    tag: tuple[Path, ...] | None = None
    odometry_noise: float | None = None
    odometry_lag: float | None = None
    rate: float | None = None
    setup: SceneSetup | None = None


@dataclass(frozen=True)
class SolvedSession:
    """Solution of a session, and the duration of the solver without reading and writing [s]."""

    solution: Solution
    solve_s: float


@dataclass(frozen=True)
class System:
    """Solver of the sessions of one system.

    Attributes
    ----------
    name : str
        As in the metadata of sessions.
    methods : tuple of str
        Algorithms; the first one is the default.
    options : tuple of str
        Fields of :class:`SolveRequest` that it uses besides ``method`` and ``artifact``.
    prepare : callable
        ``prepare(session, request)`` reads observations and artifact, and returns the call of the
        solver as a function without parameters, which is timed.
    estimates_scene : bool
        The solution has an artifact that later sessions can use.
    """

    name: str
    methods: tuple[str, ...]
    options: tuple[str, ...]
    prepare: Callable[[Session, SolveRequest], Callable[[], Solution]]
    estimates_scene: bool = False

    def __call__(self, session: Session, request: SolveRequest) -> SolvedSession:
        """Solve a session.

        Raises
        ------
        LocatkError
            The request has options of another system, or see the readers and the solver.
        """
        self.check(request)
        solve = self.prepare(session, request)
        start = time.perf_counter()
        solution = solve()
        return SolvedSession(solution, time.perf_counter() - start)

    def check(self, request: SolveRequest) -> None:
        """Raise InputError if the request has an option that this system does not use."""
        if request.method is not None and request.method not in self.methods:
            raise InputError(
                f"no method {request.method!r} for {self.name}",
                hint=f"Use --method {' or '.join(self.methods)}",
            )
        used = {"method", "artifact", *self.options}
        for field in fields(request):
            if field.name not in used and getattr(request, field.name) is not None:
                option = f"--{field.name.replace('_', '-')}"
                raise InputError(
                    f"{option} is not an option of {self.name}", hint=f"Leave out {option}"
                )


Solver = Callable[[Session, SolveRequest], SolvedSession]


def _prepare_lighthouse(session: Session, request: SolveRequest) -> Callable[[], Solution]:
    """Read sweeps, scene, reports of the stations, receivers and odometry."""
    sweeps = observations.read_sweeps(session)
    given = None if request.artifact is None else scene.read_scene(request.artifact)
    if given is not None and request.setup is not None:
        given = knowledge_of_stations(given)  # A scene is calibrated anew.
    own = observations.read_scene(session)
    known, conflicts = (own, []) if given is None else merge_scenes(given, own)
    reports = observations.read_station_reports(session)
    if not reports:
        reports, warnings = report_stations(sweeps)
        conflicts += warnings
    initial = station_reports.add_station_data(known, reports) or Scene()
    odometry = observations.read_odometry(session)
    imus = observations.read_imu(session)
    receivers = _rigid_devices(sweeps, observations.read_receivers(session))
    more: dict[str, Any] = {"receivers": receivers, "imu": imus} if receivers else {}
    options = _solver_options(
        lighthouse.SolveOptions, method=request.method, scene=request.scene, rate_hz=request.rate
    )
    conflicts += [
        SolverWarning("other_station_id", message)
        for message in station_reports.describe_unknown_stations(initial, reports)
    ]

    def solve() -> Solution:
        setup, prior = request.setup, initial
        rests: tuple[AssignedStandstill, ...] = ()
        standstills = _find_standstills(sweeps, receivers) if setup is not None or imus else []
        if setup is not None:
            rests = assign_standstills(setup, standstills)
            prior = add_to_prior(initial, setup, rests, is_rigid=bool(receivers))
        solution = lighthouse.solve(sweeps, prior, options, odometry=odometry, **more)
        if setup is not None and setup.has_floor:
            ups = inertial_ups(imus, solution.trajectories, standstills)
            solution = place_on_floor(solution, setup, rests, prior, ups)
        ups = inertial_ups(imus, solution.trajectories, standstills)
        solution = level_solution(solution, prior, ups)
        if initial.stations and own is not None and solution.artifact.scale != "unit":
            misfit = given_scene_warnings(own.markers, solution.trajectories)
            solution = replace(solution, warnings=(*solution.warnings, *misfit))
        if rests:
            solution = with_standstills(solution, rests)
        return replace(solution, warnings=(*conflicts, *solution.warnings))

    return solve


def _find_standstills(sweeps: Sweeps, receivers: Mapping[str, Receiver]) -> list[Standstill]:
    """Find standstills, with the names of trajectories as those of their devices.

    The photodiodes of a device without known positions are solved separately, as ``device/0``; the
    first one stands for the device.
    """
    is_single = ~np.isin(sweeps.device, [sweeps.devices.index(name) for name in receivers])
    standstills = find_standstills(sweeps)
    if not np.any(sweeps.sensor[is_single]):
        return standstills
    names = {
        name: name if name in receivers else f"{name}/{sweeps.sensor[sweeps.device == k].min()}"
        for k, name in enumerate(sweeps.devices)
        if np.any(sweeps.device == k)
    }
    return [replace(each, device=names[each.device]) for each in standstills]


def _rigid_devices(sweeps: Sweeps, receivers: Mapping[str, Receiver]) -> dict[str, Receiver]:
    """Select the receivers of devices of which several photodiodes received light.

    A single photodiode determines a position, but no orientation.
    """
    return {
        name: receivers[name]
        for index, name in enumerate(sweeps.devices)
        if name in receivers and len(set(sweeps.sensor[sweeps.device == index].tolist())) > 1
    }


def _prepare_dots(session: Session, request: SolveRequest) -> Callable[[], Solution]:
    """Read frames, manifest and camera."""
    if request.artifact is not None:
        manifest = sheets.read_manifest(request.artifact)
    else:
        attached = observations.read_manifest(session)
        if attached is None:
            raise InputError(
                "the session has no manifest of the sheet",
                file=session.path,
                hint="Import the frames with --sheet, or give the manifest as --artifact",
            )
        manifest = attached
    camera = (
        observations.read_camera(session)
        if request.camera is None
        else sheets.read_camera(request.camera)
    )
    frames = observations.read_frames(session)
    options = _solver_options(dots.SolveOptions, method=request.method, camera=camera)
    return lambda: dots.solve(frames, manifest, options)


def _prepare_polaris(session: Session, request: SolveRequest) -> Callable[[], Solution]:
    """Read magnetometer samples, tags and odometry."""
    known = _read_designs(session, request)
    samples = observations.read_magnetometers(session)
    odometry = observations.read_odometry(session)
    grid = None
    if request.templates is not None:
        grid = TemplateGrid(*(int(number) for number in request.templates.split(",")))
    options = _solver_options(
        polaris.SolveOptions, method=request.method, speed_mps=request.speed, templates=grid
    )
    return lambda: polaris.solve(samples, known, options, odometry=odometry)


def _read_designs(session: Session, request: SolveRequest) -> Tags | dict[str, Tags] | None:
    """Read the designs of the tags, by the names of their files if there are several."""
    paths = request.tag or ((request.artifact,) if request.artifact is not None else ())
    if len(paths) > 1:
        return tags.read_designs(paths)
    return tags.read_tags(paths[0]) if paths else observations.read_tags(session)


def _prepare_landmarks(session: Session, request: SolveRequest) -> Callable[[], Solution]:
    """Read hall samples, map and odometry, which this system requires."""
    floor = (
        observations.read_map(session)
        if request.artifact is None
        else maps.read_map(request.artifact)
    )
    samples = observations.read_halls(session)
    odometry = observations.read_odometry(session)
    with_odometry = {track.device for track in odometry if len(track) > 0}
    for each in samples:
        if each.device not in with_odometry:
            raise InputError(
                f"no odometry of {each.device}",
                file=session.path,
                hint="Hall sensors alone do not determine the path: also record x, y and heading "
                f"of the wheels, on /odometry/{each.device}",
            )
    noise_deg, lag_ms = request.odometry_noise, request.odometry_lag
    options = _solver_options(
        landmarks.SolveOptions,
        method=request.method,
        odometry_noise=None if noise_deg is None else math.radians(noise_deg),
        odometry_lag_s=None if lag_ms is None else 1e-3 * lag_ms,
    )
    return lambda: landmarks.solve(samples, floor, options, odometry=odometry)


def _solver_options(options_type: Callable[..., Any], **values: Any) -> Any:
    """Return the options of a solver; its defaults replace the values that are None."""
    return options_type(**{name: value for name, value in values.items() if value is not None})


SYSTEMS: dict[str, Solver] = {
    system.name: system
    for system in (
        System(
            "lighthouse",
            ("bundle", "paper"),
            ("scene", "rate", "setup"),
            _prepare_lighthouse,
            estimates_scene=True,
        ),
        System("dots", ("lattice", "paper"), ("camera",), _prepare_dots),
        System("polaris", ("joint", "paper"), ("tag", "speed", "templates"), _prepare_polaris),
        System(
            "landmarks", ("field", "paper"), ("odometry_noise", "odometry_lag"), _prepare_landmarks
        ),
    )
}
"""Solvers by the name of the system in the metadata of a session."""


def solve_session(path: Path, request: SolveRequest) -> SolvedSession:
    """Solve the session at ``path`` with the system that its metadata names.

    Raises
    ------
    FormatError
        The file is not a session of locatk, or its system is unknown.
    LocatkError
        See the readers and the solver of the system.
    """
    session = Session.open(path)
    kind = session.facts.get("kind")
    if kind != "session":
        raise FormatError(
            f"a {kind}, not a session" if kind else "not a session of locatk",
            file=path,
            hint="Give a session from `locatk capture`, `import` or `simulate`",
        )
    try:
        return find_solver(session)(session, request)
    except LocatkError as error:
        if error.file is None:  # Solvers work on arrays and do not know the file.
            error.file = str(path)
        raise


def find_solver(session: Session) -> Solver:
    """Return the solver of a session, from :data:`SYSTEMS` or from an entry point.

    Raises
    ------
    FormatError
        There is no solver for its system.
    """
    name = session.facts.get("system", "")
    if name in SYSTEMS:
        return SYSTEMS[name]
    for entry in metadata.entry_points(group=ENTRY_POINT_GROUP, name=name):
        solver: Solver = entry.load()
        return solver
    if not name:
        raise FormatError(
            "nothing in it can be solved: no sweeps, frames, magnetometers or hall sensors",
            file=session.path,
            hint="`locatk info` lists its contents; `locatk decode` decodes raw bytes again",
        )
    raise FormatError(
        f"no solver for the system {name!r}",
        file=session.path,
        hint=f"Known systems: {', '.join(SYSTEMS)}",
    )


def check_artifacts(request: SolveRequest) -> None:
    """Read artifact and camera of a request, to find errors before many sessions are solved.

    Artifacts in other formats are left to the solvers of other packages.

    Raises
    ------
    ArtifactError
        A file is damaged.
    """
    artifact = request.artifact
    if artifact is not None and artifact.suffix.lower() == ".toml":
        entry = ARTIFACTS.get(read_format(artifact))
        if entry is not None:
            entry.artifact.read(artifact)
    if request.camera is not None:
        sheets.read_camera(request.camera)
    if request.tag is not None:
        tags.read_designs(request.tag)
