"""Functions of ``import locatk``: open, solve, evaluate, simulate."""

from __future__ import annotations

import importlib
import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, Literal

from locatk.core.errors import InputError
from locatk.core.evaluation import Evaluation, EvaluationOptions, pair_devices
from locatk.core.evaluation import evaluate as evaluate_pairs
from locatk.core.trajectory import Trajectory
from locatk.formats.api.session import Session
from locatk.formats.api.solution import Solution, require_poses
from locatk.formats.importers.poses import trajectories as files
from locatk.formats.pipeline import provenance
from locatk.formats.pipeline.systems import SYSTEMS, SolveRequest, solve_session
from locatk.formats.sessions.reader import Session as StoredSession

Location = str | os.PathLike[str]
Poses = Solution | Location | Trajectory | Sequence[Trajectory] | Mapping[str, Trajectory]
"""What poses are taken from: a solution, a file, or trajectories."""


def open(path: Location) -> Session | Solution:
    """Open a session or a solution.

    Parameters
    ----------
    path : path
        An MCAP file of ``locatk``.

    Returns
    -------
    Session or Solution

    Raises
    ------
    MissingDataError, FormatError
        There is no such file, or it is no MCAP file.
    """
    if StoredSession.open(path).facts.get("kind") == "solution":
        return Solution.read(path)
    return Session(path)


def solve(session: Session | Location, **options: Any) -> Solution:
    """Solve a session into poses.

    Parameters
    ----------
    session : Session or path
    **options
        Those of ``locatk solve``: ``artifact``, ``camera`` and ``tag`` (paths), ``method``,
        ``scene`` (as in ``"two-3d"``), ``speed`` [m/s], ``rate`` [Hz] and more
        (:class:`locatk.formats.pipeline.systems.SolveRequest`).

    Returns
    -------
    Solution

    Raises
    ------
    InputError
        An option is unknown, or does not apply to the system of the session.
    LocatkError
        The session cannot be read or solved.
    """
    known = [field.name for field in fields(SolveRequest) if field.name != "setup"]
    unknown = [name for name in options if name not in known]
    if unknown:
        raise InputError(f"no option {unknown[0]!r}", hint=f"Known options: {', '.join(known)}")
    for name in ("artifact", "camera"):
        if options.get(name) is not None:
            options[name] = Path(options[name])
    if options.get("tag") is not None:
        tags = options["tag"]
        options["tag"] = tuple(map(Path, [tags] if isinstance(tags, str | os.PathLike) else tags))
    path = session.path if isinstance(session, Session) else Path(session)
    solved = solve_session(path, SolveRequest(**options))
    facts = provenance.source_facts(path)
    return Solution(solved.solution, path.name, facts, StoredSession.open(path))


def evaluate(
    estimate: Poses,
    truth: Poses | Session | None = None,
    *,
    align: str = "none",
    offset_s: float | Literal["auto"] = 0.0,
    names: Mapping[str, str] | None = None,
    **options: Any,
) -> Evaluation:
    """Compare poses with reference poses.

    Parameters
    ----------
    estimate : Solution, path, Trajectory, or several
    truth : Solution, Session, path, Trajectory, or several, optional
        By default the truth in the session of a solution.
    align : str
        One of :data:`locatk.core.evaluation.ALIGNMENTS`.
    offset_s : float or "auto"
        Added to the stamps of the estimate.
    names : mapping of str to str, optional
        Device in the truth of each device of the estimate. Devices without truth are left out,
        with a warning.
    **options
        Those of :class:`locatk.core.evaluation.EvaluationOptions`.

    Raises
    ------
    InputError
        There is no truth for the poses.
    DegenerateError
        The poses do not determine the alignment or the offset.
    """
    if truth is None:
        if isinstance(estimate, str | os.PathLike):
            estimate = Solution.read(estimate)
        if not isinstance(estimate, Solution) or estimate.session is None:
            raise InputError("no truth is given, and there is no session that contains it")
        truth = Session(estimate.session.path)
    estimated, true = _trajectories(estimate, "estimate"), _trajectories(truth, "truth")
    pairs, unpaired = pair_devices(estimated, true, names or {})
    if not pairs:
        raise InputError(
            "no device has truth", hint="Name the devices: names={'in estimate': 'in truth'}"
        )
    if unpaired:
        warnings.warn(f"no truth for {', '.join(unpaired)}", stacklevel=2)
    return evaluate_pairs(pairs, EvaluationOptions(align=align, offset_s=offset_s, **options))


def _trajectories(source: Poses | Session, role: files.Role) -> list[Trajectory]:
    """Return the trajectories of a source of poses."""
    if isinstance(source, Solution):
        return list(require_poses(source).values())
    if isinstance(source, Session):
        return list(source.truth.values())
    if isinstance(source, Trajectory):
        return [source]
    if isinstance(source, str | os.PathLike):
        return files.read(Path(source), role=role)
    return list(source.values()) if isinstance(source, Mapping) else list(source)


SIMULATED_ARTIFACTS = ("landmarks", "polaris")
"""Systems whose simulators take an artifact."""


def simulate(
    system: str,
    path: Location,
    settings: Mapping[str, Mapping[str, Any]] | Location | None = None,
    *,
    artifact: Location | None = None,
    seed: int | None = None,
    overwrite: bool = False,
) -> Session:
    """Simulate a session with known truth.

    Parameters
    ----------
    system : str
        ``"lighthouse"``, ``"polaris"``, ``"dots"`` or ``"landmarks"``.
    path : path
        The session to write.
    settings : mapping or path, optional
        Tables and keys of the file that ``locatk simulate SYSTEM --print-config`` prints, as in
        ``{"robots": {"count": 20}}``, or such a file.
    artifact : path, optional
        Landmarks: the map (map.toml), which is required. Polaris: the tags (tag.toml), by default
        one of the authors.
    seed : int, optional
        Seed of all random numbers, in place of that of the settings.
    overwrite : bool
        Replace an existing file.

    Raises
    ------
    InputError
        The system is unknown, or a setting is unknown, out of range or contradicts another; the
        artifact is missing, or not one of this system.
    OutputExistsError
        ``path`` exists and ``overwrite`` is false.
    """
    if system not in SYSTEMS:
        raise InputError(f"no system {system!r}", hint=f"Known systems: {', '.join(SYSTEMS)}")
    module = importlib.import_module(f"locatk.formats.simulation.{system}")
    if isinstance(settings, str | os.PathLike):
        chosen = module.CONFIG.read(settings)
    else:
        chosen = module.CONFIG.from_tables(settings or {})
    own = {} if seed is None else {"random.seed": seed}
    if artifact is None and system == "landmarks":
        hint = "Write one by `locatk map design`, and give it as artifact"
        raise InputError("landmarks are simulated on a map", hint=hint)
    if artifact is not None and system not in SIMULATED_ARTIFACTS:
        raise InputError(f"{system} is simulated without an artifact", hint="Use the settings")
    artifacts = () if artifact is None else (artifact,)
    module.write_simulation(path, module.CONFIG.merge(chosen, own), *artifacts, overwrite=overwrite)
    return Session(path)
