"""From light to sweeps as the paper does it: one window of 16 us a burst, decoded by itself."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from locatk.core.errors import InputError
from locatk.core.lighthouse.channels import channel_of
from locatk.core.lighthouse.demodulation.bursts import split_bursts
from locatk.core.lighthouse.demodulation.pipeline import SHORTEST_S, DecodedSweeps
from locatk.core.lighthouse.published import light_decoding as paper_light
from locatk.core.lighthouse.recording import UNKNOWN, Edges

WINDOW_START_S = 9e-6
"""After a burst's first edge: where the authors' decoder reads most (facts/lighthouse.md 5).
Their receiver begins with the edge of an envelope that a recording of the data line alone does
not have."""


def receive(lines: Sequence[Edges]) -> tuple[DecodedSweeps, int]:
    """Sweeps of a recording, and the number of bursts that were tried.

    Parameters
    ----------
    lines : sequence of Edges
        One a photodiode.

    Returns
    -------
    sweeps : DecodedSweeps
        Dated by the start of their window, with the index as it was decoded; nothing is
        refused, and nothing tells the planes apart.
    bursts : int

    Raises
    ------
    InputError
        Nothing was decoded, or the rate is too low.
    """
    parts, tried = [], 0
    for sensor, edges in enumerate(lines):
        bursts = split_bursts(edges)
        bursts = bursts.take(bursts.duration_s > SHORTEST_S)
        tried += len(bursts)
        start = bursts.start + round(WINDOW_START_S * edges.rate_hz)
        found = paper_light.decode(paper_light.windows_of(edges, start))
        good = (found.polynomial >= 0) & (found.index >= 0)
        number = int(np.count_nonzero(good))
        parts.append(
            (start[good], np.full(number, sensor), found.polynomial[good], found.index[good])
        )
    tick, sensors, polynomial, index = (
        np.concatenate(column) for column in zip(*parts, strict=True)
    )
    if not len(tick):
        raise InputError(
            f"the paper's method decodes none of {tried} bursts", hint="Use --method soft"
        )
    order = np.argsort(tick, kind="stable")
    return DecodedSweeps(
        tick[order].astype(float),
        sensors[order].astype(np.int32),
        channel_of(polynomial[order]).astype(np.int32),
        polynomial[order].astype(np.int32),
        np.full(len(tick), UNKNOWN, np.int32),
        index[order].astype(float),
    ), tried
