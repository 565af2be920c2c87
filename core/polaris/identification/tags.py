"""Identification of tags: from the magnets of a pass to tags with id and pose, or to refusals.

A pass has several explanations by magnets. The first one is taken that leaves a white residual and
can be decoded. Otherwise, of those whose residual is within :data:`MAX_EQUIVALENT_RESIDUAL_RATIO`
of the least, one that can be decoded is preferred.

The tags of a pass must explain all its strong magnets (:mod:`.evidence`). Tags of several designs
may be in one pass; if two designs explain the same magnets, neither is read.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError
from locatk.core.polaris import codec
from locatk.core.polaris.array import Samples
from locatk.core.polaris.detection.magnets import (
    WHITE_RESIDUAL_SIGMAS,
    MagnetHypothesis,
    detect_magnets_at,
)
from locatk.core.polaris.identification.decoding import (
    DecodedTag,
    coincidence_probability,
    decode_tag,
)
from locatk.core.polaris.identification.evidence import (
    MAX_COINCIDENCE_PROBABILITY,
    contradicts_design,
    is_in_grid,
    is_part_of_larger_tag,
)
from locatk.core.polaris.identification.matching import (
    MAX_MISFIT_SPACINGS,
    TagMatch,
    apply_scale,
    match_tags,
    refit_match,
)
from locatk.core.polaris.magnets import DetectedMagnets
from locatk.core.polaris.results import MagnetDetection, OtherMagnet, TagDetection
from locatk.core.polaris.tag import PlanarPose, Tags, as_built_magnets, cell_positions

Array = NDArray[np.float64]

MAX_SCALE_ERROR = 0.1
"""Largest deviation from 1 of the scale of a path."""

MAX_ROBUST_RESIDUAL_SIGMAS, MAX_RESIDUAL_SIGMAS = 2.0, 4.0
"""Largest residual of a tag that is accepted, in standard deviations of the noise: from the median,
and the rms (debris leaves peaks, and so does a wrong path)."""

MIN_MARGIN_STEPS_PER_SIGMA = 0.2
"""Least margin in steps, relative to the rms residual, if that is not white: a magnet at a wrong
position distorts the directions of its neighbours."""

TYPICAL_ROBUST_RESIDUAL_SIGMAS = 1.25
"""Residual from the median up to which a pass is explained, except for some outliers."""

MAX_EQUIVALENT_RESIDUAL_RATIO = 1.2
"""Ratio of two rms residuals up to which they do not tell which explanation is better."""

MIN_MAGNETS_FOR_GRID = 5
"""Number of magnets on cells from which a source on each cell of the grid is tried."""

MIN_TAG_MAGNETS = 3
"""Number of magnets that must be left for another tag."""

UNREADABLE = frozenset({"tie", "not_in_family", "beyond_code", "residual"})
"""Reasons for which a complete tag is refused; its magnets are explained nevertheless."""

LARGER_TAG_REASONS = frozenset(
    {"vertex_missing", "magnets_missing", "too_many_magnets", "no_such_placement", "ambiguous"}
)
"""Reasons that a part of a larger tag gives; ``other_design`` names the cause."""


@dataclass(frozen=True)
class TagObservation:
    """Tag in a pass, or magnets that may be one.

    Attributes
    ----------
    magnets : DetectedMagnets
        Lengths along the track are scaled by the tag if it was identified.
    match : TagMatch or None
    decoded : DecodedTag or None
    refused : str
        "" or a machine-readable reason for a missing id.
    tags : Tags or None
        Design of the tag; None if none was given.
    unexplained : tuple of int
        Indices of the magnets that belong to no tag of the pass and are nearest to this one.
    """

    magnets: DetectedMagnets
    match: TagMatch | None
    decoded: DecodedTag | None
    refused: str = ""
    tags: Tags | None = None
    unexplained: tuple[int, ...] = ()

    @property
    def tag_id(self) -> int | None:
        """Id of the tag; None if it was refused."""
        return None if self.decoded is None or self.refused else self.decoded.tag_id

    @property
    def site_pose(self) -> PlanarPose | None:
        """Pose of the tag on the site; None if it is not known."""
        if self.tags is None or self.tag_id is None:
            return None
        return self.tags.site.get(self.tag_id)

    @property
    def site_covariance(self) -> Array:
        """Covariance (3, 3) of :attr:`site_pose`; zero if it is exact."""
        if self.tags is None or self.tag_id is None:
            return np.zeros((3, 3))
        return np.diag(np.square(self.tags.site_sigma.get(self.tag_id, (0.0, 0.0, 0.0))))

    @property
    def meaning(self) -> str | None:
        """Meaning of the id; None if it has none."""
        if self.tags is None or self.tag_id is None:
            return None
        return self.tags.meanings.get(self.tag_id)

    @property
    def array_pose(self) -> PlanarPose | None:
        """Pose of the array in the tag's frame; None without a match."""
        if self.match is None:
            return None
        cos, sin = np.cos(self.match.heading_rad), np.sin(self.match.heading_rad)
        x, y = self.match.x_m, self.match.y_m
        return PlanarPose(-(cos * x + sin * y), sin * x - cos * y, -self.match.heading_rad)

    def detection(
        self, device: str, time_ns: NDArray[np.int64], design: str | None = None
    ) -> TagDetection:
        """Return the observation as a detection.

        ``time_ns`` (n,) are the times of the samples, ``design`` is the name of the tag's design.
        """
        magnets, match, decoded = self.magnets, self.match, self.decoded
        first, last = magnets.first, min(magnets.stop, len(time_ns)) - 1
        duration_s = (time_ns[last] - time_ns[first]) * 1e-9
        sigma = np.full(3, np.nan) if match is None else np.sqrt(np.diag(match.covariance))
        return TagDetection(
            time_s=magnets.time_ns * 1e-9,
            device=device,
            tag_id=self.tag_id,
            margin=None if decoded is None else decoded.margin,
            refused=self.refused or None,
            x_m=None if match is None else match.x_m,
            y_m=None if match is None else match.y_m,
            heading_rad=None if match is None else match.heading_rad,
            sigma_x_m=sigma[0],
            sigma_y_m=sigma[1],
            sigma_heading_rad=sigma[2],
            array_pose=self.array_pose,
            magnets=self._magnet_detections(),
            residual_sigma=magnets.residual_sigma,
            height_m=magnets.height_m,
            speed_mps=float(np.ptp(magnets.path_m) / duration_s) if duration_s > 0 else None,
            scale=1.0 if match is None else match.scale,
            corrected=None if decoded is None else decoded.corrected,
            erased=None if decoded is None else decoded.erased,
            other_sources=magnets.other_sources,
            other_magnets=tuple(
                OtherMagnet(
                    x_m=magnets.position_m[k, 0],
                    y_m=magnets.position_m[k, 1],
                    angle_rad=magnets.angle_rad[k],
                    moment_am2=magnets.moment_am2[k],
                )
                for k in self.unexplained
            ),
            design=design,
            meaning=self.meaning,
        )

    def _magnet_detections(self) -> tuple[MagnetDetection, ...]:
        """Return the magnets of the tag row by row if it was identified, else all."""
        magnets = self.magnets
        cell_of, symbol_of = {}, {}
        if self.match is not None and self.decoded is not None:
            cell_of = dict(zip(self.match.magnets, self.match.cells, strict=True))
            symbol_of = dict(zip(self.match.magnets, self.decoded.symbols, strict=True))
        indices = list(cell_of) if self.tag_id is not None else range(len(magnets))
        sigma = np.sqrt(np.diag(magnets.covariance)).reshape(-1, 3)
        return tuple(
            MagnetDetection(
                x_m=magnets.position_m[k, 0],
                y_m=magnets.position_m[k, 1],
                angle_rad=magnets.angle_rad[k],
                symbol=symbol_of.get(k),
                cell=cell_of.get(k),
                sigma_x_m=sigma[k, 0],
                sigma_y_m=sigma[k, 1],
                sigma_angle_rad=sigma[k, 2],
                moment_am2=magnets.moment_am2[k],
            )
            for k in indices
        )


