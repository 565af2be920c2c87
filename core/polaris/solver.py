"""From samples of magnetometer bars to tags that were read and poses of the bar."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError, InputError
from locatk.core.polaris import passes
from locatk.core.polaris.array import Samples
from locatk.core.polaris.detection import magnets as joint
from locatk.core.polaris.detection import task
from locatk.core.polaris.detection.fit import Fitted
from locatk.core.polaris.identification.tags import Seen, identify
from locatk.core.polaris.localization import along, corrections, joined, tag_poses
from locatk.core.polaris.magnets import DetectedMagnets
from locatk.core.polaris.preprocessing import cleaned
from locatk.core.polaris.published import pipeline as paper
from locatk.core.polaris.published.templates import TemplateGrid
from locatk.core.polaris.results import HeadingCorrection, PolarisFacts, TagDetection
from locatk.core.polaris.tag import Tags, places
from locatk.core.solution import Solution, SolverWarning
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]

METHODS = ("joint", "paper")

FEWEST_SAMPLES = 20

USUAL = 1.25
"""Usual residual of a pass that is explained but for some outliers, in sigma."""

ALIKE = 1.2
"""Residuals that differ by no more say nothing of which fit is the better one."""

FEWEST_LAID = 5
"""Magnets on cells from which a grid is worth to be tried whole."""

PATH_CONTRADICTED = SolverWarning(
    "path_contradicted", "the speed or odometry given does not explain the samples of a pass"
)


@dataclass(frozen=True)
class SolveOptions:
    """How to solve.

    Attributes
    ----------
    method : str
        ``"joint"``, the default, or ``"paper"``: the published algorithm.
    speed_mps : float or None
        Speed of the array over the floor where it is known and constant; ``paper`` needs
        it. None leaves the way to odometry, else to the field itself.
    templates : TemplateGrid or None
        Resolution of the templates of ``paper``; None for the paper's.
    """

    method: str = "joint"
    speed_mps: float | None = None
    templates: TemplateGrid | None = None

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise InputError(f"no method {self.method!r} for polaris", hint="Use joint or paper")
        if self.speed_mps is not None and not 0 < self.speed_mps < 100:
            raise InputError(
                f"a speed of {self.speed_mps!r} m/s cannot be", hint="Give it in metres a second"
            )
        if self.templates is not None and self.method != "paper":
            raise InputError(
                f"method {self.method} uses no templates", hint="Give them with --method paper"
            )


def solve(
    samples: Sequence[Samples],
    tags: Tags | None = None,
    options: SolveOptions | None = None,
    *,
    odometry: Sequence[Trajectory] = (),
) -> Solution:
    """Find the tags that arrays have passed over, read them, and place the arrays by them.

    Parameters
    ----------
    samples : sequence of Samples
        One a device.
    tags : Tags or None
        The design of the tags, and where they lie. Without it magnets are found, but no
        ids.
    options : SolveOptions, optional
    odometry : sequence of Trajectory
        By device; it measures the way, and joins the poses between two tags.

    Returns
    -------
    Solution
        Its detections are what was seen in each pass, read or not (docs/formats.md).

    Raises
    ------
    InputError
        A recording is empty or too short, or the method needs a speed.
    """
    options = options or SolveOptions()
    trajectories: list[Trajectory] = []
    detections: list[TagDetection] = []
    warnings: list[SolverWarning] = []
    rejected: Counter[str] = Counter()
    heading_corrections: list[HeadingCorrection] = []
    for recording in samples:
        _check(recording)
        noise = passes.noise(recording)
        recording, faults = cleaned(recording, noise)
        noise = passes.noise(recording)  # a stuck sensor seems to have none
        warnings += faults
        driven = next((t for t in odometry if t.device == recording.device), None)
        seen, empty = _seen(recording, noise, tags, options, driven)
        if empty:
            rejected["no_magnets"] += empty
        for item in seen:
            detections.append(item.detection(recording.device, recording.time_ns))
            if item.refused:
                rejected[item.refused] += 1
        read = [item for item in seen if item.tag_id is not None]
        poses, without_place = tag_poses(recording, read, tags)
        warnings += without_place
        if poses and driven is not None:
            poses = joined(poses, driven)
        trajectories += poses
        heading_corrections += corrections(recording, read, tags)
        of_passes = dict.fromkeys(each for item in seen for each in item.sighting.warnings)
        warnings += [each.about(recording.device) for each in of_passes]
        lost = np.isnan(recording.field_t).any(axis=2).mean()
        if lost > 0:
            message = f"{100 * lost:.2g} % of the sensors' samples missing"
            warnings.append(SolverWarning("samples_missing", message).about(recording.device))
    return Solution(
        system="polaris",
        method=options.method,
        trajectories=tuple(trajectories),
        rejected=dict(rejected),
        detections=tuple(detections),
        artifact=tags,
        warnings=tuple(warnings),
        facts=PolarisFacts(tuple(heading_corrections)),
    )


def _check(recording: Samples) -> None:
    if len(recording) < FEWEST_SAMPLES:
        raise InputError(
            f"{len(recording)} samples of {recording.device}, where a tag needs "
            f"{FEWEST_SAMPLES} and more",
            hint="Record from before the tag to after it",
        )
    if not np.isfinite(recording.field_t).any():
        raise InputError(
            f"no sensor of {recording.device} gave a sample", hint="Check wiring and range"
        )
    if np.any(np.diff(recording.time_ns) < 0) or recording.time_ns[0] == recording.time_ns[-1]:
        raise InputError(
            f"the time stamps of {recording.device} do not ascend", hint="Check the recording"
        )


def _seen(
    recording: Samples,
    noise: Array,
    tags: Tags | None,
    options: SolveOptions,
    driven: Trajectory | None,
) -> tuple[list[Seen], int]:
    """What each pass over magnets has shown, in order of time, and in how many passes the
    field changed but no magnet explains it."""
    if options.method == "paper":
        if tags is None:
            raise InputError(
                "the published algorithm needs the tag",
                hint="Give it as --artifact, or import with --tag",
            )
        sightings = paper.detect_magnets(recording, tags, options.speed_mps, options.templates)
        return [seen for sighting in sightings for seen in identify(sighting, recording, tags)], 0
    path = None
    if options.speed_mps is not None:
        path = (recording.time_ns - recording.time_ns[0]) * 1e-9 * options.speed_mps
    elif driven is not None:
        path = along(driven, recording.time_ns)
    found: list[tuple[DetectedMagnets, list[Seen]]] = []
    empty = 0
    for part in passes.find(recording, noise):
        fresh = _solved(recording, part, noise, tags, path)
        if fresh is None:
            empty += 1
            continue
        if found and tags is not None and _may_be_one(found[-1], fresh, tags):
            both = passes.Pass(found[-1][0].first, fresh[0].stop)
            whole = _solved(recording, both, noise, tags, path)
            if whole is not None and whole[1][0].tag_id is not None:
                found[-1] = whole
                continue
        found.append(fresh)
    return [seen for _, group in found for seen in group], empty


def _solved(
    recording: Samples,
    part: passes.Pass,
    noise: Array,
    tags: Tags | None,
    path: Array | None,
) -> tuple[DetectedMagnets, list[Seen]] | None:
    """One pass as a sighting and what it is read as; None where there is no magnet.

    The first fit is taken that leaves a white residual and is read; else the one with the
    least residual. A way that was given but does not explain the samples (lost ones, a
    start from rest) is left for the one that the field itself tells.
    """
    tried: list[tuple[DetectedMagnets, list[Seen]]] = []
    for way in (path, None) if path is not None else (None,):
        prepared = task.prepare(recording, part, noise, tags, way)
        for fitted in joint.fits(prepared):
            try:
                sighting = joint.sighting(recording, prepared, fitted)
            except DegenerateError:
                continue
            if way is None and path is not None:
                sighting = replace(sighting, warnings=(PATH_CONTRADICTED,))
            found = sighting, identify(sighting, recording, tags)
            white = sighting.residual_sigma < joint.WHITE
            # Debris leaves peaks that no other start would explain.
            white |= way is None and sighting.usual_sigma < USUAL
            if white and (tags is None or found[1][0].tag_id is not None):
                return found
            tried.append(found)
            again = _on_grid(recording, prepared, fitted, found, tags)
            if again is not None:
                return again
    if not tried:
        return None
    least = min(found[0].residual_sigma for found in tried)
    alike = [found for found in tried if found[0].residual_sigma <= ALIKE * least]
    return min(alike, key=lambda found: (found[1][0].tag_id is None, found[0].residual_sigma))


def _on_grid(
    recording: Samples,
    prepared: task.Task,
    fitted: Fitted,
    found: tuple[DetectedMagnets, list[Seen]],
    tags: Tags | None,
) -> tuple[DetectedMagnets, list[Seen]] | None:
    """The same pass with a source on each cell of the grid that was laid, if it is read then.

    Where magnets lie closer than one and a half clearances, their fields run into one
    another, and the scan takes two for one.
    """
    sighting, seen = found
    match = seen[0].match
    if tags is None or match is None or len(match.cells) < FEWEST_LAID:
        return None
    grid = tuple((c, r) for r in range(tags.order) for c in range(tags.order))
    nominal = places(tags, grid)
    cos, sin = np.cos(match.heading_rad), np.sin(match.heading_rad)
    laid = nominal @ np.array([[cos, sin], [-sin, cos]]) + [match.x_m, match.y_m]
    laid[:, 0] /= match.scale
    try:
        again = joint.seeded(prepared, fitted, laid + sighting.origin_m)
        sighting = replace(joint.sighting(recording, prepared, again), warnings=found[0].warnings)
    except DegenerateError:
        return None
    read = identify(sighting, recording, tags)
    if read[0].tag_id is None or sighting.residual_sigma > joint.WHITE:
        return None
    return sighting, read


def _may_be_one(
    before: tuple[DetectedMagnets, list[Seen]],
    after: tuple[DetectedMagnets, list[Seen]],
    tags: Tags,
) -> bool:
    """Whether two passes may be the ends of one tag: neither is read, and they are near."""
    if any(seen.tag_id is not None for seen in (*before[1], *after[1])):
        return False
    first, second = before[0], after[0]
    gap = max(second.first - first.stop, 0)
    step = np.ptp(first.path_m) / max(len(first.path_m) - 1, 1)
    return bool(gap * step < 1.5 * tags.order * tags.spacing_m)
