"""The table of systems: how a session of each is read, solved and its artifact kept.

Open to others through the entry-point group ``locatk.systems``, whose entries point to
a function like :func:`lighthouse`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from locatk.core.errors import FormatError, InputError, LocatkError

if TYPE_CHECKING:
    from locatk.core.lighthouse.receiver import Receiver
    from locatk.core.lighthouse.recording import Sweeps
    from locatk.core.solution import Solution
    from locatk.formats.sessions.reader import Session


@dataclass(frozen=True)
class Request:
    """What the user asked of a solver; None where he leaves it to the solver."""

    method: str | None = None
    scene: str | None = None
    artifact: Path | None = None
    camera: Path | None = None
    speed: float | None = None
    templates: str | None = None


@dataclass(frozen=True)
class Solved:
    """A solution, and the seconds that solving alone took."""

    solution: Solution
    solve_s: float


Solver = Callable[["Session", Request], Solved]


def lighthouse(session: Session, request: Request) -> Solved:
    """Solve a session of Lighthouse sweeps."""
    from locatk.core import lighthouse
    from locatk.core.lighthouse.scene import Scene
    from locatk.core.solution import SolverWarning
    from locatk.formats.artifacts import scene as artifacts
    from locatk.formats.sessions import observations
    from locatk.formats.sessions import station_reports as heard

    _check(
        request, "lighthouse", methods=("bundle", "paper"), refused=("camera", "speed", "templates")
    )
    sweeps = observations.read_sweeps(session)
    given = None if request.artifact is None else artifacts.read_scene(request.artifact)
    # Whatever scene it is, the stations know best how they were made.
    sent = observations.read_station_reports(session)
    scene = heard.add_station_data(given or observations.read_scene(session), sent) or Scene()
    odometry = observations.read_odometry(session)
    rigid = _rigid(sweeps, observations.read_receivers(session))
    more: dict[str, Any] = {"receivers": rigid} if rigid else {}
    options = _given(lighthouse.SolveOptions, {"method": request.method, "scene": request.scene})
    start = time.perf_counter()
    solution = lighthouse.solve(sweeps, scene, options, odometry=odometry, **more)
    solve_s = time.perf_counter() - start
    other_stations = [
        SolverWarning("other_station_id", message)
        for message in heard.describe_unknown_stations(scene, sent)
    ]
    warnings = (*other_stations, *solution.warnings)
    return Solved(replace(solution, warnings=warnings), solve_s)


def _rigid(sweeps: Sweeps, receivers: Mapping[str, Receiver]) -> dict[str, Receiver]:
    """Receivers of the devices of which several photodiodes have seen light; of the others
    there is nothing but the place of the one that did."""
    return {
        name: receivers[name]
        for number, name in enumerate(sweeps.devices)
        if name in receivers and len(set(sweeps.sensor[sweeps.device == number].tolist())) > 1
    }


def dots(session: Session, request: Request) -> Solved:
    """Solve a session of camera frames of a dot sheet."""
    from locatk.core import dots as system
    from locatk.formats.artifacts import sheets
    from locatk.formats.sessions import observations

    _check(request, "dots", methods=("lattice", "paper"), refused=("scene", "speed", "templates"))
    if request.artifact is not None:
        manifest = sheets.read_manifest(request.artifact)
    else:
        attached = observations.read_manifest(session)
        if attached is None:
            raise InputError(
                "no manifest of the sheet",
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
    options = _given(system.SolveOptions, {"method": request.method, "camera": camera})
    start = time.perf_counter()
    solution = system.solve(frames, manifest, options)
    return Solved(solution, time.perf_counter() - start)


def polaris(session: Session, request: Request) -> Solved:
    """Solve a session of a magnetometer array over tags."""
    from locatk.core import polaris as system
    from locatk.core.polaris.published.templates import TemplateGrid
    from locatk.formats.artifacts import tags
    from locatk.formats.sessions import observations

    _check(request, "polaris", methods=("joint", "paper"), refused=("scene", "camera"))
    given = request.artifact
    known = observations.read_tags(session) if given is None else tags.read_tags(given)
    samples = observations.read_magnetometers(session)
    odometry = observations.read_odometry(session)
    grid = None
    if request.templates is not None:
        grid = TemplateGrid(*(int(number) for number in request.templates.split(",")))
    options = _given(
        system.SolveOptions,
        {"method": request.method, "speed_mps": request.speed, "templates": grid},
    )
    start = time.perf_counter()
    solution = system.solve(samples, known, options, odometry=odometry)
    return Solved(solution, time.perf_counter() - start)


def landmarks(session: Session, request: Request) -> Solved:
    """Solve a session of hall sensors over a floor of landmarks."""
    from locatk.core import landmarks as system
    from locatk.formats.artifacts import maps
    from locatk.formats.sessions import observations

    _check(
        request,
        "landmarks",
        methods=("field", "paper"),
        refused=("scene", "camera", "speed", "templates"),
    )
    given = request.artifact
    floor = observations.read_map(session) if given is None else maps.read_map(given)
    samples = observations.read_halls(session)
    odometry = observations.read_odometry(session)
    driven = {trajectory.device for trajectory in odometry if len(trajectory) > 0}
    for each in samples:
        if each.device not in driven:
            raise InputError(
                f"no odometry of {each.device}",
                file=session.path,
                hint=f"Four sensors alone do not tell the way: record x, y and heading of the "
                f"wheels too, on /odometry/{each.device}",
            )
    options = _given(system.SolveOptions, {"method": request.method})
    start = time.perf_counter()
    solution = system.solve(samples, floor, options, odometry=odometry)
    return Solved(solution, time.perf_counter() - start)


SYSTEMS: dict[str, Solver] = {
    "lighthouse": lighthouse,
    "dots": dots,
    "polaris": polaris,
    "landmarks": landmarks,
}


def solve_session(path: Path, request: Request) -> Solved:
    """Solve the session at ``path`` with the system that its metadata names.

    Raises
    ------
    FormatError
        It is no session of locatk, or nobody knows its system.
    LocatkError
        Whatever reading and solving raise.
    """
    from locatk.formats.sessions.reader import Session

    session = Session.open(path)
    kind = session.facts.get("kind")
    if kind != "session":
        raise FormatError(
            f"a {kind}, not a session" if kind else "not a session of locatk",
            file=path,
            hint="Give a session made by `locatk capture`, `import` or `simulate`",
        )
    try:
        return _solver(session)(session, request)
    except LocatkError as error:
        if error.file is None:  # a solver knows arrays, not files
            error.file = str(path)
        raise


def _solver(session: Session) -> Solver:
    name = session.facts.get("system", "")
    if name in SYSTEMS:
        return SYSTEMS[name]
    from importlib.metadata import entry_points

    for entry in entry_points(group="locatk.systems", name=name):
        solver: Solver = entry.load()
        return solver
    raise FormatError(
        f"no solver for the system {name!r}",
        file=session.path,
        hint=f"Known systems: {', '.join(SYSTEMS)}",
    )


def check_given(request: Request) -> None:
    """Read the artifact and the camera that were given, so that a broken one is found before
    many sessions are solved with it.

    Artifacts that are not of locatk are for the solvers that know them.

    Raises
    ------
    ArtifactError
    """
    from locatk.formats.artifacts import maps, sheets, tags
    from locatk.formats.artifacts import scene as artifacts
    from locatk.formats.artifacts.schema import read_format

    readers: dict[str, Callable[[Path], Any]] = {
        artifacts.SCENE_FORMAT: artifacts.read_scene,
        sheets.MANIFEST_FORMAT: sheets.read_manifest,
        tags.TAG_FORMAT: tags.read_tags,
        maps.MAP_FORMAT: maps.read_map,
    }
    given = request.artifact
    if given is not None and given.suffix.lower() == ".toml":
        reader = readers.get(read_format(given))
        if reader is not None:
            reader(given)
    if request.camera is not None:
        sheets.read_camera(request.camera)


def _check(
    request: Request, system: str, *, methods: tuple[str, ...], refused: tuple[str, ...]
) -> None:
    """Refuse what was asked of a solver that means nothing to it."""
    if request.method is not None and request.method not in methods:
        raise InputError(
            f"no method {request.method!r} for {system}",
            hint=f"Use --method {' or '.join(methods)}",
        )
    for name in refused:
        if getattr(request, name) is not None:
            raise InputError(f"--{name} means nothing to {system}", hint=f"Leave out --{name}")


def _given(options: Callable[..., Any], values: dict[str, Any]) -> Any:
    """``options`` from the values that the user gave, its own defaults for the rest."""
    return options(**{name: value for name, value in values.items() if value is not None})