@dataclass(frozen=True)
class IdentifiedPass:
    """Explanation of one pass, with the tags in it.

    Attributes
    ----------
    magnets : DetectedMagnets
        As they were detected.
    observations : tuple of TagObservation
        At least one; refused if no tag could be decoded.
    """

    magnets: DetectedMagnets
    observations: tuple[TagObservation, ...]

    @property
    def tag_count(self) -> int:
        """Number of observations that have an id."""
        return sum(each.tag_id is not None for each in self.observations)

    @property
    def is_identified(self) -> bool:
        """Whether an observation has an id."""
        return self.tag_count > 0


def identify_pass(
    hypotheses: Iterable[MagnetHypothesis], samples: Samples, designs: Sequence[Tags]
) -> IdentifiedPass | None:
    """Choose among the explanations of a pass, and identify the tags in it.

    Parameters
    ----------
    hypotheses : iterable of MagnetHypothesis
        They are computed only until one is accepted.
    samples : Samples
        The recording.
    designs : sequence of Tags
        Designs that may be on the floor.

    Returns
    -------
    IdentifiedPass or None
        None if there is no explanation.
    """
    tried: list[IdentifiedPass] = []
    for hypothesis in hypotheses:
        magnets = hypothesis.magnets
        result = IdentifiedPass(magnets, identify_tags(magnets, samples, designs))
        is_explained = magnets.residual_sigma < WHITE_RESIDUAL_SIGMAS
        # Debris leaves peaks that no other initial guess would explain.
        is_explained |= (
            magnets.is_path_estimated
            and magnets.robust_residual_sigma < TYPICAL_ROBUST_RESIDUAL_SIGMAS
        )
        # The magnets of a tag of another design do not depend on the initial guess.
        is_other = len(designs) == 1 and result.observations[0].refused == "other_design"
        if is_explained and (not designs or result.is_identified or is_other):
            return result
        tried.append(result)
        on_grid = _identify_on_grid(hypothesis, result, samples, designs)
        if on_grid is not None:
            return on_grid
    if not tried:
        return None
    limit = MAX_EQUIVALENT_RESIDUAL_RATIO * min(each.magnets.residual_sigma for each in tried)
    equivalent = [each for each in tried if each.magnets.residual_sigma <= limit]
    return max(equivalent, key=lambda each: (each.tag_count, -each.magnets.residual_sigma))


