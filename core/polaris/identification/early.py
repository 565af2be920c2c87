"""Identification of a tag before its pass has ended.

A magnet is determined as soon as the array is over it: one half of its field is like the other.
What follows after the last magnet of a tag adds little to its id and pose, but shows that there is
no other magnet. A tag is therefore read early only if

- it is complete, and read with the thresholds of a finished pass,
- the samples are explained: a white residual, and no magnet that belongs to no tag,
- no magnet can be on the points of its lattice that are ahead, where a larger tag of another design
  continues (:mod:`.evidence`): the field of a magnet reaches farther than a spacing. The id itself
  excludes that if a part of another tag would have it only by a rare coincidence.

Otherwise it is left to the end of the pass. The fit takes most of the time. It is done when the
array is over the last magnet; the samples after it are only added to it to look ahead.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError
from locatk.core.polaris.detection.fit import further_moments
from locatk.core.polaris.detection.magnets import (
    WHITE_RESIDUAL_SIGMAS,
    MagnetHypothesis,
    RunningPass,
    bar_in_frame,
    detect_running_pass,
    extend_running_pass,
    refine_running_pass,
    to_fit_frame,
)
from locatk.core.polaris.given_path import scale_to_apply
from locatk.core.polaris.identification.decoding import coincidence_probability
from locatk.core.polaris.identification.evidence import (
    MAX_COINCIDENCE_PROBABILITY,
    lattice_ahead,
)
from locatk.core.polaris.identification.matching import match_tags
from locatk.core.polaris.identification.tags import (
    IdentifiedPass,
    TagObservation,
    identify_tags,
)
from locatk.core.polaris.magnets import DetectedMagnets
from locatk.core.polaris.preprocessing import PassRange, PreprocessedSamples
from locatk.core.polaris.tag import Tags

Array = NDArray[np.float64]

MAX_AHEAD_MOMENT_RATIO, EXCLUSION_SIGMAS = 0.7, 2.0
"""Moment of a magnet ahead, relative to those of the tag, from which there may be one, and the
standard deviations that are added to its estimate."""


@dataclass(frozen=True)
class EarlyTags:
    """Tags of a running pass that are complete.

    Attributes
    ----------
    tags : Tags
        Design whose magnets were expected.
    hypothesis : MagnetHypothesis
    result : IdentifiedPass
    is_path_given : bool
        False if the path was estimated from the field.
    scale : float
        Factor of the given path.
    """

    tags: Tags
    hypothesis: MagnetHypothesis
    result: IdentifiedPass
    is_path_given: bool
    scale: float = 1.0


def identify_running(
    preprocessed: PreprocessedSamples,
    part: PassRange,
    designs: Sequence[Tags],
    path_m: Array | None = None,
    known: int = 0,
) -> EarlyTags | None:
    """Identify the tags of a pass that has not ended; None if they are incomplete or in doubt.

    Parameters
    ----------
    preprocessed : PreprocessedSamples
        The recording up to now.
    part : PassRange
        From before the first magnet to the last sample.
    designs : sequence of Tags
        Designs that may be on the floor, the expected one first.
    path_m : (n,) ndarray, optional
        Distance that the array had moved at each sample of the recording.
    known : int
        Number of tags of the pass that were identified before; more are looked for.
    """

    def identify(path: Array | None, scale: float = 1.0) -> EarlyTags | None:
        return _identify_with(preprocessed, part, designs, path, scale, known)

    early = identify(path_m)
    if path_m is None:
        return early
    if early is None:
        return identify(None)
    scale = scale_to_apply(early.result.observations[0])
    return early if scale is None else identify(path_m, scale)


def _identify_with(
    preprocessed: PreprocessedSamples,
    part: PassRange,
    designs: Sequence[Tags],
    path_m: Array | None,
    scale: float,
    known: int,
) -> EarlyTags | None:
    samples, tags = preprocessed.samples, designs[0]
    scaled = None if path_m is None else scale * path_m
    running = detect_running_pass(preprocessed, part, tags, scaled)
    if running is None:
        return None
    try:
        # The final fit of an incomplete tag would take as long as that of a complete one.
        if _count_complete_grids(running.coarse_magnets(), designs) <= known:
            return None
        hypothesis = refine_running_pass(samples, running)
    except DegenerateError:
        return None
    magnets = hypothesis.magnets
    if not magnets.residual_sigma < WHITE_RESIDUAL_SIGMAS:
        return None
    observations = identify_tags(magnets, samples, designs)
    if not all(_is_complete(each) for each in observations):
        return None
    result = IdentifiedPass(magnets, observations)
    return EarlyTags(tags, hypothesis, result, path_m is not None, scale)


def _count_complete_grids(magnets: DetectedMagnets, designs: Sequence[Tags]) -> int:
    """Return the number of tags whose magnets may all be among those of a pass."""
    used: frozenset[int] = frozenset()
    count = 0
    while True:
        complete = (
            match
            for tags in designs
            for match in match_tags(magnets, tags, used)
            if len(match.cells) == tags.magnets
        )
        match = next(complete, None)
        if match is None:
            return count
        used |= frozenset(match.magnets)
        count += 1


def _is_complete(observation: TagObservation) -> bool:
    """Return whether a tag was read with all its magnets, and no other magnet is near it."""
    decoded = observation.decoded
    if observation.tag_id is None or decoded is None or observation.unexplained:
        return False
    return decoded.erased == 0


def is_beyond_doubt(
    early: EarlyTags,
    preprocessed: PreprocessedSamples,
    part: PassRange,
    path_m: Array | None = None,
) -> bool:
    """Return whether the samples of a pass exclude that early tags are parts of larger ones.

    Parameters
    ----------
    early : EarlyTags
    preprocessed, part, path_m
        As of :func:`identify_running`, with the samples since.
    """
    doubtful = [each for each in early.result.observations if _may_be_coincidence(each)]
    if not doubtful:
        return True
    magnets, array = early.hypothesis.magnets, preprocessed.samples.array
    scaled = early.scale * path_m if early.is_path_given and path_m is not None else None
    if early.is_path_given and scaled is None:
        return False
    running = extend_running_pass(preprocessed, part, early.tags, early.hypothesis, scaled)
    if running is None or not running.coarse.rms_sigma < WHITE_RESIDUAL_SIGMAS:
        return False
    return not any(_may_continue(each, magnets, running, array.position_m) for each in doubtful)


def _may_be_coincidence(observation: TagObservation) -> bool:
    """Return whether a part of another tag may have the id of this one."""
    match, tags, decoded = observation.match, observation.tags, observation.decoded
    assert match is not None
    assert tags is not None
    assert decoded is not None
    return coincidence_probability(tags, match.cells, decoded) > MAX_COINCIDENCE_PROBABILITY


def _may_continue(
    observation: TagObservation,
    magnets: DetectedMagnets,
    running: RunningPass,
    sensors_m: Array,
) -> bool:
    """Return whether a magnet may be on the lattice of a tag ahead of the array."""
    match, tags = observation.match, observation.tags
    assert match is not None
    assert tags is not None
    half_width_m = np.abs(sensors_m[:, 1]).max() + magnets.height_m / 2
    state = running.coarse.state
    position_m = lattice_ahead(magnets, tags, match, bar_in_frame(magnets, state), half_width_m)
    if not len(position_m):
        return False
    moment, sigma = further_moments(
        running.prepared.window,
        running.coarse,
        running.priors,
        to_fit_frame(magnets, position_m),
    )
    usual = float(np.median(magnets.moment_am2[list(match.magnets)]))
    return bool(np.any(moment + EXCLUSION_SIGMAS * sigma > MAX_AHEAD_MOMENT_RATIO * usual))
