"""What `locatk solve` tells people beside the poses: what a system saw, and what it did not."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING

from locatk.cli import console

if TYPE_CHECKING:
    from locatk.core.landmarks.results import LandmarkDetection, RobotFacts
    from locatk.core.polaris.results import TagDetection
    from locatk.core.solution import Solution

MOST_LANDMARKS = 40
"""So many sightings are listed for people; ``--json`` holds them all."""


def lost(solution: Solution) -> list[str]:
    """What is left unsolved: devices without a pose, and what was seen but not read."""
    losses = [f"no pose for {t.device}" for t in solution.trajectories if len(t) == 0]
    if solution.system == "landmarks":
        losses += _not_localised(solution)
    if not losses and not solution.trajectories:
        losses = ["no pose at all"]
    if solution.system == "polaris":
        unread = [seen for seen in solution.detections if seen.tag_id is None]
        losses += _refused(unread, "tag", "not read")
    elif solution.system == "landmarks":
        said = [seen for seen in solution.detections if seen.refused]
        misread = [seen for seen in said if seen.refused == "misread"]
        refused = [seen for seen in said if seen.refused != "misread"]
        losses += _refused(refused, "sighting", "refused")
        if misread:
            what = "landmark is not that" if len(misread) == 1 else "landmarks are not those"
            losses.append(f"{len(misread)} {what} of the map (misread, or laid wrongly)")
    elif solution.poses:
        losses += _most(solution)
    return losses


def _most(solution: Solution) -> list[str]:
    """Whether most frames, or most moments of sweeps, gave no pose; a few are no loss."""
    reasons = {
        reason: count
        for reason, count in solution.rejected.items()
        if solution.system == "dots" or reason.startswith("moment_")
    }
    without = sum(reasons.values())
    if without <= solution.poses:
        return []
    what = "frames" if solution.system == "dots" else "moments"
    why = max(reasons, key=reasons.__getitem__).removeprefix("moment_").replace("_", " ")
    return [f"{without} of {without + solution.poses} {what} gave no pose (most: {why})"]


def _not_localised(solution: Solution) -> list[str]:
    """Robots that do not know where on the map they are, and why."""
    losses = []
    robots: dict[str, RobotFacts] = {} if solution.facts is None else solution.facts.robots
    for device, facts in robots.items():
        if facts.localised:
            continue
        if solution.artifact is None:
            why = ": no map of the floor"
        elif not facts.landmarks_seen:
            why = ": no landmark was seen"
        elif facts.probability is not None:
            why = f": the likeliest place has a probability of {facts.probability:.2g}"
        else:
            why = ""
        losses.append(f"{device} is not localised{why}")
    return losses


def _refused(seen: Sequence[TagDetection | LandmarkDetection], what: str, how: str) -> list[str]:
    """How many were refused, and why."""
    reasons = Counter(found.refused or "?" for found in seen)
    return [
        f"{n} {what}{'' if n == 1 else 's'} {how} ({why.replace('_', ' ')})"
        for why, n in reasons.items()
    ]


def seen(solution: Solution) -> str | None:
    """A table of what the system saw; None where it saw nothing, or has no such table."""
    from locatk.formats.report import detections

    if solution.system not in ("polaris", "landmarks") or not solution.detections:
        return None
    if solution.system == "polaris":
        found = detections.tag_table(solution.detections)
    else:
        found = detections.landmark_table(solution.detections, MOST_LANDMARKS)
    table = console.table(found.header, found.rows)
    return f"{table}\n... and {found.omitted} more: see --json" if found.omitted else table
