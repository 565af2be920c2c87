"""Outcome of solving one session: a report or a failure, small enough to travel between processes.

A report lists as *losses* the devices and observations that the solution leaves unsolved.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from locatk.core import errors
from locatk.core.errors import LocatkError, system_hint
from locatk.core.landmarks.results import LandmarkDetection, RobotFacts
from locatk.core.lighthouse.scene import Scene
from locatk.core.polaris.results import TagDetection
from locatk.core.solution import Solution, SolverWarning
from locatk.core.trajectory import PROVISIONAL_PROBABILITY, Trajectory


@dataclass(frozen=True)
class DeviceSummary:
    """Number of poses of a device, and their uncertainty.

    Attributes
    ----------
    device : str
    poses : int
    median_sigma : tuple of 4 float
        Median standard deviations of x, y, z [m] and heading [rad]; nan if unknown.
    min_probability : float
        Probability of the least probable pose; nan if unknown.
    """

    device: str
    poses: int
    median_sigma: tuple[float, float, float, float]
    min_probability: float


@dataclass(frozen=True)
class SolveReport:
    """Summary of a solved session.

    Attributes
    ----------
    session, output : str
        Locations as the user gave them.
    system, method : str
    solve_s : float or None
        Duration of the solver [s]; None if the solution existed already.
    devices : tuple of DeviceSummary
        In the order of the solution.
    rejected : dict of str to int
        Number of observations that were not used, by reason.
    detections : tuple
        As in :class:`locatk.core.solution.Solution`. A report that was made without detections
        contains those of tags and landmarks only.
    facts : LandmarkFacts, PolarisFacts or None
        As in the solution of landmarks and polaris; None for other systems, and for landmarks
        without detections.
    warnings : tuple of SolverWarning
        As in :class:`locatk.core.solution.Solution`.
    losses : tuple of SolverWarning
        Devices and observations that are unsolved; the codes are ``no_pose``,
        ``not_localised``, ``provisional``, ``not_read``, ``refused``, ``misread``,
        ``few_poses`` and ``doubled_channel``.
    is_metric : bool
        False if the poses are in units of a scene without scale.
    """

    session: str
    output: str
    system: str
    method: str
    solve_s: float | None
    devices: tuple[DeviceSummary, ...]
    rejected: dict[str, int]
    detections: tuple[Any, ...]
    facts: Any
    warnings: tuple[SolverWarning, ...]
    losses: tuple[SolverWarning, ...]
    is_metric: bool

    @property
    def poses(self) -> int:
        """Number of accepted poses over all devices."""
        return sum(device.poses for device in self.devices)

    @property
    def is_resumed(self) -> bool:
        """True if an earlier run solved the session with the same options and version."""
        return self.solve_s is None


@dataclass(frozen=True)
class SolveFailure:
    """Session that could not be solved.

    Attributes
    ----------
    session : str
        Location as the user gave it.
    error : LocatkError
        One of the classes in :mod:`locatk.core.errors`, with the file names of the user.
    traceback : str
        Traceback of the original exception; empty if its process died.
    is_internal : bool
        The exception is an error of the program, which should be reported.
    """

    session: str
    error: LocatkError
    traceback: str = ""
    is_internal: bool = False


Outcome = SolveReport | SolveFailure


def summarize(
    session: str,
    output: str,
    solution: Solution,
    solve_s: float | None = None,
    *,
    with_detections: bool = True,
) -> SolveReport:
    """Return the report of a solution that was written to ``output``.

    Without detections it contains only those of tags and landmarks, which are few.
    """
    has_table = solution.system in ("polaris", "landmarks")
    has_facts = solution.system == "polaris" or (with_detections and solution.system == "landmarks")
    return SolveReport(
        session=session,
        output=output,
        system=solution.system,
        method=solution.method,
        solve_s=solve_s,
        devices=tuple(
            DeviceSummary(track.device, len(track), _median_sigma(track), track.min_probability)
            for track in solution.trajectories
        ),
        rejected=solution.rejected,
        detections=solution.detections if with_detections or has_table else (),
        facts=solution.facts if has_facts else None,
        warnings=tuple(solution.warnings),
        losses=find_losses(solution),
        is_metric=not (isinstance(solution.artifact, Scene) and solution.artifact.scale == "unit"),
    )


def _median_sigma(track: Trajectory) -> tuple[float, float, float, float]:
    """Return the medians of the known standard deviations of x, y, z and heading."""
    columns = [column[np.isfinite(column)] for column in track.sigma[:, [0, 1, 2, 5]].T]
    x, y, z, heading = (
        float(np.median(column)) if len(column) else float("nan") for column in columns
    )
    return x, y, z, heading


def portable_error(error: LocatkError, names: dict[str, str]) -> LocatkError:
    """Return a copy with paths of temporary files replaced by the names of the user.

    Errors travel between processes. A class of another package may need other parameters, so the
    copy has the next base class in :mod:`locatk.core.errors`.
    """

    def rename(text: str | None) -> str | None:
        for path, name in sorted(names.items(), reverse=True):
            text = text and text.replace(path, name)
        return text

    error_type = next(base for base in type(error).__mro__ if base.__module__ == errors.__name__)
    copy: LocatkError = error_type(
        rename(error.message) or "",
        file=rename(error.file),
        where=error.where,
        hint=rename(error.hint or system_hint(error)),
    )
    return copy


# ---- losses


def find_losses(solution: Solution) -> tuple[SolverWarning, ...]:
    """List devices without a pose, and observations that gave none."""
    losses = [
        SolverWarning("no_pose", f"no pose for {track.device}")
        for track in solution.trajectories
        if len(track) == 0
    ]
    if solution.system == "landmarks":
        losses += _unlocalized_robots(solution)
    if not losses and not solution.trajectories:
        losses = [SolverWarning("no_pose", "no pose at all")]
    if solution.system == "polaris":
        losses += _refused_tags(solution.detections)
    elif solution.system == "landmarks":
        losses += _refused_landmarks(solution.detections)
    elif solution.poses:
        losses += _minority_of_poses(solution)
    if unused := solution.rejected.get("sweep_of_doubled_channel"):
        text = f"{_count(unused, 'sweep')} of channels with more than one station not used"
        losses.append(SolverWarning("doubled_channel", text))
    return tuple(losses)


def _unlocalized_robots(solution: Solution) -> list[SolverWarning]:
    """List the robots whose position on the map is unknown."""
    losses = []
    robots: dict[str, RobotFacts] = {} if solution.facts is None else solution.facts.robots
    for device, facts in robots.items():
        if facts.localised:
            if facts.provisional:
                losses.append(_provisional_poses(device, facts))
            continue
        if solution.artifact is None:
            reason = ": no map of the floor"
        elif not facts.landmarks_seen:
            reason = ": no landmark was detected"
        elif facts.probability is not None and facts.probability < PROVISIONAL_PROBABILITY:
            reason = f": the likeliest position has a probability of {facts.probability:.2g}"
        else:
            reason = ""
        losses.append(SolverWarning("not_localised", f"{device} is not localised{reason}"))
    return losses


def _provisional_poses(device: str, facts: RobotFacts) -> SolverWarning:
    """Return the loss of a robot that may be on another floor or in another cell."""
    text = f"the poses of {device} are provisional: they are right with a probability of "
    text += (
        f"{math.floor(1e5 * facts.probability) / 1e5:.5g}"
        if facts.probability is not None
        else "unknown"
    )
    return SolverWarning("provisional", f"{text}; visit more landmarks")


def _refused_tags(detections: Sequence[TagDetection]) -> list[SolverWarning]:
    """Count the tags without an id, by reason."""
    reasons = Counter(tag.refused or "unknown" for tag in detections if tag.tag_id is None)
    return [
        SolverWarning("not_read", f"{_count(n, 'tag')} not read ({_words(reason)})")
        for reason, n in reasons.items()
    ]


def _refused_landmarks(detections: Sequence[LandmarkDetection]) -> list[SolverWarning]:
    """Count the refused landmarks, by reason; misread ones last."""
    reasons = Counter(landmark.refused for landmark in detections if landmark.refused)
    misread = reasons.pop("misread", 0)
    losses = [
        SolverWarning("refused", f"{_count(n, 'landmark')} refused ({_words(reason)})")
        for reason, n in reasons.items()
    ]
    if misread:
        verb = "differs" if misread == 1 else "differ"
        text = f"{_count(misread, 'landmark')} {verb} from the map (misread, or installed wrongly)"
        losses.append(SolverWarning("misread", text))
    return losses


def _minority_of_poses(solution: Solution) -> list[SolverWarning]:
    """Return a loss if more frames or epochs gave no pose than gave one; a few are normal."""
    prefix, unit = ("", "frames") if solution.system == "dots" else ("moment_", "epochs")
    reasons = {
        reason: count for reason, count in solution.rejected.items() if reason.startswith(prefix)
    }
    unsolved = sum(reasons.values())
    if unsolved <= solution.poses:
        return []
    main_reason = max(reasons, key=reasons.__getitem__).removeprefix(prefix)
    total = unsolved + solution.poses
    text = f"{unsolved} of {total} {unit} gave no pose (most: {_words(main_reason)})"
    return [SolverWarning("few_poses", text)]


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"


def _words(reason: str) -> str:
    return reason.replace("_", " ")
