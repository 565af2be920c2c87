"""Score estimated trajectories against the truth.

No parameter but the named alignment is fitted on the truth that scores it. A time offset is either
given or estimated on a part of the recording that is then not scored; :class:`Evaluation` records
which, and with which alignment.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.evaluation.alignment import fit_alignment
from locatk.core.evaluation.association import (
    MAX_DIFF_S,
    MAX_GAP_S,
    Association,
    Pairs,
    associate,
)
from locatk.core.evaluation.consistency import nees_of, normalize_errors, summarize_consistency
from locatk.core.evaluation.coverage import Coverage, compute_coverage
from locatk.core.evaluation.pose_errors import (
    Delta,
    Drift,
    MatchedPoses,
    RelativeErrors,
    Statistics,
    compute_drift,
    path_length,
    relative_errors,
    select_pairs,
)
from locatk.core.evaluation.result import Evaluation
from locatk.core.evaluation.time_offset import TimeOffset, estimate_held_out_offset
from locatk.core.geometry import (
    Similarity,
    quaternion_angle,
    quaternion_from_matrix,
    quaternion_inverse,
    quaternion_multiply,
)
from locatk.core.trajectory import Trajectory, has_orientation

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

MAX_DISTANCE_M = 1e100
"""Largest coordinate of estimate and truth; squares of larger ones overflow."""

DEFAULT_DELTA = Delta(1.0, "f")
"""Relative errors are those from each pose to the next."""


@dataclass(frozen=True)
class EvaluationOptions:
    """Options of :func:`evaluate`.

    Attributes
    ----------
    align : str
        One of :data:`~locatk.core.evaluation.alignment.ALIGNMENTS`; fitted on the scored poses of
        all pairs together.
    offset_s : float or "auto"
        Seconds to add to the stamps of the estimates. ``"auto"`` estimates the offset on the part
        ``held_out``, which is then not scored; if the clocks do not agree, it first brings them
        together (:func:`~locatk.core.evaluation.coarse_offset.estimate_coarse_offset`).
    match : str
        One of :data:`~locatk.core.evaluation.association.MATCHES`. ``nearest`` also trusts
        orientations as evo does, even those of a trajectory with identity orientations only.
    max_diff_s : float
        Largest time difference of ``nearest``.
    max_gap_s : float
        Longest gap in the truth that is bridged by interpolation.
    delta : Delta
        Distance between the poses of a relative error.
    all_pairs : bool
        Compute relative errors from each pose, not only from the end of the previous pair.
    held_out : (float, float), optional
        The part for the time offset, as fractions of the poses with truth, in the order of time
        over all pairs: (0, 0.25) is the first quarter. By default, the first of
        :data:`~locatk.core.evaluation.time_offset.HELD_OUT_PARTS` in which devices are fast.
    span_s : float
        Largest offset searched.
    """

    align: str = "none"
    offset_s: float | Literal["auto"] = 0.0
    match: str = "interpolate"
    max_diff_s: float = MAX_DIFF_S
    max_gap_s: float = MAX_GAP_S
    delta: Delta = DEFAULT_DELTA
    all_pairs: bool = False
    held_out: tuple[float, float] | None = None
    span_s: float = 1.0


def evaluate(pairs: Pairs, options: EvaluationOptions | None = None) -> Evaluation:
    """Score devices (or runs) under one common alignment and time offset.

    Parameters
    ----------
    pairs : sequence of (Trajectory, Trajectory)
        Estimate and truth of each; a device may occur more than once.
    options : EvaluationOptions, optional

    Raises
    ------
    InputError
        No pose has truth, stamps do not ascend, positions are not finite, an option is unknown, or
        the time offset cannot be estimated.
    DegenerateError
        The poses do not determine the alignment or the time offset.
    """
    options = options or EvaluationOptions()
    time_offset, held_out_masks = _determine_offset(pairs, options)
    matches = [
        _match(estimate, truth, time_offset.offset_s, options, mask)
        for (estimate, truth), mask in zip(pairs, held_out_masks, strict=True)
    ]
    if not any(len(match) for match in matches):
        raise _no_match_error(pairs, time_offset.offset_s)

    estimate = np.concatenate([match.estimate for match in matches])
    truth = np.concatenate([match.truth for match in matches])
    _require_finite(estimate, truth)
    time_ns = np.concatenate([match.time_ns for match in matches])
    quaternions = np.concatenate([match.estimate_quaternion for match in matches])
    true_quaternions = np.concatenate([match.truth_quaternion for match in matches])
    is_oriented = _oriented_mask(pairs, matches, trust_identity=options.match == "nearest")

    first = int(np.argmin(time_ns))
    alignment = fit_alignment(
        estimate,
        truth,
        options.align,
        first=first,
        first_quaternions=(
            (quaternions[first], true_quaternions[first]) if is_oriented[first] else None
        ),
    )
    aligned = alignment.apply(estimate)
    if options.align != "none":
        quaternions = quaternion_multiply(quaternion_from_matrix(alignment.rotation), quaternions)

    residuals = aligned - truth
    errors = np.linalg.norm(residuals, axis=1)
    rotation_errors = quaternion_multiply(quaternions, quaternion_inverse(true_quaternions))
    rotation_errors_deg = np.where(
        is_oriented, np.rad2deg(quaternion_angle(rotation_errors)), np.nan
    )

    relative_parts: list[RelativeErrors] = []
    drift_parts: list[Drift] = []
    rows_of_matches = _row_slices(matches)
    for match, rows in zip(matches, rows_of_matches, strict=True):
        # Motions are compared with orientations only if every pose of the device has one.
        oriented = bool(is_oriented[rows].all())
        poses = MatchedPoses(
            match.time_ns,
            aligned[rows],
            match.truth,
            quaternions[rows] if oriented else None,
            true_quaternions[rows] if oriented else None,
        )
        pairs_of_poses = select_pairs(poses, options.delta, all_pairs=options.all_pairs)
        part = relative_errors(poses, *pairs_of_poses)
        relative_parts.append(
            replace(part, first=part.first + rows.start, last=part.last + rows.start)
        )
        drift_parts.append(compute_drift(poses))
    relative = RelativeErrors.concatenate(relative_parts)

    known_rotation_errors = np.where(is_oriented[:, None], rotation_errors, np.nan)
    normalized = _normalize_errors(pairs, matches, residuals, known_rotation_errors, alignment)
    nees, nees_dof = nees_of(np.concatenate(normalized))
    names = tuple(dict.fromkeys(estimate.device for estimate, _ in pairs))
    return Evaluation(
        ape_translation=Statistics.from_errors(errors),
        ape_rotation=Statistics.from_finite(rotation_errors_deg),
        rpe_translation=Statistics.from_finite(relative.translation),
        rpe_rotation=Statistics.from_finite(relative.rotation_deg),
        rpe_delta=str(options.delta),
        unscored=_count_unscored(pairs, matches, held_out_masks),
        align=options.align,
        alignment=alignment,
        time_offset=time_offset,
        match=options.match,
        devices=names,
        device=np.concatenate(
            [
                np.full(len(match), names.index(estimate.device), np.int32)
                for (estimate, _), match in zip(pairs, matches, strict=True)
            ]
        ),
        time_ns=time_ns,
        residuals=residuals,
        errors=errors,
        rotation_errors_deg=rotation_errors_deg,
        relative=relative,
        coverage=_total_coverage(pairs, time_offset.offset_s, options.max_gap_s),
        path_m=sum((path_length(match.truth) for match in matches), 0.0),
        path_estimate_m=sum((path_length(match.estimate) for match in matches), 0.0),
        drift=Drift.concatenate(drift_parts),
        consistency=summarize_consistency(normalized),
        nees=nees,
        nees_dof=nees_dof,
    )


def _determine_offset(pairs: Pairs, options: EvaluationOptions) -> tuple[TimeOffset, list[Mask]]:
    """Return the time offset and the masks of the poses that are held out for it."""
    if options.offset_s == "auto":
        return estimate_held_out_offset(
            pairs,
            align=options.align,
            held_out=options.held_out,
            span_s=options.span_s,
            max_gap_s=options.max_gap_s,
        )
    return TimeOffset.given(options.offset_s), [np.zeros(len(e), bool) for e, _ in pairs]


def _match(
    estimate: Trajectory,
    truth: Trajectory,
    offset_s: float,
    options: EvaluationOptions,
    held_out_mask: Mask,
) -> Association:
    """Associate the scored poses of one pair."""
    match = associate(
        estimate,
        truth,
        offset_s=offset_s,
        match=options.match,
        max_gap_s=options.max_gap_s,
        max_diff_s=options.max_diff_s,
    )
    return match.select(~held_out_mask[match.index])


def _require_finite(estimate: Array, truth: Array) -> None:
    """Refuse positions that are not finite, or whose squares overflow."""
    if not (np.all(np.abs(estimate) < MAX_DISTANCE_M) and np.all(np.abs(truth) < MAX_DISTANCE_M)):
        raise InputError(
            f"estimate or truth has positions that are not numbers, or beyond {MAX_DISTANCE_M:g} m",
            hint="correct them, or leave them out",
        )


def _oriented_mask(pairs: Pairs, matches: Sequence[Association], *, trust_identity: bool) -> Mask:
    """Mask (n,) of the matched poses with an orientation in both estimate and truth."""
    return np.concatenate(
        [
            has_orientation(estimate, trust_identity=trust_identity)[match.index]
            & has_orientation(truth, trust_identity=trust_identity)[match.before]
            for (estimate, truth), match in zip(pairs, matches, strict=True)
        ]
    )


def _row_slices(matches: Sequence[Association]) -> list[slice]:
    """Rows of each device in arrays of all matched poses."""
    ends = np.cumsum([len(match) for match in matches]).tolist()
    return [slice(end - len(match), end) for match, end in zip(matches, ends, strict=True)]


def _count_unscored(
    pairs: Pairs, matches: Sequence[Association], held_out_masks: Sequence[Mask]
) -> dict[str, int]:
    """Count the poses of the estimates that were not scored, by reason."""
    # A pose that ``nearest`` matches repeatedly counts once; rows ascend.
    scored = sum(int(np.count_nonzero(np.diff(m.index))) + (len(m) > 0) for m in matches)
    held_out = int(sum(mask.sum() for mask in held_out_masks))
    total = sum(len(estimate) for estimate, _ in pairs)
    return {"no truth": total - scored - held_out, "held out": held_out}


def _total_coverage(pairs: Pairs, offset_s: float, max_gap_s: float) -> Coverage:
    """Coverage of all devices together."""
    parts = (compute_coverage(e, t, offset_s=offset_s, max_gap_s=max_gap_s) for e, t in pairs)
    return sum(parts, Coverage(0.0, 0.0))


def _normalize_errors(
    pairs: Pairs,
    matches: Sequence[Association],
    residuals: Array,
    rotation_errors: Array,
    alignment: Similarity,
) -> list[Array]:
    """Return the errors of each pair (n, 6), normalized by their covariances."""
    normalized = []
    for (estimate, truth), match, rows in zip(pairs, matches, _row_slices(matches), strict=True):
        if _has_variance(estimate):
            errors = normalize_errors(
                residuals[rows],
                rotation_errors[rows],
                estimate.covariance[match.index],
                alignment,
                match.interpolate_truth(truth.covariance) if _has_variance(truth) else None,
            )
        else:
            errors = np.full((len(match), 6), np.nan)
        normalized.append(errors)
    return normalized


def _has_variance(trajectory: Trajectory) -> bool:
    """Return True if any pose reports a variance of any component."""
    return any(bool(np.isfinite(trajectory.covariance[:, k, k]).any()) for k in range(6))


def _no_match_error(pairs: Pairs, offset_s: float) -> InputError:
    """Error that explains why no pose was matched."""
    ends = [(e.time_ns[[0, -1]], t.time_ns[[0, -1]]) for e, t in pairs if len(e) and len(t)]
    message = "no pose of the estimate has truth at its time"
    if not ends:
        return InputError(message, hint="one of them has no poses")
    (start, end), (true_start, true_end) = ends[0]
    delay_s = (int(start) - int(true_start)) / 1e9 + offset_s
    is_after = delay_s > (int(true_end) - int(true_start)) / 1e9
    is_before = delay_s < (int(start) - int(end)) / 1e9
    if is_after or is_before:
        relation = f"{abs(delay_s):.3f} s {'after' if delay_s > 0 else 'before'} the truth"
        return InputError(
            message, hint=f"the estimate starts {relation}: give --offset, or --offset auto"
        )
    return InputError(
        message, hint="check the time stamps, the time offset and the longest gap to bridge"
    )