def _identify_on_grid(
    hypothesis: MagnetHypothesis,
    result: IdentifiedPass,
    samples: Samples,
    designs: Sequence[Tags],
) -> IdentifiedPass | None:
    """Fit the pass with a source on each cell of the matched grid; None if that does not help.

    The fields of magnets that are closer than one and a half clearances overlap so much that the
    matched filter takes two for one.
    """
    match, tags = result.observations[0].match, result.observations[0].tags
    if tags is None or match is None or len(match.cells) < MIN_MAGNETS_FOR_GRID:
        return None
    cells = tuple((column, row) for row in range(tags.order) for column in range(tags.order))
    cos, sin = np.cos(match.heading_rad), np.sin(match.heading_rad)
    rotation = np.array([[cos, -sin], [sin, cos]])
    positions = cell_positions(tags, cells) @ rotation.T + [match.x_m, match.y_m]
    positions[:, 0] /= match.scale
    try:
        magnets = detect_magnets_at(samples, hypothesis, positions).magnets
    except DegenerateError:
        return None
    on_grid = IdentifiedPass(magnets, identify_tags(magnets, samples, designs))
    is_accepted = on_grid.is_identified and magnets.residual_sigma <= WHITE_RESIDUAL_SIGMAS
    return on_grid if is_accepted else None


def may_be_one_tag(before: IdentifiedPass, after: IdentifiedPass, tags: Tags) -> bool:
    """Return whether two passes may be the ends of one tag: not identified, and near each other."""
    if before.is_identified or after.is_identified:
        return False
    gap_samples = max(after.magnets.first - before.magnets.stop, 0)
    path = before.magnets.path_m
    step_m = np.ptp(path) / max(len(path) - 1, 1)
    return bool(gap_samples * step_m < 1.5 * tags.order * tags.spacing_m)


