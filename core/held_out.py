"""A time offset from a part of the recording, which is then not scored.

Clocks that are far apart are brought together by the motion of the whole recording first; that
is too coarse to flatter a score.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from locatk.core.association import Pairs, associate, take
from locatk.core.clocks import clocks_agree, coarse_offset, estimate_offset
from locatk.core.errors import DegenerateError, InputError, LocatkError

HELD_OUT = ((0.0, 0.25), (0.25, 0.5), (0.5, 0.75), (0.75, 1.0))
"""Parts of the recording on which a time offset may be estimated."""

FAST_ENOUGH = 0.5
"""Speed in the part that a time offset is estimated on, of that in the fastest part: where devices
stand for most of it, errors of place outweigh those of time."""


def held_out_offset(
    pairs: Pairs,
    align: str,
    held_out: tuple[float, float] | None,
    span_s: float,
    max_gap_s: float,
) -> tuple[float, str, list[NDArray[np.bool_]]]:
    """Time offset from a part of the recording.

    Parameters
    ----------
    pairs : sequence of (Trajectory, Trajectory)
        Estimate and truth of each device.
    align, span_s, max_gap_s
        As of :func:`locatk.core.clocks.estimate_offset`.
    held_out : (float, float) or None
        The part, as fractions of the poses with truth; None for the first of :data:`HELD_OUT` in
        which devices are fast enough (:data:`FAST_ENOUGH`).

    Returns
    -------
    offset_s : float
        To be added to the stamps of the estimates.
    source : str
        What it was estimated on, in words.
    windows : list of (n,) bool ndarray
        Which poses of each estimate that were: do not score them.

    Raises
    ------
    InputError, DegenerateError
        As :func:`locatk.core.clocks.estimate_offset`, of the first part; the clocks cannot be
        brought together; ``held_out`` is no part.
    """
    around, found = 0.0, ""
    if not clocks_agree(pairs):
        coarse = coarse_offset(pairs, align=align, span_s=span_s, max_gap_s=max_gap_s)
        around, span_s = coarse.offset_s, coarse.span_s
        found = f"; clocks brought together by {coarse.by}"
        if coarse.alike:
            found += f", which fits other offsets as well ({coarse.alike})"
    parts = HELD_OUT if held_out is None else (held_out,)
    choices = [(part, _held_out_poses(pairs, part, max_gap_s, around)) for part in parts]
    speeds = [_speed(pairs, windows, max_gap_s, around) for _, windows in choices]
    # The others stay a last resort: sorting is stable.
    order = np.argsort(np.array(speeds) < FAST_ENOUGH * max(speeds), kind="stable")
    first: LocatkError | None = None
    for (start, end), windows in (choices[k] for k in order):
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


def _speed(
    pairs: Pairs, windows: Sequence[NDArray[np.bool_]], max_gap_s: float, around_s: float
) -> float:
    """Median speed of the truth at the poses of ``windows``, in m/s.

    The median, since a robot that is carried from place to place seems to move at once.
    """
    speeds = [np.zeros(1)]
    for (estimate, truth), window in zip(pairs, windows, strict=True):
        m = associate(take(estimate, window), truth, offset_s=around_s, max_gap_s=max_gap_s)
        if len(m) and len(truth) > 1:
            steps = np.linalg.norm(np.diff(truth.position, axis=0), axis=1)
            speed = steps / (np.diff(truth.time_ns) / 1e9)
            speeds.append(speed[np.minimum(m.before, len(speed) - 1)])
    return float(np.median(np.concatenate(speeds)))


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
