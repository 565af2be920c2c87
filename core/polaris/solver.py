"""Pipeline of the Polaris solver, from samples of magnetometer arrays to tags and poses."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.polaris.array import Samples
from locatk.core.polaris.detection.magnets import detect_magnets
from locatk.core.polaris.given_path import (
    compare_path,
    contradicted_scale,
    contradiction_warning,
)
from locatk.core.polaris.identification.tags import (
    IdentifiedPass,
    identify_pass,
    identify_tags,
    may_be_one_tag,
)
from locatk.core.polaris.localization import Localization, distance_along, localize
from locatk.core.polaris.preprocessing import (
    PassRange,
    PreprocessedSamples,
    find_passes,
    is_no_pass,
    least_magnet_field,
    preprocess,
)
from locatk.core.polaris.published import pipeline as published
from locatk.core.polaris.published.templates import TemplateGrid
from locatk.core.polaris.results import PolarisFacts, TagDetection
from locatk.core.polaris.tag import Tags
from locatk.core.solution import Solution, SolverWarning, add_counts
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]

METHODS = ("joint", "paper")


@dataclass(frozen=True)
class SolveOptions:
    """Options of the solver.

    Attributes
    ----------
    method : str
        ``"joint"`` (default) or ``"paper"`` (the published algorithm).
    speed_mps : float or None
        Speed of the array over the floor, if it is known and constant; ``paper`` needs it. Without
        it, the path is taken from odometry, or else estimated from the field.
    templates : TemplateGrid or None
        Resolution of the templates of ``paper``; None for the paper's.
    """

    method: str = "joint"
    speed_mps: float | None = None
    templates: TemplateGrid | None = None

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise InputError(
                f"unknown method {self.method!r}", hint=f"choose one of {', '.join(METHODS)}"
            )
        if self.speed_mps is not None and not 0 < self.speed_mps < 100:
            raise InputError(
                f"impossible speed {self.speed_mps!r} m/s", hint="Give it in metres per second"
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
    """Detect and identify the tags that arrays passed over, and localize the arrays by them.

    Parameters
    ----------
    samples : sequence of Samples
        One per device.
    tags : Tags or None
        Design of the tags, and their positions on the site. Without it, magnets are detected but
        not identified.
    options : SolveOptions, optional
    odometry : sequence of Trajectory
        At most one per device, selected by its name. It measures the path, and joins the poses
        between two tags.

    Returns
    -------
    Solution
        Its detections are the tags of each pass, identified or refused (docs/formats.md).

    Raises
    ------
    InputError
        A recording is empty or too short, or the method needs a speed or the tags.
    """
    options = options or SolveOptions()
    results = [_solve_array(recording, tags, options, odometry) for recording in samples]
    return Solution(
        system="polaris",
        method=options.method,
        trajectories=tuple(t for each in results for t in each.localization.trajectories),
        rejected=add_counts(*(each.rejected for each in results)),
        detections=tuple(d for each in results for d in each.detections),
        artifact=tags,
        warnings=tuple(w for each in results for w in each.warnings),
        facts=PolarisFacts(
            tuple(c for each in results for c in each.localization.heading_corrections)
        ),
    )


@dataclass(frozen=True)
class _ArrayResult:
    """Tags and poses of one array."""

    localization: Localization
    detections: list[TagDetection]
    rejected: Counter[str]
    warnings: list[SolverWarning]


def _solve_array(
    recording: Samples, tags: Tags | None, options: SolveOptions, odometry: Sequence[Trajectory]
) -> _ArrayResult:
    """Preprocess, detect, identify and localize for one array."""
    driven = next((t for t in odometry if t.device == recording.device), None)
    preprocessed = preprocess(recording)
    recording = preprocessed.samples
    rejected: Counter[str] = Counter()
    contradiction = None
    if options.method == "paper":
        passes = _identify_published(recording, tags, options)
    else:
        path_m = _known_path(recording, options.speed_mps, driven)
        passes, counts = _identify_passes(preprocessed, tags, path_m)
        rejected.update(counts)
        if path_m is not None:
            contradiction = contradiction_warning(
                (compare_path(path_m, each.observations[0]) for each in passes), options.speed_mps
            )
    observations = [each for part in passes for each in part.observations]
    rejected.update(each.refused for each in observations if each.refused)
    identified = [each for each in observations if each.tag_id is not None]
    localization = localize(recording, identified, tags, driven)
    of_passes = dict.fromkeys(w for each in observations for w in each.magnets.warnings)
    return _ArrayResult(
        localization,
        [each.detection(recording.device, recording.time_ns) for each in observations],
        rejected,
        [
            *preprocessed.warnings,
            *localization.warnings,
            *(warning.about(recording.device) for warning in of_passes),
            *((contradiction.about(recording.device),) if contradiction else ()),
        ],
    )


def _known_path(
    recording: Samples, speed_mps: float | None, driven: Trajectory | None
) -> Array | None:
    """Return the distance moved at each sample, by speed or odometry; None without either."""
    if speed_mps is not None:
        return (recording.time_ns - recording.time_ns[0]) * 1e-9 * speed_mps
    return None if driven is None else distance_along(driven, recording.time_ns)


def _identify_passes(
    preprocessed: PreprocessedSamples, tags: Tags | None, path_m: Array | None
) -> tuple[list[IdentifiedPass], Counter[str]]:
    """Detect and identify the tags of all passes, in order of time.

    Returns
    -------
    passes : list of IdentifiedPass
    counts : Counter
        Changes of the field without a detection: ``no_magnets`` explain them, or ``no_pass`` over a
        tag caused them.
    """

    def identify(part: PassRange) -> IdentifiedPass | None:
        hypotheses = detect_magnets(preprocessed, part, tags, path_m)
        result = identify_pass(hypotheses, preprocessed.samples, tags)
        if path_m is None or tags is None or result is None or result.magnets.is_path_estimated:
            return result
        scale = contradicted_scale(result.observations[0], tags)
        if scale is None:
            return result
        hypotheses = detect_magnets(preprocessed, part, tags, scale * path_m)
        rescaled = identify_pass(hypotheses, preprocessed.samples, tags)
        return rescaled if rescaled is not None and rescaled.is_identified else result

    passes: list[IdentifiedPass] = []
    counts: Counter[str] = Counter(no_magnets=0)
    samples, noise_t = preprocessed.samples, preprocessed.noise_t
    magnet_field_t = None
    if tags is not None:
        magnet_field_t = least_magnet_field(samples, tags.magnet.moment, tags.clearance_m)
    for part in find_passes(samples, noise_t):
        current = identify(part)
        if (current is None or not current.is_identified) and (
            (current is not None and _is_at_rest(current))
            or is_no_pass(samples, part, noise_t, path_m, magnet_field_t)
        ):
            counts["no_pass"] += 1
            continue
        if current is None:
            counts["no_magnets"] += 1
            continue
        if passes and tags is not None and may_be_one_tag(passes[-1], current, tags):
            merged = identify(PassRange(passes[-1].magnets.first, current.magnets.stop))
            if merged is not None and merged.is_identified:
                passes[-1] = merged
                continue
        passes.append(current)
    return passes, counts


def _is_at_rest(current: IdentifiedPass) -> bool:
    """Return whether an array moved less than its height: the field hardly changes over that."""
    magnets = current.magnets
    return bool(np.ptp(magnets.path_m) < magnets.height_m)


def _identify_published(
    recording: Samples, tags: Tags | None, options: SolveOptions
) -> list[IdentifiedPass]:
    """Detect the magnets of all passes by the published algorithm, and identify the tags."""
    if tags is None:
        raise InputError(
            "the published algorithm needs the tag",
            hint="Give it as --artifact, or import with --tag",
        )
    passes = published.detect_magnets(recording, tags, options.speed_mps, options.templates)
    return [IdentifiedPass(magnets, identify_tags(magnets, recording, tags)) for magnets in passes]
