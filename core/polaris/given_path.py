"""Comparison of a given path, by speed or odometry, with the path that the samples determine.

A tag is a ruler: the spacing of its magnets determines the scale of the path over it, to about half
a percent for three rows of hand-built magnets. A given path whose lengths contradict it is
rescaled, and a given path that does not explain the samples is replaced by the estimated one
(:mod:`~locatk.core.polaris.detection.magnets`). Both are reported, with the factor that fits.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.polaris import codec
from locatk.core.polaris.detection.magnets import WHITE_RESIDUAL_SIGMAS
from locatk.core.polaris.identification.matching import SCALE_SIGMA, refit_match
from locatk.core.polaris.identification.tags import IdentifiedPass, TagObservation
from locatk.core.polaris.magnets import DetectedMagnets
from locatk.core.polaris.preprocessing import PassRange
from locatk.core.polaris.tag import as_built_magnets
from locatk.core.solution import SolverWarning

Array = NDArray[np.float64]

MIN_CONTRADICTION_SIGMAS = 3.0
"""Deviation of a scale from 1, in its standard deviations, from which it contradicts a path."""

MAX_PATH_DEVIATION_M = 1e-3
"""Largest rms deviation of a given path from the one that fits, after scaling [m]; 2.5 times the
placement error of a magnet."""

MAX_COMPARED_SIGMA_M = 1e-3
"""Standard deviation of the path up to which a sample is compared [m]: far from the magnets, the
samples do not determine the path."""

MAX_GIVEN_PASS_M = 50.0
"""Length of the given path of a pass from which odometry has jumped [m]. The field of a tag changes
over less than a metre."""

MIN_COMPARED_SAMPLES = 10
"""Number of samples that a comparison needs."""


@dataclass(frozen=True)
class PathContradiction:
    """Pass whose samples contradict the given path.

    Attributes
    ----------
    scale : float
        Length of the path that fits, relative to the given one: negative if the array moved in the
        other direction, infinite if the given path rests.
    """

    scale: float


def scale_to_apply(observation: TagObservation) -> float | None:
    """Return the factor by which a given path must be multiplied; None if 1 is plausible.

    It is that of the spacing of the tag.
    """
    match, tag_id, tags = observation.match, observation.tag_id, observation.tags
    if match is None or tag_id is None or tags is None:
        return None
    positions = None
    if tag_id in tags.built:
        layout = codec.layout_of(tags, tag_id)
        built, _ = as_built_magnets(tags, tag_id, layout)
        positions = built[[layout.cells.index(cell) for cell in match.cells]]
    free = replace(observation.magnets, is_path_estimated=True)
    refitted = refit_match(free, tags, match, positions)
    deviation = abs(refitted.scale - 1) / refitted.scale_sigma
    return refitted.scale if deviation > MIN_CONTRADICTION_SIGMAS else None


def known_path(given_m: Array | None, part: PassRange) -> Array | None:
    """Return the given path; None if it is unknown at a sample of a pass, or jumps in it."""
    if given_m is None:
        return None
    own_m = given_m[part.first : part.stop]
    # The length is nan if a sample has no path.
    return given_m if np.ptp(own_m) < MAX_GIVEN_PASS_M else None


def compare_path(given_m: Array, observation: TagObservation) -> PathContradiction | None:
    """Compare the path of a pass with the given one; None if they agree or nothing is known.

    Parameters
    ----------
    given_m : (n,) ndarray
        Distance that the array had moved at each sample of the recording, as given; nan if
        unknown.
    observation : TagObservation
        Its path, if it is not the given one, was estimated from the samples or rescaled.
    """
    magnets = observation.magnets
    if observation.tag_id is None and not magnets.residual_sigma < WHITE_RESIDUAL_SIGMAS:
        return None
    given = given_m[magnets.first : magnets.stop]
    is_known = (magnets.path_sigma_m < MAX_COMPARED_SIGMA_M) & np.isfinite(given)
    if is_known.sum() < MIN_COMPARED_SAMPLES:
        return None
    given, path = given[is_known], magnets.path_m[is_known]
    if not np.ptp(given) > 0:
        return PathContradiction(np.inf)
    scale, offset = np.polyfit(given, path, 1)
    deviation_m = float(np.sqrt(np.mean((path - offset - scale * given) ** 2)))
    scale_sigma = SCALE_SIGMA
    if observation.tag_id is not None and observation.match is not None:
        scale_sigma = observation.match.scale_sigma
    # A scale of exactly 1 is that of the given path itself.
    is_contradicted = abs(scale - 1) > max(MIN_CONTRADICTION_SIGMAS * scale_sigma, 1e-6)
    is_contradicted |= deviation_m > MAX_PATH_DEVIATION_M
    return PathContradiction(float(scale)) if is_contradicted else None


def contradiction_warning(
    contradictions: Iterable[PathContradiction | None], speed_mps: float | None
) -> SolverWarning | None:
    """Return a warning for the passes of a recording that contradict the path; None if none does.

    Parameters
    ----------
    contradictions : iterable of PathContradiction or None
        One per pass.
    speed_mps : float or None
        Speed, if the path was given by a speed.
    """
    each = list(contradictions)
    scales = [c.scale for c in each if c is not None]
    if not scales:
        return None
    source = "odometry" if speed_mps is None else f"speed of {speed_mps:.4g} m/s"
    message = f"the given {source} contradicts the samples of {len(scales)} of {len(each)} passes"
    finite = [scale for scale in scales if np.isfinite(scale)]
    if finite:
        lengths = sorted({abs(min(finite, key=abs)), abs(max(finite, key=abs))})
        factor = " to ".join(dict.fromkeys(f"{length:.3g}" for length in lengths))
        message += f"; {factor} times the given lengths fit"
        if speed_mps is not None:
            message += f" ({np.mean(lengths) * speed_mps:.3g} m/s)"
    if any(scale < 0 for scale in scales):
        backward = sum(scale < 0 for scale in scales)
        message += f"; the array moved in the opposite direction in {backward} of them"
    if len(finite) < len(scales):
        message += f"; it rests in {len(scales) - len(finite)} of them"
    return SolverWarning("path_contradicted", message)


def coverage_warning(given_m: Array, passes: Sequence[DetectedMagnets]) -> SolverWarning | None:
    """Return a warning for the passes whose samples odometry does not cover; None without any.

    ``given_m`` (n,) is nan at such samples of the recording.
    """
    uncovered = [np.isnan(given_m[each.first : each.stop]).any() for each in passes]
    if not any(uncovered):
        return None
    message = (
        f"the odometry does not cover the samples of {sum(uncovered)} of {len(passes)} passes: "
        "their paths are estimated from the field. Check that both clocks are the same"
    )
    return SolverWarning("samples_without_odometry", message)


def backward_warning(
    passes: Iterable[IdentifiedPass], given_m: Array | None
) -> SolverWarning | None:
    """Return a warning if an array moved backward over tags, which no given path says.

    Inverted X axes give the field of the mirror image of a tag, in backward motion.

    Parameters
    ----------
    passes : iterable of IdentifiedPass
    given_m : (n,) ndarray or None
        Distance that the array had moved at each sample of the recording, as given; nan if unknown.
    """
    ids = []
    for each in passes:
        rows = slice(each.magnets.first, each.magnets.stop)
        is_given = given_m is not None and given_m[rows][-1] < given_m[rows][0]
        if each.magnets.path_m[-1] < each.magnets.path_m[0] and not is_given:
            ids += [tag.tag_id for tag in each.observations if tag.tag_id is not None]
    if not ids:
        return None
    names = ", ".join(map(str, dict.fromkeys(ids)))
    message = (
        f"the array moved backward over {'tag' if len(ids) == 1 else 'tags'} {names}: right if the "
        "robot drove backward or the bar is mounted backward; otherwise the X axis of the sensors "
        "is inverted, and the ids are those of mirrored tags"
    )
    return SolverWarning("moved_backward", message)
