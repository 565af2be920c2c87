"""Identification of tags: from the magnets of a pass to tags with id and pose, or to refusals.

A pass has several explanations by magnets. The first one is taken that leaves a white residual and
can be decoded. Otherwise, of those whose residual is within :data:`MAX_EQUIVALENT_RESIDUAL_RATIO`
of the least, one that can be decoded is preferred.
"""

from __future__ import annotations

from collections.abc import Iterable
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
from locatk.core.polaris.identification.decoding import DecodedTag, decode_tag
from locatk.core.polaris.identification.matching import (
    MAX_MISFIT_SPACINGS,
    TagMatch,
    apply_scale,
    match_tags,
    refit_match,
)
from locatk.core.polaris.magnets import DetectedMagnets
from locatk.core.polaris.results import MagnetDetection, TagDetection
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
    """

    magnets: DetectedMagnets
    match: TagMatch | None
    decoded: DecodedTag | None
    refused: str = ""

    @property
    def tag_id(self) -> int | None:
        """Id of the tag; None if it was refused."""
        return None if self.decoded is None or self.refused else self.decoded.tag_id

    @property
    def array_pose(self) -> PlanarPose | None:
        """Pose of the array in the tag's frame; None without a match."""
        if self.match is None:
            return None
        cos, sin = np.cos(self.match.heading_rad), np.sin(self.match.heading_rad)
        x, y = self.match.x_m, self.match.y_m
        return PlanarPose(-(cos * x + sin * y), sin * x - cos * y, -self.match.heading_rad)

    def detection(self, device: str, time_ns: NDArray[np.int64]) -> TagDetection:
        """Return the observation as a detection; ``time_ns`` (n,) are the times of the samples."""
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
    def is_identified(self) -> bool:
        """Whether the first observation has an id."""
        return self.observations[0].tag_id is not None


def identify_pass(
    hypotheses: Iterable[MagnetHypothesis], samples: Samples, tags: Tags | None
) -> IdentifiedPass | None:
    """Choose among the explanations of a pass, and identify the tags in it.

    Parameters
    ----------
    hypotheses : iterable of MagnetHypothesis
        They are computed only until one is accepted.
    samples : Samples
        The recording.
    tags : Tags or None

    Returns
    -------
    IdentifiedPass or None
        None if there is no explanation.
    """
    tried: list[IdentifiedPass] = []
    for hypothesis in hypotheses:
        magnets = hypothesis.magnets
        result = IdentifiedPass(magnets, identify_tags(magnets, samples, tags))
        is_explained = magnets.residual_sigma < WHITE_RESIDUAL_SIGMAS
        # Debris leaves peaks that no other initial guess would explain.
        is_explained |= (
            magnets.is_path_estimated
            and magnets.robust_residual_sigma < TYPICAL_ROBUST_RESIDUAL_SIGMAS
        )
        if is_explained and (tags is None or result.is_identified):
            return result
        tried.append(result)
        on_grid = _identify_on_grid(hypothesis, result, samples, tags)
        if on_grid is not None:
            return on_grid
    if not tried:
        return None
    limit = MAX_EQUIVALENT_RESIDUAL_RATIO * min(each.magnets.residual_sigma for each in tried)
    equivalent = [each for each in tried if each.magnets.residual_sigma <= limit]
    return min(equivalent, key=lambda each: (not each.is_identified, each.magnets.residual_sigma))


def _identify_on_grid(
    hypothesis: MagnetHypothesis, result: IdentifiedPass, samples: Samples, tags: Tags | None
) -> IdentifiedPass | None:
    """Fit the pass with a source on each cell of the matched grid; None if that does not help.

    The fields of magnets that are closer than one and a half clearances overlap so much that the
    matched filter takes two for one.
    """
    match = result.observations[0].match
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
    on_grid = IdentifiedPass(magnets, identify_tags(magnets, samples, tags))
    is_accepted = on_grid.is_identified and magnets.residual_sigma <= WHITE_RESIDUAL_SIGMAS
    return on_grid if is_accepted else None


def may_be_one_tag(before: IdentifiedPass, after: IdentifiedPass, tags: Tags) -> bool:
    """Return whether two passes may be the ends of one tag: not identified, and near each other."""
    if any(each.tag_id is not None for each in (*before.observations, *after.observations)):
        return False
    gap_samples = max(after.magnets.first - before.magnets.stop, 0)
    path = before.magnets.path_m
    step_m = np.ptp(path) / max(len(path) - 1, 1)
    return bool(gap_samples * step_m < 1.5 * tags.order * tags.spacing_m)


def identify_tags(
    magnets: DetectedMagnets, samples: Samples, tags: Tags | None
) -> tuple[TagObservation, ...]:
    """Identify all tags among the magnets of a pass.

    Returns
    -------
    tuple of TagObservation
        At least one; refused if no tag could be decoded.
    """
    if tags is None:
        return (TagObservation(magnets, None, None, "no_tag_given"),)
    identified: list[TagObservation] = []
    used: frozenset[int] = frozenset()
    while True:
        observation = _best_observation(magnets, samples, tags, used)
        if observation.tag_id is None or observation.match is None:
            break
        identified.append(observation)
        used |= frozenset(observation.match.magnets)
        if len(magnets) - len(used) < MIN_TAG_MAGNETS:
            break
    if len({each.tag_id for each in identified}) < len(identified):
        # A tag has one position: the estimated path is wrong.
        return tuple(replace(each, refused="ambiguous") for each in identified)
    return tuple(identified) or (observation,)


def _best_observation(
    magnets: DetectedMagnets, samples: Samples, tags: Tags, used: frozenset[int]
) -> TagObservation:
    """Return the best match of the unused magnets, decoded or refused."""
    matches = match_tags(magnets, tags, used)
    if not matches:
        return TagObservation(magnets, None, None, _missing_reason(magnets, samples, tags, None))
    candidates = [(match, _decode_match(magnets, tags, match)) for match in matches]
    with_id = [(match, decoded) for match, decoded in candidates if decoded.tag_id is not None]
    if not with_id:
        match, decoded = candidates[0]
        reason = decoded.refused
        if reason in ("magnets_missing", "vertex_missing") and len(match.cells) < tags.magnets:
            reason = _missing_reason(magnets, samples, tags, match)
        return TagObservation(magnets, match, decoded, reason)
    match, decoded = with_id[0]
    shared = set(match.magnets)
    if len({other.tag_id for rival, other in with_id if shared & set(rival.magnets)}) > 1:
        return TagObservation(magnets, match, decoded, "ambiguous")
    tag_id = decoded.tag_id
    if tag_id is not None and tag_id in tags.built:
        layout = codec.layout_of(tags, tag_id)
        positions, _ = as_built_magnets(tags, tag_id, layout)
        indices = [layout.cells.index(cell) for cell in match.cells]
        match = refit_match(magnets, tags, match, positions[indices])
    refused = _fit_reason(magnets, tags, match, decoded)
    return TagObservation(apply_scale(magnets, match), match, decoded, refused)


def _fit_reason(magnets: DetectedMagnets, tags: Tags, match: TagMatch, decoded: DecodedTag) -> str:
    """Return the reason if grid or samples contradict a decoded tag, else ""."""
    if match.misfit_m > MAX_MISFIT_SPACINGS * tags.spacing_m:
        return "misfit"
    if abs(match.scale - 1) > MAX_SCALE_ERROR:
        return "misfit"
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
