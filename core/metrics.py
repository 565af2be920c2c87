"""How far an estimate is from the truth, and what was fitted before saying so.

The rule of this module: **no parameter but the named alignment is fitted on the truth
that scores it.** A time offset is either given or estimated on a part of the recording
that is then left out of the score; :class:`Evaluation` says which, and with which
alignment. Time offsets are added to the stamps of the estimate
(:mod:`locatk.core.association`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from locatk.core.alignment import ALIGNMENTS, fit_alignment
from locatk.core.association import (
    MATCHES,
    MAX_DIFF_S,
    MAX_GAP_S,
    Array,
    Association,
    Pairs,
    associate,
)
from locatk.core.clocks import estimate_offset
from locatk.core.consistency import consistency, nees
from locatk.core.coverage import Coverage, coverage
from locatk.core.errors import InputError
from locatk.core.evaluation import Evaluation
from locatk.core.geometry import Similarity, quaternion_from_matrix
from locatk.core.held_out import held_out_offset
from locatk.core.orientation import angle, inverse, multiply, told
from locatk.core.relative import (
    Delta,
    Drift,
    Poses,
    Relative,
    drift,
    pairs_apart,
    path_length,
    relative_errors,
)
from locatk.core.statistics import Statistics
from locatk.core.trajectory import Trajectory

__all__ = [
    "ALIGNMENTS",
    "MATCHES",
    "MAX_GAP_S",
    "Association",
    "Evaluation",
    "associate",
    "estimate_offset",
    "evaluate",
    "evaluate_all",
    "fit_alignment",
]

FARTHEST_M = 1e100
"""Beyond it, squares of distances run over."""


def evaluate(
    estimate: Trajectory,
    truth: Trajectory,
    *,
    align: str = "none",
    offset_s: float | Literal["auto"] = 0.0,
    match: str = "interpolate",
    max_diff_s: float = MAX_DIFF_S,
    max_gap_s: float = MAX_GAP_S,
    delta: str = "1f",
    all_pairs: bool = False,
    held_out: tuple[float, float] | None = None,
    span_s: float = 1.0,
) -> Evaluation:
    """Score one device; :func:`evaluate_all` for one pair."""
    return evaluate_all(
        [(estimate, truth)],
        align=align,
        offset_s=offset_s,
        match=match,
        max_diff_s=max_diff_s,
        max_gap_s=max_gap_s,
        delta=delta,
        all_pairs=all_pairs,
        held_out=held_out,
        span_s=span_s,
    )


def evaluate_all(
    pairs: Pairs,
    *,
    align: str = "none",
    offset_s: float | Literal["auto"] = 0.0,
    match: str = "interpolate",
    max_diff_s: float = MAX_DIFF_S,
    max_gap_s: float = MAX_GAP_S,
    delta: str = "1f",
    all_pairs: bool = False,
    held_out: tuple[float, float] | None = None,
    span_s: float = 1.0,
) -> Evaluation:
    """Score several devices (or runs) under one common alignment and time offset.

    Parameters
    ----------
    pairs : sequence of (Trajectory, Trajectory)
        Estimate and truth of each; a device may occur more than once.
    align : str
        One of :data:`ALIGNMENTS`; fitted on the scored poses of all pairs together.
    offset_s : float or "auto"
        Seconds to add to the stamps of the estimates. ``"auto"`` estimates it on the
        part ``held_out``, which is then not scored; where the clocks are of different times,
        from what :func:`locatk.core.clocks.coarse_offset` finds on all of them.
    match : str
        One of :data:`MATCHES`, see :func:`associate`. ``nearest`` also takes orientations at
        their word, as evo does: those of a trajectory of nothing but the identity too.
    max_diff_s : float
        Largest difference in time of ``nearest``.
    max_gap_s : float
        Longest gap in the truth that is bridged, see :func:`associate`.
    delta : str
        How far apart the poses of a relative error are, see
        :meth:`locatk.core.relative.Delta.parse`.
    all_pairs : bool
        Relative errors from each pose, not only from the end of the pair before.
    held_out : (float, float), optional
        The part for a time offset, as fractions of the poses with truth, in the order of time
        over all pairs: (0, 0.25) is the first quarter. Without it, the first of
        :data:`locatk.core.held_out.HELD_OUT` in which devices are fast enough.
    span_s : float
        Largest offset searched, see :func:`estimate_offset`.

    Raises
    ------
    InputError
        No pose has truth; or as :func:`estimate_offset`.
    DegenerateError
        The poses do not determine the alignment or the offset.
    """
    apart = Delta.parse(delta)
    offset, source = 0.0, "none"
    windows: list[NDArray[np.bool_]] = [np.zeros(len(e), bool) for e, _ in pairs]
    if offset_s == "auto":
        offset, source, windows = held_out_offset(pairs, align, held_out, span_s, max_gap_s)
    elif offset_s != 0.0:
        offset, source = float(offset_s), "given"

    matched: list[Association] = []
    for (estimate, truth), window in zip(pairs, windows, strict=True):
        pair = associate(
            estimate,
            truth,
            offset_s=offset,
            match=match,
            max_gap_s=max_gap_s,
            max_diff_s=max_diff_s,
        )
        matched.append(pair.take(~window[pair.index]))
    if not any(len(m) for m in matched):
        raise _nothing(pairs, offset)
    # Poses that ``nearest`` repeats are one pose with truth; rows ascend.
    scored = sum(int(np.count_nonzero(np.diff(m.index))) + (len(m) > 0) for m in matched)
    total, kept_out = sum(len(e) for e, _ in pairs), int(sum(w.sum() for w in windows))
    names = tuple(dict.fromkeys(e.device for e, _ in pairs))
    return _score(
        pairs,
        matched,
        align=align,
        apart=apart,
        all_pairs=all_pairs,
        at_its_word=match == "nearest",
        facts={
            "unscored": {"no truth": total - scored - kept_out, "held out": kept_out},
            "offset_s": offset,
            "offset_source": source,
            "match": match,
            "devices": names,
            "device": np.concatenate(
                [
                    np.full(len(m), names.index(e.device), np.int32)
                    for (e, _), m in zip(pairs, matched, strict=True)
                ]
            ),
            "coverage": sum(
                (coverage(e, t, offset_s=offset, max_gap_s=max_gap_s) for e, t in pairs),
                Coverage(0.0, 0.0),
            ),
        },
    )


def _score(
    pairs: Pairs,
    matched: Sequence[Association],
    *,
    align: str,
    apart: Delta,
    all_pairs: bool,
    at_its_word: bool,
    facts: dict[str, Any],
) -> Evaluation:
    """Align the matched poses, and compare."""
    points = np.concatenate([m.estimate for m in matched])
    true_points = np.concatenate([m.truth for m in matched])
    turns = np.concatenate([m.estimate_turn for m in matched])
    true_turns = np.concatenate([m.truth_turn for m in matched])
    if not np.all(np.abs(points - true_points) < FARTHEST_M):
        raise InputError(
            f"estimate or truth has positions that are not numbers, or beyond {FARTHEST_M:g} m",
            hint="correct them, or leave them out",
        )
    tells = np.concatenate(
        [
            told(e, at_its_word=at_its_word)[m.index] & told(t, at_its_word=at_its_word)[m.before]
            for (e, t), m in zip(pairs, matched, strict=True)
        ]
    )
    time = np.concatenate([m.time_ns for m in matched])
    first = int(np.argmin(time))
    alignment = fit_alignment(
        points,
        true_points,
        align,
        first=first,
        turns=(turns[first], true_turns[first]) if tells[first] else None,
    )
    moved = alignment.apply(points)
    if align != "none":
        turns = multiply(quaternion_from_matrix(alignment.rotation), turns)
    residuals = moved - true_points
    errors = np.linalg.norm(residuals, axis=1)
    turned = multiply(turns, inverse(true_turns))
    rotation_errors = np.where(tells, np.rad2deg(angle(turned)), np.nan)

    relative: list[Relative] = []
    drifts: list[Drift] = []
    path = path_estimate = 0.0
    start = 0
    for m in matched:
        rows = slice(start, start + len(m))
        oriented = bool(tells[rows].all())
        poses = Poses(
            m.time_ns,
            moved[rows],
            m.truth,
            turns[rows] if oriented else None,
            true_turns[rows] if oriented else None,
        )
        found = relative_errors(poses, *pairs_apart(poses, apart, all_pairs=all_pairs))
        relative.append(replace(found, first=found.first + start, last=found.last + start))
        drifts.append(drift(poses))
        path += path_length(m.truth)
        path_estimate += path_length(m.estimate)
        start += len(m)
    every = Relative.joined(relative)
    values, dof = _nees(
        pairs, matched, residuals, np.where(tells[:, None], turned, np.nan), alignment
    )
    return Evaluation(
        ape_translation=Statistics.of(errors),
        ape_rotation=Statistics.known(rotation_errors),
        rpe_translation=Statistics.known(every.translation),
        rpe_rotation=Statistics.known(every.rotation_deg),
        rpe_delta=str(apart),
        align=align,
        alignment=alignment,
        time_ns=time,
        residuals=residuals,
        errors=errors,
        rotation_errors_deg=rotation_errors,
        relative=every,
        path_m=path,
        path_estimate_m=path_estimate,
        drift=Drift.joined(drifts),
        consistency=consistency(values, dof),
        nees=values,
        nees_dof=dof,
        **facts,
    )


def _nees(
    pairs: Pairs,
    matched: Sequence[Association],
    residuals: Array,
    turned: Array,
    alignment: Similarity,
) -> tuple[Array, NDArray[np.int64]]:
    """Normalised errors of all matched poses and their degrees of freedom."""
    values, dof, start = [], [], 0
    for (estimate, truth), m in zip(pairs, matched, strict=True):
        rows = slice(start, start + len(m))
        start += len(m)
        if not _has_variance(estimate):
            values.append(np.full(len(m), np.nan))
            dof.append(np.zeros(len(m), np.int64))
            continue
        found = nees(
            residuals[rows],
            turned[rows],
            estimate.covariance[m.index],
            alignment,
            m.interpolated(truth.covariance) if _has_variance(truth) else None,
        )
        values.append(found[0])
        dof.append(found[1])
    return np.concatenate(values), np.concatenate(dof)


def _has_variance(trajectory: Trajectory) -> bool:
    return any(bool(np.isfinite(trajectory.covariance[:, k, k]).any()) for k in range(6))


def _nothing(pairs: Pairs, offset: float) -> InputError:
    """Why no pose was matched."""
    ends = [(t.time_ns[[0, -1]], e.time_ns[[0, -1]]) for e, t in pairs if len(e) and len(t)]
    if not ends:
        return InputError("no pose of the estimate has truth at its time", hint="one has no poses")
    true, mine = ends[0]
    late = (int(mine[0]) - int(true[0])) / 1e9 + offset
    hint = "check the time stamps, the time offset and the longest gap to bridge"
    if late > (int(true[1]) - int(true[0])) / 1e9 or late < (int(mine[0]) - int(mine[1])) / 1e9:
        when = f"{abs(late):.3f} s {'after' if late > 0 else 'before'} the truth"
        hint = f"the estimate starts {when}: give --offset, or --offset auto"
    return InputError("no pose of the estimate has truth at its time", hint=hint)