def identify_tags(
    magnets: DetectedMagnets, samples: Samples, designs: Sequence[Tags]
) -> tuple[TagObservation, ...]:
    """Identify all tags among the magnets of a pass.

    Parameters
    ----------
    magnets : DetectedMagnets
    samples : Samples
        The recording.
    designs : sequence of Tags
        Designs that may be on the floor.

    Returns
    -------
    tuple of TagObservation
        At least one, in the order in which the array passed them; refused if no tag could be
        decoded, or if the magnets of the pass contradict the tags.
    """
    if not designs:
        return (TagObservation(magnets, None, None, "no_tag_given"),)
    found: list[TagObservation] = []
    used: frozenset[int] = frozenset()
    while True:
        rivals = [_best_observation(magnets, samples, tags, used) for tags in designs]
        observation = _choose_design(rivals)
        is_tag = observation.tag_id is not None or (found and _is_complete(observation))
        if not is_tag or observation.match is None:
            break
        found.append(observation)
        used |= frozenset(observation.match.magnets)
        if len(magnets) - len(used) < MIN_TAG_MAGNETS:
            break
    if not found:
        return (_name_larger_tag(magnets, observation),)
    return _check_tags(magnets, found, used)


def _choose_design(rivals: Sequence[TagObservation]) -> TagObservation:
    """Choose among the best observations of each design: the one that explains most magnets.

    It is ambiguous if another design reads as many of the same magnets.
    """

    def count(observation: TagObservation) -> int:
        return 0 if observation.match is None else len(observation.match.magnets)

    best = max(rivals, key=lambda each: (each.tag_id is not None, count(each)))
    if best.match is None or best.tag_id is None:
        return best
    for rival in rivals:
        if rival is best or rival.match is None or rival.tag_id is None:
            continue
        is_shared = bool(set(best.match.magnets) & set(rival.match.magnets))
        if is_shared and count(rival) == count(best):
            return replace(best, refused="ambiguous")
    return best


def _is_complete(observation: TagObservation) -> bool:
    """Return whether all magnets of a tag are on its cells, although it was not decoded."""
    match, tags = observation.match, observation.tags
    if match is None or tags is None or observation.refused not in UNREADABLE:
        return False
    return len(match.cells) == tags.magnets


def _name_larger_tag(magnets: DetectedMagnets, observation: TagObservation) -> TagObservation:
    """Refuse an unread tag as one of another design if further magnets are on its lattice."""
    match, tags = observation.match, observation.tags
    if match is None or tags is None or len(match.cells) < MIN_TAG_MAGNETS:
        return observation
    unexplained = frozenset(range(len(magnets))) - frozenset(match.magnets)
    is_larger = is_part_of_larger_tag(magnets, tags, match, unexplained)
    if is_larger and observation.refused in LARGER_TAG_REASONS:
        return replace(observation, refused="other_design")
    return observation


def _check_tags(
    magnets: DetectedMagnets, found: Sequence[TagObservation], used: frozenset[int]
) -> tuple[TagObservation, ...]:
    """Return the tags of a pass in order of time; refuse those that the magnets contradict."""
    unexplained = frozenset(range(len(magnets))) - used
    matches = [each.match for each in found if each.match is not None]
    centre = np.array([[match.x_m / match.scale, match.y_m] for match in matches])
    distance = np.linalg.norm(magnets.position_m[:, None] - centre, axis=2)
    nearest = distance.argmin(axis=1)
    ids = [(each.tags, each.tag_id) for each in found if each.tag_id is not None]
    checked = []
    for index, observation in enumerate(found):
        match, tags, decoded = observation.match, observation.tags, observation.decoded
        refused = observation.refused
        if match is not None and tags is not None and decoded is not None and not refused:
            of_others = used - frozenset(match.magnets)
            probability = coincidence_probability(tags, match.cells, decoded)
            if is_part_of_larger_tag(magnets, tags, match, unexplained, probability) or any(
                is_in_grid(magnets, tags, match, of_others)
            ):
                refused = "other_design"
            elif sum(tags is other and observation.tag_id == i for other, i in ids) > 1:
                # A tag has one position: the estimated path is wrong.
                refused = "ambiguous"
        mine = tuple(k for k in sorted(unexplained) if nearest[k] == index)
        checked.append(replace(observation, refused=refused, unexplained=mine))
    direction = 1.0 if magnets.path_m[-1] >= magnets.path_m[0] else -1.0
    return tuple(checked[k] for k in np.argsort(direction * centre[:, 0], kind="stable"))


