"""How far an estimate is from the truth, and what was fitted before saying so.

The rule of this module: **no parameter but the named alignment is fitted on the truth
that scores it.** A time offset is either given or estimated on a part of the recording
that is then left out of the score; :class:`Evaluation` says which, and with which
alignment. Time offsets are added to the stamps of the estimate
(:mod:`locatk.core.association`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from locatk.core.association import (
    ALIGNMENTS,
    MAX_GAP_S,
    Array,
    Association,
    Pairs,
    associate,
    estimate_offset,
    fit_alignment,
    take,
)
from locatk.core.errors import InputError
from locatk.core.geometry import Similarity
from locatk.core.trajectory import Trajectory

__all__ = [
    "ALIGNMENTS",
    "HELD_OUT",
    "MAX_GAP_S",
    "Association",
    "Evaluation",
    "associate",
    "estimate_offset",
    "evaluate",
    "evaluate_all",
    "fit_alignment",
]

HELD_OUT = (0.0, 0.25)
"""Default part of the recording on which a time offset is estimated: its first quarter."""


@dataclass(frozen=True)
class Evaluation:
    """Position errors of one or several devices under one alignment and one time offset.

    Attributes
    ----------
    mae, rmse, sd, median, p95, max : float
        Of the Euclidean distances, in metres. MAE is their mean, SD their standard
        deviation (with n, not n - 1), so that rmse^2 = mae^2 + sd^2, as in Table I of
        the lighthouse paper.
    n : int
        Number of scored poses.
    unscored : dict of str to int
        Poses that were not scored: ``"no truth"`` and ``"held out"``.
    align : str
        Name of the alignment, one of :data:`ALIGNMENTS`, which was fitted on the scored
        poses. Nothing else was.
    alignment : Similarity
        That alignment: estimate to truth.
    offset_s : float
        Added to the stamps of the estimate.
    offset_source : str
        ``"none"``, ``"given"`` or ``"held-out ..."`` with the part it was estimated on.
    devices : tuple of str
        Names to which ``device`` points.
    device : (n,) int ndarray
        Index into ``devices``.
    time_ns : (n,) int64 ndarray
        Stamps of the scored poses, as in the estimate.
    residuals : (n, 3) ndarray
        Aligned estimate minus truth, in metres.
    errors : (n,) ndarray
        Lengths of the residuals.
    """

    mae: float
    rmse: float
    sd: float
    median: float
    p95: float
    max: float
    n: int
    unscored: dict[str, int]
    align: str
    alignment: Similarity
    offset_s: float
    offset_source: str
    devices: tuple[str, ...]
    device: NDArray[np.int32]
    time_ns: NDArray[np.int64]
    residuals: Array
    errors: Array

    @property
    def transform(self) -> Array:
        """(4, 4) homogeneous matrix of the alignment (its scale included)."""
        return self.alignment.matrix

    def as_dict(self) -> dict[str, Any]:
        """For JSON: all but the arrays of poses, with the figures of each device."""
        per_device = {}
        for i, name in enumerate(self.devices):
            errors = self.errors[self.device == i]
            per_device[name] = {"n": len(errors), **(_figures(errors) if len(errors) else {})}
        return {
            "n": self.n,
            **_figures(self.errors),
            "unscored": dict(self.unscored),
            "align": self.align,
            "align_fitted_on": "nothing" if self.align == "none" else "the scored poses",
            "scale": self.alignment.scale,
            "transform": self.transform.tolist(),
            "offset_s": self.offset_s,
            "offset_source": self.offset_source,
            "devices": per_device,
        }


def _figures(errors: Array) -> dict[str, float]:
    """The statistics of distances (n,) in metres, under their names in JSON."""
    return {
        "mae_m": float(np.mean(errors)),
        "rmse_m": float(np.sqrt(np.mean(errors**2))),
        "sd_m": float(np.std(errors)),
        "median_m": float(np.median(errors)),
        "p95_m": float(np.percentile(errors, 95)),
        "max_m": float(np.max(errors)),
    }


def evaluate(
    estimate: Trajectory,
    truth: Trajectory,
    *,
    align: str = "none",
    offset_s: float | Literal["auto"] = 0.0,
    held_out: tuple[float, float] = HELD_OUT,
    span_s: float = 1.0,
    max_gap_s: float = MAX_GAP_S,
) -> Evaluation:
    """Score one device; :func:`evaluate_all` for one pair."""
    return evaluate_all(
        [(estimate, truth)],
        align=align,
        offset_s=offset_s,
        held_out=held_out,
        span_s=span_s,
        max_gap_s=max_gap_s,
    )


def evaluate_all(
    pairs: Pairs,
    *,
    align: str = "none",
    offset_s: float | Literal["auto"] = 0.0,
    held_out: tuple[float, float] = HELD_OUT,
    span_s: float = 1.0,
    max_gap_s: float = MAX_GAP_S,
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
        part ``held_out``, which is then not scored.
    held_out : (float, float)
        That part, as fractions of the poses with truth, in the order of time over all
        pairs: (0, 0.25) is the first quarter.
    span_s : float
        Largest offset searched, see :func:`estimate_offset`.
    max_gap_s : float
        Longest gap in the truth that is bridged, see :func:`associate`.

    Raises
    ------
    InputError
        No pose has truth; or as :func:`estimate_offset`.
    DegenerateError
        The poses do not determine the alignment or the offset.
    """
    offset, source = 0.0, "none"
    windows: list[NDArray[np.bool_]] = [np.zeros(len(e), bool) for e, _ in pairs]
    if offset_s == "auto":
        windows = _held_out_poses(pairs, held_out, max_gap_s)
        training = [(take(e, w), t) for (e, t), w in zip(pairs, windows, strict=True)]
        offset = estimate_offset(training, align=align, span_s=span_s, max_gap_s=max_gap_s)
        source = f"held-out {held_out[0]:.0%} to {held_out[1]:.0%} of the recording, not scored"
    elif offset_s != 0.0:
        offset, source = float(offset_s), "given"

    names = tuple(dict.fromkeys(e.device for e, _ in pairs))
    matched, device, total = [], [], 0
    for (estimate, truth), window in zip(pairs, windows, strict=True):
        pair = associate(estimate, truth, offset_s=offset, max_gap_s=max_gap_s)
        pair = pair.take(~window[pair.index])
        matched.append(pair)
        device.append(np.full(len(pair), names.index(estimate.device), np.int32))
        total += len(estimate)
    n = sum(len(m) for m in matched)
    if n == 0:
        raise InputError(
            "no pose of the estimate has truth at its time",
            hint="check the time stamps, the time offset and the longest gap to bridge",
        )
    points = np.concatenate([m.estimate for m in matched])
    true_points = np.concatenate([m.truth for m in matched])
    if not np.all(np.isfinite(points - true_points)):
        raise InputError("estimate or truth has positions that are not numbers")
    alignment = fit_alignment(points, true_points, align)
    residuals = alignment.apply(points) - true_points
    errors = np.linalg.norm(residuals, axis=1)
    figures = {name.removesuffix("_m"): value for name, value in _figures(errors).items()}
    kept_out = int(sum(w.sum() for w in windows))
    return Evaluation(
        **figures,
        n=n,
        unscored={"no truth": total - n - kept_out, "held out": kept_out},
        align=align,
        alignment=alignment,
        offset_s=offset,
        offset_source=source,
        devices=names,
        device=np.concatenate(device),
        time_ns=np.concatenate([m.time_ns for m in matched]),
        residuals=residuals,
        errors=errors,
    )


def _held_out_poses(
    pairs: Pairs, held_out: tuple[float, float], max_gap_s: float
) -> list[NDArray[np.bool_]]:
    """Which poses of each estimate lie in the part for estimating the offset."""
    start, end = held_out
    if not (0 <= start < end <= 1) or (start, end) == (0, 1):
        raise InputError(
            f"the held-out part {start:g} to {end:g} is no proper part of the recording",
            hint="give two ascending fractions of 0 to 1 that leave something to score",
        )
    with_truth = np.sort(
        np.concatenate([associate(e, t, max_gap_s=max_gap_s).time_ns for e, t in pairs])
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
