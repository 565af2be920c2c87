"""What `locatk solve` tells people beside the poses: what a system saw, and what it did not."""

from __future__ import annotations

import math
from collections import Counter
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from locatk.cli import console

if TYPE_CHECKING:
    from locatk.core.solution import Solution

DEGREES = math.degrees(1)

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
        unread = [seen for seen in solution.detections if seen["tag_id"] is None]
        losses += _refused(unread, "tag", "not read")
    elif solution.system == "landmarks":
        refused = [seen for seen in solution.detections if seen["refused"]]
        losses += _refused(refused, "sighting", "refused")
    return losses


def _not_localised(solution: Solution) -> list[str]:
    """Robots that do not know where on the map they are, and why."""
    losses = []
    for device, told in solution.facts.get("robots", {}).items():
        if told["localised"]:
            continue
        if solution.artifact is None:
            why = ": no map of the floor"
        elif not told["landmarks_seen"]:
            why = ": no landmark was seen"
        elif told.get("probability") is not None:
            why = f": the likeliest place has a probability of {told['probability']:.2g}"
        else:
            why = ""
        losses.append(f"{device} is not localised{why}")
    return losses


def _refused(seen: list[dict[str, Any]], what: str, how: str) -> list[str]:
    """How many were refused, and why."""
    reasons = Counter(found["refused"] or "?" for found in seen)
    return [
        f"{n} {what}{'' if n == 1 else 's'} {how} ({why.replace('_', ' ')})"
        for why, n in reasons.items()
    ]


def seen(solution: Solution) -> str | None:
    """A table of what the system saw; None where it saw nothing, or has no such table."""
    tables = {"polaris": tags_seen, "landmarks": landmarks_seen}
    table = tables.get(solution.system)
    return table(solution.detections) if table and solution.detections else None


def tags_seen(detections: list[dict[str, Any]]) -> str:
    """Tags as the array saw them, in its own frame."""
    header = ("tag", "margin [steps]", "magnets", "x [mm]", "y [mm]", "heading [deg]")
    sigmas = ("sigma x", "sigma y [mm]", "sigma heading [deg]")
    rows = [
        (
            "-" if found["tag_id"] is None else found["tag_id"],
            _number(found["margin"], 1, ".2f"),
            len(found["magnets"]),
            *_pose(found),
        )
        for found in detections
    ]
    return console.table((*header, *sigmas), rows)


def landmarks_seen(detections: list[dict[str, Any]]) -> str:
    """Landmarks, and the robot in the frame of each."""
    shown = detections[:MOST_LANDMARKS]
    robots = len({found["device"] for found in detections}) > 1
    refused = any(found["refused"] for found in shown)
    header = (
        "time (UTC)",
        *(["robot"] if robots else []),
        "cell",
        "pattern",
        "sure [%]",
        *("x [mm]", "y [mm]", "heading [deg]"),
        *("sigma x", "sigma y [mm]", "sigma heading [deg]"),
        *(["refused"] if refused else []),
    )
    rows = [
        (
            _clock(found["time_s"]),
            *([found["device"]] if robots else []),
            "-" if found["cell"] is None else ",".join(map(str, found["cell"])),
            found["pattern"] or "-",
            _sure(found["probability"]),
            *_pose(found),
            *([(found["refused"] or "").replace("_", " ")] if refused else []),
        )
        for found in shown
    ]
    more = len(detections) - len(shown)
    table = console.table(header, rows)
    return f"{table}\n... and {more} more: see --json" if more else table


def _pose(found: dict[str, Any]) -> tuple[str, ...]:
    return (
        _number(found["x_m"], 1e3, ".2f"),
        _number(found["y_m"], 1e3, ".2f"),
        _number(found["heading_rad"], DEGREES, ".2f"),
        _number(found["sigma_x_m"], 1e3, ".2g"),
        _number(found["sigma_y_m"], 1e3, ".2g"),
        _number(found["sigma_heading_rad"], DEGREES, ".2g"),
    )


def _sure(probability: float | None) -> str:
    """In percent; what is not wholly sure is not rounded to 100."""
    if probability is None or not math.isfinite(probability):
        return "-"
    percent = 100 * probability
    return f"{percent:.1f}" if percent < 99.95 else "100" if percent >= 99.9995 else ">99.9"


def _clock(time_s: float) -> str:
    try:
        return datetime.fromtimestamp(time_s, UTC).strftime("%H:%M:%S.%f")[:-3]
    except (OverflowError, ValueError, OSError):
        return f"{time_s:g} s"


def _number(value: float | None, scale: float, form: str) -> str:
    if value is None or not math.isfinite(value):
        return "-"
    return format(value * scale, form)