def _best_observation(
    magnets: DetectedMagnets, samples: Samples, tags: Tags, used: frozenset[int]
) -> TagObservation:
    """Return the best match of the unused magnets, decoded or refused."""
    matches = match_tags(magnets, tags, used)
    if not matches:
        reason = _missing_reason(magnets, samples, tags, None)
        return TagObservation(magnets, None, None, reason, tags)
    candidates = [(match, _decode_match(magnets, tags, match)) for match in matches]
    with_id = [(match, decoded) for match, decoded in candidates if decoded.tag_id is not None]
    if not with_id:
        match, decoded = candidates[0]
        reason = decoded.refused
        if reason in ("magnets_missing", "vertex_missing") and len(match.cells) < tags.magnets:
            reason = _missing_reason(magnets, samples, tags, match)
        return TagObservation(magnets, match, decoded, reason, tags)
    # Magnets of two tags may fit the grid as well, with an id that is not in use.
    certain = [
        (match, decoded)
        for match, decoded in with_id
        if coincidence_probability(tags, match.cells, decoded) < MAX_COINCIDENCE_PROBABILITY
    ]
    with_id = certain or with_id
    match, decoded = with_id[0]
    shared = set(match.magnets)
    if len({other.tag_id for rival, other in with_id if shared & set(rival.magnets)}) > 1:
        return TagObservation(magnets, match, decoded, "ambiguous", tags)
    tag_id = decoded.tag_id
    if tag_id is not None and tag_id in tags.built:
        layout = codec.layout_of(tags, tag_id)
        positions, _ = as_built_magnets(tags, tag_id, layout)
        indices = [layout.cells.index(cell) for cell in match.cells]
        match = refit_match(magnets, tags, match, positions[indices])
    refused = _fit_reason(magnets, tags, match, decoded)
    return TagObservation(apply_scale(magnets, match), match, decoded, refused, tags)


def _fit_reason(magnets: DetectedMagnets, tags: Tags, match: TagMatch, decoded: DecodedTag) -> str:
    """Return the reason if grid or samples contradict a decoded tag, else ""."""
    if match.misfit_m > MAX_MISFIT_SPACINGS * tags.spacing_m:
        return "misfit"
    if abs(match.scale - 1) > MAX_SCALE_ERROR:
        return "misfit"
    if contradicts_design(magnets, tags, match):
        return "other_design"
    residual = magnets.residual_sigma
    if magnets.robust_residual_sigma > MAX_ROBUST_RESIDUAL_SIGMAS or residual > MAX_RESIDUAL_SIGMAS:
        return "residual"
    min_margin = MIN_MARGIN_STEPS_PER_SIGMA * residual
    if residual > WHITE_RESIDUAL_SIGMAS and decoded.margin < min_margin:
        return "residual"
    return ""


def _decode_match(magnets: DetectedMagnets, tags: Tags, match: TagMatch) -> DecodedTag:
    """Decode the orientations of matched magnets."""
    indices = list(match.magnets)
    angle = magnets.angle_rad[indices] - match.heading_rad
    sigma = np.sqrt(np.diag(magnets.covariance))[2::3][indices] / tags.step_rad
    return decode_tag(tags, match.cells, -angle / tags.step_rad, sigma)


def _missing_reason(
    magnets: DetectedMagnets, samples: Samples, tags: Tags, match: TagMatch | None
) -> str:
    """Return why magnets are missing: ``partial`` if the tag exceeds the bar or the recording."""
    range_m = np.max(np.abs(samples.array.position_m[:, 1])) + 0.5 * tags.clearance_m
    across = np.abs(magnets.position_m[:, 1])
    if match is not None and len(match.cells) > 2:
        cells = tuple((column, row) for row in range(tags.order) for column in range(tags.order))
        position = cell_positions(tags, cells)
        sin, cos = np.sin(match.heading_rad), np.cos(match.heading_rad)
        cells_across = np.abs(sin * position[:, 0] + cos * position[:, 1] + match.y_m)
        if np.any(cells_across > range_m):
            return "partial"
    elif np.any(across > range_m - tags.spacing_m):
        return "partial"
    # A tag continues beyond the bar if a magnet is at its very end.
    if np.any(across > range_m - 0.25 * tags.spacing_m):
        return "partial"
    is_at_end = magnets.first <= 1 or magnets.stop >= len(samples) - 1
    return "partial" if is_at_end else "magnets_missing"
