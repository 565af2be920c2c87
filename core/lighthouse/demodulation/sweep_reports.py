"""Decode the factory data of base stations from recorded sweeps, by their polynomials.

A receiver that identifies the polynomial of each sweep receives the slow bit of each rotation with
it (:mod:`~locatk.core.lighthouse.demodulation.ootx`). If it reports the sweeps of nearly all
rotations, as the Lighthouse deck does, its recording contains the factory data, although the
receiver did not decode them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.lighthouse.channels import (
    CHANNELS,
    TICK_HZ,
    TICKS_PER_COUNT,
    channel_of,
    period_ticks,
)
from locatk.core.lighthouse.demodulation.ootx import (
    FIXED_BITS,
    FRAME_BITS,
    MIN_FIXED_BITS,
    decode_frames,
)
from locatk.core.lighthouse.demodulation.pipeline import (
    MAX_SLOW_BIT_GAP_ROTATIONS,
    latest_factory_data,
    vote_slow_bits,
)
from locatk.core.lighthouse.recording import NANOSECONDS_PER_S, StationReport, Sweeps
from locatk.core.solution import SolverWarning

MIN_ROTATIONS_PER_BIN = MIN_FIXED_BITS * FRAME_BITS // (2 * FIXED_BITS)
"""Rotations with a sweep, of :data:`~.ootx.FRAME_BITS` in a row, below which a device is not
decoded: a frame needs 36 of its 67 fixed bits, so about half of all, and extends over two bins."""


def report_stations(sweeps: Sweeps) -> tuple[tuple[StationReport, ...], tuple[SolverWarning, ...]]:
    """Return reports on the stations whose factory data are in the polynomials of sweeps.

    Each device is decoded by itself, those with the most sweeps of a station first, until one has
    a valid frame. Stations without any are not reported.
    """
    reports: list[StationReport] = []
    warnings: list[SolverWarning] = []
    has_slow_bit = (sweeps.polynomial >= 0) & (channel_of(sweeps.polynomial) == sweeps.channel)
    has_slow_bit &= (sweeps.channel >= CHANNELS[0]) & (sweeps.channel <= CHANNELS[-1])
    rows = np.flatnonzero(has_slow_bit)
    rows = rows[np.lexsort((sweeps.device[rows], sweeps.channel[rows]))]
    for own_rows in np.split(rows, np.flatnonzero(np.diff(sweeps.channel[rows])) + 1):
        devices = np.split(own_rows, np.flatnonzero(np.diff(sweeps.device[own_rows])) + 1)
        for device_rows in sorted(devices, key=len, reverse=True):
            report, report_warnings = _report_station(sweeps, device_rows)
            if report is not None:
                reports.append(replace(report, sweeps=len(own_rows)))
                warnings += report_warnings
                break
    return tuple(reports), tuple(warnings)


def _report_station(
    sweeps: Sweeps, rows: NDArray[np.int64]
) -> tuple[StationReport | None, list[SolverWarning]]:
    """Decode the slow bits that one device received of one station; None without a valid frame."""
    if len(rows) < MIN_ROTATIONS_PER_BIN:
        return None, []
    channel = int(sweeps.channel[rows[0]])
    rotation, polynomial = _number_rotations(sweeps, rows)
    is_new = np.diff(rotation, prepend=-1) > 0
    if np.bincount(rotation[is_new] // FRAME_BITS).max() < MIN_ROTATIONS_PER_BIN:
        return None, []
    frames = decode_frames(vote_slow_bits(rotation, polynomial))
    valid_frames = [frame for frame in frames if frame.is_valid]
    data, warnings = latest_factory_data(channel, valid_frames)
    if data is None:
        return None, []
    report = StationReport(
        channel,
        id=data.id,
        calibration=data.calibration,
        frames=len(valid_frames),
        damaged=len(frames) - len(valid_frames),
        acceleration=data.acceleration,
    )
    return report, warnings


def _number_rotations(
    sweeps: Sweeps, rows: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Number the rotations of one station by the sweeps of one device, ascending from 0.

    Rotations are numbered from one sweep to the next. Times may therefore have errors of
    milliseconds, and drift. Also returns the polynomials in this order.
    """
    period = float(period_ticks(sweeps.channel[rows[0]]))
    elapsed_ns = sweeps.time_ns[rows] - sweeps.time_ns[rows[0]]
    zero = elapsed_ns * (TICK_HZ / NANOSECONDS_PER_S) - TICKS_PER_COUNT * sweeps.count[rows]
    order = np.argsort(zero, kind="stable")
    step = np.rint(np.diff(zero[order], prepend=zero[order[0]]) / period)
    rotation = np.cumsum(np.minimum(step, MAX_SLOW_BIT_GAP_ROTATIONS)).astype(np.int64)
    return rotation, sweeps.polynomial[rows[order]]
