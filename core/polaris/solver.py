"""Pipeline of the Polaris solver, from samples of magnetometer arrays to tags and poses."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.polaris.array import Samples
from locatk.core.polaris.detection.magnets import detect_magnets
from locatk.core.polaris.given_path import (
    backward_warning,
    compare_path,
    contradiction_warning,
    coverage_warning,
    known_path,
    scale_to_apply,
)
from locatk.core.polaris.identification.tags import (
    IdentifiedPass,
    TagObservation,
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
    valid_odometry,
)
from locatk.core.polaris.published import pipeline as published
from locatk.core.polaris.published.templates import TemplateGrid
from locatk.core.polaris.results import PolarisFacts, TagDetection
from locatk.core.polaris.tag import Tags
from locatk.core.progress import track
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
    tags: Tags | Mapping[str, Tags] | None = None,
    options: SolveOptions | None = None,
    *,
    odometry: Sequence[Trajectory] = (),
) -> Solution:
    """Detect and identify the tags that arrays passed over, and localize the arrays by them.

    Parameters
    ----------
    samples : sequence of Samples
        One per device.
    tags : Tags, mapping of str to Tags, or None
        Design of the tags, and their positions on the site; several designs by name. Without it,
        magnets are detected but not identified.
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
        A recording is empty or too short, the method needs a speed or the tags, or supports only
        one design.
    """
    options = options or SolveOptions()
    designs = name_designs(tags)
    if options.method == "paper" and len(designs) > 1:
        raise InputError(
            "the published algorithm supports only one design of tags",
            hint="Give one --tag, or leave out --method paper",
        )
    results = [_solve_array(recording, designs, options, odometry) for recording in samples]
    detections = tuple(d for each in results for d in each.detections)
    read = {d.design for d in detections if d.tag_id is not None} or set(designs)
    return Solution(
        system="polaris",
        method=options.method,
        trajectories=tuple(t for each in results for t in each.localization.trajectories),
        rejected=add_counts(*(each.rejected for each in results)),
        detections=detections,
        # Ids of another design have no meaning in a design.
        artifact=designs[read.pop()] if len(read) == 1 else None,
        warnings=tuple(w for each in results for w in each.warnings),
        facts=PolarisFacts(
            tuple(c for each in results for c in each.localization.heading_corrections)
        ),
    )


def name_designs(tags: Tags | Mapping[str, Tags] | None) -> Mapping[str | None, Tags]:
    """Return the designs by name; a single design has none."""
    if tags is None:
        return {}
    return {None: tags} if isinstance(tags, Tags) else dict(tags.items())


@dataclass(frozen=True)
class _ArrayResult:
    """Tags and poses of one array."""

    localization: Localization
    detections: list[TagDetection]
    rejected: Counter[str]
    warnings: list[SolverWarning]


def _solve_array(
    recording: Samples,
    named_designs: Mapping[str | None, Tags],
    options: SolveOptions,
    odometry: Sequence[Trajectory],
) -> _ArrayResult:
    """Preprocess, detect, identify and localize for one array."""
    designs = tuple(named_designs.values())
    driven = next((t for t in odometry if t.device == recording.device), None)
    odometry_warnings: tuple[SolverWarning, ...] = ()
    if driven is not None:
        driven, odometry_warnings = valid_odometry(driven)
    preprocessed = preprocess(recording)
    recording = preprocessed.samples
    rejected: Counter[str] = Counter()
    path_warnings: list[SolverWarning | None] = []
    if options.method == "paper":
        passes = _identify_published(recording, designs, options)
    else:
        path_m = _known_path(recording, options.speed_mps, driven)
        passes, counts = _identify_passes(preprocessed, designs, path_m)
        rejected.update(counts)
        if path_m is not None:
            contradictions = [compare_path(path_m, each.observations[0]) for each in passes]
            path_warnings = [
                contradiction_warning(contradictions, options.speed_mps),
                coverage_warning(path_m, [each.magnets for each in passes]),
            ]
        path_warnings.append(backward_warning(passes, path_m))
    observations = [each for part in passes for each in part.observations]
    rejected.update(each.refused for each in observations if each.refused)
    identified = [each for each in observations if each.tag_id is not None]
    localization = localize(recording, identified, driven)
    names = {id(tags): name for name, tags in named_designs.items()}
    of_passes = dict.fromkeys(w for each in observations for w in each.magnets.warnings)
    return _ArrayResult(
        localization,
        [
            each.detection(recording.device, recording.time_ns, names.get(id(each.tags)))
            for each in observations
        ],
        rejected,
        [
            *preprocessed.warnings,
            *odometry_warnings,
            *localization.warnings,
            *(warning.about(recording.device) for warning in of_passes),
            *_other_magnets(recording.device, observations),
            *(warning.about(recording.device) for warning in path_warnings if warning),
        ],
    )


def _other_magnets(device: str, observations: Sequence[TagObservation]) -> list[SolverWarning]:
    """Report the strong magnets beside tags that were read."""
    return [
        SolverWarning(
            "other_magnets",
            f"{len(each.unexplained)} further magnets near tag {each.tag_id} belong to no tag",
        ).about(device)
        for each in observations
        if each.tag_id is not None and each.unexplained
    ]


def _known_path(
    recording: Samples, speed_mps: float | None, driven: Trajectory | None
) -> Array | None:
    """Return the distance moved at each sample, by speed or odometry; None without either.

    It is nan at samples that odometry does not cover.
    """
    if speed_mps is not None:
        return (recording.time_ns - recording.time_ns[0]) * 1e-9 * speed_mps
    return None if driven is None else distance_along(driven, recording.time_ns)


def _identify_passes(
    preprocessed: PreprocessedSamples, designs: Sequence[Tags], given_m: Array | None
) -> tuple[list[IdentifiedPass], Counter[str]]:
    """Detect and identify the tags of all passes, in order of time.

    Returns
    -------
    passes : list of IdentifiedPass
    rejected : Counter
        Changes of the field without a detection: ``no_magnets`` explain them, or ``no_pass`` over a
        tag caused them.
    """
    passes: list[IdentifiedPass] = []
    rejected: Counter[str] = Counter(no_magnets=0)
    samples, noise_t = preprocessed.samples, preprocessed.noise_t
    for part in track(find_passes(samples, noise_t), "passes"):
        current = identify_range(preprocessed, designs, part, given_m)
        if has_no_tag(preprocessed, designs, part, given_m, current):
            rejected["no_pass"] += 1
            continue
        if current is None:
            rejected["no_magnets"] += 1
            continue
        if passes and any(may_be_one_tag(passes[-1], current, tags) for tags in designs):
            whole = PassRange(passes[-1].magnets.first, current.magnets.stop)
            merged = identify_range(preprocessed, designs, whole, given_m)
            if merged is not None and merged.is_identified:
                passes[-1] = merged
                continue
        passes.append(current)
    return passes, rejected


def identify_range(
    preprocessed: PreprocessedSamples,
    designs: Sequence[Tags],
    part: PassRange,
    given_m: Array | None,
) -> IdentifiedPass | None:
    """Detect the magnets of one pass, and identify the tags; None if no magnets explain it.

    ``given_m`` (n,) is the distance moved at each sample of the recording; nan if unknown.
    """

    def identify_with(path_m: Array | None) -> IdentifiedPass | None:
        # The magnets of each design are expected in turn, until a tag of any design is read. A
        # design of few magnets limits the number of sources.
        hypotheses = chain.from_iterable(
            detect_magnets(preprocessed, part, tags, path_m)
            for tags in by_magnets(designs) or (None,)
        )
        return identify_pass(hypotheses, preprocessed.samples, designs)

    path_m = known_path(given_m, part)
    result = identify_with(path_m)
    if path_m is None or result is None or result.magnets.is_path_estimated:
        return result
    scale = scale_to_apply(result.observations[0])
    if scale is None:
        return result
    rescaled = identify_with(scale * path_m)
    return rescaled if rescaled is not None and rescaled.is_identified else result


def by_magnets(designs: Sequence[Tags]) -> list[Tags]:
    """Return the designs in the order in which they are expected: most magnets first."""
    return sorted(designs, key=lambda tags: -tags.magnets)


def has_no_tag(
    preprocessed: PreprocessedSamples,
    designs: Sequence[Tags],
    part: PassRange,
    given_m: Array | None,
    current: IdentifiedPass | None,
) -> bool:
    """Return whether the field of an unidentified pass changed without a motion over a tag.

    ``current`` is the explanation of the pass by magnets, if there is one.
    """
    if current is not None and current.is_identified:
        return False
    if current is not None and _is_at_rest(current):
        return True
    samples = preprocessed.samples
    fields_t = [
        least_magnet_field(samples, tags.magnet.moment, tags.clearance_m) for tags in designs
    ]
    path_m = known_path(given_m, part)
    return is_no_pass(samples, part, preprocessed.noise_t, path_m, min(fields_t, default=None))


def _is_at_rest(current: IdentifiedPass) -> bool:
    """Return whether an array moved less than its height: the field hardly changes over that."""
    magnets = current.magnets
    return bool(np.ptp(magnets.path_m) < magnets.height_m)


def _identify_published(
    recording: Samples, designs: Sequence[Tags], options: SolveOptions
) -> list[IdentifiedPass]:
    """Detect the magnets of all passes by the published algorithm, and identify the tags."""
    if not designs:
        raise InputError(
            "the published algorithm needs the tag",
            hint="Give it as --artifact, or import with --tag",
        )
    passes = published.detect_magnets(recording, designs[0], options.speed_mps, options.templates)
    return [
        IdentifiedPass(magnets, identify_tags(magnets, recording, designs)) for magnets in passes
    ]
