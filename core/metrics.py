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
    take,
)
from locatk.core.clocks import clocks_agree, coarse_offset, estimate_offset
from locatk.core.consistency import consistency, nees
from locatk.core.coverage import Coverage, coverage
from locatk.core.errors import DegenerateError, InputError, LocatkError
from locatk.core.evaluation import Evaluation
from locatk.core.geometry import Similarity, quaternion_from_matrix
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
    "HELD_OUT",
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

HELD_OUT = ((0.0, 0.25), (0.25, 0.5), (0.5, 0.75), (0.75, 1.0))
"""Parts of the recording on which a time offset is estimated: the first of them that tells it."""


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
        :data:`HELD_OUT` in which there is motion enough.
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
        offset, source, windows = _offset(pairs, align, held_out, span_s, max_gap_s)
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
    if not np.all(np.isfinite(points - true_points)):
        raise InputError("estimate or truth has positions that are not numbers")
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
    apart = max(int(true[0]) - int(mine[1]), int(mine[0]) - int(true[1])) / 1e9
    hint = "check the time stamps, the time offset and the longest gap to bridge"
    if apart > 0:
        hint = f"the estimate starts {late:g} s after the truth: give --offset, or --offset auto"
    return InputError("no pose of the estimate has truth at its time", hint=hint)


def _offset(
    pairs: Pairs,
    align: str,
    held_out: tuple[float, float] | None,
    span_s: float,
    max_gap_s: float,
) -> tuple[float, str, list[NDArray[np.bool_]]]:
    """Time offset, what it was estimated on, and which poses that were."""
    around, found = 0.0, ""
    if not clocks_agree(pairs):
        coarse = coarse_offset(pairs, align=align, span_s=span_s, max_gap_s=max_gap_s)
        around, span_s = coarse.offset_s, coarse.span_s
        found = f"; clocks brought together by {coarse.by}"
    first: LocatkError | None = None
    for start, end in HELD_OUT if held_out is None else (held_out,):
        windows = _held_out_poses(pairs, (start, end), max_gap_s, around)
        training = [(take(e, w), t) for (e, t), w in zip(pairs, windows, strict=True)]
        try:
            offset = estimate_offset(
                training, align=align, span_s=span_s, max_gap_s=max_gap_s, around_s=around
            )
        except (InputError, DegenerateError) as error:
            first = first or error
            continue
        part = f"held-out {start:.0%} to {end:.0%} of the recording, not scored"
        return offset, part + found, windows
    assert first is not None
    if "first stamps" in found:
        raise InputError(
            "the motions of estimate and truth are too unlike to bring their clocks together",
            hint="give the offset, or the alignment that brings their frames together",
        )
    raise first


def _held_out_poses(
    pairs: Pairs, held_out: tuple[float, float], max_gap_s: float, around_s: float
) -> list[NDArray[np.bool_]]:
    """Which poses of each estimate lie in the part for estimating the offset."""
    start, end = held_out
    if not (0 <= start < end <= 1) or (start, end) == (0, 1):
        raise InputError(
            f"the held-out part {start:g} to {end:g} is no proper part of the recording",
            hint="give two ascending fractions of 0 to 1 that leave something to score",
        )
    with_truth = np.sort(
        np.concatenate(
            [associate(e, t, offset_s=around_s, max_gap_s=max_gap_s).time_ns for e, t in pairs]
        )
    )
    if len(with_truth) == 0:
        raise InputError(
            "no pose of the estimate has truth at its time", hint="check the time stamps"
        )
    # A window in time, not in rows: poses of other devices at that time are out as well.
    low = with_truth[int(start * len(with_truth))]
    stop = int(np.ceil(end * len(with_truth)))
    high = with_truth[stop] if stop < len(with_truth) else with_truth[-1] + 1
    return [(e.time_ns >= low) & (e.time_ns < high) for e, _ in pairs]
